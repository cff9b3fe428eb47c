"""What a sweep keeps is used again only where nothing that it depends on has changed."""

from __future__ import annotations

import importlib
import math
import os
import shutil
import sqlite3
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_fixtures import write_scene

from workbench.digest import digest_of_code
from workbench.errors import DataError, UsageError
from workbench.plugins import find_stages
from workbench.recording import Recording
from workbench.session import Options, Session
from workbench.stage import StageError
from workbench.sweep import plan, worker
from workbench.sweep import run as sweeping
from workbench.sweep.cache import Cache, Kept, packed, unpacked
from workbench.sweep.plan import RECORD_FORMAT, Job, result_keys, source_of
from workbench.sweep.run import Request, Sweep

STAGES = """
from pathlib import Path
from workbench.stage import Resource, Score, recorded_camera
try:
    from toy_sweep_helper import GAIN
except ImportError:
    GAIN = 1

def number(path):
    return float(path.read_text())

class Sums(Stage):
    name = "sums"
    needs = (
        recorded_image("near"),
        recorded_camera("near").optional(),
        Resource("scale", required=False, load=number, filename="scale.txt"),
    )
    gives = (Artifact("total", "float64", ""),)
    class Parameters(StageParameters):
        level: int = knob(0, "What is added.", low=0, high=255)
        times: int = knob(1, "How often.", low=0, high=255)
    presets = {"twice": {"times": 2}}
    def compute(self, inputs, p):
        scale = inputs["scale"] or 1.0
        total = inputs["near_image"].mean() * scale * GAIN * p.times + p.level
        return {"total": np.array(float(total))}
    def figures(self, artifacts):
        return [Score("total", float(artifacts["total"]), better="higher")]

class Least(Stage):
    name = "least"
    needs = (Artifact("total", "float64", ""),)
    gives = (Artifact("least", "float64", ""),)
    def compute(self, inputs, p):
        return {"least": np.array(-inputs["total"])}
    def figures(self, artifacts):
        return [Score("value", float(artifacts["least"]), better="higher")]
"""


@pytest.fixture
def stages(plugin: Callable[..., Path]) -> Path:
    """A stage that takes an image, a resource, parameters and a helper module; and one after it."""
    return plugin(STAGES, "toys.py")


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """Three small frames, no resource beside."""
    (tmp_path / "there").mkdir()
    return write_scene(tmp_path / "there" / "toy.mcap", frames=range(3))


def swept(recording: Path, stages: Path, folder: Path, **changed: Any) -> Sweep:
    """Two cells over all frames of the recording; what is changed goes to the request's options."""
    own = {
        name: changed.pop(name)
        for name in ("axes", "pictures", "workers", "metrics", "recordings")
        if name in changed
    }
    defaults: dict[str, Any] = {"plugins": [stages], "until": "least"}
    options = Options(recording, **(defaults | changed))
    asked: dict[str, Any] = {"axes": ["sums.level=10,20"], "workers": 1, "pictures": 0} | own
    recordings = asked.pop("recordings", [recording])
    return sweeping.run(Request(options, recordings, folder, **asked))


def told(sweep: Sweep) -> list[tuple[dict[str, Any], dict[str, float]]]:
    return [(dict(row.cell.values), row.figures) for row in sweep.rows]


@pytest.fixture
def helper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Writes the module that the stage imports, as an editor would between two sweeps."""
    folder = tmp_path / "lib"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))

    def write(gain: int) -> None:
        path = folder / "toy_sweep_helper.py"
        path.write_text(f"GAIN = {gain}\n")
        # Python tells an edited module by the second: an editor is not as quick as a test.
        os.utime(path, (1_700_000_000 + gain, 1_700_000_000 + gain))
        forget()

    def forget() -> None:
        for name in [name for name in sys.modules if name.startswith("toy_sweep")]:
            del sys.modules[name]
        importlib.invalidate_caches()
        digest_of_code.cache_clear()

    yield write
    forget()


def edit_stage(_: Path, stages: Path) -> dict[str, Any]:
    stages.write_text(stages.read_text().replace("(-inputs", "(-2 * inputs"))
    return {}


def scale_beside(recording: Path, _: Path) -> dict[str, Any]:
    recording.with_name("scale.txt").write_text("5")
    return {}


def own_scale_beside(recording: Path, _: Path) -> dict[str, Any]:
    recording.with_name("toy.scale.txt").write_text("6")
    return {}


def scale_by_flag(recording: Path, _: Path) -> dict[str, Any]:
    path = recording.parent / "other"
    path.write_text("7")
    return {"resources": {"scale": path}}


def other_recording(recording: Path, _: Path) -> dict[str, Any]:
    # A file of this name and as many frames, of which the pictures are others.
    write_scene(recording, frames=range(3, 6))
    return {}


def other_topic(*_: Path) -> dict[str, Any]:
    return {"topics": {"near": "/camera/far/image"}}


def by_preset(*_: Path) -> dict[str, Any]:
    return {"preset": "twice"}


def by_config(recording: Path, _: Path) -> dict[str, Any]:
    path = recording.parent / "tuned.toml"
    path.write_text("[parameters.sums]\ntimes = 3\n")
    return {"config": path}


def by_flag(*_: Path) -> dict[str, Any]:
    return {"assignments": ["sums.times=4"]}


CHANGES = [
    edit_stage, scale_beside, own_scale_beside, scale_by_flag, other_recording, other_topic,
    by_preset, by_config, by_flag,
]  # fmt: skip


@pytest.mark.parametrize("change", CHANGES, ids=[change.__name__ for change in CHANGES])
def test_one_change_and_everything_that_depends_on_it_is_computed_anew(
    recording: Path, stages: Path, tmp_path: Path, change: Callable[..., dict[str, Any]]
) -> None:
    before = swept(recording, stages, tmp_path / "out")
    assert (before.spent.computed, before.spent.kept) == (6, 0)
    same = swept(recording, stages, tmp_path / "out")
    assert (same.spent.computed, same.spent.kept) == (0, 6)
    assert told(same) == told(before)
    options = change(recording, stages)
    after = swept(recording, stages, tmp_path / "out", **options)
    assert (after.spent.computed, after.spent.kept) == (6, 0)
    assert told(after) != told(before)
    assert not any(math.isnan(v) for _, figures in told(after) for v in figures.values())
    # What is kept now is what a folder without a past would have.
    assert told(after) == told(swept(recording, stages, tmp_path / "fresh", **options))
    assert swept(recording, stages, tmp_path / "out", **options).spent.computed == 0


def test_an_edited_helper_module_is_an_edited_stage(
    recording: Path, stages: Path, tmp_path: Path, helper: Callable[[int], None]
) -> None:
    found = []
    for gain in (2, 2, 3):
        helper(gain)
        # As another process would see it: the plugin's module is loaded anew.
        for name in [name for name in sys.modules if name.startswith("workbench_plugin_toys")]:
            del sys.modules[name]
        found.append(swept(recording, stages, tmp_path / "out"))
    assert [one.spent.computed for one in found] == [6, 0, 6]
    first, second = (one.rows[0].figures["sums.total"] - 10 for one in found[1:])
    assert second == pytest.approx(first * 3 / 2)


@pytest.mark.parametrize("name", ["numpy", "opencv-python-headless", "scipy", "scikit-image",
                                  "numba", "platform"])  # fmt: skip
def test_other_versions_of_libraries_are_other_results(
    recording: Path, stages: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    from workbench.session import library_versions

    assert name in library_versions()
    session = Session.open(Options(recording, plugins=[stages], until="least"))
    before = result_keys(session.pipeline, session.pipeline.settings)
    other = dict(library_versions()) | {name: "0"}
    monkeypatch.setattr(plan, "library_versions", lambda: other)
    plan._libraries.cache_clear()
    try:
        after = result_keys(session.pipeline, session.pipeline.settings)
    finally:
        plan._libraries.cache_clear()
    assert all(before[stage] != after[stage] for stage in ("sums", "least"))


def test_another_form_of_the_records_is_other_results(
    recording: Path, stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = Session.open(Options(recording, plugins=[stages], until="least"))
    before = result_keys(session.pipeline, session.pipeline.settings)
    monkeypatch.setattr(plan, "RECORD_FORMAT", RECORD_FORMAT + 1)
    assert result_keys(session.pipeline, session.pipeline.settings)["sums"] != before["sums"]


def test_a_parameter_changes_the_keys_from_its_stage_on(recording: Path, stages: Path) -> None:
    keys = [
        result_keys(one.pipeline, one.pipeline.settings)
        for one in (
            Session.open(Options(recording, plugins=[stages], until="least", assignments=sets))
            for sets in ([], ["sums.level=3"], ["focus_maps.window_periods=3"])
        )
    ]
    assert keys[0].keys() == {"sums", "least"} and keys[0]["sums"] != keys[0]["least"]
    assert keys[1]["sums"] != keys[0]["sums"] and keys[1]["least"] != keys[0]["least"]
    assert keys[2] == keys[0]


def test_more_frames_cost_what_is_new_in_them(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    spent = [
        swept(recording, stages, tmp_path / "out", frames=frames).spent
        for frames in ((1, 2), (0, 3), (1, None), (0, None))
    ]
    assert [one.kept for one in spent] == [0, 2, 4, 6]
    assert [one.computed for one in spent] == [2, 4, 0, 0]


def test_an_earlier_end_uses_what_a_later_one_kept(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    spent = [
        swept(recording, stages, tmp_path / "out", until=until).spent
        for until in ("sums", "least", "sums", "least")
    ]
    assert [one.computed for one in spent] == [6, 6, 0, 0]


def test_a_span_that_starts_late_has_these_frames_and_no_others(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    whole = swept(recording, stages, tmp_path / "out")
    late = swept(recording, stages, tmp_path / "late", frames=(1, 3))
    assert (whole.frames, late.frames) == ([[0, 1, 2]], [[1, 2]])
    assert [row.frames for row in late.rows] == [2, 2]
    means = [np.mean([_mean(recording, k) for k in span]) for span in (range(3), range(1, 3))]
    assert whole.rows[0].figures["sums.total"] == pytest.approx(means[0] + 10)
    assert late.rows[0].figures["sums.total"] == pytest.approx(means[1] + 10)


def _mean(recording: Path, index: int) -> float:
    [frame] = Recording.open(recording).frames(["near"], [], index, index + 1)
    return float(frame.images["near"].mean())


def test_a_span_beyond_the_end_is_told(recording: Path, stages: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"toy\.mcap: no frame in it, or in --frames"):
        swept(recording, stages, tmp_path / "out", frames=(3, 6))


def test_two_recordings_have_their_own_results_and_resources(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    other = write_scene(recording.with_name("second.mcap"), frames=range(3, 5))
    recording.with_name("second.scale.txt").write_text("3")
    both = swept(recording, stages, tmp_path / "out", recordings=[recording, other])
    assert both.frames == [[0, 1, 2], [0, 1]]
    first = [_mean(recording, k) + 10 for k in range(3)]
    second = [3 * _mean(other, k) + 10 for k in range(2)]
    assert both.rows[0].figures["sums.total"] == pytest.approx(np.mean(first + second))
    # The second's resource changed: what is kept of the first stands.
    recording.with_name("second.scale.txt").write_text("4")
    again = swept(recording, stages, tmp_path / "out", recordings=[recording, other])
    assert (again.spent.kept, again.spent.computed) == (6, 4)


def test_a_failure_is_tried_again_and_then_kept(
    recording: Path, plugin: Callable[..., Path], tmp_path: Path
) -> None:
    marker = tmp_path / "broken"
    marker.touch()
    source = STAGES.replace(
        'return {"least": np.array(-inputs["total"])}',
        f"if Path({str(marker)!r}).exists():\n            raise ValueError('broken')\n"
        '        return {"least": np.array(-inputs["total"])}',
    )
    stages = plugin(source, "toys.py")
    failed = swept(recording, stages, tmp_path / "out")
    assert [(row.failed_frames, row.error) for row in failed.rows] == [
        (3, "least: ValueError: broken")
    ] * 2
    assert all("sums.total" in row.figures for row in failed.rows)
    assert all("least.value" not in row.figures for row in failed.rows)
    marker.unlink()
    mended = swept(recording, stages, tmp_path / "out")
    assert mended.spent.computed == 6 and not any(row.failed_frames for row in mended.rows)
    assert swept(recording, stages, tmp_path / "out").spent.computed == 0


def test_a_frame_that_cannot_be_read_is_not_waited_for(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    with Cache(tmp_path / "out" / sweeping.CACHE) as cache:
        session = Session.open(Options(recording, plugins=[stages], until="least"))
        cache.put(source_of(session), {1: False}, [])
    for computed in (2, 0):
        sweep = swept(recording, stages, tmp_path / "out", frames=(0, 2))
        assert (sweep.spent.computed, sweep.frames) == (computed, [[0]])
        assert [row.frames for row in sweep.rows] == [1, 1]


def test_a_sweep_of_which_no_frame_can_be_read_is_an_error(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    with Cache(tmp_path / "out" / sweeping.CACHE) as cache:
        session = Session.open(Options(recording, plugins=[stages], until="least"))
        cache.put(source_of(session), {1: False}, [])
    with pytest.raises(DataError, match=r"toy\.mcap: no frame that can be read"):
        swept(recording, stages, tmp_path / "out", frames=(1, 2))
    assert not (tmp_path / "out" / sweeping.CELLS_TABLE).exists()


def test_pictures_that_are_lacking_are_drawn(
    recording: Path, plugin: Callable[..., Path], tmp_path: Path
) -> None:
    stages = plugin("""
class Dark(Stage):
    name = "dark"
    needs = (recorded_image("near"),)
    gives = (Artifact("darkness", "bool", "H W"),)
    class Parameters(StageParameters):
        level: int = knob(90, "What is dark.", low=0, high=255)
    def compute(self, inputs, p):
        return {"darkness": inputs["near_image"] < p.level}
""")
    common: dict[str, Any] = {"axes": ["dark.level=10,20"], "until": "dark"}
    computed = [
        swept(recording, stages, tmp_path / "out", pictures=count, **common).spent.computed
        for count in (0, 0, 1, 1, 3, 3, 0)
    ]
    # A picture more costs the cells of its frame.
    assert computed == [6, 0, 2, 0, 4, 0, 0]


# -- workers that are not alike -------------------------------------------------------------------


@pytest.fixture
def job(recording: Path, stages: Path, tmp_path: Path) -> Job:
    """What the workers of a sweep over two cells are told."""
    recording.with_name("scale.txt").write_text("5")
    return swept(recording, stages, tmp_path / "out").job


def task() -> plan.Task:
    return plan.Task(0, 0, 0, 1, ({"sums.level": 10},))


def done(job: Job) -> worker.Outcome:
    worker._opened.clear()
    return worker.work(job, task())


@pytest.mark.parametrize(
    ("field", "changed", "says"),
    [
        ("code", lambda v: v | {"least": "0"}, "code of stage least"),
        ("code", lambda v: {"sums": v["sums"]}, "code of stage least"),
        ("code", lambda v: v | {"more": "0"}, "code of stage more"),
        ("resources", lambda _: ({"scale": "0"},), "file of scale"),
        ("resources", lambda _: ({},), "file of scale"),
        ("libraries", lambda v: v | {"numpy": "0.1"}, "version of numpy"),
        ("libraries", lambda v: v | {"more": "0"}, "version of more"),
        ("sources", lambda _: ("0",), r"recording toy\.mcap"),
    ],
)
def test_a_worker_that_has_something_else_is_refused(
    job: Job, field: str, changed: Callable[[Any], Any], says: str
) -> None:
    assert done(job).seen == {0: True}
    other = replace(job, **{field: changed(getattr(job, field))})
    with pytest.raises(DataError, match=f"a worker has another {says} than this machine") as error:
        done(other)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("field", "changed"),
    [
        ("recordings", lambda v: (*v, v[0])),
        ("sources", lambda _: ("0",)),
        ("options", lambda v: replace(v, until="sums")),
        ("base", lambda _: {"sums.times": 2}),
        ("picture_stage", lambda _: "sums"),
        ("picture_frames", lambda _: (frozenset({1}),)),
        ("code", lambda v: v | {"least": "0"}),
        ("resources", lambda _: ({"scale": "0"},)),
    ],
)
def test_a_worker_opens_anew_for_whatever_a_job_has_changed(
    job: Job, field: str, changed: Callable[[Any], Any]
) -> None:
    other = replace(job, **{field: changed(getattr(job, field))})
    assert other.identified() != job.identified()
    assert replace(job, **{field: getattr(job, field)}).identified() == job.identified()


def test_a_worker_keeps_what_it_opened_for_the_same_job(
    job: Job, monkeypatch: pytest.MonkeyPatch
) -> None:
    worker._opened.clear()
    opened: list[Path] = []
    really = Session.open

    def noted(options: Options, store: Any = None) -> Session:
        opened.append(options.recording)
        return really(options, store)

    monkeypatch.setattr(Session, "open", staticmethod(noted))
    first, second = (worker.work(job, task()) for _ in range(2))
    assert len(opened) == 1
    keep = [[(one.key, one.frame, one.failed) for one in out.kept] for out in (first, second)]
    assert keep[0] == keep[1] and len(keep[0]) == 2
    # As many are held open as two, the latest used.
    for number in range(3):
        worker.work(replace(job, digest=f"{number}"), task())
        worker.work(replace(job, digest="0"), task())
    assert len(opened) == 1 + 3 and len(worker._opened) == 2
    assert [where[0] for where in worker._opened] == ["2", "0"]


def test_a_worker_has_the_parents_parameters_and_keys(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    config = tmp_path / "tuned.toml"
    config.write_text('preset = "twice"\n[parameters.sums]\nlevel = 3\n')
    found = swept(
        recording, stages, tmp_path / "out", config=config, axes=["sums.times=5,6"]
    )  # fmt: skip
    assert found.job.options.preset == "twice" and found.job.options.config is None
    assert found.job.base == {"sums.level": 3}
    mean = np.mean([_mean(recording, k) for k in range(3)])
    assert [row.figures["sums.total"] for row in found.rows] == pytest.approx(
        [5 * mean + 3, 6 * mean + 3]
    )


# -- the file that holds what is kept -------------------------------------------------------------


def test_one_sweep_at_a_time(recording: Path, stages: Path, tmp_path: Path) -> None:
    path = tmp_path / "out" / sweeping.CACHE
    with (
        Cache(path),
        pytest.raises(DataError, match=r"results\.sqlite: another sweep is at work here"),
    ):
        swept(recording, stages, tmp_path / "out")
    # The lock goes with its holder, also one that failed.
    with pytest.raises(ZeroDivisionError), Cache(path):
        raise ZeroDivisionError
    assert swept(recording, stages, tmp_path / "out").spent.computed == 6


def kept(key: str, frame: int, failed: bool = False, picture: bytes | None = None) -> Kept:
    return Kept(key, frame, failed, packed({"of": [key, frame]}), f"{key}{frame}".encode(), picture)


def test_results_are_found_by_source_key_and_frame(tmp_path: Path) -> None:
    with Cache(tmp_path / "c.sqlite") as cache:
        cache.put("a", {0: True, 1: False, 2: True}, [kept("k", 0), kept("k", 2), kept("m", 2)])
        cache.put("b", {5: True}, [kept("k", 5, picture=b"png")])
        assert list(cache.records("k", "a", range(3))) == [(0, {"of": ["k", 0]}),
                                                           (2, {"of": ["k", 2]})]  # fmt: skip
        assert list(cache.records("k", "a", range(1, 2))) == []
        assert list(cache.records("k", "a", range(2))) == [(0, {"of": ["k", 0]})]
        assert list(cache.records("k", "a", range(2, 3))) == [(2, {"of": ["k", 2]})]
        assert list(cache.outlines("m", "a", range(9))) == [(2, b"m2")]
        assert list(cache.records("m", "b", range(9))) == []
        assert cache.counts("a", 0, 3) == {"k": 2, "m": 1}
        assert cache.counts("a", 1, 3) == {"k": 1, "m": 1}
        assert cache.counts("a", 0, 2) == {"k": 1}
        assert cache.counts("b", 0, 9) == {"k": 1}
        assert (cache.readable("a"), cache.unreadable("a")) == ({0, 2}, {1})
        assert (cache.readable("b"), cache.unreadable("b")) == ({5}, set())
        assert (cache.drawn("k", "b"), cache.drawn("k", "a")) == ({5}, set())
        assert (cache.drawn("m", "b"), cache.picture("k", "b", 5)) == (set(), b"png")
        assert cache.picture("k", "a", 5) is cache.picture("k", "b", 0) is None
        assert cache.picture("m", "b", 5) is None


def test_a_later_result_replaces_an_earlier_one_of_its_place(tmp_path: Path) -> None:
    with Cache(tmp_path / "c.sqlite") as cache:
        cache.put("a", {0: False}, [kept("k", 0, picture=b"old")])
        cache.put("a", {0: True}, [replace(kept("k", 0, picture=b"new"), record=packed([1]))])
        assert list(cache.records("k", "a", range(1))) == [(0, [1])]
        assert (cache.readable("a"), cache.picture("k", "a", 0)) == ({0}, b"new")


def test_failures_are_not_counted_and_are_forgotten_alone(tmp_path: Path) -> None:
    with Cache(tmp_path / "c.sqlite") as cache:
        cache.put("a", {0: True}, [kept("k", 0, failed=True), kept("m", 0)])
        assert cache.counts("a", 0, 1) == {"m": 1}
        assert len(list(cache.records("k", "a", range(1)))) == 1
        cache.forget_failures()
        assert list(cache.records("k", "a", range(1))) == []
        assert len(list(cache.records("m", "a", range(1)))) == 1


def test_a_task_is_kept_whole_or_not_at_all(tmp_path: Path) -> None:
    class Broken:
        def __iter__(self) -> Iterator[Kept]:
            yield kept("k", 0)
            raise ZeroDivisionError

    path = tmp_path / "c.sqlite"
    with Cache(path) as cache:
        with pytest.raises(ZeroDivisionError):
            cache.put("a", {0: True}, Broken())
        assert cache.readable("a") == set() and cache.counts("a", 0, 1) == {}
        cache.put("a", {1: True}, [kept("k", 1)])
    with Cache(path) as cache:
        assert cache.readable("a") == {1} and cache.counts("a", 0, 9) == {"k": 1}


def test_the_file_of_another_program_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE mine (x)")
    db.close()
    before = path.read_bytes()
    with pytest.raises(DataError, match="expected the results of a sweep, found another file"):
        Cache(path)
    assert path.read_bytes() == before
    # Left closed: whoever owns it can go on.
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE more (x)")
    db.close()


@pytest.mark.parametrize("dtype", ["<f8", ">f4", "|b1", "<u2"])
@pytest.mark.parametrize("shape", [(), (0, 3), (2, 3)])
def test_arrays_are_kept_with_type_and_shape(dtype: str, shape: tuple[int, ...]) -> None:
    value = (np.arange(math.prod(shape)) % 2).astype(dtype).reshape(shape)
    back = unpacked(packed({"a": [value, value.T]}))["a"]
    for one, other in zip((value, value.T), back, strict=True):
        assert one.dtype == other.dtype and one.shape == other.shape
        np.testing.assert_array_equal(one, other)


# -- what is refused before any work --------------------------------------------------------------


@pytest.mark.parametrize(
    ("changed", "error", "says"),
    [
        ({"workers": 0}, UsageError, "--workers 0: expected 1 or more"),
        ({"pictures": -1}, UsageError, "--pictures -1: expected 0 or more"),
        ({"axes": []}, UsageError, "--axis: expected at least one"),
        ({"metrics": ["sums"]}, UsageError, "--metric sums: expected STAGE.FIGURE"),
        ({"metrics": ["sums."]}, UsageError, r"--metric sums\.: expected STAGE.FIGURE"),
        ({"metrics": ["nothing.x"]}, UsageError, "no stage 'nothing' is run; stages: sums, least"),
        ({"metrics": ["sums.total:best"]}, UsageError, "expected :higher, :lower or :zero"),
        ({"until": "nothing"}, UsageError, "--until nothing: no such stage"),
        ({"resources": {"none": Path(__file__)}}, UsageError, "no stage takes none"),
        ({"plugins": [Path("nothing.py")]}, StageError, r"--plugin nothing\.py: no such file"),
    ],
)  # fmt: skip
def test_what_cannot_be_swept_leaves_no_folder(
    recording: Path, stages: Path, tmp_path: Path, changed: dict[str, Any], error: Any, says: str
) -> None:
    with pytest.raises(error, match=says):
        swept(recording, stages, tmp_path / "out", **changed)
    assert not (tmp_path / "out").exists()


def test_a_recording_under_two_names_is_one(recording: Path, stages: Path, tmp_path: Path) -> None:
    again = recording.parent / ".." / "there" / "toy.mcap"
    with pytest.raises(UsageError, match="is there twice"):
        swept(recording, stages, tmp_path / "out", recordings=[recording, again])
    shutil.copy(recording, recording.with_name("copy.mcap"))
    both = [recording, recording.with_name("copy.mcap")]
    assert swept(recording, stages, tmp_path / "out", recordings=both).spent.computed == 12


@pytest.mark.parametrize(
    ("metric", "address", "cell"),
    [
        ("sums.total", "sums.total", 1),
        ("sums.total:lower", "sums.total", 0),
        ("sums.total:zero", "sums.total", 0),
        ("least.value", "least.value", 0),
        # A stage may be named by what it gives; a stage's own name comes first.
        ("total.total", "sums.total", 1),
        ("least.value:lower", "least.value", 1),
    ],
)
def test_the_best_cell_by_a_figure_and_its_way(
    recording: Path, stages: Path, tmp_path: Path, metric: str, address: str, cell: int
) -> None:
    found = swept(recording, stages, tmp_path / "out", metrics=[metric])
    [choice] = found.choices
    assert (choice.metric.address, choice.row.cell.index) == (address, cell)
    best = (tmp_path / "out" / sweeping.BEST).read_text()
    assert f"level = {10 + 10 * cell}" in best and f"the best cell {cell} of a sweep" in best
    assert address in best
    # Without a figure to choose by there is no best one, also none left from before.
    swept(recording, stages, tmp_path / "out")
    assert not (tmp_path / "out" / sweeping.BEST).exists()


def test_configurations_are_those_of_this_sweep(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    swept(recording, stages, tmp_path / "out", axes=["sums.level=10,20,30"])
    found = swept(recording, stages, tmp_path / "out")
    names = sorted(path.name for path in (tmp_path / "out" / "cells").iterdir())
    assert names == ["0000.toml", "0001.toml"]
    stages_found = find_stages([stages])
    from workbench.settings import resolve

    for cell, path in found.configurations.items():
        settings = resolve(stages_found, None, path)
        assert settings.changed == {"sums.level": 10 + 10 * cell}


# -- what is told at the end ----------------------------------------------------------------------


def with_figures(plugin: Callable[..., Path], figures: str, compute: str = "") -> Path:
    """The stages, of which the second says other figures."""
    source = STAGES.replace('[Score("value", float(artifacts["least"]), better="higher")]', figures)
    if compute:
        source = source.replace('return {"least": np.array(-inputs["total"])}', compute)
    return plugin(source, "toys.py")


@pytest.mark.parametrize(
    ("figures", "compute", "metric", "error", "says"),
    [
        ('[Score("value", 1.0)]', "", "least.value", UsageError,
         "--metric least.value: its stage does not say which way is better; expected "
         "least.value:higher, :lower or :zero"),
        ('[Score("value", 1.0)]', "", "least.other", UsageError,
         "--metric least.other: no such figure; there are: sums.total, least.value"),
        ("[]", "raise ValueError('dark')", "least.value", DataError,
         "--metric least.value: no cell has it, for every one failed: least: ValueError: dark"),
        ("[]", "raise ValueError('dark')", "sums.other", DataError,
         "--metric sums.other: no cell has it, for every one failed: least: ValueError: dark"),
    ],
)  # fmt: skip
def test_a_figure_to_choose_by_that_there_is_not_is_told(
    recording: Path, plugin: Callable[..., Path], tmp_path: Path, figures: str, compute: str,
    metric: str, error: type[Exception], says: str,
) -> None:  # fmt: skip
    stages = with_figures(plugin, figures, compute)
    with pytest.raises(error) as told_of:
        swept(recording, stages, tmp_path / "out", metrics=[metric])
    assert str(told_of.value) == says
    assert not (tmp_path / "out" / sweeping.CELLS_TABLE).exists()


def test_a_way_that_is_asked_for_stands_for_one_that_the_stage_does_not_say(
    recording: Path, plugin: Callable[..., Path], tmp_path: Path
) -> None:
    stages = with_figures(plugin, '[Score("value", float(artifacts["least"]))]')
    found = swept(recording, stages, tmp_path / "out", metrics=["least.value:lower"])
    assert [choice.row.cell.index for choice in found.choices] == [1]
    ways = {metric.address: metric.better for metric in found.metrics}
    assert ways == {"sums.total": "higher", "least.value": "lower"}


def test_the_first_figure_makes_the_best_configuration(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    asked = ["least.value", "sums.total"]
    found = swept(recording, stages, tmp_path / "out", metrics=asked)
    assert [choice.row.cell.index for choice in found.choices] == [0, 1]
    assert "level = 10" in (tmp_path / "out" / sweeping.BEST).read_text()
    reasons = [path.read_text().splitlines()[1] for path in found.configurations.values()]
    totals = [row.figures["sums.total"] for row in found.rows]
    figures = [f"least.value = {-t:.6g}, sums.total = {t:.6g}" for t in totals]
    assert reasons == [
        f'reason = "the best cell 0 of a sweep: {figures[0]}"',
        f'reason = "cell 1 of a sweep: {figures[1]}"',
    ]


def test_of_many_cells_the_best_have_configurations(
    recording: Path, stages: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweeping, "MOST_CONFIGURATIONS", 2)
    axes = ["sums.level=10,50,30,40,20"]
    for metrics, kept_cells in ((["least.value"], [0, 4]), (["sums.total"], [1, 3]), ([], [0, 1]),
                                (["sums.total", "least.value"], [0, 1, 3])):  # fmt: skip
        found = swept(recording, stages, tmp_path / "out", axes=axes, metrics=metrics)
        assert sorted(found.configurations) == kept_cells
        names = sorted(path.stem for path in (tmp_path / "out" / "cells").iterdir())
        assert names == [f"{cell:04d}" for cell in kept_cells]


def test_a_configuration_that_is_the_same_is_not_written_again(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    found = swept(recording, stages, tmp_path / "out", metrics=["sums.total"])
    paths = [*found.configurations.values(), tmp_path / "out" / sweeping.BEST]
    before = [path.stat().st_ino for path in paths]
    swept(recording, stages, tmp_path / "out", metrics=["sums.total"])
    assert [path.stat().st_ino for path in paths] == before
    swept(recording, stages, tmp_path / "out", metrics=["least.value"])
    assert [path.stat().st_ino for path in paths] != before


def test_a_sweep_says_where_its_results_come_from(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    other = write_scene(recording.with_name("second.mcap"), frames=range(2))
    recording.with_name("scale.txt").write_text("2")
    found = swept(
        recording, stages, tmp_path / "out", recordings=[recording, other],
        axes=["sums.level=10,20", "sums.times=1,2"], assignments=["sums.level=7"],
        metrics=["sums.total"],
    ).provenance  # fmt: skip
    session = Session.open(
        Options(recording, plugins=[stages], until="least", assignments=["sums.level=7"])
    )
    plain = session.provenance()
    assert found["recordings"] == [
        {
            "name": path.name,
            "digest": Recording.open(path).digest,
            "resources": plain["resources"],
        }
        for path in (recording, other)
    ]
    assert found["sweep"] == {
        "axes": {"sums.level": [10, 20], "sums.times": [1, 2]},
        "zipped": [],
        "cells": 4,
        "of": 4,
        "seed": None,
        "metrics": ["sums.total"],
    }
    for name in ("bench", "code", "libraries", "parameters", "preset", "changed", "frames", "until",
                 "topics", "python"):  # fmt: skip
        assert found[name] == plain[name], name
    assert "recording" not in found and "resources" not in found


def test_a_sample_of_zipped_axes_says_so(recording: Path, stages: Path, tmp_path: Path) -> None:
    options = Options(recording, plugins=[stages], until="sums")
    request = Request(
        options, [recording], tmp_path / "out",
        ["sums.level=10,20,30", "sums.times=1,2,3"], ["sums.level,sums.times"], 2, 5,
        workers=1, pictures=0,
    )  # fmt: skip
    found = sweeping.run(request)
    told_of = found.provenance["sweep"]
    assert told_of["zipped"] == [["sums.level", "sums.times"]]
    assert (told_of["cells"], told_of["of"], told_of["seed"]) == (2, 3, 5)
    assert len(found.rows) == 2 and {len(row.cell.values) for row in found.rows} == {2}


def test_progress_is_told_from_what_was_kept_to_all_of_it(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    swept(recording, stages, tmp_path / "out", frames=(0, 1))
    reached: list[tuple[int, int]] = []
    finished: list[Any] = []
    options = Options(recording, plugins=[stages], until="least")
    request = Request(
        options, [recording], tmp_path / "out", ["sums.level=10,20"], workers=1, pictures=0
    )

    def finish(sweep: Sweep, cache: Cache) -> None:
        finished.append(sweep)
        assert cache.readable(sweep.job.sources[0]) == {0, 1, 2}

    found = sweeping.run(request, lambda done, total: reached.append((done, total)), finish)
    assert reached == [(2, 6), (4, 6), (6, 6)]
    assert finished == [found] and found.spent.tasks == 2
    assert 0 < found.spent.stages < found.spent.workers <= found.spent.total
    assert 0 < found.spent.computing <= found.spent.total


def test_cells_with_the_same_results_have_the_same_digest_and_others_another(
    recording: Path, stages: Path, tmp_path: Path
) -> None:
    cells = [row.digest for row in swept(recording, stages, tmp_path / "out").rows]
    again = [row.digest for row in swept(recording, stages, tmp_path / "other").rows]
    assert cells == again and len(set(cells)) == 2
    recording.with_name("scale.txt").write_text("2")
    other = [row.digest for row in swept(recording, stages, tmp_path / "out").rows]
    assert not set(other) & set(cells)

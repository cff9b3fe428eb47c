"""Sweeps: shared results, kept results, workers that die, and tables that are always the same."""

from __future__ import annotations

import json
import signal
import sqlite3
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import Command, write_again
from waiting import until_running

from workbench.plugins import find_stages
from workbench.recording import Frame
from workbench.session import Options, Session
from workbench.sweep.analysis import choose, main_effects
from workbench.sweep.axes import Axis, Grid
from workbench.sweep.cache import Cache, packed, unpacked
from workbench.sweep.pictures import agreement, borders, outline_of
from workbench.sweep.table import TIMES, Metric, Row, slug

TINY = """
import os, signal, time
from pathlib import Path
from workbench.stage import Score, Scorer

HERE = Path(__file__).parent

def note(name):
    with (HERE / "computed.txt").open("a") as file:
        file.write(name + "\\n")

class Dark(Stage):
    name = "dark"
    needs = (recorded_image("near"),)
    gives = (Artifact("darkness", "bool", "H W"),)
    class Parameters(StageParameters):
        level: int = knob(90, "What is dark.", low=0, high=255)
    def compute(self, inputs, p):
        note(self.name)
        return {"darkness": inputs["near_image"] < p.level}
    def figures(self, artifacts):
        return [Score("share", float(artifacts["darkness"].mean()), better="lower")]

class Agreed(Scorer):
    def __init__(self):
        self.right, self.pixels = 0, 0
    def add(self, truth, artifacts):
        right = artifacts["darkest"] == (truth.instances > 0)
        self.right += int(right.sum())
        self.pixels += right.size
        return {"agreed": float(right.mean())}
    def summary(self):
        return [Score("agreed (all)", self.right / self.pixels, "share", better="higher")]
    def state(self):
        return {"right": self.right, "pixels": self.pixels}
    def take(self, state):
        self.right += state["right"]
        self.pixels += state["pixels"]

class Darkest(Stage):
    name = "darkest"
    needs = (Artifact("darkness", "bool", "H W"),)
    gives = (Artifact("darkest", "bool", "H W"),)
    class Parameters(StageParameters):
        rows: int = knob(0, "Rows that count.", low=0, high=255)
        mood: str = knob("well", "What to do.")
    def compute(self, inputs, p):
        note(self.name)
        marker = HERE / "marker"
        if p.mood == "raise":
            raise ValueError("in a bad mood")
        if p.mood == "die" and not marker.exists():
            marker.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        if p.mood == "held" and (HERE / "held").exists():
            # After some frames, for as long as it takes to be killed.
            if (HERE / "computed.txt").read_text().split().count(self.name) > int(
                (HERE / "held").read_text()
            ):
                (HERE / "inside").touch()
                time.sleep(600)
        out = inputs["darkness"].copy()
        out[: p.rows] = False
        return {"darkest": out}
    def scorer(self):
        return Agreed()
"""


@pytest.fixture
def tiny(plugin: Callable[[str], Path]) -> Path:
    """Two quick stages that write down each of their calls."""
    return plugin(TINY)


def swept(bench: Command, scene: Path, tiny: Path, *arguments: object, to: str = "out") -> Any:
    ended = bench(
        *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:3"),
        *("--to", to, "--json", *arguments),
    )
    assert ended.code == 0, ended.err
    return ended.json


GRID = (
    *("--axis", "dark.level=60:120:30", "--axis", "darkest.rows=0,20,40"),
    *("--metric", "darkest.agreed"),
)
TEN_MILLION = (
    *("--axis", "dark.level=0:255:1", "--axis", "darkest.rows=0:255:1"),
    *("--axis", "darkest.mood=" + ",".join(f"m{n}" for n in range(200))),
)


def tables(folder: Path) -> dict[str, Any]:
    """Both tables without their times."""
    found = {}
    for name in ("cells", "frames"):
        table = pq.read_table(folder / f"{name}.parquet")
        kept = [column for column in table.column_names if not column.startswith(TIMES)]
        found[name] = table.select(kept)
    return found


def computed(tiny: Path) -> Counter[str]:
    return Counter((tiny.parent / "computed.txt").read_text().split())


def test_a_stage_runs_once_for_the_cells_that_share_it(
    bench: Command, scene: Path, tiny: Path
) -> None:
    said = swept(bench, scene, tiny, *GRID, "--workers", 1)
    # Three levels by three rows, over three frames; each stage's very first call is a warm-up.
    assert computed(tiny) == {"dark": 3 * 3 + 1, "darkest": 9 * 3 + 1}
    assert (said["cells"], said["spent"]["computed"], said["spent"]["kept"]) == (9, 27, 0)


def test_what_was_computed_is_kept(bench: Command, scene: Path, tiny: Path) -> None:
    swept(bench, scene, tiny, *GRID, "--workers", 1)
    before, first = computed(tiny), tables(Path("out"))
    said = swept(bench, scene, tiny, *GRID, "--workers", 1)
    assert computed(tiny) == before
    assert (said["spent"]["computed"], said["spent"]["kept"]) == (0, 27)
    assert tables(Path("out")) == first
    # A wider grid costs what is new in it: one level on three frames.
    wider = swept(
        *(bench, scene, tiny, "--axis", "dark.level=60:150:30", "--axis", "darkest.rows=0,20,40"),
        *("--workers", 1),
    )
    assert wider["spent"]["computed"] == 9


def test_the_table_holds_what_a_run_of_the_cell_says(
    bench: Command, scene: Path, tiny: Path
) -> None:
    said = swept(bench, scene, tiny, *GRID, "--workers", 1)
    cells = pq.read_table("out/cells.parquet")
    assert cells.column_names[:3] == ["cell", "dark.level", "darkest.rows"]
    assert json.loads(cells.schema.metadata[b"workbench.provenance"])["sweep"]["cells"] == 9
    rows = cells.to_pylist()
    assert [row["cell"] for row in rows] == list(range(9))
    best = max(rows, key=lambda row: row["darkest.agreed"])
    assert said["best"][0]["values"] == {name: best[name] for name in said["axes"]}
    ended = bench(
        *("evaluate", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:3"),
        *("--config", "out/best.toml", "--json"),
    )
    [score] = ended.json["scores"]["darkest"]
    assert score["value"] == best["darkest.agreed"]
    assert said["best"][0]["value"] == best["darkest.agreed"]
    frames = pq.read_table("out/frames.parquet").to_pylist()
    assert [(row["cell"], row["frame"]) for row in frames] == [
        (cell, frame) for cell in range(9) for frame in range(3)
    ]
    own = [row["dark.share"] for row in frames if row["cell"] == 4]
    assert rows[4]["dark.share"] == pytest.approx(np.mean(own), abs=1e-15)


def test_the_tables_are_the_same_for_any_number_of_workers(
    bench: Command, scene: Path, tiny: Path
) -> None:
    for workers in (1, 2):
        swept(bench, scene, tiny, *GRID, "--workers", workers, to=f"of{workers}")
    assert tables(Path("of1")) == tables(Path("of2"))
    assert Path("of1/best.toml").read_text() == Path("of2/best.toml").read_text()


@pytest.mark.needs("distributed")
@pytest.mark.process
@pytest.mark.slow
def test_the_tables_of_a_cluster_are_the_same_though_a_worker_dies(
    bench: Command, scene: Path, tiny: Path
) -> None:
    import distributed

    axes = (*GRID, "--axis", "darkest.mood=well,die")
    marker = tiny.parent / "marker"
    marker.touch()
    swept(bench, scene, tiny, *axes, "--workers", 1, to="here")
    marker.unlink()
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=":0",
        silence_logs=50,
    ) as cluster:
        swept(bench, scene, tiny, *axes, "--scheduler", cluster.scheduler_address, to="there")
    assert marker.exists()
    assert tables(Path("here")) == tables(Path("there"))


def test_a_killed_sweep_goes_on_where_it_was(
    bench: Command, scene: Path, tiny: Path, started: Callable[..., Any], tmp_path: Path
) -> None:
    arguments = (*GRID, "--axis", "darkest.mood=held,well", "--workers", 1)
    shared = ("--plugin", tiny, "--until", "darkest", "--frames", "0:3", *arguments)
    # A frame costs 18 cells, and the first call of all is done twice: this is in the second frame.
    (tiny.parent / "held").write_text("25")
    child = started("sweep", scene, *shared, "--to", "killed")
    until_running(child, (tiny.parent / "inside").exists, tmp_path / "stderr")
    child.send_signal(signal.SIGKILL)
    child.wait()
    (tiny.parent / "held").unlink()
    assert kept_frames(tmp_path / "killed" / ".cache" / "results.sqlite") == 1
    said = swept(bench, scene, tiny, *arguments, to="killed")
    assert (said["spent"]["kept"], said["spent"]["computed"]) == (18, 36)
    whole = swept(bench, scene, tiny, *arguments, to="whole")
    assert (whole["spent"]["kept"], whole["spent"]["computed"]) == (0, 54)
    assert tables(tmp_path / "killed") == tables(tmp_path / "whole")


def kept_frames(store: Path) -> int:
    """Frames of which a sweep has kept everything."""
    with closing(sqlite3.connect(store)) as db:
        return int(db.execute("SELECT count(*) FROM frames").fetchone()[0])


def test_a_worker_that_dies_costs_a_retry(bench: Command, scene: Path, tiny: Path) -> None:
    axes = ("--axis", "darkest.rows=0,20", "--axis", "darkest.mood=well,die")
    said = swept(bench, scene, tiny, *axes, "--workers", 2)
    assert (tiny.parent / "marker").exists()
    assert said["failed_cells"] == []
    rows = pq.read_table("out/cells.parquet").to_pylist()
    agreed = {
        mood: [row["darkest.agreed"] for row in rows if row["darkest.mood"] == mood]
        for mood in ("well", "die")
    }
    assert agreed["well"] == agreed["die"]
    assert None not in agreed["die"]


def test_a_stage_that_raises_is_a_row_with_its_error(
    bench: Command, scene: Path, tiny: Path
) -> None:
    said = swept(
        *(bench, scene, tiny, "--axis", "darkest.mood=well,raise", "--metric", "darkest.agreed"),
        *("--workers", 1),
    )
    assert said["failed_cells"] == [1]
    well, failed = pq.read_table("out/cells.parquet").to_pylist()
    assert (failed["failed_frames"], failed["error"]) == (3, "darkest: ValueError: in a bad mood")
    assert failed["darkest.agreed"] is None
    assert failed["dark.share"] == well["dark.share"]
    assert (well["failed_frames"], well["error"]) == (0, "")
    # What failed is tried again, what did not is not.
    assert swept(bench, scene, tiny, "--axis", "darkest.mood=well,raise")["spent"]["computed"] == 3


def test_a_sweep_of_which_every_cell_fails_ends_with_1(
    bench: Command, scene: Path, tiny: Path
) -> None:
    ended = bench(
        *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:1"),
        *("--axis", "darkest.rows=1,2", "--set", "darkest.mood=raise", "--workers", 1),
    )
    assert ended.code == 1
    assert "in a bad mood" in ended.out


def test_a_full_disk_ends_with_one_line_and_keeps_what_was_done(
    bench: Command, scene: Path, tiny: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    swept(bench, scene, tiny, *GRID, "--workers", 1, to="whole")
    with sqlite3.connect("whole/.cache/results.sqlite") as db:
        pages = db.execute("PRAGMA page_count").fetchone()[0]
    opened = Cache.__init__

    def small(self: Cache, path: Path) -> None:
        opened(self, path)
        self._db.execute(f"PRAGMA max_page_count = {2 * pages // 3}")

    with monkeypatch.context() as patched:
        patched.setattr(Cache, "__init__", small)
        ended = bench(
            *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:3"),
            *(*GRID, "--to", "out", "--workers", 1),
        )
    assert ended.code == 1
    assert "the disk is full" in ended.mistake
    assert not Path("out/cells.parquet").exists()
    said = swept(bench, scene, tiny, *GRID, "--workers", 1)
    assert 0 < said["spent"]["kept"] < 27


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--axis", "dark.levl=1,2"), 2, "it has: level"),
        (("--axis", "dark.level=9:1:1"), 2, "empty range"),
        (TEN_MILLION, 2, "--sample"),
        (("--axis", "recognition.step=1,2"), 2, "recognition is not run"),
        (("--axis", "dark.level=1,2", "--metric", "nothing.agreed"), 2, "no stage 'nothing'"),
        (("--axis", "dark.level=1,2", "--metric", "darkest"), 2, "STAGE.FIGURE"),
        (("--axis", "dark.level=1,2", "--metric", "darkest.agreed:up"), 2, ":higher"),
        (("--axis", "dark.level=1,2", "--workers", "0"), 2, "--workers"),
        (("--axis", "dark.level=1,2", "--scheduler", "nonsense"), 1, "--scheduler nonsense"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(
    bench: Command,
    scene: Path,
    tiny: Path,
    arguments: tuple[str, ...],
    code: int,
    says: str,
) -> None:
    ended = bench(
        *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:1"),
        *("--workers", 1, "--to", "out", *arguments),
    )
    assert ended.code == code
    assert says in ended.mistake


def test_a_figure_that_is_not_there_is_told_early_and_at_the_end(
    bench: Command, scene: Path, tiny: Path
) -> None:
    ended = bench(
        *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:3"),
        *("--workers", 1, "--to", "out", "--axis", "dark.level=60,90"),
        *("--metric", "darkest.agrees"),
    )
    early, late = ended.err.splitlines()
    assert early.startswith("warning: --metric darkest.agrees: no such figure so far")
    assert "darkest.agreed" in early
    assert late.startswith("workbench: --metric darkest.agrees: no such figure")
    assert ended.code == 2
    # Nothing is lost: with the right name the same sweep is there at once.
    said = swept(*(bench, scene, tiny, "--axis", "dark.level=60,90", "--metric", "darkest.agreed"))
    assert said["spent"]["computed"] == 0


def test_another_file_in_the_place_of_the_kept_results_is_told(
    bench: Command, scene: Path, tiny: Path
) -> None:
    path = Path("out/.cache/results.sqlite")
    path.parent.mkdir(parents=True)
    for content in (b"not a database at all, but text " * 40, None):
        if content is not None:
            path.write_bytes(content)
        else:
            path.unlink()
            with sqlite3.connect(path) as db:
                db.execute("CREATE TABLE mine (x)")
            db.close()
        before = path.read_bytes()
        ended = bench(
            *("sweep", scene, "--plugin", tiny, "--until", "darkest", "--frames", "0:1"),
            *("--to", "out", "--axis", "dark.level=1,2"),
        )
        assert ended.code == 1
        assert "expected the results of a sweep" in ended.mistake
        assert path.read_bytes() == before


# -- the parts ------------------------------------------------------------------------------------


def test_scorers_put_together_from_their_states_say_what_one_scorer_says(scene: Path) -> None:
    session = Session.open(Options(scene, frames=(0, 3)))
    runs = list(session.runs())
    scored = 0
    for stage in session.pipeline.stages:
        whole, parted = stage.scorer(), stage.scorer()
        if whole is None or parted is None:
            continue
        for run in runs:
            alone = stage.scorer()
            assert alone is not None
            assert whole.add(run.frame.truth, run.artifacts) == alone.add(
                run.frame.truth, run.artifacts
            )
            parted.take(unpacked(packed(alone.state())))
        assert whole.summary() == parted.summary()
        assert all(score.better for score in whole.summary())
        scored += bool(whole.summary())
    assert scored >= 6


def test_figures_and_pictures_need_no_ground_truth(scene: Path) -> None:
    session = Session.open(Options(scene, frames=(0, 1)))
    [run] = session.runs()
    named = {}
    for stage in session.pipeline.stages:
        for score in stage.figures(run.artifacts):
            named[f"{stage.name}.{slug(score.name)}"] = score.value
        picture = stage.picture(run.artifacts)
        assert picture is None or (picture.dtype == np.uint8 and picture.shape[:2] == (256, 256))
    shares = (
        "depth_cloud.coverage",
        "linked_edges.linked_terminators",
        "region_features.closed_lines",
    )
    assert all(0 < named[name] <= 1 for name in shares)
    assert named["recognition.picks"] == 1


def test_names_of_figures() -> None:
    assert slug("faces found (IoU ≥ 0.7)") == "faces_found"
    assert slug("faces' interior rms") == "faces_interior_rms"
    assert slug("planes, worst in middle 32×32") == "planes_worst_in_middle_32x32"


def rows_of(
    values: dict[tuple[int, ...], float], failed: frozenset[tuple[int, ...]] = frozenset()
) -> tuple[Grid, list[Row]]:
    lengths = [max(place[n] for place in values) + 1 for n in range(len(next(iter(values))))]
    axes = tuple((Axis(f"s.p{n}", tuple(range(length))),) for n, length in enumerate(lengths))
    whole = Grid(axes)
    return whole, [
        Row(cell, "", 1, int(cell.place in failed), "", {"s.m": values[cell.place]})
        for cell in whole.cells()
    ]


def test_the_best_cell_its_surroundings_and_what_matters() -> None:
    metric = Metric("s.m", "m", better="higher")
    # The first axis alone decides, but for one cell that stands by itself.
    values = {(x, y): float(10 - abs(x - 3)) for x in range(7) for y in range(3)}
    whole, rows = rows_of(values)
    choice = choose(whole, rows, metric)
    assert choice is not None
    assert choice.row.cell.place == (3, 1)
    assert choice.equals == 2
    assert len(choice.flat.cells) == 3
    assert choice.flat.spans == {"s.p0": (3, 3), "s.p1": (0, 2)}
    assert main_effects(whole, rows, metric) == pytest.approx({"s.p0": 1.0, "s.p1": 0.0})
    whole, rows = rows_of(values | {(0, 0): 11.0}, frozenset({(0, 0)}))
    choice = choose(whole, rows, metric)
    assert choice is not None and choice.row.cell.place == (3, 1)


def test_what_better_means() -> None:
    whole, rows = rows_of({(0,): -3.0, (1,): 0.5, (2,): 2.0})
    for better, place in (("higher", 2), ("lower", 0), ("zero", 1)):
        choice = choose(whole, rows, Metric("s.m", "m", better=better))  # type: ignore[arg-type]
        assert choice is not None and choice.row.cell.place == (place,)
    whole, rows = rows_of({(0,): float("nan"), (1,): float("nan")})
    assert choose(whole, rows, Metric("s.m", "m", better="lower")) is None


def test_agreement_of_outlines() -> None:
    stage = find_stages()["region_features"]
    labels = np.zeros((32, 32), np.int32)
    labels[8:24, 8:24] = 1
    shifted = np.roll(labels, 8, axis=1)
    one, same, other = (
        outline_of(stage, {"labels": image}) for image in (labels, labels * 7, shifted)
    )
    assert one is not None and same is not None and other is not None
    assert agreement([one], [same]) == 1
    assert 0 < agreement([one], [other]) < 0.5
    assert agreement([one, one], [same, other]) == pytest.approx(
        (1 + agreement([one], [other])) / 2
    )
    # The right and lower neighbours: the corner at the top left is in no pair.
    assert borders(labels).sum() == 4 * 16 - 1
    assert outline_of(stage, {"labels": None}) is None


def test_what_is_kept_comes_back_as_it_was() -> None:
    value = {
        "a": [1, 2.5, None, "text", True, float("inf")],
        "b": {"c": np.arange(6, dtype=np.uint16).reshape(2, 3), "d": np.float32(0.5)},
    }
    back = unpacked(packed(value))
    assert back["a"] == value["a"]
    np.testing.assert_array_equal(back["b"]["c"], np.arange(6).reshape(2, 3))
    assert back["b"]["c"].dtype == np.uint16
    assert back["b"]["d"] == 0.5
    with pytest.raises(TypeError, match="a set"):
        packed({"a": {1, 2}})


def test_a_recording_given_twice_is_refused(bench: Command, scene: Path) -> None:
    ended = bench("sweep", scene, scene, "--axis", "linked_edges.reach=3,5")
    assert (ended.code, "twice" in ended.mistake) == (2, True)


def test_two_recordings_count_as_one_run(
    bench: Command, tiny: Path, twins: dict[str, Path], first_frames: list[Frame], tmp_path: Path
) -> None:
    """The second has fewer frames and other images, so that neither can stand for the other."""
    dimmed = [replace(frame, images=dim(frame.images)) for frame in first_frames[:2]]
    other = write_again(tmp_path / "other.mcap", dimmed, 2)
    ended = bench(
        *("sweep", twins["protobuf"], other, "--plugin", tiny, "--until", "dark"),
        *("--axis", "dark.level=60,90", "--to", "out", "--workers", 1, "--json"),
    )
    assert ended.code == 0, ended.err
    images = [frame.images["near"] for frame in (*first_frames, *dimmed)]
    rows = pq.read_table("out/frames.parquet").to_pylist()
    cells = pq.read_table("out/cells.parquet").to_pylist()
    for cell, level in enumerate((60, 90)):
        expected = [float((image < level).mean()) for image in images]
        assert len(set(expected)) == 5
        own = [row for row in rows if row["cell"] == cell]
        assert [row["dark.share"] for row in own] == pytest.approx(expected)
        assert [row["frame"] for row in own] == [0, 1, 2, 0, 1]
        # Every frame counts alike, whichever recording it is of.
        assert cells[cell]["dark.share"] == pytest.approx(np.mean(expected))
    assert len(rows) == 10 and len(cells) == 2


def dim(images: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {channel: image // 2 for channel, image in images.items()}

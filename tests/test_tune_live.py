"""The live bench without a page: state, history, pins, one recompute at a time."""

from __future__ import annotations

import threading
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import PATIENCE_S, until

import workbench
from workbench import Artifact, Stage, StageParameters, knob
from workbench.errors import DataError, UsageError
from workbench.pipeline import Pipeline, Run
from workbench.recording import Frame
from workbench.settings import SettingsError, resolve
from workbench.stage import Cut, Histogram, Score, Scorer, recorded_image
from workbench.tune.frames import SessionFrames
from workbench.tune.live import LiveBench, Part, Picture

GATE = threading.Event()
"""Held closed by a test that wants the last stage to be busy."""

ran: list[str] = []


class Grow(Stage):
    """Adds to the image."""

    name = "grow"
    needs = (recorded_image("near"),)
    gives = (Artifact("grown", "float32", "H W"),)

    class Parameters(StageParameters):
        by: float = knob(1.0, "What is added.", low=0, high=10, step=0.5)
        times: int = knob(1, "How often.", low=1, high=5)

    presets = {"more": {"by": 4.0}}

    def compute(self, inputs: Any, p: Any) -> Any:
        ran.append(self.name)
        return {"grown": inputs["near_image"].astype(np.float32) + p.by * p.times}

    def histograms(self, artifacts: Any, p: Any) -> list[Histogram]:
        counts, edges = np.histogram(artifacts["grown"], bins=4, range=(0, 8))
        cuts = [
            Cut("by", p.by, "by"),
            Cut("half", p.by / 2, "by", lambda v: 2 * v),
            Cut("rest", 1.0),
        ]
        return [Histogram("grown", edges, counts, cuts)]


class Cutter(Stage):
    """Marks what is over a threshold; fails where nothing may pass."""

    name = "cut"
    needs = (Grow.gives[0],)
    gives = (Artifact("mask", "bool", "H W"),)

    class Parameters(StageParameters):
        over: float = knob(3.0, "What passes is greater.", low=0, high=20)

    def compute(self, inputs: Any, p: Any) -> Any:
        ran.append(self.name)
        GATE.wait(PATIENCE_S)
        if p.over == 13:
            raise ValueError("unlucky")
        return {"mask": inputs["grown"] > p.over}

    def scorer(self) -> Scorer:
        class Share(Scorer):
            def add(self, truth: Any, artifacts: Any) -> dict[str, float]:
                return {"passed": float(artifacts["mask"].mean())}

            def summary(self) -> list[Score]:
                return []

        return Share()


class Count(Stage):
    """Counts what was marked."""

    name = "count"
    needs = (Cutter.gives[0],)
    gives = (Artifact("counted", "int64", "N"),)

    def compute(self, inputs: Any, p: Any) -> Any:
        ran.append(self.name)
        return {"counted": np.array([inputs["mask"].sum()], np.int64)}


class Log:
    """A display that remembers what it was shown."""

    def __init__(self) -> None:
        self.shown: list[tuple[str, Run]] = []
        self.pictures: list[Picture] = []
        self.ended: list[Picture] = []

    def begin(self, picture: Picture) -> None:
        self.pictures.append(picture)

    def show(self, part: Part, run: Run) -> None:
        self.shown.append((part.prefix, run))

    def end(self, picture: Picture, runs: Any) -> None:
        self.ended.append(picture)

    def mark(self, x: int, y: int) -> None:
        return


class Truth:
    """Anything but None is ground truth to a scorer of one's own."""


def frame_of(value: int) -> Frame:
    image = np.full((4, 4), value, np.uint8)
    return Frame(value, value, {"near": image}, {}, {}, Truth(), f"frame {value}")  # type: ignore[arg-type]


STAGES: dict[str, Stage] = {"grow": Grow(), "cut": Cutter()}


@contextmanager
def live(stages: dict[str, Stage]) -> Iterator[LiveBench]:
    """A live bench that has shown its first frame."""
    GATE.set()
    made = LiveBench(Pipeline(stages, resolve(stages)), [frame_of(k) for k in range(5)])
    made.display = Log()
    made.start()
    try:
        assert made.wait(PATIENCE_S)
        ran.clear()
        yield made
    finally:
        GATE.set()
        made.close()


@pytest.fixture
def bench() -> Iterator[LiveBench]:
    with live(STAGES) as made:
        yield made


def value(bench: LiveBench, address: str) -> Any:
    stage, _, name = address.partition(".")
    return getattr(bench.settings.parameters[stage], name)


def test_only_what_is_downstream_runs_again(bench: LiveBench) -> None:
    # The first run of each stage warms it up.
    bench.set({"cut.over": 5.0})
    assert bench.wait()
    assert ran == ["cut"]
    run = bench.snapshot().run
    assert run is not None and run.computed == {"cut"}
    ran.clear()
    bench.undo()
    assert bench.wait() and ran == []
    bench.set({"grow.by": 2.0})
    assert bench.wait() and ran == ["grow", "cut"]


def test_the_newest_wins_and_none_queue(bench: LiveBench) -> None:
    GATE.clear()
    bench.set({"cut.over": 0.25}, settled=False)
    until(lambda: ran)
    before = bench.recomputes
    for k in range(100):
        bench.set({"cut.over": 1 + k / 10}, settled=False)
    assert bench.recomputes == before
    GATE.set()
    assert bench.wait()
    assert bench.recomputes == before + 1
    run_settings = bench.snapshot().run_settings
    assert run_settings is not None
    assert run_settings.parameters["cut"].over == 1 + 99 / 10  # type: ignore[attr-defined]
    assert ran == ["cut", "cut"]


@pytest.mark.parametrize(("patience", "left"), [(0.0, True), (PATIENCE_S, False)])
def test_a_long_recompute_is_left_for_a_newer_one_and_a_short_one_is_finished(
    monkeypatch: pytest.MonkeyPatch, patience: float, left: bool
) -> None:
    """Whichever takes longer than the bench's patience is long."""
    monkeypatch.setattr("workbench.tune.live._PATIENCE_S", patience)
    with live({**STAGES, "count": Count()}) as bench:
        log = bench.display
        assert isinstance(log, Log)
        log.pictures.clear()
        log.ended.clear()
        GATE.clear()
        bench.set({"grow.by": 3.0})
        until(lambda: ran[-1:] == ["cut"])
        bench.set({"grow.by": 6.0})
        GATE.set()
        assert bench.wait()

        def sums(pictures: list[Picture]) -> list[float]:
            return [p.settings.parameters["grow"].by for p in pictures]  # type: ignore[attr-defined]

        # What was begun is shown as far as it came; what is downstream of it did not run.
        assert sums(log.pictures) == [3, 6]
        assert sums(log.ended) == ([6] if left else [3, 6])
        whole = ["grow", "cut", "count"]
        assert ran == ([*whole[:2], *whole] if left else [*whole, *whole])
        run = bench.snapshot().run
        assert run is not None and float(run.artifacts["grown"][0, 0]) == 6
        assert run.artifacts["counted"].tolist() == [16]


def test_a_drag_is_one_step_of_the_history(bench: LiveBench) -> None:
    for k in range(1, 20):
        bench.set({"cut.over": float(k) / 2}, settled=False)
    bench.set({"cut.over": 9.5}, settled=True)
    assert value(bench, "cut.over") == 9.5
    bench.set({"grow.by": 2.0})
    bench.undo()
    assert (value(bench, "grow.by"), value(bench, "cut.over")) == (1.0, 9.5)
    bench.undo()
    assert value(bench, "cut.over") == 3.0
    assert not bench.snapshot().can_undo
    bench.undo()
    bench.redo()
    bench.redo()
    bench.redo()
    assert (value(bench, "grow.by"), value(bench, "cut.over")) == (2.0, 9.5)
    bench.undo()
    bench.set({"cut.over": 1.0})
    assert not bench.snapshot().can_redo


def test_a_release_where_the_drag_ended_ends_the_step(bench: LiveBench) -> None:
    bench.set({"cut.over": 5.0}, settled=False)
    bench.set({"cut.over": 5.0}, settled=True)
    bench.set({"cut.over": 6.0}, settled=False)
    bench.set({"cut.over": 6.0}, settled=True)
    bench.undo()
    assert value(bench, "cut.over") == 5.0


def test_what_is_dragged_back_to_where_it_was_is_no_step(bench: LiveBench) -> None:
    bench.set({"cut.over": 5.0}, settled=False)
    bench.set({"cut.over": 3.0}, settled=True)
    assert not bench.snapshot().can_undo


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"cut.over": 21.0}, "cut.over"),
        ({"cut.over": "high"}, "cut.over"),
        ({"cut.under": 1.0}, "under"),
        ({"knife.over": 1.0}, "knife"),
        ({"grow.times": 1.5}, "grow.times"),
    ],
)
def test_what_is_refused_changes_nothing(
    bench: LiveBench, values: dict[str, Any], says: str
) -> None:
    before = bench.snapshot()
    with pytest.raises(SettingsError, match=says):
        bench.set(values)
    after = bench.snapshot()
    assert (after.settings, after.number) == (before.settings, before.number)


def test_resets_and_presets(bench: LiveBench) -> None:
    bench.choose_preset("more")
    assert value(bench, "grow.by") == 4.0 and not bench.settings.changed
    bench.set({"grow.by": 7.0, "cut.over": 1.0})
    bench.reset("grow.by")
    assert value(bench, "grow.by") == 4.0 and set(bench.settings.changed) == {"cut.over"}
    bench.reset()
    assert not bench.settings.changed
    bench.undo()
    assert set(bench.settings.changed) == {"cut.over"}
    with pytest.raises(SettingsError, match="no preset"):
        bench.choose_preset("less")


def test_pins_are_held_against_one_another(bench: LiveBench) -> None:
    with pytest.raises(UsageError, match="pinned"):
        bench.show("A")
    bench.pin("A")
    bench.set({"cut.over": 0.5})
    bench.show("beside")
    assert bench.wait()
    log = bench.display
    assert isinstance(log, Log)
    overs = {part.prefix: part.settings.parameters["cut"].over for part in log.pictures[-1].parts}  # type: ignore[attr-defined]
    assert overs == {"A": 3.0, "B": 0.5}
    bench.pin("B")
    bench.set({"cut.over": 2.0})
    bench.show("difference")
    assert bench.wait()
    overs = {part.prefix: part.settings.parameters["cut"].over for part in log.pictures[-1].parts}  # type: ignore[attr-defined]
    assert overs == {"A": 3.0, "B": 0.5}
    bench.show("A")
    assert bench.wait()
    assert [part.prefix for part in log.pictures[-1].parts] == [""]
    bench.take_pin("B")
    assert value(bench, "cut.over") == 0.5
    bench.unpin("A")
    bench.unpin("B")
    assert bench.snapshot().view == "live"


def test_scores_before_and_now(bench: LiveBench) -> None:
    bench.go_to(4)
    bench.set({"cut.over": 10.0})
    assert bench.wait()
    snapshot = bench.snapshot()
    assert snapshot.before_is == "at start"
    assert (snapshot.before["cut/passed"], snapshot.scores["cut/passed"]) == (1.0, 0.0)
    bench.pin("A")
    assert bench.wait()
    snapshot = bench.snapshot()
    assert snapshot.before_is == "pin A" and snapshot.before == snapshot.scores


def test_a_stage_that_fails_is_told_and_the_others_are_there(bench: LiveBench) -> None:
    bench.set({"cut.over": 13.0})
    assert bench.wait()
    run = bench.snapshot().run
    assert run is not None
    assert [f.stage for f in run.failures] == ["cut"] and "grow" in run.stage_ms
    bench.set({"cut.over": 12.0})
    assert bench.wait()
    run = bench.snapshot().run
    assert run is not None and not run.failures


def test_a_threshold_moves_its_parameter(bench: LiveBench) -> None:
    bench.drag("grow", 0, 0, 2.5)
    assert value(bench, "grow.by") == 2.5
    assert bench.wait()
    bench.drag("grow", 0, 1, 3.0, settled=False)
    assert value(bench, "grow.by") == 6.0
    bench.drag("grow", 0, 1, 300.0)
    assert value(bench, "grow.by") == 10.0
    for histogram, cut in ((0, 2), (0, 3), (1, 0)):
        with pytest.raises(UsageError):
            bench.drag("grow", histogram, cut, 1.0)
    with pytest.raises(UsageError):
        bench.drag("nothing", 0, 0, 1.0)


def test_the_address_restores_the_state(bench: LiveBench) -> None:
    bench.choose_preset("more")
    bench.pin("A")
    bench.set({"cut.over": 7.5, "grow.times": 3})
    bench.go_to(2)
    bench.show("difference")
    bench.focus("cut")
    query = bench.query()
    fresh = LiveBench(Pipeline(STAGES, resolve(STAGES)), [frame_of(k) for k in range(5)])
    fresh.restore(query)
    ours, theirs = bench.snapshot(), fresh.snapshot()
    assert theirs.settings == ours.settings
    assert (theirs.frame, theirs.view, theirs.focus) == (2, "difference", "cut")
    assert {k: p.settings for k, p in theirs.pins.items()} == {
        k: p.settings for k, p in ours.pins.items()
    }
    assert fresh.query() == query


@pytest.mark.parametrize(
    "query",
    [
        {"frame": ["9"]},
        {"frame": ["-1"]},
        {"preset": ["none"]},
        {"set": ["cut.over"]},
        {"set": ["cut.over=99"]},
        {"set": ["cut.nothing=1"]},
        {"view": ["A"]},
        {"view": ["sideways"]},
        {"focus": ["knife"]},
        {"pinA": ["none;x"]},
    ],
)
def test_an_address_that_is_wrong_changes_nothing(
    bench: LiveBench, query: dict[str, list[str]]
) -> None:
    before = bench.snapshot()
    with pytest.raises(UsageError):
        bench.restore({"set": ["grow.by=9.0"], **query} if "set" not in query else query)
    assert bench.snapshot().settings == before.settings


def test_knobs_may_be_restricted() -> None:
    made = LiveBench(Pipeline(STAGES, resolve(STAGES)), [frame_of(1)], knobs=["cut.over"])
    assert list(made.knobs("cut")) == ["over"] and not made.knobs("grow")
    with pytest.raises(SettingsError, match=r"grow\.by"):
        made.set({"grow.by": 2.0})
    made.set({"cut.over": 2.0})


def test_saving_needs_a_reason(bench: LiveBench) -> None:
    bench.set({"cut.over": 7.5})
    with pytest.raises(UsageError, match="reason"):
        bench.saved("  ")
    saved = tomllib.loads(bench.saved("noise"))
    assert saved["reason"] == "noise" and saved["parameters"] == {"cut": {"over": 7.5}}


def test_a_frame_that_cannot_be_read_leaves_the_bench_alive() -> None:
    class Broken(list[Frame]):
        def __getitem__(self, position: Any) -> Any:
            if position == 1:
                raise DataError("pile.mcap: frame 1 cannot be read")
            return super().__getitem__(position)

    GATE.set()
    made = LiveBench(Pipeline(STAGES, resolve(STAGES)), Broken([frame_of(0), frame_of(1)]))
    made.start()
    made.go_to(1)
    assert made.wait()
    snapshot = made.snapshot()
    assert "frame 1 cannot be read" in snapshot.trouble
    made.go_to(0)
    assert made.wait() and made.snapshot().trouble == ""
    made.close()


def test_a_recording_that_is_removed_is_told(scene: Path, tmp_path: Path) -> None:
    copy = tmp_path / "scene.mcap"
    copy.write_bytes(scene.read_bytes())
    session = workbench.open(copy)
    frames = SessionFrames(session)
    assert len(frames) == 12
    first = frames[0]
    copy.unlink()
    assert frames[0] is first
    with pytest.raises(DataError, match=r"scene\.mcap: frame 11 cannot be read"):
        frames[11]
    copy.write_bytes(scene.read_bytes())
    assert frames[11].index == 11


def test_frames_are_those_of_the_session(scene: Path) -> None:
    session = workbench.open(scene)
    frames = SessionFrames(session, kept_bytes=1)
    for position in (3, 0, 1, 7, 2, 2):
        assert frames[position].index == position
    assert frames[7].digest != frames[3].digest
    with pytest.raises(DataError, match="expected 0 to 11"):
        frames[12]


def test_live_results_are_those_of_a_replay(scene: Path, tmp_path: Path) -> None:
    """After a walk through settings the artifacts are bit for bit those of a fresh run."""
    session = workbench.open(scene)
    bench = LiveBench(session.pipeline, SessionFrames(session), session.provenance_of)
    bench.start()
    for settings in (
        {"linked_edges.cone_deg": 33.0},
        {"edge_stack.max_ratio": 0.05},
        {"linked_edges.max_cost": 40.0},
    ):
        bench.set(settings)
        assert bench.wait(60)
    bench.undo()
    bench.redo()
    assert bench.wait(60)
    run = bench.snapshot().run
    bench.close()
    assert run is not None
    tuned = tmp_path / "tuned.toml"
    tuned.write_text(bench.saved("a walk"))
    read = tomllib.loads(tuned.read_text())
    assert read["provenance"]["recording"]["digest"] == session.recording.digest
    again = workbench.Session.open(workbench.session.Options(scene, config=tuned))
    fresh = next(again.runs())
    for name, artifact in session.pipeline.artifacts.items():
        if artifact.dtype != "object":
            ours, theirs = run.artifacts[name], fresh.artifacts[name]
            np.testing.assert_array_equal(ours, theirs, err_msg=name)


def test_the_thresholds_of_the_edge_stack_go_where_they_are_dragged(scene: Path) -> None:
    session = workbench.open(scene, until="edge_stack")
    bench = LiveBench(session.pipeline, SessionFrames(session))
    bench.start()
    assert bench.wait(60)
    names = [cut.name for cut in bench.histograms("edge_stack")[0].cuts]

    def where(name: str) -> float:
        return bench.histograms("edge_stack")[0].cuts[names.index(name)].value

    for name, place in (("low", 3.0), ("low", 6.0), ("greatest", 30.0), ("from", 2.5)):
        bench.drag("edge_stack", 0, names.index(name), place)
        assert bench.wait(60)
        # The low threshold can lie only where the ratio falls under all before.
        assert where(name) == pytest.approx(place, abs=1.0 if name == "low" else 1e-6), name
    with pytest.raises(UsageError, match="follows"):
        bench.drag("edge_stack", 0, names.index("medium"), 5.0)
    bench.close()


Listener = Callable[[], None]


def test_listeners_hear_of_changes_until_they_leave(bench: LiveBench) -> None:
    first: list[bool] = []
    second: list[bool] = []
    leave = bench.subscribe(lambda: first.append(bench.snapshot().busy))
    bench.subscribe(lambda: second.append(bench.snapshot().busy))

    def set_and_hear(over: float) -> None:
        """A change, until the last that is told of it: that nothing is busy any more."""
        second.clear()
        bench.set({"cut.over": over})
        until(lambda: False in second)

    set_and_hear(8.0)
    # They are told in the order in which they came.
    assert False in first
    leave()
    first.clear()
    set_and_hear(9.0)
    assert first == []

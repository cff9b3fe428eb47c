"""What a worker keeps of a result: all that the tables are made of, exactly, each result once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from mcap_fixtures import picture, write_scene

from workbench.session import Options, Session, library_versions
from workbench.sweep import worker
from workbench.sweep.cache import unpacked
from workbench.sweep.pictures import agreement
from workbench.sweep.plan import Job, Task, result_keys, source_of
from workbench.sweep.worker import Outcome

STAGES = """
import cv2
from threadpoolctl import threadpool_info
from workbench import worker_clock
from workbench.stage import Score, Scorer

class Stateful(Scorer):
    def __init__(self):
        self.total = 0.0
    def add(self, truth, artifacts):
        worker_clock.now += 0.5
        self.total += float(artifacts["bright"].mean())
        seen = len([name for name in artifacts if name != "near_image"])
        return {"seen": float(seen), "nan": float("nan"), "inf": float("inf")}
    def state(self):
        return {"total": self.total}

class Stateless(Scorer):
    def add(self, truth, artifacts):
        return {"gap": 1}

class Bright(Stage):
    name = "bright"
    needs = (recorded_image("near"),)
    gives = (Artifact("bright", "bool", "H W"),)
    class Parameters(StageParameters):
        level: int = knob(90, "What is bright.", low=0, high=255)
    def compute(self, inputs, p):
        worker_clock.now += 0.25
        worker_clock.threads.add(cv2.getNumThreads())
        worker_clock.pools |= {one["num_threads"] for one in threadpool_info()}
        return {"bright": inputs["near_image"] >= p.level, WARNINGS: ["dim", "dark: too"]}
    def scorer(self):
        return Stateful()
    def figures(self, artifacts):
        worker_clock.now += 0.125
        return [Score("share", float(artifacts["bright"].mean()), "of 1", better="lower")]

class Brighter(Stage):
    name = "brighter"
    needs = (Artifact("bright", "bool", "H W"),)
    gives = (Artifact("count", "int64", ""),)
    class Parameters(StageParameters):
        mood: str = knob("well", "What to do.")
    def compute(self, inputs, p):
        worker_clock.now += 1.0
        if p.mood == "raise":
            raise ValueError("no light")
        return {"count": np.array(int(inputs["bright"].sum()))}
    def scorer(self):
        return Stateless()

class Last(Stage):
    name = "last"
    needs = (Artifact("count", "int64", ""),)
    gives = (Artifact("last", "int64", ""),)
    def compute(self, inputs, p):
        return {"last": inputs["count"]}
"""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """A clock that only the stages and scorers move, and what they saw of threads."""
    import workbench

    clock = SimpleNamespace(now=0.0, threads=set(), pools=set())
    monkeypatch.setattr(workbench, "worker_clock", clock, raising=False)
    for module in ("workbench.pipeline", "workbench.sweep.worker"):
        monkeypatch.setattr(f"{module}.time", SimpleNamespace(perf_counter=lambda: clock.now))
    worker._opened.clear()
    return clock


@pytest.fixture
def job(tmp_path: Path, plugin: Callable[..., Path], clock: SimpleNamespace) -> Job:
    """Four frames of pictures that differ, of which a picture of the second one is kept."""
    assert clock.now == 0
    recording = write_scene(tmp_path / "toy.mcap", frames=range(4))
    options = Options(recording, plugins=[plugin(STAGES, "worker_toys.py")], until="last")
    session = Session.open(options)
    return Job(
        (recording,),
        (source_of(session),),
        options,
        {},
        "bright",
        (frozenset({1}),),
        session.pipeline.code_digests(),
        ({},),
        dict(library_versions()),
        "a job",
    )


def done(job: Job, *cells: dict[str, Any], start: int = 0, stop: int = 1) -> Outcome:
    return worker.work(job, Task(7, 0, start, stop, cells or ({},)))


def records(outcome: Outcome) -> list[dict[str, Any]]:
    return [unpacked(one.record) for one in outcome.kept]


def bright(index: int, level: int = 90) -> np.ndarray:
    found: np.ndarray = picture("near", index) >= level
    return found


def test_a_record_holds_what_the_stage_and_its_scorer_said(job: Job) -> None:
    outcome = done(job, start=2, stop=3)
    share = float(bright(2).mean())
    assert records(outcome) == [
        {
            "ms": 250.0,
            "warnings": ["dim", "dark: too"],
            # Numbers that are not finite have no place in a table of frames.
            "own": {"seen": 1.0},
            "state": {"total": share},
            "figures": [
                {"name": "share", "value": share, "unit": "of 1", "coverage": None, "note": "",
                 "better": "lower", "published": ""}
            ],
        },
        {"ms": 1000.0, "own": {"gap": 1.0}, "stateless": True},
        {"ms": 0.0},
    ]  # fmt: skip
    assert [one.frame for one in outcome.kept] == [2, 2, 2]
    assert not any(one.failed for one in outcome.kept)
    assert (outcome.task, outcome.seen) == (7, {2: True})


def test_the_keys_are_the_parents(job: Job) -> None:
    session = Session.open(job.options)
    keys = result_keys(session.pipeline, session.pipeline.settings)
    assert [one.key for one in done(job).kept] == [keys[n] for n in ("bright", "brighter", "last")]


def test_cells_that_share_a_result_have_it_once_a_frame(job: Job) -> None:
    cells = [
        {"bright.level": level, "brighter.mood": mood} for level in (90, 120) for mood in "abc"
    ]
    outcome = done(job, *cells, start=1, stop=3)
    # Two levels, six moods below them, on each of two frames.
    assert len(outcome.kept) == len({(one.key, one.frame) for one in outcome.kept}) == 2 * (2 + 12)
    assert outcome.seen == {1: True, 2: True}


def test_time_is_counted_once_for_each_result_that_was_computed(
    job: Job, clock: SimpleNamespace
) -> None:
    done(job)
    started = clock.now
    # Warm by now: two levels, two moods each.
    cells = [{"bright.level": n, "brighter.mood": m} for n in (90, 120) for m in "ab"]
    outcome = done(job, *cells)
    assert outcome.stage_seconds == 2 * 0.25 + 4 * 1.0
    assert outcome.scoring_seconds == 2 * (0.5 + 0.125)
    assert outcome.seconds == clock.now - started
    assert outcome.seconds == outcome.stage_seconds + outcome.scoring_seconds


def test_a_failure_and_what_waits_for_it_are_results(job: Job) -> None:
    outcome = done(job, {"brighter.mood": "raise"})
    assert [one.failed for one in outcome.kept] == [False, True, True]
    assert records(outcome)[1:] == [
        {"says": "ValueError: no light", "blocked_by": None},
        {"says": "not run: brighter failed", "blocked_by": "brighter"},
    ]
    assert outcome.scoring_seconds == 0.5 + 0.125


def test_a_scorer_that_fails_is_a_failure_with_the_stages_time(job: Job) -> None:
    path = job.options.plugins[0]
    path.write_text(path.read_text().replace('return {"gap": 1}', 'return {"gap": 1 / 0}'))
    session = Session.open(job.options)
    outcome = done(replace(job, code=session.pipeline.code_digests(), digest="other"))
    one, other = outcome.kept[1], records(outcome)[1]
    assert one.failed and one.outline is None
    assert other == {
        "ms": 1000.0,
        "says": "scoring: ZeroDivisionError: division by zero",
        "blocked_by": None,
    }
    # What comes after it has its inputs.
    assert records(outcome)[2] == {"ms": 0.0}


def test_only_frames_of_which_a_picture_is_kept_are_drawn(job: Job) -> None:
    outcome = done(job, stop=3)
    drawn = {(one.frame, position % 3) for position, one in enumerate(outcome.kept) if one.picture}
    assert drawn == {(1, 0)}
    data = next(one.picture for one in outcome.kept if one.picture)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, bright(1).astype(np.uint8) * 255)


def test_outlines_are_those_of_the_stages_with_an_image(job: Job) -> None:
    first, second, third = done(job, stop=1).kept
    assert first.outline is not None and second.outline is third.outline is None
    same = done(job, {"bright.level": 90}).kept[0].outline
    other = done(job, {"bright.level": 250}).kept[0].outline
    assert same is not None and other is not None
    assert agreement([first.outline], [same]) == 1 and agreement([first.outline], [other]) < 0.5


def test_a_frame_that_is_not_there_is_not_seen(job: Job) -> None:
    outcome = done(job, start=3, stop=6)
    assert outcome.seen == {3: True, 4: False, 5: False}
    assert {one.frame for one in outcome.kept} == {3}


def test_work_is_done_in_one_thread_and_the_setting_comes_back(
    job: Job, clock: SimpleNamespace
) -> None:
    before = cv2.getNumThreads()
    cv2.setNumThreads(3)
    try:
        done(job)
        assert clock.threads == {1} and clock.pools == {1}
        assert cv2.getNumThreads() == 3
        with pytest.raises(ZeroDivisionError), worker.one_thread():
            assert cv2.getNumThreads() == 1
            raise ZeroDivisionError
        assert cv2.getNumThreads() == 3
    finally:
        cv2.setNumThreads(before)


def test_pipelines_of_cells_are_held_in_bounds(job: Job, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "_HELD_CELLS", 3)
    wide = [{"bright.level": level} for level in range(100, 107)]
    outcome = done(job, *wide)
    [opened] = worker._opened.values()
    assert len(opened.cells) <= 3
    means = [record["state"]["total"] for record in records(outcome) if "state" in record]
    assert means == [float(bright(0, level).mean()) for level in range(100, 107)]


def test_results_of_a_frame_are_not_held_after_it(job: Job) -> None:
    assert [done(job).stage_seconds for _ in range(2)] == [0.25 + 1.0] * 2

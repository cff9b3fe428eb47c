"""What a worker does: cells over a block of frames, each distinct result once.

Runs in the processes of the machine and of a cluster alike, and imports neither Rerun nor the
command line.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from workbench.errors import DataError, one_line
from workbench.pipeline import Pipeline, ResultStore, Run
from workbench.plugins import find_stages
from workbench.session import Session, library_versions
from workbench.settings import Settings, adjusted
from workbench.stage import Stage
from workbench.sweep.cache import Kept, packed
from workbench.sweep.pictures import drawn, outline_of
from workbench.sweep.plan import Job, Task, result_keys, source_of, upstream

_STORE_BYTES = 512 << 20
_OPEN_SESSIONS = 2
_HELD_CELLS = 1024


@dataclass(frozen=True)
class Outcome:
    """A task's results, ready to be kept, and where its time went."""

    task: int
    seen: Mapping[int, bool]
    """The frames of the block, and whether each could be decoded."""
    kept: tuple[Kept, ...]
    seconds: float
    stage_seconds: float
    """Spent in the stages' computing, each result counted once."""
    scoring_seconds: float
    """Spent in the stages' scorers and figures."""


_alone = threading.Lock()
_opened: OrderedDict[tuple[str, int], _Opened] = OrderedDict()


def work(job: Job, task: Task) -> Outcome:
    """Do one task.  A stage that raises is a result; raises ``DataError`` if nothing can be done.

    One task at a time in a process, whatever threads its engine has: the host's results are not
    shared between threads, and a process has one setting of OpenCV's threads.
    """
    with _alone, one_thread():
        start = time.perf_counter()
        opened = _open(job, task.recording)
        return _work(opened, job, task, start)


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold OpenCV, BLAS and OpenMP to one thread: the workers share the cores already."""
    import cv2
    from threadpoolctl import threadpool_limits

    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        with threadpool_limits(limits=1):
            yield
    finally:
        cv2.setNumThreads(before)


@dataclass(frozen=True)
class _Opened:
    session: Session
    stages: Mapping[str, Stage]
    visible: Mapping[str, frozenset[str]]
    """To each stage's scorer and figures: the artifacts that do not depend on later stages."""
    base: Settings
    cells: dict[str, tuple[Pipeline, dict[str, str]]]
    """Pipelines and keys of cells, by their values: the next block of frames has the same."""


def _open(job: Job, recording: int) -> _Opened:
    """The recording with its pipeline, kept from the task before where it is the same."""
    where = (job.digest, recording)
    if where in _opened:
        _opened.move_to_end(where)
        return _opened[where]
    options = replace(job.options, recording=job.recordings[recording])
    session = Session.open(options, ResultStore(_STORE_BYTES))
    _check_alike(job, recording, session)
    stages = session.pipeline.stages
    before = upstream(stages)
    given = {stage.name: {a.name for a in stage.gives} for stage in stages}
    everything = set().union(*given.values()) if given else set()
    visible = {
        name: frozenset(
            {n.name for s in stages for n in s.needs if n.name not in everything}.union(
                *(given[other] for other in names)
            )
        )
        for name, names in before.items()
    }
    found = find_stages(job.options.plugins)
    base = adjusted(found, session.pipeline.settings, job.base)
    _opened[where] = _Opened(session, found, visible, base, {})
    while len(_opened) > _OPEN_SESSIONS:
        _opened.popitem(last=False)
    return _opened[where]


def _check_alike(job: Job, recording: int, session: Session) -> None:
    """Raise :class:`DataError` unless all that results depend on is what the parent has."""
    pipeline, recorded = session.pipeline, session.recording.path.name
    for what, expected, found in (
        ("code of stage", job.code, pipeline.code_digests()),
        ("version of", job.libraries, library_versions()),
        ("file of", job.resources[recording], pipeline.resource_digests()),
        ("recording", {recorded: job.sources[recording]}, {recorded: source_of(session)}),
    ):
        for name in sorted(expected.keys() | found.keys()):
            if expected.get(name) != found.get(name):
                raise DataError(
                    f"a worker has another {what} {name} than this machine; expected "
                    f"{expected.get(name)}, found {found.get(name)}"
                )


def _work(opened: _Opened, job: Job, task: Task, start: float) -> Outcome:
    session = opened.session
    pipelines = [_pipeline(opened, values) for values in task.cells]
    seen = dict.fromkeys(range(task.start, task.stop), False)
    kept: list[Kept] = []
    stage_seconds = scoring_seconds = 0.0
    required, optional = session.pipeline.channels
    for frame in session.recording.frames(required, optional, task.start, task.stop):
        seen[frame.index] = True
        done: set[str] = set()
        drawing = frame.index in job.picture_frames[task.recording]
        for pipeline, keys in pipelines:
            run = pipeline.run(frame)
            stage_seconds += sum(run.stage_ms[name] for name in run.computed) / 1e3
            for stage in pipeline.stages:
                key = keys[stage.name]
                if key not in done:
                    done.add(key)
                    picture = drawing and stage.name == job.picture_stage
                    found, seconds = _kept(opened, stage, key, run, picture)
                    kept.append(found)
                    scoring_seconds += seconds
        # No other frame can ask for these.
        session.pipeline.store.clear()
    seconds = time.perf_counter() - start
    return Outcome(task.number, seen, tuple(kept), seconds, stage_seconds, scoring_seconds)


def _pipeline(opened: _Opened, values: Mapping[str, Any]) -> tuple[Pipeline, dict[str, str]]:
    """The pipeline with a cell's values, and the keys of its results."""
    where = repr(sorted(values.items()))
    if where not in opened.cells:
        if len(opened.cells) >= _HELD_CELLS:
            opened.cells.clear()
        settings = adjusted(opened.stages, opened.base, values)
        pipeline = opened.session.pipeline.with_settings(settings)
        opened.cells[where] = pipeline, result_keys(pipeline, settings)
    return opened.cells[where]


def _kept(opened: _Opened, stage: Stage, key: str, run: Run, picture: bool) -> tuple[Kept, float]:
    """What is kept of one stage's result, and the seconds that the stage took to score it.

    Nothing of it depends on stages that come later.
    """
    record: dict[str, Any] = {}
    failure = run.failure_of(stage.name)
    index = run.frame.index
    if failure is not None:
        record["says"] = failure.says
        record["blocked_by"] = failure.blocked_by
        return Kept(key, index, True, packed(record), None, None), 0.0
    artifacts = {
        name: value for name, value in run.artifacts.items() if name in opened.visible[stage.name]
    }
    prefix = f"{stage.name}: "
    record["ms"] = run.stage_ms[stage.name]
    warnings = [says.removeprefix(prefix) for says in run.warnings if says.startswith(prefix)]
    if warnings:
        record["warnings"] = warnings
    outline: bytes | None = None
    image: bytes | None = None
    start = time.perf_counter()
    try:
        scorer = stage.scorer()
        if scorer is not None and run.frame.truth is not None:
            record["own"] = _finite(scorer.add(run.frame.truth, artifacts))
            state = scorer.state()
            if state is None:
                record["stateless"] = True
            else:
                record["state"] = state
        figures = stage.figures(artifacts)
        seconds = time.perf_counter() - start
        if figures:
            record["figures"] = [asdict(score) for score in figures]
        outline = outline_of(stage, artifacts)
        if picture:
            image = drawn(stage, artifacts)
        data = packed(record)
    except Exception as error:
        # As a replay counts it: the stage's own result stands, what tells of it does not.
        says = f"scoring: {one_line(error)}"
        data = packed({"ms": record["ms"], "says": says, "blocked_by": None})
        return Kept(key, index, True, data, None, None), time.perf_counter() - start
    return Kept(key, index, False, data, outline, image), seconds


def _finite(values: Mapping[str, float]) -> dict[str, float]:
    return {name: float(value) for name, value in values.items() if np.isfinite(value)}

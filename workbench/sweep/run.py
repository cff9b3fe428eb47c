"""A sweep from its flags to its tables: what is missing is computed, what is kept is read."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import tomli_w

from workbench import interrupts
from workbench.digest import digest_of
from workbench.errors import DataError, UsageError
from workbench.files import replacing
from workbench.pipeline import ResultStore
from workbench.plugins import find_stages
from workbench.session import Options, Session, library_versions
from workbench.settings import Settings, adjusted, to_toml
from workbench.stage import Better, Stage
from workbench.sweep.analysis import Choice, choose
from workbench.sweep.axes import Cell, Grid, grid
from workbench.sweep.cache import Cache
from workbench.sweep.engines import default_workers, outcomes
from workbench.sweep.pictures import can_draw
from workbench.sweep.plan import (
    Block,
    Job,
    blocks_of,
    in_tree_order,
    result_keys,
    source_of,
    tasks_of,
)
from workbench.sweep.results import STABILITY, Reader, add_stability, frame_rows, mean_ms
from workbench.sweep.table import Metric, Row, write_cells, write_frames

CACHE = Path(".cache") / "results.sqlite"
CELLS_TABLE = "cells.parquet"
FRAMES_TABLE = "frames.parquet"
BEST = "best.toml"
CONFIGURATIONS = "cells"
_FEW = 64
MOST_CONFIGURATIONS = 2000
"""Cells that get a configuration file and a place in the gallery; of more, the best."""


@dataclass(frozen=True)
class Request:
    """What the flags of ``workbench sweep`` say."""

    options: Options
    """The shared flags, with the first recording."""
    recordings: Sequence[Path]
    folder: Path
    axes: Sequence[str]
    zips: Sequence[str] = ()
    sample: int | None = None
    seed: int = 0
    metrics: Sequence[str] = ()
    workers: int | None = None
    scheduler: str | None = None
    pictures: int = 4
    """Frames of which every cell keeps a picture."""


@dataclass
class Spent:
    """Where the time of a sweep went, seconds; ``computed`` counts cells times frames."""

    computed: int = 0
    kept: int = 0
    tasks: int = 0
    workers: float = 0.0
    """In the workers, summed over them."""
    stages: float = 0.0
    """Of that, in the stages' computing."""
    scoring: float = 0.0
    """Of that, in the stages' scorers and figures."""
    computing: float = 0.0
    """On the clock, while results were computed."""
    total: float = 0.0


@dataclass
class Sweep:
    """A finished sweep."""

    request: Request
    grid: Grid
    cells: list[Cell]
    rows: list[Row]
    metrics: list[Metric]
    choices: list[Choice]
    """The best cell by each ``--metric``, the first of which made ``best.toml``."""
    provenance: dict[str, Any]
    job: Job
    configurations: dict[int, Path]
    """Cell to the file that ``replay --config`` reads."""
    stages: list[Stage]
    keys: list[dict[int, dict[str, str]]] = field(repr=False)
    reader: Reader = field(repr=False)
    frames: list[list[int]] = field(repr=False)
    """Of each recording, the frames that were read."""
    spent: Spent = field(default_factory=Spent)


def run(
    request: Request,
    advance: Callable[[int, int], None] | None = None,
    finish: Callable[[Sweep, Cache], None] | None = None,
    warn: Callable[[str], None] | None = None,
) -> Sweep:
    """Do what the request asks for and write its tables.

    ``advance`` is told how many cells times frames are done, of how many.  ``finish`` is called
    with the finished sweep while what it kept is still open, for pictures; ``warn`` is told at
    once what looks like a mistake but may come to be right.  Raises
    :class:`UsageError` or :class:`DataError` with one line; what was done until then is kept and
    not done again.
    """
    started = time.perf_counter()
    if request.workers is not None and request.workers < 1:
        raise UsageError(f"--workers {request.workers}: expected 1 or more")
    if request.pictures < 0:
        raise UsageError(f"--pictures {request.pictures}: expected 0 or more")
    sessions = _sessions(request)
    stages = find_stages(request.options.plugins)
    first = sessions[0].pipeline
    settings = first.settings
    names = [stage.name for stage in first.stages]
    asked = [_metric_asked(text, first.stages) for text in request.metrics]
    whole = grid(request.axes, request.zips, request.sample, request.seed, stages, names, settings)
    cells = whole.cells()
    spans = [_span(session) for session in sessions]
    if not sum(stop - start for start, stop in spans):
        raise DataError(f"{request.recordings[0]}: no frame in it, or in --frames")
    job = _job(request, sessions, spans, asked)
    keys = _keys(sessions, stages, settings, cells)
    _make(request.folder)
    with Cache(request.folder / CACHE) as cache:
        spent = Spent()

        def look() -> None:
            """After the first task: does anything have the figures that were asked for?"""
            early = Reader(job, spans, keys, cache, frozenset())
            for text, (address, _) in zip(request.metrics, asked, strict=True):
                stage = next(s for s in first.stages if s.name == address.partition(".")[0])
                few = cells[:_FEW]
                seen = {m.address for cell in few for m, _ in early.result(cell, stage).metrics}
                seen.add(f"{stage.name}.{STABILITY}")
                if warn is not None and len(seen) > 1 and address not in seen:
                    listed = ", ".join(sorted(seen))
                    warn(f"--metric {text}: no such figure so far; there are: {listed}")

        _compute(request, job, sessions, spans, cells, keys, cache, spent, advance, look)
        interrupts.check()
        sweep = _finished(
            request, job, sessions, spans, whole, cells, keys, stages, cache, spent, asked
        )
        if finish is not None:
            finish(sweep, cache)
    spent.total = time.perf_counter() - started
    return sweep


# -- before ---------------------------------------------------------------------------------------


def _sessions(request: Request) -> list[Session]:
    seen: set[Path] = set()
    for path in request.recordings:
        if path.resolve() in seen:
            raise UsageError(f"{path}: is there twice")
        seen.add(path.resolve())
    store = ResultStore(capacity_bytes=0)
    return [
        Session.open(replace(request.options, recording=path), store) for path in request.recordings
    ]


def _span(session: Session) -> tuple[int, int]:
    start = session.options.frames[0]
    return start, start + session.count()


def _make(folder: Path) -> None:
    try:
        (folder / CONFIGURATIONS).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--to {folder}: {error.strerror}") from error


def _metric_asked(text: str, stages: Sequence[Stage]) -> tuple[str, Better | None]:
    """``--metric`` as an address that begins with a stage's name, and which way is better.

    The stage may be named by an artifact that it gives: ``regions.mean_iou``.
    """
    address, _, way = text.strip().partition(":")
    directions: dict[str, Better] = {"higher": "higher", "lower": "lower", "zero": "zero"}
    if way and way not in directions:
        raise UsageError(f"--metric {text}: expected :higher, :lower or :zero, found :{way}")
    owner, dot, name = address.partition(".")
    known = {stage.name: stage.name for stage in stages}
    known |= {a.name: s.name for s in stages for a in s.gives if a.name not in known}
    if not (dot and name):
        raise UsageError(f"--metric {text}: expected STAGE.FIGURE, as region_features.stability")
    if owner not in known:
        listed = ", ".join(stage.name for stage in stages)
        raise UsageError(f"--metric {text}: no stage {owner!r} is run; stages: {listed}")
    return f"{known[owner]}.{name}", directions.get(way)


def _job(
    request: Request,
    sessions: Sequence[Session],
    spans: Sequence[tuple[int, int]],
    asked: Sequence[tuple[str, Better | None]],
) -> Job:
    pipeline = sessions[0].pipeline
    options = request.options
    plain = replace(
        options,
        recording=Path(),
        resources={name: path.absolute() for name, path in options.resources.items()},
        preset=pipeline.settings.preset,
        config=None,
        assignments=(),
        frames=(0, None),
        plugins=[path.absolute() for path in options.plugins],
    )
    job = Job(
        tuple(path.absolute() for path in request.recordings),
        tuple(source_of(session) for session in sessions),
        plain,
        dict(pipeline.settings.changed),
        _picture_stage(pipeline.stages, asked) if request.pictures else None,
        tuple(_spread(spans, request.pictures)),
        pipeline.code_digests(),
        tuple(session.pipeline.resource_digests() for session in sessions),
        dict(library_versions()),
    )
    return replace(job, digest=job.identified())


def _picture_stage(
    stages: Sequence[Stage], asked: Sequence[tuple[str, Better | None]]
) -> str | None:
    """The last stage with something to show, up to that of the figure that was asked for."""
    shown: str | None = None
    for stage in stages:
        if can_draw(stage):
            shown = stage.name
        if asked and stage.name == asked[0][0].partition(".")[0]:
            break
    return shown


def _spread(spans: Sequence[tuple[int, int]], count: int) -> Iterator[frozenset[int]]:
    """Frames spread evenly over all recordings, about ``count`` in all, as sets a recording."""
    everything = [(r, f) for r, (start, stop) in enumerate(spans) for f in range(start, stop)]
    count = min(count, len(everything))
    chosen = {everything[position * len(everything) // count] for position in range(count)}
    for recording in range(len(spans)):
        yield frozenset(frame for r, frame in chosen if r == recording)


def _keys(
    sessions: Sequence[Session],
    stages: Mapping[str, Stage],
    settings: Settings,
    cells: Sequence[Cell],
) -> list[dict[int, dict[str, str]]]:
    """Of each recording, each cell's keys; recordings with the same resources share them."""
    found: dict[tuple[tuple[str, str], ...], dict[int, dict[str, str]]] = {}
    result = []
    for session in sessions:
        resources = tuple(sorted(session.pipeline.resource_digests().items()))
        if resources not in found:
            found[resources] = {
                cell.index: result_keys(session.pipeline, adjusted(stages, settings, cell.values))
                for cell in cells
            }
        result.append(found[resources])
    return result


# -- computing ------------------------------------------------------------------------------------


def _compute(
    request: Request,
    job: Job,
    sessions: Sequence[Session],
    spans: Sequence[tuple[int, int]],
    cells: Sequence[Cell],
    keys: Sequence[Mapping[int, Mapping[str, str]]],
    cache: Cache,
    spent: Spent,
    advance: Callable[[int, int], None] | None,
    look: Callable[[], None],
) -> None:
    workers = request.workers or default_workers(request.scheduler)
    cache.forget_failures()
    blocks = [
        Block(
            recording,
            start,
            stop,
            tuple(_lacking(job, recording, start, stop, cells, keys[recording], cache)),
        )
        for recording, start, stop in blocks_of(spans, workers)
    ]
    total = len(cells) * sum(stop - start for start, stop in spans)
    tasks = tasks_of(blocks, sessions[0].pipeline.stages, workers)
    sizes = {task.number: len(task.cells) * (task.stop - task.start) for task in tasks}
    spent.computed = sum(sizes.values())
    spent.kept = total - spent.computed
    spent.tasks = len(tasks)
    done = spent.kept
    if advance is not None:
        advance(done, total)
    started = time.perf_counter()
    sources = {task.number: job.sources[task.recording] for task in tasks}
    for outcome in outcomes(job, tasks, workers, request.scheduler):
        cache.put(sources[outcome.task], outcome.seen, outcome.kept)
        if not spent.workers:
            look()
        spent.workers += outcome.seconds
        spent.stages += outcome.stage_seconds
        spent.scoring += outcome.scoring_seconds
        done += sizes[outcome.task]
        if advance is not None:
            advance(done, total)
    spent.computing = time.perf_counter() - started


def _lacking(
    job: Job,
    recording: int,
    start: int,
    stop: int,
    cells: Sequence[Cell],
    keys: Mapping[int, Mapping[str, str]],
    cache: Cache,
) -> Iterator[Cell]:
    """The cells of which some result in the block is not kept."""
    source = job.sources[recording]
    readable = set(range(start, stop)) - cache.unreadable(source)
    if not readable:
        return
    counts = cache.counts(source, start, stop)
    wanted = job.picture_frames[recording] & readable
    drawn: dict[str, bool] = {}
    for cell in cells:
        own = keys[cell.index]
        whole = all(counts.get(key, 0) == len(readable) for key in own.values())
        if whole and wanted and job.picture_stage is not None:
            key = own[job.picture_stage]
            if key not in drawn:
                drawn[key] = wanted <= cache.drawn(key, source)
            whole = drawn[key]
        if not whole:
            yield cell


# -- after ----------------------------------------------------------------------------------------


def _finished(
    request: Request,
    job: Job,
    sessions: Sequence[Session],
    spans: Sequence[tuple[int, int]],
    whole: Grid,
    cells: list[Cell],
    keys: list[dict[int, dict[str, str]]],
    stages: Mapping[str, Stage],
    cache: Cache,
    spent: Spent,
    asked: Sequence[tuple[str, Better | None]],
) -> Sweep:
    pipeline = sessions[0].pipeline
    order = {stage.name: position for position, stage in enumerate(pipeline.stages)}
    reader = Reader(job, spans, keys, cache, frozenset(address for address, _ in asked))
    frames = [
        sorted(set(range(start, stop)) & cache.readable(source))
        for source, (start, stop) in zip(job.sources, spans, strict=True)
    ]
    if not any(frames):
        raise DataError(f"{request.recordings[0]}: no frame that can be read")
    metrics: dict[str, Metric] = {}
    rows: dict[int, Row] = {}
    for cell in in_tree_order(cells, pipeline.stages):
        results = {stage.name: reader.result(cell, stage) for stage in pipeline.stages}
        figures: dict[str, float] = {}
        for result in results.values():
            for metric, value in result.metrics:
                metrics.setdefault(metric.address, metric)
                figures[metric.address] = value
        errors = [row.error for row in frame_rows(results) if row.error]
        identity = [key for name in order for key in reader.identity(cell, name)]
        rows[cell.index] = Row(
            cell,
            digest_of(identity),
            sum(len(own) for own in frames),
            len(errors),
            errors[0] if errors else "",
            figures,
            mean_ms(results),
        )
    ordered = [rows[cell.index] for cell in cells]
    for stage in pipeline.stages:
        add_stability(whole, ordered, stage.name, reader, metrics)
    # By stage, and within a stage as they came: figures that a first cell lacks have their place.
    listed = sorted(metrics.values(), key=lambda metric: order[metric.address.partition(".")[0]])
    listed = _with_directions(listed, asked)
    choices = _choices(request, whole, ordered, listed, asked)
    provenance = _provenance(request, sessions, whole)
    names = list(order)
    own_figures = sorted(
        {
            name
            for cell in cells
            for stage in pipeline.stages
            for row in reader.result(cell, stage).frames.values()
            for name in row.figures
        }
    )
    write_cells(request.folder / CELLS_TABLE, ordered, whole.axes, listed, names, provenance)
    write_frames(
        request.folder / FRAMES_TABLE,
        (
            (
                cell,
                frame_rows({s.name: reader.result(cell, s) for s in pipeline.stages}),
            )
            for cell in cells
        ),
        [path.name for path in request.recordings],
        own_figures,
        names,
        provenance,
    )
    configurations = _configurations(request, sessions[0], stages, ordered, choices, provenance)
    return Sweep(
        request,
        whole,
        cells,
        ordered,
        listed,
        choices,
        provenance,
        job,
        configurations,
        list(pipeline.stages),
        keys,
        reader,
        frames,
        spent,
    )


def _with_directions(
    metrics: Sequence[Metric], asked: Sequence[tuple[str, Better | None]]
) -> list[Metric]:
    ways = {address: way for address, way in asked if way is not None}
    return [replace(metric, better=ways.get(metric.address, metric.better)) for metric in metrics]


def _choices(
    request: Request,
    whole: Grid,
    rows: Sequence[Row],
    metrics: Sequence[Metric],
    asked: Sequence[tuple[str, Better | None]],
) -> list[Choice]:
    by_address = {metric.address: metric for metric in metrics}
    choices = []
    for text, (address, _) in zip(request.metrics, asked, strict=True):
        metric = by_address.get(address)
        if metric is None:
            errors = sorted({row.error for row in rows if row.error})
            if errors and all(row.failed_frames for row in rows):
                raise DataError(
                    f"--metric {text}: no cell has it, for every one failed: {errors[0]}"
                )
            listed = ", ".join(by_address) or "none"
            raise UsageError(f"--metric {text}: no such figure; there are: {listed}")
        if metric.better is None:
            raise UsageError(
                f"--metric {text}: its stage does not say which way is better; "
                f"expected {text}:higher, :lower or :zero"
            )
        choice = choose(whole, rows, metric)
        if choice is None:
            raise DataError(f"--metric {text}: it has no value in any cell")
        choices.append(choice)
    return choices


def _provenance(request: Request, sessions: Sequence[Session], whole: Grid) -> dict[str, Any]:
    first = sessions[0].provenance()
    own = [session.provenance() for session in sessions]
    return {key: first[key] for key in first if key not in ("recording", "resources")} | {
        "recordings": [one["recording"] | {"resources": one["resources"]} for one in own],
        "sweep": {
            "axes": {axis.address: list(axis.values) for axis in whole.axes},
            "zipped": [[a.address for a in step] for step in whole.steps if len(step) > 1],
            "cells": len(whole),
            "of": whole.size,
            "seed": request.seed if whole.sampled is not None else None,
            "metrics": list(request.metrics),
        },
    }


def _configurations(
    request: Request,
    session: Session,
    stages: Mapping[str, Stage],
    rows: Sequence[Row],
    choices: Sequence[Choice],
    provenance: Mapping[str, Any],
) -> dict[int, Path]:
    """A file for each cell that ``--config`` reads, and ``best.toml``."""
    folder = request.folder / CONFIGURATIONS
    shown = list(rows)
    if len(shown) > MOST_CONFIGURATIONS:
        metric = choices[0].metric if choices else None
        if metric is not None:
            shown.sort(key=lambda row: -metric.worth(row.figures.get(metric.address, math.nan)))
        chosen = [choice.row for choice in choices]
        kept = {row.cell.index: row for row in (*shown[:MOST_CONFIGURATIONS], *chosen)}
        shown = [kept[index] for index in sorted(kept)]
    digits = max(4, len(str(max(row.cell.index for row in rows))))
    # The same for all: written once, for it is most of each file.
    brief = {key: provenance[key] for key in ("bench", "code", "recordings")}
    about = "\n" + tomli_w.dumps({"provenance": brief})
    found: dict[int, Path] = {}
    for row in shown:
        settings = adjusted(stages, session.pipeline.settings, row.cell.values)
        path = folder / f"{row.cell.index:0{digits}d}.toml"
        found[row.cell.index] = path
        _write_if_other(path, to_toml(settings, _reason(row, choices)) + about)
    stale = set(folder.glob("*.toml")) - set(found.values())
    for path in stale:
        path.unlink()
    if choices:
        best = choices[0].row
        settings = adjusted(stages, session.pipeline.settings, best.cell.values)
        _write_if_other(request.folder / BEST, to_toml(settings, _reason(best, choices)) + about)
    else:
        (request.folder / BEST).unlink(missing_ok=True)
    return found


def _reason(row: Row, choices: Sequence[Choice]) -> str:
    says = f"cell {row.cell.index} of a sweep"
    figures = [
        f"{choice.metric.address} = {row.figures[choice.metric.address]:.6g}"
        for choice in choices
        if choice.metric.address in row.figures
    ]
    if choices and row is choices[0].row:
        says = f"the best {says}"
    return ": ".join([says, *([", ".join(figures)] if figures else [])])


def _write_if_other(path: Path, text: str) -> None:
    """Write a text file unless it holds this text already."""
    if path.is_file() and path.read_text(encoding="utf-8") == text:
        return
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")

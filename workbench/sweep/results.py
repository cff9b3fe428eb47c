"""Kept results put together again: one stage's figures over all frames, under one key."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from workbench.stage import Score, Stage
from workbench.sweep.analysis import neighbours
from workbench.sweep.axes import Cell, Grid
from workbench.sweep.cache import Cache
from workbench.sweep.pictures import agreement
from workbench.sweep.plan import Job
from workbench.sweep.table import FrameRow, Metric, Row, slug

_HELD_FRAMES = 20_000
STABILITY = "stability"


@dataclass(frozen=True)
class StageResult:
    """One stage's results under one key (a recording's own key each) over all frames."""

    metrics: tuple[tuple[Metric, float], ...]
    frames: Mapping[tuple[int, int], FrameRow]


class Reader:
    """Reads kept records and puts them together, each distinct result once."""

    def __init__(
        self,
        job: Job,
        spans: Sequence[tuple[int, int]],
        keys: Sequence[Mapping[int, Mapping[str, str]]],
        cache: Cache,
        asked: frozenset[str],
    ) -> None:
        self.job, self.spans, self.keys, self.cache = job, spans, keys, cache
        self.asked = asked
        frames = max(1, sum(stop - start for start, stop in spans))
        self.capacity = max(16, _HELD_FRAMES // frames)
        self._results: OrderedDict[tuple[str, ...], StageResult] = OrderedDict()
        self._outlines: OrderedDict[tuple[str, ...], list[bytes]] = OrderedDict()

    def identity(self, cell: Cell, stage: str) -> tuple[str, ...]:
        """What makes this cell's result of the stage what it is, over all recordings."""
        return (stage, *(keys[cell.index][stage] for keys in self.keys))

    def result(self, cell: Cell, stage: Stage) -> StageResult:
        identity = self.identity(cell, stage.name)
        if identity in self._results:
            self._results.move_to_end(identity)
            return self._results[identity]
        found = self._results[identity] = self._read(identity, stage)
        while len(self._results) > self.capacity:
            self._results.popitem(last=False)
        return found

    def outlines(self, cell: Cell, stage: str) -> list[bytes]:
        identity = self.identity(cell, stage)
        if identity in self._outlines:
            self._outlines.move_to_end(identity)
            return self._outlines[identity]
        found = self._outlines[identity] = [
            data
            for recording, key in enumerate(identity[1:])
            for _, data in self._rows(self.cache.outlines, recording, key)
        ]
        while len(self._outlines) > self.capacity:
            self._outlines.popitem(last=False)
        return found

    def _rows(self, read: Callable[..., Any], recording: int, key: str) -> Iterator[Any]:
        start, stop = self.spans[recording]
        yield from read(key, self.job.sources[recording], range(start, stop))

    def _read(self, identity: tuple[str, ...], stage: Stage) -> StageResult:
        scorer = stage.scorer()
        scored = False
        means = _Means()
        frames: dict[tuple[int, int], FrameRow] = {}
        for recording, key in enumerate(identity[1:]):
            for frame, record in self._rows(self.cache.records, recording, key):
                own = {f"{stage.name}.{slug(k)}": v for k, v in record.get("own", {}).items()}
                if record.get("stateless"):
                    for address, value in own.items():
                        means.add(Metric(address, address.partition(".")[2]), value)
                for score in (Score(**fields) for fields in record.get("figures", ())):
                    address = f"{stage.name}.{slug(score.name)}"
                    if math.isfinite(score.value):
                        metric = Metric(address, score.name, score.unit, score.better)
                        means.add(metric, score.value)
                        own[address] = score.value
                state = record.get("state")
                if state is not None and scorer is not None:
                    scorer.take(state)
                    scored = True
                    own.update(self._asked_of(stage, state))
                says = record.get("says")
                blocked = record.get("blocked_by") is not None
                error = "" if says is None or blocked else f"{stage.name}: {says}"
                ms = {stage.name: record["ms"]} if "ms" in record else {}
                frames[recording, frame] = FrameRow(recording, frame, own, ms, error)
        scores = _addressed(stage.name, scorer.summary()) if scorer is not None and scored else []
        return StageResult((*scores, *means.metrics()), frames)

    def _asked_of(self, stage: Stage, state: Mapping[str, Any]) -> dict[str, float]:
        """The chosen figures of one frame alone, to tell which frames are the worst."""
        if not any(address.startswith(f"{stage.name}.") for address in self.asked):
            return {}
        alone = stage.scorer()
        if alone is None:
            return {}
        alone.take(state)
        return {
            metric.address: value
            for metric, value in _addressed(stage.name, alone.summary())
            if metric.address in self.asked and math.isfinite(value)
        }


class _Means:
    """Means over frames of figures that have no scorer to put them together."""

    def __init__(self) -> None:
        self._values: dict[str, tuple[Metric, list[float]]] = {}

    def add(self, metric: Metric, value: float) -> None:
        self._values.setdefault(metric.address, (metric, []))[1].append(value)

    def metrics(self) -> list[tuple[Metric, float]]:
        return [(metric, math.fsum(v) / len(v)) for metric, v in self._values.values()]


def _addressed(stage: str, scores: Sequence[Score]) -> list[tuple[Metric, float]]:
    """Scores with addresses of their own: where names are equal the units tell them apart."""
    names = [slug(score.name) for score in scores]
    found = []
    for name, score in zip(names, scores, strict=True):
        unit = "" if names.count(name) == 1 else f"_{slug(score.unit)}"
        address = f"{stage}.{name}{unit}"
        found.append((Metric(address, score.name, score.unit, score.better), score.value))
        if score.coverage is not None:
            covered = Metric(f"{address}.covered", f"{score.name}: covered", "", "higher")
            found.append((covered, score.coverage))
    return found


def frame_rows(results: Mapping[str, StageResult]) -> list[FrameRow]:
    """A cell's frames, with what every stage says of them."""
    merged: dict[tuple[int, int], FrameRow] = {}
    for result in results.values():
        for where, row in result.frames.items():
            before = merged.get(where)
            merged[where] = (
                row
                if before is None
                else FrameRow(
                    row.recording,
                    row.frame,
                    {**before.figures, **row.figures},
                    {**before.ms, **row.ms},
                    before.error or row.error,
                )
            )
    return [merged[where] for where in sorted(merged)]


def mean_ms(results: Mapping[str, StageResult]) -> dict[str, float]:
    means = {}
    for name, result in results.items():
        times = [row.ms[name] for row in result.frames.values() if name in row.ms]
        if times:
            means[name] = math.fsum(times) / len(times)
    return means


def add_stability(
    whole: Grid,
    rows: Sequence[Row],
    stage: str,
    reader: Reader,
    metrics: dict[str, Metric],
) -> None:
    """How alike each cell's outlines are to its neighbours', where the stage's results differ."""
    by_index = {row.cell.index: row for row in rows}
    shares: dict[int, list[float]] = {}
    known: dict[frozenset[tuple[str, ...]], float] = {}
    for one, other in neighbours(whole, [row.cell for row in rows]):
        pair = frozenset((reader.identity(one, stage), reader.identity(other, stage)))
        if len(pair) == 1:
            continue
        if pair not in known:
            a, b = reader.outlines(one, stage), reader.outlines(other, stage)
            known[pair] = agreement(a, b) if len(a) == len(b) else math.nan
        if math.isfinite(known[pair]):
            for cell in (one, other):
                shares.setdefault(cell.index, []).append(known[pair])
    if not shares:
        return
    address = f"{stage}.{STABILITY}"
    metrics[address] = Metric(address, "stability: overlap with neighbouring cells", "", "higher")
    for index, values in shares.items():
        by_index[index].figures[address] = math.fsum(sorted(values)) / len(values)

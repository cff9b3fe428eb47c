"""What a finished grid says: the best cell, how flat it is around it, what each axis matters."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from workbench.sweep.axes import Cell, Grid
from workbench.sweep.table import Metric, Row

FLAT_SHARE = 0.05
"""A cell belongs to the flat region if it is worse than the best by no more than this share of
the spread between the best and the worst cell."""


@dataclass(frozen=True)
class Flat:
    """The cells around the best one that are nearly as good, connected by single steps."""

    cells: tuple[int, ...]
    within: float
    """By how much, in the metric's unit, a cell may be worse."""
    spans: Mapping[str, tuple[Any, Any]]
    """Each axis's first and last value among these cells."""


@dataclass(frozen=True)
class Choice:
    """The best cell by a metric."""

    metric: Metric
    row: Row
    flat: Flat
    equals: int
    """Other cells with the very same value."""


def neighbours(grid: Grid, cells: Sequence[Cell]) -> Iterator[tuple[Cell, Cell]]:
    """Pairs of cells that differ by one place on one axis (or on axes that are zipped)."""
    there = {cell.place: cell for cell in cells}
    for cell in cells:
        for dimension in range(len(grid.shape)):
            place = list(cell.place)
            place[dimension] += 1
            other = there.get(tuple(place))
            if other is not None:
                yield cell, other


def choose(grid: Grid, rows: Sequence[Row], metric: Metric) -> Choice | None:
    """The best cell, or None where no cell has the figure.

    Cells in which a stage failed count only where every cell has failures.  Among equals the
    one with the best surroundings is taken, then the first.
    """
    whole = [row for row in rows if not row.failed_frames] or list(rows)
    worth = {
        row.cell.index: metric.worth(row.figures.get(metric.address, math.nan)) for row in whole
    }
    worth = {index: value for index, value in worth.items() if value > -math.inf}
    if not worth:
        return None
    by_index = {row.cell.index: row for row in whole}
    beside: dict[int, list[int]] = {index: [] for index in worth}
    for one, other in neighbours(grid, [by_index[index].cell for index in worth]):
        beside[one.index].append(other.index)
        beside[other.index].append(one.index)
    top = max(worth.values())
    equals = [index for index, value in worth.items() if value == top]

    def surroundings(index: int) -> float:
        values = [worth[other] for other in beside[index]]
        return math.fsum(values) / len(values) if values else -math.inf

    best = max(equals, key=lambda index: (surroundings(index), -index))
    within = FLAT_SHARE * (top - min(worth.values()))
    reached = {best}
    waiting = deque([best])
    while waiting:
        for index in beside[waiting.popleft()]:
            if index not in reached and worth[index] >= top - within:
                reached.add(index)
                waiting.append(index)
    spans: dict[str, tuple[Any, Any]] = {}
    for step, axes in enumerate(grid.steps):
        places = [by_index[index].cell.place[step] for index in reached]
        for axis in axes:
            spans[axis.address] = (axis.values[min(places)], axis.values[max(places)])
    flat = Flat(tuple(sorted(reached)), within, spans)
    return Choice(metric, by_index[best], flat, len(equals) - 1)


def main_effects(grid: Grid, rows: Sequence[Row], metric: Metric) -> dict[str, float]:
    """The share of the metric's variance over the cells that each axis explains by itself.

    That is the variance of the means at each of the axis's values over the variance of all
    cells (the first-order index of a grid); what is left to 1 are the axes' interactions.
    Zipped axes are one, under their names joined by commas.  Empty where nothing varies.
    """
    values = [
        (row.cell.place, row.figures[metric.address])
        for row in rows
        if math.isfinite(row.figures.get(metric.address, math.nan))
    ]
    if not values:
        return {}
    mean = math.fsum(value for _, value in values) / len(values)
    total = math.fsum((value - mean) ** 2 for _, value in values)
    if total <= 1e-18 * max(1.0, mean**2) * len(values):
        return {}
    shares: dict[str, float] = {}
    for step, axes in enumerate(grid.steps):
        groups: dict[int, list[float]] = {}
        for place, value in values:
            groups.setdefault(place[step], []).append(value)
        between = math.fsum(
            len(group) * (math.fsum(group) / len(group) - mean) ** 2 for group in groups.values()
        )
        shares[",".join(axis.address for axis in axes)] = between / total
    return shares


def curve(rows: Sequence[Row], metric: Metric, step: int) -> list[tuple[int, float]]:
    """(place, best value) along one group of axes, over all that the others take."""
    return [(place[0], value) for place, value in sorted(_best_at(rows, metric, (step,)).items())]


def surface(
    rows: Sequence[Row], metric: Metric, steps: tuple[int, int]
) -> dict[tuple[int, ...], float]:
    """(place, place) to the best value there over all that the other axes take."""
    return _best_at(rows, metric, steps)


def _best_at(
    rows: Sequence[Row], metric: Metric, steps: tuple[int, ...]
) -> dict[tuple[int, ...], float]:
    found: dict[tuple[int, ...], float] = {}
    for row in rows:
        value = row.figures.get(metric.address, math.nan)
        if not math.isfinite(value):
            continue
        place = tuple(row.cell.place[step] for step in steps)
        if place not in found or metric.worth(value) > metric.worth(found[place]):
            found[place] = value
    return found

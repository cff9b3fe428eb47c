"""Heat maps and curves as Rerun entities, for it has neither with an axis that is not time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import rerun as rr

from workbench.sweep.axes import Axis
from workbench.sweep.table import Metric

_BACKGROUND = (14, 14, 16)
_TEXT = (190, 190, 200)
_MISSING = (50, 50, 56)
_CHOSEN = (235, 80, 80)
_CURVE = (240, 190, 90)
_FRAME = (110, 110, 120)
_CELL_WIDTH, _CELL_HEIGHT = 16, 8
"""Units that a cell of a heat map is wide and high; one pixel of its picture is one."""
_MOST_TICKS = 10
_LIFT = 0.3
"""How far a label's point is raised, in cells of a heat map, for Rerun writes below the point."""
_WIDTH, _HEIGHT = 100.0, 50.0


@dataclass
class Chart:
    """A drawing in its own units, y downwards."""

    x_range: tuple[float, float]
    y_range: tuple[float, float]
    image: np.ndarray | None = None
    strips: list[Any] = field(default_factory=list)
    colours: list[tuple[int, int, int]] = field(default_factory=list)
    labels: list[tuple[float, float, str]] = field(default_factory=list)
    values: list[tuple[float, float, str]] = field(default_factory=list)
    dots: list[tuple[float, float]] = field(default_factory=list)
    background: tuple[int, int, int] = _BACKGROUND

    def log(self, stream: Any, path: str) -> None:
        """Log it as static data under ``path``."""
        if self.image is not None:
            stream.log(f"{path}/map", rr.Image(self.image), static=True)
        if self.strips:
            lines = rr.LineStrips2D(self.strips, colors=self.colours, radii=0.25)
            stream.log(f"{path}/lines", lines, static=True)
        if self.dots:
            dots = rr.Points2D(self.dots, colors=_CURVE, radii=0.9)
            stream.log(f"{path}/dots", dots, static=True)
        for name, texts, colour in (
            ("values", self.values, (255, 255, 255)),
            ("labels", self.labels, _TEXT),
        ):
            if texts:
                points = rr.Points2D(
                    [(x, y) for x, y, _ in texts],
                    labels=[text for _, _, text in texts],
                    colors=colour,
                    radii=0.01,
                    show_labels=True,
                )
                stream.log(f"{path}/{name}", points, static=True)


def heat_chart(
    x: Axis,
    y: Axis,
    values: Mapping[tuple[int, ...], float],
    chosen: tuple[int, int],
    metric: Metric,
    most_labelled: int,
) -> Chart:
    """``values`` by place on two axes, in Viridis, yellow the best; the chosen cell is framed.

    Up to ``most_labelled`` cells on a side each is labelled with its value.
    """
    columns, rows = len(x.values), len(y.values)
    grid = np.full((rows, columns), np.nan)
    for (column, row), value in values.items():
        # The least value of y is at the bottom.
        grid[rows - 1 - row, column] = value
    worth = np.vectorize(metric.worth, otypes=[float])(grid)
    finite = np.isfinite(grid)
    low, high = (worth[finite].min(), worth[finite].max()) if finite.any() else (0.0, 1.0)
    share = np.where(finite, (worth - low) / max(high - low, 1e-12), 0.0)
    bgr = cv2.applyColorMap((255 * share).astype(np.uint8), cv2.COLORMAP_VIRIDIS)
    rgb = np.ascontiguousarray(bgr[..., ::-1])
    rgb[~finite] = _MISSING
    image = np.kron(rgb, np.ones((_CELL_HEIGHT, _CELL_WIDTH, 1), np.uint8))
    width, height = columns * _CELL_WIDTH, rows * _CELL_HEIGHT
    chart = Chart((-0.16 * width - 4, width + 4), (-0.08 * height - 2, height * 1.1 + 4), image)
    if max(rows, columns) <= most_labelled:
        count = digits(list(values.values()))
        for (row, column), value in np.ndenumerate(grid):
            if math.isfinite(value):
                x_label, y_label = (column + 0.5) * _CELL_WIDTH, (row + 0.5 - _LIFT) * _CELL_HEIGHT
                chart.values.append((x_label, y_label, told(float(value), count)))
    left, bottom = chosen[0] * _CELL_WIDTH, (rows - chosen[1]) * _CELL_HEIGHT
    right, top = left + _CELL_WIDTH, bottom - _CELL_HEIGHT
    box = [(left, top), (right, top), (right, bottom), (left, bottom), (left, top)]
    chart.strips.append(box)
    chart.colours.append(_CHOSEN)
    for place in _ticks(columns):
        where = (place + 0.5) * _CELL_WIDTH
        chart.labels.append((where, height + 0.01 * height + 1, written(x.values[place])))
    for place in _ticks(rows):
        where = (rows - place - 0.5 - _LIFT) * _CELL_HEIGHT
        chart.labels.append((-0.08 * width - 1, where, written(y.values[place])))
    return chart


def line_chart(
    axis: Axis, points: Sequence[tuple[int, float]], chosen: int, metric: Metric
) -> Chart:
    """A figure over one axis, its values evenly spaced; the chosen one is marked."""
    chart = Chart((-0.2 * _WIDTH, 1.06 * _WIDTH), (-0.16 * _HEIGHT, 1.28 * _HEIGHT))
    values = [value for _, value in points]
    if not values:
        return chart
    low, high = min(values), max(values)
    if high - low < 1e-12 * max(1.0, abs(high)):
        low, high = low - 0.5, high + 0.5
    last = max(1, len(axis.values) - 1)

    def at(place: int, value: float) -> tuple[float, float]:
        return place / last * _WIDTH, _HEIGHT * (1 - 0.9 * (value - low) / (high - low) - 0.05)

    frame = [(0, 0), (0, _HEIGHT), (_WIDTH, _HEIGHT)]
    mark = chosen / last * _WIDTH
    chart.strips = [frame, [(mark, 0), (mark, _HEIGHT)], [at(*point) for point in points]]
    chart.colours = [_FRAME, _CHOSEN, _CURVE]
    chart.dots = [at(*point) for point in points]
    unit = f" {metric.unit}" if metric.unit else ""
    for value in dict.fromkeys((min(values), max(values))):
        text = f"{told(value, digits(values))}{unit}"
        chart.labels.append((-0.1 * _WIDTH, at(0, value)[1], text))
    for place in _ticks(len(axis.values)):
        chart.labels.append((at(place, low)[0], 1.14 * _HEIGHT, written(axis.values[place])))
    return chart


def _ticks(count: int) -> range:
    return range(0, count, -(-count // _MOST_TICKS))


def digits(values: Sequence[float]) -> int:
    """Significant digits, 3 to 6, in which the least and the greatest value can be told apart."""
    low, high = min(values), max(values)
    for count in range(3, 6):
        if low == high or f"{low:.{count}g}" != f"{high:.{count}g}":
            return count
    return 6


def told(value: float, count: int) -> str:
    """A figure in ``count`` significant digits, with its closing zeros, so that columns align."""
    return f"{value:#.{count}g}".rstrip(".")


def written(value: Any) -> str:
    """An axis's value as short as it can be told."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)

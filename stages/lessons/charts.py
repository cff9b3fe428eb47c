"""Curves with axes in a 2D view of Rerun, whose own plots have time along x."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

WIDTH, HEIGHT = 160.0, 90.0
PAPER = (24, 25, 30)
INK = (225, 228, 235)
FAINT = (70, 74, 86)
NEAR_COLOUR = (255, 120, 90)
FAR_COLOUR = (80, 170, 255)
BOTH_COLOUR = (240, 200, 90)
GOOD_COLOUR = (100, 210, 130)
BAD_COLOUR = (240, 80, 90)
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class Axis:
    """Title with unit, ends and ticks of one axis."""

    title: str
    low: float
    high: float
    ticks: Sequence[float] = ()

    def place(self, values: Any) -> Any:
        """Values as shares of the axis, held a little beyond its ends."""
        share = (np.asarray(values, float) - self.low) / (self.high - self.low)
        return np.clip(share, -0.02, 1.02)


@dataclass(frozen=True)
class Curve:
    """A line over the chart, with its name in the legend; ``name`` "" leaves it out."""

    x: Any
    y: Any
    name: str
    colour: Colour
    thin: bool = False


@dataclass(frozen=True)
class Mark:
    """A point with a label."""

    x: float
    y: float
    label: str
    colour: Colour


def log_chart(
    recording: Any,
    path: str,
    x: Axis,
    y: Axis,
    curves: Sequence[Curve],
    marks: Sequence[Mark] = (),
) -> None:
    """Log curves over named axes under ``path``; what an earlier call drew is replaced."""

    def at(u: Any, v: Any) -> np.ndarray:
        return np.column_stack(
            [np.atleast_1d(x.place(u)) * WIDTH, (1 - np.atleast_1d(y.place(v))) * HEIGHT]
        )

    grid = [at([t, t], [y.low, y.high]) for t in x.ticks]
    grid += [at([x.low, x.high], [t, t]) for t in y.ticks]
    recording.log(f"{path}/grid", rr.LineStrips2D(grid, colors=FAINT, radii=0.12, draw_order=0))
    frame = [[(0, 0), (0, HEIGHT), (WIDTH, HEIGHT)]]
    recording.log(f"{path}/frame", rr.LineStrips2D(frame, colors=INK, radii=0.25, draw_order=1))
    strips, colours, radii = [], [], []
    for curve in curves:
        values = np.asarray(curve.y, float)
        for run in _known_runs(values):
            strips.append(at(np.asarray(curve.x, float)[run], values[run]))
            colours.append(curve.colour)
            radii.append(0.3 if curve.thin else 0.6)
    recording.log(
        f"{path}/curves", rr.LineStrips2D(strips, colors=colours, radii=radii, draw_order=2)
    )
    known = [m for m in marks if np.isfinite(m.x) and np.isfinite(m.y)]
    recording.log(
        f"{path}/marks",
        rr.Points2D(
            np.array([at(m.x, m.y)[0] for m in known]).reshape(-1, 2),
            colors=[m.colour for m in known],
            labels=[m.label for m in known],
            show_labels=True,
            radii=1.4,
            draw_order=4,
        ),
    )
    texts = [((float(x.place(t)) * WIDTH, HEIGHT + 1), _tick(t), INK) for t in x.ticks]
    texts += [((-7.0, (1 - float(y.place(t))) * HEIGHT - 3), _tick(t), INK) for t in y.ticks]
    texts.append(((WIDTH / 2, HEIGHT + 9), x.title, INK))
    # A label is centred on its point; this one should begin at the axis.
    texts.append(((max(14.0, 1.15 * len(y.title)), -12.0), y.title, INK))
    named = [curve for curve in curves if curve.name]
    for place, curve in enumerate(named):
        texts.append(((0.82 * WIDTH, -12.0 + 8 * place), curve.name, curve.colour))
    log_texts(recording, f"{path}/texts", texts)


def log_texts(
    recording: Any, path: str, texts: Sequence[tuple[tuple[float, float], str, Colour]]
) -> None:
    """Texts at places of a 2D view; Rerun hangs a label below its point."""
    recording.log(
        path,
        rr.Points2D(
            [place for place, _, _ in texts],
            labels=[text for _, text, _ in texts],
            colors=[colour for _, _, colour in texts],
            radii=0.01,
            show_labels=True,
            draw_order=5,
        ),
    )


def chart_view(path: str, name: str) -> Any:
    """A view of what :func:`log_chart` logged, with room for its texts."""
    return rrb.Spatial2DView(
        origin=path,
        name=name,
        background=PAPER,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-0.09 * WIDTH, 1.04 * WIDTH), y_range=(-0.14 * HEIGHT, 1.22 * HEIGHT)
        ),
    )


def picture_view(path: str, name: str, shape: tuple[int, ...] | None = None) -> Any:
    """A view of an image [H W] and what lies over it, filled by the image."""
    bounds = None
    if shape is not None:
        bounds = rrb.VisualBounds2D(x_range=(0, shape[1]), y_range=(0, shape[0]))
    return rrb.Spatial2DView(origin=path, name=name, background=PAPER, visual_bounds=bounds)


def nice_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Round numbers over a range, some ``about`` of them."""
    span = (high - low) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(span))
    step = next(power * k for k in (1, 2, 2.5, 5, 10) if power * k >= span * 0.999)
    first = np.ceil(low / step - 1e-9) * step
    return [float(round(v, 10)) for v in np.arange(first, high + 1e-9 * step, step)]


def _known_runs(values: np.ndarray) -> list[np.ndarray]:
    """Indices of the stretches of two or more numbers between NaNs."""
    known = np.flatnonzero(np.isfinite(values))
    runs = np.split(known, np.flatnonzero(np.diff(known) > 1) + 1)
    return [run for run in runs if len(run) > 1]


def _tick(value: float) -> str:
    return f"{value + 0.0:g}"

"""Pictures of this product's results in Rerun: one look for all stages.

Only logging code uses this module.  A float image is logged as a ``DepthImage``, the archetype
that has a colour map and a fixed range and shows the value under the cursor; what is unknown is
painted over it in grey, for Rerun would give it the colour of the smallest value.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any, Literal

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from .pictures import DARK as DARK
from .pictures import UNKNOWN_COLOUR, linked_rgb

_CHART_WIDTH, _CHART_HEIGHT = 100.0, 60.0
_TICK_COLOUR = (90, 150, 215)  # readable on the labels of the dark and of the light theme
_BAR_STEPS = 64
_BAR_ROOM = 1.42
Colours = Literal["turbo", "magma", "viridis"]
_OPENCV_MAPS = {
    "turbo": cv2.COLORMAP_TURBO,
    "magma": cv2.COLORMAP_MAGMA,
    "viridis": cv2.COLORMAP_VIRIDIS,
}


def grey_image(image: np.ndarray, top: float | None = None) -> Any:
    """An intensity image [H W], shown from black at 0 to white at ``top`` (its greatest)."""
    highest = float(image.max()) if top is None else top
    scale = 255 / highest if highest > 0 else 1.0
    return rr.Image(cv2.convertScaleAbs(image, alpha=scale))


def overlap(red: np.ndarray, cyan: np.ndarray) -> Any:
    """Two images [H W] in one: what they share is grey, what only one has is coloured."""
    top = max(float(red.max()), float(cyan.max()), 1e-6)
    first = cv2.convertScaleAbs(red, alpha=255 / top)
    second = cv2.convertScaleAbs(cyan, alpha=255 / top)
    return rr.Image(cv2.merge([first, second, second]))


def log_map(
    recording: Any,
    path: str,
    image: np.ndarray,
    low: float,
    high: float,
    colours: Colours,
    ticks: tuple[str, str, str],
) -> None:
    """Log a float map [H W] under ``path``, with its unknown pixels and a colour bar.

    ``ticks`` are the texts at the low end, the middle and the high end of the bar.
    """
    known = np.isfinite(image)
    recording.log(
        f"{path}/values",
        rr.DepthImage(
            np.where(known, image, np.float32(low)).astype(np.float32, copy=False),
            meter=1.0,
            depth_range=(low, high),
            colormap=colours,
        ),
    )
    # Not static: a viewer that is open loses the colours when they are logged so a second time.
    recording.log(
        f"{path}/unknown",
        rr.AnnotationContext([(0, "known", (0, 0, 0, 0)), (1, "unknown", UNKNOWN_COLOUR)]),
        rr.SegmentationImage((~known).astype(np.uint8)),
    )
    _log_bar(recording, path, image.shape, colours, ticks)


def log_signed_error(recording: Any, path: str, error_mm: np.ndarray, span_mm: float) -> None:
    """Log a signed error [H W]: blue where measured too near, red where too far, white at 0."""
    known = np.isfinite(error_mm)
    place = np.clip(np.nan_to_num(error_mm) / span_mm, -1, 1)
    away = np.abs(place)[..., None]
    end = np.where(place[..., None] < 0, _BLUE, _RED)
    rgb = (_WHITE * (1 - away) + end * away).astype(np.uint8)
    rgb[~known] = UNKNOWN_COLOUR
    recording.log(f"{path}/values", rr.Image(rgb))
    colours = np.array(
        [
            _WHITE * (1 - abs(p)) + (_BLUE if p < 0 else _RED) * abs(p)
            for p in np.linspace(1, -1, _BAR_STEPS)
        ],
        np.uint8,
    )
    ticks = (f"{-span_mm:g} mm", "0", f"+{span_mm:g} mm")
    _log_bar_strips(recording, path, error_mm.shape, colours, ticks)


_WHITE = np.array([245.0, 245.0, 245.0])
_BLUE = np.array([40.0, 90.0, 230.0])
_RED = np.array([220.0, 40.0, 40.0])


def _log_bar(
    recording: Any, path: str, shape: tuple[int, ...], colours: Colours, ticks: tuple[str, str, str]
) -> None:
    levels = np.linspace(255, 0, _BAR_STEPS).astype(np.uint8)[:, None]
    table = cv2.applyColorMap(levels, _OPENCV_MAPS[colours])[:, 0, ::-1]
    _log_bar_strips(recording, path, shape, table, ticks)


def _log_bar_strips(
    recording: Any,
    path: str,
    shape: tuple[int, ...],
    colours: np.ndarray,
    ticks: tuple[str, str, str],
) -> None:
    height, width = shape[:2]
    left = width * 1.05
    rows = np.linspace(0, height - 1, _BAR_STEPS + 1)
    recording.log(
        f"{path}/bar",
        rr.LineStrips2D(
            [[(left, a), (left, b)] for a, b in pairwise(rows)],
            colors=colours,
            radii=width * 0.02,
        ),
    )
    low, middle, high = ticks
    recording.log(
        f"{path}/bar/ticks",
        rr.Points2D(
            [(left + width * 0.2, y) for y in (0.0, 0.45 * height, 0.86 * height)],
            labels=[high, middle, low],
            colors=[_TICK_COLOUR] * 3,
            radii=0.05,
            show_labels=True,
        ),
    )


def map_view(path: str, name: str, shape: tuple[int, ...]) -> Any:
    """A view of what :func:`log_map` logged, with room for the colour bar."""
    height, width = shape[:2]
    return rrb.Spatial2DView(
        origin=path,
        name=name,
        background=DARK,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0, width * _BAR_ROOM), y_range=(-0.02 * height, 1.02 * height)
        ),
    )


def edge_image(edges: np.ndarray) -> Any:
    """Edges [H W] bool, white on black."""
    return rr.Image(edges.view(np.uint8) * np.uint8(255))


def linked_image(step: np.ndarray, lines: np.ndarray) -> Any:
    """Lines [H W] by the step that drew them: the paper shades its links (figure 7)."""
    return rr.Image(linked_rgb(step, lines))


def log_chart(
    recording: Any,
    path: str,
    x: np.ndarray,
    y: np.ndarray,
    marks: dict[str, float],
    level: float | None = None,
) -> None:
    """A curve y(x) as lines in a unit square, with marked places on x and a level on y.

    Rerun's plots have time along x; a threshold's curve has no time.
    """
    width = max(float(x[-1]), 1e-9)
    top = max(float(y.max(initial=0)), level or 0.0, 1e-9) * 1.05

    def place(u: float, v: float) -> tuple[float, float]:
        return (u / width * _CHART_WIDTH, _CHART_HEIGHT * (1 - v / top))

    curve = np.column_stack([x / width * _CHART_WIDTH, _CHART_HEIGHT * (1 - y / top)])
    frame = [(0, 0), (0, _CHART_HEIGHT), (_CHART_WIDTH, _CHART_HEIGHT)]
    strips: list[Any] = [curve, frame]
    colours = [(240, 190, 90), (120, 120, 130)]
    if level is not None:
        strips.append([place(0, level), place(width, level)])
        colours.append((120, 120, 130))
    for value in marks.values():
        strips.append([place(value, 0), place(value, top)])
        colours.append((235, 80, 80))
    recording.log(path, rr.LineStrips2D(strips, colors=colours, radii=0.5))
    labels = [f"{name} {value:.1f}" for name, value in marks.items()]
    # Below one another, for thresholds may lie close.
    spots = [
        (place(value, 0)[0], _CHART_HEIGHT * (0.1 + 0.22 * k))
        for k, value in enumerate(marks.values())
    ]
    recording.log(
        f"{path}/marks",
        rr.Points2D(spots, labels=labels, colors=(235, 80, 80), radii=0.3, show_labels=True),
    )
    ends = [(0, _CHART_HEIGHT), (_CHART_WIDTH, _CHART_HEIGHT)]
    recording.log(
        f"{path}/scale",
        rr.Points2D(
            ends, labels=["0", f"{width:.0f}"], colors=_TICK_COLOUR, radii=0.3, show_labels=True
        ),
    )


def chart_view(path: str, name: str) -> Any:
    """A view of what :func:`log_chart` logged."""
    return rrb.Spatial2DView(
        origin=path,
        name=name,
        background=DARK,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(-0.06 * _CHART_WIDTH, 1.06 * _CHART_WIDTH),
            y_range=(-0.05 * _CHART_HEIGHT, 1.3 * _CHART_HEIGHT),
        ),
    )


def eye_above(points: np.ndarray) -> Any:
    """An eye that sees points [N 3] from the side, with the camera above, as the rig stands."""
    low, high = np.percentile(points, [2, 98], axis=0)
    middle = (low + high) / 2
    size = float(np.linalg.norm(high - low))
    target = middle - np.array([0, 0, 0.2 * size])
    return rrb.EyeControls3D(
        position=target + size * np.array([0.5, 1.25, -0.75]),
        look_target=target,
        eye_up=(0, 0, -1),
    )

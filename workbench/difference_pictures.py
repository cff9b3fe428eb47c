"""Pictures of differences in Rerun: one legend for masks, codes, regions and maps.

What A has more of is cyan, what B has more of is yellow, and what is the same is dark or grey.
The only place besides the layout of a comparison that knows how a difference is drawn, shared by
``compare`` and by the live page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from workbench.differences import Difference, Knowledge, Place

_A = (60, 205, 235)
_B = (250, 205, 50)
_BOTH = (150, 150, 158)
_OTHER = (225, 90, 220)
_DARK = (14, 14, 16)
_UNKNOWN = (62, 62, 70)
_SAME_REGION = (58, 58, 64)
_KNOWN_IN_A = (150, 80, 235)
_KNOWN_IN_B = (60, 190, 90)
_BAR_STEPS = 48
_BAR_ROOM = 1.42
_TICK_COLOUR = (90, 150, 215)  # readable on the labels of the dark and of the light theme
_SPAN_PERCENTILE = 95.0
_BAR_COLOURS = ((60, 220, 235), (45, 110, 200), (48, 48, 52), (150, 120, 50), (250, 225, 60))

LEGEND = (
    "**cyan** only in A, or greater in A; **yellow** only in B, or greater in B; **grey** in both; "
    "**magenta** in both, but another value or a region cut in another way; in maps "
    "**violet** known only in A, **green** known only in B"
)
"""The colours in words, as markdown for a page beside the pictures."""


def has_picture(difference: Difference) -> bool:
    """Whether :func:`log_difference` has a picture to draw."""
    return difference.states is not None or difference.signed is not None


def log_difference(recording: Any, path: str, difference: Difference) -> None:
    """Log the picture of a difference under ``path``; clear it where there is none.

    States are a ``SegmentationImage``, which names the state under the cursor; a signed map is
    a ``DepthImage``, which tells the value there, over its own range: the scale beside it is
    rounded up to 1, 2 or 5, so that it seldom changes from frame to frame.  Its unit is the
    artifact's, which belongs into the name of the view.
    """
    if difference.states is not None:
        # Regions fill the picture: what is the same in both must not outshine what is not.
        same = _SAME_REGION if difference.kind == "labels" else _BOTH
        recording.log(
            f"{path}/states",
            rr.AnnotationContext(
                [
                    (int(Place.NEITHER), "in neither", _DARK),
                    (int(Place.BOTH), "the same in both", same),
                    (int(Place.ONLY_A), "only in A", _A),
                    (int(Place.ONLY_B), "only in B", _B),
                    (int(Place.OTHER), "another in B", _OTHER),
                ]
            ),
            static=True,
        )
        recording.log(f"{path}/states", rr.SegmentationImage(difference.states, opacity=1.0))
    elif difference.signed is not None and difference.knowledge is not None:
        _log_map(recording, path, difference.signed, difference.knowledge)
    else:
        recording.log(path, rr.Clear(recursive=True))


def difference_view(path: str, name: str, difference: Difference) -> Any:
    """A view of what :func:`log_difference` logged, with room for the scale of a map."""
    picture = difference.states if difference.states is not None else difference.signed
    if picture is None:
        return rrb.Spatial2DView(origin=path, name=name, background=_DARK)
    height, width = picture.shape
    room = 1.0 if difference.states is not None else _BAR_ROOM
    return rrb.Spatial2DView(
        origin=path,
        name=name,
        background=_DARK,
        visual_bounds=rrb.VisualBounds2D(
            x_range=(0, room * width), y_range=(-0.02 * height, 1.02 * height)
        ),
    )


def _log_map(
    recording: Any,
    path: str,
    signed: NDArray[np.float32],
    knowledge: NDArray[np.uint8],
) -> None:
    span = span_of(signed)
    recording.log(
        f"{path}/values",
        rr.DepthImage(signed, meter=1.0, depth_range=(-span, span), colormap="cyantoyellow"),
    )
    recording.log(
        f"{path}/known",
        rr.AnnotationContext(
            [
                (int(Knowledge.BOTH), "known in both", (0, 0, 0, 0)),
                (int(Knowledge.ONLY_A), "known only in A", _KNOWN_IN_A),
                (int(Knowledge.ONLY_B), "known only in B", _KNOWN_IN_B),
                (int(Knowledge.NEITHER), "unknown in both", _UNKNOWN),
            ]
        ),
        static=True,
    )
    recording.log(f"{path}/known", rr.SegmentationImage(knowledge))
    height, width = signed.shape
    left = width * 1.05
    rows = np.linspace(0, height - 1, _BAR_STEPS + 1)
    recording.log(
        f"{path}/scale",
        rr.LineStrips2D(
            [[(left, a), (left, b)] for a, b in pairwise(rows)],
            colors=_bar_colours(),
            radii=width * 0.02,
        ),
    )
    recording.log(
        f"{path}/scale/ticks",
        rr.Points2D(
            [(left + width * 0.2, y) for y in (0.0, 0.45 * height, 0.86 * height)],
            labels=[f"+{span:g}", "0", f"−{span:g}"],
            colors=[_TICK_COLOUR] * 3,
            radii=0.05,
            show_labels=True,
        ),
    )


def span_of(signed: NDArray[np.float32]) -> float:
    """The end of the scale of a signed map: most of what differs, rounded up to 1, 2 or 5."""
    size = np.abs(signed[np.isfinite(signed) & (signed != 0)])
    greatest = float(np.percentile(size, _SPAN_PERCENTILE)) if len(size) else 0.0
    if not greatest > 0:
        return 1.0
    decade = 10.0 ** math.floor(math.log10(greatest))
    return next(step * decade for step in (1, 2, 5, 10) if greatest <= step * decade * (1 + 1e-9))


def _bar_colours() -> NDArray[np.uint8]:
    """The scale's colours from its upper end down, as Rerun's ``CyanToYellow`` paints them."""
    places = np.linspace(1, 0, _BAR_STEPS)
    knots = np.linspace(0, 1, len(_BAR_COLOURS))
    columns: Sequence[Sequence[int]] = list(zip(*_BAR_COLOURS, strict=True))
    return np.stack([np.interp(places, knots, column) for column in columns], 1).astype(np.uint8)

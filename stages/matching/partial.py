"""Naming a surface of which something is hidden, by what shows of it.

The paper recognises a surface while less than 20 % of it is covered (section 7), and does not say
how; its features (area, perimeter, …) change with the first pixel that is hidden.  Here the part's
outline, from its manifold, is laid over the visible region at every turn and place.  Three kinds of
pixels are told apart: those of the region, which the part must cover; those where something else is
seen *behind* the surface's plane, which it must leave free; and those where something lies in
front, or nothing is known, where it may go on unseen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2

from .database import Database
from .eigenspace import OUTLINE_STEP_DEG, Eigenspace
from .surfaces import Surface, grid_px, upright_view

__all__ = ["Visible", "name_by_what_shows"]

F32 = NDArray[np.float32]

_FINE_DEG = 1.0
_FINE_PX = 2
_FINER = 3
"""The grid on which a misfit is measured is so much finer than the eigenspace's; odd, so that the
one's middles are the other's."""

_IN_FRONT_MM = 2.0
"""What is nearer than the surface's plane by more hides it, if it does."""

_BORDER_PX = 0.4
"""A border that is known no better than this, all around, is the misfit that the right part has."""

_CLEARLY = 1.5
"""The next best part's misfit must be so many times what a border explains, or what is hidden could
make either of the two."""


@dataclass(frozen=True)
class Visible:
    """The part that fits best to what shows.

    Attributes:
        model: index of the part, -1 for none of a possible area.
        hidden_share: of its surface, 0..1.
        misfit: area of the region that it does not cover and of the free surroundings that it
            does, over its own area.
        next_misfit: of the best of the other parts; infinite without one.
        allowed: misfit that the uncertainty of its border explains.
    """

    model: int
    hidden_share: float
    misfit: float
    next_misfit: float
    allowed: float

    def names(self, most_hidden: float) -> bool:
        """Whether this is that part and no other, with ``most_hidden`` (0..1) of it covered."""
        return (
            self.model >= 0
            and self.hidden_share <= most_hidden
            and self.misfit <= self.allowed
            and self.next_misfit > _CLEARLY * self.allowed
        )


def name_by_what_shows(
    surface: Surface,
    label: int,
    labels: np.ndarray,
    depth_m: np.ndarray,
    database: Database,
    most_hidden: float,
) -> Visible:
    """Fit every part whose surface could be this one with up to ``most_hidden`` (0..1) covered.

    Args:
        surface: the face, as it was cut out.
        label: its region in ``labels`` [H W] int32, 0 = none.
        depth_m: [H W] float32, NaN where unknown.
    """
    seen: tuple[F32, F32] | None = None
    border_mm = _BORDER_PX * surface.pixel_mm
    fits = []
    for k, part in enumerate(database.parts):
        whole, perimeter = np.median(part.features[:, :2], axis=0)
        slack = border_mm * perimeter
        if (1 - most_hidden) * whole - slack <= surface.area_mm2 <= whole + slack:
            if seen is None:
                side, mm_per_px = _FINER * database.side, database.mm_per_px / _FINER
                seen = _kinds(surface, label, labels, depth_m, side, mm_per_px)
            misfit, hidden = _fit(part.space, *seen)
            fits.append((misfit, hidden, float(slack / whole), k))
    if not fits:
        return Visible(-1, np.nan, np.inf, np.inf, np.nan)
    fits.sort()
    misfit, hidden, allowed, model = fits[0]
    return Visible(model, hidden, misfit, fits[1][0] if len(fits) > 1 else np.inf, allowed)


def _fit(space: Eigenspace, region: F32, free: F32) -> tuple[float, float]:
    """Least misfit of a surface over all turns and places, and how much of it is hidden there.

    ``region`` and ``free``: [N N], as :func:`_kinds` tells them on the finer grid.
    """
    middle = slice(_FINER // 2, None, _FINER)
    turn, mirrored, down, right = _coarse(space, (region - free)[middle, middle])
    reach_deg = OUTLINE_STEP_DEG / 2
    turns = turn + np.arange(-reach_deg, reach_deg + _FINE_DEG / 2, _FINE_DEG)
    masks = np.stack([space.outline(float(t), _FINER) for t in turns])
    masks = (masks[..., ::-1] if mirrored else masks).reshape(len(turns), -1)
    areas = np.maximum(masks.sum(axis=1), 1.0)
    on_region, on_free = (
        _around(kind, _FINER * down, _FINER * right) @ masks.T for kind in (region, free)
    )
    misfit = (float(region.sum()) - on_region + on_free) / areas
    at = np.unravel_index(int(misfit.argmin()), misfit.shape)
    hidden = 1 - (on_region[at] + on_free[at]) / float(areas[at[1]])
    return float(misfit[at]), float(hidden)


def _coarse(space: Eigenspace, wanted: F32) -> tuple[float, bool, int, int]:
    """Turn [deg], mirrored or not, and place (down, right, px) of the outline that fits best.

    ``wanted`` [N N] is 1 where the part must be, -1 where it must not.  All places are tried in
    the Fourier domain.
    """
    outlines = space.outlines
    size = outlines.size
    gain = irfft2(outlines.spectra * rfft2(wanted, (size, size)), (size, size))
    # Of outlines that gain as much, the one with less of itself elsewhere.
    gain -= outlines.area_px[:, None, None] / 2
    k, *place = np.unravel_index(int(gain.argmax()), gain.shape)
    down, right = (int(v) if v < size // 2 else int(v) - size for v in place)
    return float(outlines.turn_deg[k]), bool(outlines.mirrored[k]), down, right


def _around(image: F32, down: int, right: int) -> F32:
    """``image`` [N N] moved back by (down, right) and by a little more each way, [M N·N]."""
    side = len(image)
    room = max(abs(down), abs(right)) + _FINE_PX
    wide = np.pad(image, room)
    reach = range(-_FINE_PX, _FINE_PX + 1)
    corners = [(room + down + i, room + right + j) for i in reach for j in reach]
    return np.stack([wide[y : y + side, x : x + side].ravel() for y, x in corners])


def _kinds(
    surface: Surface,
    label: int,
    labels: np.ndarray,
    depth_m: np.ndarray,
    side: int,
    mm_per_px: float,
) -> tuple[F32, F32]:
    """On the rectified grid [side side]: pixels of the region, and those that are seen behind."""
    columns, rows = grid_px(surface, side, mm_per_px)
    height, width = labels.shape
    column, row = np.round(columns).astype(int), np.round(rows).astype(int)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    column, row = np.clip(column, 0, width - 1), np.clip(row, 0, height - 1)
    rx, ry = surface.camera.rays(column.astype(np.float64), row.astype(np.float64))
    normal = surface.normal
    slant = normal[0] * rx + normal[1] * ry + normal[2]
    plane_m = float(normal @ surface.origin_m) / slant
    shown = labels[row, column]
    behind = plane_m - depth_m[row, column] < 1e-3 * _IN_FRONT_MM
    # Softened, the region's staircase is not taken for the part's border.
    region = upright_view(surface, side, mm_per_px) > 0.5
    free = inside & (shown > 0) & (shown != label) & behind & ~region
    return region.astype(np.float32), free.astype(np.float32)

"""Eigenspaces of one part's surface, and the curve of its rotation in them (paper, 6.1 to 6.4)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import next_fast_len, rfft2
from scipy.interpolate import CubicSpline

from .surfaces import Surface, soft_view

__all__ = [
    "OUTLINE_STEP_DEG", "POINTS", "Eigenspace", "Match", "Outlines", "build", "match", "matches",
    "turned_views",
]  # fmt: skip

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

POINTS = 720
"""Points to which the manifold is resampled: one every half degree."""

OUTLINE_STEP_DEG = 10.0

_MIRRORED_APART = 0.1
"""A mirror image that differs by more of its area is no turned view of the surface."""

_SYMMETRIES = range(12, 1, -1)

_AS_FAR = 2.0
"""A manifold repeats where its turns lie no farther apart than this many times the views'
own distances from it."""


@dataclass(frozen=True)
class Eigenspace:
    """The eigenspace of one part.

    Attributes:
        mean: [N] float32, the mean image Ī; with the 1/P that equation 8 lacks.
        basis: [M N] float32, the eigenimages E, orthonormal rows.
        variance: [M] float64, share of the set's variance that each holds.
        manifold: [720 M] float32, projections over the rotation, one every half degree.
        views_deg: [V] float64 and views: [V M] float32, the training views' own projections.
        norm: mean norm of a centred image of the set, by which distances are divided.
        order: how often the surface looks the same in one turn.
    """

    mean: F32
    basis: F32
    variance: F64
    manifold: F32
    views_deg: F64
    views: F32
    norm: float
    order: int

    @property
    def side(self) -> int:
        """Pixels of an image's side."""
        return int(round(np.sqrt(self.mean.size)))

    def outline(self, turn_deg: float, enlarged: int = 1) -> F32:
        """The surface [N N], 0 or 1, as the nearest point of the manifold shows it."""
        at = round(turn_deg * POINTS / 360) % POINTS
        image = (self.mean + self.manifold[at] @ self.basis).reshape(self.side, self.side)
        if enlarged > 1:
            image = cv2.resize(image, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
        return (image > 0.5).astype(np.float32)

    @cached_property
    def outlines(self) -> Outlines:
        """The surface's outlines at every tenth degree."""
        turns = np.arange(0, 360 / self.order, OUTLINE_STEP_DEG)
        masks = np.stack([self.outline(float(turn)) for turn in turns])
        flipped = np.ascontiguousarray(masks[..., ::-1])
        # Where the mirror image is one of the turned ones it is not another surface.
        apart = np.abs(flipped[0] - masks).sum(axis=(1, 2)).min() / masks[0].sum()
        mirrored = np.zeros(len(turns), bool)
        if apart > _MIRRORED_APART:
            masks, turns = np.concatenate([masks, flipped]), np.tile(turns, 2)
            mirrored = np.repeat([False, True], len(mirrored))
        size = next_fast_len(2 * self.side, real=True)
        return Outlines(
            turns, mirrored, masks.sum(axis=(1, 2)), np.conj(rfft2(masks, (size, size))), size
        )


@dataclass(frozen=True)
class Outlines:
    """A surface's outlines, turned and mirrored, ready to be laid anywhere over an image.

    Attributes:
        turn_deg: [K] and mirrored: [K] bool, of each; mirrored before the turn is undone.
        area_px: [K] of each.
        spectra: [K size size/2+1] complex, conjugated.
        size: of the transforms, twice an image's side or more.
    """

    turn_deg: F64
    mirrored: NDArray[np.bool_]
    area_px: F32
    spectra: NDArray[np.complex64]
    size: int


@dataclass(frozen=True)
class Match:
    """The nearest point of a manifold.

    Attributes:
        rotation_deg: in [0, 360 / order).
        distance: of the whole image from the manifold, shares of the set's norm: what lies
            outside the eigenspace counts, for there another part would be.
        within: the distance inside the eigenspace (equation 13), in the same unit.
    """

    rotation_deg: float
    distance: float
    within: float


def turned_views(
    surfaces: Sequence[Surface],
    angles_deg: np.ndarray,
    at_deg: np.ndarray,
    side: int,
    mm_per_px: float,
) -> F32:
    """Images [A N] of the part at angles ``at_deg`` [A], from the views at ``angles_deg`` [V].

    A rectified face turns rigidly in its plane.  So between two views the face is known: each
    neighbour is turned the rest of the way, and the two are mixed by how near they are.  Where a
    view was taken the image is that view.
    """
    order = np.argsort(angles_deg)
    known = np.asarray(angles_deg, np.float64)[order]
    out = np.empty((len(at_deg), side * side), np.float32)
    for row, angle in enumerate(np.asarray(at_deg) % 360):
        after = int(np.searchsorted(known, angle, side="right")) % len(known)
        before = (after - 1) % len(known)
        gap = (known[after] - known[before]) % 360 or 360.0
        share = ((angle - known[before]) % 360) / gap
        image = np.zeros((side, side), np.float32)
        for k, weight in ((before, 1 - share), (after, share)):
            if weight > 1e-9:
                turn = float((angle - known[k] + 180) % 360 - 180)
                image += np.float32(weight) * soft_view(surfaces[order[k]], side, mm_per_px, turn)
        out[row] = image.ravel()
    return out


def build(
    surfaces: Sequence[Surface],
    angles_deg: np.ndarray,
    side: int,
    mm_per_px: float,
    share: float = 0.98,
    step_deg: float = 5.0,
) -> tuple[Eigenspace, F64]:
    """The eigenspace of a part from its views, and each view's distance left out, [V].

    Args:
        surfaces: V views of one face.
        angles_deg: [V] known rotations, anywhere in the turn.
        side, mm_per_px: of the images.
        share: of the variance that the kept eigenvectors hold.
        step_deg: the set is filled up with turned views (:func:`turned_views`) to this step, for
            30° between two views of a long part is more than a spline can guess.
    """
    angles = np.asarray(angles_deg, np.float64) % 360
    filled = np.unique(np.concatenate([np.round(angles, 6), np.arange(0, 360, step_deg)]))
    # Views a hair from a filled angle make a spline's knots too close.
    gaps = np.diff(filled, append=filled[0] + 360)
    is_view = np.isin(filled, np.round(angles, 6))
    crowded = (gaps < step_deg / 4) | (np.roll(gaps, 1) < step_deg / 4)
    filled = filled[is_view | ~crowded]
    images = turned_views(surfaces, angles, filled, side, mm_per_px).astype(np.float64)
    mean = images.mean(axis=0)
    centred = images - mean
    norm = float(np.sqrt((images**2).sum(axis=1).mean()))
    # The reduced covariance Q = S Sᵀ (equation 10): P×P, not N×N.
    values, vectors = np.linalg.eigh(centred @ centred.T)
    values, vectors = np.maximum(values[::-1], 0), vectors[:, ::-1]
    total = max(float(values.sum()), 1e-12)
    kept = int(np.searchsorted(np.cumsum(values) / total, min(share, 1 - 1e-9))) + 1
    kept = max(min(kept, int((values > 1e-9 * total).sum())), 1)
    basis = vectors[:, :kept].T @ centred
    basis /= np.maximum(np.linalg.norm(basis, axis=1, keepdims=True), 1e-12)
    # An eigenvector's sign means nothing; a file should be the same every time.
    basis *= np.sign(basis[np.arange(kept), np.abs(basis).argmax(axis=1)])[:, None]
    projected = centred @ basis.T
    closed = np.concatenate([projected, projected[:1]])
    spline = CubicSpline(np.append(filled, filled[0] + 360), closed, bc_type="periodic", axis=0)
    at = np.arange(POINTS) * (360 / POINTS)
    manifold = spline(filled[0] + (at - filled[0]) % 360)
    own = np.array([soft_view(s, side, mm_per_px).ravel() for s in surfaces], np.float64)
    left_out = _left_out(surfaces, angles, own, side, mm_per_px) / norm
    order = _order(manifold / norm, left_out)
    space = Eigenspace(
        mean.astype(np.float32), basis.astype(np.float32), values[:kept] / total,
        manifold.astype(np.float32), angles, ((own - mean) @ basis.T).astype(np.float32),
        norm, order,
    )  # fmt: skip
    return space, left_out


def _left_out(
    surfaces: Sequence[Surface], angles: F64, own: F64, side: int, mm_per_px: float
) -> F64:
    """Distance of each view from what the others say of its angle, [V], grey levels."""
    count = len(surfaces)
    if count < 3:
        return np.zeros(count)
    out = np.empty(count)
    for i in range(count):
        others = [k for k in range(count) if k != i]
        said = turned_views(
            [surfaces[k] for k in others], angles[others], angles[i : i + 1], side, mm_per_px
        )
        out[i] = np.linalg.norm(own[i] - said[0])
    return out


def _order(manifold: F64, left_out: F64) -> int:
    """How often the manifold [720 M] runs through the same curve in one turn."""
    noise = float(np.sqrt((left_out**2).mean())) if left_out.size else 0.0
    for order in _SYMMETRIES:
        at = (np.arange(POINTS) + POINTS / order) % POINTS
        low = at.astype(int)
        part = (at - low)[:, None]
        turned = (1 - part) * manifold[low] + part * manifold[(low + 1) % POINTS]
        apart = float(np.sqrt(((manifold - turned) ** 2).sum(axis=1).mean()))
        if apart <= _AS_FAR * noise:
            return order
    return 1


def match(space: Eigenspace, image: np.ndarray) -> Match:
    """The nearest point of the manifold to ``image`` [N], refined below the manifold's step."""
    return matches(space, image)[0]


def matches(space: Eigenspace, image: np.ndarray, apart_deg: float = 20.0) -> list[Match]:
    """The manifold's nearest points to ``image``, the best of each valley, nearest first.

    All of them, for a full turn: where the surface is the same after a part of a turn there is
    one in every part, and their distances tell how sure the choice between them is.
    """
    centred = np.asarray(image, np.float64).ravel() - space.mean
    h = space.basis.astype(np.float64) @ centred
    outside = max(float(centred @ centred - h @ h), 0.0)
    manifold = space.manifold.astype(np.float64)
    squares = ((manifold - h) ** 2).sum(axis=1)
    valley = (squares <= np.roll(squares, 1)) & (squares < np.roll(squares, -1))
    found: list[Match] = []
    for i in np.flatnonzero(valley)[np.argsort(squares[valley], kind="stable")]:
        before, here, after = squares[[i - 1, i, (i + 1) % POINTS]]
        bend = before - 2 * here + after
        # The parabola through three squared distances: along a smooth curve they are one.
        offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
        best = here - 0.25 * (before - after) * offset
        rotation = ((i + offset) * 360 / POINTS) % 360
        if any(abs((m.rotation_deg - rotation + 180) % 360 - 180) < apart_deg for m in found):
            continue
        within = max(float(best), 0.0)
        found.append(
            Match(
                float(rotation),
                float(np.sqrt(within + outside)) / space.norm,
                float(np.sqrt(within)) / space.norm,
            )
        )
    if not found:
        i = int(squares.argmin())
        found.append(
            Match(
                i * 360 / POINTS,
                float(np.sqrt(squares[i] + outside)) / space.norm,
                float(np.sqrt(squares[i])) / space.norm,
            )
        )
    return found

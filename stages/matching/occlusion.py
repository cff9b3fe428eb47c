"""Which regions lie below their neighbours, from the depth along shared borders (paper, 5)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..edges.planes import Camera

__all__ = ["Cover", "covers"]

_REACH = 3
"""Regions that stand no farther apart than this many pixels share a border: a line's width."""


_UPPER_PERCENT = 90.0
"""Of a region's heights: what is over it may be an outlier, or the sensor's window over an edge."""


class Cover(dict[tuple[int, int], tuple[int, float]]):
    """(below, above) → pixels of border along which it is so, and by how much (median, metres)."""


def covers(
    labels: np.ndarray,
    point_m: np.ndarray,
    normal: np.ndarray,
    residual_m: np.ndarray,
    camera: Camera,
    least_m: float,
    depth_m: np.ndarray,
) -> Cover:
    """Who lies above whom: both planes are carried on to the border and compared there.

    A steep flank of which little is measured can have a plane that is far from it.  So some of
    what was measured of the upper region must lie above the lower one's plane as well.

    Args:
        labels: [H W] int32, 0 = none.
        point_m, normal: [R 3], residual_m: [R], the regions' planes; NaN where there is none.
        camera: intrinsics.
        least_m: a smaller step is none; nor is one of less than 3 standard deviations of the fits.
        depth_m: [H W] float32, NaN where unknown.

    Returns:
        for each pair in which one lies above the other: how many border pixels say so.
    """
    count = len(point_m)
    offset = (normal * point_m).sum(axis=1)
    found: list[NDArray[np.int64]] = []
    height, width = labels.shape
    for dy, dx in ((0, 1), (1, 0)):
        for reach in range(1, _REACH + 1):
            v, u = dy * reach, dx * reach
            a, b = labels[: height - v, : width - u], labels[v:, u:]
            between = np.ones(a.shape, np.bool_)
            for k in range(1, reach):
                # A pixel nearer that has a region of its own has the border to itself.
                middle = labels[dy * k : height - v + dy * k, dx * k : width - u + dx * k]
                between &= ~_has_plane(middle, residual_m)
            both = (a != b) & (a > 0) & (b > 0) & between
            rows, columns = np.nonzero(both)
            found.append(
                np.stack([a[both], b[both], 2 * rows + v, 2 * columns + u], axis=1).astype(np.int64)
            )
    pairs = np.concatenate(found) if found else np.empty((0, 4), np.int64)
    below: dict[tuple[int, int], list[float]] = {}
    first, second = pairs[:, 0] - 1, pairs[:, 1] - 1
    ok = np.isfinite(residual_m[first]) & np.isfinite(residual_m[second])
    first, second, pairs = first[ok], second[ok], pairs[ok]
    rx, ry = camera.rays(pairs[:, 3] / 2, pairs[:, 2] / 2)
    ray = np.stack([rx, ry, np.ones_like(rx)], axis=1)
    slant_a = (normal[first] * ray).sum(axis=1)
    slant_b = (normal[second] * ray).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = offset[first] / slant_a - offset[second] / slant_b
        # Along the ray a steep plane's depth errs more than the plane does.
        step = step * np.minimum(np.abs(slant_a), np.abs(slant_b))
    noise = 3 * np.sqrt(residual_m[first] ** 2 + residual_m[second] ** 2)
    telling = np.isfinite(step) & (np.abs(step) > np.maximum(least_m, noise))
    # A flank that falls away from its own top is never above it, however its steep plane was
    # carried on to the border: the middle of what lies above is above.
    lower, upper = np.where(step > 0, (first, second), (second, first))
    telling &= ((point_m[upper] - point_m[lower]) * normal[lower]).sum(axis=1) > 0
    for i in np.flatnonzero(telling):
        low, high = (first[i], second[i]) if step[i] > 0 else (second[i], first[i])
        below.setdefault((int(low) + 1, int(high) + 1), []).append(abs(float(step[i])))
    assert count == len(residual_m)
    return Cover(
        {
            (low, high): (len(steps), float(np.median(steps)))
            for (low, high), steps in below.items()
            if _rises_above(labels == high, depth_m, camera, normal[low - 1], offset[low - 1])
            > least_m
        }
    )


def _rises_above(
    region: NDArray[np.bool_],
    depth_m: np.ndarray,
    camera: Camera,
    normal: np.ndarray,
    offset_m: float,
) -> float:
    """How far the upper tenth of a region lies above a plane, metres; -inf if nothing is known."""
    rows, columns = np.nonzero(region & np.isfinite(depth_m))
    if not len(rows):
        return -np.inf
    z = depth_m[rows, columns].astype(np.float64)
    rx, ry = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    height = z * (normal[0] * rx + normal[1] * ry + normal[2]) - offset_m
    return float(np.percentile(height, _UPPER_PERCENT))


def _has_plane(labels: np.ndarray, residual_m: np.ndarray) -> NDArray[np.bool_]:
    known = np.concatenate([[False], np.isfinite(residual_m)])
    return known[labels]

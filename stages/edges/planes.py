"""Planes through depth images, robustly (paper, 5).

A plane n · P = d, seen along the rays (X/z, Y/z, 1), has the inverse depth 1/z = (n · ray) / d:
linear in the ray.  So a plane is fitted by nine sums over pixels, without making points of them,
and the sums of all regions are made in one walk.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = ["Camera", "Plane", "background_plane", "fit_plane", "fit_planes"]

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Camera:
    """Pinhole intrinsics: focal lengths and principal point, pixels (integer pixel centres)."""

    fx: float
    fy: float
    cx: float
    cy: float

    def rays(self, x: np.ndarray, y: np.ndarray) -> tuple[F64, F64]:
        """X/z and Y/z of pixels (x, y)."""
        return (x - self.cx) / self.fx, (y - self.cy) / self.fy


@dataclass(frozen=True)
class Plane:
    """A plane in the camera's optical frame.

    Attributes:
        point: [3] float64, metres, on the plane, amid the points it was fitted to.
        normal: [3] float64, unit, towards the camera (negative z).
        residual: RMS distance of the inliers, metres; points: how many they are.
    """

    point: F64
    normal: F64
    residual: float
    points: int

    @property
    def tilt_deg(self) -> float:
        """Angle between the normal and the optical axis, degrees."""
        return float(np.degrees(np.arccos(np.clip(-self.normal[2], -1.0, 1.0))))

    def height(self, xyz: np.ndarray) -> np.ndarray:
        """Signed distance of points [... 3] in front of the plane (towards the camera), metres."""
        return (xyz - self.point) @ self.normal


_FEWEST = 8
"""Points that a plane needs."""

_STRAIGHT = 1e-7
"""Determinant of the points' spread over its squared trace: less is a line, not an area."""

_BINS = 1024
_FULL = 16.0
"""Residuals are sorted into this many bins up to this many scales of the round before."""


@njit(cache=True, nogil=True)
def _least_squares(rx, ry, q, weight, first, last, out):
    """Weighted q = a rx + b ry + c over the samples first..last; ``out`` takes a, b, c and the
    weighted means of rx and ry.  False where they do not span a plane."""
    total = 0.0
    mx = my = mq = 0.0
    for i in range(first, last):
        w = weight[i]
        total += w
        mx += w * rx[i]
        my += w * ry[i]
        mq += w * q[i]
    if total <= 0:
        return False
    mx /= total
    my /= total
    mq /= total
    xx = xy = yy = xq = yq = 0.0
    for i in range(first, last):
        w = weight[i]
        if w == 0:
            continue
        dx = rx[i] - mx
        dy = ry[i] - my
        dq = w * (q[i] - mq)
        xx += w * dx * dx
        xy += w * dx * dy
        yy += w * dy * dy
        xq += dx * dq
        yq += dy * dq
    det = xx * yy - xy * xy
    if not det > _STRAIGHT * (xx + yy) * (xx + yy):
        return False
    out[0] = (yy * xq - xy * yq) / det
    out[1] = (xx * yq - xy * xq) / det
    out[2] = mq - out[0] * mx - out[1] * my
    out[3] = mx
    out[4] = my
    return True


@njit(cache=True, nogil=True)
def _median(r, weight, over, first, last, full, counts):
    """Median of |r| over the samples that weigh more than ``over``, by a histogram to ``full``."""
    counts[:] = 0
    n = 0
    per = _BINS / full
    for i in range(first, last):
        if weight[i] <= over:
            continue
        n += 1
        counts[min(int(abs(r[i]) * per), _BINS)] += 1
    before = 0
    for k in range(_BINS):
        if 2 * (before + counts[k]) >= n:
            return (k + (0.5 * n - before) / counts[k]) / per
        before += counts[k]
    return full


@njit(cache=True, nogil=True)
def _fit(rx, ry, q, weight, r, first, last, rounds, cut, out):
    """Tukey's biweight on a slice; ``out`` takes what :func:`_least_squares` gives, then the RMS
    of the inliers in inverse depth and their number.  False where there is no plane."""
    n = last - first
    if n < _FEWEST:
        return False
    for i in range(first, last):
        weight[i] = 1.0
    counts = np.empty(_BINS + 1, np.int64)
    floor = 1e-7
    old = 0.0
    for turn in range(rounds):
        if not _least_squares(rx, ry, q, weight, first, last, out):
            return False
        square = 0.0
        middle = out[0] * out[3] + out[1] * out[4] + out[2]
        for i in range(first, last):
            r[i] = q[i] - (out[0] * rx[i] + out[1] * ry[i] + out[2])
            square += r[i] * r[i]
        full = _FULL * old if turn > 0 else 3 * np.sqrt(square / n)
        scale = 1.4826 * _median(r, weight, -1.0, first, last, full + 1e-12, counts)
        # A tenth of a micrometre, in inverse depth.
        scale += floor * middle * middle
        inverse = 1 / (cut * 1.56 * scale)
        inliers = 0
        square = 0.0
        for i in range(first, last):
            t = r[i] * inverse
            t = 1 - t * t
            weight[i] = t * t if t > 0 else 0.0
            if t > 0:
                inliers += 1
                square += r[i] * r[i]
        if turn > 0 and abs(scale - old) < 1e-3 * old:
            break
        old = scale
    out[5] = np.sqrt(square / max(inliers, 1))
    out[6] = inliers
    return inliers > 0


@njit(cache=True, nogil=True)
def _fit_slices(rx, ry, q, starts, rounds, cut, out, good):
    weight = np.empty(q.size, np.float64)
    r = np.empty(q.size, np.float64)
    for k in range(starts.size - 1):
        good[k] = _fit(rx, ry, q, weight, r, starts[k], starts[k + 1], rounds, cut, out[k])


@njit(cache=True, nogil=True)
def _sort_pixels(labels, depth, inside, least, cx, cy, fx, fy, starts, rx, ry, q):
    """Rays and inverse depths of the known pixels that lie deep enough inside, by region."""
    at = starts[:-1].copy()
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            k = labels[y, x]
            if k <= 0 or not depth[y, x] > 0 or inside[y, x] <= least[k - 1]:
                continue
            i = at[k - 1]
            at[k - 1] += 1
            rx[i] = (x - cx) / fx
            ry[i] = (y - cy) / fy
            q[i] = 1 / np.float64(depth[y, x])


@njit(cache=True, nogil=True)
def _count_inside(labels, depth, inside, levels, counts):
    """Known pixels of each region that lie more than each of ``levels`` inside, [R levels]."""
    for y in range(labels.shape[0]):
        for x in range(labels.shape[1]):
            k = labels[y, x]
            if k <= 0 or not depth[y, x] > 0:
                continue
            for j in range(levels.size):
                if inside[y, x] > levels[j]:
                    counts[k - 1, j] += 1


def _as_plane(row: F64) -> Plane:
    """The plane of a row of :func:`_fit`."""
    size = float(np.linalg.norm(row[:3]))
    normal = -row[:3] / size
    q = float(row[0] * row[3] + row[1] * row[4] + row[2])
    # d(1/z) = dz / z² along the ray, and the distance to the plane is dz times |normal · ray|.
    point = np.array([row[3], row[4], 1.0]) / q
    distance = abs(float(normal @ point)) / q
    return Plane(point, normal, float(row[5]) * distance, int(row[6]))


def fit_planes(
    labels: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    inside: np.ndarray,
    *,
    inset: float = 7.0,
    least_points: int = 40,
    rounds: int = 8,
    cut: float = 3.0,
) -> tuple[list[Plane | None], I64]:
    """A robust plane through each region, see :func:`fit_plane`.

    Args:
        labels: [H W] int32, 0 = none; depth_m: [H W] metres, greater than 0, NaN where unknown.
        inside: [H W], distance of each pixel to its region's border, pixels.
        inset: pixels nearer to the border have no part; a region with too few others is tried with
            half of it, then with all its pixels.
        least_points: pixels that a fit should rest on.

    Returns:
        planes: one for each region, None where there is none; known: [R] int64, pixels of known
        depth of each.
    """
    count = int(labels.max(initial=0))
    levels = np.array([inset, inset / 2, 0.0])
    counts = np.zeros((count, 3), np.int64)
    labels = np.ascontiguousarray(labels, np.int32)
    # NaN and infinity both fail the test of being greater than 0 once infinity is NaN.
    depth = np.where(np.isfinite(depth_m), depth_m, np.nan).astype(np.float32)
    _count_inside(labels, depth, inside, levels, counts)
    enough = counts >= least_points
    enough[:, 2] = True
    which = enough.argmax(axis=1)
    taken = counts[np.arange(count), which]
    starts = np.concatenate([[0], np.cumsum(taken)])
    rx, ry, q = (np.empty(int(starts[-1])) for _ in range(3))
    _sort_pixels(
        labels, depth, inside, levels[which], camera.cx, camera.cy, camera.fx, camera.fy,
        starts, rx, ry, q,
    )  # fmt: skip
    out = np.zeros((count, 7))
    good = np.zeros(count, np.bool_)
    _fit_slices(rx, ry, q, starts, rounds, cut, out, good)
    return [_as_plane(row) if ok else None for row, ok in zip(out, good, strict=True)], counts[:, 2]


def fit_plane(xyz: np.ndarray, rounds: int = 8, cut: float = 3.0) -> Plane | None:
    """Robust plane through points in front of the camera.

    Tukey's biweight on the residuals of the inverse depth, in which a plane is linear and in which
    a depth from defocus errs alike everywhere; the scale is 1.4826 times the median absolute
    residual and is measured anew each round, until it stands; the start is least squares.

    Args:
        xyz: [N 3] metres, z greater than 0.
        rounds: rounds of reweighting, at most.
        cut: residuals over ``cut`` times 1.56 scales have no weight.

    Returns:
        None if there are fewer than 8 points or they do not span a plane seen from the front.
    """
    xyz = np.asarray(xyz, np.float64)
    xyz = xyz[xyz[:, 2] > 0]
    q = 1 / xyz[:, 2]
    out = np.zeros((1, 7))
    good = np.zeros(1, np.bool_)
    starts = np.array([0, len(q)])
    _fit_slices(xyz[:, 0] * q, xyz[:, 1] * q, q, starts, rounds, cut, out, good)
    return _as_plane(out[0]) if good[0] else None


@njit(cache=True, nogil=True)
def _gather(depth, cx, cy, fx, fy, x, y, rx, ry, q):
    """Pixels, rays and inverse depths where the depth is known; returns how many."""
    n = 0
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            z = np.float64(depth[v, u])
            if z > 0 and z < np.inf:
                x[n] = u
                y[n] = v
                rx[n] = (u - cx) / fx
                ry[n] = (v - cy) / fy
                q[n] = 1 / z
                n += 1
    return n


@njit(cache=True, nogil=True)
def _sink(rx, ry, q, rounds, least, out):
    """Least squares through what lies behind the last plane or just before it, then about it.

    ``out`` takes what :func:`_fit` gives.  False where no plane is left.
    """
    n = q.size
    weight = np.ones(n, np.float64)
    r = np.empty(n, np.float64)
    counts = np.empty(_BINS + 1, np.int64)
    chosen = n
    both = 0
    for turn in range(rounds + 3):
        if not _least_squares(rx, ry, q, weight, 0, n, out):
            return False
        middle = out[0] * out[3] + out[1] * out[4] + out[2]
        square = 0.0
        for i in range(n):
            r[i] = q[i] - (out[0] * rx[i] + out[1] * ry[i] + out[2])
            square += weight[i] * r[i] * r[i]
        out[5] = np.sqrt(square / chosen)
        out[6] = chosen
        if both == 3:
            break
        full = 3 * out[5] + 1e-12
        scale = 1.4826 * _median(r, weight, 0.0, 0, n, full, counts)
        scale = max(scale, least * middle * middle)
        before = chosen
        chosen = 0
        # In inverse depth what is nearer is greater.  What noise lifts towards the camera is left
        # out while the plane sinks, and let in again once it has settled.
        low, high = (-3 * scale, 3 * scale) if both else (-np.inf, scale)
        for i in range(n):
            take = low < r[i] < high
            weight[i] = 1.0 if take else 0.0
            chosen += take
        if chosen < 64:
            return False
        if both or turn + 1 >= rounds or abs(chosen - before) * 500 < before:
            both += 1
    return True


@njit(cache=True, nogil=True)
def _on_plane(x, y, rx, ry, q, plane, near, shape_y, shape_x):
    """How many pixels lie on a plane, and how many of those on the image's border."""
    on = 0
    rim = 0
    for i in range(q.size):
        if abs(q[i] - (plane[0] * rx[i] + plane[1] * ry[i] + plane[2])) < near:
            on += 1
            rim += x[i] == 0 or y[i] == 0 or x[i] == shape_x - 1 or y[i] == shape_y - 1
    return on, rim


def background_plane(
    depth_m: np.ndarray, camera: Camera, least_share: float = 0.15, rounds: int = 12
) -> Plane | None:
    """The plane behind everything (the table), if enough of it was measured.

    Starts from the plane through all that is known and keeps, round by round, what lies behind it
    or just in front of it: the plane sinks onto the far side of the scene.  Three rounds through
    what lies within 3 scales of it, on either side, end that.

    Args:
        depth_m: [H W] metres, NaN where unknown.
        least_share: share of all pixels, and of those on the image's border, that must lie on the
            plane within 3 scales.  A table too dark to be measured is not mistaken for the lowest
            surface that was: a table is seen around the parts.
    """
    depth = np.ascontiguousarray(depth_m)
    size = depth.size
    x, y = np.empty(size, np.int32), np.empty(size, np.int32)
    rx, ry, q = np.empty(size), np.empty(size), np.empty(size)
    n = _gather(depth, camera.cx, camera.cy, camera.fx, camera.fy, x, y, rx, ry, q)
    if n < 64:
        return None
    x, y, rx, ry, q = x[:n], y[:n], rx[:n], ry[:n], q[:n]
    row = np.zeros(7)
    if not _sink(rx, ry, q, rounds, 2e-4, row):
        return None
    plane = _as_plane(row)
    near_q = 3 * max(float(row[5]), 2e-4 * float(row[0] * row[3] + row[1] * row[4] + row[2]) ** 2)
    on, rim = _on_plane(x, y, rx, ry, q, row, near_q, *depth.shape)
    h, w = depth.shape
    border = size if min(h, w) == 1 else 2 * (h + w) - 4
    return None if min(on / size, rim / border) < least_share else plane

"""The depth map as a point cloud in ``camera_optical_frame``, with normals."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np

_ZERO = np.float32(0)
_ONE = np.float32(1)
_FEWEST = np.float32(4)
_DEGENERATE = np.float32(1e-3)


def cloud_from_depth(
    depth_m: np.ndarray, intensity: np.ndarray, camera: Any, reach_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N 3] in metres, unit normals [N 3] and grey levels [N] of all known pixels.

    ``depth_m`` [H W] has NaN where unknown; ``camera`` has ``width``, ``height`` and ``K``.  The
    points come in row order.  The normals are those of the least-squares plane
    through the known pixels within ``reach_px``, fitted to 1/z over the image, where a plane in
    space is exactly linear; they point to the camera.  A pixel with too few known neighbours
    gets the direction to the camera.  Raises ``ValueError`` if the camera is of another size.
    """
    height, width = depth_m.shape
    if (camera.width, camera.height) != (width, height):
        raise ValueError(
            f"the camera calibration is for {camera.width}×{camera.height} pixels, "
            f"the depth is {width}×{height}"
        )
    known = np.isfinite(depth_m) & (depth_m > 0)
    filled = np.where(known, depth_m, np.float32(0))
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    y, x = np.nonzero(known)
    z = depth_m[known].astype(np.float64)
    points = np.stack([(x - cx) * z / fx, (y - cy) * z / fy, z], axis=1).astype(np.float32)
    centre = (np.float32(fx), np.float32(fy), np.float32(cx), np.float32(cy))
    normals = _plane_normals(filled, known, len(points), *centre, max(1, reach_px))
    return points, normals, intensity[known].astype(np.float32, copy=False)


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _plane_normals(depth_m, known, count, fx, fy, cx, cy, reach):  # type: ignore[no-untyped-def]
    """Normals of local planes 1/z = a·i + b·j + c around each known pixel, float32 [count 3].

    The plane's normal in space is proportional to (fx·a, fy·b, a·(cx - x) + b·(cy - y) + c')
    with c' the fitted 1/z at the pixel.  Every second pixel of the window is used.

    The nine sums of the fit (of 1, i, j, ii, ij, jj over the known pixels, of w, iw, jw) are
    separable: first down the columns, then along the row.  w is 1/z less that of some known
    pixel, so that float32 holds it to many more digits than the depth has.
    """
    height, width = depth_m.shape
    normals = np.empty((count, 3), np.float32)
    inverse = np.zeros((height, width), np.float32)
    weight = np.zeros((height, width), np.float32)
    reference = _ZERO
    for y in range(height):
        for x in range(width):
            if known[y, x] and reference == _ZERO:
                reference = _ONE / depth_m[y, x]
            inverse[y, x] = _ONE / depth_m[y, x] - reference if known[y, x] else _ZERO
            weight[y, x] = _ONE if known[y, x] else _ZERO
    # Sums down the columns of 1, j, jj, w and jw, with margins of zeros on both sides.
    column = np.zeros((5, width + 2 * reach), np.float32)
    sums = np.zeros((9, width), np.float32)
    row = np.zeros((3, width), np.float32)
    done = 0
    for y in range(height):
        column[:] = _ZERO
        for j in range(-reach, reach + 1, 2):
            if 0 <= y + j < height:
                _add_down(column, np.uintp(reach), weight[y + j], inverse[y + j], np.float32(j))
        sums[:] = _ZERO
        for i in range(-reach, reach + 1, 2):
            _add_along(sums, column, np.uintp(reach + i), np.float32(i))
        _normal_row(row, sums, inverse[y], reference, fx, fy, cx, cy - np.float32(y))
        for x in range(width):
            if known[y, x]:
                normals[done, 0] = row[0, x]
                normals[done, 1] = row[1, x]
                normals[done, 2] = row[2, x]
                done += 1
    return normals


@numba.njit(cache=True, fastmath={"contract"})
def _add_down(column, start, weight, inverse, j):  # type: ignore[no-untyped-def]
    """Add the row ``j`` below the pixels to their columns' sums."""
    for x in range(np.uintp(weight.shape[0])):
        column[0, x + start] += weight[x]
        column[1, x + start] += j * weight[x]
        column[2, x + start] += j * j * weight[x]
        column[3, x + start] += inverse[x]
        column[4, x + start] += j * inverse[x]


@numba.njit(cache=True, fastmath={"contract"})
def _add_along(sums, column, start, i):  # type: ignore[no-untyped-def]
    """Add the columns' sums ``i`` to the right of the pixels to the sums of the fit."""
    for x in range(np.uintp(sums.shape[1])):
        weight, down, inverse = column[0, x + start], column[1, x + start], column[3, x + start]
        sums[0, x] += weight
        sums[1, x] += i * weight
        sums[2, x] += down
        sums[3, x] += i * i * weight
        sums[4, x] += i * down
        sums[5, x] += column[2, x + start]
        sums[6, x] += inverse
        sums[7, x] += i * inverse
        sums[8, x] += column[4, x + start]


@numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
def _normal_row(normal, sums, inverse, reference, fx, fy, cx, below):  # type: ignore[no-untyped-def]
    """Unit normals from the sums; where they are few, of the plane that faces the camera.

    ``below`` is how far the principal point lies below this row.
    """
    for x in range(np.uintp(inverse.shape[0])):
        n = sums[0, x]
        over = _ONE / max(n, _ONE)
        i, j, w = sums[1, x] * over, sums[2, x] * over, sums[6, x] * over
        ii = sums[3, x] - n * i * i
        ij = sums[4, x] - n * i * j
        jj = sums[5, x] - n * j * j
        iw = sums[7, x] - n * i * w
        jw = sums[8, x] - n * j * w
        determinant = ii * jj - ij * ij
        good = (n >= _FEWEST) & (determinant > _DEGENERATE)
        scale = _ONE / determinant if good else _ZERO
        a = (iw * jj - jw * ij) * scale
        b = (jw * ii - iw * ij) * scale
        c = w - a * i - b * j if good else inverse[x]
        # 1/z grows towards the camera, so the outward normal is minus the vector.
        nx = -fx * a
        ny = -fy * b
        nz = -a * (cx - np.float32(np.int32(x))) - b * below - (c + reference)
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        over = _ONE / length if length > _ZERO else _ZERO
        normal[0, x] = nx * over
        normal[1, x] = ny * over
        normal[2, x] = nz * over

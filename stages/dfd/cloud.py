"""The depth map as a point cloud in ``camera_optical_frame``, with normals."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np


def cloud_from_depth(
    depth_m: np.ndarray, intensity: np.ndarray, camera: Any, reach_px: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points [N 3] in metres, unit normals [N 3] and grey levels [N] of all known pixels.

    ``depth_m`` [H W] has NaN where unknown; ``camera`` has ``width``, ``height`` and ``K``.  The
    points are made by Open3D, in row order.  The normals are those of the least-squares plane
    through the known pixels within ``reach_px``, fitted to 1/z over the image, where a plane in
    space is exactly linear; they point to the camera.  A pixel with too few known neighbours
    gets the direction to the camera.  Raises ``ValueError`` if the camera is of another size.
    """
    import open3d as o3d

    height, width = depth_m.shape
    if (camera.width, camera.height) != (width, height):
        raise ValueError(
            f"the camera calibration is for {camera.width}×{camera.height} pixels, "
            f"the depth is {width}×{height}"
        )
    known = np.isfinite(depth_m)
    filled = np.where(known, depth_m, np.float32(0))
    fx, fy, cx, cy = camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]
    cloud = o3d.geometry.PointCloud.create_from_depth_image(
        o3d.geometry.Image(np.ascontiguousarray(filled)),  # type: ignore[call-overload]
        o3d.camera.PinholeCameraIntrinsic(width, height, fx, fy, cx, cy),
        depth_scale=1.0,
        depth_trunc=float("inf"),
    )
    points = np.asarray(cloud.points).astype(np.float32)
    normals = _plane_normals(filled, known, fx, fy, cx, cy, max(1, reach_px))
    return points, normals[known], intensity[known].astype(np.float32, copy=False)


@numba.njit(cache=True, error_model="numpy")
def _plane_normals(depth_m, known, fx, fy, cx, cy, reach):  # type: ignore[no-untyped-def]
    """Normals of local planes 1/z = a·i + b·j + c around each known pixel, float32 [H W 3].

    The plane's normal in space is proportional to (fx·a, fy·b, a·(cx - x) + b·(cy - y) + c')
    with c' the fitted 1/z at the pixel.  Every second pixel of the window is used.
    """
    height, width = depth_m.shape
    normals = np.zeros((height, width, 3), np.float32)
    for y in range(height):
        for x in range(width):
            if not known[y, x]:
                continue
            middle = 1.0 / depth_m[y, x]
            n = sx = sy = sxx = sxy = syy = sw = sxw = syw = 0.0
            for j in range(-reach, reach + 1, 2):
                row = y + j
                if row < 0 or row >= height:
                    continue
                for i in range(-reach, reach + 1, 2):
                    column = x + i
                    if column < 0 or column >= width or not known[row, column]:
                        continue
                    w = 1.0 / depth_m[row, column] - middle
                    n += 1
                    sx += i
                    sy += j
                    sxx += i * i
                    sxy += i * j
                    syy += j * j
                    sw += w
                    sxw += i * w
                    syw += j * w
            a = b = 0.0
            c = middle
            if n >= 4:
                vxx = sxx - sx * sx / n
                vxy = sxy - sx * sy / n
                vyy = syy - sy * sy / n
                cxw = sxw - sx * sw / n
                cyw = syw - sy * sw / n
                determinant = vxx * vyy - vxy * vxy
                if determinant > 1e-9:
                    a = (cxw * vyy - cyw * vxy) / determinant
                    b = (cyw * vxx - cxw * vxy) / determinant
                    c = middle + (sw - a * sx - b * sy) / n
            nx = fx * a
            ny = fy * b
            nz = a * (cx - x) + b * (cy - y) + c
            length = np.sqrt(nx * nx + ny * ny + nz * nz)
            if length <= 0:
                nz = length = 1.0
            # 1/z grows towards the camera, so the outward normal is minus this vector.
            normals[y, x, 0] = -nx / length
            normals[y, x, 1] = -ny / length
            normals[y, x, 2] = -nz / length
    return normals

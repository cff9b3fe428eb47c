"""Closed regions and their features (paper, 5).

A region is a 4-connected component of the pixels that no edge covers: edges are 8-connected, and
two lines that touch at a corner must not leak.  Edge pixels then go to the region beside them, for
an edge has no width in the scene and a region that lacks its rim is too small by its perimeter.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .operators import Gradient
from .planes import Camera, background_plane, fit_planes
from .stack import image_scale

__all__ = [
    "RegionTable", "closed_regions", "closed_share", "distance_to_border", "region_features",
]  # fmt: skip

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]

_BESIDE_PX = 5


# -- regions -------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _relabel(labels, min_area, n, kept):
    """Number the regions from 1 in the order of their first pixels; returns how many there are.

    Drops label 0 and labels under ``kept`` of less than ``min_area`` px.
    """
    area = np.zeros(n, np.int64)
    h, w = labels.shape
    for y in range(h):
        for x in range(w):
            area[labels[y, x]] += 1
    new = np.zeros(n, np.int32)
    count = 0
    for y in range(h):
        for x in range(w):
            k = labels[y, x]
            if k > 0 and new[k] == 0:
                if k >= kept or area[k] >= min_area:
                    count += 1
                    new[k] = count
                else:
                    new[k] = -1
            labels[y, x] = max(new[k], 0)
    return count


@njit(cache=True, nogil=True)
def _means(labels, image, count):
    total = np.zeros(count + 1, np.float64)
    area = np.zeros(count + 1, np.int64)
    h, w = labels.shape
    for y in range(h):
        for x in range(w):
            total[labels[y, x]] += image[y, x]
            area[labels[y, x]] += 1
    for k in range(count + 1):
        total[k] /= max(area[k], 1)
    return total.astype(np.float32)


@njit(cache=True, nogil=True)
def _side(gx, gy, magnitude, y, x):
    """Where the edge through a pixel lies: pixels towards the bright side, about -1/2 to 1/2.

    The top of the parabola through the magnitude here and one pixel up and down the gradient.
    """
    h, w = magnitude.shape
    top = magnitude[y, x]
    if top == 0:
        return np.float32(0)
    dx = gx[y, x] / top
    dy = gy[y, x] / top
    # On the border one of the two is not known.
    if not (1 <= x < w - 1 and 1 <= y < h - 1):
        return np.float32(0)
    sx = 1 if dx >= 0 else -1
    sy = 1 if dy >= 0 else -1
    ax = abs(dx)
    ay = abs(dy)
    # Bilinear, in an order that a turn or mirror of the image leaves as it is.
    along_x = ax * (1 - ay)
    along_y = ay * (1 - ax)
    both = ax * ay
    still = (1 - ax) * (1 - ay) * top
    up = (still + both * magnitude[y + sy, x + sx]) + (
        along_x * magnitude[y, x + sx] + along_y * magnitude[y + sy, x]
    )
    down = (still + both * magnitude[y - sy, x - sx]) + (
        along_x * magnitude[y, x - sx] + along_y * magnitude[y - sy, x]
    )
    bend = abs(2 * top - up - down)
    if bend == 0:
        return np.float32(0)
    return np.float32(0.5) * (up - down) / bend


@njit(cache=True, nogil=True)
def _grow(labels, image, mean, gx, gy, magnitude, thin):
    """Give the unlabelled pixels to the regions beside them, ring by ring.

    A pixel that is a maximum of the gradient goes to the side of the edge its centre lies on;
    any other, such as a link's, to the region whose grey level is nearest to its own.  Where two
    regions are as good it stays without (0), for nothing in the image says whose it is.  All
    pixels of a ring decide on the same labels.
    """
    h, w = labels.shape
    todo = np.empty(h * w, np.int32)
    n = 0
    for y in range(h):
        for x in range(w):
            if labels[y, x] == 0:
                todo[n] = y * w + x
                n += 1
    given = np.empty(n, np.int32)
    while n > 0:
        left = 0
        changed = 0
        for i in range(n):
            p = todo[i]
            y = p // w
            x = p - y * w
            side = np.float32(0)
            if thin[y, x]:
                side = _side(gx, gy, magnitude, y, x)
            best = np.float32(np.inf)
            label = 0
            for k in range(4):
                oy = (k - 1) * (1 - k % 2)
                ox = (k - 2) * (k % 2)
                v = y + oy
                u = x + ox
                if v < 0 or u < 0 or v >= h or u >= w:
                    continue
                other = labels[v, u]
                if other <= 0:
                    continue
                if side != 0:
                    d = side * (gx[y, x] * ox + gy[y, x] * oy)
                else:
                    d = abs(image[y, x] - mean[other])
                if d < best:
                    best = d
                    label = other
                elif d == best and other != label:
                    label = -1
            given[i] = label
        for i in range(n):
            p = todo[i]
            if given[i] == 0:
                todo[left] = p
                left += 1
            else:
                labels[p // w, p - (p // w) * w] = given[i]
                changed += 1
        n = left
        if changed == 0:
            break
    for y in range(h):
        for x in range(w):
            if labels[y, x] < 0:
                labels[y, x] = 0


_NO_GRADIENT = np.zeros((1, 1), np.float32)


def closed_regions(
    edges: Bool,
    image: np.ndarray | None = None,
    gradient: Gradient | None = None,
    walls: I32 | None = None,
    *,
    min_area: float = 12.0,
    grow: bool = True,
) -> I32:
    """Label the closed regions between edges.

    Args:
        edges: [H W] bool.
        image: [H W] grey levels, by which an edge pixel between two regions is given to one; None
            leaves those without a region.
        gradient: of the image; where it has a maximum, it tells to a fraction of a pixel on which
            side of the edge a pixel lies, better than the grey level does.
        walls: [H W] int32, regions that are known already (:mod:`edges.walls`), 0
            elsewhere; edges within them count for nothing.
        min_area: smaller regions are none (the inside of a double line), and are shared out as
            edge pixels are; pixels at 256².
        grow: give edge pixels to regions.

    Returns:
        labels: [H W] int32, regions 1, 2, … in the order of their first pixel; 0 = none.
    """
    if edges.ndim != 2 or edges.size == 0:
        raise ValueError(f"expected edges of axes [H W], got shape {edges.shape}")
    for name, other in (("image", image), ("walls", walls)):
        if other is not None and other.shape != edges.shape:
            raise ValueError(f"{name} has shape {other.shape}, the edges {edges.shape}")
    closed = edges if walls is None else edges | (walls > 0)
    n, labels = cv2.connectedComponentsWithAlgorithm(
        (~closed).view(np.uint8), 4, cv2.CV_32S, cv2.CCL_SAUF
    )
    first_wall = n
    if walls is not None:
        np.copyto(labels, walls + np.int32(n - 1), where=walls > 0)
        n += int(walls.max(initial=0))
    count = _relabel(labels, least_area_px(edges.shape, min_area), n, first_wall)
    if grow and count:
        levels = np.zeros(edges.shape, np.float32) if image is None else image
        levels = np.nan_to_num(np.ascontiguousarray(levels, np.float32))
        mean = _means(labels, levels, count)
        if gradient is None:
            thin = np.zeros(edges.shape, np.bool_)
            _grow(labels, levels, mean, _NO_GRADIENT, _NO_GRADIENT, _NO_GRADIENT, thin)
        else:
            g = gradient
            _grow(labels, levels, mean, g.gx, g.gy, g.magnitude, g.thin)
    return labels.astype(np.int32, copy=False)


def least_area_px(shape: tuple[int, ...], min_area: float) -> int:
    """The least area of a region in an image of this shape, from pixels at 256²."""
    height, width = shape[:2]
    scale = image_scale((height, width))
    return max(int(round(min_area * scale * scale)), 1)


# -- the outline ---------------------------------------------------------------------------------

_REACH = 7
"""Cracks to either side that a tangent may rest on."""

_BOW = 0.75
"""Pixels that a straight outline may seem to bow on the grid: cracks' middles lie within half a
diagonal (0.71) of the line they follow, and the chord's ends are two of them."""


@njit(cache=True, nogil=True)
def _length(px, py, n):
    """Length of a closed outline through the middles of ``n`` cracks.

    Each crack counts for the chord between the cracks k before and k after it over 2 k, with the
    greatest k up to which the outline stays straight, within what the grid allows: on a straight
    side, whatever its angle, that is the side's true advance per crack; at a corner k is small
    and cuts little off.
    """
    total = 0.0
    reach = min(_REACH, (n - 1) // 2)
    for i in range(n):
        advance = 0.0
        for k in range(1, reach + 1):
            a = (i - k) % n
            b = (i + k) % n
            dx = px[b] - px[a]
            dy = py[b] - py[a]
            chord = np.sqrt(dx * dx + dy * dy)
            if chord == 0:
                break
            straight = True
            if k > 1:
                for j in range(1 - k, k):
                    c = (i + j) % n
                    if abs((px[c] - px[a]) * dy - (py[c] - py[a]) * dx) > _BOW * chord:
                        straight = False
                        break
            if not straight:
                break
            advance = chord / (2 * k)
        total += advance
    return total


@njit(cache=True, nogil=True)
def _outline(labels, count, cx, cy):
    """Perimeter and greatest squared centroid-to-border distance of each region.

    Follows the cracks between a region's pixels and others', region on the left, outer outline
    and holes; the border runs through the cracks' middles.
    """
    h, w = labels.shape
    perimeter = np.zeros(count + 1, np.float64)
    far = np.zeros(count + 1, np.float64)
    # seen: the crack on side d of a pixel is done; d: 0 top, 1 right, 2 bottom, 3 left.
    seen = np.zeros((h, w, 4), np.bool_)
    # With the region on the left, the top side is walked westwards, the left southwards, ...
    step_x = np.array([-1, 0, 1, 0])
    step_y = np.array([0, -1, 0, 1])
    side_x = np.array([0, 1, 0, -1])
    side_y = np.array([-1, 0, 1, 0])
    px = np.empty(1024, np.float64)
    py = np.empty(1024, np.float64)
    for y0 in range(h):
        for x0 in range(w):
            label = labels[y0, x0]
            if label <= 0:
                continue
            for d0 in range(4):
                u = x0 + side_x[d0]
                v = y0 + side_y[d0]
                if seen[y0, x0, d0] or (0 <= u < w and 0 <= v < h and labels[v, u] == label):
                    continue
                n = 0
                x, y, d = x0, y0, d0
                while not seen[y, x, d]:
                    seen[y, x, d] = True
                    if n == px.size:
                        more = np.empty(2 * n, np.float64)
                        more[:n] = px
                        px = more
                        more = np.empty(2 * n, np.float64)
                        more[:n] = py
                        py = more
                    px[n] = x + 0.5 * side_x[d] - cx[label]
                    py[n] = y + 0.5 * side_y[d] - cy[label]
                    far[label] = max(far[label], px[n] * px[n] + py[n] * py[n])
                    n += 1
                    # Ahead of this pixel, and ahead of the one across the crack.
                    ax = x + step_x[d]
                    ay = y + step_y[d]
                    bx = ax + side_x[d]
                    by = ay + side_y[d]
                    if not (0 <= ax < w and 0 <= ay < h and labels[ay, ax] == label):
                        d = (d + 3) % 4
                    elif 0 <= bx < w and 0 <= by < h and labels[by, bx] == label:
                        x, y = bx, by
                        d = (d + 1) % 4
                    else:
                        x, y = ax, ay
                perimeter[label] += _length(px, py, n)
    return perimeter, far


@njit(cache=True, nogil=True)
def _moments(labels, count):
    """Area, centroid and how many pixels lie on the image's border, per region."""
    h, w = labels.shape
    area = np.zeros(count + 1, np.int64)
    sx = np.zeros(count + 1, np.int64)
    sy = np.zeros(count + 1, np.int64)
    rim = np.zeros(count + 1, np.int64)
    for y in range(h):
        for x in range(w):
            k = labels[y, x]
            area[k] += 1
            sx[k] += x
            sy[k] += y
            if x == 0 or y == 0 or x == w - 1 or y == h - 1:
                rim[k] += 1
    return area, sx / np.maximum(area, 1), sy / np.maximum(area, 1), rim


# -- features ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RegionTable:
    """Features of the regions, one row each; row i is region i + 1 of the labels.

    Attributes:
        area_px: [R] int64, pixels.
        perimeter_px: [R] float64, length of the outline with its holes, pixels.
        shape_factor: [R] float64, 4 pi area / perimeter²: 1 for a disc, 0.785 for a square.
        greatest_distance_px: [R] float64, from the centroid to the farthest point of the border.
        centroid_px: [R 2] float64, (x, y).
        border_px: [R] int64, pixels on the image's border.
        background: [R] bool, more of the image's border than any other and a quarter of it at
            least, or (where the table was measured) lying on the table.
        known_share: [R] float64, share of the pixels whose depth is known.
        elevation_m: [R] float64, height of the fitted plane at the centroid above the table; where
            the table was not measured, above the farthest depth that was (99th percentile).
        point_m: [R 3] and normal: [R 3] float64, the fitted plane (NaN without one).
        tilt_deg, residual_m: [R] float64, of the plane; NaN without one.
        plane_px: [R] int64, pixels that the plane rests on.
        elevation_from: "table" or "farthest" or "" (no depth).
    """

    area_px: I64
    perimeter_px: F64
    shape_factor: F64
    greatest_distance_px: F64
    centroid_px: F64
    border_px: I64
    background: Bool
    known_share: F64
    elevation_m: F64
    point_m: F64
    normal: F64
    tilt_deg: F64
    residual_m: F64
    plane_px: I64
    elevation_from: str

    def __len__(self) -> int:
        return len(self.area_px)


def region_features(
    labels: I32,
    depth_m: np.ndarray | None = None,
    camera: Camera | None = None,
    *,
    inset: float = 7.0,
    least_points: int = 40,
) -> RegionTable:
    """Measure the regions (paper, 5).

    A plane is fitted to the depth at least ``inset`` pixels inside the region, since the sensor's
    windows mix both sides of an edge (optics.md, 6); a region too narrow for that is tried with
    half of it, then with all its pixels.

    Args:
        labels: [H W] int32, 0 = none.
        depth_m: [H W] metres, NaN where unknown; None leaves the features of depth NaN.
        camera: needed with depth.
        inset: pixels (of the sensor's window, not scaled with the image).
        least_points: pixels that a fit should rest on.

    Raises:
        ValueError: depth without a camera, or of another shape.
    """
    count = int(labels.max(initial=0))
    area, cx, cy, rim = _moments(labels, count)
    perimeter, far = _outline(labels, count, cx, cy)
    p = perimeter[1:]
    rim = rim[1:]
    out_of = 2 * sum(labels.shape) - 4 if min(labels.shape) > 1 else labels.size
    background = (rim == rim.max(initial=0)) & (rim >= 0.25 * out_of) & (rim > 0)
    nan = np.full(count, np.nan)
    elevation, tilt, residual, known_share = nan.copy(), nan.copy(), nan.copy(), np.zeros(count)
    point, normal = np.full((count, 3), np.nan), np.full((count, 3), np.nan)
    plane_px = np.zeros(count, np.int64)
    source = ""
    if depth_m is not None:
        if camera is None:
            raise ValueError("region features from depth need the camera's intrinsics")
        if depth_m.shape != labels.shape:
            raise ValueError(f"depth has shape {depth_m.shape}, the labels {labels.shape}")
        table = background_plane(depth_m, camera)
        finite = depth_m[np.isfinite(depth_m)]
        farthest = float(np.percentile(finite, 99)) if finite.size else float("nan")
        source = "table" if table is not None else ("farthest" if finite.size else "")
        planes, known_px = fit_planes(
            labels, depth_m, camera, distance_to_border(labels),
            inset=inset, least_points=least_points,
        )  # fmt: skip
        known_share = known_px / np.maximum(area[1:], 1)
        for i, plane in enumerate(planes):
            if plane is None:
                continue
            ray = np.array([*camera.rays(cx[i + 1], cy[i + 1]), 1.0])
            slant = float(plane.normal @ ray)
            z_c = float(plane.normal @ plane.point) / slant if abs(slant) > 1e-6 else np.nan
            point[i], normal[i] = ray * z_c, plane.normal
            tilt[i], residual[i], plane_px[i] = plane.tilt_deg, plane.residual, plane.points
            elevation[i] = table.height(point[i]) if table is not None else farthest - z_c
        if table is not None:
            background |= (np.abs(elevation) < 1.5e-3) & (tilt - table.tilt_deg < 5)
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = np.where(p > 0, 4 * np.pi * area[1:] / (p * p), 0.0)
    return RegionTable(
        area[1:], p, shape, np.sqrt(far[1:]), np.column_stack([cx[1:], cy[1:]]), rim, background,
        known_share, elevation, point, normal, tilt, residual, plane_px, source,
    )  # fmt: skip


def closed_share(labels: I32, lines: Bool) -> float:
    """Share of the line pixels [H W] with two regions beside them; the others close nothing.

    NaN without lines.  What is beside a pixel is within 2 px of it.
    """
    count = int(lines.sum())
    if not count:
        return float("nan")
    beside = np.ones((_BESIDE_PX, _BESIDE_PX), np.uint8)
    numbers = labels.astype(np.float32)
    greatest = cv2.dilate(numbers, beside)
    least = cv2.erode(np.where(labels > 0, numbers, np.float32(np.inf)), beside)
    return int((lines & (greatest > least)).sum()) / count


def distance_to_border(labels: I32) -> F32:
    """Distance of each pixel to the nearest pixel of another label, pixels, [H W] float32.

    Chamfer distances, within 2 % of Euclid's: a fifth of the work.
    """
    rim = np.ones(labels.shape, np.uint8)
    across = labels[:, 1:] != labels[:, :-1]
    rim[:, 1:][across] = 0
    rim[:, :-1][across] = 0
    down = labels[1:] != labels[:-1]
    rim[1:][down] = 0
    rim[:-1][down] = 0
    if rim.all():
        return np.full(labels.shape, np.float32(max(labels.shape)))
    distance = cv2.distanceTransform(rim, cv2.DIST_L2, cv2.DIST_MASK_5)
    return (distance + 1).astype(np.float32, copy=False)

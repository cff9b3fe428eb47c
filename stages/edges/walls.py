"""Upright walls that the intensity cannot show, from the depth of the face above them.

A wall that the light grazes can be as dark as the table beside it, and a sensor that measures depth
in a window is blind on a strip of a few pixels beside a tall step.  But a face that the depth shows
lying parallel to the table, high above it, is the top of a part that lies there: what carries it
goes down to the table, upright.  The camera sees the walls that face it: the prism under the face,
less the face.  Of that only what belongs to no surface of its own is taken: pixels of the table's
region, of regions without depth that are as dark as the table (its shadow, most often), and
regions without depth that lie wholly in the prism.

In the picture, going up along the table's normal leads towards one vanishing point, so a pixel lies
in the prism exactly if the straight way from it to the pixel of the face's plane right above its
point of the table meets the face.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .planes import Camera, background_plane, fit_planes
from .stack import image_scale

__all__ = ["Walls", "upright_walls"]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class Walls:
    """Upright walls.

    Attributes:
        labels: [H W] int32, walls 1, 2, …; 0 = none.
        foot: [H W] bool, pixels of walls beside the table: the walls' lower edges.
        height_m: [H W] float32, height of the (highest) face above it, metres; 0 elsewhere.
    """

    labels: I32
    foot: Bool
    height_m: F32


@njit(cache=True, nogil=True)
def _prisms(labels, faces, lifts, heights, open_, boxes, owner, hit_x, hit_y, level, swept):
    """Pixels in the prism under each face; where several lie in the way the highest is seen."""
    h, w = labels.shape
    for f in range(faces.size):
        face = faces[f]
        m = lifts[f]
        for y in range(boxes[f, 0], boxes[f, 1]):
            for x in range(boxes[f, 2], boxes[f, 3]):
                here = labels[y, x]
                if not open_[here]:
                    continue
                s = m[2, 0] * x + m[2, 1] * y + m[2, 2]
                dx = (m[0, 0] * x + m[0, 1] * y + m[0, 2]) / s - x
                dy = (m[1, 0] * x + m[1, 1] * y + m[1, 2]) / s - y
                far = max(abs(dx), abs(dy), 1e-6)
                # Whole pixels along the greater axis, where a half would be rounded to one side,
                # and then the end of the way.
                for i in range(1, int(far) + 2):
                    t = min(i / far, 1.0)
                    u = int(np.floor(x + t * dx + 0.5))
                    v = int(np.floor(y + t * dy + 0.5))
                    if u < 0 or v < 0 or u >= w or v >= h:
                        break
                    if labels[v, u] == face:
                        # The ray's height where it meets the wall: 0 at its foot.
                        z = heights[f] * (1 - t)
                        swept[here] += owner[y, x] < 0
                        if owner[y, x] < 0 or z > level[y, x]:
                            owner[y, x] = f
                            hit_x[y, x] = u
                            hit_y[y, x] = v
                            level[y, x] = z
                        break


@njit(cache=True, nogil=True)
def _rims(labels, owner, faces, hit_x, hit_y, radius, share, inward):
    """The face in a disc about the place where a wall meets it: its share, and its direction."""
    h, w = labels.shape
    for y in range(h):
        for x in range(w):
            if owner[y, x] < 0:
                continue
            face = faces[owner[y, x]]
            inside = 0
            total = 0
            for b in range(-radius, radius + 1):
                for a in range(-radius, radius + 1):
                    if a * a + b * b > radius * radius:
                        continue
                    total += 1
                    v = hit_y[y, x] + b
                    u = hit_x[y, x] + a
                    if 0 <= v < h and 0 <= u < w and labels[v, u] == face:
                        inside += 1
                        inward[y, x, 0] += a
                        inward[y, x, 1] += b
            share[y, x] = inside / total


@njit(cache=True, nogil=True)
def _components(owner, take, out):
    """4-connected pixels of ``take`` with one owner; numbers them from 1 and counts them."""
    h, w = owner.shape
    stack = np.empty(h * w, np.int32)
    n = 0
    for y0 in range(h):
        for x0 in range(w):
            if not take[y0, x0] or out[y0, x0]:
                continue
            n += 1
            out[y0, x0] = n
            stack[0] = y0 * w + x0
            top = 1
            while top:
                top -= 1
                y = stack[top] // w
                x = stack[top] - y * w
                for k in range(4):
                    v = y + (k - 1) * (1 - k % 2)
                    u = x + (k - 2) * (k % 2)
                    if v < 0 or u < 0 or v >= h or u >= w or out[v, u] or not take[v, u]:
                        continue
                    if owner[v, u] == owner[y, x]:
                        out[v, u] = n
                        stack[top] = v * w + u
                        top += 1
    return n


@njit(cache=True, nogil=True)
def _spread(owner, out):
    """Give pixels without a wall to the wall beside them that has their owner, ring by ring.

    Of two walls the one with more pixels beside it gets the pixel; neither does if they are equal.
    """
    h, w = owner.shape
    todo = np.empty(h * w, np.int32)
    n = 0
    for y in range(h):
        for x in range(w):
            if owner[y, x] >= 0 and out[y, x] == 0:
                todo[n] = y * w + x
                n += 1
    given = np.empty(n, np.int32)
    while n > 0:
        for i in range(n):
            y = todo[i] // w
            x = todo[i] - y * w
            first = second = 0
            ones = twos = 0
            for v in range(max(y - 1, 0), min(y + 2, h)):
                for u in range(max(x - 1, 0), min(x + 2, w)):
                    k = out[v, u]
                    if k == 0 or owner[v, u] != owner[y, x]:
                        continue
                    if k == first or first == 0:
                        first = k
                        ones += 1
                    elif k == second or second == 0:
                        second = k
                        twos += 1
            given[i] = first if ones > twos else (second if twos > ones else 0)
        left = 0
        for i in range(n):
            if given[i]:
                out[todo[i] // w, todo[i] % w] = given[i]
            else:
                todo[left] = todo[i]
                left += 1
        if left == n:
            break
        n = left


def _lift(normal: F64, offset: float, height: float, camera: Camera) -> F64:
    """Homography from the picture of the table to that of the plane ``height`` over it, [3 3].

    A ray r meets the table n · X = offset in X = r offset / (n · r); X + height n projects to
    (offset I + height n nᵀ) r, up to scale.
    """
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])
    up = offset * np.eye(3) + height * np.outer(normal, normal)
    return k @ up @ np.linalg.inv(k)


@njit(cache=True, nogil=True)
def _neighbours(out, reach, count):
    """Which walls come within ``reach`` pixels of each other, [count + 1, count + 1] bool."""
    h, w = out.shape
    near = np.zeros((count + 1, count + 1), np.bool_)
    for y in range(h):
        for x in range(w):
            if out[y, x] == 0:
                continue
            for v in range(max(y - reach, 0), min(y + reach + 1, h)):
                for u in range(max(x - reach, 0), min(x + reach + 1, w)):
                    near[out[y, x], out[v, u]] = True
    return near


@njit(cache=True, nogil=True)
def _sums(out, owner, hit_x, hit_y, inward, drops, heights, depth, table, near, count):
    """Per wall: pixels, feet (x, y), inward (x, y), pixels with the table's depth, height.

    ``drops`` lead from a face's plane down to the table, ``table`` is the table's inverse depth
    over pixels (a x + b y + c), and ``near`` how far from it the table's own depths lie.
    """
    total = np.zeros((count + 1, 7), np.float64)
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            k = out[y, x]
            if k == 0:
                continue
            total[k, 0] += 1
            q = table[0] * x + table[1] * y + table[2]
            if abs(1 / np.float64(depth[y, x]) - q) < near:
                total[k, 5] += 1
            f = owner[y, x]
            if f < 0:
                continue
            m = drops[f]
            u = hit_x[y, x]
            v = hit_y[y, x]
            s = m[2, 0] * u + m[2, 1] * v + m[2, 2]
            total[k, 1] += (m[0, 0] * u + m[0, 1] * v + m[0, 2]) / s
            total[k, 2] += (m[1, 0] * u + m[1, 1] * v + m[1, 2]) / s
            total[k, 3] += inward[y, x, 0]
            total[k, 4] += inward[y, x, 1]
            total[k, 6] = max(total[k, 6], heights[f])
    return total


def _join(out: I32, sums: F64, may: Bool, reach: int, apart: float) -> I32:
    """Give one number to walls that stand side by side in one plane, and close what parts them.

    Two faces of one part at different heights (the step of an L) share such a wall; where the
    upper one ends, a corner of a pixel or two lies under neither.

    Args:
        out: [H W], walls; sums: [walls + 1, 7], see :func:`_sums`.
        may: [H W] bool, pixels that may be taken to close a gap of up to 2 ``reach`` pixels.
        apart: pixels that feet of one plane may lie apart across it.
    """
    count = len(sums) - 1
    middle = sums[:, 1:3] / np.maximum(sums[:, :1], 1)
    way = sums[:, 3:5] / np.maximum(np.linalg.norm(sums[:, 3:5], axis=1), 1e-9)[:, None]
    new = np.arange(count + 1, dtype=np.int32)
    for a, b in np.argwhere(np.triu(_neighbours(out, 2 * reach, count)[1:, 1:], 1)) + 1:
        off = middle[a] - middle[b]
        one_way = way[a] @ way[b] > np.cos(np.radians(20))
        if one_way and max(abs(off @ way[a]), abs(off @ way[b])) < apart:
            new[new == new[b]] = new[a]
    joined = new[out]
    side = 2 * reach + 1
    for k in np.unique(new[new != np.arange(count + 1)]):
        whole = cv2.morphologyEx(
            (joined == k).view(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8)
        )
        joined[(whole > 0) & may & (joined == 0)] = k
    return joined


def upright_walls(
    labels: I32,
    levels: F32,
    depth_m: np.ndarray,
    camera: Camera,
    inside: np.ndarray,
    *,
    lying_deg: float = 4.0,
    least_height: float = 5.0,
    least_area: float = 24.0,
    corner_share: float = 0.44,
    most_table: float = 0.25,
) -> Walls | None:
    """Find the walls that the picture shows under faces lying above the table.

    Args:
        labels: [H W] int32, regions 1, 2, … that take up their edges' pixels; 0 = none.
        levels: [H W] float32, the image.
        depth_m: [H W] metres, NaN where unknown; camera: its intrinsics.
        inside: [H W], distance of each pixel to its region's border, pixels.
        lying_deg: a face this near to parallel to the table lies.
        least_height: its height over the table, in RMS residuals of the table's depth.
        least_area: walls of fewer pixels at 256² are none.
        corner_share: a wall ends where less than this share of the disc (5 px at 256²) about the
            face's rim is face: 1/4 is a square's corner, 1/3 a hexagon's, 1/2 a side.
        most_table: a wall of whose pixels more than this share have the table's own depth is none.

    Returns:
        None where the table was not measured, or where nothing lies on it.
    """
    table = background_plane(depth_m, camera)
    if table is None:
        return None
    planes, known = fit_planes(labels, depth_m, camera, inside)
    count = len(planes)
    area = np.bincount(labels.ravel(), minlength=count + 1)
    # Only what has no surface of its own can hide a wall: the table, and what was not measured.
    is_table, is_open = np.zeros(count + 1, np.bool_), np.ones(count + 1, np.bool_)
    faces, heights = [], []
    for k, plane in enumerate(planes, start=1):
        if plane is None or known[k - 1] < 0.2 * area[k]:
            continue
        turn = np.degrees(np.arccos(np.clip(plane.normal @ table.normal, -1, 1)))
        height = float(table.height(plane.point))
        is_table[k] = is_open[k] = abs(height) < 3 * table.residual and turn < 15
        if turn < lying_deg and height > least_height * table.residual:
            faces.append(k)
            heights.append(height)
    if not faces:
        return None
    offset = float(table.normal @ table.point)
    lifts = np.array([_lift(table.normal, offset, height, camera) for height in heights])
    h, w = labels.shape
    owner = np.full((h, w), -1, np.int32)
    hit_x, hit_y = np.zeros((h, w), np.int32), np.zeros((h, w), np.int32)
    swept = np.zeros(count + 1, np.int64)
    highs = np.array(heights)
    _prisms(
        labels, np.array(faces), lifts, highs, is_open, _boxes(labels, faces, lifts),
        owner, hit_x, hit_y, np.zeros((h, w), np.float32), swept,
    )  # fmt: skip
    total = np.bincount(labels.ravel(), levels.ravel(), count + 1)
    ground_area = area[is_table].sum()
    dark = total * ground_area <= total[is_table].sum() * area
    allowed = is_table | (is_open & (dark | (swept >= 0.8 * area)))
    may = allowed[labels]
    owner[~may] = -1

    scale = max(image_scale(labels.shape), 1.0)
    share, inward = np.zeros((h, w), np.float32), np.zeros((h, w, 2), np.int32)
    _rims(labels, owner, np.array(faces), hit_x, hit_y, int(round(5 * scale)), share, inward)
    out = np.zeros((h, w), np.int32)
    found = _components(owner, (owner >= 0) & (share >= corner_share), out)
    _spread(owner, out)
    # The table's inverse depth over pixels, and how far its own depths lie from it.
    a, b, c = table.normal / offset
    ground = np.array(
        [a / camera.fx, b / camera.fy, c - a * camera.cx / camera.fx - b * camera.cy / camera.fy]
    )
    story = (
        owner, hit_x, hit_y, inward, np.linalg.inv(lifts), highs,
        np.ascontiguousarray(depth_m, np.float32), ground,
        3 * table.residual / float(table.point[2]) ** 2, found,
    )  # fmt: skip
    out = _join(out, _sums(out, *story), may, int(round(2 * scale)), 2.0 * scale)
    sums = _sums(out, *story)
    good = (sums[:, 0] >= least_area * scale * scale) & (sums[:, 5] <= most_table * sums[:, 0])
    good[0] = False
    if not good.any():
        return None
    walls = np.where(good, np.cumsum(good), 0).astype(np.int32)[out]
    beside = np.zeros((h, w), np.bool_)
    free = may & (walls == 0)
    beside[:, 1:] |= free[:, :-1]
    beside[:, :-1] |= free[:, 1:]
    beside[1:] |= free[:-1]
    beside[:-1] |= free[1:]
    highest = np.concatenate([[0], sums[good, 6]]).astype(np.float32)
    return Walls(walls, beside & (walls > 0), highest[walls])


@njit(cache=True, nogil=True)
def _extents(labels, count):
    """Rows (top, bottom, left, right), all included, that each region reaches."""
    h, w = labels.shape
    out = np.empty((count + 1, 4), np.int64)
    out[:, 0] = h
    out[:, 1] = -1
    out[:, 2] = w
    out[:, 3] = -1
    for y in range(h):
        for x in range(w):
            k = labels[y, x]
            out[k, 0] = min(out[k, 0], y)
            out[k, 1] = max(out[k, 1], y)
            out[k, 2] = min(out[k, 2], x)
            out[k, 3] = max(out[k, 3], x)
    return out


def _boxes(labels: I32, faces: list[int], lifts: F64) -> NDArray[np.int64]:
    """Rows (top, bottom, left, right), the ends left out, of each face and the prism under it."""
    extents = _extents(labels, int(labels.max()))[faces]
    corners = np.stack(
        [extents[:, [2, 2, 3, 3]], extents[:, [0, 1, 0, 1]], np.ones((len(faces), 4))], axis=1
    )
    lifted = lifts @ corners
    far = np.abs(lifted[:, :2] / lifted[:, 2:] - corners[:, :2]).max(axis=(1, 2))
    reach = np.ceil(far).astype(np.int64)[:, None] + 2
    low = np.maximum(extents[:, [0, 2]] - reach, 0)
    high = np.minimum(extents[:, [1, 3]] + reach + 1, labels.shape)
    return np.stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]], axis=1)

"""Sequential edge reconstruction (paper, 4.1) and edge linking from terminators (4.2).

What the paper leaves open, and what was chosen here:

*Masks.*  A terminator is an edge pixel with one neighbour, or with two that touch each other side
by side (a line that ends in a step of its staircase): sixteen 3x3 masks, :data:`TERMINATOR_MASKS`.

*Direction.*  The line is walked back from the terminator, front by front, until it branches or a
given length is reached; the direction is the least-squares slope of position over the number of
steps walked.  All sums are integers: the direction turns with the image exactly.

*Neighbourhood.*  A wedge in that direction: a pixel is a candidate if it lies no farther off the
axis than ``lateral + tan(cone) · (distance along it)``, is not of the line itself, and if no other
edge lies between.  The image's border is a candidate too: objects are cut off there.

*Cost.*  Distance, times a penalty for turning at either end, divided by what the gradient along
the path says for an edge there.  The gradient is averaged *with its sign*, across the path:
noise averages out, a faint crease does not.

*Order.*  Every terminator of a round decides on the same image and all links are drawn together;
equal costs are all drawn.  Nothing depends on the order of a scan, so that the result turns and
mirrors with the image.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .stack import image_scale

__all__ = [
    "TERMINATOR_MASKS",
    "Linked",
    "Links",
    "Reconstruction",
    "Step",
    "bresenham",
    "link",
    "path_offset",
    "reconstruct",
    "terminators_of",
]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]


class Step(IntEnum):
    """Which step decided on a pixel, and what the value beside it means."""

    NOTHING = 0
    """Never a candidate: its gradient is no maximum.  Value: its strength."""
    WEAK = 1
    """A candidate under the low threshold.  Value: its strength."""
    SHORT_MEDIUM = 2
    """Rejected in the first iteration: a segment too short and not connected.  Value: pixels."""
    SHORT_HIGH = 3
    """Rejected in the second iteration, likewise.  Value: pixels."""
    FAINT_MEDIUM = 4
    """Rejected in the first iteration: long enough, but too faint for its length.  Value: its
    weight, see :func:`reconstruct`."""
    FAINT_HIGH = 5
    """Rejected in the second iteration, likewise.  Value: its weight."""
    BACKGROUND = 6
    """A line on the background, which may be a part's shadow: it bounds regions but is no edge.
    Value: the grey level of its brighter side."""
    LOW = 10
    """In the low resolution image.  Value: the greatest strength of its segment."""
    MEDIUM = 11
    """Added in the first iteration.  Value: pixels of the segment (of the difference image)."""
    HIGH = 12
    """Added in the second iteration.  Value: pixels of the segment (of the difference image)."""
    LINK = 20
    """Drawn by a link to another edge.  Value: the link's cost."""
    BORDER = 21
    """Drawn by a link to the image's border.  Value: the link's cost."""
    CREASE = 30
    """Drawn to close a region where depth shows a step or a crease.  Value: its evidence."""
    FOOT = 31
    """The foot of an upright wall, drawn because depth shows the face above the wall lying over
    the table, see :mod:`edges.walls`.  Value: that face's height over the table, metres."""


# -- reconstruction ------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _iterate(
    before, output, finer, min_length, strength, unit, most, min_weight,
    added, short, faint, step, value,
):  # fmt: skip
    """One iteration: the difference's segments are added if connected, or long and clear enough.

    Weights are summed in 1/256 as integers, so that no order of walking shows in the sum.
    """
    h, w = finer.shape
    stack = np.empty(h * w, np.int32)
    seen = np.zeros((h, w), np.bool_)
    for y0 in range(h):
        for x0 in range(w):
            if not finer[y0, x0] or before[y0, x0] or seen[y0, x0]:
                continue
            stack[0] = y0 * w + x0
            seen[y0, x0] = True
            top = 1
            done = 0
            weight = 0
            connected = False
            while done < top:
                y = stack[done] // w
                x = stack[done] - y * w
                done += 1
                if min_weight > 0:
                    weight += int(np.float32(256) * min(strength[y, x] / unit, most))
                for v in range(max(y - 1, 0), min(y + 2, h)):
                    for u in range(max(x - 1, 0), min(x + 2, w)):
                        if before[v, u]:
                            connected = True
                        elif finer[v, u] and not seen[v, u]:
                            seen[v, u] = True
                            stack[top] = v * w + u
                            top += 1
            fate = added
            told = np.float32(top)
            if not connected:
                if top <= min_length:
                    fate = short
                elif min_weight > 0 and weight <= np.float32(256) * min_weight:
                    fate = faint
                    told = np.float32(weight) / np.float32(256)
            for i in range(top):
                y = stack[i] // w
                x = stack[i] - y * w
                step[y, x] = fate
                value[y, x] = told
                if fate == added:
                    output[y, x] = True


@dataclass(frozen=True)
class Reconstruction:
    """What figure 6 of the paper shows, and each pixel's fate.

    Attributes:
        difference_medium: [H W] bool, medium minus low resolution (figure 6a).
        first: [H W] bool, after the first iteration (6b).
        difference_high: [H W] bool, high resolution minus ``first`` (6c).
        edges: [H W] bool, the result (6d).
        step: [H W] uint8, a :class:`Step`; value: [H W] float32, what that step decided by.
    """

    difference_medium: Bool
    first: Bool
    difference_high: Bool
    edges: Bool
    step: U8
    value: F32


def reconstruct(
    low: Bool,
    medium: Bool,
    high: Bool,
    strength: F32 | None = None,
    thin: Bool | None = None,
    segment_peak: F32 | None = None,
    min_length: float = 4.0,
    min_weight: float = 0.0,
    unit: float = 1.0,
    most: float = 3.0,
) -> Reconstruction:
    """Put the stack together from coarse to fine, losing noise at each iteration (4.1).

    A segment of the difference image stays if it touches (8-connected) what has been kept so far
    or is longer than ``min_length`` pixels.  "Longer than 4 pixels" is scaled with the image, as
    the paper's length for noise is.  Segments' length is their number of pixels.

    Args:
        low, medium, high: [H W] bool, low to high resolution.
        strength, thin, segment_peak: of the stack, for the story of each pixel; may be left out.
        min_length: pixels at 256².
        min_weight: a segment that is not connected must also weigh more than this, where each of
            its pixels weighs its ``strength`` over ``unit``, at most ``most``; pixels at 256².
            Noise leaves segments that are short *and* faint; one just over the low threshold must
            be this long, a clear one a third of it.  0 (the paper) weighs nothing.
        unit: the strength that weighs one pixel; the low threshold is a good one.

    Raises:
        ValueError: shapes that differ, or a weight asked for without a strength.
    """
    if not low.shape == medium.shape == high.shape:
        raise ValueError(
            f"the stack's images differ in shape: {low.shape}, {medium.shape}, {high.shape}"
        )
    if min_weight > 0 and strength is None:
        raise ValueError("min_weight needs the strength of the pixels")
    scale = image_scale(low.shape)
    limit = int(min_length * scale)
    weights = np.empty((1, 1), np.float32) if strength is None else strength
    needs = np.float32(unit), np.float32(most), np.float32(min_weight * scale)
    step = np.zeros(low.shape, np.uint8)
    value = np.zeros(low.shape, np.float32) if strength is None else strength.copy()
    if thin is not None:
        step[thin] = Step.WEAK
    step[low] = Step.LOW
    if segment_peak is not None:
        np.copyto(value, segment_peak, where=low)
    first = low.copy()
    _iterate(
        low, first, medium, limit, weights, *needs,
        int(Step.MEDIUM), int(Step.SHORT_MEDIUM), int(Step.FAINT_MEDIUM), step, value,
    )  # fmt: skip
    output = first.copy()
    _iterate(
        first, output, high, limit, weights, *needs,
        int(Step.HIGH), int(Step.SHORT_HIGH), int(Step.FAINT_HIGH), step, value,
    )  # fmt: skip
    return Reconstruction(medium & ~low, first, high & ~first, output, step, value)


# -- terminators ---------------------------------------------------------------------------------

_RING = ((0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1))
"""The eight neighbours (dx, dy), clockwise from the one above; bit k of a code is neighbour k."""


def _masks() -> NDArray[np.int8]:
    masks = []
    for k in range(8):
        for pair in (False, True):
            mask = np.zeros((3, 3), np.int8)
            mask[1, 1] = 1
            for j in {k, (k + 1) % 8} if pair else {k}:
                dx, dy = _RING[j]
                mask[1 + dy, 1 + dx] = 1
            masks.append(mask)
    return np.array(masks)


TERMINATOR_MASKS = _masks()
"""[16 3 3] int8: a pixel is a terminator if its 3x3 surroundings equal one of these."""

_IS_TERMINATOR = np.zeros(256, np.bool_)
for _mask in TERMINATOR_MASKS:
    _IS_TERMINATOR[sum(1 << k for k, (dx, dy) in enumerate(_RING) if _mask[1 + dy, 1 + dx])] = True


@njit(cache=True, nogil=True)
def _ring_code(e, p, w):
    """Which of the eight neighbours of flat index ``p`` are edges, see :data:`_RING`."""
    return (
        e[p - w]
        | e[p - w + 1] << 1
        | e[p + 1] << 2
        | e[p + w + 1] << 3
        | e[p + w] << 4
        | e[p + w - 1] << 5
        | e[p - 1] << 6
        | e[p - w - 1] << 7
    )


@njit(cache=True, nogil=True)
def _terminators_among(e, pixels, w, table):
    """The terminators among ``pixels`` (flat indices of ``e``, padded), as rows of (x, y)."""
    found = np.empty((pixels.size, 2), np.int32)
    n = 0
    for p in pixels:
        if table[_ring_code(e, p, w)]:
            found[n, 0] = p % w
            found[n, 1] = p // w
            n += 1
    return found[:n].copy()


def _codes(e: U8, corners: F32) -> NDArray[np.int64]:
    """Ring codes of the pixels in the first two columns."""
    x, y = corners[:, 0].astype(np.int64), corners[:, 1].astype(np.int64)
    code = np.zeros(len(corners), np.int64)
    for k, (dx, dy) in enumerate(_RING):
        code |= e[y + dy, x + dx].astype(np.int64) << k
    return code


def _terminators(e: U8, pixels: NDArray[np.int64]) -> I32:
    return _terminators_among(e.reshape(-1), pixels, e.shape[1], _IS_TERMINATOR)


@njit(cache=True, nogil=True)
def _walk_back(e, x0, y0, reach, trail, mark, stamp):
    """Walk the line back from (x0, y0); returns the pixels written to ``trail`` and the direction.

    Pixels that were met have ``stamp`` in ``mark``, which no earlier walk may have used.

    ``trail`` takes rows of (x, y, steps).  A front (the pixels first reached after equally many
    steps) that no longer fits into 2x2 pixels is a fork, and the walk ends before it.  The
    direction is minus the slope of position over steps, times a positive number: integers.
    """
    trail[0, 0] = x0
    trail[0, 1] = y0
    trail[0, 2] = 0
    mark[y0, x0] = stamp
    n = 1
    first = 0
    for k in range(1, reach):
        last = n
        for i in range(first, last):
            for v in range(trail[i, 1] - 1, trail[i, 1] + 2):
                for u in range(trail[i, 0] - 1, trail[i, 0] + 2):
                    if not e[v, u]:
                        continue
                    if mark[v, u] != stamp and n < trail.shape[0]:
                        mark[v, u] = stamp
                        trail[n, 0] = u
                        trail[n, 1] = v
                        trail[n, 2] = k
                        n += 1
        if n == last:
            break
        left = right = trail[last, 0]
        upper = lower = trail[last, 1]
        for i in range(last, n):
            left = min(left, trail[i, 0])
            right = max(right, trail[i, 0])
            upper = min(upper, trail[i, 1])
            lower = max(lower, trail[i, 1])
        if right - left > 1 or lower - upper > 1:
            n = last
            break
        first = last
    total = 0
    for i in range(n):
        total += trail[i, 2]
    dx = 0
    dy = 0
    for i in range(n):
        weight = total - n * trail[i, 2]
        dx += weight * trail[i, 0]
        dy += weight * trail[i, 1]
    return n, dx, dy


@njit(cache=True, nogil=True)
def _directions(e, ends, reach, mark):
    out = np.zeros((ends.shape[0], 2), np.int64)
    trail = np.empty((4 * reach + 16, 3), np.int32)
    for i in range(ends.shape[0]):
        _, dx, dy = _walk_back(e, ends[i, 0], ends[i, 1], reach, trail, mark, mark[0, 0] + 1)
        mark[0, 0] += 1
        out[i, 0] = dx
        out[i, 1] = dy
    return out


@njit(cache=True, nogil=True)
def _ball(e, reach, trail, seeds, mark, stamp):
    """Edge pixels within ``reach`` steps along the edges of the first ``seeds`` rows of ``trail``.

    Pixels that have ``stamp`` in ``mark`` are not walked over; those that were met get it.
    Returns how many there are; rows are (x, y, steps).
    """
    n = seeds
    first = 0
    for k in range(1, reach):
        last = n
        for i in range(first, last):
            for v in range(trail[i, 1] - 1, trail[i, 1] + 2):
                for u in range(trail[i, 0] - 1, trail[i, 0] + 2):
                    if not e[v, u]:
                        continue
                    if mark[v, u] != stamp and n < trail.shape[0]:
                        mark[v, u] = stamp
                        trail[n, 0] = u
                        trail[n, 1] = v
                        trail[n, 2] = k
                        n += 1
        if n == last:
            break
        first = last
    return n


@njit(cache=True, nogil=True)
def _corners(e, pixels, reach, sharp, mark):
    """Corners of the lines: rows (x, y, dx, dy) of padded position and outward bisector.

    A pixel whose neighbours are two groups that do not touch lies on a line of two arms.  Each is
    walked for ``reach`` steps; the arms' directions are their mean pixels as seen from here.  The
    pixel is a corner if the cosine of the angle between them is over ``sharp`` and over that of
    every other such pixel within two pixels (equal ones all are).
    """
    h, w = e.shape
    turn = np.full((h, w), np.float32(-2))
    # Room for every pixel within reach, so that nothing depends on which are met first.
    trail = np.empty(((2 * reach + 1) ** 2 + 8, 3), np.int32)
    group = np.empty(8, np.int32)
    ring_x = np.array([0, 1, 1, 1, 0, -1, -1, -1])
    ring_y = np.array([-1, -1, 0, 1, 1, 1, 0, -1])
    found = np.empty((256, 4), np.float32)
    n = 0
    for p in pixels:
        y = p // w
        x = p - y * w
        # Groups of neighbours: runs around the ring, joined over an empty diagonal.
        count = 0
        for k in range(8):
            group[k] = 1 if e[y + ring_y[k], x + ring_x[k]] else 0
            count += group[k]
        if count < 2 or count > 4:
            continue
        groups = 0
        for k in range(8):
            if group[k] == 0:
                continue
            before = group[(k + 7) % 8]
            if before == 0 and k % 2 == 0:
                before = group[(k + 6) % 8]
            if before == 0:
                groups += 1
        if groups != 2:
            continue
        k = 0
        while True:
            before = group[(k + 7) % 8]
            if before == 0 and k % 2 == 0:
                before = group[(k + 6) % 8]
            if group[k] and not before:
                break
            k += 1
        arms_ok = True
        ax = ay = bx = by = np.float32(0)
        for arm in range(2):
            mark[0, 0] += 1
            mark[y, x] = mark[0, 0]
            seeds = 0
            gap = 0
            while gap < 2:
                if group[k % 8]:
                    trail[seeds, 0] = x + ring_x[k % 8]
                    trail[seeds, 1] = y + ring_y[k % 8]
                    trail[seeds, 2] = 0
                    mark[trail[seeds, 1], trail[seeds, 0]] = mark[0, 0]
                    seeds += 1
                    gap = 0
                else:
                    gap += 1
                    # An empty corner of the ring does not part its two sides.
                    if gap == 1 and (k % 2 == 0 or not group[(k + 1) % 8]):
                        break
                k += 1
            while not group[k % 8]:
                k += 1
            m = _ball(e, reach, trail, seeds, mark, mark[0, 0])
            if trail[m - 1, 2] < reach // 2:
                arms_ok = False
                break
            sx = 0
            sy = 0
            for i in range(m):
                sx += trail[i, 0] - x
                sy += trail[i, 1] - y
            length = np.sqrt(np.float32(sx * sx + sy * sy))
            if length == 0:
                arms_ok = False
                break
            if arm == 0:
                ax = sx / length
                ay = sy / length
            else:
                bx = sx / length
                by = sy / length
        if not arms_ok:
            continue
        cosine = np.float32(ax * bx + ay * by)
        if cosine <= sharp or cosine > np.float32(0.95):
            continue
        turn[y, x] = cosine
        if n == found.shape[0]:
            more = np.empty((2 * n, 4), np.float32)
            more[:n] = found
            found = more
        found[n, 0] = x
        found[n, 1] = y
        found[n, 2] = -(ax + bx)
        found[n, 3] = -(ay + by)
        n += 1
    kept = 0
    for i in range(n):
        x = int(found[i, 0])
        y = int(found[i, 1])
        top = True
        for v in range(max(y - 2, 0), min(y + 3, h)):
            for u in range(max(x - 2, 0), min(x + 3, w)):
                if turn[v, u] > turn[y, x]:
                    top = False
        if top:
            found[kept] = found[i]
            kept += 1
    return found[:kept]


def _pixels(e: U8) -> NDArray[np.int64]:
    """Flat indices of the edge pixels; numpy counts bool much faster than other types."""
    return np.flatnonzero(e.view(np.bool_))


def _padded(edges: Bool) -> U8:
    e = np.zeros((edges.shape[0] + 2, edges.shape[1] + 2), np.uint8)
    e[1:-1, 1:-1] = edges
    return e


def _unit(vectors: NDArray[np.int64]) -> F32:
    length = np.sqrt((vectors.astype(np.float64) ** 2).sum(axis=1, keepdims=True))
    return (vectors / np.maximum(length, 1e-12)).astype(np.float32)


def terminators_of(edges: Bool, reach: float = 5.0) -> tuple[I32, F32]:
    """The ends of lines, and the direction in which each line would go on (4.2).

    Args:
        edges: [H W] bool, lines one pixel thin.
        reach: pixels of the line at 256² that the direction is taken from.

    Returns:
        position: [N 2] int32, (x, y); direction: [N 2] float32, unit vectors, outwards.
    """
    e = _padded(edges)
    ends = _terminators(e, _pixels(e))
    steps = int(round(reach * max(image_scale(edges.shape), 1.0)))
    return ends - 1, _unit(_directions(e, ends, max(steps, 2), np.zeros(e.shape, np.int32)))


# -- paths ---------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def path_offset(i, major, minor):
    """Bresenham's line: how far it has gone on the lesser axis after i steps on the greater one.

    Exactly between two pixels, the line takes the one nearer to its nearer end's level.  So it is
    the same from either end (but in its very middle), and mirrors and turns with the image;
    Bresenham's own rule, always up, does neither.
    """
    if 2 * i <= major:
        return (2 * i * minor + major - 1) // (2 * major)
    return minor - (2 * (major - i) * minor + major - 1) // (2 * major)


def bresenham(x0: int, y0: int, x1: int, y1: int) -> list[tuple[int, int]]:
    """Bresenham's line (1965) from one pixel to another, both included, 8-connected.

    Ties are resolved by symmetry, see :func:`path_offset`.
    """
    dx, dy = abs(x1 - x0), abs(y1 - y0)
    sx, sy = (1 if x1 >= x0 else -1), (1 if y1 >= y0 else -1)
    major, minor = max(dx, dy), min(dx, dy)
    path = []
    for i in range(major + 1):
        o = int(path_offset(i, major, minor)) if major else 0
        path.append((x0 + sx * i, y0 + sy * o) if dx >= dy else (x0 + sx * o, y0 + sy * i))
    return path


_MOST_EVIDENCE = np.float32(5)
"""Standard deviations of evidence that count: five are certainty, more would only let far away
strong edges win over near ones."""


@njit(cache=True, nogil=True)
def _inspect_path(e, ex, ey, use_evidence, x0, y0, x1, y1):
    """Is the way free, and what does the gradient say for an edge along it?

    Returns (free, evidence).  The evidence is the mean over the path of the gradient's component
    across it, with its sign, less the mean at three pixels to either side (shading alone has the
    same gradient there, an edge has not).  It is taken of the path and of its neighbours at one
    pixel's distance, since a straight line meets a crest only so well, and the greatest counts.
    """
    h, w = e.shape
    dx = x1 - x0
    dy = y1 - y0
    sx = 1 if dx >= 0 else -1
    sy = 1 if dy >= 0 else -1
    ax = abs(dx)
    ay = abs(dy)
    major = max(ax, ay)
    minor = min(ax, ay)
    steep = ay > ax
    length = np.sqrt(np.float32(ax * ax + ay * ay))
    nx = np.float32(-dy) / length
    ny = np.float32(dx) / length
    if not use_evidence or major < 2:
        for i in range(1, major):
            o = path_offset(i, major, minor)
            if e[y0 + sy * (i if steep else o), x0 + sx * (o if steep else i)]:
                return False, np.float32(0)
        return True, np.float32(0)
    best = np.float32(0)
    for shift_x in range(2):
        # Lateral shifts go along the lesser axis; on an exact diagonal along either.
        if ax != ay and (shift_x == 1) != steep:
            continue
        sums = np.zeros(9, np.float32)
        for i in range(1, major):
            o = path_offset(i, major, minor)
            x = x0 + sx * (o if steep else i)
            y = y0 + sy * (i if steep else o)
            if e[y, x]:
                return False, np.float32(0)
            # ex, ey are not padded.
            for k in range(9):
                u = x - 1 + (k - 4) * shift_x
                v = y - 1 + (k - 4) * (1 - shift_x)
                u = min(max(u, 0), w - 3)
                v = min(max(v, 0), h - 3)
                sums[k] += nx * ex[v, u] + ny * ey[v, u]
        for k in range(3, 6):
            best = max(best, abs(sums[k] - np.float32(0.5) * (sums[k - 3] + sums[k + 3])))
    return True, min(best / np.float32(major - 1), _MOST_EVIDENCE)


@njit(cache=True, nogil=True)
def _draw(out, step, value, x0, y0, x1, y1, code, cost):
    """Draw a link between two padded pixels into the padded image; new pixels get their story."""
    ax = abs(x1 - x0)
    ay = abs(y1 - y0)
    sx = 1 if x1 >= x0 else -1
    sy = 1 if y1 >= y0 else -1
    major = max(ax, ay)
    minor = min(ax, ay)
    for i in range(major + 1):
        o = path_offset(i, major, minor) if major > 0 else 0
        if ax >= ay:
            x = x0 + sx * i
            y = y0 + sy * o
        else:
            x = x0 + sx * o
            y = y0 + sy * i
        out[y, x] = 1
        if step[y - 1, x - 1] < 10:
            step[y - 1, x - 1] = code
            value[y - 1, x - 1] = cost
        elif step[y - 1, x - 1] >= 20 and cost < value[y - 1, x - 1]:
            # Two links of one round share the pixel: the cheaper one tells its story.
            step[y - 1, x - 1] = code
            value[y - 1, x - 1] = cost


@njit(cache=True, nogil=True)
def _draw_all(out, step, value, ends, chosen, cost, link_code, border_code):
    """Draw every row (end, x, y, goes to the border) of ``chosen``."""
    for i in range(chosen.shape[0]):
        x0, y0 = ends[chosen[i, 0]]
        code = border_code if chosen[i, 3] else link_code
        _draw(out, step, value, x0, y0, chosen[i, 1], chosen[i, 2], code, cost[i])


# -- linking -------------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _link_round(
    e, ends, where, dirs, plain, window, reach, lateral, slope, turn, facing, max_cost,
    ex, ey, use_evidence, evidence_half, least_evidence, border, chosen, cost_of, mark,
):  # fmt: skip
    """Each terminator's cheapest partner within ``window``; rows (end, x, y, kind) of ``chosen``.

    Equal costs are all taken, so a row per tie.  Returns the number of rows.
    """
    h, w = e.shape
    # Room for every pixel within reach, so that nothing depends on which are met first.
    trail = np.empty(((2 * reach + 1) ** 2 + 8, 3), np.int32)
    rows = 0
    for i in range(ends.shape[0]):
        x0 = ends[i, 0]
        y0 = ends[i, 1]
        dx = np.float32(dirs[i, 0])
        dy = np.float32(dirs[i, 1])
        norm = np.sqrt(dx * dx + dy * dy)
        if norm == 0:
            continue
        dx /= norm
        dy /= norm
        is_corner = i >= plain
        trail[0, 0] = x0
        trail[0, 1] = y0
        trail[0, 2] = 0
        mark[0, 0] += 1
        stamp = mark[0, 0]
        mark[y0, x0] = stamp
        _ball(e, reach, trail, 1, mark, stamp)
        best = np.float32(max_cost)
        first_row = rows
        for y in range(max(y0 - window, 1), min(y0 + window + 1, h - 1)):
            for x in range(max(x0 - window, 1), min(x0 + window + 1, w - 1)):
                if not e[y, x] or mark[y, x] == stamp:
                    continue
                vx = np.float32(x - x0)
                vy = np.float32(y - y0)
                along = vx * dx + vy * dy
                if along <= 0:
                    continue
                off = abs(vx * dy - vy * dx)
                if off > lateral + slope * along:
                    continue
                square = vx * vx + vy * vy
                if square > np.float32(window * window) or square <= 2:
                    continue
                distance = np.sqrt(square)
                bend = np.float32(1) - along / distance
                other = where[y, x]
                if other >= 0:
                    # Two ends that look at each other: what a gap in a contour looks like.
                    ox = np.float32(dirs[other, 0])
                    oy = np.float32(dirs[other, 1])
                    on = np.sqrt(ox * ox + oy * oy)
                    if on > 0:
                        bend += np.float32(1) + (vx * ox + vy * oy) / (distance * on)
                    else:
                        bend += np.float32(1)
                    cost = distance * (np.float32(1) + turn * bend)
                    sure = bend < 1
                else:
                    sure = False
                    cost = distance * (np.float32(1) + turn * bend) * facing
                if use_evidence:
                    if cost > best * (np.float32(1) + _MOST_EVIDENCE / evidence_half):
                        continue
                elif cost > best:
                    continue
                free, evidence = _inspect_path(e, ex, ey, use_evidence, x0, y0, x, y)
                if not free:
                    continue
                if is_corner and not sure and evidence < least_evidence:
                    continue
                if use_evidence:
                    cost = cost / (np.float32(1) + evidence / evidence_half)
                if cost > best:
                    continue
                if cost < best:
                    rows = first_row
                best = cost
                if rows < chosen.shape[0]:
                    chosen[rows, 0] = i
                    chosen[rows, 1] = x
                    chosen[rows, 2] = y
                    chosen[rows, 3] = 0
                    cost_of[rows] = cost
                    rows += 1
        if border and not is_corner:
            # Straight on to the border, if nothing else is cheaper.
            room_x = w - 2 - x0 if dx > 0 else x0 - 1
            room_y = h - 2 - y0 if dy > 0 else y0 - 1
            adx = abs(dx)
            ady = abs(dy)
            if adx > 0 and np.float32(room_x) * ady <= np.float32(room_y) * adx:
                gone_x = room_x
                gone_y = int(np.float32(room_x) * ady / adx + np.float32(0.5))
            else:
                gone_y = room_y
                gone_x = int(np.float32(room_y) * adx / ady + np.float32(0.5))
            x = x0 + (gone_x if dx > 0 else -gone_x)
            y = y0 + (gone_y if dy > 0 else -gone_y)
            square = np.float32(gone_x * gone_x + gone_y * gone_y)
            if 0 < square <= np.float32(window * window):
                free, evidence = _inspect_path(e, ex, ey, use_evidence, x0, y0, x, y)
                cost = np.sqrt(square) * facing
                if use_evidence:
                    cost = cost / (np.float32(1) + evidence / evidence_half)
                if free and not e[y, x] and cost <= best and rows < chosen.shape[0]:
                    if cost < best:
                        rows = first_row
                    chosen[rows, 0] = i
                    chosen[rows, 1] = x
                    chosen[rows, 2] = y
                    chosen[rows, 3] = 1
                    cost_of[rows] = cost
                    rows += 1
    return rows


@dataclass(frozen=True)
class Links:
    """The links of all rounds, one row each.

    Attributes:
        start, end: [L 2] int32, (x, y): the terminator and the edge or border pixel it met.
        cost: [L] float32; round: [L] int32; border: [L] bool, the link goes to the border.
    """

    start: I32
    end: I32
    cost: F32
    round: I32
    border: Bool


@dataclass(frozen=True)
class Linked:
    """The result of linking.

    Attributes:
        edges: [H W] bool, every edge that came in and the links.
        links_drawn: [H W] bool, the pixels that links added (shaded in the paper's figure 7).
        links: the links themselves.
        terminators: [N 2] int32 (x, y) before linking; directions: [N 2] float32, unit vectors.
        open_ends: [M 2] int32 (x, y), the terminators that are left.
        step, value: [H W], as in :class:`Reconstruction`, with the links entered.
    """

    edges: Bool
    links_drawn: Bool
    links: Links
    terminators: I32
    directions: F32
    open_ends: I32
    step: U8
    value: F32


_NO_EVIDENCE = np.zeros((1, 1), np.float32)


def link(
    edges: Bool,
    step: U8 | None = None,
    value: F32 | None = None,
    evidence: tuple[F32, F32] | None = None,
    *,
    windows: tuple[float, ...] = (3.0, 6.0, 9.0, 12.0, 15.0),
    reach: float = 5.0,
    lateral: float = 2.0,
    cone_deg: float = 50.0,
    turn: float = 2.0,
    facing: float = 1.5,
    max_cost: float = 18.0,
    evidence_half: float = 0.5,
    border: bool = True,
    corners: float = 0.0,
    least_evidence: float = 1.0,
) -> Linked:
    """Bridge the gaps between unlinked edges, from their terminators (4.2).

    A pass for each window, from the least to the greatest, so that near ends find each other
    before far ones are tried; terminators are looked for anew each time.

    Args:
        edges: [H W] bool, thin lines.
        step, value: [H W], each pixel's story so far (from :func:`reconstruct`), or None.
        evidence: x and y components of the gradient, [H W] float32, in standard deviations of
            their noise; None judges by geometry alone.
        windows: radii of the neighbourhood, pixels at 256²; greater images scale them up, smaller
            ones keep them, since it is the operator that opens gaps and it does not shrink.
        reach: pixels of the line that its direction is taken from, likewise scaled.
        lateral: half width of the wedge at the terminator, pixels: what a pixel grid may hide.
        cone_deg: half angle of the wedge, degrees, under 90.
        turn: how much a turn costs: a link at angle a costs 1 + turn (1 - cos a) times more, the
            angles of both ends added.
        facing: factor on the cost of a link to something else than another terminator.
        max_cost: links that cost more are not drawn; pixels at 256², scaled as the windows.
        evidence_half: mean gradient along the path, in standard deviations, that halves the cost.
        border: link to the image's border too.
        corners: in windows up to this many pixels at 256², sharp corners of lines look for
            partners as terminators do, along their bisector: where three surfaces meet, the
            operator rounds two of the lines into one that passes by the third, and no end is left
            to link from.  0 links terminators alone, as the paper does.
        least_evidence: what a corner's link needs along its path, in standard deviations, unless
            its partner is an end or a corner that faces it.

    Raises:
        ValueError: a window under 2 px, an angle outside (0, 90), other shapes than the edges'.
    """
    edges = np.ascontiguousarray(edges, np.bool_)
    if edges.ndim != 2 or edges.size == 0:
        raise ValueError(f"expected edges of axes [H W], got shape {edges.shape}")
    if min(windows, default=0) < 2:
        raise ValueError(f"windows must be 2 px or more, got {windows}")
    if not 0 < cone_deg < 90:
        raise ValueError(f"cone_deg must lie between 0 and 90, got {cone_deg}")
    if evidence is not None and not evidence[0].shape == evidence[1].shape == edges.shape:
        raise ValueError(f"evidence has shape {evidence[0].shape}, the edges {edges.shape}")
    scale = max(image_scale(edges.shape), 1.0)
    steps = max(int(round(reach * scale)), 2)
    if step is None:
        step = np.where(edges, Step.HIGH, Step.NOTHING)
    step = step.astype(np.uint8)
    value = np.zeros(edges.shape, np.float32) if value is None else value.copy()
    ex, ey = evidence if evidence is not None else (_NO_EVIDENCE, _NO_EVIDENCE)
    e = _padded(edges)
    where = np.full(e.shape, -1, np.int32)
    # Stamps of walks; the padding's first pixel counts them.
    mark = np.zeros(e.shape, np.int32)
    rows_of: list[tuple[NDArray, NDArray, NDArray, NDArray]] = []
    first_ends = np.empty((0, 2), np.int32)
    first_dirs = np.empty((0, 2), np.float32)
    first = True
    bent: NDArray | None = None
    ring = np.empty(0, np.int64)
    for window in sorted(windows):
        pixels = _pixels(e)
        ends = _terminators(e, pixels)
        dirs = _directions(e, ends, steps, mark)
        if first:
            first = False
            first_ends, first_dirs = ends - 1, _unit(dirs)
        plain = len(ends)
        if corners > 0 and window <= corners:
            if bent is None:
                # Once: what bends because of a link is no corner of the scene.
                bent = _corners(e, pixels, max(int(round(5 * scale)), 3), np.float32(-0.35), mark)
                ring = _codes(e, bent)
            else:
                # A corner that a link has reached has its partner.
                same = _codes(e, bent) == ring
                bent, ring = bent[same], ring[same]
            ends = np.concatenate([ends, bent[:, :2].astype(np.int32)])
            scaled = np.round(bent[:, 2:] * np.float32(1024)).astype(np.int64)
            dirs = np.concatenate([dirs, scaled])
        if not len(ends):
            continue
        where[ends[:, 1], ends[:, 0]] = np.arange(len(ends))
        chosen = np.empty((4 * len(ends) + 16, 4), np.int32)
        cost = np.empty(len(chosen), np.float32)
        n = _link_round(
            e, ends, where, dirs, plain, int(round(window * scale)), steps, np.float32(lateral),
            np.float32(np.tan(np.radians(cone_deg))), np.float32(turn), np.float32(facing),
            np.float32(max_cost * scale), ex, ey, evidence is not None,
            np.float32(evidence_half), np.float32(least_evidence), border, chosen, cost, mark,
        )  # fmt: skip
        where[ends[:, 1], ends[:, 0]] = -1
        chosen, cost = chosen[:n], cost[:n]
        _draw_all(e, step, value, ends, chosen, cost, int(Step.LINK), int(Step.BORDER))
        rows_of.append((ends[chosen[:, 0]] - 1, chosen[:, 1:3] - 1, cost, chosen[:, 3] != 0))
    result = e[1:-1, 1:-1].astype(np.bool_)
    links = Links(
        np.concatenate([r[0] for r in rows_of] or [np.empty((0, 2), np.int32)]),
        np.concatenate([r[1] for r in rows_of] or [np.empty((0, 2), np.int32)]),
        np.concatenate([r[2] for r in rows_of] or [np.empty(0, np.float32)]),
        np.concatenate([np.full(len(r[0]), k, np.int32) for k, r in enumerate(rows_of)])
        if rows_of
        else np.empty(0, np.int32),
        np.concatenate([r[3] for r in rows_of] or [np.empty(0, np.bool_)]),
    )
    left = _terminators(e, _pixels(e)) - 1
    return Linked(result, result & ~edges, links, first_ends, first_dirs, left, step, value)

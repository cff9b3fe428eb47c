"""What the depth says of an edge: steps and creases, in standard deviations (optics.md, 6 and 8).

A sensor that measures depth in a window smears a step over that window, so the depth cannot tell
*where* an edge is as well as the intensity can; but parts of one albedo and one tilt show no edge
in the intensity at all.  At each pixel and in four directions a line is therefore fitted to the
depth on either side, leaving out the nearest pixels; both lines are carried on to the pixel:

    step   = difference of the two values there,
    crease = difference of the two slopes.

Both are divided by their spread over the image and the lines' own residuals, measured from the
image: no number here depends on the sensor, its range or its unit, and a noisy surface (dark,
steep) needs a greater step.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .stack import image_scale

__all__ = ["RIDGE_REACH", "DepthEdges", "depth_edges"]

F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


RIDGE_REACH = 5.0
"""A ridge is the greatest within this many pixels at 256², half a sensor window."""


_UNITS = float(2**20)
"""The depth's range in whole units.  Whole numbers add up to the same in any order, so that the
lines, whose samples are summed row by row, turn and mirror with the image to the last bit."""


@njit(cache=True, nogil=True)
def _lines(z, known, ux, uy, samples, reach, value, slope, out_var, in_var, slope_var):
    """Lines through ``samples`` pixels that start at each pixel and go on by (ux, uy).

    Position is counted from the line's middle.  ``value`` is there; the variances are those of the
    value carried on by ``reach`` steps backwards (``out_var``) and forwards (``in_var``) and of the
    slope, from the line's own residuals.  Where fewer than four or half of the samples are known,
    ``value`` is NaN.  Rows are summed side by side, which vectorises.
    """
    h, w = z.shape
    n = np.empty(w, np.float64)
    st = np.empty(w, np.float64)
    stt = np.empty(w, np.float64)
    sz = np.empty(w, np.float64)
    stz = np.empty(w, np.float64)
    szz = np.empty(w, np.float64)
    middle = 0.5 * (samples - 1)
    least = max(4.0, 0.5 * samples)
    span = (samples - 1) * ux
    for y in range(h):
        last = y + uy * (samples - 1)
        if last < 0 or last >= h or span >= w:
            value[y] = np.nan
            continue
        fits = w - span
        n[:] = 0
        st[:] = 0
        stt[:] = 0
        sz[:] = 0
        stz[:] = 0
        szz[:] = 0
        for i in range(samples):
            t = i - middle
            row = z[y + uy * i, ux * i : ux * i + fits]
            there = known[y + uy * i, ux * i : ux * i + fits]
            for x in range(fits):
                n[x] += there[x]
                st[x] += t * there[x]
                stt[x] += t * t * there[x]
                sz[x] += row[x]
                stz[x] += t * row[x]
                szz[x] += np.float64(row[x]) * row[x]
        for x in range(fits):
            det = n[x] * stt[x] - st[x] * st[x]
            ok = n[x] >= least and det > 0
            det = det if ok else 1.0
            number = n[x] if ok else 4.0
            b = (n[x] * stz[x] - st[x] * sz[x]) / det
            a = (sz[x] - b * st[x]) / number
            rest = max(szz[x] - a * sz[x] - b * stz[x], 0.0) / ((number - 2) * det)
            value[y, x] = a if ok else np.nan
            slope[y, x] = b
            fixed = stt[x] + reach * reach * number
            out_var[y, x] = rest * (fixed + 2 * reach * st[x])
            in_var[y, x] = rest * (fixed - 2 * reach * st[x])
            slope_var[y, x] = rest * number
        value[y, fits:] = np.nan


_FINE = 17
"""Bits of a float32 that a histogram drops: bins of 1/64 of a power of two."""


@njit(cache=True, nogil=True)
def _compare(
    value, slope, out_var, in_var, slope_var, wanted, pad, ux, uy, near, far, length,
    step, crease, step_var, crease_var, steps, creases,
):  # fmt: skip
    """Step and crease between the lines before and behind each wanted pixel; and histograms.

    The lines' arrays have a margin of ``pad`` pixels around.
    """
    h, w = wanted.shape
    reach = np.float32(0.5 * (near + far))
    for y in range(h):
        v1 = pad + y + uy * near
        v0 = pad + y - uy * far
        for x in range(w):
            step[y, x] = np.nan
            if not wanted[y, x]:
                continue
            u1 = pad + x + ux * near
            u0 = pad + x - ux * far
            a = value[v1, u1] - reach * slope[v1, u1]
            b = value[v0, u0] + reach * slope[v0, u0]
            s = abs(a - b)
            if np.isnan(s):
                continue
            c = abs(slope[v1, u1] - slope[v0, u0]) / length
            step[y, x] = s
            crease[y, x] = c
            step_var[y, x] = out_var[v1, u1] + in_var[v0, u0]
            crease_var[y, x] = (slope_var[v1, u1] + slope_var[v0, u0]) / (length * length)
            steps[np.float32(s).view(np.int32) >> _FINE] += 1
            creases[np.float32(c).view(np.int32) >> _FINE] += 1


def _third(counts: NDArray[np.int64]) -> float:
    """The value under which a third of a histogram of :func:`_compare` lies."""
    total = np.cumsum(counts)
    k = int(np.searchsorted(total, total[-1] / 3))
    edge = np.array([k << _FINE, (k + 1) << _FINE], np.int32).view(np.float32)
    before = total[k - 1] if k else 0
    return float(edge[0] + (edge[1] - edge[0]) * (total[-1] / 3 - before) / counts[k])


_LOCAL = 4.0
"""How much more than their formal variance the two lines' own residuals count: the samples of a
windowed sensor are not independent; with windows of ten pixels about four make one."""


@njit(cache=True, nogil=True)
def _strongest(step, crease, step_var, crease_var, sigma_step, sigma_crease, local):
    """Greatest of step and crease in sigmas over the directions, and the direction's number."""
    _, h, w = step.shape
    best = np.zeros((h, w), np.float32)
    way = np.full((h, w), np.uint8(255))
    for y in range(h):
        for x in range(w):
            for k in range(4):
                s = step[k, y, x]
                if np.isnan(s):
                    continue
                a = s / np.sqrt(sigma_step[k] ** 2 + local * step_var[k, y, x])
                b = crease[k, y, x] / np.sqrt(sigma_crease[k] ** 2 + local * crease_var[k, y, x])
                d = np.float32(max(a, b))
                if d > best[y, x]:
                    best[y, x] = d
                    way[y, x] = k
    return best, way


@njit(cache=True, nogil=True)
def _ridge(best, way, low, reach):
    """Pixels over ``low`` and greatest over ``reach`` pixels either way along their direction."""
    h, w = best.shape
    thin = np.zeros((h, w), np.bool_)
    for y in range(h):
        for x in range(w):
            k = way[y, x]
            if k == 255 or best[y, x] < low:
                continue
            ux = 1 if k != 1 else 0
            uy = 1 if k == 1 or k == 2 else (-1 if k == 3 else 0)
            r = reach if k < 2 else max(int(reach * 0.70710678 + 0.5), 1)
            top = True
            for t in range(-r, r + 1):
                u = x + ux * t
                v = y + uy * t
                if t != 0 and 0 <= u < w and 0 <= v < h and best[v, u] > best[y, x]:
                    top = False
                    break
            thin[y, x] = top
    return thin


@dataclass(frozen=True)
class DepthEdges:
    """Evidence of the depth for an edge.

    Attributes:
        strength: [H W] float32, the greatest of step and crease over four directions, in standard
            deviations; 0 where the depth on a side is unknown.
        thin: [H W] bool, the crest lines of ``strength`` where it is over the threshold.
        sigma_step: what a standard deviation of the step is, in the depth's unit; likewise
            sigma_crease, unit per pixel.  One for axes, one for diagonals.
    """

    strength: F32
    thin: Bool
    sigma_step: tuple[float, float]
    sigma_crease: tuple[float, float]


def depth_edges(
    depth: np.ndarray,
    where: Bool | None = None,
    *,
    low: float = 6.0,
    near: float = 3.0,
    far: float = 10.0,
    reach: float = RIDGE_REACH,
) -> DepthEdges | None:
    """Steps and creases of a depth image.

    Args:
        depth: [H W] floating, any unit of length, NaN where unknown.
        where: [H W] bool, the pixels to look at; None looks at all.
        low: standard deviations under which a ridge is none.
        near, far: the pixels on either side, at 256², that a line is fitted to.  ``near`` leaves
            out what the sensor's window smears, in part: all of it would lose the small faces.
        reach: a ridge is the greatest within this many pixels, at 256².

    Returns:
        None where too little is known to measure the noise (under 64 pixels with both sides).
    """
    depth = np.ascontiguousarray(depth, np.float32)
    scale = max(image_scale(depth.shape), 1.0)
    a, b = max(int(round(near * scale)), 1), int(round(far * scale))
    known = np.isfinite(depth)
    if int(known.sum()) < 64:
        return None
    low_z, high_z = float(depth[known].min()), float(depth[known].max())
    unit = max(high_z - low_z, 1e-6 * abs(high_z), 1e-12) / _UNITS
    z = np.where(known, np.rint((depth - np.float64(low_z)) / unit), 0).astype(np.float32)
    # Beyond the border nothing is known, but half a line may be enough.
    z, there = (np.pad(part, b) for part in (z, known.astype(np.float32)))
    # A step often lies in a band that the sensor left unknown, so unknown pixels are asked too,
    # as far from known ones as the lines leave out.
    wanted = cv2.dilate(known.view(np.uint8), np.ones((2 * a + 1, 2 * a + 1), np.uint8)) > 0
    if where is not None:
        wanted &= where
    step, crease, step_var, crease_var = np.empty((4, 4, *depth.shape), np.float32)
    lines = np.empty((5, *z.shape), np.float32)
    bins = int(np.array([np.inf], np.float32).view(np.int32)[0] >> _FINE) + 1
    counts = np.zeros((2, 2, bins), np.int64)
    # Along a diagonal the same length takes fewer steps.
    near_d = max(int(a * np.sqrt(0.5) + 0.5), 1)
    far_d = max(int(b * np.sqrt(0.5) + 0.5), near_d + 3)
    for k, (ux, uy) in enumerate(((1, 0), (0, 1), (1, 1), (1, -1))):
        first, last = (a, b) if k < 2 else (near_d, far_d)
        value, slope, out_var, in_var, slope_var = lines
        samples, middle = last - first + 1, 0.5 * (first + last)
        _lines(z, there, ux, uy, samples, middle, value, slope, out_var, in_var, slope_var)
        length = np.float32(1 if k < 2 else np.sqrt(2))
        _compare(
            value, slope, out_var, in_var, slope_var, wanted, b, ux, uy, first, last, length,
            step[k], crease[k], step_var[k], crease_var[k],
            counts[0, k // 2], counts[1, k // 2],
        )  # fmt: skip
    if counts.sum(axis=2).min() < 64:
        return None
    # A third of |N(0,1)| lies under 0.43; low, because edges only make values greater.
    least = (1e-5 * float(np.median(np.abs(depth[known]))) + 1e-12) / unit
    sigmas = [[max(_third(c) / 0.4307, least) for c in pair] for pair in counts]
    ss = np.array([sigmas[0][0]] * 2 + [sigmas[0][1]] * 2, np.float32)
    sc = np.array([sigmas[1][0]] * 2 + [sigmas[1][1]] * 2, np.float32)
    best, way = _strongest(step, crease, step_var, crease_var, ss, sc, np.float32(_LOCAL))
    # Around an abrupt step the evidence is a plateau as wide as the lines leave out, with its noise
    # on top; cut off and averaged over that width it has one crest, in its middle.  Whole numbers
    # add up to the same whatever the order, so the crest turns with the image.
    whole = np.rint(np.minimum(best, np.float32(3 * low)) * 16).astype(np.float64)
    width = 2 * a - 1
    sums = cv2.boxFilter(
        whole, cv2.CV_64F, (width, width), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    level = (sums / (16.0 * width * width)).astype(np.float32)
    thin = _ridge(level, way, np.float32(0.5 * low), int(round(reach * scale)))
    thin &= best >= low
    in_depth = np.array(sigmas) * unit
    return DepthEdges(best, thin, tuple(in_depth[0].tolist()), tuple(in_depth[1].tolist()))

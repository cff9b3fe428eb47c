"""Hysteresis at a stack of thresholds, chosen from the lengths of the segments (paper, 4.1).

The gradient is made once.  The low threshold rises from its least value, the high one equal to it,
until few enough of the edge pixels lie in small segments; then the high threshold rises to the
operator's greatest, which gives images of high, medium and low *resolution* (detail).

One pass serves every step of that search.  The candidates are put in from the strongest to the
weakest, joined to their neighbours by union-find; each union moves the pixels of the two segments
between the counts "small" and "large".  After the last pixel of a level the two counts are those
of the image cut at that level: the whole curve costs one labelling, whatever the number of steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from .operators import Gradient

__all__ = [
    "EdgeStack",
    "NoiseModel",
    "build_stack",
    "image_scale",
    "noise_model",
    "segment_curve",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
I64 = NDArray[np.int64]
Bool = NDArray[np.bool_]


def image_scale(shape: tuple[int, int]) -> float:
    """How many times longer a length in this image is than in the paper's 256 by 256 one.

    The paper gives its lengths "when dealing with images of 256×256 resolution"; a line across an
    image grows with the square root of its area.
    """
    return float(np.sqrt(float(shape[0]) * float(shape[1])) / 256.0)


# -- noise --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class NoiseModel:
    """Standard deviation of one component of the gradient, over the grey level, of one image.

    Attributes:
        level: [B] float32, bin centres, grey levels.
        sigma: [B] float32, grey levels, never falling with the level.
    """

    level: F32
    sigma: F32

    def at(self, level: F32) -> F32:
        """Sigma at each grey level (the nearest bin below and above, linearly between)."""
        return _table(level, self.level[0], self.level[1] - self.level[0], self.sigma)


@njit(cache=True, nogil=True)
def _table(level, first, step, sigma):
    out = np.empty(level.shape, np.float32)
    last = sigma.size - 1
    inverse = np.float32(1) / step
    for i in range(level.shape[0]):
        for j in range(level.shape[1]):
            k = (level[i, j] - first) * inverse
            k = min(max(k, np.float32(0)), np.float32(last))
            b = min(int(k), last - 1)
            f = k - np.float32(b)
            out[i, j] = sigma[b] + f * (sigma[b + 1] - sigma[b])
    return out


_BINS = 16
_FINE = 256
_FINE_STEP = 1 / 16


@njit(cache=True, nogil=True)
def _magnitude_histograms(magnitude, bright, bins, fine, fine_step):
    counts = np.zeros((bins, fine + 1), np.int64)
    per_level = np.float32(bins / 256.0)
    per_step = np.float32(1.0 / fine_step)
    for i in range(magnitude.shape[0]):
        for j in range(magnitude.shape[1]):
            b = min(max(int(bright[i, j] * per_level), 0), bins - 1)
            counts[b, min(int(magnitude[i, j] * per_step), fine)] += 1
    return counts


def noise_model(
    gradient: Gradient, quantile: float = 0.2, least: float = 0.25, enough: int = 200
) -> NoiseModel:
    """Measure the gradient's noise from the image itself, apart for each grey level.

    Where the scene is smooth both components of the gradient are noise and the magnitude follows
    Rayleigh's law, so a low quantile q of it is sigma sqrt(-2 ln(1-q)): low, because edges and
    shading only make gradients greater.  A level that the scene shows only on edges still gives
    far too much.  Photon noise has a variance that rises in proportion to the level, over a
    constant of the electronics; so the variance is taken as the straight line through the least
    noisy level on which no measured level falls below the line.

    Args:
        gradient: of an image on the 8 bit scale.
        quantile: the quantile of the magnitude that is read.
        least: sigma never gets below this; 8 bit rounding alone leaves about a quarter level.
        enough: pixels that a bin must have to count, at 256².
    """
    counts = _magnitude_histograms(gradient.magnitude, gradient.bright, _BINS, _FINE, _FINE_STEP)
    cumulated = np.cumsum(counts, axis=1)
    totals = cumulated[:, -1]
    need = max(enough * image_scale(gradient.magnitude.shape) ** 2, 20)
    centres = (np.arange(_BINS) + 0.5) * (256.0 / _BINS)
    variance = np.full(_BINS, np.inf)
    rayleigh = np.sqrt(-2 * np.log(1 - quantile))
    # The brightest bin may be clipped, where noise is lost.
    for b in np.flatnonzero(totals[: _BINS - 1] >= need):
        target = quantile * totals[b]
        k = int(np.searchsorted(cumulated[b], target))
        before = cumulated[b, k - 1] if k else 0
        value = (k + (target - before) / max(counts[b, k], 1)) * _FINE_STEP / rayleigh
        if value > 0.5 * least:
            variance[b] = value * value
    measured = np.flatnonzero(np.isfinite(variance))
    if not measured.size:
        return NoiseModel(centres.astype(np.float32), np.full(_BINS, least, np.float32))
    base = measured[np.argmin(variance[measured])]
    brighter = measured[measured > base]
    slope = 0.0
    if brighter.size:
        rise = (variance[brighter] - variance[base]) / (centres[brighter] - centres[base])
        slope = float(rise.min())
    line = variance[base] + slope * np.maximum(centres - centres[base], 0)
    sigma = np.maximum(np.sqrt(line), least)
    return NoiseModel(centres.astype(np.float32), sigma.astype(np.float32))


# -- the curve of small against large segments ---------------------------------------------------


@njit(cache=True, nogil=True)
def _find(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, nogil=True)
def _sorted_by_level(strength, candidates, lowest, step, steps):
    """Candidates from the strongest level to the weakest (counting sort), and each level's count.

    ``strength`` is flat; candidates under ``lowest`` are left out.
    """
    counts = np.zeros(steps + 1, np.int64)
    inverse = np.float32(1) / step
    level = np.empty(candidates.size, np.int32)
    for i in range(candidates.size):
        s = strength[candidates[i]]
        k = -1
        if s >= lowest:
            k = min(int((s - lowest) * inverse), steps - 1)
            counts[k] += 1
        level[i] = k
    start = np.zeros(steps + 1, np.int64)
    total = 0
    for k in range(steps - 1, -1, -1):
        start[k] = total
        total += counts[k]
    order = np.empty(total, np.int64)
    for i in range(candidates.size):
        k = level[i]
        if k >= 0:
            order[start[k]] = candidates[i]
            start[k] += 1
    return order, counts[:steps]


@njit(cache=True, nogil=True)
def _curve(order, counts, h, w, small_size):
    """Pixels in small and in large segments at each level, by one descending union-find."""
    steps = counts.size
    small = np.zeros(steps, np.int64)
    large = np.zeros(steps, np.int64)
    # slot[p]: 1 + the candidate's rank; a border of one saves the bounds checks.
    slot = np.zeros((h + 2) * (w + 2), np.int32)
    n = order.size
    parent = np.empty(n, np.int32)
    size = np.ones(n, np.int32)
    around = np.array([-w - 3, -w - 2, -w - 1, -1, 1, w + 1, w + 2, w + 3])
    few = 0
    many = 0
    rank = 0
    for k in range(steps - 1, -1, -1):
        for _ in range(counts[k]):
            p = order[rank]
            q = (p // w + 1) * (w + 2) + p % w + 1
            parent[rank] = rank
            if small_size > 1:
                few += 1
            else:
                many += 1
            root = rank
            for d in around:
                other = slot[q + d]
                if other == 0:
                    continue
                r = _find(parent, np.int32(other - 1))
                if r == root:
                    continue
                for s in (size[r], size[root]):
                    if s < small_size:
                        few -= s
                    else:
                        many -= s
                if size[r] > size[root]:
                    r, root = root, r
                parent[r] = root
                size[root] += size[r]
                if size[root] < small_size:
                    few += size[root]
                else:
                    many += size[root]
            slot[q] = rank + 1
            rank += 1
        small[k] = few
        large[k] = many
    return small, large


def segment_curve(
    strength: F32, thin: Bool, lowest: float, step: float, steps: int, small_size: int
) -> tuple[I64, I64]:
    """Edge pixels in small and in large segments when the image is cut at each threshold.

    Args:
        strength: [H W] float32; thin: [H W] bool, the candidates.
        lowest, step, steps: the thresholds ``lowest + k * step``, k = 0 .. steps - 1.
        small_size: segments (8-connected) of fewer pixels are small.

    Returns:
        small, large: [steps] int64, pixel counts per threshold.
    """
    order, counts = _sorted_by_level(
        strength.reshape(-1), np.flatnonzero(thin), np.float32(lowest), np.float32(step), int(steps)
    )
    height, width = strength.shape
    return _curve(order, counts, height, width, int(small_size))


# -- hysteresis ----------------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _peaks(strength, candidates, low, peak):
    """Write to each candidate at or over ``low`` the greatest strength of its segment."""
    h, w = strength.shape
    # A border of one saves the bounds checks.
    v = w + 2
    open_ = np.zeros((h + 2) * v, np.bool_)
    for c in candidates:
        y = c // w
        if strength[y, c - y * w] >= low:
            open_[(y + 1) * v + c - y * w + 1] = True
    stack = np.empty(candidates.size, np.int32)
    around = np.array([-v - 1, -v, -v + 1, -1, 1, v - 1, v, v + 1])
    for c in candidates:
        p = (c // w + 1) * v + c % w + 1
        if not open_[p]:
            continue
        # The stack keeps its history, so the segment can be walked again to write the peak.
        stack[0] = p
        open_[p] = False
        top = 1
        done = 0
        best = np.float32(0)
        while done < top:
            q = stack[done]
            done += 1
            best = max(best, strength[q // v - 1, q % v - 1])
            for d in around:
                if open_[q + d]:
                    open_[q + d] = False
                    stack[top] = q + d
                    top += 1
        for i in range(top):
            peak[stack[i] // v - 1, stack[i] % v - 1] = best


@dataclass(frozen=True)
class EdgeStack:
    """The three images of the stack and how their thresholds were chosen.

    Attributes:
        edges_low, edges_medium, edges_high: [H W] bool; low resolution is the coarsest image and
            each contains the coarser one.
        strength: [H W] float32, what the thresholds were compared with.
        segment_peak: [H W] float32, the greatest strength of the segment that a candidate over the
            low threshold belongs to (what the high threshold was compared with), else 0.
        low_threshold: the common low threshold.
        high_thresholds: of the low, medium and high resolution images.
        thresholds, small_pixels, large_pixels, ratio: [steps], the curve of the search; the ratio
            is infinite where no large segment is left, NaN where no edge is.
        upheld: False where no threshold of the search kept the ratio under the preset value.
    """

    edges_low: Bool
    edges_medium: Bool
    edges_high: Bool
    strength: F32
    segment_peak: F32
    low_threshold: float
    high_thresholds: tuple[float, float, float]
    thresholds: F64
    small_pixels: I64
    large_pixels: I64
    ratio: F64
    upheld: bool

    def ratio_for_low(self, wanted: float) -> float:
        """The ``max_ratio`` that puts the low threshold at ``wanted``, or as near as it can lie.

        The low threshold is the first whose ratio is under ``max_ratio``: it can only lie where
        the ratio is less than everywhere before.
        """
        ratio = np.where(np.isnan(self.ratio), np.inf, self.ratio)
        before = np.concatenate([[np.inf], np.minimum.accumulate(ratio)[:-1]])
        places = np.flatnonzero(ratio < before)
        if not places.size:
            return float("inf")
        k = places[np.argmin(np.abs(self.thresholds[places] - wanted))]
        # Any value over this ratio and not over the least before it does; the middle is safest.
        return float(0.5 * (ratio[k] + before[k])) if np.isfinite(before[k]) else float("inf")


def build_stack(
    strength: F32,
    thin: Bool,
    *,
    lowest: float,
    greatest: float,
    steps: int = 128,
    max_ratio: float = 0.1,
    small_segment: float = 4.0,
) -> EdgeStack:
    """Choose the thresholds and cut the stack of three images (4.1).

    The low threshold is the least whose ratio (pixels in small segments / pixels in large ones) is
    under ``max_ratio``.  The paper does not say where between the low threshold and the greatest
    the medium image lies; the middle is taken.  If no threshold keeps the ratio, the one that comes
    nearest is taken (the paper's loop would end at the greatest and lose nearly everything); if
    there is no large segment at any, the greatest.

    Args:
        strength: [H W] float32, gradient in any unit; thin: [H W] bool, candidates.
        lowest, greatest: the range of the search, in the unit of ``strength``.
        steps: thresholds tried; they cost nothing, see the module.
        max_ratio: the preset value of the ratio.
        small_segment: segments under this many pixels at 256² are small; scaled with the image.

    Raises:
        ValueError: an empty range, fewer than 2 steps, or a ratio that is not positive.
    """
    if not greatest > lowest >= 0:
        raise ValueError(f"expected 0 <= lowest < greatest, got {lowest} and {greatest}")
    if steps < 2:
        raise ValueError(f"steps must be at least 2, got {steps}")
    if not max_ratio > 0:
        raise ValueError(f"max_ratio must be greater than 0, got {max_ratio}")
    small_size = max(int(round(small_segment * image_scale(strength.shape))), 2)
    # The last threshold is the greatest itself.
    step = (greatest - lowest) / (steps - 1)
    thresholds = (lowest + step * np.arange(steps)).astype(np.float64)
    small, large = segment_curve(strength, thin, lowest, step, steps, small_size)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = small / large
    good = np.flatnonzero(ratio < max_ratio)
    upheld = bool(good.size)
    if upheld:
        low = float(thresholds[good[0]])
    elif np.isfinite(ratio).any():
        low = float(thresholds[np.nanargmin(ratio)])
    else:
        low = float(thresholds[-1])
    highs = (float(greatest), 0.5 * (low + float(greatest)), low)
    peak = np.zeros(strength.shape, np.float32)
    _peaks(strength, np.flatnonzero(thin), np.float32(low), peak)
    coarse, medium, fine = (
        peak >= max(np.float32(high), np.finfo(np.float32).tiny) for high in highs
    )
    return EdgeStack(
        coarse, medium, fine, strength, peak, low, highs, thresholds, small, large, ratio, upheld
    )

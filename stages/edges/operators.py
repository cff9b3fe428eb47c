"""Edge operators behind one interface: image in, gradient and thin edge candidates out (4.1).

The paper needs one gradient, made once, that hysteresis then cuts at many thresholds.  An operator
is therefore a function from an image to :class:`Gradient`; :func:`register` adds another one.

Equivariance.  Turning the image by 90 degrees or mirroring it must turn or mirror the result, bit
for bit, or a tie would be decided by how the part lies on the table.  Every operator here is so
made: the x derivative is *derivative along x of (smoothing along y)* and the y derivative is the
same code on the transposed image; a forward and a backward recursion enter as a sum or a
difference; nothing depends on the order of a scan.  Non-maximum suppression breaks a tie by the
gradient's own sense (the brighter pixel wins), which turns with the image.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

__all__ = [
    "OPERATORS",
    "Gradient",
    "canny_gradient",
    "gef_gradient",
    "gradient_of",
    "grey_levels",
    "non_maximum_suppression",
    "register",
]

F32 = NDArray[np.float32]
Bool = NDArray[np.bool_]

ISEF_A0 = 0.45
"""The paper's smoothing of GEF (4.1): weight of the newest sample in Shen and Castan's filter."""

CANNY_SIGMA = 1.0
"""The paper's scale of Canny (4.1), in pixels."""


@dataclass(frozen=True)
class Gradient:
    """One gradient of one image: everything that thresholds and linking look at.

    Attributes:
        gx, gy: derivative to the right and down, [H W] float32, grey levels of 8 bit per edge
            (a step of h levels gives about h, whatever the operator).
        magnitude: sqrt(gx² + gy²), [H W] float32, grey levels; 0 where the image is unknown.
        thin: [H W] bool, the pixels that survive non-maximum suppression.
        bright: [H W] float32, mean grey level on the brighter side of the pixel: the level that
            sets the noise of the gradient there.
        greatest: the operator's greatest high threshold, grey levels (20 for GEF on 8 bit).
        levels: [H W] float32, the image itself on the scale of 8 bit, see :func:`grey_levels`.
    """

    gx: F32
    gy: F32
    magnitude: F32
    thin: Bool
    bright: F32
    greatest: float
    levels: F32


Operator = Callable[[F32], tuple[F32, F32, F32]]
"""An operator: a finite image [H W] float32 to gx, gy and the brighter side's level, [H W]."""


@dataclass(frozen=True)
class _Entry:
    function: Operator
    greatest: float


OPERATORS: dict[str, _Entry] = {}
"""The operators by name.  :func:`register` adds to it."""


def register(name: str, greatest: float) -> Callable[[Operator], Operator]:
    """Plug an operator in under ``name``; ``greatest`` is its greatest high threshold on 8 bit.

    Raises:
        ValueError: the name is taken.
    """

    def enter(function: Operator) -> Operator:
        if name in OPERATORS:
            raise ValueError(f"edge operator {name!r} is registered twice")
        OPERATORS[name] = _Entry(function, greatest)
        return function

    return enter


def grey_levels(image: np.ndarray, full_scale: float | None = None) -> tuple[F32, Bool | None]:
    """The image on the 8 bit scale of the paper's thresholds, and which pixels are unknown.

    Args:
        image: [H W], an integer or floating dtype or bool; NaN and infinity are unknown pixels.
        full_scale: the value that becomes 255.  Where it is not given: 255 for uint8 and for
            floating images, 1 for bool, and for wider integers the smallest of 8, 10, 12, 14, 16
            bits that holds the image, because a camera's 10 bits come in a 16 bit container.

    Returns:
        levels: [H W] float32, finite; an unknown pixel takes the value of its surroundings (the
            mean of the known ones, spread ring by ring), so that it raises no edge of its own.
        unknown: [H W] bool, or None where every pixel is known.

    Raises:
        ValueError: not two-dimensional, no pixels, not numbers, or not one known pixel.
    """
    image = np.asarray(image)
    if image.ndim != 2:
        raise ValueError(f"expected an image of axes [H W], got shape {image.shape}")
    if image.size == 0:
        raise ValueError(f"the image has no pixels (shape {image.shape})")
    if image.dtype.kind not in "buif":
        raise ValueError(f"expected an image of numbers, got dtype {image.dtype}")
    if full_scale is not None and not (np.isfinite(full_scale) and full_scale > 0):
        raise ValueError(f"full_scale must be positive, got {full_scale}")
    if full_scale is None:
        if image.dtype.kind == "b":
            full_scale = 1.0
        elif image.dtype.kind in "ui" and image.dtype.itemsize > 1:
            top = float(image.max())
            full_scale = next((s for s in (255.0, 1023.0, 4095.0, 16383.0) if top <= s), 65535.0)
        else:
            full_scale = 255.0
    levels = np.ascontiguousarray(image, dtype=np.float32)
    if full_scale != 255.0:
        levels = levels * np.float32(255.0 / full_scale)
    if image.dtype.kind != "f":
        return levels, None
    unknown = ~np.isfinite(levels)
    if not unknown.any():
        return levels, None
    if unknown.all():
        raise ValueError("the image has not one known pixel (all NaN)")
    return _fill_rings(levels, unknown), unknown


def _fill_rings(levels: F32, unknown: Bool) -> F32:
    """Fill unknown pixels from their known 8 neighbours, ring by ring inwards.

    Opposite neighbours are added in pairs first: float addition commutes but does not associate,
    and this grouping is the one that every turn and mirror of the image keeps.
    """
    values = np.where(unknown, np.float32(0), levels).astype(np.float64)
    known = (~unknown).astype(np.float64)
    while True:
        v, k = np.pad(values, 1), np.pad(known, 1)
        sums = []
        for a in (v, k):
            cross = (a[1:-1, :-2] + a[1:-1, 2:]) + (a[:-2, 1:-1] + a[2:, 1:-1])
            diagonal = (a[:-2, :-2] + a[2:, 2:]) + (a[:-2, 2:] + a[2:, :-2])
            sums.append(cross + diagonal)
        ring = (known == 0) & (sums[1] > 0)
        if not ring.any():
            return values.astype(np.float32)
        values[ring] = sums[0][ring] / sums[1][ring]
        known[ring] = 1


# -- GEF: the gradient exponential filter of Shen and Castan -----------------------------------


_BLOCK = 32
"""Lines filtered side by side.  A recursion waits for itself along a line, so the lines of a block
go abreast (one vector instruction each step); a block's buffers stay in the cache at 2048²."""


@njit(cache=True, nogil=True)
def _load(x, along_x, first, count, n, out):
    """Lines first.. of ``x`` (rows if ``along_x``, else columns) as the columns of ``out``."""
    if along_x:
        # In small tiles: one row at a time would miss the cache at every pixel.
        for i0 in range(0, n, 16):
            for b in range(count):
                for i in range(i0, min(i0 + 16, n)):
                    out[i, b] = x[first + b, i]
    else:
        for i in range(n):
            for b in range(count):
                out[i, b] = x[i, first + b]


@njit(cache=True, nogil=True)
def _store(lines, along_x, first, count, n, x):
    """The reverse of :func:`_load`."""
    if along_x:
        for i0 in range(0, n, 16):
            for b in range(count):
                for i in range(i0, min(i0 + 16, n)):
                    x[first + b, i] = lines[i, b]
    else:
        for i in range(n):
            for b in range(count):
                x[i, first + b] = lines[i, b]


@njit(cache=True, nogil=True)
def _one_sided_means(x, a0, count, n, forward, backward):
    """forward[i] = a0 x[i] + (1 - a0) forward[i-1], and backward likewise from the other end.

    Outside, a line goes on with its border's value, so both start there at that value.
    """
    b = np.float32(1) - a0
    for j in range(count):
        forward[0, j] = x[0, j]
        backward[n - 1, j] = x[n - 1, j]
    for i in range(1, n):
        for j in range(count):
            forward[i, j] = a0 * x[i, j] + b * forward[i - 1, j]
    for i in range(n - 2, -1, -1):
        for j in range(count):
            backward[i, j] = a0 * x[i, j] + b * backward[i + 1, j]


@njit(cache=True, nogil=True)
def _isef_smooth(image, a0, along_x, out):
    """Smooth along an axis with the ISEF a0/(2-a0) (1-a0)^|k|, exactly.

    The two one-sided means added count the pixel itself twice, hence minus a0 x.
    """
    n = image.shape[1] if along_x else image.shape[0]
    lines = image.shape[0] if along_x else image.shape[1]
    x = np.empty((n, _BLOCK), np.float32)
    forward = np.empty((n, _BLOCK), np.float32)
    backward = np.empty((n, _BLOCK), np.float32)
    gain = np.float32(1) / (np.float32(2) - a0)
    for first in range(0, lines, _BLOCK):
        count = min(_BLOCK, lines - first)
        _load(image, along_x, first, count, n, x)
        _one_sided_means(x, a0, count, n, forward, backward)
        for i in range(n):
            for j in range(count):
                x[i, j] = ((forward[i, j] + backward[i, j]) - a0 * x[i, j]) * gain
        _store(x, along_x, first, count, n, out)


@njit(cache=True, nogil=True)
def _isef_derive(image, a0, along_x, out, bright):
    """backward[i+1] - forward[i-1] along an axis: the ISEF derivative; and the brighter of both.

    The means of either side leave the pixel itself out, so a step of h between two pixels gives h
    at both of them.
    """
    n = image.shape[1] if along_x else image.shape[0]
    lines = image.shape[0] if along_x else image.shape[1]
    x = np.empty((n, _BLOCK), np.float32)
    forward = np.empty((n, _BLOCK), np.float32)
    backward = np.empty((n, _BLOCK), np.float32)
    level = np.empty((n, _BLOCK), np.float32)
    for first in range(0, lines, _BLOCK):
        count = min(_BLOCK, lines - first)
        _load(image, along_x, first, count, n, x)
        _one_sided_means(x, a0, count, n, forward, backward)
        for i in range(n):
            above = max(i - 1, 0)
            below = min(i + 1, n - 1)
            for j in range(count):
                x[i, j] = backward[below, j] - forward[above, j]
                level[i, j] = max(backward[below, j], forward[above, j])
        _store(x, along_x, first, count, n, out)
        _store(level, along_x, first, count, n, bright)


@njit(cache=True, nogil=True)
def _gef(image, a0, gx, gy, bright, smooth, other):
    shape = image.shape
    _isef_smooth(image, a0, False, smooth)
    _isef_derive(smooth, a0, True, gx, bright)
    _isef_smooth(image, a0, True, smooth)
    _isef_derive(smooth, a0, False, gy, other)
    for i in range(shape[0]):
        for j in range(shape[1]):
            bright[i, j] = max(bright[i, j], other[i, j])


def _buffers(shape: tuple[int, int], count: int) -> list[F32]:
    """Arrays for a compiled loop, made by numpy, which asks for huge pages where they are large."""
    return [np.empty(shape, np.float32) for _ in range(count)]


@register("gef", greatest=20.0)
def gef_gradient(image: F32, a0: float = ISEF_A0) -> tuple[F32, F32, F32]:
    """GEF, the gradient by exponential filters, in its exact recursive form.

    Shen and Castan (CVGIP 54, 1992): the infinite symmetric exponential filter smooths across the
    derivative, and the derivative is the difference of the one-sided exponential means on either
    side of the pixel.  ``a0`` is the weight of the newest sample; 0.45 is the paper's.

    Args:
        image: [H W] float32, finite, grey levels.
        a0: in (0, 1).

    Returns:
        gx, gy, bright: [H W] float32, grey levels (see :class:`Gradient`).
    """
    if not 0 < a0 < 1:
        raise ValueError(f"a0 must lie between 0 and 1, got {a0}")
    gx, gy, bright, smooth, other = _buffers(image.shape, 5)
    x = np.ascontiguousarray(image, np.float32)
    _gef(x, np.float32(a0), gx, gy, bright, smooth, other)
    return gx, gy, bright


# -- Canny: the derivative of a Gaussian -------------------------------------------------------


@njit(cache=True, nogil=True)
def _convolve(x, half, antisymmetric, along_x, out):
    """FIR along an axis, symmetric or antisymmetric, the border's value going on outside.

    ``half[k]`` weighs the pair at distance k, whose two samples are joined before they are
    weighed: that, and the same order of k on both axes, makes the sum the same for a mirrored or
    turned image.
    """
    h, w = x.shape
    reach = half.size - 1
    row = np.empty(w + 2 * reach, np.float32)
    for i in range(h):
        centre = np.float32(0) if antisymmetric else half[0]
        for j in range(w):
            out[i, j] = centre * x[i, j]
        if along_x:
            for j in range(reach):
                row[j] = x[i, 0]
                row[reach + w + j] = x[i, w - 1]
            for j in range(w):
                row[reach + j] = x[i, j]
            for k in range(1, reach + 1):
                a = row[reach - k : reach - k + w]
                b = row[reach + k : reach + k + w]
                weight = half[k]
                if antisymmetric:
                    for j in range(w):
                        out[i, j] += weight * (b[j] - a[j])
                else:
                    for j in range(w):
                        out[i, j] += weight * (b[j] + a[j])
        else:
            for k in range(1, reach + 1):
                below = min(i + k, h - 1)
                above = max(i - k, 0)
                weight = half[k]
                if antisymmetric:
                    for j in range(w):
                        out[i, j] += weight * (x[below, j] - x[above, j])
                else:
                    for j in range(w):
                        out[i, j] += weight * (x[below, j] + x[above, j])


@njit(cache=True, nogil=True)
def _gaussian_gradient(x, smooth, slope, gx, gy, bright, other):
    shape = x.shape
    _convolve(x, smooth, False, False, bright)
    _convolve(bright, slope, True, True, gx)
    _convolve(x, smooth, False, True, other)
    _convolve(other, slope, True, False, gy)
    for i in range(shape[0]):
        for j in range(shape[1]):
            bright[i, j] = np.float32(0.5) * (bright[i, j] + other[i, j])


@register("canny", greatest=20.0)
def canny_gradient(image: F32, sigma: float = CANNY_SIGMA) -> tuple[F32, F32, F32]:
    """Canny's gradient: a Gaussian smooths across, its derivative derives along.

    The derivative is scaled so that an ideal step of h grey levels gives h at its centre, which
    makes the thresholds of both operators mean the same contrast; the paper gives no greatest
    threshold for Canny, so GEF's is used.  The kernel reaches 4 sigma.

    Args:
        image: [H W] float32, finite, grey levels.
        sigma: pixels, greater than 0.

    Returns:
        gx, gy, bright: [H W] float32, grey levels (see :class:`Gradient`).
    """
    if not sigma > 0:
        raise ValueError(f"sigma must be greater than 0 px, got {sigma}")
    x = np.ascontiguousarray(image, np.float32)
    k = np.arange(int(4 * sigma + 0.5) + 1, dtype=np.float64)
    bell = np.exp(-0.5 * (k / sigma) ** 2)
    smooth = (bell / (bell[0] + 2 * bell[1:].sum())).astype(np.float32)
    slope = k * bell
    slope = (slope / max(slope.sum(), 1e-12)).astype(np.float32)
    gx, gy, bright, other = _buffers(x.shape, 4)
    _gaussian_gradient(x, smooth, slope, gx, gy, bright, other)
    # The brighter side is what the edge's own blur has left untouched, a sigma or so away.
    side = 2 * int(round(sigma)) + 1
    cv2.dilate(bright, np.ones((side, side), np.uint8), dst=other)
    return gx, gy, other


# -- non-maximum suppression -------------------------------------------------------------------


@njit(cache=True, nogil=True)
def _suppress(gx, gy, magnitude, floor, thin):
    h, w = magnitude.shape
    for y in range(h):
        for x in range(w):
            g = magnitude[y, x]
            if not g > floor:
                continue
            dx = gx[y, x]
            dy = gy[y, x]
            sx = 1 if dx >= 0 else -1
            sy = 1 if dy >= 0 else -1
            ax = abs(dx)
            ay = abs(dy)
            # Uphill (towards the bright side) and downhill samples, interpolated between the
            # side neighbour on the greater axis and the diagonal one.
            if ax >= ay:
                t = ay / ax
                ox, oy = sx, 0
            else:
                t = ax / ay
                ox, oy = 0, sy
            s = np.float32(1) - t
            a = b = np.float32(0)
            if 0 <= x + ox < w and 0 <= y + oy < h:
                a = s * magnitude[y + oy, x + ox]
            if 0 <= x + sx < w and 0 <= y + sy < h:
                a = a + t * magnitude[y + sy, x + sx]
            if a >= g:
                continue
            if 0 <= x - ox < w and 0 <= y - oy < h:
                b = s * magnitude[y - oy, x - ox]
            if 0 <= x - sx < w and 0 <= y - sy < h:
                b = b + t * magnitude[y - sy, x - sx]
            if b > g:
                continue
            thin[y, x] = True


def non_maximum_suppression(gx: F32, gy: F32, magnitude: F32, floor: float = 0.0) -> Bool:
    """The pixels whose magnitude is greatest along their gradient: edges one pixel thin.

    The two values to beat are interpolated at the distance of the next row, column or diagonal.
    A pixel must be greater than the brighter side's and not less than the darker side's: of two
    equal pixels, as an ideal step leaves them under GEF, the brighter stays, however the image
    is turned.

    Args:
        gx, gy, magnitude: [H W] float32.
        floor: pixels at or under it are not looked at; grey levels.

    Returns:
        [H W] bool.
    """
    thin = np.zeros(magnitude.shape, np.bool_)
    _suppress(gx, gy, magnitude, np.float32(floor), thin)
    return thin


@njit(cache=True, nogil=True)
def _magnitude(gx, gy, out):
    for i in range(gx.shape[0]):
        for j in range(gx.shape[1]):
            out[i, j] = np.sqrt(gx[i, j] * gx[i, j] + gy[i, j] * gy[i, j])


def gradient_of(
    image: np.ndarray,
    operator: str = "gef",
    full_scale: float | None = None,
    floor: float | None = 0.5,
) -> Gradient:
    """The gradient of an image by a named operator, with its thin edge candidates.

    Args:
        image: [H W], see :func:`grey_levels`.
        operator: a name in :data:`OPERATORS`.
        full_scale: the value that counts as 255, see :func:`grey_levels`.
        floor: gradients up to this many grey levels are no candidates; half a level is below
            what 8 bits can tell apart.  None leaves the candidates out (``thin`` is all False),
            for a caller that suppresses with a floor of its own.

    Raises:
        ValueError: an unknown operator, or an image that :func:`grey_levels` refuses.
    """
    if operator not in OPERATORS:
        names = ", ".join(sorted(OPERATORS))
        raise ValueError(f"unknown edge operator {operator!r}: expected one of {names}")
    entry = OPERATORS[operator]
    levels, unknown = grey_levels(image, full_scale)
    gx, gy, bright = entry.function(levels)
    (magnitude,) = _buffers(gx.shape, 1)
    _magnitude(gx, gy, magnitude)
    if unknown is not None:
        magnitude[unknown] = 0
    if floor is None:
        thin = np.zeros(magnitude.shape, np.bool_)
    else:
        thin = non_maximum_suppression(gx, gy, magnitude, floor)
    return Gradient(gx, gy, magnitude, thin, bright, entry.greatest, levels)

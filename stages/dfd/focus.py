"""The focus measure of section 3.1: energy behind a 5×5 Laplacian, over whole stripe periods.

The paper gives no coefficients and does not say how the response is pooled.  Chosen here:

* OpenCV's 5×5 Laplacian (sum of second Sobel derivatives), whose pass band lies lower and
  catches less pixel noise than the tight kernel; the tight one is kept as ``paper``.
* The root of the mean *squared* response.  Over a whole period of the stripes the mean square of
  a sinusoid does not ripple, and noise adds to it as its variance, which can be subtracted
  exactly; of the mean absolute response neither is true.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numba
import numpy as np

LaplacianKind = Literal["opencv", "paper"]

PAPER_KERNEL = (
    np.array(
        [
            [0, 0, -1, 0, 0],
            [0, -1, -2, -1, 0],
            [-1, -2, 16, -2, -1],
            [0, -1, -2, -1, 0],
            [0, 0, -1, 0, 0],
        ],
        np.float32,
    )
    / 16
)
_OPENCV_SCALE = 1 / 128


@dataclass(frozen=True)
class SensorNoise:
    """Temporal noise of a pixel: variance = ``read_variance`` + ``gain`` × grey level.

    In grey levels squared, and grey levels; the second term is shot noise.
    """

    read_variance: float = 1 / 12
    gain: float = 0.0


def laplacian(image: np.ndarray, kind: LaplacianKind) -> np.ndarray:
    """The 5×5 Laplacian of ``image`` [H W], float32 [H W], in grey levels."""
    values = image.astype(np.float32, copy=False)
    if kind == "opencv":
        return cv2.Laplacian(
            values, cv2.CV_32F, ksize=5, scale=_OPENCV_SCALE, borderType=cv2.BORDER_REFLECT_101
        )
    return cv2.filter2D(values, cv2.CV_32F, PAPER_KERNEL, borderType=cv2.BORDER_REFLECT_101)


@cache
def noise_gain(kind: LaplacianKind) -> float:
    """Variance of the Laplacian's response to white noise of variance 1."""
    impulse = np.zeros((11, 11), np.float32)
    impulse[5, 5] = 1
    return float((laplacian(impulse, kind) ** 2).sum())


def focus_map(
    image: np.ndarray,
    x_taps: np.ndarray,
    y_taps: np.ndarray,
    kind: LaplacianKind = "opencv",
    noise: SensorNoise | None = None,
) -> np.ndarray:
    """Root mean square Laplacian response of ``image`` [H W] over a window, float32 [H W].

    ``x_taps`` and ``y_taps`` are the window (:func:`dfd.stripes.whole_period_taps`).  The
    energy that ``noise`` explains is subtracted before the root; what falls below it is 0.
    """
    values = image.astype(np.float32, copy=False)
    gain = noise_gain(kind) if noise is not None else 0.0
    noise = noise or SensorNoise()
    return _focus_map(
        np.ascontiguousarray(values),
        # OpenCV's kernel is computed on the way, row by row; another one beforehand.
        laplacian(values, kind) if kind != "opencv" else np.empty((0, 0), np.float32),
        _in_groups(x_taps),
        _in_groups(y_taps),
        x_taps.size // 2,
        y_taps.size // 2,
        np.float32(gain * noise.read_variance),
        np.float32(gain * noise.gain),
    )


# -- the same, compiled: rows stream through, so that an image of any size stays in the cache ------
#
# Loops over pixels index with unsigned integers: a negative index would count from the end, and
# the choice between the two would keep LLVM from making SIMD of them.

_GROUP = 5
"""Taps of a window that one pass over a row takes at once."""

_ZERO = np.float32(0)
_TWO = np.float32(2)
_FOUR = np.float32(4)
_rows = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})


def _in_groups(taps: np.ndarray) -> np.ndarray:
    """``taps`` and zeros, to a whole number of groups."""
    padded = np.zeros(-(-taps.size // _GROUP) * _GROUP, np.float32)
    padded[: taps.size] = taps
    return padded


@_rows
def _focus_map(values, response, x_taps, y_taps, x_half, y_half, floor, gain):  # type: ignore[no-untyped-def]
    """√ of the window's mean of response² - floor - gain · values, or 0 below 0.

    Rows of energy are kept in a ring, row y at ``y % ring``, until the window has passed them.
    """
    height, width = values.shape
    out = np.empty((height, width), np.float32)
    ring = 2 * y_half + 1
    energy = np.empty((ring, width), np.float32)
    wide = np.zeros(width + 4, np.float32)
    narrow = np.zeros(width + 4, np.float32)
    column = np.zeros(width + x_taps.size + 2 * x_half, np.float32)
    mean = np.empty(width, np.float32)
    rows = np.zeros(_GROUP, np.uintp)
    for newest in range(height + y_half):
        y = newest
        if y < height:
            at = np.uintp(y % ring)
            if response.size == 0:
                for k in range(_GROUP):
                    rows[k] = mirrored(y + k - 2, height)
                _binomials_row(wide, narrow, values, rows[0], rows[1], rows[2], rows[3], rows[4])
                mirror_ends(wide, width, 2)
                mirror_ends(narrow, width, 2)
                _laplacian_row(energy, at, wide, narrow)
            else:
                energy[y % ring] = response[y]
            _energy_row(energy, at, values, np.uintp(y), floor, gain)
        y = newest - y_half
        if y >= 0:
            column[:] = _ZERO
            for first in range(0, y_taps.size, _GROUP):
                for k in range(_GROUP):
                    tap = min(first + k, ring - 1)
                    rows[k] = mirrored(y + tap - y_half, height) % ring
                w = y_taps[first : first + _GROUP]
                _down_row(
                    column, np.uintp(x_half), energy, rows[0], rows[1], rows[2], rows[3], rows[4],
                    w[0], w[1], w[2], w[3], w[4],
                )  # fmt: skip
            mirror_ends(column[: width + 2 * x_half], width, x_half)
            mean[:] = _ZERO
            for first in range(0, x_taps.size, _GROUP):
                w = x_taps[first : first + _GROUP]
                _along_row(mean, column, np.uintp(first), w[0], w[1], w[2], w[3], w[4])
            _root_row(out, np.uintp(y), mean)
    return out


@_rows
def _binomials_row(wide, narrow, values, r0, r1, r2, r3, r4):  # type: ignore[no-untyped-def]
    """Down the columns, weights 1 2 2 2 1 and 1 2 1 (see :func:`_laplacian_row`)."""
    for x in range(np.uintp(values.shape[1])):
        beside = values[r1, x] + values[r3, x]
        middle = values[r2, x]
        wide[x + np.uintp(2)] = values[r0, x] + values[r4, x] + _TWO * (beside + middle)
        narrow[x + np.uintp(2)] = beside + _TWO * middle


@_rows
def _laplacian_row(response, at, wide, narrow):  # type: ignore[no-untyped-def]
    """OpenCV's 5×5 Laplacian from the two sums down the columns.

    (1 0 -2 0 1) × (1 4 6 4 1) and its transpose add up to 2 (1 2 2 2 1)² - 8 (0 1 2 1 0)², each
    square the product of a column and a row: two separable passes less.
    """
    scale = np.float32(2 * _OPENCV_SCALE)
    a, b, c, d = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    for x in range(np.uintp(response.shape[1])):
        beside = wide[x + a] + wide[x + c]
        broad = wide[x] + wide[x + d] + _TWO * (beside + wide[x + b])
        peak = narrow[x + a] + narrow[x + c] + _TWO * narrow[x + b]
        response[at, x] = scale * (broad - _FOUR * peak)


@_rows
def _energy_row(energy, at, values, y, floor, gain):  # type: ignore[no-untyped-def]
    """In place: the response squared, less what noise would give."""
    for x in range(np.uintp(energy.shape[1])):
        energy[at, x] = energy[at, x] * energy[at, x] - (floor + gain * values[y, x])


@_rows
def _down_row(column, start, energy, r0, r1, r2, r3, r4, w0, w1, w2, w3, w4):  # type: ignore[no-untyped-def]
    """Add five weighted rows to the columns' sums."""
    for x in range(np.uintp(energy.shape[1])):
        column[x + start] += (
            w0 * energy[r0, x]
            + w1 * energy[r1, x]
            + w2 * energy[r2, x]
            + w3 * energy[r3, x]
            + w4 * energy[r4, x]
        )


@_rows
def _along_row(mean, column, first, w0, w1, w2, w3, w4):  # type: ignore[no-untyped-def]
    """Add five weighted columns' sums, from the ``first`` of the window, to its mean."""
    a, b, c, d = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4)
    for x in range(np.uintp(mean.shape[0])):
        i = x + first
        mean[x] += (
            w0 * column[i]
            + w1 * column[i + a]
            + w2 * column[i + b]
            + w3 * column[i + c]
            + w4 * column[i + d]
        )


@_rows
def _root_row(out, y, mean):  # type: ignore[no-untyped-def]
    for x in range(np.uintp(out.shape[1])):
        out[y, x] = np.sqrt(max(mean[x], _ZERO))


@numba.njit(cache=True)
def mirrored(index, size):  # type: ignore[no-untyped-def]
    """The index in 0..size-1 that reflection at both ends (REFLECT_101) leads to."""
    if size == 1:
        return 0
    while index < 0 or index >= size:
        index = -index if index < 0 else 2 * size - 2 - index
    return index


@numba.njit(cache=True)
def mirror_ends(row, width, margin):  # type: ignore[no-untyped-def]
    """Fill ``margin`` elements on either side of ``width`` values by reflection."""
    for k in range(1, margin + 1):
        row[margin - k] = row[margin + mirrored(-k, width)]
        row[margin + width - 1 + k] = row[margin + mirrored(width - 1 + k, width)]

"""The projected stripes: their period and direction, measured from an image.

Every window of the sensor must span a whole number of stripe periods, or the stripes' own ripple
leaks into the focus measure, so the period is measured and never assumed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

_LONGEST_PERIOD_SHARE = 1 / 12
_SHORTEST_PERIOD_PX = 2.2
_PEAK_SHARE = 0.25
_PEAK_HALF_WIDTH = 3


@dataclass(frozen=True)
class Stripes:
    """A periodic pattern in the image plane.

    ``period_px`` is measured along ``angle_deg``, the direction *across* the stripes: 0 for
    upright stripes, counter-clockwise as displayed, in (-90, 90].  ``strength`` is the share of
    the image's alternating power that lies in the fundamental peak.
    """

    period_px: float
    angle_deg: float
    strength: float

    @property
    def upright(self) -> bool:
        """Whether the stripes are nearer to vertical than to horizontal."""
        return abs(self.angle_deg) <= 45

    def extent_px(self) -> float:
        """One period measured along x for upright stripes, along y for the others.

        A separable window whose side on that axis is a whole multiple of this integrates the
        stripes out whatever its other side is, also where the stripes are oblique.
        """
        angle = math.radians(self.angle_deg)
        return self.period_px / max(abs(math.cos(angle)), abs(math.sin(angle)))


def measure_stripes(image: np.ndarray) -> Stripes | None:
    """The stripes of ``image`` [H W], or None where no periodic pattern stands out.

    The image less its local mean is windowed (Hann) and transformed; the strongest peak between
    a period of 2.2 pixels and a twelfth of the image is refined by fitting a parabola to the
    logarithm of its power along each axis, which is exact for a Gaussian-like window's peak.
    It counts as stripes if it is a true maximum, not the foot of something slower, and holds
    with its neighbours at least a quarter of the power in that band: natural texture spreads over
    the spectrum and grows towards low frequencies, a grating does neither.
    """
    height, width = image.shape
    if min(height, width) < 16:
        return None
    values = np.nan_to_num(image.astype(np.float32))
    # Divide out the shading, so that bright surfaces do not drown the stripes on dark ones.
    local = cv2.blur(values, (_odd(width / 12), _odd(height / 12)))
    flat = values / np.maximum(local, 1e-3 * max(float(values.max()), 1e-6)) - 1
    window = np.outer(np.hanning(height), np.hanning(width)).astype(np.float32)
    power = np.abs(np.fft.rfft2(flat * window)) ** 2
    fy = np.fft.fftfreq(height)[:, None]
    fx = np.fft.rfftfreq(width)[None, :]
    frequency = np.hypot(fx, fy)
    lowest = 1 / (min(height, width) * _LONGEST_PERIOD_SHARE)
    allowed = (frequency >= lowest) & (frequency <= 1 / _SHORTEST_PERIOD_PX)
    # Half of the plane stands for all of it: every column but the first and, of an even width, the
    # last holds its mirror image as well.
    weight = np.full(fx.shape, 2.0)
    weight[0, 0] = 1
    weight[0, -1] = 2 if width % 2 else 1
    total = float((weight * power)[allowed].sum())
    if total <= 0 or not math.isfinite(total):
        return None
    row, column = np.unravel_index(np.argmax(np.where(allowed, power, 0)), power.shape)
    near_peak, near_mirror = (
        (np.abs(fx - sign * fx[0, column]) * width <= _PEAK_HALF_WIDTH)
        & (np.abs((fy - sign * fy[row, 0] + 0.5) % 1 - 0.5) * height <= _PEAK_HALF_WIDTH)
        for sign in (1, -1)
    )
    strength = float((weight * power)[(near_peak | near_mirror) & allowed].sum()) / total
    if strength < _PEAK_SHARE or power[near_peak].max() > power[row, column]:
        return None
    along_y = np.log(power[[row - 1, row, (row + 1) % height], column] + 1e-30)
    # Left of column 0 lie the negative frequencies, which a real image mirrors through zero.
    left = power[row, column - 1] if column else power[-row % height, 1]
    right = power[row, min(column + 1, power.shape[1] - 1)]
    along_x = np.log(np.array([left, power[row, column], right]) + 1e-30)
    fy_peak = float(fy[row, 0]) + _vertex(along_y) / height
    fx_peak = float(fx[0, column]) + _vertex(along_x) / width
    # y points down in the image and up in the angle's convention.
    angle = math.degrees(math.atan2(-fy_peak, fx_peak))
    angle = (angle + 90) % 180 - 90
    if angle == -90:
        angle = 90.0
    return Stripes(1 / math.hypot(fx_peak, fy_peak), angle, strength)


def whole_period_taps(width_px: float) -> np.ndarray:
    """Weights (sum 1, odd length) of a centred box of a width that need not be an integer.

    The outermost two taps carry the fraction, so that the window spans exactly ``width_px``.
    """
    if width_px < 1:
        raise ValueError(f"a window needs at least 1 px, got {width_px}")
    half = math.ceil((width_px - 1) / 2)
    taps = np.ones(2 * half + 1)
    if half:
        taps[[0, -1]] = (width_px - (2 * half - 1)) / 2
    return (taps / width_px).astype(np.float32)


def average_over_period(image: np.ndarray, stripes: Stripes | None) -> np.ndarray:
    """``image`` [H W] averaged over exactly one period across the stripes, as float32.

    Along the stripes nothing is averaged, to keep what sharpness there is.
    """
    values = image.astype(np.float32, copy=False)
    if stripes is None:
        return values
    extent = stripes.extent_px()
    across = whole_period_taps(min(extent, values.shape[1 if stripes.upright else 0]))
    reach = len(across) // 2
    axis = 1 if stripes.upright else 0
    wide = np.take(values, _continued(values.shape[axis], reach, max(1, round(extent))), axis)
    kernel = across[None] if stripes.upright else across[:, None]
    inner = [slice(None)] * 2
    inner[axis] = slice(reach, reach + values.shape[axis])
    return np.ascontiguousarray(cv2.filter2D(wide, cv2.CV_32F, kernel)[tuple(inner)])


def _continued(size: int, reach: int, period: int) -> np.ndarray:
    """Indices -reach … size + reach, those outside taken whole periods further in.

    A mirror image would break the stripes' beat and leave a line along the border.
    """
    index = np.arange(-reach, size + reach)
    index = np.where(index < 0, index + period * (-(index // period)), index)
    over = np.maximum(0, index - (size - 1))
    index = index - period * -(-over // period)
    return np.clip(index, 0, size - 1)


def _odd(value: float) -> int:
    return max(3, int(value) | 1)


def _vertex(three: np.ndarray) -> float:
    """Where the parabola through three equidistant values has its top, from the middle one."""
    a, b, c = (float(v) for v in three)
    curvature = a - 2 * b + c
    return 0.0 if curvature >= 0 else float(np.clip(0.5 * (a - c) / curvature, -0.5, 0.5))

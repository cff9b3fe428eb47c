"""From two focus maps to depth and confidence (sections 3.1 and 3.2), with windows that stop.

The measure is the ratio Q = (near - far) / (near + far): bounded, free of albedo and exposure.
A calibrated curve takes Q to the *relative depth* t, which is 0 at the near end of the working
range, 1 at its far end, and linear in dioptres (1/z) between them.  Two facts follow that the
rest builds on: for a Gaussian blur Q is nearly linear in t, and a plane in space is exactly
linear in t over the image, whatever its tilt.

**Windows that stop at depth edges.**  A window across a depth edge mixes two surfaces, and the
blur itself mixes them over a few pixels more.  So each pixel hears, besides its own window,
eight neighbours about one stripe period away.  Each speaks for the pixel by extrapolating its
own local plane, and is heard by a weight that falls steeply with

* how much its surroundings depart from a plane (a window on an edge does),
* how far the local modulation is from what the calibration has at that depth (mixed pixels,
  shadow rims and defocus beyond the working range are),
* the predicted noise, the difference in brightness to the pixel, and the distance.

Inside a face all nine agree; at an edge the ones that look inward from the pixel's own side win.
The same terms, which are all in percent of the working range, make the predicted error, and from
it the confidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from stages.dfd.focus import LaplacianKind, SensorNoise, noise_gain

NOMINAL_CURVE = np.array([0.5, -0.5], np.float32).reshape(2, 1, 1)
"""Relative depth from Q where there is no calibration: t = (1 - Q) / 2."""

_BAND_ROWS = 128
_SAFE = np.float32(1e-6)

# What the terms of the predicted error weigh.  They are dimensionless, and were chosen once on
# ray-traced piles so that the predicted error ranks the true one; nothing depends on a rig.
_SCATTER_WEIGHT = 0.5
_MODULATION_WEIGHT = 8.0
_NOISE_WEIGHT = 1.0
_MOVED_WEIGHT = 0.5
_DISTANCE_WEIGHT = 0.5
_CONTRAST_WEIGHT = 0.01
_RELATIVE_CONTRAST = 0.02
_COST_FLOOR = 0.1
_EDGE_WEIGHT = 8.0


@dataclass(frozen=True)
class Windows:
    """The window sides in pixels, all derived from the stripe period (see :func:`windows_for`)."""

    x_taps: np.ndarray
    y_taps: np.ndarray
    scatter_px: int
    slope_px: int
    reach_px: int
    samples: float
    """Independent samples of the Laplacian in one window, for the predicted noise."""

    @property
    def halo_px(self) -> int:
        """How far away a pixel's result may depend on the focus maps."""
        own = len(self.x_taps) // 2 + self.slope_px + self.scatter_px // 2
        return own + self.reach_px


def windows_for(period_px: float, smoothing_periods: float, reach_periods: float) -> Windows:
    """Windows scaled to the stripe period (or, without stripes, to the focus window)."""
    side = max(1, int(period_px * smoothing_periods) | 1)
    taps = np.full(side, 1 / side, np.float32)
    # The Laplacian's response is correlated over about two pixels each way.
    samples = max(1.0, (period_px * max(1.0, smoothing_periods)) ** 2 / 4)
    return Windows(
        taps,
        taps,
        scatter_px=max(3, int(1.4 * period_px) | 1),
        slope_px=max(1, round(0.6 * period_px)),
        reach_px=max(1, round(reach_periods * period_px)),
        samples=samples,
    )


@dataclass(frozen=True)
class Response:
    """What the calibration knows of the sensor, as the estimator needs it.

    ``curve`` holds the coefficients of t(Q), lowest power first, [K H W] or [K 1 1];
    ``modulation`` those of (focus_near + focus_far) / (near + far) over t, [M] or None.
    """

    curve: np.ndarray
    modulation: np.ndarray | None
    slope: float
    noise: SensorNoise
    kind: LaplacianKind


def estimate(
    focus_near: np.ndarray,
    focus_far: np.ndarray,
    brightness: np.ndarray,
    guide: np.ndarray,
    response: Response,
    windows: Windows,
    edge_aware: bool = True,
) -> tuple[np.ndarray, np.ndarray]:
    """Relative depth and predicted error in percent of the working range, float32 [H W] each.

    ``focus_near`` and ``focus_far`` are focus maps over one stripe period, ``brightness`` is the
    sum of near and far over the same window, ``guide`` an image without stripes whose contrasts
    tell surfaces apart; all float32 [H W].  Where there is no energy at all the error is
    infinite and the relative depth is 0.5.

    The image is worked through in bands of rows with a halo, so that a large one stays in the
    processor's cache; the result does not depend on the bands.
    """
    height, width = focus_near.shape
    depth = np.empty((height, width), np.float32)
    error = np.empty((height, width), np.float32)
    halo = windows.halo_px
    rows = max(_BAND_ROWS, (1 << 15) // width)
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        first, last = max(0, top - halo), min(height, bottom + halo)
        band = slice(first, last)
        curve = response.curve if response.curve.shape[1] == 1 else response.curve[:, band]
        band_depth, band_error = _estimate_band(
            focus_near[band],
            focus_far[band],
            brightness[band],
            guide[band],
            curve,
            response,
            windows,
            edge_aware,
        )
        inner = slice(top - first, bottom - first)
        depth[top:bottom] = band_depth[inner]
        error[top:bottom] = band_error[inner]
    return depth, error


def _estimate_band(
    focus_near: np.ndarray,
    focus_far: np.ndarray,
    brightness: np.ndarray,
    guide: np.ndarray,
    curve: np.ndarray,
    response: Response,
    windows: Windows,
    edge_aware: bool,
) -> tuple[np.ndarray, np.ndarray]:
    def smooth(image: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(
            image,
            cv2.CV_32F,
            windows.x_taps,
            windows.y_taps,
            borderType=cv2.BORDER_REFLECT_101,
        )

    light = smooth(brightness)
    variance = noise_gain(response.kind) / windows.samples
    modulation = response.modulation
    fine, coarse, trouble = _ratios_to_depths(
        focus_near,
        focus_far,
        smooth(focus_near * focus_near),
        smooth(focus_far * focus_far),
        light,
        np.ascontiguousarray(curve),
        np.zeros(0, np.float32) if modulation is None else modulation.astype(np.float32),
        np.float32(variance * response.noise.read_variance),
        np.float32(variance * response.noise.gain),
        np.float32(response.slope * 100 * _NOISE_WEIGHT),
        np.float32(_MODULATION_WEIGHT),
    )
    side = (windows.scatter_px, windows.scatter_px)
    mean = cv2.blur(fine, side, borderType=cv2.BORDER_REFLECT_101)
    square = cv2.sqrBoxFilter(
        fine, cv2.CV_32F, side, normalize=True, borderType=cv2.BORDER_REFLECT_101
    )
    slope_x, slope_y = _slopes(coarse, windows.slope_px)
    guide_mean = cv2.blur(guide, side, borderType=cv2.BORDER_REFLECT_101)
    guide_square = cv2.sqrBoxFilter(
        guide, cv2.CV_32F, side, normalize=True, borderType=cv2.BORDER_REFLECT_101
    )
    cost, scatter = _window_costs(
        mean, square, slope_x, slope_y, trouble, guide_mean, guide_square, windows.scatter_px
    )
    if not edge_aware:
        return coarse, np.sqrt(_SCATTER_WEIGHT**2 * scatter + cost)
    return _hear_neighbours(
        coarse,
        slope_x,
        slope_y,
        cost,
        scatter,
        trouble,
        guide,
        _neighbours(windows.reach_px),
        np.float32(response.noise.read_variance),
        np.float32(response.noise.gain),
    )


def _neighbours(reach_px: int) -> np.ndarray:
    """The pixel itself and eight neighbours (dx, dy) at about ``reach_px``, int64 [9 2]."""
    near = round(0.75 * reach_px)
    straight = [(reach_px, 0), (-reach_px, 0), (0, reach_px), (0, -reach_px)]
    oblique = [(near, near), (near, -near), (-near, near), (-near, -near)]
    return np.array([(0, 0), *straight, *oblique])


@numba.njit(cache=True, error_model="numpy")
def _ratios_to_depths(  # type: ignore[no-untyped-def]
    near,
    far,
    near_energy,
    far_energy,
    light,
    curve,
    modulation,
    read_variance,
    gain,
    noise_weight,
    modulation_weight,
):
    """Relative depth over one window (fine) and over the smoothed one (coarse), and its troubles.

    ``trouble`` is what noise and odd modulation add to the squared predicted error, percent².
    """
    height, width = near.shape
    terms = curve.shape[0]
    local = curve.shape[1] > 1
    fine = np.empty((height, width), np.float32)
    coarse = np.empty((height, width), np.float32)
    trouble = np.empty((height, width), np.float32)
    half = np.float32(0.5)
    for y in range(height):
        row = y if local else 0
        for x in range(width):
            column = x if local else 0
            a = near[y, x]
            b = far[y, x]
            c = np.sqrt(near_energy[y, x])
            d = np.sqrt(far_energy[y, x])
            fine_sum = a + b
            sum_ = c + d
            q_fine = (a - b) / (fine_sum + _SAFE)
            q = (c - d) / (sum_ + _SAFE)
            t_fine = curve[terms - 1, row, column]
            t = t_fine
            for k in range(terms - 2, -1, -1):
                coefficient = curve[k, row, column]
                t_fine = t_fine * q_fine + coefficient
                t = t * q + coefficient
            fine[y, x] = t_fine if fine_sum > 0 else half
            coarse[y, x] = t if sum_ > 0 else half
            grey = half * light[y, x]
            variance = read_variance + gain * grey
            # The variance of a root-mean-square grows where noise rivals the signal.
            near_variance = variance * (1 + half * variance / (c * c + _SAFE))
            far_variance = variance * (1 + half * variance / (d * d + _SAFE))
            squared = sum_ * sum_
            noise = (
                4
                * noise_weight
                * noise_weight
                * (d * d * near_variance + c * c * far_variance)
                / (squared * squared + _SAFE * _SAFE)
            )
            odd = np.float32(0)
            if modulation.shape[0] > 0:
                inside = min(max(t, np.float32(0)), np.float32(1))
                expected = modulation[modulation.shape[0] - 1]
                for k in range(modulation.shape[0] - 2, -1, -1):
                    expected = expected * inside + modulation[k]
                shown = sum_ / (light[y, x] + _SAFE)
                # The relative difference of two amounts, symmetric and bounded by ±2: near
                # its zero it is the logarithm of their ratio, at a fraction of the cost.
                odd = 2 * modulation_weight * (shown - expected) / (shown + expected + _SAFE)
            trouble[y, x] = noise + odd * odd if sum_ > 0 else np.float32(np.inf)
    return fine, coarse, trouble


@numba.njit(cache=True)
def _slopes(values, step):  # type: ignore[no-untyped-def]
    """Central differences over ±step pixels (one-sided at the border), per pixel."""
    height, width = values.shape
    slope_x = np.empty((height, width), np.float32)
    slope_y = np.empty((height, width), np.float32)
    for y in range(height):
        above = max(0, y - step)
        below = min(height - 1, y + step)
        over = np.float32(1) / np.float32(max(1, below - above))
        for x in range(width):
            slope_y[y, x] = (values[below, x] - values[above, x]) * over
        inner = np.float32(1) / np.float32(2 * step)
        for x in range(step, width - step):
            slope_x[y, x] = (values[y, x + step] - values[y, x - step]) * inner
        for x in range(min(step, width)):
            right = min(width - 1, x + step)
            slope_x[y, x] = (values[y, right] - values[y, 0]) / max(1, right)
        for x in range(max(step, width - step), width):
            left = max(0, x - step)
            slope_x[y, x] = (values[y, width - 1] - values[y, left]) / max(1, width - 1 - left)
    return slope_x, slope_y


@numba.njit(cache=True)
def _window_costs(  # type: ignore[no-untyped-def]
    mean, square, slope_x, slope_y, trouble, guide_mean, guide_square, side
):
    """Squared error of a window, percent²: scatter about a plane, contrasts, and troubles.

    Also returns the whole scatter (tilt included): where the surface is steep, all that depends
    on where exactly a pixel looks is worth less.
    """
    height, width = mean.shape
    cost = np.empty((height, width), np.float32)
    scatter = np.empty((height, width), np.float32)
    percent = np.float32(100 * 100)
    moment = np.float32((side * side - 1) / 12)
    zero = np.float32(0)
    one = np.float32(1)
    edge = np.float32(_EDGE_WEIGHT)
    for y in range(height):
        for x in range(width):
            variance = max(square[y, x] - mean[y, x] * mean[y, x], zero)
            plane = (slope_x[y, x] * slope_x[y, x] + slope_y[y, x] * slope_y[y, x]) * moment
            scatter[y, x] = percent * variance
            grey = guide_mean[y, x] * guide_mean[y, x]
            contrast = max(guide_square[y, x] - grey, zero) / (grey + one)
            cost[y, x] = percent * max(variance - plane, zero) + trouble[y, x] + edge * contrast
    return cost, scatter


@numba.njit(cache=True, error_model="numpy")
def _hear_neighbours(  # type: ignore[no-untyped-def]
    depth, slope_x, slope_y, cost, scatter, trouble, guide, offsets, read_variance, gain
):
    """Each pixel's own window and its neighbours', extrapolated and weighed (module docstring)."""
    height, width = depth.shape
    out = np.empty((height, width), np.float32)
    error = np.empty((height, width), np.float32)
    value_sum = np.empty(width, np.float32)
    weight_sum = np.empty(width, np.float32)
    cost_sum = np.empty(width, np.float32)
    sharpness = np.empty(width, np.float32)
    one = np.float32(1)
    floor = np.float32(_COST_FLOOR)
    contrast = np.float32(_CONTRAST_WEIGHT)
    reach = max(one, np.float32(offsets[1, 0]))
    for y in range(height):
        for x in range(width):
            grey = max(guide[y, x], np.float32(0))
            sigma = np.sqrt(read_variance + gain * grey) + np.float32(_RELATIVE_CONTRAST) * grey
            sharpness[x] = contrast / (sigma * sigma + _SAFE)
            value_sum[x] = 0
            weight_sum[x] = 0
            cost_sum[x] = 0
        for n in range(offsets.shape[0]):
            dx = offsets[n, 0]
            dy = offsets[n, 1]
            source = y + dy
            if source < 0 or source >= height:
                continue
            far_x = np.float32(dx)
            far_y = np.float32(dy)
            distance = np.float32(_DISTANCE_WEIGHT) * (far_x * far_x + far_y * far_y)
            distance /= reach * reach
            for x in range(max(0, -dx), min(width, width - dx)):
                step = guide[y, x] - guide[source, x + dx]
                total = cost[source, x + dx] + sharpness[x] * step * step + distance
                inverse = one / (total + floor)
                weight = inverse * inverse
                weight *= weight
                value = (
                    depth[source, x + dx]
                    - slope_x[source, x + dx] * far_x
                    - slope_y[source, x + dx] * far_y
                )
                value_sum[x] += weight * value
                weight_sum[x] += weight
                # An infinite cost has no weight, and must not make 0 · inf of it.
                cost_sum[x] += weight * min(total, np.float32(1e12))
        for x in range(width):
            if weight_sum[x] > 0:
                value = value_sum[x] / weight_sum[x]
                moved = np.float32(100) * np.float32(_MOVED_WEIGHT) * (value - depth[y, x])
                squared = (
                    np.float32(_SCATTER_WEIGHT * _SCATTER_WEIGHT) * scatter[y, x]
                    + trouble[y, x]
                    + moved * moved
                    + cost_sum[x] / weight_sum[x]
                )
                out[y, x] = value
                error[y, x] = np.sqrt(squared)
            else:
                out[y, x] = depth[y, x]
                error[y, x] = np.float32(np.inf)
    return out, error


def confidence_from_error(error_percent: np.ndarray, half_at_percent: float) -> np.ndarray:
    """Confidence in 0..1, float32 [H W]: one half at a predicted error of ``half_at_percent``.

    1 / (1 + (error / half)²): smooth, never quite certain, and 0 for an infinite error.
    """
    ratio = error_percent * np.float32(1 / half_at_percent)
    return (1 / (1 + ratio * ratio)).astype(np.float32, copy=False)

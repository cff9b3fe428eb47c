"""From two focus maps to depth and confidence (sections 3.1 and 3.2), with windows that stop.

The measure is the ratio Q = (near - far) / (near + far): bounded, free of albedo and exposure.
A calibrated curve takes Q to the *relative depth* t, which is 0 at the near end of the working
range, 1 at its far end, and linear in dioptres (1/z) between them.  Two facts follow that the
rest builds on: for a Gaussian blur Q is nearly linear in t, and a plane in space is exactly
linear in t over the image, whatever its tilt.

**Windows that stop at depth edges.**  A window across a depth edge mixes two surfaces, and the
blur itself mixes them over a few pixels more.  So each pixel hears, besides its own window,
four neighbours about one stripe period away along the diagonals.  Each speaks for the pixel by
extrapolating its own local plane, and is heard by a weight that falls steeply with

* how much its surroundings depart from a plane (a window on an edge does),
* how far the local modulation is from what the calibration has at that depth (mixed pixels,
  shadow rims and defocus beyond the working range are),
* the predicted noise, the difference in brightness to the pixel, and the distance.

Inside a face all five agree; at an edge the ones that look inward from the pixel's own side win.
The same terms, which are all in percent of the working range, make the predicted error, and from
it the confidence.

**How it is made fast.**  A focus map is itself a mean over one stripe period, so its neighbouring
pixels say nearly the same; every window here therefore takes three samples along each axis,
0.4 to 0.6 periods apart, in place of all pixels.  The image streams through one compiled loop
over rows: each row of windows, of costs and of results is made as soon as the rows it needs are
there, and only a few rows of each are kept, so that an image of any size is worked on in the
processor's cache.  Within a row everything is a plain loop over contiguous float32 without
branches, which LLVM turns into SIMD.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numba
import numpy as np

from .focus import LaplacianKind, SensorNoise, mirror_ends, mirrored, noise_gain

NOMINAL_CURVE = np.array([0.5, -0.5], np.float32).reshape(2, 1, 1)
"""Relative depth from Q where there is no calibration: t = (1 - Q) / 2."""

# What the terms of the predicted error weigh.  They are dimensionless, and were chosen once on
# ray-traced piles so that the predicted error ranks the true one; nothing depends on a rig.
_SCATTER_WEIGHT = np.float32(0.5**2)
_MODULATION_WEIGHT = np.float32(8.0)
_MOVED_WEIGHT = np.float32((100 * 0.5) ** 2)
_EDGE_WEIGHT = np.float32(2.0)
_DISTANCE_COST = np.float32(0.56)
_CONTRAST_WEIGHT = np.float32(0.005)
_RELATIVE_CONTRAST = np.float32(0.02**2)
_COST_FLOOR = np.float32(0.1)
_ERROR_SCALE = np.float32(0.79)
_OBLIQUE_REACH = 0.85

_ZERO = np.float32(0)
_ONE = np.float32(1)
_TWO = np.float32(2)
_HALF = np.float32(0.5)
_QUARTER = np.float32(0.25)
_INFINITE = np.float32(np.inf)
_TINY = np.float32(1e-12)
_SAFE = np.float32(1e-6)
_PERCENT = np.float32(100 * 100)
_ODDEST = np.float32(0.28)
"""Relative difference of squared modulations, a factor of 4/3 between the amounts, beyond which
no surface within the working range shows so little contrast, or so much: beyond the focal planes
the ratio folds back to where it was, but there both images are blurred."""
_FOLD_CELL_PERIODS = 0.8
_FOLD_CELLS = (5, 5)
_HIGHEST_COST = np.float32(1e9)
"""Of the windows outside the image, and of those that know nothing: its fourth power is finite."""
_INVERSE_FOURTH_POWER = np.int32(5 * 127 * (1 << 23) - (1 << 32))


@dataclass(frozen=True)
class Windows:
    """Distances between the samples of a window, in pixels, all derived from the stripe period.

    ``x_taps`` and ``y_taps``: the second averaging of the energies, weights 1/4, 1/2, 1/4 at
    -``smoothing_px``, 0 and ``smoothing_px``.  See :func:`windows_for`.
    """

    x_taps: np.ndarray
    y_taps: np.ndarray
    smoothing_px: int
    scatter_px: int
    slope_px: int
    """Slopes, scatter and contrast are told from samples at -``slope_px``, 0, ``slope_px``."""
    reach_px: int
    """The neighbours that are heard lie at (±``reach_px``, ±``reach_px``)."""
    samples: float
    """Independent samples of the Laplacian in one window, for the predicted noise."""

    @property
    def halo_px(self) -> int:
        """How far away a pixel's result may depend on the focus maps."""
        return self.smoothing_px + self.slope_px + self.reach_px


def windows_for(period_px: float, smoothing_periods: float, reach_periods: float) -> Windows:
    """Windows scaled to the stripe period (or, without stripes, to the focus window)."""
    # The three samples of the second averaging have the variance of a box of this side.
    side = period_px * smoothing_periods
    smoothing = round(side / 6**0.5)
    taps = np.zeros(2 * smoothing + 1, np.float32)
    for at, weight in ((0, 0.25), (smoothing, 0.5), (2 * smoothing, 0.25)):
        taps[at] += np.float32(weight)
    # The Laplacian's response is correlated over about two pixels each way.
    samples = max(1.0, (period_px * max(1.0, smoothing_periods)) ** 2 / 4)
    return Windows(
        taps,
        taps,
        smoothing_px=smoothing,
        scatter_px=max(3, int(1.4 * period_px) | 1),
        slope_px=max(1, round(0.6 * period_px)),
        reach_px=max(1, round(_OBLIQUE_REACH * reach_periods * period_px)),
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
    infinite and the relative depth is 0.5.  A pixel's result depends on nothing further away
    than ``windows.halo_px``.
    """
    width = focus_near.shape[1]
    curve = response.curve
    if curve.shape[1:] == (1, 1):
        curve = np.repeat(curve, width, axis=2)
    # The loops over powers expect two coefficients or more.
    modulation = np.zeros(1) if response.modulation is None else response.modulation
    if len(modulation) < 2:
        modulation = np.append(modulation, 0)
    variance = noise_gain(response.kind) / windows.samples
    return _estimate(
        np.ascontiguousarray(focus_near),
        np.ascontiguousarray(focus_far),
        np.ascontiguousarray(brightness),
        np.ascontiguousarray(guide),
        # As tuples, highest power first: their lengths are then part of the compiled type, the
        # loops over powers are unrolled, and the loops over pixels around them become SIMD.
        tuple(np.ascontiguousarray(c, np.float32) for c in curve[::-1]),
        tuple(np.float32(c) for c in modulation[::-1]),
        _ZERO if response.modulation is None else _MODULATION_WEIGHT,
        np.float32(variance * response.noise.read_variance),
        # The noise of near and far together, from their common brightness: half of the sum.
        np.float32(variance * response.noise.gain / 2),
        np.float32(2 * (100 * response.slope) ** 2),
        np.float32(response.noise.read_variance),
        np.float32(response.noise.gain),
        windows.smoothing_px,
        windows.slope_px,
        windows.reach_px,
        edge_aware,
    )


# The row loops below index with unsigned integers throughout: a negative index would count from
# the end, and the choice between the two would keep LLVM from making SIMD of the loops.
_rows = numba.njit(cache=True, error_model="numpy", fastmath={"contract"})
"""Multiply-adds may be contracted; nothing else of the arithmetic is relaxed."""


@_rows
def _energies_row(  # type: ignore[no-untyped-def]
    near_energy, far_energy, start, focus_near, focus_far, above, y, below
):
    """The second averaging down the columns: means of the squared focus maps."""
    for x in range(np.uintp(focus_near.shape[1])):
        a, b, c = focus_near[above, x], focus_near[y, x], focus_near[below, x]
        near_energy[x + start] = _QUARTER * (a * a + c * c) + _HALF * b * b
        a, b, c = focus_far[above, x], focus_far[y, x], focus_far[below, x]
        far_energy[x + start] = _QUARTER * (a * a + c * c) + _HALF * b * b


@_rows
def _depth_row(  # type: ignore[no-untyped-def]
    fine,
    coarse,
    trouble,
    at,
    start,
    near_energy,
    far_energy,
    smoothing,
    focus_near,
    focus_far,
    brightness,
    y,
    curve,
    curve_y,
    modulation,
    modulation_weight,
    read_variance,
    gain,
    noise_weight,
):
    """Relative depth over one window (fine) and over the smoothed one (coarse), and its troubles.

    With the mean energies N and F, and S² = (√N + √F)² = N + F + 2√(NF), the smoothed ratio is
    Q = (N - F) / S².  ``trouble`` is what noise and odd modulation add to the squared predicted
    error, percent².  With v the variance of the noise in one window, the root of an energy E has
    the variance v (1 + v / 2E), which gives Q one of about 2 (v/S²) (1 + Q² + 2 v/S²).
    """
    left, right = start - smoothing, start + smoothing
    for x in range(np.uintp(focus_near.shape[1])):
        n = _QUARTER * (near_energy[x + left] + near_energy[x + right])
        n += _HALF * near_energy[x + start]
        f = _QUARTER * (far_energy[x + left] + far_energy[x + right])
        f += _HALF * far_energy[x + start]
        s_squared = n + f + _TWO * np.sqrt(n * f)
        inverse = _ONE / (s_squared + _TINY)
        q = (n - f) * inverse
        fine_sum = focus_near[y, x] + focus_far[y, x]
        q_fine = (focus_near[y, x] - focus_far[y, x]) / (fine_sum + _SAFE)
        t = curve[0][curve_y, x]
        t_fine = t
        for power in curve[1:]:
            coefficient = power[curve_y, x]
            t = t * q + coefficient
            t_fine = t_fine * q_fine + coefficient
        light = brightness[y, x]
        noise = (read_variance + gain * light) * inverse
        noise *= noise_weight * (_ONE + q * q + _TWO * noise)
        inside = min(max(t, _ZERO), _ONE)
        expected = modulation[0]
        for coefficient in modulation[1:]:
            expected = expected * inside + coefficient
        # The relative difference of two amounts, symmetric and bounded: near its zero it is the
        # logarithm of the ratio of their roots, at a fraction of the cost.
        expected *= light
        expected *= expected
        odd = (s_squared - expected) / (s_squared + expected + _TINY)
        possible = modulation_weight * abs(odd) <= modulation_weight * _ODDEST
        odd *= modulation_weight
        fine[at, x + start] = t_fine if fine_sum > _ZERO else _HALF
        coarse[at, x + start] = t if s_squared > _ZERO else _HALF
        known = possible and s_squared > _ZERO
        trouble[at, x + start] = noise + odd * odd if known else _INFINITE


@_rows
def _moments_row(mean, square, fine, above, at, below):  # type: ignore[no-untyped-def]
    """Down the columns: means of the fine depth and of its square."""
    for x in range(np.uintp(mean.shape[0])):
        a, b, c = fine[above, x], fine[at, x], fine[below, x]
        mean[x] = _QUARTER * (a + c) + _HALF * b
        square[x] = _QUARTER * (a * a + c * c) + _HALF * b * b


@_rows
def _costs_row(  # type: ignore[no-untyped-def]
    slope_x,
    slope_y,
    cost,
    own,
    mean,
    square,
    coarse,
    trouble,
    guide,
    above,
    at,
    below,
    start,
    width,
    step,
    over_y,
):
    """Slopes per pixel, and squared errors of windows, percent².

    The slopes are central differences of the coarse depth.  ``cost`` is what a window counts to
    those that hear it: scatter about a plane, contrast, and troubles.  ``own`` is what it counts
    to its own pixel: the whole scatter (tilt included), since where the surface is steep, all
    that depends on where exactly a pixel looks is worth less.
    """
    left, right = start - step, start + step
    # The variance that weights 1/4, 1/2, 1/4 at -step, 0 and step see of a unit slope.
    moment = _HALF * np.float32(step * step)
    over_x = _HALF / np.float32(step)
    for x in range(width):
        mean_here = _QUARTER * (mean[x + left] + mean[x + right]) + _HALF * mean[x + start]
        square_here = _QUARTER * (square[x + left] + square[x + right])
        square_here += _HALF * square[x + start]
        scatter = max(square_here - mean_here * mean_here, _ZERO)
        a = (coarse[at, x + right] - coarse[at, x + left]) * over_x
        b = (coarse[below, x + start] - coarse[above, x + start]) * over_y
        slope_x[at, x + start] = a
        slope_y[at, x + start] = b
        bend = max(scatter - (a * a + b * b) * moment, _ZERO)
        grey = guide[at, x + start]
        a = guide[at, x + right] - guide[at, x + left]
        b = guide[below, x + start] - guide[above, x + start]
        contrast = (a * a + b * b) / (grey * grey + _ONE)
        known = trouble[at, x + start]
        cost[at, x + start] = _PERCENT * bend + known + _EDGE_WEIGHT * contrast
        own[at, x + start] = _PERCENT * _SCATTER_WEIGHT * scatter + known


@numba.njit(inline="always")
def _weight(cost):  # type: ignore[no-untyped-def]
    """How much a window of this cost is heard: (cost + floor)⁻⁴, but for a factor.

    The bits of a positive float are, read as an integer and but for a constant, 2²³ times its
    logarithm, with straight lines between the powers of two.  Minus four times that are the bits
    of the inverse fourth power, times 1 to 1.35.  A weight needs to be no better; this one is as
    continuous and as steep, and it spares five divisions a pixel.
    """
    logarithm = np.float32(cost + _COST_FLOOR).view(np.int32)
    return np.int32(_INVERSE_FOURTH_POWER - np.int32(4) * logarithm).view(np.float32)


@numba.njit(inline="always")
def _heard_cost(cost, step, sharpness):  # type: ignore[no-untyped-def]
    """What a neighbour's window costs a pixel whose brightness is ``step`` away, never NaN."""
    total = cost + sharpness * step * step + _DISTANCE_COST
    return total if total < _HIGHEST_COST else _HIGHEST_COST


@_rows
def _hear_row(  # type: ignore[no-untyped-def]
    out,
    error,
    y,
    depth,
    slope_x,
    slope_y,
    cost,
    own,
    guide,
    above,
    at,
    below,
    start,
    reach,
    read_variance,
    gain,
):
    """Each pixel's own window and four neighbours', extrapolated and weighed (module docstring).

    The neighbours lie above left (1), above right (2), below left (3) and below right (4).
    """
    left, right = start - reach, start + reach
    far = np.float32(reach)
    for x in range(np.uintp(out.shape[1])):
        here, i, j = x + start, x + left, x + right
        grey = guide[at, here]
        light = max(grey, _ZERO)
        sharpness = _CONTRAST_WEIGHT / (
            read_variance + gain * light + _RELATIVE_CONTRAST * light * light + _SAFE
        )
        c0 = cost[at, here] if cost[at, here] < _HIGHEST_COST else _HIGHEST_COST
        c1 = _heard_cost(cost[above, i], guide[above, i] - grey, sharpness)
        c2 = _heard_cost(cost[above, j], guide[above, j] - grey, sharpness)
        c3 = _heard_cost(cost[below, i], guide[below, i] - grey, sharpness)
        c4 = _heard_cost(cost[below, j], guide[below, j] - grey, sharpness)
        w0, w1, w2, w3, w4 = _weight(c0), _weight(c1), _weight(c2), _weight(c3), _weight(c4)
        over = _ONE / (w0 + w1 + w2 + w3 + w4)
        value = over * (
            w0 * depth[at, here]
            + w1 * (depth[above, i] + far * (slope_x[above, i] + slope_y[above, i]))
            + w2 * (depth[above, j] - far * (slope_x[above, j] - slope_y[above, j]))
            + w3 * (depth[below, i] + far * (slope_x[below, i] - slope_y[below, i]))
            + w4 * (depth[below, j] - far * (slope_x[below, j] + slope_y[below, j]))
        )
        heard = over * (w0 * c0 + w1 * c1 + w2 * c2 + w3 * c3 + w4 * c4)
        moved = value - depth[at, here]
        squared = _ERROR_SCALE * (own[at, here] + _MOVED_WEIGHT * moved * moved + heard)
        out[y, x] = value
        error[y, x] = np.sqrt(squared) if squared < _INFINITE else _INFINITE


@_rows
def _own_row(out, error, y, depth, cost, own, at, start):  # type: ignore[no-untyped-def]
    """Each pixel's own window alone."""
    for x in range(np.uintp(out.shape[1])):
        squared = _ERROR_SCALE * (own[at, x + start] + cost[at, x + start])
        out[y, x] = depth[at, x + start]
        error[y, x] = np.sqrt(squared) if squared < _INFINITE else _INFINITE


@numba.njit(cache=True)
def _continue_ends(row, width, margin):  # type: ignore[no-untyped-def]
    """As :func:`mirror_ends`, but through the end values: a slope goes on as it is."""
    first, last = row[margin], row[margin + width - 1]
    for k in range(1, margin + 1):
        row[margin - k] = _TWO * first - row[margin + mirrored(-k, width)]
        row[margin + width - 1 + k] = _TWO * last - row[margin + mirrored(width - 1 + k, width)]


@numba.njit(cache=True, error_model="numpy")
def _estimate(  # type: ignore[no-untyped-def]
    focus_near,
    focus_far,
    brightness,
    guide,
    curve,
    modulation,
    modulation_weight,
    window_read_variance,
    window_gain,
    noise_weight,
    read_variance,
    gain,
    smoothing,
    step,
    reach,
    edge_aware,
):
    """Three passes over the rows, each as far behind the one before as it must look ahead.

    Rows are kept in rings with margins on both sides: row y is at ``y % ring``.  Row ``ring``
    stands for all rows outside the image; it costs so much that it is not heard.
    """
    height, width = focus_near.shape
    out = np.empty((height, width), np.float32)
    error = np.empty((height, width), np.float32)
    margin = max(smoothing, step, reach)
    ring = 2 * (step + reach) + 1
    padded = (ring + 1, width + 2 * margin)
    grey = np.zeros(padded, np.float32)
    fine = np.zeros(padded, np.float32)
    coarse = np.full(padded, _HALF, np.float32)
    trouble = np.zeros(padded, np.float32)
    slope_x = np.zeros(padded, np.float32)
    slope_y = np.zeros(padded, np.float32)
    own = np.zeros(padded, np.float32)
    cost = np.full(padded, _HIGHEST_COST, np.float32)
    near_energy = np.zeros(padded[1], np.float32)
    far_energy = np.zeros(padded[1], np.float32)
    mean = np.zeros(padded[1], np.float32)
    square = np.zeros(padded[1], np.float32)
    u = np.uintp
    start = u(margin)
    curve_is_local = curve[0].shape[0] > 1
    for newest in range(height + step + reach):
        y = newest
        if y < height:
            above, below = mirrored(y - smoothing, height), mirrored(y + smoothing, height)
            _energies_row(
                near_energy, far_energy, start, focus_near, focus_far, u(above), u(y), u(below)
            )
            mirror_ends(near_energy, width, margin)
            mirror_ends(far_energy, width, margin)
            at = y % ring
            _depth_row(
                fine,
                coarse,
                trouble,
                u(at),
                start,
                near_energy,
                far_energy,
                u(smoothing),
                focus_near,
                focus_far,
                brightness,
                u(y),
                curve,
                u(y if curve_is_local else 0),
                modulation,
                modulation_weight,
                window_read_variance,
                window_gain,
                noise_weight,
            )
            grey[at, margin : margin + width] = guide[y]
            mirror_ends(fine[at], width, margin)
            mirror_ends(grey[at], width, margin)
            _continue_ends(coarse[at], width, margin)
        y = newest - step
        if 0 <= y < height:
            at = u(y % ring)
            above, below = mirrored(y - step, height), mirrored(y + step, height)
            _moments_row(mean, square, fine, u(above % ring), at, u(below % ring))
            above, below = max(0, y - step), min(height - 1, y + step)
            over_y = _ONE / np.float32(max(1, below - above))
            rows = u(above % ring), at, u(below % ring)
            _costs_row(
                slope_x,
                slope_y,
                cost,
                own,
                mean,
                square,
                coarse,
                trouble,
                grey,
                *rows,
                start,
                u(width),
                u(step),
                over_y,
            )
            if not edge_aware:
                _own_row(out, error, u(y), coarse, cost, own, at, start)
        y = newest - step - reach
        if edge_aware and y >= 0:
            above = (y - reach) % ring if y >= reach else ring
            below = (y + reach) % ring if y + reach < height else ring
            _hear_row(
                out,
                error,
                u(y),
                coarse,
                slope_x,
                slope_y,
                cost,
                own,
                grey,
                u(above),
                u(y % ring),
                u(below),
                start,
                u(reach),
                read_variance,
                gain,
            )
    return out, error


def folded_back(
    focus_sum: np.ndarray,
    light: np.ndarray,
    relative_depth: np.ndarray,
    modulation: np.ndarray,
    period_px: float,
    least: float,
) -> np.ndarray:
    """Where the curve has folded back: surfaces beyond the focal planes, bool [H W].

    There the ratio takes values that it also has between the planes, but both images are
    blurred: over a few stripe periods the contrast is less than ``least`` of what the
    calibration has at that depth.  One window may show so little for other reasons (a rim, a
    shadow); a neighbourhood of four periods does not.  For the arguments see
    :func:`contrast_of_cells`.
    """
    shown, enough = contrast_of_cells(focus_sum, light, relative_depth, modulation, period_px)
    low = (shown < np.float32(least) * enough).astype(np.uint8)
    return on_pixels(low, focus_sum.shape) > 0


def contrast_of_cells(
    focus_sum: np.ndarray,
    light: np.ndarray,
    relative_depth: np.ndarray,
    modulation: np.ndarray,
    period_px: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The contrast that neighbourhoods show, and what the calibration has there; float32 [h w].

    ``focus_sum`` is focus_near + focus_far, ``light`` near + far, float32 [H W];
    ``relative_depth`` [H W] has NaN where unknown; ``modulation`` as in :class:`Response`.  A cell
    is a little less than a stripe period wide.
    """
    height, width = focus_sum.shape
    cell = max(1, round(_FOLD_CELL_PERIODS * period_px))
    size = (max(1, width // cell), max(1, height // cell))

    def cells(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)

    def pooled(image: np.ndarray) -> np.ndarray:
        return cv2.blur(image, _FOLD_CELLS, borderType=cv2.BORDER_REFLECT_101)

    known = np.isfinite(relative_depth)
    share = cells(known.astype(np.float32))
    depth = cells(np.where(known, relative_depth, np.float32(0)))
    depth /= np.maximum(share, _SAFE)
    expected = np.zeros_like(depth)
    for coefficient in modulation[::-1]:
        expected = expected * np.clip(depth, 0, 1) + coefficient
    there = (share > 0).astype(np.float32)
    return pooled(cells(focus_sum) * there), pooled(expected * cells(light) * there)


def on_pixels(cells: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Values of cells [h w] on the pixels [H W] that they are made of."""
    height, width = shape[:2]
    return cv2.resize(cells, (width, height), interpolation=cv2.INTER_NEAREST)


def confidence_from_error(error_percent: np.ndarray, half_at_percent: float) -> np.ndarray:
    """Confidence in 0..1, float32 [H W]: one half at a predicted error of ``half_at_percent``.

    1 / (1 + (error / half)²): smooth, never quite certain, and 0 for an infinite error.
    """
    errors = np.ascontiguousarray(error_percent, np.float32)
    confidence = _confidence(errors.ravel(), np.float32(1 / half_at_percent))
    return confidence.reshape(errors.shape)


@numba.njit(cache=True, error_model="numpy")
def _confidence(errors, over_half):  # type: ignore[no-untyped-def]
    out = np.empty_like(errors)
    for i in range(errors.size):
        ratio = errors[i] * over_half
        out[i] = _ONE / (_ONE + ratio * ratio)
    return out

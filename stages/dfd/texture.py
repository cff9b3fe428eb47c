"""Depth from the scene's own texture, with a curve from the optics alone (equations 1 to 3).

On the near image's grid both blur circles are set by one number, the diameter B of the blur
circle at the other focal plane: with relative depth t (0 in the near focal plane, 1 in the far
one, linear in 1/u) equation 2 gives d_near = B |t| and d_far = B |1 - t|.

The energy that a blur leaves of a texture depends on the texture's spectrum, which is not known.
But it can be measured.  For a Gaussian blur of variance σ² the power P of a filtered image obeys
d ln P / dσ² = -<ω²>, where <ω²> is the mean squared frequency of what is left, and that is the
power of the image's gradient over the power of the image.  With its mean over both images

    σ_near² - σ_far² = -ln(P_near / P_far) / <ω²>,

whatever the texture.  So the focus maps are brought to what a texture of a *reference* spectrum
would have shown at the same blur: the logarithm of their ratio is multiplied by the reference's
<ω²> over the measured one.  From there on one curve serves every pixel.

What is assumed: a thin lens with a round aperture (its blur is a uniform disc, not a Gaussian; the
curve is made with the disc's transfer), and the reference, a texture whose amplitudes fall as
1/frequency, as those of natural scenes do.  How far real textures depart from that costs only what
the disc's transfer departs from a Gaussian.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from scipy.optimize import nnls

from ..optics.analytic import disc_transfer
from .focus import LaplacianKind, SensorNoise, laplacian
from .stripes import whole_period_taps

LARGEST_BLUR_PX = 4.5
"""Blur circle at the other focal plane, in pixels of the scale at which focus is measured, beyond
which the blur empties the Laplacian's band and the ratio no longer falls steadily."""

_MODEL_SIZE = 256
_CURVE_DEGREE = 5
_MODEL_STEPS = 161
_FURTHEST = 0.3
"""How far outside the focal planes, in relative depth, the curve is looked at."""
_LEAST_SLOPE = 0.3
"""Of the ratio over relative depth, against its slope in the middle: flatter, and it is not told
apart from noise."""
_MEAN_SQUARE_FREQUENCY = (0.02, 4.0)
"""Limits of the measured <ω²>, rad²/px²: what noise makes of an empty window lies outside."""
_LEAST_TRANSFER = 1e-3
_STRONGEST_LOG_RATIO = 4.0
_ANTI_ALIAS = 0.5
"""Standard deviation of the smoothing before an image is shrunk, in pixels of the small one."""
_FOLD_SCALES = (2, 4)
_FOLD_ENERGY = 4.0
_FOLD_BEYOND = 0.8
"""Times the scale: relative depth from its middle that counts as far beyond.  Between the planes
and a little outside it is within 0.6, and the coarser the scale, the more it errs."""
_NOISE_LEVELS = 8
_NOISE_FEWEST = 400
_HIGH_PASS = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)
_MEDIAN_OF_NORMAL = 0.6745
_QUANTISATION = 1 / 12
_TINY = np.float32(1e-9)


@dataclass(frozen=True)
class Texture:
    """What a calibration from optics knows in place of projected stripes.

    ``blur_px`` is B in pixels of the recorded image.  Focus is measured on images averaged over
    ``scale_px`` × ``scale_px`` pixels.  ``mean_square_frequency`` is the reference's <ω²> behind
    the Laplacian at t = 1/2, in rad² per squared pixel of that scale.
    """

    blur_px: float
    scale_px: int
    mean_square_frequency: float


@dataclass(frozen=True)
class TextureCurve:
    """Relative depth over the ratio Q of the focus maps, from the optics.

    ``coefficients`` lowest power first, float32; ``low`` and ``high`` are the relative depths
    between which Q tells depth apart; ``worst`` is what the polynomial departs from the model.
    """

    texture: Texture
    coefficients: np.ndarray
    low: float
    high: float
    worst: float


def scale_for(blur_px: float) -> int:
    """By how much images are shrunk before focus is measured, for a blur circle B [px]."""
    return max(1, int(np.ceil(blur_px / LARGEST_BLUR_PX)))


def texture_curve(
    blur_px: float, kind: LaplacianKind = "opencv", period_px: float | None = None
) -> TextureCurve:
    """The curve for a blur circle of ``blur_px`` at the other focal plane (module docstring).

    With ``period_px``, that of a projected pattern, the reference is its first wave.
    """
    scale = 1 if period_px is not None else scale_for(blur_px)
    blur = blur_px / scale
    t = np.linspace(-_FURTHEST, 1 + _FURTHEST, _MODEL_STEPS)
    near = np.array([_reference_moments(blur * abs(one), kind, period_px) for one in t])
    far = near[::-1]
    log_ratio = np.log(near[:, 0] / far[:, 0]) / 2
    frequency = (near[:, 1] / near[:, 0] + far[:, 1] / far[:, 0]) / 2
    reference = float(frequency[_MODEL_STEPS // 2])
    ratio = np.tanh(log_ratio * reference / frequency / 2)
    low, high = _monotone(t, ratio)
    used = (t >= low) & (t <= high)
    # By symmetry t - 1/2 is odd in Q.
    powers = np.arange(1, _CURVE_DEGREE + 1, 2)
    design = ratio[used, None] ** powers
    fitted, *_ = np.linalg.lstsq(design, t[used] - 0.5, rcond=None)
    coefficients = np.zeros(_CURVE_DEGREE + 1, np.float32)
    coefficients[0] = 0.5
    coefficients[powers] = fitted
    worst = float(np.abs(design @ fitted + 0.5 - t[used]).max())
    return TextureCurve(Texture(blur_px, scale, reference), coefficients, low, high, worst)


def _reference_moments(
    blur_px: float, kind: LaplacianKind, period_px: float | None
) -> tuple[float, float]:
    """Power of the reference texture behind the Laplacian and the blur, and of its gradient."""
    if period_px is not None:
        power = max(float(disc_transfer(blur_px / period_px)), _LEAST_TRANSFER) ** 2
        return power, power * 4 * float(np.sin(np.pi / period_px)) ** 2
    impulse = np.zeros((_MODEL_SIZE, _MODEL_SIZE), np.float32)
    impulse[_MODEL_SIZE // 2, _MODEL_SIZE // 2] = 1
    fx = np.fft.rfftfreq(_MODEL_SIZE)[None]
    fy = np.fft.fftfreq(_MODEL_SIZE)[:, None]
    squared = fx**2 + fy**2
    spectrum = np.zeros_like(squared)
    spectrum[squared > 0] = 1 / squared[squared > 0]
    spectrum *= np.abs(np.fft.rfft2(laplacian(impulse, kind))) ** 2
    spectrum *= disc_transfer(blur_px * np.sqrt(squared)) ** 2
    gradient = 4 * np.sin(np.pi * fx) ** 2 + 4 * np.sin(np.pi * fy) ** 2
    return float(spectrum.sum()), float((spectrum * gradient).sum())


def _monotone(t: np.ndarray, ratio: np.ndarray) -> tuple[float, float]:
    """The stretch about t = 1/2 over which the ratio falls steeply enough."""
    slope = -np.gradient(ratio, t)
    middle = len(t) // 2
    flat = np.flatnonzero(slope < _LEAST_SLOPE * slope[middle])
    first = max((int(i) + 1 for i in flat if i < middle), default=0)
    last = min((int(i) - 1 for i in flat if i > middle), default=len(t) - 1)
    return float(t[first]), float(t[last])


def texture_taps(width_px: float) -> np.ndarray:
    """Weights of a window without corners (sum 1): a box twice as wide as the one it is run over.

    Without a period to integrate out there is no reason for sharp ends, at which details of a
    texture would enter and leave at once.
    """
    wide, narrow = whole_period_taps(width_px), whole_period_taps(max(1.0, width_px / 2))
    return np.convolve(wide, narrow).astype(np.float32)


# -- focus maps -----------------------------------------------------------------------------------


def texture_focus_maps(
    near: np.ndarray,
    far: np.ndarray,
    texture: Texture,
    x_taps: np.ndarray,
    y_taps: np.ndarray,
    kind: LaplacianKind,
    subtract_noise: bool,
    striped: bool = False,
) -> tuple[np.ndarray, np.ndarray, SensorNoise]:
    """Focus maps of ``near`` and ``far`` [H W] as the reference texture would show them.

    The maps are float32 [H W], with the noise of the images on which they were measured; the
    taps (:func:`texture_taps`, or whole stripe periods) are the window at that scale.  Both maps
    are lowered where the texture is coarser than the reference, so that their sum tells what an
    error of the ratio costs.
    """
    height, width = near.shape
    small = (max(1, width // texture.scale_px), max(1, height // texture.scale_px))
    # Averages over whole pixels leave the noise white, so that it can be told and subtracted.
    images = _averaged(near, small), _averaged(far, small)
    noise = pair_noise(*images)
    (near_power, near_gradient), (far_power, far_gradient) = (
        _powers(image, x_taps, y_taps, kind, noise if subtract_noise else None) for image in images
    )
    known = (near_power > 0) & (far_power > 0)
    if not striped:
        known &= ~_folded(*images, texture, x_taps, y_taps, kind, noise)
    near_power, far_power = np.maximum(near_power, _TINY), np.maximum(far_power, _TINY)
    lowest, highest = _MEAN_SQUARE_FREQUENCY
    frequency = 0.5 * (
        np.clip(near_gradient / near_power, lowest, highest)
        + np.clip(far_gradient / far_power, lowest, highest)
    )
    finer = frequency / np.float32(texture.mean_square_frequency)
    half_log_ratio = np.log(near_power / far_power) / (4 * finer)
    half_log_ratio = np.clip(half_log_ratio, -_STRONGEST_LOG_RATIO, _STRONGEST_LOG_RATIO)
    common = np.sqrt(np.sqrt(near_power) * np.sqrt(far_power)) * np.minimum(finer, 1)
    common *= known
    focus_near, focus_far = (
        _enlarged(common * np.exp(sign * half_log_ratio), (width, height)) for sign in (1, -1)
    )
    return focus_near, focus_far, noise


def _folded(
    near: np.ndarray,
    far: np.ndarray,
    texture: Texture,
    x_taps: np.ndarray,
    y_taps: np.ndarray,
    kind: LaplacianKind,
    noise: SensorNoise,
) -> np.ndarray:
    """Where surfaces lie far beyond the focal planes, bool [H W] of the images given.

    Far beyond, both images are so blurred that nothing but the disc's side lobes is left in the
    Laplacian's band, and the ratio says anything.  On images shrunk further the same blur is
    small, the Gaussian law holds, and relative depth is told roughly, but not mistaken.
    """
    height, width = near.shape
    folded = np.zeros((height, width), bool)
    blur_px = texture.blur_px / texture.scale_px
    lowest, highest = _MEAN_SQUARE_FREQUENCY
    for factor in _FOLD_SCALES:
        size = (width // factor, height // factor)
        if min(size) < max(x_taps.size, y_taps.size):
            break
        quieter = SensorNoise(noise.read_variance / factor**2, noise.gain / factor**2)
        powers = [
            _powers(_shrunk(image, size), x_taps, y_taps, kind, quieter) for image in (near, far)
        ]
        (near_power, near_gradient), (far_power, far_gradient) = powers
        # Without energy well above the noise a coarse scale knows nothing.
        least = (
            _FOLD_ENERGY
            * float(_noise_gains(kind)[0])
            * (quieter.read_variance + quieter.gain * float(near.mean()))
        )
        told = (near_power > least) & (far_power > least)
        near_power, far_power = np.maximum(near_power, _TINY), np.maximum(far_power, _TINY)
        frequency = 0.5 * (
            np.clip(near_gradient / near_power, lowest, highest)
            + np.clip(far_gradient / far_power, lowest, highest)
        )
        # A disc's variance is a sixteenth of its diameter squared; t - 1/2 by the Gaussian law.
        off = 8 * (factor / blur_px) ** 2 * np.log(far_power / near_power) / frequency
        beyond = (told & (np.abs(off) > factor * _FOLD_BEYOND)).astype(np.uint8)
        folded |= cv2.resize(beyond, (width, height), interpolation=cv2.INTER_NEAREST) > 0
    return folded


def _powers(
    image: np.ndarray,
    x_taps: np.ndarray,
    y_taps: np.ndarray,
    kind: LaplacianKind,
    noise: SensorNoise | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean square of the Laplacian's response and of its gradient over a window, less noise's."""
    response = laplacian(image, kind)
    pad = cv2.copyMakeBorder(response, 0, 1, 0, 1, cv2.BORDER_REPLICATE)
    across, down = np.diff(pad, axis=1)[:-1], np.diff(pad, axis=0)[:, :-1]
    power = response * response
    gradient = across * across + down * down
    if noise is not None:
        variance = np.float32(noise.read_variance) + np.float32(noise.gain) * np.maximum(image, 0)
        power_gain, gradient_gain = _noise_gains(kind)
        power -= power_gain * variance
        gradient -= gradient_gain * variance

    def pooled(values: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(
            values, cv2.CV_32F, x_taps, y_taps, borderType=cv2.BORDER_REFLECT_101
        )

    return pooled(power), np.maximum(pooled(gradient), 0)


def _noise_gains(kind: LaplacianKind) -> tuple[np.float32, np.float32]:
    """Variance of the Laplacian's response, and of its gradient, to white noise of variance 1."""
    impulse = np.zeros((15, 15), np.float32)
    impulse[7, 7] = 1
    response = laplacian(impulse, kind)
    gradient = (np.diff(response, axis=0) ** 2).sum() + (np.diff(response, axis=1) ** 2).sum()
    return np.float32((response**2).sum()), np.float32(gradient)


def pair_noise(*images: np.ndarray) -> SensorNoise:
    """Noise of images [H W] of one camera, told from their finest detail.

    The median of a high pass that no defocused texture survives, at several grey levels; of the
    images the one with the least is taken, for texture only adds.
    """
    levels, variances = [], []
    bounds = np.quantile(images[0], np.linspace(0, 1, _NOISE_LEVELS + 1))
    for low, high in pairwise(bounds):
        found = []
        for image in images:
            fine = cv2.filter2D(image, cv2.CV_32F, _HIGH_PASS)
            inside = (image >= low) & (image <= high)
            if int(inside.sum()) >= _NOISE_FEWEST:
                deviation = float(np.median(np.abs(fine[inside]))) / _MEDIAN_OF_NORMAL
                found.append(deviation**2 / float((_HIGH_PASS**2).sum()))
        if found:
            levels.append(float(low + high) / 2)
            variances.append(max(min(found), _QUANTISATION))
    if len(levels) < 2:
        return SensorNoise()
    weight = 1 / np.array(variances)
    design = np.stack([np.ones(len(levels)), np.maximum(levels, 0)], axis=1)
    fitted, _ = nnls(design * weight[:, None], np.ones(len(levels)))
    return SensorNoise(max(float(fitted[0]), 1e-3), float(fitted[1]))


def _shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``image`` averaged to ``size``, its finest detail taken off before.

    What a box lets through beyond the new pixels' frequencies would come back as detail that only
    the sharper image has.
    """
    factor = image.shape[1] / size[0]
    return _averaged(cv2.GaussianBlur(image, (0, 0), _ANTI_ALIAS * factor), size)


def _averaged(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    values = np.ascontiguousarray(image, np.float32)
    if (image.shape[1], image.shape[0]) == size:
        return values
    return cv2.resize(values, size, interpolation=cv2.INTER_AREA)


def _enlarged(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    if (image.shape[1], image.shape[0]) == size:
        return np.ascontiguousarray(image, np.float32)
    return cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)

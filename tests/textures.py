"""Textured scenes behind an analytic thin lens, for tests of depth without stripes.

A sharp picture of a made-up spectrum, on a surface of known depth, blurred by the disc of equation
2 (layer by layer where depth varies); the far image has its own magnification, gain and noise.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from workbench_stages.optics.analytic import disc_transfer
from workbench_stages.optics.rig import Rig

RIG = {
    "focal_length_mm": 50.0,
    "f_number": 2.8,
    "pixel_pitch_mm": 0.1,
    "near_focus_mm": 800.0,
    "far_focus_mm": 1200.0,
}
KINDS = ("natural", "fine", "edges")
SIZE = 256
_LAYERS = 24
_PAD = 24


def write_rig(path: Path, **changes: object) -> Path:
    """``rig.toml`` of a camera without a projector; a change to None leaves the key out."""
    values = {key: value for key, value in (RIG | changes).items() if value is not None}
    path.write_text("".join(f"{key} = {value}\n" for key, value in values.items()))
    return path


def sharp(kind: str, seed: int = 0, size: int = SIZE) -> np.ndarray:
    """A picture [size size] of amplitudes 1/frequency, of fine grain, or of flat patches."""
    rng = np.random.default_rng(seed)
    if kind == "edges":
        image = np.zeros((size, size), np.float32)
        for _ in range(1200):
            x, y = (int(v) for v in rng.integers(-10, size, 2))
            w, h = (int(v) for v in rng.integers(5, 24, 2))
            cv2.rectangle(image, (x, y), (x + w, y + h), float(rng.uniform(40, 200)), -1)
        return cv2.GaussianBlur(image, (0, 0), 0.6)
    image = rng.normal(size=(size, size))
    if kind == "natural":
        frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None])
        image = np.fft.irfft2(np.fft.rfft2(image) / np.maximum(frequency, 2 / size), image.shape)
    else:
        image = cv2.GaussianBlur(image, (0, 0), 0.8)
    return np.clip(110 + 30 * image / image.std(), 5, 215).astype(np.float32)


def pair(
    rig: Rig, image: np.ndarray, depth_mm: np.ndarray | float, noise: float = 1.0, gain: float = 0.9
) -> tuple[np.ndarray, np.ndarray]:
    """Near and far image, uint8 [H W], of ``image`` on a surface at ``depth_mm`` [H W]."""
    rng = np.random.default_rng(1)
    scale = 1.0 if rig.registered else rig.sensor_mm("far") / rig.sensor_mm("near")
    near = _blurred(image, np.asarray(rig.blur_px("near", depth_mm)))
    far = _blurred(image, np.asarray(rig.blur_px("far", depth_mm)) / scale)
    middle = (image.shape[0] - 1) / 2
    shift = middle * (1 - 1 / scale)
    matrix = np.array([[1 / scale, 0, shift], [0, 1 / scale, shift]])
    far = cv2.warpAffine(
        far,
        matrix,
        image.shape[::-1],
        flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    images = (near, gain * far)
    noisy = (one + rng.normal(size=one.shape) * noise for one in images)
    first, second = (np.clip(np.rint(one), 0, 255).astype(np.uint8) for one in noisy)
    return first, second


def _blurred(image: np.ndarray, diameter_px: np.ndarray) -> np.ndarray:
    diameter = np.broadcast_to(np.abs(diameter_px), image.shape)
    if np.ptp(diameter) == 0:
        return _disc(image, float(diameter.flat[0]))
    levels = np.linspace(0, diameter.max() + 1e-6, _LAYERS)
    layers = np.stack([_disc(image, level) for level in levels])
    at = np.minimum(diameter / levels[1], _LAYERS - 1.001)
    below = at.astype(int)
    rows, columns = np.indices(image.shape)
    share = at - below
    low, high = layers[below, rows, columns], layers[below + 1, rows, columns]
    return (low * (1 - share) + high * share).astype(np.float32)


def _disc(image: np.ndarray, diameter_px: float) -> np.ndarray:
    wide = cv2.copyMakeBorder(image, _PAD, _PAD, _PAD, _PAD, cv2.BORDER_REFLECT_101)
    rows, columns = np.fft.fftfreq(wide.shape[0])[:, None], np.fft.rfftfreq(wide.shape[1])[None]
    transfer = disc_transfer(diameter_px * np.hypot(rows, columns))
    blurred = np.fft.irfft2(np.fft.rfft2(wide) * transfer, wide.shape)
    return blurred[_PAD:-_PAD, _PAD:-_PAD].astype(np.float32)

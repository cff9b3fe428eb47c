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
from typing import Literal

import cv2
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

    ``x_taps`` and ``y_taps`` are the window (:func:`stages.dfd.stripes.whole_period_taps`).  The
    energy that ``noise`` explains is subtracted before the root; what falls below it is 0.
    """
    values = image.astype(np.float32, copy=False)
    energy = laplacian(values, kind)
    np.square(energy, out=energy)
    if noise is not None:
        gain = noise_gain(kind)
        energy -= np.float32(gain * noise.read_variance)
        energy -= np.float32(gain * noise.gain) * values
    energy = cv2.sepFilter2D(energy, cv2.CV_32F, x_taps, y_taps, borderType=cv2.BORDER_REFLECT_101)
    np.maximum(energy, 0, out=energy)
    return np.sqrt(energy, out=energy)

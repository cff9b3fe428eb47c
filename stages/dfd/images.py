"""Recorded images as the sensor's mathematics wants them: one grey level a pixel."""

from __future__ import annotations

import cv2
import numpy as np


def grey(image: np.ndarray) -> np.ndarray:
    """``image`` [H W] of any number type, or RGB [H W 3], as float32 [H W] grey levels."""
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    return image.astype(np.float32)


def full_scale(*images: np.ndarray) -> float:
    """The grey level at which these images' sensor saturates.

    255 for 8 bit.  A 16-bit image may hold 10, 12 or 16 significant bits and does not say: taken
    is the least of these that no pixel exceeds.  Floating-point images have no full scale.
    """
    if all(image.dtype == np.uint8 for image in images):
        return 255.0
    if any(not np.issubdtype(image.dtype, np.integer) for image in images):
        return float("inf")
    highest = max(int(image.max(initial=0)) for image in images)
    return float(next(top for top in (1023, 4095, 65535) if highest <= top))

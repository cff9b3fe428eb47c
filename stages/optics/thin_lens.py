"""The thin lens of section 2: Gaussian lens law and blur circle, equations 1 and 2.

Lengths are millimetres along the optical axis, all positive; arrays are taken and given alike.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

Length = TypeVar("Length", float, np.ndarray)


def image_distance_mm(focal_length_mm: float, object_distance_mm: float) -> float:
    """Where the lens images an object: v of 1/u + 1/v = 1/f.

    Raises ValueError for an object within the focal length, of which there is no real image.
    """
    if not object_distance_mm > focal_length_mm:
        raise ValueError(
            f"a lens of {focal_length_mm:g} mm cannot focus at {object_distance_mm:g} mm: "
            "expected a distance beyond its focal length"
        )
    return 1 / (1 / focal_length_mm - 1 / object_distance_mm)


def object_distance_mm(focal_length_mm: float, image_distance_mm: float) -> float:
    """What a sensor behind the lens is focused on: u of 1/u + 1/v = 1/f.

    Raises ValueError for a sensor within the focal length, which nothing is focused on.
    """
    if not image_distance_mm > focal_length_mm:
        raise ValueError(
            f"a sensor {image_distance_mm:g} mm behind a lens of {focal_length_mm:g} mm is focused "
            "on nothing: expected it beyond the focal length"
        )
    return 1 / (1 / focal_length_mm - 1 / image_distance_mm)


def blur_circle_mm(
    focal_length_mm: float, aperture_mm: float, sensor_mm: float, depth_mm: Length
) -> Length:
    """Signed diameter of the blur circle on the sensor, equation 2: D s (1/f - 1/u - 1/s).

    ``aperture_mm`` is the diameter D and ``sensor_mm`` the sensor's distance s.  Positive for
    points farther than what the sensor is focused on, negative for nearer ones.
    """
    return aperture_mm * sensor_mm * (1 / focal_length_mm - 1 / depth_mm - 1 / sensor_mm)

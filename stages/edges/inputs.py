"""The depth that edges and regions can use, from what the sensor gives."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from .planes import Camera


def best_depth(inputs: Mapping[str, Any]) -> tuple[np.ndarray | None, Camera | None]:
    """Depth [H W] and the camera to interpret it with.

    Metres with a camera where the sensor is calibrated; else relative depth (steps and creases
    show in any unit) and no camera, for without metres there are no planes in space; else
    neither.
    """
    depth_m, camera = inputs.get("depth_m"), inputs.get("near_camera")
    if (
        depth_m is not None
        and camera is not None
        and (camera.height, camera.width) == depth_m.shape
        and np.isfinite(depth_m).any()
    ):
        matrix = camera.K
        return depth_m, Camera(matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    relative = inputs.get("depth_relative")
    if relative is not None and np.isfinite(relative).any():
        return relative, None
    return None, None

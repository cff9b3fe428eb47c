"""Results as plain RGB images, without Rerun: what the stages log and what a gallery shows."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

UNKNOWN_COLOUR = (62, 62, 70)
DARK = (14, 14, 16)
_SHADOW_COLOUR = (95, 95, 105)
_GOLDEN = 0.618033988749895
_OVERLAY = 0.55


def linked_rgb(step: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """Lines [H W] by the step that drew them: the paper shades its links (figure 7)."""
    from .edges.linking import Step

    rgb = np.full((*step.shape, 3), DARK, np.uint8)
    rgb[lines] = _SHADOW_COLOUR
    for first, colour in (
        (Step.LOW, (255, 255, 255)),
        (Step.LINK, (255, 150, 40)),
        (Step.CREASE, (80, 160, 255)),
    ):
        rgb[lines & (step >= first)] = colour
    return rgb


def depth_rgb(depth: np.ndarray, near: float, far: float) -> np.ndarray:
    """Depth [H W] in Turbo from ``near`` (red) to ``far`` (blue), grey where unknown."""
    known = np.isfinite(depth)
    share = (far - np.where(known, depth, far)) / max(far - near, 1e-9)
    rgb = cv2.applyColorMap((255 * np.clip(share, 0, 1)).astype(np.uint8), cv2.COLORMAP_TURBO)
    rgb = np.ascontiguousarray(rgb[..., ::-1])
    rgb[~known] = UNKNOWN_COLOUR
    return rgb


def regions_rgb(intensity: np.ndarray, labels: np.ndarray, regions: Any) -> np.ndarray:
    """Regions [H W] in colours over the intensity; the background is left grey."""
    grey = cv2.convertScaleAbs(intensity, alpha=255 / max(float(intensity.max()), 1e-6))
    rgb = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB).astype(np.float32)
    numbers = np.arange(len(regions) + 1)
    hsv = np.full((1, len(numbers), 3), 235, np.uint8)
    hsv[0, :, 0] = numbers * _GOLDEN % 1.0 * 180
    hsv[0, :, 1] = 190
    table = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    coloured = np.r_[False, ~regions["background"]]
    shown = coloured[labels]
    rgb[shown] = (1 - _OVERLAY) * rgb[shown] + _OVERLAY * table[labels[shown]]
    return np.clip(rgb, 0, 255).astype(np.uint8)

"""Small synthetic scenes with depth for tests: no recording is needed, nothing is tuned to one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from scipy import ndimage

from workbench_stages.edges import operators


def scene(shape: tuple[int, int] = (160, 200), seed: int = 0, noise: float = 1.0):
    """A dark table with bright boxes, one pair told apart by depth alone.

    Returns (image uint8 [H W], depth_m float32 [H W] NaN on the table, faces int [H W], 0 = table).
    """
    rng = np.random.default_rng(seed)
    h, w = shape
    yy, xx = np.mgrid[:h, :w].astype(float)
    level = np.full(shape, 14.0)
    depth = np.full(shape, 0.795)
    faces = np.zeros(shape, int)
    parts = (
        (0.22, 0.30, 28, 20, 0.3, 150, 0.76),
        (0.70, 0.28, 24, 30, 1.1, 110, 0.75),
        (0.30, 0.74, 36, 22, -0.2, 130, 0.77),
        (0.55, 0.70, 22, 22, -0.2, 130, 0.745),
        (0.82, 0.74, 18, 24, 0.7, 180, 0.74),
    )
    for number, (cx, cy, a, b, turn, grey, z) in enumerate(parts, start=1):
        dx, dy = xx - cx * w, yy - cy * h
        u = np.cos(turn) * dx + np.sin(turn) * dy
        v = -np.sin(turn) * dx + np.cos(turn) * dy
        inside = (abs(u) < a) & (abs(v) < b)
        level[inside], depth[inside], faces[inside] = grey, z, number
    image = ndimage.gaussian_filter(level, 0.8)
    image += rng.normal(0, noise, shape) * np.sqrt(0.2 + image / 150)
    seen = depth + ndimage.gaussian_filter(rng.normal(0, 1, shape), 2.5) * 1e-3
    seen[faces == 0] = np.nan
    return np.clip(np.round(image), 0, 255).astype(np.uint8), seen.astype(np.float32), faces


def eight(array: np.ndarray):
    """The array under the eight turns and mirrors of the square, as contiguous copies."""
    for mirrored in (array, array.T):
        for quarter in range(4):
            yield np.ascontiguousarray(np.rot90(mirrored, quarter))


def lines_of(shape: tuple[int, int], lengths: list[int]) -> np.ndarray:
    """Level lines of these lengths in pixels, from column 4 on, in rows 10, 20, …; bool [H W]."""
    image = np.zeros(shape, bool)
    for number, length in enumerate(lengths, start=1):
        image[10 * number, 4 : 4 + length] = True
    return image


def lines_facing(shape: tuple[int, int], distance: int) -> np.ndarray:
    """Two pieces of one level line in row 30, whose ends lie ``distance`` pixels apart from 20."""
    image = np.zeros(shape, bool)
    image[30, 2:21] = True
    image[30, 20 + distance : 20 + distance + 20] = True
    return image


@contextmanager
def planted_operator() -> Iterator[None]:
    """The operator ``planted``: 10 to the right wherever the image is not 9; bright as it is."""

    @operators.register("planted", greatest=10.0)
    def planted(image):
        gx = np.where(image != 9, np.float32(10), np.float32(0))
        return gx, np.zeros_like(gx), image

    try:
        yield
    finally:
        del operators.OPERATORS["planted"]

"""Contours of random shapes with gaps cut into them, to test linking on (issue 3, item 3)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy import ndimage
from skimage.draw import line


def contour(rng: np.random.Generator, curve: bool, size: int = 256) -> np.ndarray:
    """Pixels of a closed contour in order, [N 2] int (x, y): a polygon or a smooth curve."""
    centre = size / 2 + rng.uniform(-20, 20, 2)
    if curve:
        t = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
        r = np.full_like(t, rng.uniform(35, 80))
        for k in range(2, 6):
            r += rng.normal(0, 8 / k) * np.cos(k * t + rng.uniform(0, 2 * np.pi))
        points = centre + np.column_stack([r * np.cos(t), r * np.sin(t)])
    else:
        n = int(rng.integers(3, 9))
        a = np.sort(rng.uniform(0, 2 * np.pi, n))
        r = rng.uniform(45, 95, n)
        points = centre + np.column_stack([r * np.cos(a), r * np.sin(a)])
    corners = np.round(np.vstack([points, points[:1]])).astype(int)
    path: list[tuple[int, int]] = []
    for (x0, y0), (x1, y1) in pairwise(corners):
        ys, xs = line(y0, x0, y1, x1)
        path += list(zip(xs.tolist(), ys.tolist(), strict=True))[:-1]
    # Drop doubled pixels and the inner pixel of right-angled steps: one pixel thin, as edges are.
    thin: list[tuple[int, int]] = []
    for p in path:
        if thin and p == thin[-1]:
            continue
        if len(thin) > 1 and max(abs(p[0] - thin[-2][0]), abs(p[1] - thin[-2][1])) <= 1:
            thin.pop()
        thin.append(p)
    return np.array(thin)


def cut(rng: np.random.Generator, path: np.ndarray, gap: int, count: int = 3):
    """Cut ``count`` gaps of ``gap`` pixels; returns (cut image, whole image, list of gaps).

    A gap is the pixels taken out with the two that are left at its ends.
    """
    whole = np.zeros((256, 256), bool)
    whole[path[:, 1], path[:, 0]] = True
    broken = whole.copy()
    gaps = []
    n = len(path)
    first = int(rng.integers(n))
    for k in range(count):
        start = first + k * n // count + int(rng.integers(0, max(n // count - gap - 24, 1)))
        index = np.arange(start - 1, start + gap + 1) % n
        piece = path[index]
        broken[piece[1:-1, 1], piece[1:-1, 0]] = False
        gaps.append(piece)
    return broken, whole, gaps


def healed(linked: np.ndarray, piece: np.ndarray) -> bool:
    """Are both ends of a gap joined within the gap's surroundings (its box and 3 pixels)?"""
    x0, y0 = piece.min(axis=0) - 3
    x1, y1 = piece.max(axis=0) + 4
    box = linked[max(y0, 0) : y1, max(x0, 0) : x1]
    labels, _ = ndimage.label(box, np.ones((3, 3)))
    ends = [labels[y - max(y0, 0), x - max(x0, 0)] for x, y in (piece[0], piece[-1])]
    return bool(ends[0] and ends[0] == ends[1])


def measure(link, gap: int, shapes: int = 60, seed: int = 0) -> tuple[float, float]:
    """Share of gaps healed and share of added pixels within 2 px of the true contour."""
    rng = np.random.default_rng([seed, gap])
    good = total = near = added = 0
    for k in range(shapes):
        path = contour(rng, curve=bool(k % 2))
        if path.min() < 4 or path.max() > 251 or len(path) < 3 * (gap + 30):
            continue
        broken, whole, gaps = cut(rng, path, gap)
        result = link(broken)
        good += sum(healed(result, piece) for piece in gaps)
        total += len(gaps)
        new = result & ~broken
        away = ndimage.distance_transform_edt(~whole)
        near += int((away[new] <= 2).sum())
        added += int(new.sum())
    return good / total, near / max(added, 1)

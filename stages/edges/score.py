"""Edges and regions against the faces of the ground truth (issue 3, item 2).

A *face* is a pair (instance, face): the recording's face ids are unique within an instance only.
It is one face even where something in front cuts it into parts (then no closed region can cover
it whole; that is why even perfect edges do not reach 100 %).  Instance 0 is the table and no face.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

__all__ = [
    "EdgeScore", "FaceScore", "edge_score", "face_boundaries", "face_ids", "region_score",
    "summarise",
]  # fmt: skip

Bool = NDArray[np.bool_]


def face_ids(instances: np.ndarray, faces: np.ndarray) -> NDArray[np.int64]:
    """One id per (instance, face), [H W]; the table (instance 0) is 0 whatever its face id."""
    if instances.shape != faces.shape:
        raise ValueError(f"instances {instances.shape} and faces {faces.shape} differ in shape")
    ids = instances.astype(np.int64) * 65536 + faces.astype(np.int64) + 1
    return np.where(instances == 0, 0, ids)


def face_boundaries(ids: np.ndarray) -> Bool:
    """True boundaries, [H W] bool: a pixel whose right or lower neighbour is of another face."""
    out = np.zeros(ids.shape, np.bool_)
    out[:, :-1] |= ids[:, 1:] != ids[:, :-1]
    out[:-1] |= ids[1:] != ids[:-1]
    return out


@dataclass(frozen=True)
class EdgeScore:
    """Counts, so that frames add up: edge pixels, those near a boundary, and the reverse."""

    edge_px: int
    edge_hit: int
    boundary_px: int
    boundary_hit: int

    @property
    def precision(self) -> float:
        """Share of edge pixels within the tolerance of a boundary (NaN without edges)."""
        return self.edge_hit / self.edge_px if self.edge_px else float("nan")

    @property
    def recall(self) -> float:
        """Share of boundary pixels within the tolerance of an edge (NaN without boundaries)."""
        return self.boundary_hit / self.boundary_px if self.boundary_px else float("nan")

    def __add__(self, other: EdgeScore) -> EdgeScore:
        return EdgeScore(*(getattr(self, f.name) + getattr(other, f.name) for f in fields(self)))


def edge_score(edges: Bool, boundaries: Bool, tolerance_px: float = 2.0) -> EdgeScore:
    """Edges against true boundaries, both [H W] bool, by Euclidean distance up to a tolerance."""

    def near(of: Bool, to: Bool) -> int:
        if not to.any():
            return 0
        return int((ndimage.distance_transform_edt(~to)[of] <= tolerance_px).sum())

    return EdgeScore(
        int(edges.sum()), near(edges, boundaries), int(boundaries.sum()), near(boundaries, edges)
    )


@dataclass(frozen=True)
class FaceScore:
    """Faces of one frame against its regions.

    Attributes:
        face: [F] int64 ids; area: [F] pixels; best_iou: [F] IoU with the face's best region;
        covered: [F] bool, another object or the picture's border hides a part of the face;
        leaks: regions that hold a good part of two faces; splits: faces in several regions.
    """

    face: NDArray[np.int64]
    area: NDArray[np.int64]
    best_iou: NDArray[np.float64]
    covered: Bool
    leaks: int
    splits: int


def region_score(
    labels: np.ndarray,
    ids: np.ndarray,
    depth_m: np.ndarray | None = None,
    min_area: int = 150,
    share: float = 0.25,
) -> FaceScore:
    """Compare regions with the faces of more than ``min_area`` pixels.

    A face is covered if along its outline another object is in front of it (by more than 1 mm in
    the true depth; without depth, if it touches another object at all), or if it reaches the
    border of the image.  A region *leaks* if it takes ``share`` or more of the area of each of
    two faces, or of a face and of an equal area of the table; a face is *split* if two or more
    regions each lie mostly in it and have ``share`` of it.

    Args:
        labels: [H W] int, 0 = no region; ids: [H W] from :func:`face_ids`.
        depth_m: [H W] true depth.
        min_area: pixels; faces of more count.
    """
    unique, inverse = np.unique(ids, return_inverse=True)
    inverse = inverse.reshape(ids.shape)
    area = np.bincount(inverse.ravel(), minlength=len(unique))
    n_labels = int(labels.max(initial=0)) + 1
    joint = np.bincount(
        inverse.ravel() * n_labels + labels.ravel().astype(np.int64),
        minlength=len(unique) * n_labels,
    ).reshape(len(unique), n_labels)
    regions = joint.sum(axis=0)
    iou = joint / np.maximum(area[:, None] + regions[None] - joint, 1)
    iou[:, 0] = 0
    keep = np.flatnonzero((area > min_area) & (unique != 0))

    instance = ids // 65536
    hidden = np.zeros(len(unique), np.bool_)
    for axis in (0, 1):
        for flip in (False, True):
            a, b = np.moveaxis(ids, axis, 0)[:-1], np.moveaxis(ids, axis, 0)[1:]
            ia, ib = np.moveaxis(instance, axis, 0)[:-1], np.moveaxis(instance, axis, 0)[1:]
            if flip:
                a, b, ia, ib = b, a, ib, ia
            over = (ia != ib) & (ib != 0) & (ia != 0)
            if depth_m is not None:
                z = np.moveaxis(depth_m, axis, 0)
                za, zb = (z[1:], z[:-1]) if flip else (z[:-1], z[1:])
                over &= zb < za - 1e-3
            hidden[np.searchsorted(unique, np.unique(a[over]))] = True
    rim = np.concatenate([ids[0], ids[-1], ids[:, 0], ids[:, -1]])
    hidden[np.searchsorted(unique, np.unique(rim))] = True

    of_face = joint[keep] / np.maximum(area[keep, None], 1)
    of_face[:, 0] = 0
    table = joint[unique == 0].sum(axis=0)
    leaks = 0
    for r in range(1, n_labels):
        good = of_face[:, r] >= share
        least = joint[keep, r][good].min() if good.any() else 0
        leaks += bool(good.sum() >= 2 or (good.any() and table[r] >= least))
    mostly = joint[keep] >= 0.5 * np.maximum(regions[None], 1)
    splits = int((((of_face >= share) & mostly).sum(axis=1) >= 2).sum())
    return FaceScore(
        unique[keep], area[keep], iou[keep].max(axis=1, initial=0), hidden[keep], leaks, splits
    )


def summarise(scores: Sequence[FaceScore], found_iou: float = 0.7) -> dict[str, float]:
    """Figures over frames: faces, share found, mean IoU, the same for uncovered faces, leaks…"""
    iou = np.concatenate([s.best_iou for s in scores]) if scores else np.empty(0)
    free = ~np.concatenate([s.covered for s in scores]) if scores else np.empty(0, np.bool_)

    def mean(values: np.ndarray) -> float:
        return float(values.mean()) if values.size else float("nan")

    return {
        "faces": float(iou.size),
        "found": mean(iou >= found_iou),
        "mean_iou": mean(iou),
        "uncovered": float(free.sum()),
        "uncovered_found": mean(iou[free] >= found_iou),
        "uncovered_mean_iou": mean(iou[free]),
        "leaks": float(sum(s.leaks for s in scores)),
        "splits": float(sum(s.splits for s in scores)),
    }

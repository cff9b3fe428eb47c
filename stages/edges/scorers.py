"""Edges and regions against the faces of the ground truth, over the frames of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, astuple
from typing import Any

import numpy as np

from workbench.stage import Score, Scorer

from .score import (
    EdgeScore,
    FaceScore,
    edge_score,
    face_boundaries,
    face_ids,
    region_score,
    summarise,
)

TOLERANCE_PX = 2
MIN_FACE_PX = 150
FOUND_IOU = 0.7


class EdgeScorer(Scorer):
    """Precision and recall of edge images at ±2 px against face boundaries.

    ``images`` maps artifact names to what they are called in the table.
    """

    def __init__(self, images: Mapping[str, str]) -> None:
        self.images = dict(images)
        self.totals: dict[str, EdgeScore] = {}

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        if not _has_faces(truth, next(iter(self.images)), artifacts):
            return {}
        boundaries = face_boundaries(face_ids(truth.instances, truth.faces))
        own: dict[str, float] = {}
        for artifact, name in self.images.items():
            score = edge_score(artifacts[artifact], boundaries, TOLERANCE_PX)
            before = self.totals.get(artifact)
            self.totals[artifact] = score if before is None else before + score
            key = name.replace(" ", "_")
            own[f"{key}_precision"] = score.precision
            own[f"{key}_recall"] = score.recall
        return own

    def summary(self) -> list[Score]:
        scores = []
        for artifact, total in self.totals.items():
            name = self.images[artifact]
            note = f"±{TOLERANCE_PX} px of face boundaries"
            scores += [
                Score(f"{name}, precision", total.precision, note=note, better="higher"),
                Score(f"{name}, recall", total.recall, note=note, better="higher"),
            ]
        return scores

    def state(self) -> dict[str, Any]:
        return {artifact: astuple(total) for artifact, total in self.totals.items()}

    def take(self, state: Mapping[str, Any]) -> None:
        for artifact, counts in state.items():
            score, before = EdgeScore(*counts), self.totals.get(artifact)
            self.totals[artifact] = score if before is None else before + score


class RegionScorer(Scorer):
    """Share of faces found as one region, overlap, leaks and splits."""

    def __init__(self) -> None:
        self.frames: list[FaceScore] = []

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        if not _has_faces(truth, "labels", artifacts):
            return {}
        ids = face_ids(truth.instances, truth.faces)
        score = region_score(artifacts["labels"], ids, truth.depth_m, MIN_FACE_PX)
        self.frames.append(score)
        if not score.area.size:
            return {}
        own = summarise([score], FOUND_IOU)
        return {"faces_found": own["found"], "mean_iou": own["mean_iou"]}

    def summary(self) -> list[Score]:
        if not self.frames:
            return []
        total = summarise(self.frames, FOUND_IOU)
        faces = f"{total['faces']:.0f} faces over {MIN_FACE_PX} px"
        free = f"{total['uncovered']:.0f} faces that nothing covers"
        return [
            Score(f"faces found (IoU ≥ {FOUND_IOU})", total["found"], note=faces, better="higher"),
            Score("mean IoU", total["mean_iou"], note=faces, better="higher"),
            Score("uncovered faces found", total["uncovered_found"], note=free, better="higher"),
            Score("uncovered mean IoU", total["uncovered_mean_iou"], note=free, better="higher"),
            Score("leaks", total["leaks"], "regions", note="over two faces", better="lower"),
            Score("splits", total["splits"], "faces", note="in several regions", better="lower"),
        ]

    def state(self) -> dict[str, Any]:
        return {"frames": [asdict(frame) for frame in self.frames]}

    def take(self, state: Mapping[str, Any]) -> None:
        self.frames += [FaceScore(**frame) for frame in state["frames"]]


def _has_faces(truth: Any, artifact: str, artifacts: Mapping[str, Any]) -> bool:
    if truth.instances is None or truth.faces is None or truth.meta.get("kind") == "grid":
        return False
    if truth.instances.shape != artifacts[artifact].shape:
        return False
    # A bare plane has no boundary to find.
    return bool(truth.instances.any() and np.ptp(face_ids(truth.instances, truth.faces)) > 0)

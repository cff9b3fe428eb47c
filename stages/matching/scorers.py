"""Verdicts and poses against ground truth, over the frames of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from stages.edges.planes import Camera, fit_plane
from stages.matching.surfaces import shortest_turn
from workbench.stage import Score, Scorer

__all__ = ["PoseScorer", "RecognitionScorer", "covered_px", "truth_of_surface"]

_STEP_M = 1e-3
_COVERED_PX = 10
_CORNER = np.diag([1.0, -1.0, -1.0])
"""camera_from_object of a part that lies on its default face, not turned."""


def covered_px(instances: np.ndarray, depth_m: np.ndarray, own: int) -> int:
    """Pixels of an object's outline where another object is in front of it by over 1 mm."""
    count = 0
    for axis in (0, 1):
        a, z = np.moveaxis(instances, axis, 0), np.moveaxis(depth_m, axis, 0)
        for one, other in ((slice(-1), slice(1, None)), (slice(1, None), slice(-1))):
            beside = (a[one] == own) & (a[other] != own) & (a[other] != 0)
            count += int((beside & (z[other] < z[one] - _STEP_M)).sum())
    return count


def _names(truth: Any) -> dict[int, str]:
    objects = truth.meta.get("objects")
    if not isinstance(objects, list):
        return {}
    return {int(o["id"]): str(o["name"]) for o in objects if "id" in o and "name" in o}


def _owner(truth: Any, labels: np.ndarray, label: int) -> int:
    """The object that most of a region shows; 0 is the table."""
    return int(np.bincount(truth.instances[labels == label]).argmax())


class RecognitionScorer(Scorer):
    """Picks of uncovered parts that are named rightly, wrong names, and rearrangements."""

    def __init__(self) -> None:
        self.frames = self.picks = self.right = self.good = self.wrong = 0

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        verdict = artifacts["verdict"]
        names = _names(truth)
        if verdict is None or truth.instances is None or not names:
            return {}
        self.frames += 1
        if verdict["verdict"] != "pick":
            return {"good_pick": 0.0, "wrong_name": 0.0}
        self.picks += 1
        own = _owner(truth, artifacts["labels"], verdict["region"])
        right = names.get(own) == verdict["object"]
        free = truth.depth_m is None or (
            covered_px(truth.instances, truth.depth_m, own) < _COVERED_PX
        )
        self.right += right
        self.wrong += not right
        self.good += right and free
        return {"good_pick": float(right and free), "wrong_name": float(not right)}

    def summary(self) -> list[Score]:
        if not self.frames:
            return []
        of = f"of {self.frames} frames"
        return [
            Score(
                "picked part uncovered and named rightly",
                self.good / self.frames,
                note=of,
                better="higher",
            ),
            Score("named rightly", self.right / self.frames, note=of, better="higher"),
            Score("wrong names", float(self.wrong), "frames", note=of, better="lower"),
            Score("rearrange", float(self.frames - self.picks), "frames", note=of, better="lower"),
        ]

    def state(self) -> dict[str, Any]:
        return dict(vars(self))

    def take(self, state: Mapping[str, Any]) -> None:
        for name, count in state.items():
            setattr(self, name, getattr(self, name) + count)


def truth_of_surface(
    truth: Any, labels: np.ndarray, label: int, camera: Camera
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None] | None:
    """Centroid [3] (m), normal [3] and object rotation [3 3] of the face that a region shows.

    Of the true face as far as it is seen; None without the ground truth that this takes.
    """
    if truth.instances is None or truth.faces is None or truth.depth_m is None:
        return None
    own = _owner(truth, labels, label)
    of_region = (labels == label) & (truth.instances == own)
    if own == 0:
        return None
    face = int(np.bincount(truth.faces[of_region]).argmax())
    rows, columns = np.nonzero((truth.instances == own) & (truth.faces == face))
    z = truth.depth_m[rows, columns].astype(np.float64)
    rx, ry = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    points = np.stack([rx * z, ry * z, z], axis=1)[z > 0]
    plane = fit_plane(points)
    if plane is None:
        return None
    slant = np.abs(plane.normal @ np.stack([rx, ry, np.ones_like(rx)]))[z > 0]
    weight = points[:, 2] ** 2 / np.maximum(slant, 1e-6)
    centroid = weight @ points / weight.sum()
    rotation = next(
        (
            matrix[:3, :3]
            for name, matrix in truth.camera_from_object.items()
            if name.startswith(f"object_{own}_")
        ),
        None,
    )
    return centroid, plane.normal, rotation


class PoseScorer(Scorer):
    """Rotation (modulo the symmetry that training found), normal and centroid of each pose.

    Rotation is scored where the pose's face is the one on which the part was trained, or the
    opposite one: of the others the recording does not say which way is 0.
    """

    def __init__(self) -> None:
        self.poses = 0
        self.errors: dict[str, list[float]] = {}

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        camera_info = artifacts.get("near_camera")
        if camera_info is None or not artifacts["poses"]:
            return {}
        K = camera_info.K
        camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        own: dict[str, float] = {}
        for pose in artifacts["poses"]:
            known = truth_of_surface(truth, artifacts["labels"], pose["region"], camera)
            if known is None:
                continue
            self.poses += 1
            centroid, normal, rotation = known
            matrix = np.array(pose["camera_from_surface"])
            turn = rotation_error_deg(matrix[:3, :3], normal, rotation, pose)
            off = matrix[:3, 3] - centroid
            across = (matrix[:2, 3] / matrix[2, 3] - centroid[:2] / centroid[2]) * np.array(
                [K[0, 0], K[1, 1]]
            )
            tilt = np.degrees(np.arccos(np.clip(matrix[:3, 2] @ normal, -1, 1)))
            found = {
                "normal_error_deg": float(tilt),
                "along_axis_error_mm": float(abs(1e3 * off[2])),
                "across_error_px": float(np.linalg.norm(across)),
            }
            if turn is not None:
                found["rotation_error_deg"] = turn
            for key, value in found.items():
                self.errors.setdefault(key, []).append(value)
            own = found
        return own

    def summary(self) -> list[Score]:
        scores = []
        for key, title, unit in (
            ("rotation_error_deg", "rotation", "°"),
            ("normal_error_deg", "normal", "°"),
            ("along_axis_error_mm", "centroid along the axis", "mm"),
            ("across_error_px", "centroid across the axis", "px"),
        ):
            values = self.errors.get(key)
            if not values:
                continue
            share = len(values) / max(self.poses, 1)
            note = "modulo the part's period" if key.startswith("rotation") else ""
            scores += [
                Score(f"{title}, {which} error", float(of(values)), unit, share, note, "lower")
                for which, of in (("mean", np.mean), ("worst", np.max))
            ]
        return scores

    def state(self) -> dict[str, Any]:
        return {"poses": self.poses, "errors": self.errors}

    def take(self, state: Mapping[str, Any]) -> None:
        self.poses += state["poses"]
        for key, values in state["errors"].items():
            self.errors.setdefault(key, []).extend(values)


def rotation_error_deg(
    rotation: np.ndarray, normal: np.ndarray, object_rotation: np.ndarray | None, pose: Any
) -> float | None:
    """Error of a pose's turn about the normal, degrees; None where the truth does not tell it.

    The object's true rotation carries the frame that its face had in training, at angle 0.
    """
    if object_rotation is None or pose["mirrored"]:
        return None
    candidates = []
    # A part that lies on the opposite face looks the same if that face does.
    for flip in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
        from_training = object_rotation @ flip @ _CORNER.T
        before = from_training.T @ normal
        if before[2] > -0.5:
            continue
        true_frame = from_training @ shortest_turn(before)
        difference = true_frame.T @ rotation
        turn = np.degrees(
            np.arctan2(difference[1, 0] - difference[0, 1], difference[0, 0] + difference[1, 1])
        )
        period = pose["period_deg"]
        candidates.append(abs((turn + period / 2) % period - period / 2))
        break
    return float(candidates[0]) if candidates else None

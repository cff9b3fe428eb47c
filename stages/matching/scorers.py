"""Verdicts and poses against ground truth, over the frames of a recording."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.stage import Score, Scorer

from ..edges.planes import Camera, fit_plane
from .surfaces import shortest_turn

__all__ = ["PoseScorer", "RecognitionScorer", "covered_px", "truth_of_surface"]

F64 = NDArray[np.float64]

_STEP_M = 1e-3
_COVERED_PX = 10
_CORNER = np.diag([1.0, -1.0, -1.0])
"""camera_from_object of a part that lies on its default face, not turned."""

_FLAT_DEG = 3.0
_TILTED_DEG = 25.5
"""Up to 25° the paper tilts its parts (section 7); the half degree is what a table may lean."""

_COVERED_BINS = (0.05, 0.10, 0.20, 0.35, 0.60)
_PUBLISHED_COVERED = 0.20
"""Up to this share of the surface covered the paper recognises the topmost part (section 7)."""

_SAME_FACE_DEG = 60.0
"""A face turned farther from how the part lay in training is another face."""


_SAME_AREA = 1.1
"""A face that is larger than this many times the trained one is the opposite face, and another."""


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


@dataclass(frozen=True)
class TrueFace:
    """A face of the ground truth as far as it is seen.

    Attributes:
        mask: [H W] bool, its pixels.
        centroid_m, normal: [3], of the plane through them, towards the camera.
        area_mm2: of what is seen of it.
    """

    mask: NDArray[np.bool_]
    centroid_m: F64
    normal: F64
    area_mm2: float


def _true_face(truth: Any, own: int, face: int, camera: Camera) -> TrueFace | None:
    mask = (truth.instances == own) & (truth.faces == face)
    rows, columns = np.nonzero(mask)
    z = truth.depth_m[rows, columns].astype(np.float64)
    rx, ry = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    points = np.stack([rx * z, ry * z, z], axis=1)[z > 0]
    plane = fit_plane(points)
    if plane is None:
        return None
    slant = np.abs(plane.normal @ np.stack([rx, ry, np.ones_like(rx)]))[z > 0]
    # A pixel shows this much of the plane: its solid angle over the cosine of the view.
    weight = points[:, 2] ** 2 / np.maximum(slant, 1e-6)
    area_mm2 = 1e6 * float(weight.sum()) / (camera.fx * camera.fy)
    return TrueFace(mask, weight @ points / weight.sum(), plane.normal, area_mm2)


def truth_of_surface(
    truth: Any, labels: np.ndarray, label: int, camera: Camera
) -> tuple[TrueFace, F64 | None] | None:
    """The true face that a region shows, and its object's rotation [3 3] (camera from object).

    None without the ground truth that this takes.
    """
    if truth.instances is None or truth.faces is None or truth.depth_m is None:
        return None
    own = _owner(truth, labels, label)
    if own == 0:
        return None
    of_region = (labels == label) & (truth.instances == own)
    face = _true_face(truth, own, int(np.bincount(truth.faces[of_region]).argmax()), camera)
    return None if face is None else (face, _rotation(truth, own))


def _rotation(truth: Any, own: int) -> F64 | None:
    for name, matrix in truth.camera_from_object.items():
        if name.startswith(f"object_{own}_"):
            return np.asarray(matrix[:3, :3], np.float64)
    return None


def _from_training(object_rotation: F64, normal: F64) -> F64 | None:
    """The turn [3 3] of a part from how it lay in training at angle 0; None for another face.

    A part that lies on the opposite face looks the same if that face does.
    """
    for flip in (np.eye(3), np.diag([1.0, -1.0, -1.0])):
        turn = object_rotation @ flip @ _CORNER.T
        before = turn.T @ normal
        if before[2] < -np.cos(np.radians(_SAME_FACE_DEG)):
            return turn
    return None


def _named(row: Any, database: Any) -> int:
    """The model that a candidate was named after, picked or not; -1 for none."""
    if row["distance"] <= database.phi:
        return int(row["model"])
    return int(row["visible_model"])


class RecognitionScorer(Scorer):
    """Picks of uncovered parts, wrong names, and how recognition holds as occlusion grows.

    For the last, every part that lies as in training, tilted up to 25° at most, is looked up
    among the candidates: how much of its surface is covered is known from what is seen of it and
    the area that training measured.  *Recognised* is a surface that the right part's name was found
    for, by its features under φ or by what shows of it, whether or not the bench would pick it.
    """

    def __init__(self) -> None:
        self.frames = self.picks = self.right = self.good = self.wrong = 0
        bins = len(_COVERED_BINS) + 1
        self.surfaces, self.recognised, self.misnamed = np.zeros((3, bins), np.int64)

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        verdict = artifacts["verdict"]
        names = _names(truth)
        if verdict is None or truth.instances is None or not names:
            return {}
        self.frames += 1
        self._add_surfaces(truth, artifacts, names)
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

    def _add_surfaces(
        self, truth: Any, artifacts: Mapping[str, Any], names: Mapping[int, str]
    ) -> None:
        database, recorded = artifacts.get("models"), artifacts.get("near_camera")
        if database is None or recorded is None or truth.faces is None or truth.depth_m is None:
            return
        camera = Camera(recorded.K[0, 0], recorded.K[1, 1], recorded.K[0, 2], recorded.K[1, 2])
        for own, name in names.items():
            rotation = _rotation(truth, own)
            if name not in database.names or rotation is None:
                continue
            face = self._trained_face(truth, own, rotation, camera)
            if face is None:
                continue
            whole = float(np.median(database.parts[database.names.index(name)].features[:, 0]))
            if face.area_mm2 > _SAME_AREA * whole:
                continue
            covered = float(np.clip(1 - face.area_mm2 / whole, 0, 1))
            k = int(np.searchsorted(_COVERED_BINS, covered, side="right"))
            self.surfaces[k] += 1
            shown = np.bincount(artifacts["labels"][face.mask])
            candidates = artifacts["candidates"]
            row = candidates[candidates["label"] == shown.argmax()]
            model = _named(row[0], database) if shown.argmax() and len(row) else -1
            if model >= 0:
                right = database.names[model] == name
                self.recognised[k] += right
                self.misnamed[k] += not right

    @staticmethod
    def _trained_face(truth: Any, own: int, rotation: F64, camera: Camera) -> TrueFace | None:
        """The face that lay upwards in training, if the part is tilted by 25° at most."""
        for face in np.unique(truth.faces[truth.instances == own]):
            seen = _true_face(truth, own, int(face), camera)
            turn = None if seen is None else _from_training(rotation, seen.normal)
            if turn is not None and turn[2, 2] >= np.cos(np.radians(_TILTED_DEG)):
                return seen
        return None

    def summary(self) -> list[Score]:
        if not self.frames:
            return []
        of = f"of {self.frames} frames"
        scores = [
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
        low = 0.0
        for k, high in enumerate((*_COVERED_BINS, 1.0)):
            if self.surfaces[k]:
                scores.append(
                    Score(
                        f"recognised, {100 * low:.0f} to {100 * high:.0f} % covered",
                        float(self.recognised[k] / self.surfaces[k]),
                        note=f"of {self.surfaces[k]} surfaces; {self.misnamed[k]} misnamed",
                        better="higher",
                        published="recognised" if high <= _PUBLISHED_COVERED else "not promised",
                    )
                )
            low = high
        return scores

    def state(self) -> dict[str, Any]:
        return {
            name: value.tolist() if isinstance(value, np.ndarray) else value
            for name, value in vars(self).items()
        }

    def take(self, state: Mapping[str, Any]) -> None:
        for name, count in state.items():
            setattr(self, name, getattr(self, name) + np.array(count))


@dataclass
class _Errors:
    """Magnitudes of errors in bounded memory."""

    count: int = 0
    total: float = 0.0
    worst: float = 0.0

    def add(self, error: float) -> None:
        self.count += 1
        self.total += error
        self.worst = max(self.worst, error)

    def take(self, state: Sequence[float]) -> None:
        count, total, worst = state
        self.count += int(count)
        self.total += total
        self.worst = max(self.worst, worst)

    def scores(self, title: str, unit: str, note: str, share: float, published: str) -> list[Score]:
        mean = self.total / self.count
        return [
            Score(f"{title}, mean error", mean, unit, share, note, "lower", published),
            Score(f"{title}, worst error", self.worst, unit, share, note, "lower", published),
        ]


@dataclass
class _Rotations:
    """Errors of rotation by part and by tilt, with each part's period."""

    by_tilt: dict[str, _Errors] = field(default_factory=dict)
    by_part: dict[str, _Errors] = field(default_factory=dict)
    period_deg: dict[str, float] = field(default_factory=dict)

    def add(self, pose: Mapping[str, Any], tilt_deg: float, error_deg: float) -> None:
        name = pose["object"]
        self.by_tilt.setdefault(_tilt_class(tilt_deg), _Errors()).add(error_deg)
        self.by_part.setdefault(name, _Errors()).add(error_deg)
        self.period_deg[name] = pose["period_deg"]


def _tilt_class(tilt_deg: float) -> str:
    if tilt_deg <= _FLAT_DEG:
        return "flat"
    return f"tilted up to {int(_TILTED_DEG)}°" if tilt_deg <= _TILTED_DEG else "tilted farther"


class PoseScorer(Scorer):
    """Rotation (modulo the symmetry that training found), normal and centroid of each pose.

    Rotation is scored where the pose's face is the one on which the part was trained, or the
    opposite one: of the others the recording does not say which way is 0.  A pose that says that
    its rotation is open is counted, and has no error.
    """

    def __init__(self) -> None:
        self.poses = 0
        self.open = 0
        self.rotations = _Rotations()
        self.errors: dict[str, _Errors] = {}

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        recorded = artifacts.get("near_camera")
        if recorded is None or not artifacts["poses"]:
            return {}
        K = recorded.K
        camera = Camera(K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        own: dict[str, float] = {}
        for pose in artifacts["poses"]:
            known = truth_of_surface(truth, artifacts["labels"], pose["region"], camera)
            if known is None:
                continue
            self.poses += 1
            face, rotation = known
            matrix = np.array(pose["camera_from_surface"])
            off = matrix[:3, 3] - face.centroid_m
            across = (
                matrix[:2, 3] / matrix[2, 3] - face.centroid_m[:2] / face.centroid_m[2]
            ) * np.array([K[0, 0], K[1, 1]])
            own = {
                "normal_error_deg": float(
                    np.degrees(np.arccos(np.clip(matrix[:3, 2] @ face.normal, -1, 1)))
                ),
                "along_axis_error_mm": float(abs(1e3 * off[2])),
                "across_error_px": float(np.linalg.norm(across)),
            }
            for key, value in own.items():
                self.errors.setdefault(key, _Errors()).add(value)
            if pose["open_rotations_deg"]:
                self.open += 1
                continue
            turned = rotation_error_deg(matrix[:3, :3], face.normal, rotation, pose)
            if turned is not None:
                tilt_deg, own["rotation_error_deg"] = turned
                self.rotations.add(pose, tilt_deg, own["rotation_error_deg"])
        return own

    def summary(self) -> list[Score]:
        scores: list[Score] = []
        if self.poses:
            note = f"of {self.poses} poses"
            scores.append(
                Score("rotation left open", float(self.open), "poses", note=note, better="lower")
            )
        together = _Errors()
        for errors in self.rotations.by_part.values():
            together.take(astuple(errors))
        if together.count:
            note = "modulo each part's period"
            scores += together.scores("rotation", "°", note, together.count / self.poses, "")
        for tilt, errors in sorted(self.rotations.by_tilt.items()):
            share, note = errors.count / self.poses, "modulo each part's period"
            published = "7.6 (2.1 % of a turn)" if tilt != "tilted farther" else "not promised"
            scores += errors.scores(f"rotation, {tilt}", "°", note, share, published)
        for name, errors in sorted(self.rotations.by_part.items()):
            note = f"modulo {self.rotations.period_deg[name]:g}°"
            scores += errors.scores(f"rotation of {name}", "°", note, errors.count / self.poses, "")
        for key, title, unit, published in (
            ("normal_error_deg", "normal", "°", "7 at most"),
            ("along_axis_error_mm", "centroid along the axis", "mm", ""),
            ("across_error_px", "centroid across the axis", "px", ""),
        ):
            if key in self.errors:
                scores += self.errors[key].scores(title, unit, "", 1.0, published)
        return scores

    def state(self) -> dict[str, Any]:
        return {
            "counts": [self.poses, self.open],
            "period_deg": self.rotations.period_deg,
            **{
                kind: {name: list(astuple(errors)) for name, errors in own.items()}
                for kind, own in self._kinds().items()
            },
        }

    def take(self, state: Mapping[str, Any]) -> None:
        poses, left_open = state["counts"]
        self.poses += poses
        self.open += left_open
        self.rotations.period_deg.update(state["period_deg"])
        for kind, own in self._kinds().items():
            for name, errors in state[kind].items():
                own.setdefault(name, _Errors()).take(errors)

    def _kinds(self) -> dict[str, dict[str, _Errors]]:
        return {
            "by_tilt": self.rotations.by_tilt,
            "by_part": self.rotations.by_part,
            "errors": self.errors,
        }


def rotation_error_deg(
    rotation: np.ndarray, normal: np.ndarray, object_rotation: np.ndarray | None, pose: Any
) -> tuple[float, float] | None:
    """Tilt of the part, and error of its pose's turn about the normal, both in degrees.

    The object's true rotation carries the frame that its face had in training, at angle 0.  None
    where the truth does not tell it: no rotation, another face, a mirrored one.
    """
    if object_rotation is None or pose["mirrored"]:
        return None
    turn = _from_training(object_rotation, normal)
    if turn is None:
        return None
    true_frame = turn @ shortest_turn(turn.T @ normal)
    difference = true_frame.T @ rotation
    angle = np.degrees(
        np.arctan2(difference[1, 0] - difference[0, 1], difference[0, 0] + difference[1, 1])
    )
    period = pose["period_deg"]
    error = abs((angle + period / 2) % period - period / 2)
    return float(np.degrees(np.arccos(np.clip(turn[2, 2], -1, 1)))), float(error)

"""The depth part of the evaluation: measured depth against ground truth, face by face.

A *face* is one coplanar group of one object (equal instance and face numbers).  The figures are
those of the project's acceptance: faces' interior (8 px or more from any boundary, tilted less
than 40°), within 4 px of an edge, the table, and the normals of faces over 500 px.  Each comes
with the share of pixels in its class that have a depth at all, for an error means nothing
without it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from workbench.stage import Score, Scorer

INTERIOR_PX = 8
EDGE_PX = 4
MAX_TILT_DEG = 40
NORMAL_MIN_PX = 500
MIN_FACE_COVERAGE = 0.5
PATCH_PX = 32

_BIN_MM = 0.005
_BINS = 20_000
_GRAZING_DEG = 80
_PLANE_RMS_MM = 0.3


@dataclass(frozen=True)
class Face:
    """A planar face of the ground truth: its pixels [H W] bool, unit normal, and tilt."""

    mask: np.ndarray
    normal: np.ndarray
    tilt_deg: float


@dataclass(frozen=True)
class FaceMap:
    """The faces of one frame, and each pixel's distance to the nearest face boundary."""

    faces: list[Face]
    on_object: np.ndarray
    boundary_distance_px: np.ndarray
    tilt_deg: np.ndarray


def face_map(truth: Any, camera: Any) -> FaceMap:
    """Faces of a frame's ground truth (``depth_m``, ``instances``, ``faces``, all [H W]).

    A group whose depth is not a plane to 0.3 mm counts as no face: its normal would mean nothing.
    """
    label = truth.instances.astype(np.int32) * 256 + truth.faces
    boundary = np.zeros(label.shape, bool)
    for axis in (0, 1):
        step = np.diff(label, axis=axis) != 0
        before = [slice(None)] * 2
        after = [slice(None)] * 2
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        boundary[tuple(before)] |= step
        boundary[tuple(after)] |= step
    distance = cv2.distanceTransform((~boundary).astype(np.uint8), cv2.DIST_L2, 5)
    if not boundary.any():
        distance[:] = math.inf
    tilt = np.full(label.shape, 90.0, np.float32)
    faces = []
    for value in np.unique(label[label >= 256]):
        mask = label == value
        if int(mask.sum()) < 20:
            continue
        normal, rms_mm = fit_plane(truth.depth_m, mask, camera, robust=False)
        if rms_mm > _PLANE_RMS_MM:
            continue
        angle = math.degrees(math.acos(min(1.0, -normal[2])))
        tilt[mask] = angle
        faces.append(Face(mask, normal, angle))
    return FaceMap(faces, label >= 256, distance, tilt)


def fit_plane(
    depth_m: np.ndarray,
    mask: np.ndarray,
    camera: Any,
    weights: np.ndarray | None = None,
    robust: bool = True,
) -> tuple[np.ndarray, float]:
    """Unit normal [3] (towards the camera) and residual in mm of the plane through a region.

    The fit is of 1/z, which is linear over the image for a plane in space, with ``weights``
    [H W], reweighted by Tukey's biweight where ``robust``.  The residual is the root mean
    square along the optical axis over the pixels that the fit did not reject.
    """
    rows, columns = np.nonzero(mask)
    z = depth_m[rows, columns].astype(np.float64)
    u = (columns - camera.K[0, 2]) / camera.K[0, 0]
    v = (rows - camera.K[1, 2]) / camera.K[1, 1]
    design = np.stack([u, v, np.ones_like(u)], axis=1)
    # An error of 1/z is an error of z over z²; the middle depth makes the scale uniform.
    middle = float(np.median(z))
    target = 1 / z
    base = np.ones_like(z) if weights is None else weights[rows, columns].astype(np.float64)
    weight = base
    for _ in range(8 if robust else 1):
        root = np.sqrt(weight)
        plane, *_ = np.linalg.lstsq(design * root[:, None], target * root, rcond=None)
        residual = (target - design @ plane) * middle**2 * 1e3
        if not robust:
            break
        spread = 1.4826 * float(np.median(np.abs(residual))) + 1e-3
        weight = base * np.clip(1 - (residual / (4.685 * spread)) ** 2, 0, None) ** 2
    normal = -plane / np.linalg.norm(plane)
    kept = weight > 0
    rms = float(np.sqrt(np.average(residual[kept] ** 2, weights=weight[kept])))
    return normal, rms


class _Errors:
    """Signed errors in bounded memory: sums, and a histogram of magnitudes for percentiles."""

    def __init__(self) -> None:
        self.pixels = 0
        self.known = 0
        self.total = 0.0
        self.squares = 0.0
        self.histogram = np.zeros(_BINS + 1, np.int64)

    def add(self, error_mm: np.ndarray) -> None:
        self.pixels += error_mm.size
        finite = error_mm[np.isfinite(error_mm)].astype(np.float64)
        self.known += finite.size
        self.total += float(finite.sum())
        self.squares += float((finite**2).sum())
        bins = np.minimum(np.abs(finite) / _BIN_MM, _BINS).astype(np.int64)
        self.histogram += np.bincount(bins, minlength=_BINS + 1)

    @property
    def coverage(self) -> float:
        return self.known / self.pixels if self.pixels else math.nan

    @property
    def rms(self) -> float:
        return math.sqrt(self.squares / self.known) if self.known else math.nan

    @property
    def mean(self) -> float:
        return self.total / self.known if self.known else math.nan

    def percentile(self, percent: float) -> float:
        if not self.known:
            return math.nan
        below = np.searchsorted(np.cumsum(self.histogram), percent / 100 * self.known)
        return float((below + 0.5) * _BIN_MM)


class DepthScorer(Scorer):
    """Figures of the depth against ``truth``.

    Frames without truth or calibration are skipped, and so are printed dot grids, on which no
    pattern is projected.
    """

    def __init__(self) -> None:
        self.interior = _Errors()
        self.edges = _Errors()
        self.table = _Errors()
        self.planes = _Errors()
        self.normals_deg: list[float] = []
        self.normal_faces = 0
        self.worst_patch_mm = math.nan
        self.stand_off_m = math.nan
        self.span_m = math.nan

    def add(self, truth: Any, artifacts: Mapping[str, Any]) -> dict[str, float]:
        depth_m = artifacts["depth_m"]
        calibration, camera = artifacts.get("calibration"), artifacts.get("near_camera")
        if calibration is None or truth is None or truth.depth_m is None:
            return {}
        if truth.depth_m.shape != depth_m.shape or truth.meta.get("kind") == "grid":
            return {}
        self.span_m = calibration.far_z_m - calibration.near_z_m
        self.stand_off_m = (calibration.far_z_m + calibration.near_z_m) / 2
        error_mm = (depth_m - truth.depth_m) * np.float32(1e3)
        inside = _in_range(truth.depth_m, calibration)
        if camera is None or truth.instances is None or truth.faces is None:
            return self._add_plane(error_mm, inside)
        label = truth.instances.astype(np.int32) * 256 + truth.faces
        if label.min() == label.max():
            return self._add_plane(error_mm, inside)
        scene = face_map(truth, camera)
        distance = scene.boundary_distance_px
        interior = scene.on_object & (distance >= INTERIOR_PX) & (scene.tilt_deg < MAX_TILT_DEG)
        edge = scene.on_object & (distance <= EDGE_PX)
        self.interior.add(error_mm[interior])
        self.edges.add(error_mm[edge])
        self.table.add(error_mm[~scene.on_object & (distance >= INTERIOR_PX)])
        angles = self._normals(scene, depth_m, artifacts["confidence"], camera)
        self.normals_deg += angles
        own = {
            "interior_rms_mm": _rms(error_mm[interior]),
            "edge_p95_mm": _percentile(error_mm[edge], 95),
            "interior_coverage": float(np.isfinite(error_mm[interior]).mean())
            if interior.any()
            else math.nan,
            "normal_mean_deg": float(np.mean(angles)) if angles else math.nan,
        }
        return {name: value for name, value in own.items() if math.isfinite(value)}

    def _add_plane(self, error_mm: np.ndarray, inside: np.ndarray) -> dict[str, float]:
        """A frame of one bare plane: the paper's figure, worst error in the middle 32×32."""
        if not inside.any():
            return {}
        self.planes.add(error_mm[inside])
        height, width = error_mm.shape
        top, left = max(0, (height - PATCH_PX) // 2), max(0, (width - PATCH_PX) // 2)
        middle = (slice(top, top + PATCH_PX), slice(left, left + PATCH_PX))
        patch = error_mm[middle]
        if not inside[middle].all() or not np.isfinite(patch).any():
            return {}
        worst = float(np.nanmax(np.abs(patch)))
        self.worst_patch_mm = float(np.fmax(self.worst_patch_mm, worst))
        return {"plane_worst_mm": worst, "plane_rms_mm": _rms(error_mm[inside])}

    def _normals(
        self, scene: FaceMap, depth_m: np.ndarray, confidence: np.ndarray, camera: Any
    ) -> list[float]:
        angles = []
        known = np.isfinite(depth_m)
        for face in scene.faces:
            if int(face.mask.sum()) < NORMAL_MIN_PX or face.tilt_deg > _GRAZING_DEG:
                continue
            self.normal_faces += 1
            pixels = face.mask & known
            if int(pixels.sum()) < MIN_FACE_COVERAGE * int(face.mask.sum()):
                continue
            normal, _ = fit_plane(depth_m, pixels, camera, weights=confidence**2)
            cosine = float(np.clip(normal @ face.normal, -1, 1))
            angles.append(math.degrees(math.acos(cosine)))
        return angles

    def summary(self) -> list[Score]:
        scores: list[Score] = []
        if self.interior.pixels:
            interior, edges, table = self.interior, self.edges, self.table
            scores += [
                Score("faces' interior rms", interior.rms, "mm", interior.coverage),
                *self._published("faces' interior, p99", interior.percentile(99)),
                Score("faces' interior bias", interior.mean, "mm", interior.coverage),
                Score(
                    f"within {EDGE_PX} px of an edge, p95",
                    edges.percentile(95),
                    "mm",
                    edges.coverage,
                ),
                Score("table bias", table.mean, "mm", table.coverage),
            ]
        if self.normals_deg:
            measured, worst = len(self.normals_deg), float(np.max(self.normals_deg))
            note = f"{measured} of {self.normal_faces} faces over {NORMAL_MIN_PX} px"
            share = measured / self.normal_faces
            scores += [
                Score("normals, mean", float(np.mean(self.normals_deg)), "deg", share, note),
                Score("normals, worst", worst, "deg", share, note, "7 at most"),
            ]
        if self.planes.pixels:
            planes = self.planes
            middle = f"middle {PATCH_PX}×{PATCH_PX}"
            scores += [
                Score("planes, rms", planes.rms, "mm", planes.coverage),
                Score(f"planes, worst in {middle}", self.worst_patch_mm, "mm", planes.coverage),
                *self._published(f"planes, worst in {middle}", self.worst_patch_mm),
            ]
        return scores

    def _published(self, figure: str, error_mm: float) -> list[Score]:
        """An error by both readings of the paper's "3.4 % of the ranging distance"."""
        return [
            Score(
                figure, error_mm / self.stand_off_m / 10, "% of stand-off", published="3.4, read so"
            ),
            Score(figure, error_mm / self.span_m / 10, "% of span", published="3.4, or so"),
        ]


def _in_range(depth_m: np.ndarray, calibration: Any) -> np.ndarray:
    return (depth_m >= calibration.near_z_m) & (depth_m <= calibration.far_z_m)


def _rms(error: np.ndarray) -> float:
    finite = error[np.isfinite(error)]
    return float(np.sqrt((finite.astype(np.float64) ** 2).mean())) if finite.size else math.nan


def _percentile(error: np.ndarray, percent: float) -> float:
    finite = np.abs(error[np.isfinite(error)])
    return float(np.percentile(finite, percent)) if finite.size else math.nan

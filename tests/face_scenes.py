"""Flat faces over a table, as regions and depth: what recognition and pose are tested on."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np

from workbench_stages.edges.planes import Camera
from workbench_stages.edges.regions import region_features
from workbench_stages.matching.database import Database, View, make_database, view_of
from workbench_stages.matching.recognise import Rules, find_candidates, verdict_of
from workbench_stages.matching.surfaces import Surface, camera_from_surface, cut_out
from workbench_stages.region_features import as_rows

CAMERA = Camera(1300.0, 1300.0, 127.5, 127.5)
SIZE = 256
TABLE_M = 0.795
RECTANGLE = np.array([[-25, -15], [25, -15], [25, 15], [-25, 15]]) * 1e-3
ELL = np.array([[-21, -15], [30, -15], [30, 5], [-1, 5], [-1, 25], [-21, 25]]) * 1e-3


def normal_of(tilt_deg: float, towards_deg: float) -> np.ndarray:
    tilt, towards = np.radians([tilt_deg, towards_deg])
    return np.array([np.sin(tilt) * np.cos(towards), np.sin(tilt) * np.sin(towards), -np.cos(tilt)])


def disc(radius_m: float, corners: int = 360) -> np.ndarray:
    angle = np.arange(corners) * 2 * np.pi / corners
    return radius_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)


class Scene:
    """Flat polygons over a table, painted far to near."""

    def __init__(self, camera: Camera = CAMERA, size: int = SIZE) -> None:
        self.camera = camera
        self.labels = np.ones((size, size), np.int32)
        self.depth = np.full((size, size), TABLE_M, np.float32)
        self.count = 1

    def add(
        self,
        polygon: np.ndarray,
        rotation_deg: float,
        at: Sequence[float] = (0.0, 0.0, 0.775),
        tilt_deg: float = 0.0,
        towards_deg: float = 0.0,
    ) -> int:
        """Paint a face (metres, y up); returns its label."""
        camera, size = self.camera, len(self.labels)
        normal = normal_of(tilt_deg, towards_deg)
        pose = camera_from_surface(np.asarray(at), normal, rotation_deg)
        corners = polygon @ pose[:3, :2].T + pose[:3, 3]
        pixels = corners[:, :2] / corners[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        # A pixel is the face's if most of its 8 by 8 parts are; only those around it are drawn.
        left, top = np.clip(np.floor(pixels.min(axis=0)).astype(int) - 1, 0, size - 1)
        right, bottom = np.clip(np.ceil(pixels.max(axis=0)).astype(int) + 2, 1, size)
        height, width = max(bottom - top, 1), max(right - left, 1)
        fine = np.zeros((height * 8, width * 8), np.uint8)
        corners_px = np.round((pixels - [left, top] + 0.5) * 8 - 0.5)
        cv2.fillPoly(fine, [corners_px.astype(np.int32)], 1)
        share = fine.reshape(height, 8, width, 8).sum(axis=(1, 3), dtype=np.int32)
        rows, columns = np.nonzero(share >= 32)
        rows, columns = rows + top, columns + left
        self.count += 1
        self.labels[rows, columns] = self.count
        rx, ry = camera.rays(columns, rows)
        z = (normal @ pose[:3, 3]) / (normal[0] * rx + normal[1] * ry + normal[2])
        self.depth[rows, columns] = z
        return self.count

    def surround(self, label: int, below_mm: Sequence[float]) -> None:
        """What lies around a face that is not tilted: mm below it, in each of equal directions.

        Direction 0 is to the right, the next ones follow counter-clockwise as displayed.
        """
        own = self.labels == label
        rows, columns = np.nonzero(own)
        y, x = np.mgrid[: len(own), : len(own)]
        angle = np.degrees(np.arctan2(rows.mean() - y, x - columns.mean()))
        sector = np.round(angle * len(below_mm) / 360).astype(int) % len(below_mm)
        z = float(np.median(self.depth[own]))
        self.depth[~own] = (z + 1e-3 * np.asarray(below_mm)[sector])[~own]

    def regions(self) -> np.ndarray:
        return as_rows(region_features(self.labels, self.depth, self.camera))

    def judge(self, database: Database, rules: Rules | None = None) -> tuple[np.ndarray, dict]:
        rules = rules or Rules()
        found = find_candidates(
            self.labels, self.regions(), self.depth, self.camera, database, rules
        )
        return found, verdict_of(found, database, rules)

    def surface(self, label: int) -> tuple[np.void, Surface]:
        row = self.regions()[label - 1]
        cut = cut_out(self.labels, label, row["point_m"], row["normal"], self.camera)
        assert cut is not None
        return row, cut


def face(polygon: np.ndarray, rotation_deg: float = 0.0, **place: object) -> Surface:
    """The surface of a face that lies alone."""
    scene = Scene()
    return scene.surface(scene.add(polygon, rotation_deg, **place))[1]  # type: ignore[arg-type]


def views_of(polygon: np.ndarray, step_deg: float = 15.0) -> list[View]:
    views = []
    for angle in np.arange(0, 360, step_deg):
        scene = Scene()
        label = scene.add(polygon, angle)
        _, surface = scene.surface(label)
        views.append(view_of(surface, float(angle), scene.depth, None))
    return views


@cache
def plate_and_ell() -> Database:
    """A database of two parts, made once for all tests that only look at it."""
    return make_database({"plate": views_of(RECTANGLE, 30.0), "ell": views_of(ELL, 30.0)})

"""What stands in a scene: meshes with a pose and an albedo, and the planes under and around them.

Lengths are millimetres.  Poses are ``camera_from_object`` (4 4), the object's frame being that of
its mesh.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from workbench.errors import DataError
from workbench.extras import required

_SAME_DIRECTION = np.cos(np.deg2rad(0.5))
_SAME_OFFSET = 1e-3
"""Of the mesh's size: how far apart two faces of one plane may lie."""

_CENTRED_MM = 0.01
"""A mesh whose centroid is this near its origin is left as it is."""

PLANE_HALF_SIZE_MM = 1500.0
"""Half the side of the squares that stand for planes without end."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles: ``vertices_mm`` [V 3] float64, ``triangles`` [T 3] int32, anticlockwise from
    outside."""

    vertices_mm: np.ndarray
    triangles: np.ndarray

    @cached_property
    def normals(self) -> np.ndarray:
        """Unit outward normals of the triangles, [T 3]."""
        a, b, c = (self.vertices_mm[self.triangles[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    @cached_property
    def faces(self) -> np.ndarray:
        """The coplanar group of each triangle, [T] int32, counted by their first triangles."""
        offsets = (self.normals * self.vertices_mm[self.triangles[:, 0]]).sum(1)
        size = float(np.ptp(self.vertices_mm, axis=0).max())
        groups = np.full(len(self.triangles), -1, np.int32)
        found: list[int] = []
        for k in range(len(self.triangles)):
            if groups[k] >= 0:
                continue
            same = (
                (groups < 0)
                & (self.normals @ self.normals[k] > _SAME_DIRECTION)
                & (np.abs(offsets - offsets[k]) < _SAME_OFFSET * size)
            )
            groups[same] = len(found)
            found.append(k)
        return groups


@dataclass(frozen=True, eq=False)
class Body:
    """A mesh in the scene.  ``instance`` is 0 for the background."""

    name: str
    mesh: Mesh
    camera_from_object: np.ndarray
    albedo: float
    instance: int

    def moved(self, camera_from_object: np.ndarray) -> Body:
        return replace(self, camera_from_object=camera_from_object)

    @cached_property
    def vertices_mm(self) -> np.ndarray:
        """The mesh's vertices in the camera's frame, [V 3]."""
        matrix = self.camera_from_object
        return self.mesh.vertices_mm @ matrix[:3, :3].T + matrix[:3, 3]


def load_mesh(path: Path) -> Mesh:
    """Any mesh that Open3D reads, in millimetres, without doubled vertices and empty triangles.

    Raises :class:`DataError` for a file that is missing or holds no triangles.
    """
    if not path.is_file():
        raise DataError(f"{path}: expected a mesh, found no such file")
    o3d = required("open3d", "reading a mesh", "simulate")
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        read = o3d.io.read_triangle_mesh(path)
    read.remove_duplicated_vertices()
    read.remove_degenerate_triangles()
    vertices = np.asarray(read.vertices, float)
    triangles = np.asarray(read.triangles, np.int32)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise DataError(f"{path}: expected a mesh that Open3D reads, found no triangles in it")
    mesh = _centred(Mesh(vertices, triangles))
    # Slivers have no normal.
    sound = np.isfinite(mesh.normals).all(1)
    return mesh if sound.all() else Mesh(mesh.vertices_mm, triangles[sound])


def _centred(mesh: Mesh) -> Mesh:
    """The mesh with its origin at its centroid, where the convention has it.

    The centroid is that of the volume, or of the corners where the mesh encloses none.
    """
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k]] for k in range(3))
    sixfold = (a * np.cross(b, c)).sum(1)
    volume = sixfold.sum()
    if volume > 1e-6 * np.ptp(mesh.vertices_mm, axis=0).max() ** 3:
        centroid = (sixfold[:, None] * (a + b + c)).sum(0) / (4 * volume)
    else:
        centroid = mesh.vertices_mm.mean(0)
    if np.linalg.norm(centroid) < _CENTRED_MM:
        return mesh
    return Mesh(mesh.vertices_mm - centroid, mesh.triangles)


def square(half_size_mm: float = PLANE_HALF_SIZE_MM) -> Mesh:
    """A square about the origin, facing -z (towards the camera where it is not turned)."""
    s = half_size_mm
    return Mesh(
        np.array([[-s, -s, 0], [-s, s, 0], [s, s, 0], [s, -s, 0]], float),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )


def marks(pitch_mm: float, mark_mm: float, reach_mm: float) -> Mesh:
    """Square marks of side ``mark_mm`` on a grid, as far as ``reach_mm`` from the origin."""
    steps = np.arange(-int(reach_mm / pitch_mm), int(reach_mm / pitch_mm) + 1) * pitch_mm
    one = square(mark_mm / 2)
    middles = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 1, 3)
    first = 4 * np.arange(len(middles), dtype=np.int32)[:, None, None]
    return Mesh((middles + one.vertices_mm).reshape(-1, 3), (first + one.triangles).reshape(-1, 3))

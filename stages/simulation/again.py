"""The bodies of a recorded frame, from its own ground truth: to render it once more."""

from __future__ import annotations

from collections.abc import Mapping

from workbench.errors import DataError
from workbench.recording import Truth

from .bodies import Body, Mesh, marks, square
from .scene import MARK_LIFT_MM, Table

_MARKS_REACH_MM = 150.0
_MARK_ALBEDO = 0.6


def bodies_of(truth: Truth, meshes: Mapping[str, Mesh], table: Table) -> list[Body]:
    """What ``truth`` says stands in the scene, and the table under it.

    Raises :class:`DataError` where meta, transforms or ``meshes`` miss an object.
    """
    found = []
    for entry in truth.meta.get("objects", []):
        name, identity = entry["name"], entry["id"]
        pose = truth.camera_from_object.get(f"object_{identity}_{name}")
        mesh = square() if name == "plane" else meshes.get(name)
        if pose is None or mesh is None:
            raise DataError(
                f"object {identity} ({name}): no {'mesh' if pose is not None else 'pose'}"
            )
        pose = pose.copy()
        pose[:3, 3] *= 1e3
        found.append(Body(name, mesh, pose, entry["albedo"], identity))
        if truth.meta.get("kind") == "grid":
            above = pose.copy()
            above[2, 3] -= MARK_LIFT_MM
            grid = marks(truth.meta["pitch"], truth.meta["mark"], _MARKS_REACH_MM)
            found.append(Body("marks", grid, above, _MARK_ALBEDO, 2))
    if not any(body.name == "plane" for body in found):
        found.append(table.body())
    return found

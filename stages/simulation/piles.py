"""Piles of parts, dropped one after another by a physics engine (MuJoCo, extra ``simulate``).

The world's frame: origin on the table under the camera, x right as displayed, y up as displayed,
z up towards the camera; millimetres outside this module, metres inside the engine.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from workbench.extras import required

from .bodies import Mesh

_STEP_S = 0.001
_DROP_EVERY_S = 0.35
_REST_S = 0.1
_LONGEST_S = 4.0
_REST_MM_S = 1.0
_CONVEX = 1e-3
"""Fraction by which the hull of a convex mesh may exceed it."""


@dataclass(frozen=True, eq=False)
class Pile:
    """Poses ``world_from_object`` [N 4 4] (mm) of parts at rest; ``speed_mm_s`` is the fastest."""

    world_from_object: np.ndarray
    speed_mm_s: float

    @property
    def at_rest(self) -> bool:
        return self.speed_mm_s < _REST_MM_S


def require_engine() -> None:
    """Raises :class:`DataError`, naming the extra, where the physics engine is not installed."""
    # CoACD's library breaks the import of Open3D's unless it comes second.
    for name in ("open3d", "coacd", "mujoco"):
        required(name, "a pile", "simulate")


def drop(
    meshes: Sequence[Mesh], spread_mm: float, seed: Sequence[int], height_mm: float = 15.0
) -> Pile:
    """Let ``meshes`` fall one by one, turned at random, within ``spread_mm`` of the middle.

    ``height_mm`` is how far each falls beyond what lies there.  The same arguments give the same
    pile.  Parts have no walls to lean on and may roll away; the caller looks at where they are.
    Raises :class:`DataError` where the engine is not installed.
    """
    require_engine()
    import mujoco

    rng = np.random.default_rng(list(seed))
    spec = mujoco.MjSpec()
    spec.option.timestep = _STEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.option.noslip_iterations = 4
    friction = [0.7, 0.005, 0.0001]
    # Stiff contacts: parts of some tens of grams sink by micrometres.
    contact: dict[str, Any] = {
        "friction": friction,
        "condim": 4,
        "solref": [2 * _STEP_S, 1.0],
        "solimp": [0.99, 0.999, 0.0001, 0.5, 2.0],
    }
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], **contact)
    radii = [float(np.linalg.norm(mesh.vertices_mm, axis=1).max()) for mesh in meshes]
    waiting_mm = 200.0 + np.cumsum(2 * np.array(radii))
    for k, mesh in enumerate(meshes):
        body = spec.worldbody.add_body(name=f"part{k}", pos=[10, 0, float(waiting_mm[k]) / 1e3])
        body.add_freejoint()
        for j, (vertices, triangles) in enumerate(_convex_pieces(mesh)):
            name = f"part{k}_{j}"
            asset = spec.add_mesh(name=name)
            asset.uservert = (vertices / 1e3).ravel().tolist()
            asset.userface = triangles.ravel().tolist()
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, density=2700.0, **contact)
    model = spec.compile()
    data = mujoco.MjData(model)
    # Parts wait aside, without weight, until their turn.
    first_q = [int(model.body(f"part{k}").jntadr[0]) for k in range(len(meshes))]
    q = [int(model.jnt_qposadr[joint]) for joint in first_q]
    v = [int(model.jnt_dofadr[joint]) for joint in first_q]
    gravity = np.array(model.opt.gravity)
    weights = model.body_mass[1:, None] * -gravity
    data.xfrc_applied[1:, :3] = weights
    for k in range(len(meshes)):
        angle, radius = rng.uniform(0, 2 * np.pi), spread_mm * np.sqrt(rng.uniform())
        turn = rng.normal(size=4)
        top = max((1e3 * data.qpos[q[j] + 2] + radii[j] for j in range(k)), default=0.0)
        data.qpos[q[k] : q[k] + 3] = [
            radius * np.cos(angle) / 1e3,
            radius * np.sin(angle) / 1e3,
            (top + radii[k] + height_mm) / 1e3,
        ]
        data.qpos[q[k] + 3 : q[k] + 7] = turn / np.linalg.norm(turn)
        data.xfrc_applied[1 + k, :3] = 0
        for _ in range(round(_DROP_EVERY_S / _STEP_S)):
            mujoco.mj_step(model, data)
    calm = 0
    for _ in range(round(_LONGEST_S / _STEP_S)):
        mujoco.mj_step(model, data)
        fastest = max(float(np.abs(data.qvel[at : at + 3]).max()) for at in v) * 1e3
        calm = calm + 1 if fastest < _REST_MM_S else 0
        if calm * _STEP_S >= _REST_S:
            break
    poses = np.tile(np.eye(4), (len(meshes), 1, 1))
    for k, at in enumerate(q):
        matrix = np.empty(9)
        mujoco.mju_quat2Mat(matrix, data.qpos[at + 3 : at + 7])
        poses[k, :3, :3] = matrix.reshape(3, 3)
        poses[k, :3, 3] = 1e3 * data.qpos[at : at + 3]
    return Pile(poses, fastest)


@lru_cache(maxsize=64)
def _convex_pieces(mesh: Mesh) -> list[tuple[np.ndarray, np.ndarray]]:
    """Convex pieces that make up a mesh: itself, or what CoACD cuts it into."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(mesh.vertices_mm)
    a, b, c = (mesh.vertices_mm[mesh.triangles[:, k]] for k in range(3))
    volume = abs(float((a * np.cross(b, c)).sum() / 6))
    if hull.volume <= volume * (1 + _CONVEX):
        return [(mesh.vertices_mm, mesh.triangles)]
    import coacd

    coacd.set_log_level("error")
    pieces = coacd.run_coacd(coacd.Mesh(mesh.vertices_mm, mesh.triangles), threshold=0.02, seed=0)
    return [(np.asarray(vertices), np.asarray(triangles)) for vertices, triangles in pieces]

"""The pose of a recognised surface, and how to grasp it (paper, 6.4 and 6.5).

One turn is found by the eigenspace, the other two by the plane's normal, the place by the
centroid of the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .database import Database, Part, turn_profile
from .eigenspace import POINTS, Match
from .recognise import match_part
from .surfaces import Surface, camera_from_surface, fall_off, shortest_turn

__all__ = ["choose_turn", "outline_mm", "pose_of", "project"]

_CLEARLY = 0.7
"""A turn is chosen by the range data only if its surroundings fit so much better than the next."""

_CLIP_MM = 15.0
"""Surroundings that differ by more than this are another thing than the part, whatever it is."""

_TIED = 1.3
"""Turns whose distances are within this factor are as good by the outline."""

_PIXELS_A_SAMPLE = 50.0
"""Neighbouring depths share the sensor's windows: so many pixels are worth one of their own."""


def choose_turn(
    part: Part, found: Sequence[Match], profile: NDArray[np.float64]
) -> tuple[Match, list[float], str]:
    """The rotation among those that the outline leaves open; the others if they stay open.

    Args:
        part: whose manifold was matched.
        found: the manifold's nearest points, nearest first.
        profile: [36], what lies around the face now, mm below its plane (rotation 0).

    Returns:
        the match; rotations [deg] that are as good and were not ruled out; how it was settled:
        ``outline``, ``range`` or ``open``.
    """
    best = found[0]
    period = part.period_deg
    tied = [m for m in found if m.distance <= _TIED * best.distance + 0.005]
    different = [best]
    for other in tied[1:]:
        if all(_apart(other.rotation_deg, m.rotation_deg, period) > 10 for m in different):
            different.append(other)
    if len(different) == 1:
        return best, [], "outline"
    misfit = [_misfit(part, profile, m.rotation_deg) for m in different]
    order = sorted(range(len(different)), key=lambda k: misfit[k])
    first, second = order[:2]
    chosen = different[first]
    if np.isfinite(misfit[first]) and misfit[first] <= _CLEARLY * misfit[second]:
        return chosen, [], "range"
    others = [m.rotation_deg % period for m in different if m is not best]
    return best, others, "open"


def _apart(a: float, b: float, period: float) -> float:
    return abs((a - b + period / 2) % period - period / 2)


def _misfit(part: Part, profile: NDArray[np.float64], rotation_deg: float) -> float:
    """Root mean square difference (mm) of the surroundings from the part's, turned."""
    difference = profile - turn_profile(part.profile, rotation_deg)
    difference = difference[np.isfinite(difference)]
    if difference.size < len(profile) // 2:
        return float("inf")
    return float(np.sqrt((np.clip(difference, -_CLIP_MM, _CLIP_MM) ** 2).mean()))


def pose_of(
    surface: Surface,
    region: Any,
    depth_m: np.ndarray,
    database: Database,
    model: int,
    zeta_scale: float = 1.0,
) -> dict[str, Any]:
    """The pose of the part whose face ``surface`` is: plain JSON values, see the stage."""
    part = database.parts[model]
    found, mirrored = match_part(part, surface, database.side, database.mm_per_px)
    profile, _ = fall_off(surface, depth_m)
    if mirrored:
        # Left and right exchanged: direction a is where 180° - a was.
        profile = profile[(len(profile) // 2 - np.arange(len(profile))) % len(profile)]
    best, others, settled = choose_turn(part, found, profile)
    rotation = best.rotation_deg % part.period_deg
    position = _grasp_point(surface)
    spread_mm = np.sqrt(surface.area_mm2 / np.pi) / 2
    samples = max(float(region["plane_px"]) / _PIXELS_A_SAMPLE, 1.0)
    noise_mm = 1e3 * float(region["residual_m"]) / np.sqrt(samples)
    zeta = zeta_scale * part.zeta
    return {
        "object": part.name,
        "region": int(region["label"]),
        "rotation_deg": float(rotation),
        "period_deg": part.period_deg,
        "mirrored": mirrored,
        "settled_by": settled,
        "open_rotations_deg": [float(r) for r in others],
        "camera_from_surface": camera_from_surface(
            surface.origin_m, surface.normal, rotation
        ).tolist(),
        "grasp": {"position": position.tolist(), "approach": (-surface.normal).tolist()},
        "distance": best.distance,
        "distance_within": best.within,
        "zeta": zeta,
        "phi": database.phi,
        "accepted": bool(best.distance <= zeta),
        "uncertainty": {
            "rotation_deg": _rotation_noise_deg(part, best),
            "normal_deg": float(np.degrees(noise_mm / max(spread_mm, 1e-6))),
            "position_mm": float(noise_mm),
        },
    }


def _rotation_noise_deg(part: Part, found: Match) -> float:
    """How far the rotation could be off for the image to lie where it does beside the manifold."""
    manifold = part.space.manifold.astype(np.float64) / part.space.norm
    i = int(round(found.rotation_deg * POINTS / 360)) % POINTS
    step = np.linalg.norm(manifold[(i + 1) % POINTS] - manifold[i - 1]) / 2
    per_degree = max(float(step) * POINTS / 360, 1e-9)
    # The distance has as many components as the space; along the curve lies one of them.
    return float(found.within / np.sqrt(len(part.space.basis)) / per_degree)


def _grasp_point(surface: Surface) -> NDArray[np.float64]:
    """The centroid; where the face is not under it (an L can be so), its most inward point."""
    hard = (surface.mask > 0.5).astype(np.uint8)
    inside = cv2.distanceTransform(np.pad(hard, 1), cv2.DIST_L2, cv2.DIST_MASK_5)[1:-1, 1:-1]
    camera, origin = surface.camera, surface.origin_m
    x = camera.fx * origin[0] / origin[2] + camera.cx - surface.corner[0]
    y = camera.fy * origin[1] / origin[2] + camera.cy - surface.corner[1]
    column, row = int(round(float(x))), int(round(float(y)))
    height, width = inside.shape
    if 0 <= row < height and 0 <= column < width and inside[row, column] > 0:
        return origin
    row, column = divmod(int(inside.argmax()), width)
    left, top = surface.corner
    rx, ry = camera.rays(np.array([column + left]), np.array([row + top]))
    ray = np.array([rx[0], ry[0], 1.0])
    return ray * float(surface.normal @ origin) / float(surface.normal @ ray)


def outline_mm(
    part: Part, rotation_deg: float, mm_per_px: float, mirrored: bool = False
) -> NDArray[np.float64]:
    """The model's outline [K 2] in mm (x right, y up at rotation 0), from its manifold."""
    space = part.space
    at = int(round(rotation_deg * POINTS / 360)) % POINTS
    image = (space.mean + space.manifold[at] @ space.basis).reshape(space.side, space.side)
    contours, _ = cv2.findContours(
        (cv2.resize(image, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC) > 0.5).astype(np.uint8),
        cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE,
    )  # fmt: skip
    if not contours:
        return np.zeros((0, 2))
    points = max(contours, key=len)[:, 0].astype(np.float64)
    middle = (4 * space.side - 1) / 2
    out = (points - middle) * (mm_per_px / 4) * np.array([1.0, -1.0])
    if mirrored:
        out[:, 0] *= -1
    return np.concatenate([out, out[:1]])


def outline_m(pose: dict[str, Any], part: Part, mm_per_px: float) -> NDArray[np.float64]:
    """The model's outline [K 3] in the camera's frame, metres."""
    flat = 1e-3 * outline_mm(part, pose["rotation_deg"], mm_per_px, pose["mirrored"])
    matrix = np.array(pose["camera_from_surface"])
    axes = shortest_turn(matrix[:3, 2])
    return matrix[:3, 3] + flat[:, :1] * axes[:, 0] + flat[:, 1:] * axes[:, 1]


def project(points_m: np.ndarray, K: np.ndarray) -> NDArray[np.float64]:
    """Pixels [N 2] (x, y) of points [N 3] in the camera's frame."""
    z = points_m[:, 2]
    x = K[0, 0] * points_m[:, 0] / z + K[0, 2]
    y = K[1, 1] * points_m[:, 1] / z + K[1, 2]
    return np.stack([x, y], axis=1)

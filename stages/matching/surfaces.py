"""Surfaces cut out by their regions and seen along their normals, at one scale (paper, 5 and 6).

A region is what a tilted face looks like from the camera.  Seen along its own normal, in
millimetres, the same face has the same size and outline wherever it lies: so features and images
are taken from the face as it is, not from its perspective picture.

The frame of a surface has its origin at the surface's centroid, z along the outward normal (to
the camera), and for rotation 0 the x and y that the camera's axes become by the shortest turn of
the viewing axis into the normal: x to the right and y *up* as displayed.  Rotation is about z,
counter-clockwise as displayed.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.measure import find_contours

from ..edges.planes import Camera, Plane

__all__ = [
    "FEATURES",
    "PROFILE_SECTORS",
    "RING_PX",
    "Surface",
    "camera_from_surface",
    "cut_out",
    "fall_off",
    "features_mm",
    "grid_px",
    "shortest_turn",
    "soft_view",
    "upright_view",
]

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

FEATURES = ("area mm²", "perimeter mm", "shape factor", "greatest distance mm")

PROFILE_SECTORS = 36
"""Directions around a surface in which its surroundings are measured."""

_OUTLINE_PX = 2.0
"""Blur (sigma, of the rectified grid) under which an outline's length does not depend on how the
face lies on the image's grid; the corners that it cuts are cut alike in training and use."""

_SOFT_PX = 0.7
"""Blur (sigma) of a region's mask before it is sampled: its staircase is not the face's."""

_LEAST_IN_SECTOR = 4

RING_PX = (5, 14)
"""How far outside its border a surface's surroundings are measured: beyond the sensor's window,
and not so far that they are another story."""


@dataclass(frozen=True)
class Surface:
    """One face, cut out by its region.

    Attributes:
        mask: [h w] float32, the region's softened mask on a crop of the image.
        corner: (x, y) of the crop's first pixel.
        origin_m: [3] float64, the centroid of the face, on the fitted plane.
        normal: [3] float64, unit, towards the camera.
        area_mm2: of the face itself.
        camera: by which the region was seen.
        reach_mm: from the centroid to the farthest pixel of the region.
    """

    mask: F32
    corner: tuple[int, int]
    origin_m: F64
    normal: F64
    area_mm2: float
    camera: Camera
    reach_mm: float

    @property
    def z_m(self) -> float:
        """Depth of the centroid."""
        return float(self.origin_m[2])

    @property
    def pixel_mm(self) -> float:
        """What a pixel spans at the centroid's depth, millimetres."""
        return 1e3 * self.z_m / max(self.camera.fx, self.camera.fy)


def shortest_turn(normal: np.ndarray) -> F64:
    """[3 3] camera_from_surface rotation of rotation 0: the viewing axis turned into ``normal``."""
    normal = np.asarray(normal, np.float64) / np.linalg.norm(normal)
    towards = np.array([0.0, 0.0, -1.0])
    axis = np.cross(towards, normal)
    cosine = float(towards @ normal)
    # A face seen from behind has no shortest turn; any half turn about an axis across will do.
    if cosine < -1 + 1e-9:
        return np.diag([1.0, 1.0, 1.0])
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    swing = np.eye(3) + skew + skew @ skew / (1 + cosine)
    return swing @ np.diag([1.0, -1.0, -1.0])


def camera_from_surface(origin_m: np.ndarray, normal: np.ndarray, rotation_deg: float) -> F64:
    """[4 4] metres: frame of a surface that is turned by ``rotation_deg`` about its normal."""
    angle = np.radians(rotation_deg)
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]])
    out = np.eye(4)
    out[:3, :3] = shortest_turn(normal) @ turn
    out[:3, 3] = origin_m
    return out


def cut_out(
    labels: np.ndarray, label: int, point_m: np.ndarray, normal: np.ndarray, camera: Camera
) -> Surface | None:
    """The face that region ``label`` of ``labels`` [H W] shows on its fitted plane.

    None where the plane is seen from its edge, or has no place in front of the camera.
    """
    rows, columns = np.nonzero(labels == label)
    if not len(rows) or not (np.isfinite(point_m).all() and np.isfinite(normal).all()):
        return None
    normal = np.asarray(normal, np.float64)
    offset = float(normal @ point_m)
    rx, ry = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    slant = normal[0] * rx + normal[1] * ry + normal[2]
    # A ray that hardly meets the plane meets it far away.
    if not (slant * np.sign(offset) > 0.05).all():
        return None
    z = offset / slant
    # A pixel's share of the plane: z² / |n · ray| times its solid angle's picture.
    weight = z * z / np.abs(slant) / (camera.fx * camera.fy)
    points = np.stack([rx * z, ry * z, z], axis=1)
    origin = weight @ points / weight.sum()
    reach = float(np.sqrt(((points - origin) ** 2).sum(axis=1).max()))
    pad = 4
    top, left = int(rows.min()) - pad, int(columns.min()) - pad
    hard = np.zeros(
        (int(rows.max()) + pad + 1 - top, int(columns.max()) + pad + 1 - left), np.float32
    )
    hard[rows - top, columns - left] = 1
    mask = np.asarray(cv2.GaussianBlur(hard, (0, 0), _SOFT_PX), np.float32)
    return Surface(
        mask, (left, top), origin, normal, 1e6 * float(weight.sum()), camera, 1e3 * reach
    )


def grid_px(
    surface: Surface, side: int, mm_per_px: float, rotation_deg: float = 0.0, mirrored: bool = False
) -> tuple[F64, F64]:
    """Columns and rows [side side] of the image at which :func:`upright_view` looks."""
    half = (side - 1) / 2
    across = (np.arange(side) - half) * mm_per_px * 1e-3
    u, v = np.meshgrid(across, -across)
    angle = np.radians(rotation_deg)
    cosine, sine = np.cos(angle), np.sin(angle)
    # The point that is shown at (u, v) after the turn was at the turned-back place before it.
    x, y = cosine * u + sine * v, -sine * u + cosine * v
    if mirrored:
        x = -x
    axes = shortest_turn(surface.normal)
    place = surface.origin_m + x[..., None] * axes[:, 0] + y[..., None] * axes[:, 1]
    camera = surface.camera
    depth = np.maximum(place[..., 2], 1e-6)
    columns = camera.fx * place[..., 0] / depth + camera.cx
    rows = camera.fy * place[..., 1] / depth + camera.cy
    return columns, rows


def upright_view(
    surface: Surface, side: int, mm_per_px: float, rotation_deg: float = 0.0, mirrored: bool = False
) -> F32:
    """The face seen along its normal, its centroid in the middle: [side side] float32, 0..1.

    Args:
        surface: what to look at.
        side: pixels of the picture.
        mm_per_px: its scale.
        rotation_deg: the face is turned by this first, counter-clockwise as displayed.
        mirrored: left and right are exchanged before the turn.
    """
    columns, rows = grid_px(surface, side, mm_per_px, rotation_deg, mirrored)
    left, top = surface.corner
    shown = cv2.remap(
        surface.mask,
        (columns - left).astype(np.float32),
        (rows - top).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    return np.asarray(shown, np.float32)


def soft_view(
    surface: Surface, side: int, mm_per_px: float, rotation_deg: float = 0.0, mirrored: bool = False
) -> F32:
    """:func:`upright_view` with its border widened to two pixels of the picture.

    A manifold of hard silhouettes is as jagged as their borders; one of soft ones is a smooth
    curve, on which a spline between views means something.
    """
    fine = upright_view(surface, side * 2, mm_per_px / 2, rotation_deg, mirrored)
    soft = cv2.GaussianBlur(fine, (0, 0), 2.0)
    return np.asarray(cv2.resize(soft, (side, side), interpolation=cv2.INTER_AREA), np.float32)


def features_mm(surface: Surface) -> F64:
    """[4] float64, see :data:`FEATURES`: area, perimeter, shape factor, greatest distance.

    Measured on the rectified face, where height and perspective play no part.  NaN where the
    face is too small to have an outline.
    """
    # As fine as the image saw it, so that nothing is lost and nothing invented.
    mm_per_px = surface.pixel_mm * 0.75
    side = 2 * int(np.ceil(1.1 * surface.reach_mm / mm_per_px)) + 13
    view = cv2.GaussianBlur(upright_view(surface, side, mm_per_px), (0, 0), _OUTLINE_PX)
    outlines = find_contours(view, 0.5)  # type: ignore[no-untyped-call]
    if not outlines:
        return np.full(4, np.nan)
    steps = [np.linalg.norm(np.diff(outline, axis=0), axis=1) for outline in outlines]
    perimeter = float(sum(step.sum() for step in steps)) * mm_per_px
    middle = (side - 1) / 2
    reach = max(float(np.hypot(*(outline - middle).T).max()) for outline in outlines)
    area = surface.area_mm2
    return np.array(
        [area, perimeter, 4 * np.pi * area / max(perimeter * perimeter, 1e-9), reach * mm_per_px]
    )


def fall_off(surface: Surface, depth_m: np.ndarray, table: Plane | None = None) -> tuple[F64, F64]:
    """What lies around a face: millimetres below its plane, for each direction, [36] float64.

    Returns that and, where the table's plane is given, millimetres above the table (else NaN).

    Sector k is centred on k times 10° counter-clockwise from the surface's x axis (at rotation
    0).  Medians over a ring outside the border; NaN where nothing was measured.  This is what
    tells the thin end of a wedge from the thick one, whose faces look alike.
    """
    left, top = surface.corner
    inner, outer = RING_PX
    hard = np.pad((surface.mask > 0.5).astype(np.uint8), outer)
    distance = cv2.distanceTransform(1 - hard, cv2.DIST_L2, cv2.DIST_MASK_5)
    rows, columns = np.nonzero((distance > inner) & (distance <= outer))
    rows, columns = rows + top - outer, columns + left - outer
    height, width = depth_m.shape
    inside = (rows >= 0) & (columns >= 0) & (rows < height) & (columns < width)
    rows, columns = rows[inside], columns[inside]
    z = depth_m[rows, columns].astype(np.float64)
    known = np.isfinite(z)
    rows, columns, z = rows[known], columns[known], z[known]
    rx, ry = surface.camera.rays(columns, rows)
    offset = np.stack([rx * z, ry * z, z], axis=1) - surface.origin_m
    axes = shortest_turn(surface.normal)
    below = -1e3 * (offset @ surface.normal)
    # Direction of the ray's meeting with the face's plane, which is where the border is seen.
    slant = surface.normal[0] * rx + surface.normal[1] * ry + surface.normal[2]
    on_plane = float(surface.normal @ surface.origin_m) / slant
    beside = np.stack([rx * on_plane, ry * on_plane, on_plane], axis=1) - surface.origin_m
    angle = np.degrees(np.arctan2(beside @ axes[:, 1], beside @ axes[:, 0])) % 360
    sector = np.round(angle * PROFILE_SECTORS / 360).astype(int) % PROFILE_SECTORS
    above = np.full(below.shape, np.nan)
    if table is not None:
        above = 1e3 * table.height(offset + surface.origin_m)
    out = np.full((2, PROFILE_SECTORS), np.nan)
    for k in range(PROFILE_SECTORS):
        of = sector == k
        if of.sum() >= _LEAST_IN_SECTOR:
            out[:, k] = np.median(below[of]), np.median(above[of])
    return out[0], out[1]

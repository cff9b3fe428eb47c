"""Planes through depth: exact ones, what a robust fit leaves out, and when there is no table."""

from __future__ import annotations

import numpy as np
import pytest

from workbench_stages.edges.inputs import best_depth
from workbench_stages.edges.planes import Camera, Plane, background_plane, fit_plane, fit_planes

CAMERA = Camera(900.0, 700.0, 60.0, 30.0)
SHAPE = (80, 110)


class Seen:
    """A camera's intrinsics as a recording gives them."""

    def __init__(self, height: int, width: int) -> None:
        self.height, self.width = height, width
        self.K = np.array([[900.0, 0, 60], [0, 700.0, 30], [0, 0, 1]])


def unit(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / np.sqrt(x * x + y * y + z * z)


def depth_of(normal: np.ndarray, point: np.ndarray, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    rays = np.stack([(u - 60.0) / 900.0, (v - 30.0) / 700.0, np.ones(shape)], axis=-1)
    return normal @ point / (rays @ normal)


def points_of(depth: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(np.isfinite(depth))
    z = depth[v, u]
    return np.column_stack([(u - 60.0) / 900.0 * z, (v - 30.0) / 700.0 * z, z])


def test_a_ray_leads_through_its_pixel() -> None:
    x, y = CAMERA.rays(np.array([60.0, 150.0]), np.array([30.0, 100.0]))
    assert x.tolist() == [0, 0.1]
    assert y.tolist() == [0, 0.1]


def test_height_and_tilt_of_a_plane() -> None:
    plane = Plane(np.array([0.1, 0.2, 0.7]), unit(0, 0.6, -0.8), 0.0, 9)
    assert plane.tilt_deg == pytest.approx(np.degrees(np.arccos(0.8)))
    nearer = plane.point + 0.03 * plane.normal
    assert plane.height(np.stack([nearer, plane.point])) == pytest.approx([0.03, 0])
    assert plane.height(plane.point + np.array([1.0, 0, 0])) == pytest.approx(0)
    assert Plane(plane.point, np.array([0, 0, -1.0]), 0.0, 9).tilt_deg == 0


NORMALS = [unit(0, 0, -1), unit(0.3, 0, -1), unit(0, -0.4, -1), unit(-0.25, 0.5, -1)]


@pytest.mark.parametrize("normal", NORMALS)
def test_an_exact_plane_is_found_exactly(normal: np.ndarray) -> None:
    point = np.array([0.02, -0.01, 0.7])
    plane = fit_plane(points_of(depth_of(normal, point)))
    assert plane is not None
    assert plane.normal == pytest.approx(normal, abs=1e-9)
    assert plane.height(point) == pytest.approx(0, abs=1e-9)
    assert plane.points == SHAPE[0] * SHAPE[1]
    assert plane.residual < 1e-9


@pytest.mark.parametrize("normal", NORMALS)
def test_the_residual_is_the_distance_of_what_lies_on_the_plane(normal: np.ndarray) -> None:
    """Half of the points 0.2 mm in front of it, half behind, along its normal."""
    point = np.array([0.02, -0.01, 0.7])
    xyz = points_of(depth_of(normal, point))
    sign = np.where(np.arange(len(xyz)) % 2, 1, -1)
    plane = fit_plane(xyz + 2e-4 * sign[:, None] * normal)
    assert plane is not None
    assert plane.residual == pytest.approx(2e-4, rel=0.03)
    assert plane.normal == pytest.approx(normal, abs=5e-4)
    assert plane.points == len(xyz)


@pytest.mark.parametrize(("cut", "factor"), [(3.0, 6.94), (1.0, 2.31)])
def test_points_further_off_than_the_cut_have_no_part(cut: float, factor: float) -> None:
    """Two thirds lie ±a off, which sets the scale 1.4826 a; the cut is at 1.56 of it, times three.

    The rest lie ± some multiple of a off, under and over that limit.
    """
    a = 1e-4
    q = np.full(3000, 1 / 0.7)
    rng = np.random.default_rng(0)
    rx, ry = rng.uniform(-0.1, 0.1, (2, 3000))
    number = np.arange(3000)
    for multiple, kept in ((0.96 * factor, 3000), (1.04 * factor, 2000)):
        off = np.where(number % 3 == 2, multiple, 1.0) * a * np.where(number // 3 % 2, 1, -1)
        z = 1 / (q + off)
        plane = fit_plane(np.column_stack([rx * z, ry * z, z]), cut=cut, rounds=30)
        assert plane is not None
        assert plane.points == kept


def test_a_quarter_of_strays_moves_nothing() -> None:
    normal, point = unit(0.2, -0.1, -1), np.array([0.0, 0.0, 0.7])
    rng = np.random.default_rng(1)
    depth = depth_of(normal, point) + rng.normal(0, 1e-4, SHAPE)
    strays = rng.random(SHAPE) < 0.25
    depth[strays] -= 0.05
    plane = fit_plane(points_of(depth))
    assert plane is not None
    assert plane.normal == pytest.approx(normal, abs=2e-3)
    assert plane.points == pytest.approx((~strays).sum(), rel=0.02)
    assert plane.residual == pytest.approx(1e-4 * abs(normal[2]), rel=0.05)


def test_what_spans_no_plane_is_none() -> None:
    xyz = points_of(depth_of(NORMALS[0], np.array([0, 0, 0.7])))
    few = xyz[[0, 50, 109, 4000, 4050, 8000, 8050, 8799]]
    assert fit_plane(few) is not None
    assert fit_plane(few[:7]) is None
    # What lies behind the camera is no point.
    assert fit_plane(np.concatenate([few[:7], -few[:1]])) is None
    assert fit_plane(xyz[xyz[:, 1] == xyz[0, 1]]) is None
    assert fit_plane(np.zeros((0, 3))) is None


# -- planes of regions -----------------------------------------------------------------------------


def test_a_plane_rests_on_what_lies_deep_enough_inside() -> None:
    """What lies up to the inset within the border is on another plane, and has no part."""
    labels = np.zeros(SHAPE, np.int32)
    labels[10:50, 20:90] = 1
    inside = np.zeros(SHAPE)
    for step in range(1, 21):
        inside[9 + step : 51 - step, 19 + step : 91 - step] = step
    depth = np.where(inside > 7, 0.7, 0.74)
    (plane,), known = fit_planes(labels, depth, CAMERA, inside, inset=7.0)
    assert plane is not None
    assert plane.point[2] == pytest.approx(0.7)
    assert plane.points == (40 - 14) * (70 - 14)
    assert known.tolist() == [40 * 70]


@pytest.mark.parametrize(
    ("least_points", "level"), [(900, 6.0), (901, 3.0), (1500, 3.0), (1501, 0.0)]
)
def test_with_too_few_pixels_deep_inside_half_the_inset_is_tried_and_then_all(
    least_points: int, level: float
) -> None:
    """900 pixels more than six inside, 1500 more than three, 2100 in all."""
    labels = np.zeros((50, 60), np.int32)
    labels[2:44, 5:55] = 1
    inside = np.zeros(labels.shape)
    inside[labels == 1] = np.repeat([6.5, 6.0, 3.0], [900, 600, 600])
    (plane,), known = fit_planes(
        labels, np.full(labels.shape, 0.7), CAMERA, inside, inset=6.0, least_points=least_points
    )
    assert plane is not None
    assert plane.points == {6.0: 900, 3.0: 1500, 0.0: 2100}[level]
    assert known.tolist() == [2100]


@pytest.mark.parametrize("normal", NORMALS)
def test_planes_of_several_regions_are_their_own(normal: np.ndarray) -> None:
    labels = np.zeros(SHAPE, np.int32)
    labels[5:70, 4:50], labels[12:77, 58:105] = 1, 2
    points = np.array([[0.01, -0.02, 0.7], [0.0, 0.01, 0.76]])
    depth = np.where(labels == 1, depth_of(normal, points[0]), depth_of(NORMALS[1], points[1]))
    planes, _ = fit_planes(labels, depth, CAMERA, np.ones(SHAPE), inset=0.0)
    for plane, wanted, point in zip(planes, (normal, NORMALS[1]), points, strict=True):
        assert plane is not None
        assert plane.normal == pytest.approx(wanted, abs=1e-5)
        assert plane.height(point) == pytest.approx(0, abs=1e-6)


def test_depth_that_is_none_has_no_part_and_labels_without_any_have_no_plane() -> None:
    labels = np.zeros((20, 60), np.int32)
    labels[:, :20], labels[:, 20:40], labels[:, 50:] = 1, 2, 4
    depth = np.full(labels.shape, 0.7, np.float32)
    depth[:4, :20], depth[4:6, :20], depth[6:8, :20], depth[8:10, :20] = np.nan, np.inf, 0, -1
    depth[:, 20:40] = np.nan
    inside = np.ones(labels.shape)
    planes, known = fit_planes(labels, depth, CAMERA, inside, inset=0)
    assert known.tolist() == [200, 0, 0, 200]
    assert [plane is None for plane in planes] == [False, True, True, False]
    assert planes[0] is not None and planes[0].points == 200
    assert fit_planes(labels * 0, depth, CAMERA, inside)[0] == []


# -- the table -------------------------------------------------------------------------------------


@pytest.mark.parametrize("normal", NORMALS)
def test_the_table_is_what_lies_behind_everything(normal: np.ndarray) -> None:
    """One part is parallel to it and above, another is near and square to the camera."""
    rng = np.random.default_rng(3)
    point = np.array([0.0, 0.0, 0.8])
    depth = depth_of(normal, point) + rng.normal(0, 1e-4, SHAPE)
    depth[20:60, 8:40] = depth_of(normal, point + 0.02 * normal)[20:60, 8:40]
    depth[10:40, 62:90] = depth_of(NORMALS[0], np.array([0, 0, 0.7]))[10:40, 62:90]
    depth[70:, 90:] = np.nan
    table = background_plane(depth.astype(np.float32), CAMERA)
    assert table is not None
    assert table.normal == pytest.approx(normal, abs=2e-3)
    assert table.height(point) == pytest.approx(0, abs=1e-4)
    assert table.height(point + 0.02 * normal) == pytest.approx(0.02, abs=1e-4)
    # The noise is along z; the distance is shorter by the tilt.
    assert table.residual == pytest.approx(1e-4 * abs(normal[2]), rel=0.2)


@pytest.mark.parametrize(
    ("columns", "found"), [(slice(0, 16), True), (slice(0, 12), False), (slice(30, 70), False)]
)
def test_a_table_is_a_share_of_the_image_and_of_its_border(columns: slice, found: bool) -> None:
    """15 % of both: 16 of 100 columns and all of a side; 12; 40 that have too little of the rim."""
    depth = np.full((80, 100), np.nan)
    depth[:, columns] = 0.8
    if columns.start == 30:
        depth[:2], depth[-2:] = np.nan, np.nan
    camera = Camera(900.0, 900.0, 50.0, 40.0)
    assert (background_plane(depth, camera) is not None) == found
    assert (background_plane(depth.T.copy(), camera) is not None) == found
    # A smaller share may be asked for.
    if columns.start == 0:
        assert background_plane(depth, camera, least_share=0.11) is not None


def test_a_table_needs_64_pixels() -> None:
    depth = np.full((9, 8), 0.8)
    depth[0] = np.nan
    assert background_plane(depth, CAMERA) is not None
    depth[1, 0] = np.nan
    assert background_plane(depth, CAMERA) is None


# -- which depth -----------------------------------------------------------------------------------


def test_metres_are_taken_with_the_camera_they_are_for() -> None:
    depth = np.full((6, 9), 0.7)
    relative = np.full((6, 9), 0.4)
    inputs = {"depth_m": depth, "depth_relative": relative, "near_camera": Seen(6, 9)}
    taken, camera = best_depth(inputs)
    assert taken is depth
    assert camera == Camera(900.0, 700.0, 60.0, 30.0)


@pytest.mark.parametrize(
    "changes",
    [
        {"near_camera": None}, {"near_camera": Seen(9, 6)}, {"depth_m": None},
        {"depth_m": np.full((6, 9), np.nan)},
    ],
)  # fmt: skip
def test_without_metres_relative_depth_is_taken_and_no_camera(changes: dict[str, object]) -> None:
    relative = np.full((6, 9), 0.4)
    inputs = {
        "depth_m": np.full((6, 9), 0.7), "depth_relative": relative, "near_camera": Seen(6, 9),
    }  # fmt: skip
    taken, camera = best_depth(inputs | changes)
    assert taken is relative and camera is None
    for nothing in (None, np.full((6, 9), np.nan)):
        assert best_depth(inputs | changes | {"depth_relative": nothing}) == (None, None)

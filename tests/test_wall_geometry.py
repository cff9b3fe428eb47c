"""Upright walls under a box that is cast ray by ray, on every side, and both sides of limits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from workbench_stages.edges.planes import Camera
from workbench_stages.edges.regions import distance_to_border
from workbench_stages.edges.stack import image_scale
from workbench_stages.edges.walls import Walls, upright_walls

TABLE_M = 0.8
HEIGHT_M = 0.15
NOISE_M = 2e-4


def cast(
    middle: tuple[float, float],
    shape: tuple[int, int] = (150, 210),
    size_m: tuple[float, float] = (0.05, 0.036),
    times: float = 1.0,
) -> tuple[np.ndarray, np.ndarray, Camera]:
    """What each pixel sees, 0 table, 1 top, 2 wall; the depth of table and top; and the camera.

    A box of 150 mm height on a table square to the axis; ``middle`` is the middle of its top in
    metres from the axis.  The focal lengths and the principal point are unlike.
    """
    camera = Camera(900.0 * times, 840.0 * times, 100.0 * times, 78.0 * times)
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    rx, ry = camera.rays(x, y)
    half = np.array(size_m) / 2
    low, high = np.array(middle) - half, np.array(middle) + half
    seen = np.zeros(shape, int)
    # A ray is within the box's footprint at a depth between the top's and the table's.
    for z in np.linspace(TABLE_M, TABLE_M - HEIGHT_M, 400):
        inside = (rx * z > low[0]) & (rx * z < high[0]) & (ry * z > low[1]) & (ry * z < high[1])
        seen[inside] = 2
    z = TABLE_M - HEIGHT_M
    top = (rx * z > low[0]) & (rx * z < high[0]) & (ry * z > low[1]) & (ry * z < high[1])
    seen[top] = 1
    rng = np.random.default_rng(0)
    depth = np.where(top, z, TABLE_M) + NOISE_M * rng.normal(size=shape)
    depth[seen == 2] = np.nan
    return seen, depth, camera


def found(seen: np.ndarray, depth: np.ndarray, camera: Camera, **changes: Any) -> Walls | None:
    """Walls where the table's region, 1, takes in the walls, and the top is region 2."""
    labels = changes.pop("labels", np.where(seen == 1, 2, 1).astype(np.int32))
    levels = changes.pop("levels", np.where(seen == 1, 150, 12).astype(np.float32))
    return upright_walls(
        labels, levels, depth.astype(np.float32), camera, distance_to_border(labels), **changes
    )


SIDE = (-0.045, 0.002)


@pytest.mark.parametrize(
    "middle",
    [(-0.045, 0.002), (0.047, 0), (0.002, -0.033), (0, 0.033), (-0.045, -0.033), (0.045, 0.033)],
)
def test_the_camera_sees_the_walls_on_the_side_of_the_axis(middle: tuple[float, float]) -> None:
    """To the left of the axis the right wall, above it the lower one, off both of them two."""
    seen, depth, camera = cast(middle)
    walls = found(seen, depth, camera)
    assert walls is not None
    wall = seen == 2
    both = (walls.labels > 0) & wall
    assert both.sum() / ((walls.labels > 0) | wall).sum() > 0.75
    assert walls.labels.max() == (2 if min(abs(m) for m in middle) > 0.03 else 1)
    np.testing.assert_allclose(walls.height_m[walls.labels > 0], HEIGHT_M, atol=3e-4)
    assert (walls.height_m[walls.labels == 0] == 0).all()
    # Its foot is the rim beside the table, away from the top.
    beside_table = ndimage.binary_dilation((walls.labels == 0) & (seen != 1)) & (walls.labels > 0)
    np.testing.assert_array_equal(walls.foot, beside_table)
    assert not (walls.labels[seen == 1] > 0).any()


def test_two_walls_of_one_box_have_numbers_of_their_own() -> None:
    seen, depth, camera = cast((-0.045, -0.033))
    walls = found(seen, depth, camera)
    assert walls is not None
    y, x = np.nonzero(walls.labels)
    number = walls.labels[y, x]
    ty, tx = np.argwhere(seen == 1).mean(axis=0)
    # One is to the right of the top, the other below it.
    right = number[np.argmax(x - tx - np.abs(y - ty))]
    below = number[np.argmax(y - ty - np.abs(x - tx))]
    assert {right, below} == {1, 2}
    assert x[number == right].min() > tx and y[number == below].min() > ty


def test_a_wall_is_as_large_as_asked_at_that_size() -> None:
    for times, shape in ((1.0, (150, 210)), (2.5, (400, 500))):
        seen, depth, camera = cast(SIDE, shape, times=times)
        scale = max(image_scale(shape), 1.0)
        walls = found(seen, depth, camera, least_area=1.0)
        assert walls is not None
        area = int((walls.labels == 1).sum())
        assert area > 0.7 * (seen == 2).sum()
        assert found(seen, depth, camera, least_area=area / scale**2 * (1 - 1e-9)) is not None
        assert found(seen, depth, camera, least_area=(area + 0.5) / scale**2) is None


def test_a_face_stands_out_by_so_many_residuals_of_the_table() -> None:
    seen, depth, camera = cast(SIDE)
    residuals = HEIGHT_M / NOISE_M
    assert found(seen, depth, camera, least_height=0.93 * residuals) is not None
    assert found(seen, depth, camera, least_height=1.08 * residuals) is None


@pytest.mark.parametrize(("tilt_deg", "lies"), [(3.5, True), (4.5, False)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_face_lies_within_four_degrees_of_the_table(
    tilt_deg: float, lies: bool, axis: int
) -> None:
    seen, depth, camera = cast(SIDE)
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]].astype(float)
    rays = camera.rays(x, y)
    ty, tx = np.argwhere(seen == 1).mean(axis=0)
    middle = camera.rays(np.array(tx), np.array(ty))[axis]
    # A plane turned about the middle of the top.
    slope = np.tan(np.radians(tilt_deg))
    z = (TABLE_M - HEIGHT_M) * (1 - slope * middle) / (1 - slope * rays[axis])
    depth = np.where(seen == 1, z, depth)
    assert (found(seen, depth, camera) is not None) == lies
    assert found(seen, depth, camera, lying_deg=6.0) is not None


@pytest.mark.parametrize(("share", "wall"), [(0.15, True), (0.35, False)])
def test_where_the_table_was_seen_there_is_no_wall(share: float, wall: bool) -> None:
    """A quarter of the wall's pixels may have the table's own depth."""
    seen, depth, camera = cast(SIDE)
    random = np.random.default_rng(1).random(seen.shape)
    depth = np.where((seen == 2) & (random < share), TABLE_M, depth)
    assert (found(seen, depth, camera) is not None) == wall
    assert found(seen, depth, camera, most_table=0.5) is not None


@pytest.mark.parametrize(("share", "face"), [(0.15, False), (0.3, True)])
def test_a_face_is_one_whose_depth_is_known_on_a_fifth_of_it(share: float, face: bool) -> None:
    seen, depth, camera = cast(SIDE)
    random = np.random.default_rng(1).random(seen.shape)
    depth = np.where((seen == 1) & (random > share), np.nan, depth)
    assert (found(seen, depth, camera) is not None) == face


def test_a_region_of_its_own_is_taken_where_it_is_dark_or_wholly_under_the_face() -> None:
    seen, depth, camera = cast(SIDE)
    labels = np.where(seen == 1, 2, 1).astype(np.int32)
    labels[seen == 2] = 3
    levels = np.where(seen == 1, 150, 12).astype(np.float32)
    for grey, whole, taken in ((12, True, True), (150, True, True), (150, False, False)):
        given, grown = labels.copy(), depth.copy()
        if not whole:
            # It goes on far beyond the prism, onto the table, and has no depth there either.
            ys = np.nonzero((seen == 2).any(axis=1))[0]
            given[ys.min() : ys.max() + 1, 150:200][
                given[ys.min() : ys.max() + 1, 150:200] == 1
            ] = 3
            grown[given == 3] = np.nan
        shown = levels.copy()
        shown[given == 3] = grey
        walls = found(seen, grown, camera, labels=given, levels=shown)
        assert (walls is not None) == taken
        if walls is not None:
            assert ((walls.labels > 0) & (given == 3)).sum() > 0.6 * (given == 3).sum()


def test_a_part_with_a_surface_of_its_own_hides_the_wall_behind_it() -> None:
    """A region in front of the wall whose depth was measured belongs to itself."""
    seen, depth, camera = cast(SIDE)
    labels = np.where(seen == 1, 2, 1).astype(np.int32)
    before = (seen == 2) & (np.arange(seen.shape[0])[:, None] > 78)
    labels[before] = 3
    depth[before] = 0.77
    walls = found(seen, depth, camera, labels=labels)
    assert walls is not None
    assert not (walls.labels[before] > 0).any()
    assert (walls.labels[(seen == 2) & ~before] > 0).mean() > 0.7


def test_a_table_that_leans_has_walls_along_its_own_normal() -> None:
    """The whole scene turned about the camera's centre gives the same walls, moved."""
    seen, depth, camera = cast(SIDE)
    straight = found(seen, depth, camera)
    assert straight is not None
    turn = np.radians(5)
    rotation = np.array(
        [[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]]
    )
    y, x = np.mgrid[: seen.shape[0], : seen.shape[1]].astype(float)
    rays = np.dstack([*camera.rays(x, y), np.ones_like(x)]) @ rotation
    u = np.rint(rays[..., 0] / rays[..., 2] * camera.fx + camera.cx).astype(int)
    v = np.rint(rays[..., 1] / rays[..., 2] * camera.fy + camera.cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < seen.shape[1]) & (v < seen.shape[0])
    u, v = np.clip(u, 0, seen.shape[1] - 1), np.clip(v, 0, seen.shape[0] - 1)
    there = np.where(inside, seen[v, u], 0)
    # z of the turned point: the ray's length along the old axis is its depth over rays' z.
    known = np.where(inside, depth[v, u], np.nan) / rays[..., 2]
    walls = found(there, known, camera)
    assert walls is not None
    wanted = np.where(inside, straight.labels[v, u], 0) > 0
    both = (walls.labels > 0) & wanted
    assert both.sum() / ((walls.labels > 0) | wanted).sum() > 0.75
    np.testing.assert_allclose(walls.height_m.max(), HEIGHT_M, atol=5e-4)

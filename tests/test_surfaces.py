"""Surfaces against geometry: frames, areas and centroids, views along the normal, surroundings."""

from __future__ import annotations

import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, Scene, disc, face, normal_of
from scipy.optimize import brentq
from scipy.stats import norm as gaussian

from workbench_stages.edges.planes import Camera, Plane
from workbench_stages.matching.surfaces import (
    Surface,
    camera_from_surface,
    cut_out,
    fall_off,
    features_mm,
    grid_px,
    shortest_turn,
    soft_view,
    upright_view,
)

OBLONG = Camera(1300.0, 1000.0, 63.0, 40.0)
"""Pixels that are not square, and a principal point that is not in the middle."""
TOWARDS = np.array([0.0, 0.0, -1.0])


# -- frames --------------------------------------------------------------------------------------


def test_of_a_face_that_is_not_tilted_x_is_right_y_is_up_and_z_comes_to_the_camera() -> None:
    np.testing.assert_array_equal(shortest_turn(TOWARDS), np.diag([1.0, -1.0, -1.0]))


@pytest.mark.parametrize("tilt", [0.0, 5.0, 40.0, 89.0, 95.0, 179.0, 179.9, 180.0])
@pytest.mark.parametrize("towards", [0.0, 130.0, 301.0])
def test_a_shortest_turn_is_a_rotation_whose_z_is_the_normal(tilt: float, towards: float) -> None:
    normal = normal_of(tilt, towards)
    axes = shortest_turn(3.0 * normal)
    np.testing.assert_allclose(axes[:, 2], normal, atol=1e-9)
    np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-9)
    assert np.linalg.det(axes) == pytest.approx(1)


@pytest.mark.parametrize("tilt", [10.0, 60.0, 100.0])
def test_the_shortest_turn_leaves_the_axis_it_turns_about(tilt: float) -> None:
    """Tilted to the right y stays as it is, tilted downwards x does; the other axis swings."""
    sine, cosine = np.sin(np.radians(tilt)), np.cos(np.radians(tilt))
    right = shortest_turn(np.array([sine, 0, -cosine]))
    np.testing.assert_allclose(right[:, 1], [0, -1, 0], atol=1e-12)
    np.testing.assert_allclose(right[:, 0], [cosine, 0, sine], atol=1e-12)
    down = shortest_turn(np.array([0, sine, -cosine]))
    np.testing.assert_allclose(down[:, 0], [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(down[:, 1], [0, -cosine, -sine], atol=1e-12)


def test_rotation_is_counter_clockwise_as_displayed_about_the_outward_normal() -> None:
    origin = np.array([0.01, -0.02, 0.7])
    matrix = camera_from_surface(origin, TOWARDS, 30.0)
    half, root = 0.5, np.sqrt(0.75)
    # Up as displayed is the camera's negative y.
    np.testing.assert_allclose(matrix[:3, 0], [root, -half, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 1], [-half, -root, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, 2], TOWARDS, atol=1e-12)
    np.testing.assert_array_equal(matrix[:3, 3], origin)
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


@pytest.mark.parametrize(("tilt", "towards"), [(0.0, 0.0), (35.0, 70.0), (60.0, 250.0)])
@pytest.mark.parametrize("rotation", [0.0, 17.0, 90.0, 200.0, 359.0])
def test_a_turned_frame_is_a_rotation_about_the_normal(
    tilt: float, towards: float, rotation: float
) -> None:
    normal = normal_of(tilt, towards)
    turned = camera_from_surface(np.zeros(3), normal, rotation)[:3, :3]
    np.testing.assert_allclose(turned.T @ turned, np.eye(3), atol=1e-12)
    assert np.linalg.det(turned) == pytest.approx(1)
    np.testing.assert_allclose(turned[:, 2], normal, atol=1e-12)
    before = shortest_turn(normal)
    angle = np.degrees(np.arctan2(turned[:, 0] @ before[:, 1], turned[:, 0] @ before[:, 0]))
    assert (angle - rotation + 180) % 360 - 180 == pytest.approx(0, abs=1e-9)


# -- a face cut out ------------------------------------------------------------------------------


def block(
    rows: slice, columns: slice, shape: tuple[int, int] = (90, 120), label: int = 3
) -> np.ndarray:
    labels = np.zeros(shape, np.int32)
    labels[rows, columns] = label
    return labels


def on_plane(x: np.ndarray, y: np.ndarray, point: np.ndarray, normal: np.ndarray) -> np.ndarray:
    ray = np.stack([(x - OBLONG.cx) / OBLONG.fx, (y - OBLONG.cy) / OBLONG.fy, np.ones_like(x)], -1)
    return ray * (normal @ point / (ray @ normal))[..., None]


@pytest.mark.parametrize(("tilt", "towards"), [(0, 0), (40, 20), (65, 250)])
def test_area_centroid_and_reach_are_those_of_the_face_itself(tilt: float, towards: float) -> None:
    """The pixels' corners on the plane say so, triangle by triangle."""
    labels = block(slice(20, 50), slice(70, 110))
    normal, point = normal_of(tilt, towards), np.array([0.01, 0.02, 0.8])
    surface = cut_out(labels, 3, point, normal, OBLONG)
    assert surface is not None
    y, x = np.mgrid[20:51, 70:111] - 0.5
    corners = on_plane(x, y, point, normal)
    a, b, c, d = corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]
    areas = np.concatenate(
        [np.linalg.norm(np.cross(q - p, r - p), axis=-1).ravel() / 2 for p, q, r in
         ((a, b, c), (a, c, d))]
    )  # fmt: skip
    middles = np.concatenate([((a + b + c) / 3).reshape(-1, 3), ((a + c + d) / 3).reshape(-1, 3)])
    centroid = areas @ middles / areas.sum()
    assert surface.area_mm2 == pytest.approx(1e6 * areas.sum(), rel=1e-4)
    np.testing.assert_allclose(surface.origin_m, centroid, atol=2e-6)
    assert normal @ surface.origin_m == pytest.approx(normal @ point)
    assert surface.z_m == surface.origin_m[2]
    assert surface.pixel_mm == pytest.approx(1e3 * surface.z_m / 1300.0)
    y, x = np.mgrid[20:50, 70:110].astype(float)
    farthest = np.linalg.norm(on_plane(x, y, point, normal) - centroid, axis=-1).max()
    assert surface.reach_mm == pytest.approx(1e3 * farthest, rel=1e-3)
    np.testing.assert_array_equal(surface.normal, normal)
    assert surface.camera is OBLONG


def test_the_mask_is_the_region_softened_where_it_lay() -> None:
    labels = block(slice(20, 50), slice(70, 110))
    surface = cut_out(labels, 3, np.array([0, 0, 0.8]), TOWARDS, OBLONG)
    assert surface is not None and surface.mask.dtype == np.float32
    left, top = surface.corner
    assert surface.mask.sum() == pytest.approx(30 * 40, rel=1e-5)
    assert max(surface.mask[[0, -1]].max(), surface.mask[:, [0, -1]].max()) < 1e-3
    # A Gaussian of sigma 0.7 px across a straight border.
    weight = np.exp(-0.5 * (np.arange(-3, 4) / 0.7) ** 2)
    weight /= weight.sum()
    for distance, expected in (
        (0, weight[:4].sum()),
        (1, weight[:5].sum()),
        (-1, weight[:3].sum()),
    ):
        assert surface.mask[35 - top, 70 + distance - left] == pytest.approx(expected, abs=1e-3)
        assert surface.mask[49 - distance - top, 90 - left] == pytest.approx(expected, abs=1e-3)
    assert surface.mask[35 - top, 90 - left] == pytest.approx(1)


def test_a_region_at_the_images_border_keeps_its_place() -> None:
    labels = block(slice(0, 30), slice(0, 40))
    surface = cut_out(labels, 3, np.array([0, 0, 0.8]), TOWARDS, OBLONG)
    assert surface is not None
    left, top = surface.corner
    assert left < 0 and top < 0
    inside = surface.mask > 0.5
    assert inside[-top : 30 - top, -left : 40 - left].all() and inside.sum() == 30 * 40


@pytest.mark.parametrize(
    ("label", "point", "normal"),
    [
        (4, [0, 0, 0.8], TOWARDS),
        (3, [0, np.nan, 0.8], TOWARDS),
        (3, [0, 0, 0.8], [np.nan, 0, -1]),
        (3, [0, 0, -0.8], TOWARDS),
        (3, [0, 0, -0.8], -TOWARDS),
    ],
    ids=["no such region", "no point", "no normal", "behind the camera", "behind, turned over"],
)
def test_what_has_no_plane_before_the_camera_is_not_cut_out(
    label: int, point: list[float], normal: list[float]
) -> None:
    labels = block(slice(20, 50), slice(70, 110))
    assert cut_out(labels, label, np.array(point), np.array(normal), OBLONG) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_plane_that_is_seen_from_its_edge_is_not_cut_out(sign: float) -> None:
    """The cosine of the ray and the normal is held against 0.05, whichever way the normal is."""
    labels, point = block(slice(39, 42), slice(62, 65)), np.array([0, 0, 0.8])
    for cosine, is_cut in ((0.052, True), (0.048, False)):
        normal = sign * np.array([0, np.sqrt(1 - cosine**2), -cosine])
        assert (cut_out(labels, 3, point, normal, OBLONG) is not None) == is_cut
    # One pixel that looks along the plane is enough.
    wide = block(slice(30, 50), slice(0, 120))
    assert cut_out(wide, 3, point, sign * normal_of(89.0, 0.0), OBLONG) is None
    assert cut_out(wide, 3, point, sign * normal_of(80.0, 0.0), OBLONG) is not None


# -- views along the normal ----------------------------------------------------------------------


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rotation", [0.0, 35.0, 250.0])
def test_a_view_looks_where_the_turned_face_lies(rotation: float, mirrored: bool) -> None:
    labels = block(slice(20, 50), slice(70, 110))
    surface = cut_out(labels, 3, np.array([0.01, 0.02, 0.8]), normal_of(40, 20), OBLONG)
    assert surface is not None
    columns, rows = grid_px(surface, 5, 3.0, rotation, mirrored)
    # Turned back, and then mirrored back, is where a point was that is now at (u, v) mm.
    pose = camera_from_surface(surface.origin_m, surface.normal, 0.0)
    back = np.radians(-rotation)
    for row, column in ((0, 0), (0, 4), (2, 2), (3, 1), (4, 4)):
        u, v = 3.0 * (column - 2), 3.0 * (2 - row)
        x, y = np.cos(back) * u - np.sin(back) * v, np.sin(back) * u + np.cos(back) * v
        at = pose @ [1e-3 * (-x if mirrored else x), 1e-3 * y, 0, 1]
        assert columns[row, column] == pytest.approx(1300 * at[0] / at[2] + 63, abs=1e-9)
        assert rows[row, column] == pytest.approx(1000 * at[1] / at[2] + 40, abs=1e-9)


def test_at_the_images_own_scale_a_view_is_the_mask() -> None:
    """Of a face that is not tilted, with a pixel in its middle."""
    labels = block(slice(110, 131), slice(95, 136), (256, 256))
    camera = Camera(1300.0, 1300.0, 115.0, 120.0)
    surface = cut_out(labels, 3, np.array([0, 0, 0.78]), TOWARDS, camera)
    assert surface is not None
    view = upright_view(surface, 51, 0.6)
    left, top = surface.corner
    expected = np.zeros((51, 51), np.float32)
    y, x = 120 - 25 - top, 115 - 25 - left
    expected[-y if y < 0 else 0 :, :][: len(surface.mask)][:, -x if x < 0 else 0 :][
        :, : surface.mask.shape[1]
    ] = surface.mask
    np.testing.assert_allclose(view, expected, atol=1e-3)


@pytest.mark.parametrize("view", [upright_view, soft_view])
@pytest.mark.parametrize("side", [40, 41])
def test_turns_are_counter_clockwise_and_a_mirrored_view_is_flipped_before_its_turn(
    view: object, side: int
) -> None:
    surface = face(ELL, 20.0, at=(0.01, -0.005, 0.76), tilt_deg=20.0, towards_deg=70.0)
    straight = view(surface, side, 2.0)  # type: ignore[operator]
    for quarters in (1, 2, 3):
        turned = view(surface, side, 2.0, 90.0 * quarters)  # type: ignore[operator]
        np.testing.assert_allclose(turned, np.rot90(straight, quarters), atol=2e-3)
    flipped = view(surface, side, 2.0, 0.0, True)  # type: ignore[operator]
    np.testing.assert_allclose(flipped, straight[:, ::-1], atol=2e-3)
    turned = view(surface, side, 2.0, 90.0, True)  # type: ignore[operator]
    np.testing.assert_allclose(turned, np.rot90(straight[:, ::-1]), atol=2e-3)
    assert np.abs(flipped - straight).max() > 0.5


@pytest.mark.parametrize(("side", "mm_per_px"), [(48, 2.0), (96, 1.0), (60, 1.5)])
def test_a_view_holds_the_faces_area_at_any_scale(side: int, mm_per_px: float) -> None:
    surface = face(ELL, 20.0, at=(0.01, -0.005, 0.76), tilt_deg=30.0, towards_deg=70.0)
    for view in (upright_view, soft_view):
        picture = view(surface, side, mm_per_px)
        assert picture.shape == (side, side) and picture.dtype == np.float32
        assert picture.sum() * mm_per_px**2 == pytest.approx(surface.area_mm2, rel=0.01)
        assert picture.sum() * mm_per_px**2 == pytest.approx(1420.0, rel=0.01)


def test_the_border_of_a_soft_view_is_as_wide_as_it_is_said_to_be() -> None:
    """Variances add: of the mask, of its interpolation, of the blur and of the averaging."""
    surface = face(RECTANGLE * 1.6)
    mm_per_px = 2.0
    profile = soft_view(surface, 60, mm_per_px)[25:35].mean(axis=0).astype(float)
    border = np.diff(profile[:30])
    place = np.arange(29) * mm_per_px
    middle = border @ place / border.sum()
    variance = border @ (place - middle) ** 2 / border.sum()
    pixel = surface.pixel_mm
    expected = (0.7 * pixel) ** 2 + pixel**2 / 6 + (2.0 * mm_per_px / 2) ** 2 + mm_per_px**2 / 12
    # Differences of pixels, and the averaging of two fine ones, are boxes too.
    assert variance == pytest.approx(expected + mm_per_px**2 / 12, rel=0.12)


# -- features ------------------------------------------------------------------------------------


def corner_cut(sigma: float) -> tuple[float, float]:
    """What a Gaussian blur cuts off a right corner: of the outline's length, and of its reach."""
    x = np.linspace(0.0, 5.0, 4001)[1:] + 1e-9
    y = gaussian.ppf(0.5 / gaussian.cdf(x))
    kept = (y > -8) & (y < 5) & (x < 5)
    on = np.stack([x[kept], y[kept]], axis=1)
    start = brentq(lambda t: gaussian.cdf(t) ** 2 - 0.5, 0, 3)
    half = on[on[:, 0] >= start]
    length = 2 * np.linalg.norm(np.diff(half, axis=0), axis=1).sum()
    straight = 2 * half[-1, 0]
    return sigma * float(straight - length), sigma * start


@pytest.mark.parametrize(("width", "height"), [(40, 30), (81, 50)])
@pytest.mark.parametrize("focal", [1300.0, 2600.0])
def test_features_of_a_rectangle_are_its_measures_but_for_its_smoothed_corners(
    width: int, height: int, focal: float
) -> None:
    labels = block(slice(60, 60 + height), slice(80, 80 + width), (256, 256))
    camera = Camera(focal, focal, 127.5, 127.5)
    surface = cut_out(labels, 3, np.array([0, 0, 0.78]), TOWARDS, camera)
    assert surface is not None
    area, perimeter, shape, reach = features_mm(surface)
    pixel = 1e3 * 0.78 / focal
    length, depth = corner_cut(pixel * np.sqrt((2.0 * 0.75) ** 2 + 0.7**2 + 1 / 6))
    assert area == surface.area_mm2 == pytest.approx(width * height * pixel**2, rel=1e-9)
    assert perimeter == pytest.approx(2 * (width + height) * pixel - 4 * length, rel=2e-3)
    assert shape == pytest.approx(4 * np.pi * area / perimeter**2)
    # The blurred corner, seen from the centroid, is all but where the diagonal meets it.
    cut = np.array([width, height]) / 2 * pixel - depth
    assert reach == pytest.approx(np.hypot(*cut), abs=0.1 * pixel)


@pytest.mark.parametrize("radius", [10.0, 20.0])
def test_a_disc_has_the_shape_factor_one(radius: float) -> None:
    area, perimeter, shape, reach = features_mm(face(disc(1e-3 * radius)))
    assert area == pytest.approx(np.pi * radius**2, rel=0.015)
    assert perimeter == pytest.approx(2 * np.pi * radius, rel=0.01)
    assert shape == pytest.approx(1, abs=0.015)
    assert reach == pytest.approx(radius, abs=0.25)


def test_reach_is_from_the_centroid_to_the_farthest_point_of_the_border() -> None:
    # Of a right triangle the acute corners are far from the centroid, at a third of both sides.
    triangle = (np.array([[0, 0], [48, 0], [0, 24]]) - [16, 8]) * 1e-3
    reach = features_mm(face(triangle))[3]
    assert np.hypot(32, 8) - 4 < reach < np.hypot(32, 8) - 1


def test_the_border_of_a_hole_is_border() -> None:
    ring, hole = Scene(), disc(0.008)
    label = ring.add(disc(0.02), 0.0)
    inner = ring.add(hole, 0.0)
    _, surface = ring.surface(label)
    area, perimeter, _, reach = features_mm(surface)
    assert inner == label + 1
    assert area == pytest.approx(np.pi * (20**2 - 8**2), rel=0.01)
    assert perimeter == pytest.approx(2 * np.pi * (20 + 8), rel=0.02)
    assert reach == pytest.approx(20, abs=0.3)


def test_a_face_too_small_to_have_an_outline_has_no_features() -> None:
    labels = block(slice(40, 41), slice(60, 61))
    surface = cut_out(labels, 3, np.array([0, 0, 0.8]), TOWARDS, OBLONG)
    assert surface is not None
    assert np.isnan(features_mm(surface)).all() and features_mm(surface).shape == (4,)


def test_the_same_face_in_an_image_of_twice_the_size_has_the_same_features() -> None:
    found = []
    for size, focal in ((256, 1300.0), (512, 2600.0)):
        scene = Scene(Camera(focal, focal, (size - 1) / 2, (size - 1) / 2), size)
        label = scene.add(ELL, 25.0, (0.01, -0.01, 0.77), 20.0, 130.0)
        found.append(features_mm(scene.surface(label)[1]))
    np.testing.assert_allclose(found[1] / found[0], 1, atol=0.03)


# -- surroundings --------------------------------------------------------------------------------

Z_M = 0.78


def alone(rows: slice = slice(100, 156), columns: slice = slice(90, 166)) -> Surface:
    """A face that is not tilted, whose surroundings a test writes into a depth of its own."""
    surface = cut_out(block(rows, columns, (256, 256)), 3, np.array([0, 0, Z_M]), TOWARDS, CAMERA)
    assert surface is not None
    return surface


def around(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    """Direction [deg] of each pixel from the face's centroid, and its distance from the border."""
    y, x = np.mgrid[:256, :256].astype(float)
    middle = surface.origin_m[:2] / surface.origin_m[2] * 1300 + 127.5
    angle = np.degrees(np.arctan2(middle[1] - y, x - middle[0])) % 360
    own = surface.mask > 0.5
    rows, columns = np.nonzero(own)
    top, left = rows.min() + surface.corner[1], columns.min() + surface.corner[0]
    bottom, right = rows.max() + surface.corner[1], columns.max() + surface.corner[0]
    out = np.hypot(
        np.maximum(np.maximum(left - x, x - right), 0),
        np.maximum(np.maximum(top - y, y - bottom), 0),
    )
    return angle, out


@pytest.mark.parametrize(
    ("rows", "columns"),
    [(slice(100, 156), slice(90, 166)), (slice(20, 76), slice(30, 106)),
     (slice(170, 226), slice(150, 226))],
    ids=["in the middle", "upper left", "lower right"],
)  # fmt: skip
def test_surroundings_are_told_by_direction_counter_clockwise_from_the_right(
    rows: slice, columns: slice
) -> None:
    """As far below the plane as the depth says, also far off the axis and far below."""
    surface = alone(rows, columns)
    sector = np.round(around(surface)[0] / 10).astype(int) % 36
    said = np.arange(36) * 2.0 - 10.0
    depth = (Z_M + 1e-3 * said[sector]).astype(np.float32)
    below, above = fall_off(surface, depth)
    np.testing.assert_allclose(below, said, atol=1e-3)
    assert np.isnan(above).all() and below.shape == above.shape == (36,)


def test_surroundings_of_a_tilted_face_are_measured_from_its_plane() -> None:
    """The plane itself is 0 below; a plane in parallel is as far below as it is away."""
    normal, point = normal_of(30.0, 20.0), np.array([0.0, 0.0, Z_M])
    surface = cut_out(block(slice(100, 156), slice(90, 166), (256, 256)), 3, point, normal, CAMERA)
    assert surface is not None
    y, x = np.mgrid[:256, :256].astype(float)
    rx, ry = CAMERA.rays(x, y)
    slant = normal[0] * rx + normal[1] * ry + normal[2]
    for away_mm in (0.0, 7.0, -4.0):
        depth = ((normal @ point - 1e-3 * away_mm) / slant).astype(np.float32)
        np.testing.assert_allclose(fall_off(surface, depth)[0], np.full(36, away_mm), atol=1e-3)


def test_heights_above_the_table_are_measured_from_the_tables_plane() -> None:
    surface = alone()
    table = Plane(np.array([0, 0, 0.8]), TOWARDS, 0.0, 100)
    depth = np.where(around(surface)[0] < 180, 0.795, 0.802).astype(np.float32)
    below, above = fall_off(surface, depth, table)
    np.testing.assert_allclose(above[[3, 9, 15]], 5.0, atol=1e-3)
    np.testing.assert_allclose(above[[21, 27, 33]], -2.0, atol=1e-3)
    np.testing.assert_allclose(below[[3, 9, 15]], 15.0, atol=1e-3)
    tilted = Plane(np.array([0, 0, 0.8]), normal_of(10.0, 0.0), 0.0, 100)
    y, x = np.mgrid[:256, :256].astype(float)
    rx, ry = CAMERA.rays(x, y)
    plane = tilted.normal @ tilted.point
    depth = plane / (tilted.normal[0] * rx + tilted.normal[1] * ry + tilted.normal[2])
    np.testing.assert_allclose(fall_off(surface, depth, tilted)[1], 0, atol=1e-9)


@pytest.mark.parametrize(("out", "measured"), [(5, False), (6, True), (14, True), (15, False)])
def test_surroundings_are_a_ring_beyond_the_sensors_window(out: int, measured: bool) -> None:
    """Depth is known along one line only, so far above the face's upper border."""
    surface = alone()
    depth = np.full((256, 256), np.nan, np.float32)
    depth[100 - out] = Z_M + 0.01
    below, _ = fall_off(surface, depth)
    assert np.isfinite(below[9]) == measured
    assert np.isnan(below[[0, 18, 27]]).all()
    if measured:
        assert below[9] == pytest.approx(10.0, abs=1e-3)


@pytest.mark.parametrize(("known", "measured"), [(3, False), (4, True)])
def test_a_direction_in_which_too_little_is_known_has_no_surroundings(
    known: int, measured: bool
) -> None:
    surface = alone()
    depth = np.full((256, 256), np.nan, np.float32)
    depth[92, 126 : 126 + known] = Z_M + 0.01
    below, _ = fall_off(surface, depth)
    assert np.isfinite(below).sum() == measured
    assert np.isfinite(below[9]) == measured


def test_surroundings_are_medians() -> None:
    surface = alone()
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((256, 256)) < 0.25, 0.5, Z_M + 0.01).astype(np.float32)
    table = Plane(np.array([0, 0, 0.8]), TOWARDS, 0.0, 100)
    below, above = fall_off(surface, depth, table)
    np.testing.assert_allclose(below, 10.0, atol=1e-3)
    np.testing.assert_allclose(above, 10.0, atol=1e-3)


def test_what_lies_outside_the_image_is_not_measured() -> None:
    surface = alone(slice(0, 56), slice(90, 166))
    below, _ = fall_off(surface, np.full((256, 256), Z_M + 0.01, np.float32))
    assert np.isnan(below[7:12]).all()
    np.testing.assert_allclose(below[20:35], 10.0, atol=1e-3)

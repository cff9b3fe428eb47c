"""Features of regions on exact figures, and outlines against a plain reference."""

from __future__ import annotations

import numpy as np
import pytest
from edge_scenes import eight
from scipy import ndimage
from skimage.measure import find_contours

from workbench_stages.edges.operators import Gradient
from workbench_stages.edges.planes import Camera
from workbench_stages.edges.regions import (
    closed_regions,
    closed_share,
    distance_to_border,
    region_features,
)


def block(shape: tuple[int, int], *boxes: tuple[int, int, int, int]) -> np.ndarray:
    """Labels 1, 2, … on boxes (top, bottom, left, right), ends left out; 0 elsewhere."""
    labels = np.zeros(shape, np.int32)
    for number, (top, bottom, left, right) in enumerate(boxes, start=1):
        labels[top:bottom, left:right] = number
    return labels


# -- outlines --------------------------------------------------------------------------------------


def plain_length(points: np.ndarray) -> float:
    """Length of a closed outline through crack middles [N 2], by the rule of its docstring.

    A crack counts for the chord from k before it to k after it, over 2 k, with the greatest k up
    to 7 up to which what lies between stays within 0.75 px of the chord.
    """
    n, total = len(points), 0.0
    for i in range(n):
        advance = 0.0
        for k in range(1, min(7, (n - 1) // 2) + 1):
            a, b = points[(i - k) % n], points[(i + k) % n]
            chord = float(np.hypot(*(b - a)))
            between = points[[(i + j) % n for j in range(1 - k, k)]] - a
            off = np.abs(between[:, 0] * (b - a)[1] - between[:, 1] * (b - a)[0])
            if chord == 0 or (k > 1 and (off > 0.75 * chord).any()):
                break
            advance = chord / (2 * k)
        total += advance
    return total


def plain_outline(mask: np.ndarray) -> tuple[float, float]:
    """Perimeter with holes, and greatest distance from the centroid to a crack's middle."""
    perimeter, far = 0.0, 0.0
    centroid = np.argwhere(mask).mean(axis=0)
    for contour in find_contours(np.pad(mask, 1).astype(float), 0.5, fully_connected="low"):
        points = contour[:-1] - 1
        perimeter += plain_length(points)
        far = max(far, float(np.hypot(*(points - centroid).T).max()))
    return perimeter, far


@pytest.mark.parametrize("seed", range(4))
def test_outlines_equal_a_plain_walk_around_each_region(seed: int) -> None:
    """Patches of every shape, with holes, pixels that touch at corners only, and at the border."""
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=(34, 47)), 1.3)
    labels, count = ndimage.label(field > 0.02)
    labels = labels.astype(np.int32)
    table = region_features(labels)
    assert count > 8
    for k in range(1, count + 1):
        perimeter, far = plain_outline(labels == k)
        assert table.perimeter_px[k - 1] == pytest.approx(perimeter, rel=1e-9)
        assert table.greatest_distance_px[k - 1] == pytest.approx(far, rel=1e-9)
        y, x = np.nonzero(labels == k)
        assert table.area_px[k - 1] == len(x)
        assert table.centroid_px[k - 1] == pytest.approx([x.mean(), y.mean()])
        rim = (x == 0) | (y == 0) | (x == 46) | (y == 33)
        assert table.border_px[k - 1] == rim.sum()
        assert table.shape_factor[k - 1] == pytest.approx(4 * np.pi * len(x) / perimeter**2)


def test_a_long_outline_is_not_cut_off() -> None:
    """More cracks than the walk has room for at first."""
    labels = block((40, 1600), (10, 20, 5, 1590))
    table = region_features(labels)
    assert table.perimeter_px[0] == pytest.approx(2 * (10 + 1585), abs=5)
    assert table.greatest_distance_px[0] == pytest.approx(np.hypot(792.5, 4.5))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 9), (4, 30), (21, 12)])
@pytest.mark.parametrize("place", [(0, 0), (5, 7)])
def test_a_rectangle(height: int, width: int, place: tuple[int, int]) -> None:
    top, left = place
    labels = block((40, 50), (top, top + height, left, left + width))
    for turned in eight(labels):
        table = region_features(turned)
        assert table.area_px[0] == height * width
        far = max(np.hypot(width / 2, (height - 1) / 2), np.hypot((width - 1) / 2, height / 2))
        assert table.greatest_distance_px[0] == pytest.approx(far)
    table = region_features(labels)
    assert table.centroid_px[0] == pytest.approx([left + (width - 1) / 2, top + (height - 1) / 2])
    # Each corner is cut off by little more than a pixel.
    exact = 2 * (height + width)
    assert table.perimeter_px[0] <= exact
    assert min(height, width) < 4 or table.perimeter_px[0] > exact - 4 * 1.2


def test_a_region_that_fills_the_image_ends_at_its_borders() -> None:
    """One border's pixels are no neighbours of the other's."""
    table = region_features(np.ones((24, 41), np.int32))
    assert table.perimeter_px[0] == pytest.approx(2 * (24 + 41), abs=5)
    assert table.border_px.tolist() == [2 * (24 + 41) - 4]
    assert table.greatest_distance_px[0] == pytest.approx(np.hypot(20.5, 11.5))


def test_an_l_has_its_centroid_outside_of_its_arms_middle() -> None:
    """Two arms of 40 by 10 that share a corner: areas and moments add."""
    labels = block((60, 60), (5, 45, 8, 18))
    labels[35:45, 8:48] = 1
    table = region_features(labels)
    assert table.area_px[0] == 700
    # 400 px at (12.5, 24.5) and 300 px at (32.5, 39.5).
    assert table.centroid_px[0] == pytest.approx(
        [(400 * 12.5 + 300 * 32.5) / 700, (400 * 24.5 + 300 * 39.5) / 700]
    )
    corners = [(7.5, 5), (8, 4.5), (47.5, 44), (47, 44.5), (8, 44.5), (47.5, 35)]
    far = max(np.hypot(*(table.centroid_px[0] - corner)) for corner in corners)
    assert table.greatest_distance_px[0] == pytest.approx(far)


# -- the background --------------------------------------------------------------------------------


@pytest.mark.parametrize(("rim", "background"), [(13, False), (14, True)])
def test_the_background_has_a_quarter_of_the_images_border(rim: int, background: bool) -> None:
    """Ten by twenty pixels have 56 on their border."""
    labels = block((10, 20), (0, 1, 0, rim), (2, 6, 3, 9))
    table = region_features(labels)
    assert table.border_px.tolist() == [rim, 0]
    assert table.background.tolist() == [background, False]


def test_of_several_the_one_with_most_of_the_border_is_the_background() -> None:
    labels = block((10, 20), (0, 1, 0, 20), (9, 10, 0, 19))
    assert region_features(labels).background.tolist() == [True, False]
    equal = block((10, 20), (0, 1, 0, 20), (9, 10, 0, 20))
    assert region_features(equal).background.tolist() == [True, True]
    # All of a single row is border.
    row = block((1, 20), (0, 1, 0, 4), (0, 1, 10, 15))
    assert region_features(row).background.tolist() == [False, True]


# -- closed regions --------------------------------------------------------------------------------


def test_regions_are_numbered_by_their_first_pixels() -> None:
    edges = np.zeros((9, 12), bool)
    edges[:, 5] = edges[4, 5:] = True
    labels = closed_regions(edges, grow=False, min_area=1)
    assert (labels[0, 0], labels[0, 11], labels[8, 11]) == (1, 2, 3)
    mirrored = closed_regions(np.ascontiguousarray(edges[:, ::-1]), grow=False, min_area=1)
    assert (mirrored[0, 0], mirrored[0, 11], mirrored[8, 0]) == (1, 2, 3)
    assert (labels == 0).sum() == edges.sum()
    assert labels.dtype == np.int32


def test_known_walls_are_regions_whatever_their_size_and_edges_in_them_count_for_nothing() -> None:
    edges = np.zeros((64, 256), bool)
    edges[:, 100] = True
    walls = np.zeros((64, 256), np.int32)
    walls[10, 20:22] = 1
    walls[30:40, 90:110] = 2
    labels = closed_regions(edges, walls=walls, grow=False, min_area=12)
    assert labels.max() == 4
    assert (labels[10, 20], labels[10, 21]) == (labels[10, 20],) * 2
    assert (labels == labels[10, 20]).sum() == 2
    assert (labels == labels[35, 100]).sum() == 200
    assert labels[0, 0] == 1 and labels[0, 255] == 2
    for name in ("image", "walls"):
        with pytest.raises(ValueError, match=f"{name} has shape"):
            closed_regions(edges, **{name: np.zeros((256, 64), np.int32)})


@pytest.mark.parametrize(("grey", "owner"), [(20, 1), (59, 1), (60, 0), (61, 2), (150, 2)])
def test_an_edge_pixel_goes_to_the_region_of_the_nearer_grey_level(grey: int, owner: int) -> None:
    image = np.full((16, 21), 20, np.float32)
    image[:, 11:] = 100
    image[:, 10] = grey
    edges = np.zeros(image.shape, bool)
    edges[:, 10] = True
    labels = closed_regions(edges, image, min_area=1)
    assert (labels[:, 10] == owner).all()
    assert (labels[:, 9].tolist(), labels[:, 11].tolist()) == ([1] * 16, [2] * 16)


def test_thick_lines_are_given_away_ring_by_ring() -> None:
    """Six pixels of line, all as bright as the left region: each ring goes on from the last."""
    image = np.full((16, 30), 20, np.float32)
    image[:, 16:] = 100
    edges = np.zeros(image.shape, bool)
    edges[:, 10:16] = True
    labels = closed_regions(edges, image, min_area=1)
    # From the right a pixel has no choice: three rings from either side.
    assert (labels[:, :13] == 1).all()
    assert (labels[:, 13:] == 2).all()


@pytest.mark.parametrize(("before", "after", "owner"), [(4, 8, 1), (8, 4, 2)])
def test_a_crest_pixel_goes_to_the_side_that_its_centre_lies_on(
    before: int, after: int, owner: int
) -> None:
    """The gradient grows towards the bright side: the edge lies there, the pixel in the dark."""
    image = np.full((14, 21), 20, np.float32)
    image[:, 11:] = 100
    # By its grey level the pixel would go to the other side.
    image[:, 10] = 100 if owner == 1 else 20
    edges = np.zeros(image.shape, bool)
    edges[:, 10] = True
    magnitude = np.zeros(image.shape, np.float32)
    magnitude[:, 9:12] = before, 10, after

    for turns in range(4):
        # The gradient points from dark to bright: to the right, and turned with the image.
        way = [(1, 0), (0, -1), (-1, 0), (0, 1)][turns]
        turned = [np.ascontiguousarray(np.rot90(a, turns)) for a in (image, edges, magnitude)]
        gx, gy = (turned[2] * np.float32(component) for component in way)
        gradient = Gradient(gx, gy, turned[2], turned[1], turned[0], 20.0, turned[0])
        labels = closed_regions(turned[1], turned[0], gradient, min_area=1)
        back = np.rot90(labels, -turns)
        inner = slice(1, -1)  # on the image's border one neighbour is not known
        wanted = back[5, 0] if owner == 1 else back[5, 20]
        assert (back[inner, 10] == wanted).all()


def test_a_crest_between_two_pixels_is_told_along_the_gradient_also_when_it_is_oblique() -> None:
    """Of the diagonal's pixels the magnitude beyond them decides, whichever way it points."""
    y, x = np.mgrid[0:21, 0:21]
    edges = x == y
    image = np.where(x > y, 100, 20).astype(np.float32)
    image[edges] = 60
    for shift, bright in ((0.3, False), (-0.3, True)):
        # A crest parallel to the diagonal, shifted to the bright side or to the dark one.
        magnitude = (12 - np.abs((x - y) / np.sqrt(2) - shift)).astype(np.float32)
        gx = magnitude * np.float32(np.sqrt(0.5))
        gradient = Gradient(gx, -gx, magnitude, edges, image, 20.0, image)
        labels = closed_regions(edges, image, gradient, min_area=1)
        assert (labels[edges][1:-1] == (labels[0, 20] if bright else labels[20, 0])).all()


# -- lines that close ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("width", "share"), [(1, 1.0), (2, 1.0), (3, 1 / 3), (4, 0.0)]
)  # fmt: skip
def test_a_line_closes_where_two_regions_lie_within_two_pixels(width: int, share: float) -> None:
    lines = np.zeros((20, 30), bool)
    lines[:, 10 : 10 + width] = True
    labels = closed_regions(lines, grow=False, min_area=1)
    assert closed_share(labels, lines) == pytest.approx(share)


def test_a_line_that_ends_within_a_region_closes_nothing_there() -> None:
    lines = np.zeros((20, 30), bool)
    lines[:, 10] = lines[10, 10:20] = True
    labels = closed_regions(lines, grow=False, min_area=1)
    # The spur's first pixel, two from the region beyond the upright line, has it within reach.
    assert closed_share(labels, lines) == pytest.approx((20 + 1) / 29)
    assert np.isnan(closed_share(labels, lines & False))


# -- distance to the border ------------------------------------------------------------------------


def test_distance_to_another_label_counts_pixels_and_the_images_border_is_none() -> None:
    labels = block((20, 31), (0, 20, 0, 12), (0, 20, 12, 31))
    away = distance_to_border(labels)
    np.testing.assert_allclose(away[7], [*range(12, 0, -1), *range(1, 20)], rtol=1e-6)
    np.testing.assert_allclose(
        distance_to_border(np.ascontiguousarray(labels.T))[:, 7], away[7], rtol=1e-6
    )
    assert (distance_to_border(labels * 0 + 1) == 31).all()
    assert (distance_to_border(np.zeros((40, 8), np.int32)) == 40).all()


def test_distance_to_another_label_is_euclids_within_some_percent() -> None:
    """One for the rim itself, and from there on from pixel to pixel."""
    rng = np.random.default_rng(2)
    labels = (ndimage.gaussian_filter(rng.normal(size=(60, 90)), 6) > 0).astype(np.int32)
    rim = np.zeros(labels.shape, bool)
    for value in (0, 1):
        rim |= ndimage.binary_dilation(labels != value) & (labels == value)
    exact = 1 + ndimage.distance_transform_edt(~rim)
    np.testing.assert_allclose(distance_to_border(labels), exact, rtol=0.025)


# -- planes of regions -----------------------------------------------------------------------------

CAMERA = Camera(900.0, 700.0, 70.0, 45.0)


def plane_depth(normal: np.ndarray, through: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Depth [H W] of the plane n · P = n · through, seen by ``CAMERA``."""
    v, u = np.mgrid[: shape[0], : shape[1]].astype(float)
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(shape)], -1)
    return normal @ through / (rays @ normal)


def unit(x: float, y: float, z: float) -> np.ndarray:
    return np.array([x, y, z]) / np.sqrt(x * x + y * y + z * z)


@pytest.mark.parametrize(
    "normal", [unit(0, 0, -1), unit(0.3, 0, -1), unit(0, 0.3, -1), unit(-0.2, 0.4, -1)]
)
def test_point_normal_and_tilt_of_a_region_on_an_exact_plane(normal: np.ndarray) -> None:
    shape = (90, 120)
    depth = plane_depth(normal, np.array([0.01, -0.02, 0.7]), shape)
    labels = block(shape, (20, 70, 15, 95))
    labels[20:40, 60:95] = 0
    table = region_features(labels, depth, CAMERA)
    assert table.normal[0] == pytest.approx(normal, abs=1e-5)
    assert table.tilt_deg[0] == pytest.approx(np.degrees(np.arccos(-normal[2])), abs=1e-3)
    assert table.residual_m[0] < 1e-6
    x, y = table.centroid_px[0]
    ray = np.array([*CAMERA.rays(x, y), 1.0])
    on_plane = ray * (normal @ [0.01, -0.02, 0.7]) / (normal @ ray)
    assert table.point_m[0] == pytest.approx(on_plane, abs=1e-6)
    assert table.known_share[0] == 1
    assert table.plane_px[0] == (distance_to_border(labels)[labels == 1] > 7).sum()


def test_elevation_is_the_distance_to_a_tilted_table_along_its_normal() -> None:
    shape, up = (120, 160), unit(0.1, -0.15, -1)
    table_point = np.array([0.0, 0.0, 0.8])
    depth = plane_depth(up, table_point, shape)
    labels = np.ones(shape, np.int32)
    for number, (height, left) in enumerate(((0.02, 20), (0.035, 95)), start=2):
        top = plane_depth(up, table_point + height * up, shape)
        box = (slice(40, 80), slice(left, left + 40))
        depth[box], labels[box] = top[box], number
    found = region_features(labels, depth, CAMERA)
    assert found.elevation_from == "table"
    assert found.elevation_m == pytest.approx([0, 0.02, 0.035], abs=2e-5)
    assert found.background.tolist() == [True, False, False]


@pytest.mark.parametrize(
    ("height", "tilt_deg", "background"),
    [(0.0013, 0.0, True), (0.0017, 0.0, False), (0.0, 4.0, True), (0.0, 6.0, False)],
)
def test_what_lies_flat_on_the_table_is_background(
    height: float, tilt_deg: float, background: bool
) -> None:
    """Within 1.5 mm of the table and 5 degrees of its tilt."""
    shape = (120, 160)
    depth = np.full(shape, 0.8)
    labels = np.ones(shape, np.int32)
    labels[40:80, 60:100] = 2
    x, y = CAMERA.rays(np.array(79.5), np.array(59.5))
    middle = np.array([x, y, 1.0]) * (0.8 - height)
    turn = np.radians(tilt_deg)
    normal = np.array([np.sin(turn), 0, -np.cos(turn)])
    depth[labels == 2] = plane_depth(normal, middle, shape)[labels == 2]
    found = region_features(labels, depth, CAMERA)
    assert found.elevation_m[1] == pytest.approx(height, abs=1e-4)
    assert found.background.tolist() == [True, background]


def test_without_a_table_elevation_counts_from_the_99th_percentile_of_what_is_known() -> None:
    shape = (100, 100)
    depth = np.full(shape, np.nan)
    # Nothing is known of the image's border, so there is no table.
    depth[20:70, 10:90] = np.linspace(0.70, 0.75, 4000).reshape(50, 80)
    labels = block(shape, (20, 70, 10, 90), (80, 90, 20, 60))
    depth[80:90, 20:60] = 0.6
    found = region_features(labels, depth, Camera(900.0, 900.0, 50.0, 50.0), inset=0)
    farthest = np.percentile(depth[np.isfinite(depth)], 99)
    assert found.elevation_from == "farthest"
    assert found.elevation_m[1] == pytest.approx(farthest - 0.6, abs=1e-6)


def test_known_share_counts_pixels_with_depth_and_a_plane_needs_eight() -> None:
    shape = (40, 50)
    depth = np.full(shape, np.nan, np.float32)
    labels = block(shape, (2, 12, 3, 23), (20, 30, 3, 23), (32, 36, 3, 8))
    depth[2:12, 3:13] = 0.7
    depth[20, 3:10] = 0.7
    depth[32:36, 3:5] = 0.71
    found = region_features(labels, depth, CAMERA)
    assert found.known_share == pytest.approx([0.5, 7 / 200, 8 / 20])
    assert np.isnan(found.tilt_deg).tolist() == [False, True, False]
    assert found.plane_px.tolist()[1:] == [0, 8]
    with pytest.raises(ValueError, match="depth has shape"):
        region_features(labels, depth.T, CAMERA)

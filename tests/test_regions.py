"""Regions and their features on shapes and planes whose measures are known; the metrics too."""

import numpy as np
import pytest
from edge_scenes import eight

from workbench_stages.edges import score as metrics
from workbench_stages.edges.planes import Camera, background_plane, fit_plane
from workbench_stages.edges.regions import closed_regions, region_features

CAMERA = Camera(1300.0, 1300.0, 79.5, 79.5)


def grid(size=160):
    y, x = np.mgrid[:size, :size] - (size - 1) / 2
    return x, y


@pytest.mark.parametrize("side", [24, 60])
def test_a_turned_square_has_the_same_perimeter(side):
    x, y = grid()
    measured = []
    for degrees in range(0, 90, 5):
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        square = np.maximum(abs(c * x + s * y + 0.13), abs(c * y - s * x - 0.21)) < side / 2
        table = region_features(square.astype(np.int32))
        measured.append(table.perimeter_px[0] / (4 * side))
        assert table.area_px[0] == pytest.approx(side**2, rel=0.04)
        assert table.shape_factor[0] == pytest.approx(np.pi / 4, rel=3.5 / side)
        assert table.greatest_distance_px[0] == pytest.approx(side / np.sqrt(2), rel=0.04)
    assert np.ptp(measured) < 0.05
    assert np.mean(measured) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("radius", [8, 20, 60])
def test_a_disc_has_shape_factor_one(radius):
    x, y = grid()
    table = region_features((np.hypot(x + 0.2, y - 0.3) < radius).astype(np.int32))
    assert table.perimeter_px[0] == pytest.approx(2 * np.pi * radius, rel=0.02)
    assert table.shape_factor[0] == pytest.approx(1, abs=0.04)
    assert table.centroid_px[0] == pytest.approx([79.5 - 0.2, 79.5 + 0.3], abs=0.1)


def test_a_hole_adds_to_the_perimeter():
    x, y = grid()
    ring = ((np.hypot(x, y) < 50) & (np.hypot(x, y) >= 20)).astype(np.int32)
    perimeter = region_features(ring).perimeter_px[0]
    assert perimeter == pytest.approx(2 * np.pi * 70, rel=0.02)


def test_features_turn_with_the_region():
    rng = np.random.default_rng(0)
    labels = closed_regions(rng.random((40, 60)) < 0.42, min_area=1)
    base = region_features(labels)
    for turned in eight(labels):
        table = region_features(turned)
        np.testing.assert_array_equal(table.area_px, base.area_px)
        np.testing.assert_allclose(table.perimeter_px, base.perimeter_px, atol=1e-9)
        np.testing.assert_allclose(table.greatest_distance_px, base.greatest_distance_px, atol=1e-9)


def test_an_eight_connected_line_closes_and_its_pixels_are_given_away():
    edges = np.eye(40, dtype=bool)
    image = np.where(np.add.outer(-np.arange(40), np.arange(40)) >= 0, 100, 20)
    labels = closed_regions(edges, image)
    assert labels.max() == 2
    # The diagonal is as bright as the upper right part.
    assert (labels[edges] == labels[0, 39]).all()
    assert (closed_regions(edges, image, grow=False)[edges] == 0).all()
    # Nothing tells whose a pixel is that lies as near to both.
    assert (closed_regions(edges, None)[edges] == 0).all()


def test_small_regions_are_shared_out():
    edges = np.zeros((256, 256), bool)
    edges[100:104, 100:104] = True
    edges[101:103, 101:103] = False
    labels = closed_regions(edges, np.zeros((256, 256)))
    assert labels.min() == labels.max() == 1


def plane_depth(tilt_deg, z0=0.76, noise=0.0, seed=0):
    """Depth [H W] m of a plane through (0, 0, z0) tilted about the y axis."""
    v, u = np.mgrid[:160, :160]
    rx, _ = CAMERA.rays(u, v)
    depth = z0 / (1 + np.tan(np.radians(tilt_deg)) * rx)
    return depth + np.random.default_rng(seed).normal(0, noise, depth.shape)


@pytest.mark.parametrize("tilt", [0, 10, 25, 50])
def test_plane_normal_tilt_and_residual(tilt):
    depth = plane_depth(tilt, noise=3e-4).astype(np.float32)
    depth[60:70] = 0.70
    depth[:5] = np.nan
    x, y = grid()
    labels = (np.hypot(x, y) < 40).astype(np.int32)
    table = region_features(labels, depth, CAMERA)
    assert table.tilt_deg[0] == pytest.approx(tilt, abs=0.7)
    assert table.normal[0, 2] < 0
    assert abs(table.normal[0, 0]) == pytest.approx(np.sin(np.radians(tilt)), abs=0.01)
    assert table.residual_m[0] == pytest.approx(3e-4 * np.cos(np.radians(tilt)), rel=0.15)
    assert table.point_m[0, 2] == pytest.approx(0.76, abs=3e-4)
    assert table.known_share[0] == 1


def test_elevation_is_height_above_the_table():
    depth = plane_depth(2, z0=0.795, noise=2e-4)
    labels = np.ones((160, 160), np.int32)
    depth[60:100, 50:110] = plane_depth(0, z0=0.76)[60:100, 50:110]
    labels[60:100, 50:110] = 2
    table = region_features(labels, depth.astype(np.float32), CAMERA)
    assert table.elevation_from == "table"
    assert table.elevation_m[1] == pytest.approx(0.035, abs=1e-3)
    assert table.elevation_m[0] == pytest.approx(0, abs=5e-4)
    assert table.background.tolist() == [True, False]
    assert background_plane(depth, CAMERA).tilt_deg == pytest.approx(2, abs=0.2)


def test_without_a_table_elevation_counts_from_the_farthest_depth():
    depth = np.full((160, 160), np.nan, np.float32)
    labels = np.ones((160, 160), np.int32)
    for k, z in enumerate((0.78, 0.76, 0.75, 0.74, 0.73, 0.72, 0.71, 0.70, 0.69, 0.68, 0.67)):
        part = slice(10 + 13 * k, 20 + 13 * k), slice(40, 120)
        depth[part], labels[part] = z, k + 2
    table = region_features(labels, depth, CAMERA)
    assert table.elevation_from == "farthest"
    assert table.elevation_m[2] - table.elevation_m[1] == pytest.approx(0.02, abs=1e-4)


def test_fit_plane_refuses_lines_and_few_points():
    assert fit_plane(np.zeros((5, 3))) is None
    line = np.column_stack([np.arange(50.0), np.arange(50.0), np.ones(50)])
    assert fit_plane(line) is None


def test_no_regions_and_no_depth_are_defined():
    empty = region_features(np.zeros((10, 10), np.int32))
    assert len(empty) == 0
    lone = region_features(np.ones((1, 20), np.int32), np.full((1, 20), np.nan), CAMERA)
    assert np.isnan(lone.elevation_m[0])
    assert lone.elevation_from == ""
    with pytest.raises(ValueError, match="intrinsics"):
        region_features(np.ones((2, 2), np.int32), np.ones((2, 2)))
    with pytest.raises(ValueError, match="axes"):
        closed_regions(np.zeros((0, 3), bool))


# -- metrics -------------------------------------------------------------------------------------


def two_faces():
    instances = np.zeros((60, 80), np.uint8)
    faces = np.zeros((60, 80), np.uint8)
    instances[10:50, 10:40] = 1
    instances[10:50, 40:70] = 2
    return metrics.face_ids(instances, faces)


def test_perfect_regions_and_edges_score_one():
    ids = two_faces()
    _, labels = np.unique(ids, return_inverse=True)
    score = metrics.region_score(labels.reshape(ids.shape), ids)
    assert score.best_iou.tolist() == [1.0, 1.0]
    assert (score.leaks, score.splits) == (0, 0)
    boundaries = metrics.face_boundaries(ids)
    edges = metrics.edge_score(boundaries, boundaries)
    assert edges.precision == edges.recall == 1
    shifted = metrics.edge_score(np.roll(boundaries, 4, axis=1), boundaries)
    assert shifted.precision < 0.8
    assert metrics.edge_score(np.zeros_like(boundaries), boundaries).recall == 0


def test_leaks_and_splits_are_counted():
    ids = two_faces()
    leaking = (ids > 0).astype(np.int32)
    score = metrics.region_score(leaking, ids)
    assert (score.leaks, score.splits) == (1, 0)
    split = np.unique(ids, return_inverse=True)[1].reshape(ids.shape)
    split[10:30, 10:40] = 7
    assert metrics.region_score(split, ids).splits == 1
    assert metrics.summarise([score])["found"] == 0


def test_what_is_in_front_covers():
    ids = two_faces()
    depth = np.full(ids.shape, 0.8)
    depth[10:50, 10:40] = 0.75
    depth[10:50, 40:70] = 0.77
    assert metrics.region_score(ids * 0, ids, depth).covered.tolist() == [False, True]

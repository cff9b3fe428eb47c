"""Upright walls under lying faces, on boxes whose walls no intensity shows."""

import numpy as np
import pytest
from edge_scenes import eight
from scipy import ndimage

from workbench_stages.edges.linking import Step
from workbench_stages.edges.planes import Camera, fit_plane, fit_planes
from workbench_stages.edges.regions import distance_to_border
from workbench_stages.edges.segmentation import link_edges, segment, stack_edges

CAMERA = Camera(900.0, 900.0, 99.5, 99.5)
TABLE = 0.8


def box(height=0.05, seed=0, wall_depth=False):
    """A box off the axis, its side walls as dark as the table: image, depth, truth.

    ``truth`` is 1 on the top, 2 on the walls.  The depth is unknown within 3 px of the top's edge
    and on the walls; ``wall_depth`` lets the sensor see the table there, as if nothing stood.
    """
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:200, :200].astype(float) - 99.5
    z = TABLE - height

    def square(scale):
        return (abs(x / scale + 0.052 * 900) < 22.4) & (abs(y / scale + 0.0077 * 900) < 31.3)

    top = square(TABLE / z)
    truth = np.zeros((200, 200), int)
    for k in np.linspace(1, TABLE / z, 60):
        truth[square(k)] = 2
    truth[top] = 1
    level = np.where(top, 140.0, 14.0)
    image = ndimage.gaussian_filter(level, 0.8) + rng.normal(0, 0.6, level.shape)
    depth = np.where(top, z, TABLE) + 3e-4 * rng.normal(size=level.shape)
    if not wall_depth:
        rim = ndimage.binary_dilation(top, iterations=3) & ~ndimage.binary_erosion(top)
        depth[rim | (truth == 2)] = np.nan
    return np.round(image).clip(0, 255).astype(np.uint8), depth.astype(np.float32), truth


def best_iou(labels, face):
    number = np.bincount(labels[face])
    k = int(number.argmax())
    return number[k] / ((labels == k) | face).sum() if k else 0.0


def test_a_wall_that_only_the_depth_shows_becomes_a_region():
    image, depth, truth = box()
    _, linked, labels = segment(image, depth, camera=CAMERA)
    assert best_iou(labels, truth == 1) > 0.95
    assert best_iou(labels, truth == 2) > 0.8
    assert (linked.step[linked.feet] == Step.FOOT).all()
    assert np.ptp(linked.value[linked.feet]) == 0
    assert linked.value[linked.feet][0] == pytest.approx(0.05, abs=5e-4)
    np.testing.assert_array_equal(
        linked.edges, linked.edges_reconstructed | linked.links | linked.creases | linked.feet
    )
    # Feet lie where the wall ends.
    outside = ndimage.distance_transform_edt(truth > 0)
    assert (outside[linked.feet] <= 2).mean() > 0.95


def test_no_walls_without_a_camera_a_table_or_a_height():
    image, depth, truth = box()
    stack = stack_edges(image, depth)
    assert link_edges(stack, depth).walls is None
    assert link_edges(stack, depth, CAMERA, wall_area=0).walls is None
    alone = np.where(truth == 1, depth, np.float32(np.nan))
    assert link_edges(stack, alone, CAMERA).walls is None
    low, low_depth, _ = box(height=0.001)
    assert link_edges(stack_edges(low, low_depth), low_depth, CAMERA).walls is None


def test_where_the_table_itself_was_seen_there_is_no_wall():
    image, depth, _ = box(wall_depth=True)
    assert link_edges(stack_edges(image, depth), depth, CAMERA).walls is None


def test_walls_turn_and_mirror_with_the_image():
    image, depth, _ = box()
    _, linked, labels = segment(image, depth, camera=CAMERA)
    wanted = zip(eight(linked.edges), eight(linked.step), eight(labels), strict=True)
    turned = zip(eight(image), eight(depth), strict=True)
    for (image_, depth_), (edges, step, label) in zip(turned, wanted, strict=True):
        _, linked_, labels_ = segment(image_, depth_, camera=CAMERA)
        np.testing.assert_array_equal(linked_.edges, edges)
        np.testing.assert_array_equal(linked_.step, step)
        pairs = np.unique(np.stack([labels_.ravel(), label.ravel()]), axis=1)
        assert len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == pairs.shape[1]


def test_planes_of_all_regions_are_those_of_each():
    _, depth, truth = box()
    labels = truth.astype(np.int32) + 1
    planes, known = fit_planes(labels, depth, CAMERA, distance_to_border(labels), inset=0)
    assert known.tolist() == [np.isfinite(depth[labels == k]).sum() for k in (1, 2, 3)]
    assert planes[2] is None
    for k in (1, 2):
        y, x = np.nonzero((labels == k) & np.isfinite(depth))
        z = depth[y, x].astype(float)
        rx, ry = CAMERA.rays(x, y)
        alone = fit_plane(np.column_stack([rx * z, ry * z, z]))
        np.testing.assert_allclose(planes[k - 1].normal, alone.normal, atol=1e-9)
        assert planes[k - 1].residual == pytest.approx(alone.residual)
        assert planes[k - 1].points == alone.points

"""Reconstruction and linking: laws, references, and the healing of gaps (issue 3, items 3, 4)."""

import edge_gaps as gaps
import numpy as np
import pytest
from edge_scenes import eight, scene
from scipy import ndimage

from workbench_stages.edges.linking import (
    TERMINATOR_MASKS,
    Step,
    bresenham,
    link,
    reconstruct,
    terminators_of,
)
from workbench_stages.edges.planes import Camera
from workbench_stages.edges.regions import region_features
from workbench_stages.edges.segmentation import PRESETS, link_edges, segment, stack_edges

EIGHT = np.ones((3, 3))


def random_stack(seed, shape=(256, 256)):
    rng = np.random.default_rng(seed)
    field = ndimage.gaussian_filter(rng.normal(size=shape), 1.2)
    field /= field.std()
    return field > 2.2, field > 1.9, field > 1.5


def reference_reconstruction(low, medium, high, longest_noise):
    output = low.copy()
    for finer in (medium, high):
        labels, n = ndimage.label(finer & ~output, EIGHT)
        touching = ndimage.binary_dilation(output, EIGHT)
        kept = output.copy()
        for k in range(1, n + 1):
            segment_ = labels == k
            if segment_.sum() > longest_noise or (segment_ & touching).any():
                kept |= segment_
        output = kept
    return output


def test_reconstruction_equals_the_paper_step_by_step():
    for seed in range(2):
        stack = random_stack(seed)
        ours = reconstruct(*stack)
        np.testing.assert_array_equal(ours.edges, reference_reconstruction(*stack, 4))


def test_reconstruction_never_removes_a_pixel_of_the_low_resolution_image():
    for seed in range(5):
        low, medium, high = random_stack(seed)
        strength = np.random.default_rng(seed).uniform(0, 5, low.shape).astype(np.float32)
        for min_weight in (0.0, 12.0, 1e6):
            done = reconstruct(low, medium, high, strength, min_weight=min_weight, unit=2.0)
            assert not (low & ~done.edges).any()
            assert not (low & ~done.first).any()
            assert not (done.edges & ~high).any()


def test_every_pixel_tells_who_decided():
    low, medium, high = random_stack(3)
    strength = np.ones(low.shape, np.float32)
    done = reconstruct(low, medium, high, strength, high, min_weight=8.0)
    np.testing.assert_array_equal(done.step >= Step.LOW, done.edges)
    rejected = high & ~done.edges
    fates = {Step.SHORT_MEDIUM, Step.SHORT_HIGH, Step.FAINT_MEDIUM, Step.FAINT_HIGH}
    assert set(np.unique(done.step[rejected])) <= {int(f) for f in fates}
    assert (done.value[done.step == Step.SHORT_HIGH] <= 4).all()
    faint = (done.step == Step.FAINT_HIGH) | (done.step == Step.FAINT_MEDIUM)
    assert faint.any()
    assert (done.value[faint] <= 8).all()


def test_terminators_are_the_sixteen_masks():
    edges = random_stack(1)[0]
    padded = np.pad(edges, 1)
    wanted = np.zeros_like(edges)
    for mask in TERMINATOR_MASKS:
        match = np.ones_like(edges)
        for dy in range(3):
            for dx in range(3):
                piece = padded[dy : dy + edges.shape[0], dx : dx + edges.shape[1]]
                match &= piece == bool(mask[dy, dx])
        wanted |= match
    found = np.zeros_like(edges)
    position, _ = terminators_of(edges)
    found[position[:, 1], position[:, 0]] = True
    np.testing.assert_array_equal(found, wanted)
    assert len({m.tobytes() for m in TERMINATOR_MASKS}) == 16


@pytest.mark.parametrize("angle", range(0, 360, 15))
def test_direction_goes_on_as_the_line_does(angle):
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    edges = np.zeros((80, 80), bool)
    for x, y in bresenham(40, 40, 40 + round(30 * c), 40 + round(30 * s)):
        edges[y, x] = True
    position, direction = terminators_of(edges, reach=8)
    assert len(position) == 2
    outer = np.argmax(np.abs(position - 40).sum(axis=1))
    assert direction[outer] @ (c, s) > np.cos(np.radians(12))
    assert direction[1 - outer] @ (c, s) < -np.cos(np.radians(12))


def test_bresenham_reaches_both_ends_without_a_gap_and_mirrors():
    rng = np.random.default_rng(0)
    for x0, y0, x1, y1 in rng.integers(-20, 20, (300, 4)):
        path = np.array(bresenham(x0, y0, x1, y1))
        assert tuple(path[0]) == (x0, y0)
        assert tuple(path[-1]) == (x1, y1)
        assert len(path) == max(abs(x1 - x0), abs(y1 - y0)) + 1
        assert (np.abs(np.diff(path, axis=0)).max(axis=1, initial=1) == 1).all()
        # Never more than half a pixel off the line.
        length = max(np.hypot(x1 - x0, y1 - y0), 1)
        off = np.abs((path[:, 0] - x0) * (y1 - y0) - (path[:, 1] - y0) * (x1 - x0)) / length
        assert off.max() <= 0.5 + 1e-9
        assert [(y, x) for x, y in bresenham(x0, y0, x1, y1)] == bresenham(y0, x0, y1, x1)
        assert [(-x, y) for x, y in bresenham(x0, y0, x1, y1)] == bresenham(-x0, y0, -x1, y1)


def linked_scenes():
    for seed in range(3):
        for corners in (0.0, 9.0):
            edges = random_stack(seed)[0]
            edges &= ndimage.convolve(edges.astype(int), EIGHT.astype(int)) <= 4
            yield edges, link(edges, corners=corners)


def test_linking_never_removes_a_pixel_and_touches_both_its_ends():
    links = 0
    for edges, result in linked_scenes():
        assert not (edges & ~result.edges).any()
        np.testing.assert_array_equal(result.edges, edges | result.links_drawn)
        for (x0, y0), (x1, y1) in zip(result.links.start, result.links.end, strict=True):
            path = bresenham(int(x0), int(y0), int(x1), int(y1))
            assert all(result.edges[y, x] for x, y in path)
            links += 1
    assert links > 50


def test_links_tell_their_cost():
    for _, result in linked_scenes():
        drawn = result.links_drawn
        assert set(np.unique(result.step[drawn])) <= {int(Step.LINK), int(Step.BORDER)}
        assert (result.value[drawn] > 0).all()
        assert (result.value[drawn] <= 18).all()


@pytest.mark.parametrize(("gap", "share"), [(3, 0.9), (5, 0.9), (7, 0.8), (9, 0.5)])
@pytest.mark.parametrize("preset", ["default", "paper"])
def test_gaps_are_healed(gap, share, preset):
    corners = {"default": 9.0, "paper": 0.0}[preset]
    healed, precision = gaps.measure(lambda e: link(e, corners=corners).edges, gap)
    assert healed >= share
    assert precision >= 0.9


def test_a_line_near_the_border_is_linked_to_it():
    edges = np.zeros((60, 60), bool)
    edges[30, 4:40] = True
    result = link(edges)
    assert result.edges[30, :5].all()
    assert result.links.border.sum() == 1
    assert not link(edges, border=False).links_drawn.any()


def test_a_line_along_a_border_goes_on_along_it_on_every_side():
    """Four pixels short of the corner, and far from any other."""
    edges = np.zeros((44, 60), bool)
    edges[0, 4:30] = True
    whole = edges.copy()
    whole[0, :4] = True
    for turned, wanted in zip(eight(edges), eight(whole), strict=True):
        np.testing.assert_array_equal(link(turned, windows=(6.0,), corners=0.0).edges, wanted)


def test_linking_turns_with_the_edges():
    rng = np.random.default_rng(5)
    for k in range(4):
        edges, _, _ = gaps.cut(rng, gaps.contour(rng, bool(k % 2)), 6, 5)
        edges[100, 20:50] = True
        edges = edges[:, :230]
        wanted = eight(link(edges, corners=9.0).edges)
        for turned, linked in zip(eight(edges), wanted, strict=True):
            np.testing.assert_array_equal(link(turned, corners=9.0).edges, linked)


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize("noise", [0.0, 1.0, 3.0])
def test_everything_turns_and_mirrors_with_the_image(preset, noise):
    image, depth, _ = scene(noise=noise)
    _, linked, labels = segment(image, depth, preset)
    wanted = zip(eight(linked.edges), eight(linked.step), eight(labels), strict=True)
    turned = zip(eight(image), eight(depth), strict=True)
    for (image_, depth_), (edges, step, label) in zip(turned, wanted, strict=True):
        _, linked_, labels_ = segment(image_, depth_, preset)
        np.testing.assert_array_equal(linked_.edges, edges)
        np.testing.assert_array_equal(linked_.step, step)
        # Regions are numbered in the order of the scan: the same parts under other numbers.
        pairs = np.unique(np.stack([labels_.ravel(), label.ravel()]), axis=1)
        assert len(np.unique(pairs[0])) == len(np.unique(pairs[1])) == pairs.shape[1]


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_every_edge_was_admitted_and_nothing_else(preset):
    image, depth, _ = scene()
    stacked = stack_edges(image, depth, **PRESETS[preset]["edge_stack"])
    done = link_edges(stacked, depth, **PRESETS[preset]["linked_edges"])
    np.testing.assert_array_equal(done.step >= Step.LOW, done.edges)
    low = done.step == Step.LOW
    assert (done.value[low] >= stacked.stack.high_thresholds[0] - 1e-3).all()
    # The laws hold of what is shown as edges, too, where the background's lines are left out.
    assert not (stacked.edges_low & ~stacked.edges_medium).any()
    assert not (stacked.edges_medium & ~stacked.edges_high).any()
    assert not (stacked.edges_low & ~done.edges_reconstructed).any()
    assert not (done.edges_reconstructed & ~done.edges).any()
    assert not (done.edges & ~done.lines).any()
    np.testing.assert_array_equal(done.edges, done.edges_reconstructed | done.links | done.creases)
    assert set(np.unique(done.step[done.lines & ~done.edges])) <= {int(Step.BACKGROUND)}


def test_a_shadow_on_the_background_bounds_a_region_but_is_no_edge():
    image, depth, faces = scene(noise=0.5)
    image = image.copy()
    image[60:75, 85:120][faces[60:75, 85:120] == 0] = 2
    _, linked, labels = segment(image, depth)
    ring = np.zeros(faces.shape, bool)
    ring[56:79, 81:124] = True
    ring &= ndimage.distance_transform_edt(faces == 0) > 5
    assert linked.lines[ring].sum() > 20
    assert not linked.edges[ring].any()
    assert (linked.step[ring & linked.lines] == Step.BACKGROUND).all()
    assert labels[67, 100] != labels[90, 100]
    assert segment(image, None)[1].edges[ring].sum() > 20


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((64, 64), np.uint8), np.full((64, 64), 255, np.uint8),
        np.arange(80, dtype=np.uint8)[None], np.arange(80, dtype=np.uint8)[:, None],
        np.zeros((1, 1), np.uint8), (scene()[0].astype(np.uint16) * 257),
        np.where(scene()[2] == 2, np.nan, scene()[0].astype(np.float32)),
        np.clip(scene()[0].astype(int) * 3, 0, 255).astype(np.uint8),
    ],
    ids=["constant", "saturated", "row", "column", "pixel", "16 bit", "NaN", "clipped"],
)  # fmt: skip
def test_odd_images_give_a_defined_result(preset, image):
    for depth in (None, np.full(image.shape, np.nan, np.float32), np.ones(image.shape, "f4")):
        _, linked, labels = segment(image, depth, preset)
        assert labels.shape == linked.edges.shape == image.shape
        assert labels.min() >= 0
        assert np.isfinite(linked.value).all()


def test_depth_closes_what_the_intensity_cannot():
    """Two boxes of one grey level, one in front of the other: an edge in the depth alone."""
    image, depth, faces = scene()
    touching = (faces == 3) & ndimage.binary_dilation(faces == 4)
    assert touching.sum() > 10
    for given, apart in ((None, False), (depth, True)):
        labels = segment(image, given)[2]
        a, b = (np.bincount(labels[faces == k]).argmax() for k in (3, 4))
        assert (a != b) == apart


@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_inputs_may_be_read_only_and_are_left_alone(preset):
    image, depth, _ = scene()
    before = image.copy(), depth.copy()
    for array in (image, depth):
        array.flags.writeable = False
    labels = segment(image, depth, preset)[2]
    labels.flags.writeable = False
    camera = Camera(1300.0, 1300.0, 99.5, 79.5)
    assert len(region_features(labels, depth, camera)) == labels.max()
    np.testing.assert_array_equal(image, before[0])
    np.testing.assert_array_equal(depth, before[1])

"""Lengths "in pixels at 256²" grow with the image; both sides of each limit, at several sizes."""

from __future__ import annotations

import numpy as np
import pytest
from edge_scenes import lines_facing, lines_of, planted_operator

from workbench_stages.edges.linking import Step, link, reconstruct, terminators_of
from workbench_stages.edges.operators import Gradient
from workbench_stages.edges.regions import closed_regions, least_area_px, region_features
from workbench_stages.edges.segmentation import link_edges, segment, stack_edges
from workbench_stages.edges.stack import build_stack, image_scale, noise_model

# As many pixels as 256² and 512², square and not, and one size whose scale is no round number.
SHAPES = {
    (256, 256): 1.0,
    (128, 512): 1.0,
    (512, 512): 2.0,
    (1024, 256): 2.0,
    (128, 128): 0.5,
    (200, 320): 0.98821,
}


@pytest.mark.parametrize(("shape", "scale"), SHAPES.items())
def test_a_length_grows_with_the_square_root_of_the_area(
    shape: tuple[int, int], scale: float
) -> None:
    assert image_scale(shape) == pytest.approx(scale, abs=1e-5)
    assert image_scale(shape[::-1]) == image_scale(shape)


# -- reconstruction --------------------------------------------------------------------------------


@pytest.mark.parametrize("difference", ["medium", "high"])
@pytest.mark.parametrize(
    ("shape", "longest_noise"),
    [((256, 256), 4), ((128, 512), 4), ((512, 512), 8), ((128, 128), 2), ((200, 320), 3)],
)
def test_a_segment_longer_than_the_scaled_length_is_kept(
    shape: tuple[int, int], longest_noise: int, difference: str
) -> None:
    low = np.zeros(shape, bool)
    finer = lines_of(shape, [longest_noise, longest_noise + 1])
    medium = finer if difference == "medium" else low
    done = reconstruct(low, medium, finer, min_length=4.0)
    # What the first iteration refuses comes back in the second difference, and is refused again.
    assert done.step[10, 4] == Step.SHORT_HIGH
    assert done.value[10, 4] == longest_noise
    kept = Step.MEDIUM if difference == "medium" else Step.HIGH
    assert done.step[20, 4] == kept
    assert done.value[20, 4] == longest_noise + 1
    np.testing.assert_array_equal(done.edges.sum(axis=1)[[10, 20]], [0, longest_noise + 1])


@pytest.mark.parametrize(
    ("shape", "light"), [((256, 256), 12), ((1024, 256), 24), ((512, 512), 24), ((128, 128), 6)]
)
def test_a_segment_must_weigh_more_than_the_scaled_weight(
    shape: tuple[int, int], light: int
) -> None:
    low = np.zeros(shape, bool)
    finer = lines_of(shape, [light, light + 1])
    strength = np.where(finer, np.float32(2.5), np.float32(0))
    done = reconstruct(low, low, finer, strength, min_weight=12.0, unit=2.5)
    assert (done.step[10, 4], done.step[20, 4]) == (Step.FAINT_HIGH, Step.HIGH)
    assert done.value[10, 4] == light
    assert done.value[20, 4] == light + 1


# -- the curve of small segments -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "smallest_large"),
    [((256, 256), 4), ((512, 512), 8), ((1024, 256), 8), ((128, 512), 4), ((40, 40), 2)],
)
def test_segments_under_the_scaled_length_are_small(
    shape: tuple[int, int], smallest_large: int
) -> None:
    for length in (smallest_large - 1, smallest_large):
        thin = np.zeros(shape, bool)
        thin[10, 4 : 4 + length] = True
        strength = np.where(thin, np.float32(5), np.float32(0))
        stack = build_stack(strength, thin, lowest=1, greatest=10, steps=10, small_segment=4.0)
        counts = stack.small_pixels[0], stack.large_pixels[0]
        assert counts == ((length, 0) if length < smallest_large else (0, length))


@pytest.mark.parametrize(
    ("shape", "need"), [((256, 256), 200), ((512, 512), 800), ((128, 512), 200), ((50, 80), 20)]
)
def test_the_noise_of_a_level_is_measured_from_enough_pixels_for_the_size(
    shape: tuple[int, int], need: int
) -> None:
    """A dark level and ``count`` pixels of a bright one, four times as noisy in variance."""
    for count, told in ((need - 1, False), (need, True)):
        bright = np.full(shape, 40, np.float32)
        magnitude = np.full(shape, 1.5, np.float32)
        bright.reshape(-1)[:count] = 200
        magnitude.reshape(-1)[:count] = 3.0
        zero = np.zeros(shape, np.float32)
        model = noise_model(
            Gradient(zero, zero, magnitude, zero > 1, bright, 20.0, bright), quantile=0.2
        )
        grows = bool(model.sigma[12] > 1.5 * model.sigma[2])
        assert grows == told


# -- linking ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "window"),
    [((256, 256), 6), ((128, 512), 6), ((512, 512), 12), ((1024, 256), 12), ((100, 90), 6)],
)
def test_ends_find_each_other_up_to_the_scaled_window(shape: tuple[int, int], window: int) -> None:
    """Windows grow with the image and never shrink."""
    for distance, found in ((window, True), (window + 1, False)):
        edges = lines_facing(shape, distance)
        result = link(edges, windows=(6.0,), max_cost=1000.0, border=False)
        assert bool(len(result.links.start)) == found
        assert bool(result.edges[30, 20 : 20 + distance].all()) == found


@pytest.mark.parametrize(
    ("shape", "most"), [((256, 256), 5), ((512, 512), 10), ((1024, 256), 10), ((100, 90), 5)]
)
def test_a_link_costs_at_most_the_scaled_cost(shape: tuple[int, int], most: int) -> None:
    """A straight link between ends that face each other costs its length."""
    for distance, found in ((most, True), (most + 1, False)):
        edges = lines_facing(shape, distance)
        result = link(edges, windows=(12.0,), max_cost=5.0, border=False)
        assert bool(len(result.links.start)) == found
        if found:
            np.testing.assert_allclose(result.links.cost, distance, rtol=1e-6)


@pytest.mark.parametrize(
    ("shape", "length"), [((256, 256), 5), ((512, 512), 10), ((1024, 256), 10), ((100, 90), 5)]
)
def test_a_direction_is_taken_from_the_scaled_length_of_line(
    shape: tuple[int, int], length: int
) -> None:
    for tail in (length - 1, length):
        edges = np.zeros(shape, bool)
        edges[40, 40 : 40 + tail] = True
        for k in range(1, 20):
            edges[40 + k, 40 - k] = True
        position, direction = terminators_of(edges, reach=5.0)
        linked = link(edges, windows=(3.0,), reach=5.0, border=False)
        end = [39 + tail, 40]
        for places, ways in ((position, direction), (linked.terminators, linked.directions)):
            (way,) = ways[(places == end).all(axis=1)]
            assert (way.tolist() == [1.0, 0.0]) == (tail == length)
            assert way[0] > 0.9 and way[1] <= 0


@pytest.mark.parametrize(
    ("shape", "reach"), [((256, 256), 9), ((512, 512), 18), ((1024, 256), 18), ((120, 140), 9)]
)
def test_corners_look_for_partners_up_to_their_scaled_window(
    shape: tuple[int, int], reach: int
) -> None:
    """The bent line meets the end of another one in its bisector, no farther away than this."""
    for distance, found in ((reach, True), (reach + 1, False)):
        edges = np.zeros(shape, bool)
        for k in range(36):
            edges[60 + k, 60 - k] = edges[60 - k, 60 - k] = True
        edges[60, 60 + distance : 60 + distance + 24] = True
        # To anything but an end or a corner a link costs far too much.
        result = link(
            edges, windows=(9.0, 12.0), corners=9.0, facing=1000.0, max_cost=40.0, border=False
        )
        assert bool(result.edges[60, 60 : 60 + distance].all()) == found


# -- regions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("shape", "least"),
    [
        ((256, 256), 12),
        ((512, 512), 48),
        ((1024, 256), 48),
        ((128, 512), 12),
        ((128, 128), 3),
        ((200, 320), 12),
        ((10, 10), 1),
    ],
)
def test_a_region_has_at_least_the_scaled_area(shape: tuple[int, int], least: int) -> None:
    assert least_area_px(shape, 12.0) == least
    if least == 1:
        return
    for area in (least - 1, least):
        edges = np.zeros(shape, bool)
        edges[4:7, 4 : 6 + area] = True
        edges[5, 5 : 5 + area] = False
        labels = closed_regions(edges, min_area=12.0, grow=False)
        assert labels.max() == (2 if area == least else 1)
        assert labels[5, 5] == (2 if area == least else 0)


# -- a whole scene ---------------------------------------------------------------------------------


def tiles(shape: tuple[int, int], times: int) -> tuple[np.ndarray, list[tuple[int, int, int, int]]]:
    """Bright rectangles on a dark ground, every length of it ``times`` longer, with noise.

    Rows of (top, bottom, left, right); nothing of it is symmetric.
    """
    boxes = [(20, 60, 30, 90), (90, 170, 24, 64), (40, 140, 130, 178), (30, 64, 200, 232)]
    boxes = [tuple(times * edge for edge in box) for box in boxes]
    image = np.full(shape, 20.0)
    for grey, (top, bottom, left, right) in zip((120, 90, 160, 200), boxes, strict=True):
        image[top:bottom, left:right] = grey
    image += np.random.default_rng(4).normal(0, 0.8, shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8), boxes


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("preset", ["default", "paper"])
@pytest.mark.parametrize(("shape", "times"), [((200, 256), 1), ((400, 512), 2)])
def test_the_same_scene_at_two_sizes_has_the_same_regions(
    shape: tuple[int, int], times: int, preset: str, turned: bool
) -> None:
    image, boxes = tiles(shape, times)
    given = np.ascontiguousarray(image.T) if turned else image
    labels = segment(given, preset=preset)[2]
    labels = labels.T if turned else labels
    table = region_features(np.ascontiguousarray(labels))
    assert len(table) == 1 + len(boxes)
    for top, bottom, left, right in boxes:
        middle = ((left + right - 1) / 2, (top + bottom - 1) / 2)
        row = labels[int(middle[1]), int(middle[0])] - 1
        assert table.centroid_px[row] == pytest.approx(middle, abs=0.6)
        assert table.area_px[row] == pytest.approx((bottom - top) * (right - left), rel=0.03)
        half = np.hypot(bottom - top, right - left) / 2
        assert table.greatest_distance_px[row] == pytest.approx(half, abs=1.5)
        assert not table.background[row]


@pytest.mark.parametrize(
    ("shape", "longest"), [((256, 256), 4), ((512, 512), 8), ((1024, 256), 8), ((60, 60), 1)]
)
def test_crumbs_of_a_line_on_the_background_are_as_long_as_noise_is_at_that_size(
    shape: tuple[int, int], longest: int
) -> None:
    """A piece of a shadow's line that is brighter by noise belongs to it; a longer one does not."""
    for piece, edge in ((longest, False), (longest + 1, True)):
        image = np.full(shape, 9, np.float32)
        image[5:50, 20] = 8
        image[20 : 20 + piece, 20] = 100
        with planted_operator():
            found = stack_edges(
                image,
                np.full(shape, np.nan, np.float32),
                operator="planted",
                noise_units=False,
                small_segment=4.0,
            )
        assert found.stack.edges_high.sum() == 45
        assert found.background[5:20, 20].all()
        assert found.background[20 : 20 + piece, 20].all() != edge
        assert found.edges_high.sum() == (piece if edge else 0)


def test_scaled_links_of_the_whole_scene_stay_within_their_reach() -> None:
    for times, shape in ((1, (200, 256)), (2, (400, 512))):
        image, _ = tiles(shape, times)
        stacked = stack_edges(image)
        done = link_edges(stacked, windows=(3.0, 6.0))
        reach = 6 * max(image_scale(shape), 1.0)
        links = done.linked.links
        length = np.hypot(*(links.end - links.start).T)
        assert (length <= reach + 0.5).all()

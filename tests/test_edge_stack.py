"""The one-pass search against one labelling per threshold, and the stack's laws."""

import numpy as np
import pytest
from edge_scenes import eight, scene
from scipy import ndimage
from skimage.filters import apply_hysteresis_threshold

from workbench_stages.edges.operators import Gradient, gradient_of
from workbench_stages.edges.stack import NoiseModel, build_stack, noise_model, segment_curve

EIGHT = np.ones((3, 3))


def reference_curve(strength, thin, thresholds, small_size):
    small, large = [], []
    for threshold in thresholds:
        labels, _ = ndimage.label(thin & (strength >= threshold), EIGHT)
        sizes = np.bincount(labels.ravel())[1:]
        small.append(sizes[sizes < small_size].sum())
        large.append(sizes[sizes >= small_size].sum())
    return np.array(small), np.array(large)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("small_size", [1, 2, 4, 9])
def test_one_pass_equals_a_labelling_per_threshold(seed, small_size):
    rng = np.random.default_rng(seed)
    # Quarters are exact in float32, so that thresholds fall on values.
    strength = (rng.integers(0, 100, (61, 47)) / 4).astype(np.float32)
    thin = rng.random((61, 47)) < 0.4
    thresholds = 2 + 0.5 * np.arange(40)
    ours = segment_curve(strength, thin, 2.0, 0.5, 40, small_size)
    theirs = reference_curve(strength, thin, thresholds, small_size)
    np.testing.assert_array_equal(ours[0], theirs[0])
    np.testing.assert_array_equal(ours[1], theirs[1])


def test_the_images_are_hysteresis_at_their_thresholds():
    gradient = gradient_of(scene()[0])
    stack = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=20, max_ratio=0.05)
    strength = np.where(gradient.thin, gradient.magnitude, 0)
    images = (stack.edges_low, stack.edges_medium, stack.edges_high)
    for image, high in zip(images, stack.high_thresholds, strict=True):
        # skimage asks for more than, the stack for at least.
        low_, high_ = (np.nextafter(np.float32(t), np.float32(0)) for t in
                       (stack.low_threshold, high))  # fmt: skip
        wanted = apply_hysteresis_threshold(strength, low_, high_)
        np.testing.assert_array_equal(image, wanted)


def test_each_resolution_contains_the_coarser_one():
    for seed in range(4):
        gradient = gradient_of(scene(seed=seed, noise=3)[0], "canny")
        stack = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=20)
        assert not (stack.edges_low & ~stack.edges_medium).any()
        assert not (stack.edges_medium & ~stack.edges_high).any()
        assert stack.edges_low.any()


def test_the_low_threshold_is_the_first_that_keeps_the_ratio():
    gradient = gradient_of(scene(noise=2)[0])
    stack = build_stack(gradient.magnitude, gradient.thin, lowest=0.5, greatest=20, max_ratio=0.05)
    k = int(np.argmin(np.abs(stack.thresholds - stack.low_threshold)))
    assert stack.upheld
    assert stack.ratio[k] < 0.05
    assert not (stack.ratio[:k] < 0.05).any()


def test_more_steps_refine_the_same_curve():
    gradient = gradient_of(scene(noise=2)[0])
    coarse = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=17, steps=17)
    fine = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=17, steps=257)
    np.testing.assert_array_equal(coarse.small_pixels, fine.small_pixels[::16])
    np.testing.assert_array_equal(coarse.large_pixels, fine.large_pixels[::16])


def test_noise_is_measured_from_the_image():
    rng = np.random.default_rng(0)
    ramp = np.repeat(np.array([30.0, 90.0, 150.0, 210.0]), 64)[None].repeat(256, 0)
    sigma = np.sqrt(0.25 + ramp / 60)
    gradient = gradient_of((ramp + rng.normal(0, 1, ramp.shape) * sigma).astype(np.float32))
    inner = (np.arange(256) % 64 > 16) & (np.arange(256) % 64 < 48)
    model = noise_model(gradient)
    for k, grey in enumerate((30.0, 90.0, 150.0, 210.0)):
        columns = inner & (np.arange(256) // 64 == k)
        true = gradient.gx[:, columns].std()
        level = np.full((1, 1), grey + true, np.float32)
        assert model.at(level)[0, 0] == pytest.approx(true, rel=0.2)


def test_no_edges_and_no_noise_are_defined():
    flat = np.full((32, 32), 7, np.uint8)
    gradient = gradient_of(flat)
    stack = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=20)
    assert not stack.upheld
    assert not stack.edges_high.any()
    assert np.isfinite(noise_model(gradient).sigma).all()


def test_the_stack_turns_with_the_image():
    image = scene(noise=2)[0]
    gradient = gradient_of(image)
    base = build_stack(gradient.magnitude, gradient.thin, lowest=1, greatest=20)
    wanted = eight(base.edges_high)
    for turned, edges in zip(eight(image), wanted, strict=True):
        g = gradient_of(turned)
        stack = build_stack(g.magnitude, g.thin, lowest=1, greatest=20)
        assert stack.low_threshold == base.low_threshold
        np.testing.assert_array_equal(stack.edges_high, edges)


@pytest.mark.parametrize(
    "wrong",
    [{"lowest": 20, "greatest": 20}, {"lowest": -1, "greatest": 20},
     {"lowest": 1, "greatest": 20, "steps": 1}, {"lowest": 1, "greatest": 20, "max_ratio": 0}],
)  # fmt: skip
def test_wrong_thresholds_are_refused(wrong):
    with pytest.raises(ValueError):
        build_stack(np.zeros((4, 4), np.float32), np.zeros((4, 4), bool), **wrong)


# -- planted segments ----------------------------------------------------------------------------


def planted(*segments):
    """Level lines of strengths given pixel by pixel, two rows apart: strength and candidates."""
    strength = np.zeros((4 * len(segments) + 2, 40), np.float32)
    for number, values in enumerate(segments):
        strength[4 * number + 1, 1 : 1 + len(values)] = values
    return strength, strength > 0


def stack_of(*segments, **changes):
    how = {"lowest": 1.0, "greatest": 9.0, "steps": 17, "small_segment": 4.0} | changes
    # 42 pixels a side or so: a small segment would have 2 pixels, so the length is given for it.
    strength, thin = planted(*segments)
    how["small_segment"] *= 256 / np.sqrt(strength.size)
    return build_stack(strength, thin, **how)


def test_the_thresholds_run_evenly_from_the_lowest_to_the_greatest():
    stack = stack_of([5] * 6)
    np.testing.assert_allclose(stack.thresholds, np.arange(1, 9.5, 0.5))
    assert stack_of([5] * 6, steps=2).thresholds.tolist() == [1, 9]


def test_the_low_threshold_is_the_least_at_which_small_segments_are_few_enough():
    """Twenty strong pixels in one segment, and two small ones of strengths 2 and 4."""
    segments = [8.0] * 20, [2.0] * 2, [4.0] * 2
    stack = stack_of(*segments, max_ratio=0.15)
    np.testing.assert_array_equal(stack.small_pixels[:8], [4, 4, 4, 2, 2, 2, 2, 0])
    np.testing.assert_array_equal(stack.large_pixels[:15], 20)
    np.testing.assert_array_equal(stack.large_pixels[15:], 0)
    np.testing.assert_allclose(stack.ratio[[0, 3, 7]], [0.2, 0.1, 0])
    assert np.isnan(stack.ratio[15:]).all()
    assert stack.upheld
    # Strength 2 is still cut in at 2: the first threshold that leaves it out is the next one.
    assert stack.low_threshold == 2.5
    assert stack.high_thresholds == (9.0, 5.75, 2.5)
    # The ratio must be under the preset value, not at it.
    assert stack_of(*segments, max_ratio=0.1).low_threshold == 4.5
    assert stack_of(*segments, max_ratio=0.2).low_threshold == 2.5
    assert stack_of(*segments, max_ratio=0.201).low_threshold == 1.0


def test_where_no_threshold_keeps_the_ratio_the_nearest_is_taken():
    # Small segments of strength 8 stay as long as the large one does; some of 3 do not.
    stack = stack_of([8.0] * 10, [8.0] * 2, [3.0] * 2, max_ratio=0.05)
    assert not stack.upheld
    assert stack.low_threshold == 3.5
    assert stack.ratio.min(where=np.isfinite(stack.ratio), initial=np.inf) == 0.2
    # Without any large segment the greatest threshold is left.
    alone = stack_of([8.0] * 2, [3.0])
    assert not alone.upheld
    assert alone.low_threshold == 9.0
    assert np.isinf(alone.ratio[0])


@pytest.mark.parametrize("peak", [1, 5.75, 9])
def test_a_segment_is_in_an_image_whose_threshold_its_strongest_pixel_reaches(peak):
    """With a low threshold of 2.5 the others are 5.75 and 9; a peak at a threshold is in."""
    low = np.nextafter
    values = [2.5, 2.5, max(peak, 2.5), 2.5, 2.5]
    under = [2.5, 2.5, max(float(low(np.float32(peak), np.float32(0))), 2.5), 2.5, 2.5]
    stack = stack_of([9.5] * 30, [2.0] * 3, values, under, max_ratio=0.05)
    assert stack.low_threshold == 2.5
    images = (stack.edges_low, stack.edges_medium, stack.edges_high)
    assert [bool(image[9, 1:6].all()) for image in images] == [peak >= 9, peak >= 5.75, True]
    assert [bool(image[13, 1:6].all()) for image in images] == [False, peak > 5.75, True]
    assert [bool(image[5].any()) for image in images] == [False] * 3
    assert stack.segment_peak[9, 1] == max(peak, 2.5)
    assert stack.segment_peak[5].max() == 0


def test_pixels_under_the_low_threshold_part_a_segment():
    stack = stack_of([9.0, 3.0, 2.4, 3.0, 3.0], lowest=2.5, max_ratio=99.0, small_segment=2.0)
    np.testing.assert_array_equal(stack.segment_peak[1, 1:6], [9, 9, 0, 3, 3])
    assert stack.low_threshold == 2.5
    assert stack.edges_low[1].sum() == 2
    assert stack.edges_high[1].sum() == 4


def test_segments_touch_over_their_corners_in_every_direction():
    """Eight neighbours of a strong pixel, one at a time, and none two pixels away."""
    for dy in (-2, -1, 0, 1, 2):
        for dx in (-2, -1, 0, 1, 2):
            strength = np.zeros((7, 9), np.float32)
            strength[3, 4] = 9
            strength[3 + dy, 4 + dx] = max(strength[3 + dy, 4 + dx], 2)
            stack = build_stack(strength, strength > 0, lowest=2, greatest=8, max_ratio=9.0)
            joined = max(abs(dx), abs(dy)) <= 1
            assert stack.edges_low[3 + dy, 4 + dx] == joined
            # Two that touch are large in so small an image, one alone is small.
            assert stack.large_pixels[0] == (2 if joined and (dx or dy) else 0)


def test_nothing_is_an_edge_that_is_no_candidate_even_from_zero_on():
    strength, thin = planted([5.0] * 8)
    stack = build_stack(strength, thin & False, lowest=0, greatest=9)
    assert not stack.edges_high.any()
    stack = build_stack(strength, thin, lowest=0, greatest=9)
    np.testing.assert_array_equal(stack.edges_high, thin)


def test_a_ratio_for_a_wanted_low_threshold_puts_it_there():
    segments = [8.0] * 20, [2.0] * 2, [4.0] * 2
    stack = stack_of(*segments, max_ratio=0.15)
    # The low threshold can lie at 1, where the search begins, at 2.5 and at 4.5.
    for wanted, reached in ((0.0, 1.0), (1.6, 1.0), (1.9, 2.5), (3.4, 2.5), (3.6, 4.5), (9, 4.5)):
        again = stack_of(*segments, max_ratio=stack.ratio_for_low(wanted))
        assert again.low_threshold == reached
        assert again.upheld
    assert stack_of([8.0] * 2).ratio_for_low(3.0) == np.inf


# -- noise ---------------------------------------------------------------------------------------

RAYLEIGH = np.sqrt(-2 * np.log(1 - 0.2))


def noisy(levels):
    """A gradient with, for each (bright, magnitude, count), so many pixels; and their sigma.

    The quantile of equal magnitudes is read by the share into their step of a sixteenth.
    """
    bright = np.concatenate([np.full(n, b, np.float32) for b, _, n in levels])[None]
    magnitude = np.concatenate([np.full(n, m, np.float32) for _, m, n in levels])[None]
    zero = np.zeros_like(bright)
    gradient = Gradient(zero, zero, magnitude, zero > 1, bright, 20.0, bright)
    return gradient, [(np.floor(m * 16) + 0.2) / 16 / RAYLEIGH for _, m, _ in levels]


def test_noise_rises_along_the_line_that_no_measured_level_falls_below():
    """Least at grey 72 (bin 4); of the brighter ones the one with the flattest rise sets it."""
    gradient, sigma = noisy([(40, 3, 500), (72, 1, 500), (136, 4, 500), (168, 2, 500)])
    model = noise_model(gradient)
    variance = np.square(sigma)
    rise = (variance[3] - variance[1]) / (168 - 72)
    assert rise < (variance[2] - variance[1]) / (136 - 72)
    wanted = variance[1] + rise * np.maximum(model.level - 72, 0)
    np.testing.assert_allclose(model.level, np.arange(16) * 16 + 8)
    np.testing.assert_allclose(model.sigma, np.sqrt(wanted), rtol=1e-4)


def test_noise_is_the_same_everywhere_where_one_level_was_measured():
    gradient, sigma = noisy([(72, 1, 500)])
    np.testing.assert_allclose(noise_model(gradient).sigma, sigma[0], rtol=1e-5)


def test_noise_has_a_least_value_and_clipped_white_is_not_measured():
    assert (noise_model(noisy([(72, 0.05, 500)])[0]).sigma == np.float32(0.25)).all()
    assert (noise_model(noisy([(72, 0.05, 500)])[0], least=0.5).sigma == np.float32(0.5)).all()
    # Levels 240 and up are the brightest bin.
    assert (noise_model(noisy([(241, 3, 500)])[0]).sigma == np.float32(0.25)).all()
    gradient, sigma = noisy([(239, 3, 500)])
    np.testing.assert_allclose(noise_model(gradient).sigma, sigma[0], rtol=1e-5)
    # A measured value of half the least or less is rounding, not noise.
    for least, measured in ((0.25, False), (0.2, True)):
        gradient, sigma = noisy([(72, 0.07, 500), (136, 2, 500)])
        assert (sigma[0] > 0.5 * least) == measured
        model = noise_model(gradient, least=least)
        assert model.sigma[8] == pytest.approx(sigma[1], rel=1e-4)
        assert bool(model.sigma[4] < 0.5 * sigma[1]) == measured


def test_another_quantile_reads_the_same_noise_from_rayleighs_law():
    rng = np.random.default_rng(0)
    magnitude = (1.7 * np.sqrt(-2 * np.log(rng.random((250, 400))))).astype(np.float32)
    bright = np.full(magnitude.shape, 100, np.float32)
    gradient = Gradient(bright, bright, magnitude, bright > 999, bright, 20.0, bright)
    for quantile in (0.1, 0.2, 0.5):
        assert noise_model(gradient, quantile).sigma[6] == pytest.approx(1.7, rel=0.02)


def test_between_levels_noise_is_linear_and_beyond_the_ends_it_stays():
    model = NoiseModel(
        np.arange(8, 256, 16, dtype=np.float32), np.linspace(1, 4, 16, dtype=np.float32) ** 2
    )
    level = np.array([[-5, 0, 8, 12, 24, 100.5, 240, 248, 300]], np.float32)
    wanted = np.interp(level, model.level, model.sigma)
    np.testing.assert_allclose(model.at(level), wanted, rtol=1e-6)

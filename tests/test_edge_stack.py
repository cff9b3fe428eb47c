"""The one-pass search against one labelling per threshold, and the stack's laws."""

import numpy as np
import pytest
from edge_scenes import eight, scene
from scipy import ndimage
from skimage.filters import apply_hysteresis_threshold

from workbench_stages.edges.operators import gradient_of
from workbench_stages.edges.stack import build_stack, noise_model, segment_curve

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

"""The operators against plain references, and the laws of issue 3, item 4."""

import numpy as np
import pytest
from edge_scenes import eight, scene

from workbench_stages.edges import operators as ops


def reference_gef(image, a0):
    """GEF by its definition, one pixel after the other, in double precision."""
    x = image.astype(float)

    def means(line):
        forward, backward = line.copy(), line.copy()
        for i in range(1, len(line)):
            forward[i] = a0 * line[i] + (1 - a0) * forward[i - 1]
        for i in range(len(line) - 2, -1, -1):
            backward[i] = a0 * line[i] + (1 - a0) * backward[i + 1]
        return forward, backward

    def smooth(line):
        forward, backward = means(line)
        return (forward + backward - a0 * line) / (2 - a0)

    def derive(line):
        forward, backward = means(line)
        return np.append(backward[1:], backward[-1]) - np.insert(forward[:-1], 0, forward[0])

    gx = np.apply_along_axis(derive, 1, np.apply_along_axis(smooth, 0, x))
    gy = np.apply_along_axis(derive, 0, np.apply_along_axis(smooth, 1, x))
    return gx, gy


def test_gef_is_the_recursion():
    image = np.random.default_rng(1).uniform(0, 255, (37, 83)).astype(np.float32)
    gx, gy, _ = ops.gef_gradient(image)
    for ours, theirs in zip((gx, gy), reference_gef(image, 0.45), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=2e-4)


def test_isef_smoothing_is_the_infinite_exponential():
    """The impulse response is a0 / (2 - a0) · (1 - a0)^|k| (Shen and Castan)."""
    image = np.zeros((1, 101), np.float32)
    image[0, 50] = 1
    out = np.empty_like(image)
    ops._isef_smooth(image, np.float32(0.45), True, out)
    k = np.abs(np.arange(101) - 50)
    np.testing.assert_allclose(out[0], 0.45 / 1.55 * 0.55**k, atol=1e-7)


def test_canny_is_the_derivative_of_a_gaussian():
    image = np.random.default_rng(2).uniform(0, 255, (40, 33)).astype(np.float32)
    gx, gy, _ = ops.canny_gradient(image)
    k = np.arange(-4, 5)
    bell = np.exp(-0.5 * k**2.0)
    slope = k * bell / (k[k > 0] * bell[k > 0]).sum()
    padded = np.pad(image.astype(float), 4, mode="edge")

    def fir(a, weights, axis):
        return np.apply_along_axis(lambda v: np.correlate(v, weights, "valid"), axis, a)

    np.testing.assert_allclose(gx, fir(fir(padded, bell / bell.sum(), 0), slope, 1), atol=1e-3)
    np.testing.assert_allclose(gy, fir(fir(padded, bell / bell.sum(), 1), slope, 0), atol=1e-3)


@pytest.mark.parametrize("name", ["gef", "canny"])
def test_a_step_gives_its_height_and_one_thin_line(name):
    image = np.full((40, 60), 20, np.uint8)
    image[:, 30:] = 90
    for turned in eight(image):
        gradient = ops.gradient_of(turned, name)
        assert gradient.magnitude.max() == pytest.approx(70, rel=0.02)
        assert gradient.thin.sum() == 40
        # Of the two equal pixels of an ideal step, the brighter stays.
        assert (turned[gradient.thin] == 90).all()


@pytest.mark.parametrize("name", ["gef", "canny"])
def test_operators_turn_and_mirror_with_the_image_bit_for_bit(name):
    image = scene()[0]
    base = ops.gradient_of(image, name)
    for field in ("magnitude", "thin", "bright"):
        expected = eight(getattr(base, field))
        for turned, wanted in zip(eight(image), expected, strict=True):
            np.testing.assert_array_equal(getattr(ops.gradient_of(turned, name), field), wanted)


def test_gradient_points_to_the_bright_side():
    image = np.tile(np.linspace(0, 200, 64, dtype=np.float32), (32, 1))
    for name in ops.OPERATORS:
        gradient = ops.gradient_of(image, name)
        assert (gradient.gx[5:-5, 8:-8] > 0).all()
        assert np.abs(gradient.gy).max() < 1e-3


def test_sixteen_bits_are_eight_bits_times_their_scale():
    image = scene()[0]
    base = ops.gradient_of(image)
    for bits in (10, 12, 16):
        wide = (image.astype(np.uint32) * (2**bits - 1) // 255).astype(np.uint16)
        wide[0, 0] = 2**bits - 1
        np.testing.assert_allclose(
            ops.gradient_of(wide).magnitude[8:, 8:], base.magnitude[8:, 8:], atol=1.0
        )


def test_unknown_pixels_raise_no_edge():
    image = np.full((50, 50), 80, np.float32)
    image[10:20, 15:30] = np.nan
    image[40, 40] = np.inf
    gradient = ops.gradient_of(image)
    assert not gradient.thin.any()
    assert gradient.magnitude.max() == 0


@pytest.mark.parametrize("name", ["gef", "canny"])
@pytest.mark.parametrize(
    "image",
    [
        np.zeros((20, 20), np.uint8), np.full((20, 20), 255, np.uint8), np.zeros((1, 30), np.uint8),
        np.zeros((30, 1)), np.zeros((1, 1), np.uint16), np.full((9, 9), 65535, np.uint16),
        np.ones((8, 8), bool),
    ],
)  # fmt: skip
def test_flat_images_have_no_edges(name, image):
    gradient = ops.gradient_of(image, name)
    assert gradient.thin.shape == image.shape
    assert not gradient.thin.any()


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (np.zeros((0, 5)), "no pixels"),
        (np.zeros((4, 4, 3)), "axes"),
        (np.full((4, 4), np.nan), "NaN"),
        (np.zeros((4, 4), complex), "numbers"),
    ],
)
def test_what_is_no_image_is_refused_in_one_line(image, says):
    with pytest.raises(ValueError, match=says) as caught:
        ops.gradient_of(image)
    assert "\n" not in str(caught.value)


def test_operators_can_be_plugged_in_once():
    @ops.register("central differences", greatest=30.0)
    def central(image):
        gy, gx = np.gradient(image)
        return gx.astype(np.float32), gy.astype(np.float32), image

    try:
        image = scene()[0]
        assert ops.gradient_of(image, "central differences").greatest == 30
        with pytest.raises(ValueError, match="twice"):
            ops.register("central differences", greatest=1.0)(central)
    finally:
        del ops.OPERATORS["central differences"]
    with pytest.raises(ValueError, match="unknown edge operator 'central"):
        ops.gradient_of(image, "central differences")

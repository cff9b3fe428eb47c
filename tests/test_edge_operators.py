"""The operators against plain references, and the laws of issue 3, item 4."""

import cv2
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
    for a0 in (0.45, 0.2):
        gx, gy, _ = ops.gef_gradient(image, a0)
        for ours, theirs in zip((gx, gy), reference_gef(image, a0), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=2e-4)
    np.testing.assert_array_equal(ops.gef_gradient(image)[0], ops.gef_gradient(image, 0.45)[0])


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


# -- grey levels ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("image", "top"),
    [
        (np.array([[7, 200]], np.uint8), 255), (np.array([[7, 100]], np.int8), 255),
        (np.array([[0.25, 300.0]]), 255), (np.array([[False, True]]), 1),
        (np.array([[7, 255]], np.uint16), 255), (np.array([[7, 256]], np.uint16), 1023),
        (np.array([[7, 1023]], np.uint16), 1023), (np.array([[7, 1024]], np.uint16), 4095),
        (np.array([[7, 4095]], np.int32), 4095), (np.array([[7, 4096]], np.uint16), 16383),
        (np.array([[7, 16383]], np.int64), 16383), (np.array([[7, 16384]], np.uint16), 65535),
        (np.array([[7, 65535]], np.uint32), 65535),
    ],
)  # fmt: skip
def test_full_scale_follows_from_the_type_and_the_greatest_value(image, top):
    levels, unknown = ops.grey_levels(image)
    assert levels.dtype == np.float32
    np.testing.assert_allclose(levels, image.astype(float) * 255 / top, rtol=1e-6)
    assert unknown is None


def test_a_full_scale_that_is_given_counts():
    levels, _ = ops.grey_levels(np.array([[0.0, 0.5, 1.0]]), full_scale=1.0)
    np.testing.assert_allclose(levels, [[0, 127.5, 255]])
    levels, _ = ops.grey_levels(np.array([[0, 500]], np.uint16), full_scale=1000)
    np.testing.assert_allclose(levels, [[0, 127.5]])
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="full_scale must be positive"):
            ops.grey_levels(np.ones((2, 2)), full_scale=wrong)


def test_an_unknown_pixel_takes_the_mean_of_the_known_ones_around_ring_by_ring():
    nan = np.nan
    for image, wanted in (
        ([[10, nan, nan, 40]], [[10, 10, 40, 40]]),
        ([[10, nan, nan, nan, 40]], [[10, 10, 25, 40, 40]]),
        ([[1, 2, 3], [4, nan, 6], [7, 8, 19]], [[1, 2, 3], [4, 50 / 8, 6], [7, 8, 19]]),
        ([[nan, 6, 3], [9, 12, 5]], [[9, 6, 3], [9, 12, 5]]),
    ):
        image = np.array(image)
        for turned, filled in zip(eight(image), eight(np.array(wanted)), strict=True):
            levels, unknown = ops.grey_levels(turned)
            np.testing.assert_allclose(levels, filled, rtol=1e-6)
            np.testing.assert_array_equal(unknown, np.isnan(turned))


def test_unknown_pixels_have_no_gradient_of_their_own():
    image = np.tile(np.arange(40, dtype=np.float32) * 5, (30, 1))
    image[10:14, 20] = np.nan
    gradient = ops.gradient_of(image)
    assert (gradient.magnitude[10:14, 20] == 0).all()
    assert (np.delete(gradient.magnitude, 20, axis=1) > 0).all()


# -- the operators' details ----------------------------------------------------------------------


def test_gefs_bright_side_is_the_greater_of_the_four_means_beside_the_pixel():
    image = np.random.default_rng(3).uniform(0, 255, (40, 35)).astype(np.float32)
    a0 = 0.45

    def smooth_and_sides(image, axis):
        """The image smoothed across ``axis``, and its one-sided means before and after a pixel."""
        x = np.moveaxis(image.astype(float), axis, 0)

        def means(line):
            out = line.copy()
            for i in range(1, len(line)):
                out[i] = a0 * line[i] + (1 - a0) * out[i - 1]
            return out

        across = np.moveaxis(x, 1, 0)
        smooth = (means(across) + means(across[::-1])[::-1] - a0 * across) / (2 - a0)
        x = np.moveaxis(smooth, 0, 1)
        before, after = means(x), means(x[::-1])[::-1]
        before, after = (
            np.concatenate([before[:1], before[:-1]]),
            np.concatenate([after[1:], after[-1:]]),
        )
        return np.moveaxis(np.maximum(before, after), 0, axis)

    wanted = np.maximum(smooth_and_sides(image, 0), smooth_and_sides(image, 1))
    np.testing.assert_allclose(ops.gef_gradient(image, a0)[2], wanted, atol=1e-3)


@pytest.mark.parametrize("sigma", [0.7, 1.0, 2.2])
def test_canny_at_any_scale_and_its_bright_side(sigma):
    image = np.random.default_rng(2).uniform(0, 255, (40, 33)).astype(np.float32)
    gx, gy, bright = ops.canny_gradient(image, sigma)
    reach = int(4 * sigma + 0.5)
    k = np.arange(-reach, reach + 1)
    bell = np.exp(-0.5 * (k / sigma) ** 2.0)
    bell, slope = bell / bell.sum(), k * bell / (k * bell)[reach:].sum()
    wide = np.pad(image.astype(float), reach, mode="edge")

    def fir(a, weights, axis):
        return np.apply_along_axis(lambda v: np.correlate(v, weights, "valid"), axis, a)

    np.testing.assert_allclose(gx, fir(fir(wide, bell, 0), slope, 1), atol=2e-3)
    np.testing.assert_allclose(gy, fir(fir(wide, bell, 1), slope, 0), atol=2e-3)
    inner = slice(reach, -reach)
    mean = 0.5 * (fir(wide, bell, 0)[:, inner] + fir(wide, bell, 1)[inner])
    side = 2 * round(sigma) + 1
    np.testing.assert_allclose(bright, cv2.dilate(mean, np.ones((side, side), np.uint8)), atol=1e-3)


def test_the_papers_constants():
    assert (ops.ISEF_A0, ops.CANNY_SIGMA) == (0.45, 1.0)
    assert ops.OPERATORS["gef"].greatest == ops.OPERATORS["canny"].greatest == 20


@pytest.mark.parametrize("a0", [0.0, 1.0, -0.1, 1.2, np.nan])
def test_a_weight_outside_zero_to_one_is_refused(a0):
    with pytest.raises(ValueError, match="a0 must lie between 0 and 1"):
        ops.gef_gradient(np.zeros((4, 4), np.float32), a0)


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan])
def test_a_scale_that_is_none_is_refused(sigma):
    with pytest.raises(ValueError, match="sigma must be greater than 0"):
        ops.canny_gradient(np.zeros((4, 4), np.float32), sigma)


# -- non-maximum suppression ---------------------------------------------------------------------


def reference_suppression(gx, gy, magnitude, floor):
    """Pixel by pixel: the magnitude one step up and down the gradient, 0 outside the image."""
    height, width = magnitude.shape

    def at(x, y):
        return magnitude[y, x] if 0 <= x < width and 0 <= y < height else np.float32(0)

    thin = np.zeros(magnitude.shape, bool)
    for y, x in np.ndindex(magnitude.shape):
        dx, dy = gx[y, x], gy[y, x]
        sx, sy = (1 if dx >= 0 else -1), (1 if dy >= 0 else -1)
        if abs(dx) >= abs(dy):
            t, ox, oy = np.abs(dy) / max(abs(dx), np.float32(1e-9)), sx, 0
        else:
            t, ox, oy = np.abs(dx) / abs(dy), 0, sy
        up = (1 - t) * at(x + ox, y + oy) + t * at(x + sx, y + sy)
        down = (1 - t) * at(x - ox, y - oy) + t * at(x - sx, y - sy)
        here = magnitude[y, x]
        thin[y, x] = here > floor and here > up and here >= down
    return thin


@pytest.mark.parametrize("shape", [(1, 1), (1, 12), (12, 1), (21, 34)])
def test_suppression_equals_its_definition_at_every_pixel(shape):
    rng = np.random.default_rng(5)
    for _ in range(4):
        # Small whole numbers: ties, level, upright and diagonal gradients are frequent.
        gx, gy = rng.integers(-2, 3, (2, *shape)).astype(np.float32)
        magnitude = rng.integers(0, 6, shape).astype(np.float32)
        magnitude[(gx == 0) & (gy == 0)] = 0
        for floor in (0.0, 2.0):
            found = ops.non_maximum_suppression(gx, gy, magnitude, floor)
            np.testing.assert_array_equal(found, reference_suppression(gx, gy, magnitude, floor))
    assert shape[0] * shape[1] < 100 or found.any()


def test_of_two_equal_pixels_the_one_up_the_gradient_stays():
    magnitude = np.zeros((5, 6), np.float32)
    magnitude[:, 2:4] = 7
    for sign, column in ((1, 3), (-1, 2)):
        gx = np.sign(magnitude) * np.float32(sign)
        thin = ops.non_maximum_suppression(gx, np.zeros_like(gx), magnitude)
        assert thin[:, column].all() and thin.sum() == 5
        thin = ops.non_maximum_suppression(np.zeros_like(gx.T), gx.T, magnitude.T)
        assert thin[column].all() and thin.sum() == 5


def test_half_a_grey_level_is_no_candidate_unless_asked_for():
    image = np.zeros((20, 20), np.float32)
    for height, found in ((0.4, 0), (0.6, 20)):
        image[:, 10:] = height
        assert ops.gradient_of(image).thin.sum() == found
        assert ops.gradient_of(image, floor=0.1).thin.sum() == 20
        assert not ops.gradient_of(image, floor=None).thin.any()


def test_the_magnitude_is_that_of_both_components_and_the_levels_go_along():
    image = scene()[0].astype(np.uint16) * 4
    for name in ("gef", "canny"):
        gradient = ops.gradient_of(image, name, full_scale=1020.0)
        np.testing.assert_allclose(
            gradient.magnitude, np.hypot(gradient.gx, gradient.gy), rtol=1e-5, atol=1e-6
        )
        np.testing.assert_allclose(gradient.levels, scene()[0], rtol=1e-6)
        assert gradient.greatest == 20
        np.testing.assert_array_equal(
            gradient.thin,
            ops.non_maximum_suppression(gradient.gx, gradient.gy, gradient.magnitude, 0.5),
        )


def test_the_gradient_has_the_sense_of_its_axes():
    """x grows to the right and y down: brighter to the right and to the top."""
    y, x = np.mgrid[0:40, 0:50].astype(np.float32)
    for name in ("gef", "canny"):
        gradient = ops.gradient_of(100 + 2 * x - y, name)
        inner = (slice(10, -10), slice(10, -10))
        assert (gradient.gx[inner] > 0).all() and (gradient.gy[inner] < 0).all()
        np.testing.assert_allclose(gradient.gx[inner], -2 * gradient.gy[inner], rtol=2e-3)

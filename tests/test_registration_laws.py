"""Stripes and the far-to-near map: exact figures, signs, and both sides of limits, not square."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from workbench_stages.dfd.similarity import (
    Similarity,
    _agreement,
    align_pair,
    find_dots,
    fit_similarity,
    match_dots,
    misalignment_rms_px,
    refine_similarity,
    warp_to_near,
)
from workbench_stages.dfd.stripes import (
    Stripes,
    average_over_period,
    measure_stripes,
    whole_period_taps,
)


def waves(shape: tuple[int, int], period: float, angle_deg: float) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    angle = np.radians(angle_deg)
    return np.sin(2 * np.pi * (x * np.cos(angle) - y * np.sin(angle)) / period)


# -- stripes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(120, 200), (200, 120)])
@pytest.mark.parametrize(
    ("period", "found"), [(2.1, False), (2.3, True), (9.5, True), (10.6, False)]
)
def test_periods_lie_between_two_pixels_and_a_twelfth_of_the_shorter_side(
    shape: tuple[int, int], period: float, found: bool
) -> None:
    for angle_deg in (0, 90, 25):
        stripes = measure_stripes(100 + 50 * waves(shape, period, angle_deg))
        assert (stripes is not None) == found
        if stripes is not None:
            assert stripes.period_px == pytest.approx(period, rel=0.01)
            assert stripes.angle_deg == pytest.approx(angle_deg, abs=0.6)
            assert 0.9 < stripes.strength <= 1


def test_stripes_are_measured_under_uneven_light_and_with_unknown_pixels() -> None:
    shape = (150, 220)
    image = 100 * (1 + 0.8 * waves(shape, 6.3, 12)) * np.linspace(0.05, 1, 220)[None]
    image[40:44, 100] = np.nan
    stripes = measure_stripes(image)
    assert stripes is not None
    assert stripes.period_px == pytest.approx(6.3, rel=0.01)
    assert stripes.angle_deg == pytest.approx(12, abs=0.6)


@pytest.mark.parametrize(("share", "found"), [(0.9, True), (0.35, False)])
def test_a_quarter_of_the_power_must_lie_in_the_peak(share: float, found: bool) -> None:
    """A grating in white noise whose power in the band is several times its own, or not."""
    rng = np.random.default_rng(0)
    image = 100 + 10 * share * waves((128, 160), 5, 0) + 9 * rng.normal(size=(128, 160))
    stripes = measure_stripes(image)
    assert (stripes is not None) == found
    assert stripes is None or 0.25 <= stripes.strength < 0.6


def test_an_image_must_have_sixteen_pixels_each_way() -> None:
    assert measure_stripes(100 + 50 * waves((15, 400), 3, 0)) is None
    assert measure_stripes(100 + 50 * waves((400, 15), 3, 90)) is None


@pytest.mark.parametrize(
    ("angle_deg", "upright", "extent"),
    [
        (0, True, 6.0), (90, False, 6.0), (30, True, 6 / np.cos(np.pi / 6)),
        (-30, True, 6 / np.cos(np.pi / 6)), (45, True, 6 * np.sqrt(2)), (-46, False, None),
        (60, False, 6 / np.cos(np.pi / 6)), (-60, False, 6 / np.cos(np.pi / 6)),
    ],
)  # fmt: skip
def test_one_period_along_the_nearer_axis(
    angle_deg: float, upright: bool, extent: float | None
) -> None:
    stripes = Stripes(6.0, angle_deg, 1.0)
    assert stripes.upright == upright
    if extent is not None:
        assert stripes.extent_px() == pytest.approx(extent)


@pytest.mark.parametrize(
    ("width", "taps"),
    [
        (1, [1]), (1.5, [0.25, 1, 0.25]), (2, [0.5, 1, 0.5]), (3, [1, 1, 1]),
        (3.3, [0.15, 1, 1, 1, 0.15]), (5, [1] * 5), (6, [0.5, 1, 1, 1, 1, 1, 0.5]),
    ],
)  # fmt: skip
def test_a_window_is_a_box_of_exactly_its_width(width: float, taps: list[float]) -> None:
    np.testing.assert_allclose(whole_period_taps(width), np.array(taps) / width, rtol=1e-6)


@pytest.mark.parametrize("width", [0.99, 0.0, -3.0])
def test_a_window_of_less_than_a_pixel_is_refused(width: float) -> None:
    with pytest.raises(ValueError, match="at least 1 px"):
        whole_period_taps(width)


@pytest.mark.parametrize("period", [4, 5, 8])
@pytest.mark.parametrize("upright", [True, False])
def test_averaging_over_whole_pixels_leaves_the_mean_everywhere_and_nothing_along_blurred(
    period: int, upright: bool
) -> None:
    """Also along the border, where the stripes are carried on whole periods further in."""
    shape = (40, 56)
    along = np.random.default_rng(0).uniform(50, 150, shape[0 if upright else 1])
    stripes = 1 + 0.7 * waves(shape, period, 0 if upright else 90)
    image = stripes * (along[:, None] if upright else along[None])
    out = average_over_period(image, Stripes(period, 0 if upright else 90, 1.0))
    assert out.dtype == np.float32
    np.testing.assert_allclose(
        out, np.broadcast_to(along[:, None] if upright else along[None], shape), rtol=2e-5
    )


def test_averaging_without_stripes_or_in_a_narrow_image() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(average_over_period(image, None), image)
    for narrow, stripes in ((image, Stripes(9, 0, 1)), (image.T.copy(), Stripes(9, 90, 1))):
        out = average_over_period(narrow, stripes)
        assert out.shape == narrow.shape
        assert np.isfinite(out).all()
    np.testing.assert_allclose(
        average_over_period(np.full((30, 40), 7.0), Stripes(5.4, 20, 1)), 7, rtol=1e-6
    )


# -- the map --------------------------------------------------------------------------------------

TRUE = Similarity(0.98, 1.5, 2.0, -3.0, 120, 80)


def moved(similarity: Similarity, points: np.ndarray) -> np.ndarray:
    return np.column_stack([points, np.ones(len(points))]) @ similarity.far_from_near.T


def test_the_map_turns_about_the_middle_counter_clockwise_as_displayed() -> None:
    quarter = Similarity(2.0, 90.0, 5.0, 7.0, 101, 61)
    middle = np.array([50.0, 30.0])
    points = middle + np.array([[0, 0], [10, 0], [0, 10]])
    # To the right goes up, which is a smaller y; down goes right.
    wanted = middle + np.array([5, 7]) + np.array([[0, 0], [0, -20], [20, 0]])
    np.testing.assert_allclose(moved(quarter, points), wanted, atol=1e-9)
    np.testing.assert_allclose(moved(Similarity.identity(101, 61), points), points)


def test_the_map_and_its_numbers() -> None:
    turn = np.radians(TRUE.rotation_deg)
    a, b = TRUE.scale * np.cos(turn), TRUE.scale * np.sin(turn)
    again = Similarity.from_ab(a, b, TRUE.dx_px, TRUE.dy_px, 120, 80)
    for name in ("scale", "rotation_deg", "dx_px", "dy_px", "width", "height"):
        assert getattr(again, name) == pytest.approx(getattr(TRUE, name))


@pytest.mark.parametrize("size", [(60, 40), (240, 160)])
def test_the_map_of_a_resized_image_moves_the_same_places(size: tuple[int, int]) -> None:
    small = TRUE.resized(*size)
    assert (small.width, small.height) == size
    assert (small.scale, small.rotation_deg) == (TRUE.scale, TRUE.rotation_deg)
    ratio = size[0] / 120
    assert (small.dx_px, small.dy_px) == (2 * ratio, -3 * ratio)
    points = np.array([[0.0, 0], [119, 0], [30, 79]])
    # A pixel's centre is half a pixel inside its cell.
    there = (points + 0.5) * ratio - 0.5
    wanted = (moved(TRUE, points) + 0.5) * ratio - 0.5
    np.testing.assert_allclose(moved(small, there), wanted, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "identity"),
    [
        ({"dx_px": 0.009}, True), ({"dx_px": 0.011}, False), ({"dy_px": -0.009}, True),
        ({"dy_px": -0.011}, False), ({"scale": 1 + 0.9e-2 / 100}, True),
        ({"scale": 1 + 1.1e-2 / 100}, False), ({"rotation_deg": 0.02}, False),
    ],
)  # fmt: skip
def test_a_map_that_moves_nothing_by_a_hundredth_of_a_pixel_is_none(
    change: dict[str, float], identity: bool
) -> None:
    """201 by 61 pixels: the corners lie 100 and 30 pixels from the middle."""
    numbers = {"scale": 1.0, "rotation_deg": 0.0, "dx_px": 0.0, "dy_px": 0.0} | change
    similarity = Similarity(**numbers, width=201, height=61)
    assert similarity.is_identity == identity
    image = np.random.default_rng(0).random((61, 201)).astype(np.float32)
    assert (warp_to_near(image, similarity) is image) == identity


def picture(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture without any symmetry, at any place."""
    return (
        100
        + 30 * np.sin(x / 7 + 0.3 * np.sin(y / 11))
        + 25 * np.cos(y / 6 - x / 19)
        + 0.1 * x
        - 0.2 * y
    )


@pytest.mark.parametrize(
    "similarity",
    [TRUE, Similarity(1.03, -2.0, -1.5, 4.25, 120, 80), Similarity(1.0, 0.0, 3.0, 0.0, 120, 80)],
)
def test_warping_puts_what_far_shows_where_near_has_it(similarity: Similarity) -> None:
    y, x = np.mgrid[:80, :120].astype(float)
    far_x, far_y = np.moveaxis(
        np.einsum("ij,hwj->hwi", similarity.far_from_near, np.dstack([x, y, np.ones_like(x)])),
        -1,
        0,
    )
    warped = warp_to_near(picture(x, y).astype(np.uint16), similarity)
    inner = (slice(12, -12), slice(12, -12))
    wanted = np.floor(picture(far_x, far_y))
    np.testing.assert_allclose(warped[inner], wanted[inner], atol=1.6)
    assert warped.dtype == np.float32


@pytest.mark.parametrize("similarity", [TRUE, Similarity(1.03, -2.0, -1.5, 4.25, 120, 80)])
def test_a_pair_gives_back_the_map_between_its_images(similarity: Similarity) -> None:
    y, x = np.mgrid[:80, :120].astype(float)
    fine = sum(picture(k * x + 31 * k, k * y) for k in (1, 2, 3)).astype(np.float32)
    near = warp_to_near(fine, similarity)
    found = refine_similarity([(near, fine)], Similarity.identity(120, 80), iterations=30)
    corners = np.array([[0.0, 0], [119, 0], [0, 79], [119, 79]])
    assert np.abs(moved(found, corners) - moved(similarity, corners)).max() < 0.15
    assert misalignment_rms_px(near, warp_to_near(fine, found)) < 0.05


def test_what_stripes_do_not_show_keeps_its_value() -> None:
    shape = (96, 128)
    upright = (100 + 50 * waves(shape, 9, 0)).astype(np.float32)
    level = (100 + 50 * waves(shape, 9, 90)).astype(np.float32)
    true = Similarity(1.0, 0.0, 0.7, -0.6, 128, 96)
    pairs = [(warp_to_near(image, true), image) for image in (upright, level)]
    start = Similarity(1.0, 0.0, 0.0, 1.25, 128, 96)
    alone = refine_similarity(pairs[:1], start)
    assert alone.dx_px == pytest.approx(0.7, abs=0.03)
    assert alone.dy_px == pytest.approx(1.25, abs=1e-6)
    both = refine_similarity(pairs, Similarity.identity(128, 96))
    assert (both.dx_px, both.dy_px) == pytest.approx((0.7, -0.6), abs=0.03)


@pytest.mark.parametrize(
    ("motion", "wanted"),
    [
        (Similarity(1.0, 0.0, 0.2, 0.0, 160, 96), 0.2),
        (Similarity(1.0, 0.0, 0.12, -0.16, 160, 96), 0.2),
        # A root mean square distance from the middle of 53.8 px, times the scale or the turn.
        (Similarity(1.004, 0.0, 0.0, 0.0, 160, 96), 0.004 * np.hypot(159, 95) / 12**0.5),
        (
            Similarity(1.0, np.degrees(0.004), 0.0, 0.0, 160, 96),
            0.004 * np.hypot(159, 95) / 12**0.5,
        ),
    ],
)
def test_the_misalignment_is_the_root_mean_square_motion_in_pixels(
    motion: Similarity, wanted: float
) -> None:
    far = cv2.GaussianBlur(
        np.random.default_rng(0).normal(size=(96, 160)).astype(np.float32), (0, 0), 2.0
    )
    near = warp_to_near(100 + 50 * far, motion)
    found = misalignment_rms_px(near, 100 + 50 * far)
    assert found == pytest.approx(wanted, rel=0.12)


def test_too_small_an_image_tells_no_misalignment() -> None:
    image = np.random.default_rng(0).normal(size=(64, 64)).astype(np.float32)
    shifted = np.roll(cv2.GaussianBlur(image, (0, 0), 2), 1, axis=1)
    assert misalignment_rms_px(image, shifted) > 0
    for cut in ((slice(0, 31), slice(None)), (slice(None), slice(0, 31))):
        assert misalignment_rms_px(image[cut], shifted[cut]) == 0


def test_a_small_image_that_cannot_be_aligned_keeps_its_first_start() -> None:
    image = np.random.default_rng(0).normal(size=(20, 90)).astype(np.float32)
    starts = [Similarity(1.0, 0.0, 1.0, 0.0, 90, 20), Similarity.identity(90, 20)]
    assert align_pair(image, image, starts) is starts[0]


@pytest.mark.parametrize("true", [(1.0, 0.0, 0.0, 0.0), (0.95, 0.0, 0.0, 0.0)])
def test_of_several_starts_the_one_that_the_images_bear_out_is_taken(
    true: tuple[float, float, float, float],
) -> None:
    """Fine texture: from the wrong start nothing leads to the right one."""
    shape = (200, 280)
    near = cv2.GaussianBlur(
        np.random.default_rng(2).normal(size=shape).astype(np.float32), (0, 0), 1.2
    )
    similarity = Similarity(*true, 280, 200)
    far = cv2.warpAffine(
        near, cv2.invertAffineTransform(similarity.far_from_near), (280, 200),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REFLECT_101,
    )  # fmt: skip
    guesses = [Similarity(s, 0.0, 0.0, 0.0, 280, 200) for s in (1.0, 0.95)]
    for starts in (guesses, guesses[::-1]):
        found = align_pair(100 + 30 * near, 100 + 30 * far, starts)
        assert found.scale == pytest.approx(true[0], abs=2e-3)
        assert (found.width, found.height) == (280, 200)


# -- dots -----------------------------------------------------------------------------------------


def lattice(centres: np.ndarray, shape: tuple[int, int], sigma: float = 1.6) -> np.ndarray:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    image = np.full(shape, 20.0)
    for cx, cy in centres:
        image += 160 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return image


def centres_of(columns: int, rows: int, pitch: float = 15.0) -> np.ndarray:
    """A lattice whose dots lie between pixels, each a little off."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    off = np.random.default_rng(1).uniform(-0.5, 0.5, (columns * rows, 2))
    return np.column_stack([x.ravel(), y.ravel()]) * pitch + 12 + off


def test_dots_are_found_at_their_centres() -> None:
    centres = centres_of(7, 4)
    found = find_dots(lattice(centres, (75, 120)))
    assert len(found) == 28
    off = np.linalg.norm(found[:, None] - centres[None], axis=2).min(axis=1)
    assert off.max() < 0.05


def test_dots_that_are_cut_or_of_an_odd_size_are_left_out() -> None:
    centres = centres_of(6, 4)
    image = lattice(centres, (75, 120))
    cut = np.array([[110.0, 1.0], [1.0, 70.0], [118.5, 40.0], [60.0, 73.5]])
    image += lattice(cut, (75, 120)) - 20
    image += lattice(np.array([[108.0, 60.0]]), (75, 120), sigma=4.5) - 20
    image += 0.8 * (lattice(np.array([[104.0, 22.0]]), (75, 120), sigma=0.6) - 20)
    found = find_dots(image)
    assert len(found) == 24
    assert np.linalg.norm(found[:, None] - centres[None], axis=2).min(axis=1).max() < 0.05


def test_one_dot_is_a_dot_and_ones_of_twice_the_area_or_half_of_it_are_too() -> None:
    """Left out are those of less than two fifths or more than five halves of the usual area."""
    assert find_dots(lattice(np.array([[20.3, 14.6]]), (30, 44))) == pytest.approx(
        np.array([[20.3, 14.6]]), abs=0.05
    )
    grid = np.zeros((64, 120))
    for row in range(4):
        for column in range(7):
            grid[8 + 14 * row : 12 + 14 * row, 8 + 15 * column : 12 + 15 * column] = 100
    for height, width, found in ((1, 7, True), (2, 3, False), (5, 8, True), (6, 7, False)):
        image = grid.copy()
        image[22:26, 38:42] = 0
        image[22 : 22 + height, 38 : 38 + width] = 100
        assert len(find_dots(image)) == 28 - (not found)


def test_agreement_is_a_correlation_where_both_images_have_pixels() -> None:
    image = cv2.GaussianBlur(
        np.random.default_rng(0).normal(size=(80, 120)).astype(np.float32), (0, 0), 1.5
    )
    here = Similarity.identity(120, 80)
    assert _agreement(image, image, here) == pytest.approx(1, abs=1e-5)
    assert _agreement(image, 5 * image + 3, here) == pytest.approx(1, abs=1e-3)
    assert _agreement(image, -image, here) == pytest.approx(-1, abs=1e-5)
    assert abs(_agreement(image, image[::-1, ::-1], here)) < 0.3
    moved_ = Similarity(1.0, 0.0, 6.0, 0.0, 120, 80)
    assert _agreement(warp_to_near(image, moved_), image, moved_) > 0.98
    # Three quarters of the image out of sight.
    assert _agreement(image, image, Similarity(1.0, 0.0, 92.0, 0.0, 120, 80)) == -1
    assert _agreement(image * 0, image, here) == -1


@pytest.mark.parametrize("image", [np.zeros((40, 40)), np.full((40, 40), -3.0), np.ones((40, 40))])
def test_no_dots_are_none(image: np.ndarray) -> None:
    assert find_dots(image).shape == (0, 2)


def test_pairs_are_matched_over_a_drift_and_each_with_its_own() -> None:
    near = centres_of(8, 6)
    true = Similarity(0.985, 0.6, 1.6, -1.2, 140, 110)
    far = moved(true, near)
    order = np.random.default_rng(3).permutation(len(far))
    # One dot of near has no partner, and far has one too many.
    a, b = match_dots(near[1:], np.concatenate([far[order], [[70.0, 4.0]]]))
    assert len(a) == len(near) - 1
    np.testing.assert_allclose(b, moved(true, a), atol=1e-9)
    assert len(match_dots(near[[0, 7, 40, 47]], far[[0, 7, 40, 47]])[0]) == 4
    for few in (near[:3], near[:0]):
        assert len(match_dots(few, far)[0]) == len(match_dots(near, few)[0]) == 0


def test_pairs_a_third_of_the_pitch_apart_are_not_believed() -> None:
    x, y = np.meshgrid(np.arange(6.0), np.arange(5.0))
    near = 15 * np.column_stack([x.ravel(), y.ravel()])
    assert len(match_dots(near, near + np.array([4.9, 0]))[0]) == 30
    assert len(match_dots(near, near + np.array([5.1, 0]))[0]) == 0


def test_points_give_all_four_numbers_and_what_they_leave() -> None:
    near = centres_of(8, 6)[:-1]
    far = moved(TRUE, near)
    fit = fit_similarity(near, far, 120, 80)
    for name in ("scale", "rotation_deg", "dx_px", "dy_px"):
        assert getattr(fit.similarity, name) == pytest.approx(getattr(TRUE, name), abs=1e-9)
    assert fit.points == 47
    assert fit.residual_rms_px < 1e-9
    before = np.sqrt(((near - far) ** 2).sum(axis=1).mean())
    assert fit.before_rms_px == pytest.approx(before)
    assert len(fit_similarity(near[:4], far[:4], 120, 80).similarity.far_from_near) == 2
    with pytest.raises(ValueError, match="at least 4 matched points, found 3"):
        fit_similarity(near[:3], far[:3], 120, 80)


def test_a_stray_point_is_left_out_and_noise_is_told() -> None:
    near = np.random.default_rng(4).uniform(0, 100, (400, 2))
    noise = 0.05 * np.random.default_rng(5).normal(size=near.shape)
    far = moved(TRUE, near) + noise
    far[7] += (6, -4)
    fit = fit_similarity(near, far, 120, 80)
    assert fit.similarity.scale == pytest.approx(TRUE.scale, abs=3e-4)
    assert 390 <= fit.points < 400
    assert fit.residual_rms_px == pytest.approx(0.05 * 2**0.5, rel=0.1)

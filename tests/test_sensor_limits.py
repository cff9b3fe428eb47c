"""The sensor's three stages on planted images: signs, light, and both sides of each limit."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from workbench.stage import WARNINGS, StageError
from workbench_stages.depth_cloud import DepthCloud
from workbench_stages.dfd.calibration import Calibration, gain_terms, light_ratio, pair_gain
from workbench_stages.dfd.cloud import cloud_from_depth
from workbench_stages.dfd.depth import (
    Response,
    confidence_from_error,
    contrast_of_cells,
    estimate,
    folded_back,
    on_pixels,
    windows_for,
)
from workbench_stages.dfd.focus import PAPER_KERNEL, SensorNoise, focus_map, laplacian, noise_gain
from workbench_stages.dfd.images import full_scale, grey
from workbench_stages.dfd.similarity import Similarity, warp_to_near
from workbench_stages.dfd.stripes import Stripes, whole_period_taps
from workbench_stages.dfd.texture import Texture
from workbench_stages.focus_maps import FocusMaps, window_side_px
from workbench_stages.registration import Registration

SHAPE = (60, 84)


def calibration(shape: tuple[int, int] = SHAPE, **changes: Any) -> Calibration:
    """t = (1 - Q) / 2 between 0.7 and 0.8 m, without noise to speak of."""
    values: dict[str, Any] = {
        "similarity": Similarity.identity(shape[1], shape[0]),
        "stripes": Stripes(5.0, 0.0, 1.0),
        "laplacian": "opencv",
        "curve": np.broadcast_to(np.array([0.5, -0.5], np.float32)[:, None, None], (2, *shape)),
        "near_z_m": 0.7,
        "far_z_m": 0.8,
        "modulation": np.zeros(0, np.float32),
        "noise": SensorNoise(1e-9, 0.0),
        "gain": np.array([1.0, 0, 0, 0, 0, 0]),
        "full_scale": 255.0,
    }
    return Calibration(**values | changes)


# -- images ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dtype", "highest", "top"),
    [
        (np.uint8, 3, 255), (np.uint16, 1023, 1023), (np.uint16, 1024, 4095),
        (np.uint16, 4095, 4095), (np.uint16, 4096, 65535), (np.uint16, 65535, 65535),
        (np.uint16, 0, 1023), (np.float32, 3, np.inf),
    ],
)  # fmt: skip
def test_full_scale_is_the_least_that_no_pixel_exceeds(
    dtype: type, highest: int, top: float
) -> None:
    image = np.zeros((4, 5), dtype)
    image[2, 3] = highest
    assert full_scale(image) == top
    assert full_scale(np.zeros((2, 2), dtype), image) == top
    assert full_scale(image, np.zeros((2, 2), dtype)) == top


def test_full_scale_of_unlike_images() -> None:
    eight, wide = np.full((2, 2), 9, np.uint8), np.full((2, 2), 2000, np.uint16)
    assert full_scale(eight, wide) == full_scale(wide, eight) == 4095
    assert full_scale(wide, wide.astype(np.float32)) == np.inf


def test_colour_is_read_as_red_green_blue() -> None:
    image = np.zeros((1, 3, 3), np.uint8)
    image[0, 0, 0] = image[0, 1, 1] = image[0, 2, 2] = 200
    np.testing.assert_allclose(grey(image)[0], [0.299 * 200, 0.587 * 200, 0.114 * 200], atol=0.6)
    assert grey(image).dtype == grey(image[..., 0]).dtype == np.float32


# -- the focus measure -----------------------------------------------------------------------------


def test_the_papers_laplacian_is_the_one_that_is_printed() -> None:
    rows = [[0, 0, -1, 0, 0], [0, -1, -2, -1, 0], [-1, -2, 16, -2, -1]]
    np.testing.assert_array_equal(PAPER_KERNEL * 16, np.array(rows + rows[1::-1]))
    assert noise_gain("paper") == pytest.approx((256 + 4 * 4 + 8) / 256)


@pytest.mark.parametrize(("kind", "scale"), [("opencv", 1 / 128), ("paper", 1 / 16)])
def test_a_laplacian_of_a_parabola_is_its_curvature(kind: Any, scale: float) -> None:
    y, x = np.mgrid[0:30, 0:40].astype(np.float32)
    image = 3 * x * x + 5 * y * y
    second = np.array([1, 0, -2, 0, 1]) if kind == "opencv" else None
    found = laplacian(image, kind)[8:-8, 8:-8]
    if second is not None:
        # (1 0 -2 0 1) along an axis gives 8 c for c x², 16 is the sum of the smoothing.
        wanted = scale * 16 * 8 * (3 + 5)
    else:
        weights = PAPER_KERNEL.astype(float)
        v, u = np.mgrid[-2:3, -2:3]
        wanted = float((weights * (3 * u * u + 5 * v * v)).sum())
    np.testing.assert_allclose(found, wanted, rtol=1e-4)


def test_noise_that_grows_with_the_level_is_subtracted_where_it_is() -> None:
    taps = whole_period_taps(31)
    rng = np.random.default_rng(1)
    level = np.where(np.arange(240) < 120, 40.0, 160.0)[None].repeat(160, 0)
    noise = SensorNoise(2.0, 0.05)
    sigma = np.sqrt(noise.read_variance + noise.gain * level)
    image = (level + sigma * rng.normal(size=level.shape)).astype(np.float32)
    for kind in ("opencv", "paper"):
        plain = focus_map(image, taps, taps, kind) ** 2
        for part in (slice(30, 80), slice(160, 210)):
            expected = noise_gain(kind) * sigma[0, part.start] ** 2
            assert plain[40:-40, part].mean() == pytest.approx(expected, rel=0.1)
            rest = focus_map(image, taps, taps, kind, noise)[40:-40, part] ** 2
            assert rest.mean() < 0.15 * expected


# -- windows and confidence ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("period", "smoothing", "reach", "wanted"),
    [
        (5.0, 1.4, 1.2, (3, 7, 3, 5)), (10.0, 1.4, 1.2, (6, 15, 6, 10)),
        (13.4, 0.2, 2.0, (1, 19, 8, 23)), (1.0, 0.2, 0.2, (0, 3, 1, 1)),
    ],
)  # fmt: skip
def test_windows_follow_the_period(
    period: float, smoothing: float, reach: float, wanted: tuple[int, int, int, int]
) -> None:
    windows = windows_for(period, smoothing, reach)
    found = windows.smoothing_px, windows.scatter_px, windows.slope_px, windows.reach_px
    assert found == wanted
    assert windows.halo_px == wanted[0] + wanted[2] + wanted[3]
    assert windows.samples == pytest.approx(max(1.0, (period * max(1.0, smoothing)) ** 2 / 4))
    taps = windows.x_taps
    assert taps.sum() == pytest.approx(1)
    assert taps.size == 2 * wanted[0] + 1
    np.testing.assert_array_equal(windows.y_taps, taps)
    if wanted[0]:
        at = np.arange(taps.size) - wanted[0]
        assert taps[[0, wanted[0], -1]].tolist() == [0.25, 0.5, 0.25]
        # The variance of a box of that side, but for rounding to whole pixels.
        assert (taps * at**2).sum() == wanted[0] ** 2 / 2


def test_confidence_is_a_half_at_the_error_that_is_given() -> None:
    error = np.array([[0.0, 3.3, 9.9], [33.0, np.inf, 1e-3]], np.float32)
    wanted = [[1, 0.5, 0.1], [1 / 101, 0, 1]]
    np.testing.assert_allclose(confidence_from_error(error, 3.3), wanted, rtol=1e-5)


@pytest.mark.parametrize(
    ("shown", "known"), [(1.0, True), (1.32, True), (1.35, False), (0.757, True), (0.74, False)]
)
def test_contrast_that_is_a_third_off_the_calibrations_is_no_surface(
    shown: float, known: bool
) -> None:
    """Uniform images: energy that is a multiple of what the calibration has at mid range."""
    light = np.full(SHAPE, 100, np.float32)
    half = np.full(SHAPE, shown * 0.2 * 100 / 2, np.float32)
    curve = np.array([0.5, -0.5], np.float32).reshape(2, 1, 1)
    for modulation in (np.array([0.2], np.float32), np.array([0.1, 0.2], np.float32)):
        response = Response(curve, modulation, 0.5, SensorNoise(1e-9), "opencv")
        value, error = estimate(half, half, light, light, response, windows_for(5, 1.4, 1.2))
        np.testing.assert_allclose(value, 0.5, atol=1e-6)
        assert np.isfinite(error).all() == known or error.min() > 1e4
        assert (error.max() < 1e3) == known
    none = Response(curve, None, 0.5, SensorNoise(1e-9), "opencv")
    assert estimate(half, half, light, light, none, windows_for(5, 1.4, 1.2))[1].max() < 1


@pytest.mark.parametrize("turned", [False, True])
def test_a_plane_keeps_its_depth_and_a_step_its_place(turned: bool) -> None:
    """Relative depth linear over the image, then two levels; near is 0."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    plane = 0.2 + 0.006 * x + 0.002 * y
    step = np.where(x < 40, 0.2, 0.8)
    curve = np.array([0.5, -0.5], np.float32).reshape(2, 1, 1)
    response = Response(curve, None, 0.5, SensorNoise(1e-9), "opencv")
    for truth, within in ((plane, 5e-4), (step, 0.02)):
        near, far = (20 * (1 - truth)).astype(np.float32), (20 * truth).astype(np.float32)
        light = np.where(truth == 0.8, 160, 100).astype(np.float32)
        images = (near, far, light, light)
        if turned:
            images = tuple(np.ascontiguousarray(image.T) for image in images)
        value, _ = estimate(*images, response, windows_for(5, 1.4, 1.2))
        value = value.T if turned else value
        off = np.abs(value - truth)
        away = (np.abs(x - 39.5) > 4) & (x > 8) & (x < 76) & (y > 8) & (y < 52)
        assert off[away].max() < within


# -- the fold --------------------------------------------------------------------------------------


def test_contrast_is_compared_over_cells_where_depth_is_known() -> None:
    """A patch shows less than the share; of cells without depth nothing counts."""
    shape = (48, 96)
    light = np.full(shape, 100, np.float32)
    focus = np.full(shape, 20, np.float32)
    depth = np.full(shape, 0.5, np.float32)
    depth[:, :24] = np.nan
    modulation = np.array([0.1, 0.2], np.float32)
    shown, enough = contrast_of_cells(focus, light, depth, modulation, 5.0)
    # Cells of four pixels, pooled over five by five, 0.1 + 0.2 · 0.5 of the light expected.
    assert shown.shape == (12, 24)
    np.testing.assert_allclose(shown[:, 8:], 20)
    np.testing.assert_allclose(enough, shown, rtol=1e-5)
    assert (shown[:, :4] == 0).all()
    np.testing.assert_allclose(shown[5, 4:8], [4, 8, 12, 16], rtol=1e-5)
    # Depths outside 0..1 count as its ends.
    for outside, expected in ((-3.0, 10.0), (4.0, 30.0)):
        _, enough = contrast_of_cells(focus, light, np.full(shape, outside, "f4"), modulation, 5.0)
        np.testing.assert_allclose(enough, expected, rtol=1e-5)


@pytest.mark.parametrize(("share", "folded"), [(0.85, True), (0.87, False)])
def test_a_neighbourhood_with_too_little_contrast_is_folded_back(
    share: float, folded: bool
) -> None:
    shape = (80, 120)
    light = np.full(shape, 100, np.float32)
    depth = np.full(shape, 0.5, np.float32)
    focus = np.full(shape, 20, np.float32)
    focus[:, 60:] *= np.float32(share)
    found = folded_back(focus, light, depth, np.array([0.1, 0.2], np.float32), 5.0, 0.86)
    assert found.shape == shape and found.dtype == bool
    assert not found[:, :48].any()
    assert found[:, 72:].all() == folded and found[:, 72:].any() == folded


def test_cells_are_spread_back_over_their_pixels() -> None:
    cells = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    np.testing.assert_array_equal(on_pixels(cells, (4, 9)), np.kron(cells, np.ones((2, 3))))


# -- the stage depth_cloud -------------------------------------------------------------------------


def given(q: float | np.ndarray = 0.0, **changes: Any) -> dict[str, Any]:
    """What the stage needs for focus maps of the ratio ``q`` and even light."""
    light = np.full(SHAPE, 100, np.float32)
    camera = SimpleNamespace(
        width=SHAPE[1], height=SHAPE[0], K=np.array([[900.0, 0, 40], [0, 800.0, 25], [0, 0, 1]])
    )
    return {
        "focus_near": np.asarray(10 * (1 + q) * np.ones(SHAPE), np.float32),
        "focus_far": np.asarray(10 * (1 - q) * np.ones(SHAPE), np.float32),
        "focus_noise": SensorNoise(1e-9, 0.0),
        "near": light,
        "far": light.copy(),
        "intensity": light.copy(),
        "saturated": np.zeros(SHAPE, bool),
        "stripes": Stripes(5.0, 0.0, 1.0),
        "calibration": calibration(),
        "near_camera": camera,
    } | changes


def run(inputs: dict[str, Any], **parameters: Any) -> dict[str, Any]:
    outputs: dict[str, Any] = {WARNINGS: []}
    for part in DepthCloud().compute(inputs, DepthCloud.Parameters(**parameters)):
        outputs |= part | {WARNINGS: outputs[WARNINGS] + part[WARNINGS]}
    return outputs


@pytest.mark.parametrize("q", [0.9, 0.3, 0.0, -0.55, -0.99])
def test_a_greater_near_energy_is_a_nearer_surface_linear_in_dioptres(q: float) -> None:
    out = run(given(q))
    t = (1 - q) / 2
    np.testing.assert_allclose(out["depth_relative"], t, atol=1e-5)
    np.testing.assert_allclose(out["depth_m"], 1 / (1 / 0.7 + t * (1 / 0.8 - 1 / 0.7)), rtol=1e-5)
    assert out["depth_m"].dtype == out["depth_relative"].dtype == np.float32
    assert out["confidence"].min() > 0.99


@pytest.mark.parametrize(
    ("t", "known"), [(-0.009, True), (-0.011, False), (1.009, True), (1.011, False)]
)
def test_depth_may_fall_out_of_the_range_by_its_margin(t: float, known: bool) -> None:
    for percent, factor in ((1.0, 1), (5.0, 5)):
        # A curve of slope one, so that the ratio stays within what energies can show.
        curve = np.zeros((2, *SHAPE), np.float32)
        curve[0], curve[1] = 0.5, 1.0
        margin = (t if t < 0.5 else t - 1) * factor
        wanted = margin if t < 0.5 else 1 + margin
        out = run(
            given(wanted - 0.5, calibration=calibration(curve=curve)),
            range_margin_percent=percent,
        )
        assert np.isfinite(out["depth_relative"]).all() == known
        assert np.isfinite(out["depth_m"]).any() == known
        assert len(out["cloud_xyz_m"]) == (out["depth_m"].size if known else 0)


@pytest.mark.parametrize(("least", "known"), [(0.49, True), (0.5, True), (0.51, False)])
def test_depth_of_less_confidence_than_the_least_is_unknown(least: float, known: bool) -> None:
    """The predicted error is made the one at which confidence is a half."""
    noisy = given(0.2, focus_noise=SensorNoise(20.0, 0.0))
    error = float(np.sqrt(1 / run(noisy)["confidence"] - 1)[30, 40]) * 3.3
    out = run(noisy, half_confidence_error_percent=error, min_confidence=least)
    assert out["confidence"][30, 40] == pytest.approx(0.5, abs=1e-3)
    if least != 0.5:
        assert np.isfinite(out["depth_m"][30, 40]) == known
    at = float(out["confidence"][30, 40])
    exact = run(noisy, half_confidence_error_percent=error, min_confidence=at)
    assert np.isfinite(exact["depth_m"][30, 40])


@pytest.mark.parametrize(("pixels", "known"), [(1, True), (2, False)])
def test_three_percent_of_a_neighbourhood_may_be_saturated(pixels: int, known: bool) -> None:
    """Of 49 pixels (seven a side, for stripes of five) one is two percent, two are four."""
    saturated = np.zeros(SHAPE, bool)
    saturated[30, 40 : 40 + pixels] = True
    out = run(given(0.2, saturated=saturated))
    assert np.isfinite(out["depth_m"][30, 40]) == known
    assert (out["confidence"][30, 40] > 0) == known
    assert np.isfinite(out["depth_m"][30, 46]) and np.isfinite(out["depth_m"][36, 40])
    if not known:
        assert np.isnan(out["depth_m"]).sum() == 7 * 6


@pytest.mark.parametrize(("pixels", "known"), [(2, True), (3, False)])
def test_without_stripes_the_windows_are_those_of_a_period_of_seven_pixels(
    pixels: int, known: bool
) -> None:
    """Nine pixels a side: two of 81 are two and a half percent, three nearly four."""
    saturated = np.zeros(SHAPE, bool)
    saturated[30, 40 : 40 + pixels] = True
    out = run(given(0.2, saturated=saturated, stripes=None))
    assert np.isnan(out["depth_m"]).sum() == (0 if known else 9 * 7)


def test_what_is_measured_on_shrunk_images_has_as_many_samples_as_they_have() -> None:
    """The window grows with the scale, its independent samples do not; half confidence is other."""
    noise = SensorNoise(90.0, 0.0)
    confidences = []
    for scale_px in (1, 2):
        curve = np.array([0.5, -0.5], np.float32).reshape(2, 1, 1)
        made = calibration(texture=Texture(3.0 * scale_px, scale_px, 1.0), curve=curve)
        out = run(
            given(0.2, calibration=made, focus_noise=noise, stripes=None),
            texture_half_confidence_error_percent=12.0, half_confidence_error_percent=3.0,
        )  # fmt: skip
        confidences.append(float(out["confidence"][30, 40]))
    assert confidences[0] == pytest.approx(confidences[1], rel=1e-4)
    striped = run(given(0.2, focus_noise=noise, stripes=None), half_confidence_error_percent=12.0)
    assert striped["confidence"][30, 40] == pytest.approx(confidences[0], rel=1e-4)
    assert 0.01 < confidences[0] < 0.99


@pytest.mark.parametrize(("least", "known"), [(0.85, True), (0.95, False)])
def test_folded_depth_is_unknown_and_has_no_confidence(least: float, known: bool) -> None:
    """Nine tenths of the calibrated contrast: 0.1 of near and far together."""
    calibrated = calibration(modulation=np.array([0.2 / 0.9 / 2, 0], np.float32))
    out = run(given(0.0, calibration=calibrated), min_modulation=least)
    assert np.isfinite(out["depth_m"]).all() == known
    assert np.isnan(out["depth_relative"]).all() != known
    assert (out["confidence"] == 0).all() != known


def test_without_a_calibration_depth_is_relative_and_the_cloud_empty() -> None:
    out = run(given(0.4, calibration=None))
    np.testing.assert_allclose(out["depth_relative"], 0.3, atol=1e-5)
    assert np.isnan(out["depth_m"]).all()
    assert out["cloud_xyz_m"].shape == (0, 3)
    assert len(out[WARNINGS]) == 1 and "relative" in out[WARNINGS][0]


def test_the_cloud_needs_a_camera_of_its_size() -> None:
    without = run(given(near_camera=None))
    assert "no camera calibration" in without[WARNINGS][0]
    turned = SimpleNamespace(width=SHAPE[0], height=SHAPE[1], K=np.eye(3))
    unlike = run(given(near_camera=turned))
    assert "the camera calibration is for 60×84 pixels, the images are 84×60" in unlike[WARNINGS][0]
    for out in (without, unlike):
        assert len(out["cloud_xyz_m"]) == len(out["cloud_normals"]) == 0
        assert np.isfinite(out["depth_m"]).all()


def test_without_edge_aware_windows_each_pixel_hears_its_own_alone() -> None:
    """A step is then exact beyond the three pixels of the second averaging."""
    x = np.arange(SHAPE[1])[None].repeat(SHAPE[0], 0)
    q = np.where(x < 40, 0.5, -0.5)
    aware, alone = (run(given(q), edge_aware=one, min_confidence=0) for one in (True, False))
    off = np.abs(alone["depth_relative"] - (1 - q) / 2)
    assert np.nanmax(off[:, np.abs(x[0] - 39.5) > 3]) < 1e-5
    assert np.nanmin(off[:, np.abs(x[0] - 39.5) < 3]) > 0.1
    assert not np.array_equal(aware["depth_relative"], alone["depth_relative"], equal_nan=True)


# -- the cloud -------------------------------------------------------------------------------------


def test_points_are_the_pinholes_in_row_order() -> None:
    shape = (7, 11)
    camera = SimpleNamespace(
        width=11, height=7, K=np.array([[800.0, 0, 3.25], [0, 650.0, 4.5], [0, 0, 1]])
    )
    depth = np.random.default_rng(0).uniform(0.5, 0.9, shape).astype(np.float32)
    depth[0, 3], depth[4, 4], depth[5, 5], depth[6, 6] = np.nan, np.inf, 0.0, -0.5
    shade = np.arange(77, dtype=np.uint8).reshape(shape)
    points, normals, grey_levels = cloud_from_depth(depth, shade, camera, 2)
    wanted = [
        ((x - 3.25) * z / 800, (y - 4.5) * z / 650, z)
        for (y, x), z in np.ndenumerate(depth.astype(float))
        if np.isfinite(z) and z > 0
    ]
    np.testing.assert_allclose(points, wanted, rtol=1e-6)
    assert len(points) == len(normals) == 73
    assert points.dtype == normals.dtype == grey_levels.dtype == np.float32
    assert grey_levels[:5].tolist() == [0, 1, 2, 4, 5]
    with pytest.raises(ValueError, match="is for 11×7 pixels, the depth is 7×11"):
        cloud_from_depth(depth.T.copy(), shade.T, camera, 2)


@pytest.mark.parametrize("reach", [0, 1, 3, 4])
@pytest.mark.parametrize("normal", [(0.3, 0.0, -1.0), (0.0, 0.35, -1.0), (-0.2, 0.45, -1.0)])
def test_normals_of_a_tilted_plane_are_its_own_and_face_the_camera(
    normal: tuple[float, float, float], reach: int
) -> None:
    """Focal lengths and principal point unlike, so that no axis can stand for the other."""
    n = np.array(normal) / np.linalg.norm(normal)
    fx, fy, cx, cy = 500.0, 350.0, 9.5, 31.0
    y, x = np.mgrid[:50, :40].astype(float)
    rays = np.dstack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)])
    depth = (n[2] * 0.7) / (rays @ n)
    camera = SimpleNamespace(width=40, height=50, K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    depth[20:23, 10:14] = np.nan
    points, normals, _ = cloud_from_depth(depth.astype(np.float32), depth, camera, reach)
    # A window of a pixel's own neighbours is whole only inside.
    y, x = np.nonzero(np.isfinite(depth))
    whole = (x > 0) & (x < 39) & (y > 0) & (y < 49)
    whole &= (np.abs(x - 11.5) > 3) | (np.abs(y - 21) > 3)
    inside = normals[whole]
    np.testing.assert_allclose(inside, np.broadcast_to(n, inside.shape), atol=4e-3)
    assert ((points * normals).sum(axis=1) < 0).all()


def test_a_lone_pixel_faces_back_along_the_axis() -> None:
    depth = np.full((9, 12), np.nan, np.float32)
    depth[2, 10] = depth[8, 1] = 0.6
    camera = SimpleNamespace(
        width=12, height=9, K=np.array([[30.0, 0, 4], [0, 20.0, 5], [0, 0, 1]])
    )
    _, normals, _ = cloud_from_depth(depth, depth, camera, 3)
    np.testing.assert_allclose(normals, [[0, 0, -1]] * 2, atol=1e-6)


# -- the stage focus_maps --------------------------------------------------------------------------


def test_the_window_is_whole_periods_or_a_side_in_pixels() -> None:
    parameters = FocusMaps.Parameters(window_periods=3, window_px=11)
    assert window_side_px(Stripes(5.4, 0.0, 1.0), parameters) == pytest.approx(16.2)
    oblique = Stripes(5.4, 30.0, 1.0)
    assert window_side_px(oblique, parameters) == pytest.approx(16.2 / np.cos(np.pi / 6))
    assert window_side_px(None, parameters) == 11


@pytest.mark.parametrize("shape", [(70, 90), (90, 70), (9, 64), (64, 9)])
@pytest.mark.parametrize("subtract", [True, False])
def test_focus_maps_are_taken_over_the_window_with_the_calibrations_noise(
    shape: tuple[int, int], subtract: bool
) -> None:
    """An image narrower than the window has one as wide as itself on that side."""
    rng = np.random.default_rng(0)
    near, far = rng.uniform(20, 200, (2, *shape)).astype(np.float32)
    noise = SensorNoise(9.0, 0.4)
    stripes = Stripes(6.2, 0.0, 1.0)
    inputs = {
        "near": near, "far": far, "stripes": stripes, "calibration": calibration(noise=noise),
    }  # fmt: skip
    parameters = FocusMaps.Parameters(window_periods=2, subtract_noise=subtract)
    out = FocusMaps().compute(inputs, parameters)
    x_taps, y_taps = (whole_period_taps(min(12.4, side)) for side in shape[::-1])
    for image, name in ((near, "focus_near"), (far, "focus_far")):
        wanted = focus_map(image, x_taps, y_taps, "opencv", noise if subtract else None)
        np.testing.assert_array_equal(out[name], wanted)
    assert out["focus_noise"] == noise
    assert out[WARNINGS] == []
    other = FocusMaps().compute(inputs, FocusMaps.Parameters(laplacian="paper"))
    assert "the calibration was made with opencv" in other[WARNINGS][0]
    assert not np.array_equal(other["focus_near"], out["focus_near"])


def measured(near: np.ndarray, far: np.ndarray, **changes: Any) -> dict[str, Any]:
    """Focus maps and depth of two registered images."""
    inputs = given(near=near.astype(np.float32), far=far.astype(np.float32)) | changes
    inputs |= FocusMaps().compute(inputs, FocusMaps.Parameters())
    return run(inputs) | inputs


def test_exposure_does_not_change_the_depth_nor_does_an_offset_the_focus() -> None:
    """Twice or a third of the light in both images; a black level that is not subtracted."""
    stripes = np.sin(2 * np.pi * np.arange(SHAPE[1]) / 5)[None].repeat(SHAPE[0], 0)
    near, far = 100 + 60 * stripes, 100 + 25 * stripes
    base = measured(near, far)
    np.testing.assert_allclose(base["depth_relative"][9:-9, 9:-9], 0.5 - 35 / 85 / 2, atol=3e-3)
    for exposure in (2.0, 1 / 3):
        brighter = measured(exposure * near, exposure * far)
        np.testing.assert_allclose(brighter["focus_near"], exposure * base["focus_near"], rtol=1e-4)
        np.testing.assert_allclose(brighter["depth_relative"], base["depth_relative"], atol=1e-4)
    lifted = measured(near + 40, far + 40)
    for name in ("focus_near", "focus_far"):
        np.testing.assert_allclose(lifted[name], base[name], rtol=1e-3)
    # Less light on one sensor alone is read as blur.
    darker = measured(near, 0.9 * far)
    assert (darker["depth_relative"] < base["depth_relative"] - 0.01)[9:-9, 9:-9].all()


# -- the stage registration ------------------------------------------------------------------------


def scene(shape: tuple[int, int] = SHAPE, top: float = 200.0) -> np.ndarray:
    """Upright stripes of 5 px over a smooth picture, up to ``top`` grey levels."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    smooth = cv2.GaussianBlur(np.random.default_rng(0).random(shape), (0, 0), 3)
    image = (1 + 0.5 * np.sin(2 * np.pi * x / 5)) * (0.2 + smooth) + 0.002 * y
    return top * image / image.max()


def registered(near: np.ndarray, far: np.ndarray, **changes: Any) -> dict[str, Any]:
    inputs = {"near_image": near, "far_image": far, "flat_image": None, "calibration": None}
    parameters = {k: changes.pop(k) for k in list(changes) if k not in inputs}
    return Registration().compute(inputs | changes, Registration.Parameters(**parameters))


@pytest.mark.parametrize(
    ("dtype", "top", "percent", "limit"),
    [(np.uint8, 255, 80.0, 204.0), (np.uint16, 4095, 50.0, 2047.5), (np.uint16, 1023, 100, 1023)],
)
def test_grey_levels_from_the_limit_up_are_saturated_in_either_image(
    dtype: type, top: int, percent: float, limit: float
) -> None:
    near = np.full(SHAPE, int(0.2 * top), dtype)
    far = near.copy()
    near[5, 6], near[5, 9] = int(np.ceil(limit)), int(np.ceil(limit)) - 1
    near[50, 3] = far[50, 3] = 0
    far[20, 30], far[20, 40] = int(np.ceil(limit)), int(np.ceil(limit)) - 1
    near[40, 70] = top if dtype is not np.uint8 else near[40, 70]
    out = registered(near, far, similarity="none", saturation_percent=percent)
    assert out["full_scale"] == top
    wanted = {(5, 6), (20, 30)} | ({(40, 70)} if dtype is not np.uint8 else set())
    assert {tuple(p) for p in np.argwhere(out["saturated"]).tolist()} == wanted


def test_saturation_of_far_is_taken_to_where_near_sees_it() -> None:
    image = scene()
    far = image.astype(np.uint8)
    far[30:33, 40:43] = 255
    shift = Similarity(1.0, 0.0, 4.0, -6.0, SHAPE[1], SHAPE[0])
    out = registered(
        warp_to_near(image.astype(np.float32), shift).clip(0, 254).astype(np.uint8), far,
        calibration=calibration(similarity=shift),
    )  # fmt: skip
    y, x = np.argwhere(out["saturated"]).mean(axis=0)
    # x_far = x_near + 4, y_far = y_near - 6.
    assert (x, y) == pytest.approx((41 - 4, 31 + 6))
    np.testing.assert_allclose(
        out["far"][12:-12, 12:-12],
        warp_to_near(far.astype(np.float32), shift)[12:-12, 12:-12] * out["gain_drift"],
        rtol=1e-5,
    )


def test_saturation_between_two_pixels_spoils_both() -> None:
    """A pixel of far that near sees half a pixel to the left of where it is."""
    image = np.full(SHAPE, 60, np.uint8)
    far = image.copy()
    far[30, 40] = 255
    half = Similarity(1.0, 0.0, 0.5, 0.0, SHAPE[1], SHAPE[0])
    out = registered(image, far, calibration=calibration(similarity=half))
    found = np.argwhere(out["saturated"])
    assert (found[:, 0] == 30).all()
    assert {39, 40} <= set(found[:, 1].tolist()) <= {38, 39, 40, 41}


def test_what_is_not_a_number_carries_no_depth_and_spoils_nothing() -> None:
    near, far = scene().astype(np.float32), scene().astype(np.float32)
    near[10, 20], far[30, 40] = np.nan, np.inf
    out = registered(near, far, similarity="none")
    assert {tuple(p) for p in np.argwhere(out["saturated"]).tolist()} == {(10, 20), (30, 40)}
    assert out["full_scale"] == np.inf
    clean = registered(scene().astype(np.float32), scene().astype(np.float32), similarity="none")
    known = ~out["saturated"]
    for name in ("near", "far"):
        np.testing.assert_array_equal(out[name][known], clean[name][known])
        assert (out[name][~known] <= clean[name][~known]).all()
    # Nor does it upset the balance of light.
    calibrated = registered(near, far, calibration=calibration(full_scale=np.inf))
    assert calibrated["gain_drift"] == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("gain", "told"), [(1.0, False), (1.008, False), (1.02, True), (0.97, True)]
)
@pytest.mark.parametrize("correct", [True, False])
def test_light_that_has_drifted_since_the_calibration_is_told_and_mended(
    gain: float, told: bool, correct: bool
) -> None:
    """The far sensor catches less light than when calibrated, near over far grows."""
    image = scene(top=180).astype(np.float32)
    white = np.array([1.1, 0.05, -0.03, 0, 0, 0])
    made = calibration(gain=white, full_scale=np.inf)
    far = image / made.gain_map / np.float32(gain)
    out = registered(image, far, calibration=made, correct_gain=correct)
    assert out["gain_drift"] == pytest.approx(gain, rel=1e-4)
    wanted = far * (gain if correct else 1)
    np.testing.assert_allclose(out["far"], wanted, rtol=1e-4)
    drifts = [says for says in out[WARNINGS] if "drifted" in says]
    assert bool(drifts) == told
    if told:
        assert f"{100 * (gain - 1):+.1f} %" in drifts[0]
        assert ("(corrected)" if correct else "(not corrected)") in drifts[0]


def test_another_full_scale_than_the_calibrations_is_told() -> None:
    image = scene(top=900).astype(np.uint16)
    seen_more = registered(image, image, calibration=calibration(full_scale=4095.0))
    assert seen_more["full_scale"] == 4095 and seen_more[WARNINGS] == []
    less = registered(image, image, calibration=calibration(full_scale=255.0))
    assert less["full_scale"] == 1023
    assert "full scale of 255, the images have 1023" in less[WARNINGS][0]
    eight = scene().astype(np.uint8)
    other = registered(eight, eight, calibration=calibration(full_scale=4095.0))
    assert other["full_scale"] == 255 and "4095" in other[WARNINGS][0]
    assert registered(eight, eight, calibration=calibration())[WARNINGS] == []


@pytest.mark.parametrize(("dx", "told"), [(0.3, False), (0.8, True)])
def test_images_that_stay_apart_after_registration_are_told(dx: float, told: bool) -> None:
    shape = (120, 160)
    fine = cv2.GaussianBlur(np.random.default_rng(1).random(shape) * 900, (0, 0), 2)
    far = fine.astype(np.float32)
    near = warp_to_near(far, Similarity(1.0, 0.0, dx, 0.0, 160, 120))
    out = registered(near, far, similarity="none")
    assert out["registration_drift_px"] == pytest.approx(dx, rel=0.15)
    assert any("px apart after registration" in says for says in out[WARNINGS]) == told
    pair = registered(near, far, similarity="pair")
    assert pair["registration_drift_px"] < 0.1
    np.testing.assert_allclose(pair["far"][9:-9, 9:-9], near[9:-9, 9:-9], atol=1.5)


@pytest.mark.parametrize("shape", [SHAPE, SHAPE[::-1]])
def test_the_intensity_is_the_flat_image_or_stripes_averaged_out(shape: tuple[int, int]) -> None:
    y, x = np.mgrid[: shape[0], : shape[1]]
    near = (60 * (1 + 0.5 * np.sin(2 * np.pi * x / 5)) + y).astype(np.float32)
    far = (100 * (1 + 0.1 * np.sin(2 * np.pi * x / 5)) + y).astype(np.float32)
    flat = np.full(shape, 77, np.float32)
    given_ = {"calibration": calibration(shape, full_scale=np.inf), "correct_gain": False}
    out = registered(near, far, flat_image=flat, **given_)
    np.testing.assert_array_equal(out["intensity"], flat)
    striped = {"flat_image": flat, "intensity": "stripes"}
    for changes in ({"flat_image": None}, striped, {"flat_image": flat.T}):
        out = registered(near, far, **given_ | changes)
        np.testing.assert_allclose(out["intensity"], 80 + y, rtol=1e-3)
        assert out["stripes"] == Stripes(5.0, 0.0, 1.0)


def test_images_of_unlike_size_and_calibrations_of_another_are_refused() -> None:
    image = scene()
    with pytest.raises(StageError, match="near is 84×60 and far is 60×84"):
        registered(image, image.T)
    with pytest.raises(StageError, match="calibration is for 60×84 pixels, the images are 84×60"):
        registered(image, image, calibration=calibration(SHAPE[::-1]))


# -- light -----------------------------------------------------------------------------------------


def test_gain_terms_run_from_minus_one_to_one_over_the_image() -> None:
    terms = gain_terms(3, 5)
    assert terms.shape == (3, 5, 6)
    y, x = np.mgrid[-1:1:3j, -1:1:5j]
    for k, wanted in enumerate((np.ones_like(x), x, y, x * x, x * y, y * y)):
        np.testing.assert_allclose(terms[..., k], wanted)
    gain = np.array([1.0, 0.1, -0.2, 0.03, 0.04, 0.05])
    made = calibration((3, 5), gain=gain)
    np.testing.assert_allclose(made.gain_map, terms @ gain, rtol=1e-6)


def test_light_is_near_over_far_as_calibrated() -> None:
    near, far = np.full((4, 6), 30, np.float32), np.full((4, 6), 20, np.float32)
    assert light_ratio(near, far) == pytest.approx(1.5)
    weights = np.zeros((4, 6), np.float32)
    weights[:, :3] = 2.5
    assert light_ratio(near, far, weights) == pytest.approx(30 * 24 / (20 * 2.5 * 12))
    assert light_ratio(near, far * 0) == light_ratio(near * 0, far) == 1


def test_a_pairs_gain_is_near_over_far_and_not_turned() -> None:
    """Unlike along x and y, and over a diagonal."""
    shape = (96, 160)
    y, x = np.mgrid[-1 : 1 : shape[0] * 1j, -1 : 1 : shape[1] * 1j]
    truth = np.exp(0.1 + 0.2 * x - 0.1 * y + 0.05 * x * x + 0.04 * x * y - 0.08 * y * y)
    far = scene(shape).astype(np.float32)
    gain = pair_gain((far * truth).astype(np.float32), far, Similarity.identity(160, 96))
    np.testing.assert_allclose(gain, truth, rtol=6e-3)
    assert gain.dtype == np.float32
    # Where far does not reach, nothing is learnt from.
    away = Similarity(1.0, 0.0, 40.0, 0.0, 160, 96)
    spoilt = (far * truth).astype(np.float32)
    spoilt[:, 120:] *= 3
    np.testing.assert_allclose(pair_gain(spoilt, far, away)[:, :110], truth[:, :110], rtol=0.02)
    nothing = pair_gain(far, far * 2, Similarity(1.0, 0.0, 500.0, 0.0, 160, 96))
    np.testing.assert_allclose(nothing, 0.5, rtol=1e-5)


def test_relative_depth_is_linear_in_dioptres() -> None:
    made = calibration()
    z = made.z_m(np.array([0.0, 0.5, 1.0, -0.1]))
    near, far = 1 / 0.7, 1 / 0.8
    np.testing.assert_allclose(1 / z, [near, (near + far) / 2, far, near + 0.1 * (near - far)])
    assert z.dtype == np.float32
    assert np.isnan(made.z_m(np.array([np.nan]))[0])


def test_the_slope_is_the_mean_steepness_of_the_curve_in_the_middle() -> None:
    curve = np.zeros((3, 1, 2), np.float32)
    curve[0], curve[1], curve[2] = 9, [[-0.4, 0.8]], 5
    assert calibration(curve=curve).slope == pytest.approx(0.6)

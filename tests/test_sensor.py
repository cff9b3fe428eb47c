"""The range sensor (section 3): laws of its parts, and all of it on optics it was not made on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from thin_lens import Rig, frame, passes, planes

from workbench.pipeline import Pipeline, Run
from workbench.plugins import find_stages
from workbench.settings import resolve
from workbench_stages.dfd.calibration import Calibration
from workbench_stages.dfd.depth import confidence_from_error
from workbench_stages.dfd.focus import SensorNoise, focus_map, laplacian, noise_gain
from workbench_stages.dfd.procedure import CalibrateParameters, calibrate
from workbench_stages.dfd.similarity import (
    Similarity,
    find_dots,
    fit_similarity,
    match_dots,
    misalignment_rms_px,
    refine_similarity,
    warp_to_near,
)
from workbench_stages.dfd.stripes import average_over_period, measure_stripes, whole_period_taps

RIGS = {
    "the paper's, pitch 50 µm": Rig(),
    "stripes of 8 px, level, 12 bit": Rig(
        period_px=8, angle_deg=90, f_number=4, pitch_mm=0.03, bits=12
    ),
    "stripes of 13.4 px at 30°, short stand-off": Rig(
        focal_mm=35,
        f_number=4,
        pitch_mm=0.02,
        near_focus_mm=300,
        separation_mm=0.6,
        period_px=13.4,
        angle_deg=30,
        size_px=224,
    ),
}


def grating(period: float, angle_deg: float, shape: tuple[int, int] = (160, 200)) -> np.ndarray:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    angle = np.deg2rad(angle_deg)
    across = x * np.cos(angle) - y * np.sin(angle)
    return (100 + 80 * np.sin(2 * np.pi * across / period)).astype(np.float32)


def smooth_noise(shape: tuple[int, int], sigma: float, seed: int = 0) -> np.ndarray:
    import cv2

    noise = np.random.default_rng(seed).normal(size=shape)
    image = cv2.GaussianBlur(noise, (0, 0), sigma)
    return (100 + 40 * image / image.std()).astype(np.float32)


# -- stripes --------------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [3.1, 5.0, 5.37, 8.0, 11.9])
@pytest.mark.parametrize("angle", [-89, -60, -2, 0, 33, 90])
def test_period_and_direction_are_measured(period: float, angle: float) -> None:
    stripes = measure_stripes(grating(period, angle))
    assert stripes is not None
    assert stripes.period_px == pytest.approx(period, rel=0.01)
    turn = (stripes.angle_deg - angle + 90) % 180 - 90
    assert turn == pytest.approx(0, abs=0.5)


@pytest.mark.parametrize("shape", [(120, 200), (161, 145)])
@pytest.mark.parametrize("angle", [0, 1, 40, 90])
def test_stripes_are_as_strong_whichever_way_they_run(angle: float, shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    image = grating(5.3, angle, shape) + 90 * rng.normal(size=shape).astype(np.float32)
    found = [measure_stripes(turned) for turned in (image, np.ascontiguousarray(image.T))]
    assert found[0] is not None and found[1] is not None
    # What lies just at the peak's rim may be counted or not.
    assert found[0].strength == pytest.approx(found[1].strength, rel=0.01)
    assert found[0].period_px == pytest.approx(found[1].period_px, rel=1e-3)


@pytest.mark.parametrize("seed", range(4))
def test_texture_without_a_period_is_not_stripes(seed: int) -> None:
    assert measure_stripes(smooth_noise((200, 240), 2.0, seed)) is None


@pytest.mark.parametrize("image", [np.zeros((64, 64)), np.full((64, 64), 7.0), np.ones((1, 90))])
def test_a_bare_image_has_no_stripes(image: np.ndarray) -> None:
    assert measure_stripes(image) is None


@pytest.mark.parametrize("width", [1, 2.5, 3, 5, 5.37, 10])
def test_window_weights_sum_to_one_and_are_symmetric(width: float) -> None:
    taps = whole_period_taps(width)
    assert taps.sum() == pytest.approx(1, abs=1e-6)
    assert np.array_equal(taps, taps[::-1])
    assert len(taps) % 2 == 1


@pytest.mark.parametrize("period", [5.0, 5.4, 7.0])
@pytest.mark.parametrize("angle", [0, 20, 90])
def test_averaging_over_a_period_removes_the_stripes(period: float, angle: float) -> None:
    image = grating(period, angle)
    inner = (slice(16, -16), slice(16, -16))
    rest = average_over_period(image, measure_stripes(image))[inner]
    assert rest.std() < 0.03 * image[inner].std()


# -- the focus measure ----------------------------------------------------------------------------


def test_focus_is_even_over_the_image_only_over_whole_periods() -> None:
    def ripple(width: float) -> float:
        taps = whole_period_taps(width)
        focus = focus_map(grating(5, 0), taps, taps)[20:-20, 20:-20]
        return float(focus.std() / focus.mean())

    assert ripple(5) < 0.005
    assert ripple(10) < 0.005
    assert ripple(6.2) > 5 * ripple(5)


@pytest.mark.parametrize("kind", ["opencv", "paper"])
def test_laplacian_ignores_ramps_and_sees_its_own_noise(kind: str) -> None:
    y, x = np.mgrid[0:40, 0:40].astype(np.float32)
    assert np.abs(laplacian(3 * x - 2 * y, kind)[4:-4, 4:-4]).max() < 1e-3
    noise = np.random.default_rng(0).normal(size=(400, 400)).astype(np.float32)
    assert laplacian(noise, kind).var() == pytest.approx(noise_gain(kind), rel=0.05)


def test_the_energy_of_noise_is_subtracted() -> None:
    taps = whole_period_taps(15)
    rng = np.random.default_rng(1)
    noisy = (100 + 2 * rng.normal(size=(300, 300))).astype(np.float32)
    plain = focus_map(noisy, taps, taps)
    cleaned = focus_map(noisy, taps, taps, noise=SensorNoise(4.0, 0.0))
    assert np.median(cleaned**2) < 0.1 * np.median(plain**2)


# -- registration ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "true",
    [
        Similarity(0.988, 0.0, 0.0, 0.0, 200, 160),
        Similarity(1.006, 0.4, -1.3, 0.7, 200, 160),
    ],
)
def test_the_similarity_between_two_images_is_recovered(true: Similarity) -> None:
    far = smooth_noise((160, 200), 2.5)
    near = warp_to_near(far, true)
    found = refine_similarity([(near, far)], Similarity.identity(200, 160))
    corners = np.array([[0, 0, 1], [199, 0, 1], [0, 159, 1], [199, 159, 1]], float).T
    assert np.abs(found.far_from_near @ corners - true.far_from_near @ corners).max() < 0.1
    assert misalignment_rms_px(near, far) > 0.3
    assert misalignment_rms_px(near, warp_to_near(far, found)) < 0.05


def test_dot_grids_give_the_similarity() -> None:
    true = Similarity(0.9876, 0.3, 0.8, -0.4, 240, 240)
    y, x = np.mgrid[0:240, 0:240].astype(float)

    def dots(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        squared = ((x % 16) - 8) ** 2 + ((y % 16) - 8) ** 2
        return (30 + 150 * np.exp(-squared / (2 * 2.2**2))).astype(np.float32)

    near = dots(x, y)
    inverse = np.linalg.inv(np.vstack([true.far_from_near, [0, 0, 1]]))
    back = np.tensordot(inverse, np.stack([x, y, np.ones_like(x)]), axes=1)
    far = dots(back[0], back[1])
    fit = fit_similarity(*match_dots(find_dots(near), find_dots(far)), 240, 240)
    assert fit.points > 100
    assert fit.residual_rms_px < 0.1 < fit.before_rms_px
    assert fit.similarity.scale == pytest.approx(true.scale, abs=3e-4)


def test_too_few_dots_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 4 matched points"):
        fit_similarity(np.zeros((2, 2)), np.zeros((2, 2)), 64, 64)


def test_an_identity_passes_the_image_through() -> None:
    image = smooth_noise((40, 50), 1.0)
    assert warp_to_near(image, Similarity.identity(50, 40)) is image


# -- the whole sensor -----------------------------------------------------------------------------


def calibrated(rig: Rig, tmp_path: Path) -> tuple[Path, Calibration]:
    distances = np.linspace(rig.near_focus_mm * 0.997, rig.far_focus_mm * 1.003, 17)
    made = calibrate(
        passes(planes(rig, distances)),
        {"u1": str(rig.near_focus_mm), "u2": str(rig.far_focus_mm)},
        CalibrateParameters(),
    )
    path = tmp_path / "calibration.npz"
    made.save(path)
    return path, made


def run(
    rig: Rig, calibration: Path | None, z_mm: float, *assignments: str, **changes: float
) -> Run:
    stages = find_stages()
    settings = resolve(stages, assignments=assignments)
    resources = {} if calibration is None else {"calibration": calibration}
    pipeline = Pipeline(stages, settings, resources, until="depth_cloud")
    result = pipeline.run(frame(rig.with_(**changes), 0, z_mm, np.random.default_rng(99)))
    assert not result.failures
    return result


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_planes_between_the_calibrated_ones_are_measured(rig: Rig, tmp_path: Path) -> None:
    path, made = calibrated(rig, tmp_path)
    assert made.report["stripe_period_px"] == pytest.approx(rig.period_px, rel=0.01)
    assert made.near_z_m == pytest.approx(rig.near_focus_mm / 1e3, rel=1e-6)
    span_mm = 1e3 * (made.far_z_m - made.near_z_m)
    for share in (0.13, 0.5, 0.82):
        z_mm = 1e3 * made.near_z_m + share * span_mm
        depth_m = run(rig, path, z_mm).artifacts["depth_m"]
        inner = depth_m[24:-24, 24:-24]
        assert np.isfinite(inner).mean() > 0.99
        assert np.sqrt(np.nanmean((1e3 * inner - z_mm) ** 2)) < 0.012 * span_mm


def test_beyond_the_focal_planes_no_wrong_depth_is_given(tmp_path: Path) -> None:
    rig = Rig()
    path, _ = calibrated(rig, tmp_path)
    for z_mm in (0.93 * rig.near_focus_mm, 1.07 * rig.far_focus_mm):
        depth_m = run(rig, path, z_mm).artifacts["depth_m"]
        assert np.isfinite(depth_m).mean() < 0.02


def test_light_drift_between_the_sensors_is_found_and_corrected(tmp_path: Path) -> None:
    rig = Rig()
    path, _ = calibrated(rig, tmp_path)
    drifted = run(rig, path, 750.0, far_gain=0.9)
    assert drifted.artifacts["gain_drift"] == pytest.approx(1 / 0.9, rel=0.01)
    assert any("drifted" in says for says in drifted.warnings)
    middle = drifted.artifacts["depth_m"][40:-40, 40:-40]
    assert np.nanmedian(1e3 * middle) == pytest.approx(750, abs=0.5)
    uncorrected = run(rig, path, 750.0, "registration.correct_gain=false", far_gain=0.9)
    assert abs(np.nanmedian(1e3 * uncorrected.artifacts["depth_m"][40:-40, 40:-40]) - 750) > 1.5


def test_saturated_and_dark_surfaces_have_no_depth(tmp_path: Path) -> None:
    rig = Rig()
    path, _ = calibrated(rig, tmp_path)
    stages = find_stages()
    pipeline = Pipeline(stages, resolve(stages), {"calibration": path}, until="depth_cloud")
    rng = np.random.default_rng(5)
    for albedo in (1.4, 0.002):
        bright = frame(rig, 0, 750.0, rng)
        images = {
            name: rig.image(sensor, 750.0, rng, albedo)
            for sensor, name in enumerate(("near", "far"))
        }
        object.__setattr__(bright, "images", images)
        object.__setattr__(bright, "digest", str(albedo))
        result = pipeline.run(bright)
        assert np.isfinite(result.artifacts["depth_m"]).mean() < 0.02
        assert np.isfinite(result.artifacts["confidence"]).all()


def test_without_a_calibration_depth_is_relative_and_says_so() -> None:
    rig = Rig()
    near, far = (run(rig, None, z).artifacts for z in (715.0, 790.0))
    assert np.isnan(near["depth_m"]).all()
    assert np.nanmedian(near["depth_relative"]) < 0.4 < 0.6 < np.nanmedian(far["depth_relative"])
    assert len(near["cloud_xyz_m"]) == 0
    assert any("relative" in says for says in run(rig, None, 715.0).warnings)


def test_the_cloud_is_the_depth_in_space(tmp_path: Path) -> None:
    rig = Rig()
    path, _ = calibrated(rig, tmp_path)
    result = run(rig, path, 760.0)
    depth_m, points = result.artifacts["depth_m"], result.artifacts["cloud_xyz_m"]
    known = np.isfinite(depth_m)
    assert points.shape == (known.sum(), 3)
    np.testing.assert_allclose(points[:, 2], depth_m[known], rtol=1e-6)
    matrix = result.frame.cameras["near"].K
    rows, columns = np.nonzero(known)
    np.testing.assert_allclose(
        points[:, 0] / points[:, 2], (columns - matrix[0, 2]) / matrix[0, 0], atol=1e-6
    )
    np.testing.assert_allclose(
        points[:, 1] / points[:, 2], (rows - matrix[1, 2]) / matrix[1, 1], atol=1e-6
    )
    normals = result.artifacts["cloud_normals"]
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
    assert (normals[:, 2] < 0).mean() > 0.99


def test_confidence_falls_with_the_error_and_is_bounded() -> None:
    error = np.array([0, 1, 3.2, 10, np.inf], np.float32)
    confidence = confidence_from_error(error, 3.2)
    assert confidence[0] == 1
    assert confidence[2] == pytest.approx(0.5)
    assert confidence[-1] == 0
    assert (np.diff(confidence) < 0).all()


# -- the calibration's file -----------------------------------------------------------------------


def test_a_calibration_comes_back_from_its_file(tmp_path: Path) -> None:
    path, made = calibrated(Rig(), tmp_path)
    back = Calibration.load(path)
    np.testing.assert_array_equal(back.curve, made.curve)
    np.testing.assert_array_equal(back.gain_map, made.gain_map)
    assert (back.similarity, back.stripes, back.noise) == (
        made.similarity,
        made.stripes,
        made.noise,
    )
    assert back.report == made.report
    again = tmp_path / "again.npz"
    back.save(again)
    assert again.read_bytes() == path.read_bytes()


def test_calibrating_without_planes_is_refused() -> None:
    rig = Rig()
    with pytest.raises(ValueError, match="no frame with both"):
        calibrate(passes([]), {}, CalibrateParameters())
    few = planes(rig, np.array([710.0, 750.0, 790.0]))
    with pytest.raises(ValueError, match="expected planes at 5 distances or more, found 3"):
        calibrate(passes(few), {}, CalibrateParameters())

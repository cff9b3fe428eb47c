"""What calibrating reports is measured as it says: held out, worst, of span, of stand-off."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from thin_lens import Rig, passes, planes

from workbench.recording import Frame
from workbench_stages.dfd import procedure
from workbench_stages.dfd.calibration import (
    FORMAT,
    Calibration,
    gain_terms,
    light_ratio,
    pair_gain,
)
from workbench_stages.dfd.focus import SensorNoise
from workbench_stages.dfd.procedure import (
    CalibrateParameters,
    _fit_residuals,
    _held_out,
    _linearity,
    _NormalEquations,
    _Patch,
    _PhotonTransfer,
    _Plane,
    _working_range,
    calibrate,
)
from workbench_stages.dfd.similarity import Similarity
from workbench_stages.dfd.stripes import Stripes

# -- planes held back -----------------------------------------------------------------------------

DISTANCES = (0.70, 0.71, 0.73, 0.74, 0.76, 0.78, 0.80)


def relative(z_m: float) -> float:
    return (1 / z_m - 1 / 0.70) / (1 / 0.80 - 1 / 0.70)


def cubic(t: float) -> float:
    """The ratio of a surface at relative depth t, whose inverse is no polynomial."""
    return 0.8 - 1.5 * t - 0.1 * t**2 + 0.1 * t**3


def patch(z_m: float, off: float = 0.0, shape: tuple[int, int] = (6, 8), seed: int = 0) -> _Patch:
    """A plane whose truth is ``off`` from where its ratio says; its pixels differ a little."""
    noise = 0.01 * np.random.default_rng(seed).normal(size=shape)
    ratio = (cubic(relative(z_m)) + noise).astype(np.float32)
    return _Patch(z_m, ratio, np.full(shape, relative(z_m) + off, np.float32))


def fitted_without(patches: list[_Patch], z_m: float, degree: int, side: int) -> np.ndarray:
    """A polynomial for each pixel through the planes at other distances [degree + 1 H W]."""
    others = [p for p in patches if p.z_m != z_m]
    ratio = np.array([cv2.blur(p.ratio, (side, side), borderType=4) for p in others])
    target = np.array([p.target for p in others])
    height, width = ratio.shape[1:]
    return np.array(
        [
            [np.polyfit(ratio[:, y, x], target[:, y, x], degree)[::-1] for x in range(width)]
            for y in range(height)
        ]
    ).transpose(2, 0, 1)


@pytest.mark.parametrize(("degree", "side"), [(2, 1), (3, 3), (4, 1)])
def test_held_out_errors_are_of_planes_that_the_curve_has_not_seen(degree: int, side: int) -> None:
    """Each distance but the first and the last is left out with all its shots, in turn."""
    off = (0.3, 0, 0.02, 0, -0.03, 0, -0.4)  # the ends are far off, and are not asked for
    patches = [
        patch(z, o, seed=10 * k + shot)
        for k, (z, o) in enumerate(zip(DISTANCES, off, strict=True))
        for shot in range(1 + k % 2)
    ]
    errors = []
    for z_m in DISTANCES[1:-1]:
        curve = fitted_without(patches, z_m, degree, side)
        for one in patches:
            if one.z_m == z_m:
                value = sum(c * one.ratio.astype(float) ** k for k, c in enumerate(curve))
                errors.append(value - one.target)
    rms, worst = _held_out(patches, degree, side)
    assert rms == pytest.approx(float(np.sqrt(np.mean(np.square(errors)))), rel=1e-3)
    assert worst == pytest.approx(float(np.abs(errors).max()), rel=1e-3)


def test_a_plane_that_is_off_by_itself_is_wholly_off_where_it_is_held_out() -> None:
    """Fitted with it, the curve would have gone to meet it."""
    law = [_Patch(z, np.full((4, 4), 1 - 2 * relative(z), np.float32),
                  np.full((4, 4), relative(z), np.float32)) for z in DISTANCES]  # fmt: skip
    rms, worst = _held_out(law, 1, 1)
    assert rms == pytest.approx(0, abs=1e-6) and worst == pytest.approx(0, abs=1e-6)
    law[3] = replace(law[3], target=law[3].target - np.float32(0.05))
    rms, worst = _held_out(law, 1, 1)
    assert worst == pytest.approx(0.05, abs=1e-6)
    assert worst / 5**0.5 < rms < worst


def calibration_of(curve: np.ndarray, **other: Any) -> Calibration:
    height, width = curve.shape[1:]
    made = Calibration(
        Similarity.identity(width, height), Stripes(5.0, 0.0, 1.0), "opencv",
        curve.astype(np.float32), 0.70, 0.80, np.array([0.2, 0.1], np.float32),
        SensorNoise(0.5, 0.01), np.array([1.0, 0, 0, 0, 0, 0]), 255.0,
    )  # fmt: skip
    return replace(made, **other)


def test_residuals_of_the_fit_are_in_millimetres_in_the_middle() -> None:
    """The curve of the middle 32×32 pixels, whatever the others have."""
    curve = np.full((2, 50, 60), 9.0)
    curve[:, 9:41, 14:46] = np.array([0.5, -0.5])[:, None, None]
    made = calibration_of(curve)
    patches = []
    for z_m, off_mm in ((0.72, 1.0), (0.77, -3.0)):
        right = np.full((32, 32), 1 - 2 * relative(z_m), np.float32)
        patches.append(_Patch(z_m, right, np.full((32, 32), relative(z_m + off_mm / 1e3))))
    rms, worst = _fit_residuals(patches, made)
    assert worst == pytest.approx(3, rel=1e-3)
    assert rms == pytest.approx(5**0.5, rel=1e-3)


def test_linearity_is_the_greatest_departure_from_a_line_in_percent_of_the_span() -> None:
    def planes_at(ratios: tuple[float, ...]) -> list[_Plane]:
        return [_Plane(k, 1 / (1.4 - 0.1 * k), ratio) for k, ratio in enumerate(ratios)]

    assert _linearity(planes_at((0.5, 0.0, -0.5, -1.0))) == pytest.approx(0, abs=1e-9)
    # The line through 0, 1, 0 is one third high; through 0, 4, 0 four thirds.
    assert _linearity(planes_at((0.0, 1.0, 0.0))) == pytest.approx(200 / 3)
    assert _linearity(planes_at((0.0, -4.0, 0.0))) == pytest.approx(200 / 3)


def test_every_pixel_has_the_polynomial_of_its_own_points() -> None:
    rng = np.random.default_rng(0)
    ratio = rng.uniform(-1, 1, (9, 3, 4))
    target = rng.uniform(0, 1, (9, 3, 4))
    normal = _NormalEquations(3)
    for a, b in zip(ratio, target, strict=True):
        normal.add(a, b)
    for degree in (None, 3, 2, 1):
        found = normal.solve(degree)
        taken = 3 if degree is None else degree
        assert found.shape == (taken + 1, 3, 4) and found.dtype == np.float32
        for y, x in np.ndindex(3, 4):
            wanted = np.polyfit(ratio[:, y, x], target[:, y, x], taken)[::-1]
            np.testing.assert_allclose(found[:, y, x], wanted, rtol=1e-4, atol=1e-5)


# -- the report of a whole calibration ------------------------------------------------------------

QUIET = Rig(size_px=96, full_well=1e7, read_noise=0.02, bits=12)
SPAN_MM = QUIET.far_focus_mm - QUIET.near_focus_mm
FOCAL = {"u1": str(QUIET.near_focus_mm), "u2": str(QUIET.far_focus_mm)}


def told(rig: Rig, off_mm: float = 0.0, shots: int = 1, **parameters: Any) -> dict[str, Any]:
    """The report on planes of which the sixth distance is recorded wrongly by so much."""
    distances = np.linspace(rig.near_focus_mm + 1, rig.far_focus_mm - 1, 11)
    frames = planes(rig, distances, shots)
    for one in frames:
        if one.truth is not None and one.truth.meta["z"] == distances[5]:
            depth_m = one.truth.depth_m + np.float32(off_mm / 1e3)
            object.__setattr__(one, "truth", replace(one.truth, depth_m=depth_m))
    return calibrate(passes(frames), FOCAL, CalibrateParameters(**parameters)).report


@pytest.fixture(scope="module")
def quiet() -> dict[str, Any]:
    return told(QUIET, shots=2)


@pytest.fixture(scope="module")
def misplaced() -> dict[str, Any]:
    return told(QUIET, 4.0, degree=3)


def test_a_plane_that_is_recorded_wrongly_is_held_out_as_wrong_as_it_is(
    quiet: dict[str, Any], misplaced: dict[str, Any]
) -> None:
    """In millimetres; the fit, which has seen it, went some of the way."""
    assert misplaced["held_out_worst_mm"] == pytest.approx(4, rel=0.1)
    assert 2 < misplaced["fit_worst_mm"] < 3.5
    assert quiet["held_out_worst_mm"] < 0.5
    for one in (quiet, misplaced):
        assert one["fit_rms_mm"] < one["fit_worst_mm"]
        assert one["held_out_rms_mm"] < one["held_out_worst_mm"]
        assert one["fit_rms_mm"] < one["held_out_rms_mm"]
    # The square of its own error, a ninth of all that are held out, and what it spoils elsewhere.
    assert 4 / 3 < misplaced["held_out_rms_mm"] < 2


def test_percentages_are_of_the_span_and_of_the_stand_off(misplaced: dict[str, Any]) -> None:
    near_mm, far_mm = misplaced["working_range_mm"]
    assert (near_mm, far_mm) == pytest.approx((701, QUIET.far_focus_mm - 1), abs=0.006)
    worst = misplaced["held_out_worst_mm"]
    of_span = misplaced["held_out_worst_percent_of_span"]
    of_stand_off = misplaced["held_out_worst_percent_of_stand_off"]
    assert of_span == pytest.approx(100 * worst / (far_mm - near_mm))
    assert of_stand_off == pytest.approx(100 * worst / ((near_mm + far_mm) / 2))


def test_a_report_counts_its_planes(quiet: dict[str, Any]) -> None:
    assert (quiet["planes"], quiet["planes_used"], quiet["distances"]) == (22, 22, 11)
    assert quiet["working_range_from"] == "steady part of the ratio over the planes"
    assert quiet["stripe_period_px"] == pytest.approx(5, rel=0.01)
    assert quiet["gain_near_over_far"] == pytest.approx(1, abs=1e-3)
    assert quiet["full_scale"] == 4095
    assert quiet["noise_source"] == "repeated shots of planes"
    # The blur by a disc is nearly linear in 1/z: by less than a tenth of the ratio's span.
    assert 0 < quiet["linearity_percent_of_span"] < 10


@pytest.mark.parametrize(
    ("held_out", "degree"),
    [
        ({3: 0.0102, 4: 0.010, 5: 0.010, 6: 0.010}, 3),
        ({3: 0.0104, 4: 0.0102, 5: 0.010, 6: 0.010}, 4),
        ({3: 0.02, 4: 0.0104, 5: 0.0104, 6: 0.010}, 6),
        ({3: 0.03, 4: 0.01, 5: 0.02, 6: 0.04}, 4),
    ],
)
def test_the_lowest_degree_that_is_as_good_on_unseen_planes_is_taken(
    held_out: dict[int, float], degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def told_for(patches: list[_Patch], tried: int, side: int) -> tuple[float, float]:
        assert side == 9 and {p.ratio.shape for p in patches} == {(32, 32)}
        return held_out[tried], 2 * held_out[tried]

    monkeypatch.setattr(procedure, "_held_out", told_for)
    report = told(QUIET)
    assert report["degree"] == degree
    near_mm, far_mm = report["working_range_mm"]
    assert report["held_out_rms_mm"] == pytest.approx(held_out[degree] * (far_mm - near_mm))
    assert report["held_out_worst_mm"] == pytest.approx(2 * held_out[degree] * (far_mm - near_mm))


def test_a_degree_that_is_asked_for_is_taken_unless_the_planes_are_too_few() -> None:
    report = told(QUIET, degree=4)
    assert report["degree"] == 4
    frames = planes(QUIET, np.linspace(QUIET.near_focus_mm + 1, QUIET.far_focus_mm - 1, 5))
    assert calibrate(passes(frames), FOCAL, CalibrateParameters(degree=6)).report["degree"] == 3


def test_planes_beyond_the_range_are_counted_and_not_used() -> None:
    """A plane up to a fiftieth of the range beyond it still tells of its end."""
    beyond = np.array([0.019, 0.021, -0.5])
    distances = np.concatenate(
        [
            np.linspace(QUIET.near_focus_mm, QUIET.far_focus_mm, 8),
            QUIET.far_focus_mm + beyond[:2] * SPAN_MM,
            QUIET.near_focus_mm + beyond[2:] * SPAN_MM,
        ]
    )
    made = calibrate(passes(planes(QUIET, distances, 1)), FOCAL, CalibrateParameters())
    assert (made.near_z_m, made.far_z_m) == pytest.approx(
        (QUIET.near_focus_mm / 1e3, QUIET.far_focus_mm / 1e3), abs=1e-6
    )
    assert (made.report["planes"], made.report["planes_used"]) == (11, 9)
    assert made.report["working_range_from"].endswith(", within the rig's focal planes")


# -- the working range ----------------------------------------------------------------------------


def range_of(
    ratios: dict[float, float], rig: dict[str, str] | None = None
) -> tuple[float, float, str]:
    planes_ = [_Plane(k, z / 1e3, ratio) for k, (z, ratio) in enumerate(ratios.items())]
    return _working_range(planes_, rig or {})


FALLING = {700.0 + 10 * k: 0.8 - 0.2 * k for k in range(9)}


def test_the_range_is_the_longest_run_over_which_the_ratio_falls_steadily() -> None:
    note = "steady part of the ratio over the planes"
    assert range_of(FALLING) == (0.70, 0.78, note)
    folded = FALLING | {680.0: 0.5, 690.0: 0.65, 790.0: -0.7, 800.0: -0.5}
    assert range_of(folded) == (0.70, 0.78, note)
    # What falls by less than about a seventh of the usual slope is not steady; the other way
    # round, and in any order, it is the same range.
    flat = FALLING | {790.0: -0.8 - 0.2 / 8}
    assert range_of(flat) == (0.70, 0.78, note)
    less_flat = FALLING | {790.0: -0.8 - 0.2 / 5}
    assert range_of(less_flat) == (0.70, 0.79, note)
    rising = {z: -ratio for z, ratio in reversed(folded.items())}
    assert range_of(rising) == (0.70, 0.78, note)
    # Of two runs the longer.
    two = {650.0 + 10 * k: 0.5 - 0.2 * k for k in range(4)} | FALLING
    assert range_of(two) == (0.70, 0.78, note)


@pytest.mark.parametrize(
    ("u1", "u2", "low", "high", "clipped"),
    [
        ("700", "780", 0.70, 0.78, False),
        ("690", "790", 0.70, 0.78, False),
        ("705", "790", 0.705, 0.78, True),
        ("690", "775", 0.70, 0.775, True),
        ("775", "705", 0.705, 0.775, True),
        ("far", "775", 0.70, 0.78, False),
    ],
)
def test_the_range_ends_at_the_rigs_focal_planes(
    u1: str, u2: str, low: float, high: float, clipped: bool
) -> None:
    found = range_of(FALLING, {"u1": u1, "u2": u2})
    assert found[:2] == pytest.approx((low, high))
    assert ("within the rig's focal planes" in found[2]) == clipped


def test_shots_of_one_distance_are_one_point_and_too_few_are_refused() -> None:
    shots = [_Plane(k, 0.7 + 0.01 * (k // 2), 0.8 - 0.2 * (k // 2)) for k in range(10)]
    assert _working_range(shots, {})[:2] == pytest.approx((0.70, 0.74))
    with pytest.raises(ValueError, match="planes of known distance or more, found 4"):
        _working_range(shots[:4], {})
    with pytest.raises(ValueError, match="planes at 5 distances or more, found 4"):
        _working_range(shots[:8], {})


# -- light and noise ------------------------------------------------------------------------------


def test_shot_and_read_noise_are_those_of_the_sensor() -> None:
    """Two shots of one plane differ by √2 of what one scatters by."""
    rig = Rig(size_px=128, full_well=4000.0, read_noise=2.0)
    for shots, source in ((2, "repeated shots"), (1, "single shots of planes, along the stripes")):
        frames = planes(rig, np.linspace(705, 800, 8), shots)
        noise, told_source = procedure._noise(passes(frames), Stripes(5.0, 0.0, 1.0))
        assert source in told_source
        assert noise.gain == pytest.approx(255 / 4000, rel=0.04)
        assert noise.read_variance == pytest.approx(4 + 1 / 12, rel=0.12)


def test_noise_along_level_stripes_is_measured_along_them() -> None:
    rig = Rig(size_px=128, full_well=4000.0, read_noise=2.0, angle_deg=90)
    frames = planes(rig, np.linspace(705, 800, 8), 1)
    noise, _ = procedure._noise(passes(frames), Stripes(5.0, 90.0, 1.0))
    assert noise.gain == pytest.approx(255 / 4000, rel=0.04)


def test_images_that_show_too_little_have_the_noise_of_quantisation() -> None:
    frames = planes(Rig(size_px=16), np.linspace(705, 800, 2), 1)
    noise, source = procedure._noise(passes(frames), Stripes(5.0, 0.0, 1.0))
    assert noise == SensorNoise() == SensorNoise(1 / 12, 0)
    assert source == "quantisation only: too few pixels"


def test_variance_over_level_is_fitted_as_read_and_shot_noise() -> None:
    transfer = _PhotonTransfer()
    level = np.repeat(np.arange(5.0, 250, 5), 300)
    transfer.add(np.zeros((2, 2), np.uint8), level, 3 + 0.2 * level)
    noise = transfer.fit(2)
    assert noise is not None
    assert (noise.read_variance, noise.gain) == pytest.approx((3, 0.2), rel=1e-6)
    # A fixed pattern grows with the square, and is left out by a third term.
    transfer = _PhotonTransfer()
    transfer.add(np.zeros((2, 2), np.uint8), level, 3 + 0.2 * level + 1e-3 * level**2)
    noise = transfer.fit(3)
    assert noise is not None
    assert (noise.read_variance, noise.gain) == pytest.approx((3, 0.2), rel=0.02)
    # Quantisation is the least there is.
    transfer = _PhotonTransfer()
    transfer.add(np.zeros((2, 2), np.uint8), level, 0 * level + 0.01)
    noise = transfer.fit(2)
    assert noise is not None and noise.read_variance == 1 / 12


def test_saturated_and_black_pixels_say_nothing_of_noise() -> None:
    transfer = _PhotonTransfer()
    level = np.repeat(np.arange(5.0, 240, 5), 300)
    ends = np.repeat([0.0, 243.0, 255.0], 5000)
    both = np.concatenate([level, ends])
    squared = np.concatenate([3 + 0.2 * level, np.full(15000, 1e4)])
    transfer.add(np.zeros((2, 2), np.uint8), both, squared)
    noise = transfer.fit(2)
    assert noise is not None
    assert (noise.read_variance, noise.gain) == pytest.approx((3, 0.2), rel=1e-6)


def test_the_light_ratio_is_near_over_far_as_calibrated() -> None:
    near, far = np.full((8, 10), 90, np.float32), np.full((8, 10), 100, np.float32)
    assert light_ratio(near, far) == pytest.approx(0.9)
    assert light_ratio(far, near) == pytest.approx(1 / 0.9)
    gain = np.linspace(0.8, 1.0, 10, dtype=np.float32)[None].repeat(8, 0)
    assert light_ratio(near, far, gain) == pytest.approx(1.0)
    for dark in ((near * 0, far), (near, far * 0)):
        assert light_ratio(*dark) == 1


GAIN = (1.1, 0.2, -0.05, 0.03, 0.02, -0.04)


def test_gain_is_a_quadratic_from_the_left_and_top_to_the_right_and_bottom() -> None:
    terms = gain_terms(3, 5)
    assert terms.shape == (3, 5, 6)
    assert terms[0, 4].tolist() == [1, 1, -1, 1, -1, 1]
    assert terms[1, 1].tolist() == [1, -0.5, 0, 0.25, 0, 0]
    made = calibration_of(np.zeros((2, 4, 6)), gain=np.array(GAIN))
    corner = 1.1 + 0.2 + 0.05 + 0.03 - 0.02 - 0.04  # upper right
    assert made.gain_map[0, -1] == pytest.approx(corner)
    assert made.gain_map.shape == (4, 6) and made.gain_map.dtype == np.float32


def test_calibrating_finds_how_much_brighter_near_is_all_over_the_image() -> None:
    gain_map = (gain_terms(96, 96) @ np.array(GAIN)).astype(np.float64)
    rng = np.random.default_rng(0)
    frames = []
    for one, drift in zip(
        planes(QUIET, np.linspace(705, 800, 4), 1), (1, 1.02, 1, 0.98), strict=True
    ):
        far = np.clip(100 + 20 * rng.random((96, 96)), 0, None)
        images = {
            "near": (far * gain_map * drift).astype(np.float32),
            "far": far.astype(np.float32),
        }
        frames.append(replace(one, images=images))
    gain, found, spread = procedure._gain(passes(frames), Similarity.identity(96, 96))
    np.testing.assert_allclose(gain, GAIN, atol=3e-3)
    np.testing.assert_allclose(found, gain_map, rtol=6e-3)
    assert spread == pytest.approx(100 * float(np.std([1, 1.02, 1, 0.98])), rel=0.02)


def test_the_gain_of_one_pair_is_near_over_far_at_every_pixel() -> None:
    y, x = np.mgrid[0:128, 0:160]
    u, v = 2 * x / 159 - 1, 2 * y / 127 - 1
    log_gain = 0.1 + 0.2 * u - 0.1 * v + 0.05 * u * u + 0.03 * u * v - 0.04 * v * v
    far = (100 + 30 * np.sin(x / 9) * np.sin(y / 7)).astype(np.float32)
    near = (far * np.exp(log_gain)).astype(np.float32)
    alike = Similarity.identity(160, 128)
    np.testing.assert_allclose(pair_gain(near, far, alike), np.exp(log_gain), rtol=3e-3)
    # A bright spot in one of them alone, and cells that the far image does not show, change little.
    near[40:50, 60:70] *= 2
    np.testing.assert_allclose(pair_gain(near, far, alike), np.exp(log_gain), rtol=0.02)
    dark = pair_gain(near * 0, far, alike)
    assert dark.shape == (128, 160) and (dark == 1).all()


def test_the_full_scale_holds_every_plane() -> None:
    def planes_of(*tops: float, dtype: Any) -> Any:
        frames = planes(QUIET, np.linspace(705, 800, len(tops)), 1)
        images = [np.full((96, 96), top, dtype) for top in tops]
        return passes(
            [replace(f, images={"near": i, "far": i}) for f, i in zip(frames, images, strict=True)]
        )

    assert procedure._full_scale(planes_of(100, 200, dtype=np.uint8)) == 255
    assert procedure._full_scale(planes_of(900, 3000, 1000, dtype=np.uint16)) == 4095
    assert procedure._full_scale(planes_of(0.5, 0.75, 0.25, dtype=np.float32)) == 0.75


# -- which frames are planes ----------------------------------------------------------------------


def one_frame(depth_m: Any, **meta: Any) -> Any:
    return SimpleNamespace(
        images={"near": np.zeros((64, 96), np.uint8)},
        truth=SimpleNamespace(depth_m=depth_m, meta=meta),
    )


def test_a_plane_is_known_by_its_depth_or_by_z_in_millimetres() -> None:
    y, x = np.mgrid[0:64, 0:96]
    tilted = 1 / (1.3 + 1e-4 * x - 2e-4 * y)
    found = procedure._plane_depth(one_frame(tilted))
    assert found is not None
    np.testing.assert_array_equal(found, tilted)
    found = procedure._plane_depth(one_frame(None, z=735.0))
    assert found is not None and found.shape == (64, 96) and (found == 0.735).all()
    assert procedure._plane_depth(one_frame(None, z=735, kind="plane")) is not None


@pytest.mark.parametrize(("rms_mm", "plane"), [(0.49, True), (0.51, False)])
def test_depth_that_departs_by_half_a_millimetre_is_no_plane(rms_mm: float, plane: bool) -> None:
    cells = 1 - 2 * (np.indices((8, 12)).sum(0) % 2)
    depth_m = 0.75 + rms_mm / 1e3 * np.kron(cells, np.ones((8, 8)))
    assert (procedure._plane_depth(one_frame(depth_m)) is not None) == plane


@pytest.mark.parametrize(
    "frame",
    [
        SimpleNamespace(images={"near": np.zeros((64, 96))}, truth=None),
        one_frame(None),
        one_frame(None, z="735"),
        one_frame(None, z=735.0, kind="grid"),
        one_frame(np.full((64, 95), 0.75)),
        one_frame(np.where(np.eye(64, 96), np.nan, 0.75)),
        one_frame(np.where(np.eye(64, 96), 0, 0.75)),
    ],
)
def test_what_is_no_plane_of_known_distance_calibrates_nothing(frame: Any) -> None:
    assert procedure._plane_depth(frame) is None


# -- the calibration's file -----------------------------------------------------------------------


def test_relative_depth_is_linear_in_dioptres_from_near_to_far() -> None:
    made = calibration_of(np.zeros((2, 2, 2)))
    found = made.z_m(np.array([0, 0.5, 1, -0.1, np.nan], np.float32))
    assert found.dtype == np.float32
    wanted = [0.7, 2 / (1 / 0.7 + 1 / 0.8), 0.8, 1 / (1 / 0.7 + 0.1 * (1 / 0.7 - 1 / 0.8)), np.nan]
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_a_calibration_comes_back_as_it_was(tmp_path: Path) -> None:
    curve = np.arange(2 * 3 * 5).reshape(2, 3, 5) / 7
    made = calibration_of(
        curve,
        similarity=Similarity(1.01, 0.2, 3.0, -4.0, 5, 3),
        stripes=Stripes(5.5, 30.0, 0.7),
        gain=np.array(GAIN),
        report={"degree": 3},
        laplacian="paper",
    )
    made.save(tmp_path / "c.npz")
    back = Calibration.load(tmp_path / "c.npz")
    for name in ("similarity", "stripes", "laplacian", "near_z_m", "far_z_m", "noise",
                 "full_scale", "report", "texture"):  # fmt: skip
        assert getattr(back, name) == getattr(made, name), name
    for name in ("curve", "modulation", "gain"):
        np.testing.assert_array_equal(getattr(back, name), getattr(made, name))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"range_m": np.array([0.8, 0.7])}, "expected a working range in metres, found 0.8 to 0.7"),
        ({"range_m": np.array([0.7, 0.7])}, "expected a working range in metres"),
        ({"range_m": np.array([0.0, 0.7])}, "expected a working range in metres"),
        ({"range_m": np.array([0.7])}, "expected 2 numbers for range_m"),
        ({"range_m": np.array([0.7, np.nan])}, "expected 2 numbers for range_m"),
        ({"curve": np.zeros((2, 5, 3), np.float32)}, "expected a curve for 5×3 pixels"),
        ({"curve": np.zeros((2, 1, 1), np.float32)}, "expected a curve for 5×3 pixels"),
        ({"curve": np.zeros((3, 5), np.float32)}, "expected a curve for 5×3 pixels"),
        ({"curve": np.full((2, 3, 5), np.nan, np.float32)}, "expected a curve for 5×3 pixels"),
        ({"laplacian": np.array("sobel")}, "expected laplacian opencv or paper, found 'sobel'"),
        ({"similarity": np.ones(3)}, "expected 4 numbers for similarity"),
        ({"stripes": np.ones(2)}, "expected 3 numbers for stripes"),
        ({"noise": np.ones(1)}, "expected 2 numbers for noise"),
        ({"gain": np.ones(5)}, "expected 6 numbers for gain"),
        ({"full_scale": np.ones(0)}, "expected 1 numbers for full_scale"),
        ({"texture": np.array([0.0, 1, 1])}, "expected three numbers above 0 for texture"),
        ({"texture": np.array([1.0, 0.5, 1])}, "expected three numbers above 0 for texture"),
        ({"texture": np.array([1.0, 1, 0])}, "expected three numbers above 0 for texture"),
        ({"format": np.array("models")}, "expected a defocus-calibration file"),
        ({"version": np.array(2)}, "expected calibration version 1, found 2"),
    ],
)
def test_a_file_that_cannot_calibrate_is_refused_in_a_line(
    change: dict[str, np.ndarray], says: str, tmp_path: Path
) -> None:
    path = tmp_path / "c.npz"
    calibration_of(np.zeros((2, 3, 5))).save(path)
    with np.load(path) as file:
        arrays = dict(file)
    assert str(arrays["format"]) == FORMAT
    Calibration.load(path)
    np.savez(path, **(arrays | change))
    with pytest.raises(ValueError, match=r"^expected ") as raised:
        Calibration.load(path)
    assert says in str(raised.value) and "\n" not in str(raised.value)


def test_frames_of_other_sizes_are_refused() -> None:
    frames: list[Frame] = planes(QUIET, np.linspace(705, 800, 6), 1)
    other = planes(QUIET.with_(size_px=64), np.array([750.0]), 1)
    with pytest.raises(ValueError, match="frame 0: 64×64 pixels after 96×96"):
        calibrate(passes(frames + other), {}, CalibrateParameters())
    halved = replace(frames[0], images={"near": frames[0].images["near"],
                                        "far": frames[0].images["far"][:-1]})  # fmt: skip
    with pytest.raises(ValueError, match=r"frame 0: near is \(96, 96\), far is \(95, 96\)"):
        calibrate(passes([halved]), {}, CalibrateParameters())
    assert math.isclose(SPAN_MM, 106.1, abs_tol=0.1)

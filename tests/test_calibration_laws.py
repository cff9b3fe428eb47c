"""The calibration: its file and what it refuses, its procedure's parts, the curve from optics."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from textures import write_rig
from thin_lens import Rig as Sensor
from thin_lens import frame, passes, planes

from workbench.pipeline import Pipeline
from workbench.plugins import find_stages
from workbench.recording import Frame
from workbench.settings import resolve
from workbench_stages.dfd import from_optics as from_optics_module
from workbench_stages.dfd import procedure
from workbench_stages.dfd.calibration import Calibration
from workbench_stages.dfd.focus import SensorNoise
from workbench_stages.dfd.from_optics import OpticsParameters, from_optics, read_rig
from workbench_stages.dfd.procedure import CalibrateParameters, calibrate
from workbench_stages.dfd.similarity import Similarity
from workbench_stages.dfd.stripes import Stripes
from workbench_stages.dfd.texture import (
    LARGEST_BLUR_PX,
    Texture,
    pair_noise,
    scale_for,
    texture_curve,
    texture_focus_maps,
    texture_taps,
)
from workbench_stages.optics.rig import Rig
from workbench_stages.optics.thin_lens import image_distance_mm

SHAPE = (6, 9)


def made(**changes: Any) -> Calibration:
    """Every number unlike every other."""
    curve = np.arange(4 * 54, dtype=np.float32).reshape(4, *SHAPE) / 100
    values: dict[str, Any] = {
        "similarity": Similarity(0.987, 0.25, 1.5, -2.5, SHAPE[1], SHAPE[0]),
        "stripes": Stripes(5.25, -30.0, 0.8),
        "laplacian": "paper",
        "curve": curve,
        "near_z_m": 0.701,
        "far_z_m": 0.803,
        "modulation": np.array([0.18, 0.05, -0.04], np.float32),
        "noise": SensorNoise(0.3, 0.012),
        "gain": np.array([1.01, 0.02, -0.03, 0.04, -0.05, 0.06]),
        "full_scale": 1023.0,
        "report": {"planes": 17},
    }
    return Calibration(**values | changes)


# -- the file --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "changes",
    [
        {}, {"full_scale": 255.0, "laplacian": "opencv"}, {"modulation": np.zeros(0, np.float32)},
        {
            "texture": Texture(11.5, 3, 0.62), "stripes": None, "full_scale": math.inf,
            "curve": np.ones((6, 1, 1), np.float32),
        },
    ],
)  # fmt: skip
def test_every_number_comes_back_from_the_file(changes: dict[str, Any], tmp_path: Path) -> None:
    written = made(**changes)
    written.save(tmp_path / "one.npz")
    back = Calibration.load(tmp_path / "one.npz")
    for name in (
        "similarity", "stripes", "laplacian", "near_z_m", "far_z_m", "noise", "full_scale",
        "report", "texture",
    ):  # fmt: skip
        assert getattr(back, name) == getattr(written, name), name
    for name in ("curve", "modulation", "gain"):
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))
    assert back.curve.dtype == back.modulation.dtype == np.float32


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("format", np.array("something"), "expected a defocus-calibration file"),
        ("version", np.array(2), "expected calibration version 1, found 2"),
        ("size", np.array([6, 9]), "expected a curve for 6×9 pixels"),
        ("size", np.array([9]), "expected 2 numbers for size"),
        ("curve", np.zeros((4, 6, 8), np.float32), "expected a curve for 9×6 pixels"),
        ("curve", np.zeros((6, 9), np.float32), "expected a curve"),
        ("curve", np.full((4, 6, 9), np.nan, np.float32), "expected a curve"),
        ("curve", np.zeros((4, 1, 1), np.float32), "expected a curve for 9×6 pixels"),
        ("laplacian", np.array("sobel"), "expected laplacian opencv or paper, found 'sobel'"),
        ("similarity", np.array([1.0, 0, 0]), "expected 4 numbers for similarity"),
        ("similarity", np.array([1.0, 0, 0, np.nan]), "expected 4 numbers for similarity"),
        ("range_m", np.array([0.8, 0.7]), "expected a working range in metres"),
        ("range_m", np.array([0.7, 0.7]), "expected a working range in metres"),
        ("range_m", np.array([0.0, 0.7]), "expected a working range in metres"),
        ("range_m", np.array([-0.1, 0.7]), "expected a working range in metres"),
        ("stripes", np.zeros(0), "expected 3 numbers for stripes"),
        ("noise", np.array([1.0]), "expected 2 numbers for noise"),
        ("gain", np.ones(5), "expected 6 numbers for gain"),
        ("full_scale", np.zeros(0), "expected 1 numbers for full_scale"),
        ("texture", np.array([0.0, 1, 1]), "expected three numbers above 0"),
        ("texture", np.array([1.0, 0.5, 1]), "expected three numbers above 0"),
        ("texture", np.array([1.0, 1, 0]), "expected three numbers above 0"),
        ("report", None, "damaged or not one"),
    ],
)
def test_a_file_that_cannot_be_is_refused_in_a_line(
    key: str, value: Any, says: str, tmp_path: Path
) -> None:
    made().save(tmp_path / "one.npz")
    arrays = dict(np.load(tmp_path / "one.npz"))
    if value is None:
        del arrays[key]
    else:
        arrays[key] = value
    np.savez(tmp_path / "two.npz", **arrays)
    with pytest.raises(ValueError, match=says) as raised:
        Calibration.load(tmp_path / "two.npz")
    assert "\n" not in str(raised.value)


def test_what_is_no_such_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.npz").write_text("not a zip")
    with pytest.raises(ValueError, match=r"expected a defocus-calibration file \(.npz\)"):
        Calibration.load(tmp_path / "text.npz")
    made().save(tmp_path / "one.npz")
    whole = (tmp_path / "one.npz").read_bytes()
    (tmp_path / "half.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="damaged or not one"):
        Calibration.load(tmp_path / "half.npz")
    with pytest.raises(OSError):
        Calibration.load(tmp_path / "none.npz")


# -- the procedure's parts -------------------------------------------------------------------------


def ladder(z_m: np.ndarray, ratio: np.ndarray) -> list[Any]:
    return [
        procedure._Plane(k, float(z), float(q))
        for k, (z, q) in enumerate(zip(z_m, ratio, strict=True))
    ]


def test_the_range_is_the_longest_run_over_which_the_ratio_falls_steadily() -> None:
    """Steady from 0.70 to 0.78, flat before and turning back after."""
    z = np.arange(0.66, 0.83, 0.02)
    ratio = np.array([0.80, 0.80, 0.80, 0.5, 0.2, -0.1, -0.4, -0.41, -0.2])
    for sign in (1, -1):
        near, far, note = procedure._working_range(ladder(z, sign * ratio), {})
        assert (near, far) == pytest.approx((0.70, 0.78))
        assert note == "steady part of the ratio over the planes"
    mixed = [ladder(z, ratio)[k] for k in (4, 0, 8, 2, 6, 1, 3, 5, 7)]
    assert procedure._working_range(mixed, {})[:2] == pytest.approx((0.70, 0.78))


@pytest.mark.parametrize(
    ("rig", "wanted", "within"),
    [
        ({"u1": "710", "u2": "770"}, (0.71, 0.77), True),
        ({"u1": "770", "u2": "710"}, (0.71, 0.77), True),
        ({"u1": "600", "u2": "770"}, (0.70, 0.77), True),
        ({"u1": "710", "u2": "900"}, (0.71, 0.78), True),
        ({"u1": "600", "u2": "900"}, (0.70, 0.78), False),
        ({"u1": "710"}, (0.70, 0.78), False),
        ({"u1": "x", "u2": "770"}, (0.70, 0.78), False),
    ],
)
def test_the_range_ends_at_the_rigs_focal_planes(
    rig: dict[str, str], wanted: tuple[float, float], within: bool
) -> None:
    z = np.array([0.70, 0.72, 0.74, 0.76, 0.78])
    near, far, note = procedure._working_range(ladder(z, 10 / z), rig)
    assert (near, far) == pytest.approx(wanted)
    assert ("within the rig's focal planes" in note) == within


def test_a_range_needs_five_planes_at_five_distances() -> None:
    z = np.array([0.70, 0.72, 0.74, 0.76])
    with pytest.raises(ValueError, match="expected 5 planes of known distance or more, found 4"):
        procedure._working_range(ladder(z, 10 / z), {})
    twice = np.concatenate([z, z])
    with pytest.raises(ValueError, match="expected planes at 5 distances or more, found 4"):
        procedure._working_range(ladder(twice, 10 / twice), {})


def test_each_pixels_curve_is_its_own_least_squares_polynomial() -> None:
    rng = np.random.default_rng(0)
    ratios = rng.uniform(-0.9, 0.9, (9, 3, 4))
    targets = rng.uniform(0, 1, (9, 3, 4))
    normal = procedure._NormalEquations(4)
    for ratio, target in zip(ratios, targets, strict=True):
        normal.add(ratio, target)
    for degree in (4, 2, None):
        curve = normal.solve(degree)
        assert curve.shape == ((degree or 4) + 1, 3, 4)
        for y, x in np.ndindex(3, 4):
            wanted = np.polynomial.polynomial.polyfit(
                ratios[:, y, x], targets[:, y, x], degree or 4
            )
            np.testing.assert_allclose(curve[:, y, x], wanted, rtol=2e-3, atol=2e-3)
        value = procedure._evaluate(curve, ratios[0])
        powers = ratios[0][None] ** np.arange(len(curve))[:, None, None]
        np.testing.assert_allclose(value, (curve * powers).sum(axis=0), rtol=1e-5)


def patches(off: float) -> list[Any]:
    """Seven distances, two shots each, on t = (1 - Q) / 2; the fourth is off by so much."""
    made_ = []
    for k, t in enumerate(np.linspace(0, 1, 7)):
        for _ in range(2):
            ratio = np.full((4, 4), 1 - 2 * t + (2 * off if k == 3 else 0), np.float32)
            made_.append(procedure._Patch(0.7 + 0.01 * k, ratio, np.full((4, 4), t, np.float32)))
    return made_


def test_planes_held_out_are_ones_that_the_curve_has_not_seen() -> None:
    """A line through the other six is exact, so the seventh shows all of what it is off."""
    rms, worst = procedure._held_out(patches(0.0), 1, 3)
    assert max(rms, worst) < 1e-5
    rms, worst = procedure._held_out(patches(0.05), 1, 3)
    assert worst == pytest.approx(0.05, rel=1e-3)
    # Of the five distances that are left out in turn, one is off; the others hardly.
    assert 0.05 / 5**0.5 < rms < 1.1 * 0.05 / 5**0.5


def test_residuals_of_the_fit_are_millimetres_of_depth() -> None:
    curve = np.zeros((2, 40, 50), np.float32)
    curve[0], curve[1] = 0.5, -0.5
    calibration = made(curve=curve, near_z_m=0.7, far_z_m=0.8)
    target = np.full((32, 32), 0.5, np.float32)
    ratio = np.zeros((32, 32), np.float32)
    ratio[0, 0] = -0.2
    rms, worst = procedure._fit_residuals([procedure._Patch(0.75, ratio, target)], calibration)
    wanted_mm = 1e3 * (calibration.z_m(np.array(0.6)) - calibration.z_m(np.array(0.5)))
    assert worst == pytest.approx(float(wanted_mm), rel=1e-3)
    assert rms == pytest.approx(float(wanted_mm) / 32, rel=1e-3)


def test_linearity_is_the_greatest_departure_from_a_line_over_dioptres() -> None:
    z = 1 / np.linspace(1 / 0.8, 1 / 0.7, 6)
    assert procedure._linearity(ladder(z, 3 / z - 4)) < 1e-9
    ratio = np.array([0.0, 1, 2, 3, 4, 5])
    bent = ratio + np.array([0, 0, 0.3, 0, 0, 0])
    inverse = 1 / z
    line = np.polyval(np.polyfit(inverse, bent, 1), inverse)
    wanted = 100 * np.abs(line - bent).max() / 5
    assert procedure._linearity(ladder(z, bent)) == pytest.approx(wanted)


def test_contrast_over_depth_is_a_polynomial_within_the_range() -> None:
    t = [
        np.array([-0.2, 0.0]),
        np.array([0.25]),
        np.array([0.5]),
        np.array([0.75]),
        np.array([1.0, 1.3]),
    ]

    def shown(one: np.ndarray) -> np.ndarray:
        return 0.2 + 0.1 * np.clip(one, 0, 1) - 0.3 * np.clip(one, 0, 1) ** 2

    found = procedure._fit_modulation([(one, shown(one)) for one in t])
    np.testing.assert_allclose(found, [0.2, 0.1, -0.3, 0, 0], atol=1e-5)
    few = procedure._fit_modulation([(one, shown(one)) for one in t[:2]])
    assert few.shape == (2,) and few.dtype == np.float32


def test_noise_is_the_line_of_variance_over_level_and_bright_levels_are_left_out() -> None:
    rng = np.random.default_rng(0)
    transfer = procedure._PhotonTransfer()
    level = rng.uniform(1, 254, 60_000)
    variance = 2 + 0.03 * level
    # From 95 % of full scale on noise is clipped away.
    variance[level >= 0.95 * 255] = 0
    transfer.add(np.zeros(1, np.uint8), level, variance)
    fitted = transfer.fit(2)
    assert fitted is not None
    assert (fitted.read_variance, fitted.gain) == pytest.approx((2, 0.03), rel=0.02)
    quiet = procedure._PhotonTransfer()
    quiet.add(np.zeros(1, np.uint8), level, 0.001 * level)
    least = quiet.fit(2)
    assert least is not None and least.read_variance == pytest.approx(1 / 12)
    few = procedure._PhotonTransfer()
    few.add(np.zeros(1, np.uint8), np.repeat([20.0, 200.0], [501, 500]), np.ones(1001))
    assert few.fit(2) is None


def with_truth(depth_m: np.ndarray | None, **meta: Any) -> Frame:
    made_ = frame(Sensor(size_px=40), 0, 750.0, None)
    truth = made_.truth
    assert truth is not None
    object.__setattr__(truth, "depth_m", depth_m)
    object.__setattr__(truth, "meta", meta)
    return made_


def test_a_plane_of_known_distance_is_told_from_a_scene() -> None:
    y, x = np.mgrid[0:40, 0:40]
    tilted = 1 / (1 / 0.75 + 1e-3 * x - 2e-3 * y)
    found = procedure._plane_depth(with_truth(tilted))
    assert found is not None
    np.testing.assert_allclose(found, tilted, rtol=1e-6)
    # Half a millimetre of root mean square is still a plane.
    for off, plane in ((0.9e-3, True), (1.1e-3, False)):
        wavy = 0.75 + off / 2 * np.where((x // 8 + y // 8) % 2, 1, -1)
        assert (procedure._plane_depth(with_truth(wavy)) is not None) == plane
    holed = tilted.copy()
    holed[3, 3] = np.nan
    for wrong in (holed, tilted[:20], tilted * 0, -tilted):
        assert procedure._plane_depth(with_truth(wrong)) is None
    by_z = procedure._plane_depth(with_truth(None, z=733))
    assert by_z is not None and by_z.shape == (40, 40) and (by_z == 0.733).all()
    assert procedure._plane_depth(with_truth(None, z=733, kind="pile")) is None
    assert procedure._plane_depth(with_truth(None, z="far")) is None


def test_the_middle_is_the_32_pixels_about_it() -> None:
    assert procedure._middle_slice((100, 60)) == (slice(34, 66), slice(14, 46))
    assert procedure._middle_slice((20, 33)) == (slice(0, 32), slice(0, 32))
    z, ratio = np.zeros((100, 60)), np.zeros((100, 60))
    z[34:66, 14:46], ratio[34:66, 14:46] = 0.7, np.linspace(0, 1, 1024).reshape(32, 32)
    assert procedure._middle(z, ratio) == pytest.approx((0.7, 0.5))


# -- the whole procedure ---------------------------------------------------------------------------


def cropped(frames: list[Frame], rows: slice, columns: slice) -> list[Frame]:
    """Frames that are not square; the principal point is no longer in the middle."""
    for one in frames:
        for channel, image in one.images.items():
            one.images[channel] = np.ascontiguousarray(image[rows, columns])
        assert one.truth is not None and one.truth.depth_m is not None
        object.__setattr__(one.truth, "depth_m", one.truth.depth_m[rows, columns])
        height, width = one.images["near"].shape
        matrix = one.cameras["near"].K - [[0, 0, columns.start], [0, 0, rows.start], [0, 0, 0]]
        one.cameras["near"] = replace(one.cameras["near"], width=width, height=height, K=matrix)
    return frames


@pytest.mark.parametrize("level", [False, True])
def test_an_image_that_is_not_square_is_calibrated_and_measured(
    level: bool, tmp_path: Path
) -> None:
    """Upright stripes in a wide image, level ones in a tall one; the far sensor is darker."""
    sensor = Sensor(size_px=128, far_gain=0.8, angle_deg=90.0 if level else 0.0)
    part = slice(8, 104), slice(0, 128)
    cut = part[::-1] if level else part
    shape = (128, 96) if level else (96, 128)
    near_mm, far_mm = sensor.near_focus_mm, sensor.far_focus_mm
    # Two per cent of the range on either side are used as well, and no more.
    inner = np.linspace(near_mm - 2, far_mm + 2, 9)
    frames = cropped(planes(sensor, np.array([near_mm - 4, *inner, far_mm + 4])), *cut)
    found = calibrate(
        passes(frames), {"u1": str(near_mm), "u2": str(far_mm)}, CalibrateParameters(degree=3)
    )
    assert found.curve.shape == (4, *shape)
    assert (found.similarity.height, found.similarity.width) == shape
    assert (found.near_z_m, found.far_z_m) == pytest.approx((near_mm / 1e3, far_mm / 1e3))
    assert found.gain_map.shape == shape
    assert found.gain_map.mean() == pytest.approx(1 / 0.8, rel=0.01)
    assert found.full_scale == 255
    assert found.noise.gain == pytest.approx(255 / sensor.full_well, rel=0.2)
    report = found.report
    assert report["degree"] == 3
    assert (report["planes"], report["planes_used"], report["distances"]) == (22, 18, 9)
    assert report["gain_spread_percent"] < 2
    assert report["gain_near_over_far"] == pytest.approx(1 / 0.8, rel=0.01)
    assert report["stripe_period_px"] == pytest.approx(5, rel=0.01)
    assert abs(report["stripe_direction_deg"]) == pytest.approx(sensor.angle_deg, abs=0.5)
    assert report["working_range_mm"] == pytest.approx([near_mm, far_mm])
    assert report["noise_source"] == "repeated shots of planes"
    stand_off_mm, span_mm = (near_mm + far_mm) / 2, far_mm - near_mm
    for whole, name in ((stand_off_mm, "stand_off"), (span_mm, "span")):
        share = 100 * report["held_out_worst_mm"] / whole
        assert report[f"held_out_worst_percent_of_{name}"] == pytest.approx(share)
    # The curve takes a nearer surface to a smaller relative depth, and falls with the ratio.
    ends = procedure._evaluate(found.curve, np.full(shape, 0.5, np.float32))
    other = procedure._evaluate(found.curve, np.full(shape, -0.5, np.float32))
    assert (ends < 0.5).all() and (other > 0.5).all()
    assert json.loads(json.dumps(report)) == report

    found.save(tmp_path / "calibration.npz")
    stages = find_stages()
    resources = {"calibration": tmp_path / "calibration.npz"}
    pipeline = Pipeline(stages, resolve(stages), resources, until="depth_cloud")
    (seen,) = cropped([frame(sensor, 0, 741.0, np.random.default_rng(9))], *cut)
    run = pipeline.run(seen)
    assert not run.failures and not run.warnings
    depth_m, points = run.artifacts["depth_m"], run.artifacts["cloud_xyz_m"]
    middle = depth_m[16:-16, 16:-16]
    assert np.isfinite(middle).mean() > 0.98
    assert 1e3 * np.nanmean(middle) == pytest.approx(741, abs=0.5)
    assert float(np.nanstd(1e3 * middle)) < 0.012 * span_mm
    y, x = np.nonzero(np.isfinite(depth_m))
    K = seen.cameras["near"].K
    assert K[0, 2] != K[1, 2]
    np.testing.assert_allclose(points[:, 0], (x - K[0, 2]) / K[0, 0] * points[:, 2], rtol=1e-4)
    np.testing.assert_allclose(points[:, 1], (y - K[1, 2]) / K[1, 1] * points[:, 2], rtol=1e-4)


@pytest.mark.parametrize(
    ("held_out", "degree"),
    [
        ({3: 1.04, 4: 1.029, 5: 1.0, 6: 1.2}, 4), ({3: 1.0, 4: 0.98, 5: 1.1, 6: 1.2}, 3),
        ({3: 2.0, 4: 1.5, 5: 1.2, 6: 1.0}, 6),
    ],
)  # fmt: skip
def test_the_lowest_degree_is_taken_that_is_as_good_as_the_best(
    held_out: dict[int, float], degree: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Within three per cent of the best on planes held out, of twelve bits and nine distances."""
    asked = []

    def planted(_: Any, tried: int, neighbourhood_px: int) -> tuple[float, float]:
        asked.append((tried, neighbourhood_px))
        return 1e-3 * held_out[tried], 3e-3 * held_out[tried]

    monkeypatch.setattr(procedure, "_held_out", planted)
    sensor = Sensor(size_px=64, bits=12)
    near_mm, far_mm = sensor.near_focus_mm, sensor.far_focus_mm
    found = calibrate(
        passes(planes(sensor, np.linspace(near_mm, far_mm, 9), shots=1)),
        {"u1": str(near_mm), "u2": str(far_mm)},
        CalibrateParameters(neighbourhood_px=5),
    )
    assert sorted(asked) == [(3, 5), (4, 5), (5, 5), (6, 5)]
    assert found.report["degree"] == degree == len(found.curve) - 1
    span_mm = far_mm - near_mm
    assert found.report["held_out_rms_mm"] == pytest.approx(
        1e-3 * held_out[degree] * span_mm, rel=1e-3
    )
    assert found.report["held_out_worst_mm"] == pytest.approx(
        3e-3 * held_out[degree] * span_mm, rel=1e-3
    )
    assert found.full_scale == 4095
    assert found.report["noise_source"] == "single shots of planes, along the stripes"
    assert found.noise.gain == pytest.approx(4095 / sensor.full_well, rel=0.3)


def test_dot_grids_set_the_map_where_the_recording_has_some() -> None:
    import cv2

    sensor = Sensor(size_px=128)
    near_mm, far_mm = sensor.near_focus_mm, sensor.far_focus_mm
    true = Similarity(0.985, 0.0, 1.2, -0.7, 128, 128)
    y, x = np.mgrid[0:128, 0:128].astype(float)
    near = 30 + 150 * np.exp(-(((x % 16) - 8.0) ** 2 + ((y % 16) - 8.0) ** 2) / 8)
    far = cv2.warpAffine(
        near, cv2.invertAffineTransform(true.far_from_near), (128, 128),
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
    )  # fmt: skip
    grid = planes(sensor, np.array([750.0]), shots=1)[0]
    grid.images.update(near=near.astype(np.uint8), far=far.clip(0, 255).astype(np.uint8))
    assert grid.truth is not None
    grid.truth.meta["kind"] = "grid"
    frames = planes(sensor, np.linspace(near_mm, far_mm, 6), shots=1)
    found = calibrate(
        passes([*frames, grid]), {"u1": str(near_mm), "u2": str(far_mm)}, CalibrateParameters()
    )
    assert found.similarity.scale == pytest.approx(0.985, abs=5e-4)
    shift = found.similarity.dx_px, found.similarity.dy_px
    assert shift == pytest.approx((1.2, -0.7), abs=0.03)
    registration = found.report["registration"]
    assert registration["from"].startswith("1 dot grids, ")
    assert registration["scale"] == found.similarity.scale
    assert registration["residual_rms_px"] < 0.1 < registration["before_rms_px"]
    assert registration["residual_each_px"] == pytest.approx(
        [registration["residual_rms_px"]], rel=0.1
    )
    # The grid is no plane to fit.
    assert found.report["planes"] == 6


def test_frames_of_unlike_size_are_refused_with_their_number() -> None:
    sensor = Sensor(size_px=64)
    frames = planes(sensor, np.array([710.0, 720.0]), shots=1)
    frames[1].images["far"] = frames[1].images["far"][:, :50]
    with pytest.raises(ValueError, match=r"frame 1: near is \(64, 64\), far is \(64, 50\)"):
        calibrate(passes(frames), {}, CalibrateParameters())
    frames[1].images["near"] = frames[1].images["near"][:, :50]
    with pytest.raises(ValueError, match="frame 1: 50×64 pixels after 64×64"):
        calibrate(passes(frames), {}, CalibrateParameters())


curve_for = cache(texture_curve)


# -- texture and optics ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("blur", "scale"), [(0.7, 1), (LARGEST_BLUR_PX, 1), (4.6, 2), (9.0, 2), (9.1, 3)]
)
def test_images_are_shrunk_until_the_blur_is_small_enough(blur: float, scale: int) -> None:
    assert LARGEST_BLUR_PX == 4.5
    assert scale_for(blur) == scale


def test_a_shrunk_image_has_the_curve_of_its_own_blur() -> None:
    small, large = curve_for(3.0), curve_for(9.0)
    assert (small.texture.scale_px, large.texture.scale_px) == (1, 2)
    assert (small.texture.blur_px, large.texture.blur_px) == (3.0, 9.0)
    half = curve_for(4.5)
    np.testing.assert_allclose(half.coefficients, large.coefficients, rtol=1e-5)
    assert not np.allclose(small.coefficients, large.coefficients, rtol=1e-2)


def test_relative_depth_falls_with_the_ratio_and_is_half_where_both_are_as_sharp() -> None:
    for curve in (curve_for(3.0), curve_for(3.0, period_px=5.0)):
        q = np.linspace(-0.8, 0.8, 41)
        t = np.polynomial.polynomial.polyval(q, curve.coefficients.astype(float))
        assert (np.diff(t) < 0).all()
        np.testing.assert_allclose(t + t[::-1], 1, atol=1e-6)
        assert curve.low < 0 and curve.high > 1
        assert curve.coefficients[[2, 4]].tolist() == [0, 0]


def test_a_texture_window_is_a_box_twice_as_wide_as_the_one_it_is_run_over() -> None:
    taps = texture_taps(5)
    np.testing.assert_allclose(
        taps, np.convolve(np.full(5, 0.2), np.array([0.75, 1, 0.75]) / 2.5), rtol=1e-6
    )
    np.testing.assert_allclose(texture_taps(1.4), np.array([0.2, 1, 0.2]) / 1.4, rtol=1e-6)


@pytest.mark.parametrize("blur_near", [True, False])
def test_the_sharper_image_has_the_greater_map_whatever_the_shape(blur_near: bool) -> None:
    import cv2

    rng = np.random.default_rng(0)
    sharp = cv2.GaussianBlur(rng.normal(size=(90, 140)), (0, 0), 1.0)
    sharp = (110 + 30 * sharp / sharp.std()).astype(np.float32)
    blurred = cv2.GaussianBlur(sharp, (0, 0), 1.2)
    pair = (blurred, sharp) if blur_near else (sharp, blurred)
    taps = texture_taps(9)
    curve = curve_for(3.0)
    near, far, noise = texture_focus_maps(*pair, curve.texture, taps, taps, "opencv", True)
    assert near.shape == far.shape == (90, 140)
    inner = (slice(12, -12), slice(12, -12))
    assert ((near <= far) if blur_near else (near >= far))[inner].mean() > 0.97
    # σ² of the blur is 1.44; the log ratio of the reference is that of its frequency.
    known = (near[inner] > 0) & (far[inner] > 0)
    assert known.mean() > 0.9
    half_log = 0.5 * np.log(near[inner][known] / far[inner][known])
    wanted = (-1 if blur_near else 1) * 0.25 * 1.44 * curve.texture.mean_square_frequency
    assert np.median(half_log) == pytest.approx(wanted, rel=0.25)
    assert noise.read_variance < 1


@pytest.mark.parametrize(("read", "gain"), [(9.0, 0.0), (1.0, 0.06)])
def test_noise_of_a_pair_is_told_over_the_grey_level(read: float, gain: float) -> None:
    rng = np.random.default_rng(0)
    level = np.linspace(20, 220, 400)[None].repeat(300, 0)
    images = [
        (level + np.sqrt(read + gain * level) * rng.normal(size=level.shape)).astype(np.float32)
        for _ in range(2)
    ]
    noise = pair_noise(*images)
    for grey in (50, 120, 200):
        assert noise.read_variance + noise.gain * grey == pytest.approx(read + gain * grey, rel=0.1)
    # Of an image with texture and one without the one with less is believed.
    textured = images[0] + 40 * rng.normal(size=level.shape).astype(np.float32)
    other = pair_noise(textured, images[1])
    assert other.read_variance + 120 * other.gain == pytest.approx(read + 120 * gain, rel=0.3)


@pytest.mark.parametrize("beyond", [0.0, 10.0, 30.0])
def test_the_range_from_optics_reaches_beyond_the_focal_planes_in_dioptres(
    beyond: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(from_optics_module, "texture_curve", curve_for)
    rig = read_rig(write_rig(tmp_path / "rig.toml"))
    found = from_optics(rig, None, OpticsParameters(beyond_percent=beyond))
    curve = curve_for(abs(float(rig.blur_px("near", 1200.0))), "opencv", None)
    low, high = max(-beyond / 100, curve.low), min(1 + beyond / 100, curve.high)
    between = 1 / 0.8 - 1 / 1.2
    assert 1 / found.near_z_m == pytest.approx(1 / 0.8 - low * between)
    assert 1 / found.far_z_m == pytest.approx(1 / 0.8 - high * between)
    # At a ratio of nothing, midway between the focal planes.
    middle = float(found.z_m(found.curve[0, 0, 0]))
    assert 1 / middle == pytest.approx((1 / 0.8 + 1 / 1.2) / 2, rel=1e-4)
    np.testing.assert_allclose(
        found.curve[1:, 0, 0], curve.coefficients[1:] / (high - low), rtol=1e-4, atol=1e-7
    )
    assert found.report["working_range_mm"] == pytest.approx(
        [1e3 * found.near_z_m, 1e3 * found.far_z_m]
    )
    assert found.report["focal_planes_mm"] == pytest.approx([800, 1200])


@pytest.mark.parametrize(("registered", "principal"), [(False, [100.0, 30.0]), (True, None)])
def test_the_far_image_is_smaller_by_the_sensors_distances(
    registered: bool,
    principal: list[float] | None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(from_optics_module, "texture_curve", curve_for)
    path = write_rig(
        tmp_path / "rig.toml", registered=str(registered).lower(), principal_point_px=principal
    )
    rig = read_rig(path, (320, 200))
    found = from_optics(rig, (320, 200), OpticsParameters())
    scale = image_distance_mm(50, 1200) / image_distance_mm(50, 800)
    assert found.similarity.scale == pytest.approx(1.0 if registered else scale)
    assert (found.similarity.width, found.similarity.height) == (320, 200)
    fixed = principal or [159.5, 99.5]
    assert found.similarity.far_from_near @ [*fixed, 1] == pytest.approx(fixed)
    assert found.report["magnification_far_over_near"] == pytest.approx(found.similarity.scale)


@pytest.mark.parametrize(("f_number", "refused"), [(50.0, True), (45.0, False)])
def test_a_blur_too_small_to_see_is_refused(f_number: float, refused: bool) -> None:
    """The blur circle at the other plane is inversely as the f-number."""
    rig = Rig.from_values(
        {
            "focal_length_mm": 50.0, "f_number": f_number, "pixel_pitch_mm": 0.1 / 3,
            "near_focus_mm": 800.0, "far_focus_mm": 1200.0, "projector": None,
        },
        "here",
    )  # fmt: skip
    blur = 50 / f_number * (image_distance_mm(50, 800) / image_distance_mm(50, 1200) - 1) * 30
    assert abs(float(rig.blur_px("near", 1200.0))) == pytest.approx(blur, rel=0.05)
    assert (blur < 0.7) == refused
    if refused:
        with pytest.raises(ValueError, match="no unique range"):
            from_optics(rig, None, OpticsParameters())
    else:
        assert from_optics(rig, None, OpticsParameters()).texture is not None

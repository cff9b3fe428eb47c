"""Depth from the scene's own texture, calibrated from the optics alone."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from textures import KINDS, RIG, SIZE, pair, sharp, write_rig

from workbench.pipeline import Pipeline, Run
from workbench.plugins import find_stages
from workbench.recording import Camera, Frame
from workbench.settings import resolve
from workbench_stages.dfd.calibration import Calibration, pair_gain
from workbench_stages.dfd.from_optics import OpticsParameters, from_optics, read_rig
from workbench_stages.dfd.similarity import Similarity, align_pair
from workbench_stages.dfd.texture import LARGEST_BLUR_PX, pair_noise, texture_curve
from workbench_stages.optics.rig import Rig

WHOLE = (SIZE, SIZE)
INNER = (slice(12, -12), slice(12, -12))


def rig_file(tmp_path: Path, **changes: object) -> Path:
    return write_rig(tmp_path / "rig.toml", **changes)


def depth(made: Calibration, tmp_path: Path, near: np.ndarray, far: np.ndarray) -> Run:
    path = tmp_path / "calibration.npz"
    made.save(path)
    height, width = near.shape[:2]
    K = np.array([[500, 0, (width - 1) / 2], [0, 500, (height - 1) / 2], [0, 0, 1.0]])
    camera = Camera(width, height, K, np.zeros(5), "plumb_bob", "camera", 0)
    digest = str(hash(near.tobytes() + far.tobytes()))
    images = {"near": near, "far": far}
    frame = Frame(0, 0, images, {"near": 0, "far": 0}, {"near": camera}, None, digest, ())
    stages = find_stages()
    return Pipeline(stages, resolve(stages), {"calibration": path}, until="depth_cloud").run(frame)


def relative(z_mm: np.ndarray | float) -> np.ndarray:
    """0 in the near focal plane, 1 in the far one, linear in 1/z."""
    near, far = 1 / RIG["near_focus_mm"], 1 / RIG["far_focus_mm"]
    return (1 / np.asarray(z_mm) - near) / (far - near)


@pytest.mark.parametrize("pitch_mm", [0.1, 0.04])
@pytest.mark.parametrize("kind", KINDS)
def test_planes_are_flat_and_where_they_are_whatever_their_texture(
    kind: str, pitch_mm: float, tmp_path: Path
) -> None:
    rig = read_rig(rig_file(tmp_path, pixel_pitch_mm=pitch_mm), WHOLE)
    made = from_optics(rig, WHOLE, OpticsParameters())
    medians = []
    for z_mm in (800.0, 880.0, 960.0, 1080.0, 1200.0):
        run = depth(made, tmp_path, *pair(rig, sharp(kind), z_mm))
        assert not run.failures and not run.warnings
        found = relative(1e3 * run.artifacts["depth_m"][INNER])
        known = np.isfinite(found)
        assert known.mean() > 0.75
        medians.append(float(np.median(found[known])))
        # In shares of the distance between the focal planes.
        assert medians[-1] == pytest.approx(float(relative(z_mm)), abs=0.07)
        assert float(found[known].std()) < 0.12
    assert (np.diff(medians) > 0.1).all()


def test_a_tilted_plane_and_a_step(tmp_path: Path) -> None:
    rig = read_rig(rig_file(tmp_path), WHOLE)
    made = from_optics(rig, WHOLE, OpticsParameters())
    x = np.linspace(0, 1, SIZE)[None].repeat(SIZE, 0)
    tilted = 1 / ((1 - x) / 830 + x / 1150)
    step = np.where(x < 0.5, 870.0, 1080.0)
    for truth, within in ((tilted, 0.06), (step, 0.12)):
        run = depth(made, tmp_path, *pair(rig, sharp("natural"), truth))
        error = (relative(1e3 * run.artifacts["depth_m"]) - relative(truth))[INNER]
        assert np.isfinite(error).mean() > 0.9
        assert math.sqrt(float(np.nanmean(error**2))) < within


def test_bare_surfaces_have_no_depth(tmp_path: Path) -> None:
    rig = read_rig(rig_file(tmp_path), WHOLE)
    made = from_optics(rig, WHOLE, OpticsParameters())
    image = sharp("fine")
    image[:, SIZE // 2 :] = 110
    run = depth(made, tmp_path, *pair(rig, image, 880.0))
    known = np.isfinite(run.artifacts["depth_m"])
    assert known[:, : SIZE // 2 - 20].mean() > 0.85
    assert known[:, SIZE // 2 + 40 :].mean() < 0.1


def test_beyond_the_range_is_unknown_and_not_folded_back(tmp_path: Path) -> None:
    rig = read_rig(rig_file(tmp_path), WHOLE)
    made = from_optics(rig, WHOLE, OpticsParameters())
    for kind in ("natural", "fine"):
        for z_mm in (300.0, 500.0, 700.0, 1500.0, 5000.0):
            run = depth(made, tmp_path, *pair(rig, sharp(kind), z_mm))
            assert np.isfinite(run.artifacts["depth_m"][INNER]).mean() < 0.1


def test_a_projected_pattern_is_used_where_the_rig_has_one(tmp_path: Path) -> None:
    text = "\n[projector]\nlines_per_mm = 4.0\nfocus_mm = 750.0\n"
    path = write_rig(
        tmp_path / "rig.toml",
        focal_length_mm=60.0,
        pixel_pitch_mm=0.05,
        near_focus_mm=700.0,
        far_focus_mm=806.1,
    )
    path.write_text(path.read_text() + text)
    made = from_optics(read_rig(path), None, OpticsParameters())
    assert made.texture is not None and made.texture.scale_px == 1
    assert made.texture.blur_px == pytest.approx(5.3, abs=0.1)


# -- the curve ------------------------------------------------------------------------------------


@pytest.mark.parametrize("blur_px", [1.0, 3.0, 4.5, 11.0, 40.0])
def test_the_curve_is_symmetric_steady_and_fits_its_model(blur_px: float) -> None:
    curve = texture_curve(blur_px)
    assert blur_px / curve.texture.scale_px <= LARGEST_BLUR_PX
    assert curve.low <= -0.1 and curve.high >= 1.1
    assert curve.worst < 0.01
    assert curve.low == pytest.approx(1 - curve.high, abs=1e-9)
    assert curve.coefficients[0] == pytest.approx(0.5)
    assert curve.coefficients[1] < 0


def test_noise_is_told_from_one_pair() -> None:
    rig = Rig(**RIG, projector=None, registered=True)
    near, far = pair(rig, sharp("natural"), 1200.0, noise=3.0, gain=1.0)
    noise = pair_noise(near.astype(np.float32), far.astype(np.float32))
    assert noise.read_variance + 110 * noise.gain == pytest.approx(9, rel=0.25)


# -- registration and light -----------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0.94, 1.0, 1.03])
def test_a_refocused_pair_is_aligned_from_wherever_it_begins(scale: float) -> None:
    truth = Similarity(scale, 0.4, 3.0, -5.0, SIZE, SIZE)
    near = sharp("natural")
    inverse = cv2.invertAffineTransform(truth.far_from_near)
    far = cv2.warpAffine(
        near,
        inverse,
        WHOLE,
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    starts = [Similarity(0.97, 0, 0, 0, SIZE, SIZE), Similarity.identity(SIZE, SIZE)]
    found = align_pair(cv2.GaussianBlur(near, (0, 0), 1.5), far, starts)
    corners = np.array([[0, 0, 1], [SIZE - 1, 0, 1], [0, SIZE - 1, 1]], float)
    off = corners @ (found.far_from_near - truth.far_from_near).T
    assert np.abs(off).max() < 0.5


def test_light_that_differs_over_the_image_is_brought_to_balance() -> None:
    near = sharp("natural")
    fall = 1 - 0.3 * np.linspace(-1, 1, SIZE, dtype=np.float32)[None] ** 2
    gain = pair_gain(near, near * fall, Similarity.identity(SIZE, SIZE))
    np.testing.assert_allclose(gain * fall, 1, atol=0.03)


# -- the file -------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [None, (320, 200)])
def test_it_comes_back_from_its_file(size: tuple[int, int] | None, tmp_path: Path) -> None:
    made = from_optics(read_rig(rig_file(tmp_path), size), size, OpticsParameters())
    path, again = tmp_path / "one.npz", tmp_path / "two.npz"
    made.save(path)
    back = Calibration.load(path)
    back.save(again)
    assert again.read_bytes() == path.read_bytes()
    assert (back.similarity, back.texture, back.stripes) == (made.similarity, made.texture, None)
    assert back.full_scale == math.inf


def test_ratio_one_half_lies_midway_in_dioptres(tmp_path: Path) -> None:
    made = from_optics(read_rig(rig_file(tmp_path)), None, OpticsParameters())
    middle_m = float(made.z_m(np.array(made.curve[0, 0, 0])))
    assert 2 / middle_m == pytest.approx(1 / 0.8 + 1 / 1.2, rel=1e-3)
    assert 1e3 * made.near_z_m < 800 < 1200 < 1e3 * made.far_z_m


def test_the_principal_point_sets_where_the_images_scale_from(tmp_path: Path) -> None:
    path = rig_file(tmp_path, principal_point_px=[100.0, 140.0])
    rig = read_rig(path, WHOLE)
    made = from_optics(rig, WHOLE, OpticsParameters())
    assert made.similarity.far_from_near @ [100, 140, 1] == pytest.approx([100, 140])
    assert made.similarity.scale == pytest.approx(rig.sensor_mm("far") / rig.sensor_mm("near"))


# -- rigs -----------------------------------------------------------------------------------------


def test_sensor_distances_say_the_same_as_focus_distances(tmp_path: Path) -> None:
    by_focus = read_rig(rig_file(tmp_path))
    sensors = {f"{name}_sensor_mm": by_focus.sensor_mm(name) for name in ("near", "far")}
    by_sensor = read_rig(rig_file(tmp_path, near_focus_mm=None, far_focus_mm=None, **sensors))
    assert by_sensor.near_focus_mm == pytest.approx(800)
    assert by_sensor.far_focus_mm == pytest.approx(1200)
    endless = read_rig(rig_file(tmp_path, far_focus_mm="inf"))
    made = from_optics(endless, None, OpticsParameters())
    assert 20 < made.far_z_m < math.inf


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"f_number": None, "far_focus_mm": None}, "missing f_number, far_focus_mm or far_sensor"),
        ({"aperture": 3}, "unknown key 'aperture'"),
        ({"near_focus_mm": 40.0}, "a lens of 50 mm cannot focus at 40 mm"),
        ({"near_focus_mm": None, "near_sensor_mm": 49.0}, "a sensor 49 mm behind a lens of 50 mm"),
        ({"far_focus_mm": 700.0}, "far_focus_mm 700: expected beyond near_focus_mm 800"),
        ({"near_sensor_mm": 53.0}, "expected one of near_focus_mm, near_sensor_mm, found 2"),
        ({"f_number": '"wide"'}, "f_number: Input should be a valid number"),
        ({"near_focus_mm": None, "near_sensor_mm": '"x"'}, "near_sensor_mm: expected a number"),
        ({"width_px": 100, "height_px": 80}, "are 100×80, the images are 256×256"),
        ({"f_number": "= 3"}, "expected TOML"),
    ],
)
def test_a_rig_that_cannot_be_is_told_in_a_line(
    changes: dict[str, object], says: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=says) as raised:
        read_rig(rig_file(tmp_path, **changes), WHOLE)
    assert str(raised.value).startswith(str(tmp_path / "rig.toml"))
    assert "\n" not in str(raised.value)


def test_the_sensors_width_stands_for_the_pitch(tmp_path: Path) -> None:
    path = rig_file(tmp_path, pixel_pitch_mm=None, sensor_width_mm=25.6)
    assert read_rig(path, WHOLE).pixel_pitch_mm == pytest.approx(0.1)
    with pytest.raises(ValueError, match="sensor_width_mm: expected the images' size"):
        read_rig(path)


def test_a_rig_without_a_unique_range_is_refused(tmp_path: Path) -> None:
    rig = read_rig(rig_file(tmp_path, f_number=64.0))
    with pytest.raises(ValueError, match=r"no unique range .* 800 and 1200 mm: the blur circle"):
        from_optics(rig, None, OpticsParameters())

"""The rig and the thin lens: equations 1 and 2, reading and writing, and what cannot work."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import SCENE

from workbench.recording import Recording
from workbench_stages.optics.analytic import (
    disc_transfer,
    pattern_mean,
    pattern_value,
    pattern_waves,
    plane_image,
    ratio,
    shading,
)
from workbench_stages.optics.rig import Pattern, Projector, Rig
from workbench_stages.optics.thin_lens import blur_circle_mm, image_distance_mm, object_distance_mm


def test_the_papers_numbers() -> None:
    """700 mm and b = 0.8 mm put the far focal plane at 806 mm, and magnify by 1.0123."""
    rig = Rig()
    assert rig.sensor_mm("near") == pytest.approx(65.625)
    assert rig.far_focus_mm == pytest.approx(806.1, abs=0.05)
    assert rig.sensor_mm("near") / rig.sensor_mm("far") == pytest.approx(1.0123, abs=1e-4)
    assert rig.period_px("near") == pytest.approx(5.0, abs=0.01)


def test_blur_by_similar_triangles() -> None:
    """Equation 1 from v, equation 2 from u: the same circle, and none at the focal plane."""
    rig = Rig()
    for channel in ("near", "far"):
        s = rig.sensor_mm(channel)
        for u in (650.0, 750.0, 900.0):
            v = image_distance_mm(rig.focal_length_mm, u)
            assert rig.blur_mm(channel, u) == pytest.approx(rig.aperture_mm * (s - v) / v)
        assert rig.blur_mm(channel, rig.focus_mm(channel)) == pytest.approx(0, abs=1e-12)
        assert rig.blur_px(channel, 650.0) < 0 < rig.blur_px(channel, 900.0)
    assert blur_circle_mm(60, 20, 65, 700.0) == pytest.approx(2 * blur_circle_mm(60, 10, 65, 700.0))


def test_lens_law_is_its_own_inverse() -> None:
    for u in (80.0, 700.0, 5000.0):
        assert object_distance_mm(60, image_distance_mm(60, u)) == pytest.approx(u)


def test_a_recordings_rig_and_what_follows_from_it_are_written_as_they_were_recorded() -> None:
    recorded = Recording.open(SCENE).rig
    rig = Rig.from_metadata(recorded)
    assert rig == Rig()
    written = rig.to_metadata()
    # The table is the scene's, not the optics'.
    assert {key: written.get(key) for key in recorded if key != "z_table"} == {
        key: value for key, value in recorded.items() if key != "z_table"
    }


def test_a_rig_that_shares_no_value_with_the_usual_one_comes_back_from_its_metadata() -> None:
    rig = Rig(
        focal_length_mm=35.0,
        f_number=4.0,
        pixel_pitch_mm=0.02,
        near_focus_mm=300.0,
        sensor_separation_mm=0.6,
        width_px=320,
        height_px=200,
        principal_point_px=(150.5, 98.25),
        registered=False,
        far_scale=1.01,
        far_rotation_deg=0.5,
        far_shift_px=(1.5, -2.5),
        vignette_distance_mm=40.0,
        vignette_radius_mm=13.0,
        projector=Projector(
            pattern="dots",
            lines_per_mm=6.0,
            angle_deg=12.0,
            focus_mm=320.0,
            focal_length_mm=50.0,
            f_number=5.6,
            position_mm=(10.0, -60.0, 5.0),
        ),
    )
    usual, usual_projector = Rig(), Projector()
    assert all(getattr(rig, name) != getattr(usual, name) for name in Rig.model_fields)
    assert rig.projector is not None
    assert all(
        getattr(rig.projector, name) != getattr(usual_projector, name)
        for name in Projector.model_fields
    )
    written = rig.to_metadata()
    assert Rig.from_metadata(written) == rig
    assert Rig.from_metadata(written).to_metadata() == written
    # The record's angle counts clockwise as displayed.
    assert written["pat_angle"] == "-12.0"
    without = rig.model_copy(update={"projector": None})
    assert Rig.from_metadata(without.to_metadata()) == without


def test_metadata_says_what_follows_from_the_optics() -> None:
    """By the lens law: 1/35 = 1/300 + 1/s1, s2 = s1 - 0.6, D = 35/4."""
    rig = Rig(
        focal_length_mm=35.0, f_number=4.0, pixel_pitch_mm=0.02, near_focus_mm=300.0,
        sensor_separation_mm=0.6, width_px=320,
    )  # fmt: skip
    written = {key: float(value) for key, value in rig.to_metadata().items()
               if key not in ("pattern", "proj_pos", "raw_mag")}  # fmt: skip
    s1 = 1 / (1 / 35 - 1 / 300)
    s2 = s1 - 0.6
    u2 = 1 / (1 / 35 - 1 / s2)
    mean = (s1 + s2) / 2
    middle = 1 / (1 / 35 - 1 / mean)
    assert written["D"] == 8.75 and written["pitch_um"] == 20
    assert (written["s1"], written["s2"]) == pytest.approx((s1, s2), abs=1e-3)
    assert written["u2"] == pytest.approx(u2, abs=0.05)
    assert written["depth_span"] == pytest.approx(u2 - 300, abs=0.05)
    assert written["mag_ratio"] == pytest.approx(s1 / s2, abs=1e-5)
    # Half of the image's width, by how much the images differ in scale.
    assert written["edge_shift_px"] == pytest.approx(160 * (s1 / s2 - 1), abs=0.006)
    assert written["FOV_mid_mm"] == pytest.approx(320 * 0.02 * middle / mean, abs=0.05)
    blur_mm = 8.75 * (s1 - s2) / s2
    assert written["coc_at_other_plane_px"] == pytest.approx(blur_mm / 0.02, abs=0.006)
    assert written["coc_mid_px"] == pytest.approx(8.75 * (s1 / mean - 1) / 0.02, abs=0.006)


@pytest.mark.parametrize(("change", "u2"), [({"b": "0.8"}, 806.1), ({"u2": "790.0"}, 790.0)])
def test_the_far_sensor_is_given_by_its_distance_or_by_what_it_is_focused_on(
    change: dict[str, str], u2: float
) -> None:
    record = {"f": "60", "Fno": "2.8", "p": "0.05", "u1": "700"} | change
    rig = Rig.from_metadata(record)
    assert rig.far_focus_mm == pytest.approx(u2, abs=0.05)
    assert rig.projector is None and (rig.width_px, rig.height_px) == (256, 256)
    assert Rig.from_metadata(record | {"N": "512"}).height_px == 512


def test_toml_and_the_far_focus(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(
        "focal_length_mm = 50.0\nnear_focus_mm = 400.0\nfar_focus_mm = 450.0\n"
        "width_px = 320\nheight_px = 200\n[projector]\npattern = 'dots'\nfocus_mm = 420.0\n"
    )
    rig = Rig.from_toml(path)
    assert rig.far_focus_mm == pytest.approx(450)
    assert rig.centre_px == (159.5, 99.5)
    assert rig.projector is not None and rig.projector.pattern == "dots"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("near_focus_mm = 50.0", "a lens of 60 mm cannot focus at 50 mm"),
        ("sensor_separation_mm = 6.0", "is focused on nothing"),
        ("far_focus_mm = 600.0", "expected beyond near_focus_mm 700"),
        ("far_focus_mm = 'x'", "expected a number, found 'x'"),
        ("far_focus_mm = 800.0\nsensor_separation_mm = 1.0", "found both"),
        ("f_nummer = 2.0", "unknown key 'f_nummer'"),
        ("f_number = -1.0", "f_number: Input should be greater than 0, got -1.0"),
        ("projector.focus_mm = 3.0", "projector: a lens of 60 mm cannot focus at 3 mm"),
        ("projector.pattern = 'zebra'", "projector.pattern: "),
        ("f_number = [", "not TOML"),
    ],
)
def test_a_rig_that_cannot_be_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=r"rig\.toml: ") as raised:
        Rig.from_toml(path)
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)


def test_metadata_without_optics_is_one_line() -> None:
    with pytest.raises(ValueError, match="expected the key 'f'"):
        Rig.from_metadata({"camera": "left"})
    with pytest.raises(ValueError, match="f: expected a number, found 'long'"):
        Rig.from_metadata({"f": "long"})


def test_unique_range() -> None:
    """The paper's pitch works at f/7 and not at f/2.8, where the ratio folds back."""
    assert Rig().working_range_mm == pytest.approx((700, 806.1), abs=0.1)
    fine = Rig(pixel_pitch_mm=0.02, f_number=7, projector=Projector(lines_per_mm=10))
    assert fine.working_range_mm == pytest.approx((700, 806.1), abs=0.1)
    folded = fine.model_copy(update={"f_number": 2.8})
    with pytest.raises(ValueError, match="no unique range between the focal planes 700 and 806"):
        _ = folded.working_range_mm


def test_disc_transfer_is_that_of_a_disc() -> None:
    """Against the sum over points of a disc, at frequencies on both sides of its zero."""
    y, x = np.mgrid[-200:201, -200:201] / 400
    inside = np.hypot(x, y) <= 0.5
    for cycles in (0.0, 0.4, 1.0, 1.22, 2.0):
        summed = np.cos(2 * np.pi * cycles * x[inside]).mean()
        assert disc_transfer(cycles) == pytest.approx(summed, abs=2e-3)


@pytest.mark.parametrize("pattern", ["stripes", "sine", "checker", "dots"])
def test_waves_of_a_pattern_sum_to_it(pattern: Pattern) -> None:
    y, x = np.mgrid[0:64, 0:64] / 64 + 1 / 128
    summed = np.full(x.shape, pattern_mean(pattern))
    for m, n, amplitude in pattern_waves(pattern):
        summed += 2 * (amplitude * np.exp(2j * np.pi * (m * x + n * y))).real
    value = pattern_value(pattern, x, y)
    assert value.mean() == pytest.approx(pattern_mean(pattern), abs=0.01)
    assert np.sqrt(((summed - value) ** 2).mean()) < 0.16  # what the cut-off series leaves


def test_image_is_sharp_at_its_own_plane_and_blurred_at_the_other() -> None:
    rig = Rig(width_px=40, height_px=30)
    for channel, other in (("near", "far"), ("far", "near")):
        depth = rig.focus_mm(channel)
        assert plane_image(rig, channel, depth).std() > 0.25
        assert plane_image(rig, other, depth).std() < 0.05
    assert plane_image(rig, "near", 750.0).shape == (30, 40)


def test_ratio_falls_from_the_near_to_the_far_plane() -> None:
    rig = Rig()
    depth = np.linspace(*rig.working_range_mm, 30)
    values = ratio(rig, depth)
    assert (np.diff(values) < 0).all()
    assert values[0] > 0.7 and values[-1] < -0.7


def test_projector_is_sharp_where_its_axis_meets_the_cameras() -> None:
    """Shifted by one period the pattern repeats; the focal plane goes through (0, 0, focus)."""
    projector = Projector(position_mm=(30.0, -80.0, 5.0), angle_deg=10.0)
    meeting = np.array([0.0, 0.0, projector.focus_mm])
    np.testing.assert_allclose(projector.cycles(meeting), 0, atol=1e-9)
    right, down, forward = projector.axes
    np.testing.assert_allclose(projector.axes @ projector.axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(projector.axes) == pytest.approx(1)
    for point in (meeting, meeting + 20 * right, meeting - 30 * down):
        assert projector.blur_mm(point) == pytest.approx(0, abs=1e-9)
        # Counter-clockwise as displayed, with y down.
        turn = np.deg2rad(10.0)
        across = np.cos(turn) * right - np.sin(turn) * down
        np.testing.assert_allclose(
            projector.cycles(point + projector.period_mm * across) - projector.cycles(point),
            [1, 0],
            atol=1e-9,
        )
    behind = meeting + 50 * forward
    expected = projector.aperture_mm * 50 / (projector.focal_plane_mm + 50)
    assert projector.blur_mm(behind) == pytest.approx(expected)


def test_irradiance_is_one_at_the_focus_distance_and_falls_with_its_square() -> None:
    projector = Projector(position_mm=(0.0, 0.0, 0.0))
    facing = np.array([0.0, 0.0, -1.0])
    assert projector.irradiance(np.array([0, 0, 750.0]), facing) == pytest.approx(1)
    assert projector.irradiance(np.array([0, 0, 1500.0]), facing) == pytest.approx(0.25)
    assert projector.irradiance(np.array([0, 0, 750.0]), -facing) == 0
    oblique = np.array([750.0, 0, 750.0])  # 45°: both cosines, and √2 as far
    assert projector.irradiance(oblique, facing) == pytest.approx(0.25)


def test_analytic_plane_against_a_ray_traced_one() -> None:
    """A recorded plane, with the pattern turned and its own magnification for each sensor."""
    recording = Recording.open(SCENE.with_name("unregistered.mcap"))
    rig = Rig.from_metadata(recording.rig)
    frames = recording.frames(["near", "far"])
    plane = next(f for f in frames if f.truth and f.truth.meta.get("z") == 733.0)
    for channel in ("near", "far"):
        projected, sky = shading(rig, channel, 733.0)
        light = 0.78 * (plane_image(rig, channel, 733.0) * projected + sky)
        middle = (slice(64, 192), slice(64, 192))  # the rest is vignetted
        error = plane.images[channel][middle] / 255 - light[middle]
        assert np.sqrt((error**2).mean()) < 0.02  # mostly noise of sensor and ray tracer
        assert abs(error.mean()) < 0.003


# -- exact figures, nothing symmetric --------------------------------------------------------------

UNLIKE = {
    "focal_length_mm": 40.0, "f_number": 4.0, "pixel_pitch_mm": 0.02, "near_focus_mm": 500.0,
    "sensor_separation_mm": 0.5, "width_px": 320, "height_px": 200, "registered": False,
    "principal_point_px": (150.0, 110.0), "far_scale": 1.01, "far_rotation_deg": 0.7,
    "far_shift_px": (1.5, -2.5), "vignette_distance_mm": 30.0, "vignette_radius_mm": 8.0,
    "projector": {
        "pattern": "checker", "lines_per_mm": 6.0, "angle_deg": 20.0, "focus_mm": 520.0,
        "focal_length_mm": 50.0, "f_number": 5.0, "position_mm": (10.0, -70.0, 4.0),
    },
}  # fmt: skip


def test_every_field_of_a_rig_comes_back_from_a_recordings_metadata() -> None:
    rig = Rig.from_values(UNLIKE, "here")
    assert Rig.from_metadata(rig.to_metadata()) == rig
    record = rig.to_metadata()
    # The record's angle counts clockwise as displayed; b is the separation, N the width.
    assert (record["pat_angle"], record["b"], record["N"]) == ("-20.0", "0.5", "320")
    assert (record["width"], record["height"]) == ("320", "200")
    assert (record["cx"], record["cy"]) == ("150.0", "110.0")
    assert (record["raw_mag"], record["pattern"]) == ("True", "checker")
    alone = Rig.from_values(UNLIKE | {"projector": None, "registered": True}, "here")
    assert Rig.from_metadata(alone.to_metadata()) == alone
    by_focus = {k: v for k, v in record.items() if k != "b"} | {"u2": str(rig.far_focus_mm)}
    assert Rig.from_metadata(by_focus).sensor_separation_mm == pytest.approx(0.5)


def test_a_record_that_says_little_takes_the_recordings_defaults() -> None:
    record = {"f": "60", "Fno": "2.8", "p": "0.05", "u1": "700", "b": "0.8", "N": "128"}
    rig = Rig.from_metadata(record)
    assert (rig.width_px, rig.height_px, rig.centre_px) == (128, 128, (63.5, 63.5))
    assert rig.registered and rig.projector is None and rig.far_scale == 1
    assert rig.far_shift_px == (0, 0) and rig.far_rotation_deg == 0
    assert rig.vignette_distance_mm == rig.vignette_radius_mm == 0
    for raw, registered in (("True", False), ("1", False), ("False", True), ("no", True)):
        assert Rig.from_metadata(record | {"raw_mag": raw}).registered == registered
    size = Rig.from_metadata({k: v for k, v in record.items() if k != "N"})
    assert (size.width_px, size.height_px) == (256, 256)
    striped = Rig.from_metadata(record | {"grating": "4", "proj_u": "750", "proj_Fno": "4.4"})
    assert striped.projector is not None
    assert striped.projector.pattern == "stripes"
    assert striped.projector.focal_length_mm == 60
    assert striped.projector.position_mm == (0, 0, 0)
    with pytest.raises(ValueError, match="expected one of stripe"):
        Rig.from_metadata(record | {"grating": "4", "pattern": "zebra"})
    with pytest.raises(ValueError, match=r"proj_pos: expected \[x, y, z\]"):
        Rig.from_metadata(
            record | {"grating": "4", "proj_u": "750", "proj_Fno": "4", "proj_pos": "[1, 2]"}
        )


def test_derived_lengths_of_a_rig() -> None:
    """s = 1 / (1/40 - 1/500) mm and half a millimetre less, an aperture of 10 mm, 20 µm pixels."""
    rig = Rig.from_values(UNLIKE, "here")
    s1 = 1 / (1 / 40 - 1 / 500)
    s2 = s1 - 0.5
    assert (rig.sensor_mm("near"), rig.sensor_mm("far")) == pytest.approx((s1, s2))
    u2 = 1 / (1 / 40 - 1 / s2)
    assert rig.far_focus_mm == rig.focus_mm("far") == pytest.approx(u2)
    assert rig.focus_mm("near") == 500 < u2
    assert rig.aperture_mm == 10
    assert (rig.focal_px("near"), rig.focal_px("far")) == pytest.approx((s1 / 0.02, s2 / 0.02))
    both = Rig.from_values(UNLIKE | {"registered": True}, "here")
    mean = (s1 + s2) / 2 / 0.02
    assert both.focal_px("near") == both.focal_px("far") == pytest.approx(mean)
    np.testing.assert_allclose(
        rig.camera_matrix("far"), [[s2 / 0.02, 0, 150], [0, s2 / 0.02, 110], [0, 0, 1]]
    )
    # Equation 2: D s (1/f - 1/u - 1/s), in pixels of an image that may be resampled.
    depth = np.array([450.0, 500.0, 560.0])
    for channel, s in (("near", s1), ("far", s2)):
        blur = 10 * s * (1 / 40 - 1 / depth - 1 / s)
        np.testing.assert_allclose(rig.blur_mm(channel, depth), blur, atol=1e-12)
        np.testing.assert_allclose(rig.blur_px(channel, depth), blur / 0.02, atol=1e-9)
        np.testing.assert_allclose(both.blur_px(channel, depth), blur * mean / s, atol=1e-9)
    period_mm = 520 / (1 / (1 / 50 - 1 / 520)) / 6
    assert rig.projector is not None and rig.projector.aperture_mm == 10
    assert rig.projector.period_mm == pytest.approx(period_mm)
    assert rig.period_px("far") == pytest.approx(period_mm * s2 / 0.02 / 520)
    with pytest.raises(ValueError, match="no projector"):
        Rig.from_values(UNLIKE | {"projector": None}, "here").period_px("near")


@pytest.mark.parametrize(("u", "f", "v"), [(100.0, 50.0, 100.0), (150.0, 50.0, 75.0)])
def test_the_lens_law_in_whole_numbers(u: float, f: float, v: float) -> None:
    assert image_distance_mm(f, u) == pytest.approx(v)
    assert object_distance_mm(f, v) == pytest.approx(u)
    for function in (image_distance_mm, object_distance_mm):
        with pytest.raises(ValueError, match="focal length"):
            function(f, f)
        assert function(f, f * 1.0001) > 0


def test_the_ratio_has_its_sign_and_a_checkers_waves_run_diagonally() -> None:
    for pattern, factor in (("stripes", 1.0), ("checker", 2**0.5), ("dots", 1.0)):
        rig = Rig(projector=Projector(pattern=pattern))  # type: ignore[arg-type]
        depth = np.array([710.0, 750.0, 800.0])
        energies = [
            np.abs(disc_transfer(factor * rig.blur_px(c, depth) / rig.period_px(c)))  # type: ignore[arg-type]
            for c in ("near", "far")
        ]
        wanted = (energies[0] - energies[1]) / (energies[0] + energies[1])
        np.testing.assert_allclose(ratio(rig, depth), wanted)
        assert wanted[0] > 0 > wanted[2]
    alone = Rig(projector=None)
    energies = [np.abs(disc_transfer(alone.blur_px(c, 720.0) / 5)) for c in ("near", "far")]  # type: ignore[arg-type]
    wanted = (energies[0] - energies[1]) / (energies[0] + energies[1])
    assert ratio(alone, np.array(720.0)) == pytest.approx(wanted)


@pytest.mark.parametrize(
    ("angle_deg", "width", "height"), [(0, 96, 70), (90, 70, 96), (30, 96, 72)]
)
def test_a_plane_image_has_the_patterns_period_direction_and_shape(
    angle_deg: float, width: int, height: int
) -> None:
    from workbench_stages.dfd.stripes import measure_stripes

    rig = Rig(
        width_px=width, height_px=height,
        projector=Projector(angle_deg=angle_deg, position_mm=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    image = plane_image(rig, "near", 705.0)
    assert image.shape == (height, width)
    assert image.min() >= 0 and image.max() <= 1
    assert image.mean() == pytest.approx(0.5, abs=0.02)
    stripes = measure_stripes(image)
    assert stripes is not None
    assert stripes.period_px == pytest.approx(rig.period_px("near"), rel=0.02)
    assert stripes.angle_deg == pytest.approx(angle_deg, abs=1)
    with pytest.raises(ValueError, match="no projector"):
        plane_image(Rig(projector=None), "near", 705.0)


def test_light_falls_off_from_the_principal_point_and_with_distance() -> None:
    """cos⁴ of the camera for the sky; the projector's own cosines and inverse square besides."""
    rig = Rig(
        width_px=80, height_px=50, principal_point_px=(10.0, 40.0),
        projector=Projector(position_mm=(0.0, 0.0, 0.0)),
    )  # fmt: skip
    light, sky = shading(rig, "near", 750.0, sky=0.1)
    assert light.shape == sky.shape == (50, 80)
    assert (light[40, 10], sky[40, 10]) == pytest.approx((1, 0.1))
    focal = rig.focal_px("near")
    cosine = 1 / np.sqrt(1 + (60 / focal) ** 2 + (30 / focal) ** 2)
    assert sky[10, 70] == pytest.approx(0.1 * cosine**4)
    assert light[10, 70] == pytest.approx(cosine**4 * cosine**4)
    assert shading(rig, "near", 1500.0)[0][40, 10] == pytest.approx(0.25)
    assert shading(rig, "near", 750.0)[1][40, 10] == pytest.approx(0.02)
    with pytest.raises(ValueError, match="no projector"):
        shading(Rig(projector=None), "near", 750.0)

"""``workbench import`` and ``calibrate --from-optics``: from image files to depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from PIL import Image
from textures import pair, sharp, write_rig

from workbench.errors import DataError
from workbench.importing import (
    Picture,
    choose_planes,
    exif,
    linear_light,
    pair_files,
    read_picture,
)
from workbench.recording import Recording
from workbench_stages.dfd.from_optics import read_rig

Bench = Any


def write(path: Path, image: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    ordered = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    assert cv2.imwrite(str(path), ordered)
    return path


def picture(seed: int = 0, shape: tuple[int, ...] = (24, 32), dtype: type = np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, shape, dtype=dtype, endpoint=True)


def frames(path: Path) -> list[Any]:
    recording = Recording.open(path)
    found = list(recording.frames(["near", "far"], ["flat"]))
    # Without a rig there is no camera to tell of.
    assert {defect.kind for defect in recording.scan()} <= {"missing_calibration"}
    return found


# -- one pair -------------------------------------------------------------------------------------


KINDS = [
    (suffix, shape, dtype)
    for suffix in ("png", "tif", "bmp")
    for shape in ((24, 32), (5, 7, 3))
    for dtype in (np.uint8, np.uint16)
    if (suffix, dtype) != ("bmp", np.uint16)
]


@pytest.mark.parametrize(("suffix", "shape", "dtype"), KINDS)
def test_pixels_come_back_as_they_were(
    suffix: str, shape: tuple[int, ...], dtype: type, bench: Bench, tmp_path: Path
) -> None:
    images = [picture(seed, shape, dtype) for seed in range(3)]
    names = [write(tmp_path / f"{k}.{suffix}", image) for k, image in enumerate(images)]
    ended = bench(
        "import", "--near", names[0], "--far", names[1], "--flat", names[2], "-o", "r.mcap"
    )
    assert ended.code == 0, ended.err
    (frame,) = frames(tmp_path / "r.mcap")
    for channel, image in zip(("near", "far", "flat"), images, strict=True):
        np.testing.assert_array_equal(frame.images[channel], image)


def test_a_jpeg_is_stored_byte_for_byte_and_its_curve_is_told_of(
    bench: Bench, tmp_path: Path
) -> None:
    near = write(tmp_path / "a.jpg", picture(0, (40, 40, 3)))
    far = write(tmp_path / "b.jpg", picture(1, (40, 40, 3)))
    ended = bench("import", "--near", near, "--far", far, "-o", "r.mcap", "--json")
    with (tmp_path / "r.mcap").open("rb") as file:
        messages = [message.data for _, _, message in make_reader(file).iter_messages()]
    assert any(near.read_bytes() in data for data in messages)
    (frame,) = frames(tmp_path / "r.mcap")
    np.testing.assert_array_equal(frame.images["near"], read_picture(near).pixels)
    assert "--transfer srgb" in ended.json["notes"][0]
    again = bench(
        "import", "--near", near, "--far", far, "-o", "s.mcap", "--transfer", "srgb", "--json"
    )
    assert again.json["notes"] == []
    (linear,) = frames(tmp_path / "s.mcap")
    assert linear.images["near"].dtype == np.uint16


def test_srgb_is_undone() -> None:
    levels = np.arange(256, dtype=np.uint8)
    linear = linear_light(levels, "srgb").astype(float) / 65535
    assert linear[0] == 0 and linear[-1] == 1
    assert linear[188] == pytest.approx(0.5, abs=0.005)
    assert (np.diff(linear) > 0).all()
    wide = linear_light(np.array([[188 * 257]], np.uint16), "srgb")
    assert float(wide[0, 0]) / 65535 == pytest.approx(linear[188], abs=1e-4)


def test_the_rig_gives_cameras_and_metadata(bench: Bench, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig.toml", principal_point_px=[10.0, 14.0])
    near = write(tmp_path / "a.png", picture(0))
    far = write(tmp_path / "b.png", picture(1))
    ended = bench("import", "--near", near, "--far", far, "--rig", rig, "-o", "r.mcap")
    assert ended.code == 0, ended.err
    (frame,) = frames(tmp_path / "r.mcap")
    optics = read_rig(rig, (32, 24))
    for channel in ("near", "far"):
        camera = frame.cameras[channel]
        assert (camera.width, camera.height) == (32, 24)
        assert camera.K[0, 0] == pytest.approx(optics.sensor_mm(channel) / optics.pixel_pitch_mm)
        assert camera.K[:2, 2] == pytest.approx([10, 14])
    assert float(Recording.open(tmp_path / "r.mcap").rig["u2"]) == pytest.approx(1200)


def test_the_same_files_give_the_same_bytes(bench: Bench, tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig.toml")
    near, far = (write(tmp_path / f"{k}.tif", picture(k)) for k in range(2))
    for name in ("a.mcap", "b.mcap"):
        bench("import", "--near", near, "--far", far, "--rig", rig, "-o", name)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


# -- folders of pairs -----------------------------------------------------------------------------


def test_folders_are_paired_by_their_names(bench: Bench, tmp_path: Path) -> None:
    for k in (1, 2, 10):
        write(tmp_path / "n" / f"shot{k}.png", picture(k))
    for k in (2, 10, 11):
        write(tmp_path / "f" / f"shot{k}.png", picture(100 + k))
    ended = bench("import", "--near", "n", "--far", "f", "-o", "r.mcap", "--rate", 4, "--json")
    assert ended.json["frames"] == 2 and ended.json["paired_by"] == "names"
    assert sorted(Path(p).name for p in ended.json["left_out"]) == ["shot1.png", "shot11.png"]
    found = frames(tmp_path / "r.mcap")
    for frame, k in zip(found, (2, 10), strict=True):
        np.testing.assert_array_equal(frame.images["near"], picture(k))
        np.testing.assert_array_equal(frame.images["far"], picture(100 + k))
    assert found[1].stamp_ns - found[0].stamp_ns == 250_000_000


@pytest.mark.parametrize(
    ("near", "far", "how"),
    [
        ("one/*_near.png", "one/*_far.png", "names"),
        ("n", "f", "names"),
        ("n", "other", "order of names"),
    ],
)
def test_one_folder_with_a_pattern_or_names_with_the_channel(
    near: str, far: str, how: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for k in range(3):
        write(Path("one") / f"{k}_near.png", picture(k))
        write(Path("one") / f"{k}_far.png", picture(k))
        write(Path("n") / f"near-{k}.png", picture(k))
        write(Path("f") / f"far-{k}.png", picture(k))
        write(Path("other") / f"DSC{7 * k}.png", picture(k))
    found = pair_files({"near": near, "far": far})
    assert found.how == how and not found.left_out and len(found.frames) == 3
    for k, frame in enumerate(found.frames):
        np.testing.assert_array_equal(read_picture(frame["near"]).pixels, picture(k))
        np.testing.assert_array_equal(read_picture(frame["far"]).pixels, picture(k))


def test_stamps_are_those_of_the_camera(bench: Bench, tmp_path: Path) -> None:
    for folder in ("n", "f"):
        (tmp_path / folder).mkdir()
        for k in range(2):
            tags = Image.Exif()
            inner = tags.get_ifd(0x8769)
            inner[36867], inner[37521] = f"2024:05:01 12:00:0{k}", "25"
            inner[36881], inner[33437] = "+02:00", 2.8
            Image.fromarray(picture(k)).save(tmp_path / folder / f"{k}.jpg", exif=tags)
    ended = bench("import", "--near", "n", "--far", "f", "-o", "r.mcap", "--json")
    assert ended.json["stamps_from"] == "EXIF"
    assert ended.json["lens_by_EXIF"] == ["FNumber 2.8"]
    found = frames(tmp_path / "r.mcap")
    assert found[0].stamp_ns == 1_714_557_600_250_000_000
    assert found[1].stamp_ns - found[0].stamp_ns == 10**9
    assert exif(write(tmp_path / "bare.png", picture())) == {}


# -- focal stacks ---------------------------------------------------------------------------------


def stack(count: int = 7) -> list[np.ndarray]:
    """Left third in focus in plane 1, the middle in plane 3, the right in plane 5."""
    image, third = sharp("fine"), 256 // 3
    planes = []
    for k in range(count):
        parts = [
            cv2.GaussianBlur(image, (0, 0), 0.3 + abs(k - best))[:, start : start + third]
            for best, start in ((1, 0), (3, third), (5, 2 * third))
        ]
        planes.append(np.clip(np.hstack(parts), 0, 255).astype(np.uint8))
    return planes


def test_the_planes_that_take_the_scene_between_them_are_chosen(
    bench: Bench, tmp_path: Path
) -> None:
    planes = stack()
    for k, plane in enumerate(planes):
        write(tmp_path / "s" / f"{k}.png", plane)
    assert choose_planes([Picture(Path(), plane, None) for plane in planes]) == (1, 5)
    ended = bench("import", "--stack", "s", "-o", "r.mcap", "--json")
    assert ended.json["planes"] == [1, 5] and ended.json["planes_of"] == 7
    (frame,) = frames(tmp_path / "r.mcap")
    np.testing.assert_array_equal(frame.images["near"], planes[1])
    bench("import", "--stack", "s", "--planes", "4,0", "-o", "r.mcap")
    (frame,) = frames(tmp_path / "r.mcap")
    np.testing.assert_array_equal(frame.images["near"], planes[4])
    np.testing.assert_array_equal(frame.images["far"], planes[0])


def test_pages_of_a_tiff_are_a_stack(bench: Bench, tmp_path: Path) -> None:
    planes = stack()
    assert cv2.imwritemulti(str(tmp_path / "s.tif"), planes)
    ended = bench("import", "--stack", "s.tif", "-o", "r.mcap", "--json")
    assert ended.json["planes"] == [1, 5]
    (frame,) = frames(tmp_path / "r.mcap")
    np.testing.assert_array_equal(frame.images["far"], planes[5])


# -- to depth -------------------------------------------------------------------------------------


def test_from_pictures_and_lens_data_to_depth(bench: Bench, tmp_path: Path) -> None:
    path = write_rig(tmp_path / "rig.toml")
    depth_mm = np.where(np.arange(256)[None] < 128, 870.0, 1080.0) * np.ones((256, 1))
    rig = read_rig(path, (256, 256))
    near, far = pair(rig, sharp("natural"), depth_mm)
    write(tmp_path / "n.png", near)
    write(tmp_path / "f.png", far)
    bench("import", "--near", "n.png", "--far", "f.png", "--rig", path, "-o", "r.mcap")
    for source in ("rig.toml", "r.mcap"):
        ended = bench(
            "calibrate", "r.mcap", "--from-optics", source, "-o", "r.calibration.npz", "--json"
        )
        assert ended.code == 0, ended.err
        assert ended.json["image_size"] == "256×256" and "thin lens" in ended.json["assumed"]
        out = f"out-{source}"
        ended = bench("export", "r.mcap", "--to", out, "--until", "depth_cloud")
        assert ended.code == 0, ended.err
        with np.load(tmp_path / out / "frame_000000.npz") as arrays:
            found, points = arrays["depth_m"], arrays["cloud_xyz_m"]
        left, right = (float(np.nanmedian(1e3 * half)) for half in (found[:, :100], found[:, 156:]))
        assert left == pytest.approx(870, rel=0.03) and right == pytest.approx(1080, rel=0.03)
        assert len(points) == np.isfinite(found).sum()
        np.testing.assert_array_equal(
            np.load(tmp_path / "out-rig.toml" / "frame_000000.npz")["depth_m"], found
        )


def test_a_striped_recording_is_measured_by_its_rig_alone(bench: Bench, scene: Path) -> None:
    ended = bench("calibrate", scene, "--from-optics", scene, "-o", "c.npz")
    assert ended.code == 0, ended.err
    flags = ("--frames", "0:3", "--until", "depth_cloud", "--json")
    ended = bench("evaluate", scene, "--calibration", "c.npz", *flags)
    assert ended.code == 0, ended.err
    scores = ended.json["presets"]["default"]["depth_cloud"]
    (rms,) = [one["value"] for one in scores if one["name"] == "faces' interior rms"]
    assert rms < 0.6


def test_a_calibration_of_another_size_is_refused_and_one_of_any_is_not(
    bench: Bench, tmp_path: Path
) -> None:
    rig = write_rig(tmp_path / "rig.toml")
    near, far = (write(tmp_path / f"{k}.png", picture(k, (64, 80))) for k in range(2))
    bench("import", "--near", near, "--far", far, "-o", "r.mcap")
    for size, code in (("80x64", 0), ("64x80", 1), (None, 0)):
        flags = [] if size is None else ["--image-size", size]
        ended = bench("calibrate", "--from-optics", rig, *flags, "-o", "c.npz")
        assert ended.code == 0, ended.err
        replayed = bench(
            "export", "r.mcap", "--calibration", "c.npz", "--to", "o", "--until", "depth_cloud"
        )
        assert replayed.code == code


# -- mistakes -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "code", "says"),
    [
        ("import --stack lone -o r.mcap", 1, "--stack lone: expected two images or more"),
        ("import --stack a.png -o r.mcap", 1, "--stack a.png: expected two images or more"),
        ("import --stack mixed -o r.mcap", 1, "0.png 32×24 and mixed/1.png 16×12"),
        ("import --stack none -o r.mcap", 1, "--stack none: expected a folder or a file"),
        ("import --stack pair --near a.png -o r.mcap", 2, "--stack: expected it alone"),
        ("import --stack pair --planes 0,2 -o r.mcap", 2, "two different numbers from 0 to 1"),
        ("import --stack pair --planes x -o r.mcap", 2, "--planes x: expected I,J"),
        ("import --near a.png --far small.png -o r.mcap", 1, "a.png 32×24 and small.png 16×12"),
        ("import --near a.png -o r.mcap", 2, "--far: expected a file, a folder or a pattern"),
        ("import --near a.png --far pair -o r.mcap", 1, "--near a.png: expected a folder"),
        ("import --near pair --far lone -o r.mcap", 1, None),
        ("import --near three --far pair2 -o r.mcap", 1, "3 in --near three, 2 in --far pair2"),
        ("import --near empty --far pair -o r.mcap", 1, "--near empty: no image in it (.png"),
        ("import --near x*.png --far pair -o r.mcap", 1, "--near x*.png: no file is called so"),
        ("import --near gone.png --far a.png -o r.mcap", 1, "--near gone.png: expected a file"),
        ("import --near text.png --far a.png -o r.mcap", 1, "text.png: expected an image"),
        ("import --near cut.png --far a.png -o r.mcap", 1, "cut.png: the PNG is cut"),
        ("import --near a.png --far b.png -o none/r.mcap", 1, "there is no folder none"),
        ("import --near a.png --far b.png -o r.mcap --rate 0", 2, "--rate 0: expected more"),
        ("import --near a.png --far b.png -o r.mcap --planes 0,1", 2, "--planes: expected with"),
        ("import --near a.png --far b.png -o r.mcap --transfer log", 2, "expected linear or srgb"),
        ("import --near a.png --far b.png -o r.mcap --channel x", 2, "expected CHANNEL=FILES"),
        ("import --near a.png --far b.png -o r.mcap --rig gone.toml", 1, "gone.toml: No such"),
        ("import --near a.png --far b.png -o r.mcap --rig few.toml", 1, "few.toml: missing f_nu"),
        ("import --near a.png --far b.png -o r.mcap --rig size.toml", 1, "the images are 32×24"),
        ("import --near f.tif --far f.tif -o r.mcap --transfer srgb", 2, "found float32"),
        ("calibrate --from-optics few.toml -o c.npz", 1, "few.toml: missing f_number"),
        ("calibrate --from-optics odd.toml -o c.npz", 1, "odd.toml: unknown key 'aperture'"),
        ("calibrate --from-optics blunt.toml -o c.npz", 1, "blunt.toml: no unique range"),
        ("calibrate --from-optics close.toml -o c.npz", 1, "close.toml: a lens of 50 mm cannot"),
        ("calibrate --from-optics gone.mcap -o c.npz", 1, "gone.mcap: expected an MCAP file"),
        ("calibrate --from-optics rig.toml --image-size 7 -o c.npz", 2, "7: expected WxH"),
        ("calibrate --from-optics rig.toml --set x=1 -o c.npz", 2, "calibrate.beyond_percent"),
        ("calibrate -o c.npz", 2, "expected a recording of known planes, or --from-optics"),
        ("calibrate rig.toml --image-size 4x4 -o c.npz", 2, "--image-size: expected with --from"),
    ],
)
def test_a_mistake_is_one_line(
    line: str, code: int, says: str | None, bench: Bench, tmp_path: Path
) -> None:
    for k, name in enumerate(("a", "b", "pair/0", "pair/1", "pair2/p", "pair2/q", "lone/x")):
        write(tmp_path / f"{name}.png", picture(k))
    for k in range(3):
        write(tmp_path / "three" / f"{k}.png", picture(k))
    write(tmp_path / "small.png", picture(0, (12, 16)))
    write(tmp_path / "mixed" / "0.png", picture(0))
    write(tmp_path / "mixed" / "1.png", picture(1, (12, 16)))
    write(tmp_path / "f.tif", picture(0).astype(np.float32))
    (tmp_path / "empty").mkdir()
    (tmp_path / "text.png").write_text("no picture")
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:-40])
    write_rig(tmp_path / "rig.toml")
    write_rig(tmp_path / "few.toml", f_number=None)
    write_rig(tmp_path / "odd.toml", aperture=3)
    write_rig(tmp_path / "blunt.toml", f_number=100.0)
    write_rig(tmp_path / "close.toml", near_focus_mm=30.0)
    write_rig(tmp_path / "size.toml", width_px=640, height_px=480)
    ended = bench(*line.split())
    assert ended.code == code
    if says is None:
        assert ended.mistake
    else:
        assert says in ended.mistake
    assert not (tmp_path / "r.mcap").exists() and not (tmp_path / "c.npz").exists()


def test_no_names_and_no_counts_in_common(tmp_path: Path) -> None:
    write(tmp_path / "n" / "p.png", picture())
    for k in range(2):
        write(tmp_path / "f" / f"{k}.png", picture())
    with pytest.raises(DataError, match="expected names in common or as many"):
        pair_files({"near": str(tmp_path / "n"), "far": str(tmp_path / "f")})

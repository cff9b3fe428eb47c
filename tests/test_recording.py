"""A tidy recording reads the same in every dialect, and every encoding gives the right pixels."""

from __future__ import annotations

import hashlib
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap_fixtures import (
    COMPRESSIONS,
    DIALECTS,
    START_NS,
    Recorder,
    picture,
    stamp_of,
    write_scene,
)

from workbench.recording import ENCODINGS, Frame, Recording, RecordingError

PAIR = ("near", "far")


def frames_of(path: Path, **options: object) -> list[Frame]:
    return list(Recording.open(path).frames(PAIR, ["flat"], **options))  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=DIALECTS)
def scene(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scene") / f"{request.param}.mcap", request.param)


def test_frames_carry_all_that_was_recorded(scene: Path) -> None:
    recording = Recording.open(scene)
    frames = list(recording.frames(PAIR, ["flat"]))
    assert [frame.index for frame in frames] == list(range(12))
    for frame in frames:
        assert frame.stamp_ns == stamp_of(frame.index)
        assert list(frame.images) == ["near", "far", "flat"]
        for channel, image in frame.images.items():
            np.testing.assert_array_equal(image, picture(channel, frame.index))
            assert not image.flags.writeable
            assert frame.stamps_ns[channel] == stamp_of(frame.index)
        camera = frame.cameras["near"]
        assert (camera.width, camera.height, camera.distortion_model) == (32, 24, "plumb_bob")
        np.testing.assert_array_equal(camera.K, [[50, 0, 15.5], [0, 50, 11.5], [0, 0, 1]])
        assert camera.K.dtype == np.float64 and camera.D.tolist() == [0.1] * 5
        assert camera.stamp_ns == START_NS and camera.frame_id == "camera"
        assert frame.defects == ()
        truth = frame.truth
        assert truth is not None and truth.depth_m is not None
        assert truth.depth_m.dtype == np.float32 and np.isnan(truth.depth_m[0, 0])
        np.testing.assert_array_equal(truth.instances, picture("instances", frame.index))
        np.testing.assert_array_equal(truth.faces, picture("faces", frame.index))
        assert truth.meta == {"kind": "pile", "frame": frame.index}
        turned = truth.camera_from_object["object_2_hex"]
        np.testing.assert_allclose(
            turned, [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.7], [0, 0, 0, 1]], atol=1e-15
        )
        assert truth.camera_from_object["object_1_bar"][:3, 3].tolist() == [0.1, 0.2, 0.8]
    assert not recording.defects
    assert dict(recording.rig) == {"f": "60.0", "pattern": "stripe"}


def test_every_dialect_gives_the_same_digests(tmp_path: Path) -> None:
    digests = [
        [frame.digest for frame in frames_of(write_scene(tmp_path / f"{dialect}.mcap", dialect))]
        for dialect in DIALECTS
    ]
    assert digests[0] == digests[1] == digests[2]
    assert len(set(digests[0])) == 12


def test_the_digest_tells_dtype_shape_and_channel_apart(tmp_path: Path) -> None:
    def digest(image: np.ndarray, encoding: str, channel: str) -> str:
        with Recorder(tmp_path / "one.mcap") as recorder:
            recorder.image(f"/camera/{channel}/image", START_NS, image, encoding)
        (frame,) = Recording.open(tmp_path / "one.mcap").frames([channel])
        return frame.digest

    wide = np.arange(8, dtype=np.uint8).reshape(2, 4)
    digests = [
        digest(wide, "mono8", "near"),
        digest(wide, "mono8", "far"),
        digest(wide.reshape(4, 2), "mono8", "near"),
        digest(wide.view(np.uint16), "mono16", "near"),
    ]
    assert len(set(digests)) == 4


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_compression_and_chunking_change_nothing(tmp_path: Path, compression: str) -> None:
    expected = [frame.digest for frame in frames_of(write_scene(tmp_path / "plain.mcap"))]
    for number, options in enumerate(
        [
            {"chunk_size": 100},
            {"chunk_size": 5000},
            {"chunk_size": 1 << 30},
            {"use_chunking": False},
        ]
    ):
        path = tmp_path / f"{number}.mcap"
        write_scene(path, compression=COMPRESSIONS[compression], **options)
        assert [frame.digest for frame in frames_of(path)] == expected
        assert not Recording.open(path).scan(), options


@pytest.mark.parametrize(
    ("start", "stop"), [(0, None), (3, 7), (11, 40), (12, None), (5, 5), (0, 1)]
)
def test_slices_keep_the_index(tmp_path: Path, start: int, stop: int | None) -> None:
    path = write_scene(tmp_path / "scene.mcap")
    indices = [frame.index for frame in frames_of(path, start=start, stop=stop)]
    assert indices == list(range(12))[start:stop]


def test_count_topics_and_channels(scene: Path) -> None:
    recording = Recording.open(scene)
    assert recording.count(PAIR) == 12
    assert recording.channel_topics == {c: f"/camera/{c}/image" for c in ("near", "far", "flat")}
    topics = {info.topic: info for info in recording.topics()}
    near = topics["/camera/near/image"]
    assert (near.kind, near.count, near.rate_hz) == ("image", 12, 10.0)
    assert (near.first_ns, near.last_ns) == (stamp_of(0), stamp_of(11))
    kinds = {topic.rpartition("/")[2]: info.kind for topic, info in topics.items()}
    assert kinds["transforms"] == "transform" and kinds["meta"] == "json"
    assert {kinds.get("calibration"), kinds.get("camera_info")} == {"camera", None}
    assert recording.topics() == Recording.open(scene).topics()


def test_the_digest_of_the_file_is_that_of_its_bytes(scene: Path) -> None:
    expected = hashlib.blake2b(scene.read_bytes(), digest_size=16).hexdigest()
    assert Recording.open(scene).digest == expected


def test_a_missing_channel_is_one_line_that_says_how_to_map_it(scene: Path) -> None:
    recording = Recording.open(scene)
    recording.require(PAIR)
    with pytest.raises(RecordingError) as caught:
        recording.frames(["near", "left"])
    message = str(caught.value)
    assert "\n" not in message and str(scene) in message
    assert "/camera/left/image" in message and "/camera/near/image" in message
    assert "--topic left=/some/topic" in message


def test_topics_can_be_mapped_and_find_the_calibration_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "mapped.mcap"
    with Recorder(path) as recorder:
        recorder.camera("/rig/one/camera_info", START_NS, 32, 24)
        for frame in range(3):
            recorder.image("/rig/one/picture", stamp_of(frame), picture("near", frame), "mono8")
            recorder.image("/two/image", stamp_of(frame), picture("far", frame), "mono8")
    recording = Recording.open(path, {"near": "/rig/one/picture", "far": "/two/image"})
    frames = list(recording.frames(PAIR))
    assert [list(frame.images) for frame in frames] == [["near", "far"]] * 3
    assert list(frames[0].cameras) == ["near"]
    assert recording.defects.counts == {"missing_calibration": 1}
    with pytest.raises(RecordingError, match=r"near .*/no/such"):
        Recording.open(path, {"near": "/no/such"}).require(["near"])


@pytest.mark.parametrize("name", ["image/compressed", "image_raw", "image_raw/compressed"])
def test_other_usual_names_of_image_topics(tmp_path: Path, name: str) -> None:
    with Recorder(tmp_path / "names.mcap") as recorder:
        recorder.image(f"/camera/near/{name}", START_NS, picture("near", 0), "mono8")
        recorder.camera("/camera/near/camera_info", START_NS, 32, 24)
    (frame,) = Recording.open(tmp_path / "names.mcap").frames(["near"])
    assert list(frame.cameras) == ["near"]


def test_optional_channels_join_where_they_are(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", skip=lambda c, frame: c == "flat" and frame % 3 > 0)
    recording = Recording.open(path)
    joined = ["flat" in frame.images for frame in recording.frames(PAIR, ["flat", "absent"])]
    assert joined == [frame % 3 == 0 for frame in range(12)]
    assert not recording.defects


def test_the_latest_calibration_before_a_frame_counts(tmp_path: Path) -> None:
    path = tmp_path / "recalibrated.mcap"
    with Recorder(path) as recorder:
        for frame in range(20):
            if frame in (0, 7, 13):
                recorder.camera("/camera/near/calibration", stamp_of(frame), 32, 24, f=50.0 + frame)
            recorder.image("/camera/near/image", stamp_of(frame), picture("near", frame), "mono8")
    focal = [frame.cameras["near"].K[0, 0] for frame in Recording.open(path).frames(["near"])]
    assert focal == [50.0] * 7 + [57.0] * 6 + [63.0] * 7


# -- encodings ------------------------------------------------------------------------------------


def one_image(tmp_path: Path, dialect: str = "ros2", **fields: object) -> np.ndarray:
    with Recorder(tmp_path / "one.mcap", dialect) as recorder:
        recorder.raw("/camera/near/image", START_NS, **fields)
    recording = Recording.open(tmp_path / "one.mcap")
    frames = list(recording.frames(["near"]))
    assert len(frames) == 1, recording.defects.lines()
    return frames[0].images["near"]


GREY16 = np.arange(24, dtype=np.uint16).reshape(4, 6) * 2731
RGB = np.random.default_rng(1).integers(0, 256, (4, 6, 3), dtype=np.uint8)


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("mono8", GREY16.astype(np.uint8), GREY16.astype(np.uint8)),
        ("8UC1", GREY16.astype(np.uint8), GREY16.astype(np.uint8)),
        ("mono16", GREY16, GREY16),
        ("16UC1", GREY16, GREY16),
        ("32FC1", GREY16.astype(np.float32), GREY16.astype(np.float32)),
        ("rgb8", RGB, RGB),
        ("bgr8", RGB[..., ::-1], RGB),
        ("8UC3", RGB[..., ::-1], RGB),
        ("rgba8", np.dstack([RGB, RGB[..., 0]]), RGB),
        ("bgra8", np.dstack([RGB[..., ::-1], RGB[..., 0]]), RGB),
        ("rgb16", RGB.astype(np.uint16) * 257, RGB.astype(np.uint16) * 257),
        ("bgr16", RGB[..., ::-1].astype(np.uint16) * 257, RGB.astype(np.uint16) * 257),
    ],
)
def test_raw_encodings(
    tmp_path: Path, dialect: str, encoding: str, stored: np.ndarray, expected: np.ndarray
) -> None:
    padded = np.pad(np.ascontiguousarray(stored).view(np.uint8).reshape(4, -1), ((0, 0), (0, 5)))
    for rows, data in [
        (stored.tobytes(), {"step": len(stored.tobytes()) // 4}),
        (stored.tobytes(), {"step": 0}),
        (padded.tobytes(), {"step": padded.shape[1]}),
        (padded.tobytes()[:-5], {"step": padded.shape[1]}),
    ]:
        fields = {"width": 6, "height": 4, "encoding": encoding, "data": rows, **data}
        image = one_image(tmp_path, dialect, **fields)
        assert image.dtype == expected.dtype and image.dtype.isnative
        assert image.flags.aligned and not image.flags.writeable
        np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("dtype", ["u2", "f4"])
def test_the_byte_order_of_ros_is_honoured(tmp_path: Path, dtype: str) -> None:
    stored = GREY16.astype(f">{dtype}")
    encoding = "mono16" if dtype == "u2" else "32FC1"
    fields = {"width": 6, "height": 4, "encoding": encoding, "step": 6 * stored.itemsize}
    image = one_image(tmp_path, **fields, data=stored.tobytes(), big_endian=True)
    assert image.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(image, GREY16)


@pytest.mark.parametrize("depth", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_the_colour_that_was_seen(
    tmp_path: Path, pattern: str, depth: int
) -> None:
    colour = {"r": 200, "g": 120, "b": 40}
    tile = np.array([colour[c] for c in pattern], np.uint8 if depth == 8 else np.uint16)
    mosaic = np.tile(tile.reshape(2, 2), (4, 5))
    step = mosaic.itemsize * 10
    fields = {"width": 10, "height": 8, "encoding": f"bayer_{pattern}{depth}", "step": step}
    image = one_image(tmp_path, **fields, data=mosaic.tobytes())
    assert image.dtype == mosaic.dtype
    np.testing.assert_array_equal(image, np.broadcast_to([200, 120, 40], (8, 10, 3)))


@pytest.mark.parametrize(("encoding", "order"), [("yuv422", "uyvy"), ("yuv422_yuy2", "yuyv")])
def test_yuv_of_a_grey_scene_is_grey(tmp_path: Path, encoding: str, order: str) -> None:
    tile = [126 if letter == "y" else 128 for letter in order]
    data = bytes(tile) * 3 * 4
    image = one_image(tmp_path, width=6, height=4, encoding=encoding, step=12, data=data)
    assert image.shape == (4, 6, 3) and np.ptp(image) == 0
    assert abs(int(image[0, 0, 0]) - 128) < 2


def test_every_known_encoding_decodes(tmp_path: Path) -> None:
    for encoding, layout in ENCODINGS.items():
        step = 8 * layout.channels * int(layout.dtype[1])
        fields = {"width": 8, "height": 8, "encoding": encoding, "step": step}
        image = one_image(tmp_path, **fields, data=bytes(step * 8))
        assert image.shape[:2] == (8, 8)


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return bytes(cv2.imencode(suffix, image)[1].tobytes())


@pytest.mark.parametrize("dialect", DIALECTS)
@pytest.mark.parametrize(
    ("form", "data", "expected"),
    [
        ("png", encoded(".png", GREY16.astype(np.uint8)), GREY16.astype(np.uint8)),
        ("16UC1; png compressed ", encoded(".png", GREY16), GREY16),
        ("bgr8; png compressed bgr8", encoded(".png", RGB[..., ::-1]), RGB),
        ("png", encoded(".png", np.dstack([RGB[..., ::-1], RGB[..., 0]])), RGB),
        ("jpeg", encoded(".png", RGB[..., ::-1]), RGB),
    ],
)
def test_compressed_images_are_decoded_by_content(
    tmp_path: Path, dialect: str, form: str, data: bytes, expected: np.ndarray
) -> None:
    with Recorder(tmp_path / "c.mcap", dialect) as recorder:
        recorder.compressed("/camera/near/image/compressed", START_NS, data, form)
    (frame,) = Recording.open(tmp_path / "c.mcap").frames(["near"])
    image = frame.images["near"]
    assert image.dtype == expected.dtype and not image.flags.writeable
    np.testing.assert_array_equal(image, expected)


@pytest.mark.parametrize("colour", [False, True])
def test_jpeg(tmp_path: Path, colour: bool) -> None:
    plain = np.full((16, 24, 3) if colour else (16, 24), 90, np.uint8)
    if colour:
        plain[..., 0] = 200  # red in RGB
    stored = encoded(".jpg", plain[..., ::-1] if colour else plain)
    with Recorder(tmp_path / "j.mcap") as recorder:
        recorder.compressed("/camera/near/image", START_NS, stored, "jpeg")
    (frame,) = Recording.open(tmp_path / "j.mcap").frames(["near"])
    assert frame.images["near"].shape == plain.shape
    assert np.abs(frame.images["near"].astype(int) - plain).max() < 6


# -- memory ---------------------------------------------------------------------------------------


def peak_of(path: Path) -> int:
    tracemalloc.start()
    try:
        for _ in Recording.open(path).frames(PAIR, ["flat"]):
            pass
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}, {"chunk_size": 1 << 30}])
def test_memory_does_not_grow_with_the_recording(
    tmp_path: Path, options: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.recording.container.MERGE_BYTES", 1 << 20)
    shape = (96, 128)
    short = write_scene(tmp_path / "short.mcap", frames=range(30), shape=shape, **options)
    long = write_scene(tmp_path / "long.mcap", frames=range(240), shape=shape, **options)
    peak_of(short)  # imports
    # Eight times as long; buffers differ a little by where the frames' ends fall.
    assert peak_of(long) < 1.5 * peak_of(short)


def test_memory_is_bounded_when_a_channel_stops(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("workbench.recording.pairing.HELD_BYTES", 1 << 20)
    path = write_scene(
        tmp_path / "s.mcap",
        frames=range(300),
        shape=(96, 128),
        truth=False,
        skip=lambda channel, frame: channel == "far" and frame > 3,
    )
    assert path.stat().st_size > 6 << 20
    assert peak_of(path) < 6 << 20

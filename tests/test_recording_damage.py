"""Damaged files: everything that is whole in them is read, and the damage is told."""

from __future__ import annotations

import struct
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap.writer import IndexType
from mcap_fixtures import COMPRESSIONS, START_NS, Recorder, picture, stamp_of, write_scene

from workbench.recording import Frame, Recording, RecordingError

MAGIC = b"\x89MCAP0\r\n"
PAIR = ("near", "far")
LAYOUTS: dict[str, dict[str, Any]] = {
    "zstd": {"compression": COMPRESSIONS["zstd"], "chunk_size": 7000},
    "lz4": {"compression": COMPRESSIONS["lz4"], "chunk_size": 7000},
    "plain chunks": {"compression": COMPRESSIONS["none"], "chunk_size": 7000},
    "no chunks": {"use_chunking": False},
    "no message index": {"index_types": IndexType.NONE, "chunk_size": 7000},
}


def records(data: bytes, at: int = len(MAGIC), end: int | None = None) -> Iterator[tuple[int, ...]]:
    """Opcode, offset and end of each record, independently of the code under test."""
    end = len(data) - len(MAGIC) if end is None else end
    while at < end:
        opcode, length = struct.unpack_from("<BQ", data, at)
        yield opcode, at, at + 9 + length
        at += 9 + length


def messages_before(data: bytes, cut: int) -> int:
    """How many messages are surely whole in the first ``cut`` bytes."""
    count = 0
    for opcode, at, end in records(data):
        if opcode == Opcode.MESSAGE:
            count += end <= cut
        elif opcode == Opcode.CHUNK:
            name_length = struct.unpack_from("<I", data, at + 9 + 28)[0]
            name = data[at + 41 : at + 41 + name_length].decode()
            start = at + 41 + name_length + 8
            contents = data[start:end]
            if name == "zstd":
                import zstandard

                contents = zstandard.decompress(contents)
            elif name == "lz4":
                import lz4.frame

                contents = lz4.frame.decompress(contents)
            for inner, _, inner_end in records(contents, 0, len(contents)):
                whole = end <= cut or (not name and start + inner_end <= cut)
                count += inner == Opcode.MESSAGE and whole
    return count


def read(path: Path) -> tuple[list[Frame], Recording]:
    recording = Recording.open(path)
    if not {*PAIR} <= recording.channel_topics.keys():
        return [], recording
    return list(recording.frames(PAIR, ["flat"])), recording


def check_pictures(frames: list[Frame]) -> None:
    for frame in frames:
        number = round((frame.stamp_ns - stamp_of(0)) / 1e8)
        for channel, image in frame.images.items():
            np.testing.assert_array_equal(image, picture(channel, number))


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_cut_anywhere_leaves_every_whole_frame(tmp_path: Path, layout: str) -> None:
    source = write_scene(tmp_path / "whole.mcap", truth=False, **LAYOUTS[layout])
    data = source.read_bytes()
    cut_file = tmp_path / "cut.mcap"
    for cut in np.linspace(9, len(data) - 1, 50).astype(int).tolist():
        cut_file.write_bytes(data[:cut])
        frames, recording = read(cut_file)
        # Three calibrations come first, then near, far and flat of each frame.
        whole = max(0, messages_before(data, cut) - 3) // 3
        assert len(frames) >= whole, (cut, recording.defects.lines())
        check_pictures(frames)
        assert all(set(frame.images) == {"near", "far", "flat"} for frame in frames[:whole])
        assert {"truncated", "no_index"} & recording.defects.counts.keys(), cut
        assert "chunk_damaged" not in recording.defects.counts, recording.defects.lines()


def test_a_cut_before_the_first_image_is_told_with_what_is_missing(tmp_path: Path) -> None:
    data = write_scene(tmp_path / "whole.mcap", truth=False).read_bytes()
    cut_file = tmp_path / "cut.mcap"
    cut_file.write_bytes(data[:60])
    with pytest.raises(RecordingError, match=r"an image topic for near.*truncated"):
        Recording.open(cut_file).require(PAIR)


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_what_precedes_a_cut_within_a_chunk_is_read(tmp_path: Path, compression: str) -> None:
    shape = (128, 160)
    path = write_scene(
        tmp_path / "one_chunk.mcap",
        truth=False,
        shape=shape,
        chunk_size=1 << 30,
        compression=COMPRESSIONS[compression],
    )
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    recording = Recording.open(path)
    frames = list(recording.frames(PAIR))
    assert 6 <= len(frames) <= 9  # a compressed block of 128 kB is lost
    for frame in frames:
        np.testing.assert_array_equal(frame.images["far"], picture("far", frame.index, shape))
    assert recording.defects.counts["truncated"] == 1
    assert dict(recording.rig) == {"f": "60.0", "pattern": "stripe"}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("length", [0, 5, 1 << 24, (1 << 31) - 1, 1 << 40, 1 << 60, (1 << 64) - 1])
def test_wrong_lengths_neither_raise_nor_take_memory(
    tmp_path: Path, layout: str, length: int
) -> None:
    source = write_scene(tmp_path / "whole.mcap", truth=False, **LAYOUTS[layout])
    data = source.read_bytes()
    offsets = [at + 1 for _, at, _ in records(data)]
    chunks = [at for opcode, at, _ in records(data) if opcode == Opcode.CHUNK]
    offsets += [at + 9 + 16 for at in chunks]  # the uncompressed size
    offsets += [at + 41 + struct.unpack_from("<I", data, at + 37)[0] for at in chunks]
    broken = tmp_path / "broken.mcap"
    read(source)  # imports
    for offset in offsets[:: max(1, len(offsets) // 5)]:
        broken.write_bytes(data[:offset] + struct.pack("<Q", length) + data[offset + 8 :])
        tracemalloc.start()
        frames, recording = read(broken)
        recording.scan()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 8 << 20, (offset, peak)
        check_pictures(frames)


@pytest.mark.parametrize("layout", ["zstd", "lz4", "plain chunks"])
@pytest.mark.parametrize("keep_end", [True, False])
def test_garbage_in_a_chunk_costs_that_chunk_only(
    tmp_path: Path, layout: str, keep_end: bool
) -> None:
    path = write_scene(tmp_path / "scene.mcap", truth=False, **LAYOUTS[layout])
    data = bytearray(path.read_bytes())
    chunks = [(at, end) for opcode, at, end in records(bytes(data)) if opcode == Opcode.CHUNK]
    at, end = chunks[len(chunks) // 2]
    data[at : end - 40] = np.random.default_rng(0).bytes(end - 40 - at)
    path.write_bytes(data if keep_end else data[:-20])
    frames, recording = read(path)
    assert 8 <= len(frames) < 12
    check_pictures(frames)
    assert recording.defects.counts["chunk_damaged"] >= 1
    assert ("no_index" in recording.defects.counts) is not keep_end


def test_a_flipped_bit_fails_the_checksum_and_is_told(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", truth=False, **LAYOUTS["plain chunks"])
    data = bytearray(path.read_bytes())
    at = next(at for opcode, at, _ in records(bytes(data)) if opcode == Opcode.CHUNK)
    data[at + 4000] ^= 1
    path.write_bytes(data)
    frames, recording = read(path)
    assert len(frames) == 12
    assert recording.defects.counts == {"chunk_damaged": 1}
    assert "checksum" in recording.defects.lines()[0]


def test_an_unknown_compression_is_told(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", truth=False, **LAYOUTS["zstd"])
    path.write_bytes(path.read_bytes().replace(b"zstd", b"brot", 1))
    frames, recording = read(path)
    assert 8 <= len(frames) < 12
    assert "'brot', known are zstd, lz4 and none" in recording.defects.lines()[0]


def test_a_tail_of_zeros_as_after_a_power_cut(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", truth=False, **LAYOUTS["zstd"])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) // 2))
    frames, recording = read(path)
    assert len(frames) >= 3
    assert recording.defects


def test_a_summary_that_leads_astray_is_not_followed(tmp_path: Path) -> None:
    path = write_scene(tmp_path / "s.mcap", truth=False, chunk_size=7000)
    data = path.read_bytes()
    chunk = next(at for opcode, at, _ in records(data) if opcode == Opcode.CHUNK)
    path.write_bytes(data[:chunk] + b"extra bytes" + data[chunk:])  # every offset is wrong now
    frames, recording = read(path)
    assert len(frames) == 12
    assert {"no_index", "chunk_damaged"} <= recording.defects.counts.keys()


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "empty"),
        (MAGIC[:5], "cut off after 5 bytes"),
        (b"PK\x03\x04 a zip file", "starts with 50 4b 03 04"),
    ],
)
def test_what_is_not_mcap_is_refused_in_one_line(
    tmp_path: Path, content: bytes, found: str
) -> None:
    path = tmp_path / "file.mcap"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=found) as caught:
        Recording.open(path)
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)


def test_no_file_a_directory_and_one_that_may_not_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RecordingError, match="found nothing there"):
        Recording.open(tmp_path / "none.mcap")
    with pytest.raises(RecordingError, match="found a directory"):
        Recording.open(tmp_path)

    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    with pytest.raises(RecordingError, match="cannot read it: Permission denied"):
        Recording.open(tmp_path / "secret.mcap")


def test_a_file_of_magic_only_opens_and_has_nothing(tmp_path: Path) -> None:
    path = tmp_path / "magic.mcap"
    path.write_bytes(MAGIC)
    recording = Recording.open(path)
    assert recording.topics() == [] and recording.rig == {}
    assert recording.scan().counts == {"no_index": 1}


SCENES: dict[str, bytes] = {}


@settings(
    max_examples=120,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(data=st.data())
def test_no_damage_raises(tmp_path: Path, data: st.DataObject) -> None:
    layout = data.draw(st.sampled_from(sorted(LAYOUTS)))
    if layout not in SCENES:
        path = write_scene(tmp_path / "s.mcap", frames=range(4), shape=(8, 8), **LAYOUTS[layout])
        SCENES[layout] = path.read_bytes()
    content = bytearray(SCENES[layout])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(len(MAGIC), len(content)))
        size = data.draw(st.integers(0, 60))
        content[at : at + size] = data.draw(st.binary(max_size=60))
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    recording = Recording.open(path)
    recording.scan()
    recording.topics()
    if {*PAIR} <= recording.channel_topics.keys():
        frames = list(recording.frames(PAIR))
        assert recording.count(PAIR) >= len(frames)


# -- messages and images --------------------------------------------------------------------------


def raw(**fields: Any) -> dict[str, Any]:
    return {"width": 4, "height": 3, "encoding": "mono8", "step": 4, "data": bytes(12), **fields}


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (raw(encoding="mono12"), "'mono12' is not among the known ones: mono8, 8UC1"),
        (raw(data=bytes(11)), "4 x 3 = 12 bytes, but its data has 11"),
        (raw(data=bytes(13)), "4 x 3 = 12 bytes, but its data has 13"),
        (raw(step=3), "step is 3 bytes, but 4 pixels of mono8 take 4"),
        (raw(width=0), "0 x 3"),
        (raw(width=1 << 31, height=1 << 31, step=0), "but its data has 12"),
    ],
)
@pytest.mark.parametrize("dialect", ["protobuf", "json", "ros2"])
def test_an_image_that_contradicts_itself(
    tmp_path: Path, dialect: str, fields: dict[str, Any], says: str
) -> None:
    path = tmp_path / "bad.mcap"
    with Recorder(path, dialect) as recorder:
        for frame in range(3):
            for channel in PAIR:
                bad = fields if (channel, frame) == ("far", 1) else raw()
                recorder.raw(f"/camera/{channel}/image", stamp_of(frame), **bad)
    recording = Recording.open(path)
    assert [frame.index for frame in recording.frames(PAIR)] == [0, 2]
    (defect,) = recording.defects.examples["undecodable"]
    assert says in defect.says and "/camera/far/image" in defect.says
    assert (defect.topic, defect.frame, defect.stamp_ns) == ("/camera/far/image", 1, stamp_of(1))


def test_a_bad_part_of_the_truth_leaves_the_frame(tmp_path: Path) -> None:
    path = tmp_path / "truth.mcap"
    with Recorder(path) as recorder:
        recorder.raw("/camera/near/image", START_NS, **raw())
        recorder.raw("/ground_truth/depth", START_NS, **raw(encoding="nonsense"))
        recorder.raw("/ground_truth/instances", START_NS, **raw())
        recorder.transforms("/ground_truth/transforms", START_NS, {"a": ((0, 0, 0), (0, 0, 0, 0))})
        recorder.raw(
            "/ground_truth/faces", START_NS, **raw(encoding="rgb8", step=12, data=bytes(36))
        )
    recording = Recording.open(path)
    (frame,) = recording.frames(["near"])
    assert frame.truth is not None
    assert frame.truth.depth_m is None and frame.truth.faces is None
    assert frame.truth.instances is not None and frame.truth.camera_from_object == {}
    assert recording.defects.counts["undecodable"] == 3
    assert {defect.topic for defect in frame.defects} >= {"/ground_truth/depth"}


def test_depth_in_millimetres_becomes_metres(tmp_path: Path) -> None:
    with Recorder(tmp_path / "mm.mcap") as recorder:
        recorder.raw("/camera/near/image", START_NS, **raw())
        depth = np.array([[0, 795], [1500, 65535]], np.uint16)
        recorder.image("/ground_truth/depth", START_NS, depth, "16UC1")
    (frame,) = Recording.open(tmp_path / "mm.mcap").frames(["near"])
    assert frame.truth is not None and frame.truth.depth_m is not None
    expected = np.array([[np.nan, 0.795], [1.5, 65.535]], np.float32)
    np.testing.assert_allclose(frame.truth.depth_m, expected, rtol=1e-6)


def encoded(suffix: str) -> bytes:
    import cv2

    return bytes(cv2.imencode(suffix, picture("near", 0, (64, 80)))[1].tobytes())


def giant_png() -> bytes:
    import zlib

    head = b"IHDR" + struct.pack(">IIBBBBB", 1 << 15, 1 << 15, 8, 0, 0, 0, 0)
    return (
        encoded(".png")[:8]
        + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))
        + struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND"))
    )  # fmt: skip


def giant_jpeg() -> bytes:
    data = bytearray(encoded(".jpg"))
    at = data.index(b"\xff\xc0")
    data[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "start with nothing"),
        (b"GIF89a and so on", "neither PNG nor JPEG"),
        (encoded(".png")[:-30], "PNG is cut"),
        (encoded(".png")[:40], "PNG is cut"),
        (encoded(".png").replace(b"IDAT", b"IDAT"[::-1], 1), "fails its CRC"),
        (encoded(".jpg")[: len(encoded(".jpg")) // 2], "JPEG is cut"),
        (encoded(".jpg")[:30], "JPEG is"),
        (giant_png(), "cannot code a PNG of 32768 x 32768"),
        (giant_jpeg(), "cannot code a JPEG of 65535 x 65535"),
    ],
)
def test_compressed_images_that_are_none(tmp_path: Path, data: bytes, says: str) -> None:
    path = tmp_path / "bad.mcap"
    with Recorder(path) as recorder:
        recorder.compressed("/camera/near/image", START_NS, data, "png")
    recording = Recording.open(path)
    assert list(recording.frames(["near"])) == []
    assert says in recording.defects.lines()[0]
    assert recording.scan().counts["undecodable"] == 1


def test_messages_that_their_library_cannot_decode(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    with Recorder(path) as recorder:
        for frame in range(4):
            recorder.raw("/camera/near/image", stamp_of(frame), **raw())
            recorder.bytes("/imu", "foxglove.Log", "protobuf", b"\xff\xff\xff", stamp_of(frame))
            recorder.bytes("/note", "Note", "json", b"{not json", stamp_of(frame))
            recorder.bytes("/ros1", "sensor_msgs/Image", "ros1", b"", stamp_of(frame))
            recorder.bytes("/private", "Mystery", "cbor", b"\xa0", stamp_of(frame))
    recording = Recording.open(path)
    assert len(list(recording.frames(["near"]))) == 4
    assert "undecodable" not in recording.defects.counts, "no concern of these frames"
    counts = recording.scan().counts
    assert counts["undecodable"] == 12
    says = " ".join(recording.defects.lines())
    assert "encoding 'ros1' is not among the known ones: protobuf, json, cdr" in says
    assert {info.topic: info.count for info in recording.topics()}["/private"] == 4

"""What is written is what is read back, byte for byte the same each time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from workbench.recording import Recording, RecordingWriter, Truth

STAMP = 1_700_000_000_123_456_789


def truth(turn: float) -> Truth:
    cos, sin = np.cos(turn), np.sin(turn)
    matrix = np.array([[cos, -sin, 0, 0.1], [sin, cos, 0, -0.2], [0, 0, 1, 0.8], [0, 0, 0, 1]])
    return Truth(
        np.linspace(0.7, 0.8, 12, dtype=np.float32).reshape(3, 4),
        np.eye(3, 4, dtype=np.uint8),
        np.eye(3, 4, dtype=np.uint8) * 7,
        {"object_1_bar": matrix},
        {"kind": "pile", "objects": [{"id": 1, "name": "bar"}]},
    )


def write(path: Path, frames: int = 3) -> Path:
    with RecordingWriter.create(path) as writer:
        writer.metadata("rig", {"f": "60.0"})
        for channel in ("near", "far"):
            writer.camera(channel, np.array([[50, 0, 1.5], [0, 50, 1.0], [0, 0, 1]]), 4, 3)
        for index in range(frames):
            near = np.arange(12, dtype=np.uint8).reshape(3, 4) + index
            images = {"near": near, "far": near.astype(np.uint16) * 256}
            writer.frame(STAMP + index * 10**8, images, truth(0.3 * index))
    return path


def test_read_back(tmp_path: Path) -> None:
    recording = Recording.open(write(tmp_path / "new.mcap"))
    frames = list(recording.frames(["near", "far"]))
    assert dict(recording.rig) == {"f": "60.0"}
    assert not recording.defects.lines()
    assert [frame.stamp_ns for frame in frames] == [STAMP + k * 10**8 for k in range(3)]
    for index, frame in enumerate(frames):
        expected = truth(0.3 * index)
        assert frame.images["near"][2, 3] == 11 + index
        assert frame.images["far"].dtype == np.uint16
        assert frame.cameras["far"].K[0, 2] == 1.5
        found = frame.truth
        assert found is not None and found.depth_m is not None
        np.testing.assert_array_equal(found.depth_m, expected.depth_m)
        np.testing.assert_array_equal(found.instances, expected.instances)
        np.testing.assert_array_equal(found.faces, expected.faces)
        np.testing.assert_allclose(
            found.camera_from_object["object_1_bar"],
            expected.camera_from_object["object_1_bar"],
            atol=1e-15,
        )
        assert found.meta == expected.meta


def test_the_same_bytes(tmp_path: Path) -> None:
    first, second = write(tmp_path / "a.mcap"), write(tmp_path / "b.mcap")
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    "image", [np.zeros((3, 4)), np.zeros((3, 4, 2), np.uint8), np.zeros(3, np.uint8)]
)
def test_no_image_is_refused_and_nothing_is_left(tmp_path: Path, image: np.ndarray) -> None:
    path = write(tmp_path / "kept.mcap")
    before = path.read_bytes()
    with (
        pytest.raises(ValueError, match=r"/camera/near/image: expected uint8"),
        RecordingWriter.create(path) as writer,
    ):
        writer.frame(STAMP, {"near": image})
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["kept.mcap"]


def test_interrupted_keeps_whole_frames(tmp_path: Path) -> None:
    path = tmp_path / "half.mcap"
    image = np.zeros((3, 4), np.uint8)
    with pytest.raises(KeyboardInterrupt), RecordingWriter.create(path) as writer:
        writer.frame(STAMP, {"near": image, "far": image})
        raise KeyboardInterrupt
    recording = Recording.open(path)
    assert len(list(recording.frames(["near", "far"]))) == 1
    with pytest.raises(KeyboardInterrupt), RecordingWriter.create(tmp_path / "none.mcap"):
        raise KeyboardInterrupt
    assert [file.name for file in tmp_path.iterdir()] == ["half.mcap"]

"""Writing recordings by the convention that the bench reads: MCAP with Foxglove messages.

    with RecordingWriter.create(Path("new.mcap")) as writer:
        writer.metadata("rig", {"f": "60.0"})
        writer.camera("near", K, width, height)
        writer.frame(stamp_ns, {"near": near, "far": far}, truth)

Topics are ``/camera/CHANNEL/image``, ``/camera/CHANNEL/calibration`` and ``/ground_truth/...``.
The same calls give the same bytes.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import IO, Any

import numpy as np

from workbench.files import replacing
from workbench.recording.model import Truth

FRAME_ID = "camera_optical_frame"
"""Origin at the taking lens's centre, +z forward, x right, y down."""

_ENCODINGS = {("uint8", 2): "mono8", ("uint16", 2): "mono16", ("float32", 2): "32FC1"}
_ENCODINGS[("uint8", 3)] = "rgb8"


class RecordingWriter:
    """Writes one recording to a stream; :meth:`create` also makes the file.

    Stamps are nanoseconds since the epoch, and become log times too.
    """

    def __init__(self, stream: IO[bytes], frame_id: str = FRAME_ID) -> None:
        from mcap.writer import CompressionType, Writer

        self.frame_id = frame_id
        self.frames = 0
        self._writer = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="defocus-workbench")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self._sequences: dict[int, int] = {}

    @classmethod
    @contextmanager
    def create(cls, path: Path, frame_id: str = FRAME_ID) -> Iterator[RecordingWriter]:
        """A writer to a file beside ``path``, renamed to it at the end.

        Where an exception ends the writing nothing is left and ``path`` is untouched; Ctrl-C keeps
        the frames written until then, in a whole file.
        """
        with replacing(path, keep_partial=True) as beside:
            keep = False
            try:
                with beside.open("wb") as stream:
                    writer = cls(stream, frame_id)
                    try:
                        yield writer
                        keep = True
                    except KeyboardInterrupt:
                        keep = writer.frames > 0
                        raise
                    finally:
                        writer.finish()
            finally:
                if not keep:
                    beside.unlink(missing_ok=True)

    def finish(self) -> None:
        """Write summary and footer; nothing can follow."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """A metadata record, such as ``rig``."""
        self._writer.add_metadata(name, {key: str(value) for key, value in values.items()})

    def camera(
        self,
        channel: str,
        K: np.ndarray,
        width: int,
        height: int,
        D: Sequence[float] = (0.0,) * 5,
        distortion_model: str = "plumb_bob",
        stamp_ns: int = 0,
    ) -> None:
        """Intrinsics of a channel: ``K`` is 3 3 in pixels, pixel centres at integers."""
        message = foxglove("CameraCalibration")()
        self._stamp(message, stamp_ns)
        message.width, message.height = width, height
        message.distortion_model = distortion_model
        message.D.extend(float(value) for value in D)
        message.K.extend(float(value) for value in np.asarray(K).ravel())
        message.R.extend(np.eye(3).ravel().tolist())
        message.P.extend(np.hstack([K, np.zeros((3, 1))]).ravel().tolist())
        self._send(f"/camera/{channel}/calibration", "CameraCalibration", message, stamp_ns)

    def frame(
        self, stamp_ns: int, images: Mapping[str, np.ndarray], truth: Truth | None = None
    ) -> None:
        """The images of one instant by channel, and what is known about it.

        Raises ValueError for an array that is no image (:meth:`image`).
        """
        for channel, image in images.items():
            self.image(f"/camera/{channel}/image", image, stamp_ns)
        if truth is not None:
            if truth.depth_m is not None:
                self.image("/ground_truth/depth", truth.depth_m.astype(np.float32), stamp_ns)
            for name, labels in (("instances", truth.instances), ("faces", truth.faces)):
                if labels is not None:
                    self.image(f"/ground_truth/{name}", labels, stamp_ns)
            for child, matrix in truth.camera_from_object.items():
                self.transform("/ground_truth/transforms", child, matrix, stamp_ns)
            if truth.meta:
                self.json("/ground_truth/meta", "GroundTruthMeta", truth.meta, stamp_ns)
        self.frames += 1

    def image(self, topic: str, image: np.ndarray, stamp_ns: int) -> None:
        """An array as ``foxglove.RawImage``: grey uint8, uint16 or float32 [H W], or RGB [H W 3].

        Raises ValueError for any other array.
        """
        encoding = _ENCODINGS.get((image.dtype.name, image.ndim))
        if encoding is None or (image.ndim == 3 and image.shape[2] != 3):
            raise ValueError(
                f"{topic}: expected uint8, uint16 or float32 [H W], or uint8 [H W 3], found "
                f"{image.dtype} {list(image.shape)}"
            )
        message = foxglove("RawImage")()
        self._stamp(message, stamp_ns)
        message.height, message.width = image.shape[:2]
        message.encoding = encoding
        message.data = np.ascontiguousarray(image, dtype=image.dtype.newbyteorder("<")).tobytes()
        message.step = len(message.data) // message.height
        self._send(topic, "RawImage", message, stamp_ns)

    def compressed_image(self, topic: str, data: bytes, form: str, stamp_ns: int) -> None:
        """An encoded image as it is, ``form`` being png, jpeg or another of Foxglove's names."""
        message = foxglove("CompressedImage")()
        self._stamp(message, stamp_ns)
        message.data, message.format = data, form
        self._send(topic, "CompressedImage", message, stamp_ns)

    def transform(self, topic: str, child: str, matrix: np.ndarray, stamp_ns: int) -> None:
        """``parent_from_child``, 4 4 in metres; the parent is this writer's frame."""
        from scipy.spatial.transform import Rotation

        message = foxglove("FrameTransform")()
        message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 10**9)
        message.parent_frame_id, message.child_frame_id = self.frame_id, child
        turn = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        for axis, value in zip("xyz", matrix[:3, 3], strict=True):
            setattr(message.translation, axis, float(value))
        for axis, value in zip("xyzw", turn, strict=True):
            setattr(message.rotation, axis, float(value))
        self._send(topic, "FrameTransform", message, stamp_ns)

    def json(self, topic: str, schema: str, values: Mapping[str, Any], stamp_ns: int) -> None:
        """A json object.  Raises ValueError for what json cannot hold, NaN included."""
        if topic not in self._channels:
            identity = self._writer.register_schema(schema, "jsonschema", b'{"type":"object"}')
            self._channels[topic] = self._writer.register_channel(topic, "json", identity)
        self._add(topic, json.dumps(values, allow_nan=False).encode(), stamp_ns)

    def _stamp(self, message: Any, stamp_ns: int) -> None:
        message.timestamp.seconds, message.timestamp.nanos = divmod(stamp_ns, 10**9)
        message.frame_id = self.frame_id

    def _send(self, topic: str, name: str, message: Any, stamp_ns: int) -> None:
        if topic not in self._channels:
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(
                    f"foxglove.{name}", "protobuf", foxglove_schema(name)
                )
            self._channels[topic] = self._writer.register_channel(
                topic, "protobuf", self._schemas[name]
            )
        self._add(topic, message.SerializeToString(deterministic=True), stamp_ns)

    def _add(self, topic: str, data: bytes, stamp_ns: int) -> None:
        channel = self._channels[topic]
        sequence = self._sequences[channel] = self._sequences.get(channel, 0) + 1
        self._writer.add_message(channel, stamp_ns, data, stamp_ns, sequence)


@cache
def foxglove(name: str) -> Any:
    """The protobuf class of ``foxglove.NAME``."""
    return getattr(importlib.import_module(f"foxglove_schemas_protobuf.{name}_pb2"), name)


@cache
def foxglove_schema(name: str) -> bytes:
    """The descriptor of ``foxglove.NAME`` with all that it refers to, as MCAP wants it."""
    from mcap_protobuf.schema import build_file_descriptor_set

    return bytes(build_file_descriptor_set(foxglove(name)).SerializeToString(deterministic=True))

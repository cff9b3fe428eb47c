"""Small synthetic recordings in the three dialects that the bench reads: protobuf, json and cdr."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType, Writer

from workbench.recording.writer import foxglove, foxglove_schema

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
DIALECTS = ("protobuf", "json", "ros2")

_TIME = "int32 sec\nuint32 nanosec\n"
_HEADER = "builtin_interfaces/Time stamp\nstring frame_id\n"
_PARTS = {
    "builtin_interfaces/Time": _TIME,
    "std_msgs/Header": _HEADER,
    "sensor_msgs/RegionOfInterest": (
        "uint32 x_offset\nuint32 y_offset\nuint32 height\nuint32 width\nbool do_rectify\n"
    ),
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n"
    ),
    "geometry_msgs/Transform": (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
    ),
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
}
_ROS2 = {
    "sensor_msgs/msg/Image": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
        "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    ),
    "sensor_msgs/msg/CompressedImage": "std_msgs/Header header\nstring format\nuint8[] data\n",
    "sensor_msgs/msg/CameraInfo": (
        "std_msgs/Header header\nuint32 height\nuint32 width\nstring distortion_model\n"
        "float64[] d\nfloat64[9] k\nfloat64[9] r\nfloat64[12] p\nuint32 binning_x\n"
        "uint32 binning_y\nsensor_msgs/RegionOfInterest roi\n"
    ),
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "std_msgs/msg/String": "string data\n",
}


def _ros2_definition(name: str) -> str:
    parts = [_ROS2[name], *(f"MSG: {part}\n{text}" for part, text in _PARTS.items())]
    return ("=" * 80 + "\n").join(parts)


class Recorder:
    """Writes messages of one dialect; stamps and log times are nanoseconds."""

    def __init__(self, path: Path, dialect: str = "protobuf", **options: Any) -> None:
        self.dialect = dialect
        self._stream = path.open("wb")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, Any] = {}
        if dialect == "ros2":
            from mcap_ros2.writer import Writer as Ros2Writer

            self._ros2 = Ros2Writer(self._stream, **options)
        else:
            self._writer = Writer(self._stream, **options)
            self._writer.start()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *exception: object) -> None:
        (self._ros2 if self.dialect == "ros2" else self._writer).finish()
        self._stream.close()

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        writer = self._ros2 if self.dialect == "ros2" else self._writer
        writer.add_metadata(name, dict(values))

    def raw(
        self,
        topic: str,
        stamp: int,
        log: int | None = None,
        *,
        frame_id: str = "camera",
        **raw: Any,
    ) -> None:
        """A raw image by its fields: width, height, encoding, step, data, big_endian."""
        big_endian = raw.pop("big_endian", False)
        if self.dialect == "ros2":
            fields = {**raw, "header": self._header(stamp, frame_id), "is_bigendian": big_endian}
            self._send(topic, "sensor_msgs/msg/Image", fields, stamp if log is None else log)
        else:
            fields = {**raw, "timestamp": stamp, "frame_id": frame_id}
            self._send(topic, "foxglove.RawImage", fields, stamp if log is None else log)

    def image(
        self, topic: str, stamp: int, image: np.ndarray, encoding: str, log: int | None = None
    ) -> None:
        """An array as a raw image without padding."""
        height, width = image.shape[:2]
        data = image.tobytes()
        step = len(data) // height
        self.raw(
            topic, stamp, log, width=width, height=height, encoding=encoding, step=step, data=data
        )

    def compressed(
        self, topic: str, stamp: int, data: bytes, form: str, log: int | None = None
    ) -> None:
        """A compressed image by its bytes."""
        log = stamp if log is None else log
        if self.dialect == "ros2":
            fields = {"header": self._header(stamp, "camera"), "format": form, "data": data}
            self._send(topic, "sensor_msgs/msg/CompressedImage", fields, log)
        else:
            fields = {"timestamp": stamp, "frame_id": "camera", "format": form, "data": data}
            self._send(topic, "foxglove.CompressedImage", fields, log)

    def camera(
        self,
        topic: str,
        stamp: int,
        width: int,
        height: int,
        log: int | None = None,
        f: float = 50.0,
    ) -> None:
        """Intrinsics with focal length ``f`` pixels and the principal point in the middle."""
        log = stamp if log is None else log
        K = [f, 0.0, (width - 1) / 2, 0.0, f, (height - 1) / 2, 0.0, 0.0, 1.0]
        fields: dict[str, Any] = {"width": width, "height": height, "distortion_model": "plumb_bob"}
        if self.dialect == "ros2":
            fields |= {"header": self._header(stamp, "camera"), "k": K, "d": [0.1] * 5}
            self._send(topic, "sensor_msgs/msg/CameraInfo", fields, log)
        else:
            fields |= {"timestamp": stamp, "frame_id": "camera", "K": K, "D": [0.1] * 5}
            self._send(topic, "foxglove.CameraCalibration", fields, log)

    def transforms(
        self,
        topic: str,
        stamp: int,
        poses: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]],
    ) -> None:
        """Child frame to (translation in metres, quaternion x y z w)."""
        one_by_one = []
        for child, (position, turn) in poses.items():
            moved = dict(zip("xyz", position, strict=True))
            turned = dict(zip("xyzw", turn, strict=True))
            one_by_one.append((child, moved, turned))
        if self.dialect == "ros2":
            many = [
                {
                    "header": self._header(stamp, "camera"),
                    "child_frame_id": child,
                    "transform": {"translation": moved, "rotation": turned},
                }
                for child, moved, turned in one_by_one
            ]
            self._send(topic, "tf2_msgs/msg/TFMessage", {"transforms": many}, stamp)
            return
        for child, moved, turned in one_by_one:
            fields = {
                "timestamp": stamp,
                "parent_frame_id": "camera",
                "child_frame_id": child,
                "translation": moved,
                "rotation": turned,
            }
            self._send(topic, "foxglove.FrameTransform", fields, stamp)

    def meta(self, topic: str, log: int, values: Mapping[str, Any]) -> None:
        """A json object, which has no stamp of its own."""
        if self.dialect == "ros2":
            self._send(topic, "std_msgs/msg/String", {"data": json.dumps(values)}, log)
        else:
            self.bytes(topic, "Meta", "json", json.dumps(values).encode(), log)

    def bytes(self, topic: str, schema: str, encoding: str, data: bytes, log: int) -> None:
        """A message as it is, whatever its schema says."""
        if topic not in self._channels:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(
                    schema, *_schema(schema, encoding)
                )
            self._channels[topic] = self._writer.register_channel(
                topic, encoding, self._schemas[schema]
            )
        self._writer.add_message(self._channels[topic], log, data, log)

    @staticmethod
    def _header(stamp: int, frame_id: str) -> dict[str, Any]:
        sec, nanosec = divmod(stamp, 10**9)
        return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}

    def _send(self, topic: str, schema: str, fields: dict[str, Any], log: int) -> None:
        if self.dialect == "ros2":
            if schema not in self._schemas:
                self._schemas[schema] = self._ros2.register_msgdef(schema, _ros2_definition(schema))
            self._ros2.write_message(topic, self._schemas[schema], fields, log)
        elif self.dialect == "json":
            self.bytes(topic, schema, "json", json.dumps(_json(fields)).encode(), log)
        else:
            self.bytes(topic, schema, "protobuf", _message(schema, fields).SerializeToString(), log)


def _schema(name: str, encoding: str) -> tuple[str, bytes]:
    if encoding != "protobuf":
        return ("jsonschema", b"{}") if encoding == "json" else (encoding, b"")
    return "protobuf", foxglove_schema(name.removeprefix("foxglove."))


def _message(schema: str, fields: Mapping[str, Any]) -> Any:
    message = foxglove(schema.removeprefix("foxglove."))()
    for name, value in fields.items():
        if name == "timestamp":
            message.timestamp.seconds, message.timestamp.nanos = divmod(value, 10**9)
        elif isinstance(value, Mapping):
            for axis, number in value.items():
                setattr(getattr(message, name), axis, number)
        elif isinstance(value, list):
            getattr(message, name).extend(value)
        else:
            setattr(message, name, value)
    return message


def _json(fields: Mapping[str, Any]) -> dict[str, Any]:
    plain = dict(fields)
    sec, nsec = divmod(plain["timestamp"], 10**9)
    plain["timestamp"] = {"sec": sec, "nsec": nsec}
    if "data" in plain:
        plain["data"] = base64.b64encode(plain["data"]).decode()
    return plain


# -- a whole scene --------------------------------------------------------------------------------


def picture(channel: str, frame: int, shape: tuple[int, int] = (24, 32)) -> np.ndarray:
    """The image of ``channel`` in ``frame``: noise, so that nothing compresses to nothing."""
    seed = [frame, *channel.encode()]
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


def stamp_of(frame: int) -> int:
    return START_NS + (frame + 1) * PERIOD_NS


def write_scene(
    path: Path,
    dialect: str = "protobuf",
    frames: Iterable[int] = range(12),
    *,
    channels: Iterable[str] = ("near", "far", "flat"),
    shape: tuple[int, int] = (24, 32),
    truth: bool = True,
    calibration: bool = True,
    stamp: Callable[[str, int], int] = lambda _, frame: stamp_of(frame),
    log: Callable[[str, int], int] = lambda _, frame: stamp_of(frame),
    skip: Callable[[str, int], bool] = lambda *_: False,
    **options: Any,
) -> Path:
    """A recording of random pictures with ground truth; ``stamp``, ``log`` and ``skip`` by
    channel and frame make it untidy, ``options`` go to the writer."""
    height, width = shape
    with Recorder(path, dialect, **options) as recorder:
        recorder.metadata("rig", {"f": "60.0", "pattern": "stripe"})
        for channel in channels if calibration else ():
            name = "camera_info" if dialect == "ros2" else "calibration"
            recorder.camera(f"/camera/{channel}/{name}", START_NS, width, height)
        for frame in frames:
            for channel in channels:
                if not skip(channel, frame):
                    recorder.image(
                        f"/camera/{channel}/image",
                        stamp(channel, frame),
                        picture(channel, frame, shape),
                        "mono8",
                        log(channel, frame),
                    )
            if truth:
                write_truth(recorder, stamp_of(frame), frame, shape)
    return path


def write_truth(recorder: Recorder, stamp: int, frame: int, shape: tuple[int, int]) -> None:
    depth = np.full(shape, 0.8, np.float32)
    depth[0, 0] = np.nan
    recorder.image("/ground_truth/depth", stamp, depth, "32FC1")
    recorder.image("/ground_truth/instances", stamp, picture("instances", frame, shape), "mono8")
    recorder.image("/ground_truth/faces", stamp, picture("faces", frame, shape), "mono8")
    half = 0.5**0.5
    poses = {
        "object_1_bar": ((0.1, 0.2, 0.8), (0.0, 0.0, 0.0, 1.0)),
        "object_2_hex": ((0.0, 0.0, 0.7), (0.0, 0.0, half, half)),
    }
    recorder.transforms("/ground_truth/transforms", stamp, poses)
    recorder.meta("/ground_truth/meta", stamp, {"kind": "pile", "frame": frame})


COMPRESSIONS = {
    "none": CompressionType.NONE,
    "lz4": CompressionType.LZ4,
    "zstd": CompressionType.ZSTD,
}

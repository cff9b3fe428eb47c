"""From messages to what they say, the same for Foxglove (protobuf, json) and ROS 2 (cdr).

The libraries decode; this module knows only what the fields are called in each dialect.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from mcap.records import Channel, Schema
from mcap.well_known import SchemaEncoding
from numpy.typing import NDArray

from workbench.recording.container import RawMessage
from workbench.recording.images import CompressedImage, RawImage
from workbench.recording.model import Camera, TopicKind

_KINDS: Mapping[str, TopicKind] = {
    "RawImage": "image",
    "Image": "image",
    "CompressedImage": "image",
    "CameraCalibration": "camera",
    "CameraInfo": "camera",
    "FrameTransform": "transform",
    "FrameTransforms": "transform",
    "TFMessage": "transform",
    "TransformStamped": "transform",
}

ENCODINGS = ("protobuf", "json", "cdr")
"""The message encodings that the bench decodes."""


class MessageError(ValueError):
    """A message cannot be decoded: what was expected and found."""


@dataclass(frozen=True)
class Image:
    """An image message whose pixels are still to be decoded."""

    frame_id: str
    pixels: RawImage | CompressedImage


@dataclass(frozen=True, eq=False)
class Transform:
    """``parent_from_child``, 4 4 float64, metres."""

    parent: str
    child: str
    parent_from_child: NDArray[np.float64]


Content = Image | Camera | tuple[Transform, ...] | Mapping[str, Any] | None


@dataclass(frozen=True)
class Decoded:
    """A message: its stamp (None where its schema has none) and what it says."""

    stamp_ns: int | None
    content: Content


def kind_of(channel: Channel, schema: Schema | None) -> TopicKind:
    """What the messages of ``channel`` are, by the last part of the schema's name."""
    name = re.split(r"[./]", schema.name)[-1] if schema else ""
    if name in _KINDS:
        return _KINDS[name]
    if channel.message_encoding == "json" or (name == "String" and schema):
        return "json"
    return "other"


class Decoder:
    """Decodes messages with the library of their encoding; one decoder per schema is kept."""

    def __init__(self) -> None:
        self._decoders: dict[int, Callable[[bytes], Any]] = {}
        self._factories: tuple[Any, ...] | None = None

    def decode(self, raw: RawMessage) -> Decoded:
        """Raises :class:`MessageError` if the message, or its schema, cannot be decoded."""
        kind = kind_of(raw.channel, raw.schema)
        try:
            message = self._decoder(raw.channel, raw.schema)(raw.data)
            return Decoded(_stamp_of(message), _content(message, kind))
        except MessageError:
            raise
        except Exception as error:  # whatever the libraries meet in damaged bytes
            what = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
            raise MessageError(" ".join(what.split())[:200]) from error

    def _decoder(self, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
        decoder = self._decoders.get(channel.id)
        if decoder is None:
            decoder = self._decoders[channel.id] = self._new(channel, schema)
        return decoder

    def _new(self, channel: Channel, schema: Schema | None) -> Callable[[bytes], Any]:
        if channel.message_encoding == "json":
            return json.loads
        if channel.message_encoding not in ENCODINGS:
            raise MessageError(
                f"encoding {channel.message_encoding!r} is not among the known ones: "
                + ", ".join(ENCODINGS)
            )
        if self._factories is None:
            from mcap_protobuf.decoder import DecoderFactory as ProtobufDecoders
            from mcap_ros2.decoder import DecoderFactory as Ros2Decoders

            self._factories = (ProtobufDecoders(), Ros2Decoders())
        for factory in self._factories:
            # The ROS 2 library tells of a definition that it cannot read on stderr, too.
            with contextlib.redirect_stderr(io.StringIO()):
                decoder: Callable[[bytes], Any] | None = factory.decoder_for(
                    channel.message_encoding, _tidy(schema)
                )
            if decoder is not None:
                return decoder
        found = f"schema {schema.name} in {schema.encoding}" if schema else "no schema"
        raise MessageError(f"{channel.message_encoding} message with {found} is not supported")


def _tidy(schema: Schema | None) -> Schema | None:
    """A ROS 2 definition without white space at the ends of lines, which hides its separators."""
    if schema is None or schema.encoding != SchemaEncoding.ROS2:
        return schema
    return replace(schema, data=b"\n".join(line.rstrip() for line in schema.data.splitlines()))


# -- fields ---------------------------------------------------------------------------------------


_MISSING = object()


def _get(message: Any, *names: str, default: Any = _MISSING) -> Any:
    """The first of the fields ``names`` that ``message`` (an object or a dict) has."""
    for name in names:
        if isinstance(message, Mapping):
            if name in message:
                return message[name]
        elif hasattr(message, name):
            return getattr(message, name)
    if default is _MISSING:
        raise MessageError(f"it has no field {names[0]!r}")
    return default


def _stamp_of(message: Any) -> int | None:
    header = _get(message, "header", default=message)
    stamp = _get(header, "stamp", "timestamp", default=None)
    if stamp is None:
        inner = _get(message, "transforms", default=None)
        return _stamp_of(inner[0]) if inner else None
    seconds = _get(stamp, "sec", "seconds", default=None)
    nanoseconds = _get(stamp, "nsec", "nanosec", "nanos", default=0)
    if not isinstance(seconds, int) or not isinstance(nanoseconds, int):
        return None
    return seconds * 1_000_000_000 + nanoseconds


def _content(message: Any, kind: TopicKind) -> Content:
    if kind == "image":
        return _image(message)
    if kind == "camera":
        return _camera(message)
    if kind == "transform":
        many = _get(message, "transforms", default=None)
        return tuple(_transform(one) for one in ([message] if many is None else many))
    if kind == "json":
        return _json(message)
    return None


def _frame_id(message: Any) -> str:
    return str(_get(_get(message, "header", default=message), "frame_id", default=""))


def _bytes(message: Any) -> bytes:
    data = _get(message, "data")
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _image(message: Any) -> Image:
    data = _bytes(message)
    encoding = _get(message, "encoding", default=None)
    if encoding is None:
        form = str(_get(message, "format", default=""))
        return Image(_frame_id(message), CompressedImage(form, data))
    raw = RawImage(
        width=int(_get(message, "width")),
        height=int(_get(message, "height")),
        encoding=str(encoding),
        step=int(_get(message, "step", default=0)),
        data=data,
        big_endian=bool(_get(message, "is_bigendian", default=False)),
    )
    return Image(_frame_id(message), raw)


def _camera(message: Any) -> Camera:
    K = _numbers(_get(message, "K", "k"))
    if K.size != 9:
        raise MessageError(f"K has {K.size} numbers, expected 9")
    K = K.reshape(3, 3)
    D = _numbers(_get(message, "D", "d", default=()))
    K.flags.writeable = D.flags.writeable = False
    return Camera(
        width=int(_get(message, "width")),
        height=int(_get(message, "height")),
        K=K,
        D=D,
        distortion_model=str(_get(message, "distortion_model", default="")),
        frame_id=_frame_id(message),
        stamp_ns=_stamp_of(message) or 0,
    )


def _numbers(values: Iterable[float]) -> NDArray[np.float64]:
    return np.array(list(values), dtype=np.float64)


def _transform(message: Any) -> Transform:
    parts = _get(message, "transform", default=message)
    position, turn = _get(parts, "translation"), _get(parts, "rotation")
    x, y, z, w = (float(_get(turn, axis)) for axis in "xyzw")
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    if not norm > 0 or not math.isfinite(norm):
        raise MessageError(f"the rotation ({x}, {y}, {z}, {w}) is not a quaternion")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), 0],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), 0],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), 0],
            [0, 0, 0, 1],
        ],
        dtype=np.float64,
    )
    matrix[:3, 3] = [float(_get(position, axis)) for axis in "xyz"]
    matrix.flags.writeable = False
    parent = str(_get(message, "parent_frame_id", default=None) or _frame_id(message))
    return Transform(parent, str(_get(message, "child_frame_id")), matrix)


def _json(message: Any) -> Mapping[str, Any]:
    if not isinstance(message, Mapping):  # a std_msgs/String that holds json
        message = json.loads(_get(message, "data"))
    if not isinstance(message, Mapping):
        raise MessageError(f"expected a json object, got {type(message).__name__}")
    return message

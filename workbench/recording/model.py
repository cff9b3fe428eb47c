"""What a recording gives: cameras, truth, frames and facts about topics.  Plain frozen data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.errors import DataError
from workbench.recording.defects import Defect

TopicKind = Literal["image", "camera", "transform", "json", "other"]


class RecordingError(DataError):
    """A recording cannot be used: one line with the file, what was expected and what was found."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one channel; pixel centres are at integers.

    ``K`` is 3 3 float64 in pixels, ``D`` holds the coefficients of ``distortion_model``.
    """

    width: int
    height: int
    K: NDArray[np.float64]
    D: NDArray[np.float64]
    distortion_model: str
    frame_id: str
    stamp_ns: int


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of one frame; what was not recorded, or not decodable, is None or empty.

    ``depth_m`` is H W float32, z along the optical axis in metres; ``instances`` (0 is the
    background) and ``faces`` are H W uint8; ``camera_from_object`` maps a child frame's name to a
    4 4 float64 transform in metres.
    """

    depth_m: NDArray[np.float32] | None
    instances: NDArray[np.uint8] | None
    faces: NDArray[np.uint8] | None
    camera_from_object: Mapping[str, NDArray[np.float64]]
    meta: Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Frame:
    """Images of one instant, with all that was recorded about them.

    ``index`` is the position among the paired frames of the recording, whatever slice is read.
    ``stamp_ns`` is that of the first required channel.  ``images`` are as recorded: mono H W
    (uint8, uint16 or float32), colour H W 3 RGB; all read-only.  ``digest`` identifies names,
    shapes, dtypes and pixels of ``images`` and nothing else, so that the same pictures in another
    container have the same digest.
    """

    index: int
    stamp_ns: int
    images: Mapping[str, NDArray[Any]]
    stamps_ns: Mapping[str, int]
    cameras: Mapping[str, Camera]
    truth: Truth | None
    digest: str
    defects: tuple[Defect, ...] = ()


@dataclass(frozen=True)
class TopicInfo:
    """Facts about one topic: ``encoding`` is protobuf, json or cdr; stamps are header stamps where
    the messages carry usable ones and log times otherwise; ``rate_hz`` is 1 / median interval."""

    topic: str
    schema: str
    encoding: str
    kind: TopicKind
    count: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    rate_hz: float | None = None

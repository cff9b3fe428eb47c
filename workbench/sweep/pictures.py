"""Small images of a stage's result: one for the gallery, one to tell how alike two results are."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import cv2
import numpy as np

from workbench.stage import Artifact, Stage

_LONGEST_SIDE_PX = 512
_GOLDEN = 0.618033988749895
_UNKNOWN = 62
_HEAD = struct.calcsize("<II")


def drawn(stage: Stage, artifacts: Mapping[str, Any]) -> bytes | None:
    """The stage's picture as PNG, at most 512 px long; None if it gives nothing to be seen."""
    image = stage.picture(artifacts)
    if image is None:
        image = _of_artifact(stage, artifacts)
    if image is None:
        return None
    longest = max(image.shape[:2])
    if longest > _LONGEST_SIDE_PX:
        scale = _LONGEST_SIDE_PX / longest
        image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if image.ndim == 3:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", image)
    return data.tobytes() if done else None


def outline_of(stage: Stage, artifacts: Mapping[str, Any]) -> bytes | None:
    """Where the stage's lines or the borders of its regions run, at half resolution, packed.

    Taken from the last boolean or integer image that the stage gives.  At half resolution a line
    that moves by a pixel is mostly the same line.
    """
    for value in _images(stage, artifacts):
        if value.dtype == np.bool_:
            lines = value
        elif value.dtype.kind == "i":
            lines = borders(value)
        else:
            continue
        height, width = (size - size % 2 for size in lines.shape)
        even = lines[:height, :width]
        half = even[::2, ::2] | even[1::2, ::2] | even[::2, 1::2] | even[1::2, 1::2]
        return struct.pack("<II", *half.shape) + np.packbits(half).tobytes()
    return None


def agreement(one: Sequence[bytes], other: Sequence[bytes]) -> float:
    """Mean overlap of outlines frame by frame, 0 to 1: pixels in both over pixels in either.

    Two empty outlines agree; outlines of different sizes have nothing in common.
    """
    shares = []
    for a, b in zip(one, other, strict=True):
        if a[:_HEAD] != b[:_HEAD]:
            shares.append(0.0)
            continue
        first, second = (np.frombuffer(data, np.uint8, offset=_HEAD) for data in (a, b))
        either = int(np.bitwise_count(first | second).sum())
        both = int(np.bitwise_count(first & second).sum())
        shares.append(both / either if either else 1.0)
    return math.fsum(shares) / len(shares) if shares else math.nan


def borders(labels: np.ndarray) -> np.ndarray:
    """Pixels [H W] bool whose right or lower neighbour has another label."""
    lines = np.zeros(labels.shape, np.bool_)
    lines[:, :-1] |= labels[:, 1:] != labels[:, :-1]
    lines[:-1] |= labels[1:] != labels[:-1]
    return lines


def _of_artifact(stage: Stage, artifacts: Mapping[str, Any]) -> np.ndarray | None:
    """The last image that the stage gives: white lines, coloured labels, or grey levels."""
    for value in _images(stage, artifacts):
        if value.dtype == np.bool_:
            return value.astype(np.uint8) * np.uint8(255)
        if value.dtype.kind in "iu":
            return label_colours(value)
        if value.dtype.kind == "f":
            return _grey(value)
    return None


def can_draw(stage: Stage) -> bool:
    """Whether the stage gives something that :func:`drawn` can show."""
    drawing = type(stage).picture is not Stage.picture
    return drawing or any(_is_image(artifact) for artifact in stage.gives)


def _is_image(artifact: Artifact) -> bool:
    """Two free axes: points [N 2] are no image."""
    return len(artifact.axes) == 2 and not any(axis.isdigit() for axis in artifact.axes)


def _images(stage: Stage, artifacts: Mapping[str, Any]) -> Iterator[np.ndarray]:
    """The images among what the stage gives, the last first."""
    for artifact in reversed(stage.gives):
        value = artifacts.get(artifact.name)
        if _is_image(artifact) and isinstance(value, np.ndarray) and value.size:
            yield value


def label_colours(labels: np.ndarray) -> np.ndarray:
    """Labels [H W] as RGB, neighbours in number far apart in hue, 0 black."""
    top = int(labels.max(initial=0)) + 1
    numbers = np.arange(top)
    hsv = np.zeros((1, top, 3), np.uint8)
    hsv[0, :, 0] = (numbers * _GOLDEN % 1.0 * 180).astype(np.uint8)
    hsv[0, :, 1] = 150
    hsv[0, :, 2] = 235
    table = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    table[0] = 0
    return table[np.clip(labels, 0, top - 1)]


def _grey(image: np.ndarray) -> np.ndarray:
    known = np.isfinite(image)
    if not known.any():
        return np.full(image.shape, _UNKNOWN, np.uint8)
    low, high = np.percentile(image[known], [2, 98])
    scaled = (image - low) / max(float(high - low), 1e-12)
    grey = np.clip(np.nan_to_num(scaled), 0, 1) * 255
    return np.where(known, grey, _UNKNOWN).astype(np.uint8)

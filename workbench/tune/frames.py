"""Frames of a recording by position, read when they are asked for and kept while there is room."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import Protocol

from workbench.errors import DataError, one_line
from workbench.recording import Frame
from workbench.session import Session

_KEPT_BYTES = 128 << 20


class FrameSource(Protocol):
    """Where a live bench takes its frames from; a list of frames is one."""

    def __len__(self) -> int: ...

    def __getitem__(self, position: int, /) -> Frame:
        """The frame at a position from 0.  Raises :class:`DataError` if it cannot be had."""
        ...


class SessionFrames:
    """The frames of a session, in the range that its options give.

    Reading goes on from the frame that was read last, so that playing a recording reads it once.
    """

    def __init__(self, session: Session, kept_bytes: int = _KEPT_BYTES) -> None:
        self._session = session
        self._kept: OrderedDict[int, Frame] = OrderedDict()
        self._kept_bytes = kept_bytes
        self._bytes = 0
        self._count = session.count()
        self._reader: Iterator[Frame] | None = None
        self._next = 0

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, position: int, /) -> Frame:
        if not 0 <= position < self._count:
            raise DataError(f"frame {position}: expected 0 to {self._count - 1}")
        if position in self._kept:
            self._kept.move_to_end(position)
            return self._kept[position]
        frame = self._read(self._session.options.frames[0] + position)
        self._keep(position, frame)
        return frame

    def _read(self, index: int) -> Frame:
        path = self._session.recording.path
        required, optional = self._session.pipeline.channels
        try:
            if self._reader is None or not self._next <= index < self._next + 8:
                self._reader = self._session.recording.frames(required, optional, index)
            for frame in self._reader:
                self._next = frame.index + 1
                if frame.index == index:
                    return frame
                if frame.index > index:
                    break
        except (DataError, OSError) as error:
            self._reader = None
            says = error.strerror if isinstance(error, OSError) else one_line(error)
            raise DataError(f"{path}: frame {index} cannot be read: {says}") from error
        self._reader = None
        raise DataError(f"{path}: frame {index} cannot be decoded")

    def _keep(self, position: int, frame: Frame) -> None:
        self._kept[position] = frame
        self._bytes += _size(frame)
        while self._bytes > self._kept_bytes and len(self._kept) > 1:
            _, dropped = self._kept.popitem(last=False)
            self._bytes -= _size(dropped)


def _size(frame: Frame) -> int:
    return sum(image.nbytes for image in frame.images.values())

"""From the bytes of an image message to an array.

Everything is bounded by the bytes that are there: a size in a header that the data cannot back is
refused before anything is allocated for it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[Any]


class ImageError(ValueError):
    """An image cannot be decoded: the message says what was expected and found."""


class Encoding(NamedTuple):
    """Layout of a raw encoding; ``conversion`` names the cv2 colour code that leads to RGB."""

    dtype: str
    channels: int
    conversion: str = ""


def _bayer(pattern: str) -> dict[str, Encoding]:
    # cv2's aliases in capitals name the first row's first two pixels, as ROS and Foxglove do;
    # its older two-letter names start at another pixel and are easily confused with them.
    code = f"COLOR_Bayer{pattern.upper()}2RGB"
    return {
        f"bayer_{pattern}8": Encoding("u1", 1, code),
        f"bayer_{pattern}16": Encoding("u2", 1, code),
    }


ENCODINGS: dict[str, Encoding] = {
    "mono8": Encoding("u1", 1),
    "8UC1": Encoding("u1", 1),
    "mono16": Encoding("u2", 1),
    "16UC1": Encoding("u2", 1),
    "32FC1": Encoding("f4", 1),
    "rgb8": Encoding("u1", 3),
    "bgr8": Encoding("u1", 3, "COLOR_BGR2RGB"),
    # OpenCV's name says nothing of the order of colours; its own order is BGR.
    "8UC3": Encoding("u1", 3, "COLOR_BGR2RGB"),
    "rgba8": Encoding("u1", 4, "COLOR_RGBA2RGB"),
    "bgra8": Encoding("u1", 4, "COLOR_BGRA2RGB"),
    "8UC4": Encoding("u1", 4, "COLOR_BGRA2RGB"),
    "rgb16": Encoding("u2", 3),
    "bgr16": Encoding("u2", 3, "COLOR_BGR2RGB"),
    **_bayer("rggb"),
    **_bayer("bggr"),
    **_bayer("gbrg"),
    **_bayer("grbg"),
    "yuv422": Encoding("u1", 2, "COLOR_YUV2RGB_UYVY"),
    "uyvy": Encoding("u1", 2, "COLOR_YUV2RGB_UYVY"),
    "yuv422_yuy2": Encoding("u1", 2, "COLOR_YUV2RGB_YUY2"),
    "yuyv": Encoding("u1", 2, "COLOR_YUV2RGB_YUY2"),
}
"""The raw encodings that the bench reads, by the names that Foxglove and ROS give them."""

_BY_NAME = {name.lower(): encoding for name, encoding in ENCODINGS.items()}


@dataclass(frozen=True)
class RawImage:
    """A raw image message: ``height`` rows of ``step`` bytes (0: no padding)."""

    width: int
    height: int
    encoding: str
    step: int
    data: bytes
    big_endian: bool = False

    def decode(self) -> Pixels:
        """The image as recorded, H W or H W 3 RGB, read-only; a view of ``data`` where it can be.

        Raises :class:`ImageError` if the encoding is unknown or the sizes contradict each other.
        """
        known = _BY_NAME.get(self.encoding.lower())
        if known is None:
            raise ImageError(
                f"encoding {self.encoding!r} is not among the known ones: {', '.join(ENCODINGS)}"
            )
        dtype = np.dtype(known.dtype).newbyteorder(">" if self.big_endian else "<")
        view = self._view(dtype, known.channels)
        if not dtype.isnative:
            view = view.astype(dtype.newbyteorder("="))
        if known.conversion:
            import cv2

            # Bayer and YUV codes are only defined for rows without gaps.
            view = cv2.cvtColor(np.ascontiguousarray(view), getattr(cv2, known.conversion))
        view.flags.writeable = False
        return view

    def _view(self, dtype: np.dtype[Any], channels: int) -> Pixels:
        if self.width <= 0 or self.height <= 0:
            raise ImageError(f"its size is {self.width} x {self.height}, expected at least 1 x 1")
        row = self.width * channels * dtype.itemsize
        step = self.step or row
        if step < row:
            raise ImageError(
                f"step is {step} bytes, but {self.width} pixels of {self.encoding} take {row}"
            )
        # The padding of the last row is not always written.
        whole, least = step * self.height, step * (self.height - 1) + row
        if not least <= len(self.data) <= whole:
            raise ImageError(
                f"step x height is {step} x {self.height} = {whole} bytes, "
                f"but its data has {len(self.data)}"
            )
        shape: tuple[int, ...] = (self.height, self.width)
        strides: tuple[int, ...] = (step, channels * dtype.itemsize)
        if channels > 1:
            shape, strides = (*shape, channels), (*strides, dtype.itemsize)
        view: Pixels = np.ndarray(shape, dtype, self.data, 0, strides)
        # Rows that do not start on a multiple of the pixel's size cannot be shared with C code.
        return view if view.flags.aligned else view.copy()


@dataclass(frozen=True)
class CompressedImage:
    """A compressed image message.  ``format`` is what the recorder claims; the content decides."""

    format: str
    data: bytes

    def decode(self) -> Pixels:
        """The image, H W or H W 3 RGB, uint8 or uint16, read-only.

        EXIF orientation is not applied: pixels stay where the calibration expects them.
        Raises :class:`ImageError` if the bytes are not a whole PNG or JPEG.
        """
        if self.data.startswith(_PNG):
            _check_png(self.data)
        elif self.data.startswith(b"\xff\xd8"):
            _check_jpeg(self.data)
        else:
            raise ImageError(
                f"its {len(self.data)} bytes (format {self.format!r}) are neither PNG nor JPEG: "
                f"they start with {self.data[:8].hex(' ') or 'nothing'}"
            )
        import cv2

        try:
            image = cv2.imdecode(np.frombuffer(self.data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error as error:
            raise ImageError(f"OpenCV cannot decode it: {' '.join(str(error).split())}") from None
        if image is None:
            raise ImageError(f"OpenCV cannot decode its {len(self.data)} bytes")
        if image.ndim == 3:
            colours = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
            image = cv2.cvtColor(image, colours[image.shape[2]])
        image.flags.writeable = False
        return image


_PNG = b"\x89PNG\r\n\x1a\n"

# Deflate cannot expand more than 1032 times, so more pixels than this cannot be coded.
_PNG_BYTES_PER_BYTE = 1032
# A JPEG block of 64 pixels takes at least one bit (in a progressive scan).
_JPEG_PIXELS_PER_BYTE = 64 * 8


def _check_png(data: bytes) -> None:
    """Raise :class:`ImageError` unless every chunk of the PNG is whole and its size is possible."""
    at = len(_PNG)
    while True:
        if at + 12 > len(data):
            raise ImageError(f"the PNG is cut: its {len(data)} bytes hold no end")
        length, name = struct.unpack_from(">I4s", data, at)
        end = at + 12 + length
        if end > len(data):
            raise ImageError(f"the PNG is cut: {end} bytes expected, {len(data)} found")
        if zlib.crc32(memoryview(data)[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end]):
            raise ImageError(f"the PNG is damaged: its {name.decode('latin-1')} part fails its CRC")
        if name == b"IHDR":
            width, height, depth = struct.unpack_from(">IIB", data, at + 8)
            if width * height * depth > _PNG_BYTES_PER_BYTE * 8 * len(data):
                raise ImageError(f"{len(data)} bytes cannot code a PNG of {width} x {height}")
        if name == b"IEND":
            return
        at = end


def _check_jpeg(data: bytes) -> None:
    """Raise :class:`ImageError` unless the JPEG has a size that is possible, a scan and an end."""
    at, sized = 2, False
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise ImageError(f"the JPEG is damaged: no marker at byte {at}")
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte before a marker
            at += 1
            continue
        length = int.from_bytes(data[at + 2 : at + 4])
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9].ljust(4, b"\0"))
            if width * height > _JPEG_PIXELS_PER_BYTE * len(data):
                raise ImageError(f"{len(data)} bytes cannot code a JPEG of {width} x {height}")
            sized = True
        if marker == 0xDA:
            if not sized or data.rfind(b"\xff\xd9", at) < 0:
                raise ImageError(f"the JPEG is cut: its {len(data)} bytes hold no end")
            return
        at += 2 + length
    raise ImageError(f"the JPEG is cut: its {len(data)} bytes hold no picture")

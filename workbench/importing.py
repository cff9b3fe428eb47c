"""Image files as the frames of a recording: finding, pairing, reading, stamping.

Nothing here knows what the images are of: a frame is one image of every channel.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from workbench.errors import DataError, UsageError
from workbench.recording.images import CompressedImage, ImageError

Transfer = Literal["linear", "srgb"]

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".webp")
"""What is taken from a folder; a file that is named itself may be called anything."""

FIRST_NS = 946_684_800 * 10**9
"""The first frame's stamp where the images tell no time: the start of the year 2000, UTC."""

_STORED_AS_THEY_ARE = ((b"\x89PNG\r\n\x1a\n", "png"), (b"\xff\xd8", "jpeg"))
_SECOND_NS = 10**9
_CELLS = (24, 24)
_ENDS = (0.1, 0.9)
_EXIF_IFD = 0x8769
_TAKEN, _TAKEN_FRACTION, _TAKEN_ZONE = 36867, 37521, 36881
_LENS = {37386: "FocalLength", 33437: "FNumber", 37382: "SubjectDistance"}


# -- which files belong together ------------------------------------------------------------------


@dataclass(frozen=True)
class Pairing:
    """Frames of files, one for every channel; ``how`` they were found to belong together."""

    frames: tuple[Mapping[str, Path], ...]
    how: str
    left_out: tuple[Path, ...] = ()


def pair_files(sources: Mapping[str, str]) -> Pairing:
    """The frames in ``sources``: channel to a file, a folder, or a pattern with one ``*``.

    Files, one for each channel, are one frame.  Of folders and patterns those belong together
    whose names are alike (for patterns: what the star stands for), with or without the channel's
    own name at either end; where no two are and there are as many of each, they are taken in
    the order of their names.  Raises :class:`DataError`.
    """
    found = {channel: _files(channel, source) for channel, source in sources.items()}
    lone = {channel: files for channel, files in found.items() if isinstance(files, Path)}
    if len(lone) == len(found):
        return Pairing((lone,), "files")
    if lone:
        other = next(channel for channel in found if channel not in lone)
        channel = next(iter(lone))
        raise DataError(
            f"--{channel} {sources[channel]}: expected a folder or a pattern, as --{other} is "
            f"one, found a file"
        )
    listed: dict[str, dict[str, Path]] = {c: f for c, f in found.items() if isinstance(f, dict)}
    for bare in (False, True):
        keyed = {
            channel: {_bare(key, channel) if bare else key: path for key, path in files.items()}
            for channel, files in listed.items()
        }
        first, *others = keyed.values()
        common = [key for key in first if all(key in other for other in others)]
        if common:
            left = [p for files in keyed.values() for key, p in files.items() if key not in common]
            frames = [{channel: keyed[channel][key] for channel in keyed} for key in common]
            return Pairing(tuple(frames), "names", tuple(left))
    counts = {channel: len(files) for channel, files in listed.items()}
    if len(set(counts.values())) > 1:
        told = ", ".join(f"{n} in --{channel} {sources[channel]}" for channel, n in counts.items())
        raise DataError(f"expected names in common or as many images of each, found {told}")
    rows = zip(*(files.values() for files in listed.values()), strict=True)
    return Pairing(tuple(dict(zip(listed, row, strict=True)) for row in rows), "order of names")


def _files(channel: str, source: str) -> Path | dict[str, Path]:
    """A file, or names to files in natural order."""
    path = Path(source)
    if path.is_file():
        return path
    if path.is_dir():
        return {file.stem: file for file in folder_images(f"--{channel}", path)}
    folder, pattern = path.parent, path.name
    if pattern.count("*") != 1:
        raise DataError(f"--{channel} {source}: expected a file, a folder or a pattern with one *")
    before, after = pattern.split("*")
    matches = {
        file.name[len(before) : len(file.name) - len(after)]: file
        for file in sorted(folder.glob(pattern), key=_natural)
        if file.is_file()
    }
    if not matches:
        raise DataError(f"--{channel} {source}: no file is called so")
    return matches


def folder_images(flag: str, folder: Path) -> list[Path]:
    """The images in ``folder`` in natural order.  Raises :class:`DataError` if there is none."""
    files = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
    files = sorted((f for f in files if f.is_file() and f.name[0] != "."), key=_natural)
    if not files:
        raise DataError(f"{flag} {folder}: no image in it ({', '.join(SUFFIXES)})")
    return files


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sorts ``shot2`` before ``shot10``."""
    parts = re.findall(r"\d+|\D+", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _bare(key: str, channel: str) -> str:
    """``key`` without the channel's name and what joins it."""
    name = re.escape(channel)
    return re.sub(rf"^{name}[ _.-]*|[ _.-]*{name}$", "", key, flags=re.IGNORECASE)


# -- reading --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Picture:
    """An image file: its pixels, and its own bytes where a recording can hold them as they are.

    ``pixels``: uint8, uint16 or float32, H W or H W 3 RGB.
    """

    path: Path
    pixels: np.ndarray
    encoded: bytes | None
    form: str = ""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.pixels.shape[1], self.pixels.shape[0]


def read_picture(path: Path) -> Picture:
    """Read one image file.  Raises :class:`DataError` if it is none, or of an odd kind."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DataError(f"{path}: {error.strerror}") from error
    for magic, form in _STORED_AS_THEY_ARE:
        if data.startswith(magic):
            try:
                pixels = CompressedImage(form, data).decode()
            except ImageError as error:
                raise DataError(f"{path}: {error}") from error
            return Picture(path, _checked(path, pixels), data, form)
    pages = read_pages(path, data, most=1)
    return Picture(path, pages[0], None)


def read_pages(path: Path, data: bytes, most: int = 1 << 16) -> list[np.ndarray]:
    """The pages of a file that OpenCV reads, RGB.  Raises :class:`DataError` if it does not."""
    import cv2

    try:
        done, pages = cv2.imdecodemulti(
            np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED, range=(0, most)
        )
    except cv2.error:
        done, pages = False, ()
    if not done or not len(pages):
        # Not every format has pages.
        try:
            single = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        except cv2.error:
            single = None
        pages = () if single is None else (single,)
    if not len(pages):
        raise DataError(
            f"{path}: expected an image, found {len(data)} bytes that OpenCV cannot decode"
        )
    return [_checked(path, _to_rgb(page)) for page in pages]


def _to_rgb(image: np.ndarray) -> np.ndarray:
    import cv2

    if image.ndim == 2:
        return image
    codes = {3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    return cv2.cvtColor(image, codes[image.shape[2]]) if image.shape[2] in codes else image


def _checked(path: Path, image: np.ndarray) -> np.ndarray:
    kinds = {2: ("uint8", "uint16", "float32"), 3: ("uint8", "uint16")}
    odd = image.ndim == 3 and image.shape[2] != 3
    if odd or image.dtype.name not in kinds.get(image.ndim, ()):
        raise DataError(
            f"{path}: expected grey or colour of 8 or 16 bit, or grey float32, found "
            f"{image.dtype} {list(image.shape)}"
        )
    return image


def linear_light(pixels: np.ndarray, transfer: Transfer) -> np.ndarray:
    """Grey levels in proportion to light: those of sRGB as uint16, linear ones as they are.

    Raises :class:`UsageError` for floating-point pixels in sRGB.
    """
    if transfer == "linear":
        return pixels
    if not np.issubdtype(pixels.dtype, np.integer):
        raise UsageError(f"--transfer srgb: expected images of 8 or 16 bit, found {pixels.dtype}")
    top = np.iinfo(pixels.dtype).max
    level = np.arange(top + 1) / top
    linear = np.where(level <= 0.04045, level / 12.92, ((level + 0.055) / 1.055) ** 2.4)
    return np.rint(linear * 65535).astype(np.uint16)[pixels]


def encoded_png(pixels: np.ndarray) -> bytes:
    """``pixels`` (uint8 or uint16) as PNG, which loses nothing and is about half as large."""
    import cv2

    ordered = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR)
    done, data = cv2.imencode(".png", ordered)
    assert done
    return bytes(data.tobytes())


# -- focal stacks ---------------------------------------------------------------------------------


def stack_files(source: Path) -> list[Picture]:
    """The images of a focal stack, in order: a folder, or the pages of one file.

    Raises :class:`DataError` for less than two, or of different sizes.
    """
    if source.is_dir():
        pictures = [read_picture(path) for path in folder_images("--stack", source)]
    elif source.is_file():
        pictures = [Picture(source, page, None) for page in read_pages(source, source.read_bytes())]
    else:
        raise DataError(f"--stack {source}: expected a folder or a file with pages")
    if len(pictures) < 2:
        raise DataError(f"--stack {source}: expected two images or more, found one")
    for picture in pictures[1:]:
        check_alike(pictures[0], picture)
    return pictures


def choose_planes(pictures: Sequence[Picture]) -> tuple[int, int]:
    """The two planes of a focal stack that take the scene between them.

    Where each part of the scene is sharpest is looked up over a grid of cells; taken are the
    planes below and above which a tenth of the scene's sharpness lies.
    """
    import cv2

    energies = []
    for picture in pictures:
        grey = picture.pixels.astype(np.float32)
        if grey.ndim == 3:
            grey = grey.mean(axis=2)
        fine = cv2.Laplacian(cv2.GaussianBlur(grey, (0, 0), 1.0), cv2.CV_32F, ksize=3)
        energies.append(cv2.resize(fine * fine, _CELLS, interpolation=cv2.INTER_AREA).ravel())
    energy = np.array(energies)
    # What is the same in every plane is noise.
    weight = energy.max(axis=0) - np.median(energy, axis=0)
    share = np.bincount(energy.argmax(axis=0), weight, minlength=len(pictures)).cumsum()
    if not share[-1] > 0:
        return 0, len(pictures) - 1
    first, last = (int(np.searchsorted(share, end * share[-1])) for end in _ENDS)
    if first == last:
        first, last = max(0, first - 1), min(len(pictures) - 1, last + 1)
    return first, last


# -- checks and stamps ----------------------------------------------------------------------------


def check_alike(one: Picture, other: Picture) -> None:
    """Raise :class:`DataError`, naming both sizes, unless two pictures have the same."""
    if one.size != other.size:
        raise DataError(
            f"expected images of one size, found {one.path} {one.size[0]}×{one.size[1]} and "
            f"{other.path} {other.size[0]}×{other.size[1]}"
        )


def stamps(paths: Sequence[Path], rate_hz: float | None) -> tuple[list[int], str]:
    """A stamp in nanoseconds for each frame, and where it is from.

    ``rate_hz``, else the times at which the pictures were taken (EXIF) if all have one and they
    go up, else one frame a second in the order of the files.
    """
    if rate_hz is None:
        taken = [exif(path).get("taken_ns") for path in paths]
        known = [stamp for stamp in taken if stamp is not None]
        if len(known) == len(paths) and all(a < b for a, b in pairwise(known)):
            return known, "EXIF"
    interval = _SECOND_NS / (rate_hz or 1)
    source = "order of files, one a second" if rate_hz is None else f"rate {rate_hz:g} Hz"
    return [FIRST_NS + round(k * interval) for k in range(len(paths))], source


def exif(path: Path) -> dict[str, Any]:
    """What a camera wrote about a picture, as far as it is needed here; empty if nothing.

    ``taken_ns``, and of the lens ``FocalLength`` (mm), ``FNumber``, ``SubjectDistance`` (m).
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as image:
                tags = image.getexif().get_ifd(_EXIF_IFD)
    except (OSError, ValueError, SyntaxError, struct.error, Image.DecompressionBombError):
        return {}
    found: dict[str, Any] = {}
    for tag, name in _LENS.items():
        try:
            found[name] = float(tags[tag])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            continue
    try:
        zone = str(tags.get(_TAKEN_ZONE, "+00:00")).strip() or "+00:00"
        moment = datetime.strptime(f"{tags[_TAKEN]} {zone}", "%Y:%m:%d %H:%M:%S %z")
        digits = re.sub(r"\D", "", str(tags.get(_TAKEN_FRACTION, "")))[:9]
        fraction = int(digits.ljust(9, "0")) if digits else 0
        found["taken_ns"] = int(moment.astimezone(UTC).timestamp()) * _SECOND_NS + fraction
    except (KeyError, ValueError):
        pass
    return found

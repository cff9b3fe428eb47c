"""``workbench import``: image files to a recording."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workbench import interrupts
from workbench.commands.calibrate import RESOURCE, required_channels
from workbench.console import out, table, tracked
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.importing import (
    Picture,
    Transfer,
    check_alike,
    choose_planes,
    encoded_png,
    exif,
    linear_light,
    pair_files,
    read_picture,
    stack_files,
    stamps,
)
from workbench.plugins import find_stages
from workbench.procedures import procedure_of, report_rows
from workbench.recording.writer import RecordingWriter
from workbench.report import to_json
from workbench.stage import Stage

_NOT_LINEAR = (
    "JPEG images are seldom linear in light, which blur is: if these come from a camera that "
    "developed them, import with --transfer srgb"
)


@dataclass(frozen=True)
class ImportOptions:
    """What the command was told.  ``sources``: channel to a file, a folder or a pattern."""

    sources: Mapping[str, str]
    stack: Path | None
    planes: str | None
    rig: Path | None
    rate_hz: float | None
    transfer: Transfer
    output: Path
    plugins: Sequence[Path] = field(default=())


def run(options: ImportOptions, as_json: bool) -> None:
    """Find the images, write the recording and tell what is in it."""
    stages = find_stages(options.plugins)
    channels = required_channels(stages)
    _check_flags(options, channels)
    check_output("--output", options.output)
    report: dict[str, Any] = {}
    frames: Iterable[Mapping[str, Picture]]
    if options.stack is not None:
        frames = _stack_frames(options.stack, options.planes, channels, report)
        named = [{c: picture.path for c, picture in frame.items()} for frame in frames]
    else:
        pairing = pair_files(options.sources)
        named = [dict(frame) for frame in pairing.frames]
        report["paired_by"] = pairing.how
        report["left_out"] = [str(path) for path in pairing.left_out]
        frames = _read(named)
    times, source = stamps([frame[channels[0]] for frame in named], options.rate_hz)
    first: Picture | None = None
    forms = set()
    with RecordingWriter.create(options.output) as writer:
        for stamp_ns, frame in zip(times, tracked(frames, "import", len(named)), strict=True):
            for picture in frame.values():
                first = first or picture
                check_alike(first, picture)
            if writer.frames == 0:
                assert first is not None
                _write_rig(writer, options, stages, first, list(frame), stamp_ns, report)
            for channel, picture in frame.items():
                forms.add(_write(writer, f"/camera/{channel}/image", picture, options, stamp_ns))
            writer.frames += 1
            interrupts.check()
    assert first is not None
    width, height = first.size
    report |= {
        "frames": len(named),
        "channels": list(named[0]),
        "size": f"{width}×{height}",
        "stamps_from": source,
        "transfer": options.transfer,
    }
    notes = []
    if "jpeg" in forms and options.transfer == "linear":
        notes.append(_NOT_LINEAR)
    if report.get("left_out"):
        some = ", ".join(report["left_out"][:3])
        notes.append(f"{len(report['left_out'])} images have no counterpart: {some}")
    report["notes"] = notes
    if as_json:
        print(to_json(report))
        return
    shown = {k: v for k, v in report.items() if k not in ("notes", "left_out")}
    table("Import", ("quantity", "value"), report_rows(shown))
    for note in notes:
        out.print(f"note: {note}", style="yellow", markup=False, soft_wrap=True)
    out.print(f"wrote {options.output}", soft_wrap=True, markup=False)


def _check_flags(options: ImportOptions, channels: Sequence[str]) -> None:
    if options.stack is not None:
        if options.sources:
            raise UsageError(f"--stack: expected it alone, found --{next(iter(options.sources))}")
        if len(channels) != 2:
            raise UsageError(f"--stack: expected stages of two images, found {len(channels)}")
    else:
        if options.planes is not None:
            raise UsageError("--planes: expected with --stack")
        for channel in channels:
            if channel not in options.sources:
                raise UsageError(f"--{channel}: expected a file, a folder or a pattern")
    if options.rate_hz is not None and not 0 < options.rate_hz < 1e6:
        raise UsageError(f"--rate {options.rate_hz:g}: expected more than 0 Hz")


def _read(named: Sequence[Mapping[str, Path]]) -> Iterator[Mapping[str, Picture]]:
    for frame in named:
        yield {channel: read_picture(path) for channel, path in frame.items()}


def _stack_frames(
    source: Path, planes: str | None, channels: Sequence[str], report: dict[str, Any]
) -> list[Mapping[str, Picture]]:
    pictures = stack_files(source)
    chosen = choose_planes(pictures) if planes is None else _planes(planes, len(pictures))
    report |= {
        "planes": list(chosen),
        "planes_of": len(pictures),
        "planes_from": "sharpness" if planes is None else "--planes",
    }
    return [{channel: pictures[k] for channel, k in zip(channels, chosen, strict=True)}]


def _planes(text: str, count: int) -> tuple[int, int]:
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        first = second = -1
    if first == second or not (0 <= first < count and 0 <= second < count):
        raise UsageError(
            f"--planes {text}: expected I,J, two different numbers from 0 to {count - 1}"
        )
    return first, second


def _write_rig(
    writer: RecordingWriter,
    options: ImportOptions,
    stages: Mapping[str, Stage],
    first: Picture,
    channels: Sequence[str],
    stamp_ns: int,
    report: dict[str, Any],
) -> None:
    """The metadata record ``rig`` and the cameras; else what EXIF says of the lens."""
    if options.rig is None:
        lens = {key: value for key, value in exif(first.path).items() if key != "taken_ns"}
        if lens:
            report["lens_by_EXIF"] = [f"{key} {value:g}" for key, value in lens.items()]
            writer.metadata("exif", {key: f"{value:g}" for key, value in lens.items()})
        return
    procedure = procedure_of(stages, RESOURCE)
    if not hasattr(procedure, "rig_record"):
        raise UsageError(f"--rig {options.rig}: these stages know of no rig")
    try:
        values, cameras = procedure.rig_record(options.rig, first.size)
    except ValueError as error:
        raise DataError(str(error)) from error
    writer.metadata("rig", values)
    width, height = first.size
    for channel in channels:
        if channel in cameras:
            writer.camera(channel, cameras[channel], width, height, stamp_ns=stamp_ns)
    report["rig"] = options.rig.name


def _write(
    writer: RecordingWriter, topic: str, picture: Picture, options: ImportOptions, stamp_ns: int
) -> str:
    """Write one image; what it is stored as."""
    pixels = linear_light(picture.pixels, options.transfer)
    if pixels is picture.pixels and picture.encoded is not None:
        # The file itself: nothing is lost, and nothing grows.
        writer.compressed_image(topic, picture.encoded, picture.form, stamp_ns)
        return picture.form
    if pixels.dtype.kind == "f":
        writer.image(topic, pixels, stamp_ns)
        return "raw"
    writer.compressed_image(topic, encoded_png(pixels), "png", stamp_ns)
    return "png"

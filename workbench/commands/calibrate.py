"""``workbench calibrate``: runs the procedure that the pipeline's calibration names."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from workbench.console import err, out, table
from workbench.digest import digest_of_file
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.plugins import find_stages
from workbench.procedures import parameters_of, procedure_of, report_rows
from workbench.recording import Recording
from workbench.report import to_json
from workbench.session import check_topics
from workbench.stage import RecordedImage, Stage

RESOURCE = "calibration"
_RECORDING_SUFFIX = ".mcap"


def run(
    path: Path,
    output: Path,
    assignments: Sequence[str],
    topics: Mapping[str, str],
    plugins: Sequence[Path],
    as_json: bool,
) -> None:
    """Calibrate, write the file and print its report."""
    stages = find_stages(plugins)
    check_topics(topics, stages)
    procedure = procedure_of(stages, RESOURCE)
    parameters = parameters_of(procedure.Parameters, "calibrate", assignments)
    check_output("--output", output)
    recording = Recording.open(path, topics=topics)
    required = required_channels(stages)
    recording.require(required)
    with err.status("calibrate") as status:
        try:
            made = procedure.run(
                lambda: recording.frames(required),
                dict(recording.rig),
                parameters,
                progress=lambda says: status.update(f"calibrate: {says}"),
            )
        except ValueError as error:
            raise DataError(f"{path}: {error}") from error
    made.report["recording"] = {"name": path.name, "digest": recording.digest}
    _finish(made, output, as_json, recording.defects.lines())


def run_from_optics(
    source: Path,
    path: Path | None,
    size: tuple[int, int] | None,
    output: Path,
    assignments: Sequence[str],
    topics: Mapping[str, str],
    plugins: Sequence[Path],
    as_json: bool,
) -> None:
    """Calibrate from a rig (``source``) for images of ``size``, or those of the recording ``path``.

    Without either for images of any size.
    """
    stages = find_stages(plugins)
    check_topics(topics, stages)
    procedure = procedure_of(stages, RESOURCE)
    if not hasattr(procedure, "from_optics"):
        raise UsageError("--from-optics: these stages do not calibrate from optics")
    parameters = parameters_of(procedure.OpticsParameters, "calibrate", assignments)
    check_output("--output", output)
    if path is not None and size is not None:
        raise UsageError(f"--image-size: expected without a recording, found {path}")
    rig: Path | Mapping[str, str] = source
    if source.suffix.lower() == _RECORDING_SUFFIX:
        rig = Recording.open(source).rig
        if not rig:
            raise DataError(f"{source}: expected a metadata record 'rig', found none")
    if path is not None:
        size = _image_size(Recording.open(path, topics=topics), required_channels(stages))
    try:
        made = procedure.from_optics(rig, size, parameters)
    except ValueError as error:
        where = "" if str(error).startswith(str(source)) else f"{source}: "
        raise DataError(f"{where}{error}") from error
    made.report["rig"] = {"name": source.name, "digest": digest_of_file(source)}
    _finish(made, output, as_json, ())


def required_channels(stages: Mapping[str, Stage]) -> list[str]:
    """The channels that the stages cannot do without, in their order."""
    needs = (need for stage in stages.values() for need in stage.needs)
    found = (n.channel for n in needs if isinstance(n, RecordedImage) and n.required)
    return list(dict.fromkeys(found))


def _image_size(recording: Recording, required: Sequence[str]) -> tuple[int, int]:
    """Width and height of the first frame's first image."""
    recording.require(required)
    for frame in recording.frames(required):
        height, width = frame.images[required[0]].shape[:2]
        return width, height
    raise DataError(f"{recording.path}: expected a frame of {', '.join(required)}, found none")


def _finish(made: Any, output: Path, as_json: bool, defects: Iterable[str]) -> None:
    made.save(output)
    if as_json:
        print(to_json(made.report))
        return
    table("Calibration", ("quantity", "value"), report_rows(made.report))
    for line in defects:
        out.print(f"  {line}", style="yellow", markup=False)
    out.print(f"wrote {output}", soft_wrap=True, markup=False)

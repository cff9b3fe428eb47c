"""``workbench calibrate``: runs the procedure that the pipeline's calibration names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from workbench.console import err, out, table
from workbench.errors import DataError
from workbench.files import check_output
from workbench.plugins import find_stages
from workbench.procedures import parameters_of, procedure_of, report_rows
from workbench.recording import Recording
from workbench.report import to_json
from workbench.session import check_topics
from workbench.stage import RecordedImage

RESOURCE = "calibration"


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
    required = [
        need.channel
        for stage in stages.values()
        for need in stage.needs
        if isinstance(need, RecordedImage) and need.required
    ]
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
    made.save(output)
    if as_json:
        print(to_json(made.report))
        return
    table("Calibration", ("quantity", "value"), report_rows(made.report))
    for line in recording.defects.lines():
        out.print(f"  {line}", style="yellow", markup=False)
    out.print(f"wrote {output}", soft_wrap=True, markup=False)

"""``workbench calibrate``: runs the procedure that the pipeline's calibration names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import pydantic

from workbench.console import err, out, table
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.plugins import find_stages
from workbench.recording import Recording
from workbench.report import to_json
from workbench.session import check_topics
from workbench.settings import value_from_text
from workbench.stage import RecordedImage, Resource, Stage, StageError

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
    procedure = _procedure(stages)
    parameters = _parameters(procedure.Parameters, assignments)
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
    table("Calibration", ("quantity", "value"), _rows(made.report))
    for line in recording.defects.lines():
        out.print(f"  {line}", style="yellow", markup=False)
    out.print(f"wrote {output}", soft_wrap=True, markup=False)


def _procedure(stages: Mapping[str, Stage]) -> Any:
    """The module's ``Procedure`` named by the ``make`` of the stages' calibration."""
    for stage in stages.values():
        for need in stage.needs:
            if isinstance(need, Resource) and need.name == RESOURCE and need.make:
                module, _, name = need.make.partition(":")
                return getattr(import_module(module), name)
    raise StageError("no stage says how its calibration is made")


def _parameters(model: type[pydantic.BaseModel], assignments: Sequence[str]) -> pydantic.BaseModel:
    values = {}
    for assignment in assignments:
        address, equals, text = assignment.partition("=")
        name = address.removeprefix("calibrate.").strip()
        if not equals or name not in model.model_fields:
            raise UsageError(
                f"--set {assignment}: expected one of "
                + ", ".join(f"calibrate.{field}=…" for field in model.model_fields)
            )
        values[name] = value_from_text(text.strip())
    try:
        return model(**values)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(["calibrate", *(str(part) for part in first["loc"])])
        raise UsageError(f"{where}: {first['msg']}, got {first['input']!r}") from error


def _rows(report: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    rows = []
    for key, value in report.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            rows += _rows(value, f"{key} ")
        elif isinstance(value, list):
            rows.append((name, ", ".join(_number(item) for item in value)))
        else:
            rows.append((name, _number(value)))
    return rows


def _number(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)

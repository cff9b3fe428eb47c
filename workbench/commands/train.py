"""``workbench train``: runs the procedure that the pipeline's models name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from workbench.console import err, out, table
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.pipeline import ResultStore
from workbench.plugins import find_stages
from workbench.procedures import parameters_of, procedure_of, report_rows
from workbench.report import to_json
from workbench.session import Options, Session

RESOURCE = "models"


def run(
    paths: Sequence[Path],
    output: Path,
    calibration: Path | None,
    labels: Sequence[str],
    angles: str | None,
    assignments: Sequence[str],
    topics: Mapping[str, str],
    plugins: Sequence[Path],
    save: Path | None,
    screenshot: Path | None,
    as_json: bool,
) -> None:
    """Train on the recordings, write the file, print its report and show it where asked to."""
    stages = find_stages(plugins)
    procedure = procedure_of(stages, RESOURCE)
    own = [a for a in assignments if a.startswith("train.")]
    parameters = parameters_of(procedure.Parameters, "train", own)
    if labels and len(labels) != len(paths):
        raise UsageError(
            f"--label: expected one for each recording ({len(paths)}), found {len(labels)}"
        )
    degrees = _angles(angles)
    check_output("--output", output)
    for flag, path in (("--save", save), ("--screenshot", screenshot)):
        if path is not None:
            check_output(flag, path)
    resources = {} if calibration is None else {procedure.resource: calibration}
    store = ResultStore(capacity_bytes=1)
    sessions = [
        Session.open(
            Options(
                path,
                resources,
                assignments=[a for a in assignments if a not in own],
                topics=topics,
                until=procedure.until,
                plugins=plugins,
            ),
            store,
        )
        for path in paths
    ]
    bound = _bound(sessions, procedure.resource)
    with err.status("train") as status:
        try:
            made = procedure.run(
                [
                    (labels[k] if labels else None, degrees, session.runs())
                    for k, session in enumerate(sessions)
                ],
                parameters,
                bound,
                progress=lambda says: status.update(f"train: {says}"),
            )
        except ValueError as error:
            where = paths[0] if len(paths) == 1 else f"{len(paths)} recordings"
            raise DataError(f"{where}: {error}") from error
    made.report["recordings"] = [
        {"name": path.name, "digest": session.recording.digest}
        for path, session in zip(paths, sessions, strict=True)
    ]
    made.save(output)
    shown = [path for path in (save, screenshot) if path is not None]
    if shown:
        _show(made, save, screenshot)
    if as_json:
        print(to_json(made.report))
        return
    table("Models", ("quantity", "value"), report_rows(made.report))
    for path in (output, *shown):
        out.print(f"wrote {path}", soft_wrap=True, markup=False)


def _show(made: Any, save: Path | None, screenshot: Path | None) -> None:
    """Log what training made to a file, a picture or both."""
    from workbench.digest import digest_of
    from workbench.viewer import Destinations, opened

    destinations = Destinations(save=save, screenshot=screenshot)
    with opened(destinations, digest_of([to_json(made.report)])) as stream:
        stream.recording.send_blueprint(made.log(stream.recording))


def _bound(sessions: Sequence[Session], name: str) -> Any:
    """The one resource that all recordings were run with, or None.  Raises where they differ."""
    found = [session.pipeline.resources.get(name) for session in sessions]
    digests = {None if one is None else one[1] for one in found}
    if len(digests) > 1:
        raise UsageError(
            f"expected one {name} for all recordings, found {len(digests)}; give --{name}"
        )
    return None if found[0] is None else found[0][0]


def _angles(text: str | None) -> list[float] | None:
    """``A:STEP`` is not guessed: a list of degrees, one for each frame, separated by commas."""
    if text is None:
        return None
    try:
        return [float(part) for part in text.split(",") if part.strip()]
    except ValueError as error:
        raise UsageError(f"--angles {text}: expected degrees separated by commas") from error

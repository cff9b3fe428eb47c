"""``workbench why``: a pixel's story through the stages, and what would turn its verdict."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import typer
from rich.markup import escape

from workbench import interrupts
from workbench.commands.replay import window_size
from workbench.console import err, out, progress, table
from workbench.display import has_display
from workbench.errors import EXIT_FAILED, DataError, UsageError
from workbench.files import check_output
from workbench.pipeline import Run
from workbench.report import RunReport, to_json
from workbench.session import Options, Session, check_stage
from workbench.why import (
    DEFAULT_BUDGET,
    Search,
    Story,
    as_dict,
    as_markdown,
    outcome,
    smallest_change,
    story,
)


def run(
    options: Options,
    frame: int,
    pixel: str,
    stage: str | None,
    search: bool,
    as_json: bool,
    save: Path | None,
    screenshot: Path | None,
    window: str,
) -> None:
    """Tell the story; exits with 1 if a stage failed on the frame."""
    x, y = parse_pixel(pixel)
    if frame < 0:
        raise UsageError(f"--frame {frame}: expected 0 or more")
    size = window_size(window)
    for flag, path in (("--save", save), ("--screenshot", screenshot)):
        if path is not None:
            check_output(flag, path)
    session = Session.open(replace(options, frames=(frame, frame + 1)))
    check_stage(stage, {one.name: one for one in session.pipeline.stages}, "--stage")
    result = _frame(session, frame)
    try:
        told = story(session.pipeline, result, x, y)
    except UsageError as error:
        raise UsageError(f"--pixel {pixel}: {str(error).partition(': ')[2]}") from error
    if stage is not None and stage not in told.verdicts:
        trouble = next(one.trouble for one in told.stages if one.stage == stage)
        reason = f": {trouble}" if trouble else ""
        raise DataError(f"--stage {stage}: no verdict on pixel {x},{y} of frame {frame}{reason}")
    if not as_json:
        _print_story(session, told)
    found = _search(session, result, told, stage) if search else None
    if as_json:
        document = as_dict(told, found) | {"provenance": session.provenance()}
        print(to_json(document))
    ending = outcome(found) if search else ""
    if ending and not as_json:
        out.print(_terminal(ending), soft_wrap=True)
    _show(session, result, told, ending, save, screenshot, size, as_json)
    raise typer.Exit(EXIT_FAILED if any(one.trouble for one in told.stages) else 0)


def parse_pixel(text: str) -> tuple[int, int]:
    """``X,Y`` as (X, Y).  Raises :class:`UsageError`."""
    x, comma, y = text.partition(",")
    try:
        if not comma:
            raise ValueError
        return int(x), int(y)
    except ValueError:
        raise UsageError(f"--pixel {text}: expected X,Y, two whole numbers, as 120,64") from None


def _frame(session: Session, index: int) -> Run:
    """The one frame that was asked for, run."""
    for result in session.runs():
        return result
    count = session.recording.count(session.pipeline.channels[0])
    there = f"it has frames 0 to {count - 1}" if count else "it has none"
    says = f"no frame {index} that can be read; {there}"
    raise DataError(f"{session.recording.path}: {says}")


def _search(session: Session, result: Run, told: Story, stage: str | None) -> Search | None:
    with progress("smallest change, runs", DEFAULT_BUDGET) as advance:

        def before_each() -> None:
            interrupts.check()
            advance()

        return smallest_change(
            session.pipeline, result, told.x, told.y, stage, before_each=before_each
        )


def _print_story(session: Session, told: Story) -> None:
    rows = []
    for one in told.stages:
        name = one.stage
        if not one.findings:
            says = one.trouble or "says nothing of single pixels"
            rows.append((name, f"[red]{escape(says)}[/red]" if one.trouble else says, "", ""))
        for finding, threshold in zip(one.findings, one.thresholds, strict=True):
            against = "" if threshold is None else escape(str(threshold))
            verdict = f"[bold]{escape(finding.verdict)}[/bold]" if finding.verdict else ""
            rows.append((name, escape(finding.says), against, verdict))
            name = ""
    table(
        f"{session.recording.path.name}, frame {told.index}, pixel {told.x},{told.y}",
        ("stage", "says", "held against", "verdict"),
        rows,
    )


def _terminal(markdown: str) -> str:
    """Bold and code of markdown as Rich has them."""
    bold = re.sub(r"\*\*(.+?)\*\*", r"[bold]\1[/bold]", escape(markdown))
    return re.sub(r"`(.+?)`", r"[cyan]\1[/cyan]", bold)


def _show(
    session: Session,
    result: Run,
    told: Story,
    ending: str,
    save: Path | None,
    screenshot: Path | None,
    window: tuple[int, int],
    quiet: bool,
) -> None:
    """The frame's pictures with the pixel marked, and the story beside them."""

    native = screenshot is None and not quiet and has_display()
    if not (native or save or screenshot):
        return
    from workbench.bridge import Bridge
    from workbench.digest import digest_of
    from workbench.viewer import Destinations, opened

    identity = digest_of([str(session.provenance()), told.index, told.x, told.y])
    report = RunReport(session)
    with opened(Destinations(native, False, save, screenshot, window), identity) as stream:
        if stream.trouble is not None:
            err.print(f"no viewer: {stream.trouble}", soft_wrap=True, markup=False)
        bridge = Bridge(session, stream.recording, asks=True)
        bridge.log(result, report, report.add(result))
        bridge.mark(told.x, told.y, as_markdown(told), ending)
        bridge.close(report)
    for path in (save, screenshot):
        if path is not None and path.exists() and not quiet:
            out.print(f"wrote {path}", soft_wrap=True, markup=False)

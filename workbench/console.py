"""What the commands say on a terminal: tables, progress, one-line errors."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NoReturn, TypeVar

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from rich.text import Text

from workbench import interrupts
from workbench.errors import EXIT_FAILED, DataError
from workbench.report import RunReport
from workbench.stage import Score

T = TypeVar("T")

_PIPED_WIDTH = 200
"""Columns where the output is no terminal: enough that no name is broken for a search."""

out = Console(highlight=False, width=None if sys.stdout.isatty() else _PIPED_WIDTH)
err = Console(stderr=True, highlight=False)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.1f} frames/s" if speed else "… frames/s")


@contextmanager
def progress(description: str, total: int | None) -> Iterator[Any]:
    """A progress bar on stderr, only on a terminal; yields ``advance()``."""
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _Rate(),
        TimeRemainingColumn(),
        console=err,
        disable=not err.is_terminal,
        transient=True,
    )
    with bar:
        task = bar.add_task(description, total=total)
        yield lambda: bar.advance(task)


def tracked(items: Iterable[T], description: str, total: int | None) -> Iterator[T]:
    """``items`` with a progress bar."""
    with progress(description, total) as advance:
        for item in items:
            yield item
            advance()


def table(title: str, columns: Iterable[str], rows: Iterable[Iterable[Any]]) -> None:
    """Print a table; numbers are right-aligned by their header ending in a unit or ``#``."""
    grid = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
    for column in columns:
        numeric = column.endswith((" ms", "#", "value", "covered"))
        grid.add_column(column, justify="right" if numeric else "left", overflow="fold")
    for row in rows:
        grid.add_row(*(str(cell) for cell in row))
    out.print(grid)


def scores_beside(scores: Mapping[str, Mapping[str, Sequence[Score]]]) -> None:
    """Scores of several presets side by side: one column a preset, with what it covers."""
    rows = _by_figure(scores)
    if rows:
        table(
            "Against ground truth",
            ("stage", "figure", *_value_columns(scores), "unit", "note"),
            (
                (stage, figure, *_values(found, scores), unit, _shared_note(found))
                for (stage, figure, unit), found in rows.items()
            ),
        )


def published_beside(reports: Mapping[str, RunReport]) -> None:
    """What the publication reports, beside what the same stages reached here, by preset."""
    scores = {preset: report.scores() for preset, report in reports.items()}
    rows = [
        (stage, figure, *_values(found, scores), unit, published, _shared_note(found))
        for (stage, figure, unit), found in _by_figure(scores).items()
        if (published := next(iter(found.values())).published)
    ]
    for stage in next(iter(reports.values())).session.pipeline.stages:
        if stage.published_time and any(stage.name in r.times_ms for r in reports.values()):
            times = (
                f"{report.median_ms(stage.name):.2f}" if stage.name in report.times_ms else "none"
                for report in reports.values()
            )
            rows.append((stage.name, "time of a frame", *times, "ms", stage.published_time, ""))
    if rows:
        table(
            "Beside the published figures",
            ("stage", "figure", *_value_columns(scores), "unit", "published", "note"),
            rows,
        )


def _by_figure(
    scores: Mapping[str, Mapping[str, Sequence[Score]]],
) -> dict[tuple[str, str, str], dict[str, Score]]:
    """(stage, figure, unit) to each preset's score."""
    rows: dict[tuple[str, str, str], dict[str, Score]] = {}
    for preset, stages in scores.items():
        for stage, own in stages.items():
            for score in own:
                rows.setdefault((stage, score.name, score.unit), {})[preset] = score
    return rows


def _value_columns(presets: Iterable[str]) -> Iterator[str]:
    return (f"{preset or 'this'} value" for preset in presets)


def _values(found: Mapping[str, Score], presets: Iterable[str]) -> Iterator[str]:
    return (_with_coverage(found.get(preset)) for preset in presets)


def _shared_note(found: Mapping[str, Score]) -> str:
    notes = {score.note for score in found.values()}
    return notes.pop() if len(notes) == 1 else ""


def _with_coverage(score: Score | None) -> str:
    if score is None or not math.isfinite(score.value):
        return "none"
    if score.coverage is None:
        return f"{score.value:.3f}"
    return f"{score.value:.3f} at {100 * score.coverage:.1f} %"


def closing_tables(report: RunReport, scores: bool = True) -> None:
    """The end of a run: frames, defects, times, accuracy, failures, warnings."""
    defects = report.session.recording.defects
    counts = ", ".join(f"{count} {kind}" for kind, count in sorted(defects.counts.items()))
    state = " (interrupted)" if report.interrupted else ""
    out.print(f"[bold]{report.frames} frames[/bold]{state}; defects: {counts or 'none'}")
    for line in defects.lines():
        out.print(f"  {line}", style="yellow", markup=False)
    if report.times_ms:
        table(
            "Stages",
            ("stage", "median ms", "worst ms"),
            (
                (name, f"{report.median_ms(name):.2f}", f"{report.worst_ms[name]:.2f}")
                for name in report.times_ms
            ),
        )
    if scores:
        scores_beside({report.session.pipeline.settings.preset: report.scores()})
    troubles(report)


def troubles(report: RunReport) -> None:
    """What was warned of and what failed, a line each."""
    for says, count in report.warnings.items():
        out.print(f"warning, {count} frames: {says}", style="yellow", markup=False)
    for (stage, says), count in report.failures.items():
        out.print(f"FAILED, {count} frames: {stage}: {says}", style="bold red", markup=False)


@contextmanager
def interruptible(report: RunReport) -> Iterator[None]:
    """Let Ctrl-C or SIGTERM end a run early, so that what follows keeps and tells what was done."""
    try:
        yield
    except KeyboardInterrupt:
        report.interrupted = interrupts.exit_code()


def end(report: RunReport) -> NoReturn:
    """Leave the command with the exit code that the run deserves."""
    if report.frames == 0 and not report.interrupted:
        raise DataError(f"{report.session.recording.path}: no frame in it, or in --frames")
    raise typer.Exit(report.interrupted or (EXIT_FAILED if report.failed else 0))

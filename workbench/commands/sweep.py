"""``workbench sweep``: a grid of parameters over recordings, to tables and a gallery."""

from __future__ import annotations

import math
import shlex
import threading
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import typer

from workbench.commands.replay import window_size
from workbench.console import err, out, progress_to, table
from workbench.display import has_display
from workbench.errors import EXIT_FAILED, DataError
from workbench.extras import required
from workbench.files import check_output
from workbench.report import finite, to_json
from workbench.sweep import run as sweeping
from workbench.sweep.analysis import Choice, main_effects
from workbench.sweep.cache import Cache
from workbench.sweep.run import BEST, CELLS_TABLE, FRAMES_TABLE, Request, Sweep
from workbench.sweep.table import Metric

_SHOWN_CELLS = 8
_SHOWN_METRICS = 40


def run(
    request: Request, view: bool | None, screenshot: Path | None, window: str, as_json: bool
) -> None:
    """Sweep, say what it says and show it; exits with 1 if every cell failed."""
    size = window_size(window)
    if screenshot is not None:
        check_output("--screenshot", screenshot)
    if view or screenshot is not None:
        _require_catalog()
    elif view is None and has_display() and not as_json:
        try:
            _require_catalog()
        except DataError as error:
            _warn(str(error))
            view = False
    cards = 0

    def draw(sweep: Sweep, cache: Cache) -> None:
        # Rerun is imported only now, when the work is done: workers never need it.
        from workbench.sweep import gallery

        nonlocal cards
        cards = gallery.write(sweep, cache, partial(replay_line, sweep))

    try:
        with progress_to("sweep") as advance:
            sweep = sweeping.run(request, advance, draw, _warn)
    except KeyboardInterrupt:
        err.print("interrupted; what was done is kept, and the same command goes on from there")
        raise
    if as_json:
        print(to_json(as_dict(sweep)))
    else:
        _tell(sweep, cards)
    _show(sweep, view, screenshot, size, as_json)
    if all(row.failed_frames for row in sweep.rows):
        raise typer.Exit(EXIT_FAILED)


def _require_catalog() -> None:
    """Raise :class:`DataError` where what Rerun's catalog stands on is not installed."""
    for module in ("datafusion", "pandas"):
        required(module, "the gallery of a sweep", "gallery")


def _warn(says: str) -> None:
    err.print(f"warning: {says}", style="yellow", soft_wrap=True, markup=False)


def _show(
    sweep: Sweep,
    view: bool | None,
    screenshot: Path | None,
    size: tuple[int, int],
    as_json: bool,
) -> None:
    """Open the gallery where there is a display or one is asked for, and take its picture."""
    from workbench.sweep.gallery import CELL_TIMELINE, OVERVIEW, served
    from workbench.viewer import how_to_open, show, take_screenshot

    folder = sweep.request.folder
    overview = folder / OVERVIEW
    wanted = view or (view is None and has_display() and screenshot is None and not as_json)
    if screenshot is not None:
        grid = screenshot.with_name(f"{screenshot.stem}-grid{screenshot.suffix}")
        with served(folder) as address:
            take_screenshot(address, screenshot, size)
        best = sweep.choices[0].row.cell.index if sweep.choices else sweep.rows[0].cell.index
        take_screenshot(overview, grid, size, (CELL_TIMELINE, best))
        if not as_json:
            out.print(f"wrote {screenshot} and {grid}", soft_wrap=True, markup=False)
    if wanted:
        with served(folder) as address, suppress(KeyboardInterrupt):
            if has_display():
                child = show([str(overview), address])
                says = "the gallery is served until the viewer is closed, or Ctrl-C"
                err.print(says, style="dim")
                child.wait()
            else:
                says = f"no display: open the gallery with: {how_to_open(address)}"
                err.print(says, soft_wrap=True, markup=False)
                err.print("serving until Ctrl-C", style="dim")
                threading.Event().wait()
    elif not as_json:
        says = f"open the heat maps: {how_to_open(overview)}"
        out.print(says, soft_wrap=True, markup=False)
        out.print("open the gallery: the same command with --view")


def replay_line(sweep: Sweep, configuration: Path, frames: str = "", recording: int = 0) -> str:
    """The command that shows a cell's full stack of pictures, to be copied from the terminal."""
    request = sweep.request
    options = request.options
    parts = ["workbench", "replay", str(request.recordings[recording])]
    parts += ["--config", str(configuration)]
    for name, path in options.resources.items():
        parts += [f"--{name}", str(path)]
    for channel, topic in options.topics.items():
        parts += ["--topic", f"{channel}={topic}"]
    for plugin in options.plugins:
        parts += ["--plugin", str(plugin)]
    if options.until is not None:
        parts += ["--until", options.until]
    start, stop = options.frames
    if not frames and (start, stop) != (0, None):
        frames = f"{start}:{'' if stop is None else stop}"
    if frames:
        parts += ["--frames", frames]
    return shlex.join(parts)


def as_dict(sweep: Sweep) -> dict[str, Any]:
    """All that the command says, as JSON values."""
    folder = sweep.request.folder
    return {
        "to": str(folder),
        "tables": {"cells": CELLS_TABLE, "frames": FRAMES_TABLE},
        "cells": len(sweep.rows),
        "of": sweep.grid.size,
        "axes": {axis.address: list(axis.values) for axis in sweep.grid.axes},
        "failed_cells": [row.cell.index for row in sweep.rows if row.failed_frames],
        "errors": sorted({row.error for row in sweep.rows if row.error}),
        "metrics": {
            m.address: finite({"title": m.title, "unit": m.unit, "better": m.better})
            for m in sweep.metrics
        },
        "best": [_choice_dict(sweep, choice) for choice in sweep.choices],
        "spent": {
            "computed": sweep.spent.computed,
            "kept": sweep.spent.kept,
            "seconds": round(sweep.spent.total, 3),
            "worker_seconds": round(sweep.spent.workers, 3),
            "stage_seconds": round(sweep.spent.stages, 3),
            "scoring_seconds": round(sweep.spent.scoring, 3),
        },
        "provenance": sweep.provenance,
    }


def _choice_dict(sweep: Sweep, choice: Choice) -> dict[str, Any]:
    flat = choice.flat
    return {
        "metric": choice.metric.address,
        "better": choice.metric.better,
        "cell": choice.row.cell.index,
        "values": dict(choice.row.cell.values),
        "value": choice.row.figures[choice.metric.address],
        "equals": choice.equals,
        "configuration": str(sweep.configurations[choice.row.cell.index]),
        "replay": replay_line(sweep, sweep.configurations[choice.row.cell.index]),
        "flat": {
            "cells": list(flat.cells),
            "within": flat.within,
            "spans": {axis: list(span) for axis, span in flat.spans.items()},
        },
        "main_effects": main_effects(sweep.grid, sweep.rows, choice.metric),
    }


def _tell(sweep: Sweep, cards: int) -> None:
    request, spent = sweep.request, sweep.spent
    sampled = "" if sweep.grid.sampled is None else f", a sample of {sweep.grid.size:,}"
    frames = sum(len(own) for own in sweep.frames)
    out.print(
        f"[bold]{len(sweep.rows):,} cells[/bold]{sampled}, {frames} frames; "
        f"{spent.computed:,} cells of a frame computed, {spent.kept:,} kept from before"
    )
    if sweep.choices:
        for choice in sweep.choices:
            _tell_choice(sweep, choice)
    else:
        _tell_metrics(sweep)
    failed = [row for row in sweep.rows if row.failed_frames]
    for says in sorted({row.error for row in failed}):
        count = sum(row.error == says for row in failed)
        out.print(f"FAILED, {count} cells: {says}", style="bold red", markup=False)
    names = [CELLS_TABLE, FRAMES_TABLE, *([BEST] if sweep.choices else []), "sweep.rrd"]
    best = "" if cards == len(sweep.rows) else "the best "
    says = f"wrote {', '.join(names)} and a gallery of {best}{cards} cells to {request.folder}"
    out.print(says, soft_wrap=True, markup=False)
    if sweep.choices:
        line = replay_line(sweep, request.folder / BEST)
        out.print(f"see the best cell: {line}", soft_wrap=True, markup=False)


def _tell_choice(sweep: Sweep, choice: Choice) -> None:
    metric = choice.metric
    ranked = sorted(
        (row for row in sweep.rows if math.isfinite(row.figures.get(metric.address, math.nan))),
        key=lambda row: (
            row is not choice.row,
            bool(row.failed_frames),
            -metric.worth(row.figures[metric.address]),
            row.cell.index,
        ),
    )
    shown = ranked[:_SHOWN_CELLS]
    if len(ranked) > _SHOWN_CELLS:
        shown = [*ranked[: _SHOWN_CELLS - 1], ranked[-1]]
    axes = [axis.address for axis in sweep.grid.axes]
    table(
        f"{metric.address} ({_way(metric)}), the best cells and the worst",
        ("cell #", f"{metric.address} value", *axes),
        (
            (
                row.cell.index,
                _number(row.figures[metric.address], metric),
                *(row.cell.values[address] for address in axes),
            )
            for row in shown
        ),
    )
    flat = choice.flat
    if choice.equals:
        out.print(f"{choice.equals} other cells have the same value; this one has the best around")
    spans = "; ".join(
        f"{address} {first}" if first == last else f"{address} {first} .. {last}"
        for address, (first, last) in flat.spans.items()
    )
    out.print(
        f"flat region: {len(flat.cells)} of {len(sweep.rows)} cells around the best are within "
        f"{_number(flat.within, metric)}: {spans}",
        soft_wrap=True,
        markup=False,
    )
    effects = main_effects(sweep.grid, sweep.rows, metric)
    if effects:
        shares = ", ".join(
            f"{name} {100 * share:.0f} %"
            for name, share in sorted(effects.items(), key=lambda item: -item[1])
        )
        rest = max(0.0, 1 - math.fsum(effects.values()))
        out.print(
            f"what matters: {shares}; their interplay {100 * rest:.0f} %",
            soft_wrap=True,
            markup=False,
        )
    else:
        out.print("no axis matters: every cell has the same value")


def _tell_metrics(sweep: Sweep) -> None:
    """Every figure with its spread over the cells, for who has not chosen one."""
    rows = []
    for metric in sweep.metrics:
        values = [row.figures.get(metric.address, math.nan) for row in sweep.rows]
        values = [value for value in values if math.isfinite(value)]
        if values and min(values) < max(values):
            effects = main_effects(sweep.grid, sweep.rows, metric)
            most = max(effects, key=lambda name: effects[name], default="")
            says = f"{most} {100 * effects[most]:.0f} %" if most else ""
            low, high = (_number(value, metric) for value in (min(values), max(values)))
            rows.append((metric.address, low, high, _way(metric), says))
    table(
        "Figures that differ among the cells; choose by one with --metric",
        ("figure", "least value", "greatest value", "better", "what matters most"),
        rows[:_SHOWN_METRICS],
    )


def _way(metric: Metric) -> str:
    return (
        {"higher": "higher is better", "lower": "lower is better", "zero": "nearer 0 is better"}[
            metric.better
        ]
        if metric.better
        else "neither"
    )


def _number(value: float, metric: Metric) -> str:
    return f"{value:.4g} {metric.unit}".strip()

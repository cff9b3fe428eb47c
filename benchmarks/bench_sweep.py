"""What a sweep costs beside the runs that it stands for, in one run of this program.

    python benchmarks/bench_sweep.py

200 cells of the last two stages against 200 complete runs in this process; the same sweep again;
two workers against one; and the share of the workers' time outside the stages' code.  Times on
the clock, and processor time, which does not depend on what else the machine does.  A sweep's
figures must be those of a complete run, and the same whoever computed or kept them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from aims import at_least, at_most, end, must
from rich.console import Console
from rich.table import Table

from workbench.commands.sweep import replay_line
from workbench.pipeline import ResultStore
from workbench.report import RunReport
from workbench.session import Options, Session
from workbench.sweep import gallery
from workbench.sweep.cache import Cache
from workbench.sweep.run import Request, Sweep, run
from workbench.sweep.table import slug
from workbench.sweep.worker import one_thread

SCENE = Path(__file__).parents[1] / "recordings" / "scene.mcap"
AXES = ("recognition.phi_scale=0.5:1.4:0.1", "pose_frames.zeta_scale=0.5:2.4:0.1")
METRIC = "pose_frames.rotation_mean_error"


@dataclass(frozen=True)
class Took:
    """Seconds on the clock and of the processor, with those of the children."""

    clock: float
    processor: float


def measured(do: Callable[[], Any]) -> tuple[Any, Took]:
    """What ``do`` returns and what it took; the processes that it started have ended."""
    clock, before = time.perf_counter(), os.times()
    found = do()
    after = os.times()
    processor = sum(after[:4]) - sum(before[:4])
    return found, Took(time.perf_counter() - clock, processor)


def complete_runs(frames: tuple[int, int], cells: int) -> Took:
    """The time of ``cells`` complete runs, from as many of them as take a few seconds."""
    session = Session.open(Options(SCENE, frames=frames), ResultStore(capacity_bytes=0))
    scorers = [stage.scorer() for stage in session.pipeline.stages]
    # The first run compiles; it is what every process pays once, and no sweep's merit.
    list(session.runs())
    rounds = 0
    clock, processor = time.perf_counter(), time.process_time()
    while rounds < 2 or time.perf_counter() - clock < 5:
        for result in session.runs():
            for scorer in scorers:
                if scorer is not None:
                    scorer.add(result.frame.truth, result.artifacts)
        rounds += 1
    scale = cells / rounds
    return Took(scale * (time.perf_counter() - clock), scale * (time.process_time() - processor))


def figures(sweep: Sweep) -> dict[int, float | None]:
    """The chosen figure of every cell."""
    return {row.cell.index: row.figures.get(METRIC) for row in sweep.rows}


def complete_figure(frames: tuple[int, int], values: Mapping[str, Any]) -> float | None:
    """The same figure of a complete run under these parameters."""
    assignments = [f"{address}={value}" for address, value in values.items()]
    session = Session.open(Options(SCENE, assignments=assignments, frames=frames))
    report = RunReport(session)
    for result in session.runs():
        report.add(result)
    stage = METRIC.partition(".")[0]
    found = (s.value for s in report.scores()[stage] if f"{stage}.{slug(s.name)}" == METRIC)
    return next(found, None)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--frames", type=int, default=12, help="frames of the recording")
    arguments = parser.parse_args()
    frames = (0, arguments.frames)
    folder = Path(tempfile.mkdtemp(prefix="bench-sweep-"))
    try:
        report(frames, folder)
    finally:
        shutil.rmtree(folder)
    end()


def report(frames: tuple[int, int], folder: Path) -> None:
    """Measure and print."""

    def swept(to: str, workers: int) -> Sweep:
        options = Options(SCENE, frames=frames)
        request = Request(options, [SCENE], folder / to, AXES, metrics=[METRIC], workers=workers)
        return run(request, finish=drawn)

    def drawn(sweep: Sweep, cache: Cache) -> None:
        gallery.write(sweep, cache, partial(replay_line, sweep))

    # What a process pays once for imports and compiled code is no sweep's merit or fault.
    cells = len(swept("warm", 1).rows)
    with one_thread():
        whole = complete_runs(frames, cells)
    first, one = measured(lambda: swept("one", 1))
    again, second = measured(lambda: swept("one", 1))
    swept("warm2", 2)
    fresh, two = measured(lambda: swept("two", 2))
    spent = first.spent
    scoring = spent.scoring / spent.workers
    outside = 1 - spent.stages / spent.workers - scoring
    for other, what in ((again, "the same again"), (fresh, "two workers")):
        must(figures(other) == figures(first), f"{what}: the figures are those of the first sweep")
    cell = first.rows[len(first.rows) // 3].cell
    must(
        figures(first)[cell.index] == complete_figure(frames, cell.values),
        f"cell {cell.index}: its figure is that of a complete run with its parameters",
    )
    cheaper, share = whole.clock / one.clock, 100 * second.clock / one.clock
    faster = first.spent.computing / fresh.spent.computing
    table = Table("what", "figure", "aim", "clock s", "processor s", title_justify="left")
    table.add_row(
        f"{cells} complete runs, {frames[1]} frames",
        "", "", f"{whole.clock:.1f}", f"{whole.processor:.1f}",
    )  # fmt: skip
    table.add_row(
        f"{cells} cells of the last two stages, one worker",
        f"{cheaper:.1f} x cheaper ({whole.processor / one.processor:.1f})",
        at_least(20, cheaper, " x"), f"{one.clock:.1f}", f"{one.processor:.1f}",
    )  # fmt: skip
    table.add_row(
        f"the same again ({again.spent.kept} kept)",
        f"{share:.1f} % of the first",
        at_most(5, share, " %"), f"{second.clock:.2f}", f"{second.processor:.2f}",
    )  # fmt: skip
    table.add_row(
        "two workers",
        f"{faster:.2f} x one",
        at_least(1.7, faster, " x"), f"{two.clock:.1f}", "in children",
    )  # fmt: skip
    table.add_row(
        f"outside the stages' code (computing, and {100 * scoring:.1f} % scoring)",
        f"{100 * outside:.1f} %", at_most(15, 100 * outside, " %"), "", "",
    )  # fmt: skip
    console = Console(width=120)
    console.print(table)
    console.print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")


if __name__ == "__main__":
    main()

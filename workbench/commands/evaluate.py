"""``workbench evaluate``: the stages against the recording's ground truth."""

from __future__ import annotations

from dataclasses import replace

from workbench.console import (
    closing_tables,
    end,
    interruptible,
    published_beside,
    scores_beside,
    tracked,
)
from workbench.errors import DataError
from workbench.pipeline import ResultStore
from workbench.plugins import find_stages
from workbench.report import RunReport, to_json
from workbench.session import Options, Session
from workbench.settings import preset_names


def run(options: Options, as_json: bool) -> None:
    """Evaluate every preset beside the default, or the one that is asked for.

    Stages whose parameters the presets share run once for all of them.  Exits with 1 if there is
    nothing to evaluate or a stage failed.
    """
    store = ResultStore()
    sessions = {
        name: Session.open(replace(options, preset=name), store) for name in _presets(options)
    }
    reports = {name: RunReport(session) for name, session in sessions.items()}
    first, *others = sessions
    report = reports[first]
    with interruptible(report):
        for result in tracked(sessions[first].runs(), "evaluate", sessions[first].count()):
            report.add(result)
            for name in others:
                reports[name].add(sessions[name].pipeline.run(result.frame))
    for name in others:
        report.take_failures(reports[name], f"preset {name}")
    if as_json:
        scores = {name: other.as_dict()["scores"] for name, other in reports.items()}
        print(to_json(report.as_dict() | {"presets": scores}))
    else:
        scores_beside({name: other.scores() for name, other in reports.items()})
        published_beside(reports)
        closing_tables(report, scores=False)
    if report.frames and not report.scores():
        lacking = (
            [] if "calibration" in report.session.pipeline.resources else ["no calibration given"]
        )
        raise DataError(
            f"{options.recording}: nothing could be scored: "
            + "; ".join([*lacking, "expected /ground_truth topics that the stages can be held to"])
        )
    end(report)


def _presets(options: Options) -> list[str]:
    """The preset that was asked for (also by a configuration file), or all of them."""
    if options.preset is not None or options.config is not None:
        return [options.preset] if options.preset is not None else [""]
    return preset_names(find_stages(options.plugins).values())

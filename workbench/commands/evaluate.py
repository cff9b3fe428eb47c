"""``workbench evaluate``: the stages against the recording's ground truth."""

from __future__ import annotations

from workbench.console import closing_tables, end, interruptible, tracked
from workbench.errors import DataError
from workbench.report import RunReport, to_json
from workbench.session import Options, Session


def run(options: Options, as_json: bool) -> None:
    """Evaluate; exits with 1 if there is nothing to evaluate or a stage failed."""
    session = Session.open(options)
    report = RunReport(session)
    with interruptible(report):
        for result in tracked(session.runs(), "evaluate", session.count()):
            report.add(result)
    if as_json:
        print(to_json(report.as_dict()))
    else:
        closing_tables(report)
    if report.frames and not report.scores():
        lacking = [] if "calibration" in session.pipeline.resources else ["no calibration given"]
        raise DataError(
            f"{options.recording}: nothing could be scored: "
            + "; ".join([*lacking, "expected /ground_truth topics that the stages can be held to"])
        )
    end(report)

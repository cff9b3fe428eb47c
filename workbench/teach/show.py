"""Lessons in Rerun: pictures, the text beside them, and the layout of both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import rerun as rr
import rerun.blueprint as rrb

from workbench.errors import DataError, one_line
from workbench.pipeline import Pipeline, Run
from workbench.stage import Logged
from workbench.teach.course import OpenLesson, sweep
from workbench.teach.lesson import Seen, number

TURN_TIMELINE = "turn"
"""The time of a saved lesson: 0 as it opens, then each claim's knob from before to after."""

_TEXT_SHARE, _PICTURE_SHARE = 1.0, 2.6


def log_pictures(recording: rr.RecordingStream, opened: OpenLesson, run: Run) -> None:
    """The pictures of the lesson's own stages.  Raises :class:`DataError` where they fail."""
    for stage in opened.pipeline.stages:
        if stage.name in opened.lesson.shows:
            try:
                stage.log(recording, _logged(opened.pipeline, run, stage.name))
            except Exception as error:
                raise DataError(
                    f"lesson {opened.lesson.number}, pictures of {stage.name}: {one_line(error)}"
                ) from error


def picture_views(opened: OpenLesson, run: Run) -> Any:
    """The lesson's own views, side by side."""
    views: list[Any] = []
    for name in opened.lesson.shows:
        stage = next(stage for stage in opened.pipeline.stages if stage.name == name)
        views += stage.views(_logged(opened.pipeline, run, name))
    return views[0] if len(views) == 1 else rrb.Horizontal(*views)


def _logged(pipeline: Pipeline, run: Run, stage: str) -> Logged:
    return Logged(run.artifacts, pipeline.settings.parameters[stage], run.frame.truth)


def log_saved(
    recording: rr.RecordingStream, opened: OpenLesson, sweeps: bool = True
) -> Iterator[Seen]:
    """A lesson as a recording that needs no bench: text, pictures, and every claim's sweep.

    Yields each claim, measured, when its sweep is logged; with ``sweeps`` off only the lesson as
    it opens is logged, and nothing is measured.
    """
    lesson = opened.lesson
    path = f"lessons/{lesson.slug}"
    recording.log(f"{path}/text", _markdown(lesson.page()), static=True)
    turn = 0

    def log_turn(values: Mapping[str, Any], says: Sequence[str]) -> None:
        nonlocal turn
        recording.set_time(TURN_TIMELINE, sequence=turn)
        pipeline = opened.turned(values)
        here = OpenLesson(lesson, pipeline, opened.frame)
        log_pictures(recording, here, here.run())
        recording.log(f"{path}/now", _markdown(_now_page(here, says)))
        turn += 1

    turned = ", ".join(opened.settings.changed)
    log_turn({}, [f"turned: {turned}" if turned else "as the lesson opens"])
    if not sweeps:
        return
    for place, claim in enumerate(lesson.claims, 1):
        seen = opened.check(claim)
        for values in sweep(claim, opened):
            here = claim.measure(opened.run(values))
            unit = f" {claim.unit}" if claim.unit else ""
            log_turn(values, [f"{place}. {claim.says}", f"{claim.quantity}: {number(here)}{unit}"])
        yield seen


def lesson_view(opened: OpenLesson, run: Run) -> Any:
    """A lesson as one part of a layout: the text at the left, the pictures at the right."""
    lesson = opened.lesson
    path = f"lessons/{lesson.slug}"
    return rrb.Horizontal(
        rrb.Vertical(
            rrb.TextDocumentView(origin=f"{path}/text", name=f"lesson {lesson.number}"),
            rrb.TextDocumentView(origin=f"{path}/now", name="the knobs now"),
            row_shares=[4, 1.1],
        ),
        picture_views(opened, run),
        column_shares=[_TEXT_SHARE, _PICTURE_SHARE],
        name=f"{lesson.number} {lesson.name.replace('-', ' ')}",
    )


def saved_blueprint(views: Sequence[Any]) -> rrb.Blueprint:
    """The layout of a saved recording: one lesson, or a tab for each."""
    whole = views[0] if len(views) == 1 else rrb.Tabs(*views, active_tab=0)
    return rrb.Blueprint(
        whole,
        rrb.TimePanel(state="collapsed", timeline=TURN_TIMELINE, play_state="paused", fps=1.0),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _now_page(opened: OpenLesson, says: Sequence[str]) -> str:
    """The knobs' values, and what is being tried."""
    lines = [*(f"{line}\n" for line in says), "| knob | value | unit |", "|---|---|---|"]
    values = opened.values()
    for address, knob in opened.knobs.items():
        value = values[address]
        shown = f"{value:.4g}" if isinstance(value, float) else value
        lines.append(f"| {address} | {shown} | {knob.unit} |")
    return "\n".join(lines)


def _markdown(text: str) -> rr.TextDocument:
    return rr.TextDocument(text, media_type="text/markdown")

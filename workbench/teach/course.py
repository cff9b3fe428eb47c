"""Finding lessons, opening one, running it with its knobs turned, checking its claims."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from workbench.errors import DataError, UsageError, one_line
from workbench.pipeline import Pipeline, ResultStore, Run
from workbench.recording import Frame, Recording
from workbench.session import resources_beside
from workbench.settings import Settings, adjusted, resolve
from workbench.stage import Knob, Stage, StageError
from workbench.teach.lesson import GROUP, Claim, Lesson, Seen

NO_FRAME = Frame(0, 0, {}, {}, {}, None, "lesson")
"""The frame of a lesson that makes its own images: nothing was recorded."""

OPENING = "lesson"
"""The preset that a lesson opens with: to this its knobs go back."""

SWEEP_STEPS = 5


def find_lessons() -> list[Lesson]:
    """Every installed lesson, by number.  Raises :class:`StageError` for one that is wrong."""
    lessons: dict[int, Lesson] = {}
    for entry in sorted(importlib.metadata.entry_points(group=GROUP), key=lambda e: e.name):
        origin = f"lesson {entry.name} ({entry.value})"
        try:
            found = entry.load()
        except (Exception, SystemExit) as error:
            raise StageError(f"{origin} cannot be loaded: {one_line(error)}") from error
        for lesson in found if isinstance(found, list | tuple) else [found]:
            if not isinstance(lesson, Lesson):
                raise StageError(f"{origin}: expected a workbench.teach.Lesson, got {lesson!r}")
            if lesson.number in lessons:
                raise StageError(
                    f"{origin}: {lesson.name} and {lessons[lesson.number].name} are both "
                    f"number {lesson.number}"
                )
            lessons[lesson.number] = lesson
    return [lessons[number] for number in sorted(lessons)]


def lesson_numbered(lessons: Sequence[Lesson], number: int) -> Lesson:
    """The lesson of that number.  Raises :class:`UsageError`."""
    for lesson in lessons:
        if lesson.number == number:
            return lesson
    known = ", ".join(str(lesson.number) for lesson in lessons) or "none"
    raise UsageError(f"--lesson {number}: no such lesson; lessons: {known}")


@dataclass(frozen=True)
class OpenLesson:
    """A lesson with its pipeline and its frame, ready to be run."""

    lesson: Lesson
    pipeline: Pipeline
    frame: Frame

    @staticmethod
    def open(
        lesson: Lesson, assignments: Sequence[str] = (), store: ResultStore | None = None
    ) -> OpenLesson:
        """Put the lesson's pipeline together and read its frame.

        ``assignments`` are texts ``stage.parameter=value``, laid over how the lesson opens.
        Raises :class:`DataError` where its recording is not there, ``SettingsError`` for a wrong
        assignment.
        """
        stages = _stages(lesson)
        settings = resolve(stages, OPENING, assignments=assignments)
        if lesson.recording is None:
            pipeline = Pipeline(stages, settings, store=store)
            return OpenLesson(lesson, pipeline, NO_FRAME)
        if not lesson.recording.is_file():
            raise DataError(
                f"lesson {lesson.number} needs {lesson.recording.name}, expected in "
                f"{lesson.recording.parent}: run the lessons from a clone of the repository, "
                "installed with pip install -e ."
            )
        resources = resources_beside(lesson.recording, stages)
        pipeline = Pipeline(stages, settings, resources, store=store)
        required, optional = pipeline.channels
        if not required:
            # It takes what lies beside the recording, and no image of it.
            return OpenLesson(lesson, pipeline, NO_FRAME)
        recording = Recording.open(lesson.recording)
        for frame in recording.frames(required, optional, lesson.frame, lesson.frame + 1):
            return OpenLesson(lesson, pipeline, frame)
        raise DataError(f"{lesson.recording}: no frame {lesson.frame}")

    @property
    def settings(self) -> Settings:
        """The parameters as the lesson opens."""
        return self.pipeline.settings

    @cached_property
    def knobs(self) -> dict[str, Knob]:
        """The lesson's knobs, ``stage.parameter`` to declaration, in its order."""
        by_name = {stage.name: stage.Parameters.knobs() for stage in self.pipeline.stages}
        found = {}
        for address in self.lesson.knobs:
            stage, _, parameter = address.partition(".")
            found[address] = by_name[stage][parameter]
        return found

    def values(self, turned: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Every knob's value, with some of them turned."""
        now = {}
        for address in self.lesson.knobs:
            stage, _, parameter = address.partition(".")
            now[address] = getattr(self.settings.parameters[stage], parameter)
        return now | dict(turned or {})

    def turned(self, values: Mapping[str, Any]) -> Pipeline:
        """The lesson's pipeline with some knobs turned.  Raises ``SettingsError``."""
        stages = {stage.name: stage for stage in self.pipeline.stages}
        return self.pipeline.with_settings(adjusted(stages, self.settings, values))

    def run(self, values: Mapping[str, Any] | None = None) -> Run:
        """The lesson with some knobs turned.  Raises :class:`DataError` if a stage failed."""
        run = self.turned(values or {}).run(self.frame)
        for failure in run.failures:
            raise DataError(f"lesson {self.lesson.number}, {failure.stage}: {failure.says}")
        return run

    def check(self, claim: Claim) -> Seen:
        """Turn the knobs as the claim says, and measure."""
        before, after = self.run(claim.before), self.run(claim.after)
        return Seen(claim, claim.measure(before), claim.measure(after))


def _stages(lesson: Lesson) -> dict[str, Stage]:
    """The lesson's stages by name, each with the lesson's settings as its preset."""
    opening: dict[str, dict[str, Any]] = {}
    for address, value in lesson.settings.items():
        name, _, parameter = address.partition(".")
        opening.setdefault(name, {})[parameter] = value
    stages: dict[str, Stage] = {}
    for cls in lesson.stages:
        stage = cls()
        # Of this instance alone: the class may run elsewhere at the same time.
        vars(stage)["presets"] = {OPENING: opening.get(cls.name, {})}
        stages[cls.name] = stage
    return stages


def sweep(claim: Claim, opened: OpenLesson, steps: int = SWEEP_STEPS) -> list[dict[str, Any]]:
    """Knob values from a claim's before to its after, both included, without doubles.

    Numbers go evenly; what has no middle changes at once, with nothing in between.
    """
    start, stop = opened.values(claim.before), opened.values(claim.after)
    moving = [name for name in start if start[name] != stop[name]]
    if not all(_is_number(start[name]) and _is_number(stop[name]) for name in moving):
        return [start, stop]
    found: list[dict[str, Any]] = []
    for step in range(steps):
        share = step / (steps - 1)
        values = dict(stop if step == steps - 1 else start)
        if 0 < step < steps - 1:
            for name in moving:
                between = start[name] + share * (stop[name] - start[name])
                values[name] = round(between) if isinstance(start[name], int) else between
        if not found or values != found[-1]:
            found.append(values)
    return found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)

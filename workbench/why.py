"""Why a pixel is what it is: its story through the stages.

:func:`story` asks every stage to explain one pixel of one run.  A stage that failed, or that fails
to explain, appears with its trouble and never hides the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from workbench.errors import UsageError, one_line
from workbench.pipeline import Pipeline, Run
from workbench.stage import Finding, Stage, StageError

__all__ = ["StageStory", "Story", "Threshold", "as_dict", "as_markdown", "image_size", "story"]


@dataclass(frozen=True)
class Threshold:
    """The parameter that a finding's value met, as it stands."""

    address: str
    """``stage.parameter``"""
    value: Any
    unit: str = ""

    def __str__(self) -> str:
        return f"{self.address} = {self.value}" + (f" {self.unit}" if self.unit else "")


@dataclass(frozen=True)
class StageStory:
    """What one stage tells of the pixel."""

    stage: str
    findings: tuple[Finding, ...] = ()
    trouble: str | None = None
    """Why the stage has nothing to tell: it failed, or its explanation did."""
    thresholds: tuple[Threshold | None, ...] = ()
    """One for each finding: the parameter it names, with its value; None where it names none."""

    @property
    def deciding(self) -> Finding | None:
        """The last finding that has a verdict."""
        return next((f for f in reversed(self.findings) if f.verdict), None)

    @property
    def verdict(self) -> str:
        """The stage's verdict, empty if it has none."""
        return self.deciding.verdict if self.deciding else ""


@dataclass(frozen=True)
class Story:
    """A pixel's story through all stages, in their order."""

    index: int
    """The frame's."""
    stamp_ns: int
    x: int
    y: int
    stages: tuple[StageStory, ...]
    verdicts: Mapping[str, str] = field(default_factory=dict)
    """The verdict of each stage that has one, by stage."""

    @property
    def subject(self) -> str | None:
        """The stage whose verdict is asked for: the last that has one on this very pixel."""
        own = [s.stage for s in self.stages if s.deciding and not s.deciding.about]
        return own[-1] if own else None


def image_size(pipeline: Pipeline, run: Run) -> tuple[int, int]:
    """Width and height of the grid that pixels are asked on: the first required channel's."""
    height, width = run.frame.images[pipeline.channels[0][0]].shape[:2]
    return width, height


def story(pipeline: Pipeline, run: Run, x: int, y: int) -> Story:
    """What every stage of ``pipeline`` tells of pixel (x, y) of ``run``.

    Raises :class:`UsageError` for a pixel outside the image.
    """
    width, height = image_size(pipeline, run)
    if not (0 <= x < width and 0 <= y < height):
        raise UsageError(
            f"pixel {x},{y}: expected x from 0 to {width - 1} and y from 0 to {height - 1}, for "
            f"the image is {width}×{height}"
        )
    told = tuple(tell(pipeline, run, stage, x, y) for stage in pipeline.stages)
    return Story(
        run.frame.index,
        run.frame.stamp_ns,
        x,
        y,
        told,
        {one.stage: one.verdict for one in told if one.verdict},
    )


def tell(pipeline: Pipeline, run: Run, stage: Stage, x: int, y: int) -> StageStory:
    """What one stage tells of pixel (x, y); whatever goes wrong is in ``trouble``."""
    failure = next((f for f in run.failures if f.stage == stage.name), None)
    if failure is not None:
        return StageStory(stage.name, trouble=failure.says)
    parameters = pipeline.settings.parameters[stage.name]
    try:
        findings = tuple(stage.explain(x, y, run.artifacts, parameters))
        thresholds = tuple(_threshold(stage, parameters, f.parameter) for f in findings)
    except Exception as error:
        return StageStory(stage.name, trouble=f"its explanation failed: {one_line(error)}")
    return StageStory(stage.name, findings, None, thresholds)


def _threshold(stage: Stage, parameters: Any, name: str | None) -> Threshold | None:
    if name is None:
        return None
    knob = stage.Parameters.knobs().get(name)
    if knob is None:
        raise StageError(f"a finding names the parameter {name!r}, which {stage.name} has not")
    return Threshold(f"{stage.name}.{name}", getattr(parameters, name), knob.unit)


def as_markdown(story: Story) -> str:
    """The story as a page: a heading for each stage with its verdict, a line for each finding."""
    lines = [f"# Pixel {story.x}, {story.y} of frame {story.index}"]
    for told in story.stages:
        lines += ["", f"## {told.stage}" + (f": {told.verdict}" if told.verdict else "")]
        if told.trouble is not None:
            lines.append(f"- **{told.trouble}**")
        elif not told.findings:
            lines.append("- says nothing of single pixels")
        for finding, threshold in zip(told.findings, told.thresholds, strict=True):
            lines.append(f"- {finding.says}" + (f" (`{threshold}`)" if threshold else ""))
    return "\n".join(lines) + "\n"


def as_dict(story: Story) -> dict[str, Any]:
    """The story as JSON values; a number that is not finite is None."""
    return {
        "frame": story.index,
        "stamp_ns": story.stamp_ns,
        "pixel": [story.x, story.y],
        "subject": story.subject,
        "verdicts": dict(story.verdicts),
        "stages": [
            {
                "stage": told.stage,
                "verdict": told.verdict or None,
                "trouble": told.trouble,
                "findings": [
                    {
                        "says": finding.says,
                        "values": {name: plain(value) for name, value in finding.values.items()},
                        "threshold": None
                        if threshold is None
                        else {
                            "parameter": threshold.address,
                            "value": threshold.value,
                            "unit": threshold.unit,
                        },
                        "verdict": finding.verdict or None,
                        "about": finding.about or None,
                    }
                    for finding, threshold in zip(told.findings, told.thresholds, strict=True)
                ],
            }
            for told in story.stages
        ],
    }


def plain(value: Any) -> Any:
    """``value`` as JSON holds it."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

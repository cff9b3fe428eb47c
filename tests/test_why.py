"""A pixel's story: every stage tells, whatever befalls another."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from workbench.errors import UsageError
from workbench.pipeline import Pipeline
from workbench.recording import Frame
from workbench.settings import resolve
from workbench.stage import Artifact, Finding, Stage, StageParameters, knob, recorded_image
from workbench.why import as_dict, as_markdown, story

IMAGE = recorded_image("left")


class Cut(Stage):
    """What is over a threshold."""

    name = "cut"
    needs = (IMAGE,)
    gives = (Artifact("bright", "bool", "H W"),)

    class Parameters(StageParameters):
        level: float = knob(5.0, "From here up is bright.", low=0, high=10, unit="grey levels")

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"bright": inputs["left_image"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        bright = artifacts["bright"][y, x]
        return [
            Finding(
                f"level {artifacts['left_image'][y, x]}",
                {"bright": bright, "nothing": float("nan")},
                "level",
                "bright" if bright else "dark",
            )
        ]


class Mute(Stage):
    """Says nothing of pixels."""

    name = "mute"
    needs = (Artifact("bright"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {}


class Fails(Stage):
    """Never comes through."""

    name = "fails"
    needs = (Artifact("bright"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        raise RuntimeError("no\nlight")


class CannotExplain(Stage):
    """Its explanation fails."""

    name = "cannot_explain"

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        raise KeyError("lost")


class NamesNoKnob(CannotExplain):
    """Names a parameter that it does not have."""

    name = "names_no_knob"

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("held against what is not there", {}, "ghost")]


class Beside(CannotExplain):
    """Its verdict is on something else than the pixel."""

    name = "beside"

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("the neighbour is fine", verdict="fine", about="the neighbour")]


class Lone(CannotExplain):
    """Takes an image and says nothing of it."""

    name = "lone"
    needs = (IMAGE,)


def pipeline_of(*kinds: type[Stage], sets: tuple[str, ...] = ()) -> Pipeline:
    stages = {kind.name: kind() for kind in kinds}
    return Pipeline(stages, resolve(stages, assignments=sets))


def frame(image: np.ndarray) -> Frame:
    return Frame(7, 11, {"left": image}, {"left": 11}, {}, None, "digest")


RAMP = np.arange(12, dtype=np.float32).reshape(3, 4)
ALL = (Cut, Mute, Fails, CannotExplain, NamesNoKnob, Beside)


def test_every_stage_appears_and_trouble_hides_nothing() -> None:
    pipeline = pipeline_of(*ALL)
    told = story(pipeline, pipeline.run(frame(RAMP)), 3, 1)
    assert [one.stage for one in told.stages] == [kind.name for kind in ALL]
    by_stage = {one.stage: one for one in told.stages}
    assert by_stage["cut"].findings[0].says == "level 7.0"
    assert str(by_stage["cut"].thresholds[0]) == "cut.level = 5.0 grey levels"
    assert by_stage["mute"].findings == () and by_stage["mute"].trouble is None
    assert by_stage["fails"].trouble == "RuntimeError: no light"
    assert "lost" in str(by_stage["cannot_explain"].trouble)
    assert "'ghost'" in str(by_stage["names_no_knob"].trouble)
    assert told.verdicts == {"cut": "bright", "beside": "fine"}
    page = as_markdown(told)
    for text in ("cut: bright", "cut.level = 5.0 grey levels", "no light", "lost", "ghost"):
        assert text in page


def test_what_is_asked_of_a_pixel_is_the_last_verdict_on_the_pixel_itself() -> None:
    pipeline = pipeline_of(*ALL)
    assert story(pipeline, pipeline.run(frame(RAMP)), 0, 0).subject == "cut"
    pipeline = pipeline_of(CannotExplain, Beside, Lone)
    assert story(pipeline, pipeline.run(frame(RAMP)), 0, 0).subject is None


def test_the_story_is_json() -> None:
    pipeline = pipeline_of(*ALL)
    said = as_dict(story(pipeline, pipeline.run(frame(RAMP)), 3, 1))
    again = json.loads(json.dumps(said, allow_nan=False))
    assert again["pixel"] == [3, 1] and again["frame"] == 7 and again["stamp_ns"] == 11
    finding = again["stages"][0]["findings"][0]
    assert finding["values"] == {"bright": True, "nothing": None}
    assert finding["threshold"] == {"parameter": "cut.level", "value": 5.0, "unit": "grey levels"}


@pytest.mark.parametrize(("x", "y"), [(-1, 0), (4, 0), (0, 3), (0, -1)])
def test_a_pixel_outside_the_image_is_refused(x: int, y: int) -> None:
    pipeline = pipeline_of(Cut)
    with pytest.raises(UsageError, match=f"pixel {x},{y}: .*4×3"):
        story(pipeline, pipeline.run(frame(RAMP)), x, y)

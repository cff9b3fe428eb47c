"""What a pixel's story says, held against the artifacts at that pixel, stage by stage."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from workbench.pipeline import Pipeline
from workbench.why import StageStory, Story
from workbench_stages.edges.linking import Step
from workbench_stages.matching.recognise import Reason

_JOINED = {Step.MEDIUM, Step.HIGH}
_SHORT = {Step.SHORT_MEDIUM, Step.SHORT_HIGH}
_FAINT = {Step.FAINT_MEDIUM, Step.FAINT_HIGH}


def disagreements(told: Story, pipeline: Pipeline, artifacts: Mapping[str, Any]) -> list[str]:
    """Every way in which the story departs from the artifacts; empty if it agrees."""
    found = list(_values(told, pipeline, artifacts))
    for one in told.stages:
        if one.trouble is not None:
            found.append(f"{one.stage}: {one.trouble}")
            continue
        p = pipeline.settings.parameters[one.stage]
        expected = _VERDICTS[one.stage](told.x, told.y, artifacts)
        if one.verdict != expected:
            found.append(f"{one.stage}: says {one.verdict!r}, the artifacts {expected!r}")
        if one.stage in _REASONS:
            found += [
                f"{one.stage}: {says}"
                for says in _REASONS[one.stage](one, told.x, told.y, artifacts, p)
            ]
    return found


def _values(told: Story, pipeline: Pipeline, artifacts: Mapping[str, Any]) -> Iterator[str]:
    """Values named after an artifact are that artifact's; thresholds are the parameters'."""
    declared = pipeline.artifacts
    for one in told.stages:
        parameters = pipeline.settings.parameters[one.stage]
        for finding, threshold in zip(one.findings, one.thresholds, strict=True):
            if threshold is not None:
                name = threshold.address.removeprefix(f"{one.stage}.")
                if threshold.value != getattr(parameters, name):
                    yield f"{threshold} is not what the stage had"
            for name, value in finding.values.items():
                if name not in declared:
                    continue
                there = artifacts[name]
                if declared[name].axes[:2] == ("H", "W"):
                    there = there[told.y, told.x]
                if not np.array_equal(np.asarray(value), np.asarray(there), equal_nan=True):
                    yield f"{one.stage}: {name} is told as {value}, it is {there}"


# -- verdicts, from the artifacts alone ---------------------------------------------------------


def _registration(x: int, y: int, a: Mapping[str, Any]) -> str:
    return "saturated" if a["saturated"][y, x] else "not saturated"


def _focus_maps(x: int, y: int, a: Mapping[str, Any]) -> str:
    near, far = a["focus_near"][y, x], a["focus_far"][y, x]
    if near + far == 0:
        return "no texture"
    if near == far:
        return "as sharp in both"
    return "sharper in near" if near > far else "sharper in far"


def _depth_cloud(x: int, y: int, a: Mapping[str, Any]) -> str:
    if np.isfinite(a["depth_m"][y, x]):
        return "known"
    return "relative" if np.isfinite(a["depth_relative"][y, x]) else "unknown"


def _edge_stack(x: int, y: int, a: Mapping[str, Any]) -> str:
    if a["edges_high"][y, x]:
        return "edge"
    return "line on the background" if a["edge_choice"].stack.edges_high[y, x] else "no edge"


def _linked_edges(x: int, y: int, a: Mapping[str, Any]) -> str:
    if a["edges_linked"][y, x]:
        return "edge"
    return "line on the background" if a["region_lines"][y, x] else "no edge"


def _region_features(x: int, y: int, a: Mapping[str, Any]) -> str:
    label = a["labels"][y, x]
    if label == 0:
        return "no region"
    return "background" if a["regions"]["background"][label - 1] else "region"


def _recognition(x: int, y: int, a: Mapping[str, Any]) -> str:
    rows = a["candidates"][a["candidates"]["label"] == a["labels"][y, x]]
    if a["verdict"] is None:
        return ""
    if not len(rows):
        label = a["labels"][y, x]
        seen = label > 0 and not a["regions"]["background"][label - 1]
        return "refused" if seen else "no candidate"
    if rows[0]["reason"] != Reason.NONE:
        return "refused"
    return "picked" if a["verdict"]["region"] == a["labels"][y, x] else "not the highest"


def _pose_frames(x: int, y: int, a: Mapping[str, Any]) -> str:
    for pose in a["poses"]:
        if pose["region"] == a["labels"][y, x]:
            return "pose" if pose["distance"] <= pose["zeta"] else "doubtful pose"
    return "no pose"


_VERDICTS = {
    "registration": _registration,
    "focus_maps": _focus_maps,
    "depth_cloud": _depth_cloud,
    "edge_stack": _edge_stack,
    "linked_edges": _linked_edges,
    "region_features": _region_features,
    "recognition": _recognition,
    "pose_frames": _pose_frames,
}


# -- reasons ------------------------------------------------------------------------------------


def _depth_reasons(one: StageStory, x: int, y: int, a: Mapping[str, Any], p: Any) -> Iterator[str]:
    told = {
        t.address.partition(".")[2]: f
        for f, t in zip(one.findings, one.thresholds, strict=True)
        if t
    }
    deciding = one.deciding
    if one.verdict == "known":
        if a["confidence"][y, x] < p.min_confidence:
            yield "known with too little confidence"
        if f"{1e3 * a['depth_m'][y, x]:.2f} mm" not in one.findings[-1].says:
            yield "another depth than the artifact's"
        if (
            f"confidence {a['confidence'][y, x]:.3f} is not under"
            not in told["min_confidence"].says
        ):
            yield "another confidence than the artifact's"
    elif deciding is told.get("min_modulation") and a["confidence"][y, x] != 0:
        yield "folded back, but has confidence"


def _stack_reasons(one: StageStory, x: int, y: int, a: Mapping[str, Any], p: Any) -> Iterator[str]:
    stack = a["edge_choice"].stack
    strength, peak = stack.strength[y, x], stack.segment_peak[y, x]
    says = " ".join(finding.says for finding in one.findings)
    if "is under low" in says and not strength < stack.low_threshold:
        yield "not under low"
    if "too faint to look at" in says and not strength < p.lowest:
        yield "not too faint"
    if "no maximum" in says and a["edge_choice"].gradient.thin[y, x]:
        yield "a maximum after all"
    images = [stack.edges_low[y, x], stack.edges_medium[y, x], stack.edges_high[y, x]]
    into = ["low, medium and high resolution", "image of medium and high", "image of high resol"]
    highest = into[images.index(True)] if any(images) else None
    if highest is not None and (highest not in says or f"{int(peak)}." not in says):
        yield f"not told to be in {highest}"


def _linking_reasons(
    one: StageStory, x: int, y: int, a: Mapping[str, Any], p: Any
) -> Iterator[str]:
    done = a["linking"].reconstruction
    reached, step = Step(int(done.step[y, x])), Step(int(a["edge_step"][y, x]))
    values = {key: value for f in one.findings for key, value in f.values.items()}
    says = " ".join(finding.says for finding in one.findings)
    if reached in _JOINED | _SHORT and values["segment_px"] != done.value[y, x]:
        yield f"segment of {values['segment_px']} px, it had {done.value[y, x]}"
    if reached in _JOINED and ("joined" not in says or not done.edges[y, x]):
        yield "joined but not told so"
    if reached in _SHORT | _FAINT and ("rejected" not in says or done.edges[y, x]):
        yield "rejected but not told so"
    if reached in _FAINT and not values["weight_px"] <= p.min_weight:
        yield "rejected for a weight that is enough"
    if step in (Step.LINK, Step.BORDER) and "linked: from" not in says:
        yield "the link that drew it was not found"
    if (step >= Step.LOW) != bool(a["edges_linked"][y, x]):
        yield "the step contradicts the edge"


def _region_reasons(one: StageStory, x: int, y: int, a: Mapping[str, Any], _: Any) -> Iterator[str]:
    label = a["labels"][y, x]
    if label and one.findings[-1].values["area_px"] != (a["labels"] == label).sum():
        yield "another area than the region's"


def _recognition_reasons(
    one: StageStory, x: int, y: int, a: Mapping[str, Any], _: Any
) -> Iterator[str]:
    rows = a["candidates"][a["candidates"]["label"] == a["labels"][y, x]]
    if not len(rows) or a["verdict"] is None:
        return
    knobs = {1: "min_area", 3: "max_tilt", 4: "max_residual", 5: "covered_share", 6: "phi_scale",
             7: "zeta_scale"}  # fmt: skip
    threshold = one.thresholds[-1]
    named = None if threshold is None else threshold.address.partition(".")[2]
    if named != knobs.get(int(rows[0]["reason"])):
        yield f"names {named}, but the reason is {Reason(int(rows[0]['reason'])).name}"


_REASONS = {
    "depth_cloud": _depth_reasons,
    "edge_stack": _stack_reasons,
    "linked_edges": _linking_reasons,
    "region_features": _region_reasons,
    "recognition": _recognition_reasons,
}

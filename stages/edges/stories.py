"""Why a pixel is an edge or none, in words: what its step decided by, and where lines end near it.

Plain text from arrays; every number is one that the linking itself compared.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..wording import apart
from .linking import Linked, Links, Step, bresenham
from .segmentation import LinkedResult, StackResult
from .stack import image_scale
from .walls import Walls

__all__ = ["Clause", "enclosed_px", "linking_story", "nearest_end", "on_line"]

Bool = NDArray[np.bool_]

_LEFT_IN = {
    Step.MEDIUM: ("medium", "low"),
    Step.SHORT_MEDIUM: ("medium", "low"),
    Step.FAINT_MEDIUM: ("medium", "low"),
    Step.HIGH: ("high", "the first iteration"),
    Step.SHORT_HIGH: ("high", "the first iteration"),
    Step.FAINT_HIGH: ("high", "the first iteration"),
}


@dataclass(frozen=True)
class Clause:
    """A sentence, its numbers, and the parameter that they met."""

    says: str
    parameter: str | None = None
    values: Mapping[str, Any] = field(default_factory=dict)


def linking_story(x: int, y: int, given: StackResult, result: LinkedResult, p: Any) -> list[Clause]:
    """What decided on pixel (x, y), the deciding clause last.

    ``p`` has the parameters of the stage ``linked_edges``.
    """
    step, value = Step(int(result.step[y, x])), float(result.value[y, x])
    done = result.reconstruction
    scale = image_scale(result.step.shape)
    reached = Step(int(done.step[y, x]))
    clauses: list[Clause] = []
    if reached in _LEFT_IN:
        clauses += _segment(x, y, reached, given, result, p)
    elif reached is Step.LOW:
        peak = float(done.value[y, x])
        clauses.append(
            Clause(f"in the image of low resolution: its segment reaches {peak:.2f}", "min_length")
        )
    elif reached is Step.WEAK:
        low = given.stack.low_threshold
        weak = float(done.value[y, x])
        clauses.append(
            Clause(f"no edge of the stack: strength {apart(weak, low, 2)} is under low {low:.2f}")
        )
    else:
        clauses.append(Clause("no edge of the stack: too faint to look at, or no maximum"))
    if step in (Step.LINK, Step.BORDER):
        clauses.append(_link(x, y, value, result.linked.links, p, scale))
    elif step is Step.CREASE:
        clauses.append(
            Clause(
                f"the depth shows a step or crease here (evidence {value:.1f} σ), farther than "
                f"{p.crease_clearance * max(scale, 1.0):.0f} px from every other edge: drawn",
                "crease_clearance",
            )
        )
    elif step is Step.FOOT:
        clauses.append(
            Clause(
                f"the foot of an upright wall under a face {1e3 * value:.1f} mm above the table: "
                "drawn",
                "wall_area",
            )
        )
    elif step is Step.BACKGROUND:
        why = f"its brighter side has {value:.1f} grey levels, as the background has"
        if not given.background[y, x]:
            why = "it was drawn to join a line on the background"
        clauses.append(Clause(f"{why}: it bounds regions and is no edge"))
    return clauses


def _segment(
    x: int, y: int, step: Step, given: StackResult, result: LinkedResult, p: Any
) -> list[Clause]:
    """How the segment of the difference image fared that the pixel belongs to."""
    stack, done = given.stack, result.reconstruction
    first = step in (Step.MEDIUM, Step.SHORT_MEDIUM, Step.FAINT_MEDIUM)
    difference = done.difference_medium if first else done.difference_high
    before = stack.edges_low if first else done.first
    _, labels = cv2.connectedComponentsWithAlgorithm(
        np.ascontiguousarray(difference).view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    number = int(labels[y, x])
    mask = labels == number
    size = int(mask.sum())
    touches = _touches(mask, before)
    scale = image_scale(difference.shape)
    limit = int(p.min_length * scale)
    name, less = _LEFT_IN[step]
    segment = f"segment {number} of the {name} resolution less {less} ({size} px)"
    values: dict[str, Any] = {"segment": number, "segment_px": size}
    if touches:
        onto = "the low resolution" if first else "what the first iteration kept"
        return [Clause(f"joined: {segment} touches {onto}", None, values)]
    if size <= limit:
        says = f"rejected: {segment} touches nothing kept and is not longer than {limit} px"
        return [Clause(says, "min_length", values)]
    longer = f"{segment} touches nothing kept but is longer than {limit} px"
    if p.min_weight <= 0:
        return [Clause(f"joined: {longer}", "min_length", values)]
    least = p.min_weight * scale
    if step in (Step.FAINT_MEDIUM, Step.FAINT_HIGH):
        weight = float(done.value[y, x])
        says = f"rejected as too faint: its weight {apart(weight, least, 2)} px is not over "
        says += f"{least:.1f} px"
        values["weight_px"] = weight
    else:
        says = f"joined: its weight is over {least:.1f} px"
    return [Clause(longer, "min_length", values), Clause(says, "min_weight", values)]


def _touches(mask: Bool, before: Bool) -> bool:
    around = cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return bool((around & before).any())


def _link(x: int, y: int, cost: float, links: Links, p: Any, scale: float) -> Clause:
    """The link that drew the pixel: of those that pass it, the one with its cost."""
    most = p.max_cost * max(scale, 1.0)
    for i in np.flatnonzero(links.cost == np.float32(cost)):
        (x0, y0), (x1, y1) = links.start[i].tolist(), links.end[i].tolist()
        if (x, y) in bresenham(x0, y0, x1, y1):
            long = float(np.hypot(x1 - x0, y1 - y0))
            partner = "the image's border at" if links.border[i] else "the line at"
            return Clause(
                f"linked: from {x0},{y0} to {partner} {x1},{y1}, {long:.1f} px away, for a cost of "
                f"{apart(cost, most, 2)}, not over {most:.1f} px",
                "max_cost",
                {"cost": cost},
            )
    return Clause(
        f"linked for a cost of {cost:.2f}, not over {most:.1f} px", "max_cost", {"cost": cost}
    )


def nearest_end(x: int, y: int, linked: Linked, p: Any) -> Clause | None:
    """Where the nearest end of a line within reach looked, and what it was linked to.

    None where no line ended within reach before linking.
    """
    if not len(linked.terminators):
        return None
    away = linked.terminators - np.array([x, y])
    squares = (away.astype(np.int64) ** 2).sum(axis=1)
    i = int(squares.argmin())
    scale = max(image_scale(linked.edges.shape), 1.0)
    distance = float(np.sqrt(squares[i]))
    if distance == 0 or distance > p.reach * scale:
        return None
    u, v = linked.terminators[i].tolist()
    dx, dy = (float(d) for d in linked.directions[i])
    ahead, aside = -away[i][0] * dx - away[i][1] * dy, abs(away[i][1] * dx - away[i][0] * dy)
    angle = float(np.degrees(np.arctan2(aside, ahead)))
    widest = p.lateral + np.tan(np.radians(p.cone_deg)) * ahead
    inside = ahead > 0 and aside <= widest
    says = (
        f"the line's end at {u},{v}, {distance:.1f} px away, looked {angle:.0f}° off this pixel, "
        f"{'within' if inside else 'outside'} its wedge"
    )
    own = np.flatnonzero((linked.links.start == (u, v)).all(axis=1))
    if len(own):
        to = linked.links.end[own[0]].tolist()
        says += f"; it was linked to {to[0]},{to[1]} for a cost of {linked.links.cost[own[0]]:.2f}"
    elif (linked.open_ends == (u, v)).all(axis=1).any():
        says += "; it found no partner and stayed open"
    else:
        says += "; another's link reached it"
    return Clause(says, "cone_deg", {"end_px": distance, "end_deg": angle})


def on_line(x: int, y: int, artifacts: Mapping[str, Any]) -> str:
    """What line pixel (x, y) lies on, if any: then regions are beside it, and not what it is."""
    lines, given = artifacts.get("region_lines"), artifacts.get("edge_choice")
    if lines is not None and lines[y, x]:
        return "the line"
    if given is not None and given.stack.edges_high[y, x]:
        return "the rejected edge"
    return ""


def enclosed_px(x: int, y: int, lines: Bool, walls: Walls | None) -> int:
    """How many pixels lines (and walls) close around pixel (x, y); 0 on one of them."""
    closed = lines if walls is None else lines | (walls.labels > 0)
    if closed[y, x]:
        return 0
    _, labels = cv2.connectedComponentsWithAlgorithm(
        (~closed).view(np.uint8), 4, cv2.CV_32S, cv2.CCL_SAUF
    )
    return int((labels == labels[y, x]).sum())

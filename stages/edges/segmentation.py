"""Both presets of issue 3, and the three stages as functions that chain the mathematics.

``paper``    intensity edges alone, GEF, thresholds in grey levels, terminators alone.
``default``  Canny's gradient in standard deviations of its own noise; depth steps and creases
             lower the contrast that an edge needs and close what the intensity cannot; corners
             link as well as ends.  Without depth it is the same less what needs depth.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numba import njit
from numpy.typing import NDArray

from .depth_edges import RIDGE_REACH, DepthEdges, depth_edges
from .linking import Linked, Links, Reconstruction, Step, link, path_offset, reconstruct
from .operators import Gradient, gradient_of, non_maximum_suppression
from .planes import Camera
from .presets import PRESETS
from .regions import closed_regions, distance_to_border
from .stack import EdgeStack, build_stack, image_scale, noise_model
from .walls import Walls, upright_walls

__all__ = ["PRESETS", "LinkedResult", "StackResult", "link_edges", "segment", "stack_edges"]

F32 = NDArray[np.float32]
I32 = NDArray[np.int32]
Bool = NDArray[np.bool_]


@dataclass(frozen=True)
class StackResult:
    """What the stage ``edge_stack`` gives.

    Attributes:
        gradient: the operator's gradient; noise: [H W] float32, its standard deviation in grey
            levels, or None where thresholds are in grey levels.
        background: [H W] bool, pixels whose brighter side is no brighter than the background that
            the depth sensor cannot see: a line there may be the shadow of a part as well as its
            edge.  Such lines are searched and linked as all others, since parts in shadow end at
            them and regions need them, but they are not *edges*.
        depth: the depth's evidence where it took part in the gradient, or None.
        stack: the thresholds and the three images, with the lines on the background.
        edges_low, edges_medium, edges_high: [H W] bool, the three images without them.
    """

    gradient: Gradient
    noise: F32 | None
    background: Bool
    depth: DepthEdges | None
    stack: EdgeStack
    edges_low: Bool
    edges_medium: Bool
    edges_high: Bool


@njit(cache=True, nogil=True)
def _strength(magnitude, noise, depth, gain, full, out):
    for i in range(magnitude.shape[0]):
        for j in range(magnitude.shape[1]):
            s = magnitude[i, j] / noise[i, j]
            if gain > 0:
                s *= np.float32(1) + gain * min(depth[i, j] / full, np.float32(1))
            out[i, j] = s


def stack_edges(
    image: np.ndarray,
    depth: np.ndarray | None = None,
    *,
    operator: str = "canny",
    full_scale: float | None = None,
    noise_units: bool = True,
    lowest: float = 2.0,
    greatest: float | None = None,
    max_ratio: float = 0.015,
    steps: int = 128,
    small_segment: float = 4.0,
    use_depth: bool = True,
    depth_gain: float = 0.0,
    depth_full: float = 6.0,
    background_factor: float = 1.1,
) -> StackResult:
    """Gradient, depth evidence and the stack of three images (4.1).

    Args:
        image: [H W] intensity without stripes; depth: [H W], any unit, NaN where unknown, or None.
        operator, full_scale: see :func:`edges.operators.gradient_of`.
        noise_units: thresholds in standard deviations of the gradient's noise at the pixel's
            grey level, else in grey levels of 8 bit.
        lowest: where the search for the low threshold starts, in that unit.
        greatest: the greatest high threshold, in that unit; None takes the operator's.
        max_ratio, steps, small_segment: see :func:`edges.stack.build_stack`.
        use_depth: let the depth take part where it is given.
        depth_gain: the joint gradient is the intensity's times ``1 + depth_gain · e``, where e
            rises from 0 to 1 with the depth's evidence for a step or a crease and is 1 from
            ``depth_full`` standard deviations on.
        background_factor: where the sensor sees no depth the surface is too dark to measure, as a
            bin-picking table is made to be.  Pixels no brighter on their brighter side than this
            many times the median level of what is not seen (and two standard deviations) are
            ``background``.  0 holds no pixel to be.
    """
    noise = None
    if noise_units:
        gradient = gradient_of(image, operator, full_scale, floor=None)
        model = noise_model(gradient)
        noise = model.at(gradient.bright)
        # Nothing under the least threshold can be an edge: most of the noise is spared the search.
        thin = non_maximum_suppression(
            gradient.gx, gradient.gy, gradient.magnitude, lowest * float(model.sigma.min())
        )
        gradient = replace(gradient, thin=thin)
    else:
        gradient = gradient_of(image, operator, full_scale, floor=min(0.5, lowest))
    if not use_depth:
        depth = None
    found = depth_edges(depth) if depth is not None and depth_gain > 0 else None
    strength = gradient.magnitude
    gain = depth_gain if found is not None else 0.0
    if noise is not None or gain > 0:
        strength = np.empty_like(gradient.magnitude)
        _strength(
            gradient.magnitude,
            noise if noise is not None else np.ones_like(strength),
            found.strength if found is not None else strength,
            np.float32(gain), np.float32(depth_full), strength,
        )  # fmt: skip
    background: Bool = np.zeros(gradient.thin.shape, np.bool_)
    if depth is not None and background_factor > 0:
        unseen = ~np.isfinite(depth)
        # A table that was measured, or a scene that fills the picture, leaves too little to judge.
        if unseen.mean() > 0.05:
            level = np.float32(np.median(gradient.bright[unseen])) * np.float32(background_factor)
            background = gradient.bright <= (level if noise is None else level + 2 * noise)
    stack = build_stack(
        strength, gradient.thin, lowest=lowest, greatest=greatest or gradient.greatest, steps=steps,
        max_ratio=max_ratio, small_segment=small_segment,
    )  # fmt: skip
    if background.any():
        limit = int(small_segment * image_scale(gradient.thin.shape))
        background = background | _crumbs(stack.edges_high, background, max(limit, 1))
    images = (stack.edges_low, stack.edges_medium, stack.edges_high)
    return StackResult(
        gradient, noise, background, found, stack, *(image & ~background for image in images)
    )


def _crumbs(lines: Bool, background: Bool, limit: int) -> Bool:
    """Pieces of at most ``limit`` pixels that a line on the background is broken into.

    Noise lifts a pixel here and there of such a line over the background's level.
    """
    left = lines & ~background
    n, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        left.view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    beside = cv2.dilate((lines & background).view(np.uint8), np.ones((3, 3), np.uint8)) > 0
    crumb = np.zeros(n, np.bool_)
    crumb[np.unique(labels[beside & left])] = True
    crumb &= stats[:, cv2.CC_STAT_AREA] <= limit
    crumb[0] = False
    return crumb[labels]


@dataclass(frozen=True)
class LinkedResult:
    """What the stage ``linked_edges`` gives.

    Attributes:
        reconstruction: figures 6a to 6d; linked: figure 7.  Both with the background's lines.
        edges_reconstructed: [H W] bool, the reconstruction without them.
        edges: [H W] bool, the edges after linking: the former, what the depth admitted, and every
            link between two of them or from one of them to the border, and the walls' feet.
        links: [H W] bool, pixels of ``edges`` that links added.
        lines: [H W] bool, edges and lines on the background: what bounds regions.
        step, value: [H W], each pixel's story; ``step >= Step.LOW`` are the edges.
        creases: [H W] bool, pixels that the depth alone admitted.
        depth: the depth's evidence, away from edges only; None without depth.
        feet: [H W] bool, pixels of ``edges`` that walls added.
        walls: upright walls that depth alone shows; None without a measured table or a camera.
    """

    reconstruction: Reconstruction
    linked: Linked
    edges_reconstructed: Bool
    edges: Bool
    links: Bool
    lines: Bool
    step: NDArray[np.uint8]
    value: F32
    creases: Bool
    depth: DepthEdges | None
    feet: Bool
    walls: Walls | None


def link_edges(
    given: StackResult,
    depth: np.ndarray | None = None,
    camera: Camera | None = None,
    *,
    min_length: float = 4.0,
    min_weight: float = 12.0,
    windows: tuple[float, ...] = (3.0, 6.0, 9.0, 12.0, 15.0),
    reach: float = 5.0,
    lateral: float = 2.0,
    cone_deg: float = 50.0,
    turn: float = 2.0,
    facing: float = 1.5,
    max_cost: float = 18.0,
    use_evidence: bool = True,
    evidence_half: float = 0.5,
    corners: float = 9.0,
    least_evidence: float = 1.0,
    border: bool = True,
    use_depth: bool = True,
    crease_clearance: float = 8.0,
    crease_length: float = 6.0,
    wall_area: float = 24.0,
) -> LinkedResult:
    """Reconstruct (4.1), link (4.2), and let the depth close what is left.

    The depth's ridges are let in only ``crease_clearance`` pixels and more away from every edge
    so far, since the intensity tells better where an edge is, and only in segments of
    ``crease_length`` pixels (both at 256²); then their ends are linked as other ends are.
    With the camera's intrinsics and a depth in metres, upright walls of ``wall_area`` pixels and
    more (at 256²) are found under the faces that lie above the table
    (:mod:`edges.walls`), and their feet drawn; 0 looks for none.
    For the other parameters see :func:`edges.linking.reconstruct` and
    :func:`edges.linking.link`.
    """
    stack = given.stack
    done = reconstruct(
        stack.edges_low, stack.edges_medium, stack.edges_high, stack.strength, given.gradient.thin,
        stack.segment_peak, min_length, min_weight, max(stack.low_threshold, 1e-6),
    )  # fmt: skip
    evidence = None
    if use_evidence:
        noise = given.noise if given.noise is not None else np.float32(1)
        evidence = (given.gradient.gx / noise, given.gradient.gy / noise)
    how: Mapping[str, Any] = {
        "evidence": evidence, "reach": reach, "lateral": lateral, "cone_deg": cone_deg,
        "turn": turn, "facing": facing, "max_cost": max_cost, "evidence_half": evidence_half,
        "border": border, "corners": corners, "least_evidence": least_evidence,
    }  # fmt: skip
    linked = link(done.edges, done.step, done.value, windows=windows, **how)
    creases = np.zeros(linked.edges.shape, np.bool_)
    found = None
    if use_depth and depth is not None:
        creases, found = _clear_ridges(linked.edges, depth, crease_clearance, crease_length)
    if found is not None and creases.any():
        step, value = linked.step.copy(), linked.value.copy()
        step[creases] = Step.CREASE
        value[creases] = found.strength[creases]
        wide = tuple(w for w in windows if w > min(windows)) or windows
        second = link(linked.edges | creases, step, value, windows=wide, **how)
        a, b = linked.links, second.links
        linked = replace(
            second,
            links_drawn=linked.links_drawn | second.links_drawn,
            links=Links(
                np.concatenate([a.start, b.start]),
                np.concatenate([a.end, b.end]),
                np.concatenate([a.cost, b.cost]),
                np.concatenate([a.round, b.round + len(windows)]),
                np.concatenate([a.border, b.border]),
            ),
            terminators=linked.terminators,
            directions=linked.directions,
        )
    start = done.edges & ~given.background
    if given.background.any():
        edges = _without_background(start, creases, linked.links, len(windows))
    else:
        edges = linked.edges
    step, value = linked.step.copy(), linked.value.copy()
    left_out = linked.edges & ~edges
    step[left_out] = Step.BACKGROUND
    value[left_out] = given.gradient.bright[left_out]
    links = edges & ~start & ~creases
    lines = linked.edges
    walls = None
    if use_depth and depth is not None and camera is not None and wall_area > 0:
        levels = given.gradient.levels
        labels = closed_regions(lines, levels, given.gradient)
        walls = upright_walls(
            labels, levels, depth, camera, distance_to_border(labels), least_area=wall_area
        )
    feet = np.zeros(edges.shape, np.bool_)
    if walls is not None:
        feet = walls.foot & ~edges
        step[feet] = Step.FOOT
        value[feet] = walls.height_m[feet]
        edges, lines = edges | feet, lines | feet
    return LinkedResult(
        done, linked, start, edges, links, lines, step, value, creases, found, feet, walls
    )


@njit(cache=True, nogil=True)
def _keep_links(edges, before, start, end, border, first, last):
    """Draw the links first..last whose ends are edges of ``before`` into ``edges``."""
    for i in range(first, last):
        x0, y0 = start[i]
        x1, y1 = end[i]
        if not before[y0, x0] or not (border[i] or before[y1, x1]):
            continue
        sx = 1 if x1 >= x0 else -1
        sy = 1 if y1 >= y0 else -1
        ax = abs(x1 - x0)
        ay = abs(y1 - y0)
        major = max(ax, ay)
        minor = min(ax, ay)
        for k in range(major + 1):
            o = path_offset(k, major, minor) if major > 0 else 0
            if ax >= ay:
                edges[y0 + sy * o, x0 + sx * k] = True
            else:
                edges[y0 + sy * k, x0 + sx * o] = True


def _without_background(start: Bool, creases: Bool, links: Links, first_pass: int) -> Bool:
    """``start``, the creases, and the links that join two edges, round by round.

    A link is an edge if both its ends are: so every link that is left still touches both.
    """
    edges = start.copy()
    rounds = links.round
    for number in range(int(rounds.max(initial=-1)) + 1):
        if number == first_pass:
            edges |= creases
        first, last = np.searchsorted(rounds, [number, number + 1])
        _keep_links(
            edges, edges.copy(), links.start, links.end, links.border, int(first), int(last)
        )
    return edges | creases


def _clear_ridges(
    edges: Bool, depth: np.ndarray, clearance: float, length: float
) -> tuple[Bool, DepthEdges | None]:
    """Ridges of the depth's evidence that keep clear of every edge and are long enough."""
    none = np.zeros(edges.shape, np.bool_)
    scale = max(image_scale(edges.shape), 1.0)
    # Chamfer distances are whole numbers inside, within 2 % of Euclid's, and a fifth the work.
    away = cv2.distanceTransform((~edges).view(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    if not edges.any():
        away = np.full_like(away, np.inf)
    # A ridge is the greatest within its reach, so that much more is looked at.
    found = depth_edges(depth, away > max(clearance - RIDGE_REACH, 0.0) * scale)
    if found is None:
        return none, None
    clear = found.thin & (away > clearance * scale)
    if not clear.any():
        return none, found
    _, labels, stats, _ = cv2.connectedComponentsWithStatsWithAlgorithm(
        np.ascontiguousarray(clear).view(np.uint8), 8, cv2.CV_32S, cv2.CCL_SAUF
    )
    long = stats[:, cv2.CC_STAT_AREA] >= length * scale
    long[0] = False
    return long[labels], found


def segment(
    image: np.ndarray,
    depth: np.ndarray | None = None,
    preset: str = "default",
    camera: Camera | None = None,
) -> tuple[StackResult, LinkedResult, I32]:
    """From an image (and its depth) to labels [H W] int32 with one of :data:`PRESETS`."""
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}: expected one of {', '.join(PRESETS)}")
    chosen = PRESETS[preset]
    stacked = stack_edges(image, depth, **chosen["edge_stack"])
    linked = link_edges(stacked, depth, camera, **chosen["linked_edges"])
    walls = None if linked.walls is None else linked.walls.labels
    labels = closed_regions(
        linked.lines, image, stacked.gradient, walls, **chosen["region_features"]
    )
    return stacked, linked, labels

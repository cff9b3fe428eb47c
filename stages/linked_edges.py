"""Stage ``linked_edges``: sequential reconstruction (4.1) and linking from terminators (4.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workbench.stage import (
    Finding,
    Inputs,
    Logged,
    Outputs,
    Score,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
    DEPTH,
    DIRECTIONS,
    EDGE_CHOICE,
    EDGE_STEP,
    EDGE_VALUE,
    EDGES_LINKED,
    EDGES_RECONSTRUCTED,
    LINKING,
    LINKS,
    NEAR_CAMERA,
    REGION_LINES,
    RELATIVE,
    TERMINATORS,
)
from .edges.presets import PRESETS

_FIRST_WINDOW_PX = 3.0
_WINDOW_STEP_PX = 3.0


class LinkedEdges(Stage):
    """Puts the stack together from coarse to fine, losing noise at each iteration, then bridges
    the gaps from the ends of lines.

    Every pixel carries which step admitted or rejected it (``edge_step``, the numbers of
    ``edges.linking.Step``) and the value by which it did (``edge_value``).  ``paper``
    links terminators by geometry alone; ``default`` also weighs what the gradient says along the
    link, lets corners link as ends do, and lets depth steps and creases close what intensity
    cannot.
    """

    name = "linked_edges"
    chapter = "segmentation"
    published_time = "about 500, Pentium 133"
    needs = (EDGE_CHOICE, DEPTH.optional(), RELATIVE.optional(), NEAR_CAMERA)
    gives = (
        EDGES_RECONSTRUCTED,
        TERMINATORS,
        DIRECTIONS,
        LINKS,
        EDGES_LINKED,
        REGION_LINES,
        EDGE_STEP,
        EDGE_VALUE,
        LINKING,
    )

    class Parameters(StageParameters):
        min_length: float = knob(
            4.0,
            "A segment that is not connected is kept if it is longer than this.",
            low=0,
            high=50,
            step=1,
            unit="px at 256²",
        )
        min_weight: float = knob(
            12.0,
            "And if it weighs more than this, each pixel by its strength over the low threshold "
            "(3 at most): short and faint is noise. 0 weighs nothing.",
            low=0,
            high=100,
            step=1,
            unit="px at 256²",
        )
        reach: float = knob(
            15.0,
            "The farthest that an end looks for a partner; nearer partners are tried first.",
            low=3,
            high=60,
            step=3,
            unit="px at 256²",
        )
        direction_length: float = knob(
            5.0,
            "Length of line behind an end that its direction is taken from.",
            low=2,
            high=20,
            step=1,
            unit="px at 256²",
        )
        cone_deg: float = knob(
            50.0,
            "Half angle of the wedge before an end in which a partner may lie.",
            low=5,
            high=85,
            step=1,
            unit="deg",
        )
        lateral: float = knob(
            2.0,
            "Half width of that wedge at the end itself: what a pixel grid may hide.",
            low=0,
            high=10,
            step=0.5,
            unit="px",
        )
        turn: float = knob(
            2.0,
            "How much a turn at either end of a link costs, against its length.",
            low=0,
            high=20,
            step=0.1,
            unit="factor",
        )
        facing: float = knob(
            1.5,
            "Factor on the cost of a link to something else than another end.",
            low=1,
            high=10,
            step=0.1,
            unit="factor",
        )
        max_cost: float = knob(
            18.0,
            "Links that cost more are not drawn.",
            low=1,
            high=200,
            step=1,
            unit="px at 256²",
        )
        use_evidence: bool = knob(
            True,
            "Make links cheaper along which the gradient, averaged with its sign, is an edge's.",
        )
        evidence_half: float = knob(
            0.5,
            "Mean gradient along a link that halves its cost.",
            low=0.05,
            high=10,
            step=0.05,
            unit="σ of the noise",
        )
        corners: float = knob(
            9.0,
            "In windows up to this, sharp corners look for partners as ends do, for where three "
            "surfaces meet an operator rounds two lines into one. 0 links ends alone.",
            low=0,
            high=60,
            step=1,
            unit="px at 256²",
        )
        least_evidence: float = knob(
            1.0,
            "What a corner's link needs along its path.",
            low=0,
            high=10,
            step=0.1,
            unit="σ of the noise",
        )
        border: bool = knob(True, "Link to the image's border too, where objects are cut off.")
        use_depth: bool = knob(True, "Let depth steps and creases close what the intensity cannot.")
        crease_clearance: float = knob(
            8.0,
            "The depth draws lines only this far from every edge, which knows better where it is.",
            low=0,
            high=50,
            step=1,
            unit="px at 256²",
        )
        crease_length: float = knob(
            6.0, "And only lines at least this long.", low=1, high=50, step=1, unit="px at 256²"
        )
        wall_area: float = knob(
            24.0,
            "Under a face that the depth shows above the table, upright walls of this size are "
            "drawn that neither intensity nor depth can show. 0 draws none.",
            low=0,
            high=1000,
            step=1,
            unit="px at 256²",
        )

    presets = {"paper": PRESETS["paper"]["linked_edges"]}

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from .edges.inputs import best_depth
        from .edges.segmentation import link_edges

        values = parameters.model_dump()
        reach, direction_length = values.pop("reach"), values.pop("direction_length")
        depth, camera = best_depth(inputs)
        result = link_edges(
            inputs["edge_choice"],
            depth,
            camera,
            windows=windows_up_to(reach),
            reach=direction_length,
            **values,
        )
        return {
            "edges_reconstructed": result.edges_reconstructed,
            "terminators": result.linked.terminators,
            "terminator_directions": result.linked.directions,
            "links": result.links,
            "edges_linked": result.edges,
            "region_lines": result.lines,
            "edge_step": result.step,
            "edge_value": result.value,
            "linking": result,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from .show import edge_image, linked_image

        artifacts = logged.artifacts
        done = artifacts["linking"].reconstruction
        recording.log("linked_edges/6a", edge_image(done.difference_medium))
        recording.log("linked_edges/6b", edge_image(done.first))
        recording.log("linked_edges/6c", edge_image(done.difference_high))
        recording.log("linked_edges/6d", edge_image(done.edges))
        recording.log(
            "linked_edges/linked", linked_image(artifacts["edge_step"], artifacts["region_lines"])
        )
        recording.log(
            "linked_edges/linked/terminators",
            rr.Arrows2D(
                origins=artifacts["terminators"],
                vectors=artifacts["terminator_directions"] * 6,
                colors=(90, 220, 120),
                radii=0.35,
            ),
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [
            rrb.Vertical(
                rrb.Spatial2DView(origin="linked_edges/6a", name="6a medium less low"),
                rrb.Spatial2DView(origin="linked_edges/6b", name="6b first iteration"),
                name="reconstruction",
            ),
            rrb.Vertical(
                rrb.Spatial2DView(origin="linked_edges/6c", name="6c high less 6b"),
                rrb.Spatial2DView(origin="linked_edges/6d", name="6d reconstructed"),
                name="reconstruction, second iteration",
            ),
            rrb.Spatial2DView(
                origin="linked_edges/linked",
                name="7 links orange, by depth blue, shadows grey, ends green",
            ),
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        from .edges.stories import linking_story, nearest_end

        edge, line = bool(artifacts["edges_linked"][y, x]), bool(artifacts["region_lines"][y, x])
        verdict = "edge" if edge else "line on the background" if line else "no edge"
        told = linking_story(x, y, artifacts["edge_choice"], artifacts["linking"], p)
        values = {
            name: artifacts[name][y, x]
            for name in ("edge_step", "edge_value", "edges_reconstructed", "links", "edges_linked")
        }
        findings = [Finding(clause.says, clause.values, clause.parameter) for clause in told[:-1]]
        if not line:
            ending = nearest_end(x, y, artifacts["linking"].linked, p)
            if ending is not None:
                findings.append(Finding(ending.says, ending.values, ending.parameter))
        last = told[-1]
        findings.append(Finding(last.says, {**values, **last.values}, last.parameter, verdict))
        return findings

    def scorer(self) -> Scorer:
        from .edges.scorers import EdgeScorer

        return EdgeScorer({"edges_reconstructed": "reconstructed", "edges_linked": "linked"})

    def figures(self, artifacts: Mapping[str, Any]) -> list[Score]:
        ends = len(artifacts["terminators"])
        if not ends:
            return []
        left = len(artifacts["linking"].linked.open_ends)
        return [Score("linked terminators", 1 - left / ends, better="higher")]

    def picture(self, artifacts: Mapping[str, Any]) -> Any:
        from .pictures import linked_rgb

        return linked_rgb(artifacts["edge_step"], artifacts["region_lines"])


def windows_up_to(reach_px: float) -> tuple[float, ...]:
    """The radii in which partners are looked for, one after the other, up to ``reach_px``."""
    windows = []
    window = _FIRST_WINDOW_PX
    while window < reach_px:
        windows.append(window)
        window += _WINDOW_STEP_PX
    return (*windows, max(reach_px, 2.0))

"""Lesson: reconstruction and linking (sections 4.1 and 4.2)."""

from __future__ import annotations

from typing import Any

from workbench.pipeline import Run
from workbench.stage import Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from ..artifacts import (
    DIRECTIONS,
    EDGE_STEP,
    EDGES_RECONSTRUCTED,
    INTENSITY,
    LABELS,
    LINKS,
    REGION_LINES,
    REGIONS,
    TERMINATORS,
)
from ..edge_stack import EdgeStackStage
from ..edges.presets import PRESETS
from ..linked_edges import LinkedEdges
from ..region_features import RegionFeatures
from ..registration import Registration
from .scene import SCENE, addressed

TEXT = """
A region can be measured only if its border is **closed**. Two steps close it.

*Reconstruction* (4.1) starts from the low resolution image and adds, from the finer ones, what is
connected to it or long enough (`min_length`). Noise is neither, and is dropped at each step.

*Linking* (4.2) looks at the **terminators**, the pixels where a line ends. Each has a direction,
that of the line behind it (green arrows), and looks for a partner in a wedge before it, no farther
than `reach`. If one is found, the gap is bridged with Bresenham's line (orange).

What remains open is lost as a region. One gap too many joins two faces to one; one link too many
cuts a face in two.
"""


def _regions(run: Run) -> float:
    return float(len(run.artifacts["regions"]))


def _ends(run: Run) -> float:
    return float(len(run.artifacts["terminators"]))


def _reconstructed_px(run: Run) -> float:
    return float(run.artifacts["edges_reconstructed"].sum())


class LinkPictures(Stage):
    """Figures 6 d and 7 and the regions that they close, large."""

    name = "link_pictures"
    needs = (
        INTENSITY,
        EDGES_RECONSTRUCTED,
        TERMINATORS,
        DIRECTIONS,
        LINKS,
        EDGE_STEP,
        REGION_LINES,
        LABELS,
        REGIONS,
    )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        return {}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from ..show import edge_image, grey_image, linked_image
        from .charts import INK, log_texts

        artifacts = logged.artifacts
        ends = artifacts["terminators"]
        recording.log(f"{self.name}/intensity", grey_image(artifacts["intensity"]))
        recording.log(f"{self.name}/reconstructed", edge_image(artifacts["edges_reconstructed"]))
        recording.log(
            f"{self.name}/linked",
            linked_image(artifacts["edge_step"], artifacts["region_lines"]),
        )
        recording.log(
            f"{self.name}/linked/ends",
            rr.Arrows2D(
                origins=ends,
                vectors=artifacts["terminator_directions"] * 7,
                colors=(90, 220, 120),
                radii=0.4,
            ),
        )
        recording.log(
            f"{self.name}/regions",
            rr.SegmentationImage(artifacts["labels"].astype("uint16")),
        )
        counts = {
            "reconstructed": f"{int(artifacts['edges_reconstructed'].sum())} edge pixels",
            "linked": f"{len(ends)} ends, {int(artifacts['links'].sum())} pixels of links",
            "regions": f"{len(artifacts['regions'])} closed regions",
        }
        for name, says in counts.items():
            log_texts(recording, f"{self.name}/{name}/says", [((128, 2), says, INK)])

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import picture_view

        return [
            rrb.Horizontal(
                rrb.Vertical(
                    picture_view(f"{self.name}/intensity", "the image"),
                    picture_view(f"{self.name}/reconstructed", "reconstructed"),
                    picture_view(f"{self.name}/regions", "closed regions"),
                ),
                picture_view(f"{self.name}/linked", "links orange, ends green"),
                column_shares=[1, 2.2],
            )
        ]


LESSON = Lesson(
    number=13,
    name="linking",
    title="Bridging the gaps between ends of lines",
    paper="sections 4.1 and 4.2, figures 6 and 7",
    text=TEXT,
    stages=(Registration, EdgeStackStage, LinkedEdges, RegionFeatures, LinkPictures),
    knobs=("linked_edges.reach", "linked_edges.min_length", "edge_stack.max_ratio"),
    shows=("link_pictures",),
    settings=addressed(
        {stage: PRESETS["paper"][stage] for stage in ("edge_stack", "linked_edges")}
    ),
    recording=SCENE,
    frame=5,
    claims=(
        Claim(
            "Shorten the `reach` from 15 to 3 pixels: gaps stay open, faces run into one another, "
            "and fewer than half of the closed regions are left.",
            {"linked_edges.reach": 15.0},
            {"linked_edges.reach": 3.0},
            "closed regions",
            "",
            _regions,
            lambda before, after: after < 0.5 * before,
        ),
        Claim(
            "Ask for segments of 40 pixels instead of 4 (`min_length`): short pieces of true edges "
            "are dropped with the noise.",
            {"linked_edges.min_length": 4.0},
            {"linked_edges.min_length": 40.0},
            "edge pixels after reconstruction",
            "px",
            _reconstructed_px,
            lambda before, after: after < 0.97 * before,
        ),
        Claim(
            "Let noise into the stack, `max_ratio` from 0.05 to 0.5: every speck has ends of its "
            "own, three times as many, and they are linked to cobwebs.",
            {"edge_stack.max_ratio": 0.05},
            {"edge_stack.max_ratio": 0.5},
            "ends of lines",
            "",
            _ends,
            lambda before, after: after > 3 * before,
        ),
    ),
)

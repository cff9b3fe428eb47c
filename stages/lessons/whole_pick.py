"""Lesson: from a pair of images to a pick, all stages (sections 3 to 6)."""

from __future__ import annotations

from typing import Any

from workbench.pipeline import Run
from workbench.stage import Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from ..artifacts import (
    CALIBRATION,
    CANDIDATES,
    DEPTH,
    INTENSITY,
    LABELS,
    MODELS,
    NEAR_CAMERA,
    POSES,
    REGION_LINES,
    REGIONS,
    VERDICT,
)
from ..depth_cloud import DepthCloud
from ..edge_stack import EdgeStackStage
from ..focus_maps import FocusMaps
from ..linked_edges import LinkedEdges
from ..pose_frames import PoseFrames
from ..recognition import Recognition
from ..region_features import RegionFeatures
from ..registration import Registration
from .scene import SCENE

TEXT = """
Everything together: two images and a flat one go in, a grasp comes out.

1. **Depth** from the ratio of the two focus maps (lessons 1 to 11).
2. **Edges**, linked, close the **regions** (lessons 12 and 13).
3. Each region's area, perimeter, shape factor and greatest distance are compared with those of the
   trained parts (equations 4 to 7): the distance must be under φ. The number on each outline is its
   height above the table in millimetres.
4. A region with a neighbour above it along its border is **occluded** (*Occ*, red): what it shows
   is only a part of it. Of those that are left and match, the **highest** is picked (green): it
   lies on the pile, and the gripper can reach it.
5. Its rotation comes from the **eigenspace** (lesson 14), the other two turns from the normal of
   the plane through its depth, the place from its centroid: the axes are drawn on it.

If nothing matches, the honest answer is *rearrange*: stir the pile and look again.
"""


def _picks(run: Run) -> float:
    return float(len(run.artifacts["poses"]))


def _occluded(run: Run) -> float:
    candidates = run.artifacts["candidates"]
    # Without any depth there is no verdict, and a candidate has no such field.
    return float(candidates["occluded"].sum()) if len(candidates) else 0.0


def _known(run: Run) -> float:
    import numpy as np

    return 100 * float(np.isfinite(run.artifacts["depth_m"]).mean())


class PickPictures(Stage):
    """Depth, lines, candidates and the pose, large."""

    name = "pick_pictures"
    needs = (
        INTENSITY,
        DEPTH,
        REGION_LINES,
        LABELS,
        REGIONS,
        CANDIDATES,
        VERDICT,
        POSES,
        NEAR_CAMERA,
        MODELS,
        CALIBRATION,
    )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        return {}

    def log(self, recording: Any, logged: Logged) -> None:
        import numpy as np
        import rerun as rr

        from ..matching.pose import outline_m, project
        from ..matching.show import (
            AXIS_COLOURS,
            MODEL_COLOUR,
            axes_of,
            candidate_marks,
            region_outlines,
        )
        from ..show import edge_image, grey_image, log_map
        from .charts import BAD_COLOUR, GOOD_COLOUR, log_texts

        artifacts = logged.artifacts
        calibration, database = artifacts["calibration"], artifacts["models"]
        grey = grey_image(artifacts["intensity"])
        low, high = calibration.near_z_m, calibration.far_z_m
        log_map(
            recording, f"{self.name}/depth", artifacts["depth_m"], low, high, "turbo",
            (f"{1e3 * low:.0f} mm", f"{500 * (low + high):.0f} mm", f"{1e3 * high:.0f} mm"),
        )  # fmt: skip
        recording.log(f"{self.name}/lines", edge_image(artifacts["region_lines"]))
        recording.log(f"{self.name}/candidates", grey)
        candidates = artifacts["candidates"]
        strips: list[Any] = []
        colours: list[Any] = []
        if len(candidates):
            strips, colours = region_outlines(artifacts["labels"], candidates)
        recording.log(
            f"{self.name}/candidates/outlines",
            rr.LineStrips2D(strips, colors=colours, radii=0.7),
        )
        places: list[Any] = []
        texts: list[str] = []
        if len(candidates):
            places, texts, colours = candidate_marks(candidates, artifacts["regions"], database)
        recording.log(
            f"{self.name}/candidates/marks",
            rr.Points2D(places, labels=texts, colors=colours, radii=1.5, show_labels=True),
        )
        recording.log(f"{self.name}/pose", grey)
        K = artifacts["near_camera"].K
        outlines, axes = [], []
        for pose in artifacts["poses"]:
            part = database.parts[database.names.index(pose["object"])]
            outlines.append(project(outline_m(pose, part, database.mm_per_px), K))
            axes += [project(np.array(line), K) for line in axes_of(pose)]
        recording.log(
            f"{self.name}/pose/outline", rr.LineStrips2D(outlines, colors=MODEL_COLOUR, radii=0.8)
        )
        recording.log(
            f"{self.name}/pose/axes",
            rr.LineStrips2D(axes, colors=list(AXIS_COLOURS) * len(artifacts["poses"]), radii=1.4),
        )
        says, colour = "rearrange", BAD_COLOUR
        for pose in artifacts["poses"]:
            says, colour = f"pick {pose['object']}, {pose['rotation_deg']:.1f}°", GOOD_COLOUR
        log_texts(recording, f"{self.name}/pose/says", [((128, 2), says, colour)])

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import picture_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Vertical(
                rrb.Horizontal(
                    map_view(f"{self.name}/depth", "1. depth (grey: unknown)", shape),
                    picture_view(f"{self.name}/lines", "2. lines that bound regions"),
                ),
                rrb.Horizontal(
                    picture_view(
                        f"{self.name}/candidates", "3, 4. candidates: green picked, red occluded"
                    ),
                    picture_view(f"{self.name}/pose", "5. the verdict and the pose"),
                ),
            )
        ]


LESSON = Lesson(
    number=15,
    name="whole-pick",
    title="A whole pick",
    paper="sections 3 to 6, figures 8, 9 and 11",
    text=TEXT,
    stages=(
        Registration,
        FocusMaps,
        DepthCloud,
        EdgeStackStage,
        LinkedEdges,
        RegionFeatures,
        Recognition,
        PoseFrames,
        PickPictures,
    ),
    knobs=(
        "recognition.phi_scale",
        "recognition.covered_share",
        "depth_cloud.min_confidence",
    ),
    shows=("pick_pictures",),
    settings={},
    recording=SCENE,
    frame=9,
    claims=(
        Claim(
            "Be stricter about what counts as a part, `phi_scale` from 1 to 0.1: nothing is under "
            "φ any more, and the verdict turns from pick to rearrange.",
            {"recognition.phi_scale": 1.0},
            {"recognition.phi_scale": 0.1},
            "poses",
            "",
            _picks,
            lambda before, after: (before, after) == (1, 0),
        ),
        Claim(
            "Do not mind neighbours that lie above, `covered_share` from 0.06 to 1: no region is "
            "marked Occ any more, and covered parts compete with the one on top.",
            {"recognition.covered_share": 0.06},
            {"recognition.covered_share": 1.0},
            "occluded candidates",
            "",
            _occluded,
            lambda before, after: before > 0 and after == 0,
        ),
        Claim(
            "Trust only the best of the depth, `min_confidence` from 0.5 to 0.9: large parts of "
            "the picture become unknown.",
            {"depth_cloud.min_confidence": 0.5},
            {"depth_cloud.min_confidence": 0.9},
            "pixels with a depth",
            "%",
            _known,
            lambda before, after: after < before - 10,
        ),
    ),
)

"""Lesson: why a textureless part needs projected light (section 3.1)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.pipeline import Run
from workbench.stage import Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from ..artifacts import CONFIDENCE, DEPTH, FOCUS_FAR, FOCUS_NEAR
from ..depth_cloud import DepthCloud
from ..focus_maps import FocusMaps
from ..registration import Registration
from .sensor import (
    FAR_GIVEN,
    NEAR_GIVEN,
    CalibrationPlanes,
    Optics,
    Plane,
)

TEXT = """
Blur can be measured only on something that can be blurred. A sheet of white paper looks the same in
focus and out of it: nothing in it has high frequencies. *Passive* depth from defocus fails on
exactly the parts that factories make: plain, machined, textureless.

So light with a pattern is projected onto the scene (*active* depth from defocus). The stripes give
every surface the same strong, known texture at one frequency, chosen where blur tells most.

Turn `plane.pattern` to 0: the projector becomes a plain lamp. The focus maps fall to what noise
gives, the confidence to nothing, and the depth is *unknown* (grey), which is the honest answer.

Then print something on the plane (`plane.texture`): there is something to blur again, and the focus
maps wake up, patchily. *Passive* depth from defocus works with that. This sensor, calibrated on its
own stripes, still refuses: a contrast that it does not know could be any depth.
"""

_TRUE_RANGE_M = (0.700, 0.806)


class LightPictures(Stage):
    """The near image, its focus map, depth and confidence."""

    name = "light_pictures"
    needs = (NEAR_GIVEN, FAR_GIVEN, FOCUS_NEAR, FOCUS_FAR, DEPTH, CONFIDENCE)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        return {}

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image, log_map
        from .charts import INK, log_texts

        artifacts = logged.artifacts
        for channel in ("near", "far"):
            recording.log(f"{self.name}/{channel}", grey_image(artifacts[f"{channel}_image"], 160))
        log_map(
            recording, f"{self.name}/focus", artifacts["focus_near"], 0, 30, "magma",
            ("0", "15", "30"),
        )  # fmt: skip
        depth = artifacts["depth_m"]
        log_map(
            recording, f"{self.name}/depth", depth, *_TRUE_RANGE_M, "turbo",
            ("700 mm", "753 mm", "806 mm"),
        )  # fmt: skip
        log_map(
            recording, f"{self.name}/confidence", artifacts["confidence"], 0, 1, "viridis",
            ("0", "0.5", "1"),
        )  # fmt: skip
        known = np.isfinite(depth)
        says = f"{100 * known.mean():.0f} % known"
        if known.any():
            says += f", {1e3 * float(np.median(depth[known])):.1f} mm"
        log_texts(recording, f"{self.name}/depth/says", [((50, 3), says, INK)])

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import picture_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Vertical(
                rrb.Horizontal(
                    picture_view(f"{self.name}/near", "near image"),
                    picture_view(f"{self.name}/far", "far image"),
                    map_view(f"{self.name}/focus", "focus map, near (grey levels)", shape),
                ),
                rrb.Horizontal(
                    map_view(f"{self.name}/depth", "depth (grey: unknown)", shape),
                    map_view(f"{self.name}/confidence", "confidence", shape),
                ),
            )
        ]


def _known(run: Run) -> float:
    return 100 * float(np.isfinite(run.artifacts["depth_m"]).mean())


def _confidence(run: Run) -> float:
    return float(np.median(run.artifacts["confidence"]))


def _focus(run: Run) -> float:
    return float(run.artifacts["focus_near"].mean())


LESSON = Lesson(
    number=4,
    name="projected-light",
    title="A textureless part needs projected light",
    paper="section 3.1, end; section 3.2",
    text=TEXT,
    stages=(Optics, Plane, CalibrationPlanes, Registration, FocusMaps, DepthCloud, LightPictures),
    knobs=("plane.pattern", "plane.texture", "plane.distance_mm"),
    shows=("light_pictures",),
    settings={},
    claims=(
        Claim(
            "Turn the pattern off, 1 to 0: from a depth nearly everywhere to a depth nearly "
            "nowhere.",
            {"plane.pattern": 1.0},
            {"plane.pattern": 0.0},
            "pixels with a depth",
            "%",
            _known,
            lambda before, after: before > 95 and after < 5,
        ),
        Claim(
            "The focus map says why: without a pattern there is a hundredth of the response left.",
            {"plane.pattern": 1.0},
            {"plane.pattern": 0.0},
            "focus measure, near",
            "grey levels",
            _focus,
            lambda before, after: after < 0.02 * before,
        ),
        Claim(
            "With the pattern off, print a texture on the plane, 0 to 0.5: the focus measure comes "
            "back, for there is something to blur again.",
            {"plane.pattern": 0.0, "plane.texture": 0.0},
            {"plane.pattern": 0.0, "plane.texture": 0.5},
            "focus measure, near",
            "grey levels",
            _focus,
            lambda before, after: after > 20 * before and after > 5,
        ),
    ),
)

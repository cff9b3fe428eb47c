"""Lesson: the stack of thresholds (section 4.1)."""

from __future__ import annotations

from typing import Any

from workbench.pipeline import Run
from workbench.stage import Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from ..artifacts import (
    EDGE_CHOICE,
    EDGES_HIGH,
    EDGES_LOW,
    EDGES_MEDIUM,
    GRADIENT,
    INTENSITY,
)
from ..edge_stack import EdgeStackStage
from ..edges.presets import PRESETS
from ..registration import Registration
from .scene import SCENE, addressed

TEXT = """
An edge operator gives a *gradient*; an edge image needs a *threshold*. Too high, and faint creases
between two faces are lost. Too low, and the sensor's noise is drawn as well. No value is right for
every picture, so section 4.1 lets the picture choose:

* The gradient is made **once**. Only thresholds are varied, never the scale of the filter.
* The **low threshold** starts at its least value and rises until the edge pixels in *small*
  segments (under 4 pixels: noise is short) are few against those in long ones. The chart shows
  that ratio over the threshold; the mark is where it first falls under the preset value.
* With the low threshold fixed, the **high threshold** of the hysteresis makes three images of low,
  medium and high *resolution*: figure 5 of the paper.

Each finer image contains the coarser one. Pixels in small segments are red: what you see of them in
the high resolution image is what the reconstruction has to throw away.
"""


def _low(run: Run) -> float:
    return float(run.artifacts["edge_choice"].stack.low_threshold)


def _noise_px(run: Run) -> float:
    import numpy as np

    stack = run.artifacts["edge_choice"].stack
    at = int(np.searchsorted(stack.thresholds, stack.low_threshold))
    return float(stack.small_pixels[at])


def _low_resolution_px(run: Run) -> float:
    return float(run.artifacts["edges_low"].sum())


class StackPictures(Stage):
    """Figure 5, with what is noise in red, and how the low threshold was found."""

    name = "stack_pictures"
    needs = (INTENSITY, GRADIENT, EDGES_LOW, EDGES_MEDIUM, EDGES_HIGH, EDGE_CHOICE)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        return {}

    def log(self, recording: Any, logged: Logged) -> None:
        import cv2
        import numpy as np
        import rerun as rr

        from ..show import grey_image
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            GOOD_COLOUR,
            INK,
            Axis,
            Curve,
            Mark,
            log_chart,
            log_texts,
            nice_ticks,
        )

        artifacts = logged.artifacts
        stack = artifacts["edge_choice"].stack
        recording.log(f"{self.name}/intensity", grey_image(artifacts["intensity"]))
        gradient = artifacts["gradient"]
        recording.log(
            f"{self.name}/gradient",
            rr.Image(cv2.convertScaleAbs(gradient, alpha=255 / np.percentile(gradient, 99))),
        )
        at = int(np.searchsorted(stack.thresholds, stack.low_threshold))
        for name in ("low", "medium", "high"):
            edges = artifacts[f"edges_{name}"]
            _, labels, stats, _ = cv2.connectedComponentsWithStats(
                edges.astype(np.uint8), connectivity=8
            )
            short = stats[labels, cv2.CC_STAT_AREA] < 4
            rgb = np.zeros((*edges.shape, 3), np.uint8)
            rgb[edges] = (235, 235, 235)
            rgb[edges & short] = BAD_COLOUR
            recording.log(f"{self.name}/{name}", rr.Image(rgb))
            noise = int((edges & short).sum())
            says = f"{int(edges.sum())} edge pixels, {noise} of them in small segments"
            log_texts(recording, f"{self.name}/{name}/says", [((128, 2), says, INK)])
        shown = stack.thresholds <= 10
        ratio = np.where(np.isfinite(stack.ratio), np.minimum(stack.ratio, 0.12), np.nan)
        log_chart(
            recording,
            f"{self.name}/ratio",
            Axis("threshold, grey levels", 0, 10, nice_ticks(0, 10)),
            Axis("pixels in small / in large segments", 0, 0.12, (0, 0.05, 0.1)),
            [Curve(stack.thresholds[shown], ratio[shown], "ratio", BOTH_COLOUR)],
            [
                Mark(
                    stack.low_threshold,
                    float(ratio[at]),
                    f"chosen: {stack.low_threshold:.1f}",
                    GOOD_COLOUR,
                )
            ],
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import chart_view, picture_view

        return [
            rrb.Vertical(
                rrb.Horizontal(
                    picture_view(f"{self.name}/intensity", "the image"),
                    picture_view(f"{self.name}/gradient", "its gradient, made once"),
                    chart_view(f"{self.name}/ratio", "how the low threshold is chosen"),
                ),
                rrb.Horizontal(
                    picture_view(f"{self.name}/low", "low resolution"),
                    picture_view(f"{self.name}/medium", "medium resolution"),
                    picture_view(f"{self.name}/high", "high resolution (red: small segments)"),
                ),
            )
        ]


LESSON = Lesson(
    number=12,
    name="threshold-stack",
    title="A stack of thresholds, chosen by the picture",
    paper="section 4.1, figure 5",
    text=TEXT,
    stages=(Registration, EdgeStackStage, StackPictures),
    knobs=("edge_stack.max_ratio", "edge_stack.greatest", "edge_stack.operator"),
    shows=("stack_pictures",),
    settings=addressed({"edge_stack": PRESETS["paper"]["edge_stack"]}),
    recording=SCENE,
    frame=5,
    claims=(
        Claim(
            "Allow more noise, `max_ratio` from 0.05 to 0.5: the low threshold falls, and the high "
            "resolution image fills with specks, more than twice as many red pixels.",
            {"edge_stack.max_ratio": 0.05},
            {"edge_stack.max_ratio": 0.5},
            "pixels in small segments",
            "px",
            _noise_px,
            lambda before, after: after > 2 * before,
        ),
        Claim(
            "Allow less, `max_ratio` from 0.05 to 0.005: the low threshold rises by more than a "
            "grey level, and with the noise some faint creases go.",
            {"edge_stack.max_ratio": 0.05},
            {"edge_stack.max_ratio": 0.005},
            "low threshold",
            "grey levels",
            _low,
            lambda before, after: after > before + 1,
        ),
        Claim(
            "Raise the `greatest` high threshold from 20 to 60: the low resolution image keeps "
            "only what somewhere has great contrast, a fifth less.",
            {"edge_stack.greatest": 20.0},
            {"edge_stack.greatest": 60.0},
            "edge pixels in the low resolution image",
            "px",
            _low_resolution_px,
            lambda before, after: after < 0.85 * before,
        ),
    ),
)

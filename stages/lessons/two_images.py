"""Lesson: why one image is not enough (section 3)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from .sensor import FAR_GIVEN, NEAR_GIVEN, RIG, Optics, Plane, ratio_over_distance

TEXT = """
If blur tells distance, why two images? Look at the near sensor alone (red curve). Its focus measure
has a top and falls on **both** sides of it: one value, two distances. The sign of *d* in equation 2
does not show in the picture. (The top lies a little beyond the near focal plane: the projector has
a focus of its own, at 750 mm, which counts for both images alike.)

And the value is not even certain: a darker part gives back less light, so its stripes are weaker
everywhere. Blurred, or just dark? One image cannot say.

The second sensor stands *b* = 0.8 mm nearer to the lens and is sharp elsewhere (blue). The ratio

    Q = (En - Ef) / (En + Ef)

falls steadily from one focal plane to the other: one value, one distance. What the part's albedo
does to both measures alike cancels in it.
"""

_RANGE_MM = (640.0, 880.0)


class TwoImages(Stage):
    """Both focus measures and their ratio, of the plane and over all distances."""

    name = "two_images"
    needs = (RIG, NEAR_GIVEN, FAR_GIVEN)
    gives = (
        Artifact("lesson_focus", doc="focus measures near and far, and their ratio"),
        Artifact("lesson_curves", "float64", "3 K", "", "the same over distance, at full light"),
    )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..dfd.focus import focus_map
        from ..dfd.stripes import whole_period_taps

        rig = inputs["rig"]
        taps = whole_period_taps(rig.period_px("near"))
        near, far = (
            float(focus_map(inputs[f"{channel}_image"], taps, taps)[25:-25, 25:-25].mean())
            for channel in ("near", "far")
        )
        return {
            "lesson_focus": {"near": near, "far": far, "ratio": (near - far) / (near + far)},
            "lesson_curves": ratio_over_distance(rig, _distances()),
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import grey_image
        from .charts import (
            BOTH_COLOUR,
            FAR_COLOUR,
            GOOD_COLOUR,
            INK,
            NEAR_COLOUR,
            Axis,
            Curve,
            Mark,
            log_chart,
            nice_ticks,
        )

        artifacts = logged.artifacts
        focus, curves, at = artifacts["lesson_focus"], artifacts["lesson_curves"], _distances()
        for channel in ("near", "far"):
            recording.log(f"{self.name}/{channel}", grey_image(artifacts[f"{channel}_image"], 160))
        top = 40.0
        level = focus["near"]
        crossings = [float(x) for x in _crossings(at, curves[0], level)]
        log_chart(
            recording,
            f"{self.name}/energy",
            Axis("distance u, mm", *_RANGE_MM, nice_ticks(*_RANGE_MM)),
            Axis("focus measure, grey levels", 0, top, (0, 10, 20, 30, 40)),
            [
                Curve(at, curves[0], "near, albedo 0.55", NEAR_COLOUR),
                Curve(at, curves[1], "far, albedo 0.55", FAR_COLOUR),
                Curve(_RANGE_MM, (level, level), "measured, near", INK, thin=True),
            ],
            [Mark(x, level, f"{x:.0f} mm?", BOTH_COLOUR) for x in crossings],
        )
        crossings = [float(x) for x in _crossings(at, curves[2], focus["ratio"])]
        inside = [x for x in crossings if 700 <= x <= 806.1]
        log_chart(
            recording,
            f"{self.name}/ratio",
            Axis("distance u, mm", *_RANGE_MM, nice_ticks(*_RANGE_MM)),
            Axis("ratio Q", -1, 1, (-1, 0, 1)),
            [
                Curve(at, curves[2], "ratio of both", BOTH_COLOUR),
                Curve(_RANGE_MM, (focus["ratio"],) * 2, "measured", INK, thin=True),
                Curve((700, 700), (-1, 1), "focal planes", GOOD_COLOUR, thin=True),
                Curve((806.1, 806.1), (-1, 1), "", GOOD_COLOUR, thin=True),
            ],
            [Mark(x, focus["ratio"], f"{x:.0f} mm", GOOD_COLOUR) for x in inside],
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import chart_view, picture_view

        return [
            rrb.Horizontal(
                rrb.Vertical(
                    picture_view(f"{self.name}/near", "near image"),
                    picture_view(f"{self.name}/far", "far image"),
                ),
                rrb.Vertical(
                    chart_view(f"{self.name}/energy", "each image alone: which distance?"),
                    chart_view(f"{self.name}/ratio", "both: one distance between the focal planes"),
                ),
                column_shares=[1, 2],
            )
        ]


def _distances() -> np.ndarray:
    return np.arange(_RANGE_MM[0], _RANGE_MM[1] + 1, 4)


def _crossings(x: np.ndarray, y: np.ndarray, level: float) -> np.ndarray:
    """Where the curve passes ``level``, linearly between its points."""
    above = y > level
    at = np.flatnonzero(above[1:] != above[:-1])
    return x[at] + (level - y[at]) / (y[at + 1] - y[at]) * (x[at + 1] - x[at])


def _focus(key: str) -> Any:
    return lambda run: float(run.artifacts["lesson_focus"][key])


LESSON = Lesson(
    number=3,
    name="two-images",
    title="Why one image is not enough",
    paper="section 3, after equation 2",
    text=TEXT,
    stages=(Optics, Plane, TwoImages),
    knobs=("plane.distance_mm", "plane.albedo", "plane.noise"),
    shows=("two_images",),
    settings={"plane.distance_mm": 736.0},
    claims=(
        Claim(
            "Move the plane from 692 to 736 mm: the near image's focus measure is the same within "
            "3 %. By it alone the two places cannot be told apart.",
            {"plane.distance_mm": 692.0},
            {"plane.distance_mm": 736.0},
            "focus measure, near",
            "grey levels",
            _focus("near"),
            lambda before, after: abs(after / before - 1) < 0.03,
        ),
        Claim(
            "The same move changes the ratio of both images by more than a half.",
            {"plane.distance_mm": 692.0},
            {"plane.distance_mm": 736.0},
            "ratio Q",
            "",
            _focus("ratio"),
            lambda before, after: before - after > 0.5,
        ),
        Claim(
            "Leave it at 736 mm and take a darker plane, albedo 0.55 to 0.3: the near measure "
            "falls by nearly half, as if the plane had moved.",
            {"plane.albedo": 0.55},
            {"plane.albedo": 0.3},
            "focus measure, near",
            "grey levels",
            _focus("near"),
            lambda before, after: 0.5 < after / before < 0.6,
        ),
        Claim(
            "The ratio does not care: it stays within 0.01.",
            {"plane.albedo": 0.55},
            {"plane.albedo": 0.3},
            "ratio Q",
            "",
            _focus("ratio"),
            lambda before, after: abs(after - before) < 0.01,
        ),
    ),
)

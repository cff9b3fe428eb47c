"""Lesson: from the ratio to a distance, and calibration (section 3.2)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.pipeline import Run
from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage
from workbench.teach import Claim, Lesson

from ..artifacts import DEPTH, FOCUS_FAR, FOCUS_NEAR
from ..depth_cloud import DepthCloud
from ..focus_maps import FocusMaps
from ..registration import Registration
from .sensor import (
    CALIBRATION_GIVEN,
    RIG,
    CalibrationPlanes,
    Optics,
    Plane,
    ratio_of,
    ratio_over_distance,
)

TEXT = """
The ratio Q of the two focus measures orders points by distance. *How far* they are it does not say:
that depends on aperture, stripes, pixels and on both lenses as they are, not as the catalogue has
them. So the sensor is **calibrated**, in two steps (section 3.2):

1. The two images are aligned, for the far sensor sees everything 1.2 % smaller. A dot grid shows
   it.
2. A white plane is shown at known distances, and **each pixel** gets a curve from its ratio to a
   distance. It is fitted in dioptres (1/u), in which the blur circle is linear (equation 2): there
   a low degree is enough.

The upper chart is that curve: the ratio that was seen at known distances, and the fit. Below is
what the curve makes of planes all over the range, against the truth.

A calibration belongs to **one** state of the sensor. Turn the lens's stop, `optics.f_number`,
without calibrating again, and every depth is wrong while nothing looks wrong.
"""

_AT = 61


class CurvePictures(Stage):
    """The calibrated curve and its errors over the working range."""

    name = "curve_pictures"
    needs = (RIG, CALIBRATION_GIVEN, FOCUS_NEAR, FOCUS_FAR, DEPTH)
    gives = (Artifact("lesson_curve", doc="distances, ratios, depths, measured ratio"),)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        rig, calibration = inputs["rig"], inputs["calibration"]
        distances = np.linspace(1e3 * calibration.near_z_m, 1e3 * calibration.far_z_m, _AT)
        ratios = ratio_over_distance(rig, distances)[2]
        curve = calibration.curve[:, 25:-25, 25:-25].mean(axis=(1, 2)).astype(float)
        relative = np.polynomial.polynomial.polyval(ratios, curve)
        measured = ratio_of(inputs["focus_near"], inputs["focus_far"])[25:-25, 25:-25]
        span = np.linspace(-1, 1, 101)
        fitted = np.polynomial.polynomial.polyval(span, curve)
        return {
            "lesson_curve": {
                "distances_mm": distances,
                "ratios": ratios,
                "depths_mm": 1e3 * calibration.z_m(relative).astype(float),
                "span": span,
                "span_mm": 1e3 * calibration.z_m(np.clip(fitted, -0.5, 1.5)).astype(float),
                "measured": float(measured.mean()),
            }
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from ..show import log_map
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            FAR_COLOUR,
            GOOD_COLOUR,
            INK,
            Axis,
            Curve,
            Mark,
            log_chart,
            nice_ticks,
        )

        artifacts = logged.artifacts
        curve = artifacts["lesson_curve"]
        low, high = 690.0, 816.0
        depth = artifacts["depth_m"]
        known = np.isfinite(depth)
        found = 1e3 * float(np.median(depth[known])) if known.any() else np.nan
        log_chart(
            recording,
            f"{self.name}/curve",
            Axis("ratio Q", -1, 1, (-1, -0.5, 0, 0.5, 1)),
            Axis("distance, mm", low, high, (700, 725, 750, 775, 800)),
            [
                Curve(curve["span"], curve["span_mm"], "calibrated curve", BOTH_COLOUR),
                Curve(curve["ratios"], curve["distances_mm"], "planes as they are", FAR_COLOUR,
                      thin=True),
                Curve((curve["measured"],) * 2, (low, high), "", INK, thin=True),
            ],
            [Mark(curve["measured"], found, f"this plane: {found:.1f} mm", GOOD_COLOUR)],
        )  # fmt: skip
        error = curve["depths_mm"] - curve["distances_mm"]
        top = next(
            t for t in (0.1, 0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 1e9) if np.abs(error).max() < t
        )
        worst = float(error[np.abs(error).argmax()])
        at = float(curve["distances_mm"][np.abs(error).argmax()])
        log_chart(
            recording,
            f"{self.name}/error",
            Axis("true distance, mm", low, high, nice_ticks(low, high)),
            Axis("measured less true, mm", -top, top, (-top, 0, top)),
            [
                Curve(curve["distances_mm"], error, "error", BAD_COLOUR),
                Curve((low, high), (0, 0), "", INK, thin=True),
            ],
            [Mark(at, worst, f"worst: {worst:+.2f} mm", BAD_COLOUR)],
        )
        log_map(
            recording, f"{self.name}/depth", depth, 0.7, 0.806, "turbo",
            ("700 mm", "753 mm", "806 mm"),
        )  # fmt: skip

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from ..show import map_view
        from .charts import chart_view

        shape = logged.artifacts["depth_m"].shape
        return [
            rrb.Vertical(
                rrb.Horizontal(
                    chart_view(f"{self.name}/curve", "step two: from the ratio to a distance"),
                    map_view(f"{self.name}/depth", "depth of this plane", shape),
                    column_shares=[2, 1],
                ),
                chart_view(f"{self.name}/error", "what the curve makes of planes in the range"),
            )
        ]


def _worst(run: Run) -> float:
    curve = run.artifacts["lesson_curve"]
    return float(np.abs(curve["depths_mm"] - curve["distances_mm"]).max())


def _depth(run: Run) -> float:
    depth = run.artifacts["depth_m"]
    known = np.isfinite(depth)
    return 1e3 * float(np.median(depth[known])) if known.any() else float("nan")


LESSON = Lesson(
    number=5,
    name="ratio-to-distance",
    title="From the ratio to a distance",
    paper="section 3.2, calibration",
    text=TEXT,
    stages=(Optics, Plane, CalibrationPlanes, Registration, FocusMaps, DepthCloud, CurvePictures),
    knobs=(
        "plane.distance_mm",
        "calibration_planes.degree",
        "calibration_planes.planes",
        "optics.f_number",
    ),
    shows=("curve_pictures",),
    settings={"depth_cloud.min_modulation": 0.0},
    claims=(
        Claim(
            "Move the plane from 720 to 780 mm: the depth follows to half a millimetre.",
            {"plane.distance_mm": 720.0},
            {"plane.distance_mm": 780.0},
            "depth",
            "mm",
            _depth,
            lambda before, after: abs(before - 720) < 0.5 and abs(after - 780) < 0.5,
        ),
        Claim(
            "Fit a straight line instead of a curve, `degree` 4 to 1: the worst error over the "
            "range grows more than threefold, and is still small, for in dioptres the ratio is "
            "nearly linear.",
            {"calibration_planes.degree": 4},
            {"calibration_planes.degree": 1},
            "worst error",
            "mm",
            _worst,
            lambda before, after: after > 3 * before,
        ),
        Claim(
            "Stop the lens down from f/2.8 to f/3.5 and do not calibrate again: errors of more "
            "than ten millimetres, and no picture that looks wrong.",
            {"optics.f_number": 2.8},
            {"optics.f_number": 3.5},
            "worst error",
            "mm",
            _worst,
            lambda before, after: before < 2 and after > 10,
        ),
    ),
)

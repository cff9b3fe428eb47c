"""Stage ``edge_stack``: one gradient, and hysteresis at a stack of thresholds (section 4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

from workbench.stage import (
    WARNINGS,
    Cut,
    Finding,
    Histogram,
    Inputs,
    Logged,
    Outputs,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
    DEPTH,
    EDGE_CHOICE,
    EDGES_HIGH,
    EDGES_LOW,
    EDGES_MEDIUM,
    FULL_SCALE,
    GRADIENT,
    INTENSITY,
    RELATIVE,
)
from .edges.presets import PRESETS


class EdgeStackStage(Stage):
    """The low threshold rises until few enough edge pixels lie in small segments; then the high
    one rises to the operator's greatest, which gives images of low, medium and high resolution.

    ``paper`` takes the GEF operator and thresholds in grey levels.  ``default`` takes Canny's
    gradient in standard deviations of its own noise, measured from the image.
    """

    name = "edge_stack"
    chapter = "segmentation"
    published_time = "545 (GEF) or 4900 (Canny), Pentium 133"
    needs = (INTENSITY, FULL_SCALE, DEPTH.optional(), RELATIVE.optional())
    gives = (GRADIENT, EDGES_LOW, EDGES_MEDIUM, EDGES_HIGH, EDGE_CHOICE)

    class Parameters(StageParameters):
        operator: Literal["canny", "gef"] = knob(
            "canny",
            "Canny's Gaussian derivative (σ = 1), or the ISEF-based GEF (a0 = 0.45).",
        )
        noise_units: bool = knob(
            True,
            "Thresholds in standard deviations of the gradient's noise, measured from the image, "
            "instead of grey levels of 8 bit.",
        )
        lowest: float = knob(
            2.0,
            "Where the search for the low threshold starts.",
            low=0.1,
            high=50,
            step=0.1,
            unit="grey levels, or σ of the noise",
        )
        greatest: float = knob(
            20.0,
            "The greatest high threshold: 20 for GEF on 8 bit.",
            low=1,
            high=255,
            step=1,
            unit="grey levels, or σ of the noise",
        )
        max_ratio: float = knob(
            0.015,
            "The low threshold is the least at which edge pixels in small segments are fewer "
            "than this share of those in large ones.",
            low=0.001,
            high=1,
            step=0.001,
            unit="small over large",
        )
        small_segment: float = knob(
            4.0,
            "Segments under this many pixels are small: mostly noise.",
            low=1,
            high=50,
            step=1,
            unit="px at 256²",
        )
        steps: int = knob(
            128,
            "Thresholds that the search tries; they cost nothing.",
            low=2,
            high=1024,
            step=1,
            unit="thresholds",
        )
        use_depth: bool = knob(
            True, "Let the depth tell lines on the background, which may be shadows, from edges."
        )
        depth_gain: float = knob(
            0.0,
            "How much a depth step or crease strengthens the gradient: 0 leaves it alone.",
            low=0,
            high=5,
            step=0.1,
            unit="factor",
        )
        background_factor: float = knob(
            1.1,
            "Pixels no brighter than this many times what the depth cannot see are background.",
            low=0,
            high=5,
            step=0.05,
            unit="factor",
        )

    presets = {"paper": PRESETS["paper"]["edge_stack"]}

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from .edges.inputs import best_depth
        from .edges.segmentation import stack_edges

        depth, _ = best_depth(inputs)
        top = inputs["full_scale"]
        result = stack_edges(
            inputs["intensity"],
            depth,
            full_scale=top if math.isfinite(top) else None,
            **parameters.model_dump(),
        )
        warnings = []
        if not result.stack.upheld:
            warnings.append(
                f"no threshold keeps small segments under max_ratio {parameters.max_ratio:g}; "
                f"low is {result.stack.low_threshold:.2f}"
            )
        return {
            "gradient": result.gradient.magnitude,
            "edges_low": result.edges_low,
            "edges_medium": result.edges_medium,
            "edges_high": result.edges_high,
            "edge_choice": result,
            WARNINGS: warnings,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        import numpy as np

        from .show import edge_image, log_chart, log_map

        artifacts = logged.artifacts
        stack = artifacts["edge_choice"].stack
        gradient = artifacts["gradient"]
        top = max(float(np.percentile(gradient, 99.5)), 1e-6)
        log_map(
            recording, "edge_stack/gradient", np.minimum(gradient, top), 0, top, "magma",
            ("0", f"{top / 2:.1f}", f"{top:.1f}"),
        )  # fmt: skip
        strength = stack.strength[stack.strength > 0]
        counts, edges = np.histogram(strength, bins=96, range=(0, float(stack.thresholds[-1])))
        names = ("low", "medium", "high")
        highs = dict(zip(names, stack.high_thresholds, strict=True))
        log_chart(recording, "edge_stack/histogram", edges[:-1], np.log10(1 + counts), highs)
        ratio = np.nan_to_num(np.minimum(stack.ratio, 5 * logged.parameters.max_ratio), nan=0.0)
        log_chart(
            recording,
            "edge_stack/ratio",
            stack.thresholds,
            ratio,
            {"low threshold": stack.low_threshold},
            level=logged.parameters.max_ratio,
        )
        for name in ("low", "medium", "high"):
            recording.log(f"edge_stack/{name}", edge_image(artifacts[f"edges_{name}"]))

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .show import chart_view, map_view

        shape = logged.artifacts["gradient"].shape
        unit = "σ" if logged.parameters.noise_units else "grey levels"
        return [
            rrb.Vertical(
                map_view("edge_stack/gradient", "gradient", shape),
                chart_view("edge_stack/histogram", f"histogram ({unit})"),
                chart_view("edge_stack/ratio", f"small/large ({unit})"),
                name=self.name,
            ),
            rrb.Vertical(
                rrb.Spatial2DView(origin="edge_stack/low", name="5a low"),
                rrb.Spatial2DView(origin="edge_stack/medium", name="5b medium"),
                rrb.Spatial2DView(origin="edge_stack/high", name="5c high"),
                name="the stack",
            ),
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        from .wording import apart

        chosen = artifacts["edge_choice"]
        stack = chosen.stack
        gradient, strength = chosen.gradient.magnitude[y, x], stack.strength[y, x]
        unit = "σ" if p.noise_units else "grey levels"
        images = {
            name: bool(artifacts[name][y, x])
            for name in ("edges_low", "edges_medium", "edges_high")
        }
        values = {"gradient": gradient, "strength": strength}
        measured = f"gradient {gradient:.2f} grey levels"
        if chosen.noise is not None:
            measured += f", {gradient / chosen.noise[y, x]:.2f} σ of the noise there"
        if chosen.depth is not None:
            measured += f", with the depth's evidence {strength:.2f} {unit}"
        findings = [
            Finding(measured, values, "noise_units" if chosen.depth is None else "depth_gain")
        ]
        if not chosen.gradient.thin[y, x]:
            if strength < p.lowest:
                says = (
                    f"strength {apart(strength, p.lowest, 2)} is under {p.lowest:g} {unit}, too "
                    "faint to look at"
                )
                return [*findings, Finding(says, images, "lowest", "no edge")]
            says = "the gradient is no maximum across its edge: a stronger pixel is beside it"
            return [*findings, Finding(says, images, "operator", "no edge")]
        low = stack.low_threshold
        kept = "keeps" if stack.upheld else "comes nearest to keeping"
        how = f"the least threshold that {kept} small segments under {p.max_ratio:g} of large ones"
        if strength < low:
            says = f"strength {apart(strength, low, 2)} is under low {low:.2f} {unit}, {how}"
            values = {**images, "low_threshold": low}
            return [*findings, Finding(says, values, "max_ratio", "no edge")]
        findings.append(
            Finding(
                f"strength {apart(strength, low, 2)} is not under low {low:.2f} {unit}, {how}",
                {"low_threshold": low},
                "max_ratio",
            )
        )
        peak = stack.segment_peak[y, x]
        coarse, medium, _ = stack.high_thresholds
        if stack.edges_low[y, x]:
            reaches, into = f"not under high {coarse:.2f}", "low, medium and high"
        elif stack.edges_medium[y, x]:
            reaches = f"not under medium {medium:.2f} and under high {coarse:.2f}"
            into = "medium and high"
        else:
            reaches, into = f"under medium {medium:.2f}", "high"
        nearest = min((medium, coarse), key=lambda limit: abs(limit - peak))
        says = (
            f"its segment's strongest pixel, {apart(peak, nearest, 2)} {unit}, is {reaches}: in "
            f"the image of {into} resolution"
        )
        values = {**images, "segment_peak": peak, "medium": medium, "high": coarse}
        if not chosen.background[y, x]:
            return [*findings, Finding(says, values, "greatest", "edge")]
        bright = chosen.gradient.bright[y, x]
        return [
            *findings,
            Finding(says, {}, "greatest"),
            Finding(
                f"its brighter side, {bright:.1f} grey levels, is no brighter than what the depth "
                "cannot see, or it is a crumb of such a line: a shadow perhaps, no edge",
                {**images, "bright": bright},
                "background_factor",
                "line on the background",
            ),
        ]

    def histograms(self, artifacts: Mapping[str, Any], p: Any) -> list[Histogram]:
        import numpy as np

        found = artifacts["edge_choice"]
        stack = found.stack
        # Of the pixels that can be edges: the rest of the image would drown them.
        strength = stack.strength[found.gradient.thin]
        highest, middle, _ = stack.high_thresholds
        # The axis follows the image, so that it stays where it is while a threshold is dragged.
        least, top = 1.0, 100.0
        if (strength > 0).any():
            least, top = np.percentile(strength[strength > 0], [0, 99.9])
        least, top = min(least, 0.8 * p.lowest), max(top, 1.5 * highest)
        counts, edges = np.histogram(strength, bins=np.geomspace(least, top, 100))
        cuts = [
            Cut("from", p.lowest, "lowest", lambda place: min(place, 0.9 * p.greatest)),
            Cut("low", stack.low_threshold, "max_ratio", stack.ratio_for_low),
            Cut("medium", middle),
            Cut("greatest", highest, "greatest", lambda place: max(place, 1.1 * p.lowest)),
        ]
        unit = "σ of the noise" if p.noise_units else "grey levels"
        return [Histogram("gradient along its ridges", edges, counts, cuts, unit, log_axis=True)]

    def scorer(self) -> Scorer:
        from .edges.scorers import EdgeScorer

        return EdgeScorer({"edges_high": "before reconstruction"})

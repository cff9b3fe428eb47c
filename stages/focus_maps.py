"""Stage ``focus_maps``: how sharp the stripes are in each image (section 3.1)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from workbench.stage import (
    WARNINGS,
    Finding,
    Inputs,
    Logged,
    Outputs,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
    CALIBRATION,
    FAR,
    FOCUS_FAR,
    FOCUS_NEAR,
    FOCUS_NOISE,
    NEAR,
    STRIPES,
)


class FocusMaps(Stage):
    """Energy behind a 5×5 Laplacian, over a window of whole stripe periods, for both images.

    Where the near map is the stronger, the surface is nearer to the near focal plane.  With a
    calibration from optics alone the maps are what a texture of one known spectrum would have
    shown at the same blur (see ``stages/dfd/texture.py``).
    """

    name = "focus_maps"
    chapter = "sensor"
    needs = (NEAR, FAR, STRIPES, CALIBRATION)
    gives = (FOCUS_NEAR, FOCUS_FAR, FOCUS_NOISE)

    class Parameters(StageParameters):
        laplacian: Literal["opencv", "paper"] = knob(
            "opencv",
            "Coefficients of the 5×5 Laplacian, which the paper does not print: OpenCV's passes "
            "less noise; `paper` is the tight kernel. Calibrate with the one you use.",
        )
        window_periods: int = knob(
            1,
            "Side of the window in stripe periods: a whole number, or the stripes' ripple is "
            "read as depth.",
            low=1,
            high=6,
            step=1,
            unit="stripe periods",
        )
        window_px: float = knob(
            9,
            "Side of the window where no stripes are found (texture alone, as in photographs); "
            "where blur is so large that focus is measured on shrunk images, in their pixels.",
            low=3,
            high=63,
            step=2,
            unit="px",
        )
        subtract_noise: bool = knob(
            True,
            "Subtract the energy that the sensor's noise alone would give: it makes dark "
            "surfaces look equally sharp in both images.",
        )

    presets = {"paper": {"window_periods": 2, "subtract_noise": False}}

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from .dfd.focus import SensorNoise, focus_map
        from .dfd.stripes import whole_period_taps
        from .dfd.texture import texture_focus_maps, texture_taps

        calibration = inputs["calibration"]
        warnings = []
        if calibration is not None and calibration.laplacian != parameters.laplacian:
            warnings.append(
                f"laplacian is {parameters.laplacian}, the calibration was made with "
                f"{calibration.laplacian}: depth will be off"
            )
        known = calibration.noise if calibration is not None else SensorNoise()
        texture = calibration.texture if calibration is not None else None
        side = window_side_px(inputs["stripes"], parameters)
        near, far = inputs["near"], inputs["far"]
        scale = texture.scale_px if texture is not None else 1
        alone = texture is not None and inputs["stripes"] is None
        taps_of = texture_taps if alone else whole_period_taps
        x_taps, y_taps = (taps_of(min(side, max(1, size // scale))) for size in near.shape[::-1])
        kind, subtract = parameters.laplacian, parameters.subtract_noise
        if texture is not None:
            focus_near, focus_far, known = texture_focus_maps(
                near, far, texture, x_taps, y_taps, kind, subtract, striped=not alone
            )
        else:
            noise = known if subtract else None
            focus_near = focus_map(near, x_taps, y_taps, kind, noise)
            focus_far = focus_map(far, x_taps, y_taps, kind, noise)
        return {
            "focus_near": focus_near,
            "focus_far": focus_far,
            "focus_noise": known,
            WARNINGS: warnings,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        from .show import log_map

        near, far = logged.artifacts["focus_near"], logged.artifacts["focus_far"]
        # One scale for both, or their comparison, which is the whole point, would be lost.
        top = max(float(near.max()), float(far.max()), 1e-6)
        ticks = ("0", f"{top / 2:.1f}", f"{top:.1f}")
        log_map(recording, "focus_maps/near", near, 0, top, "magma", ticks)
        log_map(recording, "focus_maps/far", far, 0, top, "magma", ticks)

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .show import map_view

        shape = logged.artifacts["focus_near"].shape
        return [
            rrb.Vertical(
                map_view("focus_maps/near", "focus map, near", shape),
                map_view("focus_maps/far", "focus map, far", shape),
                name=self.name,
            )
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        stripes = artifacts.get("stripes")
        side = window_side_px(stripes, p)
        near, far = float(artifacts["focus_near"][y, x]), float(artifacts["focus_far"][y, x])
        values = {"focus_near": near, "focus_far": far}
        findings = [
            Finding(
                f"over {side:.1f} px the Laplacian has {near:.2f} grey levels in near and "
                f"{far:.2f} in far",
                values,
                "window_px" if stripes is None else "window_periods",
            )
        ]
        if near + far == 0:
            rest = " but what the sensor's noise gives" if p.subtract_noise else ""
            says = f"neither image shows any texture{rest}: the ratio is not known"
            return [*findings, Finding(says, values, "subtract_noise", "no texture")]
        ratio = (near - far) / (near + far)
        verdict, where = "as sharp in both", "in the middle of the range"
        if near != far:
            name = "near" if near > far else "far"
            verdict, where = f"sharper in {name}", f"on the {name} side of the range"
        says = (
            f"(near - far) / (near + far) is {ratio:+.3f}: {verdict}, so the surface lies {where}"
        )
        return [*findings, Finding(says, {**values, "ratio": ratio}, None, verdict)]


def window_side_px(stripes: Any, parameters: Any) -> float:
    """Side of the focus window: whole periods of the stripes, or ``window_px`` without any."""
    if stripes is None:
        return float(parameters.window_px)
    return float(stripes.extent_px()) * int(parameters.window_periods)

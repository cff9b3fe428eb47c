"""Stage ``registration``: near and far on one pixel grid (section 3.2, step one)."""

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
    StageError,
    StageParameters,
    knob,
)

from .artifacts import (
    CALIBRATION,
    DRIFT,
    FAR,
    FAR_IMAGE,
    FLAT_IMAGE,
    FULL_SCALE,
    GAIN_DRIFT,
    INTENSITY,
    NEAR,
    NEAR_IMAGE,
    SATURATED,
    STRIPES,
)

_DRIFT_WARNING_PX = 0.5
_GAIN_WARNING = 0.01


class Registration(Stage):
    """Takes the far image onto the near image's grid, and makes an image without stripes.

    The similarity comes from the calibration; without one it is measured on the frame itself.
    So it is with a calibration from optics alone, which knows where to begin, and so is then the
    balance of light over the image.
    What misalignment is left, and how the balance of light between the sensors has drifted since
    the calibration, are measured on every frame and told.
    """

    name = "registration"
    chapter = "sensor"
    needs = (NEAR_IMAGE, FAR_IMAGE, FLAT_IMAGE, CALIBRATION)
    gives = (NEAR, FAR, INTENSITY, SATURATED, FULL_SCALE, STRIPES, DRIFT, GAIN_DRIFT)

    class Parameters(StageParameters):
        similarity: Literal["calibration", "pair", "none"] = knob(
            "calibration",
            "Where the far-to-near map comes from: the calibration (without one, or with one from "
            "optics alone, the pair), each frame's own image pair, or nowhere.",
        )
        intensity: Literal["flat", "stripes"] = knob(
            "flat",
            "The image for edges, regions and display: the recorded flat image where there is "
            "one, or near and far averaged over one stripe period.",
        )
        correct_gain: bool = knob(
            True,
            "Scale the far image so that both sensors catch as much light as when calibrated: "
            "a drift of 1 % costs 0.3 mm.",
        )
        saturation_percent: float = knob(
            99.5,
            "Grey levels from here up are taken as saturated and carry no depth.",
            low=50,
            high=100,
            step=0.5,
            unit="% of full scale",
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from dataclasses import replace

        import cv2
        import numpy as np

        from .dfd.calibration import light_ratio, pair_gain
        from .dfd.images import full_scale, grey
        from .dfd.similarity import (
            Similarity,
            align_pair,
            misalignment_rms_px,
            refine_similarity,
        )
        from .dfd.similarity import warp_to_near as warp
        from .dfd.stripes import average_over_period, measure_stripes

        near_raw, far_raw = inputs["near_image"], inputs["far_image"]
        if near_raw.shape[:2] != far_raw.shape[:2]:
            raise StageError(
                f"near is {_size(near_raw)} and far is {_size(far_raw)}; they must be alike"
            )
        near, far = grey(near_raw), grey(far_raw)
        height, width = near.shape
        calibration = inputs["calibration"]
        warnings: list[str] = []

        similarity = Similarity.identity(width, height)
        from_optics = calibration is not None and calibration.texture is not None
        if calibration is not None:
            known = calibration.similarity
            if from_optics and known.width == 0:
                known = replace(known, width=width, height=height)
            if (known.width, known.height) != (width, height):
                raise StageError(
                    f"the calibration is for {known.width}×{known.height} pixels, "
                    f"the images are {width}×{height}"
                )
            if parameters.similarity == "calibration" and not from_optics:
                similarity = known
        if from_optics and parameters.similarity != "none":
            similarity = align_pair(near, far, [known, similarity])
        elif parameters.similarity == "pair" or (
            parameters.similarity == "calibration" and calibration is None
        ):
            similarity = refine_similarity([(near, far)], similarity)
        flat = inputs["flat_image"]
        top = full_scale(*(image for image in (near_raw, far_raw, flat) if image is not None))
        if calibration is not None and not from_optics and np.isfinite(top):
            if top == calibration.full_scale or (
                near_raw.dtype != np.uint8 and top < calibration.full_scale
            ):
                # The calibration has seen more of the camera than one frame shows.
                top = calibration.full_scale
            else:
                warnings.append(
                    f"the calibration was made with a full scale of {calibration.full_scale:g}, "
                    f"the images have {top:g}: noise and confidence will be off"
                )
        limit = parameters.saturation_percent / 100 * top
        saturated = (near >= limit) | ~np.isfinite(near)
        far_saturated = (far >= limit) | ~np.isfinite(far)
        if far_saturated.any():
            moved = warp(far_saturated.astype(np.float32), similarity)
            saturated |= moved > 0.1
        # Infinity as well: the greatest float would drown the light of the whole image.
        near, far = (np.nan_to_num(image, copy=False, posinf=0, neginf=0) for image in (near, far))
        far = warp(far, similarity)

        gain_drift = 1.0
        if from_optics:
            gain = pair_gain(near, far, similarity)
            gain_drift = float(gain.mean())
            if parameters.correct_gain:
                far = far * gain
        elif calibration is not None:
            gain_drift = light_ratio(near, far, calibration.gain_map)
            if abs(gain_drift - 1) > _GAIN_WARNING:
                done = "corrected" if parameters.correct_gain else "not corrected"
                warnings.append(
                    f"near over far light has drifted by {100 * (gain_drift - 1):+.1f} % since "
                    f"the calibration ({done})"
                )
            if parameters.correct_gain:
                far = far * np.float32(gain_drift)
        if calibration is not None and not from_optics:
            stripes = calibration.stripes
        elif from_optics and calibration.texture.scale_px > 1:
            # Focus is measured on shrunk images, which no stripes survive.
            stripes = None
        else:
            stripes = measure_stripes(near)
        drift_px = misalignment_rms_px(near, far)
        if drift_px > _DRIFT_WARNING_PX:
            warnings.append(f"near and far are {drift_px:.1f} px apart after registration")
        if flat is not None and flat.shape[:2] != near.shape:
            warnings.append(
                f"flat is {_size(flat)}, near is {_size(near_raw)}: the intensity is that of near "
                "and far, with the stripes averaged out"
            )
            flat = None
        if flat is not None and parameters.intensity == "flat":
            intensity = grey(flat)
        else:
            intensity = average_over_period(cv2.addWeighted(near, 0.5, far, 0.5, 0), stripes)
        return {
            "near": near,
            "far": far,
            "intensity": intensity,
            "saturated": saturated,
            "full_scale": top,
            "stripes": stripes,
            "registration_drift_px": drift_px,
            "gain_drift": gain_drift,
            WARNINGS: warnings,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from .show import grey_image, overlap

        artifacts = logged.artifacts
        recording.log("registration/overlap", overlap(artifacts["near"], artifacts["far"]))
        recording.log("registration/intensity", grey_image(artifacts["intensity"]))
        recording.log("registration/drift_px", rr.Scalars(artifacts["registration_drift_px"]))

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin="registration/overlap", name="near (red) over registered far (cyan)"
                ),
                rrb.Spatial2DView(origin="registration/intensity", name="intensity, no stripes"),
                name=self.name,
            )
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        import numpy as np

        near, far = artifacts["near"][y, x], artifacts["far"][y, x]
        drift_px, gain = artifacts["registration_drift_px"], artifacts["gain_drift"]
        origin = {"calibration": "the calibration's map", "pair": "a map measured on this pair"}
        if artifacts.get("calibration") is None:
            origin["calibration"] = origin["pair"]
        brought = origin.get(p.similarity, "no map at all")
        if p.correct_gain:
            brought += f" and times {gain:.4f} for the balance of light"
        findings = [
            Finding(
                f"near {near:.1f}, far {far:.1f} grey levels; far was brought here by {brought}",
                {"near": near, "far": far, "gain_drift": gain},
                "correct_gain",
            ),
            Finding(
                f"over the whole image near and far are {drift_px:.2f} px apart",
                {"registration_drift_px": drift_px},
                "similarity",
            ),
        ]
        taken = "the flat image"
        if artifacts.get("flat_image") is None or p.intensity != "flat":
            taken = "near and far averaged over a stripe period"
        intensity = artifacts["intensity"][y, x]
        findings.append(
            Finding(
                f"intensity {intensity:.1f} grey levels, from {taken}",
                {"intensity": intensity},
                "intensity",
            )
        )
        top, saturated = artifacts["full_scale"], bool(artifacts["saturated"][y, x])
        limit = p.saturation_percent / 100 * top
        if not saturated:
            says = f"near is under {limit:.1f} and so is far where it comes from: not saturated"
        elif near >= limit:
            says = f"near is not under {limit:.1f}: saturated, and carries no depth"
        elif not np.isfinite(artifacts["near_image"][y, x]).all():
            says = "near is not a number: carries no depth"
        else:
            says = f"far is not under {limit:.1f} where it comes from: saturated, carries no depth"
        values = {"saturated": saturated, "full_scale": top, "limit": limit}
        verdict = "saturated" if saturated else "not saturated"
        findings.append(Finding(says, values, "saturation_percent", verdict))
        return findings


def _size(image: Any) -> str:
    return f"{image.shape[1]}×{image.shape[0]}"

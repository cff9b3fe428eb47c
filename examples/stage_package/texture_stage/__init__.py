"""A stage from another package: where the image without stripes has texture of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench import Artifact, Finding, Logged, Stage, StageParameters, knob

INTENSITY = Artifact("intensity", "float32", "H W", "grey levels")
TEXTURE = Artifact("texture", "float32", "H W", "", "standard deviation over mean, in a window")


class Texture(Stage):
    """Local contrast of the image without stripes.

    Where it is high, edges are drawn that bound no surface; where it is nothing, depth from
    defocus would be blind without the projector.
    """

    name = "texture"
    needs = (INTENSITY,)
    gives = (TEXTURE,)

    class Parameters(StageParameters):
        window_px: int = knob(
            9,
            "Side of the window: a wider one finds coarser texture.",
            low=3,
            high=31,
            step=2,
            unit="px",
        )

    def compute(self, inputs: Any, parameters: Any) -> dict[str, Any]:
        import cv2

        image = inputs["intensity"]
        side = (parameters.window_px, parameters.window_px)
        mean = cv2.blur(image, side)
        spread = np.sqrt(np.maximum(cv2.blur(image * image, side) - mean * mean, 0))
        return {"texture": (spread / np.maximum(mean, 1)).astype(np.float32)}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        recording.log(
            "texture",
            rr.DepthImage(
                logged.artifacts["texture"], meter=1.0, depth_range=(0, 0.5), colormap="viridis"
            ),
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [rrb.Spatial2DView(origin="texture", name="texture, 0 to 0.5")]

    def explain(self, x: int, y: int, artifacts: Any, p: Any) -> list[Finding]:
        value = float(artifacts["texture"][y, x])
        return [Finding(f"texture {value:.3f}", {"texture": value}, "window_px")]

"""A stage of one's own, in one file: how rough the depth is.

Run it in the bench beside the built-in stages:

    workbench replay recordings/scene.mcap --plugin examples/02_a_stage_of_your_own.py

The file is also a script, which runs the stage on the committed scene and prints its results.
"""

from pathlib import Path
from typing import Any

import numpy as np

import workbench
from workbench import Artifact, Logged, Stage, StageParameters, knob

RECORDINGS = Path(__file__).parent.parent / "recordings"


class Roughness(Stage):
    """Depth against its local mean: what the sensor adds where a surface is smooth."""

    name = "roughness"
    needs = (Artifact("depth_m", "float32", "H W", "m"),)
    gives = (Artifact("roughness_mm", "float32", "H W", "mm", "depth less its local mean"),)

    class Parameters(StageParameters):
        window_px: int = knob(
            7,
            "Side of the window of the local mean: a wider one calls a curved surface rough.",
            low=3,
            high=31,
            step=2,
            unit="px",
        )

    def compute(self, inputs: Any, parameters: Any) -> dict[str, Any]:
        import cv2

        depth_m = inputs["depth_m"]
        known = np.isfinite(depth_m).astype(np.float32)
        side = (parameters.window_px, parameters.window_px)
        share = cv2.blur(known, side)
        mean = cv2.blur(np.nan_to_num(depth_m), side) / np.maximum(share, 1e-6)
        return {"roughness_mm": (1e3 * (depth_m - mean)).astype(np.float32)}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        rough = np.nan_to_num(np.abs(logged.artifacts["roughness_mm"]))
        recording.log(
            "roughness", rr.DepthImage(rough, meter=1.0, depth_range=(0, 1), colormap="magma")
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [rrb.Spatial2DView(origin="roughness", name="roughness, 0 to 1 mm")]


def main() -> None:
    session = workbench.open(RECORDINGS / "scene.mcap", plugins=[__file__])
    for run in session.runs():
        rough = run.artifacts["roughness_mm"]
        print(f"frame {run.frame.index:2}: {np.nanmedian(np.abs(rough)):.3f} mm")


if __name__ == "__main__":
    main()

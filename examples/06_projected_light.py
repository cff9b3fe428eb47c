"""A textureless plane has a depth only under projected light (lesson 4).

Builds a pipeline of its own: the stages that make images come first, the product's stages follow.
Prints how much of the plane has a depth with the pattern on, with it off, and with a texture.
"""

import numpy as np

from workbench.pipeline import Pipeline
from workbench.settings import resolve
from workbench.teach.course import NO_FRAME
from workbench_stages.depth_cloud import DepthCloud
from workbench_stages.focus_maps import FocusMaps
from workbench_stages.lessons.sensor import CalibrationPlanes, Optics, Plane
from workbench_stages.registration import Registration

STAGES = {s.name: s() for s in (Optics, Plane, CalibrationPlanes, Registration, FocusMaps,
                                DepthCloud)}  # fmt: skip


def main() -> None:
    pipeline = Pipeline(STAGES, resolve(STAGES))
    for name, values in {
        "pattern on": [],
        "pattern off": ["plane.pattern=0.0"],
        "pattern off, texture": ["plane.pattern=0.0", "plane.texture=0.5"],
    }.items():
        # Only what a changed parameter reaches is computed again: the calibration is kept.
        run = pipeline.with_settings(resolve(STAGES, assignments=values)).run(NO_FRAME)
        known = np.isfinite(run.artifacts["depth_m"])
        ran = ", ".join(s for s in STAGES if s in run.computed)
        print(f"{name}: {100 * known.mean():.0f} % known; ran {ran}")


if __name__ == "__main__":
    main()

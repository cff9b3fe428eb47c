"""Open a recording, run its stages, and get artifacts by name.

Prints, for each frame of the committed scene, how much of it has a depth and how far away the
nearest surface is.
"""

from pathlib import Path

import numpy as np

import workbench

RECORDINGS = Path(__file__).parent.parent / "recordings"


def main() -> None:
    session = workbench.open(RECORDINGS / "scene.mcap", set=["depth_cloud.min_confidence=0.6"])
    for run in session.runs():
        depth_m = run.artifacts["depth_m"]
        known = np.isfinite(depth_m)
        print(
            f"frame {run.frame.index:2}: {100 * known.mean():.0f} % known, "
            f"nearest {1e3 * np.percentile(depth_m[known], 0.1):.1f} mm, "
            f"{sum(run.stage_ms.values()):.0f} ms"
        )


if __name__ == "__main__":
    main()

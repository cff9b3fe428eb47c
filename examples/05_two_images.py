"""Why one image is not enough, and why albedo cancels in the ratio of two (lesson 3).

Prints both focus measures and their ratio for planes at several distances, and for a darker one.
"""

import numpy as np

from workbench_stages.lessons.sensor import ratio_over_distance
from workbench_stages.optics.rig import Projector, Rig


def main() -> None:
    rig = Rig(width_px=100, height_px=100, projector=Projector())
    for albedo in (0.55, 0.3):
        print(f"albedo {albedo}")
        distances = np.array([692.0, 736.0, 770.0])
        for distance, near, far, ratio in zip(
            distances, *ratio_over_distance(rig, distances, albedo), strict=True
        ):
            print(f"  {distance:.0f} mm: near {near:5.1f}, far {far:5.1f}, ratio {ratio:+.3f}")


if __name__ == "__main__":
    main()

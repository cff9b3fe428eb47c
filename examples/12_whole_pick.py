"""From a pair of images to a pick, and to the honest answer that nothing can be (lesson 15).

Prints the verdict and the pose for the first piles of the committed recording, and again with a φ
so strict that nothing matches.
"""

from pathlib import Path

import workbench

RECORDINGS = Path(__file__).parent.parent / "recordings"


def main() -> None:
    for phi_scale in (1.0, 0.1):
        print(f"φ times {phi_scale}")
        session = workbench.open(
            RECORDINGS / "scene.mcap", set=[f"recognition.phi_scale={phi_scale}"]
        )
        required, optional = session.pipeline.channels
        for frame in session.recording.frames(required, optional, 0, 3):
            run = session.pipeline.run(frame)
            verdict = run.artifacts["verdict"]
            print(f"  frame {frame.index}: {verdict['verdict']} {verdict['object'] or ''}")
            for pose in run.artifacts["poses"]:
                x, y, z = (1e3 * value for value in pose["grasp"]["position"])
                print(f"    turned by {pose['rotation_deg']:.1f}°, at {x:.1f}, {y:.1f}, {z:.1f} mm")


if __name__ == "__main__":
    main()

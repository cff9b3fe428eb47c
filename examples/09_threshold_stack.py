"""The stack of thresholds, chosen by the lengths of edge segments (lesson 12, section 4.1).

Prints the low threshold that one recorded pile chooses, and the edge pixels of the three images,
for several shares of noise that are allowed.
"""

from pathlib import Path

import workbench

RECORDINGS = Path(__file__).parent.parent / "recordings"


def main() -> None:
    for max_ratio in (0.005, 0.05, 0.5):
        session = workbench.open(
            RECORDINGS / "scene.mcap",
            preset="paper",
            set=[f"edge_stack.max_ratio={max_ratio}"],
            until="edge_stack",
        )
        required, optional = session.pipeline.channels
        frame = next(session.recording.frames(required, optional, 5, 6))
        artifacts = session.pipeline.run(frame).artifacts
        low = artifacts["edge_choice"].stack.low_threshold
        counts = [int(artifacts[f"edges_{name}"].sum()) for name in ("low", "medium", "high")]
        print(f"max_ratio {max_ratio}: low threshold {low:.2f}, edge pixels {counts}")


if __name__ == "__main__":
    main()

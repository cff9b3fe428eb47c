"""Bridging the gaps between ends of lines closes regions (lesson 13, sections 4.1 and 4.2).

Prints ends, pixels of links and closed regions of one recorded pile over the reach of a link.
"""

from pathlib import Path

import workbench

RECORDINGS = Path(__file__).parent.parent / "recordings"


def main() -> None:
    for reach in (3.0, 6.0, 9.0, 15.0):
        session = workbench.open(
            RECORDINGS / "scene.mcap",
            preset="paper",
            set=[f"linked_edges.reach={reach}"],
            until="region_features",
        )
        required, optional = session.pipeline.channels
        frame = next(session.recording.frames(required, optional, 5, 6))
        artifacts = session.pipeline.run(frame).artifacts
        print(
            f"reach {reach:4.1f} px: {len(artifacts['terminators'])} ends, "
            f"{int(artifacts['links'].sum())} pixels of links, "
            f"{len(artifacts['regions'])} closed regions"
        )


if __name__ == "__main__":
    main()

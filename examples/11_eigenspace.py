"""A part's turn as a curve in its eigenspace (lesson 14, section 6).

Loads the committed models, turns one part by its own manifold, and finds the turn again, whole and
with a share of it covered.  Prints the rotation that is found and its distance against ζ.
"""

from pathlib import Path

import numpy as np

from workbench_stages.matching.database import Database
from workbench_stages.matching.eigenspace import POINTS, match

MODELS = Path(__file__).parent.parent / "recordings" / "scene.models.npz"


def main() -> None:
    database = Database.load(MODELS)
    for part in database.parts:
        space = part.space
        print(
            f"{part.name}: {len(space.basis)} eigenimages hold "
            f"{100 * space.variance.sum():.1f} %, the same {space.order} times in a turn"
        )
    part = database.parts[database.names.index("lblock")]
    space = part.space
    for covered in (0.0, 0.15, 0.3):
        view = (space.mean + space.manifold[70 * POINTS // 360] @ space.basis).clip(0, 1)
        view = view.reshape(space.side, space.side)
        rows = np.flatnonzero(view.max(axis=1) > 0.5)
        view[: rows[0] + round(covered * len(rows))] = 0
        found = match(space, view)
        verdict = "accepted" if found.distance <= part.zeta else "refused"
        print(
            f"{part.name} at 70°, {100 * covered:.0f} % covered: found {found.rotation_deg:.1f}°, "
            f"distance {found.distance:.3f} against ζ {part.zeta:.3f}: {verdict}"
        )


if __name__ == "__main__":
    main()

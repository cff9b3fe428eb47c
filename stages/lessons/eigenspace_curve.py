"""Lesson: the eigenspace, and a part's rotation as a curve in it (section 6)."""

from __future__ import annotations

from typing import Any

import numpy as np

from workbench.pipeline import Run
from workbench.stage import Artifact, Inputs, Logged, Outputs, Stage, StageParameters, knob
from workbench.teach import Claim, Lesson

from ..artifacts import MODELS
from .scene import SCENE

TEXT = """
Which way is the part turned? One could compare its picture with pictures of every turn, pixel by
pixel. Section 6 first **compresses** them: the pictures of one part differ from one another in a
few ways only, and principal component analysis finds these, the *eigenimages* (equations 8 to 10).
A picture becomes a handful of numbers, its projections on them (equation 11): a *point*.

Turn the part, and the point moves along a **curve**. The database holds that curve for each part:
the dots are the 24 training views, the line is their spline, resampled to 720 points. A new picture
is projected too (equation 12), and the nearest point of the curve tells its rotation; the distance
to it (equation 13) must be under ζ, or the picture shows something else.

Only the first three coordinates can be drawn here. A part that looks the same after half a turn
(take another `part`) runs through its curve twice.
"""

SCENE_VIEW = Artifact("lesson_view", "float32", "S S", "", "the part's outline as it was seen")
ANSWER = Artifact("lesson_answer", doc="found rotation, distance and threshold")


class EigenspaceCurve(Stage):
    """A view of a trained part at any turn, partly covered, matched with the part's manifold."""

    name = "eigenspace"
    needs = (MODELS,)
    gives = (SCENE_VIEW, ANSWER)

    class Parameters(StageParameters):
        part: int = knob(
            4, "Which part of the database is matched, counted round.", low=0, high=5, step=1
        )
        rotation_deg: float = knob(
            70.0, "How far the part is really turned.", low=0, high=355, step=5, unit="deg"
        )
        covered: float = knob(
            0.0,
            "Share of the outline's length that something else lies over.",
            low=0,
            high=0.6,
            step=0.05,
        )
        eigenimages: int = knob(
            26,
            "How many eigenimages are used; more than there are takes all.",
            low=1,
            high=30,
            step=1,
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from dataclasses import replace

        from ..matching.eigenspace import POINTS, match

        database = inputs["models"]
        if database is None:
            raise ValueError("the lesson needs models beside its recording")
        part = database.parts[parameters.part % len(database.parts)]
        space = part.space
        at = round(parameters.rotation_deg * POINTS / 360) % POINTS
        view = np.clip(space.mean + space.manifold[at] @ space.basis, 0, 1)
        view = view.reshape(space.side, space.side).astype(np.float32)
        rows = np.flatnonzero(view.max(axis=1) > 0.5)
        hidden = round(parameters.covered * (rows[-1] - rows[0] + 1))
        view[: rows[0] + hidden] *= 0 if hidden else 1
        kept = min(parameters.eigenimages, len(space.basis))
        few = replace(
            space,
            basis=space.basis[:kept],
            variance=space.variance[:kept],
            manifold=space.manifold[:, :kept],
            views=space.views[:, :kept],
        )
        found = match(few, view)
        period = 360 / space.order
        off = (found.rotation_deg - parameters.rotation_deg + period / 2) % period - period / 2
        answer = {
            "name": part.name,
            "rotation_deg": found.rotation_deg % period,
            "off_deg": abs(off),
            "distance": found.distance,
            "zeta": part.zeta,
            "order": space.order,
            "variance": float(few.variance.sum()),
            "point": (few.basis.astype(np.float64) @ (view.ravel() - space.mean)),
            "space": few,
        }
        return {"lesson_view": view, "lesson_answer": answer}

    def log(self, recording: Any, logged: Logged) -> None:
        import cv2
        import rerun as rr

        from ..matching.eigenspace import POINTS
        from .charts import (
            BAD_COLOUR,
            BOTH_COLOUR,
            FAR_COLOUR,
            GOOD_COLOUR,
            INK,
            log_texts,
        )

        answer = logged.artifacts["lesson_answer"]
        space = answer["space"]

        def image(values: np.ndarray) -> Any:
            flat = np.clip(values.reshape(space.side, space.side), 0, 1)
            return rr.Image(cv2.convertScaleAbs(flat.astype(np.float32), alpha=255))

        def first_three(points: np.ndarray) -> np.ndarray:
            points = np.atleast_2d(points) / space.norm
            return np.pad(points, ((0, 0), (0, max(0, 3 - points.shape[1]))))[:, :3]

        accepted = answer["distance"] <= answer["zeta"]
        colour = GOOD_COLOUR if accepted else BAD_COLOUR
        recording.log(f"{self.name}/seen", image(logged.artifacts["lesson_view"]))
        at = round(answer["rotation_deg"] * POINTS / 360) % POINTS
        nearest = space.mean + space.manifold[at] @ space.basis
        recording.log(f"{self.name}/nearest", image(nearest))
        sign = "≤" if accepted else ">"
        log_texts(
            recording,
            f"{self.name}/seen/says",
            [((24, 0.5), f"{answer['name']} at {logged.parameters.rotation_deg:.0f}°", INK)],
        )
        log_texts(
            recording,
            f"{self.name}/nearest/says",
            [
                ((24, 0.5), f"found {answer['rotation_deg']:.1f}°", colour),
                ((24, 42), f"distance {answer['distance']:.3f} {sign} ζ {answer['zeta']:.3f}",
                 colour),
            ],
        )  # fmt: skip
        tiles = [
            cv2.copyMakeBorder(_signed(row.reshape(space.side, -1)), 1, 1, 1, 1, 0, value=0)
            for row in space.basis[:6]
        ]
        while len(tiles) < 6:
            tiles.append(np.zeros_like(tiles[0]))
        grid = np.vstack([np.hstack(tiles[:3]), np.hstack(tiles[3:])])
        recording.log(f"{self.name}/eigenimages", rr.Image(grid))
        curve = first_three(space.manifold)
        recording.log(
            f"{self.name}/curve/manifold",
            rr.LineStrips3D([np.concatenate([curve, curve[:1]])], colors=BOTH_COLOUR, radii=0.006),
        )
        recording.log(
            f"{self.name}/curve/views",
            rr.Points3D(first_three(space.views), colors=FAR_COLOUR, radii=0.02),
        )
        own, other = first_three(answer["point"])[0], first_three(space.manifold[at])[0]
        recording.log(
            f"{self.name}/curve/seen",
            rr.Points3D([own], colors=colour, radii=0.045, labels=["seen"], show_labels=True),
        )
        recording.log(
            f"{self.name}/curve/gap", rr.LineStrips3D([[own, other]], colors=colour, radii=0.01)
        )
        axes = np.eye(3) * 0.5
        recording.log(
            f"{self.name}/curve/axes",
            rr.Arrows3D(
                vectors=axes,
                colors=(110, 114, 126),
                radii=0.004,
                labels=["eigenimage 1", "2", "3"],
                show_labels=True,
            ),
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .charts import PAPER, picture_view

        shape = logged.artifacts["lesson_view"].shape
        return [
            rrb.Horizontal(
                rrb.Spatial3DView(
                    origin=f"{self.name}/curve",
                    name="the part's turn as a curve (first three coordinates)",
                    background=PAPER,
                    eye_controls=rrb.EyeControls3D(
                        position=(1.05, 1.25, 0.9), look_target=(0, 0, 0), eye_up=(0, 0, 1)
                    ),
                ),
                rrb.Vertical(
                    picture_view(f"{self.name}/seen", "what is seen", shape),
                    picture_view(f"{self.name}/nearest", "the curve's nearest point", shape),
                    picture_view(f"{self.name}/eigenimages", "eigenimages 1 to 6"),
                ),
                column_shares=[1.7, 1],
            )
        ]


def _signed(image: np.ndarray) -> np.ndarray:
    """An eigenimage [S S] as colours: red above nought, blue below, uint8 [S S 3]."""
    share = np.clip(image / max(float(np.abs(image).max()), 1e-9), -1, 1)[..., None]
    colour = np.where(share > 0, np.array([240.0, 90, 80]), np.array([80.0, 140, 250]))
    return (np.abs(share) * colour).astype(np.uint8)


def _answer(key: str) -> Any:
    return lambda run: float(run.artifacts["lesson_answer"][key])


def _margin(run: Run) -> float:
    answer = run.artifacts["lesson_answer"]
    return float(answer["distance"] / answer["zeta"])


LESSON = Lesson(
    number=14,
    name="eigenspace",
    title="A part's turn as a curve in its eigenspace",
    paper="section 6, equations 8 to 13",
    text=TEXT,
    stages=(EigenspaceCurve,),
    knobs=(
        "eigenspace.rotation_deg",
        "eigenspace.covered",
        "eigenspace.eigenimages",
        "eigenspace.part",
    ),
    shows=("eigenspace",),
    settings={},
    recording=SCENE,
    claims=(
        Claim(
            "Turn the part from 70° to 160°: its point runs along the curve, and the rotation that "
            "is found follows by 90°.",
            {"eigenspace.rotation_deg": 70.0},
            {"eigenspace.rotation_deg": 160.0},
            "rotation found",
            "°",
            _answer("rotation_deg"),
            lambda before, after: abs(after - before - 90) < 1,
        ),
        Claim(
            "Cover 30 % of it: the point leaves the curve, the distance passes ζ and the match is "
            "refused, which is why the topmost part is picked and not a covered one.",
            {"eigenspace.covered": 0.0},
            {"eigenspace.covered": 0.3},
            "distance over ζ",
            "",
            _margin,
            lambda before, after: before < 1 < after,
        ),
        Claim(
            "Use 2 eigenimages instead of 26: the curve is no longer the part's, most of a picture "
            "lies outside the space, and the distance grows more than tenfold.",
            {"eigenspace.eigenimages": 26},
            {"eigenspace.eigenimages": 2},
            "distance",
            "",
            _answer("distance"),
            lambda before, after: after > 10 * before,
        ),
    ),
)

"""Stage ``recognition``: which region is the topmost part, and which part it is (section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.artifacts import (
    CALIBRATION,
    CANDIDATES,
    DEPTH,
    INTENSITY,
    LABELS,
    MODELS,
    NEAR_CAMERA,
    REGIONS,
    VERDICT,
)
from workbench.errors import DataError
from workbench.stage import (
    Finding,
    Inputs,
    Logged,
    Outputs,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

PATH = "recognition"


class Recognition(Stage):
    """Candidates among the regions, why each was refused, and the verdict: pick or rearrange.

    A region is refused if it is smaller than the smallest part, leaves the image, is too steep
    or not flat, lies below a neighbour along its border (marked Occ), has features farther than φ
    from every part's, an outline farther than ζ from its part's manifold, or surroundings that
    the part cannot have.  Of what is left the highest is picked: what lies on top of the pile.

    ``candidates`` is a numpy structured array, the largest first: ``label``, ``rank`` (by area),
    ``elevation_m``, ``tilt_deg``, ``area_mm2``, ``perimeter_mm``, ``shape_factor``,
    ``greatest_distance_mm``, ``occluded``, ``occluded_by``, ``occluded_share``, ``distances`` (to
    each model), ``model``, ``distance``, ``shape_distance``, ``zeta``, ``mirrored``,
    ``visible_model`` and ``hidden_share`` (a region that is covered or leaves the image is named
    by what shows of it, but not picked), ``reason`` (0 none, 1 too small, 2 leaves the image,
    3 tilted, 4 not flat, 5 occluded, 6 over φ, 7 over ζ, 8 surroundings), ``picked``.
    ``verdict`` has ``verdict``, ``region``, ``object`` and
    ``reason``; it is None without models or depth.
    """

    name = "recognition"
    chapter = "recognition"
    needs = (
        LABELS,
        REGIONS,
        INTENSITY,
        DEPTH.optional(),
        NEAR_CAMERA,
        MODELS,
        CALIBRATION,
    )
    gives = (CANDIDATES, VERDICT)

    class Parameters(StageParameters):
        min_area: float = knob(
            0.8,
            "A candidate's area over that of the database's smallest surface, at least.",
            low=0.1,
            high=1.0,
            step=0.05,
            unit="share",
        )
        step: float = knob(
            1.0,
            "A neighbour that is higher by this at the shared border lies above (and by 3 sigma "
            "of both planes).",
            low=0.2,
            high=10,
            step=0.1,
            unit="mm",
        )
        covered_share: float = knob(
            0.06,
            "Share of a region's border along which others are above it, from which it counts as "
            "occluded: less is the noise of a line.",
            low=0,
            high=1,
            step=0.01,
        )
        max_tilt: float = knob(
            50.0,
            "Steeper faces are the sides of a part, seen too flat to be measured.",
            low=5,
            high=85,
            step=1,
            unit="deg",
        )
        max_residual: float = knob(
            1.0,
            "A face whose depth departs more from its plane is no face of a polyhedron.",
            low=0.1,
            high=5,
            step=0.1,
            unit="mm",
        )
        phi_scale: float = knob(
            1.0,
            "Factor on the database's φ, the greatest distance of features.",
            low=0.1,
            high=10,
            step=0.1,
            unit="factor",
        )
        zeta_scale: float = knob(
            1.0,
            "Factor on the database's ζ, the greatest distance from a manifold.",
            low=0.1,
            high=10,
            step=0.1,
            unit="factor",
        )

        most_hidden: float = knob(
            0.2,
            "Up to this share of its surface hidden, a region is named by what shows of it "
            "(section 7 promises 0.2); 0 turns this off.",
            low=0,
            high=0.5,
            step=0.05,
            unit="share",
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        import numpy as np

        from stages.edges.inputs import best_depth
        from stages.matching.recognise import find_candidates, verdict_of

        database = inputs["models"]
        depth, camera = best_depth(inputs)
        if database is None or camera is None or depth is None:
            return {"candidates": np.zeros(0, [("label", np.int32)]), "verdict": None}
        try:
            database.check_calibration(inputs["calibration"])
        except ValueError as error:
            raise DataError(str(error)) from error
        rules = rules_of(parameters)
        candidates = find_candidates(
            inputs["labels"], inputs["regions"], depth, camera, database, rules
        )
        return {"candidates": candidates, "verdict": verdict_of(candidates, database, rules)}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from stages.matching.show import candidate_marks, candidates_page, region_outlines
        from stages.show import grey_image

        artifacts = logged.artifacts
        recording.log(f"{PATH}/intensity", grey_image(artifacts["intensity"]))
        verdict = artifacts["verdict"]
        database = artifacts.get("models")
        if verdict is None or database is None:
            recording.log(f"{PATH}/candidates", rr.Clear(recursive=True))
            recording.log(
                f"{PATH}/verdict",
                rr.TextDocument(
                    "no verdict: needs depth, intrinsics and models (`workbench train`)",
                    media_type="text/markdown",
                ),
            )
            return
        strips, colours = region_outlines(artifacts["labels"], artifacts["candidates"])
        recording.log(
            f"{PATH}/candidates/outlines", rr.LineStrips2D(strips, colors=colours, radii=0.6)
        )
        places, texts, colours = candidate_marks(
            artifacts["candidates"], artifacts["regions"], database
        )
        recording.log(
            f"{PATH}/candidates/marks",
            rr.Points2D(places, labels=texts, colors=colours, radii=1.5, show_labels=True),
        )
        recording.log(
            f"{PATH}/verdict",
            rr.TextDocument(
                candidates_page(
                    artifacts["candidates"], verdict, database, rules_of(logged.parameters)
                ),
                media_type="text/markdown",
            ),
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [
            rrb.Spatial2DView(
                origin=PATH,
                contents=[f"{PATH}/intensity", f"{PATH}/candidates/**"],
                name="candidates (green: picked, orange: refused, red: Occ)",
            ),
            rrb.TextDocumentView(origin=f"{PATH}/verdict", name="verdict"),
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        label = int(artifacts["labels"][y, x])
        candidates = artifacts["candidates"]
        database = artifacts.get("models")
        if artifacts["verdict"] is None or database is None:
            return [Finding("no verdict: needs depth, intrinsics and models")]
        rows = candidates[candidates["label"] == label]
        if not label or not len(rows):
            return [Finding("in no candidate: background, or no plane", {"label": label})]
        from stages.matching.recognise import explain_row

        row = rows[0]
        knobs = {
            1: "min_area", 3: "max_tilt", 4: "max_residual", 5: "step", 6: "phi_scale",
            7: "zeta_scale",
        }  # fmt: skip
        said = explain_row(row, database, rules_of(p))
        state = "picked" if row["picked"] else "refused" if row["reason"] else "would do"
        return [
            Finding(
                f"region {label}, {state}: {said}",
                {"label": label, "distance": float(row["distance"])},
                knobs.get(int(row["reason"])),
            )
        ]

    def scorer(self) -> Scorer:
        from stages.matching.scorers import RecognitionScorer

        return RecognitionScorer()


def rules_of(parameters: Any) -> Any:
    """The stage's parameters as the mathematics takes them."""
    from stages.matching.recognise import Rules

    return Rules(
        parameters.min_area,
        parameters.step,
        parameters.covered_share,
        parameters.max_tilt,
        parameters.max_residual,
        parameters.phi_scale,
        parameters.zeta_scale,
        parameters.most_hidden,
    )

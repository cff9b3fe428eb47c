"""Stage ``recognition``: which region is the topmost part, and which part it is (section 5)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from workbench.errors import DataError
from workbench.stage import (
    Finding,
    Inputs,
    Logged,
    Outputs,
    Score,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
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

    def compute(self, inputs: Inputs, parameters: Any) -> Iterator[Outputs]:
        import numpy as np

        from .edges.inputs import best_depth
        from .matching.recognise import find_candidates, verdict_of

        database = inputs["models"]
        depth, camera = best_depth(inputs)
        if database is None or camera is None or depth is None:
            yield {"candidates": np.zeros(0, [("label", np.int32)]), "verdict": None}
            return
        try:
            database.check_calibration(inputs["calibration"])
        except ValueError as error:
            raise DataError(str(error)) from error
        rules = rules_of(parameters)
        candidates = find_candidates(
            inputs["labels"], inputs["regions"], depth, camera, database, rules
        )
        yield {"candidates": candidates}
        yield {"verdict": verdict_of(candidates, database, rules)}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from .matching.show import candidate_marks, candidates_page, region_outlines
        from .show import grey_image

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
        from .edges.stories import on_line
        from .matching.recognise import Reason, checks, explain_row

        label = int(artifacts["labels"][y, x])
        candidates, database = artifacts["candidates"], artifacts.get("models")
        if artifacts["verdict"] is None or database is None:
            return [Finding("no verdict: needs depth, intrinsics and models")]
        values: dict[str, Any] = {"labels": label}
        if not label:
            says = "in no region, so in no candidate"
            return [Finding(says, values, None, "no candidate", "no region")]
        region = artifacts["regions"][label - 1]
        edge = on_line(x, y, artifacts)
        beside = f"region {label}, beside {edge}" if edge else ""
        rows = candidates[candidates["label"] == label]
        if region["background"]:
            says = f"region {label} is background, so no candidate"
            return [Finding(says, values, None, "no candidate", beside or f"region {label}")]
        if not len(rows):
            says = f"region {label} is refused: it has no plane to be seen along"
            return [Finding(says, values, None, "refused", beside)]
        row, rules = rows[0], rules_of(p)
        told = checks(row, region, database, rules)
        knobs = {
            Reason.TOO_SMALL: "min_area",
            Reason.TILTED: "max_tilt",
            Reason.NOT_FLAT: "max_residual",
            Reason.OCCLUDED: "covered_share",
            Reason.FEATURES: "phi_scale",
            Reason.SHAPE: "zeta_scale",
        }
        findings = [
            Finding(says, numbers, knobs.get(criterion)) for criterion, says, numbers in told
        ]
        said = explain_row(row, database, rules)
        if row["reason"]:
            *passed, failed = findings
            says, values = f"region {label} is refused: {failed.says}", {**values, **failed.values}
            return [*passed, Finding(says, values, failed.parameter, "refused", beside)]
        up = 1e3 * row["elevation_m"]
        if row["picked"]:
            says = f"region {label} is picked as {said}; at {up:.2f} mm it is the highest match"
            return [*findings, Finding(says, values, None, "picked", beside)]
        best = candidates[candidates["picked"]][0]
        says = (
            f"region {label} would do as {said}; but at {up:.2f} mm it lies lower than region "
            f"{best['label']} at {1e3 * best['elevation_m']:.2f} mm"
        )
        return [*findings, Finding(says, values, None, "not the highest", beside)]

    def scorer(self) -> Scorer:
        from .matching.scorers import RecognitionScorer

        return RecognitionScorer()

    def figures(self, artifacts: Mapping[str, Any]) -> list[Score]:
        verdict = artifacts["verdict"]
        if verdict is None:
            return []
        return [Score("picks", float(verdict["verdict"] == "pick"), better="higher")]


def rules_of(parameters: Any) -> Any:
    """The stage's parameters as the mathematics takes them."""
    from .matching.recognise import Rules

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

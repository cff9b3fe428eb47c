"""Stage ``pose_frames``: the pose of the picked surface, and the grasp (section 6)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workbench.stage import (
    WARNINGS,
    Finding,
    Inputs,
    Logged,
    Outputs,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
    CANDIDATES,
    DEPTH,
    INTENSITY,
    LABELS,
    MODELS,
    NEAR_CAMERA,
    POSES,
    REGIONS,
    VERDICT,
)

PATH = "pose_frames"


class PoseFrames(Stage):
    """Rotation from the eigenspace, tilt from the plane, place from the centroid.

    ``poses`` is a list, empty where the verdict is to rearrange, of plain objects: ``object``,
    ``region``, ``rotation_deg`` (about the surface's normal, counter-clockwise as displayed, 0 as
    in training, in [0, ``period_deg``)), ``camera_from_surface`` (4×4, metres; origin at the
    centroid on the fitted plane, z the outward normal), ``grasp`` (``position``, ``approach``),
    ``distance`` and ``distance_within`` (equation 13) from the manifold, ``phi``, ``zeta``,
    ``accepted``, ``mirrored`` (the part lies on its other side), ``settled_by`` (``outline``,
    ``range`` or ``open``), ``open_rotations_deg`` (as good, and not ruled out), ``uncertainty``.
    """

    name = "pose_frames"
    chapter = "recognition"
    needs = (
        LABELS,
        REGIONS,
        INTENSITY,
        CANDIDATES,
        VERDICT,
        DEPTH.optional(),
        NEAR_CAMERA,
        MODELS,
    )
    gives = (POSES,)

    class Parameters(StageParameters):
        zeta_scale: float = knob(
            1.0,
            "Factor on the database's ζ, up to which a pose is accepted.",
            low=0.1,
            high=10,
            step=0.1,
            unit="factor",
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from .edges.inputs import best_depth
        from .matching.pose import pose_of
        from .matching.surfaces import cut_out

        database, verdict = inputs["models"], inputs["verdict"]
        depth, camera = best_depth(inputs)
        if database is None or depth is None or camera is None or verdict is None:
            return {"poses": []}
        poses, warnings = [], []
        candidates = inputs["candidates"]
        for candidate in candidates[candidates["picked"]]:
            label = int(candidate["label"])
            region = inputs["regions"][label - 1]
            surface = cut_out(inputs["labels"], label, region["point_m"], region["normal"], camera)
            if surface is None:
                continue
            pose = pose_of(
                surface, region, depth, database, int(candidate["model"]), parameters.zeta_scale
            )
            poses.append(pose)
            if pose["open_rotations_deg"]:
                others = ", ".join(f"{r:.0f}°" for r in pose["open_rotations_deg"])
                warnings.append(
                    f"{pose['object']}: rotation {pose['rotation_deg']:.0f}° or {others}, the "
                    "depth around it does not tell"
                )
            if not pose["accepted"]:
                warnings.append(
                    f"{pose['object']}: outline {pose['distance']:.3f} over ζ {pose['zeta']:.3f}"
                )
        return {"poses": poses, WARNINGS: warnings}

    def log(self, recording: Any, logged: Logged) -> None:
        import numpy as np
        import rerun as rr

        from .matching.pose import outline_m, project
        from .matching.show import AXIS_COLOURS, MODEL_COLOUR, axes_of, pose_page
        from .show import grey_image

        artifacts = logged.artifacts
        recording.log(f"{PATH}/intensity", grey_image(artifacts["intensity"]))
        poses, database = artifacts["poses"], artifacts.get("models")
        recording.log(
            f"{PATH}/text",
            rr.TextDocument(pose_page(poses, artifacts["verdict"]), media_type="text/markdown"),
        )
        if not poses or database is None:
            for where in ("image", "space"):
                recording.log(f"{PATH}/{where}", rr.Clear(recursive=True))
            return
        K = artifacts["near_camera"].K
        outlines, axes = [], []
        for pose in poses:
            part = database.parts[database.names.index(pose["object"])]
            outlines.append(outline_m(pose, part, database.mm_per_px))
            axes += axes_of(pose)
        flat = [project(line, K) for line in outlines]
        flat_axes = [project(np.array(line), K) for line in axes]
        colours = list(AXIS_COLOURS) * len(poses)
        recording.log(
            f"{PATH}/image/outline", rr.LineStrips2D(flat, colors=MODEL_COLOUR, radii=0.6)
        )
        recording.log(f"{PATH}/image/axes", rr.LineStrips2D(flat_axes, colors=colours, radii=1.0))
        recording.log(
            f"{PATH}/space/outline", rr.LineStrips3D(outlines, colors=MODEL_COLOUR, radii=0.0004)
        )
        recording.log(f"{PATH}/space/axes", rr.LineStrips3D(axes, colors=colours, radii=0.0007))
        cloud = artifacts.get("cloud_xyz_m")
        if cloud is not None:
            recording.log(
                f"{PATH}/space/cloud",
                rr.Points3D(cloud[::2], colors=(140, 140, 150), radii=0.0004),
            )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from .show import DARK, eye_above

        points = logged.artifacts.get("cloud_xyz_m")
        return [
            rrb.Spatial2DView(
                origin=PATH,
                contents=[f"{PATH}/intensity", f"{PATH}/image/**"],
                name="pose (x red, y green, z blue)",
            ),
            rrb.Spatial3DView(
                origin=f"{PATH}/space",
                name="pose in space",
                background=DARK,
                eye_controls=None if points is None or not len(points) else eye_above(points),
            ),
            rrb.TextDocumentView(origin=f"{PATH}/text", name="pose and grasp"),
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        from .wording import apart

        label = int(artifacts["labels"][y, x])
        about = f"region {label}" if label else "no region"
        pose = next((one for one in artifacts["poses"] if one["region"] == label), None)
        if pose is None:
            says = "not in a surface that was picked, so it has no pose"
            return [Finding(says, {"labels": label}, None, "no pose", about)]
        tilted = f"{pose['object']} turned by {pose['rotation_deg']:.2f}°"
        settled = {
            "outline": "its outline leaves no other turn",
            "range": "its outline leaves other turns, which the depth around it rules out",
            "open": "its outline leaves others, and the depth around it does not tell: "
            + ", ".join(f"{other:.1f}°" for other in pose["open_rotations_deg"]),
        }[pose["settled_by"]]
        values = {"labels": label, "rotation_deg": pose["rotation_deg"]}
        held = {"distance": pose["distance"], "zeta": pose["zeta"]}
        over = "not over" if pose["accepted"] else "over"
        verdict = "pose" if pose["accepted"] else "doubtful pose"
        return [
            Finding(f"{tilted}: {settled}", values),
            Finding(
                f"outline {apart(pose['distance'], pose['zeta'], 3)} from the manifold, {over} ζ "
                f"{pose['zeta']:.3f}",
                held,
                "zeta_scale",
                verdict,
                about,
            ),
        ]

    def scorer(self) -> Scorer:
        from .matching.scorers import PoseScorer

        return PoseScorer()

"""Stage ``depth_cloud``: depth, confidence and a point cloud (sections 3.1 and 3.2, step two)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from stages.artifacts import (
    CALIBRATION,
    CLOUD,
    CLOUD_INTENSITY,
    CLOUD_NORMALS,
    CONFIDENCE,
    DEPTH,
    FAR,
    FOCUS_FAR,
    FOCUS_NEAR,
    INTENSITY,
    NEAR,
    NEAR_CAMERA,
    RELATIVE,
    SATURATED,
    STRIPES,
)
from workbench.stage import (
    WARNINGS,
    Cut,
    Finding,
    Histogram,
    Inputs,
    Logged,
    Outputs,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

RELATIVE_NOTE = "no calibration: depth is relative (0 near, 1 far), not metres"
_WINDOW_WITHOUT_STRIPES_PX = 7.0
_SATURATED_SHARE = 0.03
_ERROR_PICTURE_MM = 3.0


class DepthCloud(Stage):
    """Depth along the optical axis, its confidence, and the cloud in ``camera_optical_frame``.

    The ratio of the focus maps goes through the calibrated curve of its pixel; windows stop at
    depth edges (see ``stages/dfd/depth.py``).  Depth is NaN where it cannot be known: no energy,
    saturated, outside the range in which it is unique, or a predicted error that is too large.
    Without a calibration ``depth_relative`` alone is given and ``depth_m`` is all NaN.
    """

    name = "depth_cloud"
    chapter = "sensor"
    published_time = "100 (10 depth maps a second, in hardware of 2003)"
    needs = (
        FOCUS_NEAR,
        FOCUS_FAR,
        NEAR,
        FAR,
        INTENSITY,
        SATURATED,
        STRIPES,
        CALIBRATION,
        NEAR_CAMERA,
    )
    gives = (DEPTH, RELATIVE, CONFIDENCE, CLOUD, CLOUD_NORMALS, CLOUD_INTENSITY)

    class Parameters(StageParameters):
        edge_aware: bool = knob(
            True,
            "Let windows stop at depth edges instead of mixing the two surfaces across them.",
        )
        smoothing_periods: float = knob(
            1.4,
            "Side of the second averaging, on top of the focus window: larger is smoother inside "
            "faces and bleeds further at their edges.",
            low=0.2,
            high=4,
            step=0.2,
            unit="stripe periods",
        )
        reach_periods: float = knob(
            1.2,
            "How far away a pixel looks for a window that lies on its own surface.",
            low=0.2,
            high=4,
            step=0.2,
            unit="stripe periods",
        )
        half_confidence_error_percent: float = knob(
            3.3,
            "The predicted error at which confidence is one half.",
            low=0.2,
            high=50,
            step=0.1,
            unit="% of working range",
        )
        min_confidence: float = knob(
            0.5,
            "Depth of less confidence than this is given as unknown.",
            low=0,
            high=1,
            step=0.01,
        )
        min_modulation: float = knob(
            0.86,
            "Share of the calibrated contrast of the stripes that a neighbourhood must show: "
            "with less, it lies beyond the focal planes, where depth is not unique.",
            low=0,
            high=1,
            step=0.01,
        )
        range_margin_percent: float = knob(
            1.0,
            "How far outside the calibrated range a depth may fall by noise before it is given "
            "as unknown; beyond the focal planes the curve folds back.",
            low=0,
            high=10,
            step=0.5,
            unit="% of working range",
        )

    presets = {"paper": {"edge_aware": False, "smoothing_periods": 0.2, "min_confidence": 0.1}}

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        import cv2
        import numpy as np

        from stages.dfd import depth as dfd
        from stages.dfd.focus import SensorNoise
        from stages.dfd.stripes import whole_period_taps

        calibration, stripes = inputs["calibration"], inputs["stripes"]
        near, far = inputs["near"], inputs["far"]
        period_px = stripes.extent_px() if stripes is not None else _WINDOW_WITHOUT_STRIPES_PX
        windows = dfd.windows_for(period_px, parameters.smoothing_periods, parameters.reach_periods)
        taps = whole_period_taps(min(period_px, *near.shape))
        brightness = cv2.sepFilter2D(
            near + far, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101
        )
        if calibration is not None:
            response = dfd.Response(
                calibration.curve,
                calibration.modulation,
                calibration.slope,
                calibration.noise,
                calibration.laplacian,
            )
        else:
            response = dfd.Response(dfd.NOMINAL_CURVE, None, 0.5, SensorNoise(), "opencv")
        relative, error_percent = dfd.estimate(
            inputs["focus_near"],
            inputs["focus_far"],
            brightness,
            inputs["intensity"],
            response,
            windows,
            parameters.edge_aware,
        )
        confidence = dfd.confidence_from_error(
            error_percent, parameters.half_confidence_error_percent
        )
        if inputs["saturated"].any():
            share = cv2.blur(
                inputs["saturated"].astype(np.float32), (windows.scatter_px, windows.scatter_px)
            )
            confidence[share > _SATURATED_SHARE] = 0
        margin = parameters.range_margin_percent / 100
        unknown = (
            (confidence < parameters.min_confidence)
            | (confidence <= 0)
            | (relative < -margin)
            | (relative > 1 + margin)
        )
        relative[unknown] = np.nan
        if calibration is not None:
            folded = dfd.folded_back(
                inputs["focus_near"] + inputs["focus_far"],
                brightness,
                relative,
                calibration.modulation,
                period_px,
                parameters.min_modulation,
            )
            relative[folded] = np.nan
            confidence[folded] = 0
        warnings: list[str] = []
        if calibration is None:
            warnings.append(RELATIVE_NOTE)
            depth_m = np.full_like(relative, np.nan)
        else:
            depth_m = calibration.z_m(relative)
        camera = inputs["near_camera"]
        height, width = depth_m.shape
        if calibration is not None and camera is None:
            warnings.append("no camera calibration in the recording: no point cloud")
        elif camera is not None and (camera.width, camera.height) != (width, height):
            warnings.append(
                f"the camera calibration is for {camera.width}×{camera.height} pixels, the images "
                f"are {width}×{height}: no point cloud"
            )
            camera = None
        if calibration is None or camera is None:
            points = normals = np.zeros((0, 3), np.float32)
            shade = np.zeros(0, np.float32)
        else:
            from stages.dfd.cloud import cloud_from_depth

            points, normals, shade = cloud_from_depth(
                depth_m, inputs["intensity"], camera, windows.slope_px
            )
        return {
            "depth_m": depth_m,
            "depth_relative": relative,
            "confidence": confidence,
            "cloud_xyz_m": points,
            "cloud_normals": normals,
            "cloud_intensity": shade,
            WARNINGS: warnings,
        }

    def log(self, recording: Any, logged: Logged) -> None:
        import numpy as np
        import rerun as rr

        from stages import show

        artifacts = logged.artifacts
        depth_m, confidence = artifacts["depth_m"], artifacts["confidence"]
        calibration = artifacts.get("calibration")
        if calibration is not None:
            low, high = calibration.near_z_m, calibration.far_z_m
            middle = (low + high) / 2
            ticks = (f"{1e3 * low:.0f} mm", f"{1e3 * middle:.0f} mm", f"{1e3 * high:.0f} mm")
            show.log_map(recording, "depth_cloud/depth", depth_m, low, high, "turbo", ticks)
        else:
            show.log_map(
                recording,
                "depth_cloud/depth",
                artifacts["depth_relative"],
                0,
                1,
                "turbo",
                ("0 near", "relative", "1 far"),
            )
        show.log_map(
            recording, "depth_cloud/confidence", confidence, 0, 1, "viridis", ("0", "0.5", "1")
        )
        camera = artifacts.get("near_camera")
        if camera is not None:
            recording.log("world", rr.ViewCoordinates.RDF, static=True)
            recording.log(
                "world/camera",
                rr.Pinhole(
                    image_from_camera=camera.K,
                    resolution=(camera.width, camera.height),
                    image_plane_distance=_frustum_m(artifacts["cloud_xyz_m"]),
                ),
            )
            recording.log("world/camera/image", show.grey_image(artifacts["intensity"]))
        points = artifacts["cloud_xyz_m"]
        shade = artifacts["cloud_intensity"]
        top = max(float(shade.max(initial=0)), 1e-6)
        grey = np.clip(40 + 215 * shade / top, 0, 255).astype(np.uint8)
        recording.log(
            "world/cloud",
            rr.Points3D(points, colors=np.repeat(grey[:, None], 3, axis=1), radii=0.0003),
        )
        if len(points):
            some = slice(None, None, 53)
            recording.log(
                "world/cloud/normals",
                rr.Arrows3D(
                    origins=points[some],
                    vectors=artifacts["cloud_normals"][some] * 0.004,
                    colors=(90, 200, 255),
                    radii=0.0001,
                ),
            )
        recording.log("depth_cloud/coverage", rr.Scalars(float(np.isfinite(depth_m).mean())))
        truth = logged.truth
        if calibration is None or truth is None or truth.depth_m is None:
            return
        if truth.depth_m.shape == depth_m.shape:
            error_mm = (depth_m - truth.depth_m) * np.float32(1e3)
            show.log_signed_error(recording, "depth_cloud/error_mm", error_mm, _ERROR_PICTURE_MM)

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        from stages.show import DARK, eye_above, map_view

        shape = logged.artifacts["depth_m"].shape
        calibrated = logged.artifacts.get("calibration") is not None
        pictures = [
            map_view(
                "depth_cloud/depth",
                "depth" if calibrated else "RELATIVE depth (no calibration)",
                shape,
            ),
            map_view("depth_cloud/confidence", "confidence", shape),
        ]
        if calibrated and logged.truth is not None and logged.truth.depth_m is not None:
            pictures.append(
                map_view("depth_cloud/error_mm", "depth minus truth (blue: too near)", shape)
            )
        columns: list[Any] = [rrb.Vertical(*pictures, name=self.name)]
        points = logged.artifacts["cloud_xyz_m"]
        if len(points):
            columns.append(
                rrb.Spatial3DView(
                    origin="world",
                    name="cloud, camera_optical_frame",
                    eye_controls=eye_above(points),
                    background=DARK,
                )
            )
        return columns

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        import numpy as np

        confidence = float(artifacts["confidence"][y, x])
        z = float(artifacts["depth_m"][y, x])
        values = {"confidence": confidence, "depth_m": z}
        if np.isfinite(z):
            says = f"depth {1e3 * z:.2f} mm, confidence {confidence:.2f}"
        elif confidence < p.min_confidence:
            says = f"unknown: confidence {confidence:.2f} is under {p.min_confidence:g}"
        else:
            says = "unknown: outside the range in which depth is unique"
        return [Finding(says, values, "min_confidence")]

    def histograms(self, artifacts: Mapping[str, Any], p: Any) -> list[Histogram]:
        import numpy as np

        counts, edges = np.histogram(artifacts["confidence"], bins=100, range=(0, 1))
        least = Cut("unknown below", p.min_confidence, "min_confidence")
        return [Histogram("confidence", edges, counts, [least])]

    def scorer(self) -> Scorer:
        from stages.dfd.score import DepthScorer

        return DepthScorer()


def _frustum_m(points: Any) -> float:
    """How far before the camera its image is drawn: just above the nearest points."""
    import numpy as np

    return 0.86 * float(np.percentile(points[:, 2], 1)) if len(points) else 0.1

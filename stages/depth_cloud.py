"""Stage ``depth_cloud``: depth, confidence and a point cloud (sections 3.1 and 3.2, step two)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from workbench.stage import (
    WARNINGS,
    Cut,
    Finding,
    Histogram,
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
    CLOUD,
    CLOUD_INTENSITY,
    CLOUD_NORMALS,
    CONFIDENCE,
    DEPTH,
    FAR,
    FOCUS_FAR,
    FOCUS_NEAR,
    FOCUS_NOISE,
    INTENSITY,
    NEAR,
    NEAR_CAMERA,
    RELATIVE,
    SATURATED,
    STRIPES,
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
        FOCUS_NOISE,
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
        texture_half_confidence_error_percent: float = knob(
            12.0,
            "The same where depth comes from the scene's own texture and the optics alone: what "
            "lies in a window differs from place to place, and so does its blur.",
            low=0.2,
            high=100,
            step=0.5,
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

    def compute(self, inputs: Inputs, parameters: Any) -> Iterator[Outputs]:
        import numpy as np

        from .dfd import depth as dfd

        calibration = inputs["calibration"]
        measured = _measure(inputs, parameters)
        relative, confidence = measured.relative, measured.confidence
        relative[_unsure(measured, parameters)] = np.nan
        if calibration is not None and calibration.modulation.size:
            folded = dfd.folded_back(
                inputs["focus_near"] + inputs["focus_far"],
                measured.brightness,
                relative,
                calibration.modulation,
                measured.period_px,
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
        yield {
            "depth_m": depth_m,
            "depth_relative": relative,
            "confidence": confidence,
            WARNINGS: warnings,
        }
        yield _cloud(depth_m, inputs, measured.windows.slope_px)

    def log(self, recording: Any, logged: Logged) -> None:
        import numpy as np
        import rerun as rr

        from . import show

        artifacts = logged.artifacts
        depth_m, confidence = artifacts["depth_m"], artifacts["confidence"]
        calibration = artifacts.get("calibration")
        if calibration is not None and calibration.texture is not None:
            # The range may be wide: in 1/z, in which it is measured, it is seen evenly.
            low, middle, high = (float(z) for z in calibration.z_m(np.array([0, 0.5, 1])))
            ticks = (f"{1e3 * low:.0f} mm", f"{1e3 * middle:.0f} mm", f"{1e3 * high:.0f} mm")
            relative = artifacts["depth_relative"]
            show.log_map(recording, "depth_cloud/depth", relative, 0, 1, "turbo", ticks)
        elif calibration is not None:
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
        camera, points = artifacts.get("near_camera"), artifacts.get("cloud_xyz_m")
        if camera is not None and points is not None:
            recording.log("world", rr.ViewCoordinates.RDF, static=True)
            recording.log(
                "world/camera",
                rr.Pinhole(
                    image_from_camera=camera.K,
                    resolution=(camera.width, camera.height),
                    image_plane_distance=_frustum_m(points),
                ),
            )
            recording.log("world/camera/image", show.grey_image(artifacts["intensity"]))
        if points is not None:
            shade = artifacts["cloud_intensity"]
            top = max(float(shade.max(initial=0)), 1e-6)
            grey = np.clip(40 + 215 * shade / top, 0, 255).astype(np.uint8)
            recording.log(
                "world/cloud",
                rr.Points3D(points, colors=np.repeat(grey[:, None], 3, axis=1), radii=0.0003),
            )
        if points is not None and len(points):
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

        from .show import DARK, eye_above, map_view

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
        points = logged.artifacts.get("cloud_xyz_m")
        if points is not None and len(points):
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

        from .dfd import depth as dfd
        from .wording import apart

        calibration = artifacts.get("calibration")
        # What was unknown is NaN in the artifacts: its values are measured again.
        measured = _measure({need.name: artifacts.get(need.name) for need in self.needs}, p)
        relative, confidence = measured.relative[y, x], measured.confidence[y, x]
        error = measured.error_percent[y, x]
        half_name, half = _half_confidence(calibration, p)
        trust = dfd.confidence_from_error(measured.error_percent[y : y + 1, x : x + 1], half)[0, 0]
        given = {
            "depth_m": artifacts["depth_m"][y, x],
            "depth_relative": artifacts["depth_relative"][y, x],
            "confidence": artifacts["confidence"][y, x],
        }
        own = "windows on its own surface" if p.edge_aware else "one window"
        findings = [
            Finding(
                f"the ratio of the focus maps over {own} gives relative depth {relative:.3f} "
                "(0 near, 1 far)",
                {"relative_measured": relative},
                "edge_aware",
            ),
            Finding(
                f"predicted error {error:.2f} % of the working range: confidence {trust:.3f}",
                {"error_percent": error},
                half_name,
            ),
        ]
        share = measured.saturated_share
        if share is not None and share[y, x] > 0:
            over = share[y, x] > _SATURATED_SHARE
            findings.append(
                Finding(
                    f"{100 * share[y, x]:.1f} % of the window is saturated, "
                    + ("over" if over else "not over")
                    + f" {100 * _SATURATED_SHARE:g} %"
                    + (": confidence 0" if over else ""),
                    {"saturated_share": share[y, x]},
                )
            )
        low = bool(confidence < p.min_confidence or confidence <= 0)
        findings.append(
            Finding(
                f"confidence {apart(confidence, p.min_confidence, 3)} is "
                f"{'under' if low else 'not under'} "
                f"{p.min_confidence:g}",
                given if low else {},
                "min_confidence",
                "unknown" if low else "",
            )
        )
        margin = p.range_margin_percent / 100
        outside = bool(relative < -margin or relative > 1 + margin)
        end = -margin if relative < 0.5 else 1 + margin
        findings.append(
            Finding(
                f"relative depth {apart(relative, end, 3)} lies "
                f"{'outside' if outside else 'within'} "
                f"{-margin:.3f} to {1 + margin:.3f}",
                given if outside else {},
                "range_margin_percent",
                "unknown" if outside else "",
            )
        )
        folded = False
        if calibration is not None and calibration.modulation.size:
            kept = measured.relative.copy()
            kept[_unsure(measured, p)] = np.nan
            cells = dfd.contrast_of_cells(
                artifacts["focus_near"] + artifacts["focus_far"],
                measured.brightness,
                kept,
                calibration.modulation,
                measured.period_px,
            )
            shown, enough = (dfd.on_pixels(cell, kept.shape)[y, x] for cell in cells)
            folded = bool(shown < np.float32(p.min_modulation) * enough)
            if enough > 0:
                contrast = shown / enough
                findings.append(
                    Finding(
                        f"the stripes around show {apart(contrast, p.min_modulation, 3)} of the "
                        "calibrated contrast, "
                        + ("under" if folded else "not under")
                        + f" {p.min_modulation:g}"
                        + (": beyond the focal planes, confidence is given as 0" if folded else ""),
                        {"modulation_share": contrast, **(given if folded else {})},
                        "min_modulation",
                        "unknown" if folded else "",
                    )
                )
        if low or outside or folded:
            return findings
        if calibration is None:
            says = f"relative depth {relative:.3f}; there are no metres without a calibration"
            return [*findings, Finding(says, given, None, "relative")]
        says = f"depth {1e3 * given['depth_m']:.2f} mm with confidence {given['confidence']:.3f}"
        return [*findings, Finding(says, given, None, "known")]

    def histograms(self, artifacts: Mapping[str, Any], p: Any) -> list[Histogram]:
        import numpy as np

        counts, edges = np.histogram(artifacts["confidence"], bins=100, range=(0, 1))
        least = Cut("unknown below", p.min_confidence, "min_confidence")
        return [Histogram("confidence", edges, counts, [least])]

    def scorer(self) -> Scorer:
        from .dfd.score import DepthScorer

        return DepthScorer()

    def figures(self, artifacts: Mapping[str, Any]) -> list[Score]:
        import numpy as np

        known = float(np.isfinite(artifacts["depth_relative"]).mean())
        trust = float(artifacts["confidence"].mean())
        return [
            Score("coverage", known, better="higher"),
            Score("confidence", trust, better="higher"),
        ]

    def picture(self, artifacts: Mapping[str, Any]) -> Any:
        from .pictures import depth_rgb

        return depth_rgb(artifacts["depth_relative"], 0.0, 1.0)


def _cloud(depth_m: Any, inputs: Inputs, reach_px: int) -> Outputs:
    """The cloud of a depth map; empty, with a warning, where it cannot be placed in space."""
    import numpy as np

    from .dfd.cloud import cloud_from_depth

    calibration, camera = inputs["calibration"], inputs["near_camera"]
    height, width = depth_m.shape
    warnings = []
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
        points, normals, shade = cloud_from_depth(depth_m, inputs["intensity"], camera, reach_px)
    return {
        "cloud_xyz_m": points,
        "cloud_normals": normals,
        "cloud_intensity": shade,
        WARNINGS: warnings,
    }


@dataclass(frozen=True)
class _Measured:
    """Depth before it is decided where it is known.

    ``relative``, ``error_percent``, ``confidence`` and ``brightness`` (the sum of near and far) are
    float32 [H W]; so is ``saturated_share``, of a neighbourhood, or None where nothing saturates.
    """

    relative: Any
    error_percent: Any
    confidence: Any
    brightness: Any
    saturated_share: Any
    windows: Any
    period_px: float


def _unsure(measured: _Measured, parameters: Any) -> Any:
    """Where confidence is too low or depth lies outside the calibrated range, bool [H W]."""
    margin = parameters.range_margin_percent / 100
    return (
        (measured.confidence < parameters.min_confidence)
        | (measured.confidence <= 0)
        | (measured.relative < -margin)
        | (measured.relative > 1 + margin)
    )


def _half_confidence(calibration: Any, parameters: Any) -> tuple[str, float]:
    """Name and value of the parameter that says at which predicted error confidence is one half."""
    of_texture = calibration is not None and calibration.texture is not None
    name = "half_confidence_error_percent"
    name = f"texture_{name}" if of_texture else name
    return name, getattr(parameters, name)


def _measure(inputs: Mapping[str, Any], parameters: Any) -> _Measured:
    """Relative depth and its confidence at every pixel."""
    import cv2
    import numpy as np

    from .dfd import depth as dfd
    from .dfd.focus import SensorNoise
    from .dfd.stripes import whole_period_taps

    calibration, stripes = inputs["calibration"], inputs["stripes"]
    near, far = inputs["near"], inputs["far"]
    texture = calibration.texture if calibration is not None else None
    scale_px = texture.scale_px if texture is not None else 1
    period_px = _WINDOW_WITHOUT_STRIPES_PX if stripes is None else stripes.extent_px()
    period_px *= scale_px
    windows = dfd.windows_for(period_px, parameters.smoothing_periods, parameters.reach_periods)
    # The pixels of an image that was shrunk are all the independent samples that there are.
    windows = replace(windows, samples=max(1.0, windows.samples / scale_px**2))
    taps = whole_period_taps(min(period_px, *near.shape))
    brightness = cv2.sepFilter2D(
        near + far, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101
    )
    if calibration is not None:
        response = dfd.Response(
            calibration.curve,
            calibration.modulation if calibration.modulation.size else None,
            calibration.slope,
            inputs["focus_noise"],
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
        error_percent, _half_confidence(calibration, parameters)[1]
    )
    share = None
    if inputs["saturated"].any():
        share = cv2.blur(
            inputs["saturated"].astype(np.float32), (windows.scatter_px, windows.scatter_px)
        )
        confidence[share > _SATURATED_SHARE] = 0
    return _Measured(relative, error_percent, confidence, brightness, share, windows, period_px)


def _frustum_m(points: Any) -> float:
    """How far before the camera its image is drawn: just above the nearest points."""
    import numpy as np

    return 0.86 * float(np.percentile(points[:, 2], 1)) if len(points) else 0.1

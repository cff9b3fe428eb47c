"""The artifacts that this product's stages exchange: one declaration each, shared by both ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from workbench.stage import Artifact, Resource, recorded_camera, recorded_image

NEAR_IMAGE = recorded_image("near", "sensor focused on the near plane, pattern on")
FAR_IMAGE = recorded_image("far", "sensor focused on the far plane, pattern on")
FLAT_IMAGE = recorded_image("flat", "pattern off, on the near sensor's grid").optional()
NEAR_CAMERA = recorded_camera("near", "intrinsics of the near sensor").optional()


def _load_calibration(path: Path) -> Any:
    from .dfd.calibration import Calibration

    return Calibration.load(path)


CALIBRATION = Resource(
    "calibration",
    doc="both steps of section 3.2",
    required=False,
    load=_load_calibration,
    make="workbench_stages.dfd.procedure:Procedure",
    filename="calibration.npz",
)


def _load_models(path: Path) -> Any:
    from .matching.database import Database

    return Database.load(path)


MODELS = Resource(
    "models",
    doc="features and eigenspaces of the parts (sections 5 and 6)",
    required=False,
    load=_load_models,
    make="workbench_stages.matching.procedure:Procedure",
    filename="models.npz",
)

NEAR = Artifact("near", "float32", "H W", "grey levels", "near image")
FAR = Artifact("far", "float32", "H W", "grey levels", "far image on the near image's grid")
INTENSITY = Artifact(
    "intensity", "float32", "H W", "grey levels", "flat image, or stripes averaged out"
)
SATURATED = Artifact("saturated", "bool", "H W", "", "at full scale in near or far")
STRIPES = Artifact("stripes", doc="period and direction of the projected stripes, or None")
DRIFT = Artifact(
    "registration_drift_px", doc="root mean square misalignment left over the image, pixels"
)
FULL_SCALE = Artifact("full_scale", doc="grey level at which the sensors saturate; inf if unknown")
GAIN_DRIFT = Artifact("gain_drift", doc="near over far light, against the calibration; 1 is none")

FOCUS_NEAR = Artifact("focus_near", "float32", "H W", "grey levels", "focus measure, near")
FOCUS_FAR = Artifact("focus_far", "float32", "H W", "grey levels", "focus measure, far")
FOCUS_NOISE = Artifact("focus_noise", doc="noise of the images in which focus was measured")

DEPTH = Artifact("depth_m", "float32", "H W", "m", "z along the optical axis; NaN where unknown")
RELATIVE = Artifact(
    "depth_relative",
    "float32",
    "H W",
    "",
    "0 at the near end of the working range, 1 at the far end, linear in 1/z; NaN where unknown",
)
CONFIDENCE = Artifact("confidence", "float32", "H W", "0..1", "trust in the depth")
CLOUD = Artifact("cloud_xyz_m", "float32", "N 3", "m", "points in camera_optical_frame")
CLOUD_NORMALS = Artifact("cloud_normals", "float32", "N 3", "", "unit normals, to the camera")
GRADIENT = Artifact(
    "gradient", "float32", "H W", "grey levels", "magnitude of the operator's gradient"
)
EDGES_LOW = Artifact("edges_low", "bool", "H W", "", "low resolution: the coarsest image")
EDGES_MEDIUM = Artifact("edges_medium", "bool", "H W", "", "medium resolution, contains the low")
EDGES_HIGH = Artifact("edges_high", "bool", "H W", "", "high resolution, contains the medium")
EDGE_CHOICE = Artifact("edge_choice", doc="how the thresholds were chosen, and what the links need")

EDGES_RECONSTRUCTED = Artifact("edges_reconstructed", "bool", "H W", "", "after section 4.1")
TERMINATORS = Artifact("terminators", "int32", "N 2", "px", "(x, y) of each end before linking")
DIRECTIONS = Artifact("terminator_directions", "float32", "N 2", "", "unit vectors, outwards")
LINKS = Artifact("links", "bool", "H W", "", "pixels that links added")
EDGES_LINKED = Artifact("edges_linked", "bool", "H W", "", "after section 4.2")
REGION_LINES = Artifact("region_lines", "bool", "H W", "", "what bounds regions")
EDGE_STEP = Artifact("edge_step", "uint8", "H W", "", "which step decided on the pixel")
EDGE_VALUE = Artifact("edge_value", "float32", "H W", "", "the value by which it decided")
LINKING = Artifact("linking", doc="each iteration of the reconstruction, and every link")

LABELS = Artifact(
    "labels", "int32", "H W", "", "region of each pixel, 0 = none", names_regions=True
)
REGIONS = Artifact("regions", doc="one row a region, a numpy structured array; see the stage")

CANDIDATES = Artifact("candidates", doc="one row a candidate, a structured array; see the stage")
VERDICT = Artifact("verdict", doc="pick or rearrange, region, object and reason; or None")
POSES = Artifact("poses", doc="a list of plain objects, one for each picked surface; see the stage")

CLOUD_INTENSITY = Artifact("cloud_intensity", "float32", "N", "grey levels", "brightness")

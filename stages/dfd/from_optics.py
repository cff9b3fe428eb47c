"""``workbench calibrate --from-optics``: a calibration from the lens's data alone.

For pictures that come with focal length, f-number, pixel pitch and two focus distances, and with
no planes of known distance.  What is assumed is in :mod:`dfd.texture` and in the report.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from workbench.stage import StageParameters, knob

from ..optics.rig import CHANNELS, Rig
from ..optics.thin_lens import object_distance_mm
from .calibration import Calibration
from .focus import LaplacianKind, SensorNoise
from .similarity import Similarity
from .texture import texture_curve

SMALLEST_BLUR_PX = 0.7
"""Blur circle at the other focal plane under which there is no difference of sharpness to see."""

_REQUIRED = ("focal_length_mm", "f_number")
_PITCH = ("pixel_pitch_mm", "sensor_width_mm")
_NEAR = ("near_focus_mm", "near_sensor_mm")
_FAR = ("far_focus_mm", "far_sensor_mm", "sensor_separation_mm")
_INFINITY_MM = 1e7
_FURTHEST_DIOPTRES = 0.02
"""The least 1/z of the working range, as a share of what lies between the focal planes."""
_ASSUMED = (
    "a thin lens with a round aperture, distances from its centre; grey levels linear in light; "
    "a texture's spectrum is measured in each window, and taken as 1/frequency where a disc "
    "departs from a Gaussian; registration, balance of light and noise are measured on each pair"
)


class OpticsParameters(StageParameters):
    """The knobs of a calibration from optics."""

    beyond_percent: float = knob(
        10.0,
        "How far beyond the focal planes depth is still given, as far as the optics keep it "
        "unique: what lies in a focal plane falls on either side of it by noise.",
        low=0,
        high=30,
        step=5,
        unit="% between the focal planes, in 1/z",
    )


def read_rig(path: Path, size: tuple[int, int] | None = None) -> Rig:
    """The rig in a TOML file, for pictures of ``size`` = (width, height).

    The keys are those of :class:`optics.rig.Rig`, of which nothing optical may be left out
    here: a default would be a guess about somebody's lens.  The focal planes are given by
    ``near_focus_mm`` and ``far_focus_mm`` (inf is allowed) or ``sensor_separation_mm``, or by the
    sensor's distances behind the lens, ``near_sensor_mm`` and ``far_sensor_mm``; the pixels by
    ``pixel_pitch_mm``, or by ``sensor_width_mm`` if the images show the whole sensor.  Without
    ``[projector]`` there is none, and without ``registered`` near and far differ in magnification
    as the lens law says.  Raises ``ValueError`` with one line.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: expected TOML: {error}") from error
    missing = [key for key in _REQUIRED if key not in values]
    missing += [
        " or ".join(keys) for keys in (_PITCH, _NEAR, _FAR) if not values.keys() & set(keys)
    ]
    if missing:
        raise ValueError(f"{path}: missing {', '.join(missing)}")
    for keys in (_PITCH, _NEAR, _FAR):
        both = [key for key in keys if key in values]
        if len(both) > 1:
            raise ValueError(f"{path}: expected one of {', '.join(both)}, found {len(both)}")
    try:
        values = _focus_distances(values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if size is not None:
        width, height = size
        stated = (values.get("width_px", width), values.get("height_px", height))
        if stated != size:
            raise ValueError(
                f"{path}: width_px and height_px are {stated[0]}×{stated[1]}, "
                f"the images are {width}×{height}"
            )
        values |= {"width_px": width, "height_px": height}
    if "sensor_width_mm" in values:
        sensor_mm, pixels = values.pop("sensor_width_mm"), values.get("width_px")
        if pixels is None:
            raise ValueError(f"{path}: sensor_width_mm: expected the images' size to go with it")
        if not _is_number(sensor_mm) or not _is_number(pixels) or not pixels > 0:
            raise ValueError(f"{path}: sensor_width_mm: expected a number, found {sensor_mm!r}")
        values["pixel_pitch_mm"] = sensor_mm / pixels
    return Rig.from_values({"projector": None, "registered": False} | values, str(path))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _focus_distances(values: dict[str, Any]) -> dict[str, Any]:
    """Sensor distances as focus distances; infinity as a distance that a lens can be told of."""
    values = dict(values)
    for name in ("near", "far"):
        sensor = values.pop(f"{name}_sensor_mm", None)
        if sensor is not None:
            if not (_is_number(sensor) and _is_number(values["focal_length_mm"])):
                raise ValueError(f"{name}_sensor_mm: expected a number, found {sensor!r}")
            values[f"{name}_focus_mm"] = object_distance_mm(values["focal_length_mm"], sensor)
    if values.get("far_focus_mm") == math.inf:
        values["far_focus_mm"] = _INFINITY_MM
    return values


def from_optics(
    rig: Rig,
    size: tuple[int, int] | None,
    parameters: OpticsParameters,
    laplacian: LaplacianKind = "opencv",
) -> Calibration:
    """The calibration of ``rig`` for images of ``size`` = (width, height), or of any size.

    Raises ``ValueError`` with one line where the optics give no unique range.
    """
    near_mm, far_mm = rig.near_focus_mm, rig.far_focus_mm
    planes = f"between the focal planes {near_mm:.4g} and {far_mm:.4g} mm"
    blur_px = abs(float(rig.blur_px("near", far_mm)))
    if not blur_px >= SMALLEST_BLUR_PX:
        raise ValueError(
            f"no unique range {planes}: the blur circle at the other plane is {blur_px:.2g} px, "
            f"expected {SMALLEST_BLUR_PX:g} px or more (focal planes further apart, a larger "
            "aperture or smaller pixels)"
        )
    period_px = None
    if rig.projector is not None and rig.projector.pattern != "none":
        period_px = rig.period_px("near")
        # Raises where the blur outgrows the pattern.
        rig.working_range_mm  # noqa: B018
    curve = texture_curve(blur_px, laplacian, period_px)
    beyond = parameters.beyond_percent / 100
    near_inverse, far_inverse = 1e3 / near_mm, 1e3 / far_mm
    between = near_inverse - far_inverse
    low = max(-beyond, curve.low)
    high = min(1 + beyond, curve.high, (near_inverse / between) - _FURTHEST_DIOPTRES)
    # From relative depth between the focal planes to that between the ends of the range.
    coefficients = curve.coefficients.astype(np.float64)
    coefficients[0] -= low
    coefficients /= high - low
    near_z_m = 1 / (near_inverse - low * between)
    far_z_m = 1 / (near_inverse - high * between)
    width, height = size or (0, 0)
    scale = 1.0 if rig.registered else rig.sensor_mm("far") / rig.sensor_mm("near")
    dx_px = dy_px = 0.0
    if size is not None:
        dx_px, dy_px = (
            (1 - scale) * (at - (side - 1) / 2)
            for at, side in zip(rig.centre_px, size, strict=True)
        )
    similarity = Similarity(scale, 0.0, dx_px, dy_px, width, height)
    report: dict[str, Any] = {
        "from": "optics alone",
        "focal_planes_mm": [near_mm, far_mm],
        "working_range_mm": [1e3 * near_z_m, 1e3 * far_z_m],
        "unique_relative_depth": [curve.low, curve.high],
        "blur_at_other_plane_px": blur_px,
        "focus_measured_on_images_shrunk_by": curve.texture.scale_px,
        "magnification_far_over_near": scale,
        "curve_worst_percent": 100 * curve.worst,
        "image_size": f"{width}×{height}" if size else "any",
        "assumed": _ASSUMED,
    }
    return Calibration(
        similarity,
        None,
        laplacian,
        coefficients.astype(np.float32).reshape(-1, 1, 1),
        near_z_m,
        far_z_m,
        np.zeros(0, np.float32),
        SensorNoise(),
        np.array([1.0, 0, 0, 0, 0, 0]),
        math.inf,
        report,
        curve.texture,
    )


def rig_record(path: Path, size: tuple[int, int]) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """A rig file as a recording holds it: the metadata record, and K [3 3] of each channel.

    For images of ``size`` = (width, height).  Raises ``ValueError`` as :func:`read_rig`.
    """
    rig = read_rig(path, size)
    cameras: dict[str, np.ndarray] = {one: rig.camera_matrix(one) for one in CHANNELS}
    # The flat image is on the near one's grid.
    return rig.to_metadata(), {**cameras, "flat": cameras["near"]}

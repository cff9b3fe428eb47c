"""What a sensor is made of: one lens, two sensors behind it, and a projector.

A rig is read from TOML (``rig.toml``) or from the metadata record ``rig`` of a recording, whose
keys are those of the project's shared recordings.  Everything that follows from the optics (focus
distances, image distances, blur, stripe period) is derived and cannot contradict it.

Frame: ``camera_optical_frame``, origin at the centre of the taking lens, +z forward, x right,
y down; millimetres.
"""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pydantic

from .thin_lens import blur_circle_mm, image_distance_mm, object_distance_mm

Channel = Literal["near", "far"]
Pattern = Literal["stripes", "sine", "checker", "dots", "none"]

CHANNELS: tuple[Channel, Channel] = ("near", "far")

_PATTERN_NAMES: Mapping[str, Pattern] = {
    "stripe": "stripes",
    "stripes": "stripes",
    "sine": "sine",
    "checker": "checker",
    "dots": "dots",
    "none": "none",
}
"""The metadata's names; the shared recordings say ``stripe``."""
_METADATA_NAMES: Mapping[str, str] = {"stripes": "stripe"}

_Positive = pydantic.PositiveFloat
_CONFIG = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Projector(pydantic.BaseModel):
    """A grating imaged onto the scene by a lens of its own.

    Its axis meets the camera's at depth ``focus_mm``; there lies its focal plane, square to its own
    axis, in which the pattern is sharp and its irradiance is 1.
    """

    model_config = _CONFIG

    pattern: Pattern = "stripes"
    lines_per_mm: _Positive = 4.0
    """Periods of the pattern per millimetre of the grating."""
    angle_deg: float = 0.0
    """The direction across the stripes, from +x, counter-clockwise as displayed."""
    focus_mm: _Positive = 750.0
    focal_length_mm: _Positive = 60.0
    f_number: _Positive = 4.4
    position_mm: tuple[float, float, float] = (0.0, -80.0, 0.0)
    """Centre of its lens in the camera's frame."""

    @pydantic.model_validator(mode="after")
    def _can_focus(self) -> Self:
        image_distance_mm(self.focal_length_mm, self.focus_mm)
        return self

    @property
    def aperture_mm(self) -> float:
        """Diameter of its lens's aperture."""
        return self.focal_length_mm / self.f_number

    @property
    def period_mm(self) -> float:
        """Period of the pattern in the projector's focal plane."""
        grating_mm = image_distance_mm(self.focal_length_mm, self.focus_mm)
        return self.focus_mm / grating_mm / self.lines_per_mm

    @property
    def focal_plane_mm(self) -> float:
        """Distance of the focal plane from the projector's lens, along its axis."""
        return float(np.linalg.norm(np.array([0, 0, self.focus_mm]) - self.position_mm))

    @property
    def axes(self) -> np.ndarray:
        """Rows: the projector's x (right), y (down) and z (forward) in the camera's frame, 3 3."""
        forward = (np.array([0, 0, self.focus_mm]) - self.position_mm) / self.focal_plane_mm
        right = np.array([1.0, 0.0, 0.0]) - forward[0] * forward
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(forward, right), forward])

    @property
    def pattern_axes(self) -> np.ndarray:
        """Rows: across and along the stripes in the focal plane, in cycles per millimetre, 2 3."""
        turn = np.deg2rad(self.angle_deg)
        right, down = self.axes[:2] / self.period_mm
        return np.stack(
            [
                np.cos(turn) * right - np.sin(turn) * down,
                np.sin(turn) * right + np.cos(turn) * down,
            ]
        )

    def cycles(self, points_mm: np.ndarray) -> np.ndarray:
        """Where the light at points [... 3] crosses the focal plane, in periods [... 2]."""
        from_lens = points_mm - np.asarray(self.position_mm)
        forward = from_lens @ self.axes[2]
        return from_lens @ self.pattern_axes.T * (self.focal_plane_mm / forward)[..., None]

    def blur_mm(self, points_mm: np.ndarray) -> np.ndarray:
        """Diameter of the pattern's blur at points [... 3], measured in the focal plane."""
        forward = (points_mm - np.asarray(self.position_mm)) @ self.axes[2]
        return self.aperture_mm * np.abs(1 - self.focal_plane_mm / forward)

    def irradiance(self, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """Light of the open projector on surfaces at points [... 3] with unit normals [... 3].

        Inverse square and both cosines, 1 at the distance ``focus_mm`` on its axis; 0 on surfaces
        turned away.
        """
        from_lens = points_mm - np.asarray(self.position_mm)
        distance = np.linalg.norm(from_lens, axis=-1)
        leaving = np.clip(from_lens @ self.axes[2], 0, None) / distance
        arriving = np.clip(-(from_lens * normals).sum(-1), 0, None) / distance
        return (self.focus_mm / distance) ** 2 * leaving * arriving


class Rig(pydantic.BaseModel):
    """The optics of a bifocal sensor; the defaults are those of the project's recordings.

    The far sensor is given by ``sensor_separation_mm`` (b of section 2) or, for a lens that was
    refocused between two exposures, by ``far_focus_mm``.  Raises pydantic's ValidationError, a
    ValueError, where the optics cannot focus.
    """

    model_config = _CONFIG

    focal_length_mm: _Positive = 60.0
    f_number: _Positive = 2.8
    pixel_pitch_mm: _Positive = 0.05
    near_focus_mm: _Positive = 700.0
    sensor_separation_mm: _Positive = 0.8
    width_px: pydantic.PositiveInt = 256
    height_px: pydantic.PositiveInt = 256
    principal_point_px: tuple[float, float] | None = None
    """x and y, pixel centres at integers; the middle of the image if not given."""
    registered: bool = True
    """Both images share the mean magnification, as after step one of the calibration; else each
    has that of its own sensor distance."""
    far_scale: _Positive = 1.0
    """Misregistration of the far image: magnification about the principal point, turn (counter-
    clockwise as displayed) and shift, on top of what the optics do."""
    far_rotation_deg: float = 0.0
    far_shift_px: tuple[float, float] = (0.0, 0.0)
    vignette_distance_mm: float = 0.0
    """A stop in front of the lens that cuts oblique bundles, and its radius; 0 for none."""
    vignette_radius_mm: pydantic.NonNegativeFloat = 0.0
    projector: Projector | None = Projector()

    # -- reading and writing ----------------------------------------------------------------------

    @classmethod
    def from_toml(cls, path: Path) -> Rig:
        """Read ``rig.toml``.  Raises ValueError: one line with the file and what is wrong."""
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ValueError(f"{path}: {error.strerror}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: not TOML: {error}") from error
        return cls.from_values(values, str(path))

    @classmethod
    def from_values(cls, values: Mapping[str, Any], origin: str) -> Rig:
        """A rig from plain values.  Raises ValueError: one line that begins with ``origin``."""
        try:
            return cls.model_validate(values)
        except pydantic.ValidationError as error:
            raise ValueError(f"{origin}: {mistake(error)}") from error

    @classmethod
    def from_metadata(cls, record: Mapping[str, str], origin: str = "metadata rig") -> Rig:
        """A rig from a recording's metadata record ``rig``; keys that say no optics are skipped.

        Raises ValueError where f, Fno, p, u1 or (b or u2) is missing or no number.
        """

        def number(key: str, default: float | None = None) -> float:
            if key not in record:
                if default is None:
                    raise ValueError(f"{origin}: expected the key {key!r}, found {sorted(record)}")
                return default
            try:
                return float(record[key])
            except ValueError as error:
                raise ValueError(
                    f"{origin}: {key}: expected a number, found {record[key]!r}"
                ) from error

        size = number("N", 256)
        values: dict[str, Any] = {
            "focal_length_mm": number("f"),
            "f_number": number("Fno"),
            "pixel_pitch_mm": number("p"),
            "near_focus_mm": number("u1"),
            "width_px": number("width", size),
            "height_px": number("height", size),
            "registered": record.get("raw_mag", "False").lower() not in ("true", "1"),
            "far_scale": number("far_scale", 1.0),
            "far_rotation_deg": number("far_rotation", 0.0),
            "far_shift_px": (number("far_shift_x", 0.0), number("far_shift_y", 0.0)),
            "vignette_distance_mm": number("vig_z", 0.0),
            "vignette_radius_mm": number("vig_r", 0.0),
            "projector": None,
        }
        if "b" in record:
            values["sensor_separation_mm"] = number("b")
        else:
            values["far_focus_mm"] = number("u2")
        if "cx" in record or "cy" in record:
            values["principal_point_px"] = (number("cx"), number("cy"))
        if "grating" in record:
            pattern = record.get("pattern", "stripe")
            if pattern not in _PATTERN_NAMES:
                raise ValueError(
                    f"{origin}: pattern: expected one of {', '.join(_PATTERN_NAMES)}, "
                    f"found {pattern!r}"
                )
            values["projector"] = {
                "pattern": _PATTERN_NAMES[pattern],
                "lines_per_mm": number("grating"),
                # The record's angle counts clockwise as displayed, with y down.
                "angle_deg": -number("pat_angle", 0.0),
                "focus_mm": number("proj_u"),
                "focal_length_mm": number("proj_f", number("f")),
                "f_number": number("proj_Fno"),
                "position_mm": _vector(record.get("proj_pos", "[0, 0, 0]"), origin),
            }
        return cls.from_values(values, origin)

    def to_metadata(self) -> dict[str, str]:
        """The metadata record ``rig``: the same keys as in the shared recordings, and some more."""
        s1, s2, pitch = self.sensor_mm("near"), self.sensor_mm("far"), self.pixel_pitch_mm
        mean = (s1 + s2) / 2
        middle_mm = object_distance_mm(self.focal_length_mm, mean)
        values: dict[str, Any] = {
            "f": self.focal_length_mm,
            "Fno": self.f_number,
            "p": self.pixel_pitch_mm,
            "b": self.sensor_separation_mm,
            "u1": self.near_focus_mm,
            "N": self.width_px,
            "width": self.width_px,
            "height": self.height_px,
            "cx": self.centre_px[0],
            "cy": self.centre_px[1],
            "raw_mag": not self.registered,
            "far_scale": self.far_scale,
            "far_rotation": self.far_rotation_deg,
            "far_shift_x": self.far_shift_px[0],
            "far_shift_y": self.far_shift_px[1],
            "vig_z": self.vignette_distance_mm,
            "vig_r": self.vignette_radius_mm,
            # What follows from those, for readers.
            "D": round(self.aperture_mm, 2),
            "pitch_um": round(1e3 * self.pixel_pitch_mm, 6),
            "s1": round(s1, 3),
            "s2": round(s2, 3),
            "u2": round(self.far_focus_mm, 1),
            "depth_span": round(self.far_focus_mm - self.near_focus_mm, 1),
            "mag_ratio": round(s1 / s2, 5),
            "edge_shift_px": round((s1 / s2 - 1) * self.width_px / 2, 2),
            "FOV_mid_mm": round(self.width_px * self.pixel_pitch_mm * middle_mm / mean, 1),
            "coc_at_other_plane_px": round(self.aperture_mm * (s1 / s2 - 1) / pitch, 2),
            "coc_mid_px": round(self.aperture_mm * (s1 / mean - 1) / pitch, 2),
        }
        if self.projector is not None:
            values |= {
                "pattern": _METADATA_NAMES.get(self.projector.pattern, self.projector.pattern),
                "grating": self.projector.lines_per_mm,
                "pat_angle": 0.0 - self.projector.angle_deg,
                "proj_u": self.projector.focus_mm,
                "proj_f": self.projector.focal_length_mm,
                "proj_Fno": self.projector.f_number,
                "proj_pos": list(self.projector.position_mm),
                "pattern_period_mm": round(self.projector.period_mm, 6),
                "pattern_period_px": round(self.period_px("near"), 2),
            }
        return {key: str(value) for key, value in sorted(values.items())}

    # -- checks -----------------------------------------------------------------------------------

    @pydantic.model_validator(mode="before")
    @classmethod
    def _separation_from_far_focus(cls, values: Any) -> Any:
        """``far_focus_mm`` is another way to say where the far sensor is."""
        if not isinstance(values, Mapping) or "far_focus_mm" not in values:
            return values
        values = dict(values)
        far_mm = values.pop("far_focus_mm")
        if "sensor_separation_mm" in values:
            raise ValueError("expected far_focus_mm or sensor_separation_mm, found both")
        focal_mm = values.get("focal_length_mm", cls.model_fields["focal_length_mm"].default)
        near_mm = values.get("near_focus_mm", cls.model_fields["near_focus_mm"].default)
        if not all(isinstance(value, int | float) for value in (far_mm, focal_mm, near_mm)):
            raise ValueError(f"far_focus_mm: expected a number, found {far_mm!r}")
        if not far_mm > near_mm:
            raise ValueError(f"far_focus_mm {far_mm:g}: expected beyond near_focus_mm {near_mm:g}")
        values["sensor_separation_mm"] = image_distance_mm(focal_mm, near_mm) - image_distance_mm(
            focal_mm, far_mm
        )
        return values

    @pydantic.model_validator(mode="after")
    def _can_focus(self) -> Self:
        object_distance_mm(self.focal_length_mm, self.sensor_mm("far"))
        return self

    # -- what follows -----------------------------------------------------------------------------

    @property
    def aperture_mm(self) -> float:
        """Diameter D of the lens's aperture."""
        return self.focal_length_mm / self.f_number

    def sensor_mm(self, channel: Channel) -> float:
        """Distance of a sensor behind the lens: s1 of the near-focused one, s2 = s1 - b."""
        near = image_distance_mm(self.focal_length_mm, self.near_focus_mm)
        return near if channel == "near" else near - self.sensor_separation_mm

    def focus_mm(self, channel: Channel) -> float:
        """Distance that a sensor is focused on: u1, u2."""
        if channel == "near":
            return self.near_focus_mm
        return object_distance_mm(self.focal_length_mm, self.sensor_mm("far"))

    @property
    def far_focus_mm(self) -> float:
        """Distance u2 that the far sensor is focused on."""
        return self.focus_mm("far")

    @property
    def centre_px(self) -> tuple[float, float]:
        """The principal point."""
        middle = ((self.width_px - 1) / 2, (self.height_px - 1) / 2)
        return self.principal_point_px or middle

    def focal_px(self, channel: Channel) -> float:
        """Focal length of an image's pinhole camera in pixels."""
        if not self.registered:
            return self.sensor_mm(channel) / self.pixel_pitch_mm
        return sum(self.sensor_mm(one) for one in CHANNELS) / 2 / self.pixel_pitch_mm

    def camera_matrix(self, channel: Channel) -> np.ndarray:
        """K of an image, 3 3 float64 in pixels; misregistration is not part of it."""
        focal = self.focal_px(channel)
        x, y = self.centre_px
        return np.array([[focal, 0, x], [0, focal, y], [0, 0, 1]], float)

    def blur_mm(self, channel: Channel, depth_mm: np.ndarray | float) -> np.ndarray:
        """Signed diameter of the blur circle on a sensor (equation 2)."""
        return np.asarray(
            blur_circle_mm(
                self.focal_length_mm,
                self.aperture_mm,
                self.sensor_mm(channel),
                np.asarray(depth_mm, float),
            )
        )

    def blur_px(self, channel: Channel, depth_mm: np.ndarray | float) -> np.ndarray:
        """Signed diameter of the blur circle in pixels of the image."""
        scale = self.focal_px(channel) / self.sensor_mm(channel)
        return self.blur_mm(channel, depth_mm) * scale

    def period_px(self, channel: Channel) -> float:
        """Period of the pattern in the middle of an image.  Raises without a projector.

        It hardly changes with depth, because camera and projector both magnify with 1 / depth.
        """
        if self.projector is None:
            raise ValueError("the rig has no projector, hence no period")
        return self.projector.period_mm * self.focal_px(channel) / self.projector.focus_mm

    @property
    def working_range_mm(self) -> tuple[float, float]:
        """The depths between the focal planes, where a ratio of energies has one meaning.

        Raises ValueError where it has not: the ratio folds back between the focal planes, because
        the blur circle at the other plane is larger than the pattern's period (or, without a
        projector, than texture of 5 pixels).
        """
        from .analytic import ratio

        near, far = self.near_focus_mm, self.far_focus_mm
        values = ratio(self, np.linspace(near, far, 201))
        if not (np.diff(values) < 0).all():
            period = "" if self.projector is None else f" of {self.period_px('near'):.2g} px"
            raise ValueError(
                f"no unique range between the focal planes {near:.0f} and {far:.0f} mm: the blur "
                f"circle of {abs(float(self.blur_px('near', far))):.3g} px at the other plane is "
                f"too large for the pattern{period}; expected a smaller aperture, coarser lines or "
                "less separation"
            )
        return near, far


def mistake(error: pydantic.ValidationError) -> str:
    """The first thing that pydantic found, on one line: where, what was expected and found."""
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"])
    says = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        return f"unknown key {where!r}"
    if first["type"] not in ("value_error", "missing"):
        says = f"{says}, got {first['input']!r}"
    return f"{where}: {says}" if where else says


def _vector(text: str, origin: str) -> tuple[float, float, float]:
    try:
        x, y, z = (float(value) for value in ast.literal_eval(text))
    except (ValueError, TypeError, SyntaxError) as error:
        raise ValueError(f"{origin}: proj_pos: expected [x, y, z], found {text!r}") from error
    return x, y, z

"""The bifocal sensor before a plane, for lessons: optics, one pair of images, a calibration.

The images are the analytic ones of ``optics``, with noise; what looks at them are the real
stages.  :class:`Plane` and :class:`CalibrationPlanes` give artifacts that the stages otherwise take
from a recording, and so must come before them in a lesson.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from workbench.stage import Artifact, Inputs, Outputs, Stage, StageParameters, knob

RIG = Artifact("rig", doc="the optics, a optics.rig.Rig")
NEAR_GIVEN = Artifact("near_image", "uint8", "H W", "grey levels", "near image")
FAR_GIVEN = Artifact("far_image", "uint8", "H W", "grey levels", "far image")
CALIBRATION_GIVEN = Artifact("calibration", doc="both steps of section 3.2")

SIZE_PX = 100
_FULL_WELL = 20_000.0
_READ_NOISE = 40.0
_BRIGHT_ALBEDO = 0.9
"""The albedo that would fill the pixels."""
_SEED = 7
_TEXTURE_PX = 1.2


class Optics(Stage):
    """The rig of the project's recordings, with what lessons turn of it."""

    name = "optics"
    gives = (RIG,)

    class Parameters(StageParameters):
        f_number: float = knob(
            2.8,
            "Focal length over aperture: a smaller number is a wider lens, and more blur.",
            low=1.4,
            high=22,
            step=0.1,
        )
        lines_per_mm: float = knob(
            4.0,
            "Stripes per millimetre of the projector's grating.",
            low=1,
            high=20,
            step=0.5,
            unit="lines/mm",
        )
        pitch_um: float = knob(50.0, "Distance between pixels.", low=5, high=100, step=5, unit="µm")
        shift_px: float = knob(
            0.0,
            "How far the far image is shifted against the near one: sensors that are not aligned.",
            low=0,
            high=3,
            step=0.1,
            unit="px",
        )

        projector_f_number: float = knob(
            4.4,
            "Stop of the projector's lens: a wide one is in focus at 750 mm only.",
            low=1.4,
            high=32,
            step=0.1,
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..optics.rig import Projector, Rig

        rig = Rig(
            f_number=parameters.f_number,
            pixel_pitch_mm=parameters.pitch_um / 1e3,
            width_px=SIZE_PX,
            height_px=SIZE_PX,
            far_shift_px=(parameters.shift_px, 0.0),
            projector=Projector(
                lines_per_mm=parameters.lines_per_mm, f_number=parameters.projector_f_number
            ),
        )
        return {"rig": rig}


class Plane(Stage):
    """Near and far image of a plane that faces the camera."""

    name = "plane"
    needs = (RIG,)
    gives = (NEAR_GIVEN, FAR_GIVEN)

    class Parameters(StageParameters):
        distance_mm: float = knob(
            750.0, "Where the plane is.", low=600, high=950, step=2, unit="mm"
        )
        albedo: float = knob(
            0.55, "How much light the plane gives back.", low=0.02, high=0.85, step=0.01
        )
        left_albedo: float = knob(
            0.0, "The same for its left half; 0 is like the right.", low=0, high=0.85, step=0.01
        )
        pattern: float = knob(
            1.0, "Contrast of the projected stripes; 0 is a plain lamp.", low=0, high=1, step=0.05
        )
        texture: float = knob(
            0.0, "Contrast of what is printed on the plane.", low=0, high=0.5, step=0.05
        )
        noise: float = knob(
            1.0, "The sensor's noise over that of a real one.", low=0, high=4, step=0.25
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        rng = np.random.default_rng(_SEED)
        p = parameters
        near, far = (
            exposed(
                plane_light(inputs["rig"], channel, p.distance_mm, p.pattern, p.texture)
                * _albedo(p, inputs["rig"]),
                rng,
                p.noise,
            )
            for channel in ("near", "far")
        )
        return {"near_image": near, "far_image": far}


class CalibrationPlanes(Stage):
    """Both steps of section 3.2 on white planes before this rig: the real procedure."""

    name = "calibration_planes"
    needs = (RIG,)
    gives = (CALIBRATION_GIVEN,)

    class Parameters(StageParameters):
        f_number: float = knob(
            2.8, "The lens's stop while it was calibrated.", low=1.4, high=22, step=0.1
        )
        degree: int = knob(
            4, "Degree of the curve that takes the ratio to depth.", low=1, high=6, step=1
        )
        planes: int = knob(15, "How many known distances are shown to it.", low=6, high=31, step=1)

    def compute(self, inputs: Inputs, parameters: Any) -> Outputs:
        from ..dfd.procedure import CalibrateParameters, calibrate

        # Calibrated where it was well aligned: a later shift is what a lesson is about.
        rig = inputs["rig"].model_copy(
            update={"f_number": parameters.f_number, "far_shift_px": (0.0, 0.0)}
        )
        distances = np.linspace(rig.near_focus_mm - 2, rig.far_focus_mm + 2, parameters.planes)
        made = calibrate(
            lambda: _planes(rig, distances),
            rig.to_metadata(),
            CalibrateParameters(degree=parameters.degree),
        )
        return {"calibration": made}


def plane_light(
    rig: Any, channel: Any, depth_mm: float, pattern: float = 1.0, texture: float = 0.0
) -> np.ndarray:
    """Light on a sensor from a plane of albedo 1, float64 [H W], 1 at the pattern's brightest.

    ``pattern`` and ``texture`` are contrasts; the texture is the same for every plane.
    """
    from ..optics.analytic import disc_transfer, plane_image

    if channel == "far" and rig.far_shift_px != (0.0, 0.0):
        # A sensor that is shifted sees what the pinhole's centre, shifted with it, sees.
        x, y = rig.centre_px
        moved = (x + rig.far_shift_px[0], y + rig.far_shift_px[1])
        rig = rig.model_copy(update={"principal_point_px": moved})
    light = 0.5 + pattern * (plane_image(rig, channel, depth_mm) - 0.5)
    if texture > 0:
        shape = light.shape
        fy, fx = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None]
        frequency = np.hypot(fx, fy)
        blur_px = abs(float(rig.blur_px(channel, depth_mm)))
        white = np.fft.rfft2(np.random.default_rng(_SEED).normal(size=shape))
        seen = white * np.exp(-2 * (np.pi * _TEXTURE_PX * frequency) ** 2)
        sharp = np.fft.irfft2(seen, shape)
        blurred = np.fft.irfft2(seen * disc_transfer(blur_px * frequency), shape)
        light = light * np.clip(1 + texture * blurred / sharp.std(), 0, None)
    return light


def exposed(light: np.ndarray, rng: np.random.Generator | None, noise: float = 1.0) -> np.ndarray:
    """What the sensor makes of ``light`` [H W] (1 fills a pixel): 8 bit, with shot and read noise.

    The pixels hold 20 000 electrons and are read with a noise of 40, as in the recordings.
    """
    electrons = np.clip(light, 0, None) * _FULL_WELL
    if rng is not None and noise > 0:
        sigma = noise * np.sqrt(electrons + _READ_NOISE**2)
        electrons = electrons + sigma * rng.normal(size=light.shape)
    return np.clip(np.rint(electrons / _FULL_WELL * 255), 0, 255).astype(np.uint8)


def ratio_over_distance(rig: Any, distances_mm: np.ndarray, albedo: float = 0.55) -> np.ndarray:
    """Focus measures of planes at ``distances_mm`` [K]: near, far and ratio, float64 [3 K].

    Noise-free, by the real focus measure over whole stripe periods.
    """
    from ..dfd.focus import focus_map
    from ..dfd.stripes import whole_period_taps

    taps = whole_period_taps(float(rig.period_px("near")))
    middle = slice(SIZE_PX // 4, -SIZE_PX // 4)
    found = np.empty((3, len(distances_mm)))
    for k, depth in enumerate(distances_mm):
        for row, channel in enumerate(("near", "far")):
            light = plane_light(rig, channel, float(depth)) * albedo / _BRIGHT_ALBEDO
            image = (255 * light).astype(np.float32)
            found[row, k] = focus_map(image, taps, taps)[middle, middle].mean()
    found[2] = (found[0] - found[1]) / (found[0] + found[1])
    return found


def ratio_of(focus_near: np.ndarray, focus_far: np.ndarray) -> np.ndarray:
    """Q = (En - Ef) / (En + Ef), float32 [H W]; 0 where there is no energy at all."""
    total = focus_near + focus_far
    return np.where(total > 0, (focus_near - focus_far) / np.maximum(total, 1e-9), 0)


def _albedo(parameters: Any, rig: Any) -> np.ndarray:
    """Share of a pixel's well that the plane's white fills, float64 [1 W]."""
    albedo = np.full((1, rig.width_px), parameters.albedo)
    if parameters.left_albedo > 0:
        albedo[:, : rig.width_px // 2] = parameters.left_albedo
    return albedo / _BRIGHT_ALBEDO


def _planes(rig: Any, distances_mm: np.ndarray) -> Iterator[Any]:
    """White planes as a recording would give them, two shots each."""
    from workbench.recording import Frame, Truth

    rng = np.random.default_rng(_SEED + 1)
    for index, depth in enumerate(np.repeat(distances_mm, 2)):
        images = {
            channel: exposed(plane_light(rig, channel, float(depth)) * 0.6, rng)
            for channel in ("near", "far")
        }
        shape = images["near"].shape
        empty = np.ones(shape, np.uint8)
        truth = Truth(np.full(shape, depth / 1e3, np.float32), empty, empty, {}, {"kind": "plane"})
        yield Frame(index, index, images, {}, {}, truth, str(index))

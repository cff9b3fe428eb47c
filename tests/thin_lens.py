"""An analytic bifocal sensor for tests: stripes on planes, blurred by a uniform disc (equation 2).

Independent of the ray tracer that made the committed recordings, and of any rig: the tests run
the sensor on optics, stripe directions and noise that nothing was developed on.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import j1

from workbench.recording import Camera, Frame, Truth


@dataclass(frozen=True)
class Rig:
    """Lengths in millimetres; the stripe period in pixels along ``angle_deg``."""

    focal_mm: float = 60.0
    f_number: float = 2.8
    pitch_mm: float = 0.05
    near_focus_mm: float = 700.0
    separation_mm: float = 0.8
    period_px: float = 5.0
    angle_deg: float = 0.0
    size_px: int = 160
    full_well: float = 20_000.0
    read_noise: float = 0.5
    bits: int = 8
    far_gain: float = 1.0

    @property
    def sensor_mm(self) -> tuple[float, float]:
        """Distance of the near-focused and of the far-focused sensor behind the lens."""
        near = 1 / (1 / self.focal_mm - 1 / self.near_focus_mm)
        return near, near - self.separation_mm

    @property
    def far_focus_mm(self) -> float:
        return 1 / (1 / self.focal_mm - 1 / self.sensor_mm[1])

    def blur_px(self, sensor: int, z_mm: float) -> float:
        """Diameter of the blur circle in pixels: d = D s |1/f - 1/u - 1/s| (equation 2)."""
        s = self.sensor_mm[sensor]
        aperture = self.focal_mm / self.f_number
        return aperture * s * abs(1 / self.focal_mm - 1 / z_mm - 1 / s) / self.pitch_mm

    def image(
        self, sensor: int, z_mm: float, rng: np.random.Generator | None, albedo: float = 0.55
    ) -> np.ndarray:
        """The image of a plane at ``z_mm``: [size size], uint8 or uint16, with sensor noise."""
        y, x = np.mgrid[0 : self.size_px, 0 : self.size_px].astype(float)
        angle = np.deg2rad(self.angle_deg)
        phase = 2 * np.pi * (x * np.cos(angle) - y * np.sin(angle)) / self.period_px
        level = np.full(x.shape, 0.5)
        for harmonic in (1, 3):
            # Those harmonics of the square wave that the pixels can carry at all.
            if harmonic / self.period_px < 0.5:
                transfer = _disc(self.blur_px(sensor, z_mm) * harmonic / self.period_px)
                level += 2 / np.pi / harmonic * transfer * np.sin(harmonic * phase) * 0.8
        light = level * albedo * (self.far_gain if sensor else 1.0)
        full_scale = 2**self.bits - 1
        if rng is not None:
            electrons = np.clip(light, 0, None) * self.full_well
            light = (electrons + rng.normal(size=x.shape) * np.sqrt(electrons)) / self.full_well
            light = light + rng.normal(size=x.shape) * self.read_noise / 255
        counts = np.clip(np.rint(light * full_scale), 0, full_scale)
        return counts.astype(np.uint8 if self.bits == 8 else np.uint16)

    def with_(self, **changes: Any) -> Rig:
        return replace(self, **changes)


def planes(rig: Rig, distances_mm: np.ndarray, shots: int = 2, seed: int = 0) -> list[Frame]:
    """Frames of planes at known distances, as a recording would give them."""
    rng = np.random.default_rng(seed)
    return [
        frame(rig, index, float(z), rng) for index, z in enumerate(np.repeat(distances_mm, shots))
    ]


def frame(rig: Rig, index: int, z_mm: float, rng: np.random.Generator | None) -> Frame:
    """One frame of a plane at ``z_mm`` with its ground truth."""
    images = {name: rig.image(sensor, z_mm, rng) for sensor, name in enumerate(("near", "far"))}
    shape = (rig.size_px, rig.size_px)
    focal_px = sum(rig.sensor_mm) / 2 / rig.pitch_mm
    middle = (rig.size_px - 1) / 2
    matrix = np.array([[focal_px, 0, middle], [0, focal_px, middle], [0, 0, 1]])
    camera = Camera(*shape, matrix, np.zeros(5), "plumb_bob", "camera_optical_frame", 0)
    truth = Truth(
        np.full(shape, z_mm / 1e3, np.float32),
        np.ones(shape, np.uint8),
        np.ones(shape, np.uint8),
        {},
        {"kind": "plane", "z": z_mm},
    )
    return Frame(
        index, index, images, {"near": index, "far": index}, {"near": camera}, truth, str(index), ()
    )


def passes(frames: list[Frame]) -> Any:
    """What the calibration wants: a function that gives a fresh pass each time."""

    def fresh() -> Iterator[Frame]:
        return iter(frames)

    return fresh


def _disc(cycles: float) -> float:
    """Transfer of a uniform disc at ``cycles`` = diameter × frequency: 2 J1(π c) / (π c)."""
    argument = np.pi * cycles
    return 1.0 if argument < 1e-9 else float(2 * j1(argument) / argument)

"""From light to grey levels: exposure, shot noise, read noise, unlike pixels, and rounding."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import pydantic

WHITE_ALBEDO = 0.55
"""The albedo that exposure speaks of, facing the projector at its focus."""


class Exposure(pydantic.BaseModel):
    """How bright the images are, as fractions of full scale for albedo 0.55."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    level: pydantic.PositiveFloat = 0.78
    """Where the pattern is fully bright, on a surface facing the projector at its focus."""
    flat: pydantic.PositiveFloat = 0.9
    """Of the flat image, relative to the others."""
    far_gain: pydantic.PositiveFloat = 1.0
    """Of the far sensor, relative to the near one: gain that has drifted apart."""


class Sensor(pydantic.BaseModel):
    """An image sensor; the defaults are those of the project's recordings."""

    model_config = pydantic.ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    bits: Annotated[int, pydantic.Field(ge=1, le=16)] = 8
    full_well_e: pydantic.PositiveFloat = 20_000.0
    """Electrons at full scale; shot noise is the root of their number."""
    read_noise_e: pydantic.NonNegativeFloat = 40.0
    prnu_percent: pydantic.NonNegativeFloat = 1.0
    """By how much pixels differ in sensitivity, fixed for a sensor."""
    serial: pydantic.NonNegativeInt = 0
    """Which sensor it is: recordings of one serial number share their pixels' sensitivities."""
    noise: bool = True
    """Whether there is any noise; rounding and saturation remain."""

    def grey(self, level: np.ndarray, which: int, seed: list[int]) -> np.ndarray:
        """Grey levels, uint8 up to 8 bits and uint16 above, of ``level`` [H W], 1 at full scale.

        ``which`` of the sensors behind the lens it is decides its pixels, ``seed`` the noise.
        """
        full_scale = 2**self.bits - 1
        if self.noise:
            pixels = np.random.default_rng([self.serial, which]).normal(size=level.shape)
            rng = np.random.default_rng(seed)
            electrons = level * (1 + self.prnu_percent / 100 * pixels) * self.full_well_e
            electrons = rng.poisson(np.clip(electrons, 0, None)) + rng.normal(
                0, self.read_noise_e, level.shape
            )
            level = electrons / self.full_well_e
        counts = np.clip(np.rint(level * full_scale), 0, full_scale)
        return counts.astype(np.uint8 if self.bits <= 8 else np.uint16)

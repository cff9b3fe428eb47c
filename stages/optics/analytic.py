"""Images of a plane facing the camera, without tracing a ray: pattern × OTF of a uniform disc.

A periodic pattern is a sum of plane waves.  Defocus of a lens with a round aperture multiplies
each wave by the transfer of a uniform disc, 2 J1(π c) / (π c) with c = diameter × frequency; so do
the projector's defocus and, with a sinc, the square pixel.  A pixel's value is the sum of the waves
that are left.

Valid for a plane at one depth, seen whole: no edges, no shadows, no light from elsewhere.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.special import j1

from .rig import Channel, Pattern, Rig

DOT_DIAMETER = 0.5
"""Diameter of a dot in periods of the pattern ``dots``."""

TEXTURE_PERIOD_PX = 5.0
"""What is taken for the period of a scene's own texture where there is no projector."""

_HARMONICS = 15
_NEGLIGIBLE = 1e-4


def disc_transfer(cycles: np.ndarray | float) -> np.ndarray:
    """Transfer of a uniform disc at ``cycles`` = diameter × frequency: 2 J1(π c) / (π c)."""
    argument = np.pi * np.abs(np.asarray(cycles, float))
    small = argument < 1e-6
    safe = np.where(small, 1.0, argument)
    return np.where(small, 1.0, 2 * j1(safe) / safe)


def pattern_waves(pattern: Pattern) -> Iterator[tuple[int, int, complex]]:
    """The Fourier series of a pattern of period 1 with values 0..1.

    Yields (m, n, amplitude) of waves exp(2πi (m x + n y)), those of one half plane: the sum is the
    mean plus twice the real part.  Square waves are bright on the first half of a period.
    """
    if pattern == "sine":
        yield 1, 0, -0.25j
    elif pattern == "stripes":
        for m in range(1, _HARMONICS + 1, 2):
            yield m, 0, -1j / (np.pi * m)
    elif pattern == "checker":
        # 1/2 + s(x) s(y) / 2 with square waves s of amplitude 1.
        for m in range(1, _HARMONICS + 1, 2):
            for n in range(-_HARMONICS, _HARMONICS + 1, 2):
                yield m, n, 0.5 * (-2j / (np.pi * m)) * (-2j / (np.pi * n))
    elif pattern == "dots":
        area = np.pi * DOT_DIAMETER**2 / 4
        for m in range(_HARMONICS + 1):
            for n in range(-_HARMONICS, _HARMONICS + 1):
                if m > 0 or n > 0:
                    shift = (-1) ** (m + n)  # a dot's centre is the middle of its cell
                    yield m, n, shift * area * complex(disc_transfer(DOT_DIAMETER * np.hypot(m, n)))


def pattern_mean(pattern: Pattern) -> float:
    """Mean transmission of a pattern; ``none`` is an open projector."""
    if pattern == "none":
        return 1.0
    return float(np.pi * DOT_DIAMETER**2 / 4) if pattern == "dots" else 0.5


def pattern_value(pattern: Pattern, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Transmission of a pattern of period 1 at (x, y), 0..1."""
    if pattern == "none":
        return np.ones(np.broadcast_shapes(x.shape, y.shape))
    if pattern == "sine":
        return 0.5 + 0.5 * np.sin(2 * np.pi * x)
    if pattern == "stripes":
        return (x % 1 < 0.5).astype(float)
    if pattern == "checker":
        return ((x % 1 < 0.5) == (y % 1 < 0.5)).astype(float)
    return (np.hypot(x % 1 - 0.5, y % 1 - 0.5) < DOT_DIAMETER / 2).astype(float)


def plane_image(rig: Rig, channel: Channel, depth_mm: float) -> np.ndarray:
    """The pattern on a plane at ``depth_mm`` as a sensor sees it, float64 [H W], 0..1.

    Albedo, shading and noise are not in it.  Raises ValueError without a projector.
    """
    if rig.projector is None:
        raise ValueError("the rig has no projector, hence no pattern on a plane")
    projector = rig.projector
    x, y = np.meshgrid(
        (np.arange(rig.width_px) - rig.centre_px[0]) / rig.focal_px(channel),
        (np.arange(rig.height_px) - rig.centre_px[1]) / rig.focal_px(channel),
    )
    points_mm = depth_mm * np.stack([x, y, np.ones_like(x)], axis=-1)
    cycles = projector.cycles(points_mm)
    # Blur and pixel in the middle of the image; both change by a percent towards its corners.
    middle_mm = np.array([0, 0, depth_mm])
    px_mm = depth_mm / rig.focal_px(channel)
    step = projector.cycles(middle_mm + px_mm * np.eye(3)[:2]) - projector.cycles(middle_mm)
    lens_px = abs(float(rig.blur_px(channel, depth_mm)))
    projector_mm = float(projector.blur_mm(middle_mm))
    image = np.full(x.shape, pattern_mean(projector.pattern))
    for m, n, amplitude in pattern_waves(projector.pattern):
        per_px = step @ (m, n)  # cycles per pixel, in x and y
        transfer = (
            disc_transfer(lens_px * float(np.hypot(*per_px)))
            * disc_transfer(projector_mm * float(np.hypot(m, n)) / projector.period_mm)
            * np.sinc(per_px[0])
            * np.sinc(per_px[1])
        )
        if abs(amplitude * transfer) < _NEGLIGIBLE:
            continue
        image += 2 * (amplitude * transfer * np.exp(2j * np.pi * (cycles @ (m, n)))).real
    return image


def shading(rig: Rig, channel: Channel, depth_mm: float, sky: float = 0.02) -> np.ndarray:
    """Light of the open projector and of the camera's cos⁴ over a plane, float64 [H W].

    The image of a plane of albedo a is a × (:func:`plane_image` × first + second) of what is given:
    an array [2 H W], the projector's share and the ``sky``'s.
    """
    if rig.projector is None:
        raise ValueError("the rig has no projector, hence no light on a plane")
    x, y = np.meshgrid(
        (np.arange(rig.width_px) - rig.centre_px[0]) / rig.focal_px(channel),
        (np.arange(rig.height_px) - rig.centre_px[1]) / rig.focal_px(channel),
    )
    points_mm = depth_mm * np.stack([x, y, np.ones_like(x)], axis=-1)
    falloff = (1 + x**2 + y**2) ** -2
    light = rig.projector.irradiance(points_mm, np.array([0.0, 0.0, -1.0]))
    return np.stack([light * falloff, sky * falloff])


def ratio(rig: Rig, depth_mm: np.ndarray) -> np.ndarray:
    """Q = (En - Ef) / (En + Ef) at depths, En and Ef the amplitudes of the pattern's first waves.

    1 at the near side, -1 at the far side; the projector's defocus is common to both and drops out.
    Higher harmonics are beyond what the pixels of a sensible rig resolve and are left out.  Without
    a projector the scene's own texture stands in, at a period of 5 pixels.
    """
    depth = np.asarray(depth_mm, float)
    energies = []
    for channel in ("near", "far"):
        period = TEXTURE_PERIOD_PX if rig.projector is None else rig.period_px(channel)
        cycles = rig.blur_px(channel, depth) / period
        if rig.projector is not None and rig.projector.pattern == "checker":
            cycles = cycles * np.sqrt(2)
        energies.append(np.abs(disc_transfer(cycles)))
    near, far = energies
    return (near - far) / (near + far)

"""The calibration of the range sensor: what it holds, and its file.

The file is a plain ``.npz`` of arrays with a format name and version; nothing in it is pickled.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from workbench.files import replacing

from ..arrays import read_arrays
from .focus import LaplacianKind, SensorNoise
from .similarity import Similarity
from .stripes import Stripes
from .texture import Texture

_GAIN_CELLS = 16
_GAIN_ROUNDS = 5

FORMAT = "defocus-calibration"
VERSION = 1


def gain_terms(height: int, width: int) -> np.ndarray:
    """The terms 1, x, y, x², xy, y² at every pixel, float64 [H W 6]; see ``Calibration.gain``."""
    y, x = np.meshgrid(np.linspace(-1, 1, height), np.linspace(-1, 1, width), indexing="ij")
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def light_ratio(near: np.ndarray, far: np.ndarray, gain_map: np.ndarray | None = None) -> float:
    """All light on the near sensor over all on the far one [H W], as calibrated; 1 is no drift.

    Blur moves light about and loses none, so the ratio holds whatever the scene.
    """
    far_light = float(far.sum(dtype=np.float64))
    if gain_map is not None:
        far_light = float(np.einsum("ij,ij->", far, gain_map, dtype=np.float64))
    near_light = float(near.sum(dtype=np.float64))
    return near_light / far_light if near_light > 0 and far_light > 0 else 1.0


def pair_gain(near: np.ndarray, far: np.ndarray, similarity: Similarity) -> np.ndarray:
    """Light of ``near`` over that of ``far`` (registered by ``similarity``), float32 [H W].

    A quadratic over the image, as in :class:`Calibration`, fitted to averages over cells, which
    blur hardly changes.  Cells that the far image does not show are left out, and cells that
    differ most, where blur moves light across a cell's border, weigh least.
    """
    height, width = near.shape
    size = (_GAIN_CELLS, _GAIN_CELLS)

    def cells(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).ravel().astype(np.float64)

    seen = cv2.warpAffine(
        np.ones((height, width), np.float32),
        similarity.far_from_near,
        (width, height),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )
    near_light, far_light = cells(near), cells(far)
    usable = (cells(seen) > 0.99) & (near_light > 0) & (far_light > 0)
    if int(usable.sum()) < _GAIN_CELLS:
        return np.full((height, width), light_ratio(near, far), np.float32)
    inner = 1 - 1 / _GAIN_CELLS
    terms = gain_terms(_GAIN_CELLS, _GAIN_CELLS).reshape(-1, 6)[usable]
    terms = terms * np.array([1, inner, inner, inner**2, inner**2, inner**2])
    ratio = np.log(near_light[usable] / far_light[usable])
    weight = np.ones_like(ratio)
    for _ in range(_GAIN_ROUNDS):
        fitted = np.linalg.lstsq(terms * weight[:, None], ratio * weight, rcond=None)[0]
        off = np.abs(ratio - terms @ fitted)
        weight = 1 / (1 + off / (2 * float(np.median(off)) + 1e-6))
    rows, columns = np.linspace(-1, 1, height), np.linspace(-1, 1, width)
    a, b, c, d, e, f = fitted
    along = a + b * columns + d * columns**2
    gain = along[None] + (c * rows + f * rows**2)[:, None] + e * rows[:, None] * columns[None]
    return np.exp(gain).astype(np.float32)


@dataclass(frozen=True)
class Calibration:
    """Both steps of section 3.2, or what the optics alone say (``texture`` is then not None).

    ``curve`` [K H W] float32: coefficients of relative depth t over Q, lowest power first, for
    each pixel, or [K 1 1] for all; t runs from 0 at ``near_z_m`` to 1 at ``far_z_m``, linear in
    1/z.
    ``modulation`` [M] float32: coefficients of (focus_near + focus_far) / (near + far) over t;
    empty where it is not known.
    ``gain`` [6] float64: light of a white scene on the near sensor over that on the far one, as
    coefficients of 1, x, y, x², xy, y² with x and y from -1 to 1 over the image; vignetting is
    not the same on both.
    ``full_scale``: grey level at which the sensors saturate, inf where it is not known; noise is
    in the same grey levels.
    ``texture``: how the scene's own texture stands in for stripes.  A calibration from optics has
    seen no image: its similarity is where each frame's own begins, and light and noise are
    measured on each frame.  If its size is 0×0 it is for images of any size.
    ``report``: what the procedure measured, for people; plain JSON values.
    """

    similarity: Similarity
    stripes: Stripes | None
    laplacian: LaplacianKind
    curve: np.ndarray
    near_z_m: float
    far_z_m: float
    modulation: np.ndarray
    noise: SensorNoise
    gain: np.ndarray
    full_scale: float
    report: dict[str, Any] = field(default_factory=dict)
    texture: Texture | None = None

    @property
    def slope(self) -> float:
        """Mean |dt/dQ| at Q = 0: what an error of the ratio costs in relative depth."""
        return float(np.abs(self.curve[1]).mean())

    @cached_property
    def gain_map(self) -> np.ndarray:
        """``gain`` at every pixel, float32 [H W]."""
        known = self.similarity
        return (gain_terms(known.height, known.width) @ self.gain).astype(np.float32)

    def z_m(self, relative_depth: np.ndarray) -> np.ndarray:
        """Metres along the optical axis from relative depth, float32."""
        near, far = 1 / self.near_z_m, 1 / self.far_z_m
        return (1 / (near + relative_depth * (far - near))).astype(np.float32, copy=False)

    def save(self, path: Path) -> None:
        """Write beside ``path`` and rename, so that a reader never sees half a file."""
        similarity, stripes, texture = self.similarity, self.stripes, self.texture
        known_scale = [self.full_scale] if math.isfinite(self.full_scale) else []
        arrays = {
            "format": np.array(FORMAT),
            "version": np.array(VERSION),
            "similarity": np.array(
                [similarity.scale, similarity.rotation_deg, similarity.dx_px, similarity.dy_px]
            ),
            "size": np.array([similarity.width, similarity.height]),
            "stripes": np.array(
                [stripes.period_px, stripes.angle_deg, stripes.strength] if stripes else [], float
            ),
            "laplacian": np.array(self.laplacian),
            "curve": self.curve.astype(np.float32, copy=False),
            "range_m": np.array([self.near_z_m, self.far_z_m]),
            "modulation": self.modulation.astype(np.float32, copy=False),
            "noise": np.array([self.noise.read_variance, self.noise.gain]),
            "gain": self.gain,
            "full_scale": np.array(known_scale, float),
            "report": np.array(json.dumps(self.report, sort_keys=True)),
        }
        if texture is not None:
            arrays["texture"] = np.array(
                [texture.blur_px, texture.scale_px, texture.mean_square_frequency]
            )
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @staticmethod
    def load(path: Path) -> Calibration:
        """Read a file that :meth:`save` wrote.  Raises ``OSError``, or ``ValueError`` in a line."""
        return read_arrays(
            path, "calibration", FORMAT, VERSION, "workbench calibrate", _from_arrays
        )


def _from_arrays(arrays: dict[str, np.ndarray]) -> Calibration:
    """The calibration that a file's arrays hold.  Raises ``ValueError``, ``KeyError`` or so."""
    width, height = (int(v) for v in _numbers(arrays, "size", 2))
    curve = arrays["curve"]
    texture = None
    if "texture" in arrays:
        blur_px, scale_px, frequency = _numbers(arrays, "texture", 3)
        if not (blur_px > 0 and scale_px >= 1 and frequency > 0):
            raise ValueError(f"expected three numbers above 0 for texture, found {blur_px:g}, …")
        texture = Texture(blur_px, int(scale_px), frequency)
    sizes = ((height, width),) if texture is None else ((1, 1),)
    if curve.ndim != 3 or curve.shape[1:] not in sizes or not np.isfinite(curve).all():
        raise ValueError(f"expected a curve for {width}×{height} pixels, found {curve.shape}")
    kind = str(arrays["laplacian"])
    if kind not in ("opencv", "paper"):
        raise ValueError(f"expected laplacian opencv or paper, found {kind!r}")
    scale, rotation_deg, dx_px, dy_px = _numbers(arrays, "similarity", 4)
    near_z_m, far_z_m = _numbers(arrays, "range_m", 2)
    if not 0 < near_z_m < far_z_m:
        raise ValueError(f"expected a working range in metres, found {near_z_m} to {far_z_m}")
    return Calibration(
        Similarity(scale, rotation_deg, dx_px, dy_px, width, height),
        Stripes(*_numbers(arrays, "stripes", 3)) if texture is None else None,
        kind,  # type: ignore[arg-type]
        curve.astype(np.float32, copy=False),
        near_z_m,
        far_z_m,
        arrays["modulation"].astype(np.float32, copy=False),
        SensorNoise(*_numbers(arrays, "noise", 2)),
        np.array(_numbers(arrays, "gain", 6)),
        _numbers(arrays, "full_scale", 1)[0] if texture is None else math.inf,
        json.loads(str(arrays["report"])),
        texture,
    )


def _numbers(arrays: dict[str, np.ndarray], name: str, count: int) -> list[float]:
    values = arrays[name]
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"expected {count} numbers for {name}, found {values.tolist()}")
    return [float(v) for v in values]

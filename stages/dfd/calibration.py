"""The calibration of the range sensor: what it holds, and its file.

The file is a plain ``.npz`` of arrays with a format name and version; nothing in it is pickled.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stages.dfd.focus import LaplacianKind, SensorNoise
from stages.dfd.similarity import Similarity
from stages.dfd.stripes import Stripes
from workbench.files import replacing

FORMAT = "defocus-calibration"
VERSION = 1


@dataclass(frozen=True)
class Calibration:
    """Both steps of section 3.2.

    ``curve`` [K H W] float32: coefficients of relative depth t over Q, lowest power first, for
    each pixel; t runs from 0 at ``near_z_m`` to 1 at ``far_z_m``, linear in 1/z.
    ``modulation`` [M] float32: coefficients of (focus_near + focus_far) / (near + far) over t.
    ``gain_near_over_far``: ratio of all light on the two sensors.
    ``report``: what the procedure measured, for people; plain JSON values.
    """

    similarity: Similarity
    stripes: Stripes
    laplacian: LaplacianKind
    curve: np.ndarray
    near_z_m: float
    far_z_m: float
    modulation: np.ndarray
    noise: SensorNoise
    gain_near_over_far: float
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def slope(self) -> float:
        """Mean |dt/dQ| at Q = 0: what an error of the ratio costs in relative depth."""
        return float(np.abs(self.curve[1]).mean())

    def z_m(self, relative_depth: np.ndarray) -> np.ndarray:
        """Metres along the optical axis from relative depth, float32."""
        near, far = 1 / self.near_z_m, 1 / self.far_z_m
        return (1 / (near + relative_depth * (far - near))).astype(np.float32, copy=False)

    def save(self, path: Path) -> None:
        """Write beside ``path`` and rename, so that a reader never sees half a file."""
        similarity, stripes = self.similarity, self.stripes
        arrays = {
            "format": np.array(FORMAT),
            "version": np.array(VERSION),
            "similarity": np.array(
                [similarity.scale, similarity.rotation_deg, similarity.dx_px, similarity.dy_px]
            ),
            "size": np.array([similarity.width, similarity.height]),
            "stripes": np.array([stripes.period_px, stripes.angle_deg, stripes.strength]),
            "laplacian": np.array(self.laplacian),
            "curve": self.curve.astype(np.float32, copy=False),
            "range_m": np.array([self.near_z_m, self.far_z_m]),
            "modulation": self.modulation.astype(np.float32, copy=False),
            "noise": np.array([self.noise.read_variance, self.noise.gain]),
            "gain_near_over_far": np.array(self.gain_near_over_far),
            "report": np.array(json.dumps(self.report, sort_keys=True)),
        }
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    @staticmethod
    def load(path: Path) -> Calibration:
        """Read a file that :meth:`save` wrote.  Raises ``OSError``, or ``ValueError`` in a line."""
        try:
            with np.load(path, allow_pickle=False) as file:
                if "format" not in file or str(file["format"]) != FORMAT:
                    raise ValueError(f"expected a {FORMAT} file, found arrays {file.files[:4]}")
                version = int(file["version"])
                if version != VERSION:
                    raise ValueError(
                        f"expected calibration version {VERSION}, found {version}; "
                        "run `workbench calibrate` again"
                    )
                width, height = (int(v) for v in file["size"])
                curve = file["curve"]
                if curve.ndim != 3 or curve.shape[1:] != (height, width):
                    raise ValueError(
                        f"expected a curve for {width}×{height} pixels, found {curve.shape}"
                    )
                kind = str(file["laplacian"])
                if kind not in ("opencv", "paper"):
                    raise ValueError(f"expected laplacian opencv or paper, found {kind!r}")
                scale, rotation, dx, dy = (float(v) for v in file["similarity"])
                near_z_m, far_z_m = (float(v) for v in file["range_m"])
                return Calibration(
                    Similarity(scale, rotation, dx, dy, width, height),
                    Stripes(*(float(v) for v in file["stripes"])),
                    kind,  # type: ignore[arg-type]
                    curve,
                    near_z_m,
                    far_z_m,
                    file["modulation"],
                    SensorNoise(*(float(v) for v in file["noise"])),
                    float(file["gain_near_over_far"]),
                    json.loads(str(file["report"])),
                )
        except (zipfile.BadZipFile, KeyError, EOFError) as error:
            raise ValueError(f"expected a {FORMAT} file: damaged or not one ({error})") from error

"""The model database: features and eigenspaces of every part, and its file (paper, 5 and 6.3).

The file is a plain ``.npz`` of arrays with a format name and version; nothing in it is pickled.
The same views give the same bytes.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from workbench.digest import digest_of
from workbench.files import replacing

from ..arrays import read_arrays
from ..edges.planes import Plane
from .eigenspace import POINTS, Eigenspace, build, matches
from .surfaces import PROFILE_SECTORS, Surface, fall_off, features_mm, soft_view

__all__ = [
    "Database", "Part", "View", "calibration_digest", "make_database", "turn_profile", "view_of",
]  # fmt: skip

FORMAT = "defocus-models"
VERSION = 1

_LEAST_VIEWS = 3
_ROOM = 1.2
"""An image reaches this much farther than the database's largest face."""

_LEAST_SPREAD = 0.02
"""Least standard deviation of a feature, as a share of its mean: in a database of one part, or of
parts that share a measure, the spread is noise, and noise is no unit to measure with."""

_PHI_OVER_VIEWS = 2.5
_ZETA_OVER_VIEWS = 1.5
"""Thresholds over the distances inside the database: views of a part lying flat, in the middle,
free, are the best that will ever be seen of it."""

_BORDER_PX = 0.25
"""A region's border is known no better than this."""

_TILT_DEG = 25.0
_NORMAL_ERROR_DEG = 2.0
"""Up to this tilt (section 7) a face must be recognised by a normal that is so far off."""

_BODY_ABOVE_TABLE_MM = 3.0
"""What lies higher than this beside a part that lies alone is the part itself."""


@dataclass(frozen=True)
class View:
    """One training view: the face, its known rotation and what lies around it.

    ``profile`` [36]: mm below the face's plane; ``above_table`` [36]: mm above the table.
    """

    surface: Surface
    angle_deg: float
    profile: NDArray[np.float64]
    above_table: NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """What the database knows of one part's surface.

    Attributes:
        name: of the part.
        features: [V 4] float64, of its views, unnormalised.
        space: its eigenspace and manifold.
        zeta: greatest distance from the manifold at which a view is still this part's.
        profile: [36] float64, surroundings of the face at rotation 0, mm below its plane.
        profile_noise_mm: how far single views' surroundings are from it (rms).
        period_deg: least turn after which surface *and* surroundings look the same.
        left_out: [V] float64, each view's distance from what the other views say.
        body: [36] bool, directions in which the part itself goes on beyond the face, as the
            flanks of a frustum do; elsewhere it was the table that was seen.
    """

    name: str
    features: NDArray[np.float64]
    space: Eigenspace
    zeta: float
    profile: NDArray[np.float64]
    profile_noise_mm: float
    period_deg: float
    left_out: NDArray[np.float64]
    body: NDArray[np.bool_]


@dataclass(frozen=True)
class Database:
    """All parts, what normalises their features, and the thresholds.

    Attributes:
        parts: in the order of their training.
        mean, deviation: [4] float64, of each feature over all patterns (equation 4, where s is
            called a variance and is a standard deviation).
        phi: greatest distance of features (equation 7).
        side, mm_per_px: of the eigenspaces' images.
        calibration: digest of the calibration with which the parts were seen.
        report: what training measured, for people; plain JSON values.
    """

    parts: tuple[Part, ...]
    mean: NDArray[np.float64]
    deviation: NDArray[np.float64]
    phi: float
    side: int
    mm_per_px: float
    calibration: str
    report: dict[str, Any] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        return [part.name for part in self.parts]

    @cached_property
    def smallest_mm2(self) -> float:
        """Area of the smallest surface in the database."""
        return min(float(np.median(part.features[:, 0])) for part in self.parts)

    @cached_property
    def _patterns(self) -> list[NDArray[np.float64]]:
        return [(part.features - self.mean) / self.deviation for part in self.parts]

    def distances(self, features: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distance of a region's features [4] to each part: its nearest pattern's (equation 6)."""
        own = (features - self.mean) / self.deviation
        return np.array(
            [np.sqrt(((patterns - own) ** 2).sum(axis=1)).min() for patterns in self._patterns]
        )

    def check_calibration(self, calibration: Any) -> None:
        """Raise ``ValueError`` unless the parts were seen with this calibration (None: any)."""
        if calibration is None or not self.calibration:
            return
        found = calibration_digest(calibration)
        if found != self.calibration:
            raise ValueError(
                f"models were trained with calibration {self.calibration[:8]}, this is "
                f"{found[:8]}: run `workbench train` with this calibration"
            )

    def save(self, path: Path) -> None:
        """Write beside ``path`` and rename, so that a reader never sees half a file."""
        arrays: dict[str, Any] = {
            "format": np.array(FORMAT),
            "version": np.array(VERSION),
            "names": np.array(self.names),
            "mean": self.mean,
            "deviation": self.deviation,
            "phi": np.array(self.phi),
            "image": np.array([float(self.side), self.mm_per_px]),
            "calibration": np.array(self.calibration),
            "report": np.array(json.dumps(self.report, sort_keys=True)),
        }
        for k, part in enumerate(self.parts):
            space = part.space
            arrays |= {
                f"part{k}_features": part.features,
                f"part{k}_mean_image": space.mean,
                f"part{k}_eigenimages": space.basis,
                f"part{k}_variance": space.variance,
                f"part{k}_manifold": space.manifold,
                f"part{k}_views_deg": space.views_deg,
                f"part{k}_views": space.views,
                f"part{k}_profile": part.profile,
                f"part{k}_left_out": part.left_out,
                f"part{k}_body": part.body,
                f"part{k}_numbers": np.array(
                    [space.norm, space.order, part.zeta, part.profile_noise_mm, part.period_deg]
                ),
            }
        with replacing(path) as beside, beside.open("wb") as file:
            np.savez_compressed(file, allow_pickle=False, **arrays)

    def log(self, recording: Any) -> Any:
        """Log what training found to a ``rerun.RecordingStream``; returns the layout for it."""
        from .report import blueprint, log_database

        log_database(recording, self)
        return blueprint(self)

    @staticmethod
    def load(path: Path) -> Database:
        """Read a file that :meth:`save` wrote.  Raises ``OSError``, or ``ValueError`` in a line."""
        return read_arrays(path, "models", FORMAT, VERSION, "workbench train", _from_arrays)


def _from_arrays(arrays: Mapping[str, np.ndarray]) -> Database:
    side = int(arrays["image"][0])
    parts = []
    for k, name in enumerate(arrays["names"]):
        own = {
            key: arrays[f"part{k}_{key}"]
            for key in (
                "features", "mean_image", "eigenimages", "variance", "manifold", "views_deg",
                "views", "profile", "left_out", "body", "numbers",
            )
        }  # fmt: skip
        kept = own["eigenimages"].shape[0]
        expected = {
            "features": (len(own["features"]), 4),
            "mean_image": (side * side,),
            "eigenimages": (kept, side * side),
            "variance": (kept,),
            "manifold": (POINTS, kept),
            "profile": (PROFILE_SECTORS,),
            "body": (PROFILE_SECTORS,),
            "numbers": (5,),
        }
        for key, shape in expected.items():
            if own[key].shape != shape:
                raise ValueError(f"expected {key} of {name} {shape}, found {own[key].shape}")
        if not all(np.isfinite(own[key]).all() for key in expected if key != "profile"):
            raise ValueError(f"expected numbers for {name}, found some that are none")
        norm, order, zeta, noise, period = (float(v) for v in own["numbers"])
        space = Eigenspace(
            own["mean_image"], own["eigenimages"], own["variance"], own["manifold"],
            own["views_deg"], own["views"], norm, int(order),
        )  # fmt: skip
        parts.append(
            Part(str(name), own["features"], space, zeta, own["profile"], noise, period,
                 own["left_out"], own["body"])
        )  # fmt: skip
    if not parts:
        raise ValueError("expected one part or more, found none")
    if arrays["mean"].shape != (4,) or arrays["deviation"].shape != (4,):
        raise ValueError("expected a mean and a deviation of 4 features")
    return Database(
        tuple(parts), arrays["mean"], arrays["deviation"], float(arrays["phi"]), side,
        float(arrays["image"][1]), str(arrays["calibration"]), json.loads(str(arrays["report"])),
    )  # fmt: skip


def calibration_digest(calibration: Any) -> str:
    """What identifies a calibration's numbers, whatever file holds them; "" for none."""
    if calibration is None:
        return ""
    # Every sixteenth pixel tells two calibrations apart, and costs nothing per frame.
    some = np.ascontiguousarray(calibration.curve[:, ::16, ::16])
    return digest_of([some, float(calibration.near_z_m), float(calibration.far_z_m)])


# -- training ------------------------------------------------------------------------------------


def make_database(
    views: Mapping[str, Sequence[View]],
    calibration: str = "",
    side: int = 48,
    share: float = 0.995,
) -> Database:
    """The database from views of each part's surface.

    Raises ``ValueError`` with one line where a part has too few views.
    """
    if not views:
        raise ValueError("expected views of one part or more, found none")
    for name, own in views.items():
        if len(own) < _LEAST_VIEWS:
            raise ValueError(f"{name}: expected {_LEAST_VIEWS} views or more, found {len(own)}")
    reach = max(float(np.median([v.surface.reach_mm for v in own])) for own in views.values())
    mm_per_px = 2 * _ROOM * reach / side
    parts: list[Part] = []
    for name, own in views.items():
        surfaces = [view.surface for view in own]
        angles = np.array([view.angle_deg for view in own], np.float64)
        space, left_out = build(surfaces, angles, side, mm_per_px, share)
        cut = np.array(
            [matches(space, soft_view(s, side, mm_per_px).ravel())[0].distance for s in surfaces]
        )
        # What the eigenspace leaves out is part of every distance, also of a perfect view's.
        apart = np.sqrt(left_out**2 + cut**2)
        profiles = np.array([turn_profile(view.profile, -view.angle_deg) for view in own])
        profile, noise = _mean_profile(profiles)
        above, _ = _mean_profile(
            np.array([turn_profile(view.above_table, -view.angle_deg) for view in own])
        )
        parts.append(
            Part(
                name,
                np.array([features_mm(s) for s in surfaces]),
                space,
                _ZETA_OVER_VIEWS * max(float(apart.max()), _border_distance(own, space, mm_per_px)),
                profile,
                noise,
                _period_deg(space.order, profile, noise),
                apart,
                np.nan_to_num(above) > _BODY_ABOVE_TABLE_MM,
            )
        )
    patterns = np.concatenate([part.features for part in parts])
    mean = patterns.mean(axis=0)
    deviation = np.maximum(patterns.std(axis=0), _LEAST_SPREAD * np.abs(mean))
    pixel_mm = float(np.median([view.surface.pixel_mm for own in views.values() for view in own]))
    phi, within, between = _threshold(parts, mean, deviation, pixel_mm)
    zeta = _separate(parts)
    report = {
        "parts": {
            part.name: {
                "views": len(part.features),
                "features_mean": part.features.mean(axis=0).tolist(),
                "features_deviation": part.features.std(axis=0).tolist(),
                "eigenvectors": len(part.space.basis),
                "variance_kept": float(part.space.variance.sum()),
                "left_out_mean": float(part.left_out.mean()),
                "left_out_worst": float(part.left_out.max()),
                "symmetry_of_the_surface": part.space.order,
                "period_deg": part.period_deg,
                "zeta": limit,
            }
            for part, limit in zip(parts, zeta, strict=True)
        },
        "phi": phi,
        "farthest_within_a_part": within,
        **({"nearest_between_parts": between} if np.isfinite(between) else {}),
        "image_px": side,
        "mm_per_px": mm_per_px,
    }
    limited = tuple(replace(part, zeta=limit) for part, limit in zip(parts, zeta, strict=True))
    return Database(limited, mean, deviation, phi, side, mm_per_px, calibration, report)


def _border_distance(views: Sequence[View], space: Eigenspace, mm_per_px: float) -> float:
    """Distance at which a view lies whose border is off by as much as a border is uncertain.

    A face that is larger by the factor k has its border moved outwards by (k - 1) 2 A / P in the
    mean, A being its area and P its perimeter.
    """
    distances = []
    for view in views:
        area, perimeter = features_mm(view.surface)[:2]
        larger = 1 + _BORDER_PX * view.surface.pixel_mm * perimeter / (2 * area)
        images = (soft_view(view.surface, space.side, mm_per_px / k) for k in (1.0, larger))
        distances.append(float(np.linalg.norm(np.subtract(*images))) / space.norm)
    return float(np.median(distances))


def _border_error(parts: Sequence[Part], deviation: NDArray[np.float64], shift_mm: float) -> float:
    """Greatest distance that a border moved outwards by ``shift_mm`` puts between equal faces."""
    worst = 0.0
    for part in parts:
        area, perimeter, _, reach = np.median(part.features, axis=0)
        # A border that moves by e sweeps its length times e, and turns one full turn.
        area_after, length_after = area + perimeter * shift_mm, perimeter + 2 * np.pi * shift_mm
        before = np.array([area, perimeter, 4 * np.pi * area / perimeter**2, reach])
        after = np.array(
            [
                area_after,
                length_after,
                4 * np.pi * area_after / length_after**2,
                reach + shift_mm,
            ]
        )
        worst = max(worst, float(np.linalg.norm((after - before) / deviation)))
    return worst


def _tilt_error(parts: Sequence[Part], deviation: NDArray[np.float64]) -> float:
    """Greatest distance that an error of the normal puts between equal faces, at 25° of tilt.

    A face that is rectified by a normal that is off by δ is stretched by tan(tilt) δ, worst of all
    along its greatest extent.
    """
    stretch = 1 + np.tan(np.radians(_TILT_DEG)) * np.radians(_NORMAL_ERROR_DEG)
    worst = 0.0
    for part in parts:
        area, perimeter, shape, reach = np.median(part.features, axis=0)
        # A long face is all but twice its length around; a round one turns half of it away.
        longer = 1 + (stretch - 1) * min(4 * reach / perimeter, 1.0)
        before = np.array([area, perimeter, shape, reach])
        after = before * np.array([stretch, longer, stretch / longer**2, stretch])
        worst = max(worst, float(np.linalg.norm((after - before) / deviation)))
    return worst


def _threshold(
    parts: Sequence[Part],
    mean: NDArray[np.float64],
    deviation: NDArray[np.float64],
    pixel_mm: float,
) -> tuple[float, float, float]:
    """φ, the farthest a view lies from the others of its part, and the nearest two parts come.

    After Nene and Nayar: the distances inside the database say how far a neighbour can be.  φ is
    several times the farthest that a view lies from its own part's others, or what a border that is
    a fraction of a pixel off does (a symmetric part's views come in equal pairs, whose distance is
    none), and what an error of the normal adds on a tilted face (the views lie flat); and never
    more than half of what separates two parts: then nothing is within φ of both.
    """
    sets = [(part.features - mean) / deviation for part in parts]

    def apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=-1))

    within = 0.0
    for own in sets:
        distance = apart(own, own)
        np.fill_diagonal(distance, np.inf)
        within = max(within, float(distance.min(axis=1).max()))
    between = float("inf")
    for i in range(len(sets)):
        for j in range(i):
            if parts[i].name != parts[j].name:
                between = min(between, float(apart(sets[i], sets[j]).min()))
    border = _border_error(parts, deviation, _BORDER_PX * pixel_mm)
    alone = max(_PHI_OVER_VIEWS * within, border)
    return (
        min(float(np.hypot(alone, _tilt_error(parts, deviation))), 0.5 * between),
        within,
        between,
    )


def _separate(parts: Sequence[Part]) -> list[float]:
    """ζ of each part: never more than half the distance at which another part's views lie."""
    limits = []
    for i, part in enumerate(parts):
        nearest = float("inf")
        for j, other in enumerate(parts):
            if i == j or other.name == part.name:
                continue
            space = other.space
            some = space.views.astype(np.float64) @ space.basis + space.mean
            nearest = min(nearest, *(matches(part.space, image)[0].distance for image in some))
        limits.append(min(part.zeta, 0.5 * nearest))
    return limits


def turn_profile(profile: NDArray[np.float64], by_deg: float) -> NDArray[np.float64]:
    """A profile of surroundings [36] after a turn of the face, NaN where it was not measured."""
    count = len(profile)
    at = (np.arange(count) - by_deg * count / 360) % count
    low = np.floor(at).astype(int) % count
    part = at - np.floor(at)
    high = (low + 1) % count
    return np.where(part < 1e-6, profile[low], (1 - part) * profile[low] + part * profile[high])


def _mean_profile(
    profiles: NDArray[np.float64],
) -> tuple[NDArray[np.float64], float]:
    """Median over the views [V 36] in each direction, and the views' rms distance from it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        middle = np.nanmedian(profiles, axis=0)
        spread = np.nanmedian(np.abs(profiles - middle)) * 1.4826
    return middle, float(spread) if np.isfinite(spread) else float("inf")


_TELLING = 3.0
"""Surroundings tell two turns apart where they differ by so many times their noise (rms)."""


def _period_deg(order: int, profile: NDArray[np.float64], noise: float) -> float:
    """Least turn after which the surface and its surroundings look the same."""
    for times in range(order, 1, -1):
        if order % times:
            continue
        turned = turn_profile(profile, 360 / times)
        both = np.isfinite(turned) & np.isfinite(profile)
        if not both.any():
            return 360 / times
        apart = float(np.sqrt(((turned - profile)[both] ** 2).mean()))
        if apart <= _TELLING * max(noise, 0.5):
            return 360 / times
    return 360.0


def view_of(
    surface: Surface, angle_deg: float, depth_m: NDArray[np.float32], table: Plane | None
) -> View:
    """A training view from a face, its rotation, the depth around it and the table."""
    return View(surface, angle_deg, *fall_off(surface, depth_m, table))

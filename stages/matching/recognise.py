"""Which region is the topmost part, and which part it is (paper, 5)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from ..edges.planes import Camera
from ..wording import apart
from .database import Database, Part, turn_profile
from .eigenspace import Match, matches
from .occlusion import covers
from .partial import name_by_what_shows
from .surfaces import (
    PROFILE_SECTORS,
    RING_PX,
    Surface,
    cut_out,
    fall_off,
    features_mm,
    shortest_turn,
    soft_view,
)

__all__ = [
    "Reason", "Rules", "checks", "contradiction", "explain_row", "find_candidates", "match_part",
    "verdict_of",
]  # fmt: skip

_FACING = 0.2
"""Cosine between a flank's normal and the line of sight from which the flank is looked for."""

_LOWER_MM = 3.0
"""Surroundings that lie lower than the part's by less are the noise of a steep flank."""

_CONTRADICTS = 0.25
"""A part is contradicted if its body lacks in more than this share of the directions."""

_TIED = 1.5
"""Turns that fit the outline so nearly as well are given the benefit of the doubt."""


class Reason(IntEnum):
    """Why a candidate is not picked; the first criterion that it fails."""

    NONE = 0
    TOO_SMALL = 1
    CUT = 2
    TILTED = 3
    NOT_FLAT = 4
    OCCLUDED = 5
    FEATURES = 6
    SHAPE = 7
    SURROUNDINGS = 8


@dataclass(frozen=True)
class Rules:
    """The criteria; see the stage's parameters."""

    min_area: float = 0.8
    step_mm: float = 1.0
    covered_share: float = 0.06
    max_tilt_deg: float = 50.0
    max_residual_mm: float = 1.0
    phi_scale: float = 1.0
    zeta_scale: float = 1.0
    most_hidden: float = 0.2


def match_part(
    part: Part, surface: Surface, side: int, mm_per_px: float
) -> tuple[list[Match], bool]:
    """The nearest points of a part's manifold, and whether the face is the mirror image.

    A flat part that lies on its other side shows the mirror image of what was trained.
    """
    straight = matches(part.space, soft_view(surface, side, mm_per_px).ravel())
    if straight[0].distance <= part.zeta:
        return straight, False
    turned = matches(part.space, soft_view(surface, side, mm_per_px, mirrored=True).ravel())
    if turned[0].distance < min(part.zeta, straight[0].distance):
        return turned, True
    return straight, False


def contradiction(part: Part, surface: Surface, profile: np.ndarray, rotation_deg: float) -> float:
    """Share of the directions in which the part's body should be seen and is not, 0..1.

    Where in training the part itself went on beyond the face, its flank must be there, as high
    as it was or with something on it.  Directions in which the flank faces away are left out.
    """
    if not part.body.any():
        return 0.0
    expected = turn_profile(part.profile, rotation_deg)
    body = turn_profile(part.body.astype(np.float64), rotation_deg) > 0.99
    out_mm = sum(RING_PX) / 2 * surface.pixel_mm
    towards = -surface.origin_m / np.linalg.norm(surface.origin_m) @ shortest_turn(surface.normal)
    angle = np.arange(PROFILE_SECTORS) * 2 * np.pi / PROFILE_SECTORS
    along = np.cos(angle) * towards[0] + np.sin(angle) * towards[1]
    size = np.hypot(expected, out_mm)
    faces_camera = (expected * along + out_mm * towards[2]) / size > _FACING
    seen = body & faces_camera & np.isfinite(profile) & np.isfinite(expected)
    if seen.sum() < PROFILE_SECTORS // 6:
        return 0.0
    # A steep flank's fall errs with where the border is, in proportion to it.
    allowed = np.maximum(0.5 * expected[seen], max(_LOWER_MM, 3 * part.profile_noise_mm))
    return float((profile[seen] - expected[seen] > allowed).mean())


def find_candidates(
    labels: np.ndarray,
    regions: np.ndarray,
    depth_m: np.ndarray,
    camera: Camera,
    database: Database,
    rules: Rules,
) -> np.ndarray:
    """The regions that could be a part, largest first: a structured array.

    Fields: ``label``, ``rank`` (by area), ``elevation_m``, ``area_mm2``, ``perimeter_mm``,
    ``shape_factor``, ``greatest_distance_mm``, ``occluded``, ``occluded_by`` (label, 0 none),
    ``occluded_share`` (of the border), ``distances`` [models], ``model`` (index of the best),
    ``distance``, ``shape_distance`` and ``zeta`` (NaN unless under φ), ``mirrored``,
    ``visible_model`` (what shows of an incomplete one is this part's; -1 none) and
    ``hidden_share`` (of it, else NaN), ``reason`` (:class:`Reason`), ``picked``.
    """
    models = len(database.parts)
    kind = np.dtype(
        [
            ("label", np.int32), ("rank", np.int32), ("elevation_m", np.float64),
            ("tilt_deg", np.float64), ("area_mm2", np.float64), ("perimeter_mm", np.float64),
            ("shape_factor", np.float64), ("greatest_distance_mm", np.float64),
            ("occluded", np.bool_), ("occluded_by", np.int32), ("occluded_share", np.float64),
            ("distances", np.float64, (models,)), ("model", np.int32), ("distance", np.float64),
            ("shape_distance", np.float64), ("zeta", np.float64), ("mirrored", np.bool_),
            ("visible_model", np.int32), ("hidden_share", np.float64),
            ("reason", np.int32), ("picked", np.bool_),
        ]
    )  # fmt: skip
    above = covers(
        labels, regions["point_m"], regions["normal"], regions["residual_m"], camera,
        rules.step_mm * 1e-3, depth_m,
    )  # fmt: skip
    rows = []
    for region in regions[~regions["background"] & (regions["plane_px"] > 0)]:
        surface = cut_out(labels, int(region["label"]), region["point_m"], region["normal"], camera)
        if surface is None:
            continue
        row = np.zeros((), kind)
        row["label"] = region["label"]
        row["elevation_m"], row["tilt_deg"] = region["elevation_m"], region["tilt_deg"]
        row["area_mm2"] = surface.area_mm2
        for name in ("perimeter_mm", "shape_factor", "greatest_distance_mm", "distances"):
            row[name] = np.nan
        row["model"], row["distance"] = -1, np.nan
        row["shape_distance"] = row["zeta"] = row["hidden_share"] = np.nan
        row["visible_model"] = -1
        _judge(row, region, surface, above, depth_m, database, rules)
        incomplete = row["reason"] in (Reason.CUT, Reason.OCCLUDED)
        if incomplete and rules.most_hidden > 0 and row["tilt_deg"] <= rules.max_tilt_deg:
            shows = name_by_what_shows(
                surface, int(row["label"]), labels, depth_m, database, rules.most_hidden
            )
            if shows.names(rules.most_hidden):
                row["visible_model"], row["hidden_share"] = shows.model, shows.hidden_share
        rows.append(row)
    out = np.array(rows, kind) if rows else np.zeros(0, kind)
    out = out[np.argsort(-out["area_mm2"], kind="stable")]
    out["rank"] = np.arange(1, len(out) + 1)
    free = np.flatnonzero(out["reason"] == Reason.NONE)
    if len(free):
        # All of these match; the highest lies on the others and not under them.
        out["picked"][free[np.argmax(out["elevation_m"][free])]] = True
    return out


def _judge(
    row: Any,
    region: Any,
    surface: Surface,
    above: dict[tuple[int, int], tuple[int, float]],
    depth_m: np.ndarray,
    database: Database,
    rules: Rules,
) -> None:
    """Measure a candidate as far as it gets, and set the reason of the first failure."""
    border = max(float(region["perimeter_px"]), 1.0)
    own = [(n / border, high) for (low, high), (n, _) in above.items() if low == row["label"]]
    if own:
        _, by = max(own)
        row["occluded_share"], row["occluded_by"] = min(sum(s for s, _ in own), 1.0), by
        row["occluded"] = row["occluded_share"] > rules.covered_share
    if surface.area_mm2 < rules.min_area * database.smallest_mm2:
        row["reason"] = Reason.TOO_SMALL
        return
    features = features_mm(surface)
    row["perimeter_mm"], row["shape_factor"], row["greatest_distance_mm"] = features[1:]
    distances = database.distances(features)
    best = int(np.nan_to_num(distances, nan=np.inf).argmin())
    row["distances"], row["model"], row["distance"] = distances, best, distances[best]
    if region["border_px"] > 0:
        row["reason"] = Reason.CUT
    elif not region["tilt_deg"] <= rules.max_tilt_deg:
        row["reason"] = Reason.TILTED
    elif not region["residual_m"] <= rules.max_residual_mm * 1e-3:
        row["reason"] = Reason.NOT_FLAT
    elif row["occluded"]:
        row["reason"] = Reason.OCCLUDED
    elif not distances[best] <= rules.phi_scale * database.phi:
        row["reason"] = Reason.FEATURES
    else:
        part = database.parts[best]
        found, mirrored = match_part(part, surface, database.side, database.mm_per_px)
        row["shape_distance"], row["zeta"] = found[0].distance, part.zeta
        row["mirrored"] = mirrored
        if found[0].distance > rules.zeta_scale * part.zeta:
            row["reason"] = Reason.SHAPE
            return
        profile, _ = fall_off(surface, depth_m)
        wrong = min(
            contradiction(part, surface, profile, m.rotation_deg)
            for m in found
            if m.distance <= _TIED * found[0].distance + 1e-3
        )
        if wrong > _CONTRADICTS:
            row["reason"] = Reason.SURROUNDINGS


def explain_row(row: Any, database: Database, rules: Rules) -> str:
    """Why a candidate was refused, or that it is accepted, in one clause."""
    reason = Reason(int(row["reason"]))
    shows = ""
    if row["visible_model"] >= 0:
        part = database.names[int(row["visible_model"])]
        shows = f"; what shows is {part}'s, {100 * row['hidden_share']:.0f} % hidden"
    name = database.names[int(row["model"])] if row["model"] >= 0 else "none"
    if reason is Reason.TOO_SMALL:
        least = rules.min_area * database.smallest_mm2
        return f"area {row['area_mm2']:.0f} mm² under {least:.0f}"
    if reason is Reason.CUT:
        return f"leaves the image{shows}"
    if reason is Reason.TILTED:
        return f"tilt {row['tilt_deg']:.0f}° over {rules.max_tilt_deg:.0f}°"
    if reason is Reason.NOT_FLAT:
        return "not flat"
    if reason is Reason.OCCLUDED:
        share = 100 * row["occluded_share"]
        return (
            f"Occ: region {row['occluded_by']} is above it along {share:.0f} % of its border{shows}"
        )
    if reason is Reason.FEATURES:
        phi = rules.phi_scale * database.phi
        return f"features {row['distance']:.3f} from {name}, over φ {phi:.3f}"
    if reason is Reason.SHAPE:
        zeta = rules.zeta_scale * row["zeta"]
        return f"outline {row['shape_distance']:.3f} from {name}, over ζ {zeta:.3f}"
    if reason is Reason.SURROUNDINGS:
        return f"measures of {name}, but what lies around it is lower than {name} is"
    return f"{name}: features {row['distance']:.3f}, outline {row['shape_distance']:.3f}"


def checks(
    row: Any, region: Any, database: Database, rules: Rules
) -> list[tuple[Reason, str, dict[str, Any]]]:
    """The criteria in order, up to the one that the candidate failed: which, in words, numbers."""
    failed = Reason(int(row["reason"]))
    name = database.names[int(row["model"])] if row["model"] >= 0 else "none"
    smallest = rules.min_area * database.smallest_mm2
    phi, zeta = rules.phi_scale * database.phi, rules.zeta_scale * float(row["zeta"])
    area = apart(row["area_mm2"], smallest, 1)
    tilt = apart(row["tilt_deg"], rules.max_tilt_deg, 1)
    residual = apart(1e3 * region["residual_m"], rules.max_residual_mm, 2)
    share = apart(100 * row["occluded_share"], 100 * rules.covered_share, 1)
    said: list[tuple[Reason, str, dict[str, Any]]] = [
        (
            Reason.TOO_SMALL,
            f"area {area} mm² is not under {smallest:.1f} mm², the smallest part's times "
            f"{rules.min_area:g}",
            {"area_mm2": row["area_mm2"]},
        ),
        (
            Reason.CUT,
            "it does not touch the image's border",
            {"border_px": region["border_px"]},
        ),
        (
            Reason.TILTED,
            f"tilt {tilt}° is not over {rules.max_tilt_deg:g}°",
            {"tilt_deg": row["tilt_deg"]},
        ),
        (
            Reason.NOT_FLAT,
            f"{residual} mm from its plane, not over {rules.max_residual_mm:g} mm",
            {"residual_m": region["residual_m"]},
        ),
        (
            Reason.OCCLUDED,
            f"others lie {rules.step_mm:g} mm or more above it along "
            f"{share} % of its border, not over "
            f"{100 * rules.covered_share:g} %",
            {"occluded_share": row["occluded_share"], "occluded_by": row["occluded_by"]},
        ),
        (
            Reason.FEATURES,
            f"features {apart(row['distance'], phi, 3)} from {name}, not over φ {phi:.3f}",
            {"distance": row["distance"], "phi": phi},
        ),
        (
            Reason.SHAPE,
            f"outline {apart(row['shape_distance'], zeta, 3)} from {name}, not over ζ {zeta:.3f}",
            {"shape_distance": row["shape_distance"], "zeta": zeta},
        ),
        (Reason.SURROUNDINGS, f"what lies around it is what {name} has around it", {}),
    ]
    if failed is Reason.NONE:
        return said
    passed = [one for one in said if one[0] < failed]
    values = next(one[2] for one in said if one[0] is failed)
    return [*passed, (failed, refusal(row, region, database, rules), values)]


def refusal(row: Any, region: Any, database: Database, rules: Rules) -> str:
    """The criterion that a candidate failed, with the numbers that :func:`explain_row` spares."""
    reason = Reason(int(row["reason"]))
    name = database.names[int(row["model"])] if row["model"] >= 0 else "none"
    if reason is Reason.TOO_SMALL:
        least = rules.min_area * database.smallest_mm2
        return f"area {apart(row['area_mm2'], least, 1)} mm² is under {least:.1f} mm²"
    if reason is Reason.CUT:
        return f"leaves the image: {region['border_px']} px of it are on the image's border"
    if reason is Reason.TILTED:
        tilt = apart(row["tilt_deg"], rules.max_tilt_deg, 1)
        return f"tilt {tilt}° is over {rules.max_tilt_deg:g}°"
    if reason is Reason.NOT_FLAT:
        residual = apart(1e3 * region["residual_m"], rules.max_residual_mm, 2)
        return f"not flat: {residual} mm from its plane, over {rules.max_residual_mm:g} mm"
    if reason is Reason.OCCLUDED:
        share = apart(100 * row["occluded_share"], 100 * rules.covered_share, 1)
        return (
            f"Occ: region {row['occluded_by']} (and others) lie {rules.step_mm:g} mm or more above "
            f"it along {share} % of its border, over {100 * rules.covered_share:g} %"
        )
    if reason is Reason.FEATURES:
        phi = rules.phi_scale * database.phi
        distance = apart(row["distance"], phi, 3)
        return f"features {distance} from {name}, the nearest, over φ {phi:.3f}"
    if reason is Reason.SHAPE:
        zeta = rules.zeta_scale * row["zeta"]
        return f"outline {apart(row['shape_distance'], zeta, 3)} from {name}, over ζ {zeta:.3f}"
    return explain_row(row, database, rules)


def verdict_of(candidates: np.ndarray, database: Database, rules: Rules) -> dict[str, Any]:
    """``{"verdict", "region", "object", "reason"}``: pick, or rearrange and why."""
    picked = candidates[candidates["picked"]]
    if len(picked):
        row = picked[0]
        return {
            "verdict": "pick",
            "region": int(row["label"]),
            "object": database.names[int(row["model"])],
            "reason": f"topmost match, {1e3 * row['elevation_m']:.1f} mm up; "
            + explain_row(row, database, rules),
        }
    large = candidates[candidates["reason"] != Reason.TOO_SMALL]
    if len(large):
        said = "; ".join(
            f"region {row['label']}: {explain_row(row, database, rules)}" for row in large
        )
    else:
        said = "no region has the area of a part"
    return {"verdict": "rearrange", "region": None, "object": None, "reason": said}

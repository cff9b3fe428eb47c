"""What recognition and pose look like: marks, tables and axes.  Arrays and text, no Rerun."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from .database import Database
from .recognise import Reason, Rules, explain_row

__all__ = [
    "AXIS_COLOURS", "MODEL_COLOUR", "axes_of", "candidate_marks", "candidates_page", "pose_page",
    "region_outlines",
]  # fmt: skip

_PICKED = (80, 220, 110)
_GOOD = (90, 170, 255)
_REFUSED = (240, 170, 60)
_COVERED = (240, 80, 80)
MODEL_COLOUR = (255, 220, 60)
AXIS_COLOURS = ((240, 70, 70), (80, 220, 90), (80, 140, 255))
_AXIS_M = 0.02


def _colour(row: Any) -> tuple[int, int, int]:
    if row["picked"]:
        return _PICKED
    if row["occluded"]:
        return _COVERED
    return _GOOD if row["reason"] == Reason.NONE else _REFUSED


def _shown(candidates: np.ndarray) -> np.ndarray:
    return candidates[(candidates["reason"] != Reason.TOO_SMALL) | candidates["occluded"]]


def region_outlines(labels: np.ndarray, candidates: np.ndarray) -> tuple[list[Any], list[Any]]:
    """Outlines [K 2] of the candidates of a part's size, and their colours."""
    strips, colours = [], []
    for row in _shown(candidates):
        mask = (labels == row["label"]).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            points = contour[:, 0]
            strips.append(np.concatenate([points, points[:1]]))
            colours.append(_colour(row))
    return strips, colours


def candidate_marks(
    candidates: np.ndarray, regions: np.ndarray, database: Database
) -> tuple[list[Any], list[str], list[Any]]:
    """Places (x, y), texts and colours: elevation in mm, occluded ones marked as in figure 8.

    Rank, area and perimeter, as in figure 11 b, are in the table beside the picture.
    """
    places, texts, colours = [], [], []
    for row in _shown(candidates):
        places.append(regions[int(row["label"]) - 1]["centroid_px"])
        text = f"{1e3 * row['elevation_m']:.0f}"
        if row["picked"]:
            text = f"{database.names[int(row['model'])]} {text} mm"
        elif row["occluded"]:
            text = f"Occ {text}"
        texts.append(text)
        colours.append(_colour(row))
    return places, texts, colours


def candidates_page(
    candidates: np.ndarray, verdict: dict[str, Any], database: Database, rules: Rules
) -> str:
    """The verdict and the candidates as markdown, the largest first."""
    name = f" {verdict['object']}" if verdict["object"] else ""
    distances = " | ".join(database.names)
    lines = [
        f"## {verdict['verdict']}{name}",
        "",
        verdict["reason"],
        "",
        f"φ {rules.phi_scale * database.phi:.3f}",
        "",
        f"| rank | region | elevation mm | area mm² | perimeter mm | {distances} | says |",
        "|---|---|---|---|---|" + "---|" * (len(database.names) + 1),
    ]
    for row in candidates:
        each = " | ".join("–" if np.isnan(d) else f"{d:.2f}" for d in row["distances"])
        perimeter = "–" if np.isnan(row["perimeter_mm"]) else f"{row['perimeter_mm']:.0f}"
        lines.append(
            f"| {row['rank']} | {row['label']} | {1e3 * row['elevation_m']:.1f} "
            f"| {row['area_mm2']:.0f} | {perimeter} | {each} "
            f"| {'**picked** ' if row['picked'] else ''}{explain_row(row, database, rules)} |"
        )
    return "\n".join(lines)


def axes_of(pose: dict[str, Any]) -> list[list[Any]]:
    """The pose's x, y and z axis as lines in the camera's frame, metres."""
    matrix = np.array(pose["camera_from_surface"])
    origin = matrix[:3, 3]
    return [[origin, origin + _AXIS_M * matrix[:3, k]] for k in range(3)]


def pose_page(poses: Sequence[dict[str, Any]], verdict: dict[str, Any] | None) -> str:
    """The poses as markdown."""
    if not poses:
        reason = verdict["reason"] if verdict else "no verdict"
        return f"## no pose\n\n{reason}"
    lines = []
    for pose in poses:
        noise = pose["uncertainty"]
        x, y, z = (1e3 * v for v in pose["grasp"]["position"])
        approach = ", ".join(f"{v:.3f}" for v in pose["grasp"]["approach"])
        lines += [
            f"## {pose['object']}, {pose['rotation_deg']:.1f}°",
            "",
            f"* rotation {pose['rotation_deg']:.2f}° ± {noise['rotation_deg']:.2f}°, the same "
            f"every {pose['period_deg']:.0f}°, settled by: {pose['settled_by']}",
            f"* normal ± {noise['normal_deg']:.2f}°, position ± {noise['position_mm']:.2f} mm",
            f"* outline {pose['distance']:.3f} against ζ {pose['zeta']:.3f}",
            f"* grasp at {x:.1f}, {y:.1f}, {z:.1f} mm, approach {approach}",
        ]
        if pose["mirrored"]:
            lines.append("* lies on its other side: the mirror image of what was trained")
        if pose["open_rotations_deg"]:
            others = ", ".join(f"{r:.1f}°" for r in pose["open_rotations_deg"])
            lines.append(f"* **open**: as good at {others}; the depth around it does not tell")
    return "\n".join(lines)

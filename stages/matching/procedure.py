"""``workbench train``: the database of parts from recordings of each lying flat (paper, 5 and 6.3).

The recordings run through the stages up to ``region_features``, as they will when the database is
used: what recognition measures is what training measured.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from workbench.stage import StageParameters, knob

from ..edges.inputs import best_depth
from ..edges.planes import background_plane
from .database import (
    Database,
    View,
    calibration_digest,
    make_database,
    view_of,
)
from .surfaces import cut_out

_FLAT_M = 1.2e-3
_KNOWN = 0.5
_STEEPEST_DEG = 60.0
_OF_LARGEST = 0.2
_SAME_AREA = 0.15


class TrainParameters(StageParameters):
    """The knobs of the procedure."""

    side: int = knob(48, "Side of the images in the eigenspace.", low=16, high=128, unit="px")
    variance: float = knob(
        0.995,
        "Share of the image set's variance that the kept eigenvectors hold; what is left out adds "
        "to every distance.",
        low=0.5,
        high=1.0,
        step=0.005,
    )
    every: int = knob(1, "Take only every so many-th view of a part.", low=1, high=12, step=1)
    first: int = knob(0, "Begin with this view.", low=0, high=1000, step=1)


def top_surface(regions: np.ndarray) -> Any | None:
    """The row of the region that is the part's visible top: the highest flat face of some size.

    Of what is not table: the largest may be flanks that ran together, so it must be flat, turned
    towards the camera, and of the flat ones the highest.
    """
    faces = regions[
        ~regions["background"]
        & (regions["plane_px"] > 0)
        & (regions["border_px"] == 0)
        & (regions["residual_m"] < _FLAT_M)
        & (regions["tilt_deg"] < _STEEPEST_DEG)
        & (regions["known_share"] > _KNOWN)
    ]
    if not len(faces):
        return None
    faces = faces[faces["area_px"] >= _OF_LARGEST * faces["area_px"].max()]
    return faces[int(np.argmax(faces["elevation_m"]))]


def training_view(artifacts: Mapping[str, Any], angle_deg: float) -> View | None:
    """The view of a part that lies alone, from one run's artifacts; None where no face is found."""
    depth, camera = best_depth(artifacts)
    if depth is None or camera is None:
        return None
    row = top_surface(artifacts["regions"])
    if row is None:
        return None
    surface = cut_out(artifacts["labels"], int(row["label"]), row["point_m"], row["normal"], camera)
    if surface is None:
        return None
    return view_of(surface, angle_deg, depth, background_plane(depth, camera))


def train(
    recordings: Iterable[tuple[str | None, Sequence[float] | None, Iterable[Any]]],
    parameters: TrainParameters,
    calibration: Any = None,
    progress: Callable[[str], None] = lambda _: None,
) -> Database:
    """The database from recordings, each of one part lying flat at known angles.

    ``recordings``: (label, angles, runs) each; label and angles override the ground truth's
    ``objects[0].name`` and ``angle`` (degrees, counter-clockwise as displayed).  Raises
    ``ValueError`` with one line where the recordings cannot train.
    """
    views: dict[str, list[View]] = {}
    left_aside: dict[str, list[str]] = {}
    for label, angles, runs in recordings:
        for position, run in enumerate(runs):
            index = run.frame.index
            if index < parameters.first or (index - parameters.first) % parameters.every:
                continue
            name, angle = _known(run.frame, label, angles, position)
            progress(f"{name}, {angle:.0f}°")
            view = None
            if "regions" in run.artifacts and "labels" in run.artifacts:
                view = training_view(
                    {"near_camera": run.frame.cameras.get("near"), **run.artifacts}, angle
                )
            if view is None:
                left_aside.setdefault(name, []).append(f"frame {index}: no flat face with depth")
            else:
                views.setdefault(name, []).append(view)
    for name, own in views.items():
        area = float(np.median([view.surface.area_mm2 for view in own]))
        same = [v for v in own if abs(v.surface.area_mm2 - area) <= _SAME_AREA * area]
        if len(same) < len(own):
            left_aside.setdefault(name, []).append(
                f"{len(own) - len(same)} views show another face"
            )
        views[name] = same
    lost = [name for name in left_aside if name not in views]
    if lost:
        raise ValueError(f"{lost[0]}: {left_aside[lost[0]][0]} (is there a calibration?)")
    progress("eigenspaces")
    database = make_database(
        views, calibration_digest(calibration), parameters.side, parameters.variance
    )
    for name, says in left_aside.items():
        database.report["parts"][name]["left_aside"] = says
    return database


def _known(
    frame: Any, label: str | None, angles: Sequence[float] | None, position: int
) -> tuple[str, float]:
    """Name and angle of the part in a frame.  Raises ``ValueError`` where nobody says."""
    meta = frame.truth.meta if frame.truth is not None else {}
    if label is None:
        objects = meta.get("objects")
        if isinstance(objects, list) and objects and isinstance(objects[0], Mapping):
            label = objects[0].get("name")
        if not isinstance(label, str) or not label:
            raise ValueError(f"frame {frame.index}: no object's name in the ground truth; --label")
        count = len(objects) if isinstance(objects, list) else 0
        if count > 1:
            raise ValueError(f"frame {frame.index}: expected one part lying alone, found {count}")
    if angles is not None:
        if position >= len(angles):
            raise ValueError(f"--angles: expected one for each frame, found {len(angles)}")
        return label, float(angles[position])
    angle = meta.get("angle")
    if not isinstance(angle, int | float):
        raise ValueError(f"frame {frame.index}: no angle in the ground truth; give --angles")
    return label, float(angle)


class Procedure:
    """What ``workbench train`` runs for this product."""

    Parameters = TrainParameters
    run = staticmethod(train)
    until = "region_features"
    """The stage up to which the recordings are run."""
    resource = "calibration"
    """The resource that the database is bound to."""


__all__ = ["Procedure", "TrainParameters", "top_surface", "train", "training_view"]

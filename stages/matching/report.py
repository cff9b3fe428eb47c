"""What training found, in Rerun: mean images, eigenimages, variance kept, and the manifolds."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from ..show import DARK
from .eigenspace import POINTS

if TYPE_CHECKING:
    from .database import Database, Part

__all__ = ["blueprint", "log_database"]

_SHOWN_EIGENIMAGES = 12
_ACROSS = 4
_ENLARGED = 4
_GAP_PX = 6
_LABELLED_DEG = 45.0


def log_database(recording: Any, database: Database) -> None:
    """Log every part's eigenspace, once and for all times, under ``models/NAME``."""
    recording.log(
        "models/thresholds",
        rr.TextDocument(_page(database), media_type="text/markdown"),
        static=True,
    )
    for part in database.parts:
        path = _path(part)
        side = part.space.side
        mean = cv2.convertScaleAbs(part.space.mean.reshape(side, side), alpha=255)
        recording.log(f"{path}/mean", rr.Image(_larger(mean)), static=True)
        _log_eigenimages(recording, f"{path}/eigenimages", part)
        recording.log(f"{path}/variance", rr.BarChart(100 * part.space.variance), static=True)
        _log_manifold(recording, f"{path}/manifold", part)


def blueprint(database: Database) -> rrb.Blueprint:
    """A tab for each part: mean image and variance, eigenimages, and the closed curve in 3D."""
    tabs = []
    for part in database.parts:
        path = _path(part)
        space = part.space
        kept = f"{100 * space.variance.sum():.1f} % of the variance in {len(space.basis)}"
        tabs.append(
            rrb.Horizontal(
                rrb.Vertical(
                    rrb.Spatial2DView(origin=f"{path}/mean", name=f"{part.name}: mean image"),
                    rrb.BarChartView(
                        origin=f"{path}/variance", name=f"% of the variance each ({kept})"
                    ),
                    rrb.TextDocumentView(origin="models/thresholds", name="features, φ and ζ"),
                ),
                rrb.Spatial2DView(
                    origin=f"{path}/eigenimages",
                    name="eigenimages, the greatest variance first (red +, blue -)",
                ),
                rrb.Spatial3DView(
                    origin=f"{path}/manifold",
                    name="manifold over a full turn: first three components",
                    background=DARK,
                ),
                column_shares=[1, 1.3, 1.5],
                name=part.name,
            )
        )
    return rrb.Blueprint(
        rrb.Tabs(*tabs),
        rrb.TimePanel(state="hidden"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _path(part: Part) -> str:
    # A user's label may be any text; a path of Rerun's takes letters, digits, - and _.
    return "models/" + "".join(c if c.isalnum() or c in "-_" else "_" for c in part.name)


def _larger(image: np.ndarray) -> np.ndarray:
    return cv2.resize(image, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_NEAREST)


def _log_eigenimages(recording: Any, path: str, part: Part) -> None:
    """The first eigenimages in one picture, each with the share of the variance that it holds."""
    space = part.space
    shown = space.basis[:_SHOWN_EIGENIMAGES]
    pitch = space.side * _ENLARGED + _GAP_PX
    rows = -(-len(shown) // _ACROSS)
    canvas = np.full((rows * pitch, _ACROSS * pitch, 3), DARK, np.uint8)
    places, texts = [], []
    for k, image in enumerate(shown):
        top, left = (k // _ACROSS) * pitch, (k % _ACROSS) * pitch
        picture = _larger(_signed(image.reshape(space.side, space.side)))
        canvas[top : top + len(picture), left : left + len(picture)] = picture
        places.append((left + pitch / 2, top + 14))
        texts.append(f"{k + 1}: {100 * space.variance[k]:.1f} %")
    recording.log(f"{path}/picture", rr.Image(canvas), static=True)
    recording.log(
        f"{path}/shares",
        rr.Points2D(places, labels=texts, show_labels=True, radii=0.01, colors=(230, 230, 230)),
        static=True,
    )


def _signed(image: np.ndarray) -> np.ndarray:
    """Red where positive, blue where negative, white at zero: [H W 3] uint8."""
    share = image / max(float(np.abs(image).max()), 1e-12)
    red = 255 * np.clip(1 + share, 0, 1)
    blue = 255 * np.clip(1 - share, 0, 1)
    return np.stack([red, np.minimum(red, blue), blue], axis=-1).astype(np.uint8)


def _log_manifold(recording: Any, path: str, part: Part) -> None:
    """The closed curve of the first three components, and the training views on it."""
    space = part.space
    curve = _three(space.manifold) / space.norm
    views = _three(space.views) / space.norm
    hue = np.linspace(0, 179, POINTS, endpoint=False, dtype=np.uint8)
    hsv = np.stack([hue, np.full_like(hue, 190), np.full_like(hue, 255)], axis=-1)[None]
    colours = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB)[0]
    closed = np.stack([curve, np.roll(curve, -1, axis=0)], axis=1)
    radius = 0.004 * float(np.ptp(curve, axis=0).max())
    recording.log(
        f"{path}/curve", rr.LineStrips3D(list(closed), colors=colours, radii=radius), static=True
    )
    labels = [
        f"{angle:.0f}°" if abs(angle / _LABELLED_DEG - round(angle / _LABELLED_DEG)) < 1e-6 else ""
        for angle in space.views_deg
    ]
    for name, chosen in (("views", [not text for text in labels]), ("labelled", map(bool, labels))):
        kept = np.array(list(chosen), bool)
        if kept.any():
            recording.log(
                f"{path}/{name}",
                rr.Points3D(
                    views[kept],
                    labels=[text for text, k in zip(labels, kept, strict=True) if k],
                    show_labels=name == "labelled",
                    colors=(245, 245, 245),
                    radii=2.5 * radius,
                ),
                static=True,
            )


def _three(projections: np.ndarray) -> np.ndarray:
    """The first three components [N 3]; zeros where the space has fewer."""
    return np.pad(projections[:, :3], ((0, 0), (0, max(0, 3 - projections.shape[1]))))


def _page(database: Database) -> str:
    lines = [
        f"φ {database.phi:.3f} of the features' deviations",
        "",
        "| part | area mm² | perimeter mm | shape | reach mm | ζ | period |",
        "|---|---|---|---|---|---|---|",
    ]
    for part in database.parts:
        area, perimeter, shape, reach = part.features.mean(axis=0)
        lines.append(
            f"| {part.name} | {area:.0f} | {perimeter:.1f} | {shape:.3f} | {reach:.2f} | "
            f"{part.zeta:.3f} | {part.period_deg:g}° |"
        )
    return "\n".join(lines)

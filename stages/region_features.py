"""Stage ``region_features``: closed regions and what section 5 measures on them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from workbench.stage import (
    Finding,
    Inputs,
    Logged,
    Outputs,
    Score,
    Scorer,
    Stage,
    StageParameters,
    knob,
)

from .artifacts import (
    DEPTH,
    EDGE_CHOICE,
    INTENSITY,
    LABELS,
    LINKING,
    NEAR_CAMERA,
    REGION_LINES,
    REGIONS,
)


class RegionFeatures(Stage):
    """Regions between closed lines, with their geometry and, from the depth, their planes.

    ``regions`` is a numpy structured array, row i for label i + 1: ``label``, ``area_px``,
    ``perimeter_px`` (with holes), ``shape_factor`` (4π area / perimeter²), ``greatest_distance_px``
    (centroid to border), ``centroid_px`` (x, y), ``border_px``, ``background``, ``known_share``,
    ``elevation_m`` (above the table, or above the farthest depth where no table was measured),
    ``point_m`` and ``normal`` of the fitted plane, ``tilt_deg``, ``residual_m``, ``plane_px``.
    What the depth does not tell is NaN.
    """

    name = "region_features"
    chapter = "segmentation"
    needs = (REGION_LINES, INTENSITY, EDGE_CHOICE, LINKING, DEPTH.optional(), NEAR_CAMERA)
    gives = (LABELS, REGIONS)

    class Parameters(StageParameters):
        min_area: float = knob(
            12.0,
            "Smaller regions are none: the inside of a double line.",
            low=1,
            high=1000,
            step=1,
            unit="px at 256²",
        )
        inset: float = knob(
            7.0,
            "The plane is fitted this far inside a region, where no window of the range sensor "
            "reaches across its border.",
            low=0,
            high=40,
            step=0.5,
            unit="px",
        )
        least_points: int = knob(
            40, "Pixels that a plane should rest on.", low=8, high=2000, step=1, unit="px"
        )

    def compute(self, inputs: Inputs, parameters: Any) -> Iterator[Outputs]:
        from .edges.inputs import best_depth
        from .edges.regions import closed_regions, region_features

        walls = inputs["linking"].walls
        labels = closed_regions(
            inputs["region_lines"],
            inputs["intensity"],
            inputs["edge_choice"].gradient,
            None if walls is None else walls.labels,
            min_area=parameters.min_area,
        )
        yield {"labels": labels}
        depth, camera = best_depth(inputs)
        table = region_features(
            labels,
            depth if camera is not None else None,
            camera,
            inset=parameters.inset,
            least_points=parameters.least_points,
        )
        yield {"regions": as_rows(table)}

    def log(self, recording: Any, logged: Logged) -> None:
        import rerun as rr

        from .show import grey_image

        artifacts = logged.artifacts
        regions = artifacts["regions"]
        recording.log("region_features/intensity", grey_image(artifacts["intensity"]))
        # The background is left as it is, so that the parts stand out.
        shown = artifacts["labels"].astype("uint16")
        for row in regions[regions["background"]]:
            shown[shown == row["label"]] = 0
        recording.log(
            "region_features/labels",
            rr.AnnotationContext(
                [(0, "none", (0, 0, 0, 0))]
                + [(int(row["label"]), describe(row)) for row in regions if not row["background"]]
            ),
            rr.SegmentationImage(shown, opacity=0.6),
        )
        recording.log(
            "region_features/table",
            rr.TextDocument(table_page(regions), media_type="text/markdown"),
        )

    def views(self, logged: Logged) -> list[Any]:
        import rerun.blueprint as rrb

        return [
            rrb.Vertical(
                rrb.Spatial2DView(
                    origin="region_features",
                    contents=["region_features/intensity", "region_features/labels"],
                    name="regions (hover)",
                ),
                rrb.TextDocumentView(origin="region_features/table", name="regions by area"),
                name=self.name,
            )
        ]

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        from .edges.regions import least_area_px
        from .edges.stories import enclosed_px, on_line

        label = int(artifacts["labels"][y, x])
        walls = artifacts["linking"].walls
        wall = 0 if walls is None else int(walls.labels[y, x])
        findings: list[Finding] = []
        line = bool(artifacts["region_lines"][y, x])
        edge = on_line(x, y, artifacts)
        shared = f"given to region {label} beside it" if label else "between regions, given to none"
        if wall:
            findings.append(
                Finding(f"in upright wall {wall} of those that the depth shows", {"wall": wall})
            )
        elif line:
            findings.append(Finding(f"on a line: {shared}", {"region_lines": line}))
        else:
            area = enclosed_px(x, y, artifacts["region_lines"], walls)
            least = least_area_px(artifacts["region_lines"].shape, p.min_area)
            small = area < least
            says = f"lines close {area} px around it, {'under' if small else 'not under'} {least}"
            if small:
                says += f": no region of its own, {shared}"
            findings.append(Finding(says, {"enclosed_px": area}, "min_area"))
        if label == 0:
            says = "in no closed region"
            return [*findings, Finding(says, {"labels": 0}, None, "no region")]
        row = artifacts["regions"][label - 1]
        about = f"region {label}, beside {edge}" if edge else ""
        values = {"labels": label, "area_px": row["area_px"], "background": row["background"]}
        if row["plane_px"] > 0:
            findings.append(
                Finding(
                    f"its plane rests on {row['plane_px']} px, {1e3 * row['residual_m']:.2f} mm "
                    f"from flat: {1e3 * row['elevation_m']:.2f} mm up, tilt {row['tilt_deg']:.1f}°",
                    {name: row[name] for name in ("plane_px", "elevation_m", "tilt_deg")},
                    "least_points",
                )
            )
        else:
            says = (
                f"no plane: depth is known on {100 * row['known_share']:.0f} % of it, and too "
                "little of that lies far enough inside"
            )
            findings.append(Finding(says, {"known_share": row["known_share"]}, "inset"))
        said = f"region {label}: {row['area_px']} px, shape {row['shape_factor']:.3f}"
        if row["background"]:
            says = (
                f"{said}, background: it has {row['border_px']} px of the image's border, or lies "
                "flat on the table"
            )
            return [*findings, Finding(says, values, None, "background", about)]
        return [*findings, Finding(said, values, None, "region", about)]

    def scorer(self) -> Scorer:
        from .edges.scorers import RegionScorer

        return RegionScorer()

    def figures(self, artifacts: Mapping[str, Any]) -> list[Score]:
        from .edges.regions import closed_share

        count = int((~artifacts["regions"]["background"]).sum())
        share = closed_share(artifacts["labels"], artifacts["region_lines"])
        return [
            Score("closed lines", share, better="higher"),
            Score("regions", float(count), "regions"),
        ]

    def picture(self, artifacts: Mapping[str, Any]) -> Any:
        from .pictures import regions_rgb

        return regions_rgb(artifacts["intensity"], artifacts["labels"], artifacts["regions"])


def as_rows(table: Any) -> Any:
    """A ``RegionTable`` as a structured array, which a file holds without pickling."""
    import numpy as np

    count = len(table)
    columns = {
        "label": np.arange(1, count + 1, dtype=np.int32),
        "area_px": table.area_px,
        "perimeter_px": table.perimeter_px,
        "shape_factor": table.shape_factor,
        "greatest_distance_px": table.greatest_distance_px,
        "centroid_px": table.centroid_px,
        "border_px": table.border_px,
        "background": table.background,
        "known_share": table.known_share,
        "elevation_m": table.elevation_m,
        "point_m": table.point_m,
        "normal": table.normal,
        "tilt_deg": table.tilt_deg,
        "residual_m": table.residual_m,
        "plane_px": table.plane_px,
    }
    rows = np.zeros(count, dtype=[(name, v.dtype, v.shape[1:]) for name, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


def describe(row: Any) -> str:
    """A region in a few words, for a hover label."""
    text = f"{row['label']}: {row['area_px']} px, shape {row['shape_factor']:.2f}"
    if row["plane_px"] > 0:
        text += f", {1e3 * row['elevation_m']:.1f} mm up, tilt {row['tilt_deg']:.0f}°"
    return text


def table_page(regions: Any) -> str:
    """The regions that are not background as a markdown table, the largest first."""
    lines = [
        "| # | area px | up mm | tilt ° | perimeter px | shape | reach px | residual mm |",
        "|---|---|---|---|---|---|---|---|",
    ]
    parts = regions[~regions["background"]]
    lines += [
        f"| {row['label']} | {row['area_px']} "
        f"| {1e3 * row['elevation_m']:.1f} | {row['tilt_deg']:.1f} "
        f"| {row['perimeter_px']:.1f} | {row['shape_factor']:.3f} "
        f"| {row['greatest_distance_px']:.1f} | {1e3 * row['residual_m']:.2f} |"
        for row in parts[parts["area_px"].argsort(kind="stable")[::-1]]
    ]
    return "\n".join(lines)

"""The tables of a sweep: a row a cell, and a row a cell and frame, as Parquet.

Rows are in the order of the cells.  Times have columns of their own, ``ms.STAGE``; all other
columns are the same whatever the number of workers and whatever was kept from before.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workbench.files import replacing
from workbench.stage import Better
from workbench.sweep.axes import Axis, Cell

PROVENANCE_KEY = "workbench.provenance"
METRICS_KEY = "workbench.metrics"
TIMES = "ms."
"""What the names of columns that hold times begin with."""

_ROWS_A_GROUP = 4096


@dataclass(frozen=True)
class Metric:
    """A figure that every cell may have, by its address ``stage.name``."""

    address: str
    title: str
    unit: str = ""
    better: Better | None = None

    def worth(self, value: float) -> float:
        """The value as a number of which more is better; minus infinity where there is none."""
        if not math.isfinite(value):
            return -math.inf
        if self.better == "zero":
            return -abs(value)
        return -value if self.better == "lower" else value


@dataclass(frozen=True)
class FrameRow:
    """One frame of a cell: its own figures, times and failure."""

    recording: int
    frame: int
    figures: Mapping[str, float]
    ms: Mapping[str, float]
    error: str


@dataclass
class Row:
    """One cell over all frames."""

    cell: Cell
    digest: str
    """Of all that the cell's results depend on but the frames: parameters, code, resources."""
    frames: int
    failed_frames: int
    error: str
    figures: dict[str, float]
    ms: Mapping[str, float] = field(default_factory=dict)


@functools.lru_cache(maxsize=4096)
def slug(name: str) -> str:
    """A figure's name as part of an address: ``faces found (IoU ≥ 0.7)`` is ``faces_found``."""
    bare = re.sub(r"\([^)]*\)", "", name.replace("×", "x").replace("%", "percent"))
    return re.sub(r"[^a-z0-9]+", "_", bare.replace("'", "").lower()).strip("_")


def write_cells(
    path: Path,
    rows: Sequence[Row],
    axes: Sequence[Axis],
    metrics: Sequence[Metric],
    stages: Sequence[str],
    provenance: Mapping[str, Any],
) -> None:
    """The table of cells, ``path`` replaced when it is complete."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns: dict[str, Any] = {
        "cell": pa.array([row.cell.index for row in rows], pa.int64()),
        **{axis.address: _axis_column(axis, rows) for axis in axes},
        "frames": pa.array([row.frames for row in rows], pa.int64()),
        "failed_frames": pa.array([row.failed_frames for row in rows], pa.int64()),
        "error": pa.array([row.error for row in rows], pa.string()),
    }
    for metric in metrics:
        values = [_number(row.figures.get(metric.address)) for row in rows]
        columns[metric.address] = pa.array(values, pa.float64())
    columns["result"] = pa.array([row.digest for row in rows], pa.string())
    for stage in stages:
        values = [_number(row.ms.get(stage)) for row in rows]
        columns[TIMES + stage] = pa.array(values, pa.float64())
    about = {
        PROVENANCE_KEY: json.dumps(provenance, sort_keys=True),
        METRICS_KEY: json.dumps(
            {m.address: {"title": m.title, "unit": m.unit, "better": m.better} for m in metrics}
        ),
    }
    table = pa.table(columns).replace_schema_metadata(about)
    with replacing(path) as beside:
        pq.write_table(table, beside, compression="zstd")


def write_frames(
    path: Path,
    cells: Iterable[tuple[Cell, Sequence[FrameRow]]],
    recordings: Sequence[str],
    figures: Sequence[str],
    stages: Sequence[str],
    provenance: Mapping[str, Any],
) -> None:
    """The table of cells and frames, written as ``cells`` gives them, in bounded memory."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = pa.schema(
        [
            ("cell", pa.int64()),
            ("recording", pa.string()),
            ("frame", pa.int64()),
            ("error", pa.string()),
            *((name, pa.float64()) for name in figures),
            *((TIMES + stage, pa.float64()) for stage in stages),
        ],
        metadata={PROVENANCE_KEY: json.dumps(provenance, sort_keys=True)},
    )
    with replacing(path) as beside, pq.ParquetWriter(beside, schema, compression="zstd") as writer:
        batch: list[dict[str, Any]] = []

        def flush() -> None:
            if batch:
                writer.write_table(pa.Table.from_pylist(batch, schema))
                batch.clear()

        for cell, rows in cells:
            batch += [
                {
                    "cell": cell.index,
                    "recording": recordings[row.recording],
                    "frame": row.frame,
                    "error": row.error,
                    **{name: _number(row.figures.get(name)) for name in figures},
                    **{TIMES + stage: _number(row.ms.get(stage)) for stage in stages},
                }
                for row in rows
            ]
            if len(batch) >= _ROWS_A_GROUP:
                flush()
        flush()


def _axis_column(axis: Axis, rows: Sequence[Row]) -> Any:
    import pyarrow as pa

    values = [row.cell.values[axis.address] for row in rows]
    kinds = {type(value) for value in axis.values}
    if len(kinds) > 1:
        # A choice among values of several types: as they are written on the command line.
        return pa.array([str(value) for value in values], pa.string())
    return pa.array(values)


def _number(value: float | None) -> float | None:
    return None if value is None or math.isnan(value) else value

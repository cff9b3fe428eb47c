"""``workbench export``: artifacts as files that any tool reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from workbench.console import closing_tables, end, interruptible, out, tracked
from workbench.errors import DataError, UsageError
from workbench.files import replacing
from workbench.pipeline import ResultStore, Run
from workbench.report import RunReport, to_json, write_beside
from workbench.session import Options, Session


def run(options: Options, folder: Path, artifacts: str | None, as_json: bool) -> None:
    """Export; exits with 1 if a stage failed on any frame or there was no frame."""
    # No result is asked for twice: none is kept.
    session = Session.open(options, ResultStore(capacity_bytes=0))
    wanted = _wanted(session, artifacts)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(f"--to {folder}: {error.strerror}") from error
    report = RunReport(session)
    # Frames of an earlier export would pass for this one's.
    for stale in folder.glob("frame_*.npz"):
        stale.unlink()
    write_beside(folder / "provenance.json", to_json(session.provenance()) + "\n")
    with (
        replacing(folder / "results.jsonl", keep_partial=True) as beside,
        beside.open("w", encoding="utf-8") as lines,
        interruptible(report),
    ):
        for result in tracked(session.runs(), "export", session.count()):
            report.add(result)
            _write_arrays(folder / f"frame_{result.frame.index:06d}.npz", result, wanted)
            lines.write(json.dumps(result_line(result), sort_keys=True) + "\n")
    if as_json:
        print(to_json(report.as_dict() | {"to": str(folder), "artifacts": wanted}))
    else:
        closing_tables(report)
        out.print(f"wrote {report.frames} frames to {folder}", soft_wrap=True, markup=False)
    end(report)


def result_line(run: Run) -> dict[str, Any]:
    """One line of ``results.jsonl``."""
    failures = [f"{failure.stage} failed: {failure.says}" for failure in run.failures]
    return {
        "index": run.frame.index,
        "stamp_ns": run.frame.stamp_ns,
        "verdict": run.artifacts.get("verdict"),
        "poses": run.artifacts.get("poses", []),
        "stage_ms": {name: round(ms, 3) for name, ms in run.stage_ms.items()},
        "warnings": [*run.warnings, *failures],
        "failures": [{"stage": f.stage, "says": f.says} for f in run.failures],
    }


def _wanted(session: Session, artifacts: str | None) -> list[str]:
    known = session.pipeline.artifacts
    if artifacts is None:
        return list(known)
    names = [name.strip() for name in artifacts.split(",") if name.strip()]
    for name in names:
        if name not in known:
            raise UsageError(f"--artifacts {name}: no such artifact; there are: {', '.join(known)}")
    if not names:
        raise UsageError("--artifacts: expected names separated by commas")
    return names


def _write_arrays(path: Path, run: Run, wanted: list[str]) -> None:
    """The arrays and numbers among the wanted artifacts; the others have no place in an npz."""
    arrays = {
        name: np.asarray(run.artifacts[name])
        for name in wanted
        if isinstance(run.artifacts.get(name), np.ndarray | int | float)
    }
    with replacing(path) as beside, beside.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)

"""The bench: recordings, stages, runs and Rerun, and nothing of what a pipeline is about.

import workbench

session = workbench.open("recordings/scene.mcap")
for run in session.runs():
    depth_m = run.artifacts["depth_m"]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from workbench.pipeline import Pipeline, Run
    from workbench.recording import Recording
    from workbench.session import Session
    from workbench.stage import (
        Artifact,
        Finding,
        Logged,
        Score,
        Scorer,
        Stage,
        StageParameters,
        knob,
    )

_WHERE = {
    "Artifact": "stage",
    "Finding": "stage",
    "Logged": "stage",
    "Score": "stage",
    "Scorer": "stage",
    "Stage": "stage",
    "StageParameters": "stage",
    "knob": "stage",
    "Pipeline": "pipeline",
    "Run": "pipeline",
    "Recording": "recording",
    "Session": "session",
}

__all__ = [
    "Artifact",
    "Finding",
    "Logged",
    "Pipeline",
    "Recording",
    "Run",
    "Score",
    "Scorer",
    "Session",
    "Stage",
    "StageParameters",
    "knob",
    "open",
]


def __getattr__(name: str) -> object:
    """Import the rest of the bench when it is first asked for, so that ``--help`` stays quick."""
    from importlib import import_module

    if name not in _WHERE:
        raise AttributeError(f"module 'workbench' has no attribute {name!r}")
    return getattr(import_module(f"workbench.{_WHERE[name]}"), name)


def open(
    recording: str | Path,
    *,
    preset: str | None = None,
    set: Sequence[str] = (),
    until: str | None = None,
    topics: Mapping[str, str] | None = None,
    calibration: str | Path | None = None,
    plugins: Sequence[str | Path] = (),
) -> Session:
    """A recording with its pipeline, as the command line would put it together.

    ``set`` holds ``stage.parameter=value`` texts.  Iterate ``runs()`` of what is returned.
    """
    from workbench.session import Options, Session

    return Session.open(
        Options(
            Path(recording),
            resources={} if calibration is None else {"calibration": Path(calibration)},
            preset=preset,
            assignments=set,
            topics=topics or {},
            until=until,
            plugins=[Path(plugin) for plugin in plugins],
        )
    )

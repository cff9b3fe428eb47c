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
    calibration: str | Path | None = None,
    models: str | Path | None = None,
    preset: str | None = None,
    config: str | Path | None = None,
    set: Sequence[str] = (),
    topics: Mapping[str, str] | None = None,
    frames: tuple[int, int | None] = (0, None),
    until: str | None = None,
    plugins: Sequence[str | Path] = (),
) -> Session:
    """A recording with its pipeline, as the command line would put it together.

    ``recording`` may be ``sample:scene``, which comes with the package.  ``set`` holds
    ``stage.parameter=value`` texts; ``frames`` is (first, one past the last, or None for the end).
    Iterate ``runs()`` of what is returned.  Raises ``RecordingError``, ``StageError`` or
    ``SettingsError``, each with one line.
    """
    from workbench.samples import located
    from workbench.session import Options, Session

    return Session.open(
        Options(
            located(recording),
            resources={
                name: Path(path)
                for name, path in (("calibration", calibration), ("models", models))
                if path is not None
            },
            preset=preset,
            config=None if config is None else Path(config),
            assignments=set,
            topics=topics or {},
            frames=frames,
            until=until,
            plugins=[Path(plugin) for plugin in plugins],
        )
    )

"""The committed recording that lessons with real piles run on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCENE = Path(__file__).parents[2] / "recordings" / "scene.mcap"
"""In a clone of the repository, from which the package is installed with ``pip install -e .``."""


def addressed(by_stage: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings by stage as ``stage.parameter`` to value."""
    return {
        f"{stage}.{name}": value
        for stage, values in by_stage.items()
        for name, value in values.items()
    }

"""The committed recording that lessons with real piles run on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workbench.samples import located

SCENE = located("sample:scene")


def addressed(by_stage: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Settings by stage as ``stage.parameter`` to value."""
    return {
        f"{stage}.{name}": value
        for stage, values in by_stage.items()
        for name, value in values.items()
    }

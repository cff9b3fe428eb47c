"""All that a stage gives, whether at once or in parts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from workbench.stage import Stage


def given(stage: Stage, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
    """The outputs of ``stage.compute``, put together."""
    parts = stage.compute(inputs, parameters)
    outputs: dict[str, Any] = {}
    for part in [parts] if isinstance(parts, Mapping) else parts:
        outputs |= part
    return outputs

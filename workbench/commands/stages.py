"""``workbench stages``: the reference page, made from the declarations."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from workbench.console import out, table
from workbench.errors import UsageError
from workbench.pipeline import ordered
from workbench.plugins import find_stages
from workbench.report import to_json
from workbench.stage import Artifact, Knob, Stage


def run(name: str | None, plugins: Sequence[Path], as_json: bool) -> None:
    """All stages in the order in which they run, or one of them."""
    stages = find_stages(plugins)
    if name is not None and name not in stages:
        raise UsageError(f"no stage {name!r}; stages: {', '.join(stages)}")
    chosen = [stages[name]] if name is not None else ordered(stages)
    if as_json:
        print(to_json([describe(stage) for stage in chosen]))
        return
    for stage in chosen:
        out.print(f"\n[bold]{stage.name}[/bold]")
        out.print(inspect.getdoc(type(stage)) or "", markup=False)
        out.print(f"needs: {', '.join(_need(need) for need in stage.needs)}", markup=False)
        for artifact in stage.gives:
            axes = f"{artifact.dtype} [{artifact.shape}]" if artifact.dtype != "object" else ""
            unit = f", {artifact.unit}" if artifact.unit else ""
            out.print(f"gives {artifact.name} {axes}{unit}: {artifact.doc}", markup=False)
        knobs = stage.Parameters.knobs()
        if knobs:
            table(
                "",
                ("parameter", "default", "range", "step", "unit", "why"),
                (
                    (
                        f"{stage.name}.{knob.name}",
                        knob.default,
                        range_text(knob),
                        "" if knob.step is None else knob.step,
                        knob.unit,
                        knob.why,
                    )
                    for knob in knobs.values()
                ),
            )
        for preset, changes in stage.presets.items():
            values = ", ".join(f"{key}={value}" for key, value in changes.items())
            out.print(f"preset {preset}: {values}", markup=False)


def describe(stage: Stage) -> dict[str, Any]:
    """A stage's declarations as JSON values."""
    return {
        "name": stage.name,
        "says": inspect.getdoc(type(stage)) or "",
        "needs": [
            {"name": need.name, "required": need.required, "says": need.doc} for need in stage.needs
        ],
        "gives": [
            {
                "name": artifact.name,
                "dtype": artifact.dtype,
                "shape": artifact.shape,
                "unit": artifact.unit,
                "says": artifact.doc,
            }
            for artifact in stage.gives
        ],
        "parameters": [
            {
                "name": f"{stage.name}.{knob.name}",
                "kind": knob.kind,
                "default": knob.default,
                "low": knob.low,
                "high": knob.high,
                "step": knob.step,
                "unit": knob.unit,
                "choices": list(knob.choices),
                "why": knob.why,
            }
            for knob in stage.Parameters.knobs().values()
        ],
        "presets": {name: dict(values) for name, values in stage.presets.items()},
    }


def range_text(knob: Knob) -> str:
    """The values a parameter may take, in a few characters."""
    if knob.choices:
        return " | ".join(str(choice) for choice in knob.choices)
    if knob.kind == "bool":
        return "true | false"
    if knob.low is None and knob.high is None:
        return ""
    low = "" if knob.low is None else f"{knob.low:g}"
    high = "" if knob.high is None else f"{knob.high:g}"
    return f"{low} … {high}"


def _need(need: Artifact) -> str:
    return need.name if need.required else f"{need.name} (optional)"

"""Procedures that make a resource: ``workbench calibrate`` and ``workbench train``.

A stage's :class:`Resource` names its procedure, so that the bench runs it and knows nothing of what
it measures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from typing import Any

import pydantic

from workbench.errors import UsageError
from workbench.settings import value_from_text
from workbench.stage import Resource, Stage, StageError


def procedure_of(stages: Mapping[str, Stage], resource: str) -> Any:
    """What the ``make`` of these stages' ``resource`` names.  Raises :class:`StageError`."""
    for stage in stages.values():
        for need in stage.needs:
            if isinstance(need, Resource) and need.name == resource and need.make:
                module, _, name = need.make.partition(":")
                return getattr(import_module(module), name)
    raise StageError(f"no stage says how {resource} is made")


def parameters_of(
    model: type[pydantic.BaseModel], command: str, assignments: Sequence[str]
) -> pydantic.BaseModel:
    """Parameters from ``--set command.parameter=value`` texts.  Raises :class:`UsageError`."""
    values = {}
    for assignment in assignments:
        address, equals, text = assignment.partition("=")
        name = address.removeprefix(f"{command}.").strip()
        if not equals or name not in model.model_fields:
            raise UsageError(
                f"--set {assignment}: expected one of "
                + ", ".join(f"{command}.{field}=…" for field in model.model_fields)
            )
        values[name] = value_from_text(text.strip())
    try:
        return model(**values)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join([command, *(str(part) for part in first["loc"])])
        raise UsageError(f"{where}: {first['msg']}, got {first['input']!r}") from error


def report_rows(report: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """A procedure's report as rows of a table: quantity, value."""
    for key, value in report.items():
        if isinstance(value, Mapping):
            yield from report_rows(value, f"{key} ")
        else:
            items = value if isinstance(value, list) else [value]
            yield f"{prefix}{key}".replace("_", " "), ", ".join(_text(item) for item in items)


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return str(value["name"])
    return f"{value:.5g}" if isinstance(value, float) else str(value)

"""Procedures that make a resource: ``workbench calibrate`` and ``workbench train``; and others.

A stage's :class:`Resource` names its procedure, so that the bench runs it and knows nothing of what
it measures.  Procedures that no stage needs, such as :class:`Simulation`, are entry points of the
group ``workbench.procedures``.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pydantic

from workbench.errors import UsageError, one_line
from workbench.recording import Truth
from workbench.settings import value_from_text
from workbench.stage import Resource, Stage, StageError

GROUP = "workbench.procedures"


@dataclass(frozen=True, eq=False)
class SimulatedFrame:
    """The images of one instant by channel, and all that is known about it."""

    stamp_ns: int
    images: Mapping[str, np.ndarray]
    truth: Truth


class Simulation(Protocol):
    """What the entry point ``simulate`` makes of a scene file and a seed.

    The same file, seed and code give the same frames, however many are asked for at once.  Raises
    :class:`workbench.errors.DataError` for a scene that cannot be rendered.
    """

    def __init__(self, path: Path, seed: int) -> None: ...

    def __len__(self) -> int:
        """The number of frames."""
        ...

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """Records for the recording, by name."""
        ...

    @property
    def cameras(self) -> Mapping[str, tuple[np.ndarray, int, int]]:
        """K, width and height by channel."""
        ...

    def frames(self, start: int, stop: int) -> Iterator[SimulatedFrame]:
        """Frames ``start`` to ``stop``, each as it is ready."""
        ...


def installed(name: str) -> Any:
    """The procedure of an entry point.  Raises :class:`UsageError` if there is none, or broken."""
    found = importlib.metadata.entry_points(group=GROUP, name=name)
    if not found:
        raise UsageError(f"{name}: no installed package has an entry point {name!r} in {GROUP}")
    entry = next(iter(found))
    try:
        return entry.load()
    except (Exception, SystemExit) as error:
        raise UsageError(
            f"procedure {name} ({entry.value}) cannot be loaded: {one_line(error)}"
        ) from error


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

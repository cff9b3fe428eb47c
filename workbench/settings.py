"""Parameters of a whole pipeline: presets, TOML files and ``stage.parameter=value`` flags.

They are laid over one another in that order: the stages' defaults, the preset, the ``--config``
file, and each ``--set``.  What differs from the preset is remembered, for the provenance.
"""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pydantic

from workbench.errors import UsageError
from workbench.stage import Stage, StageParameters

DEFAULT_PRESET = "default"
_CONFIG_KEYS = ("preset", "parameters", "reason", "provenance")


class SettingsError(UsageError):
    """A parameter, preset or configuration file is wrong: one line that says what was expected."""


@dataclass(frozen=True)
class Settings:
    """The parameters of every stage, and how they came to be."""

    preset: str
    parameters: Mapping[str, StageParameters]
    changed: Mapping[str, Any]
    """``stage.parameter`` to value, where it differs from the preset."""

    def as_dict(self) -> dict[str, dict[str, Any]]:
        """Every parameter's value, by stage."""
        return {name: p.model_dump() for name, p in self.parameters.items()}


def preset_names(stages: Iterable[Stage]) -> list[str]:
    """The names of all presets of these stages, ``default`` first."""
    names = {name for stage in stages for name in stage.presets}
    return [DEFAULT_PRESET, *sorted(names - {DEFAULT_PRESET})]


def resolve(
    stages: Mapping[str, Stage],
    preset: str | None = None,
    config: Path | None = None,
    assignments: Sequence[str] = (),
) -> Settings:
    """Lay preset, configuration file and assignments over the stages' defaults.

    ``assignments`` are texts ``stage.parameter=value``.  A ``config`` may name its own preset,
    which an explicit ``preset`` overrides.  Raises :class:`SettingsError`.
    """
    from_file: dict[str, Any] = {}
    if config is not None:
        from_file = _read_toml(config)
        for key in from_file:
            if key not in _CONFIG_KEYS:
                raise SettingsError(
                    f"--config {config}: unknown key {key!r}; expected {', '.join(_CONFIG_KEYS)}"
                )
    preset = preset or str(from_file.get("preset", DEFAULT_PRESET))
    if preset not in preset_names(stages.values()):
        raise SettingsError(
            f"no preset {preset!r}; presets: {', '.join(preset_names(stages.values()))}"
        )
    values = {name: dict(stage.presets.get(preset, {})) for name, stage in stages.items()}
    for address, value in _flat(from_file.get("parameters", {}), config):
        stage_name, parameter = _address(address, stages, f"{config}")
        values[stage_name][parameter] = value
    for assignment in assignments:
        address, equals, text = assignment.partition("=")
        if not equals:
            raise SettingsError(f"--set {assignment}: expected stage.parameter=value")
        stage_name, parameter = _address(address.strip(), stages, f"--set {assignment}")
        values[stage_name][parameter] = value_from_text(text.strip())
    return _settled(stages, preset, values)


def adjusted(
    stages: Mapping[str, Stage], settings: Settings, values: Mapping[str, Any]
) -> Settings:
    """``settings`` with other values at some addresses (``stage.parameter``).

    Raises :class:`SettingsError` for an unknown address or a value that its knob refuses.
    """
    laid = settings.as_dict()
    for address, value in values.items():
        stage_name, parameter = _address(address, stages, address)
        laid[stage_name][parameter] = value
    return _settled(stages, settings.preset, laid)


def _settled(
    stages: Mapping[str, Stage], preset: str, values: Mapping[str, Mapping[str, Any]]
) -> Settings:
    parameters = {name: _validate(stage, values[name]) for name, stage in stages.items()}
    changed: dict[str, Any] = {}
    for name, stage in stages.items():
        unchanged = _validate(stage, stage.presets.get(preset, {}))
        for key in type(unchanged).model_fields:
            value = getattr(parameters[name], key)
            if value != getattr(unchanged, key):
                changed[f"{name}.{key}"] = value
    return Settings(preset, parameters, changed)


def to_toml(
    settings: Settings, reason: str = "", provenance: Mapping[str, Any] | None = None
) -> str:
    """A configuration that ``--config`` reads back to the same settings: what was changed, and why.

    ``provenance`` is kept beside it for readers and ``compare``; nothing in it is None.
    """
    import tomli_w

    tables: dict[str, dict[str, Any]] = {}
    for address, value in settings.changed.items():
        stage, _, parameter = address.partition(".")
        tables.setdefault(stage, {})[parameter] = value
    document: dict[str, Any] = {"preset": settings.preset}
    if reason:
        document["reason"] = reason
    document["parameters"] = tables
    if provenance:
        document["provenance"] = _without_none(provenance)
    return tomli_w.dumps(document)


def reason_in(config: Path) -> str:
    """Why a configuration was kept, as its file says.  Raises :class:`SettingsError`."""
    return str(_read_toml(config).get("reason", ""))


def _without_none(value: Any) -> Any:
    """``value`` as TOML can hold it, which has no null."""
    if isinstance(value, Mapping):
        return {str(key): _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value if item is not None]
    return value


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return tomllib.load(file)
    except OSError as error:
        raise SettingsError(f"--config {path}: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"--config {path}: not TOML: {error}") from error


def _flat(table: Any, origin: Path | None) -> Iterable[tuple[str, Any]]:
    """``[parameters.stage]`` tables (or ``"stage.parameter"`` keys) as addresses and values."""
    if not isinstance(table, dict):
        raise SettingsError(f"--config {origin}: [parameters] should be a table")
    for key, value in table.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{inner}", v) for inner, v in value.items())
        else:
            yield key, value


def _address(address: str, stages: Mapping[str, Stage], origin: str) -> tuple[str, str]:
    stage_name, _, parameter = address.partition(".")
    if stage_name not in stages:
        raise SettingsError(f"{origin}: no stage {stage_name!r}; stages: {', '.join(stages)}")
    known = stages[stage_name].Parameters.model_fields
    if parameter not in known:
        raise SettingsError(
            f"{origin}: stage {stage_name} has no parameter {parameter!r}; "
            f"it has: {', '.join(known) or 'none'}"
        )
    return stage_name, parameter


def value_from_text(text: str) -> Any:
    """A value from the command line: TOML's literals, and bare words as text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _validate(stage: Stage, values: Mapping[str, Any]) -> StageParameters:
    try:
        return stage.Parameters(**values)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join([stage.name, *(str(part) for part in first["loc"])])
        raise SettingsError(f"{where}: {first['msg']}, got {first['input']!r}") from error

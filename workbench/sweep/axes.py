"""The grid of a sweep: axes from the command line, and the cells that they span.

An axis is a parameter with its values, ``stage.parameter=…``:

* ``3,5,7`` a list, also of texts and booleans;
* ``0.02:0.2:0.02`` from, to (included where a step ends there), step;
* ``0.01:10:x4`` from, to and how many, equal factors apart.

Axes are crossed; those zipped with one another move together.
"""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from typing import Any

from workbench.errors import UsageError, one_line
from workbench.settings import Settings, SettingsError, adjusted, value_from_text
from workbench.stage import Knob, Stage

MOST_CELLS = 100_000
"""A grid of more cells is refused: it would take days, and a sample of it says as much."""

_MOST_VALUES = 10_000
_SIGNIFICANT = 6


@dataclass(frozen=True)
class Axis:
    """One parameter and the values it takes, in the order given."""

    address: str
    values: tuple[Any, ...]
    unit: str = ""


@dataclass(frozen=True)
class Cell:
    """One point of the grid: its number in the whole grid, its place on each step, its values."""

    index: int
    place: tuple[int, ...]
    values: Mapping[str, Any]


@dataclass(frozen=True)
class Grid:
    """Axes, crossed or zipped.  ``steps`` are the groups of axes that move together."""

    steps: tuple[tuple[Axis, ...], ...]
    sampled: tuple[int, ...] | None = None
    """The numbers of the cells in the sample, ascending; None is the whole grid."""

    @property
    def axes(self) -> tuple[Axis, ...]:
        return tuple(axis for step in self.steps for axis in step)

    @property
    def shape(self) -> tuple[int, ...]:
        """How many places each group of axes has."""
        return tuple(len(step[0].values) for step in self.steps)

    @property
    def size(self) -> int:
        """Cells of the whole grid."""
        return math.prod(self.shape)

    def __len__(self) -> int:
        return self.size if self.sampled is None else len(self.sampled)

    def cell(self, index: int) -> Cell:
        """The cell with this number; the last axis given moves fastest."""
        place = []
        rest = index
        for length in reversed(self.shape):
            rest, position = divmod(rest, length)
            place.append(position)
        place.reverse()
        values = {
            axis.address: axis.values[position]
            for step, position in zip(self.steps, place, strict=True)
            for axis in step
        }
        return Cell(index, tuple(place), values)

    def cells(self) -> list[Cell]:
        """Every cell, or those of the sample, by number."""
        chosen = range(self.size) if self.sampled is None else self.sampled
        return [self.cell(index) for index in chosen]


def grid(
    texts: Sequence[str],
    zips: Sequence[str],
    sample: int | None,
    seed: int,
    stages: Mapping[str, Stage],
    run: Sequence[str],
    settings: Settings,
) -> Grid:
    """The grid that the flags ask for.

    ``texts`` are the values of ``--axis``, ``zips`` those of ``--zip``, ``run`` the names of the
    stages that are run.  Raises :class:`UsageError` with one line for whatever cannot be swept.
    """
    if not texts:
        raise UsageError("--axis: expected at least one, as --axis stage.parameter=1:5:1")
    axes: dict[str, Axis] = {}
    for text in texts:
        axis = parse_axis(text, stages, settings)
        stage = axis.address.partition(".")[0]
        if stage not in run:
            raise UsageError(f"--axis {text}: {stage} is not run; stages: {', '.join(run)}")
        if axis.address in axes:
            raise UsageError(f"--axis {text}: {axis.address} has an axis already")
        axes[axis.address] = axis
    whole = Grid(_zipped(axes, zips))
    if sample is not None:
        if sample < 1:
            raise UsageError(f"--sample {sample}: expected a number of cells")
        if sample < whole.size:
            chosen = random.Random(seed).sample(range(whole.size), sample)
            whole = Grid(whole.steps, tuple(sorted(chosen)))
    if len(whole) > MOST_CELLS:
        shape = " x ".join(str(length) for length in whole.shape)
        raise UsageError(
            f"--axis: {shape} = {len(whole):,} cells are more than {MOST_CELLS:,}; take wider "
            "steps, zip axes with --zip, or draw some of them with --sample 1000"
        )
    return whole


def parse_axis(text: str, stages: Mapping[str, Stage], settings: Settings) -> Axis:
    """One ``--axis``: its values checked against the parameter's declaration."""
    address, equals, written = (part.strip() for part in text.partition("="))
    flag = f"--axis {text}"
    if not (equals and written):
        raise UsageError(f"{flag}: expected STAGE.PARAMETER=LO:HI:STEP, =LO:HI:xN or =A,B,C")
    stage, _, parameter = address.partition(".")
    if stage not in stages:
        raise UsageError(f"{flag}: no stage {stage!r}; stages: {', '.join(stages)}")
    knobs = stages[stage].Parameters.knobs()
    if parameter not in knobs:
        has = ", ".join(knobs) or "none"
        raise UsageError(f"{flag}: stage {stage} has no parameter {parameter!r}; it has: {has}")
    knob = knobs[parameter]
    values = [_as_kind(value, knob) for value in _values(written, knob, flag)]
    if ":x" in written.replace(" ", ""):
        values = list(dict.fromkeys(values))
    for position, value in enumerate(values):
        # True equals 1, and a knob may take either: told apart by type.
        if any(value == other and type(value) is type(other) for other in values[:position]):
            raise UsageError(f"{flag}: the value {value} is there twice")
        try:
            adjusted(stages, settings, {address: value})
        except SettingsError as error:
            raise UsageError(f"{flag}: {one_line(error)}{_range_of(knob)}") from error
    return Axis(address, tuple(values), knob.unit)


def _zipped(axes: Mapping[str, Axis], zips: Sequence[str]) -> tuple[tuple[Axis, ...], ...]:
    groups: list[list[str]] = []
    for text in zips:
        names = [name.strip() for name in text.split(",") if name.strip()]
        if len(names) < 2:
            raise UsageError(f"--zip {text}: expected two or more axes separated by commas")
        for name in names:
            if name not in axes:
                raise UsageError(f"--zip {text}: no axis {name}; axes: {', '.join(axes)}")
            if any(name in group for group in groups) or names.count(name) > 1:
                raise UsageError(f"--zip {text}: {name} is zipped already")
        lengths = {len(axes[name].values) for name in names}
        if len(lengths) > 1:
            counts = ", ".join(f"{name} has {len(axes[name].values)}" for name in names)
            raise UsageError(f"--zip {text}: expected as many values in each; {counts}")
        groups.append(names)
    steps: list[tuple[Axis, ...]] = []
    placed: set[str] = set()
    for name in axes:
        if name in placed:
            continue
        together = next((group for group in groups if name in group), [name])
        placed.update(together)
        steps.append(tuple(axes[other] for other in together))
    return tuple(steps)


def _values(written: str, knob: Knob, flag: str) -> list[Any]:
    if ":" not in written:
        texts = [text.strip() for text in written.split(",")]
        if not all(texts):
            raise UsageError(f"{flag}: expected values between the commas")
        return [value_from_text(text) for text in texts]
    parts = [part.strip() for part in written.split(":")]
    if knob.kind not in ("int", "float"):
        choices = ",".join(str(c) for c in knob.choices or ("true", "false"))
        raise UsageError(f"{flag}: {knob.name} is no number; expected a list, as {choices}")
    if len(parts) != 3:
        raise UsageError(f"{flag}: expected LO:HI:STEP or LO:HI:xN, found {len(parts)} parts")
    low, high = (_number(part, flag) for part in parts[:2])
    if low > high:
        raise UsageError(f"{flag}: an empty range, for {low} is over {high}; expected LO <= HI")
    if parts[2].startswith("x"):
        return _logarithmic(low, high, parts[2], knob, flag)
    step = _number(parts[2], flag)
    if step <= 0:
        raise UsageError(f"{flag}: an empty range, for the step is {step}; expected one over 0")
    count = int((high - low) / step) + 1
    _check_count(count, flag)
    # Decimal, so that 0.02:0.2:0.02 is 0.02, 0.04, … and reaches 0.2.
    return [float(low + position * step) for position in range(count)]


def _logarithmic(low: Decimal, high: Decimal, text: str, knob: Knob, flag: str) -> list[Any]:
    if not text[1:].isdigit() or int(text[1:]) < 2:
        raise UsageError(f"{flag}: expected LO:HI:xN with a number N of 2 or more, found {text}")
    if low <= 0:
        raise UsageError(f"{flag}: equal factors need a range over 0, found {low}")
    count = int(text[1:])
    _check_count(count, flag)
    ratio = math.log(float(high) / float(low)) / (count - 1)
    values = [float(low) * math.exp(ratio * position) for position in range(count)]
    values[-1] = float(high)
    if knob.kind == "int":
        return [float(round(value)) for value in values]
    return [float(f"{value:.{_SIGNIFICANT}g}") for value in values]


def _check_count(count: int, flag: str) -> None:
    if count > _MOST_VALUES:
        raise UsageError(
            f"{flag}: {count:,} values are more than {_MOST_VALUES:,}; take a wider step"
        )


def _number(text: str, flag: str) -> Decimal:
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise UsageError(f"{flag}: expected a number, found {text!r}") from None
    if not value.is_finite():
        raise UsageError(f"{flag}: expected a finite number, found {text!r}")
    return value


def _as_kind(value: Any, knob: Knob) -> Any:
    """A number as the knob's own type, so that 5 and 5.0 are one cell."""
    if knob.kind == "int" and isinstance(value, float) and value.is_integer():
        return int(value)
    if knob.kind == "float" and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def _range_of(knob: Knob) -> str:
    if knob.kind == "choice":
        return f"; expected one of {', '.join(str(choice) for choice in knob.choices)}"
    if knob.low is None and knob.high is None:
        return ""
    low = "" if knob.low is None else f"{knob.low:g}"
    high = "" if knob.high is None else f"{knob.high:g}"
    return f"; it ranges over {low} .. {high}"

"""What a lesson is: plain declarations, as a stage's are."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from workbench.pipeline import Run
from workbench.stage import Stage

GROUP = "workbench.lessons"


@dataclass(frozen=True)
class Claim:
    """A statement that a machine can check: turn knobs from here to there, and see that.

    ``says`` is one sentence, what to do and what one sees.  ``before`` and ``after`` map knobs
    (``stage.parameter``) to values; what they leave out stays as the lesson opens.  ``measure``
    takes one number, ``quantity`` in ``unit``, out of a run, and ``holds`` says of the number
    before and the one after whether the statement is true of them.
    """

    says: str
    before: Mapping[str, Any]
    after: Mapping[str, Any]
    quantity: str
    unit: str
    measure: Callable[[Run], float]
    holds: Callable[[float, float], bool]


@dataclass(frozen=True)
class Seen:
    """A claim with what was measured."""

    claim: Claim
    before: float
    after: float

    @property
    def holds(self) -> bool:
        """Whether the claim is true of what was measured; never true of what is no number."""
        measured = math.isfinite(self.before) and math.isfinite(self.after)
        return measured and bool(self.claim.holds(self.before, self.after))

    def line(self) -> str:
        """What was measured, for people."""
        unit = f" {self.claim.unit}" if self.claim.unit else ""
        return f"{self.claim.quantity}: {number(self.before)} → {number(self.after)}{unit}"


@dataclass(frozen=True)
class Lesson:
    """A small pipeline with a text, a few knobs and claims.

    Attributes:
        number: its place in the course, from 1; unique.
        name: for file names: lower case, words joined by hyphens.
        title: one line.
        paper: which equations or sections it is about.
        text: markdown, what it shows and why; the claims are put below it.
        stages: in an order in which a stage that stands in for something recorded comes before
            those that need it.
        knobs: the few parameters that are turned, as ``stage.parameter``.
        shows: the stages whose pictures are the lesson's.
        claims: what to try and what one sees.
        settings: ``stage.parameter`` to value, where the lesson opens off the defaults.
        recording: the file that it runs on, one frame of it; None for a lesson that makes its
            own images.
        frame: which.
    """

    number: int
    name: str
    title: str
    paper: str
    text: str
    stages: Sequence[type[Stage]]
    knobs: Sequence[str]
    shows: Sequence[str]
    claims: Sequence[Claim]
    settings: Mapping[str, Any]
    recording: Path | None = None
    frame: int = 0

    @property
    def slug(self) -> str:
        """Number and name, which sort as the course goes."""
        return f"{self.number:02}-{self.name}"

    def page(self) -> str:
        """The text that stands beside the pictures: markdown."""
        lines = [f"# {self.number}. {self.title}", "", f"*Paper: {self.paper}*", ""]
        lines += [self.text.strip(), "", "## Try, and see", ""]
        lines += [f"{place}. {claim.says}" for place, claim in enumerate(self.claims, 1)]
        return "\n".join(lines) + "\n"


def number(value: float) -> str:
    """A measured number with as many digits as a person reads."""
    if not math.isfinite(value):
        return "none"
    if value == int(value) and abs(value) < 1e6:
        return f"{value:.0f}"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{min(digits, 5)}f}"

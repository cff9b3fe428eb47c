"""Two runs held against each other: parameters, digests, results, scores and times, told.

What is compared may be two configurations on one recording, or two saved replays; both end up
as two :class:`Side` and one :class:`~workbench.differences.Totals`.  No Rerun in here.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from workbench.differences import Difference, Total, Totals
from workbench.report import RunReport, finite
from workbench.stage import Score, Stage

_TOLD_FRAMES = 12
_SAYS = 160


@dataclass
class Side:
    """One of the two: what identifies it, and the numbers that it left."""

    title: str
    preset: str
    changed: Sequence[str]
    """``stage.parameter=value``, where it differs from the preset."""
    parameters: Mapping[str, Any]
    """Every parameter's value by its address, ``stage.parameter``."""
    digests: Mapping[str, str]
    """What it was made from: recording, resources, code of each stage, libraries."""
    median_ms: Mapping[str, float] = field(default_factory=dict)
    """Stage to the median of its milliseconds."""
    figures: Mapping[str, Sequence[Score]] = field(default_factory=dict)
    """What the stages' scorers sum up; only where they ran here."""

    def described(self) -> str:
        """Its title, preset and what was changed in that, on one line."""
        preset = f"preset {self.preset}"
        named = self.title in (preset, self.preset)
        changed = f", changed: {', '.join(self.changed)}" if self.changed else ""
        return (preset if named else f"{self.title}, {preset}") + changed


def side_of(title: str, provenance: Mapping[str, Any]) -> Side:
    """A side that runs here, from :meth:`workbench.session.Session.provenance`."""
    return Side(
        title,
        provenance["preset"],
        [f"{address}={value}" for address, value in provenance["changed"].items()],
        {
            f"{stage}.{name}": value
            for stage, values in provenance["parameters"].items()
            for name, value in values.items()
        },
        {
            "recording": provenance["recording"]["digest"],
            **{name: resource["digest"] for name, resource in provenance["resources"].items()},
            **{f"code of {stage}": digest for stage, digest in provenance["code"].items()},
            "bench": provenance["bench"],
            **provenance["libraries"],
        },
    )


@dataclass
class _Scored:
    """One figure over the frames on which both sides have it."""

    frames: int = 0
    sum_a: float = 0.0
    sum_b: float = 0.0


@dataclass
class Comparison:
    """A and B, and how their results differ."""

    a: Side
    b: Side
    totals: Totals
    units: Mapping[str, str] = field(default_factory=dict)
    """The unit of a parameter by its address."""
    frames: int = 0
    only_a: Sequence[int] = ()
    """Frames that only A has."""
    only_b: Sequence[int] = ()
    interrupted: bool = False
    _scored: dict[str, _Scored] = field(default_factory=dict, repr=False)

    def take(
        self,
        frame: int,
        differences: Mapping[str, Mapping[str, Difference]],
        scores_a: Mapping[str, float],
        scores_b: Mapping[str, float],
    ) -> None:
        """Take in one frame: what differs, and what each side scored (``stage/name``)."""
        self.frames += 1
        self.totals.add(frame, differences)
        for name in _either(scores_a, scores_b):
            scored = self._scored.setdefault(name, _Scored())
            a, b = scores_a.get(name, math.nan), scores_b.get(name, math.nan)
            if math.isfinite(a) and math.isfinite(b):
                scored.frames += 1
                scored.sum_a += a
                scored.sum_b += b

    def parameters(self) -> list[dict[str, Any]]:
        """The parameters that differ; a value is None where a side does not have it."""
        a, b = self.a.parameters, self.b.parameters
        return [
            {
                "address": address,
                "a": a.get(address),
                "b": b.get(address),
                "unit": self.units.get(address, ""),
            }
            for address in _either(a, b)
            if address not in a or address not in b or a[address] != b[address]
        ]

    def digests(self) -> list[dict[str, Any]]:
        """What both were made from; None where a side does not tell."""
        a, b = self.a.digests, self.b.digests
        return [
            {"what": what, "a": a.get(what), "b": b.get(what), "same": a.get(what) == b.get(what)}
            for what in _either(a, b)
        ]

    def scores(self) -> list[dict[str, Any]]:
        """The frames' own scores, in the mean over those frames that both scored."""
        rows = []
        for name in self._in_order(self._scored):
            scored = self._scored[name]
            mean_a = scored.sum_a / scored.frames if scored.frames else None
            mean_b = scored.sum_b / scored.frames if scored.frames else None
            stage, _, figure = name.partition("/")
            rows.append(
                {
                    "stage": stage,
                    "name": figure,
                    "frames": scored.frames,
                    "a": mean_a,
                    "b": mean_b,
                    "difference": _less(mean_b, mean_a),
                }
            )
        return rows

    def figures(self) -> list[dict[str, Any]]:
        """What the scorers sum up over the run, side by side; empty for saved replays."""
        rows: dict[tuple[str, str, str], dict[str, Score]] = {}
        for name, side in (("a", self.a), ("b", self.b)):
            for stage, scores in side.figures.items():
                for score in scores:
                    rows.setdefault((stage, score.name, score.unit), {})[name] = score
        found = []
        for (stage, name, unit), own in rows.items():
            a, b = _value(own.get("a")), _value(own.get("b"))
            found.append(
                {
                    "stage": stage,
                    "name": name,
                    "unit": unit,
                    "a": a,
                    "b": b,
                    "difference": _less(b, a),
                    "coverage_a": own["a"].coverage if "a" in own else None,
                    "coverage_b": own["b"].coverage if "b" in own else None,
                }
            )
        return found

    def times(self) -> list[dict[str, Any]]:
        """The median milliseconds of each stage."""
        return [
            {
                "stage": stage,
                "a_ms": self.a.median_ms.get(stage),
                "b_ms": self.b.median_ms.get(stage),
            }
            for stage in self._in_order(_either(self.a.median_ms, self.b.median_ms))
        ]

    def _in_order(self, names: Iterable[str]) -> list[str]:
        """Names that begin with a stage's, in the order of the stages and then of the names."""
        order = {stage: place for place, stage in enumerate(self.totals.of)}

        def place(name: str) -> tuple[int, str]:
            return order.get(name.partition("/")[0], len(order)), name

        return sorted(names, key=place)

    def remarks(self) -> list[str]:
        """What a reader should know before believing the rest."""
        says = []
        a, b = self.a.digests, self.b.digests
        if a.get("recording") != b.get("recording"):
            says.append(
                "the recordings are not the same: frames are held against each other by number"
            )
        if self.only_a or self.only_b:
            says.append(
                f"frames only in A: {_frames(self.only_a)}; only in B: {_frames(self.only_b)}"
            )
        if self.interrupted:
            says.append(f"interrupted after {self.frames} frames")
        return says

    def as_dict(self) -> dict[str, Any]:
        """All of it as JSON values."""
        differing = self.totals.differing()
        every = [total for own in self.totals.of.values() for total in own.values()]
        return {
            "a": _identity(self.a),
            "b": _identity(self.b),
            "frames": self.frames,
            "frames_only_a": list(self.only_a),
            "frames_only_b": list(self.only_b),
            "interrupted": self.interrupted,
            "remarks": self.remarks(),
            "same": not (differing or self.parameters()),
            "parameters": self.parameters(),
            "digests": self.digests(),
            "stages_that_differ": self.totals.stages,
            "results": [total.as_dict() for total in differing],
            "same_results": [f"{t.stage}.{t.artifact}" for t in every if not t.differing_frames],
            "scores": [finite(row) for row in self.scores()],
            "figures": [finite(row) for row in self.figures()],
            "times": self.times(),
        }

    def page(self, legend: str) -> str:
        """What differs, as markdown for the viewer."""
        differing = self.totals.stages
        same = [stage for stage in self.totals.of if stage not in differing]
        return "\n".join(
            [
                f"**A** {self.a.described()}  ",
                f"**B** {self.b.described()}  ",
                f"{self.frames} frames. Stages that differ: {', '.join(differing) or 'none'}; "
                f"that do not: {', '.join(same) or 'none'}.",
                *(f"\n**Note**: {says}." for says in self.remarks()),
                "",
                "## Parameters that differ",
                *_markdown(
                    ("parameter", "A", "B", "unit"),
                    (
                        [row["address"], told(row["a"]), told(row["b"]), row["unit"]]
                        for row in self.parameters()
                    ),
                ),
                "## Results that differ",
                *_markdown(RESULT_COLUMNS, map(result_row, self.totals.differing())),
                *([f"Pictures: {legend}."] if differing else []),
            ]
        )

    def numbers_page(self) -> str:
        """Scores, times and what both were made from, as markdown for the viewer."""
        digests = (
            [row["what"], told(row["a"]), "the same" if row["same"] else told(row["b"])]
            for row in self.digests()
        )
        return "\n".join(
            [
                "## Against ground truth",
                *_markdown(("stage", "figure", "A", "B", "B − A", "unit"), self.score_rows()),
                "## Stage times, median",
                *_markdown(("stage", "A ms", "B ms"), self.time_rows()),
                "## Made from",
                *_markdown(("what", "A", "B"), digests),
            ]
        )

    def score_rows(self) -> list[list[str]]:
        """Stage, figure, A, B, B minus A, unit: the summed-up figures, or the frames' means."""
        rows = self.figures() or self.scores()
        return [
            [
                row["stage"],
                row["name"],
                number(row["a"]) + _covered(row.get("coverage_a")),
                number(row["b"]) + _covered(row.get("coverage_b")),
                _change(row["difference"]),
                row.get("unit", "mean of frames"),
            ]
            for row in rows
        ]

    def time_rows(self) -> list[list[str]]:
        """Stage, A ms, B ms."""
        return [
            [row["stage"], number(row["a_ms"], 2), number(row["b_ms"], 2)] for row in self.times()
        ]


RESULT_COLUMNS = ("stage", "artifact", "frames", "differs", "largest", "where")


def result_row(total: Total) -> list[str]:
    """One artifact that differs, in the columns of :data:`RESULT_COLUMNS`."""
    share = "" if total.share is None else f"{100 * total.share:.3g} %"
    largest = "" if total.largest is None else f"{total.largest:.4g} {total.unit}".strip()
    where = []
    frame = total.largest_frame if total.largest is not None else total.worst_frame
    if total.at is not None and frame is not None:
        where.append(f"frame {frame} at ({', '.join(map(str, total.at))})")
    if total.box is not None:
        x0, y0, x1, y1 = total.box
        where.append(f"within x {x0}…{x1}, y {y0}…{y1}")
    if total.only_a or total.only_b:
        where.append(f"only A {total.only_a} px, only B {total.only_b} px")
    if total.says:
        says = total.says if len(total.says) <= _SAYS else total.says[: _SAYS - 1] + "…"
        where.append(says)
    return [
        total.stage,
        total.artifact,
        f"{total.differing_frames} of {total.frames}",
        share,
        largest,
        "; ".join(where),
    ]


def units_of(stages: Iterable[Stage]) -> dict[str, str]:
    """The unit of every parameter, by its address."""
    return {
        f"{stage.name}.{name}": knob.unit
        for stage in stages
        for name, knob in stage.Parameters.knobs().items()
    }


def take_report(side: Side, report: RunReport) -> None:
    """Keep what a finished run sums up: the stages' times and their scorers' figures."""
    side.median_ms = {stage: report.median_ms(stage) for stage in report.times_ms}
    side.figures = report.scores()


def number(value: float | None, digits: int = 3) -> str:
    """A number for a table; what is none is a dash."""
    return "–" if value is None else f"{value:.{digits}f}"


def _either(a: Iterable[str], b: Iterable[str]) -> list[str]:
    """The keys of both, in A's order and then B's own."""
    return list(dict.fromkeys([*a, *b]))


def _less(b: float | None, a: float | None) -> float | None:
    return None if a is None or b is None else b - a


def _value(score: Score | None) -> float | None:
    return score.value if score is not None and math.isfinite(score.value) else None


def _identity(side: Side) -> dict[str, Any]:
    return {
        "title": side.title,
        "preset": side.preset,
        "changed": list(side.changed),
        "parameters": dict(side.parameters),
        "digests": dict(side.digests),
    }


def told(value: Any) -> str:
    """A value for a table; one that is not there is a dash."""
    return "–" if value is None else str(value)


def _change(difference: float | None) -> str:
    """A difference for a table; what is exactly the same stands out as a bare 0."""
    return "" if difference is None else f"{difference:+.3f}" if difference else "0"


def _covered(coverage: float | None) -> str:
    return "" if coverage is None else f" at {100 * coverage:.1f} %"


def _frames(frames: Sequence[int]) -> str:
    told = ", ".join(map(str, frames[:_TOLD_FRAMES]))
    more = len(frames) - _TOLD_FRAMES
    return (told or "none") + (f" and {more} more" if more > 0 else "")


def _markdown(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    body = ["| " + " | ".join(str(cell).replace("|", "¦") for cell in row) + " |" for row in rows]
    if not body:
        return ["", "none", ""]
    return ["", "| " + " | ".join(columns) + " |", "|" + "---|" * len(columns), *body, ""]

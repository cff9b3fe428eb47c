"""What a run leaves for people and machines: counts, times, failures, scores."""

from __future__ import annotations

import json
import math
import statistics
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from workbench.errors import one_line
from workbench.files import replacing
from workbench.pipeline import Run
from workbench.session import Session
from workbench.stage import Score, Scorer

_KEPT_TIMES = 4096
_KEPT_MESSAGES = 20
_MORE = "and other messages of this kind"


@dataclass
class RunReport:
    """Accumulates over a run, in memory that does not grow with it."""

    session: Session
    frames: int = 0
    times_ms: dict[str, list[float]] = field(default_factory=dict)
    worst_ms: dict[str, float] = field(default_factory=dict)
    failures: Counter[tuple[str, str]] = field(default_factory=Counter)
    warnings: Counter[str] = field(default_factory=Counter)
    interrupted: int = 0
    """The exit code of Ctrl-C or SIGTERM if the run was ended by one, else 0."""
    scorers: dict[str, Scorer] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for stage in self.session.pipeline.stages:
            scorer = stage.scorer()
            if scorer is not None:
                self.scorers[stage.name] = scorer

    def add(self, run: Run) -> dict[str, float]:
        """Take one run in; returns its own scores, ``stage/name`` to value."""
        self.frames += 1
        for stage, ms in run.stage_ms.items():
            times = self.times_ms.setdefault(stage, [])
            if len(times) < _KEPT_TIMES:
                times.append(ms)
            else:
                times[self.frames % _KEPT_TIMES] = ms
            self.worst_ms[stage] = max(self.worst_ms.get(stage, 0.0), ms)
        for one in run.failures:
            self._count(self.failures, (one.stage, one.says))
        for says in run.warnings:
            self._count(self.warnings, says)
        scores: dict[str, float] = {}
        if run.frame.truth is not None:
            for name, scorer in self.scorers.items():
                failure = run.failure_of(name)
                if failure is not None and not failure.gave:
                    continue
                try:
                    own = scorer.add(run.frame.truth, run.artifacts)
                except Exception as error:
                    # What a failed stage did not give cannot be scored: that is told already.
                    if failure is None:
                        self.fail(name, f"scoring: {one_line(error)}")
                    continue
                scores.update({f"{name}/{key}": value for key, value in own.items()})
        return scores

    def fail(self, stage: str, says: str) -> None:
        """Count a failure of a stage outside its computation."""
        self._count(self.failures, (stage, says))

    def take_failures(self, other: RunReport, of: str) -> None:
        """Add what failed and what was warned of in another run of the same frames."""
        for (stage, says), count in other.failures.items():
            if (stage, says) not in self.failures:
                self.failures[(stage, f"{of}: {says}")] += count
        for says, count in other.warnings.items():
            if says not in self.warnings:
                self.warnings[f"{of}: {says}"] += count

    @staticmethod
    def _count(counter: Counter[Any], key: Any) -> None:
        """Count a message; beyond a bounded number of different ones, only that there are more."""
        if key not in counter and len(counter) >= _KEPT_MESSAGES:
            key = (key[0], _MORE) if isinstance(key, tuple) else _MORE
        counter[key] += 1

    def scores(self) -> dict[str, list[Score]]:
        """The figures of every stage that can be scored and had truth to be scored against."""
        found = {}
        for name, scorer in self.scorers.items():
            try:
                found[name] = scorer.summary()
            except Exception as error:
                self.failures[(name, f"scoring: {one_line(error)}")] = 1
        return {name: scores for name, scores in found.items() if scores}

    def median_ms(self, stage: str) -> float:
        return statistics.median(self.times_ms[stage])

    @property
    def failed(self) -> bool:
        """Whether no frame came through, or a stage failed on any of them."""
        return self.frames == 0 or bool(self.failures)

    def as_dict(self) -> dict[str, Any]:
        """All of it as JSON values; what is not a number is None."""
        # First, for a scorer that fails to sum up is one of the failures.
        scores = self.scores()
        return {
            "recording": self.session.recording.path.name,
            "frames": self.frames,
            "interrupted": bool(self.interrupted),
            "defects": self.session.recording.defects.as_dict(),
            "stages": {
                name: {"median_ms": self.median_ms(name), "worst_ms": self.worst_ms[name]}
                for name in self.times_ms
            },
            "failures": [
                {"stage": stage, "says": says, "frames": count}
                for (stage, says), count in self.failures.items()
            ],
            "warnings": [{"says": says, "frames": count} for says, count in self.warnings.items()],
            "scores": {
                stage: [finite(asdict(score)) for score in own] for stage, own in scores.items()
            },
            "provenance": self.session.provenance(),
        }


def finite(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same with floats that JSON cannot hold as None."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in values.items()
    }


def write_beside(path: Path, text: str) -> None:
    """Write a text file beside ``path`` and rename it into place."""
    with replacing(path) as beside:
        beside.write_text(text, encoding="utf-8")


def to_json(value: Any) -> str:
    """JSON with sorted keys, one item a line."""
    return json.dumps(value, indent=2, sort_keys=True, allow_nan=False)

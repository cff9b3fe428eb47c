"""A run's report counts, times and scores what came through, in bounded memory."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from workbench.report import RunReport, finite, to_json, write_beside
from workbench.stage import Score, Scorer


class Ruler(Scorer):
    """Takes the number that the artifact ``value`` is, and fails where there is none."""

    def __init__(self, summary_fails: bool = False) -> None:
        self.taken: list[float] = []
        self.summary_fails = summary_fails

    def add(self, truth: Any, artifacts: Any) -> dict[str, float]:
        self.taken.append(artifacts["value"] - truth)
        return {"error": self.taken[-1]}

    def summary(self) -> list[Score]:
        if self.summary_fails:
            raise ValueError("no\nsummary")
        return [Score("worst", max(self.taken), "mm", math.nan)] if self.taken else []


def report_of(*scorers: Scorer | None) -> RunReport:
    stages = [
        SimpleNamespace(name=f"stage{k}", scorer=lambda s=scorer: s)
        for k, scorer in enumerate(scorers)
    ]
    session: Any = SimpleNamespace(
        pipeline=SimpleNamespace(stages=stages),
        recording=SimpleNamespace(
            path=Path("/x/scene.mcap"), defects=SimpleNamespace(as_dict=lambda: {"gaps": 2})
        ),
        provenance=lambda: {"bench": "1"},
    )
    return RunReport(session)


def run_of(truth: Any = 1.0, failures: Any = (), warnings: Any = (), **other: Any) -> Any:
    failed = {one.stage: one for one in failures}
    return SimpleNamespace(
        stage_ms=other.pop("stage_ms", {}),
        failures=failures,
        warnings=warnings,
        frame=SimpleNamespace(truth=truth),
        failure_of=failed.get,
        artifacts=other,
    )


def failure(stage: str, says: str, gave: bool = False) -> Any:
    return SimpleNamespace(stage=stage, says=says, gave=gave)


def test_only_stages_that_can_be_scored_have_a_scorer() -> None:
    ruler = Ruler()
    assert report_of(None, ruler).scorers == {"stage1": ruler}


def test_a_frame_is_scored_against_its_truth_under_its_stages_name() -> None:
    report = report_of(Ruler(), Ruler())
    assert report.add(run_of(truth=1.0, value=4.0)) == {"stage0/error": 3, "stage1/error": 3}
    assert report.add(run_of(truth=None, value=9.0)) == {}
    assert report.add(run_of(truth=2.0, value=1.0)) == {"stage0/error": -1, "stage1/error": -1}
    assert report.frames == 3 and not report.failed
    assert {name: scores[0].value for name, scores in report.scores().items()} == {
        "stage0": 3,
        "stage1": 3,
    }


def test_what_a_failed_stage_did_not_give_is_not_scored_and_hides_nothing() -> None:
    report = report_of(Ruler(), Ruler())
    own = report.add(run_of(failures=[failure("stage0", "broke")], value=4.0))
    assert own == {"stage1/error": 3}
    # A stage that gave something before it failed is scored by that, if it can be.
    own = report.add(run_of(failures=[failure("stage0", "broke", gave=True)], value=4.0))
    assert own == {"stage0/error": 3, "stage1/error": 3}
    assert report.add(run_of(failures=[failure("stage0", "broke", gave=True)])) == {}
    assert report.failures == {("stage0", "broke"): 3, ("stage1", "scoring: KeyError: 'value'"): 1}
    assert report.failed


def test_a_scorer_that_fails_is_told_and_hides_no_other() -> None:
    report = report_of(Ruler(summary_fails=True), Ruler(), Ruler())
    report.scorers["stage1"].taken = []  # type: ignore[attr-defined]
    assert report.scores() == {} and report.failed
    report = report_of(Ruler(summary_fails=True), Ruler())
    report.add(run_of(value=2.0))
    assert not report.failed
    assert list(report.scores()) == ["stage1"]
    assert report.failures == {("stage0", "scoring: ValueError: no summary"): 1}
    # However often it is asked, it is one failure, and the machine's report has it.
    fresh = report_of(Ruler(summary_fails=True))
    fresh.add(run_of(value=2.0))
    for _ in range(2):
        assert fresh.as_dict()["failures"] == [
            {"stage": "stage0", "says": "scoring: ValueError: no summary", "frames": 1}
        ]


def test_times_have_a_median_and_a_worst() -> None:
    report = report_of()
    for ms in (5.0, 1.0, 9.0, 2.0):
        report.add(run_of(stage_ms={"a": ms, "b": 2 * ms}))
    assert (report.median_ms("a"), report.worst_ms["a"]) == (3.5, 9)
    assert (report.median_ms("b"), report.worst_ms["b"]) == (7, 18)
    report.add(run_of(stage_ms={"c": 0.25}))
    assert report.worst_ms["c"] == 0.25


def test_times_of_a_long_run_are_some_4096_of_the_latest() -> None:
    report = report_of()
    for frame in range(2 * 4096):
        report.add(run_of(stage_ms={"a": 1.0 if frame < 3000 else 2.0}))
    assert len(report.times_ms["a"]) == 4096
    assert set(report.times_ms["a"]) == {2.0}
    report.add(run_of(stage_ms={"a": 7.0}))
    assert report.times_ms["a"].count(7.0) == 1 and report.worst_ms["a"] == 7


def test_messages_are_counted_and_beyond_twenty_only_that_there_are_more() -> None:
    report = report_of()
    for k in range(25):
        report.add(run_of(failures=[failure("s", f"broke {k}")], warnings=[f"odd {k}"]))
    report.add(run_of(failures=[failure("s", "broke 3")], warnings=["odd 19"]))
    assert len(report.failures) == len(report.warnings) == 21
    more = "and other messages of this kind"
    assert report.failures[("s", more)] == report.warnings[more] == 5
    assert report.failures[("s", "broke 3")] == report.warnings["odd 19"] == 2
    assert report.failures[("s", "broke 19")] == 1
    # The rest is told by the stage that it is of.
    report.fail("t", "broke too")
    assert report.failures[("t", more)] == 1


def test_a_run_failed_if_no_frame_came_through_or_a_stage_failed() -> None:
    report = report_of()
    assert report.failed
    report.add(run_of(warnings=["odd"]))
    assert not report.failed
    report.fail("stage", "could not be drawn")
    assert report.failed and report.failures == {("stage", "could not be drawn"): 1}


def test_failures_of_another_run_of_the_same_frames_are_told_as_that_ones() -> None:
    report, other = report_of(), report_of()
    report.add(run_of(failures=[failure("s", "both")], warnings=["seen"]))
    for _ in range(2):
        other.add(run_of(failures=[failure("s", "both"), failure("s", "new")], warnings=["seen"]))
    other.add(run_of(warnings=["strange"]))
    report.take_failures(other, "preset paper")
    assert report.failures == {("s", "both"): 1, ("s", "preset paper: new"): 2}
    assert report.warnings == {"seen": 1, "preset paper: strange": 1}


def test_a_report_for_machines_holds_all_of_it() -> None:
    report = report_of(Ruler())
    report.add(
        run_of(
            truth=1.0, value=3.0, stage_ms={"stage0": 4.0},
            failures=[failure("late", "broke")], warnings=["odd"],
        )
    )  # fmt: skip
    report.add(run_of(truth=None, stage_ms={"stage0": 6.0}, warnings=["odd"]))
    report.interrupted = 130
    found = json.loads(to_json(report.as_dict()))
    assert found == {
        "recording": "scene.mcap",
        "frames": 2,
        "interrupted": True,
        "defects": {"gaps": 2},
        "stages": {"stage0": {"median_ms": 5.0, "worst_ms": 6.0}},
        "failures": [{"stage": "late", "says": "broke", "frames": 1}],
        "warnings": [{"says": "odd", "frames": 2}],
        "scores": {
            "stage0": [
                {
                    "name": "worst", "value": 2.0, "unit": "mm", "coverage": None, "note": "",
                    "better": None, "published": "",
                }
            ]
        },
        "provenance": {"bench": "1"},
    }  # fmt: skip
    assert report_of().as_dict()["interrupted"] is False


def test_what_json_cannot_hold_is_none() -> None:
    values = {"a": math.nan, "b": math.inf, "c": -math.inf, "d": 1.5, "e": 2, "f": "nan", "g": None}
    assert finite(values) == values | {"a": None, "b": None, "c": None}
    assert to_json({"b": 1, "a": [2]}) == '{\n  "a": [\n    2\n  ],\n  "b": 1\n}'
    with pytest.raises(ValueError, match="JSON compliant"):
        to_json({"a": math.nan})


def test_a_text_is_written_whole_and_replaces_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    for text in ("äß → 1", "2"):
        write_beside(path, text)
        assert path.read_text(encoding="utf-8") == text
    assert [entry.name for entry in tmp_path.iterdir()] == ["report.json"]

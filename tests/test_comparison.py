"""A comparison tells B minus A: of scores, of figures; and what both were made from, in order."""

from __future__ import annotations

import json
import math
from types import SimpleNamespace
from typing import Any

import pytest

from workbench.comparison import (
    RESULT_COLUMNS,
    Comparison,
    Side,
    number,
    result_row,
    side_of,
    take_report,
    told,
    units_of,
)
from workbench.differences import Difference, Total, Totals
from workbench.stage import Artifact, Score, StageParameters, knob

MAP = Artifact("map", "float32", "H W", "mm")
MASK = Artifact("mask", "bool", "H W")
NAN = math.nan


def side(title: str = "A", **other: Any) -> Side:
    return Side(title, "default", [], {}, {"recording": "1"}, **other)


def compared(a: Side | None = None, b: Side | None = None, **other: Any) -> Comparison:
    totals = Totals({"sensor": [MAP], "edges": [MASK]})
    return Comparison(a or side("A"), b or side("B"), totals, **other)


# -- scores and figures ---------------------------------------------------------------------------


def test_scores_are_means_over_the_frames_that_both_scored() -> None:
    made = compared()
    for frame, (a, b) in enumerate(
        [
            ({"edges/recall": 0.5, "sensor/rms": 2.0}, {"edges/recall": 0.8, "sensor/rms": 1.0}),
            ({"edges/recall": 0.7, "sensor/rms": NAN}, {"edges/recall": 0.6, "sensor/rms": 9.0}),
            ({"edges/recall": 0.9}, {"sensor/rms": 9.0}),
            ({"sensor/rms": 4.0}, {"sensor/rms": 1.5}),
            ({"sensor/rms": 1.0}, {"sensor/rms": math.inf}),
        ]
    ):
        made.take(frame, {}, a, b)
    assert made.frames == 5
    # In the stages' order, whichever came first.
    assert made.scores() == [
        {
            "stage": "sensor", "name": "rms", "frames": 2,
            "a": 3.0, "b": 1.25, "difference": -1.75,
        },
        {
            "stage": "edges", "name": "recall", "frames": 2,
            "a": pytest.approx(0.6), "b": pytest.approx(0.7), "difference": pytest.approx(0.1),
        },
    ]  # fmt: skip


def test_a_score_that_only_one_has_has_no_difference() -> None:
    made = compared()
    made.take(0, {}, {"edges/recall": 1.0}, {"sensor/rms/of all": 2.0})
    assert made.scores() == [
        {"stage": "sensor", "name": "rms/of all", "frames": 0, "a": None, "b": None,
         "difference": None},
        {"stage": "edges", "name": "recall", "frames": 0, "a": None, "b": None,
         "difference": None},
    ]  # fmt: skip


def test_figures_stand_side_by_side_with_b_minus_a_and_what_each_covers() -> None:
    a = {"sensor": [Score("rms", 0.5, "mm", 0.9), Score("rms", 5.0, "%"), Score("bad", NAN, "mm")]}
    b = {
        "sensor": [Score("rms", 0.2, "mm", 0.8), Score("bad", 1.0, "mm")],
        "edges": [Score("recall", 0.75)],
    }
    made = compared(side("A", figures=a), side("B", figures=b))
    found = [tuple(row.values()) for row in made.figures()]
    assert found == [
        ("sensor", "rms", "mm", 0.5, 0.2, pytest.approx(-0.3), 0.9, 0.8),
        ("sensor", "rms", "%", 5.0, None, None, None, None),
        ("sensor", "bad", "mm", None, 1.0, None, None, None),
        ("edges", "recall", "", None, 0.75, None, None, None),
    ]
    assert list(made.figures()[0]) == [
        "stage", "name", "unit", "a", "b", "difference", "coverage_a", "coverage_b",
    ]  # fmt: skip
    assert made.score_rows() == [
        ["sensor", "rms", "0.500 at 90.0 %", "0.200 at 80.0 %", "-0.300", "mm"],
        ["sensor", "rms", "5.000", "–", "", "%"],
        ["sensor", "bad", "–", "1.000", "", "mm"],
        ["edges", "recall", "–", "0.750", "", ""],
    ]


def test_without_figures_the_frames_means_are_told_with_their_sign() -> None:
    made = compared()
    made.take(
        0,
        {},
        {"sensor/rms": 2.0, "edges/recall": 0.5, "edges/same": 0.25},
        {"sensor/rms": 1.0, "edges/recall": 0.75, "edges/same": 0.25},
    )
    assert made.score_rows() == [
        ["sensor", "rms", "2.000", "1.000", "-1.000", "mean of frames"],
        ["edges", "recall", "0.500", "0.750", "+0.250", "mean of frames"],
        ["edges", "same", "0.250", "0.250", "0", "mean of frames"],
    ]


def test_a_page_of_numbers_has_b_minus_a_beside_both() -> None:
    a = side("A", figures={"sensor": [Score("rms", 0.5, "mm")]}, median_ms={"edges": 3.0})
    b = side("B", figures={"sensor": [Score("rms", 0.75, "mm")]}, median_ms={"sensor": 1.234})
    b.digests = {"recording": "1", "bench": "x|y"}
    lines = compared(a, b).numbers_page().splitlines()
    assert "| stage | figure | A | B | B − A | unit |" in lines
    assert "| sensor | rms | 0.500 | 0.750 | +0.250 | mm |" in lines
    assert lines[lines.index("| stage | A ms | B ms |") + 2 :][:2] == [
        "| sensor | – | 1.23 |",
        "| edges | 3.00 | – |",
    ]
    assert "| recording | 1 | the same |" in lines
    assert "| bench | – | x¦y |" in lines


class Viewer:
    """Keeps the numbers that are plotted, by path, frame and stamp."""

    def __init__(self) -> None:
        self.plotted: dict[str, list[tuple[int, float]]] = {}
        self.frame = -1

    def set_time(self, timeline: str, **at: Any) -> None:
        self.frame = at.get("sequence", self.frame)

    def log(self, path: str, entity: Any, static: bool = False) -> None:
        if type(entity).__name__ == "Scalars":
            (value,) = entity.scalars.as_arrow_array().to_pylist()
            self.plotted.setdefault(path, []).append((self.frame, value))

    def send_blueprint(self, blueprint: Any) -> None:
        pass


def test_scores_are_plotted_as_b_minus_a_and_what_differs_in_percent() -> None:
    from workbench.comparison_view import ComparisonView

    made, viewer = compared(), Viewer()
    view = ComparisonView(viewer, made)  # type: ignore[arg-type]
    for frame, a, b, differing in (
        (5, {"edges/recall": 0.5, "sensor/rms": 1.0}, {"edges/recall": 0.75, "sensor/rms": 1.0}, 1),
        (6, {"edges/recall": 0.5, "sensor/rms": NAN}, {"edges/recall": 0.25, "sensor/rms": 1.0}, 0),
        (7, {"edges/recall": 0.5, "sensor/rms": 2.0}, {"edges/recall": 0.5, "sensor/rms": 1.5}, 3),
        (8, {"sensor/rms": 2.0}, {"edges/recall": 0.5}, 0),
    ):
        differences = {"edges": {"mask": Difference("mask", differing, 4)}}
        made.take(frame, differences, a, b)
        view.log(frame, 0, differences, {}, a, b)
    assert viewer.plotted == {
        "comparison/differing/edges/mask": [(5, 25), (6, 0), (7, 75), (8, 0)],
        # What has once differed is plotted where it is the same, too.
        "comparison/scores/edges/recall": [(5, 0.25), (6, -0.25), (7, 0)],
        "comparison/scores/sensor/rms": [(7, -0.5)],
    }


# -- parameters and what both were made from ------------------------------------------------------


def test_parameters_differ_where_either_lacks_or_changes_one() -> None:
    a, b = side(), side()
    a.parameters = {"edges.reach": 15, "edges.same": 1, "old.knob": None}
    b.parameters = {"edges.reach": 6, "edges.same": 1, "new.knob": 2}
    made = compared(a, b, units={"edges.reach": "px"})
    assert made.parameters() == [
        {"address": "edges.reach", "a": 15, "b": 6, "unit": "px"},
        {"address": "old.knob", "a": None, "b": None, "unit": ""},
        {"address": "new.knob", "a": None, "b": 2, "unit": ""},
    ]


def test_digests_say_what_is_the_same() -> None:
    a, b = side(), side()
    a.digests, b.digests = (
        {"recording": "1", "code": "x"},
        {"recording": "1", "code": "y", "c": "z"},
    )
    assert [tuple(row.values()) for row in compared(a, b).digests()] == [
        ("recording", "1", "1", True),
        ("code", "x", "y", False),
        ("c", None, "z", False),
    ]


def test_a_side_tells_all_that_it_was_made_from() -> None:
    made = side_of(
        "tuned.toml",
        {
            "preset": "paper",
            "changed": {"edges.reach": 6},
            "parameters": {"edges": {"reach": 6, "gap": 2}, "sensor": {"gain": True}},
            "recording": {"digest": "r"},
            "resources": {"calibration": {"digest": "c"}, "models": {"digest": "m"}},
            "code": {"edges": "e", "sensor": "s"},
            "bench": "0.1.0",
            "libraries": {"numpy": "2"},
        },
    )
    assert made.changed == ["edges.reach=6"]
    assert made.parameters == {"edges.reach": 6, "edges.gap": 2, "sensor.gain": True}
    assert made.digests == {
        "recording": "r", "calibration": "c", "models": "m",
        "code of edges": "e", "code of sensor": "s", "bench": "0.1.0", "numpy": "2",
    }  # fmt: skip
    assert made.described() == "tuned.toml, preset paper, changed: edges.reach=6"


@pytest.mark.parametrize(
    ("title", "changed", "described"),
    [
        ("preset default", [], "preset default"),
        ("default", ["a.b=1", "a.c=2"], "preset default, changed: a.b=1, a.c=2"),
        ("other", [], "other, preset default"),
    ],
)
def test_a_side_is_described_without_saying_its_preset_twice(
    title: str, changed: list[str], described: str
) -> None:
    assert Side(title, "default", changed, {}, {}).described() == described


def test_times_are_medians_in_the_stages_order() -> None:
    report: Any = SimpleNamespace(
        times_ms={"edges": [1, 2], "sensor": [3]},
        median_ms=lambda stage: {"edges": 1.5, "sensor": 3.0}[stage],
        scores=lambda: {"edges": [Score("recall", 1.0)]},
    )
    a, b = side("A"), side("B", median_ms={"extra": 9.0, "edges": 2.0})
    take_report(a, report)
    assert a.median_ms == {"edges": 1.5, "sensor": 3.0}
    assert a.figures == {"edges": [Score("recall", 1.0)]}
    assert compared(a, b).times() == [
        {"stage": "sensor", "a_ms": 3.0, "b_ms": None},
        {"stage": "edges", "a_ms": 1.5, "b_ms": 2.0},
        {"stage": "extra", "a_ms": None, "b_ms": 9.0},
    ]
    assert compared(a, b).time_rows()[:2] == [["sensor", "3.00", "–"], ["edges", "1.50", "2.00"]]


def test_units_of_parameters_are_known_by_address() -> None:
    class Parameters(StageParameters):
        reach: float = knob(1.0, "How far.", low=0, high=2, unit="px")
        on: bool = knob(True, "Whether.")

    stages: Any = [SimpleNamespace(name="edges", Parameters=Parameters)]
    assert units_of(stages) == {"edges.reach": "px", "edges.on": ""}


# -- what a reader should know --------------------------------------------------------------------


def test_remarks_say_what_does_not_match() -> None:
    assert compared().remarks() == []
    b = side("B")
    b.digests = {"recording": "2"}
    made = compared(side("A"), b, only_a=[1, 2], interrupted=True)
    made.frames = 7
    assert made.remarks() == [
        "the recordings are not the same: frames are held against each other by number",
        "frames only in A: 1, 2; only in B: none",
        "interrupted after 7 frames",
    ]
    assert compared(only_b=[5]).remarks() == ["frames only in A: none; only in B: 5"]


@pytest.mark.parametrize(("count", "more"), [(12, ""), (13, " and 1 more"), (500, " and 488 more")])
def test_of_many_frames_twelve_are_named(count: int, more: str) -> None:
    (says,) = compared(only_b=range(count)).remarks()
    assert says == (
        "frames only in A: none; only in B: 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11" + more
    )


# -- results that differ --------------------------------------------------------------------------


def different(**other: Any) -> Total:
    return Total("sensor", "map", "map", "mm", frames=4, differing_frames=2, **other)


@pytest.mark.parametrize(
    ("total", "cells"),
    [
        (
            different(share_sum=0.5, shared_frames=4, worst_frame=2, largest=1.23456,
                      largest_frame=3, at=(7, 5), box=(1, 2, 30, 40), only_a=8, only_b=9),
            ("12.5 %", "1.235 mm",
             "frame 3 at (7, 5); within x 1…30, y 2…40; only A 8 px, only B 9 px"),
        ),
        (different(worst_frame=2, at=(7, 5)), ("", "", "frame 2 at (7, 5)")),
        (different(only_b=3), ("", "", "only A 0 px, only B 3 px")),
        (different(only_a=3), ("", "", "only A 3 px, only B 0 px")),
        (different(at=(1, 2)), ("", "", "")),
        (different(says="x" * 160), ("", "", "x" * 160)),
        (different(says="x" * 161), ("", "", "x" * 159 + "…")),
    ],
)  # fmt: skip
def test_a_row_tells_how_much_differs_and_where(total: Total, cells: tuple[str, str, str]) -> None:
    row = result_row(total)
    assert row == ["sensor", "map", "2 of 4", *cells]
    assert len(row) == len(RESULT_COLUMNS)


def test_a_number_without_a_unit_stands_alone() -> None:
    total = different(largest=2.0, largest_frame=1)
    total.unit = ""
    assert result_row(total)[4] == "2"
    assert number(None) == "–" and number(1.23456) == "1.235" and number(1.2, 1) == "1.2"
    assert told(None) == "–" and told(0) == "0"


def test_a_page_tells_what_differs_and_what_does_not() -> None:
    a, b = side("A"), side("B")
    a.parameters, b.parameters = {"edges.reach": 1}, {"edges.reach": 2}
    made = compared(a, b, units={"edges.reach": "px"}, interrupted=True)
    made.take(
        0,
        {
            "sensor": {"map": Difference("map", 0, 4)},
            "edges": {"mask": Difference("mask", 1, 4, at=(2, 3), only_b=1)},
        },
        {},
        {},
    )
    lines = made.page("cyan is A").splitlines()
    assert lines[0] == "**A** A, preset default  " and lines[1] == "**B** B, preset default  "
    assert "1 frames. Stages that differ: edges; that do not: sensor." in lines
    assert "**Note**: interrupted after 1 frames." in lines
    assert "| edges.reach | 1 | 2 | px |" in lines
    assert "| edges | mask | 1 of 1 | 25 % |  | frame 0 at (2, 3); only A 0 px, only B 1 px |" in (
        lines
    )
    assert "Pictures: cyan is A." in lines
    same = compared().page("cyan is A")
    assert (
        "Pictures" not in same and "Stages that differ: none; that do not: sensor, edges." in same
    )
    assert same.count("none\n") >= 2


def test_all_of_it_is_json_and_says_whether_it_is_the_same() -> None:
    made = compared(only_b=[9])
    made.take(0, {"edges": {"mask": Difference("mask", 0, 4)}}, {}, {})
    found = json.loads(json.dumps(made.as_dict(), allow_nan=False))
    assert found["same"] is True and found["frames"] == 1 and found["frames_only_b"] == [9]
    assert found["same_results"] == ["sensor.map", "edges.mask"] and found["results"] == []
    made.b.parameters = {"edges.reach": 2}
    assert made.as_dict()["same"] is False
    made.b.parameters = {}
    made.take(1, {"edges": {"mask": Difference("mask", 1, 4)}}, {}, {})
    found = made.as_dict()
    assert found["same"] is False and found["stages_that_differ"] == ["edges"]
    assert [row["artifact"] for row in found["results"]] == ["mask"]
    assert found["same_results"] == ["sensor.map"]
    assert found["a"] == {
        "title": "A", "preset": "default", "changed": [], "parameters": {},
        "digests": {"recording": "1"},
    }  # fmt: skip
    assert found["b"]["title"] == "B" and found["frames_only_a"] == []

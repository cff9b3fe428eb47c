"""The search for the smallest change finds the least one that there is, or says that it stopped."""

from __future__ import annotations

import itertools
import math
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any, Literal

import numpy as np
import pytest

from workbench.pipeline import Pipeline
from workbench.recording import Frame
from workbench.settings import adjusted, resolve
from workbench.stage import Artifact, Finding, Stage, StageParameters, knob, recorded_image
from workbench.why import (
    DEFAULT_BUDGET,
    Change,
    Search,
    StageStory,
    Story,
    Threshold,
    _same,
    as_markdown,
    outcome,
    plain,
    smallest_change,
    story,
)


class Sum(Stage):
    """Adds its knobs to the image."""

    name = "sum"
    needs = (recorded_image("left"),)
    gives = (Artifact("total", "float64", "H W"),)

    class Parameters(StageParameters):
        # A lattice of whole numbers: a tenth of the step.
        near: float = knob(32.0, "Added.", low=0, high=64, step=10)

    weights: Mapping[str, float] = {"near": 1.0}

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        added = sum(w * getattr(parameters, name) for name, w in self.weights.items())
        return {"total": inputs["left_image"].astype(np.float64) + added}


class Over(Stage):
    """Whether the total is over nothing."""

    name = "over"
    needs = (Artifact("total", "float64", "H W"),)
    gives = (Artifact("over", "bool", "H W"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"over": inputs["total"] >= 0}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        over = bool(artifacts["over"][y, x])
        says = f"{artifacts['total'][y, x]:g}"
        return [Finding(says, {"over": over}, verdict="over" if over else "under")]


def searched(
    value: float, *kinds: type[Stage], sets: tuple[str, ...] = (), **options: Any
) -> Search:
    stages: dict[str, Stage] = {kind.name: kind() for kind in kinds or (Sum, Over)}
    pipeline = Pipeline(stages, resolve(stages, assignments=sets))
    frame = Frame(0, 0, {"left": np.full((2, 3), value)}, {}, {}, None, f"{value}")
    found = smallest_change(pipeline, pipeline.run(frame), 1, 1, **options)
    assert found is not None
    return found


def changed(found: Search) -> tuple[Any, float]:
    assert found.change is not None
    return found.change.after, found.change.share


# -- one parameter --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("threshold", "after", "runs"),
    [
        # One place up and down: 33 and 31.
        (33, 33.0, 2),
        # Then 40 and 24; between 33 and 40: 36, 34, 35.
        (35, 35.0, 7),
        (40, 40.0, 7),
        (34, 34.0, 6),
        # All of the range: 64 and 0; between 40 and 64 are 23 places, so five more or fewer.
        (41, 41.0, 10),
        (64, 64.0, 11),
    ],
)
def test_one_parameter_is_tried_further_and_further_and_then_bisected(
    threshold: float, after: float, runs: int
) -> None:
    found = searched(-threshold)
    assert (found.verdict, found.change and found.change.verdict) == ("under", "over")
    assert changed(found) == (after, (after - 32) / 64)
    assert (found.runs, found.complete, found.parameters) == (runs, True, 1)
    assert (found.stage, found.instead) == ("over", None)
    assert found.change is not None and found.change.before == 32.0


@pytest.mark.parametrize("threshold", [0, 1, 7, 23, 24, 25, 30, 31, 32])
def test_downwards_as_upwards(threshold: float) -> None:
    found = searched(-threshold)
    # It is over at the threshold, so that the first under it is the change.
    if threshold == 0:
        assert found.change is None and found.complete
    else:
        assert found.verdict == "over"
        assert changed(found) == (threshold - 1, (32 - threshold + 1) / 64)


@pytest.mark.parametrize("threshold", range(33, 65))
def test_every_threshold_above_is_met_exactly(threshold: int) -> None:
    assert changed(searched(-threshold))[0] == threshold


@pytest.mark.parametrize(("value", "after"), [(0.0, 5.0), (64.0, 4.0), (32.5, 4.0), (1.7, 5.0)])
def test_from_wherever_it_stands_only_the_range_is_tried(value: float, after: float) -> None:
    found = searched(-5, sets=(f"sum.near={value}",))
    assert changed(found) == (after, pytest.approx(abs(after - value) / 64))


def test_a_threshold_between_two_places_is_met_by_the_next_one() -> None:
    assert changed(searched(-34.5))[0] == 35.0
    assert changed(searched(-33.0, sets=("sum.near=32.5",))) == (33.0, 0.5 / 64)
    # Down from between two places: the next one is below.
    assert changed(searched(-32.2, sets=("sum.near=32.5",)))[0] == 32.0


def test_what_lies_beyond_the_range_turns_nothing() -> None:
    found = searched(-65)
    assert found.change is None and found.complete
    # One, eight and all of the places, both ways.
    assert found.runs == 6
    # From the end of the range there is one way alone.
    assert searched(-65, sets=("sum.near=64",)).runs == 3
    assert searched(5, sets=("sum.near=0",)).runs == 3


class Unbounded(Sum):
    """Knobs without bounds, or with one."""

    class Parameters(StageParameters):
        near: float = knob(2.0, "Added.")

    weights = {"near": 1.0}


class Below(Unbounded):
    class Parameters(StageParameters):
        near: float = knob(2.0, "Added.", low=0)


class Zero(Unbounded):
    class Parameters(StageParameters):
        near: float = knob(0.0, "Added.")


class Whole(Unbounded):
    class Parameters(StageParameters):
        near: int = knob(0, "Added.", low=-100, high=100)


@pytest.mark.parametrize(
    ("kind", "sets", "reach"),
    [
        # Ten times the size, on either side of where it stands.
        (Unbounded, (), (2 - 20, 2 + 20)),
        (Unbounded, ("sum.near=-3",), (-3 - 30, -3 + 30)),
        (Unbounded, ("sum.near=0.5",), (0.5 - 20, 0.5 + 20)),
        (Below, (), (0, 2 + 20)),
        (Zero, (), (-1, 1)),
        (Whole, (), (-100, 100)),
    ],
)
def test_the_range_that_is_searched(
    kind: type[Stage], sets: tuple[str, ...], reach: tuple[float, float]
) -> None:
    low, high = reach
    for end, inside, outside in ((high, high - 1e-6, high + 1e-3), (low, low + 1e-6, low - 1e-3)):
        upwards = end == high
        # Upwards it turns from under to over at the threshold, downwards just below it.
        turned = searched(-inside, kind, Over, sets=sets)
        assert turned.change is not None and turned.change.after == pytest.approx(end)
        assert turned.change.share == pytest.approx(abs(end - turned.change.before) / (high - low))
        beyond = searched(-outside, kind, Over, sets=sets)
        assert beyond.change is None, upwards
    # A thousandth of the range is told apart, or whole numbers.
    step = (high - low) / 1000 if kind is not Whole else 1
    start = searched(-high, kind, Over, sets=sets).change
    assert start is not None
    at = float(start.before) + 0.3 * (high - float(start.before))
    found = searched(-at, kind, Over, sets=sets).change
    assert found is not None and at <= found.after < at + step + 1e-9


class Window(Sum):
    """A wide range, of which one value alone is over."""

    class Parameters(StageParameters):
        near: float = knob(3200.0, "Added.", low=0, high=6400, step=10)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        over = parameters.near == inputs["left_image"]
        return {"total": np.where(over, 0.0, -1.0)}


@pytest.mark.parametrize(
    ("at", "seen"),
    [
        # A 64th, an eighth and all of the range, both ways.
        (3300, True), (3100, True), (4000, True), (2400, True), (6400, True), (0, True),
        (3299, False), (3301, False), (3201, False), (3099, False), (3999, False), (4001, False),
        (2399, False), (6399, False), (1, False),
    ],
)  # fmt: skip
def test_what_turns_and_turns_back_is_seen_only_where_the_search_looks(at: int, seen: bool) -> None:
    found = searched(at, Window, Over)
    assert found.complete
    assert (found.change.after if found.change else None) == (float(at) if seen else None)


# -- several parameters ---------------------------------------------------------------------------


class Many(Sum):
    """Knobs of different ranges and weights."""

    class Parameters(StageParameters):
        wide: float = knob(0.0, "Added.", low=-500, high=500, step=10)
        narrow: float = knob(0.0, "Added twice.", low=-20, high=20, step=1)
        whole: int = knob(10, "Taken away.", low=0, high=40, step=1)
        idle: float = knob(0.5, "Of no effect.", low=0, high=1, step=0.1)

    weights = {"wide": 1.0, "narrow": 2.0, "whole": -3.0, "idle": 0.0}


def least_share(value: float) -> float:
    """By trying every place of every lattice."""
    places = {
        "wide": (np.arange(-500, 501, 1.0), 0.0, 1000),
        "narrow": (np.arange(-200, 201) / 10, 0.0, 40),
        "whole": (np.arange(0, 41), 10, 40),
    }
    before = value - 30 >= 0
    shares = [
        abs(v - at) / span
        for name, (values, at, span) in places.items()
        for v in values
        if (value - 30 + Many.weights[name] * (v - at) >= 0) != before
    ]
    return min(shares)


@pytest.mark.parametrize("value", [29, 28, 20, 10, 5, -3, -25, -60, 30, 31, 33, 39, 60, 71, 100])
def test_the_least_share_over_all_parameters_is_found(value: float) -> None:
    found = searched(value, Many, Over)
    assert found.complete and found.parameters == 4
    assert changed(found)[1] == pytest.approx(least_share(value), abs=1e-12)
    assert found.change is not None and found.change.address != "sum.idle"


def test_a_change_that_is_found_is_that_of_a_whole_run() -> None:
    for value in (28, -25, 71):
        found = searched(value, Many, Over).change
        assert found is not None
        stages: dict[str, Stage] = {"sum": Many(), "over": Over()}
        settings = adjusted(stages, resolve(stages), {found.address: found.after})
        pipeline = Pipeline(stages, settings)
        run = pipeline.run(Frame(0, 0, {"left": np.full((2, 3), value)}, {}, {}, None, "d"))
        told = story(pipeline, run, 1, 1)
        assert told.verdicts["over"] == found.verdict
        assert told.stages[-1].findings[0].says == found.says


class Kinds(Sum):
    """A switch and a choice, which count as all of a range."""

    class Parameters(StageParameters):
        turned: bool = knob(False, "Its sign.")
        how: Literal["as it is", "times ten", "dark"] = knob("as it is", "What is done.")
        label: str = knob("", "A text, which is not varied.")
        near: float = knob(0.0, "Added.", low=-10, high=10, step=10)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        total = inputs["left_image"].astype(np.float64) + parameters.near
        total = -total if parameters.turned else total
        return {"total": total - (1000 if parameters.how == "dark" else 0)}


def test_a_switch_or_a_choice_is_taken_where_no_number_does() -> None:
    # -5: a quarter of a range of 20 by the number; the switch is all of it.
    number = searched(-5, Kinds, Over)
    assert number.change is not None and number.change.address == "sum.near"
    assert number.parameters == 3 and number.change.share == 0.25
    switch = searched(-50, Kinds, Over)
    assert switch.change is not None
    assert (switch.change.address, switch.change.after) == ("sum.turned", True)
    assert switch.change.share == 1.0
    back = searched(50, Kinds, Over, sets=("sum.turned=true",))
    assert back.change is not None and back.change.after is False
    choice = searched(0.0, Kinds, Over, sets=("sum.near=0",))
    # At nothing a number does it, for 0 is over and -1 is under.
    assert choice.change is not None and choice.change.after == -1.0


class Dim(Kinds):
    """No knob but the choice."""

    class Parameters(StageParameters):
        how: Literal["as it is", "times ten", "dark"] = knob("as it is", "What is done.")

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"total": inputs["left_image"] - (1000.0 if parameters.how == "dark" else 0.0)}


def test_every_value_of_a_choice_is_tried_once() -> None:
    found = searched(5, Dim, Over)
    assert changed(found) == ("dark", 1.0) and found.runs == 2
    assert searched(-5, Dim, Over).change is None


class Named(Over):
    """Over a level of its own, which its finding names."""

    name = "named"
    gives = (Artifact("named", "bool", "H W"),)

    class Parameters(StageParameters):
        level: float = knob(32.0, "From here up is over.", low=0, high=64, step=10)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"named": inputs["total"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        over = bool(artifacts["named"][y, x])
        return [Finding("it is", {}, "level", verdict="over" if over else "under")]


class NamesNothing(Named):
    name = "names_nothing"
    gives = (Artifact("names_nothing", "bool", "H W"),)

    def compute(self, inputs: Mapping[str, Any], parameters: Any) -> dict[str, Any]:
        return {"names_nothing": inputs["total"] >= parameters.level}

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        over = bool(artifacts["names_nothing"][y, x])
        return [Finding("it is", verdict="over" if over else "under")]


@pytest.mark.parametrize("kind", [Named, NamesNothing])
@pytest.mark.parametrize("by", [1, 3, 20, 32])
def test_of_equal_changes_that_which_a_finding_names_and_else_the_later_stages(
    kind: type[Stage], by: int
) -> None:
    # Both ranges are the same: the level down by so much, or what is added up by so much.
    found = searched(-by, Sum, kind)
    assert found.change is not None
    assert (found.change.address, found.change.after) == (f"{kind.name}.level", 32.0 - by)


class SumNamed(Sum):
    """Its finding names its knob."""

    def explain(self, x: int, y: int, artifacts: Mapping[str, Any], p: Any) -> list[Finding]:
        return [Finding("added", {}, "near")]


@pytest.mark.parametrize("by", [1, 3, 20, 32])
def test_a_parameter_that_a_finding_names_comes_before_a_later_stages(by: int) -> None:
    found = searched(-by, SumNamed, NamesNothing)
    assert found.change is not None
    assert (found.change.address, found.change.after) == ("sum.near", 32.0 + by)


# -- the early stop -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("budget", "after", "runs", "complete"),
    [
        (0, None, 0, False),
        (1, None, 1, False),
        # 33, 31: nothing yet; 40 turns it.
        (2, None, 2, False),
        (3, 40.0, 3, False),
        (4, 40.0, 4, False),
        (5, 36.0, 5, False),
        (6, 36.0, 6, False),
        (7, 35.0, 7, True),
        (8, 35.0, 7, True),
    ],
)
def test_a_search_that_is_ended_early_has_the_best_until_then_and_says_so(
    budget: int, after: float | None, runs: int, complete: bool
) -> None:
    found = searched(-35, budget=budget)
    assert (found.runs, found.complete) == (runs, complete)
    assert (found.change.after if found.change else None) == after
    assert ("ended early" in outcome(found)) == (not complete)
    assert ("mallest change" in outcome(found)) == (after is not None)


def test_the_budget_counts_runs_of_the_search_and_not_the_proof() -> None:
    calls: list[int] = []
    found = searched(-35, before_each=lambda: calls.append(1))
    assert len(calls) == found.runs == 7
    assert DEFAULT_BUDGET == 600


def test_a_value_that_its_knob_refuses_costs_no_run() -> None:
    class Strict(Sum):
        class Parameters(StageParameters):
            near: float = knob(32.0, "Added.", low=0, high=64, step=10)

            def __init__(self, **values: Any) -> None:
                super().__init__(**values)
                if self.near == 33:
                    from workbench.settings import SettingsError

                    raise SettingsError("not 33")

    found = searched(-35, Strict, Over)
    assert (found.runs, changed(found)[0]) == (6, 35.0)


# -- what is told ---------------------------------------------------------------------------------

CHANGE = Change("sum.near", 32.0, 35.0, "px", 3 / 64, "over", "0 is enough")
FOUND = Search("over", "under", CHANGE, 7, 3, True)


@pytest.mark.parametrize(
    ("search", "says"),
    [
        (None, "There is no verdict on this pixel that could be turned."),
        (
            FOUND,
            "Smallest change: with `sum.near` at **35.0** px instead of 32.0 (4.7 % of its range) "
            "`over` says **over** instead of **under**: 0 is enough (3 parameters, 7 runs).",
        ),
        (
            replace(FOUND, complete=False),
            "The search was ended early. Until then the smallest change: with `sum.near` at "
            "**35.0** px instead of 32.0 (4.7 % of its range) `over` says **over** instead of "
            "**under**: 0 is enough (3 parameters, 7 runs).",
        ),
        (
            replace(FOUND, change=replace(CHANGE, unit="", share=1.0)),
            "Smallest change: with `sum.near` at **35.0** instead of 32.0 (all of its range) "
            "`over` says **over** instead of **under**: 0 is enough (3 parameters, 7 runs).",
        ),
        (
            replace(FOUND, change=None),
            "No change of one parameter within its range turns `over`'s **under** "
            "(3 parameters, 7 runs).",
        ),
        (
            replace(FOUND, change=None, complete=False),
            "The search was ended early: nothing was found that turns `over`'s **under** "
            "(3 parameters, 7 runs).",
        ),
        (
            replace(FOUND, instead=("last", "fixed")),
            "No change of one parameter within its range turns `last`'s **fixed**. In an earlier "
            "stage the smallest change: with `sum.near` at **35.0** px instead of 32.0 (4.7 % of "
            "its range) `over` says **over** instead of **under**: 0 is enough (3 parameters, "
            "7 runs).",
        ),
        (
            replace(FOUND, instead=("last", "fixed"), complete=False),
            "The search was ended early: nothing was found that turns `last`'s **fixed**. In an "
            "earlier stage the smallest change: with `sum.near` at **35.0** px instead of 32.0 "
            "(4.7 % of its range) `over` says **over** instead of **under**: 0 is enough "
            "(3 parameters, 7 runs).",
        ),
    ],
)
def test_what_a_search_found_in_words(search: Search | None, says: str) -> None:
    assert outcome(search) == says


def test_a_story_as_a_page() -> None:
    fine = Finding("it is bright", {}, "near", verdict="bright")
    beside = Finding("the neighbour is not", verdict="dark", about="the neighbour")
    told = Story(
        3,
        11,
        5,
        7,
        (
            StageStory("sum", (fine,), None, (Threshold("sum.near", 32.0, "px"),)),
            StageStory("beside", (Finding("words"), beside), None, (None, None)),
            StageStory("fails", trouble="ValueError: dark"),
            StageStory("mute"),
        ),
    )
    assert (told.own, told.subject) == (("sum",), "sum")
    assert told.stages[1].verdict == "dark" and told.stages[3].verdict == ""
    assert as_markdown(told, FOUND).splitlines() == [
        "## Pixel 5, 7 of frame 3",
        "",
        "`sum` says **bright**: it is bright.",
        "",
        "**sum: bright**",
        "",
        "- it is bright · `sum.near = 32.0 px`",
        "",
        "**beside: dark**",
        "",
        "- words",
        "- the neighbour is not",
        "",
        "**fails**",
        "",
        "- *ValueError: dark*",
        "",
        "**mute**",
        "",
        "- says nothing of single pixels",
        "",
        "**What would turn it**",
        "",
        outcome(FOUND),
    ]
    assert "What would turn it" not in as_markdown(told)


def test_the_last_finding_with_a_verdict_decides() -> None:
    first, last = Finding("a", verdict="one"), Finding("b", verdict="two")
    told = StageStory("s", (first, last, Finding("c")))
    assert told.deciding is last and told.verdict == "two"
    assert StageStory("s", (Finding("c"),)).deciding is None
    assert str(Threshold("s.p", 3)) == "s.p = 3"


@pytest.mark.parametrize(
    ("value", "same"),
    [
        (np.float32(0.5), 0.5),
        (np.int64(3), 3),
        (np.bool_(True), True),
        (np.array([[1, 2]]), [[1, 2]]),
        (np.array([1.0, np.nan]), [1.0, None]),
        ({1: (np.uint8(2), math.inf)}, {"1": [2, None]}),
        (MappingProxyType({"a": [-math.inf, 1.5]}), {"a": [None, 1.5]}),
        ("text", "text"),
        (None, None),
        (True, True),
    ],
)
def test_values_as_json_holds_them(value: Any, same: Any) -> None:
    assert plain(value) == same and type(plain(value)) is type(same)


# -- what makes no difference ---------------------------------------------------------------------


@dataclass
class Held:
    """An artifact that holds arrays."""

    array: np.ndarray
    more: Any = None


@dataclass
class Other(Held):
    """Another type with the same fields."""


A = np.arange(6, dtype=np.float32).reshape(2, 3)

DIFFERENT: list[Any] = [
    A, A.T, A.reshape(3, 2), A.astype(np.float64), A + 1, -A, [A], (A,), [A, A], [A, A + 1],
    [], (), {}, {"a": A}, {"b": A}, {"a": A + 1}, {"a": A, "b": A}, Held(A), Held(A + 1),
    Held(A, 1), Other(A), 1, 1.0, True, 2, "1", None, OrderedDict(a=A),
]  # fmt: skip


def test_only_what_is_the_same_to_the_last_byte_makes_no_difference() -> None:
    import copy

    for one, other in itertools.combinations(range(len(DIFFERENT)), 2):
        assert not _same(DIFFERENT[one], DIFFERENT[other]), (one, other)
        assert not _same(DIFFERENT[other], DIFFERENT[one]), (one, other)
    for value in DIFFERENT:
        assert _same(value, value) and _same(value, copy.deepcopy(value))
    # Unknown depth is the same unknown depth.
    nan = np.array([np.nan, 1.0])
    assert _same(nan, nan.copy()) and _same(Held(nan), Held(nan.copy()))
    assert not _same(np.array([0.0]), np.array([-0.0]))

"""What differs between two results is told to the pixel: its sign, its place and its bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from declared_artifacts import CODES, LABELS, MAP, MASK, POINTS, THING

from workbench.differences import (
    Difference,
    Knowledge,
    Place,
    Total,
    Totals,
    difference_of,
    differences_of_runs,
    kind_of,
    matched,
)
from workbench.stage import Artifact

NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("artifact", "kind"),
    [
        (MASK, "mask"),
        (CODES, "codes"),
        (LABELS, "labels"),
        (MAP, "map"),
        (POINTS, "array"),
        (THING, "object"),
        (Artifact("stack", "bool", "N H W"), "array"),
        (Artifact("row", "float32", "W"), "array"),
        (Artifact("names", "str", "H W"), "array"),
        (Artifact("signed", "int16", "H W"), "codes"),
    ],
)
def test_an_artifact_is_compared_by_what_it_was_declared_to_be(
    artifact: Artifact, kind: str
) -> None:
    assert kind_of(artifact) == kind


# -- masks, codes and regions ---------------------------------------------------------------------


@pytest.mark.parametrize(("artifact", "dtype"), [(MASK, bool), (CODES, np.uint8)])
def test_what_only_one_has_set_is_told_of_that_one(artifact: Artifact, dtype: Any) -> None:
    a = np.array([[1, 1, 0, 0, 1], [0, 0, 0, 1, 1]], dtype)
    b = np.array([[1, 0, 1, 0, 1], [0, 1, 1, 0, 1]], dtype)
    found = difference_of(artifact, a, b)
    assert (found.only_a, found.only_b, found.differing, found.of) == (2, 3, 5, 10)
    assert found.share == 0.5 and found.box == (1, 0, 3, 1)
    assert found.states is not None and found.states.tolist() == [
        [Place.BOTH, Place.ONLY_A, Place.ONLY_B, Place.NEITHER, Place.BOTH],
        [Place.NEITHER, Place.ONLY_B, Place.ONLY_B, Place.ONLY_A, Place.BOTH],
    ]
    assert found.largest is None and found.signed is None


def test_another_code_is_neither_only_in_a_nor_only_in_b() -> None:
    a, b = np.array([[1, 2, 0, 3]], np.uint8), np.array([[2, 2, 4, 0]], np.uint8)
    found = difference_of(CODES, a, b)
    assert found.states is not None
    assert found.states[0].tolist() == [Place.OTHER, Place.BOTH, Place.ONLY_B, Place.ONLY_A]
    assert (found.differing, found.only_a, found.only_b) == (3, 1, 1)


def test_what_is_the_same_has_no_place_and_no_picture() -> None:
    for artifact, dtype in ((MASK, bool), (CODES, np.uint8), (LABELS, np.int32), (MAP, np.float32)):
        value = np.eye(4, dtype=dtype)
        kind = kind_of(artifact)
        assert difference_of(artifact, value, value.copy()) == Difference(kind, 0, 16)


def test_bounds_and_place_are_column_before_row() -> None:
    a = np.zeros((70, 100), bool)
    b = a.copy()
    b[5, 90] = b[60, 12] = True
    b[33:36, 50:57] = True
    found = difference_of(MASK, a, b)
    assert found.box == (12, 5, 90, 60)
    # The middle of the block of 16 pixels in which most differ: columns 50 to 56, rows 33 to 35.
    assert found.at == (53, 34)


@pytest.mark.parametrize(("column", "at"), [(15, 13), (16, 17)])
def test_the_densest_block_begins_at_every_sixteenth_pixel(column: int, at: int) -> None:
    """Two runs of pixels that are cut by column 16: the block that holds more has the place."""
    a, b = np.zeros((20, 40), bool), np.zeros((20, 40), bool)
    b[3, 11 : column + 1] = True
    b[3, 16:19] = True
    b[3, 17:19] = column == 16
    if column == 16:
        b[3, 11:15] = False
        b[3, 16:19] = True
    found = difference_of(MASK, a, b)
    assert found.at == (at, 3)


def regions(*runs: tuple[int, int]) -> np.ndarray:
    """One row of labels, each for so many pixels."""
    return np.repeat([label for label, _ in runs], [count for _, count in runs])[None]


@pytest.mark.parametrize(
    ("a", "b", "same"),
    [
        # The numbers say nothing.
        (regions((1, 3), (2, 2)), regions((5, 3), (1, 2)), "11111"),
        # No region is the same as no region, and as nothing else.
        (regions((0, 2), (1, 3)), regions((0, 1), (7, 4)), "10111"),
        (regions((1, 4)), regions((0, 4)), "0000"),
        # Of a region cut in two, the larger part is still it.
        (regions((1, 5)), regions((4, 2), (3, 3)), "00111"),
        (regions((4, 2), (3, 3)), regions((1, 5)), "00111"),
        # Two regions that share most with the same one are not both it.
        (regions((1, 3), (2, 4)), regions((9, 7)), "0001111"),
        # Of halves that are equal, one alone is.
        (regions((1, 4)), regions((2, 2), (3, 2)), "1100"),
        (regions((2, 2), (3, 2)), regions((1, 4)), "1100"),
        # A's best is not B's best.
        (regions((1, 3), (2, 5)), regions((8, 1), (9, 7)), "00011111"),
    ],
)
def test_regions_are_matched_by_what_they_share_most_with(
    a: np.ndarray, b: np.ndarray, same: str
) -> None:
    assert "".join("01"[int(v)] for v in matched(a, b)[0]) == same


# -- maps -----------------------------------------------------------------------------------------


def test_a_map_differs_by_b_minus_a() -> None:
    a = np.array([[1, 5, 0.5], [2, 2, -1]], np.float32)
    b = np.array([[3, 1, 0.5], [2, 2.5, -1]], np.float32)
    found = difference_of(MAP, a, b)
    assert found.signed is not None and found.signed.tolist() == [[2, -4, 0], [0, 0.5, 0]]
    assert (found.largest, found.at, found.box) == (4, (1, 0), (0, 0, 1, 1))
    assert (found.differing, found.of, found.only_a, found.only_b) == (3, 6, 0, 0)
    assert found.states is None


@pytest.mark.parametrize(
    ("a", "b", "signed", "knowledge"),
    [
        (NAN, 1.0, 0.0, Knowledge.ONLY_B),
        (1.0, NAN, 0.0, Knowledge.ONLY_A),
        (NAN, NAN, 0.0, Knowledge.NEITHER),
        (INF, INF, 0.0, Knowledge.BOTH),
        (1.0, INF, INF, Knowledge.BOTH),
        (INF, 1.0, -INF, Knowledge.BOTH),
        (-INF, INF, INF, Knowledge.BOTH),
        (2.0, 2.0, 0.0, Knowledge.BOTH),
    ],
)
def test_what_is_not_finite_differs_as_it_says(
    a: float, b: float, signed: float, knowledge: Knowledge
) -> None:
    one, other = np.array([[0, a, 0]], np.float32), np.array([[9, b, 0]], np.float32)
    found = difference_of(MAP, one, other)
    assert found.signed is not None and found.knowledge is not None
    assert found.signed[0].tolist() == [9, signed, 0]
    assert found.knowledge[0].tolist() == [Knowledge.BOTH, knowledge, Knowledge.BOTH]
    changed = signed != 0 or knowledge in (Knowledge.ONLY_A, Knowledge.ONLY_B)
    assert found.differing == 1 + changed
    assert found.largest == (INF if math.isinf(signed) else 9)
    assert found.at == ((1, 0) if math.isinf(signed) else (0, 0))
    assert (found.only_a, found.only_b) == (
        int(knowledge == Knowledge.ONLY_A),
        int(knowledge == Knowledge.ONLY_B),
    )


def test_a_map_that_is_only_known_elsewhere_has_a_place_and_no_largest() -> None:
    a, b = np.zeros((5, 8), np.float32), np.zeros((5, 8), np.float32)
    a[3, 6] = NAN
    found = difference_of(MAP, a, b)
    assert (found.largest, found.at, found.box, found.only_b) == (None, (6, 3), (6, 3, 6, 3), 1)


def test_a_difference_is_taken_before_it_is_rounded() -> None:
    """In double precision, though the map is of single: 0.1 mm at 16 m is not lost."""
    a = np.full((1, 1), 1e4, np.float64)
    found = difference_of(Artifact("map", "float64", "H W", "mm"), a, a + 1e-4)
    assert found.largest == pytest.approx(1e-4, rel=1e-6)


# -- other arrays ---------------------------------------------------------------------------------


def test_arrays_tell_how_many_values_differ_and_the_greatest() -> None:
    a = np.array([[0, 1, NAN], [5, INF, -3]], np.float32)
    b = np.array([[0, 4, NAN], [1, 2, -3]], np.float32)
    found = difference_of(POINTS, a, b)
    # The infinite one differs, but has no size.
    assert (found.differing, found.of, found.largest, found.at) == (3, 6, 4, (1, 0))
    assert found.kind == "array" and found.box is None
    assert difference_of(POINTS, a, a.copy()) == Difference("array", 0, 6)
    # Of unsigned numbers the difference does not wrap around.
    counts = Artifact("counts", "uint8", "N")
    found = difference_of(counts, np.array([9, 3], np.uint8), np.array([9, 5], np.uint8))
    assert (found.largest, found.at) == (2, (1,))
    found = difference_of(counts, np.array([5], np.uint8), np.array([2], np.uint8))
    assert found.largest == 3


def test_arrays_without_sizes_tell_the_first_place() -> None:
    names = Artifact("names", "str", "N")
    found = difference_of(names, np.array(["a", "b", "c"]), np.array(["a", "x", "y"]))
    assert (found.differing, found.largest, found.at) == (2, None, (1,))
    found = difference_of(POINTS, np.array([[1.0, NAN, 3]]), np.array([[1.0, 2, 3]]))
    assert (found.differing, found.largest, found.at) == (1, None, (0, 1))


@pytest.mark.parametrize("artifact", [MASK, MAP, POINTS])
def test_other_shapes_are_told_and_not_compared(artifact: Artifact) -> None:
    a, b = np.zeros((4, 3), artifact.dtype), np.zeros((2, 3), artifact.dtype)
    found = difference_of(artifact, a, b)
    assert (found.differing, found.of, found.share) == (1, None, None)
    assert found.says == "4×3 in A, 2×3 in B"
    assert not found.same


# -- objects --------------------------------------------------------------------------------------


@dataclass
class Pose:
    angle: float
    name: str


class Bare:
    def __init__(self, value: float) -> None:
        self.value = value


class Unwilling:
    def __eq__(self, other: object) -> bool:
        raise RuntimeError("cannot be asked")

    def __str__(self) -> str:
        return "unwilling"

    __hash__ = None  # type: ignore[assignment]


def nested(wrap: Any, depth: int, value: int) -> Any:
    made: Any = value
    for _ in range(depth):
        made = wrap(made)
    return made


@pytest.mark.parametrize(
    ("a", "b", "says"),
    [
        (1, 2, "thing 1 in A, 2 in B"),
        (0.1 + 0.2, 0.30001, "thing 0.3 in A, 0.30001 in B"),
        (1, 1.5, "thing 1 in A, 1.5 in B"),
        (None, {"a": 1}, "thing None in A, {'a': 1} in B"),
        ({"x": 1, "y": 2}, {"x": 1, "y": 3}, "thing.y 2 in A, 3 in B"),
        ({"x": 1}, {}, "thing.x only in A"),
        ({}, {"x": 1}, "thing.x only in B"),
        ([1, 2, 3], [1, 5], "thing has 3 in A, 2 in B; thing[1] 2 in A, 5 in B"),
        ((1, [2]), (1, [4]), "thing[1][0] 2 in A, 4 in B"),
        (Pose(1, "a"), Pose(1, "b"), "thing.name a in A, b in B"),
        (Bare(1), Bare(2), "thing.value 1 in A, 2 in B"),
        (Unwilling(), Unwilling(), "thing unwilling in A, unwilling in B"),
        ("two\n  lines", "x", "thing two lines in A, x in B"),
        (np.zeros(3), np.zeros(2), "thing has 3 rows in A, 2 rows in B"),
        (np.zeros((2, 2)), np.zeros((2, 2), int), "thing has 2×2 float64 and int64 in A, 2×2 in B"),
        (np.array([[1, 2], [3, 4]]), np.array([[1, 2], [0, 9]]), "thing[1][0] 3 in A, 0 in B"),
        (np.float32(1), NAN, "thing 1 in A, nan in B"),
        (NAN, "x", "thing nan in A, x in B"),
        ("x", NAN, "thing x in A, nan in B"),
        ([1], None, "thing [1] in A, None in B"),
        (None, (1,), "thing None in A, (1,) in B"),
        ({"k": 1}, [1], "thing {'k': 1} in A, [1] in B"),
        (np.zeros(1), "x", "thing [0.] in A, x in B"),
        (Pose(1, "a"), None, "thing Pose(angle=1, name='a') in A, None in B"),
    ],
)
def test_an_object_tells_where_it_differs_and_what_each_holds(a: Any, b: Any, says: str) -> None:
    found = difference_of(THING, a, b)
    assert found.says == says and found.kind == "object" and not found.same
    assert found.of is None and found.share is None


def test_objects_count_every_value_that_differs() -> None:
    a = {"table": np.arange(6.0), "k": 1, "same": "x"}
    b = {"table": np.array([0, 1, 9, 9, 4, 9.0]), "k": 2, "same": "x"}
    found = difference_of(THING, a, b)
    assert found.differing == 4
    assert found.says == "thing.table[2] 2 in A, 9 in B; thing.k 1 in A, 2 in B"


def test_of_many_differences_three_are_told_and_the_rest_counted() -> None:
    for count, more in ((3, ""), (4, "; and 1 more"), (40, "; and 37 more")):
        found = difference_of(THING, [0] * count, [1] * count)
        assert found.differing == count
        told = "; ".join(f"thing[{k}] 0 in A, 1 in B" for k in range(3))
        assert found.says == told + more


def test_what_stands_in_two_places_differs_in_both() -> None:
    """Python keeps one object for a small number, and a user may for a dictionary."""
    one, other = {"k": 5}, {"k": 6}
    found = difference_of(THING, [one, one, {"x": 1, "y": 1}], [other, other, {"x": 2, "y": 2}])
    assert found.differing == 4


def test_a_long_value_is_cut() -> None:
    for length, cut in ((60, False), (61, True), (5000, True)):
        says = difference_of(THING, "a" * length, "b").says
        assert says == f"thing {'a' * 57 + '…' if cut else 'a' * length} in A, b in B"


@pytest.mark.parametrize(
    "wrap", [lambda v: [v], lambda v: {"k": v}, lambda v: Pose(v, "same"), lambda v: Bare(v)]
)
def test_objects_are_followed_sixteen_deep(wrap: Any) -> None:
    found = difference_of(THING, nested(wrap, 3, 1), nested(wrap, 3, 2))
    assert found.differing == 1
    # An object without fields of its own is as deep as what it holds.
    deepest = 16 if not isinstance(wrap(1), Bare) else 8
    assert not difference_of(THING, nested(wrap, deepest, 1), nested(wrap, deepest, 2)).same
    beyond = deepest + 1
    assert difference_of(THING, nested(wrap, beyond, 1), nested(wrap, beyond, 2)).same


def test_what_contains_itself_is_told_once() -> None:
    def circle(value: int) -> list[Any]:
        found: list[Any] = [value]
        found.append({"again": found})
        return found

    assert difference_of(THING, circle(1), circle(2)).says == "thing[0] 1 in A, 2 in B"


def test_not_a_number_is_the_same_as_itself_wherever_it_stands() -> None:
    assert difference_of(THING, [NAN, np.float32(NAN)], [NAN, np.float32(NAN)]).same
    rows = np.array([(NAN, 1)], [("a", float), ("b", int)])
    assert difference_of(THING, rows, rows.copy()).same
    assert not difference_of(THING, {"x": NAN}, {"x": 0.0}).same


# -- runs -----------------------------------------------------------------------------------------


def run_of(**artifacts: Any) -> Any:
    return SimpleNamespace(
        artifacts={name: value for name, (value, _) in artifacts.items()},
        digests={name: digest for name, (_, digest) in artifacts.items()},
    )


def test_runs_differ_artifact_by_artifact_and_what_has_one_digest_is_one_result() -> None:
    stages: Any = [
        SimpleNamespace(name="first", gives=(MASK, THING)),
        SimpleNamespace(name="second", gives=(MAP, CODES, LABELS)),
    ]
    one, other = np.ones((2, 3), bool), np.zeros((2, 3), bool)
    a = run_of(mask=(one, "x"), thing=([1], "t"), codes=(one, "c"))
    b = run_of(mask=(other, "y"), thing=([2], "t"), map=(one, "m"))
    found = differences_of_runs(stages, a, b)
    assert {stage: list(own) for stage, own in found.items()} == {
        "first": ["mask", "thing"],
        "second": ["map", "codes"],
    }
    assert (found["first"]["mask"].only_a, found["first"]["mask"].only_b) == (6, 0)
    assert found["first"]["thing"] == Difference("object", 0, None)
    assert found["second"]["map"] == Difference("missing", 1, None, "only in B: A failed")
    assert found["second"]["codes"] == Difference("missing", 1, None, "only in A: B failed")
    same = differences_of_runs(stages, a, a)
    assert same["first"]["mask"] == Difference("mask", 0, 6)


# -- over many frames -----------------------------------------------------------------------------


def test_a_total_is_the_mean_of_shares_over_every_frame() -> None:
    total = Total("stage", "map", "map", "mm")
    for frame, (differing, of) in enumerate([(0, 10), (4, 10), (2, 10), (1, None)]):
        total.add(frame, Difference("map", differing, of))
    assert (total.frames, total.differing_frames) == (4, 3)
    assert total.share == pytest.approx(0.6 / 3)
    assert (total.worst_frame, total.worst_share) == (1, 0.4)
    assert Total("stage", "map").share is None


def test_a_total_keeps_the_first_of_equals_and_sums_what_only_one_has() -> None:
    total = Total("stage", "mask", "mask")
    for frame, (share, at, box, only) in enumerate(
        [(2, (1, 1), (3, 4, 5, 6), (2, 0)), (2, (2, 2), (1, 5, 4, 9), (0, 1))], start=7
    ):
        total.add(
            frame,
            Difference("mask", share, 10, at=at, box=box, only_a=only[0], only_b=only[1]),
        )
    assert (total.worst_frame, total.at) == (7, (1, 1))
    assert total.box == (1, 4, 5, 9)
    assert (total.only_a, total.only_b) == (2, 1)
    total.add(9, Difference("mask", 3, 10, at=(8, 9), box=(0, 0, 9, 5)))
    assert (total.worst_frame, total.worst_share, total.at) == (9, 0.3, (8, 9))
    assert total.box == (0, 0, 9, 9)


@pytest.mark.parametrize("order", [1, -1])
def test_the_bounds_over_frames_hold_those_of_each(order: int) -> None:
    total = Total("stage", "mask", "mask")
    boxes = [(1, 20, 33, 40), (5, 12, 31, 47)]
    for frame, box in enumerate(boxes[::order]):
        total.add(frame, Difference("mask", 1, 10, box=box))
    assert total.box == (1, 12, 33, 47)


def test_a_total_of_maps_is_where_the_greatest_is() -> None:
    total = Total("stage", "map", "map", "mm")
    total.add(3, Difference("map", 5, 10, largest=2.0, at=(1, 0)))
    total.add(4, Difference("map", 1, 10, largest=7.0, at=(2, 0)))
    total.add(5, Difference("map", 9, 10, largest=None, at=(3, 0)))
    total.add(6, Difference("map", 1, 10, largest=7.0, at=(4, 0)))
    assert (total.largest, total.largest_frame, total.at) == (7, 4, (2, 0))
    assert (total.worst_frame, total.worst_share) == (5, 0.9)


def test_a_total_tells_the_first_thing_that_was_said_and_the_kind_that_differed() -> None:
    total = Total("stage", "thing", "object")
    total.add(0, Difference("object", 0))
    total.add(1, Difference("missing", 1, None, "only in A: B failed"))
    total.add(2, Difference("object", 3, says="later"))
    assert total.says == "frame 1: only in A: B failed"
    assert total.kind == "missing"
    assert total.worst_frame == 1


def test_a_total_as_json_holds_no_infinity_and_lists_for_places() -> None:
    total = Total("stage", "map", "map", "mm")
    total.add(3, Difference("map", 5, 10, largest=INF, at=(1, 2), box=(1, 2, 3, 4), only_b=1))
    told = total.as_dict()
    assert told == {
        "stage": "stage", "artifact": "map", "kind": "map", "unit": "mm",
        "frames": 1, "differing_frames": 1, "share": 0.5, "worst_frame": 3, "worst_share": 0.5,
        "largest": None, "largest_frame": 3, "at": [1, 2], "box": [1, 2, 3, 4],
        "only_a": 0, "only_b": 1, "says": "",
    }  # fmt: skip
    total = Total("stage", "thing")
    total.add(0, Difference("object", 1, says="x"))
    told = total.as_dict()
    assert told["share"] is told["worst_share"] is told["at"] is told["box"] is None
    total = Total("stage", "map")
    total.add(0, Difference("map", 1, 4, largest=2.5))
    assert total.as_dict()["largest"] == 2.5


def test_totals_keep_stages_in_order_and_name_those_that_differ() -> None:
    totals = Totals({"first": [MASK], "second": [MAP, CODES], "third": [THING]})
    assert [total.kind for own in totals.of.values() for total in own.values()] == [
        "mask",
        "map",
        "codes",
        "object",
    ]
    same, other = Difference("mask", 0, 4), Difference("mask", 1, 4)
    totals.add(0, {"first": {"mask": same}, "second": {"map": same, "codes": other}})
    totals.add(1, {"third": {"thing": other}, "second": {"map": other}})
    assert [t.artifact for t in totals.differing()] == ["map", "codes", "thing"]
    assert totals.stages == ["second", "third"]
    assert totals.of["second"]["map"].unit == "mm"
    assert totals.of["second"]["map"].stage == "second"
    assert totals.of["first"]["mask"].frames == 1

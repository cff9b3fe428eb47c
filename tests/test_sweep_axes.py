"""The grid: what is written on the command line, what cells it makes, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.errors import UsageError
from workbench.settings import resolve
from workbench.stage import Stage, StageParameters, knob
from workbench.sweep.axes import Axis, Grid, grid


class Tunable(Stage):
    name = "mine"

    class Parameters(StageParameters):
        count: int = knob(3, "A number.", low=0, high=100)
        share: float = knob(0.5, "A share.", low=0, high=10)
        kind: Literal["plain", "odd"] = knob("plain", "A choice.")
        flag: bool = knob(True, "A switch.")


class Cut(Stage):
    name = "cut"

    class Parameters(StageParameters):
        x: float = knob(0.0, "Of a stage that is not run.")


STAGES: Mapping[str, Stage] = {"mine": Tunable(), "cut": Cut()}


def grid_of(
    *axes: str, zips: tuple[str, ...] = (), sample: int | None = None, seed: int = 0
) -> Any:
    return grid(axes, zips, sample, seed, STAGES, ["mine"], resolve(STAGES))


@pytest.mark.parametrize(
    ("written", "values"),
    [
        ("mine.share=0.02:0.2:0.02", [round(0.02 * n, 2) for n in range(1, 11)]),
        ("mine.share=0:1:0.3", [0.0, 0.3, 0.6, 0.9]),
        ("mine.share=3,5,7", [3.0, 5.0, 7.0]),
        ("mine.count=2:8:3", [2, 5, 8]),
        ("mine.count=5:5:1", [5]),
        ("mine.share=0.01:10:x4", [0.01, 0.1, 1.0, 10.0]),
        ("mine.count=1:8:x9", [1, 2, 3, 4, 5, 6, 8]),
        ("mine.kind=odd,plain", ["odd", "plain"]),
        ("mine.flag=true,false", [True, False]),
        (" mine.count = 4 , 2 ", [4, 2]),
    ],
)
def test_values_of_an_axis(written: str, values: list[Any]) -> None:
    [axis] = grid_of(written).axes
    assert list(axis.values) == values
    assert [type(value) for value in axis.values] == [type(value) for value in values]


@pytest.mark.parametrize(
    ("axes", "zips", "says"),
    [
        ((), (), "expected at least one"),
        (("mine.share",), (), "expected STAGE.PARAMETER="),
        (("yours.share=1,2",), (), "no stage 'yours'; stages: mine, cut"),
        (("mine.sahre=1,2",), (), "it has: count, share, kind, flag"),
        (("cut.x=1,2",), (), "cut is not run"),
        (("mine.share=1:0:0.1",), (), "empty range"),
        (("mine.share=0:1:0",), (), "empty range"),
        (("mine.share=0:1:-1",), (), "empty range"),
        (("mine.share=0:1",), (), "LO:HI:STEP"),
        (("mine.share=0:1:x3",), (), "over 0"),
        (("mine.share=1:2:x1",), (), "2 or more"),
        (("mine.share=a:2:1",), (), "expected a number, found 'a'"),
        (("mine.share=0:inf:1",), (), "finite"),
        (("mine.share=1,,2",), (), "between the commas"),
        (("mine.share=1,1.0",), (), "twice"),
        (("mine.share=1,20",), (), "ranges over 0 .. 10"),
        (("mine.count=1.5,2",), (), "mine.count"),
        (("mine.kind=plain,strange",), (), "expected one of plain, odd"),
        (("mine.kind=1:2:1",), (), "expected a list, as plain,odd"),
        (("mine.share=1,2", "mine.share=3,4"), (), "has an axis already"),
        (("mine.share=0:10:0.00001",), (), "wider step"),
        (("mine.share=0:10:0.002", "mine.count=0:100:1"), (), "--sample"),
        (("mine.share=1,2", "mine.count=1,2,3"), ("mine.share,mine.count",), "as many values"),
        (("mine.share=1,2",), ("mine.share,mine.flag",), "no axis mine.flag"),
        (("mine.share=1,2",), ("mine.share",), "two or more"),
        (("mine.share=1,2", "mine.count=1,2"), ("mine.share,mine.share",), "zipped already"),
    ],
)
def test_what_cannot_be_swept_is_told_in_one_line(
    axes: tuple[str, ...], zips: tuple[str, ...], says: str
) -> None:
    with pytest.raises(UsageError) as told:
        grid_of(*axes, zips=zips)
    assert says in str(told.value)
    assert "\n" not in str(told.value)


def test_zipped_axes_move_together_and_cross_the_others() -> None:
    whole = grid_of(
        "mine.share=1,2", "mine.kind=plain,odd", "mine.count=7,8", zips=("mine.share,mine.count",)
    )
    assert whole.shape == (2, 2)
    assert [tuple(cell.values.values()) for cell in whole.cells()] == [
        (1.0, 7, "plain"),
        (1.0, 7, "odd"),
        (2.0, 8, "plain"),
        (2.0, 8, "odd"),
    ]


def test_a_sample_of_a_grid_too_large_to_run_is_drawn_by_its_seed() -> None:
    axes = ("mine.share=0:10:0.002", "mine.count=0:100:1", "mine.flag=true,false")
    first, again, other = (grid_of(*axes, sample=50, seed=seed) for seed in (3, 3, 4))
    assert first == again != other
    assert len(first) == 50 == len({tuple(cell.values.values()) for cell in first.cells()})
    assert first.size == 5001 * 101 * 2
    assert grid_of("mine.count=1,2", sample=9).sampled is None


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(1, 5), min_size=1, max_size=4))
def test_the_cells_of_a_grid_are_its_product_once_each(lengths: list[int]) -> None:
    axes = [Axis(f"s.p{n}", tuple(range(length))) for n, length in enumerate(lengths)]
    whole = Grid(tuple((axis,) for axis in axes))
    cells = whole.cells()
    assert [cell.index for cell in cells] == list(range(whole.size))
    assert len({cell.place for cell in cells}) == whole.size
    assert all(tuple(cell.values.values()) == cell.place for cell in cells)
    assert all(whole.cell(cell.index) == cell for cell in cells)

"""The parts of a sweep: cells in order, tasks that cover each once, figures put together."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from workbench.errors import DataError, UsageError
from workbench.settings import resolve
from workbench.stage import Artifact, Score, Scorer, Stage, StageParameters, knob
from workbench.sweep import engines
from workbench.sweep.analysis import (
    FLAT_SHARE,
    choose,
    curve,
    main_effects,
    neighbours,
    surface,
)
from workbench.sweep.axes import MOST_CELLS, Axis, Cell, Grid, _check_count, grid
from workbench.sweep.cache import Cache, Kept, packed
from workbench.sweep.plan import Block, Task, blocks_of, in_tree_order, tasks_of, upstream
from workbench.sweep.results import (
    STABILITY,
    Reader,
    add_stability,
    frame_rows,
    mean_ms,
)
from workbench.sweep.run import (
    Request,
    _metric_asked,
    _picture_stage,
    _spread,
)
from workbench.sweep.table import (
    METRICS_KEY,
    PROVENANCE_KEY,
    TIMES,
    FrameRow,
    Metric,
    Row,
    write_cells,
    write_frames,
)

# -- which frames and cells a task has -------------------------------------------------------------


def stage(name: str, needs: str = "", gives: str | None = None) -> Stage:
    members = {
        "name": name,
        "needs": [Artifact(word) for word in needs.split()],
        "gives": [Artifact(word) for word in (name.lower() if gives is None else gives).split()],
    }
    made: Stage = type(name, (Stage,), members)()
    return made


def cells_of(*values: Mapping[str, Any]) -> list[Cell]:
    return [Cell(index, (index,), value) for index, value in enumerate(values)]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 9), st.integers(0, 90)), min_size=1, max_size=4),
    st.integers(1, 16),
)
def test_blocks_cover_every_frame_once(spans: list[tuple[int, int]], workers: int) -> None:
    counts = [(start, start + length) for start, length in spans]
    found = [
        (recording, frame)
        for recording, start, stop in blocks_of(counts, workers)
        for frame in range(start, stop)
    ]
    expected = [(r, f) for r, (start, stop) in enumerate(counts) for f in range(start, stop)]
    assert found == expected
    assert all(stop > start for _, start, stop in blocks_of(counts, workers))


@pytest.mark.parametrize(
    ("frames", "workers", "lengths"),
    [
        (12, 1, [3, 3, 3, 3]),
        (12, 2, [1] * 12),
        (8, 1, [2, 2, 2, 2]),
        (9, 1, [2, 2, 2, 2, 1]),
        (64, 1, [16] * 4),
        (68, 1, [16] * 4 + [4]),
        (3, 8, [1, 1, 1]),
        (0, 1, []),
    ],
)
def test_blocks_are_four_a_worker_and_sixteen_frames_at_most(
    frames: int, workers: int, lengths: list[int]
) -> None:
    assert [stop - start for _, start, stop in blocks_of([(0, frames)], workers)] == lengths


def levels(count: int) -> tuple[Cell, ...]:
    return tuple(cells_of(*({"a.x": n} for n in range(count))))


@pytest.mark.parametrize(
    ("blocks", "cells", "workers", "sizes"),
    [
        (1, 10, 1, [10]),
        # One block for two workers: four parts.
        (1, 10, 2, [3, 3, 3, 1]),
        (2, 10, 2, [5, 5, 5, 5]),
        (3, 10, 2, [5, 5, 5, 5, 5, 5]),
        (4, 10, 2, [10, 10, 10, 10]),
        (1, 3, 4, [1, 1, 1]),
        (1, 256, 1, [256]),
        (1, 257, 1, [256, 1]),
        (0, 10, 2, []),
    ],
)
def test_tasks_share_out_blocks_and_part_cells_only_where_workers_would_wait(
    blocks: int, cells: int, workers: int, sizes: list[int]
) -> None:
    given = [Block(0, n, n + 1, levels(cells)) for n in range(blocks)]
    given.append(Block(1, 0, 5, ()))
    tasks = tasks_of(given, [stage("a")], workers)
    assert [len(task.cells) for task in tasks] == sizes
    assert [task.number for task in tasks] == list(range(len(tasks)))
    covered = Counter((t.recording, t.start, t.stop, v["a.x"]) for t in tasks for v in t.cells)
    assert covered == {(0, n, n + 1, x): 1 for n in range(blocks) for x in range(cells)}


def test_cells_that_share_the_longest_prefix_follow_one_another() -> None:
    stages = [stage("a"), stage("b"), stage("c")]
    values = [{"c.x": c, "a.x": a, "b.x": b} for c in (9, 1) for b in (2, 8) for a in (5, 3, 4)]
    ordered = in_tree_order(cells_of(*values), stages)
    runs = [tuple(cell.values[f"{s}.x"] for s in "abc") for cell in ordered]
    # In the order in which values first came, the first stage's slowest.
    assert runs == [(a, b, c) for a in (5, 3, 4) for b in (2, 8) for c in (9, 1)]


def test_values_of_two_types_are_two_branches() -> None:
    ordered = in_tree_order(
        cells_of({"a.x": True, "b.x": 1}, {"a.x": 1, "b.x": 1}, {"a.x": True, "b.x": 2}),
        [stage("a"), stage("b")],
    )
    assert [cell.index for cell in ordered] == [0, 2, 1]


def test_what_a_stage_depends_on() -> None:
    stages = [stage("A"), stage("B", "a"), stage("C"), stage("D", "b c near_image")]
    assert upstream(stages) == {
        "A": {"A"}, "B": {"A", "B"}, "C": {"C"}, "D": {"A", "B", "C", "D"}
    }  # fmt: skip


@pytest.mark.parametrize(
    ("spans", "count", "chosen"),
    [
        ([(0, 12)], 4, [{0, 3, 6, 9}]),
        ([(0, 12)], 1, [{0}]),
        ([(5, 9)], 2, [{5, 7}]),
        ([(0, 3)], 9, [{0, 1, 2}]),
        ([(0, 4), (2, 6)], 4, [{0, 2}, {2, 4}]),
        ([(0, 0), (2, 6)], 1, [set(), {2}]),
    ],
)
def test_pictures_are_of_frames_spread_over_all_recordings(
    spans: list[tuple[int, int]], count: int, chosen: list[set[int]]
) -> None:
    assert list(_spread(spans, count)) == [frozenset(one) for one in chosen]


class Draws(Stage):
    name = "draws"
    gives = (Artifact("labels", "int32", "H W"),)


class Later(Stage):
    name = "later"
    gives = (Artifact("picture", "uint8", "H W"),)


class Says(Stage):
    name = "says"
    gives = (Artifact("points", "float32", "N 2"),)


@pytest.mark.parametrize(
    ("asked", "stage_name"),
    [([], "later"), ([("draws.x", None)], "draws"), ([("says.x", None)], "draws"),
     ([("later.x", None)], "later"), ([("draws.x", None), ("later.x", None)], "draws")],
)  # fmt: skip
def test_the_picture_is_that_of_the_stage_that_is_asked_about(asked: Any, stage_name: str) -> None:
    assert _picture_stage([Draws(), Says(), Later()], asked) == stage_name
    assert _picture_stage([Says()], asked) is None


@pytest.mark.parametrize(
    ("text", "asked"),
    [
        ("draws.count", ("draws.count", None)),
        (" draws.count:higher ", ("draws.count", "higher")),
        ("draws.count:lower", ("draws.count", "lower")),
        ("draws.count:zero", ("draws.count", "zero")),
        ("labels.count", ("draws.count", None)),
        ("points.a.b", ("says.a.b", None)),
    ],
)
def test_a_figure_as_it_is_asked_for(text: str, asked: tuple[str, str | None]) -> None:
    assert _metric_asked(text, [Draws(), Says()]) == asked


# -- the grid -------------------------------------------------------------------------------------


class Mine(Stage):
    name = "mine"

    class Parameters(StageParameters):
        count: int = knob(3, "A number.", low=0, high=100_000)
        share: float = knob(0.5, "A share.", low=0, high=10)


MINE: Mapping[str, Stage] = {"mine": Mine()}


def grid_of(*axes: str, sample: int | None = None) -> Grid:
    return grid(axes, (), sample, 0, MINE, ["mine"], resolve(MINE))


def test_a_grid_may_have_a_hundred_thousand_cells_and_not_one_more() -> None:
    assert MOST_CELLS == 100_000
    thousand = "mine.count=1:1000:1"
    assert len(grid_of(thousand, "mine.share=0.1:10:0.1")) == MOST_CELLS
    with pytest.raises(UsageError, match=r"1000 x 101 = 101,000 cells are more than 100,000"):
        grid_of(thousand, "mine.share=0:10:0.1")


@pytest.mark.parametrize("axis", ["mine.count=0:10000:1", "mine.share=0.001:10:x10001"])
def test_an_axis_may_have_ten_thousand_values_and_not_one_more(axis: str) -> None:
    with pytest.raises(UsageError, match=r"10,001 values are more than 10,000"):
        grid_of(axis)
    _check_count(10_000, axis)


@pytest.mark.parametrize(("sample", "cells"), [(1, 1), (2, 2), (6, 6), (7, 6)])
def test_a_sample_has_as_many_cells_as_asked_for(sample: int, cells: int) -> None:
    whole = grid_of("mine.count=1,2,3", "mine.share=1,2", sample=sample)
    assert len(whole) == cells == len(whole.cells()) and whole.size == 6
    assert (whole.sampled is None) == (sample >= 6)
    if whole.sampled is not None:
        assert list(whole.sampled) == sorted(set(whole.sampled))
        assert {cell.index for cell in whole.cells()} == set(whole.sampled)
    with pytest.raises(UsageError, match="--sample 0: expected a number of cells"):
        grid_of("mine.count=1,2", sample=0)


@pytest.mark.parametrize(
    ("axis", "says"),
    [
        ("mine.count=100001", "; it ranges over 0 .. 100000"),
        ("mine.share=-1", "; it ranges over 0 .. 10"),
        ("mine.share=0.5,x", r"mine\.share"),
        ("mine.share=0:1:0:1", "found 4 parts"),
        ("mine.share=0.1:1:xa", "found xa"),
        ("mine.share=-1:1:x3", "found -1"),
        ("mine.share=nan:1:1", "expected a finite number, found 'nan'"),
    ],
)
def test_what_is_wrong_with_an_axis_is_told(axis: str, says: str) -> None:
    with pytest.raises(UsageError, match=says):
        grid_of(axis)


@pytest.mark.parametrize(
    ("axis", "values"),
    [
        ("mine.share=1:3:1", [1.0, 2.0, 3.0]),
        ("mine.share=1:2.9:1", [1.0, 2.0]),
        ("mine.share=0.1:0.3:0.1", [0.1, 0.2, 0.3]),
        ("mine.share=1:4:x3", [1.0, 2.0, 4.0]),
        ("mine.share=0.3:0.3:x2", [0.3]),
        ("mine.share=1:10:x3", [1.0, 3.16228, 10.0]),
        ("mine.count=1:3:x3", [1, 2, 3]),
    ],
)
def test_ranges_reach_their_ends(axis: str, values: list[float]) -> None:
    assert list(grid_of(axis).axes[0].values) == values


# -- what a finished grid says ---------------------------------------------------------------------


def rows_of(
    values: Mapping[tuple[int, ...], float],
    failed: Iterable[tuple[int, ...]] = (),
    zipped: bool = False,
) -> tuple[Grid, list[Row]]:
    """A grid with the figure ``s.m`` in each cell; axes have values ten times their places."""
    lengths = [max(place[n] for place in values) + 1 for n in range(len(next(iter(values))))]
    steps: list[tuple[Axis, ...]] = [
        (Axis(f"s.p{n}", tuple(10 * k for k in range(length))),) for n, length in enumerate(lengths)
    ]
    if zipped:
        steps[0] = (*steps[0], Axis("s.q", tuple(-k for k in range(lengths[0]))))
    whole = Grid(tuple(steps))
    return whole, [
        Row(cell, "", 1, int(cell.place in set(failed)), "", {"s.m": values[cell.place]})
        for cell in whole.cells()
    ]


def metric(better: Any = "higher") -> Metric:
    return Metric("s.m", "m", better=better)


@pytest.mark.parametrize(
    ("better", "value", "worth"),
    [
        ("higher", 2.0, 2.0), ("higher", -2.0, -2.0), ("lower", 2.0, -2.0), ("lower", -2.0, 2.0),
        ("zero", 2.0, -2.0), ("zero", -2.0, -2.0), ("zero", 0.0, 0.0), (None, 2.0, 2.0),
        ("lower", math.nan, -math.inf), ("lower", -math.inf, -math.inf),
        ("higher", math.inf, -math.inf), ("zero", math.nan, -math.inf),
    ],
)  # fmt: skip
def test_more_worth_is_better(better: Any, value: float, worth: float) -> None:
    assert metric(better).worth(value) == worth


def test_neighbours_differ_by_one_place_on_one_axis() -> None:
    whole, rows = rows_of({(x, y): 0.0 for x in range(3) for y in range(2)})
    cells = [row.cell for row in rows]
    pairs = {(a.place, b.place) for a, b in neighbours(whole, cells)}
    assert pairs == {
        ((0, 0), (1, 0)), ((1, 0), (2, 0)), ((0, 1), (1, 1)), ((1, 1), (2, 1)),
        ((0, 0), (0, 1)), ((1, 0), (1, 1)), ((2, 0), (2, 1)),
    }  # fmt: skip
    # Of a sample only what is there.
    assert list(neighbours(whole, [cells[0], cells[5]])) == []


def test_among_equals_the_one_with_the_best_around_it_and_then_the_first() -> None:
    choice = choose(*rows_of({(0,): 5, (1,): 1, (2,): 3, (3,): 5, (4,): 4}), metric())
    assert choice is not None and (choice.row.cell.place, choice.equals) == ((3,), 1)
    choice = choose(*rows_of({(0,): 5, (1,): 1, (2,): 5}), metric())
    assert choice is not None and (choice.row.cell.place, choice.equals) == ((0,), 1)
    choice = choose(*rows_of({(0,): 5}), metric())
    assert choice is not None and (choice.equals, choice.flat.within) == (0, 0.0)


def test_a_cell_that_failed_is_chosen_only_where_all_did() -> None:
    values = {(0,): 9.0, (1,): 5.0, (2,): 7.0}
    for failed, place in (((), 0), ([(0,)], 2), ([(0,), (2,)], 1), ([(0,), (1,), (2,)], 0)):
        choice = choose(*rows_of(values, failed), metric())
        assert choice is not None and choice.row.cell.place == (place,)


def test_a_cell_without_the_figure_is_neither_chosen_nor_crossed() -> None:
    whole, rows = rows_of({(0,): 5.0, (1,): math.nan, (2,): 5.0, (3,): 0.0})
    del rows[1].figures["s.m"]
    choice = choose(whole, rows, metric())
    # Of the two that are equal only the last has a neighbour; the first is not reached from it.
    assert choice is not None and choice.row.cell.place == (2,)
    assert choice.flat.cells == (2,) and choice.equals == 1


def test_the_flat_region_is_connected_and_within_a_twentieth_of_the_spread() -> None:
    assert FLAT_SHARE == 0.05
    # From 100 down to 0: down to 95 is flat, 94.9 is not, and what lies behind it neither.
    values = dict(zip([(n,) for n in range(7)], [0.0, 95.0, 99, 100, 98, 94.9, 97], strict=True))
    choice = choose(*rows_of(values), metric())
    assert choice is not None
    assert choice.flat.cells == (1, 2, 3, 4)
    assert choice.flat.within == pytest.approx(5.0)
    assert choice.flat.spans == {"s.p0": (10, 40)}
    lower = choose(*rows_of({place: -value for place, value in values.items()}), metric("lower"))
    assert lower is not None and lower.flat == choice.flat


def test_the_spans_of_axes_that_are_zipped_are_their_own() -> None:
    whole, rows = rows_of(
        {(x, y): 10.0 - 100 * (x == 0) for x in range(3) for y in range(2)}, zipped=True
    )
    choice = choose(whole, rows, metric())
    assert choice is not None
    assert choice.flat.spans == {"s.p0": (10, 20), "s.q": (-1, -2), "s.p1": (0, 10)}


def test_what_each_axis_explains() -> None:
    for values, shares in (
        ({(x, y): 3.0 * x for x in range(3) for y in range(2)}, (1.0, 0.0)),
        ({(x, y): 3.0 * y for x in range(3) for y in range(2)}, (0.0, 1.0)),
        # Two effects of equal variance, added: half each.
        ({(x, y): 1.0 * x + y for x in range(2) for y in range(2)}, (0.5, 0.5)),
        # Twice the step is four times the variance.
        ({(x, y): 2.0 * x + y for x in range(2) for y in range(2)}, (0.8, 0.2)),
        # All of it is interplay.
        ({(x, y): float(x == y) for x in range(2) for y in range(2)}, (0.0, 0.0)),
    ):
        whole, rows = rows_of(values)
        found = main_effects(whole, rows, metric())
        assert found == pytest.approx({"s.p0": shares[0], "s.p1": shares[1]})


def test_where_nothing_varies_nothing_matters_and_cells_without_a_value_do_not_count() -> None:
    whole, rows = rows_of({(x, y): 7.0 for x in range(2) for y in range(2)})
    assert main_effects(whole, rows, metric()) == {}
    whole, rows = rows_of({(0,): 1.0, (1,): math.nan, (2,): 3.0})
    assert main_effects(whole, rows, metric()) == pytest.approx({"s.p0": 1.0})
    assert main_effects(whole, [rows[1]], metric()) == {}
    whole, rows = rows_of({(0,): 1e6, (1,): 1e6 + 1e-2}, zipped=True)
    assert main_effects(whole, rows, metric()) == pytest.approx({"s.p0,s.q": 1.0})


def test_curves_and_surfaces_are_the_best_over_what_the_other_axes_take() -> None:
    values = {
        (x, y, z): 100.0 * x + 10 * y + z for x in range(2) for y in range(3) for z in range(2)
    }
    _, rows = rows_of(values)
    assert curve(rows, metric(), 0) == [(0, 21.0), (1, 121.0)]
    assert curve(rows, metric(), 1) == [(0, 101.0), (1, 111.0), (2, 121.0)]
    assert curve(rows, metric("lower"), 1) == [(0, 0.0), (1, 10.0), (2, 20.0)]
    assert surface(rows, metric("lower"), (2, 0)) == {
        (0, 0): 0.0, (0, 1): 100.0, (1, 0): 1.0, (1, 1): 101.0
    }  # fmt: skip
    for row in rows:
        if row.cell.place[0] == 1:
            row.figures["s.m"] = math.nan
    assert curve(rows, metric(), 0) == [(0, 21.0)]


# -- records put together --------------------------------------------------------------------------


class Sums(Scorer):
    """Put together from states; the figure is the mean over all frames."""

    def __init__(self) -> None:
        self.total, self.count = 0.0, 0

    def take(self, state: Mapping[str, Any]) -> None:
        self.total += state["total"]
        self.count += state["count"]

    def summary(self) -> list[Score]:
        if not self.count:
            return []
        mean = self.total / self.count
        return [
            Score("mean (all)", mean, "mm", coverage=self.count / 10, better="lower"),
            Score("mean (some)", 2 * mean, "px", better="higher"),
        ]


class Measured(Stage):
    name = "measured"

    def scorer(self) -> Scorer:
        return Sums()


def reader_of(
    tmp_path: Path, records: Mapping[tuple[int, int], Any], asked: frozenset[str] = frozenset()
) -> Reader:
    """A reader over two recordings, three and two frames long, with keys k0 and k1."""
    cache = Cache(tmp_path / "c.sqlite")
    for (recording, frame), record in records.items():
        outline = record.pop("outline", None)
        failed = "says" in record
        one = Kept(f"k{recording}", frame, failed, packed(record), outline, None)
        cache.put(f"s{recording}", {frame: True}, [one])
    job = SimpleNamespace(sources=("s0", "s1"))
    keys = [{0: {"measured": f"k{n}"}, 1: {"measured": f"k{n}"}} for n in range(2)]
    return Reader(job, [(0, 3), (4, 6)], keys, cache, asked)  # type: ignore[arg-type]


CELL = Cell(0, (0,), {})


def test_figures_are_those_of_one_scorer_over_all_frames(tmp_path: Path) -> None:
    reader = reader_of(
        tmp_path,
        {
            (0, 0): {"ms": 1.0, "own": {"rms (1)": 5.0}, "state": {"total": 1.0, "count": 1}},
            (0, 2): {"ms": 3.0, "own": {"rms (1)": 6.0}, "state": {"total": 2.0, "count": 3}},
            (1, 4): {"ms": 5.0, "state": {"total": 9.0, "count": 2}},
            # Beyond the span that was asked for.
            (1, 6): {"ms": 7.0, "state": {"total": 99.0, "count": 9}},
        },
    )
    with reader.cache:
        found = reader.result(CELL, Measured())
        assert reader.result(CELL, Measured()) is found
    assert found.metrics == (
        (Metric("measured.mean_mm", "mean (all)", "mm", "lower"), 2.0),
        (Metric("measured.mean_mm.covered", "mean (all): covered", "", "higher"), 0.6),
        (Metric("measured.mean_px", "mean (some)", "px", "higher"), 4.0),
    )
    assert list(found.frames) == [(0, 0), (0, 2), (1, 4)]
    assert found.frames[0, 2] == FrameRow(0, 2, {"measured.rms": 6.0}, {"measured": 3.0}, "")
    assert mean_ms({"measured": found}) == {"measured": 3.0}


def test_a_chosen_figure_is_also_told_frame_by_frame(tmp_path: Path) -> None:
    records = {
        (0, 0): {"ms": 1.0, "state": {"total": 1.0, "count": 1}},
        (0, 1): {"ms": 1.0, "state": {"total": 6.0, "count": 2}},
    }
    reader = reader_of(tmp_path, records, frozenset({"measured.mean_px", "other.x"}))
    with reader.cache:
        frames = reader.result(CELL, Measured()).frames
    assert [row.figures for row in frames.values()] == [
        {"measured.mean_px": 2.0}, {"measured.mean_px": 6.0}
    ]  # fmt: skip


def test_figures_without_a_state_are_means_over_the_frames_that_have_them(tmp_path: Path) -> None:
    share = {"name": "share (%)", "unit": "%", "better": "higher"}
    reader = reader_of(
        tmp_path,
        {
            (0, 0): {"ms": 1.0, "stateless": True, "own": {"gap": 1.0},
                     "figures": [share | {"value": 2.0}]},
            (0, 1): {"ms": 1.0, "stateless": True, "own": {"gap": 2.0},
                     "figures": [share | {"value": math.nan}]},
            (1, 5): {"ms": 1.0, "stateless": True, "own": {"gap": 6.0},
                     "figures": [share | {"value": 5.0}]},
        },
    )  # fmt: skip
    with reader.cache:
        found = reader.result(CELL, Measured())
    assert found.metrics == (
        (Metric("measured.gap", "gap"), 3.0),
        (Metric("measured.share", "share (%)", "%", "higher"), 3.5),
    )
    assert found.frames[0, 1].figures == {"measured.gap": 2.0}
    assert found.frames[1, 5].figures == {"measured.gap": 6.0, "measured.share": 5.0}


def test_a_failure_is_told_of_the_stage_that_failed_and_not_of_those_that_wait(
    tmp_path: Path,
) -> None:
    reader = reader_of(
        tmp_path,
        {
            (0, 0): {"says": "ValueError: dark", "blocked_by": None},
            (0, 1): {"says": "not run: other failed", "blocked_by": "other"},
            (0, 2): {"ms": 2.0, "says": "scoring: x", "blocked_by": None},
        },
    )
    with reader.cache:
        found = reader.result(CELL, Measured())
    errors = [row.error for row in found.frames.values()]
    assert errors == ["measured: ValueError: dark", "", "measured: scoring: x"]
    assert found.metrics == () and mean_ms({"measured": found}) == {"measured": 2.0}


def test_frames_hold_what_every_stage_says_and_the_first_error() -> None:
    def result(frames: Sequence[FrameRow]) -> Any:
        return SimpleNamespace(frames={(row.recording, row.frame): row for row in frames})

    merged = frame_rows(
        {
            "a": result([FrameRow(1, 0, {"a.x": 1.0}, {"a": 2.0}, ""),
                         FrameRow(0, 5, {}, {}, "a: dark")]),
            "b": result([FrameRow(1, 0, {"b.x": 3.0}, {"b": 4.0}, "b: odd"),
                         FrameRow(0, 5, {}, {}, "b: odd")]),
        }
    )  # fmt: skip
    assert merged == [
        FrameRow(0, 5, {}, {}, "a: dark"),
        FrameRow(1, 0, {"a.x": 1.0, "b.x": 3.0}, {"a": 2.0, "b": 4.0}, "b: odd"),
    ]


def outline(*bits: int) -> bytes:
    import struct

    return struct.pack("<II", 1, 8) + bytes(bits)


def test_stability_is_the_mean_overlap_with_the_neighbours_that_differ(tmp_path: Path) -> None:
    whole = Grid(((Axis("measured.x", (0, 1, 2, 3)),),))
    rows = [Row(cell, "", 1, 0, "", {}) for cell in whole.cells()]
    bits = [0b1111, 0b0011, 0b0011, 0b0001]
    with Cache(tmp_path / "c.sqlite") as cache:
        for index, value in enumerate(bits):
            key = "k1" if index == 2 else f"k{index}"
            kept = Kept(key, 0, False, packed({}), outline(value), None)
            cache.put("s0", {0: True}, [kept])
        keys = {index: {"measured": "k1" if index == 2 else f"k{index}"} for index in range(4)}
        job = SimpleNamespace(sources=("s0",))
        reader = Reader(job, [(0, 1)], [keys], cache, frozenset())  # type: ignore[arg-type]
        metrics: dict[str, Metric] = {}
        add_stability(whole, rows, "measured", reader, metrics)
    assert [row.figures.get(f"measured.{STABILITY}") for row in rows] == [0.5, 0.5, 0.5, 0.5]
    assert metrics[f"measured.{STABILITY}"].better == "higher"


def test_where_no_neighbour_differs_there_is_no_stability(tmp_path: Path) -> None:
    reader = reader_of(tmp_path, {(0, 0): {"outline": outline(1)}})
    whole = Grid(((Axis("measured.x", (0, 1)),),))
    rows = [Row(cell, "", 1, 0, "", {}) for cell in whole.cells()]
    metrics: dict[str, Metric] = {}
    with reader.cache:
        add_stability(whole, rows, "measured", reader, metrics)
    assert metrics == {} and all(row.figures == {} for row in rows)


# -- the tables -----------------------------------------------------------------------------------


def test_the_table_of_cells_holds_axes_figures_times_and_where_it_comes_from(
    tmp_path: Path,
) -> None:
    axes = [Axis("s.n", (1, 2)), Axis("s.mixed", (True, "box"))]
    rows = [
        Row(Cell(3, (0, 0), {"s.n": 1, "s.mixed": True}), "d0", 5, 0, "", {"s.m": 0.5},
            {"s": 2.5}),
        Row(Cell(7, (1, 1), {"s.n": 2, "s.mixed": "box"}), "d1", 5, 2, "s: dark",
            {"s.m": math.nan, "s.inf": math.inf}),
    ]  # fmt: skip
    path = tmp_path / "cells.parquet"
    metrics = [Metric("s.m", "m", "mm", "lower"), Metric("s.inf", "i")]
    write_cells(path, rows, axes, metrics, ["s", "t"], {"bench": "1"})
    table = pq.read_table(path)
    assert table.to_pylist() == [
        {"cell": 3, "s.n": 1, "s.mixed": "True", "frames": 5, "failed_frames": 0, "error": "",
         "s.m": 0.5, "s.inf": None, "result": "d0", "ms.s": 2.5, "ms.t": None},
        {"cell": 7, "s.n": 2, "s.mixed": "box", "frames": 5, "failed_frames": 2,
         "error": "s: dark", "s.m": None, "s.inf": math.inf, "result": "d1", "ms.s": None,
         "ms.t": None},
    ]  # fmt: skip
    assert table.schema.field("s.n").type == pa.int64() and TIMES == "ms."
    about = table.schema.metadata
    assert json.loads(about[PROVENANCE_KEY.encode()]) == {"bench": "1"}
    assert json.loads(about[METRICS_KEY.encode()]) == {
        "s.m": {"title": "m", "unit": "mm", "better": "lower"},
        "s.inf": {"title": "i", "unit": "", "better": None},
    }
    assert [one.name for one in tmp_path.iterdir()] == ["cells.parquet"]


@pytest.mark.parametrize("frames", [1, 3000])
def test_the_table_of_frames_has_every_row_once_in_order(tmp_path: Path, frames: int) -> None:
    cells = [Cell(n, (n,), {}) for n in range(3)]

    def rows(cell: Cell) -> list[FrameRow]:
        return [
            FrameRow(n % 2, n, {"s.m": float(cell.index), "s.nan": math.nan}, {"s": 1.0}, "e")
            for n in range(frames)
        ]

    path = tmp_path / "frames.parquet"
    write_frames(
        path, ((cell, rows(cell)) for cell in cells), ["a.mcap", "b.mcap"], ["s.m", "s.nan"],
        ["s", "t"], {"bench": "1"},
    )  # fmt: skip
    table = pq.read_table(path)
    found = table.to_pylist()
    assert [(row["cell"], row["frame"]) for row in found] == [
        (cell, frame) for cell in range(3) for frame in range(frames)
    ]
    assert found[-1] == {
        "cell": 2, "recording": "ab"[(frames - 1) % 2] + ".mcap", "frame": frames - 1,
        "error": "e", "s.m": 2.0, "s.nan": None, "ms.s": 1.0, "ms.t": None,
    }  # fmt: skip
    assert json.loads(table.schema.metadata[PROVENANCE_KEY.encode()]) == {"bench": "1"}


# -- engines --------------------------------------------------------------------------------------


def test_one_worker_does_every_task_in_this_process_and_stops_when_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from workbench import interrupts

    done: list[int] = []

    def work(job: Any, task: Task) -> Any:
        assert job == "job"
        done.append(task.number)
        return SimpleNamespace(task=task.number)

    monkeypatch.setattr(engines, "work", work)
    tasks = [Task(number, 0, 0, 1, ()) for number in range(3)]
    found = [one.task for one in engines.outcomes("job", tasks, 1, None)]  # type: ignore[arg-type]
    assert found == done == [0, 1, 2]
    assert list(engines.outcomes("job", [], 1, "nowhere")) == []  # type: ignore[arg-type]
    done.clear()
    ended = engines.outcomes("job", tasks, 1, None)  # type: ignore[arg-type]
    next(ended)
    monkeypatch.setattr(interrupts, "_received", 2)
    with pytest.raises(KeyboardInterrupt):
        next(ended)
    assert done == [0]


def test_workers_are_as_many_as_cores_or_two_a_core_for_a_cluster(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(engines, "cores", lambda: 3)
    monkeypatch.setattr("os.cpu_count", lambda: 5)
    assert engines.default_workers(None) == 3
    assert engines.default_workers("tcp://x") == 10
    monkeypatch.setattr("os.cpu_count", lambda: None)
    assert engines.default_workers("tcp://x") == 2


@pytest.mark.parametrize("deaths", [0, 1, 3, 4])
def test_workers_may_die_three_times_in_a_row(monkeypatch: pytest.MonkeyPatch, deaths: int) -> None:
    import joblib
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    assert engines.MOST_RETRIES == 3
    died: list[int] = []
    sizes: list[int] = []

    class Parallel:
        """One task comes through, then the workers die, as often as they are to."""

        def __init__(self, n_jobs: int, **_: Any) -> None:
            sizes.append(n_jobs)

        def __call__(self, calls: Iterable[Any]) -> Any:
            tasks = [arguments[1] for _, arguments, _ in calls]
            if len(tasks) == 2 and len(died) < deaths:
                died.append(1)
                raise TerminatedWorkerError("died")
            yield SimpleNamespace(task=tasks[0].number)
            if len(tasks) == 3:
                raise TerminatedWorkerError("died")
            yield from (SimpleNamespace(task=task.number) for task in tasks[1:])

    monkeypatch.setattr(joblib, "Parallel", Parallel)
    tasks = [Task(number, 0, 0, 1, ()) for number in range(3)]
    found = engines.outcomes(None, tasks, 2, None)  # type: ignore[arg-type]
    if deaths < 3:
        assert [one.task for one in found] == [0, 1, 2]
        assert sizes == [2] * (2 + deaths)
    else:
        # The death after the first task counts as well, for nothing was done since.
        with pytest.raises(DataError, match=r"workers died 4 times in a row"):
            list(found)


def test_a_cluster_that_is_not_installed_names_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    tasks = [Task(0, 0, 0, 1, ())]
    with pytest.raises(DataError, match=r"pip install 'defocus-workbench\[cluster\]'"):
        list(engines.outcomes(None, tasks, 2, "tcp://x"))  # type: ignore[arg-type]


def test_a_request_has_the_documented_defaults() -> None:
    request = Request(None, [], Path(), [])  # type: ignore[arg-type]
    assert (request.pictures, request.seed, request.sample, request.workers) == (4, 0, None, None)

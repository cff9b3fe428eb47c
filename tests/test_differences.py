"""What is said of two results holds: what differs, how much, and where."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from declared_artifacts import CODES, LABELS, MAP, MASK, POINTS, THING
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from test_replay import frames_of

from workbench.difference_pictures import has_picture, log_difference, span_of
from workbench.differences import (
    Knowledge,
    Place,
    Totals,
    difference_of,
    differences_of_runs,
)
from workbench.plugins import find_stages
from workbench.recording import Frame
from workbench.settings import adjusted, resolve

SHAPE = (6, 9)
VALUES = {
    "mask": (MASK, hnp.arrays(np.bool_, SHAPE)),
    "codes": (CODES, hnp.arrays(np.uint8, SHAPE, elements=st.integers(0, 3))),
    "labels": (LABELS, hnp.arrays(np.int32, SHAPE, elements=st.integers(0, 4))),
    "map": (
        MAP,
        hnp.arrays(
            np.float32, SHAPE, elements=st.sampled_from([0.0, 1.5, -2.0, np.nan, np.inf, -np.inf])
        ),
    ),
}


@pytest.mark.parametrize("kind", VALUES)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_laws_of_a_difference_of_images(kind: str, data: st.DataObject) -> None:
    artifact, values = VALUES[kind]
    a, b = data.draw(values), data.draw(values)
    assert difference_of(artifact, a, a.copy()).same
    forth, back = difference_of(artifact, a, b), difference_of(artifact, b, a)
    # What B has more than A is what A has less than B.
    assert (forth.differing, forth.only_a, forth.only_b, forth.box, forth.largest) == (
        back.differing, back.only_b, back.only_a, back.box, back.largest,
    )  # fmt: skip
    assert forth.of == a.size
    if kind != "labels":
        assert forth.differing == int((~np.isclose(a, b, 0, 0, equal_nan=kind == "map")).sum())
    if forth.same:
        assert forth.at is forth.box is None and not has_picture(forth)
        return
    assert forth.at is not None and forth.box is not None and has_picture(forth)
    x, y = forth.at
    assert forth.box[0] <= x <= forth.box[2] and forth.box[1] <= y <= forth.box[3]
    if forth.signed is not None:
        assert back.signed is not None
        assert np.array_equal(forth.signed, -back.signed)
        if forth.largest is not None:
            assert abs(forth.signed[y, x]) == forth.largest == np.abs(forth.signed).max()
    else:
        assert forth.states is not None and forth.states[y, x] >= Place.ONLY_A


def test_regions_are_the_same_whatever_their_numbers() -> None:
    a = np.array([[1, 1, 2, 2, 0], [1, 1, 2, 2, 3]], np.int32)
    renumbered = np.array([0, 7, 1, 2], np.int32)[a]
    assert difference_of(LABELS, a, renumbered).same
    assert not difference_of(replace(LABELS, names_regions=False), a, renumbered).same
    # Cut in two, the larger part is still the region, and the smaller another.
    cut = a.copy()
    cut[0, 0] = 9
    found = difference_of(LABELS, a, cut)
    assert found.differing == 1 and found.at == (0, 0)
    assert found.states is not None and found.states[0, 0] == Place.OTHER
    gone = np.where(a == 3, 0, a)
    assert difference_of(LABELS, a, gone).only_a == 1


def test_a_map_tells_what_is_known_in_one_alone() -> None:
    nan = np.nan
    a = np.array([[1, nan, nan, 2]], np.float32)
    b = np.array([[1, nan, 3, nan]], np.float32)
    found = difference_of(MAP, a, b)
    assert found.knowledge is not None
    assert found.knowledge.tolist() == [
        [Knowledge.BOTH, Knowledge.NEITHER, Knowledge.ONLY_B, Knowledge.ONLY_A]
    ]
    assert (found.differing, found.only_a, found.only_b, found.largest) == (2, 1, 1, None)


def test_other_arrays_tell_the_place_or_that_they_cannot_be_held_together() -> None:
    a = np.zeros((4, 3), np.float32)
    b = a.copy()
    b[2, 1] = -5
    found = difference_of(POINTS, a, b)
    assert (found.differing, found.of, found.largest, found.at) == (1, 12, 5.0, (2, 1))
    found = difference_of(POINTS, a, b[:3])
    assert not found.same and found.share is None
    assert "4×3 in A" in found.says and "3×3 in B" in found.says


@dataclass(frozen=True)
class Inner:
    angle: float
    table: Any


class Plain:
    def __init__(self, value: float) -> None:
        self.value = value


def test_objects_are_the_same_by_what_they_hold() -> None:
    rows = np.zeros(3, [("area", np.float64), ("label", np.int32)])
    rows["area"][1] = np.nan
    other = rows.copy()
    other["area"][2] = 4

    def build(table: Any, angle: float = 1.0, deep: float = 2.0) -> Any:
        return {"inner": [Inner(angle, table), None], "plain": Plain(deep), "nan": float("nan")}

    assert difference_of(THING, build(rows), build(rows.copy())).same
    found = difference_of(THING, build(rows), build(other, angle=1.25, deep=3))
    assert found.differing == 3
    assert "thing.inner[0].angle 1 in A, 1.25 in B" in found.says
    assert "thing.inner[0].table.area[2] 0 in A, 4 in B" in found.says
    assert "thing.plain.value 2 in A, 3 in B" in found.says
    assert "3 rows in A, 2 rows in B" in difference_of(THING, build(rows), build(rows[:2])).says
    assert "only in A" in difference_of(THING, {"a": 1, "b": 2}, {"b": 2}).says
    assert not difference_of(THING, None, {"a": 1}).same


def test_an_object_that_contains_itself_is_compared() -> None:
    def circle(value: int) -> list[Any]:
        found: list[Any] = [value]
        found.append(found)
        return found

    assert difference_of(THING, circle(1), circle(1)).same
    assert difference_of(THING, circle(1), circle(2)).differing == 1


def test_totals_name_the_frame_and_the_place_of_the_greatest() -> None:
    totals = Totals({"stage": [MAP, MASK]})
    zero = np.zeros(SHAPE, np.float32)
    for frame, (value, place) in enumerate([(0, (0, 0)), (2, (1, 2)), (-7, (4, 5)), (3, (5, 8))]):
        b = zero.copy()
        b[place] = value
        same = difference_of(MASK, zero != 0, zero != 0)
        totals.add(10 + frame, {"stage": {"map": difference_of(MAP, zero, b), "mask": same}})
    (total,) = totals.differing()
    assert (total.frames, total.differing_frames) == (4, 3)
    assert (total.largest, total.largest_frame, total.at) == (7.0, 12, (5, 4))
    assert total.box == (2, 1, 8, 5)
    assert total.share == pytest.approx(3 / 4 / zero.size)
    assert totals.stages == ["stage"]


def test_one_parameter_changes_what_is_downstream_only(first_frames: list[Frame]) -> None:
    from workbench.pipeline import Pipeline

    stages = find_stages()
    base = resolve(stages)
    a = Pipeline(stages, base, until="linked_edges")
    b = a.with_settings(adjusted(stages, base, {"edge_stack.greatest": 6.0}))
    run = a.run(first_frames[0])
    same = differences_of_runs(a.stages, run, a.run(first_frames[0]))
    assert {d.differing for own in same.values() for d in own.values()} == {0}
    found = differences_of_runs(a.stages, run, b.run(first_frames[0]))
    for name in ("registration", "focus_maps", "depth_cloud"):
        assert all(difference.same for difference in found[name].values()), name
    # The gradient is computed again, with the same outcome.
    assert found["edge_stack"]["gradient"].same
    # The greatest threshold makes the coarsest image alone, and a lower one only adds to it.
    assert found["edge_stack"]["edges_high"].same
    low = found["edge_stack"]["edges_low"]
    assert low.only_b > 0 and low.only_a == 0
    assert not found["linked_edges"]["edges_reconstructed"].same


def test_every_kind_of_picture_comes_back_from_a_file(tmp_path: Path) -> None:
    """On the frame on which it was logged, and one that no longer differs is cleared."""
    import rerun as rr

    path = tmp_path / "differences.rrd"
    recording = rr.RecordingStream("test", recording_id="test")
    recording.save(path)
    a = np.eye(5, dtype=np.float32)
    artifacts = ((MASK, bool), (CODES, np.uint8), (LABELS, np.int32), (MAP, np.float32))
    for frame in (3, 4):
        recording.set_time("frame", sequence=frame)
        for artifact, dtype in artifacts:
            b = a * (0 if frame == 3 else 1)
            found = difference_of(artifact, a.astype(dtype), b.astype(dtype))
            assert has_picture(found) == (frame == 3)
            log_difference(recording, f"difference/{artifact.name}", found)
    recording.flush()
    recording.disconnect()
    shown = frames_of(path)
    pictures = {"mask": "states", "codes": "states", "labels": "states", "map": "values"}
    for name, picture in pictures.items():
        assert shown[f"difference/{name}/{picture}"] == {3}, name
        assert shown[f"difference/{name}"] == {3, 4}, name
    assert shown["difference/map/known"] == shown["difference/map/scale/ticks"] == {3}


def test_the_scale_of_a_map_is_round_and_holds_most_of_it() -> None:
    rng = np.random.default_rng(0)
    for size in (1e-9, 0.003, 1.0, 4.2, 5.0, 7e6):
        signed = (rng.uniform(-size, size, (40, 40))).astype(np.float32)
        span = span_of(signed)
        assert np.mean(np.abs(signed) <= span) >= 0.94
        assert f"{span:e}"[0] in "125" and span <= 2.6 * size
    assert span_of(np.zeros((3, 3), np.float32)) == 1.0

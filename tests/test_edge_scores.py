"""Edges and regions are held against the faces of the truth pixel by pixel, borders included."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from edge_scenes import eight

from workbench.stage import Score
from workbench_stages.edges.score import (
    EdgeScore,
    FaceScore,
    edge_score,
    face_boundaries,
    face_ids,
    region_score,
    summarise,
)
from workbench_stages.edges.scorers import EdgeScorer, RegionScorer

SHAPE = (60, 90)


def painted(*boxes: tuple[int, int, int, int, int], shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """An image of 0 on which boxes (value, first row, row after, first column, column after)."""
    image = np.zeros(shape, np.int32)
    for value, top, bottom, left, right in boxes:
        image[top:bottom, left:right] = value
    return image


def single(rows: int, columns: int, *places: tuple[int, int]) -> np.ndarray:
    image = np.zeros((rows, columns), bool)
    for place in places:
        image[place] = True
    return image


# -- faces and their boundaries -------------------------------------------------------------------


def test_every_pair_of_instance_and_face_has_a_number_of_its_own_and_the_table_none() -> None:
    instances, faces = np.meshgrid(np.arange(256), np.arange(256), indexing="ij")
    ids = face_ids(instances.astype(np.uint8), faces.astype(np.uint8))
    assert (ids[0] == 0).all()
    assert len(np.unique(ids[1:])) == 255 * 256 and (ids[1:] > 0).all()
    np.testing.assert_array_equal(ids[1:] // 65536, instances[1:])
    with pytest.raises(ValueError, match=r"\(2, 3\) and faces \(3, 2\) differ in shape"):
        face_ids(np.zeros((2, 3)), np.zeros((3, 2)))


def test_a_boundary_is_the_pixel_left_of_it_or_above_it() -> None:
    ids = painted((7, 2, 4, 3, 6), shape=(6, 8))
    wanted = single(
        6, 8,
        (1, 3), (1, 4), (1, 5), (3, 3), (3, 4), (3, 5),  # above, and the last row of the face
        (2, 2), (3, 2), (2, 5), (3, 5),
    )  # fmt: skip
    np.testing.assert_array_equal(face_boundaries(ids), wanted)
    assert not face_boundaries(np.full((4, 4), 3)).any()


# -- edges ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("down", "right", "hit"),
    [(0, 0, 1), (2, 0, 1), (0, -2, 1), (3, 0, 0), (0, 3, 0), (1, 1, 1), (-1, 2, 0), (2, 2, 0)],
)
def test_an_edge_is_right_within_two_pixels_by_euclids_distance(
    down: int, right: int, hit: int
) -> None:
    boundary = single(20, 20, (10, 10))
    edge = single(20, 20, (10 + down, 10 + right))
    assert edge_score(edge, boundary) == EdgeScore(1, hit, 1, hit)


def test_precision_is_of_the_edges_and_recall_of_the_boundaries() -> None:
    boundary = painted((1, 0, 60, 30, 31)) > 0
    edge = painted((1, 0, 45, 32, 33), (1, 0, 30, 70, 71)) > 0
    found = edge_score(edge, boundary)
    assert found == EdgeScore(75, 45, 60, 45)  # below the edge's end the nearest lies 2.24 px away
    assert (found.precision, found.recall) == (0.6, 0.75)
    back = edge_score(boundary, edge)
    assert (back.precision, back.recall) == (0.75, 0.6)
    for turned in zip(eight(edge), eight(boundary), strict=True):
        assert edge_score(*turned) == found


def test_the_tolerance_is_the_one_asked_for() -> None:
    boundary, edge = single(20, 20, (10, 10)), single(20, 20, (10, 13))
    assert [edge_score(edge, boundary, t).edge_hit for t in (2.9, 3.0)] == [0, 1]


def test_without_edges_or_boundaries_a_share_is_no_number() -> None:
    nothing, something = single(9, 9), single(9, 9, (4, 4))
    found = edge_score(nothing, something)
    assert math.isnan(found.precision) and found.recall == 0
    found = edge_score(something, nothing)
    assert found.precision == 0 and math.isnan(found.recall)


def test_counts_of_edges_add_up() -> None:
    assert EdgeScore(1, 2, 3, 4) + EdgeScore(10, 20, 30, 40) == EdgeScore(11, 22, 33, 44)


# -- regions against faces ------------------------------------------------------------------------

ONE = 65536 + 1
TWO = 2 * 65536 + 1
ONE_ASIDE = 65536 + 2
"""Another face of the same part as ``ONE``."""


def test_overlap_is_intersection_over_union_with_the_best_region() -> None:
    ids = painted((ONE, 10, 50, 20, 60))
    labels = painted((5, 10, 50, 30, 70), (2, 10, 50, 20, 26))
    found = region_score(labels, ids)
    assert found.face.tolist() == [ONE] and found.area.tolist() == [1600]
    assert found.best_iou.tolist() == [pytest.approx(30 / 50)]
    assert (found.leaks, found.splits) == (0, 0)
    # What is no region is none that could overlap.
    assert region_score(labels * 0, ids).best_iou.tolist() == [0]


@pytest.mark.parametrize(("area", "counts"), [(150, 0), (151, 1)])
def test_faces_of_more_than_150_pixels_count(area: int, counts: int) -> None:
    ids = np.zeros(SHAPE, np.int64)
    ids[10:].flat[:area] = ONE
    assert len(region_score(np.zeros(SHAPE, np.int32), ids).face) == counts
    assert len(region_score(np.zeros(SHAPE, np.int32), ids, min_area=area - 1).face) == 1


def test_without_faces_there_is_nothing_to_find() -> None:
    found = region_score(painted((1, 0, 9, 0, 9)), np.zeros(SHAPE, np.int64))
    assert found.best_iou.size == found.covered.size == found.leaks == found.splits == 0


@pytest.mark.parametrize(
    ("box", "covered"),
    [
        ((10, 50, 20, 60), False),
        ((1, 59, 1, 89), False),
        ((0, 40, 20, 60), True),
        ((20, 60, 20, 60), True),
        ((10, 50, 0, 40), True),
        ((10, 50, 50, 90), True),
    ],
)
def test_a_face_that_the_border_cuts_is_covered(
    box: tuple[int, int, int, int], covered: bool
) -> None:
    ids = painted((ONE, *box))
    depth = np.where(ids, 0.75, 0.79)
    assert region_score(ids * 0, ids, depth).covered.tolist() == [covered]
    assert region_score(ids * 0, ids).covered.tolist() == [covered]


@pytest.mark.parametrize(("higher_mm", "covered"), [(-5.0, 0), (0.9, 0), (1.1, 1), (30.0, 1)])
@pytest.mark.parametrize("turn", range(8))
def test_what_lies_a_millimetre_higher_beside_a_face_covers_it(
    turn: int, higher_mm: float, covered: int
) -> None:
    """On whichever side the other lies; and the one that lies higher is not covered."""
    ids = painted((ONE, 10, 50, 15, 40), (TWO, 10, 50, 40, 70))
    depth = np.where(ids == ONE, 0.760, np.where(ids == TWO, 0.760 - higher_mm / 1e3, 0.79))
    ids, depth = list(eight(ids))[turn], list(eight(depth))[turn]
    assert region_score(ids * 0, ids, depth).covered.tolist() == [covered, higher_mm < -1]
    # Without depth, whatever touches may cover.
    assert region_score(ids * 0, ids).covered.tolist() == [True, True]


def test_a_part_does_not_cover_itself_nor_does_the_table_cover_it() -> None:
    ids = painted((ONE, 10, 50, 15, 40), (ONE_ASIDE, 10, 50, 40, 70))
    depth = np.where(ids == ONE, 0.77, np.where(ids == ONE_ASIDE, 0.74, 0.70))
    assert region_score(ids * 0, ids, depth).covered.tolist() == [False, False]
    assert region_score(ids * 0, ids).covered.tolist() == [False, False]


@pytest.mark.parametrize(("width", "leaks"), [(9, 0), (10, 1)])
def test_a_region_with_a_quarter_of_two_faces_leaks(width: int, leaks: int) -> None:
    ids = painted((ONE, 10, 50, 10, 50), (TWO, 10, 50, 50, 90))
    labels = painted((3, 10, 50, 40, 50 + width))  # 10 of 40 columns of the one face
    assert region_score(labels, ids).leaks == leaks
    assert region_score(labels, ids, share=0.2).leaks == 1


@pytest.mark.parametrize(("width", "leaks"), [(9, 0), (10, 1)])
def test_a_region_with_a_face_and_as_much_of_the_table_leaks(width: int, leaks: int) -> None:
    ids = painted((ONE, 10, 50, 10, 50))
    assert region_score(painted((3, 10, 50, 40, 50 + width)), ids).leaks == leaks
    # The table alone is no leak, nor are two regions of one face.
    assert region_score(painted((3, 10, 50, 55, 85), (4, 10, 50, 10, 25)), ids).leaks == 0


@pytest.mark.parametrize(("first", "splits"), [(9, 0), (10, 1)])
def test_a_face_with_two_regions_of_a_quarter_each_is_split(first: int, splits: int) -> None:
    ids = painted((ONE, 10, 50, 10, 50))
    labels = painted((1, 10, 50, 10, 10 + first), (2, 10, 50, 30, 45))
    assert region_score(labels, ids).splits == splits
    assert region_score(labels, ids, share=0.2).splits == 1


@pytest.mark.parametrize(("beyond", "splits"), [(15, 1), (16, 0)])
def test_only_a_region_that_lies_mostly_in_a_face_splits_it(beyond: int, splits: int) -> None:
    ids = painted((ONE, 10, 50, 10, 50))
    labels = painted((1, 10, 50, 10, 25), (2, 10, 50, 35, 50 + beyond))
    assert region_score(labels, ids).splits == splits


def frame_score(iou: list[float], covered: list[bool], leaks: int, splits: int) -> FaceScore:
    count = len(iou)
    return FaceScore(
        np.arange(count), np.full(count, 200), np.array(iou), np.array(covered, bool), leaks, splits
    )


def test_figures_over_frames_weigh_every_face_alike() -> None:
    frames = [
        frame_score([0.7, 0.69, 1.0, 0.0], [False, False, True, True], 2, 1),
        frame_score([0.9], [False], 3, 4),
        frame_score([], [], 5, 0),
    ]
    assert summarise(frames) == {
        "faces": 5,
        "found": pytest.approx(3 / 5),
        "mean_iou": pytest.approx(3.29 / 5),
        "uncovered": 3,
        "uncovered_found": pytest.approx(2 / 3),
        "uncovered_mean_iou": pytest.approx(2.29 / 3),
        "leaks": 10,
        "splits": 5,
    }
    assert summarise(frames, found_iou=0.95)["found"] == pytest.approx(1 / 5)


@pytest.mark.parametrize("frames", [[], [frame_score([], [], 0, 0)]])
def test_figures_of_nothing_are_no_numbers(frames: list[FaceScore]) -> None:
    found = summarise(frames)
    assert found["faces"] == found["uncovered"] == found["leaks"] == found["splits"] == 0
    for name in ("found", "mean_iou", "uncovered_found", "uncovered_mean_iou"):
        assert math.isnan(found[name])


# -- the scorers ----------------------------------------------------------------------------------


def truth_of(instances: np.ndarray, faces: np.ndarray | None = None, **meta: Any) -> Any:
    return SimpleNamespace(
        instances=instances.astype(np.uint8),
        faces=(np.ones_like(instances) if faces is None else faces).astype(np.uint8),
        depth_m=np.where(instances, 0.79 - 0.01 * instances, 0.79).astype(np.float32),
        meta=meta,
    )


def by_name(scores: list[Score]) -> dict[str, Score]:
    return {one.name: one for one in scores}


WALL = truth_of(painted((1, 0, 60, 40, 90)))
"""A truth with one upright boundary, at column 39."""


def lines(*columns: int, rows: int = 60) -> np.ndarray:
    image = np.zeros(SHAPE, bool)
    image[:rows, list(columns)] = True
    return image


def edge_scorer() -> EdgeScorer:
    return EdgeScorer({"edges_high": "before linking", "edges_linked": "linked"})


def test_edges_are_scored_at_two_pixels_and_each_image_by_itself() -> None:
    scorer = edge_scorer()
    own = scorer.add(WALL, {"edges_high": lines(41, 42), "edges_linked": lines(37, 10, 20)})
    assert own == {
        "before_linking_precision": 0.5,
        "before_linking_recall": 1,
        "linked_precision": pytest.approx(1 / 3),
        "linked_recall": 1,
    }
    own = scorer.add(WALL, {"edges_high": lines(42, rows=30), "edges_linked": lines(39, rows=30)})
    assert own["before_linking_recall"] == 0 and own["linked_recall"] == 32 / 60
    found = by_name(scorer.summary())
    assert list(found) == [
        "before linking, precision",
        "before linking, recall",
        "linked, precision",
        "linked, recall",
    ]
    assert found["before linking, precision"].value == pytest.approx(60 / 150)
    assert found["before linking, recall"].value == pytest.approx(60 / 120)
    assert found["linked, precision"].value == pytest.approx(90 / 210)
    assert found["linked, recall"].value == pytest.approx(92 / 120)
    for one in found.values():
        assert (one.note, one.better, one.unit) == ("±2 px of face boundaries", "higher", "")


def test_regions_are_scored_over_the_faces_of_every_frame() -> None:
    instances = painted((1, 10, 50, 10, 40), (2, 10, 50, 40, 70))
    truth = truth_of(instances)  # the second lies higher, and covers the first
    scorer = RegionScorer()
    own = scorer.add(truth, {"labels": painted((1, 10, 50, 10, 40), (2, 10, 50, 40, 60))})
    assert own == {"faces_found": 0.5, "mean_iou": pytest.approx(5 / 6)}
    scorer.add(truth, {"labels": painted((1, 10, 50, 10, 70))})
    found = by_name(scorer.summary())
    values = {name: one.value for name, one in found.items()}
    assert values == {
        "faces found (IoU ≥ 0.7)": pytest.approx(1 / 4),
        "mean IoU": pytest.approx((1 + 2 / 3 + 1 / 2 + 1 / 2) / 4),
        "uncovered faces found": 0,
        "uncovered mean IoU": pytest.approx((2 / 3 + 1 / 2) / 2),
        "leaks": 1,
        "splits": 0,
    }
    assert found["mean IoU"].note == found["faces found (IoU ≥ 0.7)"].note == "4 faces over 150 px"
    assert found["uncovered mean IoU"].note == "2 faces that nothing covers"
    assert found["uncovered faces found"].note == "2 faces that nothing covers"
    assert [one.better for one in found.values()] == ["higher"] * 4 + ["lower"] * 2
    assert [one.unit for one in found.values()] == [""] * 4 + ["regions", "faces"]


def test_faces_are_scored_from_151_pixels_and_as_found_from_seven_tenths() -> None:
    scorer = RegionScorer()
    truth = truth_of(painted((1, 10, 20, 10, 25), (2, 30, 50, 10, 60)))  # 150 and 1000 pixels
    labels = painted((1, 30, 50, 10, 45), (2, 10, 20, 10, 25))
    assert scorer.add(truth, {"labels": labels}) == {
        "faces_found": 1.0,
        "mean_iou": pytest.approx(0.7),
    }
    assert by_name(scorer.summary())["mean IoU"].note == "1 faces over 150 px"
    assert RegionScorer().summary() == []


def test_a_frame_of_small_faces_alone_has_no_figures_of_its_own() -> None:
    scorer = RegionScorer()
    truth = truth_of(painted((1, 10, 20, 10, 25)))
    assert scorer.add(truth, {"labels": painted((1, 10, 20, 10, 25))}) == {}
    found = by_name(scorer.summary())
    assert math.isnan(found["mean IoU"].value) and found["leaks"].value == 0


def test_what_is_covered_is_told_by_the_depth_of_the_truth() -> None:
    truth = truth_of(painted((1, 10, 50, 10, 40), (2, 10, 50, 40, 70)))
    for depth_m, free in ((truth.depth_m, 1), (truth.depth_m * 0 + 0.7, 2), (None, 0)):
        scorer = RegionScorer()
        truth.depth_m = depth_m
        scorer.add(truth, {"labels": truth.instances})
        note = f"{free} faces that nothing covers"
        assert by_name(scorer.summary())["uncovered mean IoU"].note == note


@pytest.mark.parametrize("lacks", ["instances", "faces", "no grid", "size", "parts", "boundary"])
def test_truth_without_faces_is_skipped(lacks: str) -> None:
    truth = truth_of(painted((1, 10, 50, 10, 40)))
    if lacks in ("instances", "faces"):
        setattr(truth, lacks, None)
    elif lacks == "no grid":
        truth.meta = {"kind": "grid"}
    elif lacks == "size":
        truth = truth_of(painted((1, 10, 50, 10, 40), shape=(60, 91)))
    elif lacks == "parts":
        truth = truth_of(painted(), painted((1, 10, 50, 10, 40)))
    else:
        truth = truth_of(painted() + 1)
    edges, regions = edge_scorer(), RegionScorer()
    image = lines(30)
    assert edges.add(truth, {"edges_high": image, "edges_linked": image}) == {}
    assert regions.add(truth, {"labels": image.astype(np.int32)}) == {}
    assert edges.summary() == regions.summary() == []


def test_one_part_with_two_faces_and_no_table_has_a_boundary() -> None:
    truth = truth_of(painted() + 1, painted((1, 0, 60, 0, 45)))
    scorer = edge_scorer()
    image = lines(44)
    assert scorer.add(truth, {"edges_high": image, "edges_linked": image})["linked_precision"] == 1


def test_scorers_put_together_tell_what_one_tells_of_all_frames() -> None:
    rng = np.random.default_rng(2)
    truth = truth_of(painted((1, 10, 50, 10, 40), (2, 10, 50, 40, 70)))
    frames = [
        {
            "edges_high": rng.random(SHAPE) < 0.1,
            "edges_linked": rng.random(SHAPE) < 0.2,
            "labels": np.maximum(truth.instances - (rng.random(SHAPE) < 0.1 * k), 0).astype(int),
        }
        for k in range(1, 4)
    ]
    for make in (edge_scorer, RegionScorer):
        one, first, second, together = make(), make(), make(), make()
        for frame, part in zip(frames, (first, second, second), strict=True):
            one.add(truth, frame)
            part.add(truth, frame)
        for part in (first, make(), second):
            together.take(part.state())
        assert together.summary() == one.summary() and len(one.summary()) >= 4

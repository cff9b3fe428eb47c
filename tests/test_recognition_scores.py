"""Verdicts and poses are scored to the figure: covered picks, names, shares, angles, signs."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from edge_scenes import eight

from workbench.stage import Score
from workbench_stages.edges.planes import Camera
from workbench_stages.matching.scorers import (
    PoseScorer,
    RecognitionScorer,
    covered_px,
    rotation_error_deg,
    truth_of_surface,
)
from workbench_stages.matching.surfaces import camera_from_surface

FX, FY, CX, CY = 1300.0, 1000.0, 45.0, 28.0
K = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1.0]])
RECORDED = SimpleNamespace(K=K)
CAMERA = Camera(FX, FY, CX, CY)
SHAPE = (60, 90)
TABLE_M = 0.79
UP = np.diag([1.0, -1.0, -1.0])
"""camera_from_object of a part that lies as in training, at angle 0."""


def turn(axis: str, degrees: float) -> np.ndarray:
    """A right-handed turn about an axis of the camera."""
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    out = np.eye(3)
    out[i, i] = out[j, j] = c
    out[i, j], out[j, i] = -s, s
    return out


def by_name(scores: list[Score]) -> dict[str, Score]:
    return {one.name: one for one in scores}


class Pile:
    """Boxes of one face each; ``truth`` as a recording tells it, labels = 10 × instance."""

    def __init__(self) -> None:
        self.instances = np.zeros(SHAPE, np.uint8)
        self.faces = np.zeros(SHAPE, np.uint8)
        self.depth_m = np.full(SHAPE, TABLE_M)
        self.names: dict[int, str] = {}
        self.rotations: dict[str, np.ndarray] = {}

    def add(
        self,
        own: int,
        name: str,
        box: tuple[int, int, int, int],
        z_m: float = 0.77,
        rotation: np.ndarray = UP,
        normal: np.ndarray | None = None,
        face: int = 1,
    ) -> None:
        top, bottom, left, right = box
        here = (slice(top, bottom), slice(left, right))
        self.instances[here], self.faces[here] = own, face
        rows, columns = np.mgrid[top:bottom, left:right]
        n = np.array([0, 0, -1.0]) if normal is None else normal
        slant = n[0] * (columns - CX) / FX + n[1] * (rows - CY) / FY + n[2]
        self.depth_m[here] = n[2] * z_m / slant
        self.names[own] = name
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        self.rotations[f"object_{own}_{name}"] = matrix

    @property
    def truth(self) -> Any:
        return SimpleNamespace(
            instances=self.instances,
            faces=self.faces,
            depth_m=self.depth_m.astype(np.float32),
            camera_from_object=self.rotations,
            meta={"objects": [{"id": own, "name": name} for own, name in self.names.items()]},
        )

    @property
    def labels(self) -> np.ndarray:
        return self.instances.astype(np.int32) * 10


# -- what covers ----------------------------------------------------------------------------------


@pytest.mark.parametrize("which", range(8))
def test_covered_pixels_are_those_beside_a_part_that_is_a_millimetre_nearer(which: int) -> None:
    instances = np.zeros((20, 24), np.uint8)
    instances[4:16, 5:12] = 1
    instances[6:13, 12:20] = 2
    for nearer_mm, wanted in ((1.1, (7, 0)), (0.9, (0, 0)), (-1.1, (0, 7)), (20, (7, 0))):
        depth_m = np.where(instances == 1, 0.77, np.where(instances, 0.77 - nearer_mm / 1e3, 0.5))
        a, z = list(eight(instances))[which], list(eight(depth_m))[which]
        assert (covered_px(a, z, 1), covered_px(a, z, 2)) == wanted
    assert covered_px(instances, depth_m, 3) == 0


# -- verdicts -------------------------------------------------------------------------------------


def judged(pile: Pile, verdict: dict[str, Any] | None, **other: Any) -> dict[str, Any]:
    return {
        "verdict": verdict,
        "labels": pile.labels,
        "near_camera": RECORDED,
        "models": None,
        "candidates": np.zeros(0, [("label", int)]),
    } | other


def pick(region: int, name: str) -> dict[str, Any]:
    return {"verdict": "pick", "region": region, "object": name}


REARRANGE = {"verdict": "rearrange", "region": None, "object": None}


def beside(touching: int, nearer_m: float = 0.01) -> Pile:
    """A plate, and an ell that overlooks so many pixels of its border."""
    pile = Pile()
    pile.add(1, "plate", (5, 45, 10, 40))
    pile.add(2, "ell", (5, 5 + touching, 40, 70), 0.77 - nearer_m)
    return pile


@pytest.mark.parametrize(
    ("touching", "region", "name", "own"),
    [
        (9, 10, "plate", (1, 0)),
        (10, 10, "plate", (0, 0)),
        (30, 20, "ell", (1, 0)),
        (30, 20, "plate", (0, 1)),
        (30, 10, "ell", (0, 1)),
    ],
)
def test_a_pick_is_good_if_nothing_covers_it_and_its_name_is_right(
    touching: int, region: int, name: str, own: tuple[int, int]
) -> None:
    pile, scorer = beside(touching), RecognitionScorer()
    found = scorer.add(pile.truth, judged(pile, pick(region, name)))
    assert found == {"good_pick": own[0], "wrong_name": own[1]}
    scores = by_name(scorer.summary())
    assert scores["picked part uncovered and named rightly"].value == own[0]
    assert scores["named rightly"].value == 1 - own[1]
    assert scores["wrong names"].value == own[1]
    assert scores["rearrange"].value == 0


def test_without_true_depth_a_pick_is_taken_for_uncovered() -> None:
    pile = beside(30)
    truth = pile.truth
    truth.depth_m = None
    found = RecognitionScorer().add(truth, judged(pile, pick(10, "plate")))
    assert found == {"good_pick": 1, "wrong_name": 0}


def test_a_region_belongs_to_the_part_that_most_of_it_shows() -> None:
    pile = beside(0)
    labels = np.zeros(SHAPE, np.int32)
    labels[5:45, 26:51] = 7  # 14 columns of the plate, 11 of the table
    artifacts = judged(pile, pick(7, "plate"), labels=labels)
    assert RecognitionScorer().add(pile.truth, artifacts)["good_pick"] == 1
    labels[5:45, 51:60] = 7
    assert RecognitionScorer().add(pile.truth, artifacts)["wrong_name"] == 1


def test_verdicts_are_counted_over_frames() -> None:
    covered, free = beside(30), beside(9)
    scorer = RecognitionScorer()
    own = [
        scorer.add(pile.truth, judged(pile, verdict))
        for pile, verdict in (
            (free, pick(10, "plate")),
            (covered, pick(10, "plate")),
            (free, pick(10, "ell")),
            (free, REARRANGE),
            (free, pick(20, "ell")),
        )
    ]
    assert own[3] == {"good_pick": 0, "wrong_name": 0}
    scores = scorer.summary()
    assert [(s.name, s.value, s.unit, s.note, s.better) for s in scores] == [
        ("picked part uncovered and named rightly", 2 / 5, "", "of 5 frames", "higher"),
        ("named rightly", 3 / 5, "", "of 5 frames", "higher"),
        ("wrong names", 1.0, "frames", "of 5 frames", "lower"),
        ("rearrange", 1.0, "frames", "of 5 frames", "lower"),
    ]


@pytest.mark.parametrize("lacks", ["verdict", "instances", "objects", "a list", "ids"])
def test_a_frame_without_verdict_or_names_is_skipped(lacks: str) -> None:
    pile = beside(3)
    truth, verdict = pile.truth, None if lacks == "verdict" else pick(10, "plate")
    if lacks == "instances":
        truth.instances = None
    elif lacks == "objects":
        truth.meta = {}
    elif lacks == "a list":
        truth.meta = {"objects": "plate"}
    elif lacks == "ids":
        truth.meta = {"objects": [{"name": "plate"}, {"id": 2}]}
    scorer = RecognitionScorer()
    assert scorer.add(truth, judged(pile, verdict)) == {}
    assert scorer.summary() == []


# -- recognition as occlusion grows ---------------------------------------------------------------

PIXEL_MM2 = 1e6 * 0.77**2 / (FX * FY)
"""What a pixel shows of a face that lies at 0.77 m and faces the camera."""
AREA_MM2 = 40 * 30 * PIXEL_MM2


def database_of(phi: float = 1.0, **whole_mm2: float) -> Any:
    """Models of parts whose training views had these areas in the median."""
    return SimpleNamespace(
        names=list(whole_mm2),
        phi=phi,
        parts=[
            SimpleNamespace(features=np.array([[0.5 * area, 9], [area, 8], [7 * area, 7.0]]))
            for area in whole_mm2.values()
        ],
    )


def candidate(label: int, distance: float, model: int, visible_model: int = -1) -> np.ndarray:
    row = (label, distance, model, visible_model)
    names = ("label", "distance", "model", "visible_model")
    return np.array([(99, 0.0, 1, 1), row], list(zip(names, (int, float, int, int), strict=True)))


def recognised(pile: Pile, database: Any, candidates: np.ndarray, **other: Any) -> list[Score]:
    scorer = RecognitionScorer()
    scorer.add(
        pile.truth,
        judged(pile, REARRANGE, models=database, candidates=candidates, **other),
    )
    return [one for one in scorer.summary() if one.name.startswith("recognised")]


def plate(**how: Any) -> Pile:
    pile = Pile()
    pile.add(1, "plate", (5, 45, 10, 40), **how)
    return pile


@pytest.mark.parametrize(
    ("covered", "bin_", "published"),
    [
        (-0.09, "0 to 5 %", "recognised"),
        (0.0, "0 to 5 %", "recognised"),
        (0.049, "0 to 5 %", "recognised"),
        (0.051, "5 to 10 %", "recognised"),
        (0.099, "5 to 10 %", "recognised"),
        (0.101, "10 to 20 %", "recognised"),
        (0.199, "10 to 20 %", "recognised"),
        (0.201, "20 to 35 %", "not promised"),
        (0.349, "20 to 35 %", "not promised"),
        (0.351, "35 to 60 %", "not promised"),
        (0.599, "35 to 60 %", "not promised"),
        (0.601, "60 to 100 %", "not promised"),
        (0.95, "60 to 100 %", "not promised"),
    ],
)
def test_what_is_covered_is_what_lacks_of_the_trained_area(
    covered: float, bin_: str, published: str
) -> None:
    database = database_of(ell=7.0, plate=AREA_MM2 / (1 - covered))
    (one,) = recognised(plate(), database, candidate(10, 0.5, 1))
    assert one == Score(
        f"recognised, {bin_} covered",
        1.0,
        note="of 1 surfaces; 0 misnamed",
        better="higher",
        published=published,
    )


@pytest.mark.parametrize(("larger", "counts"), [(1.09, 1), (1.11, 0)])
def test_a_face_that_is_larger_than_the_trained_one_is_another(larger: float, counts: int) -> None:
    database = database_of(plate=AREA_MM2 / larger)
    assert len(recognised(plate(), database, candidate(10, 0.5, 0))) == counts


@pytest.mark.parametrize(
    ("candidates", "right", "misnamed"),
    [
        (candidate(10, 1.0, 0), 1, 0),  # at φ itself the features do
        (candidate(10, 1.0, 1), 0, 1),
        (candidate(10, 1.01, 0), 0, 0),
        (candidate(10, 1.01, 1, visible_model=0), 1, 0),
        (candidate(10, 1.01, 0, visible_model=1), 0, 1),
        (candidate(10, 0.5, 1, visible_model=0), 0, 1),
        (candidate(20, 0.5, 0), 0, 0),
    ],
)
def test_a_surface_is_recognised_by_features_or_by_what_shows(
    candidates: np.ndarray, right: int, misnamed: int
) -> None:
    database = database_of(plate=AREA_MM2, ell=1.0)
    (one,) = recognised(plate(), database, candidates)
    assert (one.value, one.note) == (right, f"of 1 surfaces; {misnamed} misnamed")


@pytest.mark.parametrize(("columns", "right"), [(14, 1), (16, 0)])
def test_a_surface_that_shows_mostly_no_region_is_not_recognised(columns: int, right: int) -> None:
    pile, candidates = plate(), candidate(10, 0.5, 0)
    candidates["label"][0] = 0  # no region is no candidate, whatever is said of it
    labels = pile.labels.copy()
    labels[5:45, 10 : 10 + columns] = 0
    (one,) = recognised(pile, database_of(plate=AREA_MM2), candidates, labels=labels)
    assert (one.value, one.note) == (right, "of 1 surfaces; 0 misnamed")


@pytest.mark.parametrize(("tilt", "counts"), [(0.0, 1), (25.0, 1), (-25.0, 1), (26.0, 0), (70, 0)])
def test_surfaces_that_lie_as_in_training_are_looked_up_to_25_degrees(
    tilt: float, counts: int
) -> None:
    leaned = turn("y", tilt)
    pile = plate(rotation=leaned @ UP, normal=leaned @ np.array([0, 0, -1.0]))
    # A leaned face shows as much of itself as its cosine.
    database = database_of(plate=1.02 * AREA_MM2 / math.cos(math.radians(tilt)))
    found = recognised(pile, database, candidate(10, 0.5, 0))
    assert len(found) == counts
    if counts:
        assert found[0].name == "recognised, 0 to 5 % covered"


def test_a_part_on_its_back_shows_the_opposite_face() -> None:
    pile = plate(rotation=turn("x", 180) @ UP)
    assert len(recognised(pile, database_of(plate=AREA_MM2), candidate(10, 0.5, 0))) == 1
    on_end = plate(rotation=turn("x", 90) @ UP)
    assert recognised(on_end, database_of(plate=AREA_MM2), candidate(10, 0.5, 0)) == []


@pytest.mark.parametrize("lacks", ["models", "camera", "faces", "depth", "training", "rotation"])
def test_surfaces_need_truth_and_training(lacks: str) -> None:
    pile, database = plate(), database_of(plate=AREA_MM2)
    truth, camera = pile.truth, RECORDED
    if lacks == "models":
        database = None
    elif lacks == "camera":
        camera = None
    elif lacks == "faces":
        truth.faces = None
    elif lacks == "depth":
        truth.depth_m = None
    elif lacks == "training":
        database = database_of(ell=AREA_MM2)
    else:
        truth.camera_from_object = {}
    scorer = RecognitionScorer()
    own = scorer.add(
        truth,
        judged(
            pile, pick(10, "plate"), models=database, candidates=candidate(10, 0.5, 0),
            near_camera=camera,
        ),
    )  # fmt: skip
    assert own["wrong_name"] == 0
    assert len(scorer.summary()) == 4


def test_parts_before_one_that_cannot_be_looked_up_hide_it_not() -> None:
    pile = Pile()
    pile.add(1, "stranger", (0, 10, 0, 10))
    pile.add(2, "plate", (20, 30, 0, 30), rotation=turn("x", 90) @ UP)
    pile.add(3, "plate", (40, 60, 0, 60), 0.77)  # as large as AREA_MM2
    pile.add(4, "ell", (0, 30, 45, 85), 0.77)  # larger than it was trained
    pile.add(5, "plate", (0, 20, 10, 40), 0.77)  # half of a plate
    database = database_of(plate=AREA_MM2, ell=AREA_MM2 / 2)
    found = by_name(recognised(pile, database, candidate(30, 0.2, 0)))
    assert {name: (one.value, one.note) for name, one in found.items()} == {
        "recognised, 0 to 5 % covered": (1, "of 1 surfaces; 0 misnamed"),
        "recognised, 35 to 60 % covered": (0, "of 1 surfaces; 0 misnamed"),
    }


def test_verdict_scorers_put_together_tell_what_one_tells_of_all_frames() -> None:
    database = database_of(plate=AREA_MM2 / 0.7, ell=1e6)
    covered = beside(30)
    frames = [
        judged(covered, verdict, models=database, candidates=candidates)
        for verdict, candidates in (
            (pick(10, "plate"), candidate(10, 0.5, 0)),
            (pick(20, "plate"), candidate(10, 0.5, 1)),
            (REARRANGE, candidate(20, 0.5, 1)),
            (pick(20, "ell"), candidate(10, 2.5, 1)),
        )
    ]
    one, parts = RecognitionScorer(), [RecognitionScorer() for _ in range(3)]
    for frame, part in zip(frames, (0, 2, 2, 2), strict=True):
        one.add(covered.truth, frame)
        parts[part].add(covered.truth, frame)
    together = RecognitionScorer()
    for part in parts:
        together.take(part.state())
    assert together.summary() == one.summary()
    assert {s.name: s.note for s in one.summary()}["recognised, 20 to 35 % covered"] == (
        "of 4 surfaces; 1 misnamed"
    )


# -- the surface of the truth ---------------------------------------------------------------------


def test_the_true_face_is_that_which_most_of_a_region_shows_of_its_part() -> None:
    pile = Pile()
    pile.add(1, "plate", (5, 45, 10, 40), 0.77, face=3)
    pile.add(1, "plate", (5, 45, 40, 60), 0.75, face=4)
    pile.add(2, "ell", (5, 45, 60, 90), 0.76, rotation=turn("z", 30) @ UP)
    labels = np.zeros(SHAPE, np.int32)
    labels[5:45, 35:60] = 9
    labels[5:45, 60:65] = 9
    known = truth_of_surface(pile.truth, labels, 9, CAMERA)
    assert known is not None
    face, rotation = known
    np.testing.assert_array_equal(face.mask, pile.faces == 4)
    np.testing.assert_allclose(rotation, UP)
    np.testing.assert_allclose(face.normal, [0, 0, -1], atol=1e-6)
    z = 0.75
    middle = [(49.5 - CX) / FX * z, (24.5 - CY) / FY * z, z]
    np.testing.assert_allclose(face.centroid_m, middle, atol=1e-7)
    assert face.area_mm2 == pytest.approx(40 * 20 * 1e6 * z**2 / (FX * FY), rel=1e-5)
    labels[labels > 0] = 0
    labels[5:45, 70:80] = 9
    known = truth_of_surface(pile.truth, labels, 9, CAMERA)
    assert known is not None
    np.testing.assert_allclose(known[1], turn("z", 30) @ UP)


def test_a_leaned_face_has_its_own_area_and_centroid() -> None:
    """Of a plane that leans by 40°, a pixel shows z² / (f² |n · ray|)."""
    normal = turn("y", 40) @ np.array([0, 0, -1.0])
    pile = plate(normal=normal)
    known = truth_of_surface(pile.truth, pile.labels, 10, CAMERA)
    assert known is not None
    rows, columns = np.mgrid[5:45, 10:40].astype(float)

    # The corners of every pixel on the plane give its area, by the cross product.
    def on_plane(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ray = np.stack([(x - CX) / FX, (y - CY) / FY, np.ones_like(x)], -1)
        return ray * (normal[2] * 0.77 / (ray @ normal))[..., None]

    corner = on_plane(columns - 0.5, rows - 0.5)
    right = on_plane(columns + 0.5, rows - 0.5) - corner
    down = on_plane(columns - 0.5, rows + 0.5) - corner
    area = np.linalg.norm(np.cross(right, down), axis=-1)
    assert known[0].area_mm2 == pytest.approx(1e6 * area.sum(), rel=2e-3)
    centre = (area[..., None] * on_plane(columns, rows)).sum((0, 1)) / area.sum()
    np.testing.assert_allclose(known[0].centroid_m, centre, atol=1e-5)
    np.testing.assert_allclose(known[0].normal, normal, atol=1e-4)


@pytest.mark.parametrize("lacks", ["instances", "faces", "depth_m", "part", "plane"])
def test_a_region_without_truth_has_no_surface(lacks: str) -> None:
    pile = plate()
    truth, labels = pile.truth, pile.labels
    if lacks == "part":
        labels = (labels == 0).astype(np.int32) * 10
    elif lacks == "plane":
        truth.depth_m = truth.depth_m * 0
    else:
        setattr(truth, lacks, None)
    assert truth_of_surface(truth, labels, 10, CAMERA) is None


def test_a_part_without_a_transform_has_a_face_and_no_rotation() -> None:
    pile = plate()
    pile.rotations["object_11_plate"] = pile.rotations.pop("object_1_plate")
    known = truth_of_surface(pile.truth, pile.labels, 10, CAMERA)
    assert known is not None and known[1] is None


# -- poses ----------------------------------------------------------------------------------------

CENTROID = np.array([(24.5 - CX) / FX, (24.5 - CY) / FY, 1.0]) * 0.77
FACING = np.array([0, 0, -1.0])


def pose_of(matrix: np.ndarray, region: int = 10, name: str = "plate", **other: Any) -> Any:
    return {
        "object": name,
        "region": region,
        "mirrored": False,
        "period_deg": 360.0,
        "open_rotations_deg": [],
        "camera_from_surface": matrix.tolist(),
    } | other


def placed(origin: np.ndarray = CENTROID, normal: np.ndarray = FACING, turned: float = 0.0) -> Any:
    return camera_from_surface(origin, normal, turned)


def scored(
    pile: Pile, *poses: Any, scorer: PoseScorer | None = None
) -> tuple[dict[str, float], dict[str, Score]]:
    scorer = scorer or PoseScorer()
    artifacts = {"near_camera": RECORDED, "labels": pile.labels, "poses": list(poses)}
    return scorer.add(pile.truth, artifacts), by_name(scorer.summary())


def test_the_true_pose_has_no_error() -> None:
    own, scores = scored(plate(), pose_of(placed()))
    assert own == {
        "normal_error_deg": pytest.approx(0, abs=0.02),
        "along_axis_error_mm": pytest.approx(0, abs=1e-3),
        "across_error_px": pytest.approx(0, abs=1e-3),
        "rotation_error_deg": pytest.approx(0, abs=1e-6),
    }
    assert scores["rotation, flat, worst error"].value == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("off_mm", [3.0, -2.0])
def test_an_error_along_the_axis_is_in_millimetres_and_none_across(off_mm: float) -> None:
    along = CENTROID * (CENTROID[2] + off_mm / 1e3) / CENTROID[2]
    own, _ = scored(plate(), pose_of(placed(along)))
    assert own["along_axis_error_mm"] == pytest.approx(abs(off_mm), abs=1e-3)
    assert own["across_error_px"] == pytest.approx(0, abs=1e-3)


def test_an_error_across_the_axis_is_in_pixels_of_either_focal_length() -> None:
    for off_px in ((3.0, 0.0), (0.0, -2.0), (3.0, 4.0)):
        off = np.array([off_px[0] / FX, off_px[1] / FY, 0]) * 0.77
        own, _ = scored(plate(), pose_of(placed(CENTROID + off)))
        assert own["across_error_px"] == pytest.approx(math.hypot(*off_px), abs=1e-3)
        assert own["along_axis_error_mm"] == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(("axis", "degrees"), [("x", 5.0), ("y", -12.0)])
def test_the_error_of_a_normal_is_the_angle_between_both(axis: str, degrees: float) -> None:
    own, _ = scored(plate(), pose_of(placed(normal=turn(axis, degrees) @ FACING)))
    assert own["normal_error_deg"] == pytest.approx(abs(degrees), abs=0.02)


@pytest.mark.parametrize(
    ("period", "turned", "error"),
    [
        (360, 10, 10), (360, -10, 10), (360, 179, 179), (360, 200, 160),
        (180, 100, 80), (180, 170, 10), (180, -89, 89), (180, 91, 89),
        (90, 50, 40), (90, 44, 44), (120, 61, 59), (60, 355, 5),
    ],
)  # fmt: skip
def test_rotation_errs_by_the_shorter_way_modulo_the_parts_period(
    period: float, turned: float, error: float
) -> None:
    for at in (0.0, 75.0):  # a part is turned counter-clockwise, as it is displayed
        pile = plate(rotation=turn("z", -at) @ UP)
        pose = pose_of(placed(turned=at + turned), period_deg=float(period))
        own, scores = scored(pile, pose)
        assert own["rotation_error_deg"] == pytest.approx(error, abs=1e-4)
        assert scores["rotation of plate, mean error"].value == pytest.approx(error, abs=1e-4)
        assert scores["rotation of plate, mean error"].note == f"modulo {period}°"


@pytest.mark.parametrize(
    ("tilt", "said", "published"),
    [
        (0.0, "flat", "7.6 (2.1 % of a turn)"),
        (2.9, "flat", "7.6 (2.1 % of a turn)"),
        (3.1, "tilted up to 25°", "7.6 (2.1 % of a turn)"),
        (25.4, "tilted up to 25°", "7.6 (2.1 % of a turn)"),
        (25.6, "tilted farther", "not promised"),
        (55.0, "tilted farther", "not promised"),
    ],
)
def test_rotations_are_told_by_how_far_the_part_leans(
    tilt: float, said: str, published: str
) -> None:
    leaned = turn("x", tilt)
    pile = plate(rotation=leaned @ UP, normal=leaned @ FACING)
    own, scores = scored(pile, pose_of(placed(normal=leaned @ FACING, turned=6.0)))
    assert own["rotation_error_deg"] == pytest.approx(6, abs=0.1)
    for kind in ("mean", "worst"):
        one = scores[f"rotation, {said}, {kind} error"]
        assert one.value == pytest.approx(6, abs=0.1)
        assert (one.unit, one.better, one.published) == ("°", "lower", published)
    assert [name for name in scores if name.startswith("rotation, ")] == [
        "rotation, mean error",
        "rotation, worst error",
        f"rotation, {said}, mean error",
        f"rotation, {said}, worst error",
    ]


def test_rotation_has_no_truth_for_another_face_a_mirrored_part_or_no_transform() -> None:
    pose = pose_of(placed())
    assert rotation_error_deg(placed()[:3, :3], FACING, UP, pose) == (0, pytest.approx(0, abs=1e-6))
    assert rotation_error_deg(placed()[:3, :3], FACING, None, pose) is None
    assert rotation_error_deg(placed()[:3, :3], FACING, UP, {**pose, "mirrored": True}) is None
    for tilt, known in ((59.0, True), (61.0, False)):
        # The part lies as in training, but the face that is seen leans away from above.
        normal = turn("x", tilt) @ FACING
        found = rotation_error_deg(placed(normal=normal)[:3, :3], normal, UP, pose)
        assert (found is not None) == known
    # Its frame is that face's own, and carries the turn.
    leaned = turn("x", 40) @ FACING
    found = rotation_error_deg(placed(normal=leaned, turned=-35)[:3, :3], leaned, UP, pose)
    assert found == (0, pytest.approx(35, abs=1e-6))
    upside_down = turn("x", 180) @ UP
    found = rotation_error_deg(placed(turned=7)[:3, :3], FACING, upside_down, pose)
    assert found == (0, pytest.approx(7, abs=1e-6))


def test_errors_of_poses_have_means_worsts_and_shares() -> None:
    pile = Pile()
    pile.add(1, "plate", (5, 45, 10, 40))
    pile.add(2, "ell", (5, 45, 50, 80))
    ell = np.array([(64.5 - CX) / FX, (24.5 - CY) / FY, 1.0]) * 0.77

    def ell_pose(turned: float, **other: Any) -> Any:
        return pose_of(placed(ell, turned=turned), 20, "ell", **other)

    scorer = PoseScorer()
    scored(pile, pose_of(placed(turned=2), period_deg=180.0), ell_pose(-6), scorer=scorer)
    scored(pile, pose_of(placed(turned=4), period_deg=180.0), scorer=scorer)
    scored(pile, ell_pose(30, open_rotations_deg=[0.0, 180.0]), scorer=scorer)
    scored(pile, ell_pose(50, mirrored=True), scorer=scorer)
    _, scores = scored(pile, scorer=scorer)
    told = {
        name: (round(one.value, 3), one.coverage, one.note)
        for name, one in scores.items()
        if name.startswith("rotation")
    }
    assert told == {
        "rotation left open": (1, None, "of 5 poses"),
        "rotation, mean error": (4, 3 / 5, "modulo each part's period"),
        "rotation, worst error": (6, 3 / 5, "modulo each part's period"),
        "rotation, flat, mean error": (4, 3 / 5, "modulo each part's period"),
        "rotation, flat, worst error": (6, 3 / 5, "modulo each part's period"),
        "rotation of ell, mean error": (6, 1 / 5, "modulo 360°"),
        "rotation of ell, worst error": (6, 1 / 5, "modulo 360°"),
        "rotation of plate, mean error": (3, 2 / 5, "modulo 180°"),
        "rotation of plate, worst error": (4, 2 / 5, "modulo 180°"),
    }
    assert scores["rotation left open"].unit == "poses"
    assert scores["rotation left open"].better == "lower"


def test_errors_of_place_and_normal_have_their_units() -> None:
    scorer = PoseScorer()
    for off_mm, lean in ((1.0, 2.0), (-4.0, -8.0)):
        origin = CENTROID * (CENTROID[2] + off_mm / 1e3) / CENTROID[2]
        _, scores = scored(
            plate(), pose_of(placed(origin, turn("x", lean) @ FACING)), scorer=scorer
        )
    for title, mean, worst, unit, published in (
        ("normal", 5, 8, "°", "7 at most"),
        ("centroid along the axis", 2.5, 4, "mm", ""),
        ("centroid across the axis", 0, 0, "px", ""),
    ):
        for kind, value in (("mean", mean), ("worst", worst)):
            one = scores[f"{title}, {kind} error"]
            assert one.value == pytest.approx(value, abs=0.03)
            assert (one.unit, one.coverage, one.better) == (unit, 1, "lower")
            assert one.published == published


@pytest.mark.parametrize("lacks", ["camera", "poses", "truth"])
def test_a_frame_without_poses_or_truth_is_skipped(lacks: str) -> None:
    pile, scorer = plate(), PoseScorer()
    artifacts: dict[str, Any] = {
        "near_camera": None if lacks == "camera" else RECORDED,
        "labels": pile.labels,
        "poses": [] if lacks == "poses" else [pose_of(placed())],
    }
    truth = pile.truth
    if lacks == "truth":
        truth.depth_m = None
    assert scorer.add(truth, artifacts) == {}
    assert scorer.summary() == []


def test_a_pose_without_truth_hides_none_of_those_after_it() -> None:
    pile = plate()
    pile.instances[50:, 50:] = 7  # a part of which nothing but its pixels is recorded
    pile.depth_m[50:, 50:] = 0
    own, scores = scored(pile, pose_of(placed(), 70), pose_of(placed(turned=5)))
    assert own["rotation_error_deg"] == pytest.approx(5, abs=1e-4)
    assert scores["rotation left open"].note == "of 1 poses"


def test_pose_scorers_put_together_tell_what_one_tells_of_all_frames() -> None:
    pile, one = plate(), PoseScorer()
    leaned = turn("x", 10)
    tilted = plate(rotation=leaned @ UP, normal=leaned @ FACING)
    frames = [
        (pile, pose_of(placed(turned=3), period_deg=180.0)),
        (tilted, pose_of(placed(normal=leaned @ FACING, turned=-8))),
        (pile, pose_of(placed(CENTROID * 1.01, turned=1))),
        (pile, pose_of(placed(turned=3), open_rotations_deg=[0.0, 90.0])),
    ]
    parts = [PoseScorer() for _ in range(3)]
    for (scene, pose), part in zip(frames, (0, 0, 2, 2), strict=True):
        scored(scene, pose, scorer=one)
        scored(scene, pose, scorer=parts[part])
    together = PoseScorer()
    for scorer in parts:
        together.take(scorer.state())
    found, wanted = together.summary(), one.summary()
    assert [(s.name, s.note, s.coverage) for s in found] == [
        (s.name, s.note, s.coverage) for s in wanted
    ]
    np.testing.assert_allclose([s.value for s in found], [s.value for s in wanted], rtol=1e-12)
    assert len(wanted) == 1 + 2 + 4 + 2 + 6

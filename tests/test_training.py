"""Which face trains a part, at which angle, under which name, and what is left aside."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, TABLE_M, Scene

from workbench_stages.matching.database import calibration_digest
from workbench_stages.matching.procedure import (
    Procedure,
    TrainParameters,
    top_surface,
    train,
    training_view,
)

RECORDED = SimpleNamespace(
    K=np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]]),
    height=256,
    width=256,
)
PARAMETERS = TrainParameters(side=16)


# -- the face that is the part's top -------------------------------------------------------------


def regions() -> tuple[np.ndarray, int, int]:
    """A high face and a lower one beside it, over the table; the high one is smaller."""
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0, (-0.03, 0.0, 0.775))
    high = scene.add(RECTANGLE * 0.6, 0.0, (0.03, 0.0, 0.765))
    return scene.regions(), low, high


def test_the_highest_flat_face_is_the_top() -> None:
    rows, _, high = regions()
    assert top_surface(rows)["label"] == high
    assert top_surface(rows[::-1])["label"] == high
    assert top_surface(rows[:1]) is None and top_surface(rows[:0]) is None


@pytest.mark.parametrize(
    ("name", "value", "is_top"),
    [
        ("background", True, False),
        ("plane_px", 0, False),
        ("plane_px", 1, True),
        ("border_px", 1, False),
        ("residual_m", 1.19e-3, True),
        ("residual_m", 1.2e-3, False),
        ("residual_m", np.nan, False),
        ("tilt_deg", 59.9, True),
        ("tilt_deg", 60.0, False),
        ("known_share", 0.51, True),
        ("known_share", 0.5, False),
        ("elevation_m", 0.0199, False),
        ("elevation_m", 0.0201, True),
    ],
)
def test_what_is_not_whole_flat_upwards_and_known_is_no_top(
    name: str, value: float, is_top: bool
) -> None:
    rows, low, high = regions()
    rows[name][high - 1] = value
    assert top_surface(rows)["label"] == (high if is_top else low)


@pytest.mark.parametrize(("share", "is_top"), [(0.2, True), (0.199, False)])
def test_a_top_is_a_fifth_of_the_largest_face_at_least(share: float, is_top: bool) -> None:
    rows, low, high = regions()
    rows["area_px"][low - 1] = 10_000
    rows["area_px"][high - 1] = round(share * 10_000)
    assert top_surface(rows)["label"] == (high if is_top else low)


def artifacts_of(scene: Scene) -> dict[str, Any]:
    return {
        "depth_m": scene.depth, "near_camera": RECORDED, "labels": scene.labels,
        "regions": scene.regions(),
    }  # fmt: skip


def test_a_training_view_is_the_top_face_with_what_lies_around_it() -> None:
    scene = Scene()
    scene.add(RECTANGLE, 20.0)
    view = training_view(artifacts_of(scene), 20.0)
    assert view is not None and view.angle_deg == 20.0
    assert view.surface.area_mm2 == pytest.approx(1500, rel=0.01)
    np.testing.assert_allclose(view.profile, 1e3 * (TABLE_M - 0.775), atol=0.1)
    np.testing.assert_allclose(view.above_table, 0.0, atol=0.1)


@pytest.mark.parametrize("missing", ["depth_m", "near_camera"])
def test_without_depth_in_metres_there_is_no_view(missing: str) -> None:
    scene = Scene()
    scene.add(RECTANGLE, 20.0)
    assert training_view(artifacts_of(scene) | {missing: None}, 20.0) is None
    relative = {missing: None, "depth_relative": scene.depth}
    assert training_view(artifacts_of(scene) | relative, 20.0) is None


def test_without_a_top_there_is_no_view() -> None:
    assert training_view(artifacts_of(Scene()), 20.0) is None
    scene = Scene()
    scene.add(RECTANGLE, 20.0)
    edgewise = artifacts_of(scene)
    edgewise["regions"]["normal"][1] = [1.0, 0.0, 0.0]
    assert training_view(edgewise, 20.0) is None


# -- training ------------------------------------------------------------------------------------


def runs(
    polygon: np.ndarray,
    angles: Sequence[float],
    name: str | None = "plate",
    others: Sequence[str] = (),
    told: bool = True,
    scales: Sequence[float] = (),
    first: int = 0,
) -> Iterator[Any]:
    """Runs of a part that lies alone, as the stages give them."""
    for k, angle in enumerate(angles):
        scene = Scene()
        scene.add(polygon * (scales[k] if scales else 1.0), angle)
        meta: dict[str, Any] = {}
        if name is not None:
            meta["objects"] = [{"id": i, "name": n} for i, n in enumerate([name, *others], 1)]
        if told:
            meta["angle"] = angle
        artifacts = artifacts_of(scene)
        camera = artifacts.pop("near_camera")
        frame = SimpleNamespace(
            index=first + k, cameras={"near": camera}, truth=SimpleNamespace(meta=meta)
        )
        yield SimpleNamespace(frame=frame, artifacts=artifacts)


FOUR = (0.0, 90.0, 180.0, 270.0)


def test_name_and_angle_are_those_of_the_ground_truth() -> None:
    said: list[str] = []
    database = train(
        [(None, None, runs(RECTANGLE, FOUR)), (None, None, runs(ELL, FOUR, "ell"))],
        PARAMETERS,
        progress=said.append,
    )
    assert database.names == ["plate", "ell"]
    np.testing.assert_array_equal(database.parts[0].space.views_deg, FOUR)
    assert said[:2] == ["plate, 0°", "plate, 90°"]
    assert said[4] == "ell, 0°" and said[-1] == "eigenspaces" and len(said) == 9
    assert database.side == 16 and database.calibration == ""
    assert "left_aside" not in database.report["parts"]["plate"]


def test_label_and_angles_override_the_ground_truth() -> None:
    database = train([("rod", [10.0, 20.5, 30.0, 40.0], runs(RECTANGLE, FOUR))], PARAMETERS)
    assert database.names == ["rod"]
    np.testing.assert_array_equal(database.parts[0].space.views_deg, [10.0, 20.5, 30.0, 40.0])
    # Without any ground truth they are enough.
    bare = list(runs(RECTANGLE, FOUR))
    for run in bare:
        run.frame.truth = None
    assert train([("rod", FOUR, bare)], PARAMETERS).names == ["rod"]


def test_recordings_of_one_name_are_one_part() -> None:
    database = train(
        [("rod", None, runs(RECTANGLE, FOUR[:2])), ("rod", None, runs(RECTANGLE, FOUR[2:]))],
        PARAMETERS,
    )
    np.testing.assert_array_equal(database.parts[0].space.views_deg, FOUR)


@pytest.mark.parametrize(
    ("first", "every", "taken"),
    [(0, 1, [0, 1, 2, 3, 4, 5, 6]), (0, 2, [0, 2, 4, 6]), (1, 2, [1, 3, 5]), (3, 1, [3, 4, 5, 6])],
)
def test_views_are_taken_from_the_first_by_the_frames_number(
    first: int, every: int, taken: list[int]
) -> None:
    angles = 40.0 * np.arange(7)
    database = train(
        [(None, None, runs(RECTANGLE, angles.tolist()))],
        TrainParameters(side=16, first=first, every=every),
    )
    np.testing.assert_array_equal(database.parts[0].space.views_deg, angles[taken])


def test_angles_go_with_the_place_among_the_frames_not_with_those_taken() -> None:
    database = train(
        [(None, [5.0, 15.0, 25.0, 35.0, 45.0, 55.0], runs(RECTANGLE, range(6), first=2))],  # type: ignore[arg-type]
        TrainParameters(side=16, first=3, every=2),
    )
    np.testing.assert_array_equal(database.parts[0].space.views_deg, [15.0, 35.0, 55.0])


def test_what_the_eigenspaces_keep_is_asked_for() -> None:
    few, many = (
        train([(None, None, runs(ELL, FOUR, "ell"))], TrainParameters(side=16, variance=share))
        for share in (0.6, 0.99)
    )
    for database, share in ((few, 0.6), (many, 0.99)):
        variance = database.parts[0].space.variance
        assert variance.sum() >= share > variance[:-1].sum()


def test_the_database_is_bound_to_the_calibration() -> None:
    seen_with = SimpleNamespace(curve=np.ones((3, 32, 32), np.float32), near_z_m=0.7, far_z_m=0.8)
    database = train([(None, None, runs(RECTANGLE, FOUR))], PARAMETERS, seen_with)
    assert database.calibration == calibration_digest(seen_with) != ""


@pytest.mark.parametrize(
    ("scale", "is_same"), [(1.05, True), (0.95, True), (1.09, False), (0.9, False)]
)
def test_views_of_another_face_are_left_aside(scale: float, is_same: bool) -> None:
    """Whose area is off by over 15 % of the median; sides that are 5 % longer are not yet."""
    scales = [1.0, scale, 1.0, 1.0, 1.0]
    database = train([(None, None, runs(RECTANGLE, (*FOUR, 300.0), scales=scales))], PARAMETERS)
    told = database.report["parts"]["plate"]
    assert told["views"] == (5 if is_same else 4)
    assert told.get("left_aside") == (None if is_same else ["1 views show another face"])


def test_frames_without_a_face_are_left_aside_and_told() -> None:
    own = list(runs(RECTANGLE, (*FOUR, 300.0)))
    own[1].artifacts["depth_m"] = np.full((256, 256), np.nan, np.float32)
    del own[3].artifacts["regions"]
    database = train([(None, None, own)], PARAMETERS)
    told = database.report["parts"]["plate"]
    assert told["views"] == 3
    assert told["left_aside"] == [
        "frame 1: no flat face with depth", "frame 3: no flat face with depth",
    ]  # fmt: skip
    del own[0].artifacts["labels"]
    with pytest.raises(ValueError, match="plate: expected 3 views or more, found 2"):
        train([(None, None, own)], PARAMETERS)


def test_a_part_of_which_no_view_is_left_is_refused() -> None:
    own = list(runs(RECTANGLE, FOUR))
    for run in own:
        run.artifacts["depth_m"] = np.full((256, 256), np.nan, np.float32)
    with pytest.raises(ValueError) as refused:
        train([(None, None, runs(ELL, FOUR, "ell")), (None, None, own)], PARAMETERS)
    assert str(refused.value) == (
        "plate: frame 0: no flat face with depth (is there a calibration?)"
    )


@pytest.mark.parametrize(
    ("asked", "label", "angles", "says"),
    [
        ({"name": None}, None, None, "frame 4: no object's name in the ground truth; --label"),
        ({"name": ""}, None, None, "frame 4: no object's name in the ground truth; --label"),
        ({"others": ["b"]}, None, None, "frame 4: expected one part lying alone, found 2"),
        ({"told": False}, None, None, "frame 4: no angle in the ground truth; give --angles"),
        ({}, None, [1.0, 2.0], "--angles: expected one for each frame, found 2"),
    ],
)
def test_who_does_not_say_what_is_seen_is_told_what_is_missing(
    asked: dict[str, Any], label: str | None, angles: list[float] | None, says: str
) -> None:
    with pytest.raises(ValueError) as refused:
        train([(label, angles, runs(RECTANGLE, FOUR, first=4, **asked))], PARAMETERS)
    assert str(refused.value) == says


def test_with_a_label_nobody_asks_how_many_parts_there_are() -> None:
    database = train([("a", None, runs(RECTANGLE, FOUR, others=["b", "c"]))], PARAMETERS)
    assert database.names == ["a"]


def test_the_procedure_runs_as_far_as_recognition_begins_and_is_bound_to_the_calibration() -> None:
    assert Procedure.run is train and Procedure.Parameters is TrainParameters
    assert (Procedure.until, Procedure.resource) == ("region_features", "calibration")
    assert TrainParameters() == TrainParameters(side=48, variance=0.995, every=1, first=0)

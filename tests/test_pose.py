"""Turns that the outline leaves open, the grasp, the frame and what a pose says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, Scene, disc, normal_of, views_of

from workbench_stages.edges.planes import Camera
from workbench_stages.matching.database import Database, Part, make_database, turn_profile
from workbench_stages.matching.eigenspace import Eigenspace, Match
from workbench_stages.matching.pose import (
    choose_turn,
    outline_m,
    outline_mm,
    pose_of,
    project,
)
from workbench_stages.matching.surfaces import Surface, camera_from_surface

SLOPE = 5.0 * np.cos(np.radians(np.arange(36) * 10.0)) + 8.0
"""Surroundings that are deepest at direction 0, and tell every turn from every other."""


def part_of(profile: np.ndarray, period: float = 360.0, space: Any = None) -> Part:
    return Part(
        "part", np.ones((3, 4)), space, 0.1, profile, 0.1, period, np.zeros(3), np.zeros(36, bool)
    )


def at(*turns: tuple[float, float]) -> list[Match]:
    return [Match(rotation, distance, distance / 2) for rotation, distance in turns]


# -- of turns that the outline leaves open -------------------------------------------------------


@pytest.mark.parametrize("true", [0, 1])
@pytest.mark.parametrize("rotation", [20.0, 70.0])
def test_the_turn_is_the_one_whose_surroundings_fit_best(true: int, rotation: float) -> None:
    """Whether the outline had it first or second, and never the one that fits worst."""
    found = at((rotation, 0.02), (rotation + 180, 0.021))
    profile = turn_profile(SLOPE, found[true].rotation_deg)
    chosen, others, settled = choose_turn(part_of(SLOPE), found, profile)
    assert (chosen, others, settled) == (found[true], [], "range")


def test_of_three_turns_the_best_is_found_wherever_it_is() -> None:
    for true in range(3):
        found = at((10.0, 0.02), (130.0, 0.02), (250.0, 0.02))
        profile = turn_profile(SLOPE, found[true].rotation_deg)
        assert choose_turn(part_of(SLOPE), found, profile)[0] is found[true]


@pytest.mark.parametrize(("second", "settled"), [(0.0309, "open"), (0.0311, "outline")])
def test_a_turn_is_as_good_within_a_factor_and_a_little(second: float, settled: str) -> None:
    """1.3 times 0.02, and 0.005 more; surroundings that were not measured decide nothing."""
    found = at((10.0, 0.02), (190.0, second))
    chosen, others, said = choose_turn(part_of(SLOPE), found, np.full(36, np.nan))
    assert chosen is found[0] and said == settled
    assert others == ([190.0] if settled == "open" else [])


@pytest.mark.parametrize(
    ("period", "other", "settled"),
    [
        (360.0, 19.0, "outline"),
        (360.0, 21.0, "open"),
        (180.0, 190.0, "outline"),
        (180.0, 201.0, "open"),
        (180.0, 179.0, "open"),
        (180.0, 181.0, "outline"),
        (60.0, 310.0, "outline"),
    ],
)
def test_turns_within_ten_degrees_or_a_period_are_the_same(
    period: float, other: float, settled: str
) -> None:
    found = at((10.0, 0.02), (other, 0.02))
    chosen, others, said = choose_turn(part_of(SLOPE, period), found, np.full(36, np.nan))
    assert chosen is found[0] and said == settled
    assert others == ([other % period] if settled == "open" else [])


def test_a_turn_is_counted_once_however_many_points_are_near_it() -> None:
    found = at((10.0, 0.02), (190.0, 0.02), (195.0, 0.02), (100.0, 0.021))
    _, others, _ = choose_turn(part_of(SLOPE), found, np.full(36, np.nan))
    assert others == [190.0, 100.0]


@pytest.mark.parametrize(("better", "settled"), [(6.9, "range"), (7.1, "open")])
@pytest.mark.parametrize("first", [True, False])
def test_seven_tenths_of_the_next_ones_misfit_settles_a_turn(
    better: float, settled: str, first: bool
) -> None:
    """One half of the part is ``better`` mm lower than what is there, the other half 10 mm."""
    model = np.full(36, 20.0)
    # At no turn the halves are off by (a, b); after half a turn they change places.
    a, b = (better, 10.0) if first else (10.0, better)
    profile = np.full(36, np.nan)
    profile[:18] = 20.0
    model[:18] += a
    model[18:] += b
    found = at((0.0, 0.02), (180.0, 0.02))
    chosen, others, said = choose_turn(part_of(model), found, profile)
    assert said == settled
    if settled == "range":
        assert chosen is found[0 if first else 1] and others == []
    else:
        assert chosen is found[0] and others == [180.0]


@pytest.mark.parametrize(("known", "settled"), [(17, "open"), (18, "range")])
def test_half_of_the_directions_must_be_known(known: int, settled: str) -> None:
    found = at((0.0, 0.02), (180.0, 0.02))
    profile = SLOPE.copy()
    profile[known:] = np.nan
    assert choose_turn(part_of(SLOPE), found, profile)[2] == settled


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_what_is_far_from_the_part_is_another_thing_and_counts_for_no_more_than_15_mm(
    sign: float,
) -> None:
    """A neighbour in one direction does not outweigh all the others."""
    model = np.where(np.arange(36) < 18, 4.0, 10.0)
    profile = model.copy()
    found = at((0.0, 0.02), (180.0, 0.02))
    # Clipped, two directions are 15 mm off, 5.6 mm rms of 12 known; unclipped, thousands.
    profile[:2] += sign * 1e4
    assert choose_turn(part_of(model), found, profile)[0] is found[0]
    assert choose_turn(part_of(model), found, profile)[2] == "range"
    # Of many such directions nothing can be told: 6 mm are no longer seen beside 15.
    profile = np.full(36, sign * 1e4)
    assert choose_turn(part_of(model), found, profile)[2] == "open"


# -- the pose of a face --------------------------------------------------------------------------

SLANTED = np.array([[-25, -12], [15, -12], [25, 12], [-15, 12]]) * 1e-3
"""A parallelogram: the same after half a turn, and never its mirror image."""

PEAK = 4.0 + 12.0 * np.exp(-(((np.arange(36) * 10.0 - 20.0 + 180) % 360 - 180) ** 2) / 60.0**2)
"""Deepest at 20°: in the mirror that is 160°, and after half a turn 200°."""


def with_profile(polygon: np.ndarray, profile: np.ndarray, step: float) -> Sequence[Any]:
    views = views_of(polygon, step)
    return [replace(v, profile=turn_profile(profile, v.angle_deg)) for v in views]


@pytest.fixture(scope="module")
def database() -> Database:
    return make_database(
        {
            "slanted": with_profile(SLANTED, PEAK, 30.0),
            "ell": views_of(ELL, 30.0),
            "plate": views_of(RECTANGLE, 30.0),
        }
    )


def posed(
    database: Database, scene: Scene, label: int, name: str, zeta_scale: float = 1.0
) -> tuple[dict[str, Any], Surface]:
    row, surface = scene.surface(label)
    model = database.names.index(name)
    return pose_of(surface, row, scene.depth, database, model, zeta_scale), surface


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rotation", [15.0, 130.0, 265.0])
def test_surroundings_tell_a_turn_from_its_opposite_on_either_side_of_a_part(
    database: Database, rotation: float, mirrored: bool
) -> None:
    """Turned over, left and right are exchanged: of the outline, and of what lies around it."""
    assert [part.period_deg for part in database.parts] == [360, 360, 180]
    scene = Scene()
    sign = -1 if mirrored else 1
    label = scene.add(SLANTED * [sign, 1], sign * rotation)
    below = turn_profile(PEAK, rotation)
    # Direction a of the part is where 180° - a was.
    scene.surround(label, (below[(18 - np.arange(36)) % 36] if mirrored else below).tolist())
    pose, _ = posed(database, scene, label, "slanted")
    assert pose["mirrored"] == mirrored and pose["settled_by"] == "range"
    assert pose["rotation_deg"] == pytest.approx(rotation, abs=1.5)
    assert pose["open_rotations_deg"] == []


def test_a_turn_that_nothing_tells_is_left_open(database: Database) -> None:
    scene = Scene()
    label = scene.add(SLANTED, 40.0)
    scene.depth[scene.labels != label] = np.nan
    pose, _ = posed(database, scene, label, "slanted")
    assert pose["settled_by"] == "open"
    assert sorted([pose["rotation_deg"], *pose["open_rotations_deg"]]) == pytest.approx(
        [40.0, 220.0], abs=1.0
    )


@pytest.mark.parametrize("rotation", [10.0, 100.0, 185.0, 350.0])
def test_rotation_is_told_within_the_parts_period(database: Database, rotation: float) -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, rotation)
    pose, surface = posed(database, scene, label, "plate")
    assert pose["period_deg"] == 180 and pose["settled_by"] == "outline"
    assert pose["rotation_deg"] == pytest.approx(rotation % 180, abs=0.7)
    np.testing.assert_allclose(
        pose["camera_from_surface"],
        camera_from_surface(surface.origin_m, surface.normal, pose["rotation_deg"]),
    )


def test_a_turn_beyond_the_period_is_told_within_it(database: Database) -> None:
    """The manifold has it at 250°; a part that is the same after half a turn is turned by 70°."""
    slanted, ell, plate = database.parts
    twice = replace(database, parts=(slanted, replace(ell, period_deg=180.0), plate))
    scene = Scene()
    label = scene.add(ELL, 250.0)
    pose, surface = posed(twice, scene, label, "ell")
    assert pose["rotation_deg"] == pytest.approx(70, abs=0.7)
    np.testing.assert_allclose(
        pose["camera_from_surface"],
        camera_from_surface(surface.origin_m, surface.normal, pose["rotation_deg"]),
    )


@pytest.mark.parametrize(("tilt", "towards"), [(0.0, 0.0), (25.0, 40.0), (40.0, 250.0)])
def test_the_gripper_comes_along_the_inward_normal_to_the_centroid(
    database: Database, tilt: float, towards: float
) -> None:
    scene = Scene()
    at_m = (0.01, -0.015, 0.76)
    label = scene.add(RECTANGLE, 30.0, at_m, tilt, towards)
    pose, surface = posed(database, scene, label, "plate")
    normal = normal_of(tilt, towards)
    approach = np.array(pose["grasp"]["approach"])
    np.testing.assert_allclose(approach, -normal, atol=2e-3)
    # From the camera's side, and so from above, into the pile.
    assert approach[2] > 0 and approach @ surface.normal == pytest.approx(-1)
    np.testing.assert_allclose(pose["grasp"]["position"], at_m, atol=4e-4)
    np.testing.assert_allclose(np.array(pose["camera_from_surface"])[:3, 3], at_m, atol=4e-4)
    np.testing.assert_array_equal(pose["grasp"]["position"], surface.origin_m)


THIN_ELL = np.array([[-30, -30], [30, -30], [30, -18], [-18, -18], [-18, 30], [-30, 30]]) * 1e-3


@pytest.mark.parametrize("mirrored", [1, -1])
@pytest.mark.parametrize("rotation", [0.0, 70.0, 200.0])
@pytest.mark.parametrize(("tilt", "towards"), [(0.0, 0.0), (30.0, 60.0)])
def test_where_the_centroid_is_beside_the_face_the_grasp_is_on_it(
    database: Database, rotation: float, mirrored: int, tilt: float, towards: float
) -> None:
    """On its plane, as far inside as the face is broad."""
    scene = Scene()
    at_m = np.array([0.012, -0.008, 0.75])
    label = scene.add(THIN_ELL * [mirrored, 1], rotation, at_m.tolist(), tilt, towards)
    pose, surface = posed(database, scene, label, "ell")
    grasp = np.array(pose["grasp"]["position"])
    column, row = np.round(project(grasp[None], matrix_of(CAMERA))[0]).astype(int)
    assert scene.labels[row, column] == label
    middle = np.round(project(surface.origin_m[None], matrix_of(CAMERA))[0]).astype(int)
    assert scene.labels[middle[1], middle[0]] != label
    assert abs((grasp - surface.origin_m) @ surface.normal) < 1e-9
    frame = camera_from_surface(at_m, normal_of(tilt, towards), rotation)
    x, y = 1e3 * frame[:3, :2].T @ (grasp - at_m) * [mirrored, 1]
    # The greatest circle inside touches both outer sides and the inner corner.
    inside = cv2.pointPolygonTest((1e3 * THIN_ELL).astype(np.float32), (float(x), float(y)), True)
    assert inside == pytest.approx(12 * np.sqrt(2) / (1 + np.sqrt(2)), abs=0.9)
    # The frame stays where the centroid is.
    np.testing.assert_allclose(
        np.array(pose["camera_from_surface"])[:3, 3], surface.origin_m, atol=1e-12
    )


def test_a_ring_is_grasped_on_its_rim(database: Database) -> None:
    scene = Scene()
    label = scene.add(disc(0.025), 0.0, (0.01, 0.0, 0.77))
    scene.add(disc(0.013), 0.0, (0.01, 0.0, 0.77))
    pose, surface = posed(database, scene, label, "plate")
    grasp = np.array(pose["grasp"]["position"])
    assert 1e3 * np.linalg.norm(grasp - surface.origin_m) == pytest.approx(19, abs=1.5)


def test_a_pose_says_what_it_was_held_against(database: Database) -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 30.0, (0.01, 0.0, 0.77))
    pose, _ = posed(database, scene, label, "plate")
    plate = database.parts[2]
    assert pose["object"] == "plate" and pose["region"] == label
    assert pose["zeta"] == plate.zeta and pose["phi"] == database.phi
    assert 0 < pose["distance_within"] <= pose["distance"] <= pose["zeta"] and pose["accepted"]
    scale = pose["distance"] / plate.zeta
    for by, accepted in ((1 + 1e-9, True), (1 - 1e-9, False)):
        held, _ = posed(database, scene, label, "plate", scale * by)
        assert held["zeta"] == pytest.approx(pose["distance"])
        assert held["accepted"] is accepted
    for value in (pose["grasp"]["position"], pose["open_rotations_deg"]):
        assert isinstance(value, list)


@pytest.mark.parametrize("plane_px", [20, 200, 3200])
def test_what_is_uncertain_follows_from_the_planes_residual(
    database: Database, plane_px: int
) -> None:
    """Fifty pixels are worth one; the normal errs by that over half an equal disc's radius."""
    scene = Scene()
    label = scene.add(RECTANGLE, 30.0)
    row, surface = scene.surface(label)
    row["plane_px"], row["residual_m"] = plane_px, 0.4e-3
    noise = pose_of(surface, row, scene.depth, database, 2)["uncertainty"]
    error = 0.4 / np.sqrt(max(plane_px / 50, 1))
    assert noise["position_mm"] == pytest.approx(error)
    radius = np.sqrt(surface.area_mm2 / np.pi)
    assert noise["normal_deg"] == pytest.approx(np.degrees(error / (radius / 2)))


def test_the_rotations_uncertainty_is_the_way_along_the_manifold() -> None:
    """On a circle of radius 2 in a space of 4 dimensions, its unit being the norm 5."""
    from workbench_stages.matching.pose import _rotation_noise_deg

    angle = np.radians(np.arange(720) / 2)
    manifold = np.zeros((720, 4), np.float32)
    manifold[:, 0], manifold[:, 1] = 2 * np.cos(angle), 2 * np.sin(angle)
    space = Eigenspace(
        np.zeros(16, np.float32), np.eye(16, dtype=np.float32)[:4], np.ones(4), manifold,
        np.zeros(3), np.zeros((3, 4), np.float32), 5.0, 1,
    )  # fmt: skip
    part = part_of(SLOPE, space=space)
    for rotation in (0.0, 123.4, 359.9):
        found = Match(rotation, 0.3, 0.04)
        expected = np.degrees(0.04 / np.sqrt(4) / (2 / 5))
        assert _rotation_noise_deg(part, found) == pytest.approx(expected, rel=1e-3)
    still = replace(space, manifold=np.zeros((720, 4), np.float32))
    assert np.isfinite(_rotation_noise_deg(part_of(SLOPE, space=still), Match(0.0, 0.3, 0.04)))


# -- outlines ------------------------------------------------------------------------------------


def matrix_of(camera: Camera) -> np.ndarray:
    return np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]])


def test_points_are_projected_by_the_cameras_matrix() -> None:
    K = np.array([[1000.0, 0, 60.0], [0, 1200.0, 40.0], [0, 0, 1]])
    points = np.array([[0.1, -0.2, 0.5], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(project(points, K), [[260.0, -440.0], [60.0, 40.0]])


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("rotation", [0.0, 90.0, 200.5])
def test_an_outline_is_the_parts_own_turned_counter_clockwise(
    database: Database, rotation: float, mirrored: bool
) -> None:
    outline = outline_mm(database.parts[1], rotation, database.mm_per_px, mirrored)
    np.testing.assert_array_equal(outline[0], outline[-1])
    # The L's centroid is in the middle.
    ell = 1e3 * ELL
    x, y = np.meshgrid(np.arange(-30, 40, 0.5), np.arange(-25, 35, 0.5))
    inside = np.array(
        [cv2.pointPolygonTest(ell.astype(np.float32), (float(a), float(b)), False) > 0
         for a, b in zip(x.ravel(), y.ravel(), strict=True)]
    )  # fmt: skip
    centred = ell - [x.ravel()[inside].mean(), y.ravel()[inside].mean()]
    angle = np.radians(rotation)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    expected = (centred @ turn.T) * [-1 if mirrored else 1, 1]
    distance = [
        abs(cv2.pointPolygonTest(expected.astype(np.float32), (float(a), float(b)), True))
        for a, b in outline
    ]
    assert np.median(distance) < 0.4 and max(distance) < 3
    corner = np.abs(outline[:, None] - expected[None]).sum(axis=2).min(axis=0)
    assert np.median(corner) < 3


@pytest.mark.parametrize("mirrored", [1, -1])
@pytest.mark.parametrize(("tilt", "towards"), [(0.0, 0.0), (25.0, 40.0)])
def test_the_outline_of_a_pose_lies_over_the_face_in_the_image(
    database: Database, tilt: float, towards: float, mirrored: int
) -> None:
    scene = Scene()
    label = scene.add(ELL * [mirrored, 1], 50.0, (0.01, -0.01, 0.76), tilt, towards)
    pose, _ = posed(database, scene, label, "ell")
    assert pose["mirrored"] == (mirrored < 0)
    outline = project(outline_m(pose, database.parts[1], database.mm_per_px), matrix_of(CAMERA))
    drawn = np.zeros(scene.labels.shape, np.uint8)
    cv2.fillPoly(drawn, [np.round(outline).astype(np.int32)], 1)
    own = scene.labels == label
    assert ((drawn > 0) & own).sum() > 0.93 * ((drawn > 0) | own).sum()


def test_a_surface_that_is_nowhere_has_no_outline() -> None:
    space = Eigenspace(
        np.zeros(16, np.float32), np.zeros((1, 16), np.float32), np.ones(1),
        np.zeros((720, 1), np.float32), np.zeros(3), np.zeros((3, 1), np.float32), 1.0, 1,
    )  # fmt: skip
    assert outline_mm(part_of(SLOPE, space=space), 0.0, 1.0).shape == (0, 2)

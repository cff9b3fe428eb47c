"""Verdict, part, pose and grasp of every committed frame, held to the recordings' ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import workbench
from workbench.pipeline import Run
from workbench_stages.matching.surfaces import shortest_turn

RECORDINGS = Path(__file__).parents[1] / "recordings"
TABLE_M = 0.795

PICKED = {
    "scene": [1, 4, 2, 4, 3, 6, 3, 3, 1, 7, 3, 4],
    "simulated": [9, None, 1, 6],
}
"""Of the parts that lie free, whole and not too steep, the highest whose face is found as one
region; None where there is none."""

UNTOLD = {("simulated", 3)}
"""A bar on its narrow side, whose face in training is hidden: no angle is known of it."""

FRAMES = [(name, k) for name, objects in PICKED.items() for k in range(len(objects))]
PICKS = [(name, k) for name, k in FRAMES if PICKED[name][k] is not None]


@pytest.fixture(scope="session")
def recorded_runs() -> dict[tuple[str, int], Run]:
    """Every frame of the committed piles, run once with the calibration and models beside them."""
    return {
        (name, run.frame.index): run
        for name in PICKED
        for run in workbench.open(RECORDINGS / f"{name}.mcap").runs()
    }


@dataclass(frozen=True)
class TrueFace:
    """The face that a region shows, by the ground truth: [3] metres and unit vectors."""

    own: int
    name: str
    mask: np.ndarray
    centroid_m: np.ndarray
    normal: np.ndarray
    rotation: np.ndarray


def points_of(run: Run, mask: np.ndarray) -> np.ndarray:
    K = run.frame.cameras["near"].K
    rows, columns = np.nonzero(mask)
    z = run.frame.truth.depth_m[rows, columns].astype(float)
    return np.stack([(columns - K[0, 2]) / K[0, 0] * z, (rows - K[1, 2]) / K[1, 1] * z, z], axis=1)


def true_face(run: Run, label: int) -> TrueFace:
    truth = run.frame.truth
    region = run.artifacts["labels"] == label
    own = int(np.bincount(truth.instances[region]).argmax())
    number = np.bincount(truth.faces[region & (truth.instances == own)]).argmax()
    mask = (truth.instances == own) & (truth.faces == number)
    points = points_of(run, mask)
    middle = points.mean(axis=0)
    normal = np.linalg.eigh(np.cov((points - middle).T))[1][:, 0]
    normal = -normal * np.sign(normal @ middle)
    # A pixel shows more of the face the farther away and the more slantingly it meets it.
    weight = points[:, 2] ** 3 / np.abs(points @ normal)
    names = {o["id"]: o["name"] for o in truth.meta["objects"]}
    return TrueFace(
        own, names[own], mask, weight @ points / weight.sum(), normal,
        truth.camera_from_object[f"object_{own}_{names[own]}"][:3, :3],
    )  # fmt: skip


def the_pose(run: Run) -> dict[str, Any]:
    (pose,) = run.artifacts["poses"]
    return pose


def angle_deg(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(a @ b, -1, 1))))


@pytest.mark.parametrize(("name", "index"), FRAMES)
def test_the_part_on_top_is_picked_and_named_or_the_pile_is_to_be_rearranged(
    recorded_runs: dict[tuple[str, int], Run], name: str, index: int
) -> None:
    run = recorded_runs[name, index]
    verdict, candidates = run.artifacts["verdict"], run.artifacts["candidates"]
    if PICKED[name][index] is None:
        assert verdict["verdict"] == "rearrange"
        assert verdict["region"] is None and verdict["object"] is None
        assert run.artifacts["poses"] == [] and not candidates["picked"].any()
        return
    assert verdict["verdict"] == "pick"
    face = true_face(run, verdict["region"])
    assert face.own == PICKED[name][index]
    assert verdict["object"] == face.name == the_pose(run)["object"]
    (row,) = candidates[candidates["picked"]]
    assert row["label"] == verdict["region"] == the_pose(run)["region"]
    shown = run.artifacts["labels"] == verdict["region"]
    assert (shown & face.mask).sum() > 0.9 * (shown | face.mask).sum()
    # Nothing lies over it: along its outline no other part is nearer.
    truth = run.frame.truth
    z, instances = truth.depth_m, truth.instances
    over = 0
    for axis in (0, 1):
        for by in (-1, 1):
            other, beside = np.roll(instances, by, axis), np.roll(z, by, axis)
            over += (face.mask & (other != face.own) & (other > 0) & (beside < z - 1e-3)).sum()
    assert over <= 10
    # No part that would do as well lies higher; heights are above the table.
    height = TABLE_M - face.centroid_m[2]
    assert row["elevation_m"] == pytest.approx(height, abs=1.5e-3)
    for rival in candidates[(candidates["reason"] == 0) & ~candidates["picked"]]:
        assert TABLE_M - true_face(run, int(rival["label"])).centroid_m[2] < height + 2e-4


@pytest.mark.parametrize(("name", "index"), PICKS)
def test_the_pose_is_where_the_part_is(
    recorded_runs: dict[tuple[str, int], Run], name: str, index: int
) -> None:
    run = recorded_runs[name, index]
    pose = the_pose(run)
    face = true_face(run, pose["region"])
    matrix = np.array(pose["camera_from_surface"])
    np.testing.assert_allclose(matrix[:3, :3].T @ matrix[:3, :3], np.eye(3), atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1)
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
    assert angle_deg(matrix[:3, 2], face.normal) < 2.0
    np.testing.assert_allclose(matrix[:3, 3], face.centroid_m, atol=0.8e-3)
    assert pose["accepted"] and not pose["open_rotations_deg"] and not pose["mirrored"]
    # The turn that took the part from how it lay in training, on this or the opposite face.
    for flip in (np.diag([1.0, -1, -1]), np.eye(3)):
        turn = face.rotation @ flip
        before = turn.T @ face.normal
        if before[2] < -0.5:
            break
    else:
        assert (name, index) in UNTOLD
        return
    assert (name, index) not in UNTOLD
    true_frame = turn @ shortest_turn(before)
    x, y = true_frame[:, :2].T @ matrix[:3, 0]
    error = np.degrees(np.arctan2(y, x))
    period = pose["period_deg"]
    assert abs((error + period / 2) % period - period / 2) < 1.0
    assert 0 <= pose["rotation_deg"] < period
    assert period == {"hex": 60, "lblock": 360, "wedge": 360}.get(face.name, 180)


@pytest.mark.parametrize(("name", "index"), PICKS)
def test_the_gripper_comes_from_above_to_the_middle_of_the_face(
    recorded_runs: dict[tuple[str, int], Run], name: str, index: int
) -> None:
    run = recorded_runs[name, index]
    pose = the_pose(run)
    face = true_face(run, pose["region"])
    position, approach = (np.array(pose["grasp"][key]) for key in ("position", "approach"))
    assert np.linalg.norm(approach) == pytest.approx(1)
    assert angle_deg(approach, -face.normal) < 2.0
    # Away from the camera, which looks down, and so downwards.
    assert approach[2] > 0.5
    np.testing.assert_allclose(position, face.centroid_m, atol=0.8e-3)
    K = run.frame.cameras["near"].K
    column, row = np.round((K @ position)[:2] / position[2]).astype(int)
    assert face.mask[row, column]
    assert run.artifacts["labels"][row, column] == pose["region"]


def test_the_parts_of_the_frames_are_of_many_kinds_and_lie_in_many_ways(
    recorded_runs: dict[tuple[str, int], Run],
) -> None:
    """What holds of every frame above says something: flat and steep faces, five kinds of part."""
    poses = [the_pose(recorded_runs[at]) for at in PICKS]
    assert len({pose["object"] for pose in poses}) >= 5
    tilts = [angle_deg(np.array(p["grasp"]["approach"]), np.array([0, 0, 1.0])) for p in poses]
    assert min(tilts) < 2 and max(tilts) > 40

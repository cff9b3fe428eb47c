"""Verdicts and poses are held against the ground truth as the tables say that they are."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from face_scenes import CAMERA, ELL, RECTANGLE, Scene, normal_of, views_of

from workbench.stage import Score
from workbench_stages.matching.database import Database, make_database
from workbench_stages.matching.scorers import PoseScorer, RecognitionScorer
from workbench_stages.matching.surfaces import camera_from_surface

RECORDED = SimpleNamespace(
    K=np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1.0]])
)


@pytest.fixture(scope="module")
def database() -> Database:
    return make_database({"plate": views_of(RECTANGLE), "ell": views_of(ELL)})


def truth_of(scene: Scene, names: dict[int, str], rotations: dict[int, np.ndarray]) -> Any:
    """The scene as a recording would tell it: label 1 is the table, every part has one face."""
    transforms = {}
    for own, rotation in rotations.items():
        matrix = np.eye(4)
        matrix[:3, :3] = rotation
        transforms[f"object_{own - 1}_{names[own]}"] = matrix
    return SimpleNamespace(
        instances=(scene.labels - 1).astype(np.uint8),
        faces=np.ones_like(scene.labels, np.uint8),
        depth_m=scene.depth,
        camera_from_object=transforms,
        meta={"objects": [{"id": own - 1, "name": name} for own, name in names.items()]},
    )


def by_name(scores: list[Score]) -> dict[str, Score]:
    return {score.name: score for score in scores}


@pytest.mark.parametrize(
    ("tilt", "towards", "said"),
    [(0.0, 0.0, "flat"), (20.0, 70.0, "tilted up to 25°"), (40.0, 200.0, "tilted farther")],
)
def test_the_error_of_a_pose_is_what_was_put_in(tilt: float, towards: float, said: str) -> None:
    scene = Scene()
    at = np.array([0.004, -0.006, 0.775])
    label = scene.add(RECTANGLE, 33.0, at, tilt, towards)
    normal = normal_of(tilt, towards)
    truth = truth_of(
        scene, {label: "plate"}, {label: camera_from_surface(at, normal, 33.0)[:3, :3]}
    )
    scorer = PoseScorer()
    for turned in (1.5, 180.5):
        matrix = camera_from_surface(at + np.array([0, 0, 1e-3]), normal, 33.0 + turned)
        pose = {
            "object": "plate", "region": label, "mirrored": False, "period_deg": 180.0,
            "open_rotations_deg": [],
            "camera_from_surface": matrix.tolist(),
        }  # fmt: skip
        scorer.add(truth, {"near_camera": RECORDED, "labels": scene.labels, "poses": [pose]})
    scores = by_name(scorer.summary())
    assert scores[f"rotation, {said}, mean error"].value == pytest.approx(1.0, abs=0.05)
    assert scores[f"rotation, {said}, worst error"].value == pytest.approx(1.5, abs=0.05)
    assert scores["rotation of plate, worst error"].note == "modulo 180°"
    assert scores["normal, worst error"].value < 0.2
    assert scores["centroid along the axis, mean error"].value == pytest.approx(1.0, abs=0.1)
    assert ("7.6" in scores[f"rotation, {said}, mean error"].published) == (tilt <= 25)


def test_rotation_of_another_face_is_not_scored() -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 0.0)
    # The part stands on end: what is seen now was its side in training.
    on_end = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    truth = truth_of(scene, {label: "plate"}, {label: on_end})
    pose = {
        "object": "plate", "region": label, "mirrored": False, "period_deg": 180.0,
            "open_rotations_deg": [],
        "camera_from_surface": camera_from_surface(
            np.array([0, 0, 0.775]), normal_of(0, 0), 0.0
        ).tolist(),
    }  # fmt: skip
    scorer = PoseScorer()
    own = scorer.add(truth, {"near_camera": RECORDED, "labels": scene.labels, "poses": [pose]})
    assert "rotation_error_deg" not in own
    assert not [
        name
        for name in by_name(scorer.summary())
        if name.startswith("rotation") and "error" in name
    ]


@pytest.mark.parametrize(
    ("over_mm", "bin_"), [(-3.0, "0 to 5 %"), (7.0, "5 to 10 %"), (14.0, "10 to 20 %")]
)
def test_how_much_is_covered_is_told_from_what_is_seen(
    database: Database, over_mm: float, bin_: str
) -> None:
    """A plate of 50 mm, of which an ell lying 15 mm higher hides some of the lower left half."""
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0, (0.02, 0.0, 0.785))
    # The ell reaches 30 mm to the right of its own origin, and up to the plate's middle.
    x = (20 - 25 + over_mm - 30) * 1e-3 * 0.770 / 0.785
    high = scene.add(ELL + np.array([0, -0.005]), 0.0, (x, 0.0, 0.770))
    flat = camera_from_surface(np.array([0, 0, 0.78]), normal_of(0, 0), 0.0)[:3, :3]
    truth = truth_of(scene, {low: "plate", high: "ell"}, {low: flat, high: flat})
    candidates, verdict = scene.judge(database)
    scorer = RecognitionScorer()
    scorer.add(
        truth,
        {
            "near_camera": RECORDED, "labels": scene.labels, "models": database,
            "candidates": candidates, "verdict": verdict,
        },
    )  # fmt: skip
    scores = by_name(scorer.summary())
    found = {name: score for name, score in scores.items() if name.startswith("recognised")}
    assert any(bin_ in name for name in found), found
    assert sum(int(score.note.split()[1]) for score in found.values()) == 2
    # What shows is enough for a name, until a plate without its corner could be an ell.
    assert all(
        score.value == (bin_ != "10 to 20 %" or bin_ not in name) for name, score in found.items()
    )
    assert all("0 misnamed" in score.note for score in found.values())
    assert scores["wrong names"].value == 0
    assert scores["picked part uncovered and named rightly"].value == 1

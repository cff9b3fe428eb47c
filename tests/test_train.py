"""`workbench train` and the stages behind it, through the command line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import CALIBRATION, SCENE, Command

from workbench.recording import Recording
from workbench_stages.matching.database import Database

POSES = SCENE.with_name("pose_bar.mcap")
SIMULATED = SCENE.with_name("simulated.calibration.npz")


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--label", "a", "--label", "b"], "--label: expected one for each recording (1), found 2"),
        (["--angles", "0,x"], "--angles 0,x: expected degrees"),
        (["--set", "train.sides=3"], "--set train.sides=3: expected one of"),
        (["--set", "train.side=3"], "train.side"),
    ],
)
def test_wrong_usage_is_one_line(bench: Command, flags: list[str], says: str) -> None:
    ended = bench("train", SCENE, "-o", "m.npz", *flags)
    assert ended.code == 2 and says in ended.mistake


def test_a_recording_without_a_lone_part_is_one_line(bench: Command) -> None:
    ended = bench("train", SCENE, "--calibration", CALIBRATION, "-o", "m.npz")
    assert ended.code == 1
    assert "scene.mcap: frame 0: expected one part lying alone" in ended.mistake
    assert not Path("m.npz").exists()


class Trained:
    """A database of one part, with what was said and shown of its training."""

    def __init__(self, folder: Path) -> None:
        self.path, self.shown = folder / "told.npz", folder / "told.rrd"
        program = "from workbench.cli import main; main()"
        done = subprocess.run(
            [
                *(sys.executable, "-c", program, "train", POSES, "--calibration", SIMULATED),
                *("-o", self.path, "--save", self.shown, "--json"),
            ],
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        self.report: dict[str, Any] = json.loads(done.stdout)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Trained:
    return Trained(tmp_path_factory.mktemp("trained"))


@pytest.mark.process
@pytest.mark.slow
def test_name_and_angles_come_from_the_truth_or_from_the_flags(
    bench: Command, trained: Trained
) -> None:
    assert trained.report["parts"]["bar"]["views"] == 6
    assert trained.report["recordings"][0]["name"] == "pose_bar.mcap"
    ended = bench(
        *("train", POSES, "--calibration", SIMULATED, "-o", "said.npz", "--label", "rod"),
        *("--angles", "100,115,130,145,160,175"),
    )
    assert ended.code == 0, ended.err
    bar, rod = (Database.load(path).parts[0] for path in (trained.path, Path("said.npz")))
    assert (bar.name, rod.name) == ("bar", "rod")
    np.testing.assert_allclose(bar.space.views_deg, np.arange(0, 90, 15))
    np.testing.assert_allclose(rod.space.views_deg, bar.space.views_deg + 100)
    # The features are of the views, whatever they are called.
    np.testing.assert_array_equal(bar.features, rod.features)


def test_too_few_angles_is_one_line(bench: Command) -> None:
    ended = bench("train", POSES, "--calibration", SIMULATED, "-o", "m.npz", "--angles", "0,15")
    assert ended.code != 0
    assert "--angles: expected one for each frame, found 2" in ended.mistake
    assert not Path("m.npz").exists()


@pytest.mark.process
def test_training_can_be_seen(trained: Trained) -> None:
    from rerun.chunk import RrdReader

    stored = {str(chunk.entity_path) for chunk in RrdReader(trained.shown).stream()}
    for name in ("mean", "eigenimages/picture", "variance", "manifold/curve", "manifold/labelled"):
        assert f"/models/bar/{name}" in stored


def results(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def test_without_models_there_is_no_verdict_and_no_failure(bench: Command, tmp_path: Path) -> None:
    alone = tmp_path / "scene.mcap"
    alone.write_bytes(SCENE.read_bytes())
    ended = bench("export", alone, "--calibration", CALIBRATION, "--to", "out", "--frames", "0:1")
    assert ended.code == 0, ended.err
    (line,) = results(tmp_path / "out")
    assert line["verdict"] is None
    assert line["poses"] == line["failures"] == []


def test_every_frame_of_the_scene_ends_in_the_pick_of_a_part_that_lies_there(
    bench: Command, tmp_path: Path
) -> None:
    """Region, name, pose and grasp, held against the truth that the recording holds."""
    ended = bench("export", SCENE, "--to", "out", "--artifacts", "labels")
    assert ended.code == 0, ended.err
    frames = Recording.open(SCENE).frames(["near", "far"], ["flat"], 0, None)
    for frame, line in zip(frames, results(tmp_path / "out"), strict=True):
        verdict, (pose,), truth = line["verdict"], line["poses"], frame.truth
        assert truth is not None and truth.instances is not None and truth.depth_m is not None
        with np.load(tmp_path / "out" / f"frame_{frame.index:06d}.npz") as file:
            shown = truth.instances[file["labels"] == verdict["region"]]
        own = int(np.bincount(shown).argmax())
        assert own > 0 and (shown == own).mean() > 0.9, frame.index
        (name,) = (one["name"] for one in truth.meta["objects"] if one["id"] == own)
        assert (verdict["verdict"], verdict["object"]) == ("pick", name), frame.index
        assert f"topmost match, {name}" in re.sub(r" [\d.]+ mm up;", "", verdict["reason"])
        assert (pose["object"], pose["region"]) == (name, verdict["region"])
        assert pose["accepted"] and pose["distance"] <= pose["zeta"]
        # The frame of the surface is a right-handed one, whose z points out of the part.
        matrix = np.array(pose["camera_from_surface"])
        np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, np.eye(3), atol=1e-9)
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1) and matrix[2, 2] < 0
        np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])
        # The gripper comes from above, along the normal, to a point that is on that part.
        np.testing.assert_allclose(pose["grasp"]["approach"], -matrix[:3, 2], atol=1e-9)
        x, y, z = pose["grasp"]["position"]
        K = frame.cameras["near"].K
        column, row = (round(K[k, k] * v / z + K[k, 2]) for k, v in enumerate((x, y)))
        assert truth.instances[row, column] == own, frame.index
        assert z == pytest.approx(truth.depth_m[row, column], abs=1e-3), frame.index

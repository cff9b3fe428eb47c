"""`workbench train` and the stages behind it, through the command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCENE = Path(__file__).parents[1] / "recordings" / "scene.mcap"
CALIBRATION = SCENE.with_name("scene.calibration.npz")


def workbench(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from workbench.cli import main; main()", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )


def one_line(done: subprocess.CompletedProcess[str], code: int) -> str:
    assert done.returncode == code, done.stderr
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_a_recording_without_a_lone_part_is_one_line(tmp_path: Path) -> None:
    done = workbench("train", SCENE, "--calibration", CALIBRATION, "-o", tmp_path / "m.npz")
    assert "scene.mcap: frame 0: expected one part lying alone" in one_line(done, 1)
    assert not (tmp_path / "m.npz").exists()


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--label", "a", "--label", "b"], "--label: expected one for each recording (1), found 2"),
        (["--angles", "0,x"], "--angles 0,x: expected degrees"),
        (["--set", "train.sides=3"], "--set train.sides=3: expected one of"),
        (["--set", "train.side=3"], "train.side"),
    ],
)
def test_wrong_usage_is_one_line(tmp_path: Path, flags: list[str], says: str) -> None:
    assert says in one_line(workbench("train", SCENE, "-o", tmp_path / "m.npz", *flags), 2)


POSES = SCENE.with_name("pose_bar.mcap")
SIMULATED = SCENE.with_name("simulated.calibration.npz")


def train(output: Path, *flags: object) -> subprocess.CompletedProcess[str]:
    return workbench("train", POSES, "--calibration", SIMULATED, "-o", output, *flags)


def test_name_and_angles_come_from_the_truth_or_from_the_flags(tmp_path: Path) -> None:
    from workbench_stages.matching.database import Database

    told, said = tmp_path / "told.npz", tmp_path / "said.npz"
    done = train(told, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert report["parts"]["bar"]["views"] == 6
    assert report["recordings"][0]["name"] == "pose_bar.mcap"
    done = train(said, "--label", "rod", "--angles", "100,115,130,145,160,175")
    assert done.returncode == 0, done.stderr
    bar, rod = (Database.load(path).parts[0] for path in (told, said))
    assert (bar.name, rod.name) == ("bar", "rod")
    np.testing.assert_allclose(bar.space.views_deg, np.arange(0, 90, 15))
    np.testing.assert_allclose(rod.space.views_deg, bar.space.views_deg + 100)
    # The features are of the views, whatever they are called.
    np.testing.assert_array_equal(bar.features, rod.features)


def test_too_few_angles_is_one_line(tmp_path: Path) -> None:
    done = train(tmp_path / "m.npz", "--angles", "0,15")
    assert "--angles: expected one for each frame, found 2" in one_line(done, 1)


def test_training_can_be_seen(tmp_path: Path) -> None:
    done = train(tmp_path / "m.npz", "--save", tmp_path / "m.rrd")
    assert done.returncode == 0, done.stderr
    assert f"wrote {tmp_path / 'm.rrd'}" in done.stdout
    stored = rrd_entities(tmp_path / "m.rrd")
    for name in ("mean", "eigenimages/picture", "variance", "manifold/curve", "manifold/labelled"):
        assert f"/models/bar/{name}" in stored


def rrd_entities(path: Path) -> set[str]:
    from rerun.chunk import RrdReader

    return {str(chunk.entity_path) for chunk in RrdReader(path).stream()}


def test_without_models_there_is_no_verdict_and_no_failure(tmp_path: Path) -> None:
    alone = tmp_path / "scene.mcap"
    alone.write_bytes(SCENE.read_bytes())
    done = workbench(
        "export", alone, "--calibration", CALIBRATION, "--to", tmp_path / "out", "--frames", "0:1"
    )
    assert done.returncode == 0, done.stderr
    line = json.loads((tmp_path / "out" / "results.jsonl").read_text().splitlines()[0])
    assert line["verdict"] is None
    assert line["poses"] == []


@pytest.mark.parametrize(
    ("recording", "frames", "objects"),
    [("scene", "0:3", ["hex", "frustum", "hex"]), ("simulated", "1:2", [None])],
)
def test_an_export_tells_the_part_that_is_picked_and_its_pose(
    tmp_path: Path, recording: str, frames: str, objects: list[str | None]
) -> None:
    """With the models beside the recording; of a pile to be rearranged, why, and no pose."""
    done = workbench(
        "export", SCENE.with_name(f"{recording}.mcap"), "--to", tmp_path / "out",
        "--frames", frames, "--artifacts", "candidates",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = (tmp_path / "out" / "results.jsonl").read_text().splitlines()
    for text, name in zip(lines, objects, strict=True):
        line = json.loads(text)
        verdict = line["verdict"]
        with np.load(tmp_path / "out" / f"frame_{line['index']:06d}.npz") as arrays:
            candidates = arrays["candidates"]
        picked = candidates["label"][candidates["picked"]].tolist()
        assert verdict["object"] == name
        if name is None:
            assert verdict["verdict"] == "rearrange" and verdict["region"] is None
            assert "leaves the image" in verdict["reason"]
            assert line["poses"] == picked == []
            continue
        assert verdict["verdict"] == "pick" and picked == [verdict["region"]]
        assert (
            verdict["reason"].startswith("topmost match, ") and f"; {name}: " in verdict["reason"]
        )
        (pose,) = line["poses"]
        assert (pose["object"], pose["region"]) == (name, verdict["region"])
        assert pose["accepted"] and pose["distance"] <= pose["zeta"]
        assert np.shape(pose["camera_from_surface"]) == (4, 4)
        # Into the pile, along the inward normal.
        inward = -np.array(pose["camera_from_surface"])[:3, 2]
        np.testing.assert_allclose(pose["grasp"]["approach"], inward, atol=1e-9)
        assert pose["grasp"]["approach"][2] > 0

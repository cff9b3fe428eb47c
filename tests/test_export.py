"""What is exported is the same every time, whatever the recording was written with."""

from __future__ import annotations

import hashlib
import json
import signal
import subprocess
from collections.abc import Callable
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from waiting import PATIENCE_S, until_running

import workbench

Command = Callable[..., Any]
LONG = 120
PROMISED = {
    "near", "far", "intensity", "focus_near", "focus_far", "depth_m", "confidence", "cloud_xyz_m",
    "cloud_normals",
}  # fmt: skip


def digests(folder: Path) -> dict[str, str]:
    paths = sorted(folder.glob("frame_*.npz"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def lines(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def test_a_second_export_gives_the_same_bytes(bench: Command, scene: Path, tmp_path: Path) -> None:
    for folder in ("a", "b"):
        assert bench("export", scene, "--to", folder, "--frames", "4:7").code == 0
    found = digests(tmp_path / "a")
    assert list(found) == [f"frame_{index:06d}.npz" for index in (4, 5, 6)]
    assert found == digests(tmp_path / "b")
    assert len(set(found.values())) == 3


def test_every_dialect_gives_the_same_artifacts(
    bench: Command, twins: dict[str, Path], scene: Path, tmp_path: Path
) -> None:
    for dialect, recording in twins.items():
        assert bench("export", recording, "--to", dialect).code == 0
    assert bench("export", scene, "--to", "original", "--frames", ":3").code == 0
    original = digests(tmp_path / "original")
    assert len(original) == 3
    for dialect in twins:
        assert digests(tmp_path / dialect) == original, dialect
        for line, other in zip(
            lines(tmp_path / dialect), lines(tmp_path / "original"), strict=True
        ):
            assert line["warnings"] == other["warnings"] and line["index"] == other["index"]


def test_frames_hold_the_promised_artifacts(bench: Command, scene: Path, tmp_path: Path) -> None:
    bench("export", scene, "--to", "out", "--frames", "0:1")
    with np.load(tmp_path / "out" / "frame_000000.npz", allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
    assert arrays.keys() >= PROMISED
    depth, confidence, cloud = arrays["depth_m"], arrays["confidence"], arrays["cloud_xyz_m"]
    assert depth.dtype == np.float32 and depth.shape == confidence.shape == (256, 256)
    known = np.isfinite(depth)
    assert known.mean() > 0.5 and 0.6 < np.nanmin(depth) <= np.nanmax(depth) < 0.9
    assert np.isfinite(confidence).all() and 0 <= confidence.min() <= confidence.max() <= 1
    assert cloud.shape == (known.sum(), 3) == arrays["cloud_normals"].shape
    assert np.isfinite(cloud).all() and (cloud[:, 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(arrays["cloud_normals"], axis=1), 1, atol=1e-4)
    # Normals look back at the camera.
    assert ((arrays["cloud_normals"] * cloud).sum(axis=1) < 0).mean() > 0.99


def test_one_line_a_frame(bench: Command, scene: Path, tmp_path: Path) -> None:
    ended = bench("export", scene, "--to", "out", "--frames", "2:5", "--json")
    assert ended.code == 0 and ended.err == "" and ended.json["frames"] == 3
    found = lines(tmp_path / "out")
    assert [line["index"] for line in found] == [2, 3, 4]
    assert [line["stamp_ns"] for line in found] == sorted(line["stamp_ns"] for line in found)
    for line in found:
        assert line.keys() >= {"index", "stamp_ns", "verdict", "poses", "stage_ms", "warnings"}
        assert set(line["stage_ms"]) == {
            entry.name for entry in entry_points(group="workbench.stages")
        }
        assert all(ms > 0 for ms in line["stage_ms"].values())
    provenance = json.loads((tmp_path / "out" / "provenance.json").read_text())
    assert provenance == ended.json["provenance"]
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {*digests(tmp_path / "out"), "results.jsonl", "provenance.json"}


def test_only_the_artifacts_that_are_asked_for(bench: Command, scene: Path, tmp_path: Path) -> None:
    bench("export", scene, "--to", "out", "--frames", "0:1", "--artifacts", "depth_m, confidence")
    with np.load(tmp_path / "out" / "frame_000000.npz") as file:
        assert set(file.files) == {"depth_m", "confidence"}


def test_until_exports_only_what_was_run(bench: Command, scene: Path, tmp_path: Path) -> None:
    bench("export", scene, "--to", "out", "--frames", "0:1", "--until", "focus_maps")
    with np.load(tmp_path / "out" / "frame_000000.npz") as file:
        assert {"focus_near", "near"} <= set(file.files) and "depth_m" not in file.files


def test_a_parameter_changes_what_is_downstream_of_it_alone(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    common = ("--frames", "0:1", "--artifacts", "near,focus_near,confidence")
    bench("export", scene, "--to", "a", *common)
    bench("export", scene, "--to", "b", *common, "--set", "focus_maps.window_periods=2")
    a, b = (np.load(tmp_path / folder / "frame_000000.npz") for folder in "ab")
    with a, b:
        same = {name: np.array_equal(a[name], b[name]) for name in a.files}
    assert same == {"near": True, "focus_near": False, "confidence": False}


def test_python_gives_what_the_command_line_writes(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    bench("export", scene, "--to", "out", "--frames", "0:2")
    runs = workbench.open(scene).runs()
    for index, run in zip(range(2), runs, strict=False):
        assert run.frame.index == index and run.failures == ()
        with np.load(tmp_path / "out" / f"frame_{index:06d}.npz") as file:
            for name in file.files:
                # Bytes, for the NaN of a table's row equals nothing, not even itself.
                assert file[name].tobytes() == np.asarray(run.artifacts[name]).tobytes(), name


def test_a_stage_that_fails_leaves_the_others_results(
    bench: Command, scene: Path, tmp_path: Path, plugin: Callable[[str], Path]
) -> None:
    path = plugin("""
class Depth(Stage):
    name = "depth_cloud"
    needs = (Artifact("focus_near", "float32", "H W"),)
    gives = (Artifact("depth_m", "float32", "H W"),)
    def compute(self, inputs, parameters):
        raise ValueError("no depth today")
""")
    ended = bench("export", scene, "--to", "out", "--frames", "0:2", "--plugin", path, "--json")
    assert ended.code == 1
    (failure,) = ended.json["failures"]
    assert failure["stage"] == "depth_cloud" and failure["frames"] == 2
    assert "no depth today" in failure["says"]
    for line in lines(tmp_path / "out"):
        assert any("no depth today" in says for says in line["warnings"])
    with np.load(tmp_path / "out" / "frame_000001.npz") as file:
        assert "focus_near" in file.files and "depth_m" not in file.files


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_export_keeps_what_was_done_and_says_what_it_was_made_with(
    started: Callable[..., subprocess.Popen[str]],
    long_recordings: dict[int, Path],
    held: Path,
    tmp_path: Path,
    sent: signal.Signals,
    code: int,
) -> None:
    recording, out = long_recordings[LONG], tmp_path / "out"
    child = started("export", recording, "--to", out, "--plugin", held, "--until", "held")
    until_running(child, (tmp_path / "inside").exists, tmp_path / "stderr")
    child.send_signal(sent)
    assert child.wait(PATIENCE_S) == code
    # Every frame before the one that it was stopped in, and nothing of that one.
    assert [line["index"] for line in lines(out)] == [0, 1, 2, 3]
    assert list(digests(out)) == [f"frame_{index:06d}.npz" for index in range(4)]
    for name in digests(out):
        with np.load(out / name) as file:
            assert {"depth_m", "held"} <= set(file.files)
    assert not list(out.glob("*.part"))
    told = json.loads((out / "provenance.json").read_text())
    assert told["recording"]["name"] == recording.name
    assert (tmp_path / "stderr").read_text() == ""
    assert "interrupted" in (tmp_path / "stdout").read_text()


@pytest.mark.slow
def test_an_export_that_is_interrupted_anywhere_has_no_line_without_its_frame(
    started: Callable[..., subprocess.Popen[str]], long_recordings: dict[int, Path], tmp_path: Path
) -> None:
    """Also while it writes; which moment it is nobody knows."""
    out = tmp_path / "out"
    child = started("export", long_recordings[LONG], "--to", out, "--until", "focus_maps")
    until_running(child, lambda: len(list(out.glob("frame_*.npz"))) > 3, tmp_path / "stderr")
    child.send_signal(signal.SIGTERM)
    child.wait(PATIENCE_S)
    found = [line["index"] for line in lines(out)]
    assert len(found) >= 3 and found == list(range(len(found)))
    # A frame of which the line is missing may be there.
    assert len(digests(out)) - len(found) in (0, 1)
    for index in found:
        with np.load(out / f"frame_{index:06d}.npz") as file:
            assert "focus_near" in file.files
    assert not list(out.glob("*.part"))

"""Each command does what it says, and a user's mistake is one line on stderr and an exit code."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
from mcap_fixtures import write_scene

from workbench.cli import app
from workbench.errors import DataError, UsageError
from workbench.settings import SettingsError
from workbench.stage import StageError

Command = Callable[..., Any]
ROOT = Path(__file__).parents[1]
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
STAGES = [
    "registration",
    "focus_maps",
    "depth_cloud",
    "edge_stack",
    "linked_edges",
    "region_features",
    "recognition",
    "pose_frames",
]


# -- what is documented ---------------------------------------------------------------------------


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_help_names_every_flag_and_says_something_of_each(bench: Command, command: str) -> None:
    ended = bench(*command.split(), "--help")
    assert ended.code == 0 and ended.err == ""
    if not command:
        assert all(name in ended.out for name in COMMANDS)
        return
    assert COMMANDS[command].help.strip().endswith(".")
    for parameter in COMMANDS[command].params:
        assert (parameter.help or "").strip(), parameter.name
        if parameter.param_type_name == "option":
            assert parameter.opts[-1] in ended.out, parameter.name


def test_commands_that_run_stages_share_their_flags() -> None:
    shared = {"calibration", "models", "preset", "config", "set", "topic", "frames", "until"}
    for name in ("replay", "export", "evaluate", "compare"):
        flags = {flag.lstrip("-") for one in COMMANDS[name].params for flag in one.opts}
        assert flags >= shared | {"plugin", "json"}, name


def test_no_command_at_all_shows_the_help_as_wrong_usage(bench: Command) -> None:
    asked, bare = bench("--help"), bench()
    assert asked.code == 0 and asked.err == ""
    assert (bare.code, bare.out) == (2, "")
    assert bare.err.strip() == asked.out.strip()


HEAVY = ("rerun", "numpy", "open3d", "cv2", "scipy", "numba")


@pytest.mark.parametrize(
    "what", ["import workbench", "workbench --help", "workbench replay --help"]
)
def test_help_and_import_load_nothing_heavy(what: str) -> None:
    program, *arguments = what.split()
    source = "import workbench" if program == "import" else "from workbench.cli import main; main()"
    script = (
        f"import atexit, sys\nsys.argv[1:] = {arguments if program != 'import' else []}\n"
        f"atexit.register(lambda: print('LOADED', *sorted(set({HEAVY}) & set(sys.modules))))\n"
        f"{source}\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert ended.stdout.splitlines()[-1] == "LOADED", ended


# -- what the commands do -------------------------------------------------------------------------


def test_info_tells_topics_and_defects(bench: Command, scene: Path) -> None:
    told = bench("info", scene, "--json").json
    assert {"near", "far", "flat"} == set(told["channels"])
    assert {topic["topic"]: topic["count"] for topic in told["topics"]}["/camera/near/image"] == 12
    plain = bench("info", scene)
    assert plain.code == 0 and plain.err == "" and "no defects" in plain.out
    assert [one["topic"] for one in told["topics"] if one["topic"] not in plain.out] == []


def test_info_of_a_damaged_recording_tells_the_damage(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(scene.read_bytes()[:1_000_000])
    ended = bench("info", cut, "--json")
    assert ended.code == 0 and ended.err == "" and ended.json["defects"]
    assert "truncated" in json.dumps(ended.json["defects"]) or "no_index" in ended.out


def test_stages_are_told_in_the_order_in_which_they_run(bench: Command) -> None:
    told = bench("stages", "--json").json
    assert [stage["name"] for stage in told] == STAGES
    for stage in told:
        assert stage["says"] and stage["gives"]
        assert all(knob["why"] for knob in stage["parameters"])
    plain = bench("stages")
    assert plain.code == 0 and plain.err == ""
    assert sorted(STAGES, key=plain.out.index) == STAGES


def test_one_stage_is_told_alone(bench: Command) -> None:
    (told,) = bench("stages", "depth_cloud", "--json").json
    assert told["name"] == "depth_cloud"
    plain = bench("stages", "depth_cloud").out
    # Whole, also where the output is piped: an address must be there to be searched and copied.
    assert [knob["name"] for knob in told["parameters"] if knob["name"] not in plain] == []
    assert "focus_near" in plain and "depth_m" in plain


def test_evaluate_gives_figures_with_their_coverage(bench: Command, scene: Path) -> None:
    ended = bench("evaluate", scene, "--frames", ":2", "--json")
    assert ended.code == 0 and ended.err == "" and ended.json["frames"] == 2
    scores = ended.json["scores"]["depth_cloud"]
    assert all(score["name"] and score["unit"] for score in scores)
    rms = next(score for score in scores if "rms" in score["name"])
    assert 0 < rms["value"] < 0.5 and 0.9 < rms["coverage"] <= 1
    told = bench("evaluate", scene, "--frames", ":2").out
    assert "rms" in told
    # What the paper reports stands beside it, with the times of its stages.
    published = told[told.index("Beside the published figures") :]
    for figure in ("% of stand-off", "% of span", "rotation, flat", "covered", "Pentium 133"):
        assert figure in published, figure


def test_calibrate_writes_a_file_that_replay_takes(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    ended = bench("calibrate", scene.with_name("unregistered.mcap"), "-o", "c.npz", "--json")
    assert ended.code == 0 and ended.err == ""
    report = ended.json
    assert report["recording"]["name"] == "unregistered.mcap" and report["distances"] == 23
    assert report["held_out_worst_percent_of_stand_off"] < 0.25
    sizes = {path.name for path in tmp_path.iterdir()}
    assert sizes == {"c.npz"}
    used = bench(
        "evaluate", scene.with_name("unregistered.mcap"), "--calibration", "c.npz", "--json"
    )
    assert used.json["provenance"]["resources"]["calibration"]["name"] == "c.npz"


def test_replay_reports_what_it_ran(bench: Command, scene: Path, tmp_path: Path) -> None:
    config = tmp_path / "tuned.toml"
    config.write_text('preset = "paper"\n[parameters.depth_cloud]\nmin_confidence = 0.25\n')
    ended = bench(
        "replay", scene, "--save", "a.rrd", "--json", "a.json", "--frames", "3:5",
        "--config", config, "--set", "focus_maps.window_periods=3",
    )  # fmt: skip
    assert ended.code == 0 and ended.err == ""
    told = json.loads((tmp_path / "a.json").read_text())
    assert told["frames"] == 2 and not told["failures"] and not told["interrupted"]
    assert list(told["stages"]) == sorted(STAGES)
    provenance = told["provenance"]
    assert provenance["preset"] == "paper"
    assert provenance["changed"] == {
        "depth_cloud.min_confidence": 0.25,
        "focus_maps.window_periods": 3,
    }
    assert set(provenance["code"]) == set(STAGES)
    assert provenance["recording"]["name"] == "scene.mcap" and provenance["bench"]
    assert "calibration" in provenance["resources"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.json", "a.rrd", "tuned.toml"]


def test_replay_until_a_stage_runs_no_other(bench: Command, scene: Path) -> None:
    ended = bench(
        "replay", scene, "--until", "focus_maps", "--frames", "0:1", "--json", "-", "--preset",
        "paper", "--save", "a.rrd",
    )  # fmt: skip
    assert ended.code == 0
    assert list(ended.json["stages"]) == ["focus_maps", "registration"]


def test_a_closing_table_names_stages_times_and_accuracy(bench: Command, scene: Path) -> None:
    out = bench("replay", scene, "--frames", "0:1", "--save", "a.rrd").out
    for words in ("1 frames", "defects: none", "median ms", "worst ms", *STAGES, "truth", "a.rrd"):
        assert words in out


# -- mistakes -------------------------------------------------------------------------------------


def not_mcap(folder: Path) -> Path:
    path = folder / "words.mcap"
    path.write_text("these are words and no recording")
    return path


WRONG = [
    # The recording.
    ("info {tmp}/none.mcap", 1, "none.mcap"),
    ("replay {tmp}/none.mcap", 1, "none.mcap"),
    ("evaluate {tmp}", 1, "directory"),
    ("export {words} --to out", 1, "words.mcap"),
    ("calibrate {words} -o c.npz", 1, "words.mcap"),
    ("info {empty}", 1, "empty.mcap"),
    # Flags of every command that runs stages.
    *(
        (f"{command} {{scene}} {rest} {flags}", code, named)
        for command, rest in (("replay", "--save a.rrd"), ("export", "--to out"), ("evaluate", ""))
        for flags, code, named in (
            ("--frames x", 2, "--frames x"),
            ("--frames 3:1", 2, "--frames 3:1"),
            ("--frames=-1:", 2, "--frames -1:"),
            ("--frames 1:2:3", 2, "--frames 1:2:3"),
            ("--frames 100:200", 1, "no frame"),
            ("--topic near", 2, "--topic near"),
            ("--topic near=", 2, "--topic near="),
            ("--topic middle=/x", 2, "middle"),
            ("--topic near=/x", 1, "/x"),
            ("--topic flat=/x", 1, "/x"),
            ("--until nothing", 2, "nothing"),
            ("--preset nothing", 2, "nothing"),
            ("--config {tmp}/none.toml", 2, "none.toml"),
            ("--config {words}", 2, "words.mcap"),
            ("--set nothing.x=1", 2, "nothing"),
            ("--set depth_cloud.x=1", 2, "depth_cloud"),
            ("--set depth_cloud.min_confidence=2", 2, "depth_cloud.min_confidence"),
            ("--plugin {tmp}/none.py", 1, "none.py"),
            ("--calibration {tmp}/none.npz", 1, "none.npz"),
            ("--calibration {tmp}", 1, "--calibration"),
            ("--models {tmp}/none.npz", 1, "none.npz"),
        )
    ),
    # Flags of one command.
    ("replay {scene} --window big --save a.rrd", 2, "--window big"),
    ("replay {scene} --frames 0:1 --save none/a.rrd", 1, "none/a.rrd"),
    ("replay {scene} --frames 0:1 --save {words}/a.rrd", 1, "a.rrd"),
    ("replay {scene} --frames 0:1 --save {folder}", 1, "{folder}"),
    ("replay {scene} --frames 0:1 --save a.rrd --json none/a.json", 1, "none/a.json"),
    ("export {scene} --to {words}", 1, "words.mcap"),
    ("export {scene} --to {words}/out", 1, "words.mcap"),
    ("export {scene} --to out --artifacts depth", 2, "depth"),
    ("export {scene} --to out --artifacts ,", 2, "--artifacts"),
    ("export {scene} --to out --until focus_maps --artifacts depth_m", 2, "depth_m"),
    ("stages nothing", 2, "nothing"),
    ("calibrate {scene} -o none/c.npz", 1, "none/c.npz"),
    ("calibrate {planes} -o {folder}", 1, "{folder}"),
    ("calibrate {scene} -o c.npz --set x=1", 2, "x=1"),
    ("info {scene} --topic near", 2, "--topic near"),
    ("info {scene} --topic near=/x", 1, "/x"),
    ("train {scene} -o none/m.npz", 1, "none/m.npz"),
    ("train {scene} -o m.npz --save none/m.rrd", 1, "--save none/m.rrd"),
    ("train {scene} -o m.npz --label a --label b", 2, "--label: expected one for each"),
    ("train {scene} -o m.npz --angles 0,x", 2, "--angles 0,x"),
    ("train {scene} -o m.npz --set train.x=1", 2, "train.x=1"),
    ("train {scene} -o m.npz --set nothing.x=1", 2, "nothing"),
    ("train {scene} -o m.npz --topic middle=/x", 2, "middle"),
    ("train {scene} -o m.npz --calibration {tmp}/none.npz", 1, "none.npz"),
    ("train {words} -o m.npz", 1, "words.mcap"),
    ("train {tmp}/none.mcap -o m.npz", 1, "none.mcap"),
    ("simulate {tmp}/none.toml -o a.mcap", 1, "none.toml"),
    # Typer's own.
    ("nothing", 2, "nothing"),
    ("info", 2, "REC"),
    ("info {scene} --nothing", 2, "--nothing"),
    ("export {scene}", 2, "--to"),
]  # fmt: skip


@pytest.mark.parametrize(("line", "code", "named"), WRONG, ids=[line for line, *_ in WRONG])
def test_a_mistake_is_one_line_and_an_exit_code(
    bench: Command, scene: Path, tmp_path: Path, line: str, code: int, named: str
) -> None:
    (tmp_path / "empty.mcap").touch()
    names = {"tmp": tmp_path, "scene": scene, "words": not_mcap(tmp_path)}
    names["empty"] = tmp_path / "empty.mcap"
    names["planes"] = scene.with_name("unregistered.mcap")
    names["folder"] = tmp_path / "folder"
    names["folder"].mkdir()
    ended = bench(*(word.format(**names) for word in line.split()))
    assert named.format(**names) in ended.mistake
    assert ended.code == code
    assert not list(tmp_path.rglob("*.part"))


def altered(path: Path, source: Path, **changed: Any) -> Path:
    """The calibration with other arrays; one that is None is left out."""
    with np.load(source) as file:
        arrays = {name: file[name] for name in file.files} | changed
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def damaged(path: Path, source: Path) -> Path:
    """The calibration with wrong bytes in the middle of its biggest array."""
    data = bytearray(source.read_bytes())
    with zipfile.ZipFile(source) as file:
        biggest = max(file.infolist(), key=lambda item: item.compress_size)
    middle = biggest.header_offset + biggest.compress_size // 2
    data[middle : middle + 64] = bytes(64)
    path.write_bytes(data)
    return path


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def saved(path: Path, array: np.ndarray) -> Path:
    with path.open("wb") as file:
        np.save(file, array)
    return path


WRONG_CALIBRATIONS: dict[str, Callable[[Path, Path], Path]] = {
    "garbage": lambda to, _: written(to, os.urandom(4000)),
    "empty": lambda to, _: written(to, b""),
    "text": lambda to, _: written(to, b"calibration: yes"),
    "truncated": lambda to, good: written(to, good.read_bytes()[:100_000]),
    "damaged": damaged,
    "a single array": lambda to, _: saved(to, np.zeros(3)),
    "another file": lambda to, good: altered(to, good, format=np.array("models")),
    "another version": lambda to, good: altered(to, good, version=np.array(99)),
    "pickled": lambda to, good: altered(to, good, report=np.array({"a": 1}, dtype=object)),
    "no curve": lambda to, good: altered(to, good, curve=None),
    "a flat curve": lambda to, good: altered(to, good, curve=np.zeros((256, 256), np.float32)),
    "stripes of two numbers": lambda to, good: altered(to, good, stripes=np.zeros(2)),
    "a report that is no json": lambda to, good: altered(to, good, report=np.array("{")),
    "a version that is no number": lambda to, good: altered(to, good, version=np.array("one")),
    "far before near": lambda to, good: altered(to, good, range_m=np.array([0.9, 0.6])),
    "a range that is no number": lambda to, good: altered(to, good, range_m=np.array([1, np.nan])),
}


@pytest.mark.parametrize("how", WRONG_CALIBRATIONS)
def test_a_wrong_calibration_is_told_in_one_line(
    bench: Command, scene: Path, calibration: Path, tmp_path: Path, how: str
) -> None:
    wrong = WRONG_CALIBRATIONS[how](tmp_path / "wrong.npz", calibration)
    ended = bench("evaluate", scene, "--frames", "0:1", "--calibration", wrong)
    assert "wrong.npz" in ended.mistake and "--calibration" in ended.mistake
    assert ended.code == 1


@pytest.mark.parametrize(
    ("range_m", "fits"),
    [((0.6, 0.9), True), ((0.6, 0.6000001), True), ((1e-6, 9.0), True), ((0.9, 0.6), False),
     ((0.6, 0.6), False), ((0.0, 0.9), False), ((-0.6, 0.9), False), ((-0.9, -0.6), False)],
)  # fmt: skip
def test_a_calibrations_working_range_goes_from_near_to_far(
    calibration: Path, tmp_path: Path, range_m: tuple[float, float], fits: bool
) -> None:
    from workbench_stages.dfd.calibration import Calibration

    path = altered(tmp_path / "c.npz", calibration, range_m=np.array(range_m))
    if fits:
        loaded = Calibration.load(path)
        assert (loaded.near_z_m, loaded.far_z_m) == range_m
        # The near end is at 0 of the relative depth, the far one at 1.
        np.testing.assert_allclose(loaded.z_m(np.array([0.0, 1.0])), range_m, rtol=1e-6)
    else:
        with pytest.raises(ValueError, match="expected a working range in metres"):
            Calibration.load(path)


def test_a_calibration_for_another_image_size_says_both_sizes(
    bench: Command, scene: Path, calibration: Path, tmp_path: Path
) -> None:
    small = np.zeros((2, 128, 128), np.float32)
    other = altered(tmp_path / "o.npz", calibration, size=np.array([128, 128]), curve=small)
    ended = bench("replay", scene, "--frames", "0:1", "--calibration", other, "--save", "a.rrd")
    assert ended.code == 1
    assert "128×128" in ended.out and "256×256" in ended.out


def test_another_version_of_a_calibration_says_what_to_do(
    bench: Command, scene: Path, calibration: Path, tmp_path: Path
) -> None:
    other = altered(tmp_path / "o.npz", calibration, version=np.array(99))
    says = bench("evaluate", scene, "--calibration", other).mistake
    assert "99" in says and "workbench calibrate" in says


def test_a_recording_without_the_pair_names_its_topics_and_the_flag(
    bench: Command, tmp_path: Path
) -> None:
    recording = write_scene(tmp_path / "left_right.mcap", channels=("left", "right"), truth=False)
    for command in (["replay", "--save", "a.rrd"], ["evaluate"], ["export", "--to", "out"]):
        ended = bench(command[0], recording, *command[1:])
        assert ended.code == 1
        for words in ("near", "far", "/camera/left/image", "/camera/right/image", "--topic"):
            assert words in ended.mistake
    assert not (tmp_path / "a.rrd").exists() and not (tmp_path / "out").exists()


def test_topics_can_be_mapped_to_channels(bench: Command, tmp_path: Path) -> None:
    recording = write_scene(tmp_path / "r.mcap", channels=("left", "right"), truth=False)
    mapped = ["--topic", "near=/camera/left/image", "--topic", "far=/camera/right/image"]
    ended = bench("export", recording, "--to", "out", "--until", "registration", *mapped, "--json")
    assert ended.code == 0 and ended.json["frames"] == 12


def test_without_a_calibration_depth_is_relative_and_says_so(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    alone = tmp_path / "alone.mcap"
    alone.write_bytes(scene.read_bytes())
    ended = bench("export", alone, "--to", "out", "--frames", "0:1", "--json")
    assert ended.code == 0 and "relative" in json.dumps(ended.json["warnings"])
    with np.load(tmp_path / "out" / "frame_000000.npz") as file:
        assert np.isnan(file["depth_m"]).all() and not np.isnan(file["depth_relative"]).all()
    evaluated = bench("evaluate", alone, "--frames", "0:1", "--until", "depth_cloud")
    assert "no calibration" in evaluated.mistake


def test_nothing_to_score_is_told_in_one_line(bench: Command, twins: dict[str, Path]) -> None:
    ended = bench("evaluate", twins["protobuf"])
    assert ended.code == 1 and "ground_truth" in ended.mistake


def test_a_reader_that_leaves_early_makes_no_noise(tmp_path: Path) -> None:
    script = f"{sys.executable} -c 'from workbench.cli import main; main()' stages | head -1"
    ended = subprocess.run(script, shell=True, capture_output=True, text=True, cwd=tmp_path)
    assert ended.stderr == ""


# -- however a command ends -----------------------------------------------------------------------


class Wrong(Exception):  # noqa: N818
    """As the library of the command line tells of a wrong flag."""

    def format_message(self) -> str:
        return "no such\n  option"


@pytest.mark.parametrize(
    ("error", "received", "code", "says"),
    [
        (None, None, 0, ""),
        (UsageError("--x: wrong"), None, 2, "workbench: --x: wrong\n"),
        (SettingsError("blur.x: wrong"), None, 2, "workbench: blur.x: wrong\n"),
        (DataError("a.mcap:\nbroken"), None, 1, "workbench: a.mcap: broken\n"),
        (StageError("plugin"), None, 1, "workbench: plugin\n"),
        (OSError(28, "No space left"), None, 1, "workbench: OSError: [Errno 28] No space left\n"),
        (Wrong(), None, 2, "workbench: no such option\n"),
        (KeyboardInterrupt(), signal.SIGINT, 130, ""),
        (KeyboardInterrupt(), signal.SIGTERM, 143, ""),
        (KeyboardInterrupt(), None, 130, ""),
        (typer.Abort(), None, 130, ""),
        (typer.Exit(1), None, 1, ""),
        (typer.Exit(130), signal.SIGTERM, 143, ""),
    ],
)
def test_an_end_is_an_exit_code_and_at_most_one_line(
    bench: Command,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException | None,
    received: int | None,
    code: int,
    says: str,
) -> None:
    from workbench import interrupts
    from workbench.commands import info

    def run(*_: object) -> None:
        if error is not None:
            raise error

    monkeypatch.setattr(info, "run", run)
    monkeypatch.setattr(interrupts, "_received", received)
    ended = bench("info", "a.mcap")
    assert (ended.code, ended.err, ended.out) == (code, says, "")


def test_a_fault_of_the_bench_itself_is_not_hidden(
    monkeypatch: pytest.MonkeyPatch, bench: Command
) -> None:
    from workbench.cli import main
    from workbench.commands import info

    def run(*_: object) -> None:
        raise ZeroDivisionError

    assert bench("--help").code == 0
    monkeypatch.setattr(info, "run", run)
    monkeypatch.setattr(sys, "argv", ["workbench", "info", "a.mcap"])
    with pytest.raises(ZeroDivisionError):
        main()


@pytest.mark.parametrize(
    ("text", "size"),
    [("1920x1080", (1920, 1080)), ("1X2", (1, 2)), ("3", None), ("3x", None), ("x4", None),
     ("0x4", None), ("4x0", None), ("-1x4", None), ("4x4x4", None), ("1.5x2", None)],
)  # fmt: skip
def test_a_size_as_it_is_written(text: str, size: tuple[int, int] | None) -> None:
    from workbench.cli import parse_size

    if size is not None:
        assert parse_size("--image-size", text) == size
    else:
        with pytest.raises(UsageError, match=f"--image-size {text}: expected WxH"):
            parse_size("--image-size", text)

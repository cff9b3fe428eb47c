"""A session runs the frames, files and parameters that were asked for, and says which they were."""

from __future__ import annotations

import hashlib
import importlib.metadata
import itertools
import platform
import sys
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError
from pathlib import Path
from typing import Any

import pytest
from conftest import Command
from mcap_fixtures import Recorder, picture, stamp_of, write_scene

import workbench
from workbench.cli import parse_frames, parse_topics
from workbench.digest import digest_of_file
from workbench.errors import DataError, UsageError
from workbench.pipeline import ResultStore
from workbench.session import (
    Options,
    Session,
    bench_version,
    check_resources,
    check_stage,
    check_topics,
    library_versions,
    resources_beside,
)
from workbench.settings import SettingsError
from workbench.stage import Resource, Stage, StageError, recorded_image

STAGES = """
from workbench.stage import Resource, recorded_camera

class Levels(Stage):
    name = "levels"
    needs = (
        recorded_image("left"),
        recorded_image("right").optional(),
        Resource("scale", required=False, load=lambda p: float(p.read_text()),
                 filename="scale.txt"),
    )
    gives = (Artifact("level", "float64", ""), Artifact("scaled", "float64", ""))
    class Parameters(StageParameters):
        add: float = knob(0.0, "Added.", low=0, high=99)
        times: float = knob(1.0, "Factor.", low=0, high=99)
    presets = {"twice": {"times": 2.0}, "thrice": {"times": 3.0}}
    def compute(self, inputs, p):
        level = float(inputs["left_image"].mean())
        scaled = level * (inputs["scale"] or 1.0) * p.times + p.add
        return {"level": np.array(level), "scaled": np.array(scaled)}

class Ends(Stage):
    name = "ends"
    needs = (Artifact("level", "float64", ""),)
    gives = (Artifact("end", "float64", ""),)
    def compute(self, inputs, p):
        return {"end": np.array(float(inputs["level"]))}
"""
FRAMES = 7


@pytest.fixture(scope="module")
def stages(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from conftest import PLUGIN_HEADER

    path = tmp_path_factory.mktemp("stages") / "session_toys.py"
    path.write_text(PLUGIN_HEADER + STAGES)
    return path


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("made") / "toy.mcap"
    return write_scene(path, frames=range(FRAMES), channels=("left", "right", "other"))


@pytest.fixture
def recording(made: Path, tmp_path: Path) -> Path:
    """Seven frames in a folder of their own."""
    path = tmp_path / "there" / "toy.mcap"
    path.parent.mkdir()
    path.write_bytes(made.read_bytes())
    return path


def opened(recording: Path, stages: Path, **options: Any) -> Session:
    return Session.open(Options(recording, **({"plugins": [stages], "until": "levels"} | options)))


def level_of(index: int, channel: str = "left") -> float:
    return float(picture(channel, index).mean())


# -- frames ---------------------------------------------------------------------------------------

SPANS = [
    (0, None), (0, 1), (3, 6), (3, None), (6, 7), (6, None), (0, 7), (0, 8), (5, 99), (7, 9),
    (7, None), (9, 12), (2, 3),
]  # fmt: skip


@pytest.mark.parametrize("span", SPANS)
def test_a_span_of_frames_is_these_frames(
    made: Path, stages: Path, span: tuple[int, int | None]
) -> None:
    session = opened(made, stages, frames=span)
    expected = list(range(FRAMES))[span[0] : span[1]]
    runs = list(session.runs())
    assert [run.frame.index for run in runs] == expected
    assert session.count() == len(expected)
    assert [float(run.artifacts["level"]) for run in runs] == [level_of(k) for k in expected]
    assert session.provenance()["frames"] == list(span)


@pytest.mark.parametrize(
    ("text", "span"),
    [
        (None, (0, None)),
        ("3:6", (3, 6)),
        ("3:", (3, None)),
        (":6", (0, 6)),
        (":", (0, None)),
        ("3", (3, 4)),
        ("0", (0, 1)),
        ("0:1", (0, 1)),
        ("12:130", (12, 130)),
    ],
)
def test_frames_as_they_are_written(text: str | None, span: tuple[int, int | None]) -> None:
    assert parse_frames(text) == span


@pytest.mark.parametrize("text", ["3:3", "3:2", "-1", "-1:", "-2:5", ":0", "a", "a:b", "1:2:3",
                                  "1.5", "3:-1"])  # fmt: skip
def test_frames_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=f"--frames {text}: expected A:B with 0 <= A < B"):
        parse_frames(text)


@pytest.mark.parametrize(("flag", "indices"), [("3:6", [3, 4, 5]), ("5:", [5, 6]), (":2", [0, 1]),
                                               ("4", [4]), ("6:99", [6])])  # fmt: skip
def test_a_command_runs_the_frames_that_are_asked_for(
    bench: Command, recording: Path, stages: Path, tmp_path: Path, flag: str, indices: list[int]
) -> None:
    ended = bench(
        "export", recording, "--plugin", stages, "--until", "levels", "--frames", flag,
        "--to", "out", "--json",
    )  # fmt: skip
    assert ended.code == 0 and ended.json["frames"] == len(indices)
    assert ended.json["provenance"]["frames"] == list(parse_frames(flag))
    names = [path.name for path in sorted((tmp_path / "out").glob("*.npz"))]
    assert names == [f"frame_{index:06d}.npz" for index in indices]


# -- what lies beside the recording ----------------------------------------------------------------

SHARED, OWN, FLAG = "scale.txt", "toy.scale.txt", "flag.txt"
VALUES = {SHARED: 2.0, OWN: 3.0, FLAG: 5.0}


@pytest.mark.parametrize(
    "there", [set(c) for n in range(4) for c in itertools.combinations(VALUES, n)], ids=sorted
)
def test_a_flag_comes_before_the_recordings_own_file_and_that_before_the_shared_one(
    recording: Path, stages: Path, there: set[str]
) -> None:
    for name in there:
        recording.with_name(name).write_text(str(VALUES[name]))
    given = {"scale": recording.with_name(FLAG)} if FLAG in there else {}
    session = opened(recording, stages, resources=given, frames=(0, 1))
    [run] = session.runs()
    first = next((name for name in (FLAG, OWN, SHARED) if name in there), None)
    assert run.artifacts["scaled"] == level_of(0) * (1.0 if first is None else VALUES[first])
    told = session.provenance()["resources"]
    if first is None:
        assert told == {}
    else:
        assert told == {
            "scale": {"name": first, "digest": digest_of_file(recording.with_name(first))}
        }


def test_another_recordings_own_file_is_not_taken(recording: Path, stages: Path) -> None:
    recording.with_name("toys.scale.txt").write_text("7")
    recording.with_name("to.scale.txt").write_text("7")
    recording.with_name(SHARED).mkdir()
    assert opened(recording, stages).pipeline.resources == {}


def test_only_resources_with_a_file_name_are_looked_for(recording: Path) -> None:
    class Takes(Stage):
        name = "takes"
        needs = (Resource("a", filename="a.txt"), Resource("b"), recorded_image("left"))

    for name in ("a.txt", "b", "toy.b", "toy."):
        recording.with_name(name).write_text("")
    assert resources_beside(recording, {"takes": Takes()}) == {"a": recording.with_name("a.txt")}


def test_a_named_resource_must_be_there_and_taken(recording: Path, stages: Path) -> None:
    with pytest.raises(DataError, match=r"--scale .*none\.txt: no such file"):
        opened(recording, stages, resources={"scale": recording.with_name("none.txt")})
    with pytest.raises(UsageError, match=r"--weight .*toy\.mcap: no stage takes weight"):
        opened(recording, stages, resources={"weight": recording})
    with pytest.raises(StageError, match=r"--scale .*toy\.mcap: "):
        opened(recording, stages, resources={"scale": recording})


# -- the order of precedence of parameters ---------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "in_file", "value", "sets", "expected"),
    [
        (None, None, None, [], (1.0, "default")),
        ("twice", None, None, [], (2.0, "twice")),
        (None, "twice", None, [], (2.0, "twice")),
        ("thrice", "twice", None, [], (3.0, "thrice")),
        ("twice", "thrice", None, [], (2.0, "twice")),
        ("default", "twice", None, [], (1.0, "default")),
        (None, None, 4.0, [], (4.0, "default")),
        ("twice", None, 4.0, [], (4.0, "twice")),
        (None, "twice", 4.0, [], (4.0, "twice")),
        (None, None, None, ["5"], (5.0, "default")),
        ("twice", "thrice", 4.0, ["5"], (5.0, "twice")),
        ("twice", "thrice", 4.0, ["5", "6"], (6.0, "twice")),
    ],
)
def test_a_flag_comes_before_the_file_and_that_before_the_preset(
    recording: Path,
    stages: Path,
    tmp_path: Path,
    preset: str | None,
    in_file: str | None,
    value: float | None,
    sets: list[str],
    expected: tuple[float, str],
) -> None:
    config = None
    if in_file is not None or value is not None:
        config = tmp_path / "tuned.toml"
        lines = [] if in_file is None else [f"preset = '{in_file}'"]
        lines += [] if value is None else ["[parameters.levels]", f"times = {value}"]
        config.write_text("\n".join(lines))
    session = opened(
        recording, stages, preset=preset, config=config, frames=(0, 1),
        assignments=[f"levels.times={text}" for text in sets],
    )  # fmt: skip
    [run] = session.runs()
    assert run.artifacts["scaled"] == level_of(0) * expected[0]
    told = session.provenance()
    assert told["preset"] == expected[1]
    plain = {"default": 1.0, "twice": 2.0, "thrice": 3.0}[expected[1]]
    changed = {"levels.times": expected[0]} if expected[0] != plain else {}
    assert told["changed"] == changed
    assert told["parameters"] == {"levels": {"add": 0.0, "times": expected[0]}}


# -- topics ---------------------------------------------------------------------------------------


def test_a_channel_is_read_from_its_topic_or_the_one_that_is_named(
    recording: Path, stages: Path
) -> None:
    plain = opened(recording, stages, frames=(2, 3))
    mapped = opened(
        recording, stages, frames=(2, 3), topics={"left": "/camera/other/image"}
    )  # fmt: skip
    for session, channel in ((plain, "left"), (mapped, "other")):
        [run] = session.runs()
        assert run.artifacts["level"] == level_of(2, channel)
        assert session.provenance()["topics"] == {
            "left": f"/camera/{channel}/image", "right": "/camera/right/image"
        }  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "topics"),
    [
        ([], {}),
        (["near=/a"], {"near": "/a"}),
        (["near=/a", "far=/b"], {"near": "/a", "far": "/b"}),
        (["near=/a", "near=/b"], {"near": "/b"}),
        (["near=/a=b"], {"near": "/a=b"}),
    ],
)
def test_topics_as_they_are_written(texts: list[str], topics: dict[str, str]) -> None:
    assert parse_topics(texts) == topics


@pytest.mark.parametrize("text", ["near", "near=", "=/a", "="])
def test_topics_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(UsageError, match=f"--topic {text}: expected CHANNEL=/TOPIC"):
        parse_topics([text])


def test_what_is_asked_of_no_stage_is_told_with_what_there_is() -> None:
    class Takes(Stage):
        name = "takes"
        needs = (recorded_image("right"), recorded_image("left"), Resource("scale"))

    stages: Mapping[str, Stage] = {"takes": Takes()}
    check_topics({"left": "/x"}, stages)
    with pytest.raises(UsageError, match=r"--topic up=/x: .*'up'; channels: left, right"):
        check_topics({"left": "/x", "up": "/x"}, stages)
    check_stage(None, stages, "--until")
    check_stage("takes", stages, "--until")
    with pytest.raises(UsageError, match="--until ends: no such stage; stages: takes"):
        check_stage("ends", stages, "--until")
    check_resources({}, stages)
    check_resources({"scale": Path(__file__)}, stages)


def test_a_recording_without_what_is_required_is_refused(tmp_path: Path, stages: Path) -> None:
    path = tmp_path / "right.mcap"
    with Recorder(path) as recorder:
        recorder.image("/camera/right/image", stamp_of(0), picture("right", 0), "mono8")
    with pytest.raises(DataError, match="left"):
        opened(path, stages)


# -- provenance -----------------------------------------------------------------------------------


def test_a_result_is_identified_by_all_that_it_depends_on(recording: Path, stages: Path) -> None:
    recording.with_name(OWN).write_text("2")
    session = opened(
        recording, stages, preset="twice", assignments=["levels.add=3"], until="ends",
        frames=(1, 4),
    )  # fmt: skip
    told = session.provenance()
    data = recording.read_bytes()
    assert told == {
        "bench": importlib.metadata.version("defocus-workbench"),
        "recording": {
            "name": "toy.mcap",
            "digest": hashlib.blake2b(data, digest_size=16).hexdigest(),
        },
        "topics": {"left": "/camera/left/image", "right": "/camera/right/image"},
        "frames": [1, 4],
        "until": "ends",
        "resources": {
            "scale": {"name": OWN, "digest": hashlib.blake2b(b"2", digest_size=16).hexdigest()}
        },
        "preset": "twice",
        "changed": {"levels.add": 3.0},
        "parameters": {"levels": {"add": 3.0, "times": 2.0}, "ends": {}},
        "code": session.pipeline.code_digests(),
        "libraries": dict(library_versions()),
        "python": platform.python_version(),
    }
    assert told["code"].keys() == {"levels", "ends"}
    assert set(told["parameters"]) == {"levels", "ends"}


def test_other_settings_are_identified_by_their_own_parameters(
    recording: Path, stages: Path
) -> None:
    from workbench.settings import adjusted

    session = opened(recording, stages)
    pipeline = session.pipeline
    other = pipeline.with_settings(adjusted(pipeline.known, pipeline.settings, {"levels.add": 3}))
    told, plain = session.provenance_of(other), session.provenance()
    assert told["changed"] == {"levels.add": 3.0} and plain["changed"] == {}
    assert told["parameters"]["levels"]["add"] == 3.0
    differ = {key for key in told if told[key] != plain[key]}
    assert differ == {"changed", "parameters"}


def test_the_libraries_are_named_with_their_versions(monkeypatch: pytest.MonkeyPatch) -> None:
    found = library_versions()
    names = {"numpy", "opencv-python-headless", "scipy", "scikit-image", "numba", "rerun-sdk"}
    assert found == {name: importlib.metadata.version(name) for name in names} | {
        "platform": sys.platform
    }

    def version(name: str) -> str:
        if name == "numba":
            raise PackageNotFoundError
        return f"{name} 1"

    monkeypatch.setattr("workbench.session.version", version)
    library_versions.cache_clear()
    try:
        assert library_versions().keys() == names - {"numba"} | {"platform"}
    finally:
        library_versions.cache_clear()


def test_a_bench_that_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    assert bench_version() == importlib.metadata.version("defocus-workbench")

    def version(_: str) -> str:
        raise PackageNotFoundError

    monkeypatch.setattr("workbench.session.version", version)
    assert bench_version() == "not installed"


# -- from Python ----------------------------------------------------------------------------------


def test_python_passes_on_every_option(recording: Path, stages: Path, tmp_path: Path) -> None:
    config = tmp_path / "tuned.toml"
    config.write_text("[parameters.levels]\nadd = 1\n")
    session = workbench.open(
        str(recording), preset="twice", config=str(config), set=["levels.times=3"],
        topics={"left": "/camera/other/image"}, frames=(1, 2), until="levels",
        plugins=[str(stages)],
    )  # fmt: skip
    assert session.options == Options(
        recording,
        {},
        "twice",
        config,
        ["levels.times=3"],
        {"left": "/camera/other/image"},
        (1, 2),
        "levels",
        [stages],
    )
    [run] = session.runs()
    assert run.artifacts["scaled"] == pytest.approx(3 * level_of(1, "other") + 1)


@pytest.mark.parametrize("name", ["calibration", "models"])
def test_python_names_the_resources_of_the_pipeline(scene: Path, name: str) -> None:
    path = scene.with_name(f"scene.{name}.npz")
    other = workbench.open(scene, until="registration", **{name: str(path)})  # type: ignore[arg-type]
    assert other.options.resources == {name: path}
    with pytest.raises(DataError, match=rf"--{name} none\.npz: no such file"):
        workbench.open(scene, **{name: "none.npz"})  # type: ignore[arg-type]


def test_sessions_with_one_store_share_results(recording: Path, stages: Path) -> None:
    store = ResultStore()
    computed = []
    for _ in range(2):
        options = Options(recording, plugins=[stages], until="levels", frames=(0, 1))
        [run] = Session.open(options, store).runs()
        computed.append(set(run.computed))
    assert computed == [{"levels"}, set()]


def test_a_stage_to_end_at_must_be_there(recording: Path, stages: Path) -> None:
    with pytest.raises(UsageError, match=r"--until nothing: no such stage; stages: .*levels"):
        opened(recording, stages, until="nothing")


def test_a_wrong_parameter_is_told_though_its_stage_is_not_run(
    recording: Path, stages: Path
) -> None:
    with pytest.raises(SettingsError, match=r"ends .*'x'"):
        opened(recording, stages, assignments=["ends.x=1"])


def test_a_signal_ends_the_run_after_the_frame_at_hand(
    recording: Path, stages: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from workbench import interrupts

    got = []
    with pytest.raises(KeyboardInterrupt):
        for run in opened(recording, stages).runs():
            got.append(run.frame.index)
            if len(got) == 2:
                monkeypatch.setattr(interrupts, "_received", 2)
    assert got == [0, 1]

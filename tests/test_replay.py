"""What a replay leaves behind is whole, whatever ends it, and nobody else can listen."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer
from waiting import PATIENCE_S, until_running

from workbench.recording import Frame
from workbench.session import Options
from workbench_stages.depth_cloud import DepthCloud
from workbench_stages.focus_maps import FocusMaps
from workbench_stages.registration import Registration

Command = Callable[..., Any]
Start = Callable[..., subprocess.Popen[str]]

LONG = 120
EXPECTED = {
    "recorded/near", "recorded/far", "recorded/flat",
    "registration/overlap", "registration/intensity", "registration/drift_px",
    "focus_maps/near", "focus_maps/far",
    "depth_cloud/depth", "depth_cloud/confidence", "depth_cloud/error_mm",
    "world/camera", "world/camera/image", "world/cloud",
    "bench/times/registration", "bench/times/focus_maps", "bench/times/depth_cloud",
    "bench/defects", "bench/parameters", "bench/pipeline",
}  # fmt: skip


def rerun(*arguments: object) -> subprocess.CompletedProcess[str]:
    from workbench.viewer import rerun_program

    return subprocess.run(
        [rerun_program(), *map(str, arguments)], capture_output=True, text=True, timeout=60
    )


def chunks(rrd: Path) -> Iterator[Any]:
    import rerun.chunk

    return iter(rerun.chunk.RrdReader(str(rrd)).stream())


def frames_of(rrd: Path) -> dict[str, set[int]]:
    """Every entity of a saved replay, and the frames in which it or a part of it was logged."""
    found: dict[str, set[int]] = defaultdict(set)
    for chunk in chunks(rrd):
        frames: set[int] = set()
        if not chunk.is_static and "frame" in chunk.timeline_names:
            frames = set(chunk.to_record_batch().column("frame").to_pylist())
        parts = chunk.entity_path.strip("/").split("/")
        for depth in range(1, len(parts) + 1):
            found["/".join(parts[:depth])] |= frames
    return dict(found)


def assert_whole(rrd: Path) -> None:
    ended = rerun("rrd", "verify", rrd)
    assert ended.returncode == 0, ended.stderr
    assert not list(rrd.parent.glob("*.part"))


# -- a saved replay -------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def saved(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A saved replay of frames 3 to 5 of the committed scene."""
    from workbench.commands import replay

    path = tmp_path_factory.mktemp("saved") / "a.rrd"
    with pytest.raises(typer.Exit) as ended:
        replay.run(Options(scene, frames=(3, 6)), path, None, False, None, "640x480")
    assert ended.value.exit_code == 0
    return path


def test_a_saved_replay_is_whole_and_holds_every_result(saved: Path) -> None:
    assert_whole(saved)
    shown = frames_of(saved)
    once = {"bench/parameters", "bench/defects", "bench/pipeline"}
    assert {entity for entity in EXPECTED if entity not in shown} == set()
    assert {entity: shown[entity] for entity in EXPECTED - once if shown[entity] != {3, 4, 5}} == {}


def provenance_in(rrd: Path) -> dict[str, list[str]]:
    """What a saved replay says that it was made from."""
    (told,) = (chunk for chunk in chunks(rrd) if chunk.entity_path == "/__properties/provenance")
    found = told.to_record_batch().to_pydict()
    return {name: values[0] for name, values in found.items() if not name.startswith("rerun.")}


def digest(path: Path) -> str:
    return hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def test_a_saved_replay_says_what_it_was_made_from(
    bench: Command, scene: Path, calibration: Path, tmp_path: Path
) -> None:
    """Held against the files, the defaults and the installed packages themselves."""
    ended = bench(
        "replay", scene, "--save", "a.rrd", "--frames", "0:1", "--json", "a.json",
        "--until", "depth_cloud", "--set", "depth_cloud.min_confidence=0.4",
    )  # fmt: skip
    assert ended.code == 0
    found = provenance_in(tmp_path / "a.rrd")
    code = dict(line.split("=") for line in found.pop("code"))
    stages = [Registration, FocusMaps, DepthCloud]
    changed = {"depth_cloud.min_confidence": 0.4}
    knobs = {
        f"{stage.name}.{name}": value
        for stage in stages
        for name, value in stage.Parameters().model_dump().items()
    }
    libraries = (
        "numpy", "opencv-python-headless", "scipy", "scikit-image", "numba", "rerun-sdk"
    )  # fmt: skip
    assert found == {
        "bench": [version("defocus-workbench")],
        "recording": [digest(scene)],
        "resources": [f"calibration={digest(calibration)}"],
        "preset": ["default"],
        "changed": ["depth_cloud.min_confidence=0.4"],
        "parameters": [f"{address}={value}" for address, value in (knobs | changed).items()],
        "libraries": [*(f"{name}={version(name)}" for name in libraries), "platform=linux"],
    }
    assert list(code) == [stage.name for stage in stages]
    assert len(set(code.values())) == len(stages)
    # The report says the same.
    told = json.loads((tmp_path / "a.json").read_text())["provenance"]
    assert told["code"] == code and told["changed"] == changed and told["frames"] == [0, 1]
    assert told["recording"] == {"name": scene.name, "digest": digest(scene)}
    assert told["resources"]["calibration"]["digest"] == digest(calibration)


PLAIN = """
class Plain(Stage):
    name = "plain"
    needs = (recorded_image("near"), Artifact("near", "float32", "H W"))
    gives = (Artifact("scaled", "float32", "H W"),)
    class Parameters(StageParameters):
        by: float = knob(2.0, "What is multiplied by.", low=0, high=9)
    def compute(self, inputs, parameters):
        return {{"scaled": {factor} * parameters.by * inputs["near"]}}
"""


def test_the_provenance_follows_each_thing_that_is_changed(
    bench: Command, scene: Path, calibration: Path, tmp_path: Path, plugin: Callable[..., Path]
) -> None:
    other_scene, other_calibration = tmp_path / "other.mcap", tmp_path / "other.npz"
    other_scene.write_bytes(scene.with_name("unregistered.mcap").read_bytes())
    with np.load(calibration) as file:
        np.savez(other_calibration, **file)
    stage = plugin(PLAIN.format(factor=1), "plain.py")

    def told(recording: Path = scene, resource: Path = calibration, *more: str) -> dict[str, Any]:
        ended = bench(
            "replay", recording, "--save", "a.rrd", "--frames", "0:1", "--until", "plain",
            "--plugin", stage, "--calibration", resource, *more,
        )  # fmt: skip
        assert ended.code == 0, ended.err
        found = provenance_in(tmp_path / "a.rrd")
        return found | dict(line.split("=") for line in found.pop("code"))

    before = told()

    def changes(after: dict[str, Any]) -> set[str]:
        assert after.keys() == before.keys()
        return {name for name in before if before[name] != after[name]}

    assert changes(told()) == set()
    assert changes(told(other_scene)) == {"recording"}
    assert changes(told(scene, other_calibration)) == {"resources"}
    assert changes(told(scene, calibration, "--set", "plain.by=3")) == {"parameters", "changed"}
    stage.unlink()
    stage = plugin(PLAIN.format(factor=2), "plain.py")
    assert changes(told()) == {"plain"}


def test_a_saved_replay_carries_its_layout(saved: Path) -> None:
    printed = rerun("rrd", "print", saved).stdout
    assert "Blueprint," in printed and "/viewport" in printed


def test_a_second_replay_shows_the_same(bench: Command, scene: Path, tmp_path: Path) -> None:
    for name in "ab":
        bench("replay", scene, "--save", f"{name}.rrd", "--frames", "0:2")
    alike: list[dict[str, list[str]]] = []
    for name in "ab":
        # Row by row: how rows are packed into chunks is a matter of when they were flushed.
        seen: dict[str, list[str]] = defaultdict(list)
        for chunk in chunks(tmp_path / f"{name}.rrd"):
            if chunk.entity_path.startswith(("/depth_cloud", "/world", "/focus", "/regist")):
                batch = chunk.to_record_batch()
                values = [c for c in batch.schema.names if not c.startswith("rerun.")]
                seen[chunk.entity_path] += map(str, batch.select(values).to_pylist())
        alike.append(seen)
    assert alike[0].keys() == alike[1].keys()
    for entity, values in alike[0].items():
        assert sorted(values) == sorted(alike[1][entity]), entity


def test_without_a_display_it_says_so_and_saves(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    ended = bench("replay", scene, "--frames", "0:1")
    assert ended.code == 0
    assert "no display" in ended.mistake and "scene.rrd" in ended.mistake
    assert "rerun scene.rrd" in ended.mistake
    assert_whole(tmp_path / "scene.rrd")


def test_a_name_is_told_as_it_is(bench: Command, scene: Path, tmp_path: Path) -> None:
    """Brackets are no markup, and a long name is not broken: it is there to be copied."""
    name = "a [red] recording with a very long name, such as those that come out of a robot cell"
    recording = tmp_path / f"{name}.mcap"
    recording.write_bytes(scene.read_bytes())
    ended = bench("replay", recording, "--frames", "0:1", "--until", "registration")
    assert f"rerun '{name}.rrd'" in ended.mistake or f"rerun {name}.rrd" in ended.mistake
    assert f"wrote {name}.rrd" in ended.out


# -- interruptions --------------------------------------------------------------------------------


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupted_replay_leaves_a_whole_file(
    started: Start,
    long_recordings: dict[int, Path],
    tmp_path: Path,
    sent: signal.Signals,
    code: int,
) -> None:
    child = started("replay", long_recordings[LONG], "--save", "a.rrd", "--json", "a.json")
    part = tmp_path / "a.rrd.part"
    until_running(
        child, lambda: part.exists() and part.stat().st_size > 1 << 20, tmp_path / "stderr"
    )
    child.send_signal(sent)
    assert child.wait(PATIENCE_S) == code
    assert_whole(tmp_path / "a.rrd")
    report = json.loads((tmp_path / "a.json").read_text())
    assert report["interrupted"] and 0 < report["frames"] < LONG
    # Every frame that is reported is there, in full but for the one in which it was stopped.
    shown = frames_of(tmp_path / "a.rrd")
    assert shown["depth_cloud/confidence"] >= set(range(report["frames"] - 1))
    assert "Traceback" not in (tmp_path / "stderr").read_text()
    assert "interrupted" in (tmp_path / "stdout").read_text()


def has_loaded(child: subprocess.Popen[str], library: str) -> bool:
    return library in Path(f"/proc/{child.pid}/maps").read_text()


def takes_sigterm(child: subprocess.Popen[str]) -> bool:
    """Whether a handler of the program's own is in place, from the kernel's mask of them."""
    status = Path(f"/proc/{child.pid}/status").read_text()
    caught = re.search(r"SigCgt:\s*([0-9a-f]+)", status)
    return caught is not None and bool(int(caught[1], 16) >> (signal.SIGTERM - 1) & 1)


AT_ONCE: Callable[[subprocess.Popen[str]], bool] = lambda _: True  # noqa: E731


@pytest.mark.linux
@pytest.mark.parametrize(
    ("begun", "codes"),
    [
        # Until the handler is in place the system's own takes it, with the same meaning.
        pytest.param(AT_ONCE, {143, -signal.SIGTERM}, id="at once"),
        pytest.param(takes_sigterm, {143}, id="with a handler"),
        pytest.param(lambda child: has_loaded(child, "_multiarray_umath"), {143}, id="with numpy"),
        pytest.param(lambda child: has_loaded(child, "rerun_bindings"), {143}, id="with rerun"),
    ],
)
def test_a_replay_that_is_ended_before_it_began_is_silent(
    started: Start,
    scene: Path,
    tmp_path: Path,
    begun: Callable[[subprocess.Popen[str]], bool],
    codes: set[int],
) -> None:
    child = started("replay", scene, "--save", "a.rrd")
    until_running(child, lambda: begun(child), tmp_path / "stderr")
    child.send_signal(signal.SIGTERM)
    assert child.wait(PATIENCE_S) in codes
    # An import that is ended leaves its file to the interpreter, which says so if warnings are on.
    told = (tmp_path / "stderr").read_text().splitlines()
    assert [line for line in told if "ResourceWarning" not in line] == []
    # What was begun until then is whole, or there is nothing.
    if (tmp_path / "a.rrd").exists():
        assert_whole(tmp_path / "a.rrd")
    assert not list(tmp_path.glob("*.part"))


SWALLOWING = """
import time
from pathlib import Path
class Deaf(Stage):
    name = "deaf"
    needs = (recorded_image("near"),)
    gives = (Artifact("heard", "float32", "H W"),)
    def compute(self, inputs, parameters):
        first = not Path("inside").exists()
        Path("inside").touch()
        try:
            time.sleep(600 if first else 0)
        except BaseException:
            raise ImportError("initialization failed") from None
        return {"heard": np.zeros((2, 2), np.float32)}
"""


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_no_stage_can_swallow_an_interruption(
    started: Start,
    scene: Path,
    tmp_path: Path,
    plugin: Callable[[str], Path],
    sent: signal.Signals,
    code: int,
) -> None:
    """As Open3D does: interrupted while it is imported it raises an ImportError of its own."""
    path = plugin(SWALLOWING)
    child = started(
        "replay", scene, "--frames", "0:4", "--until", "deaf", "--plugin", path, "--save", "a.rrd"
    )
    until_running(child, (tmp_path / "inside").exists, tmp_path / "stderr")
    child.send_signal(sent)
    ended = child.wait(PATIENCE_S)
    assert "interrupted" in (tmp_path / "stdout").read_text()
    assert ended == code
    assert_whole(tmp_path / "a.rrd")


# -- stages that fail -----------------------------------------------------------------------------


FAILING = """
class Picky(Stage):
    name = "picky"
    needs = (recorded_image("near"), Artifact("focus_near", "float32", "H W"))
    gives = (Artifact("picked", "float32", "H W"),)
    def compute(self, inputs, parameters):
        if int(inputs["near_image"].sum(dtype="int64")) == {total} and "{where}" == "compute":
            raise ValueError("frame is too picky")
        return {{"picked": inputs["focus_near"].copy()}}
    def log(self, recording, logged):
        import rerun as rr
        if "{where}" == "log":
            raise ValueError("frame is too picky")
        recording.log("picky/picked", rr.Image(logged.artifacts["picked"]))
    def views(self, logged):
        if "{where}" == "views":
            raise ValueError("frame is too picky")
        return ()
    def scorer(self):
        from workbench import Scorer
        class Judge(Scorer):
            def add(self, truth, artifacts):
                if "{where}" == "scorer":
                    raise ValueError("frame is too picky")
                return {{}}
            def summary(self):
                return []
        return Judge()
class After(Stage):
    name = "after"
    needs = (Artifact("picked", "float32", "H W"),)
    gives = (Artifact("late", "float32", "H W"),)
    def compute(self, inputs, parameters):
        return {{"late": inputs["picked"].copy()}}
"""


def test_a_stage_that_fails_on_one_frame_is_named_and_hides_nothing(
    bench: Command,
    scene: Path,
    tmp_path: Path,
    plugin: Callable[[str], Path],
    first_frames: list[Frame],
) -> None:
    total = int(first_frames[2].images["near"].sum(dtype="int64"))
    path = plugin(FAILING.format(total=total, where="compute"))
    common = ("replay", scene, "--frames", "1:4", "--plugin", path)
    ended = bench(*common, "--save", "a.rrd", "--json", "a.json")
    assert ended.code == 1 and ended.err == ""
    failed = [line for line in ended.out.splitlines() if "FAILED" in line]
    assert any("picky" in line and "too picky" in line and "1 frames" in line for line in failed)
    assert any("after" in line and "picky failed" in line for line in failed)
    failures = json.loads((tmp_path / "a.json").read_text())["failures"]
    assert {one["stage"]: one["frames"] for one in failures} == {"picky": 1, "after": 1}
    shown = frames_of(tmp_path / "a.rrd")
    # On frame 2 it is cleared, or frame 1's picture would stand there as if it were frame 2's.
    assert shown["picky/picked"] == {1, 2, 3}
    cleared = [
        chunk
        for chunk in chunks(tmp_path / "a.rrd")
        if chunk.entity_path == "/picky/picked" and "Clear" in str(chunk.to_record_batch().schema)
    ]
    assert cleared
    for entity in ("depth_cloud/confidence", "focus_maps/near", "registration/overlap"):
        assert shown[entity] == {1, 2, 3}
    documents = [
        str(chunk.to_record_batch().to_pydict())
        for chunk in chunks(tmp_path / "a.rrd")
        if chunk.entity_path == "/bench/defects"
    ]
    assert any("too picky" in document for document in documents)


@pytest.mark.parametrize("where", ["log", "views", "scorer"])
def test_whatever_a_stage_fails_in_is_named_and_hides_nothing(
    bench: Command, scene: Path, tmp_path: Path, plugin: Callable[[str], Path], where: str
) -> None:
    path = plugin(FAILING.format(total=-1, where=where))
    ended = bench("replay", scene, "--frames", "0:2", "--plugin", path, "--save", "a.rrd")
    assert_whole(tmp_path / "a.rrd")
    assert frames_of(tmp_path / "a.rrd")["world/cloud"] == {0, 1}
    assert ended.code == 1 and "Traceback" not in ended.err
    assert any(
        "FAILED" in line and "picky" in line and "too picky" in line
        for line in ended.out.splitlines()
    )


# -- memory ---------------------------------------------------------------------------------------


MEASURE = """
import resource, sys
from contextlib import nullcontext
from pathlib import Path
from workbench.bridge import Bridge
from workbench.pipeline import ResultStore
from workbench.report import RunReport
from workbench.session import Options, Session
from workbench.viewer import Destinations, opened

path, save = sys.argv[1:]
# The store is bounded, and would fill up in the long replay only.
session = Session.open(Options(Path(path)), ResultStore(8 << 20))
report = RunReport(session)
with opened(Destinations(save=Path(save)), "id") if save else nullcontext() as stream:
    bridge = Bridge(session, stream.recording) if save else None
    for run in session.runs():
        scores = report.add(run)
        if bridge:
            bridge.log(run, report, scores)
print(report.frames, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.process
@pytest.mark.slow
@pytest.mark.parametrize("save", [False, True], ids=["no sink", "a file"])
def test_a_replay_keeps_nothing_of_the_frames_that_are_done(
    long_recordings: dict[int, Path], tmp_path: Path, save: bool
) -> None:
    """Its memory may not grow by what they hold, several megabytes each; how far it grows with
    what the viewer's library keeps of a file, and with the machine's load, is another matter."""
    megabytes, written = {}, {}
    for count in (20, 60):
        target = tmp_path / f"{count}.rrd"
        ended = subprocess.run(
            [sys.executable, "-c", MEASURE, long_recordings[count], target if save else ""],
            capture_output=True,
            text=True,
        )
        assert ended.returncode == 0, ended.stderr
        frames, megabytes[count] = map(int, ended.stdout.split())
        assert frames == count
        written[count] = target.stat().st_size >> 20 if save else 0
    # Compressed, 40 frames take 100 MB; a third of that is what a file costs.
    bound = 0.7 * (written[60] - written[20]) if save else 25
    assert megabytes[60] - megabytes[20] < bound, (megabytes, written)


# -- pictures and sockets -------------------------------------------------------------------------


@pytest.mark.vulkan
@pytest.mark.slow
def test_a_screenshot_without_a_screen_shows_something(
    bench: Command, scene: Path, tmp_path: Path
) -> None:
    ended = bench(
        "replay", scene, "--frames", "0:1", "--screenshot", "a.png", "--window", "960x540"
    )
    assert ended.code == 0 and "wrote a.png" in ended.out
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape[1] >= 960 and picture.shape[1] * 540 == picture.shape[0] * 960
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 1000
    assert (picture.max(axis=2) > 40).mean() > 0.05
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]


def descendants(pid: int) -> set[int]:
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue  # It has ended meanwhile.
    family = {pid}
    while more := {child for child, parent in parents.items() if parent in family} - family:
        family |= more
    return family


def listening(pids: set[int]) -> list[str]:
    """The addresses on which these processes listen, from the tables of the Linux kernel."""
    inodes = set()
    for pid in pids:
        for link in Path(f"/proc/{pid}/fd").iterdir():
            if match := re.fullmatch(r"socket:\[(\d+)\]", str(link.readlink())):
                inodes.add(match[1])
    addresses = []
    for table, family, width in (("tcp", socket.AF_INET, 8), ("tcp6", socket.AF_INET6, 32)):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == "0A" and fields[9] in inodes:
                words = fields[1][:width]
                packed = b"".join(bytes.fromhex(words[i : i + 8])[::-1] for i in range(0, width, 8))
                addresses.append(socket.inet_ntop(family, packed))
    return addresses


@pytest.mark.linux
def test_a_replay_for_the_browser_listens_on_loopback_alone(
    started: Start, scene: Path, tmp_path: Path
) -> None:
    child = started("replay", scene, "--frames", "0:1", "--until", "registration", "--web")
    told = tmp_path / "stderr"
    try:
        until_running(child, lambda: "serving" in told.read_text(), told)
        family = descendants(child.pid)
        assert len(family) >= 2
        addresses = listening(family)
        assert len(addresses) >= 2 and set(addresses) <= {"127.0.0.1", "::1"}, addresses
        url = re.search(r"http://127\.0\.0\.1:(\d+)\S*", told.read_text())
        assert url is not None
        with socket.create_connection(("127.0.0.1", int(url[1])), timeout=5) as client:
            client.sendall(b"GET / HTTP/1.0\r\n\r\n")
            assert b"200" in client.recv(64)
    finally:
        child.send_signal(signal.SIGINT)
    assert child.wait(PATIENCE_S) == 0
    # Nothing is left: the viewer has ended before the replay has.
    left = [pid for pid in family - {child.pid} if Path(f"/proc/{pid}").exists()]
    for pid in left:
        os.kill(pid, signal.SIGKILL)
    assert left == []
    assert "Traceback" not in told.read_text()

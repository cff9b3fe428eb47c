"""What the tests of the bench share: the committed recordings, twins of them, and the commands."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from mcap_fixtures import PERIOD_NS, START_NS, Recorder

from workbench.recording import Frame, Recording

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "recordings" / "scene.mcap"
CALIBRATION = SCENE.with_name("scene.calibration.npz")
MODELS = SCENE.with_name("scene.models.npz")


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        return json.loads(self.out)

    @property
    def mistake(self) -> str:
        """The one line that tells of a user's mistake; there must be no other."""
        lines = self.err.splitlines()
        assert len(lines) == 1, f"expected one line on stderr, found:\n{self.err}\n{self.out}"
        assert "Traceback" not in self.out
        return lines[0]


Command = Callable[..., Ended]


@pytest.fixture(autouse=True)
def _without_display(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def bench(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Iterable[Command]:
    """``workbench`` in this process, in a folder of its own."""
    from workbench.cli import main

    handlers = {which: signal.getsignal(which) for which in (signal.SIGTERM, signal.SIGINT)}
    monkeypatch.chdir(tmp_path)

    def run(*arguments: object) -> Ended:
        monkeypatch.setattr(sys, "argv", ["workbench", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        code = ended.value.code
        assert code is None or isinstance(code, int)
        return Ended(code or 0, *capsys.readouterr())

    yield run
    for which, handler in handlers.items():
        signal.signal(which, handler)


@pytest.fixture
def started(tmp_path: Path) -> Iterable[Callable[..., subprocess.Popen[str]]]:
    """Starts ``workbench`` as a program in a folder of its own; its stderr goes to a file there."""
    children: list[subprocess.Popen[str]] = []

    def start(*arguments: object) -> subprocess.Popen[str]:
        with (tmp_path / "stdout").open("w") as out, (tmp_path / "stderr").open("w") as err:
            child = subprocess.Popen(
                [sys.executable, "-c", "from workbench.cli import main; main()"]
                + [str(argument) for argument in arguments],
                cwd=tmp_path,
                stdout=out,
                stderr=err,
                text=True,
                env=os.environ | {"PYTHONWARNINGS": "default"},
                # A shell's background job ignores Ctrl-C, and its children with it.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )
        children.append(child)
        return child

    yield start
    for child in children:
        child.kill()
        child.wait()


@pytest.fixture(scope="session")
def scene() -> Path:
    """12 piles with near, far and flat images, ground truth, and a calibration beside them."""
    return SCENE


@pytest.fixture(scope="session")
def calibration() -> Path:
    """The calibration of :func:`scene`."""
    return CALIBRATION


@pytest.fixture(scope="session")
def first_frames() -> list[Frame]:
    """The first frames of the committed recording, decoded."""
    return list(Recording.open(SCENE).frames(["near", "far"], ["flat"], 0, 3))


def write_again(path: Path, frames: list[Frame], count: int, dialect: str = "protobuf") -> Path:
    """``count`` frames with the images of ``frames``, over and over, with stamps of their own."""
    info = "camera_info" if dialect == "ros2" else "calibration"
    with Recorder(path, dialect) as recorder:
        camera = frames[0].cameras["near"]
        for channel in ("near", "far"):
            recorder.camera(
                f"/camera/{channel}/{info}",
                START_NS,
                camera.width,
                camera.height,
                f=float(camera.K[0, 0]),
            )
        for number in range(count):
            for channel, image in frames[number % len(frames)].images.items():
                stamp = START_NS + (number + 1) * PERIOD_NS
                recorder.image(f"/camera/{channel}/image", stamp, image, "mono8")
    return path


@pytest.fixture(scope="session")
def twins(tmp_path_factory: pytest.TempPathFactory, first_frames: list[Frame]) -> dict[str, Path]:
    """Three frames of the committed scene in each dialect, calibration and models beside."""
    made = {}
    for dialect in ("protobuf", "json", "ros2"):
        folder = tmp_path_factory.mktemp(dialect)
        made[dialect] = write_again(folder / "twin.mcap", first_frames, 3, dialect)
        (folder / "calibration.npz").write_bytes(CALIBRATION.read_bytes())
        (folder / "models.npz").write_bytes(MODELS.read_bytes())
    return made


@pytest.fixture(scope="session")
def long_recordings(
    tmp_path_factory: pytest.TempPathFactory, first_frames: list[Frame]
) -> dict[int, Path]:
    """The same images as a short and as a long recording, by the number of frames."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "calibration.npz").write_bytes(CALIBRATION.read_bytes())
    return {
        count: write_again(folder / f"long{count}.mcap", first_frames, count) for count in (20, 120)
    }


@pytest.fixture
def plugin(tmp_path: Path) -> Callable[[str], Path]:
    """Writes a plugin file whose stages' source is given; each file has a name of its own."""
    written = 0

    def write(source: str, name: str | None = None) -> Path:
        nonlocal written
        written += 1
        stem = re.sub(r"\W", "_", f"{tmp_path.name}_{written}")
        path = tmp_path / (name or f"plugin_{stem}.py")
        path.write_text(PLUGIN_HEADER + source, encoding="utf-8")
        return path

    return write


PLUGIN_HEADER = """\
import numpy as np
from workbench import Artifact, Stage, StageParameters, knob
from workbench.stage import WARNINGS, recorded_image

"""

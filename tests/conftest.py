"""What the tests of the bench share: the committed recordings, twins of them, and the commands.

Also what a test needs of the machine, and which of them run beside each other; see CONTRIBUTING.md.
"""

from __future__ import annotations

import functools
import importlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import pytest
import rooms
from mcap_fixtures import PERIOD_NS, START_NS, Recorder
from waiting import PATIENCE_S

from workbench.recording import Frame, Recording

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "recordings" / "scene.mcap"
CALIBRATION = SCENE.with_name("scene.calibration.npz")
MODELS = SCENE.with_name("scene.models.npz")

# -- which tests run, and where -------------------------------------------------------------------


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--no-skips",
        action="store_true",
        help="a test that would be skipped fails: for a machine that must have everything (CI)",
    )


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    for room, says in rooms.ROOMS.items():
        config.addinivalue_line("markers", f"{room}: {says}")
    # Of pytest-xdist, which need not be there: with -n the tests of a file stay together.
    if config.getoption("dist", "no") == "load":
        config.option.dist = "loadgroup"
        config.option.loadscopereorder = False


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.stem in rooms.FILES:
            item.add_marker(rooms.FILES[item.path.stem])
        if "browser" in item.keywords:
            item.add_marker("slow")
        if "started" in getattr(item, "fixturenames", ()):
            item.add_marker("process")
    # Told so in the processes of pytest-xdist alone.
    if not getattr(config.option, "loadgroup", False):
        return
    # What a file makes once is made in one process; what draws with the processor alone is drawn
    # in one as well, for two at once would take turns.
    long = {item.path for item in items if "slow" in item.keywords}
    for item in items:
        drawn = any(name in item.keywords for name in ("browser", "vulkan"))
        item.add_marker(pytest.mark.xdist_group("drawn" if drawn else item.path.stem))
    # What takes longest comes first, so that both end together.
    items.sort(key=lambda item: ("browser" not in item.keywords, item.path not in long))


# -- what a test needs of the machine -------------------------------------------------------------


def missing_browser() -> str:
    """Why there is no browser for the tests of the pages; empty where there is one."""
    if reason := missing_module("playwright.sync_api"):
        return reason
    try:
        found = chromium()
    except Exception as error:
        return f"Playwright's driver does not start: {str(error).splitlines()[0]}"
    return "" if found else "there is no Chromium (playwright install chromium, or the system's)"


@functools.cache
def chromium() -> str | None:
    """The program of a Chromium: Playwright's own, or the system's."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        own = playwright.chromium.executable_path
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return own if Path(own).is_file() else next(filter(None, map(shutil.which, names)), None)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A Chromium for the pages of a test file; it keeps what it compiled of the viewer.

    Not for the whole session: Playwright leaves its event loop running in this thread.
    """
    from playwright.sync_api import sync_playwright

    flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
    with sync_playwright() as playwright:
        opened = playwright.chromium.launch_persistent_context(
            tmp_path_factory.mktemp("chromium"),
            executable_path=chromium(),
            args=[*flags, "--enable-unsafe-swiftshader"],
        )
        opened.set_default_timeout(PATIENCE_S * 1e3)
        yield opened
        opened.close()


def missing_vulkan() -> str:
    """Why the viewer cannot draw without a screen; empty where it can."""
    folders = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")
    found = any(path for folder in folders for path in Path(folder).glob("*.json"))
    return "" if found else "there is no Vulkan driver (Debian: mesa-vulkan-drivers)"


def missing_linux() -> str:
    """Why it cannot be told what processes are at; empty where it can."""
    return "" if Path("/proc/net/tcp").exists() else "there is no /proc as Linux has it"


@functools.cache
def missing_module(name: str) -> str:
    """Why a module cannot be imported, be it for a library of the system; empty where it can."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            importlib.import_module(name)
    except (ImportError, OSError) as error:
        return f"{name} cannot be imported: {str(error).splitlines()[0]}"
    return ""


MACHINE: dict[str, Callable[[], str]] = {
    "browser": missing_browser,
    "vulkan": missing_vulkan,
    "linux": missing_linux,
}
"""By marker, what a test needs beside Python's packages; the marker ``needs`` names packages."""


def missing(item: pytest.Item) -> str:
    """Why a test cannot run on this machine; empty where it can."""
    reasons = [find() for marker, find in MACHINE.items() if item.get_closest_marker(marker)]
    # Once each, and those of a test before those of its file: some import only in their order.
    named = dict.fromkeys(name for marker in item.iter_markers("needs") for name in marker.args)
    return "; ".join(filter(None, [*reasons, *map(missing_module, named)]))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    if reason := missing(item):
        pytest.skip(reason)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item,
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    return told(item.config, (yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    return told(collector.config, (yield))


Report = TypeVar("Report", pytest.TestReport, pytest.CollectReport)


def told(config: pytest.Config, report: Report) -> Report:
    """The report as it is; with --no-skips a skip is a failure."""
    if config.getoption("--no-skips") and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"
        report.longrepr = f"skipped, with --no-skips: {report.longrepr}"
    return report


# -- recordings and commands ----------------------------------------------------------------------


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
    """The same images as recordings of different lengths, by the number of frames."""
    folder = tmp_path_factory.mktemp("long")
    (folder / "calibration.npz").write_bytes(CALIBRATION.read_bytes())
    return {
        count: write_again(folder / f"long{count}.mcap", first_frames, count)
        for count in (20, 60, 120)
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


@pytest.fixture
def held(plugin: Callable[[str], Path]) -> Path:
    """A plugin whose stage stops in the fifth frame until it is interrupted: see ``inside``."""
    return plugin(HELD)


HELD = """
import time
from pathlib import Path
class Held(Stage):
    name = "held"
    needs = (recorded_image("near"), Artifact("depth_m", "float32", "H W"))
    gives = (Artifact("held", "float32", "H W"),)
    def compute(self, inputs, parameters):
        # The first call of all is done twice.
        with Path("calls").open("a") as calls:
            calls.write(".")
        if Path("calls").stat().st_size > 5:
            Path("inside").touch()
            time.sleep(600)
        return {"held": inputs["depth_m"].copy()}
"""

PLUGIN_HEADER = """\
import numpy as np
from workbench import Artifact, Stage, StageParameters, knob
from workbench.stage import WARNINGS, recorded_image

"""

"""The live page in a browser: Rerun's own viewer beside the knobs, in headless Chromium."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Command

import workbench

sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")

FLAGS = (
    "--no-sandbox",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
# Software rendering pays for each pixel.
SIZE = {"width": 1100, "height": 620}
SECONDS = 60.0


def chromium(playwright: Any) -> str:
    """A Chromium to use, or a skipped test."""
    own = Path(playwright.chromium.executable_path)
    found = str(own) if own.is_file() else shutil.which("chromium") or shutil.which("chrome")
    if found is None:
        pytest.skip("there is no Chromium (playwright install chromium, or the system's)")
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with sync_api.sync_playwright() as playwright:
        opened = playwright.chromium.launch(executable_path=chromium(playwright), args=list(FLAGS))
        yield opened
        opened.close()


@dataclass
class Host:
    """The program that serves the page."""

    child: subprocess.Popen[str]
    url: str
    artifacts: Path
    recording: Path

    def end(self) -> dict[str, np.ndarray]:
        """Ctrl-C; returns the artifacts that were live."""
        self.child.send_signal(signal.SIGINT)
        assert self.child.wait(30) == 0
        with np.load(self.artifacts) as saved:
            return dict(saved)


@pytest.fixture
def host(tmp_path: Path, twins: dict[str, Path]) -> Iterator[Host]:
    recording = tmp_path / "scene.mcap"
    for file in twins["protobuf"].parent.iterdir():
        target = recording if file.suffix == ".mcap" else tmp_path / file.name
        target.write_bytes(file.read_bytes())
    artifacts = tmp_path / "live.npz"
    child = subprocess.Popen(
        [sys.executable, Path(__file__).with_name("tune_host.py"), recording, artifacts],
        stdout=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert child.stdout is not None
    yield Host(child, child.stdout.readline().strip(), artifacts, recording)
    child.kill()
    child.wait()
    child.stdout.close()


class Tab:
    """A page as a person uses it."""

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        page.set_default_timeout(SECONDS * 1e3)
        page.goto(url)
        self.wait_for_viewer()

    def wait_for_viewer(self) -> None:
        self.page.wait_for_function(
            "document.getElementById('viewer-cover')?.style.display === 'none'"
        )

    @property
    def address(self) -> str:
        """The page's address as it is now; Playwright's own is that of the last event it saw."""
        try:
            return str(self.page.evaluate("location.href"))
        except sync_api.Error:
            # The page is loading again, as it does after a long stall.
            return ""

    def stages(self) -> dict[str, str]:
        """What each stage's head says of whether it ran."""
        heads = self.page.locator(".stage-head")
        return {
            head.locator(".stage-name").inner_text(): head.locator(".ran").inner_text()
            for head in heads.all()
        }

    def open_stage(self, name: str) -> None:
        self.page.locator(f".stage-name:text-is('{name}')").click()
        self.page.locator(".knob-name >> visible=true").first.wait_for()

    def knob(self, name: str) -> Any:
        return self.page.locator(f".knob:has(.knob-name:text-is('{name}'))").locator("visible=true")

    def drag(self, name: str, share: float, steps: int = 12) -> None:
        """Drag a knob's slider to a share of its range, with the moves of a hand."""
        slider = self.knob(name).locator(".knob-slider")
        slider.scroll_into_view_if_needed()
        box = slider.bounding_box()
        thumb = slider.locator(".q-slider__thumb").bounding_box()
        y = box["y"] + box["height"] / 2
        start, stop = thumb["x"] + thumb["width"] / 2, box["x"] + share * box["width"]
        self.page.mouse.move(start, y)
        self.page.mouse.down()
        for k in range(1, steps + 1):
            self.page.mouse.move(start + (stop - start) * k / steps, y)
        self.page.mouse.up()

    def picture(self) -> np.ndarray:
        """The viewer's canvas as it is at rest."""
        self.page.mouse.move(5, 5)
        # A message lies over the canvas for some seconds.
        self.page.wait_for_function("!document.querySelector('.q-notification')")
        before = b""
        for _ in range(40):
            now = self.page.locator("#viewer").screenshot()
            if now == before:
                break
            before = now
            time.sleep(0.3)
        return cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR).astype(float)

    def until(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + SECONDS
        while not condition():
            assert time.monotonic() < deadline, what
            time.sleep(0.1)

    def says(self, text: str) -> None:
        """Wait for a message on the page."""
        self.page.locator(f".q-notification:has-text('{text}')").first.wait_for()

    def click_pixel(self, at: tuple[float, float]) -> tuple[int, int]:
        """Click at shares of the canvas; returns the pixel whose story is told."""
        box = self.page.locator("#viewer").bounding_box()
        title = self.page.locator(".story-head .story-title")
        before = title.inner_text() if title.is_visible() else ""
        for _ in range(4):
            self.page.mouse.click(box["x"] + at[0] * box["width"], box["y"] + at[1] * box["height"])
            # The canvas may become narrower for the story; the next click must find it at rest.
            self.page.wait_for_timeout(2500)
            if title.is_visible() and title.inner_text() != before:
                break
        x, y = title.inner_text().removeprefix("Why pixel ").split(", ")
        return int(x), int(y)


def differ(a: np.ndarray, b: np.ndarray) -> int:
    """Pixels that are visibly not the same."""
    return int((np.abs(a - b).max(axis=2) > 40).sum())


def test_a_session_of_tuning(browser: Any, host: Host, bench: Command, tmp_path: Path) -> None:
    tab = Tab(browser.new_page(viewport=SIZE), host.url)
    assert "token" not in tab.address
    tab.open_stage("linked_edges")
    tab.until(lambda: "focus=linked_edges" in tab.address, "the address follows")
    first = tab.picture()
    tab.page.get_by_role("button", name="Pin as A").click()

    # A drag changes the picture, and nothing upstream runs again.
    tab.drag("min_weight", 1.0)
    tab.until(lambda: "min_weight%3D100" in tab.address, "the drag arrives")
    tab.until(lambda: tab.stages()["linked_edges"] == "ran", "the stage ran")
    upstream = ("registration", "focus_maps", "depth_cloud", "edge_stack")
    assert [tab.stages()[name] for name in upstream] == ["kept"] * 4
    second = tab.picture()
    assert differ(first, second) > 300
    tab.page.get_by_role("button", name="Pin as B").click()

    # Undo, by the keyboard, brings back both the value and the picture; a whole drag is one step.
    tab.page.keyboard.press("Control+z")
    tab.until(lambda: "min_weight" not in tab.address.partition("pinA")[0], "the value is back")
    tab.until(lambda: differ(first, tab.picture()) < 30, "the picture is back")

    # A and B are flipped in place.
    views = tab.page.locator(".views button")
    views.nth(2).click()
    tab.until(lambda: differ(second, tab.picture()) < 30, "B is shown")
    views.nth(1).click()
    tab.until(lambda: differ(first, tab.picture()) < 30, "A is shown")
    views.nth(4).click()
    tab.until(lambda: min(differ(p, tab.picture()) for p in (first, second)) > 1000, "B less A")
    views.nth(0).click()
    tab.until(lambda: differ(first, tab.picture()) < 30, "now is shown")

    # The first click opens the story beside the canvas; two more tell how the picture lies on it
    # now, and the next asks for an edge's pixel.
    tab.click_pixel((0.8, 0.3))
    near, far = (0.80, 0.34), (0.84, 0.40)
    a, b = tab.click_pixel(near), tab.click_pixel(far)
    edges = next(workbench.open(host.recording).runs()).artifacts["edges_linked"]
    ys, xs = np.nonzero(edges)
    away = np.hypot(xs - (a[0] + b[0]) / 2, ys - (a[1] + b[1]) / 2)
    x, y = int(xs[away.argmin()]), int(ys[away.argmin()])
    at = (
        near[0] + (x - a[0]) * (far[0] - near[0]) / (b[0] - a[0]),
        near[1] + (y - a[1]) * (far[1] - near[1]) / (b[1] - a[1]),
    )
    asked = tab.click_pixel(at)
    assert np.hypot(asked[0] - x, asked[1] - y) <= 3
    story = tab.page.locator(".story-text").inner_text()
    assert "linked_edges" in story and "gradient" in story

    # Typed, not half-typed; then saved with a reason, and replayed to the same artifacts.
    field = tab.knob("cone_deg").locator("input")
    field.fill("4")
    assert "cone_deg" not in tab.address
    field.fill("41.5")
    field.press("Enter")
    tab.until(lambda: "cone_deg%3D41.5" in tab.address, "what was typed is taken")
    tab.page.get_by_role("button", name="Save").click()
    tab.page.locator(".save").get_by_role("button", name="Save").click()
    refused = tab.page.locator(".save .refused")
    tab.until(lambda: "reason" in refused.inner_text(), "a reason is asked for")
    tab.page.locator(".save textarea").fill("the cone let in what lies beside")
    tab.page.locator(".save").get_by_role("button", name="Save").click()
    tuned = tmp_path / "scene.tuned.toml"
    tab.until(tuned.is_file, "it is saved")
    assert "the cone let in" in tuned.read_text()
    live = host.end()
    ended = bench(
        "export", host.recording, "--config", tuned, "--frames", "0:1", "--to", tmp_path / "out"
    )
    assert ended.code == 0, ended.err
    with np.load(tmp_path / "out" / "frame_000000.npz") as exported:
        assert set(exported) >= {"edges_linked", "labels", "depth_m"}
        for name in set(exported) & set(live):
            # Bit for bit: NaN in a structured array is not equal to itself.
            assert exported[name].dtype == live[name].dtype, name
            assert exported[name].shape == live[name].shape, name
            assert exported[name].tobytes() == live[name].tobytes(), name


def test_what_goes_wrong_is_told_and_survived(browser: Any, host: Host) -> None:
    context = browser.new_context(viewport=SIZE)
    tab = Tab(context.new_page(), host.url + "&set=linked_edges.cone_deg%3D400")
    tab.says("linked_edges.cone_deg")
    assert "cone_deg" not in tab.address
    tab.page.goto(host.url + "&set=linked_edges.nothing%3D1")
    tab.says("no parameter")
    tab.wait_for_viewer()

    # A value out of range and half a number are refused, and the field shows what is.
    tab.open_stage("linked_edges")
    field = tab.knob("reach").locator("input")
    for typed, says in (("1000", "linked_edges.reach"), ("1.2.3", "expected a number")):
        field.fill(typed)
        field.press("Enter")
        tab.says(says)
        tab.until(lambda: field.input_value() == "15", "the value stays")

    # A second tab shows the same state, live.
    other = Tab(context.new_page(), tab.page.url)
    tab.page.bring_to_front()
    tab.drag("reach", 1.0)
    other.until(lambda: "reach%3D60" in other.address, "the other tab follows")
    other.page.close()

    # A connection that is lost comes again, with its pictures.
    tab.page.evaluate("bench.drop()")
    tab.wait_for_viewer()
    assert tab.picture().std() > 10

    # A recording that is gone: what is kept is shown, what is not is told, the page lives on.
    box = tab.page.locator(".frames").bounding_box()
    y = box["y"] + box["height"] / 2
    label = tab.page.locator(".frame-label")
    tab.page.mouse.click(box["x"] + box["width"] - 2, y)
    tab.until(lambda: "frame 2" in label.inner_text(), "the last frame is shown")
    host.recording.unlink()
    tab.page.mouse.click(box["x"] + box["width"] / 2, y)
    banner = tab.page.locator(".banner")
    banner.wait_for()
    assert "scene.mcap: frame 1 cannot be read" in banner.inner_text()
    tab.page.mouse.click(box["x"] + 2, y)
    banner.wait_for(state="hidden")
    assert json.loads(tab.page.evaluate("JSON.stringify(bench.pieces() > 0)"))

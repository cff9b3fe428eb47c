"""The live page in a browser: Rerun's own viewer beside the knobs, in headless Chromium."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from conftest import Command
from waiting import PATIENCE_S, until, until_running

import workbench

pytestmark = [pytest.mark.browser, pytest.mark.process]

# Software rendering pays for each pixel.
SIZE = {"width": 1000, "height": 560}


class Host:
    """The program that serves the page, for as long as the tests of this file take."""

    def __init__(self, folder: Path, like: Path) -> None:
        self.recording, self.artifacts = folder / "scene.mcap", folder / "live.npz"
        for file in like.parent.iterdir():
            target = self.recording if file.suffix == ".mcap" else folder / file.name
            target.write_bytes(file.read_bytes())
        with (folder / "stdout").open("w") as out:
            self.child = subprocess.Popen(
                [
                    *(sys.executable, Path(__file__).with_name("tune_host.py")),
                    *(self.recording, self.artifacts),
                ],
                stdout=out,
                text=True,
                cwd=folder,
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
            )
        said = folder / "stdout"
        until_running(self.child, lambda: said.read_text().endswith("\n"))
        self.url = said.read_text().strip()

    def live(self) -> dict[str, np.ndarray]:
        """The artifacts as they are now."""
        self.artifacts.unlink(missing_ok=True)
        self.child.send_signal(signal.SIGUSR1)
        until_running(self.child, self.artifacts.exists)
        with np.load(self.artifacts) as saved:
            return dict(saved)


@pytest.fixture(scope="module")
def host(tmp_path_factory: pytest.TempPathFactory, twins: dict[str, Path]) -> Iterator[Host]:
    made = Host(tmp_path_factory.mktemp("host"), twins["protobuf"])
    yield made
    made.child.send_signal(signal.SIGINT)
    try:
        assert made.child.wait(PATIENCE_S) == 0
    finally:
        made.child.kill()


@pytest.fixture(scope="module")
def opened(browser: Any, host: Host) -> Tab:
    page = browser.new_page()
    page.set_viewport_size(SIZE)
    return Tab(page, host.url)


@pytest.fixture
def tab(opened: Tab) -> Tab:
    """The one page on which all of this file's tests are done, as it is at the start."""
    opened.begin_anew()
    return opened


class Tab:
    """A page as a person uses it."""

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        page.goto(url)
        self.wait_for_viewer()

    def begin_anew(self) -> None:
        """All stages of the first frame, with the default settings and the knobs folded."""
        for head in self.page.locator(".q-expansion-item--expanded .stage-name").all():
            head.click()
        self.page.get_by_role("button", name="All stages").click()
        self.page.evaluate("emitEvent('bench_restore', 'preset=default&frame=0&view=live&focus=')")
        until(
            lambda: not re.search("[?&](set|focus|frame|view)=", self.address or "&set="),
            "it is reset",
        )

    def wait_for_viewer(self) -> None:
        self.page.wait_for_function(
            "document.getElementById('viewer-cover')?.style.display === 'none'"
        )

    @property
    def address(self) -> str:
        """The page's address as it is now; Playwright's own is that of the last event it saw."""
        from playwright.sync_api import Error

        try:
            return str(self.page.evaluate("location.href"))
        except Error:
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

    def picture(
        self, fits: Callable[[np.ndarray], bool] = lambda _: True, what: str = ""
    ) -> np.ndarray:
        """The viewer's canvas when it is at rest, and is as it is awaited."""
        self.page.mouse.move(5, 5)
        before = b""
        deadline = time.monotonic() + PATIENCE_S
        while True:
            # Messages lie over the canvas for some seconds.
            now = self.page.locator("#viewer").screenshot(
                style=".q-notification { display: none !important }"
            )
            if now == before:
                found = cv2.imdecode(np.frombuffer(now, np.uint8), cv2.IMREAD_COLOR).astype(float)
                if fits(found):
                    return found
                assert time.monotonic() < deadline, what
            before = now
            self.page.wait_for_timeout(150)

    def says(self, text: str) -> None:
        """Wait for a message on the page."""
        self.page.locator(f".q-notification:has-text('{text}')").first.wait_for()

    def wait_for_layout(self) -> None:
        """Until the canvas has its place and the viewer draws as large as it is there."""
        self.page.evaluate("window.benchPlace = ''")
        self.page.wait_for_function(
            """() => {
                const canvas = document.getElementById('viewer');
                const box = canvas.getBoundingClientRect();
                const place = [box.x, box.y, box.width, box.height, canvas.width].join();
                const still = place === window.benchPlace;
                window.benchPlace = place;
                return still && Math.abs(canvas.width - box.width * devicePixelRatio) < 2;
            }""",
            polling=150,
        )

    def click_pixel(self, at: tuple[float, float]) -> tuple[int, int]:
        """Click at shares of the canvas; returns the pixel whose story is told."""
        title = self.page.locator(".story-head .story-title")

        def told() -> str:
            return title.inner_text() if title.is_visible() else ""

        before = told()
        asked = -np.inf

        def answered() -> bool:
            nonlocal asked
            # While the picture is drawn anew a click may be lost.
            if time.monotonic() - asked > 3:
                self.wait_for_layout()
                box = self.page.locator("#viewer").bounding_box()
                x, y = (
                    box[k] + share * box[s]
                    for k, s, share in zip("xy", ("width", "height"), at, strict=True)
                )
                self.page.mouse.click(x, y)
                asked = time.monotonic()
            return told() not in ("", before)

        until(answered, "a pixel's story is told")
        self.wait_for_layout()
        x, y = told().removeprefix("Why pixel ").split(", ")
        return int(x), int(y)


def differ(a: np.ndarray, b: np.ndarray) -> int:
    """Pixels that are visibly not the same."""
    return int((np.abs(a - b).max(axis=2) > 40).sum())


def test_a_session_of_tuning(tab: Tab, host: Host, bench: Command, tmp_path: Path) -> None:
    assert "token" not in tab.address
    tab.open_stage("linked_edges")
    until(lambda: "focus=linked_edges" in tab.address, "the address follows")
    first = tab.picture()
    tab.page.get_by_role("button", name="Pin as A").click()

    # A drag changes the picture, and nothing upstream runs again.
    tab.drag("min_weight", 1.0)
    until(lambda: "min_weight%3D100" in tab.address, "the drag arrives")
    until(lambda: tab.stages()["linked_edges"] == "ran", "the stage ran")
    upstream = ("registration", "focus_maps", "depth_cloud", "edge_stack")
    assert [tab.stages()[name] for name in upstream] == ["kept"] * 4
    second = tab.picture(lambda seen: differ(first, seen) > 300, "the picture changes")
    tab.page.get_by_role("button", name="Pin as B").click()

    # Undo, by the keyboard, brings back both the value and the picture; a whole drag is one step.
    tab.page.keyboard.press("Control+z")
    until(lambda: "min_weight" not in tab.address.partition("pinA")[0], "the value is back")
    tab.picture(lambda seen: differ(first, seen) < 30, "the picture is back")

    # A and B are flipped in place.
    views = tab.page.locator(".views button")
    views.nth(2).click()
    tab.picture(lambda seen: differ(second, seen) < 30, "B is shown")
    views.nth(1).click()
    tab.picture(lambda seen: differ(first, seen) < 30, "A is shown")
    views.nth(4).click()
    tab.picture(lambda seen: min(differ(p, seen) for p in (first, second)) > 1000, "B less A")
    views.nth(0).click()
    tab.picture(lambda seen: differ(first, seen) < 30, "now is shown")

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
    until(lambda: "cone_deg%3D41.5" in tab.address, "what was typed is taken")
    until(lambda: tab.stages()["linked_edges"] == "ran", "the stage ran")
    tab.page.get_by_role("button", name="Save").click()
    tab.page.locator(".save").get_by_role("button", name="Save").click()
    refused = tab.page.locator(".save .refused")
    until(lambda: "reason" in refused.inner_text(), "a reason is asked for")
    tab.page.locator(".save textarea").fill("the cone let in what lies beside")
    tab.page.locator(".save").get_by_role("button", name="Save").click()
    tuned = host.recording.with_name("scene.tuned.toml")
    until(tuned.is_file, "it is saved")
    assert "the cone let in" in tuned.read_text()
    live = host.live()
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


@pytest.mark.parametrize(
    ("asked", "says"),
    [("cone_deg%3D400", "linked_edges.cone_deg"), ("nothing%3D1", "no parameter")],
)
def test_an_address_that_cannot_be_is_told(browser: Any, host: Host, asked: str, says: str) -> None:
    page = browser.new_page()
    page.goto(f"{host.url}&set=linked_edges.{asked}")
    page.locator(f".q-notification:has-text('{says}')").first.wait_for()
    until(lambda: asked not in page.evaluate("location.href"), "the address is as it was")
    page.close()


def test_what_is_typed_wrongly_is_refused_and_the_field_shows_what_is(tab: Tab) -> None:
    """A value out of range, and half a number."""
    tab.open_stage("linked_edges")
    field = tab.knob("reach").locator("input")
    for typed, says in (("1000", "linked_edges.reach"), ("1.2.3", "expected a number")):
        field.fill(typed)
        field.press("Enter")
        tab.says(says)
        until(lambda: field.input_value() == "15", "the value stays")


def test_a_second_tab_shows_the_same_state_live(browser: Any, tab: Tab) -> None:
    other = browser.new_page()
    other.goto(tab.address)
    tab.page.bring_to_front()
    tab.open_stage("linked_edges")
    tab.drag("reach", 1.0)
    until(lambda: "reach%3D60" in other.evaluate("location.href"), "the other tab follows")
    other.close()


def test_a_connection_that_is_lost_comes_again_with_its_pictures(tab: Tab) -> None:
    tab.page.evaluate("bench.drop()")
    tab.wait_for_viewer()
    tab.picture(lambda seen: bool(seen.std() > 10), "there are pictures")


def test_a_recording_that_is_gone_is_told_and_survived(tab: Tab, host: Host) -> None:
    """What is kept is shown, what is not is told, the page lives on."""
    label = tab.page.locator(".frame-label")

    def click(share: float) -> None:
        box = tab.page.locator(".frames").bounding_box()
        x = box["x"] + 2 + share * (box["width"] - 4)
        tab.page.mouse.click(x, box["y"] + box["height"] / 2)
        tab.page.wait_for_timeout(150)

    def last_frame() -> bool:
        # The page may still be laying itself out when it is clicked for the first time.
        click(1)
        return "frame 2" in label.inner_text()

    until(last_frame, "the last frame is shown")
    kept = host.recording.read_bytes()
    host.recording.unlink()
    try:
        click(0.5)
        banner = tab.page.locator(".banner")
        banner.wait_for()
        assert "scene.mcap: frame 1 cannot be read" in banner.inner_text()
        click(0)
        banner.wait_for(state="hidden")
        assert json.loads(tab.page.evaluate("JSON.stringify(bench.pieces() > 0)"))
    finally:
        host.recording.write_bytes(kept)

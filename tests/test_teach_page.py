"""The course in a browser: every lesson, its pictures drawn and its first claim tried."""

from __future__ import annotations

import re
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from waiting import PATIENCE_S, until, until_running

from workbench.teach import find_lessons

pytestmark = [pytest.mark.browser, pytest.mark.process]

# Software rendering pays for each pixel.
SIZE = {"width": 760, "height": 440}
# The viewer would tell its maker that it runs; the page does not let it, and the viewer complains.
OUTSIDE = re.compile(r"tel\.rerun\.io|Failed to fetch")


def drawn(page: Any) -> bool:
    """Whether the canvas shows pictures: many colours, and not one that covers nearly all of it."""
    shot = page.locator("#viewer").screenshot()
    image = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_GRAYSCALE)[30:]
    counts = np.bincount(image.ravel(), minlength=256)
    return bool((counts > 20).sum() > 12 and counts.max() < 0.97 * image.size)


def test_the_course_runs_through_in_a_browser(
    browser: Any, started: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    errors: list[str] = []
    tab = browser.new_page()
    tab.set_viewport_size(SIZE)
    tab.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    child = started("teach", "--no-browser")
    told = tmp_path / "stderr"
    until_running(child, lambda: "serving" in told.read_text(), told)
    address = re.search(r"http://127\.0\.0\.1:\S+", told.read_text())
    assert address is not None
    tab.goto(address.group(0))
    lessons = find_lessons()
    for lesson in lessons:
        tab.wait_for_url(re.compile(rf"/lesson/{lesson.number}($|\?)"))
        tab.wait_for_function("document.getElementById('viewer-cover')?.style.display === 'none'")
        assert lesson.title in tab.locator(".lesson-title").inner_text()
        assert tab.locator(".lesson-knobs .knob").count() == len(lesson.knobs)
        until(lambda: drawn(tab), f"lesson {lesson.number} draws")
        first = tab.locator(".claim").first
        first.locator(".turn-before").click()
        until(lambda f=first: stands(f), "before is measured")
        first.locator(".turn-after").click()
        until(lambda f=first: ": seen" in f.inner_text(), f"lesson {lesson.number}")
        if lesson is not lessons[-1]:
            tab.locator(".step-next").click()
    assert tab.locator(".step-next").is_disabled()

    # The knobs can be put back as the lesson opened.
    assert tab.locator(".knob.changed").count() == 1
    tab.keyboard.press("Control+z")
    tab.keyboard.press("Control+z")
    until(lambda: tab.locator(".knob.changed").count() == 0, "undone")
    assert [error for error in errors if not OUTSIDE.search(error)] == []
    child.send_signal(signal.SIGINT)
    assert child.wait(PATIENCE_S) == 0


def stands(claim: Any) -> bool:
    """Whether the knobs stand at the claim's beginning, and it was measured there."""
    return "stands" in (claim.locator(".turn-before").get_attribute("class") or "")

"""How fast a turned knob shows, and whether an hour of turning costs memory.

    python benchmarks/bench_tune.py                  # medians of 30
    python benchmarks/bench_tune.py --soak 5000      # memory over 5000 changes

What the bench holds after the changes must be what a run with its parameters gives.

Without a browser: from the change to the pieces that leave for the viewer, for the first stage
that ran again and for the last.  With one (Chromium, software rendering): from the press on the
slider's track to the first frame of the viewer's canvas whose pixels have changed.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import rerun as rr
from aims import end, must

import workbench
from workbench.tune.canvas import Canvas, live_recording
from workbench.tune.frames import SessionFrames
from workbench.tune.live import LiveBench

ROOT = Path(__file__).parents[1]
SCENE = ROOT / "recordings" / "scene.mcap"
REPEATS = 30
PROGRAM = "from workbench.cli import main; main()"
KNOBS = {"edge_stack.max_ratio": (0.01, 0.03), "linked_edges.max_cost": (10.0, 30.0)}


def opened(recording: Path) -> tuple[LiveBench, list[int]]:
    """A live bench that logs as the page does, and the bytes that left it."""
    session = workbench.open(recording)
    bench = LiveBench(session.pipeline, SessionFrames(session))
    stream = live_recording("benchmark")
    pieces = rr.binary_stream(stream)
    sent: list[int] = [0]

    def flush() -> None:
        sent[0] += len(pieces.read(flush=True) or b"")

    bench.display = Canvas(session.pipeline, stream, flush)
    bench.start()
    assert bench.wait(120)
    return bench, sent


def times(recording: Path) -> None:
    """Print the medians from a change to what was logged."""
    bench, sent = opened(recording)
    for address, (low, high) in KNOBS.items():
        bench.focus(address.partition(".")[0])
        first, last, own = [], [], []
        for k in range(REPEATS + 3):
            # A new value each time: none is kept from before.
            bench.set({address: low + (high - low) * (k + 0.5) / (REPEATS + 3)})
            assert bench.wait(60)
            snapshot = bench.snapshot()
            assert snapshot.run is not None
            if k >= 3:
                first.append(snapshot.first_ms)
                last.append(snapshot.all_ms)
                own.append(snapshot.run.stage_ms[address.partition(".")[0]])
        print(
            f"{address}: median of {REPEATS}: {statistics.median(first):.1f} ms to the stage's own "
            f"result logged (of it {statistics.median(own):.1f} ms computing), "
            f"{statistics.median(last):.1f} ms to all that is downstream"
        )
    print(f"{sent[0] / (len(KNOBS) * (REPEATS + 3)) / 1e6:.2f} MB a change to the viewer")
    check(bench, recording)
    bench.close()


def check(bench: LiveBench, recording: Path) -> None:
    """Hold what the bench has now to a run of its own with the same parameters."""
    snapshot = bench.snapshot()
    assert snapshot.run is not None
    assignments = [f"{address}={value}" for address, value in snapshot.settings.changed.items()]
    index = snapshot.run.frame.index
    (run,) = workbench.open(recording, set=assignments, frames=(index, index + 1)).runs()
    for name, value in run.artifacts.items():
        if isinstance(value, np.ndarray):
            same = np.array_equal(
                value, snapshot.run.artifacts[name], equal_nan=value.dtype.kind == "f"
            )
            must(same, f"{name}: the live result is that of a run with its parameters")


WATCH = """
(() => {
  const small = document.createElement("canvas");
  small.width = 240; small.height = 135;
  const context = small.getContext("2d", { willReadFrequently: true });
  window.watch = { held: null, pressed: 0, took: null };
  const ask = window.requestAnimationFrame.bind(window);
  // Looked at right after the viewer has drawn: later its buffer is gone.
  window.requestAnimationFrame = (draw) => ask((now) => {
    draw(now);
    const canvas = document.getElementById("viewer");
    if (!canvas || !canvas.width || window.watch.took !== null) return;
    context.drawImage(canvas, 0, 0, small.width, small.height);
    const pixels = context.getImageData(0, 0, small.width, small.height).data;
    if (window.watch.pressed && window.watch.held) {
      let changed = 0;
      for (let k = 0; k < pixels.length; k += 4)
        if (Math.abs(pixels[k] - window.watch.held[k]) > 24) changed += 1;
      if (changed > 6) window.watch.took = performance.now() - window.watch.pressed;
    } else window.watch.held = pixels;
  });
  window.addEventListener("pointerdown", () => { window.watch.pressed = performance.now(); }, true);
})();
"""


def browser(recording: Path) -> None:
    """Print the median from a press on the slider to changed pixels of the viewer."""
    from playwright.sync_api import sync_playwright

    child = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "tune", str(recording), "--no-browser", "--json"],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert child.stdout is not None
        text = ""
        while "}" not in text:
            text += child.stdout.readline()
        url = text.partition('"url": "')[2].partition('"')[0]
        with sync_playwright() as playwright:
            own = Path(playwright.chromium.executable_path)
            path = str(own) if own.is_file() else shutil.which("chromium")
            flags = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader"]
            opened = playwright.chromium.launch(
                executable_path=path, args=[*flags, "--enable-unsafe-swiftshader"]
            )
            page = opened.new_page(viewport={"width": 1366, "height": 768})
            page.set_default_timeout(120_000)
            page.add_init_script(WATCH)
            page.goto(url)
            page.wait_for_function(
                "document.getElementById('viewer-cover')?.style.display === 'none'"
            )
            page.locator(".stage-name:text-is('linked_edges')").click()
            slider = page.locator(".knob:has(.knob-name:text-is('min_weight')) .knob-slider")
            slider.scroll_into_view_if_needed()
            time.sleep(4)
            box = slider.bounding_box()
            assert box is not None
            took = []
            for k, share in zip(range(REPEATS), itertools.cycle((0.1, 0.95)), strict=False):
                page.evaluate("watch.pressed = 0; watch.held = null; watch.took = null;")
                # A move over the page makes the viewer draw once, for the picture before.
                page.mouse.move(700, 300 + k % 7)
                page.wait_for_function("watch.held !== null")
                x = box["x"] + (share + 0.002 * k) * box["width"]
                page.mouse.click(x, box["y"] + box["height"] / 2)
                page.wait_for_function("watch.took !== null")
                took.append(page.evaluate("watch.took"))
                time.sleep(0.3)
            print(
                f"linked_edges.min_weight: median of {REPEATS}: {statistics.median(took):.0f} ms "
                f"from the press on the slider to changed pixels (software rendering)"
            )
            opened.close()
    finally:
        child.terminate()
        child.wait(20)
        assert child.stdout is not None
        child.stdout.close()


def soak(recording: Path, changes: int) -> None:
    """Print the process's memory while ``changes`` random changes are made."""
    bench, sent = opened(recording)
    process = psutil.Process(os.getpid())
    chance = random.Random(7)
    addresses = [
        (f"{stage}.{name}", knob)
        for stage in ("edge_stack", "linked_edges", "depth_cloud")
        for name, knob in bench.knobs(stage).items()
        if knob.kind == "float" and knob.low is not None and knob.high is not None
    ]
    warm = 0.0
    start = time.monotonic()
    for k in range(1, changes + 1):
        what = chance.random()
        if what < 0.02:
            bench.go_to(chance.randrange(len(bench.frames)))
        elif what < 0.12:
            bench.undo()
        elif what < 0.13:
            bench.pin(chance.choice("AB"))
        elif what < 0.15 and bench.snapshot().pins:
            bench.show(chance.choice(["beside", "difference", "live", "live"]))
        else:
            address, knob = chance.choice(addresses)
            # Near the default: a scene of nothing but noise would only show how slow that is.
            span = 0.05 * (knob.high - knob.low)
            value = min(max(knob.default + chance.uniform(-span, span), knob.low), knob.high)
            bench.set({address: value})
        assert bench.wait(120)
        if k == min(500, changes // 4):
            warm = process.memory_info().rss
        if k % max(changes // 10, 1) == 0:
            mb = process.memory_info().rss / 2**20
            print(f"{k} changes, {time.monotonic() - start:.0f} s: {mb:.0f} MB", flush=True)
    grown = (process.memory_info().rss - warm) / 2**20
    print(f"grown by {grown:.0f} MB since the first {min(500, changes // 4)} changes")
    print(f"{sent[0] / 2**30:.1f} GiB to the viewer")
    bench.close()


def main() -> None:
    """Run what the flags ask for."""
    parser: Any = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("recording", nargs="?", type=Path, default=SCENE)
    parser.add_argument("--soak", type=int, metavar="CHANGES", help="measure memory instead")
    parser.add_argument("--no-browser", action="store_true", help="leave the browser out")
    arguments = parser.parse_args()
    if arguments.soak:
        soak(arguments.recording, arguments.soak)
        return
    times(arguments.recording)
    if not arguments.no_browser:
        browser(arguments.recording)
    end()


if __name__ == "__main__":
    main()

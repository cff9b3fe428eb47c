"""What the sensor and the bench cost, as ratios to yardsticks measured in the same run.

    python benchmarks/bench_sensor.py

Four questions, each with an aim: depth and confidence from a registered pair against one
``cv2.Canny`` of one of the images; the time of a pixel in a large image against one in a small
image; replay with logging against the same frames without; ``workbench --help`` against
importing typer.  Everything runs on one thread.  Yardstick and candidate take turns, so that a
machine that is busy or slows down does so to both; the ratio is that of their medians (least
times for whole processes and replays, which are few).  The depth must be that of the pipeline, and
a replay's scores the same with logging as without.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from aims import at_most, end, must
from numba import set_num_threads
from rich.console import Console
from rich.table import Table

from workbench.session import Options, Session
from workbench_stages.dfd import depth as dfd
from workbench_stages.dfd.calibration import Calibration
from workbench_stages.dfd.focus import focus_map
from workbench_stages.dfd.stripes import whole_period_taps

SCENE = Path(__file__).parents[1] / "recordings" / "scene.mcap"
SMALL_PX = 256
LARGE_PX = 2048
SMOOTHING_PERIODS = 1.4
REACH_PERIODS = 1.2
HALF_CONFIDENCE_PERCENT = 3.3


class Pair:
    """A registered pair with its calibration, tiled to ``size`` × ``size`` pixels."""

    def __init__(self, session: Session, size: int) -> None:
        calibration: Calibration = session.pipeline.resources["calibration"][0]
        artifacts = next(session.runs()).artifacts
        repeats = -(-size // artifacts["near"].shape[0])

        def tiled(image: np.ndarray) -> np.ndarray:
            many = (*[1] * (image.ndim - 2), repeats, repeats)
            return np.ascontiguousarray(np.tile(image, many)[..., :size, :size])

        self.near, self.far = tiled(artifacts["near"]), tiled(artifacts["far"])
        self.guide = tiled(artifacts["intensity"])
        self.bytes = np.clip(self.near, 0, 255).astype(np.uint8)
        self.calibration = replace(calibration, curve=tiled(calibration.curve))
        self.response = dfd.Response(
            self.calibration.curve,
            self.calibration.modulation,
            self.calibration.slope,
            self.calibration.noise,
            self.calibration.laplacian,
        )
        period_px = self.calibration.stripes.extent_px()
        self.taps = whole_period_taps(period_px)
        self.windows = dfd.windows_for(period_px, SMOOTHING_PERIODS, REACH_PERIODS)

    def depth(self, edge_aware: bool = True) -> tuple[np.ndarray, np.ndarray]:
        """Depth and confidence, as ``focus_maps`` and ``depth_cloud`` make them."""
        taps, kind, noise = self.taps, self.calibration.laplacian, self.calibration.noise
        relative, error = dfd.estimate(
            focus_map(self.near, taps, taps, kind, noise),
            focus_map(self.far, taps, taps, kind, noise),
            self.brightness(),
            self.guide,
            self.response,
            self.windows,
            edge_aware,
        )
        return relative, dfd.confidence_from_error(error, HALF_CONFIDENCE_PERCENT)

    def brightness(self) -> np.ndarray:
        """Sum of near and far over the focus window."""
        return cv2.sepFilter2D(
            self.near + self.far,
            cv2.CV_32F,
            self.taps,
            self.taps,
            borderType=cv2.BORDER_REFLECT_101,
        )

    def parts(self) -> dict[str, Callable[[], object]]:
        """The pieces of :meth:`depth`, to see where its time goes."""
        taps, kind, noise = self.taps, self.calibration.laplacian, self.calibration.noise
        near = focus_map(self.near, taps, taps, kind, noise)
        far = focus_map(self.far, taps, taps, kind, noise)
        light = self.brightness()
        given = (near, far, light, self.guide, self.response, self.windows)
        error = dfd.estimate(*given)[1]
        return {
            "focus map, each of two": lambda: focus_map(self.near, taps, taps, kind, noise),
            "brightness": self.brightness,
            "estimate, edge-aware": lambda: dfd.estimate(*given),
            "estimate, box": lambda: dfd.estimate(*given, edge_aware=False),
            "confidence": lambda: dfd.confidence_from_error(error, HALF_CONFIDENCE_PERCENT),
        }


def seconds(call: Callable[[], object]) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def in_turn(
    calls: dict[str, Callable[[], object]],
    rounds: int,
    summary: Callable[[list[float]], float] = statistics.median,
) -> dict[str, float]:
    """Seconds of each call: the summary over ``rounds`` in which all take turns, warmed up."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    for call in calls.values():
        call()
    for _ in range(rounds):
        for name, call in calls.items():
            times[name].append(seconds(call))
    return {name: summary(taken) for name, taken in times.items()}


def replay(until: str | None, logging: bool, scores: list[str]) -> Callable[[], None]:
    """One replay of the committed recording, its frames logged to a file or not at all.

    ``until`` is the last stage to run; all are if it is None.  What it scored is added to
    ``scores``.
    """
    import rerun as rr

    from workbench.bridge import Bridge
    from workbench.report import RunReport

    def run() -> None:
        session = Session.open(Options(SCENE, until=until))
        report = RunReport(session)
        if not logging:
            for result in session.runs():
                report.add(result)
            scores.append(repr(report.scores()))
            return
        with tempfile.TemporaryDirectory() as folder:
            stream = rr.RecordingStream("defocus_bench", make_default=False)
            stream.save(Path(folder) / "replay.rrd")
            bridge = Bridge(session, stream)
            for result in session.runs():
                bridge.log(result, report, report.add(result))
            bridge.close(report)
            scores.append(repr(report.scores()))
            stream.flush()
            stream.disconnect()

    return run


def process(*command: str) -> Callable[[], None]:
    """A whole process, from its start to its end."""
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL) and None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=150, help="rounds of the small images")
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    set_num_threads(1)
    table = Table(title="Ratios to yardsticks, one thread")
    for column in ("measured", "takes", "yardstick", "takes", "ratio", "aim"):
        right = "left" if column in ("measured", "yardstick") else "right"
        table.add_column(column, justify=right)  # type: ignore[arg-type]

    def row(
        name: str, taken: float, yardstick: str, unit: float, aim: float | None, per: float = 1
    ) -> None:
        scale, suffix = (1e3, "ms") if per == 1 else (1e9, "ns")
        table.add_row(
            name,
            f"{scale * taken:.3g} {suffix}",
            yardstick,
            f"{scale * unit:.3g} {suffix}",
            f"{taken / unit:.2f}",
            "" if aim is None else at_most(aim, taken / unit),
        )

    session = Session.open(Options(SCENE, until="depth_cloud", frames=(0, 1)))
    small, large = Pair(session, SMALL_PX), Pair(session, LARGE_PX)
    (whole,) = session.runs()
    known = np.isfinite(whole.artifacts["depth_relative"])
    here = small.depth()[0][known]
    must(
        np.array_equal(here, whole.artifacts["depth_relative"][known]),
        "the depth that is timed is that of the pipeline",
    )
    canny = "cv2.Canny, 256²"
    times = in_turn(
        {
            canny: lambda: cv2.Canny(small.bytes, 100, 200),
            "depth and confidence, edge-aware, 256²": small.depth,
            "depth and confidence, box, 256²": lambda: small.depth(edge_aware=False),
        },
        rounds,
    )
    for name in list(times)[1:]:
        row(name, times[name], canny, times[canny], 1.5)
    parts = in_turn({canny: lambda: cv2.Canny(small.bytes, 100, 200)} | small.parts(), rounds)
    for name in list(parts)[1:]:
        row(f"  of it: {name}", parts[name], canny, parts[canny], None)

    names = {"edge-aware": True, "box": False}
    calls: dict[str, Callable[[], object]] = {}
    for name, edge_aware in names.items():
        calls[f"{name} small"] = lambda e=edge_aware: [small.depth(e) for _ in range(8)]  # type: ignore[misc]
        calls[f"{name} large"] = lambda e=edge_aware: large.depth(e)  # type: ignore[misc]
    sizes = in_turn(calls, max(5, rounds // 10))
    for name in names:
        per_small = sizes[f"{name} small"] / 8 / SMALL_PX**2
        per_large = sizes[f"{name} large"] / LARGE_PX**2
        row(f"a pixel at 2048², {name}", per_large, "a pixel at 256²", per_small, 1.3, per=2)

    for until, name in (("depth_cloud", "up to depth_cloud"), (None, "all stages")):
        scores: list[str] = []
        ways = {"logged": replay(until, True, scores), "not": replay(until, False, scores)}
        replays = in_turn(ways, 5, min)
        must(len(set(scores)) == 1, f"{name}: each replay scores the same, logged or not")
        logged, unlogged = replays["logged"], replays["not"]
        row(f"replay logged to a file, {name}", logged, "not logged", unlogged, 1.5)

    workbench = str(Path(sys.executable).with_name("workbench"))
    starts = in_turn(
        {
            "help": process(workbench, "--help"),
            "typer": process(sys.executable, "-c", "import typer"),
        },
        7,
        min,
    )
    row("workbench --help", starts["help"], "import typer", starts["typer"], 3)
    Console(width=120).print(table)
    end()


if __name__ == "__main__":
    main()

"""What a whole pick costs, from a near and a far image to a grasp, beside the paper's rates.

    python benchmarks/bench_pick.py

Every stage on every frame of the committed pile recording, on one thread, in milliseconds and
over one ``cv2.Canny`` of the same images in the same run.  Every round must come to the same picks,
and no stage may fail.
"""

from __future__ import annotations

import argparse
from statistics import median

import cv2
import numpy as np
from aims import end, must
from bench_sensor import SCENE, in_turn
from numba import set_num_threads
from rich.console import Console
from rich.table import Table

from workbench.pipeline import ResultStore
from workbench.plugins import find_stages
from workbench.session import Options, Session
from workbench.settings import preset_names

PAPER = {
    "sensor": "100 ms: 10 depth maps a second",
    "segmentation": "about 1045 ms: GEF 545, reconstruction and linking 500 (Pentium 133)",
    "recognition": "very low, says section 7",
}


def stage_ms(preset: str, rounds: int) -> dict[str, tuple[str, float]]:
    """Each stage's chapter and median time over all frames."""
    session = Session.open(Options(SCENE, preset=preset), ResultStore(capacity_bytes=0))
    times: dict[str, list[float]] = {}
    outcomes: dict[int, str] = {}
    for _ in range(rounds):
        for run in session.runs():
            came_to = repr((run.artifacts.get("verdict"), run.artifacts.get("poses")))
            first = outcomes.setdefault(run.frame.index, came_to)
            must(came_to == first, f"frame {run.frame.index}, {preset}: each round's pick is alike")
            must(not run.failures, f"frame {run.frame.index}, {preset}: no stage fails")
            for stage, milliseconds in run.stage_ms.items():
                times.setdefault(stage, []).append(milliseconds)
    return {s.name: (s.chapter, median(times[s.name])) for s in session.pipeline.stages}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3, help="rounds through the recording")
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    set_num_threads(1)
    session = Session.open(Options(SCENE, until="registration", frames=(5, 6)))
    image = np.clip(next(session.runs()).artifacts["intensity"], 0, 255).astype(np.uint8)
    unit_ms = 1e3 * in_turn({"canny": lambda: cv2.Canny(image, 100, 200)}, 200)["canny"]
    presets = preset_names(find_stages().values())
    found = {preset: stage_ms(preset, rounds) for preset in presets}

    table = Table(title=f"A frame of {image.shape[1]}², one thread; cv2.Canny {unit_ms:.2f} ms")
    for column in ("measured", *(f"{p} ms" for p in presets), "over Canny", "the paper"):
        table.add_column(column, justify="left" if column in ("measured", "the paper") else "right")

    def row(name: str, chosen: set[str], says: str = "") -> None:
        sums = [sum(ms for stage, (_, ms) in found[p].items() if stage in chosen) for p in presets]
        table.add_row(name, *(f"{ms:.2f}" for ms in sums), f"{sums[0] / unit_ms:.1f}", says)

    chapters: dict[str, set[str]] = {}
    for stage, (chapter, _) in found[presets[0]].items():
        chapters.setdefault(chapter, set()).add(stage)
        row(stage, {stage})
    table.add_section()
    for chapter, stages in chapters.items():
        row(chapter, stages, PAPER.get(chapter, ""))
    row("a whole frame", set.union(*chapters.values()), "over 1145 ms")
    Console(width=130).print(table)
    end()


if __name__ == "__main__":
    main()

"""What it costs to get from an image to closed regions, as ratios to yardsticks of the same run.

    python benchmarks/bench_edges.py

From the gradient to the labels of the regions, on one thread, against ``skimage.feature.canny``
of the same image (8 bit, σ = 1) and against one ``cv2.Canny``; and the time of a pixel in a large
image against one in a small image.  The labels must be those of the pipeline.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from aims import at_most, end, must
from bench_sensor import LARGE_PX, SCENE, SMALL_PX, in_turn
from numba import set_num_threads
from rich.console import Console
from rich.table import Table
from skimage.feature import canny

from workbench.session import Options, Session
from workbench_stages.edges.inputs import best_depth
from workbench_stages.edges.planes import Camera
from workbench_stages.edges.regions import closed_regions, region_features
from workbench_stages.edges.segmentation import PRESETS, link_edges, stack_edges


def to_regions(
    image: np.ndarray, depth: np.ndarray | None, camera: Camera | None, preset: str
) -> np.ndarray:
    """Labels [H W] of the closed regions of an image, as the three stages make them."""
    chosen = PRESETS[preset]
    stacked = stack_edges(image, depth, **chosen["edge_stack"])
    linked = link_edges(stacked, depth, camera, **chosen["linked_edges"])
    walls = None if linked.walls is None else linked.walls.labels
    return closed_regions(linked.lines, image, stacked.gradient, walls)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=30, help="rounds of the small images")
    rounds = parser.parse_args().rounds
    cv2.setNumThreads(1)
    set_num_threads(1)
    session = Session.open(Options(SCENE, until="region_features", frames=(5, 6)))
    artifacts = next(session.runs()).artifacts
    image = artifacts["intensity"]
    bytes_ = np.clip(image, 0, 255).astype(np.uint8)
    depth, camera = best_depth(artifacts)
    ways: dict[str, Callable[[], Any]] = {
        "paper": lambda: to_regions(image, None, None, "paper"),
        "default, no depth": lambda: to_regions(image, None, None, "default"),
        "default": lambda: to_regions(image, depth, camera, "default"),
    }
    labels = to_regions(image, depth, camera, "default")
    must(np.array_equal(labels, artifacts["labels"]), "the labels are those of the pipeline")
    yardsticks: dict[str, Callable[[], Any]] = {
        "skimage canny, σ 1": lambda: canny(bytes_, sigma=1),
        "cv2.Canny": lambda: cv2.Canny(bytes_, 100, 200),
    }
    features = {"region features": lambda: region_features(labels, depth, camera)}
    times = in_turn(yardsticks | ways | features, rounds)

    table = Table(title=f"From the gradient to regions, {SMALL_PX}², one thread")
    for column in ("measured", "takes", *(f"over {name}" for name in yardsticks)):
        table.add_column(column, justify="left" if column == "measured" else "right")
    for name in [*ways, *features]:
        ratios = [f"{times[name] / times[unit]:.2f}" for unit in yardsticks]
        table.add_row(name, f"{1e3 * times[name]:.2f} ms", *ratios)
    console = Console(width=110)
    console.print(table)
    for unit, aim in zip(yardsticks, (1.0, 4.0), strict=True):
        ratio = times["paper"] / times[unit]
        console.print(f"paper over {unit}: {ratio:.2f}, aim {at_most(aim, ratio)}")

    large = cv2.resize(image, (LARGE_PX, LARGE_PX), interpolation=cv2.INTER_CUBIC)
    sizes = in_turn(
        {
            f"{preset} {size}": lambda p=preset, i=picture: to_regions(i, None, None, p)  # type: ignore[misc]
            for preset in PRESETS
            for size, picture in (("small", image), ("large", large))
        },
        3,
        min,
    )
    for preset in PRESETS:
        per_small = sizes[f"{preset} small"] / SMALL_PX**2
        per_large = sizes[f"{preset} large"] / LARGE_PX**2
        ratio = per_large / per_small
        console.print(
            f"{preset}: a pixel takes {1e9 * per_large:.0f} ns at {LARGE_PX}², "
            f"{1e9 * per_small:.0f} ns at {SMALL_PX}²: ratio {ratio:.2f}, aim {at_most(1.3, ratio)}"
        )
    end()


if __name__ == "__main__":
    main()

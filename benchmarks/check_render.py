"""Render a recording's frames again from its own transforms and rig, and compare.

    python benchmarks/check_render.py recordings/scene.mcap [--frames 3] [--pictures DIR]

Says, for each frame, by how much depth and images differ (rms in per cent of full scale), how many
pixels lie at edges where the two see different surfaces, and how long the rendering took.  Where
both see the same surface the depth must be the same to 0.01 mm, and the images to 2 % of full scale
in the root mean square; else the exit code is 1.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from aims import end, must

from workbench.recording import Recording
from workbench_stages.optics.rig import Rig
from workbench_stages.simulation.again import bodies_of
from workbench_stages.simulation.bodies import load_mesh
from workbench_stages.simulation.render import render
from workbench_stages.simulation.scene import Table

PARTS = Path(__file__).parents[1] / "recordings" / "parts"
EXPOSURE = 0.78 / 0.55
MOST_MM, MOST_PERCENT = 0.01, 2.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frames", type=int, default=None)
    parser.add_argument("--paths", type=int, default=64)
    parser.add_argument("--pictures", type=Path)
    arguments = parser.parse_args()
    recording = Recording.open(arguments.recording)
    rig = Rig.from_metadata(recording.rig)
    table = Table(distance_mm=float(recording.rig.get("z_table", 795)))
    meshes = {path.stem: load_mesh(path) for path in sorted(PARTS.glob("*.stl"))}
    print("frame    depth mm  differ px   near %    far %   flat %   seconds")
    for frame in recording.frames(["near", "far"], ["flat"], 0, arguments.frames):
        assert frame.truth is not None and frame.truth.depth_m is not None
        begun = time.perf_counter()
        pattern_off = frame.truth.meta.get("pattern") == "none"
        made = render(rig, bodies_of(frame.truth, meshes, table), paths=arguments.paths)
        seconds = time.perf_counter() - begun
        same = made.instances == frame.truth.instances
        depth = np.abs(made.depth_mm - 1e3 * frame.truth.depth_m)[same].max()
        rms = []
        for channel in ("near", "far", "flat"):
            if channel not in frame.images:
                rms.append(np.nan)
                continue
            if channel == "flat":
                light = 0.9 * EXPOSURE * made.open_light["near"]
            else:
                light = EXPOSURE * (made.open_light if pattern_off else made.light)[channel]
            error = np.clip(light, 0, 1) - frame.images[channel] / 255
            rms.append(100 * float(np.sqrt((error**2).mean())))
            if arguments.pictures:
                import cv2

                both = np.hstack(
                    [
                        np.clip(255 * light, 0, 255),
                        frame.images[channel],
                        np.clip(127 + 10 * 255 * error, 0, 255),
                    ]
                )
                arguments.pictures.mkdir(exist_ok=True)
                name = f"{frame.index:03}_{channel}.png"
                picture = cv2.resize(both, None, fx=3, fy=3, interpolation=cv2.INTER_NEAREST)
                cv2.imwrite(str(arguments.pictures / name), picture.astype(np.uint8))
        must(depth <= MOST_MM, f"frame {frame.index}: depth differs by {depth:.4f} mm")
        for channel, percent in zip(("near", "far", "flat"), rms, strict=True):
            says = f"frame {frame.index}: {channel} differs by {percent:.2f} % of full scale"
            must(not percent > MOST_PERCENT, says)
        near, far, flat = rms
        print(
            f"{frame.index:5} {depth:11.4f} {(~same).sum():10} {near:8.2f} {far:8.2f} {flat:8.2f}"
            f" {seconds:9.2f}",
            flush=True,
        )
    end()


if __name__ == "__main__":
    main()

"""``workbench simulate``: writes what the installed procedure ``simulate`` renders."""

from __future__ import annotations

import time
from pathlib import Path

from workbench import interrupts
from workbench.console import err, out, table, tracked
from workbench.errors import DataError, UsageError
from workbench.files import check_output
from workbench.procedures import Simulation, installed
from workbench.report import to_json


def run(
    scene: Path, output: Path, seed: int, frames: tuple[int, int | None], as_json: bool
) -> None:
    """Render the scene, write the recording and say how long a frame took."""
    check_output("--output", output)
    if not scene.is_file():
        raise DataError(f"{scene}: expected a scene file, found no such file")
    if output.exists() and output.samefile(scene):
        raise UsageError(f"--output {output}: expected another file than the scene")
    with err.status("simulate: preparing the scene"):
        procedure: type[Simulation] = installed("simulate")
        simulation = procedure(scene, seed)
    count = len(simulation)
    start, stop = frames[0], count if frames[1] is None else min(frames[1], count)
    if start >= count:
        raise UsageError(f"--frames: {scene} has {count} frames, the first is 0")
    seconds = _write(simulation, output, start, stop)
    # The first frame also compiles what has not been compiled yet.
    usual = sorted(seconds)[len(seconds) // 2]
    size = output.stat().st_size
    report = {
        "scene": str(scene),
        "recording": str(output),
        "seed": seed,
        "frames": len(seconds),
        "seconds": sum(seconds),
        "median_seconds_a_frame": usual,
        "bytes": size,
    }
    if as_json:
        print(to_json(report))
        return
    table(
        "Simulation",
        ("quantity", "value"),
        [
            ("frames", str(len(seconds))),
            ("seconds a frame (median)", f"{usual:.2f}"),
            ("size", f"{size / 1e6:.1f} MB"),
        ],
    )
    out.print(f"wrote {output}", soft_wrap=True, markup=False)


def _write(simulation: Simulation, output: Path, start: int, stop: int) -> list[float]:
    """Write frames ``start`` to ``stop`` as they come; how long each took, in seconds."""
    from workbench.recording import RecordingWriter

    seconds = []
    with RecordingWriter.create(output) as writer:
        for name, record in simulation.metadata.items():
            writer.metadata(name, record)
        for channel, (K, width, height) in simulation.cameras.items():
            writer.camera(channel, K, width, height)
        begun = time.perf_counter()
        for frame in tracked(simulation.frames(start, stop), "simulate", stop - start):
            interrupts.check()
            writer.frame(frame.stamp_ns, frame.images, frame.truth)
            seconds.append(time.perf_counter() - begun)
            begun = time.perf_counter()
    return seconds

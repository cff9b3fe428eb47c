"""Whether ``workbench why`` tells the truth: random pixels of a recording, held to the artifacts.

    python benchmarks/check_why.py REC [--calibration FILE] [--models FILE] [--pixels 200] [--list]

At each pixel every stage's story is compared with that pixel's artifacts, and the smallest change
that is named is run anew, from a configuration file as ``--config`` would read it and with nothing
kept from before: it must turn the verdict.  Exits with 1 if a story departs from the artifacts or
a change turns nothing.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

from story_laws import disagreements

from workbench.pipeline import ResultStore
from workbench.recording import Frame
from workbench.session import Options, Session
from workbench.settings import adjusted, to_toml
from workbench.why import Search, image_size, outcome, smallest_change, story

STORE_BYTES = 1 << 30


def turns(options: Options, session: Session, frame: Frame, x: int, y: int, found: Search) -> bool:
    """Whether the change turns the verdict in a session of its own, set up from a file."""
    assert found.change is not None
    stages = {stage.name: stage for stage in session.pipeline.stages}
    values = {found.change.address: found.change.after}
    settings = adjusted(stages, session.pipeline.settings, values)
    with tempfile.TemporaryDirectory() as folder:
        config = Path(folder) / "changed.toml"
        config.write_text(to_toml(settings), encoding="utf-8")
        changed = Session.open(replace(options, config=config), ResultStore(0)).pipeline
    again = story(changed, changed.run(frame), x, y)
    return again.verdicts.get(found.stage) == found.change.verdict != found.verdict


def main() -> None:
    """Draw the pixels, check them, print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--calibration", type=Path)
    parser.add_argument("--models", type=Path)
    parser.add_argument("--pixels", type=int, default=200)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--list", action="store_true", help="a line for each change")
    given = parser.parse_args()
    named = {"calibration": given.calibration, "models": given.models}
    options = Options(given.recording, {name: path for name, path in named.items() if path})
    session = Session.open(options, ResultStore(STORE_BYTES))
    pipeline = session.pipeline
    random = np.random.default_rng(given.seed)
    chosen = Counter(random.integers(session.count(), size=given.pixels).tolist())
    out = Console(highlight=False)
    stories, agreeing, changes, turning = 0, 0, 0, 0
    seconds, runs, subjects = [], [], Counter[str]()
    for run in session.runs():
        width, height = image_size(pipeline, run)
        for _ in range(chosen[run.frame.index]):
            x, y = int(random.integers(width)), int(random.integers(height))
            wrong = disagreements(story(pipeline, run, x, y), pipeline, run.artifacts)
            stories, agreeing = stories + 1, agreeing + (not wrong)
            for says in wrong:
                out.print(f"frame {run.frame.index} pixel {x},{y}: {says}", markup=False)
            start = time.perf_counter()
            found = smallest_change(pipeline, run, x, y)
            seconds.append(time.perf_counter() - start)
            if found is None:
                continue
            runs.append(found.runs)
            subjects[found.stage] += 1
            if found.change is None:
                continue
            changes += 1
            turned = turns(options, session, run.frame, x, y, found)
            turning += turned
            if given.list or not turned:
                out.print(
                    f"frame {run.frame.index} pixel {x},{y} {seconds[-1]:.1f} s: "
                    f"{'turns' if turned else 'TURNS NOTHING'}: {outcome(found)}",
                    markup=False,
                    soft_wrap=True,
                )
    out.print(f"{stories} pixels, {agreeing} agree with the artifacts in every stage")
    out.print(f"{changes} smallest changes named, {turning} turn the verdict when run")
    out.print(
        f"search: median {statistics.median(seconds):.2f} s, worst {max(seconds):.2f} s; median "
        f"{statistics.median(runs):.0f} runs, most {max(runs)}"
    )
    out.print("asked: " + ", ".join(f"{name} {count}" for name, count in subjects.most_common()))
    sys.exit(0 if agreeing == stories and turning == changes else 1)


if __name__ == "__main__":
    main()

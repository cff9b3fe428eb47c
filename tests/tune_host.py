"""The page of ``workbench tune`` as a program that leaves its artifacts in a file when it is asked.

Usage: tune_host.py RECORDING ARTIFACTS.npz.  Prints the page's address when it is up; on SIGUSR1 it
writes what is live then.
"""

from __future__ import annotations

import signal
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

import workbench
from workbench import interrupts
from workbench.commands.tune import page_of
from workbench.viewer import free_port


def main(recording: str, artifacts: str) -> None:
    """Serve until Ctrl-C."""
    interrupts.install()
    with tempfile.TemporaryDirectory() as folder:
        page = page_of(workbench.open(recording), Path(folder), free_port())

        def write(*_: Any) -> None:
            run = page.bench.snapshot().run
            assert run is not None
            arrays = {k: v for k, v in run.artifacts.items() if isinstance(v, np.ndarray)}
            beside = Path(artifacts).with_suffix(".part.npz")
            np.savez(beside, **arrays)
            beside.rename(artifacts)

        signal.signal(signal.SIGUSR1, write)
        with suppress(KeyboardInterrupt):
            page.serve(lambda: print(page.url, flush=True))


if __name__ == "__main__":
    main(*sys.argv[1:])

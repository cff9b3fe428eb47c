"""The page of ``workbench tune`` as a program that leaves its last artifacts in a file.

Usage: tune_host.py RECORDING ARTIFACTS.npz.  Prints the page's address when it is up.
"""

from __future__ import annotations

import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import numpy as np

import workbench
from workbench import interrupts
from workbench.commands.tune import page_of
from workbench.viewer import free_port


def main(recording: str, artifacts: str) -> None:
    """Serve until Ctrl-C, then write the artifacts that are arrays."""
    interrupts.install()
    with tempfile.TemporaryDirectory() as folder:
        page = page_of(workbench.open(recording), Path(folder), free_port())
        with suppress(KeyboardInterrupt):
            page.serve(lambda: print(page.url, flush=True))
    run = page.bench.snapshot().run
    assert run is not None
    arrays = {k: v for k, v in run.artifacts.items() if isinstance(v, np.ndarray)}
    np.savez(artifacts, **arrays)


if __name__ == "__main__":
    main(*sys.argv[1:])

"""Waiting for a condition, as long as it takes: no test sleeps for a time that may be too short."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PATIENCE_S = 180.0
"""How long a condition may take on a machine that compiles for the first time, and is busy."""


def until(condition: Callable[[], Any], what: str = "", seconds: float = PATIENCE_S) -> None:
    """Wait until ``condition`` holds; fails with ``what`` where it does not."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.01)


def until_running(
    child: subprocess.Popen[Any], condition: Callable[[], Any], told: Path | None = None
) -> None:
    """Wait until ``condition`` holds while ``child`` runs; fails with what it has told."""

    def held() -> bool:
        if condition():
            return True
        assert child.poll() is None, "" if told is None else told.read_text()
        return False

    until(held, f"{child.args}")

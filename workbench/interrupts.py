"""Ctrl-C and SIGTERM: raised at once, and remembered in case something swallows them.

An exception that is raised in the middle of a C extension's import comes out as that import's
failure, and a stage may catch what it should not.  So the handlers also remember the signal, and
loops over frames ask after each one.
"""

from __future__ import annotations

import signal
from typing import Any

from workbench.errors import EXIT_INTERRUPTED, EXIT_TERMINATED

_received: int | None = None


def install() -> None:
    """Take SIGINT and SIGTERM for this process."""
    signal.signal(signal.SIGINT, _handle)
    signal.signal(signal.SIGTERM, _handle)


def _handle(signum: int, _frame: Any) -> None:
    global _received
    _received = signum
    raise KeyboardInterrupt


def check() -> None:
    """Raise ``KeyboardInterrupt`` if a signal came, whatever became of its own exception."""
    if _received is not None:
        raise KeyboardInterrupt


def exit_code() -> int:
    """The exit code of the signal that came: 128 and its number."""
    return EXIT_TERMINATED if _received == signal.SIGTERM else EXIT_INTERRUPTED

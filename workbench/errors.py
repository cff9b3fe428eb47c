"""Mistakes that are told in one line, and the exit codes that go with them."""

from __future__ import annotations

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class DataError(Exception):
    """The data, or the run on it, failed: exit code 1."""


class UsageError(Exception):
    """The command was called wrongly: exit code 2."""


def one_line(error: BaseException) -> str:
    """What an exception says, on one line, with its type unless it is one of ours."""
    text = " ".join(str(error).split())
    if isinstance(error, DataError | UsageError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__

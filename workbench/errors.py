"""Mistakes that are told in one line, and the exit codes that go with them."""

from __future__ import annotations

import re

EXIT_DONE = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


class DataError(Exception):
    """The data, or the run on it, failed: exit code 1."""


class UsageError(Exception):
    """The command was called wrongly: exit code 2."""


_MISSING_LIBRARY = re.compile(r"(lib(\S+?)\.so)\.(\d+)\S*: cannot open shared object file")


def one_line(error: BaseException) -> str:
    """What an exception says, on one line, with its type unless it is one of ours."""
    text = " ".join(str(error).split())
    if isinstance(error, DataError | UsageError):
        return text
    lacking = _MISSING_LIBRARY.search(text) if isinstance(error, ImportError) else None
    if lacking:
        return (
            f"this system lacks {lacking[1]}.{lacking[3]} "
            f"(Debian: apt-get install {_debian_package(lacking[2], lacking[3])})"
        )
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _debian_package(name: str, version: str) -> str:
    """The Debian package of a shared library, by Debian's rule: its soname in lower case."""
    return f"lib{name}{'-' if name[-1].isdigit() else ''}{version}".lower().replace("_", "-")

"""Recordings that installed packages carry, to try the bench without files of one's own.

A package offers one through the entry-point group ``workbench.samples``: the object is its path.
"""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

from workbench.errors import UsageError

GROUP = "workbench.samples"
PREFIX = "sample:"


def located(recording: str | Path) -> Path:
    """The path of ``sample:NAME``; any other path as it is.  Raises :class:`UsageError`."""
    prefix, name = str(recording)[: len(PREFIX)], str(recording)[len(PREFIX) :]
    if prefix != PREFIX:
        return Path(recording)
    found = {entry.name: entry for entry in importlib.metadata.entry_points(group=GROUP)}
    if name not in found:
        known = ", ".join(PREFIX + other for other in sorted(found)) or "none"
        raise UsageError(f"{recording}: no such sample; samples: {known}")
    return Path(found[name].load())

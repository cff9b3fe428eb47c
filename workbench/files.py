"""Writing files so that a reader never sees half of one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from workbench.errors import DataError


@contextmanager
def replacing(path: Path, keep_partial: bool = False) -> Iterator[Path]:
    """A path beside ``path`` to write to, renamed to it at the end.

    Where the writing fails or is interrupted nothing is left behind and ``path`` is untouched;
    with ``keep_partial`` what was written until then takes its place, for files that are
    readable at any length.
    """
    beside = path.with_name(path.name + ".part")
    done = False
    try:
        yield beside
        done = True
    finally:
        if (done or keep_partial) and beside.exists():
            beside.replace(path)
        else:
            beside.unlink(missing_ok=True)


def check_output(flag: str, path: Path) -> None:
    """Raise :class:`DataError` unless a file can be put at ``path``, before any work is done."""
    if path.is_dir():
        raise DataError(f"{flag} {path}: expected a file, found a folder")
    if not path.absolute().parent.is_dir():
        raise DataError(f"{flag} {path}: there is no folder {path.parent}")

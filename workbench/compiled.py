"""Where numba keeps compiled code where neither the package nor a home can be written.

Numba keeps it beside the source, else in the user's cache folder, and refuses to compile for
keeping where it finds neither: in a container with an arbitrary user, or a service without a home.
"""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

VARIABLE = "NUMBA_CACHE_DIR"


def keep_somewhere(source: Path | None = None) -> None:
    """Name a private folder among the temporary ones, where numba would find no place.

    ``source`` is the folder of the code, by default that of this package.  Numba unpickles what it
    kept, so the folder is one that nobody else can write; where there is none, compiled code is
    kept for this process alone.  Children inherit the choice.
    """
    beside = source or Path(__file__).parent
    if os.environ.get(VARIABLE) or _writable(beside / "__pycache__") or _writable(_users()):
        return
    user = os.getuid() if hasattr(os, "getuid") else 0
    folder = Path(tempfile.gettempdir()) / f"workbench-compiled-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        private = stat.S_ISDIR(found.st_mode) and not found.st_mode & 0o077
        if not private or found.st_uid != user:
            folder = Path(tempfile.mkdtemp(prefix="workbench-compiled-"))
    except OSError:
        return
    os.environ[VARIABLE] = str(folder)


def _users() -> Path:
    """The folder in which numba keeps things for a user."""
    cache = os.environ.get("XDG_CACHE_HOME")
    return (Path(cache) if cache else Path("~").expanduser() / ".cache") / "numba"


def _writable(folder: Path) -> bool:
    """Whether a folder can be written, or made."""
    for path in (folder, *folder.parents):
        if path.exists():
            return path.is_dir() and os.access(path, os.W_OK | os.X_OK)
    return False

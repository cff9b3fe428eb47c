"""Files of plain arrays with a format name and a version: the calibration, the models."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import numpy as np

T = TypeVar("T")

_ZIP_MAGIC = b"PK"


def read_arrays(
    path: Path,
    kind: str,
    format_name: str,
    version: int,
    command: str,
    make: Callable[[dict[str, np.ndarray]], T],
) -> T:
    """What ``make`` builds of the arrays in an ``.npz``; nothing is unpickled.

    ``kind`` is what to call the file, ``command`` what writes it anew.  Raises ``OSError``, or
    ``ValueError`` with one line: not such a file, of another version, or damaged.
    """
    try:
        with path.open("rb") as raw:
            if raw.read(len(_ZIP_MAGIC)) != _ZIP_MAGIC:
                raise ValueError(f"expected a {format_name} file (.npz), found something else")
            raw.seek(0)
            file = np.load(raw, allow_pickle=False)
            arrays = {name: file[name] for name in file.files}
        if str(arrays.get("format")) != format_name:
            found = ", ".join(list(arrays)[:4])
            raise ValueError(f"expected a {format_name} file, found arrays {found}")
        if str(arrays["version"]) != str(version):
            raise ValueError(
                f"expected {kind} version {version}, found {arrays['version']}; "
                f"run `{command}` again"
            )
        return make(arrays)
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        AttributeError,
        KeyError,
        IndexError,
        TypeError,
    ) as error:
        raise ValueError(f"expected a {format_name} file: damaged or not one ({error})") from error

"""Libraries that a part of the bench needs and the rest does without: imported late, one by one."""

from __future__ import annotations

import importlib
import sys
from typing import Any

from workbench.errors import DataError, one_line

DISTRIBUTION = "defocus-workbench"


def required(module: str, what: str, extra: str) -> Any:
    """The module ``module``, which ``what`` (a few words, "a pile") cannot do without.

    Raises :class:`DataError` with one line: that it is not installed and which ``extra`` of this
    distribution brings it, or what it fails for, such as a library that the system lacks.
    """
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:
            raise DataError(f"{what} needs {module}, which cannot be loaded: {error}") from error
        raise DataError(
            f"{what} needs {module}, which is not installed: "
            f"{sys.executable} -m pip install '{DISTRIBUTION}[{extra}]'"
        ) from error
    except (ImportError, OSError) as error:
        says = f"{what} needs {module}, which cannot be loaded: {one_line(error)}"
        raise DataError(says) from error

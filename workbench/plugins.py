"""Finding stages: entry points of the group ``workbench.stages``, and files given by hand."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import ModuleType

from workbench.digest import STAGES, digest_of_file
from workbench.errors import one_line
from workbench.stage import Artifact, Stage, StageError

GROUP = STAGES


def find_stages(files: Sequence[Path] = ()) -> dict[str, Stage]:
    """Every stage by name: installed ones first, then those in ``files``.

    A later stage of the same name replaces an earlier one, which is how a file of one's own
    stands in for a built-in.  Raises :class:`StageError` for a plugin that cannot be loaded.
    """
    stages: dict[str, Stage] = {}
    for entry in sorted(importlib.metadata.entry_points(group=GROUP), key=lambda e: e.name):
        try:
            found = entry.load()
        except (Exception, SystemExit) as error:
            raise StageError(
                f"plugin {entry.name} ({entry.value}) cannot be loaded: {one_line(error)}"
            ) from error
        _add(stages, [found], f"plugin {entry.name} ({entry.value})")
    for path in files:
        module = _load_file(path)
        found_here = [
            value
            for value in vars(module).values()
            if isinstance(value, type)
            and issubclass(value, Stage)
            and value is not Stage
            and value.__module__ == module.__name__
        ]
        # A class that others here derive from is their common base, not a stage of its own.
        found_here = [
            cls
            for cls in found_here
            if not any(other is not cls and issubclass(other, cls) for other in found_here)
        ]
        if not found_here:
            raise StageError(f"--plugin {path}: no class derived from workbench.Stage in it")
        _add(stages, found_here, f"--plugin {path}")
    return stages


def _add(stages: dict[str, Stage], classes: Iterable[type], origin: str) -> None:
    for cls in classes:
        if not (isinstance(cls, type) and issubclass(cls, Stage)):
            raise StageError(f"{origin}: expected a class derived from workbench.Stage, got {cls}")
        if not getattr(cls, "name", ""):
            raise StageError(f"{origin}: {cls.__name__} has no name")
        for declared in (*cls.needs, *cls.gives):
            if not isinstance(declared, Artifact):
                raise StageError(
                    f"{origin}: {cls.__name__} needs and gives Artifacts, got {declared!r}"
                )
        try:
            stages[cls.name] = cls()
        except Exception as error:
            raise StageError(f"{origin}: {cls.__name__}: {one_line(error)}") from error


def _load_file(path: Path) -> ModuleType:
    if not path.is_file():
        raise StageError(f"--plugin {path}: no such file")
    # Its own name for each content: an edited file, or another of the same name, is another
    # module, with another code digest.
    name = f"workbench_plugin_{path.stem}_{digest_of_file(path)[:12]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise StageError(f"--plugin {path}: expected a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        # Not through Python's own cache of compiled code, which tells an edited file by the second
        # and the size: two edits in one second would run the first.
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise StageError(f"--plugin {path}: {one_line(error)}") from error
    return module

"""Digests that identify results: of values, of files and of a stage's code."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Iterable
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

import numpy as np

_BLOCK = 1 << 20
_DIGEST_BYTES = 16
_BENCH = __name__.partition(".")[0]
_INSTALLED = {"site-packages", "dist-packages"}
"""Folders of installed packages, by name."""

STAGES = "workbench.stages"
"""The group of entry points through which packages bring stages."""


def digest_of(parts: Iterable[Any]) -> str:
    """A hex digest of a sequence of strings, bytes, numbers, None and numpy arrays.

    Each part is framed by its type and length, so that ``("ab", "c")`` is not ``("a", "bc")``.
    """
    h = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for part in parts:
        if type(part) is str:
            # The commonest by far, and met in the inner loop of a sweep.
            data = repr(part).encode()
            h.update(b"str %d;" % len(data))
            h.update(data)
        elif isinstance(part, np.ndarray):
            h.update(f"array {part.dtype.str} {part.shape};".encode())
            h.update(np.ascontiguousarray(part).data)
        else:
            data = part if isinstance(part, bytes) else repr(part).encode()
            h.update(f"{type(part).__name__} {len(data)};".encode())
            h.update(data)
    return h.hexdigest()


def digest_of_file(path: Path) -> str:
    """A hex digest of a file's bytes, read in blocks."""
    h = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            h.update(block)
    return h.hexdigest()


@functools.cache
def digest_of_code(module_name: str) -> str:
    """A hex digest of a module's source and of every first-party module that it reaches.

    Follows ``import`` statements (also those inside functions), so that a change in a helper
    reruns the stages that use it, and a change elsewhere does not.  First-party are the module's
    own package, the bench, the packages that bring stages, and whatever else does not lie among
    the installed packages.  The others are identified by version instead.
    """
    own = module_name.partition(".")[0]
    seen: dict[str, bytes] = {}
    waiting = [module_name]
    while waiting:
        name = waiting.pop()
        # The bench's door leads to all of it: what is imported through it is declarations.
        if name in ("", _BENCH) or name in seen or not _is_first_party(name.partition(".")[0], own):
            continue
        path = _source_of(name)
        if path is None:
            continue
        seen[name] = source = path.read_bytes()
        above = name.rpartition(".")[0]
        # Who imports a module runs its package first.
        waiting += [above, *_imported(source, name if path.name == "__init__.py" else above)]
    return digest_of([item for name in sorted(seen) for item in (name, seen[name])])


def _is_first_party(root: str, own: str) -> bool:
    """Whether the top-level package ``root`` belongs to what a stage of package ``own`` is."""
    if root in (own, _BENCH) or root in _stage_packages():
        return True
    if root in sys.stdlib_module_names:
        return False
    spec = _spec_of(root)
    places = [spec.origin, *(spec.submodule_search_locations or ())] if spec is not None else []
    return not any(place is not None and _INSTALLED & set(Path(place).parts) for place in places)


@functools.cache
def _stage_packages() -> frozenset[str]:
    """The installed top-level packages that bring stages."""
    entries = importlib.metadata.entry_points(group=STAGES)
    return frozenset(entry.module.partition(".")[0] for entry in entries)


def _source_of(module_name: str) -> Path | None:
    """The source file of a module, without importing it if it has not been."""
    file = getattr(sys.modules.get(module_name), "__file__", None)
    if file is None:
        spec = _spec_of(module_name)
        file = spec.origin if spec is not None else None
    return Path(file) if file is not None and file.endswith(".py") else None


def _spec_of(module_name: str) -> ModuleSpec | None:
    """Where a module is found, or None; unlike ``find_spec`` this imports no package."""
    spec: ModuleSpec | None = getattr(sys.modules.get(module_name), "__spec__", None)
    if spec is not None:
        return spec
    package = module_name.rpartition(".")[0]
    if not package:
        try:
            return importlib.util.find_spec(module_name)
        except (ImportError, ValueError):
            return None
    above = _spec_of(package)
    inside = above.submodule_search_locations if above is not None else None
    return None if inside is None else PathFinder.find_spec(module_name, inside)


@functools.cache
def _imported(source: bytes, package: str) -> list[str]:
    """Names that may be modules imported by ``source``: ``from a import b`` gives a and a.b."""
    names: list[str] = []
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        # A file that no stage can have imported, such as one for another Python.
        return names
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return names

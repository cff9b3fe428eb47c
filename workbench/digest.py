"""Digests that identify results: of values, of files and of a stage's code."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

_BLOCK = 1 << 20
_DIGEST_BYTES = 16


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
    """A hex digest of a module's source and of every module of its own package that it imports.

    Follows ``import`` statements (also those inside functions) as long as they stay within the
    module's top-level package, so that a change in a helper reruns the stages that use it, and
    a change elsewhere does not.  Third-party packages are identified by version in the
    provenance instead.
    """
    root = module_name.partition(".")[0]
    seen: dict[str, bytes] = {}
    waiting = [module_name]
    while waiting:
        name = waiting.pop()
        if name in seen:
            continue
        path = _source_of(name)
        if path is None:
            continue
        seen[name] = source = path.read_bytes()
        package = name if path.name == "__init__.py" else name.rpartition(".")[0]
        waiting += [n for n in _imported(source, package) if n.partition(".")[0] == root]
    return digest_of([item for name in sorted(seen) for item in (name, seen[name])])


def _source_of(module_name: str) -> Path | None:
    """The source file of a module, without importing it if it has not been."""
    module = sys.modules.get(module_name)
    file = getattr(module, "__file__", None)
    if file is None:
        try:
            spec = importlib.util.find_spec(module_name)
        except (ImportError, ValueError):
            return None
        file = spec.origin if spec is not None else None
    return Path(file) if file is not None and file.endswith(".py") else None


def _imported(source: bytes, package: str) -> list[str]:
    """Names that may be modules imported by ``source``: ``from a import b`` gives a and a.b."""
    names: list[str] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                parents = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*parents, base] if base else parents)
            names += [base, *(f"{base}.{alias.name}" for alias in node.names)]
    return names

"""What a sweep keeps of each result, under its key, in one SQLite file.

Kept is not the stage's arrays but what the tables and the gallery are made of: scores and figures
with their state, times, failures, a bitmap for stability, a small picture.  One process writes; a
transaction holds one task, so that a sweep that is killed keeps every task that was done.
"""

from __future__ import annotations

import base64
import json
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from workbench.errors import DataError

_APPLICATION = 0x5357_4550  # "SWEP", so that another program's file is not taken for ours.
_ARRAY = "__array__"
# Made once, for that costs more than what they do; a process packs in one thread at a time.
_compressor = zstandard.ZstdCompressor(level=3)
_decompressor = zstandard.ZstdDecompressor()
_SCHEMA = """
CREATE TABLE IF NOT EXISTS results (
    source TEXT, frame INTEGER, key TEXT, failed INTEGER, record BLOB, outline BLOB,
    PRIMARY KEY (source, frame, key)
);
CREATE INDEX IF NOT EXISTS by_key ON results (key, source, frame);
CREATE TABLE IF NOT EXISTS pictures (
    key TEXT, source TEXT, frame INTEGER, image BLOB, PRIMARY KEY (key, source, frame)
);
CREATE TABLE IF NOT EXISTS frames (
    source TEXT, frame INTEGER, readable INTEGER, PRIMARY KEY (source, frame)
);
"""


@dataclass(frozen=True)
class Kept:
    """One stage's result on one frame, as it is kept; ``record`` is :func:`packed`."""

    key: str
    frame: int
    failed: bool
    record: bytes
    outline: bytes | None
    picture: bytes | None


def packed(value: Any) -> bytes:
    """Numbers, texts, lists, mappings and numpy arrays as bytes, which nothing executes to read."""
    text = json.dumps(value, default=_array_to_json, separators=(",", ":"))
    return _compressor.compress(text.encode())


def unpacked(data: bytes) -> Any:
    """The value that was :func:`packed`."""
    text = _decompressor.decompress(data)
    return json.loads(text, object_hook=_array_from_json)


def _array_to_json(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        data = base64.b64encode(np.ascontiguousarray(value).tobytes()).decode()
        return {_ARRAY: [value.dtype.str, list(value.shape), data]}
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a scorer's state holds a {type(value).__name__}, which cannot be kept")


def _array_from_json(value: dict[str, Any]) -> Any:
    if _ARRAY not in value:
        return value
    dtype, shape, data = value[_ARRAY]
    return np.frombuffer(base64.b64decode(data), dtype=np.dtype(dtype)).reshape(shape)


class Cache:
    """The results kept in one file; use it as a context manager.

    Raises :class:`DataError` with one line where the file is another's, in use or cannot grow.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with self._told():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, timeout=1.0, isolation_level=None)
            try:
                application = self._db.execute("PRAGMA application_id").fetchone()[0]
                tables = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
                if tables and application != _APPLICATION:
                    raise DataError(f"{path}: expected the results of a sweep, found another file")
                # One sweep at a time: a second one would wait for ever or do all work twice.
                self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute("PRAGMA synchronous = NORMAL")
                self._db.executescript(_SCHEMA)
                self._db.execute(f"PRAGMA application_id = {_APPLICATION}")
            except BaseException:
                self._db.close()
                raise

    def __enter__(self) -> Cache:
        return self

    def __exit__(self, *exception: object) -> None:
        self._db.close()

    def forget_failures(self) -> None:
        """Drop the results that failed: what failed for want of memory may not fail again."""
        with self._told():
            self._db.execute("DELETE FROM results WHERE failed")

    def put(self, source: str, seen: Mapping[int, bool], kept: Iterable[Kept]) -> None:
        """Take in one task's results, all of them or none.

        ``seen`` maps the frames that were read to whether they could be decoded.
        """
        with self._told():
            self._db.execute("BEGIN")
            try:
                self._db.executemany(
                    "INSERT OR REPLACE INTO frames VALUES (?, ?, ?)",
                    [(source, frame, readable) for frame, readable in seen.items()],
                )
                for one in kept:
                    self._db.execute(
                        "INSERT OR REPLACE INTO results VALUES (?, ?, ?, ?, ?, ?)",
                        (source, one.frame, one.key, one.failed, one.record, one.outline),
                    )
                    if one.picture is not None:
                        self._db.execute(
                            "INSERT OR REPLACE INTO pictures VALUES (?, ?, ?, ?)",
                            (one.key, source, one.frame, one.picture),
                        )
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise

    def unreadable(self, source: str) -> set[int]:
        """Frames that are known not to decode."""
        return self._frames("SELECT frame FROM frames WHERE source = ? AND NOT readable", source)

    def readable(self, source: str) -> set[int]:
        """Frames that are known to decode."""
        return self._frames("SELECT frame FROM frames WHERE source = ? AND readable", source)

    def _frames(self, query: str, source: str) -> set[int]:
        with self._told():
            return {row[0] for row in self._db.execute(query, (source,))}

    def counts(self, source: str, start: int, stop: int) -> dict[str, int]:
        """Of how many frames in ``start`` to ``stop`` each key has a result."""
        with self._told():
            return dict(
                self._db.execute(
                    "SELECT key, count(*) FROM results "
                    "WHERE source = ? AND frame >= ? AND frame < ? AND NOT failed GROUP BY key",
                    (source, start, stop),
                )
            )

    def drawn(self, key: str, source: str) -> set[int]:
        """The frames of which a picture is kept under this key."""
        with self._told():
            rows = self._db.execute(
                "SELECT frame FROM pictures WHERE key = ? AND source = ?", (key, source)
            )
            return {row[0] for row in rows}

    def records(self, key: str, source: str, frames: range) -> Iterator[tuple[int, Any]]:
        """(frame, record) in the order of the frames."""
        yield from (
            (frame, unpacked(data)) for frame, data in self._column("record", key, source, frames)
        )

    def outlines(self, key: str, source: str, frames: range) -> Iterator[tuple[int, bytes]]:
        """(frame, bitmap) in the order of the frames, where there is one."""
        yield from (
            (frame, data)
            for frame, data in self._column("outline", key, source, frames)
            if data is not None
        )

    def _column(
        self, column: str, key: str, source: str, frames: range
    ) -> Sequence[tuple[int, bytes]]:
        with self._told():
            return self._db.execute(
                f"SELECT frame, {column} FROM results WHERE key = ? AND source = ? "
                "AND frame >= ? AND frame < ? ORDER BY frame",
                (key, source, frames.start, frames.stop),
            ).fetchall()

    def picture(self, key: str, source: str, frame: int) -> bytes | None:
        """An encoded image, or None."""
        with self._told():
            row = self._db.execute(
                "SELECT image FROM pictures WHERE key = ? AND source = ? AND frame = ?",
                (key, source, frame),
            ).fetchone()
        return None if row is None else row[0]

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            says = str(error)
            if "locked" in says:
                raise DataError(f"{self.path}: another sweep is at work here") from error
            if "full" in says:
                raise DataError(f"{self.path}: the disk is full; what was done is kept") from error
            raise DataError(f"{self.path}: {says}") from error
        except sqlite3.DatabaseError as error:
            raise DataError(
                f"{self.path}: expected the results of a sweep, found a file that cannot be read "
                f"({error}); remove it to start anew"
            ) from error

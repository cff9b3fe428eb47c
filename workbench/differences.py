"""How two runs of one frame differ: which artifacts, on how much of them, and where.

``A`` is what is held against, ``B`` what is held against it; a signed difference is B minus A.
Plain numpy: neither Rerun nor the command line is imported here.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from workbench.pipeline import Run
from workbench.stage import Artifact, Stage

Kind = Literal["mask", "codes", "labels", "map", "array", "object", "missing"]
"""How an artifact is compared; ``missing`` is one that only one of the two runs gave."""

_BLOCK_PX = 16
_TOLD = 3
_DEEPEST = 16


class Place(IntEnum):
    """What a pixel of a picture of states says of the two runs."""

    NEITHER = 0
    """Zero, false or without a region in both."""
    BOTH = 1
    """The same in both."""
    ONLY_A = 2
    ONLY_B = 3
    OTHER = 4
    """Something in both, but not the same: another code, or a region cut up in another way."""


class Knowledge(IntEnum):
    """Where a map of floats has a value at all."""

    BOTH = 0
    ONLY_A = 1
    ONLY_B = 2
    NEITHER = 3


@dataclass(frozen=True)
class Difference:
    """How one artifact differs between two runs of one frame."""

    kind: Kind
    differing: int
    """Elements (pixels of an image, values inside an object) that are not the same."""
    of: int | None = None
    """Elements that were compared; None where they cannot be counted alike."""
    says: str = ""
    """What differs, in a few words, where numbers alone do not tell: an object, a shape."""
    largest: float | None = None
    """The greatest absolute difference among values known in both, in the artifact's unit."""
    at: tuple[int, ...] | None = None
    """Where that is: (x, y) in an image, otherwise the index.  For states, where most differ."""
    box: tuple[int, int, int, int] | None = None
    """The bounds of what differs in an image: least x, least y, greatest x, greatest y."""
    only_a: int = 0
    """Pixels that only A has: set, in a region, or known."""
    only_b: int = 0
    states: NDArray[np.uint8] | None = None
    """H W, a :class:`Place` each; of masks, codes and labels that differ."""
    signed: NDArray[np.float32] | None = None
    """H W, B minus A, in the artifact's unit; 0 where it is not known in both.  Of maps."""
    knowledge: NDArray[np.uint8] | None = None
    """H W, a :class:`Knowledge` each; of maps that differ."""

    @property
    def same(self) -> bool:
        return self.differing == 0

    @property
    def share(self) -> float | None:
        """Differing elements over all, 0..1; None where they cannot be counted."""
        return self.differing / self.of if self.of else None


def kind_of(artifact: Artifact) -> Kind:
    """How an artifact is compared, by what it was declared to be."""
    if artifact.dtype == "object":
        return "object"
    dtype = np.dtype(artifact.dtype)
    if artifact.axes != ("H", "W"):
        return "array"
    if dtype.kind == "b":
        return "mask"
    if dtype.kind in "iu":
        return "labels" if artifact.names_regions else "codes"
    return "map" if dtype.kind == "f" else "array"


def differences_of_runs(
    stages: Sequence[Stage], a: Run, b: Run
) -> dict[str, dict[str, Difference]]:
    """The difference of every artifact that either run has, by stage and by name.

    Results under the same digest are the same result, and are not looked at.
    """
    found: dict[str, dict[str, Difference]] = {}
    for stage in stages:
        own: dict[str, Difference] = {}
        for artifact in stage.gives:
            name = artifact.name
            in_a, in_b = name in a.artifacts, name in b.artifacts
            if in_a and in_b:
                if a.digests[name] == b.digests[name]:
                    own[name] = Difference(kind_of(artifact), 0, _size(a.artifacts[name]))
                else:
                    own[name] = difference_of(artifact, a.artifacts[name], b.artifacts[name])
            elif in_a or in_b:
                has, lacks = ("A", "B") if in_a else ("B", "A")
                own[name] = Difference("missing", 1, None, f"only in {has}: {lacks} failed")
        found[stage.name] = own
    return found


def difference_of(artifact: Artifact, a: Any, b: Any) -> Difference:
    """The difference of two values of one artifact."""
    kind = kind_of(artifact)
    if kind == "object":
        return _of_objects(a, b, artifact.name)
    if a.shape != b.shape:
        return Difference(kind, 1, None, f"{_shape(a)} in A, {_shape(b)} in B")
    if kind == "map":
        return _of_maps(a, b)
    if kind == "array":
        return _of_arrays(a, b)
    return _of_states(kind, a, b)


# -- images ---------------------------------------------------------------------------------------


def _of_states(kind: Kind, a: NDArray[Any], b: NDArray[Any]) -> Difference:
    same = matched(a, b) if kind == "labels" else np.asarray(a == b)
    in_a, in_b = np.asarray(a != 0), np.asarray(b != 0)
    states = np.full(a.shape, Place.OTHER, np.uint8)
    states[same] = Place.BOTH
    states[in_a & ~in_b] = Place.ONLY_A
    states[in_b & ~in_a] = Place.ONLY_B
    states[~in_a & ~in_b] = Place.NEITHER
    differs = states >= Place.ONLY_A
    count = int(differs.sum())
    return Difference(
        kind,
        count,
        differs.size,
        at=_densest(differs) if count else None,
        box=_box(differs),
        only_a=int((states == Place.ONLY_A).sum()),
        only_b=int((states == Place.ONLY_B).sum()),
        states=states if count else None,
    )


def matched(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Where two label images [H W] show the same region, whatever its number in each.

    A region of A and one of B are the same if each is the one that the other shares most pixels
    with.  0 is no region, and is the same as 0.
    """
    names_a, index_a = np.unique(a, return_inverse=True)
    names_b, index_b = np.unique(b, return_inverse=True)
    pair = index_a.ravel() * len(names_b) + index_b.ravel()
    pairs, shared = np.unique(pair, return_counts=True)
    rows, columns = np.divmod(pairs, len(names_b))
    labelled = (names_a[rows] != 0) & (names_b[columns] != 0)
    best_a = np.zeros(len(names_a), shared.dtype)
    best_b = np.zeros(len(names_b), shared.dtype)
    np.maximum.at(best_a, rows[labelled], shared[labelled])
    np.maximum.at(best_b, columns[labelled], shared[labelled])
    mutual = labelled & (shared == best_a[rows]) & (shared == best_b[columns])
    mutual &= _first_of_each(rows, mutual) & _first_of_each(columns, mutual)
    mutual |= (names_a[rows] == 0) & (names_b[columns] == 0)
    return np.isin(pair, pairs[mutual]).reshape(a.shape)


def _first_of_each(keys: NDArray[Any], among: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of the entries in ``among``, the first of each key: a tie goes to one pair alone."""
    first = np.zeros(len(keys), bool)
    places = np.flatnonzero(among)
    first[places[np.unique(keys[places], return_index=True)[1]]] = True
    return first


def _of_maps(a: NDArray[Any], b: NDArray[Any]) -> Difference:
    unknown_a, unknown_b = np.isnan(a), np.isnan(b)
    knowledge = np.zeros(a.shape, np.uint8)
    knowledge[unknown_b & ~unknown_a] = Knowledge.ONLY_A
    knowledge[unknown_a & ~unknown_b] = Knowledge.ONLY_B
    knowledge[unknown_a & unknown_b] = Knowledge.NEITHER
    both = knowledge == Knowledge.BOTH
    # Equal infinities are equal, though their difference is not a number.
    moved = both & (a != b)
    signed = np.zeros(a.shape, np.float32)
    signed[moved] = b[moved].astype(np.float64) - a[moved]
    differs = moved | (knowledge == Knowledge.ONLY_A) | (knowledge == Knowledge.ONLY_B)
    count = int(differs.sum())
    if count == 0:
        return Difference("map", 0, a.size)
    size = np.abs(signed)
    peak = int(size.argmax())
    largest = float(size.flat[peak])
    row, column = divmod(peak, a.shape[1])
    return Difference(
        "map",
        count,
        a.size,
        largest=largest if moved.any() else None,
        at=(column, row) if moved.any() else _densest(differs),
        box=_box(differs),
        only_a=int((knowledge == Knowledge.ONLY_A).sum()),
        only_b=int((knowledge == Knowledge.ONLY_B).sum()),
        signed=signed,
        knowledge=knowledge,
    )


def _box(differs: NDArray[np.bool_]) -> tuple[int, int, int, int] | None:
    rows, columns = np.flatnonzero(differs.any(axis=1)), np.flatnonzero(differs.any(axis=0))
    if not len(rows):
        return None
    return int(columns[0]), int(rows[0]), int(columns[-1]), int(rows[-1])


def _densest(differs: NDArray[np.bool_]) -> tuple[int, int]:
    """A pixel (x, y) that differs, in the block of the image where most do."""
    rows = np.arange(0, differs.shape[0], _BLOCK_PX)
    columns = np.arange(0, differs.shape[1], _BLOCK_PX)
    sums = np.add.reduceat(np.add.reduceat(differs.astype(np.int64), rows, 0), columns, 1)
    row, column = np.unravel_index(int(sums.argmax()), sums.shape)
    top, left = int(rows[row]), int(columns[column])
    ys, xs = np.nonzero(differs[top : top + _BLOCK_PX, left : left + _BLOCK_PX])
    middle = int(np.argmin((ys - ys.mean()) ** 2 + (xs - xs.mean()) ** 2))
    return left + int(xs[middle]), top + int(ys[middle])


# -- other arrays, and objects --------------------------------------------------------------------


def _of_arrays(a: NDArray[Any], b: NDArray[Any]) -> Difference:
    changed = _changed(a, b)
    count = int(changed.sum())
    if count == 0:
        return Difference("array", 0, a.size)
    largest, place = None, np.unravel_index(int(changed.argmax()), changed.shape)
    if a.dtype.kind in "iuf":
        # What is not finite in one of them differs, but by no amount.
        finite = changed & np.isfinite(a) & np.isfinite(b)
        if finite.any():
            size = np.zeros(a.shape)
            size[finite] = np.abs(b[finite].astype(np.float64) - a[finite].astype(np.float64))
            peak = int(size.argmax())
            largest, place = float(size.flat[peak]), np.unravel_index(peak, size.shape)
    return Difference(
        "array", count, a.size, largest=largest, at=tuple(int(index) for index in place)
    )


def _changed(a: NDArray[Any], b: NDArray[Any]) -> NDArray[np.bool_]:
    """Where two arrays of one shape differ; NaN is the same as NaN."""
    changed = np.asarray(a != b)
    if a.dtype.kind in "fc" and b.dtype.kind in "fc":
        changed &= ~(np.isnan(a) & np.isnan(b))
    return changed


@dataclass(frozen=True)
class _Leaf:
    """A place inside an object where two runs differ, and how many values do there."""

    path: str
    says: str
    count: int = 1


def _of_objects(a: Any, b: Any, name: str) -> Difference:
    leaves = list(_leaves(a, b, name, frozenset(), 0))
    if not leaves:
        return Difference("object", 0)
    says = "; ".join(f"{leaf.path} {leaf.says}" for leaf in leaves[:_TOLD])
    if len(leaves) > _TOLD:
        says += f"; and {len(leaves) - _TOLD} more"
    return Difference("object", sum(leaf.count for leaf in leaves), says=says)


def _leaves(
    a: Any, b: Any, path: str, within: frozenset[tuple[int, int]], depth: int
) -> Iterator[_Leaf]:
    """Where two objects differ; ``within`` are the pairs that they are inside of."""
    if a is b or (id(a), id(b)) in within or depth > _DEEPEST:
        return
    within |= {(id(a), id(b))}
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        yield from _leaves_of_arrays(a, b, path)
    elif isinstance(a, Mapping) and isinstance(b, Mapping):
        for key in [*a, *(key for key in b if key not in a)]:
            inner = f"{path}.{key}"
            if key in a and key in b:
                yield from _leaves(a[key], b[key], inner, within, depth + 1)
            else:
                yield _Leaf(inner, f"only in {'A' if key in a else 'B'}")
    elif isinstance(a, list | tuple) and isinstance(b, list | tuple):
        if len(a) != len(b):
            yield _Leaf(path, f"has {len(a)} in A, {len(b)} in B")
        for index, (one, other) in enumerate(zip(a, b, strict=False)):
            yield from _leaves(one, other, f"{path}[{index}]", within, depth + 1)
    elif type(a) is type(b) and is_dataclass(a) and not isinstance(a, type):
        for part in fields(a):
            one, other = getattr(a, part.name), getattr(b, part.name)
            yield from _leaves(one, other, f"{path}.{part.name}", within, depth + 1)
    elif not _equal(a, b):
        if type(a) is type(b) and hasattr(a, "__dict__") and "__eq__" not in vars(type(a)):
            # Its own idea of equality is to be the very same object: what it holds decides.
            yield from _leaves(vars(a), vars(b), path, within, depth + 1)
        else:
            yield _Leaf(path, f"{_short(a)} in A, {_short(b)} in B")


def _leaves_of_arrays(a: NDArray[Any], b: NDArray[Any], path: str) -> Iterator[_Leaf]:
    if a.dtype.names is not None and a.dtype == b.dtype and a.shape == b.shape:
        for name in a.dtype.names:
            yield from _leaves_of_arrays(a[name], b[name], f"{path}.{name}")
    elif a.shape != b.shape or a.dtype != b.dtype:
        kinds = "" if a.dtype == b.dtype or a.dtype.names else f" {a.dtype} and {b.dtype}"
        yield _Leaf(path, f"has {_shape(a)}{kinds} in A, {_shape(b)} in B")
    else:
        changed = _changed(a, b)
        count = int(changed.sum())
        if count:
            index = np.unravel_index(int(changed.argmax()), changed.shape)
            place = "".join(f"[{int(i)}]" for i in index)
            says = f"{_short(a[index])} in A, {_short(b[index])} in B"
            yield _Leaf(path + place, says, count)


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, float | np.floating) and isinstance(b, float | np.floating):
        return bool(a == b) or (math.isnan(a) and math.isnan(b))
    try:
        return bool(a == b)
    except Exception:
        # An object that cannot be asked is not known to be the same.
        return False


def _short(value: Any) -> str:
    text = f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
    text = " ".join(text.split())
    return text if len(text) <= 60 else text[:57] + "…"


def _shape(array: NDArray[Any]) -> str:
    return "×".join(map(str, array.shape)) + (" rows" if array.ndim == 1 else "")


def _size(value: Any) -> int | None:
    return value.size if isinstance(value, np.ndarray) and value.dtype.names is None else None


# -- over many frames -----------------------------------------------------------------------------


@dataclass
class Total:
    """How one artifact differs over the frames of two runs."""

    stage: str
    artifact: str
    kind: Kind = "object"
    unit: str = ""
    frames: int = 0
    differing_frames: int = 0
    share_sum: float = 0.0
    shared_frames: int = 0
    worst_share: float = 0.0
    worst_frame: int | None = None
    """The frame of which the greatest share differs, or the first that differs."""
    largest: float | None = None
    largest_frame: int | None = None
    at: tuple[int, ...] | None = None
    """Where ``largest`` is in its frame; for states, where most differ in ``worst_frame``."""
    box: tuple[int, int, int, int] | None = None
    """The bounds of what differs on any frame."""
    only_a: int = 0
    only_b: int = 0
    says: str = ""

    def add(self, frame: int, difference: Difference) -> None:
        """Take the difference of one frame in."""
        self.frames += 1
        share = difference.share
        if share is not None:
            self.share_sum += share
            self.shared_frames += 1
        if difference.same:
            return
        if self.differing_frames == 0:
            self.kind = difference.kind
        self.differing_frames += 1
        if self.worst_frame is None or (share or 0.0) > self.worst_share:
            self.worst_share, self.worst_frame = share or 0.0, frame
            if difference.largest is None and self.largest is None:
                self.at = difference.at
        if difference.largest is not None and (
            self.largest is None or difference.largest > self.largest
        ):
            self.largest, self.largest_frame = difference.largest, frame
            self.at = difference.at
        if difference.says and not self.says:
            self.says = f"frame {frame}: {difference.says}"
        self.only_a += difference.only_a
        self.only_b += difference.only_b
        if difference.box is not None:
            self.box = difference.box if self.box is None else _union(self.box, difference.box)

    @property
    def share(self) -> float | None:
        """The mean share of elements that differ, over every frame; None if not countable."""
        return self.share_sum / self.shared_frames if self.shared_frames else None

    def as_dict(self) -> dict[str, Any]:
        """JSON values."""
        finite = self.largest is not None and math.isfinite(self.largest)
        return {
            "stage": self.stage,
            "artifact": self.artifact,
            "kind": self.kind,
            "unit": self.unit,
            "frames": self.frames,
            "differing_frames": self.differing_frames,
            "share": self.share,
            "worst_frame": self.worst_frame,
            "worst_share": self.worst_share if self.shared_frames else None,
            "largest": self.largest if finite else None,
            "largest_frame": self.largest_frame,
            "at": list(self.at) if self.at is not None else None,
            "box": list(self.box) if self.box is not None else None,
            "only_a": self.only_a,
            "only_b": self.only_b,
            "says": self.says,
        }


class Totals:
    """The differences of two runs over their frames, by stage and artifact, in order."""

    def __init__(self, artifacts: Mapping[str, Sequence[Artifact]]) -> None:
        self.of: dict[str, dict[str, Total]] = {
            stage: {a.name: Total(stage, a.name, kind_of(a), a.unit) for a in own}
            for stage, own in artifacts.items()
        }

    def add(self, frame: int, differences: Mapping[str, Mapping[str, Difference]]) -> None:
        """Take the differences of one frame in."""
        for stage, own in differences.items():
            for artifact, difference in own.items():
                self.of[stage][artifact].add(frame, difference)

    def differing(self) -> list[Total]:
        """The artifacts that differ on any frame."""
        return [t for own in self.of.values() for t in own.values() if t.differing_frames]

    @property
    def stages(self) -> list[str]:
        """The stages of which some artifact differs on any frame."""
        return list(dict.fromkeys(total.stage for total in self.differing()))


def _union(a: tuple[int, int, int, int], b: tuple[int, int, int, int]) -> tuple[int, int, int, int]:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])

"""Saved replays, read back: their provenance, their numbers, their pictures and their layout.

Everything that relies on how Rerun keeps a recording in an .rrd file is in this module.  A file
is held in memory while it is read, about as large as it is unpacked.
"""

from __future__ import annotations

import re
import statistics
import uuid
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from workbench.bridge import FRAME_TIMELINE, STAMP_TIMELINE
from workbench.comparison import Side
from workbench.differences import Difference, difference_of
from workbench.errors import DataError, one_line
from workbench.stage import Artifact

PROVENANCE = "/__properties/provenance"
_PROPERTIES = "/__properties"
_TIMES, _SCORES = "/bench/times/", "/bench/scores/"
_OWN = ("/bench/", "/recorded/", _PROPERTIES)
_NEEDED = ("preset", "parameters", "recording", "code")
_CLEAR = "Clear:"
_VALUES, _UNKNOWN = "/values", "/unknown"
"""A depth image cannot hold NaN: where one that is called ``values`` is not known is told by the
classes of a segmentation image beside it, called ``unknown``."""

Row = Mapping[str, Any]
"""Component name to its Arrow array, of one entity on one frame."""


@dataclass
class SavedReplay:
    """One replay out of an .rrd file."""

    path: Path
    provenance: Mapping[str, list[str]]
    chunks: list[Any] = field(repr=False)
    rows: Mapping[str, Mapping[int, Row]] = field(repr=False)
    """Entity to frame to what was logged there then; the stages' own entities and scalars."""
    stamps_ns: dict[int, int] = field(repr=False)
    """Frame to its stamp."""
    views: list[rrb.View] = field(repr=False)
    """The views of the layout that the file carries, in reading order."""

    @property
    def stages(self) -> list[str]:
        """The stages, in the order in which they ran."""
        return [line.partition("=")[0] for line in self.provenance["code"]]

    def side(self) -> Side:
        """What the file tells of itself."""
        told = self.provenance
        return Side(
            self.path.name,
            told["preset"][0],
            [line for line in told.get("changed", []) if line != "nothing"],
            {key: _typed(text) for key, text in _pairs(told["parameters"]).items()},
            {
                "recording": told["recording"][0],
                **_pairs(told.get("resources", [])),
                **{f"code of {stage}": d for stage, d in _pairs(told["code"]).items()},
                "bench": told.get("bench", ["not told"])[0],
                **_pairs(told.get("libraries", [])),
            },
            self._median_ms(),
        )

    def scores(self, frame: int) -> dict[str, float]:
        """What one frame scored, ``stage/name`` to value."""
        found = {}
        for entity in sorted(self.rows):
            if entity.startswith(_SCORES):
                value = _scalar(self.rows[entity].get(frame, {}))
                if value is not None:
                    found[entity.removeprefix(_SCORES)] = value
        return found

    def _median_ms(self) -> dict[str, float]:
        found = {}
        for entity in sorted(self.rows):
            if entity.startswith(_TIMES):
                values = [_scalar(row) for row in self.rows[entity].values()]
                known = [value for value in values if value is not None]
                if known:
                    found[entity.removeprefix(_TIMES)] = statistics.median(known)
        return found

    def pictures(self) -> list[str]:
        """The entities that stages logged over the frames, by name: a file has no other order."""
        return [entity for entity in sorted(self.rows) if not entity.startswith(_OWN)]

    def forward(self, recording: rr.RecordingStream, prefix: str) -> None:
        """Send everything that was logged on to another recording, under ``/prefix``."""
        recording.send_chunks(
            [
                chunk.with_entity_path(f"/{prefix}{chunk.entity_path}")
                for chunk in self.chunks
                if not chunk.entity_path.startswith(_PROPERTIES)
            ]
        )
        values: dict[str, Any] = dict(self.provenance)
        recording.send_property(f"provenance_{prefix.lower()}", rr.AnyValues(**values))


def read(path: Path) -> SavedReplay:
    """A replay that ``workbench replay --save`` wrote.

    Raises :class:`DataError` where the file is no such thing.
    """
    import rerun.chunk

    if not path.is_file():
        raise DataError(f"{path}: no such file")
    try:
        with warnings.catch_warnings():
            # An interrupted replay may lack its index; the chunks are read one by one anyway.
            warnings.simplefilter("ignore")
            reader = rerun.chunk.RrdReader(str(path))
            recordings = reader.recordings()
            if not recordings:
                raise DataError(f"{path}: expected a replay saved by workbench, found none in it")
            chunks = reader.stream(store=recordings[0]).to_chunks()
            layouts = reader.blueprints()
            layout = reader.stream(store=layouts[-1]).to_chunks() if layouts else []
    except (RuntimeError, ValueError, OSError) as error:
        says = one_line(error).rpartition(f"{path}: ")[2]
        if "decode" in says:
            says += f" ({_saved_by(path)})"
        raise DataError(f"{path}: expected a saved replay (.rrd), found: {says}") from error
    provenance = _provenance(chunks)
    if provenance is None:
        raise DataError(
            f"{path}: expected a replay saved by workbench, found a recording of "
            f"{recordings[0].application_id!r} without a replay's provenance (if it was cut short, "
            f"{_saved_by(path)})"
        )
    rows: dict[str, dict[int, dict[str, Any]]] = {}
    stamps_ns: dict[int, int] = {}
    for chunk in chunks:
        if chunk.is_static or FRAME_TIMELINE not in chunk.timeline_names:
            continue
        batch = chunk.to_record_batch()
        frames = batch.column(FRAME_TIMELINE).to_pylist()
        if STAMP_TIMELINE in chunk.timeline_names:
            stamps = np.asarray(batch.column(STAMP_TIMELINE).cast("int64"))
            stamps_ns.update(zip(frames, stamps.tolist(), strict=True))
        own = rows.setdefault(chunk.entity_path, {})
        for index, frame in enumerate(frames):
            # What was logged in one call may be spread over several chunks.
            row = _row(batch, index)
            if row:
                own.setdefault(frame, {}).update(row)
    return SavedReplay(path, provenance, chunks, rows, stamps_ns, views_of(layout))


def differences(
    a: SavedReplay, b: SavedReplay, frame: int, owners: Mapping[str, tuple[str, str]]
) -> dict[str, dict[str, Difference]]:
    """How the pictures of one frame differ, by stage and name.

    ``owners`` gives the stage and the name of each entity.  What is not a picture is the same or
    is not.
    """
    found: dict[str, dict[str, Difference]] = {}
    for entity, (stage, name) in owners.items():
        row_a, row_b = (side.rows.get(entity, {}).get(frame) for side in (a, b))
        if row_a is not None and row_b is not None:
            unknown = entity.removesuffix(_VALUES) + _UNKNOWN
            masks = [_unknown(side.rows.get(unknown, {}).get(frame)) for side in (a, b)]
            if not entity.endswith(_VALUES):
                masks = [None, None]
            found.setdefault(stage, {})[name] = _row_difference(name, row_a, row_b, masks)
        elif row_a is not None or row_b is not None:
            only = "A" if row_a is not None else "B"
            found.setdefault(stage, {})[name] = Difference("missing", 1, None, f"only in {only}")
    return found


def owners_of(
    replays: Iterable[SavedReplay], views: Mapping[str, Iterable[rrb.View]]
) -> dict[str, tuple[str, str]]:
    """The stage and the name of every entity that stages logged.

    ``views`` are the views of each stage: an entity that does not begin with the name of a stage
    belongs to the stage whose view looks at it.
    """
    homes = {
        str(view.origin).lstrip("/").partition("/")[0]: stage
        for stage, own in views.items()
        for view in own
    }
    found: dict[str, tuple[str, str]] = {}
    for replay in replays:
        for entity in replay.pictures():
            first, _, rest = entity.lstrip("/").partition("/")
            if first in replay.stages:
                found[entity] = (first, rest or first)
            else:
                found[entity] = (homes.get(first, first), entity.lstrip("/"))
    return found


# -- what an .rrd holds ---------------------------------------------------------------------------


def _saved_by(path: Path) -> str:
    return f"what is whole is saved by: rerun rrd optimize {path} -o whole.rrd"


def _provenance(chunks: Iterable[Any]) -> dict[str, list[str]] | None:
    for chunk in chunks:
        if chunk.entity_path == PROVENANCE and chunk.num_rows:
            batch = chunk.to_record_batch()
            told = {
                name: [str(item) for item in batch.column(name)[0].as_py() or []]
                for name in batch.schema.names
                if not name.startswith("rerun.")
            }
            if all(told.get(name) for name in _NEEDED):
                return told
    return None


def _row(batch: Any, index: int) -> dict[str, Any]:
    """The components of one row; none where it clears what was there."""
    row = {}
    for name in batch.schema.names:
        kind = (batch.schema.field(name).metadata or {}).get(b"rerun:kind")
        column = batch.column(name)
        if kind == b"data" and column[index].is_valid:
            row[name] = column[index].values
    return {} if any(name.startswith(_CLEAR) for name in row) else row


def _scalar(row: Row) -> float | None:
    values = row.get("Scalars:scalars")
    return float(values[0].as_py()) if values is not None and len(values) == 1 else None


def _unknown(row: Row | None) -> NDArray[np.bool_] | None:
    image = _image(row) if row is not None else None
    return image[1] != 0 if image is not None and image[0] == "SegmentationImage" else None


def _row_difference(
    name: str, a: Row, b: Row, unknown: Sequence[NDArray[np.bool_] | None]
) -> Difference:
    same = all(key in b and b[key].equals(a[key]) for key in a) and len(a) == len(b)
    if same and unknown[0] is None and unknown[1] is None:
        return Difference("object", 0)
    image_a, image_b = _image(a), _image(b)
    if image_a is not None and image_b is not None and image_a[0] == image_b[0]:
        (kind, picture_a), (_, picture_b) = image_a, image_b
        if picture_a.shape == picture_b.shape and picture_a.dtype == picture_b.dtype:
            for picture, mask in zip((picture_a, picture_b), unknown, strict=True):
                if mask is not None and mask.shape == picture.shape and kind == "DepthImage":
                    picture[mask] = np.nan
            return _image_difference(name, kind, picture_a, picture_b)
    if same:
        return Difference("object", 0)
    value_a, value_b = _scalar(a), _scalar(b)
    if value_a is not None and value_b is not None:
        says = f"{value_a:.6g} in A, {value_b:.6g} in B"
        return Difference("object", 1, says=says, largest=abs(value_b - value_a))
    return Difference("object", 1, says="not the same " + ", ".join(_archetypes(a, b)))


def _archetypes(a: Row, b: Row) -> list[str]:
    changed = [key for key in {**a, **b} if key not in a or key not in b or a[key] != b[key]]
    return sorted({key.replace(":", " ") for key in changed})


def _image_difference(name: str, kind: str, a: NDArray[Any], b: NDArray[Any]) -> Difference:
    if kind == "SegmentationImage":
        # Classes of a picture are numbered as they come.
        return difference_of(Artifact(name, a.dtype.name, "H W", names_regions=True), a, b)
    if a.ndim > 2:
        # A picture in colours has no sign: a pixel is the same or it is not.
        changed = (a != b).any(axis=-1)
        both = np.where(changed, np.uint8(2), np.uint8(1))
        return difference_of(Artifact(name, "uint8", "H W"), np.ones_like(both), both)
    if kind == "Image" and _is_mask(a) and _is_mask(b):
        return difference_of(Artifact(name, "bool", "H W"), a != 0, b != 0)
    as_floats = a.astype(np.float32), b.astype(np.float32)
    return difference_of(Artifact(name, "float32", "H W"), *as_floats)


def _is_mask(image: NDArray[Any]) -> bool:
    return image.dtype == np.uint8 and bool(np.isin(image, (0, 255)).all())


def _image(row: Row) -> tuple[str, NDArray[Any]] | None:
    """The archetype and the pixels of an image that is not packed; else None."""
    for kind in ("Image", "DepthImage", "SegmentationImage"):
        if f"{kind}:buffer" in row and f"{kind}:format" in row:
            told = row[f"{kind}:format"][0].as_py()
            if told.get("pixel_format") is not None or told.get("channel_datatype") is None:
                return None
            dtype = rr.ChannelDatatype(told["channel_datatype"]).to_np_dtype()
            model = told.get("color_model")
            channels = rr.ColorModel(model).num_channels() if model is not None else 1
            shape = (told["height"], told["width"], channels)
            # A buffer is one list of bytes; the array around it may hold other frames' as well.
            pixels: NDArray[Any] = np.asarray(row[f"{kind}:buffer"][0].values).view(dtype)
            if pixels.size != np.prod(shape):
                return None
            image = pixels.reshape(shape if channels > 1 else shape[:2])
            # Rerun's depth images of whole numbers have no way to be unknown either.
            return kind, image.astype(np.float32) if kind == "DepthImage" else image
    return None


def _pairs(lines: Iterable[str]) -> dict[str, str]:
    """``key=value`` lines; a line without a value, such as "none", says that there are none."""
    split = (line.partition("=") for line in lines)
    return {key: value for key, equals, value in split if equals}


def _typed(text: str) -> Any:
    """A parameter's value out of its text; the text itself where it is neither number nor truth."""
    if text in ("True", "False"):
        return text == "True"
    if re.fullmatch(r"[+-]?\d{1,18}", text):
        return int(text)
    try:
        return float(text)
    except ValueError:
        return text


# -- the layout -----------------------------------------------------------------------------------


class _Kept:
    """Components as they were read, to be logged again."""

    def __init__(self, batch: Any) -> None:
        self._batches: list[Any] = []
        for schema in batch.schema:
            told = schema.metadata or {}
            if told.get(b"rerun:kind") != b"data" or not batch.column(schema.name)[-1].is_valid:
                continue
            describes = rr.ComponentDescriptor(
                told[b"rerun:component"].decode(),
                archetype=_text(told.get(b"rerun:archetype")),
                component_type=_text(told.get(b"rerun:component_type")),
            )
            self._batches.append(
                rr.DescribedComponentBatch(_Array(batch.column(schema.name)[-1].values), describes)
            )

    def as_component_batches(self) -> list[Any]:
        return self._batches


class _Array:
    def __init__(self, array: Any) -> None:
        self._array = array

    def as_arrow_array(self) -> Any:
        return self._array


def _text(value: bytes | None) -> str | None:
    return None if value is None else value.decode()


def views_of(chunks: Iterable[Any]) -> list[rrb.View]:
    """The views of a saved layout, in reading order, with their queries and properties."""
    found: dict[str, Any] = {
        chunk.entity_path: chunk.to_record_batch() for chunk in chunks if chunk.num_rows
    }
    root = _last(found.get("/viewport"), "ViewportBlueprint:root_container")
    views: list[rrb.View] = []
    waiting = [f"container/{_uuid(root[0])}"] if root else []
    seen: set[str] = set()
    while waiting:
        path = "/" + waiting.pop(0).lstrip("/")
        if path in seen:
            continue
        seen.add(path)
        batch = found.get(path)
        if path.startswith("/container/"):
            waiting = [*map(str, _last(batch, "ContainerBlueprint:contents")), *waiting]
            continue
        kind = _last(batch, "ViewBlueprint:class_identifier")
        if not kind:
            continue
        parts: dict[str, Any] = {
            other.removeprefix(path + "/"): _Kept(own)
            for other, own in found.items()
            if other.startswith(path + "/") and not other.startswith(f"{path}/ViewContents")
        }
        query = _last(found.get(f"{path}/ViewContents"), "ViewContents:query")
        views.append(
            rrb.View(
                class_identifier=kind[0],
                origin=(_last(batch, "ViewBlueprint:space_origin") or ["/"])[0],
                contents=query or ["$origin/**"],
                name=(_last(batch, "ViewBlueprint:display_name") or [None])[0],
                properties=parts,
            )
        )
    return views


def _last(batch: Any, component: str) -> list[Any]:
    """A component of the newest row; empty where there is none."""
    if batch is None or component not in batch.schema.names:
        return []
    return batch.column(component)[-1].as_py() or []


def _uuid(value: Any) -> str:
    raw = value if isinstance(value, bytes) else bytes(value)
    return str(uuid.UUID(bytes=raw))

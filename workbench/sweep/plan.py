"""What a sweep has to compute: result keys, and tasks of cells that share upstream results.

The *key* of a stage's result names everything that it depends on except the frame: the codes and
parameters of the stage and of those before it, the resources and the libraries.  Two cells whose
parameters differ only downstream of a stage have one key there, and so one result a frame.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from workbench.digest import digest_of
from workbench.pipeline import Pipeline
from workbench.session import Options, Session, library_versions
from workbench.settings import Settings
from workbench.stage import Stage
from workbench.sweep.axes import Cell

RECORD_FORMAT = 1
"""Part of every key: what is kept of a result; a change here leaves older results unused."""

_TASKS_A_WORKER = 4
_MOST_CELLS_A_TASK = 256
_MOST_FRAMES_A_TASK = 16


@dataclass(frozen=True)
class Job:
    """All that a worker must know to do as the parent would, in plain data."""

    recordings: tuple[Path, ...]
    sources: tuple[str, ...]
    """Of each recording, the digest of its bytes and of the topics read."""
    options: Options
    """The shared flags, without a configuration file: its values are in ``base``."""
    base: Mapping[str, Any]
    """``stage.parameter`` to value where every cell differs from the preset."""
    picture_stage: str | None
    picture_frames: tuple[frozenset[int], ...]
    """Of each recording, the frames of which pictures are kept."""
    code: Mapping[str, str]
    resources: tuple[Mapping[str, str], ...]
    """Of each recording, the digest of each of its resources."""
    libraries: Mapping[str, str]
    digest: str = field(default="", compare=False)

    def identified(self) -> str:
        """A digest by which a worker keeps what it has opened for this job."""
        return digest_of(
            [
                *(str(path) for path in self.recordings),
                *self.sources,
                repr(self.options),
                repr(sorted(self.base.items())),
                str(self.picture_stage),
                repr([sorted(frames) for frames in self.picture_frames]),
                repr(sorted(self.code.items())),
                repr([sorted(own.items()) for own in self.resources]),
            ]
        )


@dataclass(frozen=True)
class Task:
    """Cells, in the order of the tree of their shared prefixes, over a block of frames."""

    number: int
    recording: int
    start: int
    stop: int
    cells: tuple[Mapping[str, Any], ...]


@dataclass(frozen=True)
class Block:
    """Frames ``start`` to ``stop`` of one recording, and the cells that lack results there."""

    recording: int
    start: int
    stop: int
    cells: tuple[Cell, ...]


def source_of(session: Session) -> str:
    """What identifies a session's frames: the recording's bytes and the topics read from it."""
    topics = session.recording.channel_topics
    required, optional = session.pipeline.channels
    read = {name: topic for name, topic in topics.items() if name in (*required, *optional)}
    return digest_of([session.recording.digest, *sorted(read.items())])


def result_keys(pipeline: Pipeline, settings: Settings) -> dict[str, str]:
    """Each stage's key under these settings."""
    givers = {artifact.name: stage.name for stage in pipeline.stages for artifact in stage.gives}
    code = pipeline.code_digests()
    libraries = _libraries()
    keys: dict[str, str] = {}
    for stage in pipeline.stages:
        parts = [RECORD_FORMAT, libraries, stage.name, code[stage.name]]
        parts.append(settings.parameters[stage.name].model_dump_json())
        for need in stage.needs:
            if need.name in givers:
                parts.append(f"{need.name} {keys[givers[need.name]]}")
            elif need.name in pipeline.resources:
                parts.append(f"{need.name} {pipeline.resources[need.name][1]}")
            else:
                parts.append(need.name)
        keys[stage.name] = digest_of(parts)
    return keys


@functools.cache
def _libraries() -> str:
    return repr(sorted(library_versions().items()))


def upstream(stages: Sequence[Stage]) -> dict[str, set[str]]:
    """Each stage's own name and those of the stages that it depends on."""
    givers = {artifact.name: stage.name for stage in stages for artifact in stage.gives}
    found: dict[str, set[str]] = {}
    for stage in stages:
        found[stage.name] = {stage.name}.union(
            *(found[givers[need.name]] for need in stage.needs if need.name in givers)
        )
    return found


def in_tree_order(cells: Iterable[Cell], stages: Sequence[Stage]) -> list[Cell]:
    """Cells sorted so that those which share the longest prefix of stages follow one another."""
    order = {stage.name: position for position, stage in enumerate(stages)}
    seen: dict[str, dict[Any, int]] = {}

    def place(cell: Cell) -> tuple[tuple[int, str, int], ...]:
        return tuple(
            sorted(
                (
                    order[address.partition(".")[0]],
                    address,
                    seen.setdefault(address, {}).setdefault(
                        (type(value), value), len(seen[address])
                    ),
                )
                for address, value in cell.values.items()
            )
        )

    return sorted(cells, key=place)


def blocks_of(counts: Sequence[tuple[int, int]], workers: int) -> list[tuple[int, int, int]]:
    """Blocks (recording, start, stop) of frames, enough of them to keep the workers busy.

    ``counts`` has each recording's first frame and the one after its last.
    """
    total = sum(stop - start for start, stop in counts)
    length = min(_MOST_FRAMES_A_TASK, max(1, total // max(1, _TASKS_A_WORKER * workers)))
    return [
        (recording, first, min(first + length, stop))
        for recording, (start, stop) in enumerate(counts)
        for first in range(start, stop, length)
    ]


def tasks_of(blocks: Sequence[Block], stages: Sequence[Stage], workers: int) -> list[Task]:
    """The tasks for these blocks.

    Blocks of frames share nothing, so they are what is spread over the workers.  Cells are parted
    only where there are fewer blocks than workers need, or so many cells that a lost task would
    cost too much: each part runs the common prefix again.
    """
    filled = [block for block in blocks if block.cells]
    parts = 1
    if filled and len(filled) < 2 * workers:
        parts = -(-2 * workers // len(filled)) if workers > 1 else 1
    tasks: list[Task] = []
    for block in filled:
        cells = in_tree_order(block.cells, stages)
        length = min(_MOST_CELLS_A_TASK, -(-len(cells) // parts))
        for first in range(0, len(cells), length):
            values = tuple(cell.values for cell in cells[first : first + length])
            tasks.append(Task(len(tasks), block.recording, block.start, block.stop, values))
    return tasks

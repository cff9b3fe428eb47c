"""Ordering stages by needs and gives, running them, and keeping what is still valid."""

from __future__ import annotations

import copy
import time
import warnings as python_warnings
from collections import OrderedDict, deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from workbench.digest import digest_of, digest_of_code, digest_of_file
from workbench.errors import one_line
from workbench.settings import Settings
from workbench.stage import (
    WARNINGS,
    Artifact,
    RecordedCamera,
    RecordedImage,
    Resource,
    Stage,
    StageError,
)

if TYPE_CHECKING:
    from workbench.recording import Camera, Frame

S = TypeVar("S", bound=Artifact)

DEFAULT_STORE_BYTES = 256 << 20


@dataclass(frozen=True)
class Failure:
    """A stage that did not give its results on one frame."""

    stage: str
    says: str
    blocked_by: str | None = None
    """The stage whose failure left this one without its inputs; None if it failed itself."""
    gave: tuple[str, ...] = ()
    """The artifacts that it had given before it failed, which stand."""


@dataclass(frozen=True)
class Run:
    """One frame through the stages."""

    frame: Frame
    artifacts: Mapping[str, Any]
    digests: Mapping[str, str]
    failures: tuple[Failure, ...]
    warnings: tuple[str, ...]
    stage_ms: Mapping[str, float]
    """Milliseconds that each stage's result took to compute (also where it was kept)."""
    computed: frozenset[str]
    """The stages that really ran; the others' results were kept from before."""

    def failure_of(self, stage: str) -> Failure | None:
        """How the stage failed on this frame, or None."""
        return next((failure for failure in self.failures if failure.stage == stage), None)


@dataclass(frozen=True)
class _Result:
    outputs: Mapping[str, Any]
    warnings: tuple[str, ...]
    milliseconds: float
    size: int
    failure: str | None = None
    """Why the stage did not give the rest of what it declares."""


@dataclass
class ResultStore:
    """Stage results under their digests, oldest dropped first beyond ``capacity_bytes``."""

    capacity_bytes: int = DEFAULT_STORE_BYTES
    _results: OrderedDict[str, _Result] = field(default_factory=OrderedDict)
    _bytes: int = 0

    def get(self, digest: str) -> _Result | None:
        result = self._results.get(digest)
        if result is not None:
            self._results.move_to_end(digest)
        return result

    def put(self, digest: str, result: _Result) -> None:
        self._results[digest] = result
        self._bytes += result.size
        while self._bytes > self.capacity_bytes and len(self._results) > 1:
            _, dropped = self._results.popitem(last=False)
            self._bytes -= dropped.size

    def clear(self) -> None:
        """Drop everything, as when no later frame can ask for it."""
        self._results.clear()
        self._bytes = 0


class Pipeline:
    """Stages in an order in which each finds what it needs.

    ``until`` keeps only that stage and what it needs; ``known`` still holds all, whose parameters
    the settings carry.  ``resources`` maps the names of
    :class:`Resource` artifacts to files.  Raises :class:`StageError` if the stages do not fit
    together, or a resource cannot be read.
    """

    def __init__(
        self,
        stages: Mapping[str, Stage],
        settings: Settings,
        resources: Mapping[str, Path] | None = None,
        until: str | None = None,
        store: ResultStore | None = None,
    ) -> None:
        self.stages = ordered(stages, until)
        self.known = MappingProxyType(dict(stages))
        self.settings = settings
        self.store = store or ResultStore()
        self.resources: dict[str, tuple[Any, str]] = {}
        self.resource_paths = dict(resources or {})
        for need in self.sources(Resource):
            path = self.resource_paths.get(need.name)
            if path is not None and need.load is not None:
                self.resources[need.name] = _load(need, path)
        self._code = {s.name: digest_of_code(type(s).__module__) for s in self.stages}
        self._texts = self._parameter_texts()
        self._warm: set[str] = set()
        self._taken: list[tuple[Frame, dict[str, Any], dict[str, str]]] = []

    def with_settings(self, settings: Settings) -> Pipeline:
        """The same stages and resources under other parameters, with results kept in common."""
        other = copy.copy(self)
        other.settings = settings
        other._texts = other._parameter_texts()
        return other

    def up_to(self, stage: str) -> Pipeline:
        """This stage and what it needs alone, with settings, resources and results in common."""
        return self.with_stages(ordered({one.name: one for one in self.stages}, stage))

    def with_stages(self, stages: Sequence[Stage]) -> Pipeline:
        """Some of the same stages, in an order in which each finds what it needs."""
        other = copy.copy(self)
        other.stages = list(stages)
        return other

    def _parameter_texts(self) -> dict[str, str]:
        return {s.name: self.settings.parameters[s.name].model_dump_json() for s in self.stages}

    def sources(self, kind: type[S]) -> list[S]:
        """The needs of one kind that no stage gives, without doubles; required where any is."""
        found: dict[str, S] = {}
        for stage in self.stages:
            for need in stage.needs:
                if isinstance(need, kind) and (need.name not in found or need.required):
                    found[need.name] = need
        return list(found.values())

    @property
    def channels(self) -> tuple[list[str], list[str]]:
        """The recorded image channels that must be there, and those that may be."""
        images = self.sources(RecordedImage)
        return (
            [i.channel for i in images if i.required],
            [i.channel for i in images if not i.required],
        )

    @property
    def artifacts(self) -> dict[str, Artifact]:
        """Every artifact that the stages give, by name, in order."""
        return {artifact.name: artifact for stage in self.stages for artifact in stage.gives}

    def code_digests(self) -> dict[str, str]:
        """The digest of each stage's code."""
        return dict(self._code)

    def resource_digests(self) -> dict[str, str]:
        """The digest of each resource that was given."""
        return {name: digest for name, (_, digest) in self.resources.items()}

    def run(self, frame: Frame) -> Run:
        """The frame through all stages.  A stage's exception never hides the others' results."""
        return deque(self.steps(frame), maxlen=1).pop()

    def steps(self, frame: Frame) -> Iterator[Run]:
        """The same one stage at a time: the run before the first stage, and after each.

        Who shows results live shows each as it comes, and may leave when a newer one is wanted.
        """
        artifacts, digests = self._sources_of(frame)
        failures: list[Failure] = []
        warnings: list[str] = []
        stage_ms: dict[str, float] = {}
        computed: set[str] = set()

        def so_far() -> Run:
            return Run(
                frame,
                MappingProxyType(dict(artifacts)),
                MappingProxyType(dict(digests)),
                tuple(failures),
                tuple(warnings),
                MappingProxyType(dict(stage_ms)),
                frozenset(computed),
            )

        yield so_far()
        failed_givers: dict[str, str] = {}
        for stage in self.stages:
            failure = self._step(
                stage, artifacts, digests, failed_givers, warnings, stage_ms, computed
            )
            if failure is not None:
                failures.append(failure)
                culprit = failure.blocked_by or stage.name
                lost = (a.name for a in stage.gives if a.name not in artifacts)
                failed_givers.update((name, culprit) for name in lost)
            yield so_far()

    def _step(
        self,
        stage: Stage,
        artifacts: dict[str, Any],
        digests: dict[str, str],
        failed_givers: Mapping[str, str],
        warnings: list[str],
        stage_ms: dict[str, float],
        computed: set[str],
    ) -> Failure | None:
        """Run one stage, or take its kept result, and add what came of it; or say why not."""
        lacking = [n.name for n in stage.needs if n.required and n.name not in artifacts]
        if lacking:
            return _lacking(stage, lacking, failed_givers)
        parameters = self.settings.parameters[stage.name]
        key = digest_of(
            [stage.name, self._code[stage.name], self._texts[stage.name]]
            + [f"{n.name} {digests.get(n.name)}" for n in stage.needs]
        )
        result = self.store.get(key)
        if result is None:
            inputs = {n.name: artifacts.get(n.name) for n in stage.needs}
            try:
                result = self._compute(stage, inputs, parameters)
            except Exception as error:
                return Failure(stage.name, one_line(error))
            if result.failure is None:
                self.store.put(key, result)
            computed.add(stage.name)
        artifacts.update(result.outputs)
        digests.update((name, f"{key} {name}") for name in result.outputs)
        warnings += [f"{stage.name}: {says}" for says in result.warnings]
        stage_ms[stage.name] = result.milliseconds
        if result.failure is not None:
            return Failure(stage.name, result.failure, gave=tuple(result.outputs))
        return None

    def _sources_of(self, frame: Frame) -> tuple[dict[str, Any], dict[str, str]]:
        """What no stage gives, and its digests; of the latest frame they are remembered."""
        if not (self._taken and self._taken[0][0] is frame):
            artifacts: dict[str, Any] = {}
            digests: dict[str, str] = {}
            self._take_sources(frame, artifacts, digests)
            # In place: pipelines with other settings share it.
            self._taken[:] = [(frame, artifacts, digests)]
        _, artifacts, digests = self._taken[0]
        return dict(artifacts), dict(digests)

    def _take_sources(
        self, frame: Frame, artifacts: dict[str, Any], digests: dict[str, str]
    ) -> None:
        for image in self.sources(RecordedImage):
            if image.channel in frame.images:
                artifacts[image.name] = frame.images[image.channel]
                digests[image.name] = f"{frame.digest} {image.channel}"
        for camera in self.sources(RecordedCamera):
            recorded = frame.cameras.get(camera.channel)
            if recorded is not None:
                artifacts[camera.name] = recorded
                digests[camera.name] = _digest_of_camera(recorded)
        for name, (value, digest) in self.resources.items():
            artifacts[name] = value
            digests[name] = digest

    def _compute(self, stage: Stage, inputs: Mapping[str, Any], parameters: Any) -> _Result:
        with python_warnings.catch_warnings(record=True) as caught:
            python_warnings.simplefilter("always")
            if stage.name not in self._warm:
                # The first call of a stage pays for imports and compilation, which would be
                # told as its time on the first frame; the timed call is the second.
                _outputs_of(stage, inputs, parameters)
                self._warm.add(stage.name)
                caught.clear()
            start = time.perf_counter()
            outputs, failure = _outputs_of(stage, inputs, parameters)
            milliseconds = (time.perf_counter() - start) * 1e3
        says = [*outputs.pop(WARNINGS, ()), *(str(w.message) for w in caught)]
        expected = {artifact.name for artifact in stage.gives}
        if set(outputs) - expected or (failure is None and set(outputs) != expected):
            raise StageError(f"gave {sorted(outputs)} where it declares {sorted(expected)}")
        sizes: dict[str, int] = {}
        seen: set[int] = set()
        size = 0
        for artifact in stage.gives:
            if artifact.name not in outputs:
                continue
            value = outputs[artifact.name]
            try:
                artifact.check(value, sizes)
            except StageError as error:
                # One result that is not what was declared does not take the others with it.
                del outputs[artifact.name]
                failure = failure or str(error)
                continue
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            size += _bytes_of(value, seen)
        if not outputs and failure is not None:
            raise StageError(failure)
        return _Result(MappingProxyType(outputs), tuple(says), milliseconds, size, failure)


def _outputs_of(
    stage: Stage, inputs: Mapping[str, Any], parameters: Any
) -> tuple[dict[str, Any], str | None]:
    """All that a stage gives, at once or in parts, and why the parts ended early, or None.

    Raises what the stage raises before it has given anything.
    """
    given = stage.compute(inputs, parameters)
    outputs: dict[str, Any] = {}
    warnings: list[str] = []
    failure = None
    try:
        for part in [given] if isinstance(given, Mapping) else given:
            outputs.update(part)
            warnings += outputs.pop(WARNINGS, ())
    except Exception as error:
        if not outputs:
            raise
        failure = one_line(error)
    return {**outputs, WARNINGS: warnings}, failure


def ordered(stages: Mapping[str, Stage], until: str | None = None) -> list[Stage]:
    """The stages in an order in which each comes after those that give what it needs.

    Stages that do not depend on one another keep the order of their names' arrival.  An optional
    need orders as well, where some stage gives it.  Raises :class:`StageError` for two stages
    that give one artifact, for a need that nothing gives, for a circle, and for an unknown
    ``until``.
    """
    giver: dict[str, str] = {}
    for stage in stages.values():
        for artifact in stage.gives:
            if artifact.name in giver:
                raise StageError(
                    f"both {giver[artifact.name]} and {stage.name} give {artifact.name}"
                )
            giver[artifact.name] = stage.name
    needs: dict[str, list[str]] = {}
    for stage in stages.values():
        needs[stage.name] = []
        for need in stage.needs:
            if isinstance(need, RecordedImage | RecordedCamera | Resource):
                continue
            if need.name in giver:
                needs[stage.name].append(giver[need.name])
            elif need.required:
                raise StageError(f"{stage.name} needs {need.name}, which no stage gives")
    if until is not None and until not in stages:
        raise StageError(f"no stage {until!r}; stages: {', '.join(stages)}")
    order: list[Stage] = []
    placed: set[str] = set()

    def place(name: str, path: Sequence[str]) -> None:
        if name in placed:
            return
        if name in path:
            circle = " → ".join([*path[path.index(name) :], name])
            raise StageError(f"stages need each other in a circle: {circle}")
        for before in needs[name]:
            place(before, [*path, name])
        placed.add(name)
        order.append(stages[name])

    for name in [until] if until is not None else stages:
        place(name, [])
    return order


def dependencies(stages: Iterable[Stage]) -> list[tuple[str, str, str]]:
    """The pipeline as a graph: (giver, taker, artifact); a source's giver is its own name."""
    stages = list(stages)
    giver = {a.name: s.name for s in stages for a in s.gives}
    return [
        (giver.get(need.name, need.name), stage.name, need.name)
        for stage in stages
        for need in stage.needs
    ]


_PLAIN = frozenset((float, int, str, bool, type(None)))


def _bytes_of(value: Any, seen: set[int]) -> int:
    """Bytes of the arrays that a value holds, through dataclasses and containers, each once."""
    if id(value) in seen:
        return 0
    seen.add(id(value))
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, Mapping):
        return _bytes_of(list(value.values()), seen)
    if isinstance(value, list | tuple):
        # Numbers and texts are by far the most of what lists hold, and no arrays.
        return sum(_bytes_of(item, seen) for item in value if type(item) not in _PLAIN)
    if is_dataclass(value) and not isinstance(value, type):
        return sum(_bytes_of(getattr(value, f.name), seen) for f in fields(value))
    return 0


def _digest_of_camera(camera: Camera) -> str:
    """All that a stage may take from it but its stamp, which each message has anew."""
    model, frame_id = camera.distortion_model, camera.frame_id
    return digest_of([camera.width, camera.height, camera.K, camera.D, model, frame_id])


def _load(need: Resource, path: Path) -> tuple[Any, str]:
    assert need.load is not None
    try:
        return need.load(path), digest_of_file(path)
    except OSError as error:
        raise StageError(f"--{need.name} {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise StageError(f"--{need.name} {path}: {error}") from error


def _lacking(stage: Stage, lacking: Sequence[str], failed: Mapping[str, str]) -> Failure:
    culprit = next((failed[name] for name in lacking if name in failed), None)
    if culprit is not None:
        return Failure(stage.name, f"not run: {culprit} failed", blocked_by=culprit)
    return Failure(stage.name, f"not run: there is no {', '.join(lacking)}")

"""One recording with one pipeline: what the commands that run stages have in common."""

from __future__ import annotations

import functools
import platform
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any

from workbench import interrupts
from workbench.errors import DataError, UsageError
from workbench.extras import DISTRIBUTION
from workbench.pipeline import Pipeline, ResultStore, Run
from workbench.plugins import find_stages
from workbench.recording import Recording
from workbench.settings import resolve
from workbench.stage import RecordedImage, Resource, Stage

_IDENTIFIED_LIBRARIES = (
    "numpy",
    "opencv-python-headless",
    "scipy",
    "scikit-image",
    "numba",
    "rerun-sdk",
)


@dataclass(frozen=True)
class Options:
    """What the shared flags say."""

    recording: Path
    resources: Mapping[str, Path] = field(default_factory=dict)
    preset: str | None = None
    config: Path | None = None
    assignments: Sequence[str] = ()
    topics: Mapping[str, str] = field(default_factory=dict)
    frames: tuple[int, int | None] = (0, None)
    until: str | None = None
    plugins: Sequence[Path] = ()


@dataclass(frozen=True)
class Session:
    """An open recording and the pipeline to run on it."""

    options: Options
    recording: Recording
    pipeline: Pipeline

    @staticmethod
    def open(options: Options, store: ResultStore | None = None) -> Session:
        """Open the recording and put the pipeline together.

        A resource that is not named is looked for beside the recording.  Raises
        ``RecordingError``, ``StageError``, ``SettingsError`` or :class:`UsageError`.
        """
        recording = Recording.open(options.recording, topics=options.topics)
        stages = find_stages(options.plugins)
        check_stage(options.until, stages, "--until")
        check_topics(options.topics, stages)
        settings = resolve(stages, options.preset, options.config, options.assignments)
        check_resources(options.resources, stages)
        resources = resources_beside(options.recording, stages) | dict(options.resources)
        pipeline = Pipeline(stages, settings, resources, options.until, store)
        recording.require(pipeline.channels[0])
        recording.check_overrides()
        return Session(options, recording, pipeline)

    def count(self) -> int:
        """How many frames a run will have."""
        start, stop = self.options.frames
        paired = self.recording.count(self.pipeline.channels[0])
        return max(0, min(paired, paired if stop is None else stop) - start)

    def runs(self) -> Iterator[Run]:
        """Every frame through the stages, one at a time."""
        required, optional = self.pipeline.channels
        start, stop = self.options.frames
        for frame in self.recording.frames(required, optional, start, stop):
            run = self.pipeline.run(frame)
            interrupts.check()
            yield run

    def provenance(self) -> dict[str, Any]:
        """What identifies a result: code, parameters, input and what it ran on."""
        return self.provenance_of(self.pipeline)

    def provenance_of(self, pipeline: Pipeline) -> dict[str, Any]:
        """The same for this session's pipeline under other settings."""
        return {
            "bench": bench_version(),
            "recording": {"name": self.recording.path.name, "digest": self.recording.digest},
            "topics": {
                channel: topic
                for channel, topic in sorted(self.recording.channel_topics.items())
                if channel in (*pipeline.channels[0], *pipeline.channels[1])
            },
            "frames": list(self.options.frames),
            "until": self.options.until,
            "resources": {
                name: {"name": pipeline.resource_paths[name].name, "digest": digest}
                for name, (_, digest) in pipeline.resources.items()
            },
            "preset": pipeline.settings.preset,
            "changed": dict(pipeline.settings.changed),
            "parameters": {
                stage.name: pipeline.settings.as_dict()[stage.name] for stage in pipeline.stages
            },
            "code": pipeline.code_digests(),
            "libraries": dict(library_versions()),
            "python": platform.python_version(),
        }


def resources_beside(recording: Path, stages: Mapping[str, Stage]) -> dict[str, Path]:
    """Resource files that lie beside a recording: ``NAME.calibration.npz``, else the plain name.

    ``scene.calibration.npz`` belongs to ``scene.mcap`` alone, ``calibration.npz`` to every
    recording in its folder.
    """
    found = {}
    for stage in stages.values():
        for need in stage.needs:
            if isinstance(need, Resource) and need.filename:
                own = recording.with_name(f"{recording.stem}.{need.filename}")
                shared = recording.with_name(need.filename)
                for path in (shared, own):
                    if path.is_file():
                        found[need.name] = path
    return found


def check_stage(name: str | None, stages: Mapping[str, Stage], flag: str) -> None:
    """Raise :class:`UsageError` unless ``name`` is None or a stage."""
    if name is not None and name not in stages:
        raise UsageError(f"{flag} {name}: no such stage; stages: {', '.join(stages)}")


def check_resources(resources: Mapping[str, Path], stages: Mapping[str, Stage]) -> None:
    """Raise unless every named file exists and some stage takes it."""
    taken = {
        need.name for stage in stages.values() for need in stage.needs if isinstance(need, Resource)
    }
    for name, path in resources.items():
        if not path.is_file():
            raise DataError(f"--{name} {path}: no such file")
        if name not in taken:
            raise UsageError(f"--{name} {path}: no stage takes {name}")


def check_topics(topics: Mapping[str, str], stages: Mapping[str, Stage]) -> None:
    """Raise :class:`UsageError` if a topic is mapped to a channel that no stage takes."""
    channels = {
        need.channel
        for stage in stages.values()
        for need in stage.needs
        if isinstance(need, RecordedImage)
    }
    for channel in topics:
        if channel not in channels:
            raise UsageError(
                f"--topic {channel}={topics[channel]}: no stage takes a channel {channel!r}; "
                f"channels: {', '.join(sorted(channels))}"
            )


def bench_version() -> str:
    """The installed version of the bench."""
    try:
        return version(DISTRIBUTION)
    except PackageNotFoundError:
        return "not installed"


@functools.cache
def library_versions() -> Mapping[str, str]:
    """The installed versions of the libraries that results depend on."""
    found = {}
    for name in _IDENTIFIED_LIBRARIES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return MappingProxyType(found | {"platform": sys.platform})

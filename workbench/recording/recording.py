"""The front of the package: an MCAP file as frames, topics and defects."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import BinaryIO

from workbench.recording.container import MAGIC, Index, UnchunkedError, read_summary, walk
from workbench.recording.defects import Defect, DefectReport
from workbench.recording.messages import Decoder, kind_of
from workbench.recording.model import Frame, RecordingError, TopicInfo, TopicKind
from workbench.recording.pairing import Instant
from workbench.recording.passing import Lane, Pass, camera_topics_of

_IMAGE_SUFFIXES = ("image", "image/compressed", "image_raw", "image_raw/compressed")
_CHANNEL = re.compile(r"/camera/([^/]+)/(.+)")


class Recording:
    """An MCAP file of paired images, opened with :meth:`open`.

    Nothing is kept open between calls, and every pass streams the file in bounded memory.  After
    opening, data never raises: what is wrong with it is in :attr:`defects`.
    """

    def __init__(
        self,
        path: Path,
        index: Index,
        found: DefectReport,
        topics: Mapping[str, str],
        tolerance_ns: int,
    ) -> None:
        self.path = path
        self._index = index
        self._found = found
        self._overrides = dict(topics)
        self._tolerance_ns = tolerance_ns
        self._decoder = Decoder()
        self._digest: str | None = None
        self._counts: dict[tuple[str, ...], int] = {}
        self._topics: list[TopicInfo] | None = None
        self._passes: tuple[Pass, ...] = ()  # the latest over frames, and the furthest before it

    @staticmethod
    def open(
        path: str | Path,
        topics: Mapping[str, str] | None = None,
        tolerance_ns: int = 20_000_000,
    ) -> Recording:
        """Open the recording at ``path``.

        ``topics`` maps channels to image topics where these are not ``/camera/{channel}/image``.
        Images belong together if their stamps are within ``tolerance_ns``.  Raises
        :class:`RecordingError` if the file cannot be read or is not MCAP; a damaged file opens.
        """
        path = Path(path)
        found = DefectReport()
        try:
            with path.open("rb") as file:
                size = file.seek(0, 2)
                _check_magic(path, file, size)
                try:
                    index = read_summary(file, size)
                except UnchunkedError:
                    index = walk(file, size, found.add)
                except ValueError as reason:
                    says = f"{reason}; the file is read from its start instead"
                    found.add(Defect("no_index", says))
                    index = walk(file, size, found.add)
        except IsADirectoryError:
            raise RecordingError(f"{path}: expected an MCAP file, found a directory") from None
        except FileNotFoundError:
            raise RecordingError(f"{path}: expected an MCAP file, found nothing there") from None
        except OSError as error:
            why = error.strerror or error
            raise RecordingError(f"{path}: expected an MCAP file, cannot read it: {why}") from None
        return Recording(path, index, found, topics or {}, tolerance_ns)

    # -- what is in it ----------------------------------------------------------------------------

    @property
    def digest(self) -> str:
        """blake2b of the file's bytes, computed once when first asked for."""
        if self._digest is None:
            digest = hashlib.blake2b(digest_size=16)
            with self.path.open("rb") as file:
                while piece := file.read(1 << 20):
                    digest.update(piece)
            self._digest = digest.hexdigest()
        return self._digest

    @property
    def rig(self) -> Mapping[str, str]:
        """The metadata record ``rig``; empty if there is none."""
        return MappingProxyType(self._index.metadata.get("rig", {}))

    @property
    def channel_topics(self) -> Mapping[str, str]:
        """Channel to image topic: ``/camera/{channel}/image``, also ``image_raw`` and
        ``/compressed``, and the topics given to :meth:`open`, as far as they are in the file."""
        images = self._image_topics()
        matches = [match for topic in images if (match := _CHANNEL.fullmatch(topic))]
        known = [match for match in matches if match[2] in _IMAGE_SUFFIXES]
        known.sort(key=lambda match: _IMAGE_SUFFIXES.index(match[2]))
        by_channel = {match[1]: match[0] for match in reversed(known)}
        found = {match[1]: by_channel[match[1]] for match in matches if match[1] in by_channel}
        for channel, topic in self._overrides.items():
            found.pop(channel, None)
            if topic in images:
                found[channel] = topic
        return found

    def require(self, channels: Sequence[str]) -> None:
        """Raise :class:`RecordingError` unless every channel has an image topic in the file."""
        there = self.channel_topics
        missing = [channel for channel in channels if channel not in there]
        if not missing:
            return
        wanted = ", ".join(
            f"{channel} ({self._overrides.get(channel, f'/camera/{channel}/image')})"
            for channel in missing
        )
        images = ", ".join(sorted(self._image_topics())) or "none"
        damage = "".join(f"; {defect.kind}: {defect.says}" for defect in self._found)
        raise RecordingError(
            f"{self.path}: expected an image topic for {wanted}; image topics found: {images}; "
            f"map one with --topic {missing[0]}=/some/topic{damage}"
        )

    def topics(self) -> list[TopicInfo]:
        """Facts about every topic, in the order of their names; reads the file once."""
        if self._topics is None:
            survey = self._pass((), (), everything=True)
            for _ in self._instants(survey):
                pass
            self._topics = self._infos(survey)
        return list(self._topics)

    def count(self, required: Sequence[str]) -> int:
        """How many paired frames :meth:`frames` will number; no image is decoded for it."""
        key = tuple(required)
        if key not in self._counts:
            counting = self._pass(self._lanes(key), (), truth=False)
            self._counts[key] = sum(1 for _ in self._instants(counting))
        return self._counts[key]

    # -- frames and defects -----------------------------------------------------------------------

    def frames(
        self,
        required: Sequence[str],
        optional: Sequence[str] = (),
        start: int = 0,
        stop: int | None = None,
    ) -> Iterator[Frame]:
        """The frames ``start`` to ``stop`` in which every ``required`` channel has an image.

        Images of ``optional`` channels join where they are within tolerance.  A frame of which a
        required image cannot be decoded is left out and keeps its index.  Raises
        :class:`RecordingError` at once if a required channel has no topic.
        """
        there = self.channel_topics
        others = [channel for channel in optional if channel in there and channel not in required]
        reading = self._pass(self._lanes(required), self._lanes(others))
        return self._frames(reading, start, stop)

    def _frames(self, reading: Pass, start: int, stop: int | None) -> Iterator[Frame]:
        if stop is not None and stop <= start:
            return
        self._passes = (*self._furthest(), reading)
        for instant in self._instants(reading):
            if instant.index >= start:
                frame = reading.frame(instant)
                if frame is not None:
                    yield frame
            if stop is not None and instant.index + 1 >= stop:
                return

    @property
    def defects(self) -> DefectReport:
        """What has been found so far: in the container, and by the pass over the messages that got
        furthest.  Complete after a whole pass; :meth:`scan` makes the most thorough one."""
        furthest = self._furthest()
        return self._found.merged(furthest[0].report() if furthest else DefectReport())

    def _furthest(self) -> tuple[Pass, ...]:
        return tuple(sorted(self._passes, key=lambda one: (one.thorough, one.read)))[-1:]

    def scan(self, required: Sequence[str] | None = None) -> DefectReport:
        """Read everything, decode every image, and report every defect.

        ``required`` are the channels to pair.  If None, those that have a calibration, because
        they are cameras that work together; or all, if none has one.
        """
        channels = self._calibrated() if required is None else list(required)
        others = [channel for channel in self.channel_topics if channel not in channels]
        scanning = self._pass(
            self._lanes(channels), self._lanes(others), everything=True, thorough=True
        )
        for instant in self._instants(scanning):
            scanning.frame(instant)
        self._topics = self._infos(scanning)
        self._passes = (scanning,)
        return self.defects

    def check_overrides(self) -> None:
        """Raise :class:`RecordingError` if a topic that a channel was mapped to is not there."""
        images = self._image_topics()
        for channel, topic in self._overrides.items():
            if topic not in images:
                raise RecordingError(
                    f"{self.path}: expected images on {topic} (--topic {channel}={topic}); "
                    f"image topics found: {', '.join(sorted(images)) or 'none'}"
                )

    # -- how --------------------------------------------------------------------------------------

    def _pass(
        self,
        required: Sequence[Lane],
        optional: Sequence[Lane],
        *,
        everything: bool = False,
        thorough: bool = False,
        truth: bool = True,
    ) -> Pass:
        return Pass(
            self._index,
            self._decoder,
            required,
            optional,
            self._tolerance_ns,
            everything=everything,
            thorough=thorough,
            truth=truth,
        )

    def _instants(self, reading: Pass) -> Iterator[Instant]:
        with self.path.open("rb") as file:
            yield from reading.instants(file)

    def _lanes(self, channels: Sequence[str]) -> list[Lane]:
        self.require(channels)
        there, known = self.channel_topics, self._kinds()
        lanes = []
        for channel in dict.fromkeys(channels):
            topic = there[channel]
            candidates = (*camera_topics_of(topic), *camera_topics_of(f"/camera/{channel}/image"))
            cameras = [name for name in candidates if known.get(name) == "camera"]
            lanes.append(Lane(channel, topic, cameras[0] if cameras else None))
        return lanes

    def _calibrated(self) -> list[str]:
        everyone = list(self.channel_topics)
        return [lane.channel for lane in self._lanes(everyone) if lane.camera_topic] or everyone

    def _kinds(self) -> dict[str, TopicKind]:
        index = self._index
        return {
            channel.topic: kind_of(channel, index.schemas.get(channel.schema_id))
            for channel in index.channels.values()
        }

    def _image_topics(self) -> list[str]:
        return [topic for topic, kind in self._kinds().items() if kind == "image"]

    def _infos(self, survey: Pass) -> list[TopicInfo]:
        infos = {}
        for channel in self._index.channels.values():
            schema = self._index.schemas.get(channel.schema_id)
            watch = survey.watches.get(channel.topic)
            infos[channel.topic] = TopicInfo(
                topic=channel.topic,
                schema=schema.name if schema else "",
                encoding=channel.message_encoding,
                kind=kind_of(channel, schema),
                count=watch.count if watch else 0,
                first_ns=watch.first_ns if watch else None,
                last_ns=watch.last_ns if watch else None,
                rate_hz=watch.rate_hz if watch else None,
            )
        return [infos[topic] for topic in sorted(infos)]


def _check_magic(path: Path, file: BinaryIO, size: int) -> None:
    if size == 0:
        raise RecordingError(f"{path}: expected an MCAP file, found an empty one")
    file.seek(0)
    start = file.read(len(MAGIC))
    if start == MAGIC:
        return
    if MAGIC.startswith(start):
        raise RecordingError(
            f"{path}: expected an MCAP file, found one that is cut off after {size} bytes"
        )
    raise RecordingError(
        f"{path}: expected an MCAP file, found one that starts with {start.hex(' ')}"
    )

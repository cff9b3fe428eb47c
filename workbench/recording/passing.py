"""One pass over a recording: messages in, paired frames out, every defect noted on the way."""

from __future__ import annotations

import hashlib
import statistics
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from workbench.recording.clocks import PROBE, Clocks, Sample, TopicWatch, choose
from workbench.recording.container import Index, MessageReader, RawMessage
from workbench.recording.defects import Defect, DefectReport, Pairing
from workbench.recording.images import ImageError, Pixels
from workbench.recording.messages import (
    ENCODINGS,
    Content,
    Decoded,
    Decoder,
    Image,
    MessageError,
    kind_of,
)
from workbench.recording.model import Camera, Frame, TopicKind, Truth
from workbench.recording.pairing import Alone, Held, Instant, Pairer

TRUTH = "/ground_truth/"
TRUTH_TOPICS = tuple(TRUTH + part for part in ("depth", "instances", "faces", "transforms", "meta"))

_PROBE_BYTES = 32 << 20  # no more is read ahead to choose the clocks
_CAMERAS_KEPT = 64  # calibrations that a channel remembers, for frames that are still waiting
_OFFSETS_KEPT = 4096
_SIZES_KEPT = 256  # combinations of topic, size and frame id that are told apart


@dataclass(frozen=True)
class Lane:
    """A channel of the pass: where its images and its calibration are."""

    channel: str
    topic: str
    camera_topic: str | None


@dataclass(frozen=True, eq=False)
class _Message:
    """A message on its way in; ``decoded`` is None if it could not be, or need not be."""

    topic: str
    kind: TopicKind
    log: int
    size: int
    decoded: Decoded | None

    @property
    def sample(self) -> Sample:
        return Sample(self.log, self.decoded.stamp_ns if self.decoded else None)


@dataclass(frozen=True)
class _Size:
    """The size that an image or a calibration of a topic has."""

    topic: str
    frame_id: str
    width: int
    height: int


class Pass:
    """Reads a recording once.

    ``required`` lanes make the frames, ``optional`` ones and ground truth join them.
    ``thorough`` reads every topic and decodes every image, also those that belong to no frame.
    ``report`` and ``watches`` are complete when :meth:`instants` is exhausted.
    """

    def __init__(
        self,
        index: Index,
        decoder: Decoder,
        required: Sequence[Lane],
        optional: Sequence[Lane],
        tolerance_ns: int,
        *,
        everything: bool = False,
        thorough: bool = False,
        truth: bool = True,
    ) -> None:
        self._index, self._decoder, self._tolerance = index, decoder, tolerance_ns
        self._required, self._optional = tuple(required), tuple(optional)
        self._everything, self.thorough = everything, thorough
        self._lanes: dict[str, list[str]] = {}
        for lane in (*required, *optional):
            self._lanes.setdefault(lane.topic, []).append(lane.channel)
        truths = TRUTH_TOPICS if truth else ()
        self._lanes |= {topic: [topic] for topic in truths}
        self._cameras: dict[str, deque[Held]] = {
            lane.camera_topic: deque(maxlen=_CAMERAS_KEPT)
            for lane in (*required, *optional)
            if lane.camera_topic
        }
        self._pairer = Pairer(
            [lane.channel for lane in required],
            [*(lane.channel for lane in optional), *truths],
            tolerance_ns,
        )
        self._found = DefectReport()
        self._recent: deque[Defect] = deque(maxlen=256)
        self._clocks = Clocks()
        self._offsets: deque[int] = deque(maxlen=_OFFSETS_KEPT)
        self._offset_max = 0
        self._frames = 0
        self._alone = 0
        self._uncalibrated: set[str] = set()
        self._last_camera: dict[str, tuple[bytes, Decoded]] = {}
        self._image_sizes: Counter[_Size] = Counter()
        self._camera_sizes: Counter[_Size] = Counter()
        self.watches: dict[str, TopicWatch] = {}
        self.read = 0
        """How many messages have been taken in: how far the pass is."""

    # -- reading ----------------------------------------------------------------------------------

    def instants(self, file: BinaryIO) -> Iterator[Instant]:
        """The paired instants in the order of their stamps; their images are not decoded yet."""
        topics = None if self._everything else self._lanes.keys() | self._cameras.keys()
        reader = MessageReader(file, self._index, self._found.add)
        try:
            for message in self._clocked(reader.messages(topics)):
                self.read += 1
                yield from self._paired(self._take(message))
            for watch in self.watches.values():
                for defect in watch.finish():
                    self._note(defect)
            yield from self._paired(self._pairer.drain())
            if self.thorough:
                self._compare_sizes()
        finally:
            self._pairer.clear()  # a pass that ends early is kept for its report, not its images

    def _clocked(self, raws: Iterator[RawMessage]) -> Iterator[_Message]:
        """The messages, after the clocks have been chosen by the first of them."""
        first: list[_Message] = []
        samples: dict[str, list[Sample]] = {}
        size = 0
        paired = [lane.topic for lane in self._required]
        for raw in raws:
            message = self._decode(raw)
            first.append(message)
            size += message.size
            seen = samples.setdefault(message.topic, [])
            if message.decoded:
                seen.append(message.sample)
            counts = [len(samples.get(topic, ())) for topic in paired or samples]
            # A channel that has stopped, or a calibration that came once, is not waited for.
            if size > _PROBE_BYTES or min(counts) >= PROBE or max(counts) >= 4 * PROBE:
                break
        self._clocks, defects = choose(samples, paired, self._tolerance)
        for defect in defects:
            self._note(defect)
        first.reverse()
        while first:  # let go of each as it passes
            yield first.pop()
        for raw in raws:
            yield self._decode(raw)

    def _decode(self, raw: RawMessage) -> _Message:
        topic, kind = raw.channel.topic, kind_of(raw.channel, raw.schema)
        decoded: Decoded | None = None
        known = self._last_camera.get(topic)
        if known and known[0] == raw.data:
            decoded = known[1]
        elif kind != "other" or raw.channel.message_encoding in ENCODINGS:
            try:
                decoded = self._decoder.decode(raw)
            except MessageError as error:
                says = f"{topic}: the message logged at {raw.log_time} cannot be decoded: {error}"
                self._note(Defect("undecodable", says, topic, raw.log_time))
            else:
                if kind == "camera":
                    self._last_camera[topic] = (raw.data, decoded)
        return _Message(topic, kind, raw.log_time, len(raw.data), decoded)

    def _take(self, message: _Message) -> Iterator[Instant | Alone]:
        topic = message.topic
        watch = self.watches.get(topic)
        if watch is None:
            watch = self.watches[topic] = TopicWatch(topic, stream=message.kind == "image")
        if message.decoded is None:
            watch.count += 1
            return
        own = self._clocks.own_ns(topic, message.decoded.stamp_ns)
        log_ns = self._clocks.log_ns(message.log)
        stamp_ns = log_ns if own is None else own
        doubled = False
        for defect in watch.see(message.sample, stamp_ns):
            self._note(defect)
            doubled |= defect.kind == "doubled"
        content = message.decoded.content
        by_log = own is None and self._clocks.paired_by == "header"
        held = Held(stamp_ns, log_ns, message.size, content, by_log)
        if isinstance(content, Camera):
            self._take_camera(topic, held, content)
        elif not doubled and topic in self._lanes:
            for lane in self._lanes[topic]:
                yield from self._pairer.add(lane, held)
        elif self.thorough and isinstance(content, Image):
            self._check(topic, held)

    def _take_camera(self, topic: str, held: Held, camera: Camera) -> None:
        if topic in self._cameras:
            self._cameras[topic].append(held)
        if self.thorough:
            size = _Size(topic, camera.frame_id, camera.width, camera.height)
            _count(self._camera_sizes, size)

    def _paired(self, decided: Iterator[Instant | Alone]) -> Iterator[Instant]:
        channels = {lane.channel: lane for lane in self._required}
        for outcome in decided:
            if isinstance(outcome, Instant):
                self._measure(outcome)
                yield outcome
                continue
            self._alone += 1
            topic, lacks = channels[outcome.lane].topic, channels[outcome.lacks].topic
            says = (
                f"{topic}: the image of stamp {outcome.held.stamp_ns} has no partner on {lacks} "
                f"within {self._tolerance / 1e6:g} ms"
            )
            self._note(Defect("unpaired", says, topic, outcome.held.stamp_ns))
            if self.thorough:
                self._check(topic, outcome.held)

    def _measure(self, instant: Instant) -> None:
        self._frames += 1
        stamps = [held.stamp_ns for held in instant.required.values()]
        self._offsets.append(max(stamps) - min(stamps))
        self._offset_max = max(self._offset_max, self._offsets[-1])

    # -- what was found ---------------------------------------------------------------------------

    def report(self) -> DefectReport:
        """What has been found so far, with the statistics of the pairing."""
        report = DefectReport().merged(self._found)
        if self._required:
            report.pairing = Pairing(
                channels=tuple(lane.channel for lane in self._required),
                frames=self._frames,
                unpaired=self._alone,
                offset_max_ns=self._offset_max,
                offset_median_ns=int(statistics.median(self._offsets)) if self._offsets else 0,
                clock=self._clocks.paired_by,
                why=self._clocks.why,
            )
        return report

    def _note(self, defect: Defect) -> None:
        self._found.add(defect)
        self._recent.append(defect)

    def _check(self, topic: str, held: Held) -> None:
        """Decode an image that belongs to no frame, only to know whether it can be."""
        content = held.payload
        if not isinstance(content, Image):
            return
        try:
            height, width = content.pixels.decode().shape[:2]
        except ImageError as error:
            self._note(_undecodable(topic, held, error))
        else:
            _count(self._image_sizes, _Size(topic, content.frame_id, width, height))

    def _compare_sizes(self) -> None:
        """Hold images outside the channels against the calibrations that could be meant for them:
        of the same frame id, or else beside them."""
        for image, images in self._image_sizes.items():
            if image.topic in self._lanes:
                continue  # each frame has been compared with its own calibration
            beside = set(camera_topics_of(image.topic))
            for camera in self._camera_sizes:
                related = camera.topic in beside or (
                    bool(image.frame_id) and camera.frame_id == image.frame_id
                )
                if related and (camera.width, camera.height) != (image.width, image.height):
                    says = (
                        f"{image.topic}: {images} images are {image.width} x {image.height}, but "
                        f"the calibration {camera.topic} is for {camera.width} x {camera.height}"
                    )
                    self._note(Defect("size_mismatch", says, image.topic))

    # -- frames -----------------------------------------------------------------------------------

    def frame(self, instant: Instant) -> Frame | None:
        """Decode an instant; None, with the defect noted, if a required image cannot be."""
        found: list[Defect] = []

        def note(defect: Defect) -> None:
            found.append(replace(defect, frame=instant.index))
            self._found.add(found[-1])

        helds = dict(instant.required)
        helds |= {
            lane.channel: instant.attached[lane.channel][0]
            for lane in self._optional
            if lane.channel in instant.attached
        }
        lanes = {lane.channel: lane for lane in (*self._required, *self._optional)}
        images: dict[str, Pixels] = {}
        for channel, held in helds.items():
            image = _decode_image(lanes[channel].topic, held, note)
            if image is not None:
                images[channel] = image
            elif channel in instant.required:
                return None
        reference = next(iter(instant.required.values()))
        cameras = self._cameras_at(reference, [lanes[channel] for channel in images], note)
        self._check_sizes(images, cameras, lanes, reference, note)
        stamps = {channel: helds[channel].stamp_ns for channel in images}
        about = {(lanes[channel].topic, stamp) for channel, stamp in stamps.items()}
        earlier = [
            replace(defect, frame=instant.index)
            for defect in self._recent
            if (defect.topic, defect.stamp_ns) in about
        ]
        truth = _truth(instant.attached, note)
        return Frame(
            index=instant.index,
            stamp_ns=reference.stamp_ns,
            images=images,
            stamps_ns=stamps,
            cameras=cameras,
            truth=truth,
            digest=_digest(images),
            defects=(*earlier, *found),
        )

    def _cameras_at(
        self, reference: Held, lanes: Sequence[Lane], note: Callable[[Defect], None]
    ) -> dict[str, Camera]:
        """The latest calibration at or before the frame, else the first after it."""
        cameras = {}
        for lane in lanes:
            known = self._cameras.get(lane.camera_topic or "", ())
            before = [held for held in known if held.after(reference) <= 0]
            camera = before[-1].payload if before else known[0].payload if known else None
            if camera is not None and camera.K[0, 0] > 0 and camera.K[1, 1] > 0:
                cameras[lane.channel] = camera
            elif lane in self._required and lane.channel not in self._uncalibrated:
                self._uncalibrated.add(lane.channel)
                if camera is not None:
                    why = f"{lane.camera_topic} says that the camera is not calibrated (K[0] is 0)"
                else:
                    where = lane.camera_topic or " or ".join(camera_topics_of(lane.topic))
                    why = f"there is none on {where} at the first frame"
                says = f"{lane.topic}: channel {lane.channel} has no calibration: {why}"
                note(Defect("missing_calibration", says, lane.topic, reference.stamp_ns))
        return cameras

    def _check_sizes(
        self,
        images: Mapping[str, Pixels],
        cameras: Mapping[str, Camera],
        lanes: Mapping[str, Lane],
        reference: Held,
        note: Callable[[Defect], None],
    ) -> None:
        first = next(iter(images))
        for channel, image in images.items():
            height, width = image.shape[:2]
            topic, camera = lanes[channel].topic, cameras.get(channel)
            says = f"{topic}: the image is {width} x {height}"
            if camera is not None and (camera.width, camera.height) != (width, height):
                says += f", but its calibration is for {camera.width} x {camera.height}"
                note(Defect("size_mismatch", says, topic, reference.stamp_ns))
            elif image.shape[:2] != images[first].shape[:2]:
                expected = images[first].shape
                says += f", but that of {lanes[first].topic} is {expected[1]} x {expected[0]}"
                note(Defect("size_mismatch", says, topic, reference.stamp_ns))


def camera_topics_of(image_topic: str) -> tuple[str, str]:
    """Where the calibration of an image topic is looked for: beside it."""
    parent = image_topic.removesuffix("/compressed").rpartition("/")[0]
    return f"{parent}/calibration", f"{parent}/camera_info"


def _count(sizes: Counter[_Size], size: _Size) -> None:
    if size in sizes or len(sizes) < _SIZES_KEPT:
        sizes[size] += 1


def _undecodable(topic: str, held: Held, error: Exception) -> Defect:
    says = f"{topic}: the message of stamp {held.stamp_ns} cannot be decoded: {error}"
    return Defect("undecodable", says, topic, held.stamp_ns)


def _decode_image(topic: str, held: Held, note: Callable[[Defect], None]) -> Pixels | None:
    content: Content = held.payload
    try:
        if not isinstance(content, Image):
            raise ImageError("it is not an image")
        return content.pixels.decode()
    except ImageError as error:
        note(_undecodable(topic, held, error))
        return None


def _digest(images: Mapping[str, Pixels]) -> str:
    digest = hashlib.blake2b(digest_size=16)
    for channel in sorted(images):
        image = images[channel]
        digest.update(f"{channel} {image.dtype.name} {image.shape}".encode())
        digest.update(np.ascontiguousarray(image).data)
    return digest.hexdigest()


# -- ground truth ---------------------------------------------------------------------------------


def _truth(
    attached: Mapping[str, tuple[Held, ...]], note: Callable[[Defect], None]
) -> Truth | None:
    """What was recorded of the truth at an instant; None if nothing was."""
    parts = {topic: attached[topic] for topic in TRUTH_TOPICS if topic in attached}
    if not parts:
        return None

    def image(part: str, dtype: type[np.generic]) -> Pixels | None:
        topic = TRUTH + part
        if topic not in parts:
            return None
        pixels = _decode_image(topic, parts[topic][0], note)
        if pixels is not None and dtype is np.float32 and pixels.dtype == np.uint16:
            # The ROS convention (REP 118) for 16UC1 depth: millimetres, 0 where unknown.
            pixels = np.where(pixels == 0, np.float32(np.nan), pixels * np.float32(1e-3))
            pixels.flags.writeable = False
        if pixels is not None and (pixels.dtype != dtype or pixels.ndim != 2):
            found = f"expected H W {dtype.__name__}, found {pixels.shape} {pixels.dtype}"
            note(_undecodable(topic, parts[topic][0], ImageError(found)))
            return None
        return pixels

    transforms: dict[str, NDArray[np.float64]] = {}
    for held in parts.get(TRUTH + "transforms", ()):
        if isinstance(held.payload, tuple):
            transforms |= {one.child: one.parent_from_child for one in held.payload}
    meta = parts[TRUTH + "meta"][0].payload if TRUTH + "meta" in parts else {}
    return Truth(
        depth_m=image("depth", np.float32),
        instances=image("instances", np.uint8),
        faces=image("faces", np.uint8),
        camera_from_object=transforms,
        meta=meta if isinstance(meta, Mapping) else {},
    )

"""The MCAP file as a container: an index, and messages in the order of time, in bounded memory.

The records themselves are parsed by the ``mcap`` library.  Their framing is read here, because the
library's readers give up at the first damage, sort a file without an index as a whole in memory,
and allocate what a length field says.  There are two ways to the same index:

* :func:`read_summary` takes it from the end of the file, if all of it is there and consistent;
* :func:`walk` rebuilds it by hopping from record to record, survives cuts and garbage, and reads
  only the parts that it cannot hop over.

An index is a list of :class:`Segment`, and :class:`MessageReader` merges the segments by log time.
A segment is decompressed as a stream, so that of a chunk that is cut everything is read that
precedes the cut.
"""

from __future__ import annotations

import heapq
import io
import re
import struct
import zlib
from collections.abc import Callable, Collection, Generator, Iterator
from dataclasses import dataclass, field
from typing import Any, BinaryIO, NamedTuple, Protocol

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Metadata, Schema, Statistics

from workbench.recording.defects import Defect

MAGIC = b"\x89MCAP0\r\n"

MERGE_BYTES = 32 << 20
"""Messages held to put overlapping chunks in order; beyond it the earliest goes first."""

RECORD_LIMIT = 64 << 20
"""The largest record other than messages and chunks that is read; schemas take kilobytes."""

MESSAGE_LIMIT = 512 << 20
"""The largest message that is read: 128 million pixels of float32."""

_PIECE = 1 << 20  # what is read at once: a length is never trusted with an allocation
_RUN_BYTES = 1 << 20  # messages outside chunks are indexed in runs of about this many bytes
_HEAD = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_CHUNK = struct.Struct("<QQQII")
_COMPRESSIONS = ("", "zstd", "lz4")
_LONGEST_NAME = 16  # of a compression
_CHUNK_HEAD = _CHUNK.size + _LONGEST_NAME + 8

Report = Callable[[Defect], None]


class Segment(NamedTuple):
    """Bytes ``offset`` to ``end`` of the file: one chunk record, or a run of plain records."""

    start_time: int
    offset: int
    end: int
    chunk: bool


class RawMessage(NamedTuple):
    """A message as it lies in the file, with the records that say how to decode it."""

    log_time: int
    order: int
    channel: Channel
    schema: Schema | None
    data: bytes


@dataclass
class Index:
    """Where the messages are, and what they are."""

    segments: list[Segment] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)

    def learn(self, opcode: int, body: bytes) -> None:
        """Take in a schema, channel or metadata record; raise ``ValueError`` if it is damaged."""
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(body))
                self.schemas.setdefault(schema.id, schema)
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(_stream(body))
                self.channels.setdefault(channel.id, channel)
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(_stream(body))
                self.metadata.setdefault(metadata.name, metadata.metadata)
        except Exception as error:  # whatever the library meets in damaged bytes
            raise ValueError(f"{_name(opcode)} record: {error}") from error


class UnchunkedError(ValueError):
    """The summary is sound, but lists no place of any message, because there are no chunks."""


class _Stream(Protocol):
    def read(self, size: int, /) -> bytes: ...


# -- the index ------------------------------------------------------------------------------------


def read_summary(file: BinaryIO, size: int) -> Index:
    """The index from the file's own summary.  Raises ``ValueError`` saying why it is of no use."""
    tail_size = _HEAD.size + 20 + len(MAGIC)
    if size < tail_size + len(MAGIC):
        raise ValueError("the file ends before any footer")
    file.seek(size - tail_size)
    tail = file.read(tail_size)
    if not tail.endswith(MAGIC) or _HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
        raise ValueError("the file does not end with a footer")
    footer = Footer.read(_stream(tail[_HEAD.size :]))
    footer_at = size - tail_size
    if footer.summary_start == 0:
        raise ValueError("the footer names no summary")
    if not len(MAGIC) <= footer.summary_start <= footer_at:
        raise ValueError(f"the footer places the summary at byte {footer.summary_start} of {size}")
    if footer.summary_crc:
        file.seek(footer.summary_start)
        crc = zlib.crc32(tail[: _HEAD.size + 16], _crc_of(file, footer_at - footer.summary_start))
        if crc != footer.summary_crc:
            raise ValueError("the summary fails its checksum")
    return _summary_records(file, footer.summary_start, footer_at, size)


def _summary_records(file: BinaryIO, at: int, end: int, size: int) -> Index:
    index = Index()
    statistics: Statistics | None = None
    rig_at: list[int] = []
    metadata_count = 0
    while at < end:
        opcode, length = _head(file, at)
        if length > min(RECORD_LIMIT, end - at - _HEAD.size):
            raise ValueError(f"the summary's record at byte {at} is too long")
        body = file.read(length)
        at += _HEAD.size + length
        try:
            if opcode == Opcode.STATISTICS:
                statistics = Statistics.read(_stream(body))
            elif opcode == Opcode.CHUNK_INDEX:
                chunk = ChunkIndex.read(_stream(body))
                first = chunk.chunk_start_offset
                last = first + chunk.chunk_length
                if last > size:
                    raise ValueError(f"a chunk lies at bytes {first} to {last} of {size}")
                index.segments.append(Segment(chunk.message_start_time, first, last, True))
            elif opcode == Opcode.METADATA_INDEX:
                metadata_count += 1
                rig_at.append(struct.unpack_from("<Q", body)[0])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                index.learn(opcode, body)
        except ValueError:
            raise
        except Exception as error:  # whatever the library meets in damaged bytes
            raise ValueError(f"the summary's {_name(opcode)} record: {error}") from error
    for offset in rig_at:
        opcode, length = _head(file, offset)
        if opcode == Opcode.METADATA and length <= RECORD_LIMIT:
            index.learn(opcode, file.read(length))
    found = (len(index.segments), metadata_count, len(index.channels))
    if statistics is None:
        raise ValueError("the summary has no statistics to check it by")
    said = (statistics.chunk_count, statistics.metadata_count, statistics.channel_count)
    if said != found:
        raise ValueError(
            "the summary lists {} chunks, {} metadata and {} channels".format(*found)
            + " where its statistics say {}, {} and {}".format(*said)
        )
    if statistics.message_count and not index.segments:
        raise UnchunkedError("the messages lie outside chunks")
    return index


def walk(file: BinaryIO, size: int, report: Report) -> Index:
    """The index by hopping over the records of the file, whatever state it is in.

    A record whose length leads nowhere ends the file (``truncated``) unless records are found
    further on (``chunk_damaged``).
    """
    index = Index()
    walker = _Walker(file, size, index, report)
    walker.run()
    return index


class _Walker:
    """One walk.  ``_open_chunk`` waits for the message indexes that follow its chunk: they tell
    whether it holds channels that are not known yet, in which case it is read for their names."""

    def __init__(self, file: BinaryIO, size: int, index: Index, report: Report) -> None:
        self.file, self.size, self.index, self.report = file, size, index, report
        self._open_chunk: Segment | None = None
        self._open_channels: set[int] = set()
        self._run: tuple[int, int] | None = None  # start time and offset of the run at hand

    def run(self) -> None:
        at = len(MAGIC)
        while at < self.size:
            step = self._step(at)
            if step is None:
                break
            at = step
        self._close_run(min(at, self.size))
        self._close_chunk()

    def _step(self, at: int) -> int | None:
        """Take in the record at ``at``; return where the next one is, None at the end."""
        if self.size - at < _HEAD.size:
            self._truncated(at, f"{self.size - at} bytes into the head of a record")
            return None
        opcode, length = _head(self.file, at)
        end = at + _HEAD.size + length
        if opcode == 0 or end > self.size or not self._sane(opcode, length, at):
            return self._recover(at, opcode, length)
        if opcode != Opcode.MESSAGE_INDEX:
            self._close_chunk()
        self.file.seek(at + _HEAD.size)
        if opcode == Opcode.FOOTER:
            return None
        if opcode == Opcode.MESSAGE:
            (log_time,) = struct.unpack_from("<Q", self.file.read(14), 6)
            if self._run is None:
                self._run = (log_time, at)
            self._run = (min(self._run[0], log_time), self._run[1])
            if end - self._run[1] >= _RUN_BYTES:
                self._close_run(end)
        elif opcode == Opcode.CHUNK:
            self._close_run(at)
            (start_time,) = struct.unpack("<Q", self.file.read(8))
            self._open_chunk = Segment(start_time, at, end, True)
        elif opcode == Opcode.MESSAGE_INDEX:
            self._open_channels.add(int.from_bytes(self.file.read(2), "little"))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA):
            self._learn(opcode, length, at)
        return end

    def _learn(self, opcode: int, length: int, at: int) -> None:
        try:
            if length > RECORD_LIMIT:
                raise ValueError(f"{_name(opcode)} record of {length} bytes")
            self.index.learn(opcode, self.file.read(length))
        except ValueError as error:
            self.report(Defect("chunk_damaged", f"at byte {at}: {error}"))

    def _sane(self, opcode: int, length: int, at: int) -> bool:
        """Whether the inner sizes of the record agree with its length."""
        self.file.seek(at + _HEAD.size)
        if opcode == Opcode.MESSAGE:
            return _MESSAGE.size <= length <= MESSAGE_LIMIT
        if opcode == Opcode.CHUNK:
            chunk = _chunk_head(self.file.read(_CHUNK_HEAD))
            return chunk is not None and chunk.length == length
        if opcode == Opcode.MESSAGE_INDEX:
            body = self.file.read(6)
            return len(body) == 6 and int.from_bytes(body[2:], "little") == length - 6
        return True

    def _recover(self, at: int, opcode: int, length: int) -> int | None:
        """Go on at the next record that can be believed, or end the file here."""
        self._close_run(at)
        self._close_chunk()
        self.file.seek(at + _HEAD.size)
        chunk = _chunk_head(self.file.read(_CHUNK_HEAD)) if opcode == Opcode.CHUNK else None
        # If both lengths of a chunk agree, the file is too short for it: no length is wrong.
        cut = chunk is not None and chunk.length == length
        found = None if cut else self._resync(at + 1)
        if chunk is not None:
            self._open_chunk = Segment(chunk.start_time, at, found or self.size, True)
        there = self.size - at - _HEAD.size
        if found is None:
            what = f"a {_name(opcode)} record of {length} bytes, of which {there} are there"
            self._truncated(at, what)
            return None
        says = (
            f"byte {at}: opcode {opcode} with length {length} is no sound record; "
            f"{found - at} bytes are passed over"
        )
        self.report(Defect("chunk_damaged", says))
        return found

    def _truncated(self, at: int, what: str) -> None:
        self.report(
            Defect("truncated", f"the file of {self.size} bytes ends, at byte {at}, within {what}")
        )

    def _resync(self, at: int) -> int | None:
        """The first offset from ``at`` on where a chain of believable records starts."""
        while at < self.size:
            self.file.seek(at)
            block = self.file.read(_PIECE + _HEAD.size)
            for match in _CANDIDATE.finditer(block):
                if self._believable(at + match.start(), 3):
                    return at + match.start()
            at += _PIECE
        return None

    def _believable(self, at: int, depth: int) -> bool:
        if at == self.size or (depth == 0 and at < self.size):
            return True
        if self.size - at < _HEAD.size:
            return depth < 3
        opcode, length = _head(self.file, at)
        end = at + _HEAD.size + length
        if not Opcode.HEADER <= opcode <= Opcode.DATA_END or not self._sane(opcode, length, at):
            return False
        if opcode == Opcode.CHUNK:
            # Two lengths that agree and a known name are proof, even if the file is cut there.
            self.file.seek(at + _HEAD.size)
            chunk = _chunk_head(self.file.read(_CHUNK_HEAD))
            return chunk is not None and chunk.compression in _COMPRESSIONS
        if opcode == Opcode.MESSAGE:
            self.file.seek(at + _HEAD.size)
            if int.from_bytes(self.file.read(2), "little") not in self.index.channels:
                return False
        return (end <= self.size or depth < 3) and self._believable(min(end, self.size), depth - 1)

    def _close_run(self, end: int) -> None:
        if self._run is not None:
            self.index.segments.append(Segment(self._run[0], self._run[1], end, False))
            self._run = None

    def _close_chunk(self) -> None:
        if self._open_chunk is None:
            return
        chunk, channels = self._open_chunk, self._open_channels
        self._open_chunk, self._open_channels = None, set()
        self.index.segments.append(chunk)
        if not channels or not channels <= self.index.channels.keys():
            # Its damage is told when its messages are read.
            reader = MessageReader(self.file, self.index, lambda _: None)
            for _ in reader.segment(chunk, frozenset()):
                pass


_CANDIDATE = re.compile(rb"(?=[\x01-\x0f].{5}\x00{3})", re.DOTALL)
"""Where a record could start: a known opcode and a length below one tebibyte."""


class _ChunkHead(NamedTuple):
    """What a chunk record says before its data, which starts ``data_at`` bytes into its body."""

    start_time: int
    size: int
    crc: int
    compression: str
    data_at: int
    data_length: int

    @property
    def length(self) -> int:
        """The length that the record should have."""
        return self.data_at + self.data_length


def _chunk_head(body: bytes) -> _ChunkHead | None:
    """The head of a chunk by the first bytes of its body; None if it cannot be one."""
    if len(body) < _CHUNK.size:
        return None
    start_time, _, size, crc, name_length = _CHUNK.unpack_from(body)
    data_at = _CHUNK.size + name_length + 8
    if name_length > _LONGEST_NAME or len(body) < data_at:
        return None
    name = body[_CHUNK.size : data_at - 8].decode("ascii", "replace")
    (data_length,) = struct.unpack_from("<Q", body, data_at - 8)
    return _ChunkHead(start_time, size, crc, name, data_at, data_length)


# -- messages -------------------------------------------------------------------------------------


class MessageReader:
    """Messages of an index, by log time, in bounded memory; damage goes to ``report``."""

    def __init__(self, file: BinaryIO, index: Index, report: Report) -> None:
        self._file, self._index, self._report = file, index, report
        self._order = 0
        self._nameless: set[int] = set()  # channels with messages that no record names

    def messages(self, topics: Collection[str] | None = None) -> Iterator[RawMessage]:
        """The messages on ``topics`` (all if None) in the order of log time, then of the file.

        Overlapping segments are merged.  At most about :data:`MERGE_BYTES` are held for it: a
        file that would need more comes slightly out of order instead, which pairing can take.
        """
        segments = sorted(self._index.segments)
        starts = [segment.start_time for segment in segments[1:]]
        heap: list[RawMessage] = []
        held = 0
        for number, segment in enumerate(segments):
            for message in self.segment(segment, topics):
                heapq.heappush(heap, message)
                held += len(message.data)
                while held > MERGE_BYTES:
                    earliest = heapq.heappop(heap)
                    held -= len(earliest.data)
                    yield earliest
            while heap and (number == len(starts) or heap[0].log_time < starts[number]):
                earliest = heapq.heappop(heap)
                held -= len(earliest.data)
                yield earliest

    def segment(self, segment: Segment, topics: Collection[str] | None) -> Iterator[RawMessage]:
        """The messages of one segment in the order of the file, as far as it can be read."""
        if not segment.chunk:
            self._file.seek(segment.offset)
            source = _Slice(self._file, segment.end - segment.offset)
            yield from self._records(_Checked(source), segment, topics, False)
            return
        self._file.seek(segment.offset)
        head = self._file.read(min(_HEAD.size + _CHUNK_HEAD, segment.end - segment.offset))
        chunk = _chunk_head(head[_HEAD.size :])
        if head[:1] != bytes([Opcode.CHUNK]) or chunk is None:
            if len(head) >= _HEAD.size + _CHUNK_HEAD:  # else it is cut, which has been told
                self._damaged(segment, f"no chunk starts there, but {head[:8].hex(' ')}")
            return
        if chunk.compression not in _COMPRESSIONS:
            name = chunk.compression
            self._damaged(segment, f"its compression is {name!r}, known are zstd, lz4 and none")
            return
        start = segment.offset + _HEAD.size + chunk.data_at
        there = max(0, min(chunk.data_length, segment.end - start))
        self._file.seek(start)
        stream = _Checked(_decompressed(_Slice(self._file, there), chunk.compression))
        cut = there < chunk.data_length
        sound = yield from self._records(stream, segment, topics, cut)
        if cut or not sound:
            return  # a cut has been told with the index, broken contents just now
        if stream.count != chunk.size:
            self._damaged(segment, f"it holds {stream.count} bytes and claims {chunk.size}")
        elif chunk.crc not in (0, stream.crc):
            says = f"its checksum is {stream.crc:08x} and should be {chunk.crc:08x}"
            self._damaged(segment, f"{says}; its messages are used")

    def _records(
        self, stream: _Checked, segment: Segment, topics: Collection[str] | None, cut: bool
    ) -> Generator[RawMessage, None, bool]:
        """Messages from a stream of records; returns whether the stream was sound to its end.

        ``cut`` if the stream is known to end early, which is then no news.
        """
        channels, schemas = self._index.channels, self._index.schemas
        try:
            while True:
                head = stream.read(_HEAD.size)
                if not head:
                    return True
                if len(head) < _HEAD.size:
                    raise EOFError
                opcode, length = _HEAD.unpack(head)
                if opcode == Opcode.MESSAGE and _MESSAGE.size <= length <= MESSAGE_LIMIT:
                    fixed = stream.read(_MESSAGE.size)
                    if len(fixed) < _MESSAGE.size:
                        raise EOFError
                    channel_id, _, log_time, _ = _MESSAGE.unpack(fixed)
                    channel = channels.get(channel_id)
                    if channel is None:
                        self._unnamed(channel_id, topics)
                    rest = length - _MESSAGE.size
                    if channel is None or (topics is not None and channel.topic not in topics):
                        stream.skip(rest)
                        continue
                    data = stream.read(rest)
                    if len(data) < rest:
                        raise EOFError
                    self._order += 1
                    schema = schemas.get(channel.schema_id)
                    yield RawMessage(log_time, self._order, channel, schema, data)
                elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL) and length <= RECORD_LIMIT:
                    body = stream.read(length)
                    if len(body) < length:
                        raise EOFError
                    self._index.learn(opcode, body)
                elif opcode > Opcode.MESSAGE and opcode != Opcode.CHUNK:
                    stream.skip(length)
                else:
                    raise ValueError(f"a record with opcode {opcode} and length {length}")
        except EOFError:
            if not cut:
                self._damaged(segment, f"it ends after {stream.count} bytes, within a record")
        except Exception as error:  # the decompressors' own exceptions share no base class
            self._damaged(segment, f"after {stream.count} bytes: {' '.join(str(error).split())}")
        return False

    def _unnamed(self, channel_id: int, topics: Collection[str] | None) -> None:
        if topics is None and channel_id not in self._nameless:
            self._nameless.add(channel_id)
            says = f"messages on channel {channel_id}, which no channel record names, are left out"
            self._report(Defect("undecodable", says))

    def _damaged(self, segment: Segment, why: str) -> None:
        what = "chunk" if segment.chunk else "records"
        self._report(Defect("chunk_damaged", f"{what} at byte {segment.offset}: {why}"))


# -- streams --------------------------------------------------------------------------------------


class _Slice:
    """The next ``left`` bytes of a file as a stream."""

    def __init__(self, file: BinaryIO, left: int) -> None:
        self._file, self._left = file, left

    def read(self, size: int = -1, /) -> bytes:
        wanted = self._left if size < 0 else min(size, self._left)
        data = self._file.read(wanted)
        self._left -= len(data)
        return data


class _Lz4:
    """An lz4 frame as a stream that ends where its source ends, be it whole or cut."""

    def __init__(self, source: _Stream) -> None:
        import lz4.frame

        self._source = source
        self._decompressor: Any = lz4.frame.LZ4FrameDecompressor()

    def read(self, size: int, /) -> bytes:
        parts: list[bytes] = []
        while size > 0 and not self._decompressor.eof:
            data = b""
            if self._decompressor.needs_input:
                data = self._source.read(1 << 17)
                if not data:
                    break
            parts.append(self._decompressor.decompress(data, max_length=size))
            size -= len(parts[-1])
        return b"".join(parts)


def _decompressed(source: _Slice, compression: str) -> _Stream:
    if compression == "zstd":
        import zstandard

        reader: Any = zstandard.ZstdDecompressor()
        stream: _Stream = reader.stream_reader(source, read_across_frames=True, closefd=False)
        return stream
    return _Lz4(source) if compression == "lz4" else source


class _Checked:
    """Counts and checksums what is read, in pieces: memory follows the data, not a length field."""

    def __init__(self, source: _Stream) -> None:
        self._source = source
        self.count = 0
        self.crc = 0

    def read(self, size: int) -> bytes:
        """Up to ``size`` bytes; fewer only where the source ends."""
        parts: list[bytes] = []
        while size > 0:
            part = self._source.read(min(size, _PIECE))
            if not part:
                break
            self.count += len(part)
            self.crc = zlib.crc32(part, self.crc)
            parts.append(part)
            size -= len(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)

    def skip(self, size: int) -> None:
        """Pass over ``size`` bytes; raise ``EOFError`` if there are fewer."""
        while size > 0:
            part = self.read(min(size, _PIECE))
            if not part:
                raise EOFError
            size -= len(part)


def _head(file: BinaryIO, at: int) -> tuple[int, int]:
    file.seek(at)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        raise ValueError(f"no record at byte {at}")
    opcode, length = _HEAD.unpack(head)
    return opcode, length


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(body))


def _crc_of(file: BinaryIO, size: int) -> int:
    checked = _Checked(_Slice(file, size))
    checked.skip(size)
    return checked.crc


def _name(opcode: int) -> str:
    names = {int(code): code.name for code in Opcode}
    return names.get(opcode, f"opcode {opcode}").lower().replace("_", " ")

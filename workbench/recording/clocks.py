"""Which clock to believe.

A message has up to two times: the *log time* that the recorder gave it, and the *header stamp*
inside it that says when it was taken.  The rule, the same for every recording:

1. Both are brought to nanoseconds if they are evidently in another unit (``stamp_unit``): the value
   is a date between 2000 and 2100 in that unit, and either the other clock of the same message
   says about the same date, or the steps would mean more than 1000 messages a second.  A small
   value alone is no evidence: clocks that start at zero are common and sane.
2. Header stamps are the clock of the paired channels.  Log times are it instead if, by the first
   messages of each channel (:data:`PROBE`), the header stamps of one stand still, are too coarse or
   absent, or two channels are more than a second apart, and log times make more than twice as many
   pairs.  Header stamps that are merely further apart than the tolerance stay the clock: the images
   are not of one instant then.
3. Any other topic goes by its header stamps unless these are frozen; a message without a header
   stamp goes by its log time, and is matched with the log time of the image it belongs to.
"""

from __future__ import annotations

import statistics
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from heapq import heappop, heappush
from itertools import pairwise
from typing import NamedTuple

from workbench.recording.defects import Defect

PROBE = 8
"""How many messages of a topic are looked at before its clock is chosen."""

_EPOCH_2000 = 946_684_800 * 10**9
_EPOCH_2100 = 4_102_444_800 * 10**9
_YEAR = 366 * 86_400 * 10**9
_FASTEST = 1_000_000  # one millisecond: two messages of a topic are not closer in a bench's work
_UNRELATED = 10**9  # one second: beyond it two cameras do not share a clock


class Sample(NamedTuple):
    """The two times of one message, as recorded."""

    log: int
    header: int | None


class Unit(NamedTuple):
    """A wrong unit: nanoseconds are the value times ``times`` divided by ``over``."""

    name: str
    times: int
    over: int

    def ns(self, value: int) -> int:
        """``value`` in nanoseconds."""
        return value * self.times // self.over


_UNITS = (
    Unit("seconds in a nanosecond field", 10**9, 1),
    Unit("milliseconds in a nanosecond field", 10**6, 1),
    Unit("microseconds in a nanosecond field", 10**3, 1),
    Unit("milliseconds in a field of seconds", 1, 10**3),
    Unit("microseconds in a field of seconds", 1, 10**6),
    Unit("nanoseconds in a field of seconds", 1, 10**9),
)


def plausible(ns: int) -> bool:
    """Whether ``ns`` is a date between 2000 and 2100."""
    return _EPOCH_2000 <= ns <= _EPOCH_2100


def unit_of(values: Sequence[int], others: Sequence[int | None]) -> Unit | None:
    """The wrong unit that ``values`` are in, None if they are nanoseconds for all one can tell.

    ``others`` are the other clock's times of the same messages.
    """
    if not values or plausible(values[0]):
        return None
    unit = next((unit for unit in _UNITS if plausible(unit.ns(values[0]))), None)
    if unit is None or unit.over > 1:
        return unit  # later than 2100: no clock starts there
    other = next((time for time in others if time is not None and plausible(time)), None)
    if other is not None and abs(unit.ns(values[0]) - other) < _YEAR:
        return unit
    steps = [step for step in _steps(values) if step > 0]
    return unit if steps and statistics.median(steps) <= _FASTEST else None


def _steps(values: Sequence[int]) -> list[int]:
    return [later - earlier for earlier, later in pairwise(sorted(values))]


def frozen(samples: Sequence[Sample]) -> bool:
    """Whether the header stamps stand still while the log times go on (three messages or more)."""
    headers = {sample.header for sample in samples}
    return (
        len(samples) >= 3
        and len(headers) == 1
        and None not in headers
        and len({sample.log for sample in samples}) > 1
    )


@dataclass(frozen=True)
class Clocks:
    """The clocks chosen for a recording.  ``paired_by`` is ``header`` or ``log``, ``why`` says
    why it is not the header; ``by_log`` are the topics that go by log time."""

    log_unit: Unit | None = None
    header_units: Mapping[str, Unit] = field(default_factory=dict)
    by_log: frozenset[str] = frozenset()
    paired_by: str = "header"
    why: str = ""

    def log_ns(self, log: int) -> int:
        """A log time in nanoseconds."""
        return self.log_unit.ns(log) if self.log_unit else log

    def header_ns(self, topic: str, header: int | None) -> int | None:
        """A header stamp of ``topic`` in nanoseconds, None if there is none."""
        unit = self.header_units.get(topic)
        return unit.ns(header) if unit and header is not None else header

    def own_ns(self, topic: str, header: int | None) -> int | None:
        """The header stamp of a message if its topic goes by it, else None."""
        return None if topic in self.by_log else self.header_ns(topic, header)


def choose(
    samples: Mapping[str, Sequence[Sample]], paired: Sequence[str], tolerance_ns: int
) -> tuple[Clocks, list[Defect]]:
    """The clocks for a recording by the first messages of its topics, and what is wrong with them.

    ``paired`` are the topics of the required channels, the reference first.
    """
    defects: list[Defect] = []
    log_unit: Unit | None = None
    header_units: dict[str, Unit] = {}
    for topic, seen in samples.items():
        logs = [sample.log for sample in seen]
        headers = [sample.header for sample in seen if sample.header is not None]
        unit = unit_of(logs, [sample.header for sample in seen])
        if unit and not log_unit:
            log_unit = unit
            defects.append(_unit_defect("log times", unit, logs[0], topic))
        unit = unit_of(headers, logs)
        if unit:
            header_units[topic] = unit
            defects.append(_unit_defect("header stamps", unit, headers[0], topic))
    units = Clocks(log_unit, header_units)
    by_log = {topic for topic, seen in samples.items() if frozen(seen)} - set(paired)
    headers_of = {topic: _headers(units, topic, samples.get(topic, ())) for topic in paired}
    logs_of = {topic: _logs(units, samples.get(topic, ())) for topic in paired}
    trouble = _trouble(headers_of, logs_of)
    by_header = _pairs(list(headers_of.values()), tolerance_ns)
    by_logs = _pairs(list(logs_of.values()), tolerance_ns)
    paired_by, why = "header", ""
    if trouble and 2 * by_header < by_logs:
        paired_by = "log"
        why = f"{trouble}: they pair {by_header} of the first images, log times {by_logs}"
        by_log.update(paired)
    return Clocks(log_unit, header_units, frozenset(by_log), paired_by, why), defects


def _trouble(headers: Mapping[str, Sequence[int]], logs: Mapping[str, Sequence[int]]) -> str:
    """Why header stamps are no clock to pair by; empty if they may be."""
    for topic, stamps in headers.items():
        if 2 * len(set(stamps)) < len(set(logs[topic])):
            return f"the header stamps of {topic} have {len(set(stamps))} values only"
    reference, *others = headers or [""]
    for topic in others:
        apart = min((abs(a - b) for a in headers[topic] for b in headers[reference]), default=0)
        if apart > _UNRELATED:
            return f"the header stamps of {topic} and {reference} are {apart / 1e9:g} s apart"
    return ""


def _headers(clocks: Clocks, topic: str, seen: Sequence[Sample]) -> list[int]:
    headers = (clocks.header_ns(topic, sample.header) for sample in seen)
    return [header for header in headers if header is not None]


def _logs(clocks: Clocks, seen: Sequence[Sample]) -> list[int]:
    return [clocks.log_ns(sample.log) for sample in seen]


def _pairs(times: Sequence[Sequence[int]], tolerance_ns: int) -> int:
    """How many distinct times of the first list have one within tolerance in every other."""
    if not times:
        return 0
    others = [sorted(other) for other in times[1:]]
    return sum(all(_near(time, other, tolerance_ns) for other in others) for time in set(times[0]))


def _near(time: int, ordered: Sequence[int], tolerance_ns: int) -> bool:
    at = bisect_left(ordered, time - tolerance_ns)
    return at < len(ordered) and ordered[at] <= time + tolerance_ns


def _unit_defect(what: str, unit: Unit, value: int, topic: str) -> Defect:
    says = (
        f"{topic}: its {what} are {unit.name}: the first, {value}, is read as "
        f"{_date(unit.ns(value))} instead of {_date(value)}"
    )
    return Defect("stamp_unit", says, topic, value)


def _date(ns: int) -> str:
    if not 0 <= ns < 253_402_300_800 * 10**9:
        return f"{ns} ns"
    return datetime.fromtimestamp(ns // 10**9, UTC).strftime("%Y-%m-%d %H:%M:%S")


# -- one topic over time --------------------------------------------------------------------------


class TopicWatch:
    """Follows the times of one topic in bounded memory and finds what is wrong with them.

    ``stream`` is whether the topic is one of images: only there must stamps be distinct and
    regular.  :meth:`see` takes messages in the order of the log; intervals are judged in the order
    of stamps, a few messages later, so that a late message is not taken for a gap.
    """

    _REORDER = 3
    _MEDIAN_OF = 64
    _FEWEST = 6  # intervals before a median is believed while more will come
    _REMEMBERED = 256

    def __init__(self, topic: str, stream: bool) -> None:
        self.topic, self.stream = topic, stream
        self.count = 0
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.intervals: deque[int] = deque(maxlen=self._MEDIAN_OF)
        self._headers_differ = False
        self._logs_differ = False
        self._first: Sample | None = None
        self._recent: deque[int] = deque(maxlen=self._REMEMBERED)
        self._waiting: list[int] = []
        self._previous: int | None = None
        self._unjudged: list[tuple[int, int]] = []

    def see(self, sample: Sample, stamp_ns: int) -> list[Defect]:
        """Take in a message by its recorded times and the stamp it goes by; return what is wrong.

        A ``doubled`` among them means that the message repeats an earlier one.
        """
        self.count += 1
        self._first = self._first or sample
        self._headers_differ |= sample.header != self._first.header
        self._logs_differ |= sample.log != self._first.log
        found: list[Defect] = []
        if self.stream and stamp_ns in self._recent:
            says = f"{self.topic}: stamp {stamp_ns} comes again, the first image with it is kept"
            return [Defect("doubled", says, self.topic, stamp_ns)]
        if self.last_ns is not None and stamp_ns < self.last_ns:
            says = (
                f"{self.topic}: stamp {stamp_ns} comes {(self.last_ns - stamp_ns) / 1e6:.3f} ms "
                f"after its time, behind {self.last_ns}"
            )
            found.append(Defect("late", says, self.topic, stamp_ns))
        self._recent.append(stamp_ns)
        self.first_ns = stamp_ns if self.first_ns is None else min(self.first_ns, stamp_ns)
        self.last_ns = stamp_ns if self.last_ns is None else max(self.last_ns, stamp_ns)
        heappush(self._waiting, stamp_ns)
        if len(self._waiting) > self._REORDER:
            self._pass(heappop(self._waiting))
            found += self._gaps(self._FEWEST)
        return found

    def finish(self) -> list[Defect]:
        """What can only be said at the end: stamps that never changed, and the last gaps."""
        while self._waiting:
            self._pass(heappop(self._waiting))
        found = self._gaps(3)
        header = self._first.header if self._first else None
        still = self._logs_differ and not self._headers_differ
        if self.count >= 3 and still and header is not None:
            says = (
                f"{self.topic}: the header stamps of its {self.count} messages never change "
                f"from {header}, while their log times do"
            )
            found.append(Defect("stamp_frozen", says, self.topic, header))
        return found

    @property
    def rate_hz(self) -> float | None:
        """One over the median interval; None below two messages."""
        median = statistics.median(self.intervals) if self.intervals else 0
        return 1e9 / median if median > 0 else None

    def _pass(self, stamp_ns: int) -> None:
        if self._previous is not None and stamp_ns > self._previous:
            self.intervals.append(stamp_ns - self._previous)
            self._unjudged.append((stamp_ns - self._previous, stamp_ns))
        self._previous = max(stamp_ns, self._previous or stamp_ns)

    def _gaps(self, fewest: int) -> list[Defect]:
        if not self.stream:
            self._unjudged.clear()
        if not self._unjudged or len(self.intervals) < fewest:
            return []
        median = statistics.median(self.intervals)
        beats = [interval / median for interval in self.intervals]
        usual = sum(abs(beat - 1) <= 0.2 for beat in beats)
        on_beat = sum(abs(beat - max(1, round(beat))) <= 0.2 for beat in beats)
        # A camera that is triggered now and then has no rhythm that could be broken.
        rhythmic = usual >= 0.5 * len(beats) and on_beat >= 0.8 * len(beats)
        found = []
        for interval, stamp_ns in self._unjudged:
            if rhythmic and interval > 1.5 * median:
                missing = max(1, round(interval / median) - 1)
                says = (
                    f"{self.topic}: {interval / 1e6:.3f} ms before stamp {stamp_ns} where "
                    f"{median / 1e6:.3f} ms are usual: probably {missing} missing"
                )
                found.append(Defect("dropped", says, self.topic, stamp_ns))
        self._unjudged.clear()
        return found

"""Putting together what belongs to one instant, from streams that jitter, drop, double and delay.

Two images belong together when each is the other's nearest and they are within tolerance: so a
dropped image leaves its partner alone and does not shift all that follow, even when the tolerance
is longer than the period.  An instant is decided when several later messages of each required lane
have been seen (:data:`LOOKAHEAD`), or when waiting longer would cost too much (:data:`HORIZON_NS`,
:data:`HELD_BYTES`, :data:`HELD_COUNT`): memory is bounded, whatever the recording.
"""

from __future__ import annotations

from bisect import bisect_left, insort
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any

LOOKAHEAD = 4
HORIZON_NS = 5 * 10**9
HELD_BYTES = 128 << 20
HELD_COUNT = 512


@dataclass(frozen=True, eq=False)
class Held:
    """A message that waits for its instant.  ``by_log`` if it has no stamp of its own."""

    stamp_ns: int
    log_ns: int
    size: int
    payload: Any
    by_log: bool = False

    def after(self, reference: Held) -> int:
        """By how many nanoseconds this is later than ``reference``, by the clock that both have."""
        if self.by_log:
            return self.log_ns - reference.log_ns
        return self.stamp_ns - reference.stamp_ns

    def distance(self, reference: Held) -> int:
        """How far this is from ``reference``; nanoseconds."""
        return abs(self.after(reference))


@dataclass(frozen=True, eq=False)
class Instant:
    """One per required lane, in their order, and whatever of the other lanes belongs to it."""

    index: int
    required: Mapping[str, Held]
    attached: Mapping[str, tuple[Held, ...]]


@dataclass(frozen=True, eq=False)
class Alone:
    """A message of a required lane that found no instant; ``lacks`` names the lane it missed."""

    lane: str
    held: Held
    lacks: str


_stamp = attrgetter("stamp_ns")


class Pairer:
    """Takes messages lane by lane and gives instants in the order of their stamps.

    ``required`` lanes make an instant, the first is the reference; ``attached`` lanes join it.
    """

    def __init__(self, required: Sequence[str], attached: Sequence[str], tolerance_ns: int) -> None:
        self._tolerance = tolerance_ns
        self._required: dict[str, list[Held]] = {lane: [] for lane in required}
        self._attached: dict[str, list[Held]] = {lane: [] for lane in attached}
        self._reference = required[0] if required else ""
        self._bytes = 0
        self._newest_log = -(1 << 63)
        self._index = 0

    def add(self, lane: str, held: Held) -> Iterator[Instant | Alone]:
        """Take in a message and give what is decided by it."""
        lanes = self._required if lane in self._required else self._attached
        insort(lanes[lane], held, key=_stamp)
        self._bytes += held.size
        self._newest_log = max(self._newest_log, held.log_ns)
        while oldest := self._oldest():
            if not self._decided(*oldest):
                break
            yield from self._settle(*oldest)
        self._bound_attached()

    def drain(self) -> Iterator[Instant | Alone]:
        """Give what is left when no more messages will come."""
        while oldest := self._oldest():
            yield from self._settle(*oldest)

    def clear(self) -> None:
        """Let go of everything that waits."""
        for waiting in (*self._required.values(), *self._attached.values()):
            waiting.clear()
        self._bytes = 0

    def _oldest(self) -> tuple[str, Held] | None:
        heads = [(lane, waiting[0]) for lane, waiting in self._required.items() if waiting]
        return min(heads, key=lambda head: head[1].stamp_ns) if heads else None

    def _decided(self, lane: str, held: Held) -> bool:
        horizon = held.stamp_ns + 3 * self._tolerance
        if all(
            len(waiting) >= LOOKAHEAD and waiting[-LOOKAHEAD].stamp_ns > horizon
            for waiting in self._required.values()
        ):
            return True
        own = self._required[lane]
        return (
            (self._newest_log - held.log_ns > HORIZON_NS and len(own) > LOOKAHEAD)
            or len(own) > HELD_COUNT
            or (self._bytes > HELD_BYTES and len(own) > 2)
        )

    def _settle(self, lane: str, held: Held) -> Iterator[Instant | Alone]:
        reference = held if lane == self._reference else self._nearest(held, self._reference)
        if reference is None:
            yield self._alone(lane, held, self._reference)
            return
        members = {self._reference: reference}
        for other in self._required:
            if other == self._reference:
                continue
            partner = self._nearest(reference, other)
            if partner is None or self._nearest(partner, self._reference) is not reference:
                yield self._alone(lane, held, other)
                return
            members[other] = partner
        if members[lane] is not held:
            yield self._alone(lane, held, self._reference)
            return
        attached = self._attach(reference)
        for name, member in members.items():
            self._remove(self._required[name], member)
        yield Instant(self._index, {name: members[name] for name in self._required}, attached)
        self._index += 1

    def _alone(self, lane: str, held: Held, lacks: str) -> Alone:
        self._remove(self._required[lane], held)
        return Alone(lane, held, lacks)

    def _nearest(self, held: Held, lane: str) -> Held | None:
        """The message of a required ``lane`` nearest to ``held``, the earlier of two; None if
        there is none within tolerance."""
        waiting = self._required[lane]
        at = bisect_left(waiting, held.stamp_ns, key=_stamp)
        near = [
            one for one in waiting[max(0, at - 1) : at + 1] if one.distance(held) <= self._tolerance
        ]
        return min(near, key=lambda one: one.distance(held), default=None)

    def _attach(self, reference: Held) -> dict[str, tuple[Held, ...]]:
        """What belongs to ``reference`` in the attached lanes; older leftovers are let go."""
        following = self._required[self._reference][1:2]
        attached = {}
        for lane, waiting in self._attached.items():
            best = min(waiting, key=lambda one: one.distance(reference), default=None)
            if (
                best is not None
                and best.distance(reference) <= self._tolerance
                and all(best.distance(reference) <= best.distance(other) for other in following)
            ):
                # Transforms come one by one: all with the same stamp belong together.
                attached[lane] = tuple(one for one in waiting if one.stamp_ns == best.stamp_ns)
            used = attached.get(lane, ())
            for one in list(waiting):
                if one in used or one.after(reference) < -self._tolerance:
                    self._remove(waiting, one)
        return attached

    def _bound_attached(self) -> None:
        for waiting in self._attached.values():
            # Transforms are many to an instant and tiny.
            while len(waiting) > 8 * HELD_COUNT or (self._bytes > HELD_BYTES and len(waiting) > 2):
                self._remove(waiting, waiting[0])

    def _remove(self, waiting: list[Held], held: Held) -> None:
        waiting.pop(next(at for at, one in enumerate(waiting) if one is held))
        self._bytes -= held.size

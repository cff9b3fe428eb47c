"""What can be wrong with a recording: the vocabulary, one finding, and a bounded report of many."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

KINDS: Mapping[str, str] = MappingProxyType(
    {
        "truncated": "the file ends within a record",
        "no_index": "the summary, the chunk index or the footer is missing or wrong",
        "chunk_damaged": "a part of the file fails its checksum, its compression or its framing",
        "undecodable": "a message or its image cannot be decoded",
        "unpaired": "an image has no partner of the same instant on another required channel",
        "doubled": "an image carries a stamp that its topic has carried before",
        "late": "a message is older than one that its topic carried before it",
        "dropped": "a regular stream has a gap",
        "stamp_unit": "stamps are in seconds, milliseconds or microseconds instead of nanoseconds",
        "stamp_frozen": "the stamps of a topic never change while time passes",
        "size_mismatch": "the size of an image contradicts a calibration or another image",
        "missing_calibration": "a channel has images but no usable calibration",
    }
)
"""Every kind of defect and what it means, gravest first; reports keep this order."""


@dataclass(frozen=True)
class Defect:
    """One finding.  ``says`` is one sentence with the numbers, naming the topic if there is one."""

    kind: str
    says: str
    topic: str = ""
    stamp_ns: int | None = None
    frame: int | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"defect kind: expected one of {', '.join(KINDS)}, got {self.kind!r}")

    def as_dict(self) -> dict[str, Any]:
        """This finding for JSON; what is unknown is left out."""
        found: dict[str, Any] = {"says": self.says}
        if self.topic:
            found["topic"] = self.topic
        if self.stamp_ns is not None:
            found["stamp_ns"] = self.stamp_ns
        if self.frame is not None:
            found["frame"] = self.frame
        return found


@dataclass(frozen=True)
class Pairing:
    """How well the required channels pair.

    ``offset_*_ns`` is the largest distance between the stamps of one frame; the median is over
    the latest 4096 frames.  ``clock`` is what the pairs were made by: ``header`` stamps or ``log``
    times (see :mod:`workbench.recording.clocks`), ``why`` the reason when it is not the header.
    """

    channels: tuple[str, ...]
    frames: int
    unpaired: int
    offset_max_ns: int
    offset_median_ns: int
    clock: str = "header"
    why: str = ""

    def as_dict(self) -> dict[str, Any]:
        """These numbers for JSON."""
        return {
            "channels": list(self.channels),
            "frames": self.frames,
            "unpaired": self.unpaired,
            "offset_max_ns": self.offset_max_ns,
            "offset_median_ns": self.offset_median_ns,
            "clock": self.clock,
            "why": self.why,
        }

    def line(self) -> str:
        """One sentence for people."""
        by = "header stamps" if self.clock == "header" else f"log times, because {self.why}"
        return (
            f"{self.frames} frames of {' + '.join(self.channels)} and {self.unpaired} unpaired "
            f"images; stamps within a frame differ by {self.offset_median_ns / 1e6:.3f} ms in the "
            f"median and {self.offset_max_ns / 1e6:.3f} ms at most (by {by})"
        )


@dataclass
class DefectReport:
    """Counts every defect and keeps the first ``keep`` examples of each kind: bounded memory."""

    keep: int = 5
    counts: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[Defect]] = field(default_factory=dict)
    pairing: Pairing | None = None

    def add(self, defect: Defect) -> None:
        """Count ``defect`` and keep it if it is among the first of its kind."""
        self.counts[defect.kind] += 1
        examples = self.examples.setdefault(defect.kind, [])
        if len(examples) < self.keep:
            examples.append(defect)

    def merged(self, other: DefectReport) -> DefectReport:
        """A new report of both; ``other`` comes second and its pairing wins."""
        both = DefectReport(max(self.keep, other.keep), self.counts + other.counts)
        for kind in KINDS:
            examples = self.examples.get(kind, []) + other.examples.get(kind, [])
            if examples:
                both.examples[kind] = examples[: both.keep]
        both.pairing = other.pairing or self.pairing
        return both

    def __len__(self) -> int:
        """How many defects were found."""
        return self.counts.total()

    def __bool__(self) -> bool:
        return len(self) > 0

    def __iter__(self) -> Iterator[Defect]:
        """The kept examples, gravest kind first."""
        for kind in KINDS:
            yield from self.examples.get(kind, ())

    def as_dict(self) -> dict[str, Any]:
        """The report for JSON."""
        kinds = [kind for kind in KINDS if self.counts[kind]]
        return {
            "total": len(self),
            "counts": {kind: self.counts[kind] for kind in kinds},
            "examples": {kind: [d.as_dict() for d in self.examples[kind]] for kind in kinds},
            "pairing": self.pairing.as_dict() if self.pairing else None,
        }

    def lines(self) -> list[str]:
        """The report as sentences: the kept examples, and how many more there are of each kind."""
        lines = []
        for kind in KINDS:
            examples = self.examples.get(kind, [])
            lines += [f"{kind}: {defect.says}" for defect in examples]
            more = self.counts[kind] - len(examples)
            if more > 0:
                lines.append(f"{kind}: and {more} more of this kind")
        return lines

"""What the benchmarks have in common: aims that are met or not, and results that must be right.

An aim that is missed is told and no more, for how fast a machine is depends on what else it does.
A wrong result is told and makes the program end with exit code 1.
"""

from __future__ import annotations

import sys
from typing import NoReturn

_wrong: list[str] = []


def at_most(aim: float, value: float, unit: str = "") -> str:
    """The aim, and whether ``value`` meets it."""
    return f"≤ {aim:g}{unit}: {'met' if value <= aim else 'missed'}"


def at_least(aim: float, value: float, unit: str = "") -> str:
    """The aim, and whether ``value`` meets it."""
    return f"≥ {aim:g}{unit}: {'met' if value >= aim else 'missed'}"


def must(holds: bool, says: str) -> None:
    """Note that a result is wrong unless it holds; ``says`` is what should hold."""
    if not holds:
        _wrong.append(says)


def end() -> NoReturn:
    """End the program: with 1, and what is wrong, if any result is."""
    for says in _wrong:
        print(f"WRONG: {says}", file=sys.stderr)
    sys.exit(1 if _wrong else 0)

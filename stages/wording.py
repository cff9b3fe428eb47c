"""Numbers in sentences: as few digits as tell the story, as many as it needs."""

from __future__ import annotations

import math

_MOST_DIGITS = 9


def apart(value: float, limit: float, digits: int) -> str:
    """``value`` with ``digits`` decimals, or as many more as tell it from ``limit``.

    A value that is compared with a limit and told as equal to it would contradict its verdict.
    """
    value, limit = float(value), float(limit)
    if value != limit and math.isfinite(value):
        while digits < _MOST_DIGITS and f"{value:.{digits}f}" == f"{limit:.{digits}f}":
            digits += 1
    return f"{value:.{digits}f}"

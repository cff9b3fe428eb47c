"""Every test file is in a room, so that a change of one room is tried with that room's tests."""

from __future__ import annotations

from pathlib import Path

import rooms


def test_every_test_file_is_in_a_room_and_every_room_has_one() -> None:
    assert rooms.problem(Path(__file__).parent) == ""

"""Pictures of differences: what A has more of is cyan, what B has more of is yellow."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import rerun as rr

from workbench.difference_pictures import (
    LEGEND,
    difference_view,
    has_picture,
    log_difference,
    span_of,
)
from workbench.differences import Difference, difference_of
from workbench.stage import Artifact

MASK = Artifact("mask", "bool", "H W")
LABELS = Artifact("labels", "int32", "H W", names_regions=True)
MAP = Artifact("map", "float32", "H W", "mm")

CYAN, YELLOW, GREY, MAGENTA = (60, 205, 235), (250, 205, 50), (150, 150, 158), (225, 90, 220)
VIOLET, GREEN = (150, 80, 235), (60, 190, 90)


class Recorder:
    """Keeps what is logged, by path and by the name of the archetype."""

    def __init__(self) -> None:
        self.logged: dict[tuple[str, str], Any] = {}
        self.static: set[tuple[str, str]] = set()

    def log(self, path: str, entity: Any, static: bool = False) -> None:
        key = (path, type(entity).__name__)
        self.logged[key] = entity
        if static:
            self.static.add(key)


def values(batch: Any) -> Any:
    return batch.as_arrow_array().to_pylist()


def logged(difference: Difference) -> Recorder:
    recorder = Recorder()
    log_difference(recorder, "d", difference)
    return recorder


def pixels(recorder: Recorder, path: str, archetype: str, dtype: Any) -> np.ndarray:
    image = recorder.logged[path, archetype]
    (shape,) = values(image.format)
    (buffer,) = values(image.buffer)
    raw = np.frombuffer(bytes(buffer), dtype)
    return raw.reshape(shape["height"], shape["width"])


def rgb(packed: int) -> tuple[int, int, int]:
    return packed >> 24, packed >> 16 & 255, packed >> 8 & 255


def classes(recorder: Recorder, path: str) -> dict[int, tuple[str, tuple[int, int, int], int]]:
    """Number to name, colour and opacity."""
    (context,) = values(recorder.logged[path, "AnnotationContext"].context)
    found = {}
    for entry in context:
        info = entry["class_description"]["info"]
        found[entry["class_id"]] = (info["label"], rgb(info["color"]), info["color"] & 255)
    return found


@pytest.mark.parametrize(("artifact", "same"), [(MASK, GREY), (LABELS, (58, 58, 64))])
def test_states_name_who_has_what_in_the_legends_colours(
    artifact: Artifact, same: tuple[int, int, int]
) -> None:
    dtype = bool if artifact is MASK else np.int32
    a, b = np.array([[1, 1, 0, 0]] * 2, dtype), np.array([[1, 0, 1, 0]] * 2, dtype)
    recorder = logged(difference_of(artifact, a, b))
    named = classes(recorder, "d/states")
    states = pixels(recorder, "d/states", "SegmentationImage", np.uint8)
    assert [named[int(state)][:2] for state in states[0]] == [
        ("the same in both", same),
        ("only in A", CYAN),
        ("only in B", YELLOW),
        ("in neither", (14, 14, 16)),
    ]
    assert states.shape == (2, 4)
    assert named[4][:2] == ("another in B", MAGENTA)
    assert ("d/states", "AnnotationContext") in recorder.static
    assert ("d/states", "SegmentationImage") not in recorder.static


def test_a_map_is_drawn_as_b_minus_a_from_cyan_to_yellow_about_zero() -> None:
    a = np.array([[1, 5, 0.5], [2, np.nan, np.nan], [3, 3, 3]], np.float32)
    b = np.array([[3, 1, 0.5], [np.nan, 7, np.nan], [3, 3, 3]], np.float32)
    recorder = logged(difference_of(MAP, a, b))
    drawn = pixels(recorder, "d/values", "DepthImage", np.float32)
    np.testing.assert_array_equal(drawn, [[2, -4, 0], [0, 0, 0], [0, 0, 0]])
    image = recorder.logged["d/values", "DepthImage"]
    assert values(image.depth_range) == [[-5, 5]]  # 4, rounded up to 1, 2 or 5
    assert values(image.meter) == [1]
    assert (
        image.colormap.as_arrow_array()
        == rr.components.ColormapBatch(["cyantoyellow"]).as_arrow_array()
    )
    named = classes(recorder, "d/known")
    known = pixels(recorder, "d/known", "SegmentationImage", np.uint8)
    assert [named[int(k)][0] for k in known[1]] == [
        "known only in A",
        "known only in B",
        "unknown in both",
    ]
    assert [named[int(k)][1] for k in known[1]] == [VIOLET, GREEN, (62, 62, 70)]
    # What is known in both lets the values through.
    assert named[int(known[0, 0])][0] == "known in both" and named[int(known[0, 0])][2] == 0


def test_the_scale_has_the_greater_in_b_above_and_the_greater_in_a_below() -> None:
    signed = np.zeros((100, 200), np.float32)
    signed[:50] = -0.3
    recorder = logged(difference_of(MAP, 0 * signed, signed))
    ticks = recorder.logged["d/scale/ticks", "Points2D"]
    heights = [y for _, y in values(ticks.positions)]
    assert values(ticks.labels) == ["+0.5", "0", "−0.5"]
    assert heights == sorted(heights) and heights[0] == 0
    assert heights[1] == pytest.approx(45) and heights[2] == pytest.approx(86)
    bar = recorder.logged["d/scale", "LineStrips2D"]
    strips, colours = values(bar.strips), [rgb(c) for c in values(bar.colors)]
    assert len(strips) == len(colours) == 48
    assert strips[0][0] == [210, 0] and strips[-1][1] == pytest.approx([210, 99])
    for strip, after in pairwise(strips):
        assert strip[0][1] < strip[1][1] == after[0][1]
    assert colours[0] == (250, 225, 60) and colours[-1] == (60, 220, 235)
    red = [c[0] for c in colours]
    blue = [c[2] for c in colours]
    assert min(range(48), key=lambda k: sum(colours[k])) in (23, 24)
    assert red[5] > blue[5] and red[-6] < blue[-6]
    assert values(bar.radii) == [4]


def test_what_does_not_differ_is_cleared() -> None:
    for difference in (Difference("map", 0, 4), Difference("object", 2, says="x")):
        assert not has_picture(difference)
        recorder = logged(difference)
        assert list(recorder.logged) == [("d", "Clear")]
        assert values(recorder.logged["d", "Clear"].is_recursive) == [True]


def test_a_view_has_room_for_the_scale_of_a_map_alone() -> None:
    a = np.zeros((50, 80), np.float32)
    for artifact, right in ((MASK, 80), (MAP, 1.42 * 80)):
        found = difference_of(artifact, a.astype(artifact.dtype), (a + 1).astype(artifact.dtype))
        assert has_picture(found)
        view = difference_view("d/x", "title", found)
        assert (view.origin, view.name) == ("d/x", "title")
        (bounds,) = values(view.properties["VisualBounds2D"].range)
        assert bounds["x_range"] == pytest.approx([0, right])
        assert bounds["y_range"] == pytest.approx([-1, 51])
    assert "VisualBounds2D" not in difference_view("d", "t", Difference("map", 0)).properties


@pytest.mark.parametrize(
    ("greatest", "span"),
    [
        (0.9, 1), (1, 1), (1.1, 2), (2, 2), (2.1, 5), (5, 5), (5.1, 10), (10, 10), (11, 20),
        (0.003, 0.005), (7e6, 1e7), (1e-9, 1e-9),
    ],
)  # fmt: skip
@pytest.mark.parametrize("sign", [1, -1])
def test_the_scale_ends_at_the_next_of_one_two_and_five(
    greatest: float, span: float, sign: int
) -> None:
    signed = np.full((4, 4), sign * greatest, np.float32)
    assert span_of(signed) == pytest.approx(span, rel=1e-6)


def test_the_scale_holds_ninety_five_percent_of_what_differs() -> None:
    signed = np.full(100, 0.7, np.float32)
    signed[:4] = -900
    assert span_of(signed) == 1
    signed[:6] = -900
    assert span_of(signed) == 1000
    # What does not differ, and what is not finite, has no say.
    assert span_of(np.append(np.append(signed[6:], np.zeros(9999)), np.inf)) == 1
    for nothing in (np.zeros((3, 3)), np.full(2, np.inf), np.zeros(0)):
        assert span_of(nothing.astype(np.float32)) == 1


def test_the_legend_says_the_colours_in_words() -> None:
    for words in (
        "**cyan** only in A, or greater in A",
        "**yellow** only in B, or greater in B",
        "**violet** known only in A",
        "**green** known only in B",
    ):
        assert words in LEGEND

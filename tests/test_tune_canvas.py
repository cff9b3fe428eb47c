"""What a live bench draws: only what has changed, and which pixel a click is on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb

import workbench
from workbench.tune.canvas import Canvas, _under, live_recording
from workbench.tune.frames import SessionFrames
from workbench.tune.live import LiveBench


class Drawn:
    """A live bench on the committed recording, and the bytes that went to the viewer."""

    def __init__(self, scene: Path, **options: Any) -> None:
        self.session = workbench.open(scene, **options)
        self.bench = LiveBench(self.session.pipeline, SessionFrames(self.session))
        recording = live_recording("canvas test")
        self.pieces = rr.binary_stream(recording)
        self.sent: list[int] = []
        self.canvas = Canvas(self.session.pipeline, recording, self._flush)
        self.bench.display = self.canvas
        self.bench.start()
        assert self.bench.wait(60)

    def _flush(self) -> None:
        self.sent.append(len(self.pieces.read(flush=True) or b""))

    def bytes_of(self, change: Any) -> int:
        """What a change sends."""
        self.sent.clear()
        change()
        assert self.bench.wait(60)
        return sum(self.sent)


@pytest.fixture(scope="module")
def drawn(scene: Path) -> Iterator[Drawn]:
    made = Drawn(scene)
    yield made
    made.bench.close()


def test_only_what_changed_is_drawn_again(drawn: Drawn) -> None:
    bench = drawn.bench
    whole = drawn.bytes_of(bench.redraw)
    nothing = drawn.bytes_of(lambda: bench.mark(3, 4))
    edges = drawn.bytes_of(lambda: bench.set({"linked_edges.cone_deg": 41.0}))
    assert edges < 0.7 * whole
    assert nothing < 0.2 * whole


def test_a_click_is_on_the_pixel_below_it(drawn: Drawn) -> None:
    canvas = drawn.canvas
    assert canvas.pictures()["linked_edges/linked"] == (256, 256)
    for entity in (
        "/linked_edges/linked",
        "/linked_edges/linked/terminators",
        "/depth_cloud/depth/values",
        "/depth_cloud/depth/bar",
        "/recorded/near",
    ):
        assert canvas.pixel_of(entity, [17.9, 0.2, None]) == (17, 0), entity
        assert canvas.pixel_of(entity, [300.0, 5.0, None]) is None
        assert canvas.pixel_of(entity, [-0.2, 5.0, None]) is None
    assert canvas.pixel_of("/edge_stack/histogram", [17.9, 0.2, None]) is None
    assert canvas.pixel_of("/world/cloud", [0.1, 0.2, 0.7]) is None
    assert canvas.pixel_of("/linked_edges/linked", [None, 3.0]) is None
    assert canvas.pixel_of("/nothing", [3.0, 3.0]) is None


def test_pictures_of_a_stage_that_fails_are_cleared(drawn: Drawn) -> None:
    bench = drawn.bench
    bench.set({"edge_stack.lowest": 40.0})
    assert bench.wait(60)
    run = bench.snapshot().run
    assert run is not None and "edge_stack" in {f.stage for f in run.failures}
    assert not [path for path in drawn.canvas.pictures() if path.startswith("edge_stack")]
    assert "depth_cloud/depth/values" in drawn.canvas.pictures()
    bench.undo()
    assert bench.wait(60)
    assert "edge_stack/low" in drawn.canvas.pictures()


def test_pictures_that_fail_are_told_beside_the_stage(
    drawn: Drawn, monkeypatch: pytest.MonkeyPatch
) -> None:
    def log(*_: Any) -> None:
        raise ValueError("no ink")

    stage = drawn.bench.stages["focus_maps"]
    with monkeypatch.context() as broken:
        broken.setattr(stage, "log", log, raising=False)
        drawn.bench.redraw()
        assert drawn.bench.wait(60)
        assert drawn.canvas.troubles == {"focus_maps": "its pictures: ValueError: no ink"}
        assert "linked_edges/linked" in drawn.canvas.pictures()
    drawn.bench.redraw()
    assert drawn.bench.wait(60)
    assert not drawn.canvas.troubles


def test_differences_and_sides_have_layers_of_their_own(drawn: Drawn) -> None:
    bench = drawn.bench
    bench.pin("A")
    bench.set({"linked_edges.min_weight": 100.0})
    bench.show("beside")
    assert bench.wait(60)
    pictures = drawn.canvas.pictures()
    assert pictures["A/linked_edges/linked"] == pictures["B/linked_edges/linked"] == (256, 256)
    bench.show("difference")
    assert bench.wait(60)
    found = drawn.canvas._differences["linked_edges"]["edges_linked"]
    assert not found.same and found.states is not None
    a, b = (bench._under[name][1].artifacts["edges_linked"] for name in "AB")
    assert found.differing == int(np.count_nonzero(a != b))
    assert drawn.canvas._differences["edge_stack"]["edges_low"].same
    story_a = bench.story(100, 100, "A")
    assert story_a.x == 100
    bench.show("live")
    bench.unpin("A")
    bench.undo()
    assert bench.wait(60)


def test_views_move_under_a_prefix_whole() -> None:
    inner = rrb.Spatial2DView(
        origin="/stage/picture",
        contents=["$origin/**", "+ /world/cloud/**", "- /world/noise"],
        overrides={"stage/picture/lines": rr.LineStrips2D.from_fields(radii=2.0)},
    )
    _under(rrb.Vertical(inner), "A")
    assert inner.origin == "A/stage/picture"
    assert inner.contents == ["+ $origin/**", "+ /A/world/cloud/**", "- /A/world/noise"]
    assert list(inner.visualizer_overrides) == ["A/stage/picture/lines"]
    _under(inner, "")
    assert inner.origin == "A/stage/picture"

"""What a live bench draws: only what has changed, and which pixel a click is on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from rerun.chunk import RrdReader
from waiting import PATIENCE_S

import workbench
from workbench.tune.canvas import Canvas, _under, live_recording
from workbench.tune.frames import SessionFrames
from workbench.tune.live import LiveBench


class Drawn:
    """A live bench on the committed recording, and what went to the viewer."""

    def __init__(self, scene: Path, folder: Path) -> None:
        self.folder = folder
        self.session = workbench.open(scene)
        self.bench = LiveBench(self.session.pipeline, SessionFrames(self.session))
        recording = live_recording("canvas test")
        self.stream = rr.binary_stream(recording)
        self.pieces: list[bytes] = []
        self.canvas = Canvas(self.session.pipeline, recording, self._flush)
        self.bench.display = self.canvas
        self.bench.start()
        assert self.bench.wait(PATIENCE_S)

    def _flush(self) -> None:
        self.pieces.append(self.stream.read(flush=True) or b"")

    def entities(self, change: Callable[[], None]) -> set[str]:
        """The entities that a change draws."""
        self.pieces.clear()
        change()
        assert self.bench.wait(PATIENCE_S)
        found = set()
        for piece in filter(None, self.pieces):
            path = self.folder / "piece.rrd"
            path.write_bytes(piece)
            reader = RrdReader(path)
            # A piece may hold a layout alone.
            if reader.recordings():
                found |= {chunk.entity_path.strip("/") for chunk in reader.stream()}
        return found - {"__properties"}


@pytest.fixture(scope="module")
def drawn(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drawn]:
    made = Drawn(scene, tmp_path_factory.mktemp("drawn"))
    yield made
    made.bench.close()


def owners(entities: set[str]) -> set[str]:
    return {entity.partition("/")[0] for entity in entities}


STAGES = [
    *("registration", "focus_maps", "depth_cloud", "edge_stack"),
    *("linked_edges", "region_features", "recognition", "pose_frames"),
]


def test_only_what_changed_is_drawn_again(drawn: Drawn) -> None:
    bench = drawn.bench
    whole = drawn.entities(bench.redraw)
    # The cloud lies in the world, which has a camera with its image.
    assert owners(whole) == {*STAGES, "recorded", "world"}
    assert whole >= set(drawn.canvas.pictures())
    # A mark is drawn on every picture, and no picture with it.
    marks = drawn.entities(lambda: bench.mark(3, 4))
    assert marks == {f"{picture}/asked_pixel" for picture in drawn.canvas.pictures()}
    # A parameter: its stage and what is downstream of it, all of theirs.
    changed = drawn.entities(lambda: bench.set({"linked_edges.cone_deg": 41.0}))
    downstream = STAGES[STAGES.index("linked_edges") :]
    assert changed == {entity for entity in whole if entity.partition("/")[0] in downstream}
    assert drawn.entities(lambda: bench.set({"linked_edges.cone_deg": 41.0})) == set()
    # Back again is a change as any other; another frame is everything.
    assert owners(drawn.entities(bench.undo)) == set(downstream)
    assert owners(drawn.entities(lambda: bench.go_to(1))) == owners(whole)
    bench.go_to(0)
    assert bench.wait(PATIENCE_S)


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
    assert bench.wait(PATIENCE_S)
    run = bench.snapshot().run
    assert run is not None and "edge_stack" in {f.stage for f in run.failures}
    assert not [path for path in drawn.canvas.pictures() if path.startswith("edge_stack")]
    assert "depth_cloud/depth/values" in drawn.canvas.pictures()
    bench.undo()
    assert bench.wait(PATIENCE_S)
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
        assert drawn.bench.wait(PATIENCE_S)
        assert drawn.canvas.troubles == {"focus_maps": "its pictures: ValueError: no ink"}
        assert "linked_edges/linked" in drawn.canvas.pictures()
    drawn.bench.redraw()
    assert drawn.bench.wait(PATIENCE_S)
    assert not drawn.canvas.troubles


def test_differences_and_sides_have_layers_of_their_own(drawn: Drawn) -> None:
    bench = drawn.bench
    bench.pin("A")
    bench.set({"linked_edges.min_weight": 100.0})
    bench.show("beside")
    assert bench.wait(PATIENCE_S)
    pictures = drawn.canvas.pictures()
    assert pictures["A/linked_edges/linked"] == pictures["B/linked_edges/linked"] == (256, 256)
    bench.show("difference")
    assert bench.wait(PATIENCE_S)
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
    assert bench.wait(PATIENCE_S)


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

"""The live bench in Rerun's native viewer: tensor views as sliders."""

from __future__ import annotations

from pathlib import Path

import pytest
from conftest import Command
from waiting import PATIENCE_S, until

import workbench
from workbench.stage import StageParameters, knob
from workbench.tune.canvas import live_recording
from workbench.tune.frames import SessionFrames
from workbench.tune.live import LiveBench
from workbench.tune.native import NativePanel, active_tab, indices, slider_of
from workbench.viewer import native_viewer
from workbench_stages.linked_edges import LinkedEdges
from workbench_stages.registration import Registration


class Odd(StageParameters):
    free: float = knob(1.0, "It has no bounds.")
    word: str = knob("a", "It is a word.")
    many: int = knob(3, "It has more values than places.", low=0, high=100_000)
    fine: float = knob(0.5, "It has no step.", low=0.25, high=0.75)


def test_every_bounded_knob_has_a_slider_with_its_default_on_it() -> None:
    for stage in (LinkedEdges, Registration):
        for name, declared in stage.Parameters.knobs().items():
            slider = slider_of(stage.name, declared)
            assert slider is not None and slider.path == f"knobs/{stage.name}/{name}"
            # The nearest place is the default itself, or as near as two hundred places allow.
            place = slider.values[slider.index_of(declared.default)]
            if declared.kind in ("bool", "choice", "int"):
                assert place == declared.default
            else:
                assert declared.low is not None and declared.high is not None
                assert abs(place - declared.default) <= (declared.high - declared.low) / 200 + 1e-9
            for value in slider.values:
                stage.Parameters(**{name: value})


def test_odd_knobs() -> None:
    knobs = Odd.knobs()
    assert slider_of("odd", knobs["free"]) is None and slider_of("odd", knobs["word"]) is None
    many = slider_of("odd", knobs["many"])
    assert many is not None and len(many.values) <= 201
    assert all(isinstance(value, int) for value in many.values)
    fine = slider_of("odd", knobs["fine"])
    assert fine is not None and (fine.values[0], fine.values[-1]) == (0.25, 0.75)


def test_a_blueprint_of_something_else_has_no_sliders() -> None:
    views = {
        "/view/1": {"ViewBlueprint": {"class_identifier": "Tensor", "space_origin": "stack"}},
        "/view/2": {"ViewBlueprint": {"class_identifier": "2D", "space_origin": "knobs/a/b"}},
        "/container/1": {"ContainerBlueprint": {"container_kind": "Tabs", "contents": "view/1"}},
    }
    assert indices(views) == {} and active_tab(views) is None


@pytest.mark.vulkan
@pytest.mark.process
@pytest.mark.slow
def test_a_slider_of_the_viewer_turns_the_knob(scene: Path) -> None:
    session = workbench.open(scene, until="linked_edges")
    bench = LiveBench(session.pipeline, SessionFrames(session))
    recording = live_recording("native test")
    with native_viewer(headless=True) as (port, child):
        panel = NativePanel(bench, recording, port)
        bench.start()
        bench.focus("linked_edges")
        assert bench.wait(PATIENCE_S)
        client = panel._client

        def stands() -> dict[str, int]:
            return indices(client.get_blueprint().blueprint)

        address = "knobs/linked_edges/min_weight"
        until(lambda: stands().get(address) == 12, "the sliders are there")
        panel.poll()
        assert not bench.settings.changed
        blueprint = client.get_blueprint().blueprint
        assert active_tab(blueprint) == "linked_edges"
        for path, parts in blueprint.items():
            view = parts.get("ViewBlueprint", {})
            if str(view.get("space_origin", "")).strip("/") == address:
                moved = {"dimension": 0, "index": 90}
                chosen = blueprint[f"{path}/TensorSliceSelection"]["TensorSliceSelection"]
                chosen["indices"] = moved
        client.set_blueprint(blueprint, of="recording")

        def turned() -> bool:
            panel.poll()
            return bool(bench.settings.changed)

        until(turned, "the knob follows")
        assert bench.settings.changed == {"linked_edges.min_weight": 90.0}
        assert bench.wait(PATIENCE_S)
        run = bench.snapshot().run
        assert run is not None and run.computed == {"linked_edges"}
        assert child.poll() is None
        bench.close()
        recording.disconnect()


def test_without_a_display_it_is_told(bench: Command, scene: Path) -> None:
    ended = bench("tune", scene, "--native")
    assert ended.code == 1 and "no display" in ended.mistake
    ended = bench("tune", scene, "--native", "--port", "5000")
    assert ended.code == 2 and "--port" in ended.mistake

"""The figures that the committed scene must keep, and how the stages of the segmentation behave."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import workbench
from workbench.pipeline import Run
from workbench.report import RunReport
from workbench.stage import Score
from workbench_stages.edge_stack import EdgeStackStage
from workbench_stages.edges.linking import Step
from workbench_stages.edges.segmentation import link_edges, stack_edges
from workbench_stages.linked_edges import LinkedEdges, windows_up_to

SCENE = Path(__file__).parent.parent / "recordings" / "scene.mcap"


def scored(preset: str, *assignments: str) -> dict[str, Score]:
    session = workbench.open(SCENE, preset=preset, set=assignments)
    report = RunReport(session)
    for run in session.runs():
        report.add(run)
    assert not report.failed
    return {score.name: score for scores in report.scores().values() for score in scores}


@pytest.fixture(scope="module")
def default() -> dict[str, Score]:
    return scored("default")


@pytest.fixture(scope="module")
def box() -> dict[str, Score]:
    return scored("paper")


@pytest.fixture(scope="module")
def runs() -> list[Run]:
    session = workbench.open(SCENE)
    return [run for run, _ in zip(session.runs(), range(3), strict=False)]


@pytest.mark.parametrize(
    ("figure", "at_least", "at_most", "covering"),
    [
        # What noise alone leaves: a figure below that is not measured.
        ("faces' interior rms", 0.15, 0.30, 0.95),
        ("within 4 px of an edge, p95", 1.5, 3.0, 0.80),
        ("normals, mean", 0.3, 1.0, 0.90),
        ("normals, worst", 1.0, 4.0, 0.90),
    ],
)
def test_depth_is_as_good_as_promised(
    default: Mapping[str, Score], figure: str, at_least: float, at_most: float, covering: float
) -> None:
    assert at_least <= default[figure].value <= at_most
    assert covering <= default[figure].coverage < 1


def test_the_table_is_not_off(default: Mapping[str, Score]) -> None:
    assert abs(default["table bias"].value) <= 1.5


def test_windows_that_stop_beat_the_box_at_edges(
    default: Mapping[str, Score], box: Mapping[str, Score]
) -> None:
    figure = "within 4 px of an edge, p95"
    assert default[figure].value < 0.6 * box[figure].value
    assert default["normals, worst"].value < box["normals, worst"].value


@pytest.mark.parametrize(
    ("figure", "at_least"),
    [
        ("linked, precision", 0.95),
        ("linked, recall", 0.97),
        ("faces found (IoU ≥ 0.7)", 0.90),
        ("mean IoU", 0.85),
        ("uncovered faces found", 0.90),
    ],
)
def test_edges_and_regions_are_as_good_as_promised(
    default: Mapping[str, Score], figure: str, at_least: float
) -> None:
    assert default[figure].value >= at_least


@pytest.mark.parametrize(
    ("figure", "note"),
    [
        ("normals, mean", "of 121 faces over 500 px"),
        ("mean IoU", "144 faces over 150 px"),
        ("uncovered mean IoU", "90 faces that nothing covers"),
        ("named rightly", "of 12 frames"),
        ("recognised, 0 to 5 % covered", "of 12 surfaces; 0 misnamed"),
        ("recognised, 5 to 10 % covered", "of 2 surfaces; 0 misnamed"),
        ("rotation left open", "of 12 poses"),
    ],
)
def test_figures_are_of_all_that_the_truth_holds(
    default: Mapping[str, Score], figure: str, note: str
) -> None:
    """How many faces, surfaces and poses there are is the recording's, whatever was found."""
    assert default[figure].note.endswith(note)


@pytest.mark.parametrize(
    ("figure", "value"),
    [
        ("picked part uncovered and named rightly", 1),
        ("named rightly", 1),
        ("wrong names", 0),
        ("rearrange", 0),
        ("recognised, 0 to 5 % covered", 1),
        ("recognised, 5 to 10 % covered", 1),
    ],
)
def test_the_topmost_part_of_every_pile_is_recognised(
    default: Mapping[str, Score], figure: str, value: float
) -> None:
    assert default[figure].value == value


@pytest.mark.parametrize(
    ("figure", "at_most", "covering"),
    [
        ("rotation, mean error", 0.3, 1.0),
        ("rotation, worst error", 1.5, 1.0),
        ("rotation, flat, worst error", 0.6, 0.6),
        ("normal, mean error", 1.0, 1.0),
        ("normal, worst error", 3.0, 1.0),
        ("centroid along the axis, worst error", 1.0, 1.0),
        ("centroid across the axis, mean error", 0.25, 1.0),
        ("centroid across the axis, worst error", 0.6, 1.0),
    ],
)
def test_every_picked_part_lies_where_its_pose_says(
    default: Mapping[str, Score], figure: str, at_most: float, covering: float
) -> None:
    assert 0 < default[figure].value <= at_most
    assert default[figure].coverage >= covering
    assert default["rotation left open"].value == 0


def test_striped_images_alone_still_find_most_faces() -> None:
    striped = scored("default", "registration.intensity=stripes")
    assert striped["linked, precision"].value >= 0.92
    assert striped["faces found (IoU ≥ 0.7)"].value >= 0.75


# -- the stages hold together ---------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stage", "function"), [(EdgeStackStage, stack_edges), (LinkedEdges, link_edges)]
)
def test_a_stage_declares_what_its_function_takes(stage: Any, function: Any) -> None:
    """Every knob is taken, and its default is the function's own, also where that is 0 or false."""
    taken = {name: one.default for name, one in inspect.signature(function).parameters.items()}
    declared = {name: knob.default for name, knob in stage.Parameters.knobs().items()}
    if stage is LinkedEdges:
        # What the stage calls reach are the function's windows; its own reach, the direction's.
        assert windows_up_to(declared.pop("reach")) == taken["windows"]
        assert declared.pop("direction_length") == taken["reach"]
    else:
        # Without one the function takes the greatest threshold from its operator.
        assert (declared.pop("greatest"), taken["greatest"]) == (20.0, None)
    assert declared == {name: taken.get(name, "not taken") for name in declared}
    assert len(declared) >= 9


def test_each_resolution_contains_the_coarser_and_reconstruction_keeps_it(runs: list[Run]) -> None:
    for run in runs:
        a = run.artifacts
        assert not (a["edges_low"] & ~a["edges_medium"]).any()
        assert not (a["edges_medium"] & ~a["edges_high"]).any()
        assert not (a["edges_low"] & ~a["edges_reconstructed"]).any()
        assert not (a["edges_reconstructed"] & ~a["edges_linked"]).any()
        assert not (a["links"] & ~a["edges_linked"]).any()


def test_every_edge_pixel_says_which_step_admitted_it(runs: list[Run]) -> None:
    for run in runs:
        a = run.artifacts
        np.testing.assert_array_equal(a["edge_step"] >= Step.LOW, a["edges_linked"])


def test_the_regions_table_is_of_the_labels(runs: list[Run]) -> None:
    for run in runs:
        labels, regions = run.artifacts["labels"], run.artifacts["regions"]
        counts = np.bincount(labels.ravel(), minlength=len(regions) + 1)[1:]
        np.testing.assert_array_equal(counts, regions["area_px"])
        measured = regions[regions["plane_px"] > 0]
        np.testing.assert_allclose(np.linalg.norm(measured["normal"], axis=1), 1, rtol=1e-6)


def test_regions_come_back_from_an_export_without_pickling(tmp_path: Path, runs: list[Run]) -> None:
    regions = runs[0].artifacts["regions"]
    np.savez(tmp_path / "a.npz", regions=regions)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert file["regions"].dtype == regions.dtype
        assert file["regions"].tobytes() == regions.tobytes()


def test_until_linked_edges_stops_there() -> None:
    session = workbench.open(SCENE, until="linked_edges")
    names = [stage.name for stage in session.pipeline.stages]
    assert names[-1] == "linked_edges"
    assert "region_features" not in names


def test_a_changed_link_leaves_what_is_before_it_alone() -> None:
    first = workbench.open(SCENE)
    frame = next(first.runs()).frame
    again = workbench.open(SCENE, set=["linked_edges.max_cost=9.0"])
    again.pipeline.store = first.pipeline.store
    names = [stage.name for stage in again.pipeline.stages]
    assert again.pipeline.run(frame).computed == set(names[names.index("linked_edges") :])


@pytest.mark.parametrize("x", [0, 100, 255])
def test_every_stage_explains_a_pixel(runs: list[Run], x: int) -> None:
    session = workbench.open(SCENE)
    for stage in session.pipeline.stages:
        parameters = session.pipeline.settings.parameters[stage.name]
        for finding in stage.explain(x, 128, runs[0].artifacts, parameters):
            assert finding.says
            assert finding.parameter is None or finding.parameter in stage.Parameters.model_fields

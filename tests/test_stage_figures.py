"""What a stage says of one frame without truth, and which scorer holds it against truth."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from workbench.plugins import find_stages
from workbench.stage import Score, Stage
from workbench_stages.dfd.score import DepthScorer
from workbench_stages.edges.regions import closed_share
from workbench_stages.edges.scorers import EdgeScorer, RegionScorer
from workbench_stages.matching.scorers import PoseScorer, RecognitionScorer

NAN = np.nan


@pytest.fixture(scope="module")
def stages() -> dict[str, Stage]:
    return dict(find_stages())


def told(stage: Stage, **artifacts: Any) -> list[tuple[str, float, str, Any]]:
    found: list[Score] = list(stage.figures(artifacts))
    return [(one.name, one.value, one.unit, one.better) for one in found]


def test_depth_tells_the_share_that_is_known_and_the_mean_confidence(
    stages: dict[str, Stage],
) -> None:
    relative = np.array([[0.1, NAN, 0.3, 0.4], [NAN, NAN, 0.7, 1.2]], np.float32)
    confidence = np.array([[1, 0, 0.5, 0.5], [0, 0, 1, 0.6]], np.float32)
    assert told(stages["depth_cloud"], depth_relative=relative, confidence=confidence) == [
        ("coverage", 5 / 8, "", "higher"),
        ("confidence", pytest.approx(0.45), "", "higher"),
    ]


@pytest.mark.parametrize(("ends", "left", "share"), [(8, 2, 0.75), (5, 5, 0), (5, 0, 1)])
def test_linking_tells_the_share_of_ends_that_were_linked(
    stages: dict[str, Stage], ends: int, left: int, share: float
) -> None:
    linking = SimpleNamespace(linked=SimpleNamespace(open_ends=[(0, 0)] * left))
    assert told(stages["linked_edges"], terminators=np.zeros((ends, 2)), linking=linking) == [
        ("linked terminators", share, "", "higher")
    ]
    assert told(stages["linked_edges"], terminators=np.zeros((0, 2)), linking=linking) == []


def test_regions_tell_how_many_are_no_background_and_what_the_lines_close(
    stages: dict[str, Stage],
) -> None:
    labels = np.ones((20, 30), np.int32)
    labels[:, 15:] = 2
    labels[:, 14] = 0
    lines = np.zeros((20, 30), bool)
    lines[:, 14] = True
    lines[:5, 5] = lines[:5, 24] = True  # these have one region on both sides
    regions = np.zeros(5, [("background", bool)])
    regions["background"][:2] = True
    assert told(stages["region_features"], labels=labels, region_lines=lines, regions=regions) == [
        ("closed lines", pytest.approx(20 / 30), "", "higher"),
        ("regions", 3, "regions", None),
    ]
    assert math.isnan(closed_share(labels, lines & False))


@pytest.mark.parametrize(("verdict", "picks"), [("pick", 1), ("rearrange", 0)])
def test_recognition_tells_whether_it_picks(
    stages: dict[str, Stage], verdict: str, picks: int
) -> None:
    assert told(stages["recognition"], verdict={"verdict": verdict}) == [
        ("picks", picks, "", "higher")
    ]
    assert told(stages["recognition"], verdict=None) == []


@pytest.mark.parametrize("stage", ["registration", "focus_maps", "edge_stack", "pose_frames"])
def test_the_other_stages_tell_nothing_of_a_frame(stages: dict[str, Stage], stage: str) -> None:
    assert told(stages[stage]) == []


@pytest.mark.parametrize(
    ("stage", "kind"),
    [
        ("registration", type(None)),
        ("focus_maps", type(None)),
        ("depth_cloud", DepthScorer),
        ("edge_stack", EdgeScorer),
        ("linked_edges", EdgeScorer),
        ("region_features", RegionScorer),
        ("recognition", RecognitionScorer),
        ("pose_frames", PoseScorer),
    ],
)
def test_a_stage_is_scored_by_the_scorer_of_what_it_gives(
    stages: dict[str, Stage], stage: str, kind: type
) -> None:
    first, second = stages[stage].scorer(), stages[stage].scorer()
    assert type(first) is kind
    # Every run has one of its own.
    assert first is None or first is not second


def test_each_image_of_edges_is_scored_under_its_own_name(stages: dict[str, Stage]) -> None:
    found: dict[str, str] = {}
    for stage in ("edge_stack", "linked_edges"):
        scorer = stages[stage].scorer()
        assert isinstance(scorer, EdgeScorer)
        found |= scorer.images
    assert found == {
        "edges_high": "before reconstruction",
        "edges_reconstructed": "reconstructed",
        "edges_linked": "linked",
    }

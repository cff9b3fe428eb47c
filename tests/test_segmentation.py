"""The three stages of segmentation as functions, on planted gradients and planted depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from edge_scenes import planted_operator
from stage_outputs import given as whole

from workbench_stages.edge_stack import EdgeStackStage
from workbench_stages.edges import segmentation
from workbench_stages.edges.depth_edges import DepthEdges
from workbench_stages.edges.linking import Step
from workbench_stages.edges.presets import PRESETS
from workbench_stages.edges.regions import region_features
from workbench_stages.edges.segmentation import LinkedResult, StackResult, link_edges, stack_edges
from workbench_stages.linked_edges import LinkedEdges, windows_up_to
from workbench_stages.region_features import RegionFeatures, as_rows

SHAPE = (64, 90)


def stacked(image: np.ndarray, depth: np.ndarray | None = None, **changes: Any) -> StackResult:
    how: dict[str, Any] = {"operator": "planted", "noise_units": False, "small_segment": 1.0}
    with planted_operator():
        return stack_edges(image, depth, **how | changes)


def lines(*rows: tuple[int, int, int, float]) -> np.ndarray:
    """An image of 9 with upright lines (column, top, bottom, value)."""
    image = np.full(SHAPE, 9, np.float32)
    for column, top, bottom, value in rows:
        image[top:bottom, column] = value
    return image


UNSEEN = np.full(SHAPE, np.nan, np.float32)


# -- the stack -------------------------------------------------------------------------------------


def test_thresholds_are_in_grey_levels_or_in_noise() -> None:
    """Ten grey levels on a gradient without noise: its least is a quarter of a level."""
    # Fewer pixels than a level needs to tell its own noise.
    image = lines((20, 10, 28, 100))
    plain = stacked(image)
    assert plain.noise is None
    assert plain.stack.strength[20, 20] == 10
    units = stacked(image, noise_units=True)
    assert units.noise is not None and (units.noise == 0.25).all()
    assert units.stack.strength[20, 20] == 40
    for found in (plain, units):
        np.testing.assert_array_equal(found.edges_low, image != 9)
        np.testing.assert_array_equal(found.gradient.thin, image != 9)
        assert found.depth is None and not found.background.any()


def test_candidates_begin_at_the_least_threshold_in_its_unit() -> None:
    image = lines((20, 10, 28, 100))
    assert not stacked(image, noise_units=True, lowest=40.1, greatest=90).gradient.thin.any()
    assert stacked(image, noise_units=True, lowest=39.9, greatest=90).gradient.thin.any()
    assert stacked(image, lowest=9.0, greatest=90).gradient.thin.any()
    # In grey levels weaker ones than half a level only where the search begins below it.
    for lowest, found in ((2.0, False), (0.1, True)):
        weak = np.zeros(SHAPE, np.float32)
        weak[:, 45:] = 0.3
        stack = stack_edges(weak, operator="gef", noise_units=False, lowest=lowest)
        assert stack.gradient.thin.any() == found


def test_the_greatest_threshold_is_the_operators_unless_given() -> None:
    image = lines((20, 10, 50, 100))
    assert stacked(image).stack.high_thresholds[0] == 10
    assert stacked(image, greatest=15.0).stack.high_thresholds[0] == 15
    assert not stacked(image, greatest=15.0).edges_low.any()


@pytest.mark.parametrize(("unseen", "judged"), [(4, False), (6, True)])
def test_a_twentieth_of_the_image_must_be_unseen_to_tell_the_background(
    unseen: int, judged: bool
) -> None:
    """Four or six of ninety columns, and a bit: 4.4 and 6.7 per cent."""
    depth = np.full(SHAPE, 0.7, np.float32)
    depth[:, :unseen] = np.nan
    found = stacked(lines((20, 10, 50, 9.5)), depth)
    assert bool(found.background[30, 20]) == judged
    assert bool(found.edges_high[30, 20]) != judged
    assert found.stack.edges_high[30, 20]


@pytest.mark.parametrize(
    ("bright", "factor", "background"),
    [(9.8, 1.1, True), (10.0, 1.1, False), (10.0, 1.2, True), (8.0, 0.8, False), (8.0, 0.0, False)],
)
def test_background_is_no_brighter_than_the_factor_times_what_is_not_seen(
    bright: float, factor: float, background: bool
) -> None:
    """Nine is the median of what the depth does not see; noise adds two deviations, 0.5."""
    image = lines((20, 10, 50, bright))
    for noise_units, added in ((False, 0.0), (True, 0.5)):
        found = stacked(
            image + np.float32(added) * (image != 9), UNSEEN, background_factor=factor,
            noise_units=noise_units,
        )  # fmt: skip
        if noise_units and factor == 0.8:
            continue
        assert bool(found.background[30, 20]) == background
        for name in ("edges_low", "edges_medium", "edges_high"):
            assert bool(getattr(found, name)[30, 20]) != background
            assert getattr(found.stack, name)[30, 20]
    assert not stacked(image, UNSEEN, use_depth=False).background.any()


def test_depth_strengthens_the_gradient_by_its_evidence() -> None:
    rng = np.random.default_rng(0)
    depth = 0.7 + 2e-4 * rng.normal(size=SHAPE)
    depth[:, 45:] += 0.01
    image = lines((45, 20, 29, 100), (15, 20, 29, 100))
    found = stacked(image, depth, depth_gain=0.5, depth_full=6.0)
    assert found.depth is not None
    share = np.minimum(found.depth.strength / 6, 1)
    wanted = np.where(image != 9, 10 * (1 + 0.5 * share), 0)
    np.testing.assert_allclose(found.stack.strength, wanted, rtol=1e-5)
    assert found.stack.strength[25, 45] == pytest.approx(15)
    assert found.stack.strength[20:29, 15].mean() < 14
    assert stacked(image, depth).depth is None
    assert stacked(image, depth, depth_gain=0.5, use_depth=False).depth is None
    with_noise = stacked(image, depth, depth_gain=0.5, noise_units=True)
    np.testing.assert_allclose(with_noise.stack.strength, 4 * wanted, rtol=1e-5)


# -- linking with a background ---------------------------------------------------------------------

PLAIN: dict[str, Any] = {
    "use_evidence": False, "corners": 0.0, "use_depth": False, "min_weight": 0.0,
    "min_length": 1.0,
}  # fmt: skip


def linked(given: StackResult, depth: np.ndarray | None = None, **changes: Any) -> LinkedResult:
    return link_edges(given, depth, **PLAIN | changes)


def test_a_link_is_an_edge_where_both_its_ends_are() -> None:
    """Bright to bright, dark to bright, and both to the image's border."""
    image = lines((20, 3, 20, 100), (20, 24, 40, 100), (60, 3, 20, 8), (60, 24, 40, 100))
    given = stacked(image, UNSEEN)
    done = linked(given)
    assert done.lines[:40, 20].all() and done.lines[:40, 60].all()
    assert done.edges[:40, 20].all()
    assert not done.edges[:24, 60].any()
    assert done.edges[24:40, 60].all()
    np.testing.assert_array_equal(done.links, done.edges & (image == 9))
    np.testing.assert_array_equal(done.edges_reconstructed, image == 100)
    assert (done.step[:24, 60] == Step.BACKGROUND).all()
    np.testing.assert_array_equal(done.value[:24, 60], given.gradient.bright[:24, 60])
    assert (done.step[20:24, 20] == Step.LINK).all()
    assert (done.step[:3, 20] == Step.BORDER).all()
    np.testing.assert_array_equal(done.step >= Step.LOW, done.edges)
    assert not done.creases.any() and not done.feet.any() and done.walls is None


def test_an_edge_that_hangs_on_the_background_by_several_links_stays_one_chain() -> None:
    """Rounds go on from what earlier ones kept: near links first, then farther ones."""
    image = lines((20, 4, 16, 8), (20, 19, 28, 100), (20, 34, 44, 100), (20, 53, 60, 8))
    done = linked(stacked(image, UNSEEN), border=False)
    assert done.lines[4:60, 20].all()
    np.testing.assert_array_equal(np.flatnonzero(done.edges[:, 20]), np.arange(19, 44))


def test_a_weight_is_counted_from_the_low_threshold() -> None:
    """Strength 10 over a low threshold of 2 counts three at most: five pixels weigh 15."""
    scale = np.sqrt(SHAPE[0] * SHAPE[1]) / 256
    image = lines((20, 3, 40, 100))
    given = stacked(image, lowest=2.0, greatest=9.0)
    assert given.stack.low_threshold == 2.0
    high_only = StackResult(
        given.gradient, None, given.background, None,
        type(given.stack)(
            given.stack.edges_low & False, given.stack.edges_medium & False, given.stack.edges_high,
            given.stack.strength, given.stack.segment_peak, given.stack.low_threshold,
            given.stack.high_thresholds, given.stack.thresholds, given.stack.small_pixels,
            given.stack.large_pixels, given.stack.ratio, True,
        ),
        given.edges_low & False, given.edges_medium & False, given.edges_high,
    )  # fmt: skip
    for weight, kept in ((37 * 3 - 1, True), (37 * 3 + 1, False)):
        done = linked(high_only, min_weight=weight / scale, border=False)
        assert done.edges.any() == kept


# -- what depth adds -------------------------------------------------------------------------------


def planted_depth(monkeypatch: pytest.MonkeyPatch, thin: np.ndarray) -> list[np.ndarray]:
    """Ridges of the depth as given; returns the places that were asked for."""
    asked: list[np.ndarray] = []

    def found(_: np.ndarray, where: np.ndarray) -> DepthEdges:
        asked.append(where)
        strength = np.full(thin.shape, 7.5, np.float32)
        return DepthEdges(strength, thin, (1.0, 1.0), (1.0, 1.0))

    monkeypatch.setattr(segmentation, "depth_edges", found)
    return asked


@pytest.mark.parametrize(
    ("shape", "clearance", "length"),
    [((256, 256), 8, 6), ((512, 512), 16, 12), ((1024, 256), 16, 12), ((128, 512), 8, 6),
     ((90, 120), 8, 6)],
)  # fmt: skip
def test_ridges_keep_clear_of_edges_and_are_long_enough_at_that_size(
    shape: tuple[int, int], clearance: int, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Upright ridges beside an upright edge: too near, too short, and just right."""
    image = np.full(shape, 9, np.float32)
    image[5:80, 40] = 100
    thin = np.zeros(shape, bool)
    thin[5 : 5 + length, 40 - clearance] = True
    thin[25 : 25 + length, 40 - clearance - 1] = True
    thin[45 : 45 + length - 1, 40 + clearance + 1] = True
    asked = planted_depth(monkeypatch, thin)
    depth = np.full(shape, 0.7, np.float32)
    with planted_operator():
        given = stack_edges(image, operator="planted", noise_units=False, small_segment=1.0)
    how = PLAIN | {"use_depth": True, "windows": (2.0,), "border": False}
    done = link_edges(given, depth, **how, crease_clearance=8.0, crease_length=6.0)
    wanted = np.zeros(shape, bool)
    wanted[25 : 25 + length, 40 - clearance - 1] = True
    np.testing.assert_array_equal(done.creases, wanted)
    assert (done.step[wanted] == Step.CREASE).all()
    assert (done.value[wanted] == 7.5).all()
    assert done.edges[wanted].all() and done.lines[wanted].all()
    assert not done.links[wanted].any()
    # Ridges are looked for so far from edges that the greatest within their reach is known.
    away = np.abs(np.arange(shape[1]) - 40)[None].repeat(shape[0], 0)[40]
    scale = clearance / 8
    np.testing.assert_array_equal(asked[0][40], away > 3 * scale)


def test_without_any_edge_every_ridge_is_clear(monkeypatch: pytest.MonkeyPatch) -> None:
    thin = np.zeros(SHAPE, bool)
    thin[10:30, 40] = True
    planted_depth(monkeypatch, thin)
    depth = np.full(SHAPE, 0.7, np.float32)
    done = linked(stacked(lines()), depth, use_depth=True, border=False)
    np.testing.assert_array_equal(done.creases, thin)
    np.testing.assert_array_equal(done.edges, thin)
    assert not linked(stacked(lines()), depth, use_depth=False).edges.any()
    assert not linked(stacked(lines()), None, use_depth=True).edges.any()


def test_ends_of_ridges_are_linked_as_other_ends_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """The links of both passes are told, those of the second with rounds of their own."""
    thin = np.zeros(SHAPE, bool)
    thin[30:50, 20] = True
    planted_depth(monkeypatch, thin)
    image = lines((20, 2, 10, 100), (20, 13, 20, 100))
    depth = np.full(SHAPE, 0.7, np.float32)
    done = linked(stacked(image), depth, use_depth=True, windows=(3.0, 6.0, 12.0), border=False)
    assert done.edges[2:50, 20].all()
    rounds = {
        (int(a[1]), int(b[1])): int(r)
        for a, b, r in zip(
            done.linked.links.start, done.linked.links.end, done.linked.links.round, strict=True
        )
    }
    # Four pixels are in the window of six, the second of three; eleven in the last one of the
    # second pass, which leaves the nearest window out.
    assert rounds[9, 13] == rounds[13, 9] == 1
    assert rounds[19, 30] == rounds[30, 19] == 3 + 1
    # The terminators that are told are those before any linking.
    assert sorted(done.linked.terminators[:, 1].tolist()) == [2, 9, 13, 19]


def test_an_unknown_preset_is_refused_and_the_papers_is_what_it_says() -> None:
    with pytest.raises(ValueError, match="unknown preset 'fast': expected one of paper, default"):
        segmentation.segment(np.zeros((8, 8), np.uint8), preset="fast")
    paper = PRESETS["paper"]
    assert paper["edge_stack"]["operator"] == "gef"
    assert paper["edge_stack"]["noise_units"] is paper["edge_stack"]["use_depth"] is False
    assert paper["linked_edges"]["corners"] == paper["linked_edges"]["min_weight"] == 0
    assert paper["linked_edges"]["use_evidence"] is paper["linked_edges"]["use_depth"] is False
    assert EdgeStackStage.presets == {"paper": paper["edge_stack"]}
    assert LinkedEdges.presets == {"paper": paper["linked_edges"]}


# -- the stages ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reach", "windows"),
    [
        (15.0, (3, 6, 9, 12, 15)), (16.0, (3, 6, 9, 12, 15, 16)), (3.0, (3,)), (4.0, (3, 4)),
        (6.0, (3, 6)),
    ],
)  # fmt: skip
def test_partners_are_looked_for_in_steps_of_three_up_to_the_reach(
    reach: float, windows: tuple[float, ...]
) -> None:
    assert windows_up_to(reach) == windows
    assert windows_up_to(1.0) == (2.0,)


@pytest.mark.parametrize("stage", [EdgeStackStage, LinkedEdges, RegionFeatures])
def test_the_stages_declare_what_the_functions_default_to(stage: Any) -> None:
    """One meaning for a parameter, whichever way the mathematics is called."""
    import inspect

    from workbench_stages.edges.regions import closed_regions

    functions = {
        EdgeStackStage: [stack_edges], LinkedEdges: [link_edges],
        RegionFeatures: [closed_regions, region_features],
    }[stage]  # fmt: skip
    defaults = {
        name: p.default
        for function in functions
        for name, p in inspect.signature(function).parameters.items()
        if p.default is not inspect.Parameter.empty
    }
    declared = stage.Parameters().model_dump()
    if stage is LinkedEdges:
        assert windows_up_to(declared.pop("reach")) == defaults["windows"]
        assert declared.pop("direction_length") == defaults["reach"]
    if stage is EdgeStackStage:
        assert declared.pop("greatest") == 20
    assert {name: defaults[name] for name in declared} == declared


def test_the_row_of_a_region_holds_its_features_under_their_names() -> None:
    labels = np.zeros((30, 40), np.int32)
    labels[2:12, 3:23], labels[15:25, 5:9] = 1, 2
    table = region_features(labels)
    rows = as_rows(table)
    assert rows["label"].tolist() == [1, 2]
    for name in rows.dtype.names[1:]:
        np.testing.assert_array_equal(rows[name], getattr(table, name))


@pytest.mark.parametrize("top", [255.0, 1023.0, np.inf])
def test_the_stage_of_the_stack_takes_the_full_scale_of_the_sensor(top: float) -> None:
    image = np.full((40, 60), 20, np.float32)
    image[:, 30:] = 60
    inputs = {"intensity": image, "full_scale": top, "depth_m": None, "depth_relative": None}
    out = EdgeStackStage().compute(inputs, EdgeStackStage.Parameters(noise_units=False))
    scale = 1.0 if np.isinf(top) else 255 / top
    assert out["gradient"].max() == pytest.approx(40 * scale, rel=1e-3)
    for name in ("edges_low", "edges_medium", "edges_high"):
        assert out[name] is getattr(out["edge_choice"], name)


def test_the_stage_of_linking_looks_as_far_as_it_is_told() -> None:
    image = lines((20, 4, 20, 100), (20, 27, 40, 100))
    given = stacked(image)
    for reach, found in ((8.0, True), (7.0, False)):
        inputs = {"edge_choice": given, "depth_m": None, "depth_relative": None}
        parameters = LinkedEdges.Parameters(reach=reach, border=False, use_evidence=False)
        out = LinkedEdges().compute(inputs, parameters)
        assert bool(out["edges_linked"][20:27, 20].all()) == found
        np.testing.assert_array_equal(out["links"], out["edges_linked"] & (image == 9))
        np.testing.assert_array_equal(out["edges_reconstructed"], image != 9)
        assert len(out["terminators"]) == len(out["terminator_directions"]) == 4


def test_relative_depth_gives_regions_no_planes() -> None:
    """Without metres there is no elevation, however well the relative depth is known."""
    image = lines((45, 0, 64, 100))
    done = linked(stacked(image))
    inputs: dict[str, Any] = {
        "region_lines": done.lines, "intensity": image, "edge_choice": stacked(image),
        "linking": done, "depth_m": None, "depth_relative": np.full(SHAPE, 0.4, np.float32),
        "near_camera": None,
    }  # fmt: skip
    regions = whole(RegionFeatures(), inputs, RegionFeatures.Parameters())["regions"]
    assert len(regions) == 2
    assert np.isnan(regions["elevation_m"]).all() and (regions["plane_px"] == 0).all()

    class Seen:
        width, height, K = SHAPE[1], SHAPE[0], np.diag([900.0, 900.0, 1.0])

    metric = inputs | {"depth_m": np.full(SHAPE, 0.7, np.float32), "near_camera": Seen()}
    regions = whole(RegionFeatures(), metric, RegionFeatures.Parameters(inset=3.0))["regions"]
    assert np.isfinite(regions["elevation_m"]).all()
    small = whole(RegionFeatures(), metric, RegionFeatures.Parameters(inset=9.0))["regions"]
    assert (small["plane_px"] < regions["plane_px"]).all()

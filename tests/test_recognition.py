"""Every criterion of recognition at both sides of its limit, the reason it gives, and the pick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from face_scenes import ELL, RECTANGLE, Scene, face, plate_and_ell

from workbench_stages.edges.planes import Camera
from workbench_stages.matching.database import Database, Part
from workbench_stages.matching.pose import pose_of
from workbench_stages.matching.recognise import (
    Reason,
    Rules,
    checks,
    contradiction,
    explain_row,
    find_candidates,
    match_part,
    refusal,
    verdict_of,
)
from workbench_stages.matching.surfaces import Surface, cut_out, features_mm


@pytest.fixture(scope="module")
def database() -> Database:
    return plate_and_ell()


class Lone:
    """One plate on the table, whose regions a test may change before they are judged."""

    def __init__(self, polygon: np.ndarray = RECTANGLE, **place: Any) -> None:
        self.scene = Scene()
        self.label = self.scene.add(polygon, 20.0, **place)
        self.regions = self.scene.regions()
        self.row = self.regions[self.label - 1]

    def judge(self, database: Database, **rules: float) -> np.void:
        scene = self.scene
        (found,) = find_candidates(
            scene.labels, self.regions, scene.depth, scene.camera, database, Rules(**rules)
        )
        assert found["label"] == self.label
        assert found["picked"] == (found["reason"] == Reason.NONE)
        return found


def test_a_plate_that_lies_free_is_measured_and_picked(database: Database) -> None:
    plate = Lone()
    found = plate.judge(database)
    features = features_mm(plate.scene.surface(plate.label)[1])
    assert found["reason"] == Reason.NONE and found["picked"] and found["rank"] == 1
    measured = [found[k] for k in (
        "area_mm2", "perimeter_mm", "shape_factor", "greatest_distance_mm")]  # fmt: skip
    np.testing.assert_allclose(measured, features)
    assert found["elevation_m"] == plate.row["elevation_m"] == pytest.approx(0.02, abs=1e-4)
    assert found["tilt_deg"] == plate.row["tilt_deg"]
    np.testing.assert_allclose(found["distances"], database.distances(features))
    assert found["model"] == 0 and found["distance"] == found["distances"][0]
    assert found["zeta"] == database.parts[0].zeta and found["shape_distance"] < found["zeta"]
    assert not found["occluded"] and found["occluded_by"] == 0 and found["occluded_share"] == 0
    assert found["visible_model"] == -1 and np.isnan(found["hidden_share"])
    assert not found["mirrored"]


def test_the_part_is_the_one_whose_features_are_nearest(database: Database) -> None:
    found = Lone(ELL).judge(database)
    assert found["model"] == 1 and found["distances"].argmin() == 1
    assert found["distance"] == found["distances"][1] and found["picked"]


# -- one criterion at a time ---------------------------------------------------------------------

Change = Callable[[Lone, Database], tuple[Database, dict[str, float]]]


def too_small(by: float) -> Change:
    def change(part: Lone, database: Database) -> tuple[Database, dict[str, float]]:
        area = part.judge(database)["area_mm2"]
        return database, {"min_area": (area / database.smallest_mm2) * (1 + by)}

    return change


def border_px(count: int) -> Change:
    def change(part: Lone, database: Database) -> tuple[Database, dict[str, float]]:
        part.row["border_px"] = count
        return database, {}

    return change


def measured(name: str, value: float, **rules: float) -> Change:
    def change(part: Lone, database: Database) -> tuple[Database, dict[str, float]]:
        part.row[name] = value
        return database, rules

    return change


def features_apart(by: float, scale: float) -> Change:
    def change(part: Lone, database: Database) -> tuple[Database, dict[str, float]]:
        distance = part.judge(database)["distance"]
        return replace(database, phi=distance / scale * (1 + by)), {"phi_scale": scale}

    return change


def outline_apart(by: float, scale: float) -> Change:
    def change(ell: Lone, database: Database) -> tuple[Database, dict[str, float]]:
        distance = ell.judge(database)["shape_distance"]
        plate_part, ell_part = database.parts
        ell_part = replace(ell_part, zeta=distance / scale * (1 + by))
        return replace(database, parts=(plate_part, ell_part)), {"zeta_scale": scale}

    return change


TINY = 1e-9


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (too_small(-TINY), Reason.NONE),
        (too_small(TINY), Reason.TOO_SMALL),
        (border_px(0), Reason.NONE),
        (border_px(1), Reason.CUT),
        (measured("tilt_deg", 50.0), Reason.NONE),
        (measured("tilt_deg", 50.001), Reason.TILTED),
        (measured("tilt_deg", np.nan), Reason.TILTED),
        (measured("tilt_deg", 29.9, max_tilt_deg=30.0), Reason.NONE),
        (measured("tilt_deg", 30.1, max_tilt_deg=30.0), Reason.TILTED),
        (measured("residual_m", 1.0e-3), Reason.NONE),
        (measured("residual_m", 1.001e-3), Reason.NOT_FLAT),
        (measured("residual_m", np.nan), Reason.NOT_FLAT),
        (measured("residual_m", 0.29e-3, max_residual_mm=0.3), Reason.NONE),
        (measured("residual_m", 0.31e-3, max_residual_mm=0.3), Reason.NOT_FLAT),
        (features_apart(TINY, 1.0), Reason.NONE),
        (features_apart(-TINY, 1.0), Reason.FEATURES),
        (features_apart(TINY, 2.0), Reason.NONE),
        (features_apart(-TINY, 2.0), Reason.FEATURES),
        (outline_apart(TINY, 1.0), Reason.NONE),
        (outline_apart(-TINY, 1.0), Reason.SHAPE),
        (outline_apart(TINY, 2.0), Reason.NONE),
        (outline_apart(-TINY, 2.0), Reason.SHAPE),
    ],
)
def test_a_limit_is_where_it_is_said_to_be(
    database: Database, change: Change, reason: Reason
) -> None:
    """Only what is *over* a limit is refused: at it, and a hair under it, a part is picked."""
    ell = Lone(ELL)
    changed, rules = change(ell, database)
    found = ell.judge(changed, **rules)
    assert Reason(found["reason"]) is reason
    verdict = verdict_of(np.array([found]), changed, Rules(**rules))
    assert verdict["verdict"] == ("pick" if reason is Reason.NONE else "rearrange")


@pytest.mark.parametrize(
    ("tilt", "reason"), [(48.0, Reason.NONE), (53.0, Reason.TILTED)], ids=["48°", "53°"]
)
def test_a_face_that_is_too_steep_is_refused(
    database: Database, tilt: float, reason: Reason
) -> None:
    found = Lone(at=(0.0, 0.0, 0.75), tilt_deg=tilt, towards_deg=30.0).judge(
        replace(database, phi=np.inf)
    )
    assert Reason(found["reason"]) is reason
    assert found["tilt_deg"] == pytest.approx(tilt, abs=0.1)


@pytest.mark.parametrize(("bow_mm", "reason"), [(0.5, Reason.NONE), (4.0, Reason.NOT_FLAT)])
def test_a_face_that_is_not_flat_is_refused(
    database: Database, bow_mm: float, reason: Reason
) -> None:
    """A saddle, as far above its plane as below it: its rms is a third of what its corners are."""
    plate = Lone()
    scene = plate.scene
    own = scene.labels == plate.label
    rows, columns = np.nonzero(own)
    u = (columns - columns.mean()) / np.ptp(columns) * 2
    v = (rows - rows.mean()) / np.ptp(rows) * 2
    scene.depth[own] += (1e-3 * bow_mm * np.sin(6 * u) * np.sin(6 * v)).astype(np.float32)
    plate.regions = scene.regions()
    assert Reason(plate.judge(database)["reason"]) is reason


@pytest.mark.parametrize(("by", "over"), [(-1e-9, True), (0.0, False), (1e-9, False)])
def test_a_region_counts_as_covered_over_its_share_of_the_border(
    database: Database, by: float, over: bool
) -> None:
    """The share is the border pixels that say so over the region's own perimeter, in pixels."""
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0)
    high = scene.add(RECTANGLE * [0.2, 0.2], 0.0, (0.023, 0.0, 0.76))
    regions = scene.regions()
    rows = np.nonzero((scene.labels[:, :-1] == low) & (scene.labels[:, 1:] == high))[0]
    columns = sum(
        int(((a == low) & (b == high)).sum())
        for a, b in ((scene.labels[:-1], scene.labels[1:]), (scene.labels[1:], scene.labels[:-1]))
    )
    share = (len(rows) + columns) / regions[low - 1]["perimeter_px"]
    limit = share * (1 + by)
    found = find_candidates(
        scene.labels, regions, scene.depth, scene.camera, database, Rules(covered_share=limit)
    )
    row = found[found["label"] == low][0]
    assert row["occluded_share"] == pytest.approx(share)
    assert row["occluded_by"] == high
    assert bool(row["occluded"]) == over
    assert (row["reason"] == Reason.OCCLUDED) == over
    # A step that is held to be none covers nothing.
    found = find_candidates(
        scene.labels, regions, scene.depth, scene.camera, database, Rules(step_mm=20.0)
    )
    row = found[found["label"] == low][0]
    assert not row["occluded"] and row["occluded_share"] == 0 and row["occluded_by"] == 0


@pytest.mark.parametrize(("step_mm", "covered"), [(1.5, False), (2.5, True)])
def test_how_much_higher_lies_above_is_asked_in_millimetres(
    database: Database, step_mm: float, covered: bool
) -> None:
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0)
    scene.add(RECTANGLE * 0.4, 0.0, (0.02, 0.0, 0.775 - 1e-3 * step_mm))
    found, _ = scene.judge(database, Rules(step_mm=2.0))
    assert bool(found[found["label"] == low][0]["occluded"]) == covered


def test_the_region_that_covers_most_of_the_border_is_named(database: Database) -> None:
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0)
    wide = scene.add(RECTANGLE * 0.5, 0.0, (0.022, 0.0, 0.76))
    narrow = scene.add(RECTANGLE * 0.25, 0.0, (-0.022, 0.0, 0.75))
    found, verdict = scene.judge(database)
    row = found[found["label"] == low][0]
    assert narrow > wide and row["occluded_by"] == wide
    assert 0.06 < row["occluded_share"] <= 1
    assert f"Occ: region {wide} is above it" in verdict["reason"]


def test_shares_of_the_border_add_up_to_all_of_it_at_most(database: Database) -> None:
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0)
    scene.add(RECTANGLE * 0.5, 0.0, (0.022, 0.0, 0.76))
    scene.add(RECTANGLE * 0.5, 0.0, (-0.022, 0.0, 0.76))
    both, _ = scene.judge(database)
    regions = scene.regions()
    regions["perimeter_px"][low - 1] = 0.5
    full = find_candidates(scene.labels, regions, scene.depth, scene.camera, database, Rules())
    assert 0.2 < both[both["label"] == low][0]["occluded_share"] < 0.8
    assert full[full["label"] == low][0]["occluded_share"] == 1


# -- what the part has around it -----------------------------------------------------------------


def with_body(
    part: Part, below_mm: float, sectors: slice = slice(None), noise: float = 0.1
) -> Part:
    """The part with flanks that go down to ``below_mm`` in these directions."""
    body = np.zeros(36, bool)
    body[sectors] = True
    return replace(part, profile=np.full(36, below_mm), profile_noise_mm=noise, body=body)


def seen_from_above(polygon: np.ndarray = RECTANGLE) -> Surface:
    return face(polygon)


@pytest.mark.parametrize(
    ("below_mm", "noise", "allowed"),
    [(10.0, 0.1, 5.0), (4.0, 0.1, 3.0), (4.0, 1.5, 4.5), (20.0, 1.5, 10.0)],
    ids=["half of it", "noise of a flank", "noise of the views", "half of it again"],
)
def test_the_body_is_missing_where_what_is_seen_lies_lower_than_is_allowed(
    database: Database, below_mm: float, noise: float, allowed: float
) -> None:
    part, surface = with_body(database.parts[0], below_mm, noise=noise), seen_from_above()
    for more, share in ((allowed - 0.01, 0.0), (allowed + 0.01, 1.0), (-50.0, 0.0)):
        assert contradiction(part, surface, np.full(36, below_mm + more), 0.0) == share
    lower = np.full(36, below_mm)
    lower[:9] += allowed + 0.01
    assert contradiction(part, surface, lower, 0.0) == 9 / 36


def test_what_was_not_measured_does_not_contradict(database: Database) -> None:
    part, surface = with_body(database.parts[0], 10.0), seen_from_above()
    profile = np.full(36, 30.0)
    profile[:18] = np.nan
    assert contradiction(part, surface, profile, 0.0) == 1.0
    profile[18:27] = 10.0
    assert contradiction(part, surface, profile, 0.0) == 0.5
    unknown = replace(part, profile=np.where(np.arange(36) < 27, np.nan, 10.0))
    assert contradiction(unknown, surface, np.full(36, 30.0), 0.0) == 1.0


@pytest.mark.parametrize(("directions", "share"), [(5, 0.0), (6, 1.0)])
def test_too_few_directions_say_nothing(database: Database, directions: int, share: float) -> None:
    part = with_body(database.parts[0], 10.0, slice(0, directions))
    assert contradiction(part, seen_from_above(), np.full(36, 30.0), 0.0) == share


def test_a_part_without_a_body_beyond_its_face_is_never_contradicted(database: Database) -> None:
    part = with_body(database.parts[0], 10.0, slice(0, 0))
    assert contradiction(part, seen_from_above(), np.full(36, 90.0), 0.0) == 0.0


@pytest.mark.parametrize("rotation", [0.0, 90.0, 250.0])
def test_the_body_turns_with_the_part(database: Database, rotation: float) -> None:
    """Flanks in the directions 0 to 80°, as deep as the direction, turned counter-clockwise."""
    part = with_body(database.parts[0], 10.0, slice(0, 9))
    part = replace(part, profile=10.0 + np.arange(36.0))
    surface = seen_from_above()
    right = np.roll(10.0 + np.arange(36.0), round(rotation / 10))
    assert contradiction(part, surface, right, rotation) == 0.0
    at = (np.arange(9) + round(rotation / 10)) % 36
    lower = right.copy()
    lower[at[:3]] += 30.0
    assert contradiction(part, surface, lower, rotation) == pytest.approx(3 / 9)
    others = right.copy()
    others[np.setdiff1d(np.arange(36), at)] += 30.0
    assert contradiction(part, surface, others, rotation) == 0.0


def test_between_two_directions_only_those_that_are_both_body_count(database: Database) -> None:
    part = with_body(database.parts[0], 10.0, slice(0, 9))
    profile = np.full(36, 10.0)
    profile[0] = profile[9] = 60.0
    assert contradiction(part, seen_from_above(), profile, 5.0) == 0.0


@pytest.mark.parametrize(("below_mm", "share"), [(26.0, 1.0), (30.0, 0.0)])
def test_a_flank_is_looked_for_where_it_faces_the_camera(
    database: Database, below_mm: float, share: float
) -> None:
    """Seen from above it does if the ring's middle, 9.5 px out, is a fifth of the slope's way."""
    surface = seen_from_above()
    out = 9.5 * surface.pixel_mm
    assert (out / np.hypot(26.0, out) > 0.2) and (out / np.hypot(30.0, out) < 0.2)
    part = with_body(database.parts[0], below_mm)
    assert contradiction(part, surface, np.full(36, 3 * below_mm), 0.0) == share


@pytest.mark.parametrize(
    ("place", "facing"),
    [((0.07, 0.0), 18), ((-0.07, 0.0), 0), ((0.0, 0.07), 9), ((0.0, -0.07), 27)],
    ids=["right", "left", "below", "above"],
)
def test_beside_the_axis_the_flanks_towards_the_axis_are_seen(
    database: Database, place: tuple[float, float], facing: int
) -> None:
    """A face that lies to the right of the axis shows its left flank, and hides its right one."""
    labels = np.zeros((256, 256), np.int32)
    labels[110:150, 110:150] = 1
    point = np.array([*place, 0.775])
    middle = np.array([place[0], place[1]]) / 0.775 * 1300
    camera = Camera(1300.0, 1300.0, 129.5 - middle[0], 129.5 - middle[1])
    surface = cut_out(labels, 1, point, np.array([0.0, 0, -1]), camera)
    assert surface is not None
    for sectors, share in (((facing - 4, facing + 5), 1.0), ((facing + 14, facing + 23), 0.0)):
        part = with_body(database.parts[0], 32.0)
        body = np.zeros(36, bool)
        body[np.arange(*sectors) % 36] = True
        part = replace(part, body=body)
        assert contradiction(part, surface, np.full(36, 90.0), 0.0) == share


@pytest.mark.parametrize(
    ("missing", "reason"), [(9, Reason.NONE), (11, Reason.SURROUNDINGS)], ids=["9", "11"]
)
def test_a_part_whose_body_is_missing_in_over_a_quarter_of_the_directions_is_refused(
    database: Database, missing: int, reason: Reason
) -> None:
    """In every turn that fits the outline: a plate is missing as much after half a turn."""
    plate, ell = database.parts
    flanked = replace(database, parts=(with_body(plate, 10.0), ell))
    lone = Lone()
    below = np.full(36, 10.0)
    below[:missing] = 40.0
    lone.scene.surround(lone.label, below.tolist())
    found = lone.judge(flanked)
    assert Reason(found["reason"]) is reason
    if reason is Reason.SURROUNDINGS:
        said = verdict_of(np.array([found]), flanked, Rules())["reason"]
        assert said.endswith("measures of plate, but what lies around it is lower than plate is")


def test_a_turn_in_which_the_body_could_be_there_is_enough(database: Database) -> None:
    """A plate with a flank at one end: after half a turn the outline fits as well, and it is."""
    plate, ell = database.parts
    flank = with_body(plate, 10.0, slice(-9, 9))
    flank = replace(flank, body=np.roll(np.arange(36) < 17, -8))
    turned = replace(database, parts=(flank, ell))
    for first in (0, 18):
        lone = Lone()
        below = np.full(36, 40.0)
        # The plate lies at 20°, its flank at one of its ends.
        below[(np.arange(17) - 8 + 2 + first) % 36] = 10.0
        lone.scene.surround(lone.label, below.tolist())
        assert lone.judge(turned)["reason"] == Reason.NONE
    lone = Lone()
    lone.scene.surround(lone.label, [40.0] * 36)
    assert lone.judge(turned)["reason"] == Reason.SURROUNDINGS


# -- which criterion comes first -----------------------------------------------------------------


def test_the_first_criterion_that_fails_is_the_reason(database: Database) -> None:
    """Everything is wrong with a plate, and one by one is put right in the criteria's order."""
    plate, ell = database.parts
    scene = Scene()
    low = scene.add(RECTANGLE, 20.0)
    high = scene.add(RECTANGLE * 0.2, 0.0, (0.023, 0.009, 0.74))
    scene.depth[(scene.labels != low) & (scene.labels != high)] = 0.775 + 0.05
    regions = scene.regions()
    row = regions[low - 1]
    row["border_px"], row["tilt_deg"], row["residual_m"] = 3, 70.0, 5e-3
    worst = Rules(min_area=9.0, covered_share=0.01, phi_scale=1e-20, zeta_scale=1e-20)
    flanked = replace(database, phi=1e9, parts=(replace(with_body(plate, 10.0), zeta=1e9), ell))
    expected = [
        (Reason.TOO_SMALL, lambda r: replace(r, min_area=0.1)),
        (Reason.CUT, lambda r: row.__setitem__("border_px", 0) or r),
        (Reason.TILTED, lambda r: replace(r, max_tilt_deg=80.0)),
        (Reason.NOT_FLAT, lambda r: replace(r, max_residual_mm=9.0)),
        (Reason.OCCLUDED, lambda r: replace(r, covered_share=1.0)),
        (Reason.FEATURES, lambda r: replace(r, phi_scale=1.0)),
        (Reason.SHAPE, lambda r: replace(r, zeta_scale=1.0)),
        (Reason.SURROUNDINGS, None),
    ]
    rules = worst
    for reason, mend in expected:
        found = find_candidates(scene.labels, regions, scene.depth, scene.camera, flanked, rules)
        of_low = found[found["label"] == low][0]
        assert Reason(of_low["reason"]) is reason
        assert [int(r) for r, _, _ in checks(of_low, row, flanked, rules)] == list(
            range(1, int(reason) + 1)
        )
        # Measured as far as it got.
        assert np.isnan(of_low["perimeter_mm"]) == (reason is Reason.TOO_SMALL)
        assert np.isnan(of_low["shape_distance"]) == (reason < Reason.SHAPE)
        assert np.isnan(of_low["zeta"]) == (reason < Reason.SHAPE)
        if reason is Reason.TOO_SMALL:
            assert of_low["model"] == -1 and np.isnan(of_low["distances"]).all()
        rules = mend(rules) if mend else rules


def test_reasons_have_the_numbers_that_scripts_read() -> None:
    assert {reason.name: reason.value for reason in Reason} == {
        "NONE": 0, "TOO_SMALL": 1, "CUT": 2, "TILTED": 3, "NOT_FLAT": 4, "OCCLUDED": 5,
        "FEATURES": 6, "SHAPE": 7, "SURROUNDINGS": 8,
    }  # fmt: skip


def test_the_rules_are_those_of_the_stage() -> None:
    """The declared defaults, and every parameter in its own place."""
    from workbench_stages.recognition import Recognition, rules_of

    assert rules_of(Recognition.Parameters()) == Rules()
    told = Recognition.Parameters(
        min_area=0.3, step=2.0, covered_share=0.4, max_tilt=44.0, max_residual=0.7,
        phi_scale=1.1, zeta_scale=1.2, most_hidden=0.15,
    )  # fmt: skip
    assert rules_of(told) == Rules(0.3, 2.0, 0.4, 44.0, 0.7, 1.1, 1.2, 0.15)


# -- the pick ------------------------------------------------------------------------------------

PLACES = [(-0.038, -0.04), (0.0, 0.04), (0.038, -0.04)]


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1), (1, 2, 0)])
def test_of_all_that_match_the_highest_is_picked(
    database: Database, order: tuple[int, int, int]
) -> None:
    """Not the largest, not the first: the one that lies on top, wherever it lies."""
    heights = np.array([0.775, 0.765, 0.74])[list(order)]
    scene = Scene()
    labels = [
        scene.add(ELL if k == 1 else RECTANGLE, 10.0 * k, (*PLACES[k], z))
        for k, z in enumerate(heights)
    ]
    found, verdict = scene.judge(database)
    assert (found["reason"] == Reason.NONE).all() and len(found) == 3
    top = labels[int(heights.argmin())]
    assert verdict["verdict"] == "pick" and verdict["region"] == top
    assert found["label"][found["picked"]].tolist() == [top]
    assert verdict["object"] == ("ell" if top == labels[1] else "plate")
    up = 1e3 * (0.795 - heights.min())
    assert verdict["reason"].startswith(f"topmost match, {up:.1f} mm up; {verdict['object']}: ")


def test_an_image_of_twice_the_size_comes_to_the_same_answer(database: Database) -> None:
    """The pick, its place and turn, and who covers whom: in millimetres nothing is another."""
    found = []
    for size, focal in ((256, 1300.0), (512, 2600.0)):
        scene = Scene(Camera(focal, focal, (size - 1) / 2, (size - 1) / 2), size)
        low = scene.add(RECTANGLE, 0.0, (-0.02, 0.03, 0.785))
        high = scene.add(RECTANGLE * 0.4, 0.0, (0.004, 0.03, 0.77))
        top = scene.add(ELL, 200.0, (0.01, -0.03, 0.765), 10.0, 40.0)
        candidates, verdict = scene.judge(database)
        assert (verdict["region"], verdict["object"]) == (top, "ell")
        rows = {row["label"]: row for row in candidates}
        assert {k: Reason(row["reason"]) for k, row in rows.items()} == {
            low: Reason.OCCLUDED, high: Reason.TOO_SMALL, top: Reason.NONE,
        }  # fmt: skip
        assert rows[low]["occluded_by"] == high
        region, surface = scene.surface(top)
        pose = pose_of(surface, region, scene.depth, database, 1)
        assert pose["rotation_deg"] == pytest.approx(200, abs=0.7)
        found.append(
            [
                rows[low]["occluded_share"], *(1e3 * np.array(pose["grasp"]["position"])),
                *pose["grasp"]["approach"], 1e-3 * rows[top]["area_mm2"],
                rows[top]["perimeter_mm"] / 100,
            ]
        )  # fmt: skip
    np.testing.assert_allclose(found[1], found[0], atol=0.05, rtol=1e-4)


def test_a_higher_part_that_does_not_match_is_passed_over(database: Database) -> None:
    scene = Scene()
    low = scene.add(RECTANGLE, 0.0, (*PLACES[0], 0.775))
    scene.add(RECTANGLE * 1.3, 0.0, (*PLACES[1], 0.74))
    _, verdict = scene.judge(database)
    assert verdict["region"] == low


def test_candidates_are_ranked_by_their_area(database: Database) -> None:
    scene = Scene()
    sizes = {scene.add(RECTANGLE * k, 0.0, (*at, 0.775)): k for k, at in zip(
        (0.6, 1.2, 0.9), PLACES, strict=True)}  # fmt: skip
    found, _ = scene.judge(database)
    assert found["rank"].tolist() == [1, 2, 3]
    assert [sizes[k] for k in found["label"].tolist()] == [1.2, 0.9, 0.6]
    assert (np.diff(found["area_mm2"]) < 0).all()


def test_background_and_regions_without_a_plane_are_no_candidates(database: Database) -> None:
    scene = Scene()
    plate = scene.add(RECTANGLE, 0.0, (*PLACES[0], 0.775))
    unseen = scene.add(RECTANGLE, 0.0, (*PLACES[1], 0.775))
    scene.depth[scene.labels == unseen] = np.nan
    regions = scene.regions()
    assert regions["background"].tolist() == [True, False, False]
    assert regions["plane_px"][unseen - 1] == 0
    found, _ = scene.judge(database)
    assert found["label"].tolist() == [plate]
    # Nor is one whose plane is seen from its edge.
    regions["normal"][plate - 1] = [1.0, 0.0, 0.0]
    none = find_candidates(scene.labels, regions, scene.depth, scene.camera, database, Rules())
    assert len(none) == 0 and none.dtype == found.dtype
    assert verdict_of(none, database, Rules()) == {
        "verdict": "rearrange", "region": None, "object": None,
        "reason": "no region has the area of a part",
    }  # fmt: skip


def test_what_is_too_small_is_not_told_of_beside_what_is_not(database: Database) -> None:
    scene = Scene()
    scene.add(RECTANGLE * 0.4, 0.0, (*PLACES[0], 0.775))
    large = scene.add(RECTANGLE * 1.3, 0.0, (*PLACES[1], 0.775))
    found, verdict = scene.judge(database)
    assert sorted(found["reason"].tolist()) == [Reason.TOO_SMALL, Reason.FEATURES]
    assert verdict["reason"].startswith(f"region {large}: features")
    assert "; " not in verdict["reason"]


def test_an_incomplete_face_is_named_by_what_shows_unless_it_is_too_steep(
    database: Database,
) -> None:
    cut = Lone(at=(0.055, 0.0, 0.785))
    assert cut.judge(database)["visible_model"] == 0
    assert np.isfinite(cut.judge(database)["hidden_share"])
    assert cut.judge(database, most_hidden=0.0)["visible_model"] == -1
    cut.row["tilt_deg"] = 50.0
    assert cut.judge(database)["visible_model"] == 0
    cut.row["tilt_deg"] = 50.1
    assert cut.judge(database)["visible_model"] == -1
    # A whole one needs no such name, whatever else is wrong with it.
    whole = Lone()
    whole.row["residual_m"] = 5e-3
    assert whole.judge(database)["visible_model"] == -1


# -- the mirror image ----------------------------------------------------------------------------


def test_a_face_is_mirrored_only_where_it_does_not_fit_as_it_is(database: Database) -> None:
    ell = database.parts[1]
    side, scale = database.side, database.mm_per_px
    straight, turned = face(ELL, 40.0), face(ELL * [-1, 1], 40.0)
    found, mirrored = match_part(ell, straight, side, scale)
    assert not mirrored and found[0].rotation_deg == pytest.approx(40, abs=1)
    found, mirrored = match_part(ell, turned, side, scale)
    assert mirrored and found[0].distance <= ell.zeta
    # Mirrored, a turn to the left is one to the right.
    assert found[0].rotation_deg == pytest.approx(320, abs=1)
    # Over ζ both ways it is not said to be the mirror image, though it is more like it.
    strict, mirrored = match_part(replace(ell, zeta=1e-6), turned, side, scale)
    assert not mirrored and strict[0].distance > found[0].distance
    # A ζ that the face is within as it is leaves it so, though the mirror image fits better.
    loose, mirrored = match_part(replace(ell, zeta=9.0), turned, side, scale)
    assert not mirrored and loose[0].distance == strict[0].distance
    # Of two that do not fit as they are the better one counts.
    stranger = face(RECTANGLE * 1.2)
    assert not match_part(database.parts[0], stranger, side, scale)[1]


# -- what is said --------------------------------------------------------------------------------


@pytest.fixture
def said() -> tuple[np.ndarray, Database]:
    """A candidate and a database whose numbers are all different."""
    part = Part(
        "plate", np.full((3, 4), 1000.0), None, 0.05, np.zeros(36), 0.1, 180.0,  # type: ignore[arg-type]
        np.zeros(3), np.zeros(36, bool),
    )  # fmt: skip
    ell = replace(part, name="ell", features=np.full((3, 4), 1500.0))
    database = Database((part, ell), np.zeros(4), np.ones(4), 0.25, 48, 1.0, "")
    row = np.zeros(1, [
        ("label", int), ("reason", int), ("elevation_m", float), ("area_mm2", float),
        ("tilt_deg", float), ("occluded_share", float), ("occluded_by", int), ("distance", float),
        ("shape_distance", float), ("zeta", float), ("model", int), ("visible_model", int),
        ("hidden_share", float), ("picked", bool), ("mirrored", bool),
    ])  # fmt: skip
    row[0] = (
        7,
        0,
        0.0123,
        700.4,
        61.7,
        0.237,
        9,
        0.3456,
        0.0789,
        0.05,
        1,
        -1,
        np.nan,
        False,
        False,
    )
    return row, database


REGION = {"border_px": 12, "residual_m": 0.001304}
RULES = Rules(
    min_area=0.9, step_mm=1.5, covered_share=0.06, max_tilt_deg=50.0, max_residual_mm=1.25,
    phi_scale=1.2, zeta_scale=1.5,
)  # fmt: skip


@pytest.mark.parametrize(
    ("reason", "clause", "at_length"),
    [
        (Reason.NONE, "ell: features 0.346, outline 0.079", None),
        (Reason.TOO_SMALL, "area 700 mm² under 900", "area 700.4 mm² is under 900.0 mm²"),
        (
            Reason.CUT,
            "leaves the image",
            "leaves the image: 12 px of it are on the image's border",
        ),
        (Reason.TILTED, "tilt 62° over 50°", "tilt 61.7° is over 50°"),
        (Reason.NOT_FLAT, "not flat", "not flat: 1.30 mm from its plane, over 1.25 mm"),
        (
            Reason.OCCLUDED,
            "Occ: region 9 is above it along 24 % of its border",
            "Occ: region 9 (and others) lie 1.5 mm or more above it along 23.7 % of its border, "
            "over 6 %",
        ),
        (
            Reason.FEATURES,
            "features 0.346 from ell, over φ 0.300",
            "features 0.346 from ell, the nearest, over φ 0.300",
        ),
        (
            Reason.SHAPE,
            "outline 0.079 from ell, over ζ 0.075",
            "outline 0.079 from ell, over ζ 0.075",
        ),
        (
            Reason.SURROUNDINGS,
            "measures of ell, but what lies around it is lower than ell is",
            "measures of ell, but what lies around it is lower than ell is",
        ),
    ],
)
def test_a_refusal_names_its_criterion_with_its_numbers(
    said: tuple[np.ndarray, Database], reason: Reason, clause: str, at_length: str | None
) -> None:
    (row,), database = said
    row["reason"] = reason
    assert explain_row(row, database, RULES) == clause
    if at_length is not None:
        assert refusal(row, REGION, database, RULES) == at_length
        assert checks(row, REGION, database, RULES)[-1][:2] == (reason, at_length)


def test_what_shows_of_an_incomplete_part_is_said(said: tuple[np.ndarray, Database]) -> None:
    (row,), database = said
    row["visible_model"], row["hidden_share"] = 0, 0.134
    for reason, clause in (
        (Reason.CUT, "leaves the image"),
        (Reason.OCCLUDED, "Occ: region 9 is above it along 24 % of its border"),
    ):
        row["reason"] = reason
        said_of = explain_row(row, database, RULES)
        assert said_of == f"{clause}; what shows is plate's, 13 % hidden"


def test_the_criteria_that_were_met_are_told_with_their_numbers(
    said: tuple[np.ndarray, Database],
) -> None:
    (row,), database = said
    row["reason"], row["model"] = Reason.NONE, 0
    told = checks(row, REGION, database, RULES)
    assert [(int(criterion), text) for criterion, text, _ in told] == [
        (1, "area 700.4 mm² is not under 900.0 mm², the smallest part's times 0.9"),
        (2, "it does not touch the image's border"),
        (3, "tilt 61.7° is not over 50°"),
        (4, "1.30 mm from its plane, not over 1.25 mm"),
        (5, "others lie 1.5 mm or more above it along 23.7 % of its border, not over 6 %"),
        (6, "features 0.346 from plate, not over φ 0.300"),
        (7, "outline 0.079 from plate, not over ζ 0.075"),
        (8, "what lies around it is what plate has around it"),
    ]
    values: dict[str, Any] = {}
    for _, _, numbers in told:
        values |= numbers
    assert values == {
        "area_mm2": 700.4, "border_px": 12, "tilt_deg": 61.7, "residual_m": 0.001304,
        "occluded_share": 0.237, "occluded_by": 9, "distance": 0.3456, "phi": 0.25 * 1.2,
        "shape_distance": 0.0789, "zeta": 0.05 * 1.5,
    }  # fmt: skip


def test_a_candidate_that_was_not_measured_is_named_after_none(
    said: tuple[np.ndarray, Database],
) -> None:
    (row,), database = said
    row["reason"], row["model"] = Reason.FEATURES, -1
    assert explain_row(row, database, RULES) == "features 0.346 from none, over φ 0.300"
    assert refusal(row, REGION, database, RULES).startswith("features 0.346 from none, the nearest")
    assert "from none" in checks(row, REGION, database, RULES)[-1][1]


def test_a_verdict_is_of_the_picked_region_or_of_all_that_were_refused(
    said: tuple[np.ndarray, Database],
) -> None:
    one, database = said
    rows = np.repeat(one, 3)
    rows["label"], rows["reason"] = [4, 7, 8], [Reason.CUT, Reason.NONE, Reason.TILTED]
    rows["picked"] = [False, True, False]
    assert verdict_of(rows, database, RULES) == {
        "verdict": "pick", "region": 7, "object": "ell",
        "reason": "topmost match, 12.3 mm up; ell: features 0.346, outline 0.079",
    }  # fmt: skip
    rows["picked"], rows["reason"] = False, [Reason.CUT, Reason.TOO_SMALL, Reason.TILTED]
    assert verdict_of(rows, database, RULES) == {
        "verdict": "rearrange", "region": None, "object": None,
        "reason": "region 4: leaves the image; region 8: tilt 62° over 50°",
    }  # fmt: skip

"""The database of parts: distances, thresholds, what is said of symmetry, and its file."""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from face_scenes import ELL, RECTANGLE, disc, face, views_of

from workbench_stages.matching.database import (
    Database,
    Part,
    View,
    _border_distance,
    _border_error,
    _mean_profile,
    _period_deg,
    _separate,
    _threshold,
    _tilt_error,
    calibration_digest,
    make_database,
    turn_profile,
    view_of,
)
from workbench_stages.matching.eigenspace import Eigenspace, matches
from workbench_stages.matching.surfaces import fall_off, features_mm, soft_view

STEP_DEG = 45.0
SIDE = 24


@pytest.fixture(scope="module")
def views() -> dict[str, list[View]]:
    return {
        "plate": views_of(RECTANGLE, STEP_DEG),
        "disc": views_of(disc(0.018), STEP_DEG),
        "ell": views_of(ELL, STEP_DEG),
    }


@pytest.fixture(scope="module")
def database(views: dict[str, list[View]]) -> Database:
    return make_database(views, "1234", SIDE, 0.99)


def bare(name: str, features: Any, zeta: float = 0.1, space: Any = None) -> Part:
    features = np.asarray(features, float)
    return Part(
        name, features, space, zeta, np.zeros(36), 0.1, 360.0, np.zeros(len(features)),
        np.zeros(36, bool),
    )  # fmt: skip


# -- distances of features -----------------------------------------------------------------------


def test_distance_is_to_the_nearest_pattern_in_deviations() -> None:
    first = bare("first", [[10, 0, 0, 0], [50, 0, 0, 0]])
    second = bare("second", [[10, 30, 0, 0]])
    database = Database(
        (first, second), np.array([3.0, 5, 7, 9]), np.array([10.0, 15, 0.5, 2]), 1.0, 8, 1.0, ""
    )
    features = np.array([40.0, 30.0, 1.0, 8.0])
    expected = [
        np.sqrt((10 / 10) ** 2 + (30 / 15) ** 2 + 2**2 + 4**2),
        np.sqrt((30 / 10) ** 2 + 0 + 2**2 + 4**2),
    ]
    np.testing.assert_allclose(database.distances(features), expected)
    assert np.isnan(database.distances(np.full(4, np.nan))).all()
    assert database.names == ["first", "second"]


def test_the_smallest_surface_is_the_least_of_the_parts_medians() -> None:
    large = bare("large", [[5, 0, 0, 0], [900, 0, 0, 0], [1000, 0, 0, 0]])
    small = bare("small", [[400, 0, 0, 0], [410, 0, 0, 0], [2000, 0, 0, 0]])
    for parts in ((large, small), (small, large)):
        assert Database(parts, np.zeros(4), np.ones(4), 1, 8, 1, "").smallest_mm2 == 410


# -- what training measures ----------------------------------------------------------------------


def test_features_are_normalised_by_all_patterns_together(
    database: Database, views: dict[str, list[View]]
) -> None:
    features = [np.array([features_mm(v.surface) for v in own]) for own in views.values()]
    for part, own in zip(database.parts, features, strict=True):
        np.testing.assert_array_equal(part.features, own)
    patterns = np.concatenate(features)
    np.testing.assert_allclose(database.mean, patterns.mean(axis=0))
    np.testing.assert_allclose(database.deviation, patterns.std(axis=0))


def test_a_deviation_is_two_hundredths_of_the_mean_at_least(views: dict[str, list[View]]) -> None:
    """In a database of one part the spread is noise."""
    alone = make_database({"disc": views["disc"]}, "", SIDE)
    assert (alone.parts[0].features.std(axis=0) < 0.02 * alone.mean).all()
    np.testing.assert_allclose(alone.deviation, 0.02 * alone.mean)


def test_images_reach_a_fifth_farther_than_the_largest_face(
    database: Database, views: dict[str, list[View]]
) -> None:
    reach = max(np.median([v.surface.reach_mm for v in own]) for own in views.values())
    assert database.mm_per_px == pytest.approx(2 * 1.2 * reach / SIDE)
    assert database.side == SIDE and database.parts[0].space.side == SIDE
    # One view that reaches too far counts for nothing.
    far = replace(views["ell"][0], surface=replace(views["ell"][0].surface, reach_mm=90.0))
    again = make_database(views | {"ell": [far, *views["ell"][1:]]}, "", SIDE)
    assert again.mm_per_px == pytest.approx(database.mm_per_px, rel=0.02)


def test_zeta_is_half_again_the_farthest_view_or_what_a_border_does(
    views: dict[str, list[View]],
) -> None:
    """The farthest view, by what the others say of it and by what its eigenspace leaves out."""
    alone = make_database({"ell": views["ell"]}, "", SIDE, 0.99)
    (part,) = alone.parts
    space, scale = part.space, alone.mm_per_px
    cut = [matches(space, soft_view(v.surface, SIDE, scale))[0].distance for v in views["ell"]]
    assert (part.left_out >= cut).all() and (np.array(cut) > 0).all()
    border = _border_distance(views["ell"], space, scale)
    assert part.zeta == pytest.approx(1.5 * max(part.left_out.max(), border))
    fine = make_database({"ell": views["ell"]}, "", SIDE, 0.9999).parts[0]
    assert fine.zeta < part.zeta


def test_a_views_distance_joins_what_the_others_say_and_what_is_left_out(
    views: dict[str, list[View]],
) -> None:
    from workbench_stages.matching.eigenspace import build

    alone = make_database({"ell": views["ell"]}, "", SIDE, 0.9)
    (part,) = alone.parts
    surfaces = [v.surface for v in views["ell"]]
    angles = np.array([v.angle_deg for v in views["ell"]])
    space, said = build(surfaces, angles, SIDE, alone.mm_per_px, 0.9)
    cut = [matches(space, soft_view(s, SIDE, alone.mm_per_px))[0].distance for s in surfaces]
    np.testing.assert_allclose(part.left_out, np.hypot(said, cut))
    assert len(space.basis) == len(part.space.basis)


def test_the_report_says_what_was_measured(
    database: Database, views: dict[str, list[View]]
) -> None:
    report = database.report
    assert list(report["parts"]) == database.names == ["plate", "disc", "ell"]
    for part in database.parts:
        told = report["parts"][part.name]
        assert told == {
            "views": 8,
            "features_mean": pytest.approx(part.features.mean(axis=0).tolist()),
            "features_deviation": pytest.approx(part.features.std(axis=0).tolist()),
            "eigenvectors": len(part.space.basis),
            "variance_kept": pytest.approx(part.space.variance.sum()),
            "left_out_mean": pytest.approx(part.left_out.mean()),
            "left_out_worst": pytest.approx(part.left_out.max()),
            "symmetry_of_the_surface": part.space.order,
            "period_deg": part.period_deg,
            "zeta": part.zeta,
        }
        assert told["variance_kept"] >= 0.99
    assert [p.space.order for p in database.parts] == [2, 12, 1]
    assert [p.period_deg for p in database.parts] == [180, 30, 360]
    assert report["phi"] == database.phi
    pixel_mm = float(np.median([v.surface.pixel_mm for own in views.values() for v in own]))
    phi, within, between = _threshold(database.parts, database.mean, database.deviation, pixel_mm)
    assert phi == database.phi
    assert report["farthest_within_a_part"] == within
    assert report["nearest_between_parts"] == between
    assert (report["image_px"], report["mm_per_px"]) == (SIDE, database.mm_per_px)
    assert phi <= between / 2


def test_a_database_of_one_part_has_no_distance_between_parts(
    views: dict[str, list[View]],
) -> None:
    report = make_database({"ell": views["ell"]}, "", SIDE).report
    assert "nearest_between_parts" not in report and np.isfinite(report["phi"])


def test_surroundings_are_turned_back_to_rotation_0_and_their_median_is_kept(
    views: dict[str, list[View]],
) -> None:
    base = 3.0 * np.arange(36.0)
    above = np.where(np.arange(36) < 12, 3.5, 2.5)
    noise = np.array([-1.0, 0, 1, 0, -1, 0, 1, 0])
    own = [
        View(
            v.surface, v.angle_deg, turn_profile(base + n, v.angle_deg),
            turn_profile(above, v.angle_deg),
        )
        for v, n in zip(views["ell"], noise, strict=True)
    ]  # fmt: skip
    own[3] = replace(own[3], profile=np.full(36, 500.0))
    own[4] = replace(own[4], profile=np.full(36, np.nan), above_table=np.full(36, np.nan))
    (part,) = make_database({"ell": own}, "", SIDE).parts
    off = np.abs(part.profile - base)
    # A turn by 45 degrees lies between two directions, whose middle is taken.
    assert np.median(off) < 0.6 and off[3:-3].max() < 1.1
    assert part.body[2:10].all() and not part.body[14:34].any()
    assert part.body.dtype == bool


@pytest.mark.parametrize(("above_mm", "is_body"), [(2.9, False), (3.1, True), (np.nan, False)])
def test_what_is_higher_than_the_table_beside_a_lone_part_is_the_part(
    views: dict[str, list[View]], above_mm: float, is_body: bool
) -> None:
    own = [replace(v, above_table=np.full(36, above_mm)) for v in views["ell"]]
    (part,) = make_database({"ell": own}, "", SIDE).parts
    assert part.body.tolist() == [is_body] * 36


def test_a_view_is_of_the_face_and_what_lies_around_it() -> None:
    surface = face(RECTANGLE)
    depth = np.full((256, 256), 0.795, np.float32)
    view = view_of(surface, 12.5, depth, None)
    assert view.surface is surface and view.angle_deg == 12.5
    np.testing.assert_array_equal(view.profile, fall_off(surface, depth)[0])
    np.testing.assert_allclose(view.profile, 20.0, atol=0.01)
    assert np.isnan(view.above_table).all()


@pytest.mark.parametrize("count", [0, 1, 2])
def test_three_views_are_needed(views: dict[str, list[View]], count: int) -> None:
    few = views["ell"][:count]
    with pytest.raises(ValueError, match=f"^ell: expected 3 views or more, found {count}$"):
        make_database({"disc": views["disc"], "ell": few}, "", SIDE)
    make_database({"ell": views["ell"][:3]}, "", SIDE)


def test_no_part_is_no_database() -> None:
    with pytest.raises(ValueError, match=r"^expected views of one part or more, found none$"):
        make_database({})


# -- thresholds ----------------------------------------------------------------------------------

DEVIATION = np.array([100.0, 10.0, 0.1, 2.0])


def oblong(perimeter: float = 140.0) -> list[float]:
    return [900.0, perimeter, 0.6, 30.0]


def test_a_border_that_moves_outwards_sweeps_its_length_and_turns_once() -> None:
    """Of a disc it is the disc that is larger by so much."""
    radius, shift = 20.0, 0.3
    before, after = (
        np.array([np.pi * r**2, 2 * np.pi * r, 1.0, r]) for r in (radius, radius + shift)
    )
    after[0] = before[0] + before[1] * shift
    after[2] = 4 * np.pi * after[0] / after[1] ** 2
    part = bare("disc", [before] * 3)
    expected = np.linalg.norm((after - before) / DEVIATION)
    assert _border_error([part], DEVIATION, shift) == pytest.approx(expected)
    # The worst of all parts, by the median of each one's views.
    odd = bare("odd", [before, before, 9 * before])
    assert _border_error([odd], DEVIATION, shift) == pytest.approx(expected)
    both = _border_error([part, bare("large", [9 * before] * 3)], DEVIATION, shift)
    assert both == _border_error([bare("large", [9 * before] * 3), part], DEVIATION, shift)
    assert both > expected


@pytest.mark.parametrize(("reach", "share"), [(30.0, 120 / 140), (36.0, 1.0)])
def test_a_normal_that_is_off_stretches_a_tilted_face(reach: float, share: float) -> None:
    """By tan 25° times 2°; its length around by as much as goes along the stretch."""
    stretch = np.tan(np.radians(25)) * np.radians(2)
    before = np.array([900.0, 140.0, 0.6, reach])
    longer = 1 + stretch * share
    after = before * [1 + stretch, longer, (1 + stretch) / longer**2, 1 + stretch]
    expected = np.linalg.norm((after - before) / DEVIATION)
    part = bare("oblong", [before] * 3)
    assert _tilt_error([part], DEVIATION) == pytest.approx(expected)
    large = bare("large", [before * [4, 2, 1, 2]] * 3)
    assert _tilt_error([part, large], DEVIATION) > expected
    assert _tilt_error([large, part], DEVIATION) == _tilt_error([part, large], DEVIATION)
    odd = bare("odd", [before, before, 9 * before])
    assert _tilt_error([odd], DEVIATION) == pytest.approx(expected)


def test_phi_joins_what_the_views_a_border_and_a_tilt_do() -> None:
    """The greater of 2.5 times the farthest view and of a border, and a tilt in quadrature."""
    mean = np.array([5.0, 6, 7, 8])
    for spread in (0.0, 3.0):
        shifts = np.array([0, 0.1, 0.35]) * spread
        part = bare("oblong", [oblong(140 + 10 * s) for s in shifts])
        farthest = 0.25 * spread
        border = _border_error([part], DEVIATION, 0.25 * 0.6)
        tilt = _tilt_error([part], DEVIATION)
        phi, within, between = _threshold([part], mean, DEVIATION, 0.6)
        assert within == pytest.approx(farthest)
        assert phi == pytest.approx(np.hypot(max(2.5 * farthest, border), tilt))
        assert (2.5 * farthest > border) == (spread > 0)
        assert between == np.inf


def test_phi_is_never_more_than_half_of_what_separates_two_parts() -> None:
    """So nothing is within φ of both; views of one name are no two parts."""
    near = oblong(140.2)
    far = oblong(190.0)
    parts = [bare("a", [oblong()] * 3), bare("b", [near, near, far]), bare("c", [far] * 3)]
    phi, _, between = _threshold(parts, np.zeros(4), DEVIATION, 0.6)
    assert between == pytest.approx(0.0) and phi == 0.0
    parts = [bare("a", [oblong()] * 3), bare("b", [near] * 3), bare("c", [far] * 3)]
    phi, within, between = _threshold(parts, np.zeros(4), DEVIATION, 0.6)
    assert within == 0 and between == pytest.approx(0.02) and phi == pytest.approx(0.01)
    alike = [bare("a", [oblong()] * 3), bare("a", [near] * 3), bare("c", [far] * 3)]
    assert _threshold(alike, np.zeros(4), DEVIATION, 0.6)[2] == pytest.approx(4.98)
    assert _threshold(parts[:1] + parts[2:], np.zeros(4), DEVIATION, 0.6)[0] < 0.5 * 5.0


def point_space(*at: float) -> Eigenspace:
    """A surface that looks the same at every turn, and whose views lie where it does."""
    basis = np.eye(16, dtype=np.float32)[:2]
    place = np.array(at, np.float32)
    return Eigenspace(
        np.zeros(16, np.float32), basis, np.ones(2), np.tile(place, (720, 1)), np.zeros(3),
        np.tile(place, (3, 1)), 2.0, 1,
    )  # fmt: skip


def test_zeta_reaches_half_of_the_way_to_another_parts_views_at_most() -> None:
    """Three parts at 0, 3 and 10: to the nearest it is 3, in units of the norm 1.5."""
    parts = [
        bare("a", [oblong()] * 3, 9.0, point_space(0, 0)),
        bare("b", [oblong()] * 3, 9.0, point_space(3, 0)),
        bare("c", [oblong()] * 3, 9.0, point_space(10, 0)),
    ]
    assert _separate(parts) == pytest.approx([0.75, 0.75, 1.75])
    assert _separate([replace(p, zeta=0.7) for p in parts]) == [0.7, 0.7, 0.7]
    assert _separate(parts[:1]) == [9.0]
    # Of its own name it may be as near as it is.
    assert _separate([parts[0], replace(parts[1], name="a"), parts[2]]) == pytest.approx(
        [2.5, 1.75, 1.75]
    )


def test_the_nearest_of_another_parts_views_bounds_zeta() -> None:
    odd = point_space(8, 0)
    odd = replace(odd, views=np.array([[8, 0], [3, 0], [8, 0]], np.float32))
    parts = [bare("a", [oblong()] * 3, 9.0, point_space(0, 0)), bare("b", [oblong()] * 3, 9.0, odd)]
    assert _separate(parts) == pytest.approx([0.75, 2.0])
    # A mean that is not 0 is part of a view.
    moved = replace(odd, mean=np.eye(16, dtype=np.float32)[0] * 2)
    parts = [parts[0], bare("b", [oblong()] * 3, 9.0, moved)]
    assert _separate(parts)[0] == pytest.approx(1.25)


def test_zeta_is_limited_in_the_database_as_it_is_in_the_report(
    views: dict[str, list[View]],
) -> None:
    larger = views_of(RECTANGLE * 1.04, STEP_DEG)
    close = make_database({"plate": views["plate"], "larger": larger}, "", SIDE, 0.99)
    for one, other in ((0, 1), (1, 0)):
        space = close.parts[other].space
        nearest = min(
            matches(close.parts[one].space, view @ space.basis + space.mean)[0].distance
            for view in space.views.astype(float)
        )
        assert close.parts[one].zeta <= nearest / 2 + 1e-12
    told = [close.report["parts"][name]["zeta"] for name in close.names]
    assert told == [part.zeta for part in close.parts]


def test_a_border_that_is_off_by_a_quarter_of_a_pixel_puts_a_view_so_far(
    views: dict[str, list[View]], database: Database
) -> None:
    """Of a disc, that is the distance to a disc whose radius is longer by that."""
    own, part = views["disc"], database.parts[1]
    surface = own[0].surface
    quarter_mm = 0.25 * surface.pixel_mm
    one = soft_view(surface, SIDE, database.mm_per_px)
    other = soft_view(surface, SIDE, database.mm_per_px / (1 + quarter_mm / 18.0))
    expected = np.linalg.norm(other - one) / part.space.norm
    found = _border_distance(own, part.space, database.mm_per_px)
    assert found == pytest.approx(expected, rel=0.03)


# -- surroundings and symmetry -------------------------------------------------------------------


def test_between_two_directions_a_turned_profile_is_mixed() -> None:
    profile = np.arange(36.0) ** 2
    np.testing.assert_array_equal(turn_profile(profile, 0), profile)
    np.testing.assert_array_equal(turn_profile(profile, 30), np.roll(profile, 3))
    np.testing.assert_array_equal(turn_profile(profile, -360), profile)
    quarter = turn_profile(profile, 2.5)
    # Direction 5 after a turn of a quarter step shows what was at 4.75.
    assert quarter[5] == pytest.approx(0.25 * 16 + 0.75 * 25)
    assert quarter[0] == pytest.approx(0.25 * 35**2)
    back = turn_profile(profile, -2.5)
    assert back[5] == pytest.approx(0.75 * 25 + 0.25 * 36)
    unknown = profile.copy()
    unknown[7] = np.nan
    assert np.flatnonzero(np.isnan(turn_profile(unknown, 10))).tolist() == [8]
    assert np.flatnonzero(np.isnan(turn_profile(unknown, 5))).tolist() == [7, 8]


def test_the_mean_profile_is_the_median_and_its_noise_the_views_deviation() -> None:
    rng = np.random.default_rng(1)
    base = np.arange(36.0)
    views = base + rng.normal(0, 0.5, (400, 36))
    views[:40] += 300.0
    views[:, 5] = np.nan
    middle, noise = _mean_profile(views)
    assert np.isnan(middle[5])
    known = np.arange(36) != 5
    np.testing.assert_allclose(middle[known], base[known], atol=0.2)
    assert noise == pytest.approx(0.5, rel=0.25)
    nothing, without = _mean_profile(np.full((3, 36), np.nan))
    assert np.isnan(nothing).all() and without == np.inf


def wave(times: int, height: float) -> np.ndarray:
    return height * np.cos(np.radians(times * 10.0 * np.arange(36)))


@pytest.mark.parametrize(
    ("order", "profile", "noise", "period"),
    [
        (1, wave(1, 9.0), 0.1, 360),
        (2, np.zeros(36), 0.1, 180),
        (6, np.zeros(36), 0.1, 60),
        (6, wave(6, 9.0), 0.1, 60),
        (6, wave(3, 9.0), 0.1, 120),
        (6, wave(2, 9.0), 0.1, 180),
        (6, wave(1, 9.0), 0.1, 360),
        (4, wave(3, 9.0), 0.1, 360),
        (2, np.full(36, np.nan), 0.1, 180),
        (2, np.where(np.arange(36) < 18, np.nan, wave(1, 9.0)), 0.1, 180),
    ],
)
def test_a_period_is_that_of_the_surface_and_of_what_lies_around_it(
    order: int, profile: np.ndarray, noise: float, period: float
) -> None:
    assert _period_deg(order, profile, noise) == period


@pytest.mark.parametrize(("noise", "told"), [(0.1, 0.5), (0.4, 0.5), (0.9, 0.9)])
@pytest.mark.parametrize(("share", "period"), [(0.98, 180), (1.02, 360)])
def test_surroundings_tell_two_turns_apart_over_three_times_their_noise(
    noise: float, told: float, share: float, period: float
) -> None:
    """After half a turn a wave of height h is √2 h off (rms); noise is half a mm or more."""
    height = share * 3 * told / np.sqrt(2)
    assert _period_deg(2, wave(1, height), noise) == period


# -- the file ------------------------------------------------------------------------------------


def test_everything_comes_back_from_the_file(database: Database, tmp_path: Path) -> None:
    marked = replace(
        database,
        parts=tuple(
            replace(
                part,
                profile=np.where(np.arange(36) == k, np.nan, np.arange(36.0) + k),
                profile_noise_mm=0.3 + k,
                body=np.arange(36) % (k + 2) == 0,
            )
            for k, part in enumerate(database.parts)
        ),
    )
    marked.save(tmp_path / "m.npz")
    back = Database.load(tmp_path / "m.npz")
    for name in ("phi", "side", "mm_per_px", "calibration", "report"):
        assert getattr(back, name) == getattr(marked, name), name
        assert type(getattr(back, name)) is type(getattr(marked, name)), name
    np.testing.assert_array_equal(back.mean, marked.mean)
    np.testing.assert_array_equal(back.deviation, marked.deviation)
    assert len(back.parts) == 3
    for one, other in zip(back.parts, marked.parts, strict=True):
        for entry in fields(Part):
            if entry.name != "space":
                np.testing.assert_array_equal(
                    getattr(one, entry.name), getattr(other, entry.name), err_msg=entry.name
                )
        for entry in fields(Eigenspace):
            np.testing.assert_array_equal(
                getattr(one.space, entry.name), getattr(other.space, entry.name), entry.name
            )
        assert isinstance(one.space.order, int)
    assert not list(tmp_path.glob("*.tmp")) and len(list(tmp_path.iterdir())) == 1
    again = tmp_path / "again.npz"
    back.save(again)
    assert again.read_bytes() == (tmp_path / "m.npz").read_bytes()


def rewritten(path: Path, **changed: Any) -> Path:
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    kept = {k: v for k, v in (arrays | changed).items() if v is not None}
    np.savez_compressed(path, **kept)
    return path


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({"format": np.array("other")}, "expected a defocus-models file, found arrays"),
        ({"version": np.array(2)}, "expected models version 1, found 2; run `workbench train`"),
        ({"part1_features": np.zeros((8, 3))}, r"expected features of disc \(8, 4\), found"),
        ({"part1_mean_image": np.zeros(9)}, r"expected mean_image of disc \(576,\), found \(9,\)"),
        ({"part0_eigenimages": np.zeros((2, 9))}, "expected eigenimages of plate"),
        ({"part0_variance": np.zeros(1)}, "expected variance of plate"),
        ({"part2_manifold": np.zeros((719, 2))}, "expected manifold of ell"),
        ({"part2_profile": np.zeros(35)}, r"expected profile of ell \(36,\), found \(35,\)"),
        ({"part2_body": np.zeros(35, bool)}, "expected body of ell"),
        ({"part2_numbers": np.zeros(4)}, r"expected numbers of ell \(5,\), found \(4,\)"),
        ({"part2_numbers": np.array([1, 1, np.nan, 1, 1])}, "expected numbers for ell, found some"),
        ({"part1_features": np.full((8, 4), np.inf)}, "expected numbers for disc, found some"),
        ({"names": np.array([], "U1")}, "expected one part or more, found none"),
        ({"mean": np.zeros(3)}, "expected a mean and a deviation of 4 features"),
        ({"deviation": np.zeros(5)}, "expected a mean and a deviation of 4 features"),
        ({"part0_left_out": None}, "damaged or not one"),
        ({"phi": None}, "damaged or not one"),
        ({"image": np.array([24.0])}, "damaged or not one"),
    ],
)
def test_a_file_that_is_not_what_it_should_be_is_refused_in_a_line(
    database: Database, tmp_path: Path, changed: dict[str, Any], says: str
) -> None:
    path = tmp_path / "m.npz"
    database.save(path)
    with pytest.raises(ValueError, match=rf"^{says}[^\n]*$|^[^\n]*{says}[^\n]*$"):
        Database.load(rewritten(path, **changed))


def calibration(curve: np.ndarray, near: float = 0.7, far: float = 0.8) -> Any:
    return SimpleNamespace(curve=curve, near_z_m=near, far_z_m=far)


def test_a_calibration_is_known_by_its_numbers() -> None:
    curve = np.random.default_rng(0).random((3, 64, 64)).astype(np.float32)
    own = calibration_digest(calibration(curve))
    assert calibration_digest(None) == "" and len(own) > 8
    assert calibration_digest(calibration(curve.copy())) == own
    changed = curve.copy()
    changed[2, 48, 16] += 1e-3
    others = {
        calibration_digest(calibration(changed)),
        calibration_digest(calibration(curve, 0.71)),
        calibration_digest(calibration(curve, 0.7, 0.81)),
        calibration_digest(calibration(curve, 0.8, 0.7)),
    }
    assert len(others) == 4 and own not in others


def test_parts_that_were_seen_with_another_calibration_are_refused(database: Database) -> None:
    curve = np.ones((3, 64, 64), np.float32)
    own = calibration(curve)
    bound = replace(database, calibration=calibration_digest(own))
    bound.check_calibration(own)
    bound.check_calibration(None)
    replace(database, calibration="").check_calibration(own)
    other = calibration(curve, 0.71)
    found, known = calibration_digest(other)[:8], bound.calibration[:8]
    with pytest.raises(ValueError) as refused:
        bound.check_calibration(other)
    assert str(refused.value) == (
        f"models were trained with calibration {known}, this is {found}: run `workbench train` "
        "with this calibration"
    )

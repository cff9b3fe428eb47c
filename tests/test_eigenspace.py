"""Eigenspaces on curves that are known: the nearest point, the manifold, symmetry, outlines."""

from __future__ import annotations

import numpy as np
import pytest
from face_scenes import ELL, RECTANGLE, face
from scipy.fft import irfft2

from workbench_stages.matching.eigenspace import (
    Eigenspace,
    _left_out,
    _order,
    build,
    match,
    matches,
    turned_views,
)
from workbench_stages.matching.surfaces import Surface, soft_view

DEGREES = np.arange(720) / 2
SIDE = 4
PIXELS = SIDE * SIDE


def circle(turns: float = 1.0, radius: float = 1.0) -> np.ndarray:
    angle = np.radians(turns * DEGREES)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def space_of(manifold: np.ndarray, norm: float = 1.0, order: int = 1) -> Eigenspace:
    """A manifold in the first pixels of an image of 4 by 4, about a mean that is not 0."""
    kept = manifold.shape[1]
    return Eigenspace(
        np.linspace(0.1, 0.4, PIXELS).astype(np.float32),
        np.eye(PIXELS, dtype=np.float32)[:kept],
        np.full(kept, 1 / kept),
        manifold.astype(np.float32),
        np.array([0.0, 120.0, 240.0]),
        manifold[[0, 240, 480]].astype(np.float32),
        norm,
        order,
    )


def image_at(space: Eigenspace, *inside: float, outside: float = 0.0) -> np.ndarray:
    image = space.mean.astype(float).copy()
    image[: len(inside)] += inside
    image[-1] += outside
    return image.reshape(SIDE, SIDE)


# -- the nearest point of a manifold -------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.2, 33.13, 90.0, 179.87, 270.4, 359.76, 359.95])
@pytest.mark.parametrize(("radius", "norm"), [(1.0, 1.0), (1.3, 4.0), (0.6, 0.5)])
def test_the_nearest_point_of_a_circle_is_found_below_its_step(
    angle: float, radius: float, norm: float
) -> None:
    space = space_of(circle(), norm)
    at = np.radians(angle)
    image = image_at(space, radius * np.cos(at), radius * np.sin(at), outside=0.25)
    found = matches(space, image)
    assert len(found) == 1 and found[0] == match(space, image)
    turned = (found[0].rotation_deg - angle + 180) % 360 - 180
    assert turned == pytest.approx(0, abs=0.02) and 0 <= found[0].rotation_deg < 360
    assert found[0].within == pytest.approx(abs(radius - 1) / norm, abs=2e-3 / norm)
    assert found[0].distance == pytest.approx(np.hypot(radius - 1, 0.25) / norm, rel=2e-3)


def test_every_valley_is_found_and_the_nearest_is_first() -> None:
    """From a point off the middle of an ellipse there are two nearest points, at its flat sides."""
    space = space_of(circle() * [3.0, 1.0], 2.0)
    for up, first in ((0.2, 90.0), (-0.2, 270.0)):
        image = image_at(space, 0.0, up)
        found = matches(space, image)
        assert [m.rotation_deg for m in found] == pytest.approx([first, (first + 180) % 360])
        assert [m.distance for m in found] == pytest.approx([0.4, 0.6], abs=1e-3)
        assert match(space, image) == found[0]


@pytest.mark.parametrize(("apart", "count"), [(18.0, 2), (22.0, 1)])
def test_of_valleys_that_lie_side_by_side_only_the_nearest_counts(apart: float, count: int) -> None:
    """Two dents in the distance, ``apart`` degrees from each other, against 20 degrees."""
    depth = np.ones(720)
    for middle, low in ((100.0, 0.2), (100.0 + apart, 0.4)):
        near = np.abs(DEGREES - middle) < 5
        depth[near] = low + 0.1 * np.abs(DEGREES - middle)[near] / 5
    space = space_of(depth[:, None])
    found = matches(space, image_at(space, 0.0), apart_deg=20.0)
    assert found[0].rotation_deg == pytest.approx(100.0, abs=0.3)
    near = [m for m in found if abs(m.rotation_deg - 100 - apart) < 1]
    assert len(near) == 2 - count
    wide = matches(space, image_at(space, 0.0), apart_deg=apart + 1)
    assert not [m for m in wide if abs(m.rotation_deg - 100 - apart) < 1]


def test_valleys_are_apart_also_across_the_full_turn() -> None:
    depth = np.ones(720)
    depth[[716, 717, 718]] = 0.5, 0.2, 0.5
    depth[[3, 4, 5]] = 0.6, 0.3, 0.6
    found = matches(space_of(depth[:, None]), image_at(space_of(depth[:, None]), 0.0))
    assert found[0].rotation_deg == pytest.approx(358.5)
    assert not [m for m in found if m.rotation_deg < 20]


def test_where_every_turn_is_as_near_the_first_is_given() -> None:
    space = space_of(np.full((720, 1), 0.5), 2.0)
    (only,) = matches(space, image_at(space, 0.1, outside=0.3))
    assert only.rotation_deg == 0
    assert only.within == pytest.approx(0.2)
    assert only.distance == pytest.approx(0.25)


# -- symmetry ------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3, 5, 6, 7, 8, 11, 12])
def test_a_curve_that_is_run_through_many_times_in_a_turn_says_how_many(order: int) -> None:
    assert _order(circle(order), np.full(6, 0.01)) == order


def test_more_than_twelve_times_is_not_asked_for() -> None:
    assert _order(circle(13), np.full(6, 0.01)) == 1
    assert _order(circle(24), np.full(6, 0.01)) == 12


@pytest.mark.parametrize(("share", "order"), [(0.9, 2), (1.1, 1)])
def test_a_curve_repeats_within_twice_the_noise_of_its_views(share: float, order: int) -> None:
    """What is opposite after half a turn is 2 · share · noise away; the noise is a rms."""
    noise = 0.05
    odd = share * noise
    manifold = np.concatenate([circle(2), circle(1, odd)], axis=1)
    assert _order(manifold, np.full(4, noise)) == order
    assert _order(manifold, np.array([noise * np.sqrt(2), 0.0])) == order
    assert _order(manifold, np.zeros(0)) == 1


# -- outlines ------------------------------------------------------------------------------------


def test_an_outline_is_that_of_the_nearest_of_the_720_points() -> None:
    manifold = np.zeros((720, 2))
    manifold[90] = 0.45, 0.0
    manifold[719] = 0.0, 0.45
    space = space_of(manifold)
    for turn, pixel in ((45.0, 0), (45.2, 0), (405.0, 0), (-315.0, 0), (359.5, 1), (-0.5, 1)):
        outline = space.outline(turn)
        assert outline.shape == (SIDE, SIDE) and outline.dtype == np.float32
        assert np.flatnonzero(outline).tolist() == [pixel], turn
        assert outline.max() == 1
    for turn in (44.5, 45.5, 0.0, 359.8):
        assert not space.outline(turn).any()


def test_half_grey_is_outside_and_a_finer_outline_has_as_much_of_it() -> None:
    space = space_of(np.zeros((720, 1)))
    mean = np.zeros((SIDE, SIDE), np.float32)
    mean[1:3, 1:3] = 1.0
    mean[0, 0] = 0.5
    space = Eigenspace(
        mean.ravel(),
        space.basis,
        space.variance,
        space.manifold,
        space.views_deg,
        space.views,
        1,
        1,
    )
    assert space.outline(0.0).sum() == 4
    fine = space.outline(0.0, 3)
    assert fine.shape == (3 * SIDE, 3 * SIDE)
    assert set(np.unique(fine)) == {0, 1}
    assert fine[3:9, 3:9].sum() == pytest.approx(36, abs=4) == fine.sum()


@pytest.mark.parametrize(("area", "odd", "mirrored"), [(19, 1, True), (21, 1, False)])
def test_a_mirror_image_that_differs_by_a_tenth_is_another_surface(
    area: int, odd: int, mirrored: bool
) -> None:
    """Symmetric but for one pixel: in the mirror two pixels differ, of ``area``."""
    side = 8
    mask = np.zeros((side, side), np.float32)
    pairs = [(y, x) for y in range(side) for x in range(side // 2)][: (area - odd) // 2]
    for y, x in pairs:
        mask[y, x] = mask[y, side - 1 - x] = 1
    mask[7, 1] = 1
    assert mask.sum() == area
    space = Eigenspace(
        mask.ravel(), np.zeros((1, side * side), np.float32), np.ones(1),
        np.zeros((720, 1), np.float32), np.zeros(3), np.zeros((3, 1), np.float32), 1.0, 12,
    )  # fmt: skip
    outlines = space.outlines
    turns = [0.0, 10.0, 20.0]
    assert outlines.turn_deg.tolist() == turns * (2 if mirrored else 1)
    assert outlines.mirrored.tolist() == [False] * 3 + [True] * (3 if mirrored else 0)
    np.testing.assert_array_equal(outlines.area_px, area)
    assert outlines.size >= 2 * side
    shown = irfft2(np.conj(outlines.spectra), (outlines.size, outlines.size))[:, :side, :side]
    for picture, flipped in zip(shown, outlines.mirrored, strict=True):
        expected = mask[:, ::-1] if flipped else mask
        np.testing.assert_allclose(picture, expected, atol=1e-4)


# -- views and what is built of them -------------------------------------------------------------

SMALL, SCALE = 24, 4.0


@pytest.fixture(scope="module")
def two() -> tuple[Surface, Surface]:
    """Two faces that cannot be taken for each other."""
    return face(ELL), face(RECTANGLE)


@pytest.mark.parametrize(
    ("at", "first", "second", "share"),
    [
        (10.0, 10.0, -30.0, 0.25),
        (30.0, 30.0, -10.0, 0.75),
        (0.0, 0.0, None, 0.0),
        (40.0, None, 0.0, 1.0),
        (120.0, 120.0, 80.0, 0.75),
        (360.0 + 280.0, -80.0, -120.0, 0.25),
    ],
)
@pytest.mark.parametrize("swapped", [False, True])
def test_between_two_views_both_are_turned_the_rest_of_the_way_and_mixed_by_nearness(
    two: tuple[Surface, Surface],
    at: float,
    first: float | None,
    second: float | None,
    share: float,
    swapped: bool,
) -> None:
    """One view at 0°, the other at 40°, in either order; ``share`` is the second one's."""
    angles = np.array([0.0, 40.0])
    views = list(two)
    if swapped:
        angles, views = angles[::-1], views[::-1]
    expected = np.zeros((SMALL, SMALL))
    for surface, turn, weight in ((two[0], first, 1 - share), (two[1], second, share)):
        if turn is not None:
            expected += weight * soft_view(surface, SMALL, SCALE, turn)
    (found,) = turned_views(views, angles, np.array([at]), SMALL, SCALE)
    np.testing.assert_allclose(found.reshape(SMALL, SMALL), expected, atol=1e-5)


def test_one_view_alone_is_turned_all_the_way(two: tuple[Surface, Surface]) -> None:
    found = turned_views([two[0]], np.array([30.0]), np.array([30.0, 120.0]), SMALL, SCALE)
    for image, turn in zip(found, (0.0, 90.0), strict=True):
        expected = soft_view(two[0], SMALL, SCALE, turn).ravel()
        np.testing.assert_allclose(image, expected, atol=1e-5)


ANGLES = np.arange(0.0, 360.0, 30.0)


@pytest.fixture(scope="module")
def ells() -> list[Surface]:
    return [face(ELL, angle) for angle in ANGLES]


@pytest.fixture(scope="module")
def built(ells: list[Surface]) -> Eigenspace:
    return build(ells, ANGLES, SMALL, SCALE, 0.99)[0]


def test_an_eigenspace_is_orthonormal_and_holds_the_share_that_was_asked_for(
    ells: list[Surface], built: Eigenspace
) -> None:
    rows = built.basis.astype(float)
    np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), atol=1e-5)
    assert (np.diff(built.variance) <= 0).all()
    assert built.variance.sum() >= 0.99 > built.variance[:-1].sum()
    few = build(ells, ANGLES, SMALL, SCALE, 0.5)[0]
    assert few.variance.sum() >= 0.5 > few.variance[:-1].sum()
    np.testing.assert_allclose(few.variance, built.variance[: len(few.basis)])
    # Of each eigenimage the greatest pixel is positive, whatever the solver gave.
    assert (rows.max(axis=1) >= -rows.min(axis=1) - 1e-6).all()


def test_all_of_the_variance_is_never_more_than_the_set_has(ells: list[Surface]) -> None:
    whole = build(ells, ANGLES, SMALL, SCALE, 1.0)[0]
    assert whole.variance.sum() == pytest.approx(1)
    assert len(whole.basis) <= 72 and (whole.variance > 1e-9).all()
    np.testing.assert_allclose(
        whole.basis.astype(float) @ whole.basis.T, np.eye(len(whole.basis)), atol=1e-4
    )


def test_mean_norm_and_projections_are_those_of_the_set_filled_up_to_five_degrees(
    ells: list[Surface], built: Eigenspace
) -> None:
    images = turned_views(ells, ANGLES, np.arange(0, 360, 5.0), SMALL, SCALE).astype(float)
    mean = images.mean(axis=0)
    np.testing.assert_allclose(built.mean, mean, atol=1e-6)
    assert built.norm == pytest.approx(np.sqrt((images**2).sum(axis=1).mean()))
    centred = images - mean
    variance = (centred @ built.basis.T.astype(float)).var(axis=0) / (centred**2).sum(axis=1).mean()
    np.testing.assert_allclose(variance, built.variance, rtol=1e-3)
    # The curve runs through every image's projection, half a degree a point.
    np.testing.assert_allclose(built.manifold[::10], centred @ built.basis.T, atol=1e-3)
    own = np.array([soft_view(s, SMALL, SCALE).ravel() for s in ells]) - mean
    np.testing.assert_allclose(built.views, own @ built.basis.T, atol=1e-4)
    np.testing.assert_array_equal(built.views_deg, ANGLES)
    assert built.manifold.shape[0] == 720 and built.side == SMALL
    # It is closed: the last step, to the first point, is a step like the others.
    step = np.linalg.norm(built.manifold - np.roll(built.manifold, 1, axis=0), axis=1)
    assert step[0] == pytest.approx(np.median(step[-9:]), rel=0.2)


def test_the_manifold_starts_at_no_turn_wherever_the_views_start(
    ells: list[Surface], built: Eigenspace
) -> None:
    """Views that were taken from 130° on, angles beyond a turn, and none at 0°."""
    order = np.roll(np.arange(12), -5)
    shifted = build([ells[k] for k in order], ANGLES[order] - 360, SMALL, SCALE, 0.99)[0]
    np.testing.assert_allclose(np.sort(shifted.views_deg), ANGLES)
    np.testing.assert_allclose(shifted.manifold, built.manifold, atol=1e-3)


@pytest.mark.parametrize("rotation", [7.0, 128.0, 352.0])
def test_a_turn_between_the_views_is_found_on_the_manifold(
    built: Eigenspace, rotation: float
) -> None:
    found = match(built, soft_view(face(ELL, rotation), SMALL, SCALE))
    assert found.rotation_deg == pytest.approx(rotation, abs=1.5)
    assert found.distance < 0.1
    assert match(built, soft_view(face(RECTANGLE, rotation), SMALL, SCALE)).distance > 0.2


def test_views_a_hair_from_a_filled_angle_do_not_bend_the_curve(ells: list[Surface]) -> None:
    """At 0.02° and at 59.99° views were taken, beside the filled 0° and 60°."""
    hair = ANGLES + np.where(np.arange(12) % 2, 0.02, -0.01)
    near = build(ells, hair, SMALL, SCALE, 0.99)[0]
    step = np.linalg.norm(near.manifold - np.roll(near.manifold, 1, axis=0), axis=1)
    assert step.max() < 2.5 * np.median(step)
    assert near.order == 1


def test_each_view_is_held_against_what_the_others_say(two: tuple[Surface, Surface]) -> None:
    """Views of one face agree; one that shows another face does not, and pulls its neighbours."""
    views = [face(ELL, angle) for angle in (0.0, 90.0, 180.0, 270.0)]
    angles = np.array([0.0, 90.0, 180.0, 270.0])
    own = np.array([soft_view(s, SMALL, SCALE).ravel() for s in views], float)
    good = _left_out(views, angles, own, SMALL, SCALE)
    assert good.shape == (4,) and good.max() < 0.5
    views[2] = two[1]
    own[2] = soft_view(two[1], SMALL, SCALE).ravel()
    bad = _left_out(views, angles, own, SMALL, SCALE)
    others = [views[k] for k in (0, 1, 3)]
    (said,) = turned_views(others, angles[[0, 1, 3]], np.array([180.0]), SMALL, SCALE)
    assert bad[2] == pytest.approx(np.linalg.norm(own[2] - said), rel=1e-5)
    assert bad[2] > bad[1] > 1 > bad[0]
    assert _left_out(views[:2], angles[:2], own[:2], SMALL, SCALE).tolist() == [0, 0]
    assert _left_out(views[1:], angles[1:], own[1:], SMALL, SCALE).min() > 0


def test_the_distances_that_are_left_out_are_shares_of_the_norm() -> None:
    angles = np.array([0.0, 90.0, 180.0, 270.0])
    views = [face(ELL), face(ELL, 90.0), face(RECTANGLE), face(ELL, 270.0)]
    space, left_out = build(views, angles, SMALL, SCALE)
    own = np.array([soft_view(s, SMALL, SCALE).ravel() for s in views], float)
    np.testing.assert_allclose(
        left_out * space.norm, _left_out(views, angles, own, SMALL, SCALE), rtol=1e-9
    )


def test_symmetry_is_that_of_the_face() -> None:
    views = [face(RECTANGLE, angle) for angle in ANGLES]
    assert build(views, ANGLES, SMALL, SCALE)[0].order == 2


def test_unless_told_otherwise_a_space_keeps_98_percent_of_a_set_filled_to_five_degrees(
    ells: list[Surface],
) -> None:
    said = build(ells, ANGLES, SMALL, SCALE, 0.98, 5.0)[0]
    np.testing.assert_array_equal(build(ells, ANGLES, SMALL, SCALE)[0].manifold, said.manifold)

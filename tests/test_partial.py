"""A part's outline laid over what shows of it: what is free, what is hidden, whose it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from face_scenes import ELL, RECTANGLE, Scene, face, plate_and_ell

from workbench_stages.matching.database import Database
from workbench_stages.matching.eigenspace import Outlines
from workbench_stages.matching.partial import (
    Visible,
    _around,
    _coarse,
    _fit,
    _kinds,
    name_by_what_shows,
)
from workbench_stages.matching.surfaces import Surface, features_mm, upright_view


@pytest.fixture(scope="module")
def database() -> Database:
    return plate_and_ell()


def shown(
    database: Database, scene: Scene, label: int, most_hidden: float = 0.2, **changed: object
) -> Visible:
    surface = replace(scene.surface(label)[1], **changed)  # type: ignore[arg-type]
    return name_by_what_shows(surface, label, scene.labels, scene.depth, database, most_hidden)


# -- when a name is given ------------------------------------------------------------------------

RIGHT = Visible(model=1, hidden_share=0.1, misfit=0.05, next_misfit=0.2, allowed=0.1)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({}, True),
        ({"model": 0}, True),
        ({"model": -1}, False),
        ({"hidden_share": 0.2}, True),
        ({"hidden_share": 0.201}, False),
        ({"hidden_share": np.nan}, False),
        ({"misfit": 0.1}, True),
        ({"misfit": 0.101}, False),
        ({"next_misfit": 0.15}, False),
        ({"next_misfit": 0.151}, True),
        ({"next_misfit": np.inf}, True),
        ({"allowed": np.nan}, False),
    ],
)
def test_a_name_is_given_to_what_fits_and_to_nothing_that_could_be_another(
    changed: dict[str, float], named: bool
) -> None:
    """0.2 may be hidden; the border allows 0.1, and the next part must be 1.5 times that off."""
    assert replace(RIGHT, **changed).names(0.2) == named


# -- which parts are tried -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("most_hidden", "by", "tried"),
    [
        (0.2, ("least", 1.001), True),
        (0.2, ("least", 0.999), False),
        (0.4, ("least", 1.001), True),
        (0.4, ("least", 0.999), False),
        (0.2, ("most", 0.999), True),
        (0.2, ("most", 1.001), False),
    ],
)
def test_a_part_is_tried_if_its_area_is_possible(
    database: Database, most_hidden: float, by: tuple[str, float], tried: bool
) -> None:
    """As large as it is or smaller by what may be hidden, give or take 0.4 px of its border."""
    alone = replace(database, parts=database.parts[:1])
    scene = Scene()
    label = scene.add(RECTANGLE, 0.0)
    surface = scene.surface(label)[1]
    area, perimeter = np.median(alone.parts[0].features[:, :2], axis=0)
    slack = 0.4 * surface.pixel_mm * perimeter
    limit = (1 - most_hidden) * area - slack if by[0] == "least" else area + slack
    found = shown(alone, scene, label, most_hidden, area_mm2=by[1] * limit)
    assert (found.model >= 0) == tried
    if tried:
        assert found.allowed == pytest.approx(slack / area) and found.next_misfit == np.inf
    else:
        assert np.isnan(found.hidden_share) and np.isnan(found.allowed)
        assert found.misfit == found.next_misfit == np.inf


def test_the_part_that_fits_best_is_first_and_the_next_is_told(database: Database) -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 30.0)
    found = shown(database, scene, label)
    turned = replace(database, parts=database.parts[::-1])
    again = shown(turned, scene, label)
    assert (found.model, again.model) == (0, 1)
    assert found.misfit == again.misfit < found.allowed
    assert found.next_misfit == again.next_misfit > 1.5 * found.allowed
    assert abs(found.hidden_share) < 0.03
    assert found.names(0.2)
    scene = Scene()
    label = scene.add(ELL, 30.0)
    assert shown(database, scene, label).model == 1


# -- what is hidden ------------------------------------------------------------------------------


@pytest.mark.parametrize("turn", [0.0, 77.0, 200.0])
@pytest.mark.parametrize("hidden", [0.08, 0.19])
@pytest.mark.parametrize(("tilt", "towards"), [(0.0, 0.0), (20.0, 110.0)])
def test_as_much_is_said_to_be_hidden_as_is(
    database: Database, turn: float, hidden: float, tilt: float, towards: float
) -> None:
    """An end of a plate of 50 mm lies under something nearer, or beyond the image's border."""
    shorter = RECTANGLE.copy()
    shorter[[0, 3], 0] += hidden * 0.05
    scene = Scene()
    place = ((0.004, -0.006, 0.775), tilt, towards)
    whole = scene.add(RECTANGLE, turn, *place)
    label = scene.add(shorter, turn, *place)
    over = scene.labels == whole
    scene.depth[over] -= 0.02
    found = shown(database, scene, label)
    assert found.model == 0
    assert found.hidden_share == pytest.approx(hidden, abs=0.04)
    assert found.misfit < found.allowed


def test_where_something_is_seen_behind_the_plane_the_part_cannot_go_on(
    database: Database,
) -> None:
    """The same short plate, beside which the table is seen: it is no plate of the database."""
    shorter = RECTANGLE.copy()
    shorter[[0, 3], 0] += 0.12 * 0.05
    scene = Scene()
    label = scene.add(shorter, 30.0)
    found = shown(database, scene, label)
    assert found.misfit > found.allowed and not found.names(0.2)


@pytest.mark.parametrize(
    ("above_mm", "free"), [(1.9, True), (2.1, False), (-5.0, True), (np.nan, False)]
)
def test_what_is_free_is_seen_and_not_nearer_than_the_plane_by_2_mm(
    above_mm: float, free: bool
) -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 0.0, (0.005, -0.01, 0.775), 15.0, 200.0)
    surface = scene.surface(label)[1]
    rx, ry = scene.camera.rays(*np.mgrid[:256, :256][::-1].astype(float))
    plane = surface.normal @ surface.origin_m
    slant = surface.normal[0] * rx + surface.normal[1] * ry + surface.normal[2]
    around = scene.labels != label
    scene.depth[around] = (plane / slant - 1e-3 * above_mm)[around]
    region, seen = _kinds(surface, label, scene.labels, scene.depth, 81, 1.0)
    np.testing.assert_array_equal(region, upright_view(surface, 81, 1.0) > 0.5)
    assert region.dtype == seen.dtype == np.float32
    assert not (region * seen).any()
    assert region.sum() == pytest.approx(1500, rel=0.02)
    if free:
        # All but the softened rim, whose pixels are the region's by their label.
        assert (region + seen).mean() > 0.97
    else:
        assert not seen.any()


def test_neither_the_outside_of_the_image_nor_what_has_no_label_is_free() -> None:
    scene = Scene()
    label = scene.add(RECTANGLE, 0.0, (-0.06, 0.0, 0.775))
    scene.labels[:100] = 0
    surface = scene.surface(label)[1]
    region, free = _kinds(surface, label, scene.labels, scene.depth, 81, 1.0)
    column = 40 - round(1e3 * (surface.origin_m[0] + 127.5 / 1300 * 0.775))
    assert not free[:, : column - 1].any() and not region[:, : column - 1].any()
    row = 40 - round(1e3 * (27.5 / 1300 * 0.775 + surface.origin_m[1]))
    assert not free[: row - 1].any()
    assert free[row + 2 : 80, column + 30 : 80].mean() > 0.8


# -- laying an outline over what shows -----------------------------------------------------------


def test_an_image_is_moved_back_by_its_place_and_a_little_each_way() -> None:
    image = np.zeros((7, 7), np.float32)
    image[4, 5] = 1.0
    moved = _around(image, 1, -2).reshape(5, 5, 7, 7)
    # Back by one down and two to the left: up by one, to the right by two.
    assert moved[2, 2].sum() == 0  # column 7 is outside
    moved = _around(image, 1, 2).reshape(5, 5, 7, 7)
    for i in range(5):
        for j in range(5):
            (row,), (column,) = np.nonzero(moved[i, j])
            assert (row, column) == (4 - 1 - (i - 2), 5 - 2 - (j - 2))


class Shapes:
    """Stands for an eigenspace: outlines of 6 by 6, each at a turn of its own."""

    def __init__(self, masks: list[np.ndarray]) -> None:
        stack = np.stack(masks).astype(np.float32)
        size = 16
        count = len(masks)
        self.outlines = Outlines(
            10.0 * np.arange(count), np.arange(count) % 2 == 1, stack.sum(axis=(1, 2)),
            np.conj(np.fft.rfft2(stack, (size, size))), size,
        )  # fmt: skip


@pytest.mark.parametrize("place", [(0, 0), (2, 1), (-1, 1), (-2, -1), (1, -1)])
def test_all_turns_and_places_are_tried(place: tuple[int, int]) -> None:
    bar, square = np.zeros((2, 6, 6))
    bar[2, 1:5] = 1
    square[2:4, 2:4] = 1
    down, right = place
    for k, mask in enumerate((bar, square)):
        wanted = np.roll(mask, (down, right), (0, 1)).astype(np.float32)
        shapes = Shapes([bar, square])
        assert _coarse(shapes, wanted) == (10.0 * k, k == 1, down, right)  # type: ignore[arg-type]


def test_of_outlines_that_gain_as_much_the_smaller_one_fits_better() -> None:
    small, large = np.zeros((2, 6, 6))
    small[2:4, 2:4] = 1
    large[1:5, 1:5] = 1
    wanted = small.astype(np.float32)
    assert _coarse(Shapes([large, small]), wanted)[0] == 10.0  # type: ignore[arg-type]
    assert _coarse(Shapes([small, large]), wanted)[0] == 0.0  # type: ignore[arg-type]
    # Where it must not be it costs what it gains elsewhere.
    wanted = large.astype(np.float32)
    assert _coarse(Shapes([small, large]), wanted)[0] == 10.0  # type: ignore[arg-type]
    wanted[small == 0] = -1
    assert _coarse(Shapes([small, large]), wanted)[0] == 0.0  # type: ignore[arg-type]


def test_misfit_is_what_is_not_covered_and_what_is_covered_wrongly(database: Database) -> None:
    """Of a plate's outline laid over its own region, with a block free that it must cover."""
    side, mm = 3 * database.side, database.mm_per_px / 3
    space = database.parts[0].space
    surface: Surface = face(RECTANGLE, 40.0)
    region = (upright_view(surface, side, mm) > 0.5).astype(np.float32)
    nothing = np.zeros_like(region)
    misfit, hidden = _fit(space, region, nothing)
    assert misfit < 0.02 and abs(hidden) < 0.02
    area = region.sum()
    far = region.copy()
    far[:4, :4] = 1.0
    more, _ = _fit(space, far, nothing)
    assert more == pytest.approx(misfit + 16 / area, abs=0.01)
    middle = slice(side // 2 - 5, side // 2 + 5)
    holed, free = region.copy(), nothing.copy()
    holed[middle, middle], free[middle, middle] = 0.0, 1.0
    wrong, seen = _fit(space, holed, free)
    assert wrong == pytest.approx(misfit + 100 / area, abs=0.02)
    # What is free is seen, and so not hidden; what is neither is.
    assert seen == pytest.approx(hidden, abs=0.02)
    _, unseen = _fit(space, holed, nothing)
    assert unseen == pytest.approx(hidden + 100 / area, abs=0.02)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_part_that_was_turned_over_fits_by_its_mirror_image(
    database: Database, sign: int
) -> None:
    scene = Scene()
    label = scene.add(ELL * [sign, 1], 73.0)
    found = shown(database, scene, label)
    assert found.model == 1 and found.misfit < 0.04 < 0.3 < found.next_misfit
    assert features_mm(scene.surface(label)[1])[0] == pytest.approx(1420, rel=0.02)

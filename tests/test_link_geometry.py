"""Linking against a plain reference on random lines, and both sides of each of its limits."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from skimage.morphology import skeletonize

from workbench_stages.edges.linking import (
    TERMINATOR_MASKS,
    Step,
    _corners,
    bresenham,
    link,
    path_offset,
    reconstruct,
    terminators_of,
)

RING = ((0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1))
ALONE = {"border": False, "corners": 0.0, "max_cost": 1e6}


# -- reconstruction --------------------------------------------------------------------------------


def row(*pixels: int, shape: tuple[int, int] = (256, 256), y: int = 9) -> np.ndarray:
    image = np.zeros(shape, bool)
    image[y, list(pixels)] = True
    return image


@pytest.mark.parametrize(
    ("strength", "most", "kept"),
    [(2.4, 3.0, False), (2.5, 3.0, True), (9.0, 3.0, True), (9.0, 2.4, False), (9.0, 2.5, True)],
)
def test_a_pixel_weighs_its_strength_but_never_more_than_most(
    strength: float, most: float, kept: bool
) -> None:
    """Five pixels that must weigh more than twelve together."""
    finer, none = row(*range(20, 25)), row()
    given = np.where(finer, np.float32(strength * 0.5), np.float32(0))
    done = reconstruct(none, none, finer, given, min_weight=12.0, unit=0.5, most=most)
    assert done.edges.sum() == (5 if kept else 0)
    weight = 5 * min(strength, most)
    assert done.value[9, 22] == pytest.approx(5 if kept else weight, abs=0.03)
    assert done.step[9, 22] == (Step.HIGH if kept else Step.FAINT_HIGH)


@pytest.mark.parametrize(("dx", "dy"), [*RING, (2, 0), (0, 2), (-2, 1), (2, 2)])
def test_a_segment_that_touches_what_is_kept_stays_however_short_and_faint(
    dx: int, dy: int
) -> None:
    low = row(100)
    finer = low.copy()
    finer[9 + dy, 100 + dx] = True
    strength = np.full(low.shape, 0.01, np.float32)
    for medium in (low, finer):
        done = reconstruct(low, medium, finer, strength, min_weight=12.0)
        assert bool(done.edges[9 + dy, 100 + dx]) == (max(abs(dx), abs(dy)) == 1)


def test_the_second_iteration_builds_on_the_first() -> None:
    """A pixel of high resolution beside one of medium, which itself touches nothing low."""
    low, medium, high = row(), row(*range(20, 25)), row(*range(20, 26))
    done = reconstruct(low, medium, high)
    np.testing.assert_array_equal(done.difference_medium, medium)
    np.testing.assert_array_equal(done.first, medium)
    np.testing.assert_array_equal(done.difference_high, row(25))
    np.testing.assert_array_equal(done.edges, high)
    assert (done.step[9, 20:25] == Step.MEDIUM).all()
    assert (done.value[9, 20:25] == 5).all()
    assert done.step[9, 25] == Step.HIGH
    assert done.value[9, 25] == 1


def test_pixels_that_no_iteration_looks_at_tell_their_strength() -> None:
    low, high = row(3, 4), row(3, 4)
    strength = np.random.default_rng(0).random(low.shape).astype(np.float32)
    thin, peak = row(3, 4, 50), np.where(low, np.float32(7), np.float32(0))
    done = reconstruct(low, low, high, strength, thin, peak)
    assert (done.step[9, 3:5] == Step.LOW).all()
    assert (done.value[9, 3:5] == 7).all()
    assert done.step[9, 50] == Step.WEAK
    assert done.step[9, 51] == Step.NOTHING
    np.testing.assert_array_equal(done.value[9, 50:], strength[9, 50:])


def test_what_cannot_be_put_together_is_refused() -> None:
    image = np.zeros((4, 5), bool)
    for stack in ((image, image, image[:3]), (image, image[:, :4], image)):
        with pytest.raises(ValueError, match="differ in shape"):
            reconstruct(*stack)
    with pytest.raises(ValueError, match="needs the strength"):
        reconstruct(image, image, image, min_weight=0.1)


def test_the_steps_have_the_numbers_that_files_hold() -> None:
    wanted = {
        "NOTHING": 0, "WEAK": 1, "SHORT_MEDIUM": 2, "SHORT_HIGH": 3, "FAINT_MEDIUM": 4,
        "FAINT_HIGH": 5, "BACKGROUND": 6, "LOW": 10, "MEDIUM": 11, "HIGH": 12, "LINK": 20,
        "BORDER": 21, "CREASE": 30, "FOOT": 31,
    }  # fmt: skip
    assert {step.name: int(step) for step in Step} == wanted


# -- terminators and directions --------------------------------------------------------------------


def test_a_terminator_has_one_neighbour_or_two_side_by_side() -> None:
    """All 256 surroundings of a pixel."""
    ends = set()
    for code in range(256):
        neighbours = [k for k in range(8) if code >> k & 1]
        edges = np.zeros((5, 5), bool)
        edges[2, 2] = True
        for k in neighbours:
            edges[2 + RING[k][1], 2 + RING[k][0]] = True
        gap = (neighbours[-1] - neighbours[0]) % 8 if len(neighbours) == 2 else 0
        wanted = len(neighbours) == 1 or (len(neighbours) == 2 and gap in (1, 7))
        position, _ = terminators_of(edges)
        assert ([2, 2] in position.tolist()) == wanted
        if wanted:
            ends.add(edges[1:4, 1:4].tobytes())
    assert {mask.astype(bool).tobytes() for mask in TERMINATOR_MASKS} == ends
    assert len(ends) == 16


@pytest.mark.parametrize(
    ("line", "way"),
    [
        ([(10 + k, 20) for k in range(9)], (-1, 0)),
        ([(10, 20 + k) for k in range(9)], (0, -1)),
        ([(10 + k, 20 + k) for k in range(9)], (-1, -1)),
        ([(10 + k, 20 - k) for k in range(9)], (-1, 1)),
        ([(10 + 2 * k + i, 20 + k) for k in range(8) for i in (0, 1)], None),
    ],
)
def test_a_straight_line_goes_on_as_it_came(
    line: list[tuple[int, int]], way: tuple[int, int] | None
) -> None:
    edges = np.zeros((40, 50), bool)
    for x, y in line:
        edges[y, x] = True
    position, direction = terminators_of(edges, reach=5)
    first = direction[(position == line[0]).all(axis=1)][0]
    last = direction[(position == line[-1]).all(axis=1)][0]
    np.testing.assert_allclose(first, -last, atol=1e-6)
    if way is not None:
        np.testing.assert_allclose(first, np.array(way) / np.hypot(*way), atol=1e-6)
    else:
        # Two to the right for one down, over five pixels of its staircase.
        x, y = np.array(line[:5]).T
        slope = np.array([np.polyfit(np.arange(5), x, 1)[0], np.polyfit(np.arange(5), y, 1)[0]])
        np.testing.assert_allclose(first, -slope / np.hypot(*slope), atol=1e-6)


def test_the_walk_back_ends_before_a_fork() -> None:
    """Behind the fork the line bends; only the three pixels before it count."""
    edges = np.zeros((40, 50), bool)
    edges[20, 10:13] = True
    for k in range(1, 9):
        edges[20 + k, 12 + k] = edges[20 - 2 * k : 22 - 2 * k, 12 + k] = True
    position, direction = terminators_of(edges, reach=7)
    np.testing.assert_allclose(direction[(position == [10, 20]).all(axis=1)][0], [-1, 0])


# -- paths -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("major", range(1, 14))
def test_a_path_is_the_nearest_pixel_and_of_two_the_one_level_with_its_nearer_end(
    major: int,
) -> None:
    for minor in range(major + 1):
        for i in range(major + 1):
            exact = Fraction(i * minor, major)
            below = exact.numerator // exact.denominator
            over = exact - below
            wanted = below + (over > Fraction(1, 2))
            if over == Fraction(1, 2):
                wanted = below if 2 * i <= major else below + 1
            assert path_offset(i, major, minor) == wanted


# -- the reference ---------------------------------------------------------------------------------


def plain_terminators(edges: np.ndarray) -> list[tuple[int, int]]:
    wide = np.pad(edges, 1)
    found = []
    for y, x in np.argwhere(edges):
        around = [k for k, (dx, dy) in enumerate(RING) if wide[y + 1 + dy, x + 1 + dx]]
        gap = (around[-1] - around[0]) % 8 if len(around) == 2 else 0
        if len(around) == 1 or gap in (1, 7):
            found.append((int(x), int(y)))
    return found


def fronts(edges: np.ndarray, start: tuple[int, int], steps: int) -> list[set[tuple[int, int]]]:
    """Pixels first reached after 0, 1, … steps along the edges."""
    height, width = edges.shape
    met, found = {start}, [{start}]
    while len(found) < steps and found[-1]:
        front = {
            (x + dx, y + dy)
            for x, y in found[-1]
            for dx, dy in RING
            if 0 <= x + dx < width and 0 <= y + dy < height and edges[y + dy, x + dx]
        } - met
        met |= front
        found.append(front)
    return found


def plain_direction(edges: np.ndarray, end: tuple[int, int], steps: int) -> np.ndarray:
    points = []
    for k, front in enumerate(fronts(edges, end, steps)):
        if not front or np.ptp(np.array(sorted(front)), axis=0).max() > 1:
            break
        points += [(x, y, k) for x, y in front]
    x, y, k = np.array(points, float).T
    slope = -np.array([((k - k.mean()) * x).sum(), ((k - k.mean()) * y).sum()])
    length = np.hypot(*slope)
    return slope / length if length > 1e-9 else slope * 0


def plain_path(
    edges: np.ndarray,
    evidence: tuple[np.ndarray, np.ndarray] | None,
    start: tuple[int, int],
    end: tuple[int, int],
) -> tuple[bool, float]:
    """Whether the way between two pixels is free, and its evidence in standard deviations."""
    path = bresenham(*start, *end)[1:-1]
    if any(edges[y, x] for x, y in path):
        return False, 0.0
    if evidence is None or not path:
        return True, 0.0
    height, width = edges.shape
    dx, dy = end[0] - start[0], end[1] - start[1]
    nx, ny = -dy / np.hypot(dx, dy), dx / np.hypot(dx, dy)
    best = 0.0
    shifts = {True: [(1, 0)], False: [(0, 1)]}[abs(dy) > abs(dx)]
    if abs(dx) == abs(dy):
        shifts = [(0, 1), (1, 0)]
    for across in shifts:

        def mean(k: int, across: tuple[int, int] = across) -> float:
            values = []
            for x, y in path:
                u = min(max(x + k * across[0], 0), width - 1)
                v = min(max(y + k * across[1], 0), height - 1)
                values.append(nx * evidence[0][v, u] + ny * evidence[1][v, u])
            return float(np.mean(values))

        for k in (-1, 0, 1):
            best = max(best, abs(mean(k) - (mean(k - 3) + mean(k + 3)) / 2))
    return True, min(best, 5.0)


def plain_links(
    edges: np.ndarray, evidence: tuple[np.ndarray, np.ndarray] | None, how: dict[str, Any]
) -> dict[tuple[int, int], dict[tuple[int, int], tuple[float, bool]]]:
    """For each terminator all that it may link to, with the cost and whether it is the border."""
    height, width = edges.shape
    window, slope = how["windows"][0], np.tan(np.radians(how["cone_deg"]))
    ends = plain_terminators(edges)
    ways = {end: plain_direction(edges, end, int(how["reach"])) for end in ends}
    links: dict[tuple[int, int], dict[tuple[int, int], tuple[float, bool]]] = {}
    for end, way in ways.items():
        options: dict[tuple[int, int], tuple[float, bool]] = {}
        if not way.any():
            continue
        own = set().union(*fronts(edges, end, int(how["reach"])))
        for y, x in np.argwhere(edges):
            v = np.array([x - end[0], y - end[1]], float)
            distance, along = float(np.hypot(*v)), float(v @ way)
            off = abs(v[0] * way[1] - v[1] * way[0])
            if (int(x), int(y)) in own or not np.sqrt(2) < distance <= window:
                continue
            # What lies exactly on the wedge's rim is left to rounding: see the table below.
            if along <= 1e-6 or off > how["lateral"] + slope * along + 1e-5:
                continue
            free, shown = plain_path(edges, evidence, end, (int(x), int(y)))
            if not free:
                continue
            bend = 1 - along / distance
            if (int(x), int(y)) in ways:
                bend += 1 + float(v @ ways[int(x), int(y)]) / distance
                cost = distance * (1 + how["turn"] * bend)
            else:
                cost = distance * (1 + how["turn"] * bend) * how["facing"]
            cost /= 1 + shown / how["evidence_half"]
            if cost <= how["max_cost"]:
                options[int(x), int(y)] = (cost, False)
        if how["border"]:
            room = [width - 1 - end[0] if way[0] > 0 else end[0]]
            room += [height - 1 - end[1] if way[1] > 0 else end[1]]
            share = min(
                r / abs(w) if abs(w) > 1e-9 else np.inf for r, w in zip(room, way, strict=True)
            )
            gone = [int(np.floor(share * abs(w) + 0.5 + 1e-6)) for w in way]
            target = tuple(
                int(a + g * (1 if w > 0 else -1)) for a, g, w in zip(end, gone, way, strict=True)
            )
            distance = float(np.hypot(*gone))
            if 0 < distance <= window and not edges[target[1], target[0]]:
                free, shown = plain_path(edges, evidence, end, target)
                cost = distance * how["facing"] / (1 + shown / how["evidence_half"])
                if free and cost <= how["max_cost"]:
                    options[target] = (cost, True)
        links[end] = options
    return links


@pytest.mark.parametrize("with_evidence", [False, True])
@pytest.mark.parametrize("seed", range(6))
def test_one_round_of_links_is_the_cheapest_of_each_end(seed: int, with_evidence: bool) -> None:
    rng = np.random.default_rng(seed)
    shape = (30, 38)
    edges = skeletonize(rng.random(shape) < 0.55) & (rng.random(shape) < 0.93)
    evidence = tuple(rng.normal(0, 2, (2, *shape)).astype(np.float32)) if with_evidence else None
    how: dict[str, Any] = {
        "windows": (7.0,), "reach": 4.0, "lateral": 1.3, "cone_deg": 37.0, "turn": 1.7,
        "facing": 1.6, "max_cost": 11.0, "evidence_half": 0.8, "border": True,
    }  # fmt: skip
    result = link(edges, evidence=evidence, corners=0.0, **how)
    links = plain_links(edges, evidence, how)
    assert {tuple(p) for p in result.terminators.tolist()} == set(plain_terminators(edges))
    for position, way in zip(result.terminators, result.directions, strict=True):
        wanted = plain_direction(edges, tuple(position.tolist()), 4)
        np.testing.assert_allclose(way, wanted, atol=1e-5)
    drawn: dict[tuple[int, int], list[tuple[tuple[int, int], float, bool]]] = {}
    rows = zip(
        result.links.start.tolist(), result.links.end.tolist(), result.links.cost.tolist(),
        result.links.border.tolist(), strict=True,
    )  # fmt: skip
    pixels: dict[tuple[int, int], float] = {}
    for start, end, cost, border in rows:
        drawn.setdefault(tuple(start), []).append((tuple(end), cost, border))
        for pixel in bresenham(*start, *end):
            pixels[pixel] = min(cost, pixels.get(pixel, np.inf))
    compared = 0
    for end, options in links.items():
        if not options:
            assert end not in drawn
            continue
        best = min(cost for cost, _ in options.values())
        chosen = drawn[end]
        for target, cost, border in chosen:
            assert cost == pytest.approx(best, rel=1e-4)
            assert options[target][0] == pytest.approx(cost, rel=1e-4)
            assert options[target][1] == border
            compared += 1
        ties = [t for t, (cost, _) in options.items() if cost < best * (1 - 1e-6) + 2e-6]
        assert len(ties) <= len(chosen) or len(ties) > 1
    assert compared > 10
    # The image is the lines and the links, and each new pixel tells the cheapest of its links.
    new = {(int(x), int(y)) for y, x in np.argwhere(result.links_drawn)}
    assert new == {p for p in pixels if not edges[p[1], p[0]]}
    for x, y in new:
        assert result.value[y, x] == pytest.approx(pixels[x, y], rel=1e-6)
        codes = {
            drawn_border for s in drawn.values() for _, c, drawn_border in s if c == pixels[x, y]
        }
        assert result.step[y, x] in {Step.BORDER if b else Step.LINK for b in codes}
    assert (result.step[edges] == Step.HIGH).all()
    assert (result.value[edges] == 0).all()
    np.testing.assert_array_equal(result.edges, edges | result.links_drawn)
    assert {tuple(p) for p in result.open_ends.tolist()} == set(plain_terminators(result.edges))


# -- limits ----------------------------------------------------------------------------------------

END = (30, 30)


def before(*targets: tuple[int, int], shape: tuple[int, int] = (60, 70)) -> np.ndarray:
    """A level line that ends at (30, 30) and single pixels at offsets (right, down) from there."""
    edges = np.zeros(shape, bool)
    edges[30, 16:31] = True
    for dx, dy in targets:
        edges[30 + dy, 30 + dx] = True
    return edges


@pytest.mark.parametrize(
    ("lateral", "cone_deg"), [(0.0, 45.0), (2.0, 45.0), (1.0, 20.0), (0.0, 75.0), (3.5, 10.0)]
)
def test_a_partner_lies_in_the_wedge_before_the_end(lateral: float, cone_deg: float) -> None:
    slope = np.float32(np.tan(np.radians(cone_deg)))
    for dx in range(-7, 8):
        for dy in range(-7, 8):
            if dy == 0 and dx <= 0:
                continue
            result = link(
                before((dx, dy)), windows=(6.0,), lateral=lateral, cone_deg=cone_deg, **ALONE
            )
            found = [30 + dx, 30 + dy] in result.links.end[
                (result.links.start == END).all(axis=1)
            ].tolist()
            inside = dx > 0 and abs(dy) <= np.float32(lateral) + slope * np.float32(dx)
            assert found == (inside and 2 < dx * dx + dy * dy <= 36)


@pytest.mark.parametrize(("dx", "dy"), [(4, 0), (3, 3), (5, -2), (2, 4)])
def test_a_link_to_a_line_costs_its_length_times_its_turn_and_facing(dx: int, dy: int) -> None:
    for turn, facing in ((2.0, 1.5), (0.0, 1.0), (0.7, 4.0)):
        result = link(
            before((dx, dy)), windows=(8.0,), turn=turn, facing=facing, cone_deg=80, **ALONE
        )
        distance = np.hypot(dx, dy)
        wanted = distance * (1 + turn * (1 - dx / distance)) * facing
        np.testing.assert_allclose(result.links.cost, [wanted], rtol=1e-5)
        at = result.step == Step.LINK
        np.testing.assert_allclose(result.value[at], wanted, rtol=1e-5)
        # The cost may be the greatest, and no more.
        for most, count in ((wanted * 1.001, 1), (wanted * 0.999, 0)):
            again = link(
                before((dx, dy)), windows=(8.0,), turn=turn, facing=facing, cone_deg=80,
                border=False, max_cost=most,
            )  # fmt: skip
            assert len(again.links.start) == count


@pytest.mark.parametrize(("way", "bend"), [((1, 0), 0.0), ((0, 1), 1.0), ((0, -1), 1.0)])
def test_two_ends_pay_for_the_turns_of_both(way: tuple[int, int], bend: float) -> None:
    """The other line goes on straight, or turns off by 90 degrees; its end is 5 px ahead."""
    edges = before()
    for k in range(9):
        edges[30 + k * way[1], 35 + k * way[0]] = True
    result = link(edges, windows=(6.0,), turn=2.0, facing=9.0, **ALONE)
    mine = (result.links.start == END).all(axis=1)
    assert result.links.end[mine].tolist() == [[35, 30]]
    np.testing.assert_allclose(result.links.cost[mine], 5 * (1 + 2 * bend), rtol=1e-5)


def test_the_cheapest_partner_is_taken_and_equal_ones_all() -> None:
    for turn, target in ((20.0, [36, 30]), (0.0, [33, 32])):
        result = link(before((3, 2), (6, 0)), windows=(8.0,), turn=turn, **ALONE)
        assert result.links.end.tolist() == [target]
    both = link(before((5, 2), (5, -2)), windows=(8.0,), **ALONE)
    assert sorted(both.links.end.tolist()) == [[35, 28], [35, 32]]
    assert np.ptp(both.links.cost) == 0


def test_an_edge_between_stops_the_look() -> None:
    edges = before((6, 0))
    edges[27:34, 33] = True
    result = link(edges, windows=(9.0,), **ALONE)
    mine = (result.links.start == END).all(axis=1)
    assert result.links.end[mine].tolist() == [[33, 30]]


def test_nearer_windows_go_first_whatever_their_order() -> None:
    """An end that is nearer in line with another is joined before farther ones are looked at."""
    edges = np.zeros((60, 90), bool)
    edges[20, 10:31] = edges[20, 33:50] = edges[20, 57:80] = True
    result = link(edges, windows=(9.0, 3.0, 6.0), border=False, corners=0.0)
    rounds = dict(zip(result.links.start[:, 0].tolist(), result.links.round.tolist(), strict=True))
    assert rounds == {30: 0, 33: 0, 49: 2, 57: 2}
    assert result.edges[20, 10:80].all()
    assert sorted(result.open_ends[:, 0].tolist()) == [10, 79]
    assert sorted(result.terminators[:, 0].tolist()) == [10, 30, 33, 49, 57, 79]
    assert not result.links.border.any()


@pytest.mark.parametrize("side", ["left", "right", "top", "bottom"])
@pytest.mark.parametrize(("away", "found"), [(1, True), (6, True), (7, False)])
def test_an_end_goes_straight_on_to_a_border_within_the_window(
    side: str, away: int, found: bool
) -> None:
    """Not square, so that a swapped width and height would show."""
    edges = np.zeros((44, 60), bool)
    if side in ("left", "right"):
        edges[17, away : 30 + away] = True
    else:
        edges[away : 24 + away, 25] = True
    end = [away, 17] if side in ("left", "right") else [25, away]
    target = [0, 17] if side in ("left", "right") else [25, 0]
    if side in ("right", "bottom"):
        edges = np.ascontiguousarray(edges[::-1, ::-1])
        end, target = ([59 - x, 43 - y] for x, y in (end, target))
    result = link(edges, windows=(6.0,), facing=1.5, corners=0.0)
    assert result.links.start.tolist() == ([end] if found else [])
    assert result.links.end.tolist() == ([target] if found else [])
    assert result.links.border.tolist() == ([True] if found else [])
    if found:
        assert result.links.cost[0] == pytest.approx(1.5 * away)
        assert result.step[target[1], target[0]] == Step.BORDER
        assert result.edges[target[1], target[0]]


def test_what_is_cheaper_goes_before_the_border() -> None:
    for distance, border in ((3, False), (5, True)):
        edges = np.zeros((40, 50), bool)
        edges[20, 4:30] = True
        # Off the straight way; the border is 4 px away.
        edges[20 + distance, 2] = True
        result = link(edges, windows=(9.0,), turn=0.0, facing=1.0, corners=0.0, cone_deg=80)
        assert result.links.border[(result.links.start == [4, 20]).all(axis=1)].tolist() == [border]


def test_a_border_as_near_as_an_edge_is_drawn_as_well() -> None:
    edges = np.zeros((40, 50), bool)
    edges[20, 5:30] = edges[24, 2] = True
    result = link(edges, windows=(9.0,), turn=0.0, facing=1.0, corners=0.0, cone_deg=80)
    mine = (result.links.start == [5, 20]).all(axis=1)
    assert sorted(result.links.end[mine].tolist()) == [[0, 20], [2, 24]]
    assert sorted(result.links.border[mine].tolist()) == [False, True]
    assert result.links.cost[mine].tolist() == [5, 5]


# -- evidence --------------------------------------------------------------------------------------


def crest(edges: np.ndarray, y: int, value: float) -> tuple[np.ndarray, np.ndarray]:
    """A gradient downwards of ``value`` standard deviations in row ``y``, nothing elsewhere."""
    ex, ey = np.zeros((2, *edges.shape), np.float32)
    ey[y] = value
    return ex, ey


@pytest.mark.parametrize(
    ("row_", "value", "counts"),
    [(30, 0.5, 0.5), (30, -2.0, 2.0), (29, 1.0, 1.0), (31, 1.0, 1.0), (30, 50.0, 5.0),
     (27, 1.0, 0.5), (33, 1.0, 0.5), (26, 1.0, 0.5), (34, 1.0, 0.5), (25, 1.0, 0.0)],
)  # fmt: skip
def test_evidence_along_the_way_divides_the_cost(row_: int, value: float, counts: float) -> None:
    """On the way and a pixel beside it; less half of what is three pixels further off."""
    edges = before((6, 0))
    result = link(
        edges, evidence=crest(edges, row_, value), windows=(8.0,), evidence_half=0.25, **ALONE
    )
    assert result.links.cost == pytest.approx(6 * 1.5 / (1 + counts / 0.25), rel=1e-5)


def test_evidence_turns_with_the_image() -> None:
    """An upright way looks at gradients to the right, and to its left and right."""
    edges = before((6, 0))
    ex, ey = crest(edges, 29, 2.0)
    level = link(edges, evidence=(ex, ey), windows=(8.0,), **ALONE)
    upright = link(
        np.ascontiguousarray(edges.T),
        evidence=(np.ascontiguousarray(ey.T), np.ascontiguousarray(ex.T)),
        windows=(8.0,),
        **ALONE,
    )
    np.testing.assert_array_equal(level.links.cost, upright.links.cost)
    # A gradient along the way says nothing, nor does shading that is the same all over.
    for given in (crest(edges, 30, 2.0)[::-1], (ex, np.full_like(ey, 3))):
        shown = link(edges, evidence=given, windows=(8.0,), **ALONE)
        assert shown.links.cost == pytest.approx(9.0)


def test_noise_along_the_way_averages_out() -> None:
    edges = before((7, 0))
    ex, ey = crest(edges, 30, 0.0)
    ey[30, 31:37] = [3, -3, 3, -3, 3, -3]
    assert link(edges, evidence=(ex, ey), windows=(8.0,), **ALONE).links.cost == pytest.approx(10.5)


# -- corners ---------------------------------------------------------------------------------------


def bent(angle_deg: float, shape: tuple[int, int] = (120, 140)) -> np.ndarray:
    """A line bent at (60, 60), its arms this far apart and to the left of it."""
    edges = np.zeros(shape, bool)
    for sign in (1, -1):
        turn = np.radians(180 + sign * angle_deg / 2)
        end = 60 + round(40 * np.cos(turn)), 60 + round(40 * np.sin(turn))
        for x, y in bresenham(60, 60, *end):
            edges[y, x] = True
    return edges


@pytest.mark.parametrize(
    ("angle_deg", "corner"), [(70, True), (90, True), (104, True), (118, False)]
)
def test_a_line_bent_by_more_than_seventy_degrees_or_so_has_a_corner(
    angle_deg: float, corner: bool
) -> None:
    """The angle whose cosine is -0.35 is 110 degrees; the end ahead is found by corners alone."""
    edges = bent(angle_deg)
    edges[60, 66:90] = True
    how: dict[str, Any] = {"windows": (8.0,), "facing": 1000.0, "max_cost": 40.0, "border": False}
    assert not link(edges, corners=0.0, **how).links_drawn.any()
    assert not link(edges, corners=7.0, **how).links_drawn.any()
    result = link(edges, corners=8.0, **how)
    assert bool(result.edges[60, 61:66].all()) == corner


@pytest.mark.parametrize(("value", "found"), [(1.0, True), (0.99, False), (3.0, True)])
def test_a_corner_needs_evidence_for_a_partner_that_does_not_face_it(
    value: float, found: bool
) -> None:
    edges = bent(90)
    edges[40:80, 66] = True
    how: dict[str, Any] = {"windows": (8.0,), "corners": 8.0, "border": False}
    given = crest(edges, 60, value)
    result = link(edges, evidence=given, least_evidence=1.0, **how)
    assert bool(result.edges[60, 61:66].all()) == found
    # Without evidence there is none, and nothing is needed where nothing is asked.
    assert not link(edges, **how).edges[60, 62]
    assert link(edges, least_evidence=0.0, **how).edges[60, 62]


def plain_corners(edges: np.ndarray, reach: int) -> dict[tuple[int, int], np.ndarray]:
    """Pixels of lines with two arms at less than 110 degrees, and the bisector away from both.

    Of those within two pixels of each other the sharpest; arms of less than half the reach and
    hairpins are none.
    """
    found: dict[tuple[int, int], tuple[float, np.ndarray]] = {}
    for y, x in np.argwhere(edges):
        around = [(x + dx, y + dy) for dx, dy in RING]
        around = [
            (int(u), int(v)) for u, v in around
            if 0 <= u < edges.shape[1] and 0 <= v < edges.shape[0] and edges[v, u]
        ]  # fmt: skip
        if not 2 <= len(around) <= 4:
            continue
        arms: list[set[tuple[int, int]]] = []
        for pixel in around:
            beside = [a for a in arms if any(max(abs(np.subtract(pixel, q))) == 1 for q in a)]
            arms = [a for a in arms if a not in beside] + [set().union({pixel}, *beside)]
        if len(arms) != 2:
            continue
        ways = []
        without = edges.copy()
        without[y, x] = False
        for arm in arms:
            met, front, steps = set(arm), set(arm), 0
            for _ in range(1, reach):
                front = {
                    (u + dx, v + dy)
                    for u, v in front
                    for dx, dy in RING
                    if 0 <= u + dx < edges.shape[1] and 0 <= v + dy < edges.shape[0]
                    if without[v + dy, u + dx]
                } - met
                if not front:
                    break
                met |= front
                steps += 1
            way = np.array(sorted(met), float).sum(axis=0) - len(met) * np.array([x, y])
            if steps < reach // 2 or not way.any():
                break
            ways.append(way / np.hypot(*way))
        if len(ways) == 2 and -0.35 < (cosine := float(ways[0] @ ways[1])) <= 0.95:
            found[int(x), int(y)] = (cosine, -(ways[0] + ways[1]))
    return {
        (x, y): way
        for (x, y), (cosine, way) in found.items()
        if all(
            other <= cosine + 1e-6
            for (u, v), (other, _) in found.items()
            if abs(u - x) <= 2 and abs(v - y) <= 2
        )
    }


@pytest.mark.parametrize("reach", [3, 5, 8])
def test_corners_equal_a_plain_search_on_random_lines(reach: int) -> None:
    compared = 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        edges = skeletonize(rng.random((34, 40)) < 0.5) & (rng.random((34, 40)) < 0.97)
        wide = np.pad(edges, 1).astype(np.uint8)
        found = _corners(
            wide, np.flatnonzero(wide), reach, np.float32(-0.35), np.zeros(wide.shape, np.int32)
        )
        wanted = plain_corners(edges, reach)
        ours = {(int(x) - 1, int(y) - 1): way for x, y, *way in found.tolist()}
        assert ours.keys() <= wanted.keys()
        # Of two that are equal but for rounding one may be missing.
        for x, y in wanted.keys() - ours.keys():
            assert any(max(abs(u - x), abs(v - y)) <= 2 for u, v in ours)
        for place, way in ours.items():
            np.testing.assert_allclose(way, wanted[place], atol=1e-5)
        compared += len(ours)
    assert compared > 30


def test_no_corner_of_many_is_lost() -> None:
    """More than the search has room for at first, all alike."""
    edges = np.zeros((512, 420), bool)
    x = np.arange(420)
    for top in range(10, 500, 14):
        edges[top + np.abs((x % 20) - 10), x] = True
    wide = np.pad(edges, 1).astype(np.uint8)
    found = _corners(
        wide, np.flatnonzero(wide), 5, np.float32(-0.35), np.zeros(wide.shape, np.int32)
    )
    # Two a period of twenty pixels in each of 35 rows, but for those at the ends.
    places = {(int(u) - 1, int(v) - 1) for u, v, *_ in found.tolist()}
    wanted = {(u, top + abs(u % 20 - 10)) for top in range(10, 500, 14) for u in range(10, 420, 10)}
    assert len(wanted) > 1000
    assert wanted - places == set()
    assert len(places - wanted) <= 2 * 35


# -- refusals --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"windows": (1.9, 6.0)}, "2 px or more"),
        ({"windows": ()}, "2 px or more"),
        ({"cone_deg": 0.0}, "between 0 and 90"),
        ({"cone_deg": 90.0}, "between 0 and 90"),
        ({"evidence": (np.zeros((60, 70), "f4"), np.zeros((70, 60), "f4"))}, "evidence has shape"),
        ({"evidence": (np.zeros((70, 60), np.float32),) * 2}, "evidence has shape"),
    ],
)  # fmt: skip
def test_what_links_cannot_be_made_of_is_refused(changes: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        link(before(), **changes)


def test_a_window_of_two_pixels_and_steep_wedges_are_accepted() -> None:
    assert len(link(before((2, 0)), windows=(2.0,), **ALONE).links.start) == 1
    assert len(link(before(), windows=(2.0,), cone_deg=89.9, **ALONE).links.start) == 0
    for wrong in (np.zeros((0, 4), bool), np.zeros(5, bool)):
        with pytest.raises(ValueError, match="axes"):
            link(wrong)

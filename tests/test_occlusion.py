"""Who lies above whom, on small images whose borders can be counted."""

from __future__ import annotations

import numpy as np
import pytest

from workbench_stages.edges.planes import Camera
from workbench_stages.matching.occlusion import Cover, covers

CAMERA = Camera(100.0, 80.0, 9.5, 7.0)
SHAPE = (15, 20)
LEVEL = np.array([0.0, 0.0, -1.0])
Z_M = 0.8


def halves(gap: int = 0, middle: int = 0, label: tuple[int, int] = (1, 2)) -> np.ndarray:
    """Two regions left and right, with so many columns of ``middle`` between them."""
    labels = np.zeros(SHAPE, np.int32)
    labels[:, :10], labels[:, 10:] = label
    labels[:, 10 : 10 + gap] = middle
    return labels


def depth_of(labels: np.ndarray, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: labels.shape[0], : labels.shape[1]]
    rx, ry = CAMERA.rays(x, y)
    ray = np.stack([rx, ry, np.ones_like(rx)], axis=-1)
    depth = np.full(labels.shape, np.nan)
    for k, (point, normal) in enumerate(zip(points, normals, strict=True), start=1):
        own = labels == k
        depth[own] = (normal @ point / (ray @ normal))[own]
    return depth.astype(np.float32)


def cover(
    labels: np.ndarray,
    z_m: list[float] | np.ndarray,
    normals: list[np.ndarray] | None = None,
    residual_m: list[float] | None = None,
    least_m: float = 1e-3,
    depth: np.ndarray | None = None,
) -> Cover:
    count = len(z_m)
    points = np.array([[0, 0, z] for z in z_m]) if np.ndim(z_m) == 1 else np.asarray(z_m)
    normal = np.array(normals or [LEVEL] * count).reshape(-1, 3)
    residual = np.array(residual_m or [1e-4] * count)
    depth = depth_of(labels, points, normal) if depth is None else depth
    return covers(labels, points, normal, residual, CAMERA, least_m, depth)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(("z", "pair"), [([0.8, 0.79], (1, 2)), ([0.79, 0.8], (2, 1))])
def test_the_nearer_region_lies_above_along_every_pixel_of_the_border(
    turned: bool, z: list[float], pair: tuple[int, int]
) -> None:
    labels = halves().T.copy() if turned else halves()
    found = cover(labels, z)
    assert list(found) == [pair]
    count, step = found[pair]
    assert count == 15
    assert step == pytest.approx(0.01)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("label", [(1, 2), (2, 1)])
@pytest.mark.parametrize("gap", [0, 1, 2, 3, 6])
def test_a_line_of_up_to_two_pixels_lies_between_two_regions(
    turned: bool, gap: int, label: tuple[int, int]
) -> None:
    """A pixel of no region is in no pair, whatever depth is known of it."""
    labels = halves(gap, label=label)
    labels = labels.T.copy() if turned else labels
    depth = np.where(labels == 1, 0.8, np.where(labels == 2, 0.79, 0.7)).astype(np.float32)
    found = cover(labels, [0.8, 0.79], depth=depth)
    assert {pair: count for pair, (count, _) in found.items()} == ({(1, 2): 15} if gap < 3 else {})


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("gap", [1, 2])
def test_a_thin_region_between_two_has_their_border_to_itself_if_it_has_a_plane(
    turned: bool, gap: int
) -> None:
    labels = halves(gap, middle=3)
    labels = labels.T.copy() if turned else labels
    found = cover(labels, [0.8, 0.79, 0.78])
    assert set(found) == {(1, 3), (2, 3)}
    without = cover(labels, [0.8, 0.79, 0.78], residual_m=[1e-4, 1e-4, np.nan])
    assert set(without) == {(1, 2)} and without[1, 2][0] == 15


@pytest.mark.parametrize(("step_mm", "is_one"), [(0.99, False), (1.01, True), (3.0, True)])
def test_a_smaller_step_than_asked_for_is_none(step_mm: float, is_one: bool) -> None:
    assert bool(cover(halves(), [Z_M, Z_M - 1e-3 * step_mm])) == is_one
    assert bool(cover(halves(), [Z_M - 1e-3 * step_mm, Z_M])) == is_one
    assert not cover(halves(), [Z_M, Z_M - 1e-3 * step_mm], least_m=4e-3)


@pytest.mark.parametrize(("share", "is_one"), [(0.98, False), (1.02, True)])
@pytest.mark.parametrize("residual_mm", [[1.0, 1.0], [0.4, 1.4], [1.4, 0.4]])
def test_a_step_within_three_deviations_of_both_planes_is_none(
    residual_mm: list[float], share: float, is_one: bool
) -> None:
    step_m = share * 3e-3 * np.hypot(*residual_mm)
    residual = [1e-3 * r for r in residual_mm]
    assert bool(cover(halves(), [Z_M, Z_M - step_m], residual_m=residual)) == is_one


def test_a_region_without_a_plane_covers_nothing_and_is_not_covered() -> None:
    assert not cover(halves(), [0.8, 0.79], residual_m=[1e-4, np.nan])
    assert not cover(halves(), [0.8, 0.79], residual_m=[np.nan, 1e-4])
    assert not cover(np.zeros(SHAPE, np.int32), np.zeros((0, 3)), [], [])


def test_nothing_is_above_where_no_region_is() -> None:
    """Label 0 is no region, on either side."""
    assert not cover(halves(label=(1, 0)), [0.8])
    assert not cover(halves(label=(0, 1)), [0.8])


def test_of_planes_in_parallel_the_step_is_their_distance_however_they_are_tilted() -> None:
    """Along the ray it is longer, by one over the cosine between the ray and the normal."""
    tilt = np.radians(50.0)
    normal = np.array([0, np.sin(tilt), -np.cos(tilt)])
    points = np.array([[0, 0, Z_M], np.array([0, 0, Z_M]) + 0.006 * normal])
    found = cover(halves(), points, [normal, normal])
    assert found[1, 2] == (15, pytest.approx(0.006))


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("gap", [0, 1, 2])
def test_planes_are_compared_in_the_middle_between_the_two_pixels(turned: bool, gap: int) -> None:
    """A tilted region meets a level one; of two pixels that face each other."""
    tilt = np.radians(30.0)
    across = np.array([0, 1.0, 0]) if turned else np.array([1.0, 0, 0])
    tilted = np.sin(tilt) * across - np.cos(tilt) * np.array([0, 0, 1.0])
    labels = halves(gap)
    points = np.array([-0.01 * across + [0, 0, 0.765], [0.03, 0, Z_M]])
    found = cover(labels.T.copy() if turned else labels, points, [tilted, LEVEL])
    at = (9 + 10 + gap) / 2
    ray = np.array([0, (at - CAMERA.cy) / CAMERA.fy, 1.0])
    ray = ray if turned else np.array([(at - CAMERA.cx) / CAMERA.fx, 0, 1.0])
    step = (Z_M - tilted @ points[0] / (tilted @ ray)) * min(abs(tilted @ ray), 1.0)
    assert found[2, 1] == (15, pytest.approx(step, rel=1e-6))


def test_the_step_of_two_regions_is_the_median_along_their_border() -> None:
    """They meet in the rows 0, 1, 2 and 14, and the step grows from row to row."""
    tilt = np.radians(10.0)
    tilted = np.array([0, np.sin(tilt), -np.cos(tilt)])
    labels = halves()
    labels[3:14, 10:] = 0
    points = np.array([[0, 0, Z_M], [0, 0, Z_M - 0.03]])
    ry = (np.array([0.0, 1.0, 2.0, 14.0]) - CAMERA.cy) / CAMERA.fy
    slant = np.abs(tilted[1] * ry + tilted[2])
    steps = (Z_M - (tilted @ points[1]) / (tilted[1] * ry + tilted[2])) * np.minimum(slant, 1)
    count, step = cover(labels, points, [LEVEL, tilted])[1, 2]
    assert count == 4
    assert step == pytest.approx(np.median(steps))
    assert abs(np.median(steps) - np.mean(steps)) > 1e-3


@pytest.mark.parametrize("turned", [False, True])
def test_only_where_the_step_is_one_is_the_border_counted(turned: bool) -> None:
    """A tilted face rises out of a level one, and is above it along the half that rises."""
    tilt = np.radians(20.0)
    axis = np.array([1.0, 0, 0]) if turned else np.array([0, 1.0, 0])
    tilted = np.sin(tilt) * axis - np.cos(tilt) * np.array([0, 0, 1.0])
    labels = halves().T.copy() if turned else halves()
    points = np.array([[0, 0, Z_M], [0, 0, Z_M - 2e-3]])
    found = cover(labels, points, [LEVEL, tilted])
    along = np.arange(15.0)
    across = np.full(15, 9.5)
    rx, ry = CAMERA.rays(along, across) if turned else CAMERA.rays(across, along)
    ray = np.stack([rx, ry, np.ones(15)], axis=1)
    slant = ray @ tilted
    step = (Z_M - tilted @ points[1] / slant) * np.minimum(np.abs(slant), 1)
    above = step > 1e-3
    assert 3 < above.sum() < 12
    assert found[1, 2] == (above.sum(), pytest.approx(np.median(step[above])))
    # Where it dips under the level one it is not covered by it: its middle lies higher.
    assert (2, 1) not in found


def test_a_flank_is_not_above_its_own_top_whose_border_its_steep_plane_overshoots() -> None:
    """Its plane, carried on to the border, comes out over the top; its middle lies far below."""
    steep = np.array([np.sin(np.radians(75)), 0, -np.cos(np.radians(75))])
    at = (9.5 - CAMERA.cx) / CAMERA.fx
    # Where the ray of the crack meets the flank's plane, it is 3 mm over the top.
    over = np.array([at, 0, 1.0]) * (Z_M - 3e-3)
    down = np.array([np.cos(np.radians(75)), 0, np.sin(np.radians(75))])
    points = np.array([[0, 0, Z_M], over + 0.05 * down])
    depth = depth_of(halves(), points, np.array([LEVEL, steep]))
    depth[:, 10:12] = Z_M - 0.02
    assert not cover(halves(), points, [LEVEL, steep], depth=depth)


@pytest.mark.parametrize(("raised", "is_one"), [(16, True), (14, False)])
def test_a_tenth_of_what_was_measured_of_the_upper_region_must_lie_above(
    raised: int, is_one: bool
) -> None:
    """Its plane says that it is above; of 150 pixels, 15 are a tenth."""
    labels = halves()
    depth = np.full(SHAPE, Z_M, np.float32)
    rows, columns = np.nonzero(labels == 2)
    depth[rows[:raised], columns[:raised]] = Z_M - 0.01
    assert bool(cover(labels, [Z_M, Z_M - 0.01], depth=depth)) == is_one


@pytest.mark.parametrize(("raised_mm", "is_one"), [(0.9, False), (1.1, True)])
def test_what_was_measured_must_lie_as_far_above_as_a_step(raised_mm: float, is_one: bool) -> None:
    labels = halves()
    depth = np.where(labels == 2, Z_M - 1e-3 * raised_mm, Z_M).astype(np.float32)
    depth[0] = np.nan
    assert bool(cover(labels, [Z_M, Z_M - 0.01], depth=depth)) == is_one
    depth[labels == 2] = np.nan
    assert not cover(labels, [Z_M, Z_M - 0.01], depth=depth)


def test_what_was_measured_is_held_against_the_lower_plane_where_it_is_seen() -> None:
    """A lower plane that rises to the right and down: both coordinates of a pixel's ray matter."""
    normal = np.array([0.35, 0.2, -1.0])
    normal /= np.linalg.norm(normal)
    point = np.array([0, 0, Z_M])
    for away_mm, is_one in ((0.9, False), (1.1, True)):
        lifted = point + 1e-3 * away_mm * normal
        depth = depth_of(halves(), np.array([point, lifted]), np.array([normal, normal]))
        planes = np.array([point, point + 0.005 * normal])
        assert bool(cover(halves(), planes, [normal, normal], depth=depth)) == is_one


def test_a_chain_of_regions_is_told_pair_by_pair() -> None:
    labels = np.zeros(SHAPE, np.int32)
    labels[:, :6], labels[:8, 6:], labels[8:, 6:] = 1, 2, 3
    found = cover(labels, [0.80, 0.78, 0.79])
    assert {pair: (n, round(step, 6)) for pair, (n, step) in found.items()} == {
        (1, 2): (8, 0.02),
        (1, 3): (7, 0.01),
        (3, 2): (14, 0.01),
    }

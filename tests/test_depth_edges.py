"""Steps and creases of a depth image: against a plain fit at each pixel, and in known noise."""

from __future__ import annotations

import numpy as np
import pytest
from edge_scenes import eight
from scipy import ndimage

from workbench_stages.edges.depth_edges import DepthEdges, depth_edges

WAYS = ((1, 0), (0, 1), (1, 1), (1, -1))


def fit(samples: list[tuple[float, float]], at: float) -> tuple[float, float, float, float]:
    """A line through (t, z): its value at ``at``, its slope, and the variances of both."""
    t, z = np.array(samples, float).T
    design = np.stack([np.ones_like(t), t], axis=1)
    solution, *_ = np.linalg.lstsq(design, z, rcond=None)
    rest = float(((z - design @ solution) ** 2).sum()) / max(len(t) - 2, 1)
    covariance = rest * np.linalg.inv(design.T @ design)
    there = np.array([1, at])
    variances = float(there @ covariance @ there), float(covariance[1, 1])
    return float(there @ solution), float(solution[1]), *variances


def plain_evidence(depth: np.ndarray, near: int, far: int) -> tuple[np.ndarray, ...]:
    """Step, crease and their variances in four directions, [4 4 H W]; NaN where a side is unknown.

    A side counts where at least half of its samples, and four, are known; the pixel itself may be
    unknown as far as ``near`` pixels from a known one.
    """
    height, width = depth.shape
    known = np.isfinite(depth)
    wanted = ndimage.binary_dilation(known, np.ones((2 * near + 1,) * 2))
    out = np.full((4, 4, height, width), np.nan)
    for k, (ux, uy) in enumerate(WAYS):
        first, last = near, far
        if k > 1:
            first = max(int(near * 0.5**0.5 + 0.5), 1)
            last = max(int(far * 0.5**0.5 + 0.5), first + 3)
        length = np.hypot(ux, uy)
        for y, x in np.argwhere(wanted):
            sides = []
            for sign in (1, -1):
                samples = [
                    (sign * i * length, depth[y + sign * i * uy, x + sign * i * ux])
                    for i in range(first, last + 1)
                    if 0 <= y + sign * i * uy < height and 0 <= x + sign * i * ux < width
                    if known[y + sign * i * uy, x + sign * i * ux]
                ]
                if len(samples) >= max(4, (last - first + 1) / 2):
                    sides.append(fit(samples, 0.0))
            if len(sides) == 2:
                before, behind = np.array(sides)
                out[:2, k, y, x] = np.abs(before - behind)[:2]
                out[2:, k, y, x] = (before + behind)[2:]
    return tuple(out)


def plain_crests(strength: np.ndarray, way: np.ndarray, near: int) -> np.ndarray:
    """Pixels of 6 sigma whose mean over 2 near - 1 pixels is greatest within 5 along their way.

    Evidence over 18 sigma counts as 18, in steps of a sixteenth; a diagonal step is longer.
    """
    whole = np.rint(np.minimum(strength.astype(float), 18) * 16)
    width = 2 * near - 1
    level = ndimage.uniform_filter(np.pad(whole, near), width)[near:-near, near:-near] / 16
    thin = np.zeros(strength.shape, bool)
    for y, x in np.argwhere((strength >= 6) & (level >= 3)):
        ux, uy = WAYS[way[y, x]]
        reach = 5 if way[y, x] < 2 else 4
        others = [
            level[y + t * uy, x + t * ux]
            for t in range(-reach, reach + 1)
            if 0 <= y + t * uy < level.shape[0] and 0 <= x + t * ux < level.shape[1]
        ]
        thin[y, x] = level[y, x] >= max(others) - 1e-9
    return thin


def holed(shape: tuple[int, int], seed: int) -> np.ndarray:
    """A step, a crease and noise, with unknown pixels and an unknown block."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    rng = np.random.default_rng(seed)
    z = 0.7 + 4e-4 * x - 2e-4 * y + 6e-3 * (x > shape[1] * 0.55) + 1e-3 * np.abs(y - 11)
    z += 3e-4 * rng.normal(size=shape)
    z[rng.random(shape) < 0.12] = np.nan
    z[18:27, 4:13] = np.nan
    return z.astype(np.float32)


@pytest.mark.parametrize(("near", "far"), [(3, 10), (2, 7), (1, 5)])
def test_strength_equals_lines_fitted_on_both_sides_of_each_pixel(near: int, far: int) -> None:
    depth = holed((38, 44), near)
    step, crease, step_var, crease_var = plain_evidence(depth.astype(float), near, far)
    sigmas = []
    for values in (step, crease):
        # A third of |N(0, 1)| lies under 0.4307; axes and diagonals apart.
        pairs = [values[:2], values[2:]]
        sigmas.append([np.quantile(p[np.isfinite(p)], 1 / 3) / 0.4307 for p in pairs])
    found = depth_edges(depth, near=near, far=far)
    assert found is not None
    np.testing.assert_allclose(found.sigma_step, sigmas[0], rtol=0.03)
    np.testing.assert_allclose(found.sigma_crease, sigmas[1], rtol=0.03)
    # The same sigmas for both, so that what is compared is each pixel's evidence.
    which = [0, 0, 1, 1]
    a = step / np.sqrt(np.square(np.array(found.sigma_step)[which])[:, None, None] + 4 * step_var)
    b = crease / np.sqrt(
        np.square(np.array(found.sigma_crease)[which])[:, None, None] + 4 * crease_var
    )
    each = np.nan_to_num(np.fmax(a, b), nan=0.0)
    wanted = each.max(axis=0)
    np.testing.assert_allclose(found.strength, wanted, rtol=5e-3, atol=1e-3)
    assert (wanted == 0).any() and (wanted > 8).any()
    # Where two directions are as good either may be taken.
    clear = np.sort(each, axis=0)[-2] < 0.99 * wanted
    crests = plain_crests(found.strength, each.argmax(axis=0), near)
    np.testing.assert_array_equal(found.thin[clear], crests[clear])
    assert crests[clear].sum() > 20


@pytest.mark.parametrize(
    ("shape", "near", "far"), [((256, 256), 3, 10), ((512, 512), 6, 20), ((128, 200), 3, 10)]
)
def test_in_white_noise_the_standard_deviations_are_those_of_the_lines(
    shape: tuple[int, int], near: int, far: int
) -> None:
    """From the variance of a least-squares line carried on to the pixel; scaled with the image."""
    noise = 2e-4
    depth = 0.7 + noise * np.random.default_rng(0).normal(size=shape)
    found = depth_edges(depth)
    assert found is not None
    wanted_step, wanted_crease = [], []
    for first, last, length in (
        (near, far, 1.0),
        (round(near / 2**0.5), round(far / 2**0.5), 2**0.5),
    ):
        t = length * np.arange(first, last + 1)
        spread = float(((t - t.mean()) ** 2).sum())
        wanted_step.append(noise * np.sqrt(2 * (1 / len(t) + t.mean() ** 2 / spread)))
        wanted_crease.append(noise * np.sqrt(2 / spread))
    np.testing.assert_allclose(found.sigma_step, wanted_step, rtol=0.04)
    np.testing.assert_allclose(found.sigma_crease, wanted_crease, rtol=0.04)
    assert found.thin.mean() < 0.002


def scene(shape: tuple[int, int], column: int, step: float, crease: float) -> np.ndarray:
    """A plane in noise with a step, or a crease, at the column."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    z = 0.7 + 2e-4 * y + step * (x >= column) + crease * np.maximum(x - column, 0)
    return z + 1e-4 * np.random.default_rng(1).normal(size=shape)


@pytest.mark.parametrize("step", [0.004, -0.004])
@pytest.mark.parametrize(("shape", "column"), [((100, 130), 50), ((512, 512), 230)])
def test_a_step_is_drawn_where_it_is(shape: tuple[int, int], column: int, step: float) -> None:
    """Within two pixels of it at 256², and nowhere within the reach of a ridge besides."""
    depth = scene(shape, column, step, 0.0)
    scale = max(np.sqrt(shape[0] * shape[1]) / 256, 1)
    for turned, upright in ((depth, True), (np.ascontiguousarray(depth.T), False)):
        found = depth_edges(turned)
        assert found is not None
        thin = found.thin if upright else found.thin.T
        rows = slice(int(12 * scale), -int(12 * scale))
        y, x = np.nonzero(thin[rows])
        beside = np.abs(x - (column - 0.5)) < 2.5 * scale
        assert beside.mean() > 0.9
        assert len(np.unique(y[beside])) > 0.7 * thin[rows].shape[0]
        assert beside.sum() < 1.5 * thin[rows].shape[0]
        assert abs(x[beside].mean() - (column - 0.5)) < 0.6


def test_a_ridge_is_as_strong_as_asked_and_none_beside_it_is_as_strong() -> None:
    depth = scene((100, 130), 50, 0.004, 0.0)
    found = depth_edges(depth, low=6.0)
    assert found is not None
    assert (found.strength[found.thin] >= 6).all()
    strongest = float(found.strength.max())
    none = depth_edges(depth, low=strongest + 1)
    assert none is not None and not none.thin.any()
    few = depth_edges(depth, low=0.9 * strongest)
    assert few is not None and 0 < few.thin.sum() < found.thin.sum()
    # With a reach of nothing every strong pixel would be a crest of its own.
    wide = depth_edges(depth, reach=0.0)
    assert wide is not None and wide.thin.sum() > 2 * found.thin.sum()


def test_evidence_has_no_unit_and_no_sense_of_near_and_far() -> None:
    depth = holed((60, 70), 5).astype(np.float64)
    base = depth_edges(depth)
    assert base is not None
    for changed, unit in ((1000 * depth, 1000.0), (2 - depth, 1.0), (depth + 5, 1.0)):
        found = depth_edges(changed)
        assert found is not None
        np.testing.assert_allclose(found.strength, base.strength, rtol=0.02, atol=0.05)
        np.testing.assert_allclose(found.sigma_step, np.multiply(base.sigma_step, unit), rtol=0.02)


def test_evidence_turns_with_the_image() -> None:
    depth = holed((60, 74), 6)

    def of(image: np.ndarray) -> DepthEdges:
        found = depth_edges(image)
        assert found is not None
        return found

    base = of(depth)
    for turned, strength, thin in zip(
        eight(depth), eight(base.strength), eight(base.thin), strict=True
    ):
        np.testing.assert_array_equal(of(turned).strength, strength)
        np.testing.assert_array_equal(of(turned).thin, thin)


def test_only_pixels_that_are_asked_for_are_looked_at() -> None:
    depth = holed((60, 70), 7)
    where = np.zeros(depth.shape, bool)
    where[10:50, 20:60] = True
    base, some = depth_edges(depth), depth_edges(depth, where)
    assert base is not None and some is not None
    assert (some.strength[~where] == 0).all()
    assert not some.thin[~where].any()
    assert (some.strength[where] > 0).mean() > 0.9
    np.testing.assert_array_equal(some.strength[where] > 0, base.strength[where] > 0)


def test_an_exact_plane_has_no_evidence_and_too_little_depth_none_at_all() -> None:
    y, x = np.mgrid[:50, :60].astype(float)
    flat = depth_edges(0.7 + 1e-3 * x - 2e-3 * y)
    assert flat is not None and flat.strength.max() < 1
    few = np.full((50, 60), np.nan)
    few[10:17, 10:19] = 0.7
    assert depth_edges(few) is None
    # 64 known pixels are enough to begin, but not for lines on both sides of 64.
    few[17, 10] = 0.7
    assert depth_edges(few) is None
    assert depth_edges(np.full((50, 60), np.nan)) is None

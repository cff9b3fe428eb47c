"""The sensor's compiled loops against plain numpy, and what must hold whatever the image."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numba
import numpy as np
import pytest

from workbench_stages.dfd import cloud, depth, focus, similarity
from workbench_stages.dfd.depth import (
    Response,
    Windows,
    confidence_from_error,
    estimate,
    windows_for,
)
from workbench_stages.dfd.focus import SensorNoise, focus_map
from workbench_stages.dfd.stripes import whole_period_taps

SHAPES = [(1, 1), (1, 40), (40, 1), (2, 3), (16, 16), (57, 83), (90, 33)]
NOISE = SensorNoise(0.3, 0.01)


def texture(shape: tuple[int, int], seed: int = 0) -> np.ndarray:
    return (200 * np.random.default_rng(seed).random(shape)).astype(np.float32)


def padded(image: np.ndarray, margin: int, mode: str = "reflect") -> np.ndarray:
    # numpy refuses to reflect an axis of one; there is then nothing but that one value.
    modes = [mode if size > 1 else "edge" for size in image.shape]
    image = np.pad(image, ((margin, margin), (0, 0)), modes[0])
    return np.pad(image, ((0, 0), (margin, margin)), modes[1])


def moved(image: np.ndarray, dx: int, dy: int, mode: str = "reflect") -> np.ndarray:
    """The image whose pixel (x, y) is ``image``'s (x + dx, y + dy)."""
    margin = max(abs(dx), abs(dy))
    height, width = image.shape
    wide = padded(image, margin, mode)
    return wide[margin + dy : margin + dy + height, margin + dx : margin + dx + width]


# -- focus maps ------------------------------------------------------------------------------------


def plain_focus(image: np.ndarray, x_taps: np.ndarray, y_taps: np.ndarray, kind: str) -> np.ndarray:
    """focus_map in float64, one shifted image per coefficient."""
    if kind == "paper":
        kernel = focus.PAPER_KERNEL.astype(float)
    else:
        second, smooth = np.array([1, 0, -2, 0, 1]), np.array([1, 4, 6, 4, 1])
        kernel = (np.outer(smooth, second) + np.outer(second, smooth)) / 128
    values = image.astype(float)
    response = np.zeros(image.shape)
    for row, column in np.ndindex(5, 5):
        response += kernel[row, column] * moved(values, column - 2, row - 2)
    gain = (kernel**2).sum()
    energy = response**2 - gain * (NOISE.read_variance + NOISE.gain * values)
    for taps, across in ((x_taps, True), (y_taps, False)):
        half = len(taps) // 2
        steps = [(k - half, 0) if across else (0, k - half) for k in range(len(taps))]
        energy = sum(w * moved(energy, *step) for w, step in zip(taps, steps, strict=True))
    return np.sqrt(np.maximum(energy, 0))


@pytest.mark.parametrize("kind", ["opencv", "paper"])
@pytest.mark.parametrize("width", [1, 3.3, 5, 9.7, 13.4])
@pytest.mark.parametrize("shape", SHAPES)
def test_focus_map_equals_plain_numpy(shape: tuple[int, int], width: float, kind: str) -> None:
    image = texture(shape)
    x_taps = whole_period_taps(min(width, shape[1]))
    y_taps = whole_period_taps(min(width, shape[0]))
    found = focus_map(image, x_taps, y_taps, kind, NOISE)  # type: ignore[arg-type]
    assert found.dtype == np.float32
    # The root magnifies rounding where noise takes nearly all: compare what is under it.
    wanted = plain_focus(image, x_taps, y_taps, kind)
    np.testing.assert_allclose(found**2, wanted**2, rtol=1e-4, atol=0.02)


# -- depth -----------------------------------------------------------------------------------------


@numba.vectorize
def weight_of(cost):  # type: ignore[no-untyped-def]
    return depth._weight(cost)


def maps(shape: tuple[int, int], seed: int = 0) -> list[np.ndarray]:
    """Near, far, brightness and guide of a smooth scene with a step in depth and brightness."""
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    rng = np.random.default_rng(seed)
    q = 0.3 * np.sin(x / 17 + y / 23) + 0.3 * (x > shape[1] / 2)
    light = 150.0 + 60 * (x > shape[1] / 2) + rng.normal(size=shape)
    total = 0.2 * light
    images = [total * (1 + q) / 2, total * (1 - q) / 2, light, light / 2]
    return [image.astype(np.float32) for image in images]


def response_for(shape: tuple[int, int], local: bool = True) -> Response:
    rng = np.random.default_rng(7)
    base = np.array([0.5, -0.5, 0.03, -0.02, 0.01])[:, None, None]
    curve = base + 0.01 * rng.normal(size=(5, *shape)) * (1 if local else 0)
    curve = curve if local else curve[:, :1, :1]
    return Response(
        curve.astype(np.float32), np.array([0.18, 0.05, -0.05], np.float32), 0.5, NOISE, "opencv"
    )


def plain_estimate(
    images: list[np.ndarray], response: Response, windows: Windows, edge_aware: bool
) -> tuple[np.ndarray, np.ndarray]:
    """estimate in float64 on whole images; only the weight's own approximation is shared."""
    near, far, light, guide = (image.astype(float) for image in images)
    shape = near.shape

    def three(image: np.ndarray, step: int) -> np.ndarray:
        for dx, dy in ((step, 0), (0, step)):
            image = (moved(image, dx, dy) + 2 * image + moved(image, -dx, -dy)) / 4
        return image

    def relative_depth(q: np.ndarray) -> np.ndarray:
        return sum(c.astype(float) * q**k for k, c in enumerate(response.curve))

    n, f = (three(image**2, windows.smoothing_px) for image in (near, far))
    s_squared = (np.sqrt(n) + np.sqrt(f)) ** 2
    q = (n - f) / (s_squared + 1e-12)
    coarse, fine = relative_depth(q), relative_depth((near - far) / (near + far + 1e-6))
    variance = focus.noise_gain(response.kind) / windows.samples
    variance = variance * (response.noise.read_variance + response.noise.gain * light / 2)
    share = variance / (s_squared + 1e-12)
    noise = 2 * (100 * response.slope) ** 2 * share * (1 + q**2 + 2 * share)
    odd: float | np.ndarray = 0.0
    if response.modulation is not None:
        powers = np.clip(coarse, 0, 1)[..., None] ** np.arange(len(response.modulation))
        expected = ((powers * response.modulation).sum(-1) * light) ** 2
        odd = 8 * (s_squared - expected) / (s_squared + expected + 1e-12)
    trouble = noise + odd**2

    step = windows.slope_px
    wide = padded(coarse, step)
    inner = (slice(step, step + shape[0]), slice(step, step + shape[1]))
    for k in range(1, step + 1):  # a slope goes on beyond the sides as it is
        wide[:, step - k] = 2 * wide[:, step] - wide[:, step - k]
        wide[:, -step - 1 + k] = 2 * wide[:, -step - 1] - wide[:, -step - 1 + k]
    slope_x = (wide[inner[0], 2 * step :] - wide[inner[0], : shape[1]]) / (2 * step)
    rows = np.arange(shape[0])
    above, below = np.maximum(rows - step, 0), np.minimum(rows + step, shape[0] - 1)
    slope_y = (coarse[below] - coarse[above]) / np.maximum(below - above, 1)[:, None]
    scatter = np.maximum(three(fine**2, step) - three(fine, step) ** 2, 0)
    bend = np.maximum(scatter - (slope_x**2 + slope_y**2) * step**2 / 2, 0)
    down = guide[below] - guide[above]
    contrast = (moved(guide, step, 0) - moved(guide, -step, 0)) ** 2 + down**2
    cost = 1e4 * bend + trouble + 2 * contrast / (guide**2 + 1)
    own = 0.25 * 1e4 * scatter + trouble
    if not edge_aware:
        return coarse, np.sqrt(0.79 * (own + cost))

    def outside(image: np.ndarray, dx: int, dy: int, value: float) -> np.ndarray:
        margin = windows.reach_px
        wide = np.pad(image, margin, constant_values=value)
        return wide[margin + dy :, margin + dx :][: shape[0], : shape[1]]

    noise_of_guide = response.noise.read_variance + response.noise.gain * guide
    sharpness = 0.005 / (noise_of_guide + 0.0004 * guide**2 + 1e-6)
    value_sum = weight_sum = cost_sum = np.zeros(shape)
    r = windows.reach_px
    for dx, dy in ((0, 0), (-r, -r), (r, -r), (-r, r), (r, r)):
        heard = outside(cost, dx, dy, 1e9) + 0.56 * (dx != 0)
        heard = heard + sharpness * (outside(guide, dx, dy, 0) - guide) ** 2
        heard = np.minimum(heard, 1e9).astype(np.float32)
        weight = weight_of(heard).astype(float)
        value = outside(coarse, dx, dy, 0)
        value = value - dx * outside(slope_x, dx, dy, 0) - dy * outside(slope_y, dx, dy, 0)
        value_sum = value_sum + weight * value
        weight_sum = weight_sum + weight
        cost_sum = cost_sum + weight * heard
    value = value_sum / weight_sum
    squared = own + (50 * (value - coarse)) ** 2 + cost_sum / weight_sum
    return value, np.sqrt(0.79 * squared)


@pytest.mark.parametrize("edge_aware", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("period", [5.0, 9.7])
def test_depth_equals_plain_numpy(shape: tuple[int, int], edge_aware: bool, period: float) -> None:
    images, response = maps(shape), response_for(shape)
    windows = windows_for(period, 1.4, 1.2)
    found = estimate(*images, response, windows, edge_aware)
    wanted = plain_estimate(images, response, windows, edge_aware)
    np.testing.assert_allclose(found[0], wanted[0], atol=2e-4)
    np.testing.assert_allclose(found[1], wanted[1], rtol=5e-3, atol=5e-3)


@pytest.mark.parametrize("modulation", [None, [0.2], [0.18, 0.05, -0.05]])
def test_one_curve_for_all_pixels_is_the_same_as_one_for_each(modulation: list | None) -> None:
    images, shape = maps((30, 50)), (30, 50)
    one = response_for(shape, local=False)
    known = None if modulation is None else np.array(modulation, np.float32)
    one = Response(one.curve, known, one.slope, one.noise, one.kind)
    each = Response(np.tile(one.curve, (1, *shape)), known, one.slope, one.noise, one.kind)
    windows = windows_for(5, 1.4, 1.2)
    for a, b in zip(estimate(*images, one, windows), estimate(*images, each, windows), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("smoothing", [0.2, 1.4, 4])
def test_a_band_of_rows_has_the_depth_that_it_has_in_the_whole(smoothing: float) -> None:
    images, response = maps((120, 70)), response_for((120, 70))
    windows = windows_for(5, smoothing, 1.2)
    whole = estimate(*images, response, windows)
    halo, top, bottom = windows.halo_px, 31, 100
    cut = Response(
        response.curve[:, top:bottom],
        response.modulation,
        response.slope,
        response.noise,
        response.kind,
    )
    band = estimate(*(image[top:bottom] for image in images), cut, windows)
    for a, b in zip(whole, band, strict=True):
        np.testing.assert_array_equal(a[top + halo : bottom - halo], b[halo:-halo])


def test_no_energy_is_known_as_such() -> None:
    near, far, light, guide = maps((40, 60))
    near[:, :30] = far[:, :30] = 0
    value, error = estimate(
        near, far, light, guide, response_for((40, 60)), windows_for(5, 1.4, 1.2)
    )
    assert np.isinf(error[:, :25]).all()
    np.testing.assert_allclose(value[:, :15], 0.5, atol=1e-6)
    assert np.isfinite(error[:, 40:]).all()
    assert (confidence_from_error(error, 3.2)[:, :25] == 0).all()


@pytest.mark.parametrize("which", range(4))
def test_a_pixel_that_is_not_a_number_spoils_only_what_sees_it(which: int) -> None:
    images, response, windows = maps((60, 60)), response_for((60, 60)), windows_for(5, 1.4, 1.2)
    clean = estimate(*images, response, windows)
    images[which][30, 30] = np.nan
    value, error = estimate(*images, response, windows)
    assert error[30, 30] > 1e4
    assert not np.isnan(error).any()
    beyond = np.ones((60, 60), bool)
    reach = windows.halo_px
    beyond[30 - reach : 31 + reach, 30 - reach : 31 + reach] = False
    np.testing.assert_array_equal(value[beyond], clean[0][beyond])
    np.testing.assert_array_equal(error[beyond], clean[1][beyond])


def test_a_weight_is_nearly_the_inverse_fourth_power_and_falls() -> None:
    cost = np.geomspace(1e-3, 1e9, 4001).astype(np.float32)
    weight = weight_of(cost)
    exact = (cost.astype(float) + 0.1) ** -4
    assert (weight / exact).max() < 1.36 * (weight / exact).min()
    assert (np.diff(weight) <= 0).all()
    assert (weight > 0).all()


def test_confidence_equals_its_formula() -> None:
    error = np.array([[0, 1, 3.2, 1e6, np.inf]], np.float32)
    wanted = 1 / (1 + (error.astype(float) / 3.2) ** 2)
    np.testing.assert_allclose(confidence_from_error(error, 3.2), wanted, rtol=1e-5)


# -- misalignment ----------------------------------------------------------------------------------


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.2, -0.1), (-0.6, 0.5)])
@pytest.mark.parametrize("shape", [(128, 160), (256, 256), (300, 90)])
def test_misalignment_is_one_step_of_the_refinement(
    shape: tuple[int, int], shift: tuple[float, float]
) -> None:
    near = cv2.GaussianBlur(texture(shape), (0, 0), 2.0)
    start = similarity.Similarity.identity(shape[1], shape[0])
    far = cv2.warpAffine(
        near,
        similarity.Similarity(1.0, 0.0, *shift, shape[1], shape[0]).far_from_near,
        (shape[1], shape[0]),
        flags=cv2.INTER_CUBIC,
        borderMode=cv2.BORDER_REFLECT_101,
    )
    found = similarity.misalignment_rms_px(near, far)
    step = similarity.refine_similarity([(near, far)], start, iterations=1)
    corners = np.array([(x, y, 1.0) for x in (0, shape[1] - 1) for y in (0, shape[0] - 1)])
    middle = np.array([(shape[1] - 1) / 2, (shape[0] - 1) / 2, 1.0])
    points = middle + (corners - middle) / 3**0.5
    off = points @ step.far_from_near.T - points[:, :2]
    assert found == pytest.approx(float(np.sqrt((off**2).sum(1).mean())), rel=0.06, abs=0.01)


@pytest.mark.parametrize(
    "image", [np.zeros((64, 64)), np.full((64, 64), 90.0), np.full((64, 64), np.nan)]
)
def test_images_that_show_nothing_count_as_aligned(image: np.ndarray) -> None:
    image = image.astype(np.float32)
    assert similarity.misalignment_rms_px(image, image) == 0


# -- the cloud -------------------------------------------------------------------------------------


def camera(shape: tuple[int, int]) -> SimpleNamespace:
    height, width = shape
    matrix = np.array([[1300.0, 0, width / 2 - 0.3], [0, 1310.0, height / 2 + 0.4], [0, 0, 1]])
    return SimpleNamespace(width=width, height=height, K=matrix)


def plain_normal(depth_m: np.ndarray, K: np.ndarray, x: int, y: int, reach: int) -> np.ndarray:
    around = [
        (i, j, 1 / depth_m[y + j, x + i])
        for j in range(-reach, reach + 1, 2)
        for i in range(-reach, reach + 1, 2)
        if 0 <= y + j < depth_m.shape[0] and 0 <= x + i < depth_m.shape[1]
        if np.isfinite(depth_m[y + j, x + i])
    ]
    a = b = 0.0
    c = 1 / float(depth_m[y, x])
    design = np.array([(i, j, 1) for i, j, _ in around], float).reshape(-1, 3)
    if len(around) >= 4 and np.linalg.matrix_rank(design) == 3:
        a, b, c = np.linalg.lstsq(design, np.array([w for *_, w in around]), rcond=None)[0]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    normal = -np.array([fx * a, fy * b, a * (cx - x) + b * (cy - y) + c])
    return normal / np.linalg.norm(normal)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("reach", [1, 3, 4])
def test_normals_equal_a_plain_fit_at_each_pixel(shape: tuple[int, int], reach: int) -> None:
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    rng = np.random.default_rng(3)
    z = 0.75 + 0.0003 * x - 0.0002 * y + 0.0002 * rng.normal(size=shape)
    z[rng.random(shape) < 0.3] = np.nan
    z[0, 0] = 0.75
    z = z.astype(np.float32)
    points, normals, shade = cloud.cloud_from_depth(z, texture(shape), camera(shape), reach)
    known = np.isfinite(z)
    assert len(points) == len(normals) == len(shade) == known.sum()
    np.testing.assert_array_equal(points[:, 2], z[known])
    wanted = [plain_normal(z, camera(shape).K, u, v, reach) for v, u in np.argwhere(known)]
    np.testing.assert_allclose(normals, wanted, atol=1e-3)
    again = cloud.cloud_from_depth(z, texture(shape), camera(shape), reach)
    np.testing.assert_array_equal(again[0], points)
    np.testing.assert_array_equal(again[1], normals)


def test_a_cloud_of_nothing_is_empty() -> None:
    nothing = np.full((20, 30), np.nan, np.float32)
    points, normals, shade = cloud.cloud_from_depth(nothing, nothing, camera((20, 30)), 3)
    assert points.shape == normals.shape == (0, 3)
    assert shade.shape == (0,)

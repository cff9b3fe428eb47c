"""The predicted error of depth is what its formula promises, and what noisy images scatter by."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from thin_lens import Rig, frame, passes, planes

from workbench.pipeline import Pipeline
from workbench.plugins import find_stages
from workbench.settings import resolve
from workbench_stages.dfd.calibration import Calibration
from workbench_stages.dfd.depth import (
    Response,
    Windows,
    confidence_from_error,
    contrast_of_cells,
    estimate,
    folded_back,
    on_pixels,
    windows_for,
)
from workbench_stages.dfd.focus import SensorNoise, focus_map, laplacian
from workbench_stages.dfd.procedure import CalibrateParameters, calibrate
from workbench_stages.dfd.similarity import Similarity
from workbench_stages.dfd.stripes import whole_period_taps

SHARE = 0.79
"""Of the squared errors of a pixel's own window and of what it hears, chosen on ray-traced piles
so that the predicted error ranks the true one."""


def line(slope: float, noise: SensorNoise, kind: str = "opencv") -> Response:
    """t = 1/2 - slope × Q for every pixel."""
    curve = np.array([0.5, -slope], np.float32).reshape(2, 1, 1)
    return Response(curve, None, slope, noise, kind)  # type: ignore[arg-type]


def single(samples: float, smoothing_px: int = 0) -> Windows:
    """Windows of one pixel each, that hold so many samples."""
    taps = np.zeros(2 * smoothing_px + 1, np.float32)
    return Windows(taps, taps, smoothing_px, 3, 1, 1, samples)


def laplacian_variance(kind: str) -> float:
    """Variance of the Laplacian's response to white noise of variance 1, measured on noise."""
    noise = np.random.default_rng(0).normal(size=(600, 600)).astype(np.float32)
    return float(laplacian(noise, kind)[4:-4, 4:-4].var())  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["opencv", "paper"])
@pytest.mark.parametrize(
    ("near", "far", "light", "read", "gain", "samples", "slope"),
    [
        (4.0, 4.0, 200.0, 1.0, 0.0, 12.25, 0.5),
        (9.0, 3.0, 200.0, 1.0, 0.0, 12.25, 0.5),
        (9.0, 3.0, 200.0, 0.0, 0.05, 12.25, 0.5),
        (2.0, 6.0, 300.0, 0.5, 0.02, 40.0, 0.5),
        (4.0, 4.0, 200.0, 1.0, 0.0, 1.0, 0.9),
    ],
)
def test_the_error_by_noise_is_that_of_first_principles(
    near: float,
    far: float,
    light: float,
    read: float,
    gain: float,
    samples: float,
    slope: float,
    kind: str,
) -> None:
    """A focus of variance v gives the ratio 2 v/S² (1 + Q² + 2 v/S²); the curve makes it depth.

    Of a plane without anything else to err by: own window and what is heard both count the noise.
    """
    shape = (40, 40)
    images = [np.full(shape, value, np.float32) for value in (near, far, light, light / 2)]
    noise = SensorNoise(read, gain)
    value, error = estimate(*images, line(slope, noise, kind), single(samples), edge_aware=False)
    q, total = (near - far) / (near + far), near + far
    per_pixel = read + gain * light / 2  # of each image, which has half of the light
    share = laplacian_variance(kind) * per_pixel / samples / total**2
    wanted = 100 * slope * math.sqrt(2 * share * (1 + q**2 + 2 * share))
    np.testing.assert_allclose(value, 0.5 - slope * q, rtol=1e-5)
    np.testing.assert_allclose(error, math.sqrt(2 * SHARE) * wanted, rtol=0.01)
    # Neighbours that know as much are heard as well, and cost a little for their distance.
    _, heard = estimate(*images, line(slope, noise, kind), single(samples), edge_aware=True)
    assert (heard >= error * 0.999).all() and (heard**2 <= error**2 + SHARE * 0.57).all()


@pytest.mark.parametrize(("near", "far"), [(4.0, 4.0), (7.0, 3.0), (2.0, 6.0)])
@pytest.mark.parametrize("slope", [0.5, -0.8])
def test_the_error_by_noise_is_the_scatter_of_noisy_focus(
    near: float, far: float, slope: float
) -> None:
    """Energies whose roots scatter as the noise in one window says scatter depth as predicted."""
    shape, samples, read = (200, 200), 10.0, 0.5
    noise, light = SensorNoise(read, 0.0), np.full((200, 200), 200, np.float32)
    sigma = math.sqrt(laplacian_variance("opencv") * read / samples)
    rng = np.random.default_rng(4)
    noisy = [
        (np.full(shape, value) + sigma * rng.normal(size=shape)).astype(np.float32)
        for value in (near, far)
    ]
    clean = [np.full(shape, value, np.float32) for value in (near, far)]
    response, windows = line(slope, noise), single(samples)
    response = Response(response.curve, None, abs(slope), noise, "opencv")
    value, error = estimate(*clean, light, light / 2, response, windows, edge_aware=False)
    scattered, _ = estimate(*noisy, light, light / 2, response, windows, edge_aware=False)
    scatter = 100 * float((scattered - value).std())
    assert scatter == pytest.approx(float(error.mean()) / math.sqrt(2 * SHARE), rel=0.03)


def noisy_errors(
    edge_aware: bool, swing: tuple[float, float], noise: SensorNoise
) -> tuple[float, float]:
    """Root mean square of true and of predicted error, percent, of stripes of 5 px with noise."""
    shape, period = (96, 96), 5.0
    x = np.mgrid[0:96, 0:96][1]
    images = [(120 + a * np.sin(2 * np.pi * x / period)).astype(np.float32) for a in swing]
    taps, windows = whole_period_taps(period), windows_for(period, 1.4, 1.2)
    light = cv2.sepFilter2D(sum(images), cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    guide, response = np.full(shape, 120, np.float32), line(0.5, noise)

    def depth_of(pair: list[np.ndarray], known: SensorNoise) -> tuple[np.ndarray, np.ndarray]:
        maps = [focus_map(image, taps, taps, "opencv", known) for image in pair]
        return estimate(*maps, light, guide, response, windows, edge_aware)

    true, _ = depth_of(images, SensorNoise(0, 0))
    rng, inner = np.random.default_rng(1), (slice(16, -16), slice(16, -16))
    off, told = [], []
    for _ in range(6):
        spread = [np.sqrt(noise.read_variance + noise.gain * image) for image in images]
        shot = [
            (image + s * rng.normal(size=shape)).astype(np.float32)
            for image, s in zip(images, spread, strict=True)
        ]
        value, error = depth_of(shot, noise)
        off.append(100 * (value - true)[inner])
        told.append(error[inner])
    return float(np.sqrt(np.mean(np.square(off)))), float(np.sqrt(np.mean(np.square(told))))


@pytest.mark.parametrize("edge_aware", [True, False])
@pytest.mark.parametrize("swing", [(40.0, 10.0), (25.0, 25.0), (8.0, 30.0)])
@pytest.mark.parametrize("noise", [SensorNoise(1.0, 0.0), SensorNoise(0.1, 0.03)])
def test_the_predicted_error_of_noisy_stripes_is_twice_what_they_scatter_by(
    edge_aware: bool, swing: tuple[float, float], noise: SensorNoise
) -> None:
    """Own window and what is heard both count, and so does their scatter: a safe two and a bit."""
    true, predicted = noisy_errors(edge_aware, swing, noise)
    assert 2.05 < predicted / true < 2.75


def test_confidence_of_a_noisy_plane_tells_two_to_three_times_what_its_shots_differ_by(
    tmp_path: Path,
) -> None:
    """Through every stage, with the noise that calibrating found; noise is nearly all there is."""
    rig, path = Rig(size_px=96, read_noise=5), tmp_path / "calibration.npz"
    distances = np.linspace(rig.near_focus_mm * 0.997, rig.far_focus_mm * 1.003, 11)
    focal = {"u1": str(rig.near_focus_mm), "u2": str(rig.far_focus_mm)}
    calibrate(passes(planes(rig, distances)), focal, CalibrateParameters()).save(path)
    stages = find_stages()
    settings = resolve(stages, assignments=["depth_cloud.min_confidence=0"])
    half = settings.parameters["depth_cloud"].half_confidence_error_percent
    pipeline = Pipeline(stages, settings, {"calibration": path}, until="depth_cloud")
    inner = (slice(16, -16), slice(16, -16))
    variances, predicted = [], []
    for at, z_mm in enumerate((718.0, 745.0, 775.0)):
        shots = []
        for index in range(4 * at, 4 * at + 4):
            shot = pipeline.run(frame(rig, index, z_mm, np.random.default_rng(index))).artifacts
            shots.append(shot["depth_relative"][inner])
            predicted.append(half**2 * (1 / shot["confidence"][inner].astype(float) - 1))
        variances.append(1e4 * np.var(shots, axis=0, ddof=1))
    assert 2.3 < math.sqrt(np.mean(predicted) / np.mean(variances)) < 3.0


@pytest.mark.parametrize(
    ("period", "smoothing", "reach", "wanted"),
    [
        # side 7: 7/√6 = 2.86; 1.4 × 5 = 7; 0.6 × 5 = 3; 0.85 × 1.2 × 5 = 5.1; 7² / 4
        (5.0, 1.4, 1.2, (3, 7, 3, 5, 12.25)),
        # 13.4 × 0.5 = 6.7: 2.7; 18.8 made odd; 8.04; 22.8; one whole window at least
        (13.4, 0.5, 2.0, (3, 19, 8, 23, 44.89)),
        (10.0, 2.0, 0.2, (8, 15, 6, 2, 100.0)),
        (1.2, 0.2, 0.2, (0, 3, 1, 1, 1.0)),
    ],
)
def test_windows_scale_with_the_stripe_period(
    period: float, smoothing: float, reach: float, wanted: tuple[float, ...]
) -> None:
    made = windows_for(period, smoothing, reach)
    found = (made.smoothing_px, made.scatter_px, made.slope_px, made.reach_px, made.samples)
    assert found == pytest.approx(wanted)
    assert made.halo_px == sum(wanted[k] for k in (0, 2, 3))
    for taps in (made.x_taps, made.y_taps):
        assert taps.sum() == pytest.approx(1)
        np.testing.assert_array_equal(taps, taps[::-1])
        if made.smoothing_px:
            assert taps[[0, made.smoothing_px, -1]].tolist() == [0.25, 0.5, 0.25]
            assert np.count_nonzero(taps) == 3


def test_the_slope_of_a_calibration_is_the_mean_size_of_its_linear_term() -> None:
    curve = np.array([[[9.0, 9.0]], [[-0.4, 0.8]], [[7.0, 7.0]]], np.float32)
    made = Calibration(
        Similarity.identity(2, 1), None, "opencv", curve, 0.7, 0.8, np.zeros(0), SensorNoise(),
        np.zeros(6), 255.0,
    )  # fmt: skip
    assert made.slope == pytest.approx(0.6)


@pytest.mark.parametrize("half", [3.3, 12.0])
def test_confidence_is_one_half_at_its_error_and_one_fifth_at_twice_that(half: float) -> None:
    error = np.array([[0, half, 2 * half], [3 * half, np.inf, half / 2]], np.float32)
    found = confidence_from_error(error, half)
    np.testing.assert_allclose(found, [[1, 1 / 2, 1 / 5], [1 / 10, 0, 4 / 5]], rtol=1e-5)
    assert found.dtype == np.float32


# -- beyond the focal planes ----------------------------------------------------------------------

MODULATION = np.array([0.2, 0.1, -0.05], np.float32)


def scene(contrast: np.ndarray, relative: float = 0.6) -> list[np.ndarray]:
    """Sum of focus, light and relative depth of a surface with this share of its contrast."""
    expected = 0.2 + 0.1 * relative - 0.05 * relative**2
    light = np.full(contrast.shape, 150, np.float32)
    depth = np.full(contrast.shape, relative, np.float32)
    return [(contrast * expected * light).astype(np.float32), light, depth]


@pytest.mark.parametrize(("share", "folded"), [(0.85, True), (0.87, False)])
def test_a_surface_with_too_little_contrast_has_folded_back(share: float, folded: bool) -> None:
    maps = scene(np.full((80, 100), share))
    found = folded_back(*maps, MODULATION, 5.0, 0.86)
    assert found.shape == (80, 100) and found.dtype == bool
    assert (found == folded).all()


def test_what_has_folded_back_is_told_where_it_is() -> None:
    contrast = np.ones((80, 120))
    contrast[:, :60] = 0.4
    found = folded_back(*scene(contrast), MODULATION, 5.0, 0.86)
    assert found[:, :56].all() and not found[:, 72:].any()
    found = folded_back(*scene(contrast.T), MODULATION, 5.0, 0.86)
    assert found[:56].all() and not found[72:].any()


def test_cells_have_the_contrast_of_their_mean_depth_and_are_a_little_less_than_a_period() -> None:
    maps = scene(np.full((60, 84), 0.5))
    shown, expected = contrast_of_cells(*maps, MODULATION, 5.0)
    assert shown.shape == expected.shape == (15, 21)  # 0.8 × 5 = 4 px
    amount = 150 * (0.2 + 0.1 * 0.6 - 0.05 * 0.36)
    np.testing.assert_allclose(expected, amount, rtol=1e-5)
    np.testing.assert_allclose(shown, 0.5 * amount, rtol=1e-5)
    # Half of a cell may be unknown without the rest meaning less.
    maps[2][:, ::2] = np.nan
    np.testing.assert_allclose(contrast_of_cells(*maps, MODULATION, 5.0)[1], amount, rtol=1e-5)
    # Depth beyond the range has the contrast of its end.
    for beyond, end in ((-0.3, 0.2), (1.4, 0.25)):
        maps[2][:] = beyond
        found = contrast_of_cells(*maps, MODULATION, 5.0)[1]
        np.testing.assert_allclose(found, 150 * end, rtol=1e-5)


def test_cells_of_which_nothing_is_known_have_no_say_over_a_neighbourhood_of_five() -> None:
    maps = scene(np.ones((80, 80)))
    maps[0][:, :40] = 0
    maps[2][:, :40] = np.nan
    shown, expected = contrast_of_cells(*maps, MODULATION, 5.0)
    np.testing.assert_allclose(shown, expected, rtol=1e-5)
    assert (expected[:, :8] == 0).all()
    amount = 150 * (0.2 + 0.1 * 0.6 - 0.05 * 0.36)
    np.testing.assert_allclose(expected[10, 7:13] / amount, [0, 0.2, 0.4, 0.6, 0.8, 1], atol=1e-5)
    assert not folded_back(*maps, MODULATION, 5.0, 0.86)[:, 40:].any()


def test_an_image_smaller_than_a_cell_is_one_cell() -> None:
    shown, _ = contrast_of_cells(*scene(np.ones((6, 7))), MODULATION, 20.0)
    assert shown.shape == (1, 1)


def test_cells_come_back_on_the_pixels_that_they_are_made_of() -> None:
    cells = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    np.testing.assert_array_equal(on_pixels(cells, (4, 6)), np.kron(cells, np.ones((2, 2))))

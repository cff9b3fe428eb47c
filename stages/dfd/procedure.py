"""``workbench calibrate``: both steps of section 3.2 from one recording, with a report.

Step one fits the far-to-near similarity to dot grids where the recording has some, and to the
image pairs themselves otherwise.  Step two fits, for every pixel, relative depth as a polynomial
of the focus ratio over planes of known distance.  Frames are read several times and never held:
what is kept per pixel are the sums of the normal equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import nnls

from workbench.stage import StageParameters, knob

from ..optics.rig import Rig
from .calibration import Calibration, gain_terms, light_ratio
from .depth import windows_for
from .focus import LaplacianKind, SensorNoise, focus_map
from .from_optics import OpticsParameters, from_optics, read_rig, rig_record
from .images import full_scale, grey
from .score import PATCH_PX
from .similarity import (
    Similarity,
    find_dots,
    fit_similarity,
    match_dots,
    misalignment_rms_px,
    refine_similarity,
    warp_to_near,
)
from .stripes import Stripes, measure_stripes, whole_period_taps

_MIN_DOTS = 16
_ALIGNING_PAIRS = 8
_PLANE_RMS_MM = 0.5
_FLATTEST_SLOPE = 0.15
_MODULATION_TERMS = 5
_NOISE_LEVELS = 24
_NOISE_MIN_SAMPLES = 500
_QUANTISATION = 1 / 12
_SAME_PLACE_M = 1e-6
_MIN_PLANES = 5
_RANGE_MARGIN = 0.02
_DEGREES = (3, 4, 5, 6)
_AS_GOOD = 1.03
_GAIN_CELLS = 16


class CalibrateParameters(StageParameters):
    """The knobs of the procedure."""

    degree: int = knob(
        0,
        "Degree of the curve that takes the focus ratio to depth; 0 takes the one that predicts "
        "planes best which it has not seen.",
        low=0,
        high=6,
        step=1,
    )
    neighbourhood_px: int = knob(
        9,
        "Side of the window over which neighbouring pixels share their ratios: the curve varies "
        "slowly over the image, the noise of a plane does not.",
        low=1,
        high=65,
        step=2,
        unit="px",
    )
    smoothing_periods: float = knob(
        1.4,
        "Second averaging when ratios are taken; as in the stage depth_cloud.",
        low=0.2,
        high=4,
        step=0.2,
        unit="stripe periods",
    )


@dataclass(frozen=True)
class _Plane:
    """What is remembered of one calibration frame: its distance, and its middle's ratio."""

    index: int
    z_m: float
    ratio: float


@dataclass(frozen=True)
class _Patch:
    """The middle 32×32 of a calibration frame: ratio and true relative depth, [32 32] each."""

    z_m: float
    ratio: np.ndarray
    target: np.ndarray


Frames = Callable[[], Iterator[Any]]


def calibrate(
    frames: Frames,
    rig: dict[str, str],
    parameters: CalibrateParameters,
    laplacian: LaplacianKind = "opencv",
    progress: Callable[[str], None] = lambda _: None,
) -> Calibration:
    """The calibration from a recording of planes (and dot grids).

    ``frames`` gives a fresh pass over the recording's frames each time it is called; a plane's
    distance is its ground truth depth, or ``z`` (millimetres) in its ``meta``.  Raises
    ``ValueError`` with one line where the recording cannot calibrate.
    """
    progress("step 1: registration")
    similarity, step_one = _register(frames)
    progress("stripes, light and noise")
    stripes = _stripes(frames, similarity)
    gain, gain_map, gain_spread = _gain(frames, similarity)
    noise, noise_source = _noise(frames, stripes)
    scale = _full_scale(frames)
    side = stripes.extent_px()
    taps = whole_period_taps(side)
    windows = windows_for(side, parameters.smoothing_periods, 1.0)

    def maps(frame: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Ratio, sum of focus and brightness of a frame, over the windows of depth_cloud."""
        near, far = _registered(frame, similarity)
        far = far * np.float32(light_ratio(near, far, gain_map))

        def pooled(image: np.ndarray) -> np.ndarray:
            energy = focus_map(image, taps, taps, laplacian, noise) ** 2
            return np.sqrt(_smooth(energy, windows.x_taps))

        a, b = pooled(near), pooled(far)
        light = _smooth(_smooth(near + far, taps), windows.x_taps)
        return (a - b) / (a + b + np.float32(1e-6)), a + b, light

    progress("step 2: working range")
    planes = [_Plane(frame.index, *_middle(z_m, maps(frame)[0])) for frame, z_m in _planes(frames)]
    near_z_m, far_z_m, range_note = _working_range(planes, rig)
    margin_m = _RANGE_MARGIN * (far_z_m - near_z_m)
    used = [p for p in planes if near_z_m - margin_m <= p.z_m <= far_z_m + margin_m]
    distances = sorted({round(p.z_m, 5) for p in used})
    if len(distances) < _MIN_PLANES:
        raise ValueError(
            f"expected planes at {_MIN_PLANES} distances or more within the working range, "
            f"found {len(distances)}"
        )
    inverse_near, inverse_far = 1 / near_z_m, 1 / far_z_m

    def relative(z_m: np.ndarray) -> np.ndarray:
        return (1 / z_m - inverse_near) / (inverse_far - inverse_near)

    progress("step 2: curve of every pixel")
    highest = min(parameters.degree or max(_DEGREES), len(distances) - 2)
    normal = _NormalEquations(highest)
    modulation_points: list[tuple[np.ndarray, np.ndarray]] = []
    patches: list[_Patch] = []
    chosen = {p.index for p in used}
    for frame, z_m in _planes(frames):
        if frame.index not in chosen:
            continue
        ratio, energy, light = maps(frame)
        target = relative(z_m).astype(np.float32)
        middle = _middle_slice(ratio.shape)
        patches.append(
            _Patch(round(float(np.median(z_m[middle])), 5), ratio[middle], target[middle])
        )
        some = (slice(None, None, 16), slice(None, None, 16))
        modulation_points.append((target[some].ravel(), (energy / (light + 1e-6))[some].ravel()))
        size = (parameters.neighbourhood_px,) * 2
        normal.add(cv2.blur(ratio, size, borderType=cv2.BORDER_REFLECT_101), target)
    progress("step 2: planes held back")
    span_m = far_z_m - near_z_m
    candidates = [parameters.degree] if parameters.degree else _DEGREES
    shared_px = parameters.neighbourhood_px
    tried = {d: _held_out(patches, d, shared_px) for d in candidates if d <= highest} or {
        highest: _held_out(patches, highest, shared_px)
    }
    best = min(rms for rms, _ in tried.values())
    # The lowest degree that is as good as the best one, for it extrapolates more calmly.
    degree = min(d for d, (rms, _) in tried.items() if rms <= _AS_GOOD * best)
    curve = normal.solve(degree)
    modulation = _fit_modulation(modulation_points)

    calibration = Calibration(
        similarity,
        stripes,
        laplacian,
        curve,
        near_z_m,
        far_z_m,
        modulation,
        noise,
        gain,
        scale,
    )
    progress("report")
    stand_off_mm = 500 * (near_z_m + far_z_m)
    span_mm = 1e3 * span_m
    # Relative depth is linear in dioptres; the middle's scale is the mean one.
    held_out_rms, held_out = (span_mm * error for error in tried[degree])
    fit_rms, fit_worst = _fit_residuals(patches, calibration)
    report = {
        "registration": step_one,
        "stripe_period_px": stripes.period_px,
        "stripe_direction_deg": stripes.angle_deg,
        "stripe_strength": stripes.strength,
        "gain_near_over_far": float(gain_map.mean()),
        "gain_over_the_image": [float(gain_map.min()), float(gain_map.max())],
        "gain_spread_percent": gain_spread,
        "noise_read_variance": noise.read_variance,
        "noise_shot_gain": noise.gain,
        "noise_floor_grey_levels": math.sqrt(noise.read_variance),
        "noise_source": noise_source,
        "full_scale": scale,
        "planes": len(planes),
        "planes_used": len(used),
        "distances": len(distances),
        "working_range_mm": [1e3 * near_z_m, 1e3 * far_z_m],
        "working_range_from": range_note,
        "degree": degree,
        "fit_rms_mm": fit_rms,
        "fit_worst_mm": fit_worst,
        "linearity_percent_of_span": _linearity(used),
        "held_out_rms_mm": held_out_rms,
        "held_out_worst_mm": held_out,
        "held_out_worst_percent_of_stand_off": 100 * held_out / stand_off_mm,
        "held_out_worst_percent_of_span": 100 * held_out / span_mm,
    }
    calibration.report.update(report)
    return calibration


# -- which frames are what ------------------------------------------------------------------------


def _is_grid(frame: Any) -> bool:
    """Whether the frame shows a printed dot grid; one that does not say so has no stripes."""
    kind = frame.truth.meta.get("kind") if frame.truth is not None else None
    if kind is not None:
        return bool(kind == "grid")
    return measure_stripes(grey(frame.images["near"])) is None


def _plane_depth(frame: Any) -> np.ndarray | None:
    """Depth [H W] in metres of a frame that shows one plane of known distance, else None."""
    truth = frame.truth
    if truth is None:
        return None
    height, width = frame.images["near"].shape[:2]
    if truth.depth_m is None:
        z = truth.meta.get("z")
        if not isinstance(z, int | float) or truth.meta.get("kind", "plane") != "plane":
            return None
        return np.full((height, width), z / 1e3)
    z_m = truth.depth_m.astype(np.float64)
    if z_m.shape != (height, width) or not np.isfinite(z_m).all() or z_m.min() <= 0:
        return None
    rows, columns = np.mgrid[0:height:8, 0:width:8]
    design = np.stack([columns.ravel(), rows.ravel(), np.ones(rows.size)], axis=1)
    target = 1 / z_m[::8, ::8].ravel()
    fitted = design @ np.linalg.lstsq(design, target, rcond=None)[0]
    off_mm = 1e3 * (1 / fitted - 1 / target)
    return z_m if float(np.sqrt((off_mm**2).mean())) < _PLANE_RMS_MM else None


def _planes(frames: Frames) -> Iterator[tuple[Any, np.ndarray]]:
    for frame in frames():
        z_m = _plane_depth(frame)
        if z_m is not None and not _is_grid(frame):
            yield frame, z_m


def _registered(frame: Any, similarity: Similarity) -> tuple[np.ndarray, np.ndarray]:
    return grey(frame.images["near"]), warp_to_near(grey(frame.images["far"]), similarity)


def _middle_slice(shape: tuple[int, ...]) -> tuple[slice, slice]:
    top, left = max(0, (shape[0] - PATCH_PX) // 2), max(0, (shape[1] - PATCH_PX) // 2)
    return slice(top, top + PATCH_PX), slice(left, left + PATCH_PX)


def _middle(z_m: np.ndarray, ratio: np.ndarray) -> tuple[float, float]:
    middle = _middle_slice(ratio.shape)
    return float(np.median(z_m[middle])), float(ratio[middle].mean())


def _smooth(image: np.ndarray, taps: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)


# -- step one -------------------------------------------------------------------------------------


def _register(frames: Frames) -> tuple[Similarity, dict[str, Any]]:
    near_points, far_points = [], []
    pairs: list[tuple[np.ndarray, np.ndarray]] = []
    seen, stride = 0, 1
    size = (0, 0)
    for frame in frames():
        near, far = grey(frame.images["near"]), grey(frame.images["far"])
        if near.shape != far.shape:
            raise ValueError(f"frame {frame.index}: near is {near.shape}, far is {far.shape}")
        height, width = near.shape
        if size not in ((0, 0), (width, height)):
            raise ValueError(
                f"frame {frame.index}: {width}×{height} pixels after {size[0]}×{size[1]}"
            )
        size = (width, height)
        if _is_grid(frame):
            matched = match_dots(find_dots(near), find_dots(far))
            if len(matched[0]) >= _MIN_DOTS:
                near_points.append(matched[0])
                far_points.append(matched[1])
        elif seen % stride == 0:
            # A few frames, spread over a recording whose length is not known: whenever there
            # are too many, every other one is dropped and the stride doubled.
            pairs.append((near, far))
            if len(pairs) > _ALIGNING_PAIRS:
                pairs, stride = pairs[::2], 2 * stride
        seen += 1
    if seen == 0:
        raise ValueError("the recording has no frame with both a near and a far image")
    width, height = size
    start = Similarity.identity(width, height)
    if near_points:
        fit = fit_similarity(np.concatenate(near_points), np.concatenate(far_points), width, height)
        similarity = fit.similarity
        report = _describe(fit.similarity) | {
            "from": f"{len(near_points)} dot grids, {fit.points} dots",
            "residual_rms_px": fit.residual_rms_px,
            "before_rms_px": fit.before_rms_px,
            "residual_each_px": [
                _apart(similarity, a, b) for a, b in zip(near_points, far_points, strict=True)
            ],
        }
    else:
        similarity = refine_similarity(pairs, start)
        before = [misalignment_rms_px(near, far) for near, far in pairs]
        after = [misalignment_rms_px(near, warp_to_near(far, similarity)) for near, far in pairs]
        report = _describe(similarity) | {
            "from": f"{len(pairs)} image pairs",
            "residual_rms_px": _root_mean_square(after),
            "before_rms_px": _root_mean_square(before),
        }
    return similarity, report


def _describe(similarity: Similarity) -> dict[str, Any]:
    return {
        "scale": similarity.scale,
        "rotation_deg": similarity.rotation_deg,
        "dx_px": similarity.dx_px,
        "dy_px": similarity.dy_px,
    }


def _apart(similarity: Similarity, near: np.ndarray, far: np.ndarray) -> float:
    mapped = np.column_stack([near, np.ones(len(near))]) @ similarity.far_from_near.T
    return _root_mean_square(np.linalg.norm(mapped - far, axis=1))


def _root_mean_square(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


# -- stripes, light and noise ---------------------------------------------------------------------


def _stripes(frames: Frames, similarity: Similarity) -> Stripes:
    """Median period and direction over the planes, measured where the pattern is sharper."""
    found = []
    for frame, _ in _planes(frames):
        near, far = _registered(frame, similarity)
        both = [s for s in (measure_stripes(near), measure_stripes(far)) if s is not None]
        if both:
            found.append(max(both, key=lambda s: s.strength))
    if not found:
        raise ValueError(
            "the recording has no plane of known distance with stripes on it "
            "(needs /ground_truth/depth, or z in /ground_truth/meta)"
        )
    upright = np.median([abs(s.angle_deg) <= 45 for s in found]) > 0.5
    # Directions of level stripes straddle the ends of (-90, 90], so they are turned first.
    angles = [s.angle_deg if upright else s.angle_deg % 180 for s in found]
    angle = float(np.median(angles))
    return Stripes(
        float(np.median([s.period_px for s in found])),
        angle - 180 if angle > 90 else angle,
        float(np.median([s.strength for s in found])),
    )


def _gain(frames: Frames, similarity: Similarity) -> tuple[np.ndarray, np.ndarray, float]:
    """Light on the near sensor over that on the far one: coefficients [6], map [H W], spread.

    The images are averaged over 16×16 cells, which no stripe survives, and a quadratic is fitted
    to the cells' ratios over all planes.  The spread is the standard deviation of the planes'
    drift against it, in percent.
    """
    near_light = np.zeros((_GAIN_CELLS, _GAIN_CELLS))
    far_light = np.zeros((_GAIN_CELLS, _GAIN_CELLS))
    shape = (0, 0)
    for frame, _ in _planes(frames):
        near, far = _registered(frame, similarity)
        shape = near.shape
        size = (_GAIN_CELLS, _GAIN_CELLS)
        near_light += cv2.resize(near, size, interpolation=cv2.INTER_AREA)
        far_light += cv2.resize(far, size, interpolation=cv2.INTER_AREA)
    ratio = near_light / np.maximum(far_light, 1e-9)
    terms = gain_terms(_GAIN_CELLS, _GAIN_CELLS).reshape(-1, 6)
    # The cells' centres lie half a cell inside the image's border.
    inner = 1 - 1 / _GAIN_CELLS
    terms = terms * np.array([1, inner, inner, inner**2, inner**2, inner**2])
    gain = np.linalg.lstsq(terms, ratio.ravel(), rcond=None)[0]
    gain_map = (gain_terms(*shape) @ gain).astype(np.float32)
    drifts = [
        light_ratio(*_registered(frame, similarity), gain_map) for frame, _ in _planes(frames)
    ]
    return gain, gain_map, 100 * float(np.std(drifts))


def _full_scale(frames: Frames) -> float:
    """The full scale that holds every plane: one frame of a 12-bit camera may look like 10 bits.

    Of floating-point images the greatest level seen, for a file holds no infinity.
    """
    highest, levels = 0.0, 0.0
    for frame, _ in _planes(frames):
        images = [frame.images[channel] for channel in ("near", "far")]
        highest = max(highest, full_scale(*images))
        levels = max(levels, *(float(np.nanmax(image)) for image in images))
    return highest if math.isfinite(highest) else levels


class _PhotonTransfer:
    """Variance against grey level, gathered in bins."""

    def __init__(self) -> None:
        self.count = np.zeros(_NOISE_LEVELS)
        self.level = np.zeros(_NOISE_LEVELS)
        self.variance = np.zeros(_NOISE_LEVELS)
        self.top = 0.0

    def add(self, recorded: np.ndarray, level: np.ndarray, squared: np.ndarray) -> None:
        """Samples [N] of the variance at grey levels [N] of an image of ``recorded``'s type."""
        if not self.top:
            self.top = full_scale(recorded)
            if not math.isfinite(self.top):
                self.top = float(np.nanmax(recorded))
        usable = (level < 0.95 * self.top) & (level > 0)
        bins = np.minimum((level[usable] / self.top * _NOISE_LEVELS).astype(int), _NOISE_LEVELS - 1)
        self.count += np.bincount(bins, minlength=_NOISE_LEVELS)
        self.level += np.bincount(bins, level[usable], minlength=_NOISE_LEVELS)
        self.variance += np.bincount(bins, squared[usable], minlength=_NOISE_LEVELS)

    def fit(self, terms: int) -> SensorNoise | None:
        """Read and shot noise of a non-negative polynomial in the level; None with too little."""
        good = self.count > _NOISE_MIN_SAMPLES
        if int(good.sum()) < 2:
            return None
        level, variance = (v[good] / self.count[good] for v in (self.level, self.variance))
        weight = np.sqrt(self.count[good]) / np.maximum(variance, 1e-9)
        design = np.vander(level, min(terms, int(good.sum())), increasing=True)
        fitted, _ = nnls(design * weight[:, None], variance * weight)
        return SensorNoise(max(float(fitted[0]), _QUANTISATION), float(fitted[1]))


def _noise(frames: Frames, stripes: Stripes) -> tuple[SensorNoise, str]:
    """Temporal noise, by photon transfer on the planes.

    From successive shots of one plane: half the squared difference of two is the variance of
    one.  Where no plane was shot twice, from the second difference along the stripes, where the
    image is smooth; that contains the pixels' fixed pattern, which grows with the square of the
    level, and is fitted and left out.
    """
    repeated, single = _PhotonTransfer(), _PhotonTransfer()
    before: tuple[float, dict[str, np.ndarray]] | None = None
    for frame, z_m in _planes(frames):
        z = float(z_m.mean())
        images = {c: frame.images[c] for c in ("near", "far")}
        for channel, image in images.items():
            now = grey(image)
            if before is not None and abs(before[0] - z) < _SAME_PLACE_M:
                other = grey(before[1][channel])
                repeated.add(image, ((now + other) / 2).ravel(), ((now - other) ** 2).ravel() / 2)
            along = now if stripes.upright else now.T
            second = along[:-2] - 2 * along[1:-1] + along[2:]
            single.add(image, along[1:-1].ravel(), (second**2).ravel() / 6)
        before = (z, images)
    fitted = repeated.fit(2)
    if fitted is not None:
        return fitted, "repeated shots of planes"
    fitted = single.fit(3)
    if fitted is not None:
        return fitted, "single shots of planes, along the stripes"
    return SensorNoise(), "quantisation only: too few pixels"


# -- step two -------------------------------------------------------------------------------------


def _working_range(planes: list[_Plane], rig: dict[str, str]) -> tuple[float, float, str]:
    """The longest run of distances over which the ratio falls steadily, within the focal planes.

    Where the recording's ``rig`` names the focal planes (``u1``, ``u2``, millimetres) the range
    ends there: beyond them the same ratio means two distances.
    """
    if len(planes) < _MIN_PLANES:
        raise ValueError(
            f"expected {_MIN_PLANES} planes of known distance or more, found {len(planes)}"
        )
    by_distance: dict[float, list[float]] = {}
    for plane in planes:
        by_distance.setdefault(round(plane.z_m, 5), []).append(plane.ratio)
    z = np.array(sorted(by_distance))
    ratio = np.array([np.mean(by_distance[d]) for d in z])
    if len(z) < _MIN_PLANES:
        raise ValueError(f"expected planes at {_MIN_PLANES} distances or more, found {len(z)}")
    slope = -np.diff(ratio) / np.diff(1 / z)
    falling = -slope * np.sign(np.median(-slope))
    steady = falling > _FLATTEST_SLOPE * float(np.median(np.abs(slope)))
    start = best_start = best_end = 0
    for i in range(len(steady) + 1):
        if i == len(steady) or not steady[i]:
            if i - start > best_end - best_start:
                best_start, best_end = start, i
            start = i + 1
    low, high = float(z[best_start]), float(z[best_end])
    note = "steady part of the ratio over the planes"
    try:
        u1, u2 = sorted((float(rig["u1"]) / 1e3, float(rig["u2"]) / 1e3))
    except (KeyError, ValueError):
        u1, u2 = low, high
    if u1 > low or u2 < high:
        note += ", within the rig's focal planes"
    return max(low, u1), min(high, u2), note


class _NormalEquations:
    """Per-pixel least squares of a polynomial, held as sums over the planes."""

    def __init__(self, degree: int) -> None:
        self.degree = degree
        self.powers: np.ndarray | None = None
        self.products: np.ndarray | None = None

    def add(self, ratio: np.ndarray, target: np.ndarray) -> None:
        if self.powers is None or self.products is None:
            self.powers = np.zeros((2 * self.degree + 1, *ratio.shape))
            self.products = np.zeros((self.degree + 1, *ratio.shape))
        power = np.ones(ratio.shape)
        for k in range(2 * self.degree + 1):
            self.powers[k] += power
            if k <= self.degree:
                self.products[k] += power * target
            power *= ratio

    def solve(self, degree: int | None = None) -> np.ndarray:
        """Coefficients of this or a lower degree, lowest power first, float32 [degree + 1 H W]."""
        assert self.powers is not None and self.products is not None
        terms = (self.degree if degree is None else degree) + 1
        shape = self.products.shape[1:]
        curve = np.empty((terms, *shape), np.float32)
        order = np.add.outer(np.arange(terms), np.arange(terms))
        for row in range(shape[0]):
            matrix = np.moveaxis(self.powers[:, row][order], -1, 0)
            matrix = matrix + 1e-9 * np.eye(terms)
            right = self.products[:terms, row].T[..., None]
            curve[:, row] = np.linalg.solve(matrix, right)[..., 0].T
        return curve


def _fit_modulation(points: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    t = np.concatenate([p[0] for p in points]).astype(np.float64)
    shown = np.concatenate([p[1] for p in points]).astype(np.float64)
    terms = min(_MODULATION_TERMS, len(points))
    design = np.vander(np.clip(t, 0, 1), terms, increasing=True)
    return np.linalg.lstsq(design, shown, rcond=None)[0].astype(np.float32)


# -- the report -----------------------------------------------------------------------------------


def _held_out(patches: list[_Patch], degree: int, neighbourhood_px: int) -> tuple[float, float]:
    """Root mean square and worst error of relative depth on planes that the curve has not seen.

    In the middle 32×32.  Each distance between the first and the last is left out in turn (all
    its shots), and the middle's curves are fitted to the others as the calibration itself is.
    """
    squares, pixels, worst = 0.0, 0, 0.0
    for left_out in sorted({patch.z_m for patch in patches})[1:-1]:
        normal = _NormalEquations(degree)
        for patch in patches:
            if patch.z_m != left_out:
                size = (neighbourhood_px, neighbourhood_px)
                shared = cv2.blur(patch.ratio, size, borderType=cv2.BORDER_REFLECT_101)
                normal.add(shared, patch.target)
        curve = normal.solve()
        for patch in patches:
            if patch.z_m == left_out:
                error = (_evaluate(curve, patch.ratio) - patch.target).astype(np.float64)
                squares += float((error**2).sum())
                pixels += error.size
                worst = max(worst, float(np.abs(error).max()))
    return math.sqrt(squares / pixels), worst


def _fit_residuals(patches: list[_Patch], calibration: Calibration) -> tuple[float, float]:
    """Root mean square and worst residual (mm) of the fit in the middle 32×32 of each plane."""
    squares, pixels, worst = 0.0, 0, 0.0
    curve = calibration.curve[:, *_middle_slice(calibration.curve.shape[1:])]
    for patch in patches:
        t = _evaluate(curve, patch.ratio)
        error_mm = 1e3 * (calibration.z_m(t) - calibration.z_m(patch.target)).astype(np.float64)
        squares += float((error_mm**2).sum())
        pixels += error_mm.size
        worst = max(worst, float(np.abs(error_mm).max()))
    return math.sqrt(squares / pixels), worst


def _evaluate(curve: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    value = curve[-1].copy()
    for coefficient in curve[-2::-1]:
        value = value * ratio + coefficient
    return value


def _linearity(planes: list[_Plane]) -> float:
    """Greatest departure of the ratio from a straight line over 1/z, percent of its span."""
    inverse = np.array([1 / p.z_m for p in planes])
    ratio = np.array([p.ratio for p in planes])
    line = np.polynomial.Polynomial.fit(inverse, ratio, 1)
    return 100 * float(np.abs(line(inverse) - ratio).max() / np.ptp(ratio))


class Procedure:
    """What ``workbench calibrate`` runs for this product."""

    Parameters = CalibrateParameters
    run = staticmethod(calibrate)
    OpticsParameters = OpticsParameters
    rig_record = staticmethod(rig_record)

    @staticmethod
    def from_optics(
        source: Path | Mapping[str, str],
        size: tuple[int, int] | None,
        parameters: Any,
    ) -> Calibration:
        """The calibration from a rig alone: a TOML file, or a recording's metadata."""
        rig = read_rig(source, size) if isinstance(source, Path) else Rig.from_metadata(source)
        return from_optics(rig, size, parameters)

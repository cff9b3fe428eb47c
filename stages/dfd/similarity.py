"""Step one of the calibration (section 3.2): the far image onto the near image's pixel grid.

The two sensors see the scene at magnifications that differ by s1/s2, and are never mounted
exactly alike, so the far image is mapped by a similarity.  The paper turns the screws of a
multi-axis translator; here the residual misalignment is measured and resampled away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numba
import numpy as np

_MATCH_ROUNDS = 3
_OUTLIER_SIGMAS = 4.0
_SMALLEST_FOR_DRIFT_PX = 32
_DRIFT_ROWS = 64
_DRIFT_SHRINK = 4
_ALIGNING_SIDES_PX = (128, 256, 512, 1024)


@dataclass(frozen=True)
class Similarity:
    """x_far = scale · R(rotation) · (x_near - centre) + centre + (dx, dy), in pixels.

    ``rotation_deg`` is counter-clockwise as displayed; ``centre`` is the image's middle, so that
    the four numbers are nearly independent of one another.
    """

    scale: float
    rotation_deg: float
    dx_px: float
    dy_px: float
    width: int
    height: int

    @staticmethod
    def identity(width: int, height: int) -> Similarity:
        return Similarity(1.0, 0.0, 0.0, 0.0, width, height)

    @property
    def far_from_near(self) -> np.ndarray:
        """The map as a 2×3 matrix on (x, y, 1)."""
        a, b = self._ab
        cx, cy = (self.width - 1) / 2, (self.height - 1) / 2
        return np.array(
            [
                [a, b, cx + self.dx_px - a * cx - b * cy],
                [-b, a, cy + self.dy_px + b * cx - a * cy],
            ]
        )

    def resized(self, width: int, height: int) -> Similarity:
        """The same map for the images shrunk or enlarged to ``width`` × ``height`` pixels."""
        ratio = width / self.width
        return replace(
            self,
            dx_px=self.dx_px * ratio,
            dy_px=self.dy_px * ratio,
            width=width,
            height=height,
        )

    @property
    def _ab(self) -> tuple[float, float]:
        turn = math.radians(self.rotation_deg)
        return self.scale * math.cos(turn), self.scale * math.sin(turn)

    @property
    def is_identity(self) -> bool:
        """Whether it moves no pixel of the image by as much as a hundredth of a pixel.

        OpenCV's warp rounds positions to 1/32 px: it would change nothing, and take its time.
        """
        corners = np.array([[0, 0, 1], [self.width - 1, self.height - 1, 1]], float).T
        return bool(np.abs(self.far_from_near @ corners - corners[:2]).max() < 1e-2)

    @staticmethod
    def from_ab(a: float, b: float, dx: float, dy: float, width: int, height: int) -> Similarity:
        """From a = scale·cos, b = scale·sin and the shift of the image's middle."""
        return Similarity(math.hypot(a, b), math.degrees(math.atan2(b, a)), dx, dy, width, height)


def warp_to_near(far: np.ndarray, similarity: Similarity) -> np.ndarray:
    """``far`` [H W] resampled onto the near image's grid, float32 [H W].

    Lanczos over 8×8 pixels: a bilinear warp blurs the image by a measurable amount, and blur
    is what this sensor measures.  An identity is passed through untouched.  The border is
    mirrored, so that no dark frame is read as an edge.
    """
    if similarity.is_identity:
        return far.astype(np.float32, copy=False)
    return cv2.warpAffine(
        far.astype(np.float32, copy=False),
        similarity.far_from_near,
        (similarity.width, similarity.height),
        flags=cv2.INTER_LANCZOS4 | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT_101,
    )


# -- from dot grids --------------------------------------------------------------------------------


def find_dots(image: np.ndarray) -> np.ndarray:
    """Centres (x, y) of the bright dots on a dark ground in ``image`` [H W], float64 [N 2].

    Dots are the connected parts above the middle between ground and mark (Otsu); the centre is
    the centroid of the grey levels above the local ground, which a symmetric blur does not
    move.  Dots cut by the border or of an odd size are left out.  N may be 0.
    """
    values = image.astype(np.float32)
    top = float(values.max())
    if top <= 0:
        return np.zeros((0, 2))
    bytes_ = np.clip(values * (255 / top), 0, 255).astype(np.uint8)
    _, mask = cv2.threshold(bytes_, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    count, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return np.zeros((0, 2))
    areas = stats[1:, cv2.CC_STAT_AREA]
    usual = float(np.median(areas))
    margin = max(2, round(math.sqrt(usual) / 2) + 1)
    height, width = values.shape
    centres = []
    for x, y, w, h, area in stats[1:]:
        x0, y0, x1, y1 = x - margin, y - margin, x + w + margin, y + h + margin
        if not 0.4 * usual <= area <= 2.5 * usual:
            continue
        if x0 < 0 or y0 < 0 or x1 > width or y1 > height:
            continue
        patch = values[y0:y1, x0:x1]
        rim = np.concatenate([patch[0], patch[-1], patch[1:-1, 0], patch[1:-1, -1]])
        weight = np.clip(patch - np.median(rim), 0, None)
        total = float(weight.sum())
        if total <= 0:
            continue
        ys, xs = np.mgrid[y0:y1, x0:x1]
        centres.append((float((weight * xs).sum()) / total, float((weight * ys).sum()) / total))
    return np.array(centres).reshape(-1, 2)


def match_dots(near: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of mutually nearest dots, after removing the common drift: two arrays [M 2].

    Dots sit on a lattice, so a pair is only believed within a third of the lattice's pitch.
    """
    if len(near) < 4 or len(far) < 4:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pitch = float(np.median(_nearest(near, near, skip_self=True)[1]))
    moved = far
    pairs = np.zeros((0, 2), int)
    for _ in range(_MATCH_ROUNDS):
        forward, distance = _nearest(near, moved)
        backward, _ = _nearest(moved, near)
        mutual = np.flatnonzero(
            (backward[forward] == np.arange(len(near))) & (distance < pitch / 3)
        )
        if len(mutual) < 4:
            return np.zeros((0, 2)), np.zeros((0, 2))
        pairs = np.stack([mutual, forward[mutual]], axis=1)
        design = np.column_stack([far[pairs[:, 1]], np.ones(len(pairs))])
        solution, *_ = np.linalg.lstsq(design, near[pairs[:, 0]], rcond=None)
        moved = np.column_stack([far, np.ones(len(far))]) @ solution
    return near[pairs[:, 0]], far[pairs[:, 1]]


@dataclass(frozen=True)
class SimilarityFit:
    """A fitted similarity, with the root mean square of what it leaves and how many points."""

    similarity: Similarity
    residual_rms_px: float
    points: int
    before_rms_px: float
    """Root mean square misalignment with no registration at all."""


def fit_similarity(near: np.ndarray, far: np.ndarray, width: int, height: int) -> SimilarityFit:
    """Least-squares similarity that takes points ``near`` [M 2] to ``far`` [M 2].

    Points further off than four robust standard deviations are left out, once.  Raises
    ``ValueError`` with fewer than 4 points.
    """
    if len(near) < 4:
        raise ValueError(f"expected at least 4 matched points, found {len(near)}")
    centre = np.array([(width - 1) / 2, (height - 1) / 2])
    keep = np.ones(len(near), bool)
    for last in (False, True):
        x, y = (near[keep] - centre).T
        one, zero = np.ones_like(x), np.zeros_like(x)
        design = np.concatenate([np.stack([x, y, one, zero], 1), np.stack([y, -x, zero, one], 1)])
        target = (far[keep] - centre).T.ravel()
        a, b, dx, dy = np.linalg.lstsq(design, target, rcond=None)[0]
        fitted = Similarity.from_ab(float(a), float(b), float(dx), float(dy), width, height)
        mapped = np.column_stack([near, np.ones(len(near))]) @ fitted.far_from_near.T
        off = np.linalg.norm(mapped - far, axis=1)
        if not last:
            spread = 1.4826 * float(np.median(off)) + 1e-6
            kept = off < _OUTLIER_SIGMAS * spread
            keep = kept if int(kept.sum()) >= 4 else keep
    before = np.linalg.norm(near[keep] - far[keep], axis=1)
    return SimilarityFit(
        fitted,
        float(np.sqrt((off[keep] ** 2).mean())),
        int(keep.sum()),
        float(np.sqrt((before**2).mean())),
    )


def _nearest(
    points: np.ndarray, others: np.ndarray, skip_self: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    distance, index = cKDTree(others).query(points, k=2 if skip_self else 1)
    return (index[:, 1], distance[:, 1]) if skip_self else (index, distance)


# -- from the images themselves --------------------------------------------------------------------


def refine_similarity(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]],
    start: Similarity,
    iterations: int = 12,
) -> Similarity:
    """The similarity that best aligns image pairs ``(near, far)`` [H W], by Gauss-Newton.

    Both images of a pair are smoothed alike and brought to equal local contrast, so that what
    is left of the difference in blur is even and does not pull on the (odd) gradients.  A
    direction that no pair shows (along the stripes of bare planes) keeps its value in
    ``start``: the normal equations are solved by truncated eigenvalues.
    """
    prepared = [(_equalised(near), _equalised(far)) for near, far in pairs]
    width, height = start.width, start.height
    ys, xs = np.mgrid[0:height, 0:width].astype(np.float32)
    xs -= (width - 1) / 2
    ys -= (height - 1) / 2
    inner = np.zeros((height, width), bool)
    margin = max(4, round(0.04 * min(width, height)))
    inner[margin:-margin, margin:-margin] = True
    half = min(width, height) / 2
    current = start
    for _ in range(iterations):
        normal = np.zeros((4, 4))
        right = np.zeros(4)
        for near, far in prepared:
            warped = warp_to_near(far, current)
            mean = 0.5 * (warped + near)
            gx = cv2.Sobel(mean, cv2.CV_32F, 1, 0, ksize=3, scale=1 / 8)
            gy = cv2.Sobel(mean, cv2.CV_32F, 0, 1, ksize=3, scale=1 / 8)
            columns = [gx * xs + gy * ys, gx * ys - gy * xs, gx, gy]
            columns[0] /= half
            columns[1] /= half
            jacobian = np.stack([c[inner] for c in columns], axis=1).astype(np.float64)
            residual = (near - warped)[inner].astype(np.float64)
            normal += jacobian.T @ jacobian
            right += jacobian.T @ residual
        values, vectors = np.linalg.eigh(normal)
        good = values > 1e-2 * values[-1]
        step = vectors[:, good] @ ((vectors[:, good].T @ right) / values[good])
        a, b = current._ab
        current = Similarity.from_ab(
            a + step[0] / half,
            b + step[1] / half,
            current.dx_px + step[2],
            current.dy_px + step[3],
            width,
            height,
        )
        if np.abs(step).max() < 1e-4:
            break
    return current


def align_pair(near: np.ndarray, far: np.ndarray, starts: Sequence[Similarity]) -> Similarity:
    """The similarity of one image pair [H W], from coarse to fine, for lenses that were refocused.

    ``starts`` are guesses, and what the images say decides between them: a lens's data may be
    off, or the pair may have been aligned before.  Each is refined on images shrunk to 128
    pixels and more, so that misalignment of several per cent of the image is found; the finest
    images have 1024 pixels, on which a tenth of a pixel is told.
    """
    height, width = near.shape
    pyramid = []
    for side in _ALIGNING_SIDES_PX:
        factor = max(1.0, max(width, height) / side)
        size = (max(1, round(width / factor)), max(1, round(height / factor)))
        if min(size) >= _SMALLEST_FOR_DRIFT_PX:
            pyramid.append(
                (
                    cv2.resize(near, size, interpolation=cv2.INTER_AREA),
                    cv2.resize(far, size, interpolation=cv2.INTER_AREA),
                )
            )
        if factor == 1:
            break
    if not pyramid:
        return starts[0]

    def refined(level: int, guess: Similarity) -> tuple[float, Similarity]:
        """The guess made better on these images, or as it was, with the images' agreement."""
        pair = pyramid[level]
        known = guess.resized(pair[0].shape[1], pair[0].shape[0])
        # From one level to the next there is little left to find.
        better = refine_similarity([pair], known, iterations=3 if level else 12)
        found = [(_agreement(*pair, one), one) for one in (known, better)]
        return max(found, key=lambda one: one[0])

    _, best = max((refined(0, guess) for guess in starts), key=lambda one: one[0])
    for level in range(1, len(pyramid)):
        _, best = refined(level, best)
    return best.resized(width, height)


def _agreement(near: np.ndarray, far: np.ndarray, similarity: Similarity) -> float:
    """Correlation of the images, less their local means, where both have pixels; -1..1."""
    seen = cv2.warpAffine(
        np.ones(far.shape, np.uint8),
        similarity.far_from_near,
        (similarity.width, similarity.height),
        flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
    )
    if int(seen.sum()) < seen.size // 4:
        return -1.0
    inside = seen > 0
    a = _equalised(near)[inside]
    b = _equalised(warp_to_near(far, similarity))[inside]
    norm = math.sqrt(float((a * a).sum()) * float((b * b).sum()))
    return float((a * b).sum()) / norm if norm > 0 else -1.0


def _equalised(image: np.ndarray) -> np.ndarray:
    """``image`` less its local mean, over its local contrast; float32."""
    values = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.5)
    size = max(9, (min(image.shape) // 12) | 1)
    centred = values - cv2.blur(values, (size, size))
    contrast = np.sqrt(cv2.blur(centred * centred, (size, size)))
    return centred / (contrast + 0.02 * float(contrast.max()) + 1e-6)


def misalignment_rms_px(near: np.ndarray, far: np.ndarray) -> float:
    """Root mean square misalignment that is left between two registered images [H W], pixels.

    One Gauss-Newton step of :func:`refine_similarity` away from no motion, taken as the root
    mean square over the image of the motion that it asks for.  Directions that the images do
    not show count as aligned; an image without contrast gives 0.

    This runs on every frame, so it looks at some 64 rows and takes the local mean and contrast,
    which are smooth, from images shrunk by four.  The images themselves must not be shrunk:
    stripes of five pixels would have no true gradient left.
    """
    height, width = near.shape
    if min(height, width) < _SMALLEST_FOR_DRIFT_PX:
        return 0.0
    margin = max(4, round(0.04 * min(width, height)))
    stride = max(1, height // _DRIFT_ROWS)
    normal, right = _normal_equations(_evened(near), _evened(far), margin, stride)
    if not (np.isfinite(normal).all() and np.isfinite(right).all() and normal.any()):
        return 0.0
    values, vectors = np.linalg.eigh(normal)
    good = values > 1e-2 * values[-1]
    turn_a, turn_b, dx, dy = vectors[:, good] @ ((vectors[:, good].T @ right) / values[good])
    # The step's first two numbers are motions at half the shorter side away from the middle, and
    # the mean square distance from the middle is a third of that to a corner.
    half = min(width, height) / 2
    distance = ((width - 1) ** 2 + (height - 1) ** 2) / 12 / half**2
    return math.sqrt((turn_a**2 + turn_b**2) * distance + dx**2 + dy**2)


def _evened(image: np.ndarray) -> np.ndarray:
    """As :func:`_equalised`, with local mean and contrast from a shrunk image; C-contiguous."""
    height, width = image.shape
    small = (max(1, width // _DRIFT_SHRINK), max(1, height // _DRIFT_SHRINK))
    side = max(3, round(min(height, width) / 12 / _DRIFT_SHRINK) | 1)

    def local_mean(values: np.ndarray) -> np.ndarray:
        return cv2.blur(cv2.resize(values, small, interpolation=cv2.INTER_AREA), (side, side))

    def enlarged(values: np.ndarray) -> np.ndarray:
        return cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)

    smooth: np.ndarray = cv2.GaussianBlur(image.astype(np.float32, copy=False), (9, 9), 1.5)
    centred = smooth - enlarged(local_mean(smooth))
    contrast = np.sqrt(local_mean(centred * centred))
    over = 1 / (contrast + np.float32(0.02) * contrast.max() + np.float32(1e-6))
    return centred * enlarged(over)


@numba.njit(cache=True, fastmath={"contract", "reassoc"})
def _normal_equations(near, far, margin, stride):  # type: ignore[no-untyped-def]
    """JᵀJ [4 4] and Jᵀr [4] of a similarity step, over every ``stride``-th row, float64.

    The columns of J are the image's gradient against turning and scaling about the middle (in
    units of half the shorter side) and against shifts, from the Sobel derivatives of the mean of
    both images; r is near less far.  Sums run in float32 along a row, so that they are SIMD,
    and in float64 over the rows.
    """
    height, width = near.shape
    normal = np.zeros((4, 4))
    right = np.zeros(4)
    middle_x, middle_y = np.float32((width - 1) / 2), np.float32((height - 1) / 2)
    over = np.float32(2 / min(width, height))
    two = np.float32(2)
    # 1/8 of the Sobel kernel, 1/2 of the mean.
    unit = np.float32(1 / 16)
    for y in range(margin, height - margin, stride):
        near_0, near_1, near_2 = near[y - 1], near[y], near[y + 1]
        far_0, far_1, far_2 = far[y - 1], far[y], far[y + 1]
        v = (np.float32(y) - middle_y) * over
        aa = ab = ax = ay = bb = bx = by = xx = xy = yy = np.float32(0)
        ra = rb = rx = ry = np.float32(0)
        for x in range(margin, width - margin):
            above_left = near_0[x - 1] + far_0[x - 1]
            above_right = near_0[x + 1] + far_0[x + 1]
            below_left = near_2[x - 1] + far_2[x - 1]
            below_right = near_2[x + 1] + far_2[x + 1]
            across = near_1[x + 1] + far_1[x + 1] - near_1[x - 1] - far_1[x - 1]
            down = near_2[x] + far_2[x] - near_0[x] - far_0[x]
            gx = unit * (above_right - above_left + below_right - below_left + two * across)
            gy = unit * (below_left - above_left + below_right - above_right + two * down)
            u = (np.float32(x) - middle_x) * over
            ga = gx * u + gy * v
            gb = gx * v - gy * u
            residual = near_1[x] - far_1[x]
            aa += ga * ga
            ab += ga * gb
            ax += ga * gx
            ay += ga * gy
            bb += gb * gb
            bx += gb * gx
            by += gb * gy
            xx += gx * gx
            xy += gx * gy
            yy += gy * gy
            ra += ga * residual
            rb += gb * residual
            rx += gx * residual
            ry += gy * residual
        upper = ((aa, ab, ax, ay), (ab, bb, bx, by), (ax, bx, xx, xy), (ay, by, xy, yy))
        normal += np.array(upper, np.float64)
        right += np.array((ra, rb, rx, ry), np.float64)
    return normal, right

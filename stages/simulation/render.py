"""The bifocal sensor's images of a scene by ray tracing, and the ground truth that goes with them.

A pixel is the mean over rays from points of its area through points of the lens (a thin lens: all
rays of a pixel point meet at its focus), both focus settings with one set of points.  Where a ray
ends, a ray to a point of the projector's aperture finds shadow; the pattern that arrives is
averaged over the aperture in closed form, so that its defocus carries no noise of sampling.  Where
the aperture is half hidden that average is the whole aperture's, which blurs the stripes of a
penumbra (less than a pixel wide) a little too much.  Sky and one diffuse bounce are gathered once
for each pixel, as a pinhole sees the scene, and shared by the rays that end on the same face
nearby.  Surfaces are Lambertian; the image falls off with cos⁴.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from workbench.errors import DataError
from workbench.extras import required

from ..optics.analytic import disc_transfer, pattern_mean, pattern_value
from ..optics.rig import CHANNELS, Channel, Pattern, Projector, Rig
from . import rays
from .bodies import Body

_RAYS_AT_ONCE = 1 << 19
_PATTERN_CELLS = {"stripes": (1, 1024), "sine": (1, 256), "none": (1, 1)}
_BLUR_LEVELS = 96
_PAD_PX = 12
"""How far beyond the image's border the scene is looked at."""


@dataclass(frozen=True)
class Lighting:
    """What lights the scene beside the pattern, all relative to the projector's focal plane."""

    sky: float = 0.02
    """Light of an unobstructed sky, as a fraction of the open projector's."""
    bounce: float = 1.0
    """Strength of the one diffuse bounce; 1 is physical, 0 none."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """Light and truth of one frame.

    ``light`` maps near and far to float64 [H W], albedo × irradiance: 1 for white facing the
    projector at its focus; ``open_light`` is the same without the pattern, the projector open.
    ``depth_mm`` is float64 [H W], z along the axis through pixel centres, NaN where nothing is;
    ``instances`` and ``faces`` (coplanar groups, counted for each mesh from 0) are uint8 [H W].
    """

    light: dict[Channel, np.ndarray]
    open_light: dict[Channel, np.ndarray]
    depth_mm: np.ndarray
    instances: np.ndarray
    faces: np.ndarray


def render(
    rig: Rig,
    bodies: Sequence[Body],
    lighting: Lighting | None = None,
    paths: int = 64,
    seed: int = 0,
    workers: int | None = None,
) -> Rendering:
    """Ray trace ``bodies``.  The same arrays whatever the number of ``workers`` (default: cores).

    ``paths`` is the number of rays for each pixel and image, a power of two.  Raises
    :class:`DataError` for a body that reaches the lens, and for a rig without a projector.
    """
    require_in_front(rig, bodies)
    with ThreadPoolExecutor(workers or os.cpu_count()) as pool:
        return _Tracer(rig, bodies, lighting or Lighting(), paths, seed, pool).rendering()


def require_in_front(rig: Rig, bodies: Sequence[Body]) -> None:
    """Raise :class:`DataError` for a body within the focal length, of which no image is real."""
    for body in bodies:
        if body.instance == 0 or len(body.mesh.triangles) < 3:
            nearest = float(body.camera_from_object[2, 3])  # planes reach anywhere but to the lens
        else:
            nearest = float(body.vertices_mm[:, 2].min())
        if nearest <= rig.focal_length_mm:
            raise DataError(
                f"{body.name} (object {body.instance}) reaches to {nearest:.1f} mm from the lens: "
                f"expected it beyond the focal length, {rig.focal_length_mm:g} mm"
            )


def visible_area_px(rig: Rig, bodies: Sequence[Body], instance: int, per_px: int = 3) -> float:
    """How many pixels show an instance, as a pinhole sees it through ``per_px``² points of each."""
    with ThreadPoolExecutor(1) as pool:
        fine = rig.model_copy(
            update={
                "width_px": rig.width_px * per_px,
                "height_px": rig.height_px * per_px,
                "pixel_pitch_mm": rig.pixel_pitch_mm / per_px,
                "principal_point_px": None,
            }
        )
        seen = _Tracer(fine, bodies, Lighting(), 1, 0, pool).instances()
    return float((seen == instance).sum()) / per_px**2


class _Tracer:
    """One frame's scene, ready to be hit by rays."""

    def __init__(
        self,
        rig: Rig,
        bodies: Sequence[Body],
        lighting: Lighting,
        paths: int,
        seed: int,
        pool: ThreadPoolExecutor,
    ) -> None:
        o3d = required("open3d", "ray casting", "simulate")
        self.rig, self.lighting, self.paths, self.seed = rig, lighting, paths, seed
        self._pool = pool
        self._tensor = o3d.core.Tensor
        self._scene = o3d.t.geometry.RaycastingScene()
        self._none = np.uint32(self._scene.INVALID_ID)
        firsts, first_face, normals, albedo, faces, instances, groups = [], 0, [], [], [], [], []
        count = 0
        for body in bodies:
            self._scene.add_triangles(
                self._tensor.from_numpy(body.vertices_mm.astype(np.float32)),
                self._tensor.from_numpy(body.mesh.triangles.astype(np.uint32)),
            )
            firsts.append(count)
            count += len(body.mesh.triangles)
            normals.append(body.mesh.normals @ body.camera_from_object[:3, :3].T)
            albedo.append(np.full(len(body.mesh.triangles), body.albedo))
            groups.append(body.mesh.faces)
            faces.append(body.mesh.faces + first_face)
            first_face += int(body.mesh.faces.max()) + 1
            instances.append(np.full(len(body.mesh.triangles), body.instance))
        self._first_triangle = np.array(firsts, np.int64)
        self._corners = np.concatenate(
            [body.vertices_mm[body.mesh.triangles[:, 0]] for body in bodies]
        )
        self._normals = np.concatenate(normals)
        self._albedo = np.concatenate(albedo)
        self._face = np.concatenate(faces).astype(np.int32)
        self._face_count = first_face
        self._group = np.concatenate(groups)
        self._instance = np.concatenate(instances)

    def _in_parts(
        self, pixels: np.ndarray, rays_each: int, work: Callable[[np.ndarray], None]
    ) -> None:
        """``work`` on parts of ``pixels``, each part by itself, on the pool's threads."""
        step = max(_RAYS_AT_ONCE // rays_each, 1)
        parts = [pixels[first : first + step] for first in range(0, len(pixels), step)]
        for _ in self._pool.map(work, parts):
            pass

    # -- rays -------------------------------------------------------------------------------------

    def _cast(self, bundle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parameter and triangle (-1 for none) of what rays [P S 6] hit, each [P S]."""
        found = self._scene.cast_rays(self._tensor.from_numpy(bundle))
        geometry = found["geometry_ids"].numpy()
        hit = geometry != self._none
        first = self._first_triangle[np.where(hit, geometry, 0)]
        triangle = np.where(hit, first + found["primitive_ids"].numpy(), -1).astype(np.int32)
        return found["t_hit"].numpy(), triangle

    def _occluded(self, bundle: np.ndarray) -> np.ndarray:
        return self._scene.test_occlusions(
            self._tensor.from_numpy(bundle), tnear=0.0, tfar=1.0
        ).numpy()

    @cached_property
    def _samples(self) -> np.ndarray:
        return _points(self.paths, 6)

    # -- truth ------------------------------------------------------------------------------------

    def _seen(self, channel: Channel, pad: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays through pixel centres and ``pad`` more on each side [h w 6], depth and triangle."""
        shape = (self.rig.height_px + 2 * pad, self.rig.width_px + 2 * pad)
        bundle = np.empty((shape[0] * shape[1], 6), np.float32)
        rays.pinhole_rays(bundle, self.rig.width_px, pad, _camera(self.rig, channel))
        depth, triangle = self._cast(bundle)
        return bundle.reshape(*shape, 6), depth.reshape(shape), triangle.reshape(shape)

    @cached_property
    def _pinhole(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Depth, triangle and points of what the pixel centres see: [H W], [H W], [H W 3]."""
        bundle, depth, triangle = self._seen("near", 0)
        directions = bundle[..., 3:].astype(float)
        return depth.astype(float), triangle, directions * depth[..., None]

    def _plain(self, channel: Channel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Which pixels see one plane only, evenly lit or evenly shadowed; what; and whether lit.

        Bool, int32 and bool [H W].  Judged by what a pinhole sees as far around a pixel as anything
        in the scene is blurred.
        """
        from scipy.ndimage import maximum_filter, minimum_filter

        rig = self.rig
        bundle, depth, triangle = self._seen(channel, _PAD_PX)
        inside = (slice(_PAD_PX, -_PAD_PX),) * 2
        hit = triangle >= 0
        # Points around the projector's aperture and its middle: what all of them light is lit.
        around = np.arange(8) / 8 * 2 * np.pi
        rim = [[np.cos(a), np.sin(a)] for a in around] + [[0.0, 0.0]]
        count = np.zeros(triangle.shape, np.int32)
        for x, y in rim:
            aperture = self._aperture.copy()
            radius = aperture[9]
            aperture[:3] += radius * (x * aperture[3:6] + y * aperture[6:9])
            aperture[9] = 0
            shape = (-1, 1, 6)
            flat = bundle.reshape(shape)
            pixels = np.zeros(len(flat), np.int64)
            count += self._shadow(
                flat, depth.reshape(-1, 1), triangle.reshape(-1, 1), pixels, aperture
            ).reshape(triangle.shape)
        even = (count == 0) | (count == len(rim))
        label = np.where(hit, self._face[triangle] * 2 + (count > 0), -1)
        if not hit.any():
            return np.zeros_like(hit)[inside], triangle[inside], hit[inside]
        nearest, farthest = float(depth[hit].min()), float(depth[hit].max())
        blur = np.abs(rig.blur_px(channel, np.array([nearest, farthest]))).max()
        reach = int(np.ceil(blur / 2 + 1))
        if reach > _PAD_PX:
            return np.zeros_like(hit)[inside], triangle[inside], hit[inside]
        size = 2 * reach + 1
        plain = hit & (minimum_filter(label, size) == maximum_filter(label, size))
        plain &= minimum_filter(even, size)
        return plain[inside], triangle[inside], (count > 0)[inside]

    def instances(self) -> np.ndarray:
        """The instance that each pixel's centre sees, 0 for none, uint8 [H W]."""
        _, triangle, _ = self._pinhole
        return np.where(triangle >= 0, self._instance[triangle], 0).astype(np.uint8)

    def rendering(self) -> Rendering:
        depth, triangle, _ = self._pinhole
        seen = triangle >= 0
        light, open_light = {}, {}
        for channel in CHANNELS:
            light[channel], open_light[channel] = self._image(channel)
        groups = np.minimum(self._group, 255)
        return Rendering(
            light,
            open_light,
            np.where(seen, depth, np.nan),
            self.instances(),
            np.where(seen, groups[triangle], 0).astype(np.uint8),
        )

    # -- light ------------------------------------------------------------------------------------

    @cached_property
    def _light(self) -> np.ndarray:
        projector = self._projector
        return np.concatenate(
            [
                projector.position_mm,
                projector.axes[2],
                [projector.focus_mm, projector.focal_plane_mm],
                projector.pattern_axes.ravel(),
                [projector.aperture_mm],
            ]
        )

    @cached_property
    def _aperture(self) -> np.ndarray:
        projector = self._projector
        axes = projector.axes[:2].ravel()
        return np.concatenate([projector.position_mm, axes, [projector.aperture_mm / 2]])

    @property
    def _projector(self) -> Projector:
        if self.rig.projector is None:
            raise DataError("expected a projector in the rig: nothing else lights the scene")
        return self.rig.projector

    def _shadow(
        self,
        bundle: np.ndarray,
        t: np.ndarray,
        triangle: np.ndarray,
        pixels: np.ndarray,
        aperture: np.ndarray | None = None,
    ) -> np.ndarray:
        """Whether something stands between what rays [P S 6] hit and the projector, [P S]."""
        towards = np.empty_like(bundle)
        rays.shadow_rays(
            towards,
            bundle,
            t,
            triangle,
            self._normals,
            _points(bundle.shape[1], 6),
            self.seed,
            pixels,
            self._aperture if aperture is None else aperture,
        )
        return self._occluded(towards)

    @cached_property
    def _ambient(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Face (-1: not known) [H W], light from elsewhere [H W 2], and its mean by face [F 2].

        The two are with the pattern and with the projector open.
        """
        _, triangle, points = self._pinhole
        shape = triangle.shape
        seen = triangle.ravel() >= 0
        normals = self._normals[triangle.ravel()]
        points = np.where(seen[:, None], points.reshape(-1, 3), 1e6)
        facing = (normals * points).sum(1) > 0
        normals = np.where(facing[:, None], -normals, normals)
        samples = _points(4 * self.paths, 6)
        light = np.zeros((seen.size, 2))

        def work(pixels: np.ndarray) -> None:
            bundle = np.empty((len(pixels), len(samples), 6), np.float32)
            rays.hemisphere_rays(
                bundle, points[pixels], normals[pixels], samples, self.seed, pixels
            )
            t, hit = self._cast(bundle)
            shadowed = self._shadow(bundle, t, hit, pixels)
            gathered = np.empty((len(pixels), 2))
            rays.gather_ambient(
                gathered,
                bundle,
                t,
                hit,
                shadowed,
                self._normals,
                self._albedo,
                self._light,
                self.lighting.sky,
                self.lighting.bounce,
                pattern_mean(self._projector.pattern),
            )
            light[pixels] = gathered

        # Every second pixel of every second row, and all of a face that those miss.
        faces = np.where(seen, self._face[triangle.ravel()], -1).astype(np.int32)
        lattice = np.zeros(shape, bool)
        lattice[::2, ::2] = True
        sampled = lattice.ravel()
        sampled |= ~np.isin(faces, faces[sampled])
        self._in_parts(np.flatnonzero(sampled & seen), len(samples), work)
        faces = np.where(sampled, faces, -1).astype(np.int32)
        known = faces >= 0
        counts = np.bincount(faces[known], minlength=self._face_count)
        sums = np.stack(
            [np.bincount(faces[known], of[known], minlength=self._face_count) for of in light.T], 1
        )
        few = np.full_like(sums, self.lighting.sky / 2)
        means = np.divide(sums, counts[:, None], out=few, where=counts[:, None] > 0)
        return faces.reshape(shape), light.reshape(*shape, 2), means

    def _image(self, channel: Channel) -> tuple[np.ndarray, np.ndarray]:
        """A sensor's light with the pattern and with the projector open, each [H W]."""
        rig = self.rig
        size = rig.width_px * rig.height_px
        faces, ambient, means = self._ambient
        table, table_step = _pattern_table(self._projector.pattern, self._largest_blur())
        pinhole = np.array([rig.focal_px("near"), *rig.centre_px])
        camera = _camera(rig, channel)
        striped, plain = np.empty(size), np.empty(size)
        shading = (
            self._normals,
            self._albedo,
            self._face,
            self._light,
            table,
            table_step * self._projector.period_mm,
            pinhole,
            faces,
            ambient,
            means,
        )
        simple, seen, dark = (of.ravel() for of in self._plain(channel))

        def trace(pixels: np.ndarray) -> None:
            bundle = np.empty((len(pixels), self.paths, 6), np.float32)
            weights = np.empty(bundle.shape[:2], np.float32)
            rays.lens_rays(bundle, weights, self._samples, self.seed, pixels, rig.width_px, camera)
            t, triangle = self._cast(bundle)
            shadowed = self._shadow(bundle, t, triangle, pixels)
            result = np.empty((2, len(pixels)))
            rays.gather(result, bundle, weights, t, triangle, shadowed, *shading)
            striped[pixels], plain[pixels] = result

        def meet(pixels: np.ndarray) -> None:
            result = np.empty((2, len(pixels)))
            rays.gather_plain(
                result,
                self._samples,
                self.seed,
                pixels,
                rig.width_px,
                camera,
                seen[pixels],
                dark[pixels],
                self._corners,
                _stripe_waves(self._projector.pattern, rig.period_px(channel)),
                *_disc_table(),
                *shading,
            )
            striped[pixels], plain[pixels] = result

        self._in_parts(np.flatnonzero(~simple), self.paths, trace)
        self._in_parts(np.flatnonzero(simple), self.paths, meet)
        falloff = _falloff(rig, channel)
        shape = (rig.height_px, rig.width_px)
        return striped.reshape(shape) * falloff, plain.reshape(shape) * falloff

    def _largest_blur(self) -> float:
        """Largest diameter of the projector's blur in the scene, in periods, rounded up."""
        _, triangle, points = self._pinhole
        seen = points[triangle >= 0]
        if not seen.size:
            return 1.0
        blur = self._projector.blur_mm(seen) / self._projector.period_mm
        return float(np.ceil(blur.max() * 1.2 + 0.1))


@lru_cache(maxsize=8)
def _stripe_waves(pattern: Pattern, period_px: float) -> np.ndarray:
    """What makes up a pattern of stripes: mean, then harmonic and amplitude of sines, [N 2].

    As many as a pixel does not average out; empty for patterns in two directions.
    """
    if pattern == "none":
        return np.array([[0.0, 1.0]])
    if pattern == "sine":
        return np.array([[0.0, 0.5], [1.0, 0.5]])
    if pattern != "stripes":
        return np.empty((0, 2))
    odd = np.arange(1, np.clip(5 * period_px, 15, 999), 2)
    return np.array([[0.0, 0.5], *((m, 2 / (np.pi * m)) for m in odd)])


@lru_cache(maxsize=1)
def _disc_table() -> tuple[np.ndarray, float]:
    """The transfer of a uniform disc over diameter × frequency, and the step."""
    cycles = np.linspace(0, 64, 1 << 14)
    return disc_transfer(cycles), float(cycles[1])


def _camera(rig: Rig, channel: Channel) -> np.ndarray:
    """What :func:`rays.lens_rays` wants to know of a sensor."""
    x, y = rig.centre_px
    affine = np.array([[1.0, 0, 0], [0, 1, 0]])
    if channel == "far":
        # The far image is the ideal one magnified, turned and shifted: undo that.
        turn = np.deg2rad(rig.far_rotation_deg)
        back = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        back /= rig.far_scale
        middle = np.array([x, y])
        shift = middle - back @ (middle + np.array(rig.far_shift_px))
        affine = np.hstack([back, shift[:, None]])
    return np.array(
        [
            x,
            y,
            rig.focal_px(channel),
            *affine.ravel(),
            rig.focus_mm(channel),
            rig.aperture_mm / 2,
            rig.vignette_distance_mm,
            rig.vignette_radius_mm,
        ]
    )


def _falloff(rig: Rig, channel: Channel) -> np.ndarray:
    """cos⁴ of the angle to the axis, [H W]."""
    x = (np.arange(rig.width_px) - rig.centre_px[0]) / rig.focal_px(channel)
    y = (np.arange(rig.height_px) - rig.centre_px[1]) / rig.focal_px(channel)
    return (1 + x[None, :] ** 2 + y[:, None] ** 2) ** -2


@lru_cache(maxsize=8)
def _points(count: int, dimensions: int) -> np.ndarray:
    """``count`` points that fill a cube of side 2³² evenly (Sobol), uint32 [count dimensions].

    Every pixel moves them by amounts of its own.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(dimensions, scramble=False).random(count)
    return (points * 2.0**32).astype(np.uint32)


@lru_cache(maxsize=8)
def _pattern_table(pattern: Pattern, largest_blur: float) -> tuple[np.ndarray, float]:
    """A period of the pattern under discs of growing diameter: [blur, along, across], and the step.

    Diameters are in periods, from 0 to ``largest_blur``; entry (k, j, i) is the pattern at
    (i / width, j / height).
    """
    height, width = _PATTERN_CELLS.get(pattern, (128, 128))
    # Samples sit in the middle of what each stands for, an edge falling between two of them.
    x = (np.arange(width) + 0.5)[None, :] / width
    y = (np.arange(height) + 0.5)[:, None] / height
    spectrum = np.fft.fft2(np.broadcast_to(pattern_value(pattern, x, y), (height, width)))
    fx, fy = np.fft.fftfreq(width) * width, np.fft.fftfreq(height) * height
    # Back from the middles to the grid's corners.
    spectrum = spectrum * np.exp(-1j * np.pi * (fx[None, :] / width + fy[:, None] / height))
    frequency = np.hypot(fx[None, :], fy[:, None])
    diameters = np.linspace(0, largest_blur, _BLUR_LEVELS)
    levels = [np.fft.ifft2(spectrum * disc_transfer(d * frequency)).real for d in diameters]
    return np.stack(levels).astype(np.float32), float(diameters[1])

"""The compiled loops of the ray tracer: rays that leave the lens, and the light that they find.

Open3D finds what a ray hits; everything before and after is here.  A pixel's samples depend on the
seed, the pixel and the number of the sample, never on the order in which pixels are worked on, so
that any number of threads gives the same image.  Lengths are millimetres in the camera's frame.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_compiled = numba.njit(cache=True, error_model="numpy", nogil=True)

_NUDGE_MM = 0.01
"""How far rays start above the surface that they leave."""


@_compiled
def _shift(seed, pixel, dimension):
    """A hash of three numbers, uint32: how a pixel's samples are moved."""
    state = np.uint32(seed) * np.uint32(747796405) + np.uint32(2891336453)
    for value in (pixel, dimension):
        state = (state ^ np.uint32(value)) * np.uint32(2654435769)
        state ^= state >> np.uint32(15)
        state *= np.uint32(2246822519)
        state ^= state >> np.uint32(13)
        state *= np.uint32(3266489917)
        state ^= state >> np.uint32(16)
    return np.uint32(state)


@_compiled
def _unit(sample, shift):
    """A sample (uint32) moved by a digital shift, which keeps a net a net, in [0, 1)."""
    return np.uint32(sample ^ shift) * 2.3283064365386963e-10


@_compiled
def _on_disc(a, b):
    """A point of the unit disc from a point of the unit square, area kept (Shirley and Chiu)."""
    x, y = 2 * a - 1, 2 * b - 1
    if x == 0 and y == 0:
        return 0.0, 0.0
    if abs(x) > abs(y):
        radius, angle = x, math.pi / 4 * (y / x)
    else:
        radius, angle = y, math.pi / 2 - math.pi / 4 * (x / y)
    return radius * math.cos(angle), radius * math.sin(angle)


@_compiled
def _ideal(x, y, camera):
    """The direction (z = 1) that a pixel position sees through the lens's centre."""
    qx = camera[3] * x + camera[4] * y + camera[5]
    qy = camera[6] * x + camera[7] * y + camera[8]
    return (qx - camera[0]) / camera[2], (qy - camera[1]) / camera[2]


@_compiled
def _lens_ray(x, y, sample, moves, camera):
    """Origin's x and y, direction's x and y (z = 1), and whether the stop lets it pass."""
    dx, dy = _ideal(
        x - 0.5 + _unit(sample[0], moves[0]), y - 0.5 + _unit(sample[1], moves[1]), camera
    )
    u, v = _on_disc(_unit(sample[2], moves[2]), _unit(sample[3], moves[3]))
    ox, oy = u * camera[10], v * camera[10]
    dx, dy = dx - ox / camera[9], dy - oy / camera[9]
    passes = camera[12] <= 0 or (
        math.hypot(ox + dx * camera[11], oy + dy * camera[11]) < camera[12]
    )
    return ox, oy, dx, dy, passes


@_compiled
def _moves(seed, pixel):
    return (
        _shift(seed, pixel, 0),
        _shift(seed, pixel, 1),
        _shift(seed, pixel, 2),
        _shift(seed, pixel, 3),
    )


@_compiled
def pinhole_rays(rays, width, pad, camera):
    """Rays from the lens's centre through pixel centres, ``pad`` more at each side: [P 6]."""
    for p in range(rays.shape[0]):
        x, y = p % (width + 2 * pad) - pad, p // (width + 2 * pad) - pad
        dx, dy = _ideal(x, y, camera)
        rays[p, 0] = rays[p, 1] = rays[p, 2] = 0
        rays[p, 3], rays[p, 4], rays[p, 5] = dx, dy, 1.0


@_compiled
def lens_rays(rays, weights, samples, seed, pixels, width, camera):
    """Rays from the lens through what pixels are focused on.

    ``rays`` [P S 6] float32 (origin, direction with z = 1, so that a ray's parameter is depth) and
    ``weights`` [P S] (0 where the stop cuts a ray) are filled for ``pixels`` [P], counted by rows.
    ``samples`` [S 6] uint32 are points of a cube: pixel, lens, projector.  ``camera`` is centre x
    and y, focal length, a 2 3 matrix from the pixel to the ideal one, focus, aperture's radius,
    stop's distance and radius.
    """
    for p in range(rays.shape[0]):
        x, y = pixels[p] % width, pixels[p] // width
        moves = _moves(seed, pixels[p])
        for s in range(samples.shape[0]):
            ox, oy, dx, dy, passes = _lens_ray(x, y, samples[s], moves, camera)
            rays[p, s, 0], rays[p, s, 1], rays[p, s, 2] = ox, oy, 0.0
            rays[p, s, 3], rays[p, s, 4], rays[p, s, 5] = dx, dy, 1.0
            weights[p, s] = 1.0 if passes else 0.0


@_compiled
def _hit(ray, depth):
    return ray[0] + depth * ray[3], ray[1] + depth * ray[4], ray[2] + depth * ray[5]


@_compiled
def _facing(normal, ray):
    """The side of a surface that a ray sees."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    if nx * ray[3] + ny * ray[4] + nz * ray[5] > 0:
        return -nx, -ny, -nz
    return nx, ny, nz


@_compiled
def shadow_rays(out, rays, t, triangle, normals, samples, seed, pixels, projector):
    """Rays from what was hit to points of the projector's aperture, their parameter 0 to 1.

    ``out`` is like ``rays`` [P S 6].  Surfaces turned away get a ray that leaves the scene; their
    irradiance is 0 in any case.  ``projector`` is its position, x and y axis, aperture's radius.
    """
    for p in range(rays.shape[0]):
        s4, s5 = _shift(seed, pixels[p], 4), _shift(seed, pixels[p], 5)
        for s in range(rays.shape[1]):
            out[p, s, :] = 0
            out[p, s, 2] = -1e6
            out[p, s, 5] = -1.0
            if triangle[p, s] < 0:
                continue
            u, v = _on_disc(_unit(samples[s, 4], s4), _unit(samples[s, 5], s5))
            u, v = u * projector[9], v * projector[9]
            x, y, z = _hit(rays[p, s], t[p, s])
            nx, ny, nz = _facing(normals[triangle[p, s]], rays[p, s])
            dx = projector[0] + u * projector[3] + v * projector[6] - x
            dy = projector[1] + u * projector[4] + v * projector[7] - y
            dz = projector[2] + u * projector[5] + v * projector[8] - z
            if nx * dx + ny * dy + nz * dz > 0:
                out[p, s, 0] = x + _NUDGE_MM * nx
                out[p, s, 1] = y + _NUDGE_MM * ny
                out[p, s, 2] = z + _NUDGE_MM * nz
                out[p, s, 3], out[p, s, 4], out[p, s, 5] = dx, dy, dz


@_compiled
def _irradiance(x, y, z, nx, ny, nz, light):
    """Open projector's light at a point: both cosines, inverse square; 0 where turned away.

    ``light`` is position (3), axis (3), focus distance, distance of the focal plane, across (3) and
    along (3) the stripes in cycles per millimetre, aperture's diameter.
    """
    dx, dy, dz = x - light[0], y - light[1], z - light[2]
    square = dx * dx + dy * dy + dz * dz
    arriving = -(dx * nx + dy * ny + dz * nz)
    leaving = dx * light[3] + dy * light[4] + dz * light[5]
    if arriving <= 0 or leaving <= 0:
        return 0.0
    return light[6] * light[6] * arriving * leaving / (square * square)


@_compiled
def _cycles(x, y, z, light):
    """Where the light at a point crosses the projector's focal plane, and 1 - blur / aperture."""
    dx, dy, dz = x - light[0], y - light[1], z - light[2]
    scale = light[7] / (dx * light[3] + dy * light[4] + dz * light[5])
    u = (dx * light[8] + dy * light[9] + dz * light[10]) * scale
    v = (dx * light[11] + dy * light[12] + dz * light[13]) * scale
    return u, v, scale


@_compiled
def _pattern(x, y, z, light, table, table_step):
    """Transmission of the pattern at a point, blurred by the projector's defocus there."""
    u, v, scale = _cycles(x, y, z, light)
    levels, height, width = table.shape
    at = min(light[14] * abs(1 - scale) / table_step, levels - 1.001)
    a = (u - math.floor(u)) * width
    b = (v - math.floor(v)) * height
    k, i, j = int(at), int(a) % width, int(b) % height
    fk, fi, fj = at - k, a - int(a), b - int(b)
    i1, j1 = (i + 1) % width, (j + 1) % height
    value = 0.0
    for level, weight in ((k, 1 - fk), (k + 1, fk)):
        row = (1 - fi) * table[level, j, i] + fi * table[level, j, i1]
        next_row = (1 - fi) * table[level, j1, i] + fi * table[level, j1, i1]
        value += weight * ((1 - fj) * row + fj * next_row)
    return value


@_compiled
def _from_elsewhere(x, y, z, own, pinhole, ambient_face, ambient, ambient_of_face):
    """Sky and bounce at a point: they change slowly, so a near pixel's of the same face do."""
    height, width = ambient.shape[0], ambient.shape[1]
    i = int(round(pinhole[0] * x / z + pinhole[1]))
    j = int(round(pinhole[0] * y / z + pinhole[2]))
    i = min(max(i, 0), width - 1)
    j = min(max(j, 0), height - 1)
    if ambient_face[j, i] == own:
        return ambient[j, i, 0], ambient[j, i, 1]
    value, nearest = (ambient_of_face[own, 0], ambient_of_face[own, 1]), 1000
    for jj in range(max(j - 2, 0), min(j + 3, height)):
        for ii in range(max(i - 2, 0), min(i + 3, width)):
            apart = (ii - i) ** 2 + (jj - j) ** 2
            if ambient_face[jj, ii] == own and apart < nearest:
                nearest, value = apart, (ambient[jj, ii, 0], ambient[jj, ii, 1])
    return value


@_compiled
def gather(
    out,
    rays,
    weights,
    t,
    triangle,
    shadowed,
    normals,
    albedo,
    face,
    light,
    table,
    table_step,
    pinhole,
    ambient_face,
    ambient,
    ambient_of_face,
):
    """Mean light of each pixel's rays, with the pattern and with the projector open: [2 P].

    ``normals`` [T 3], ``albedo`` [T] and ``face`` [T] are by triangle; ``ambient`` [H W 2] is
    the light from elsewhere, with the pattern and without, by pixel of the ``pinhole`` (focal
    length, centre x, y) that sees ``ambient_face`` [H W], and ``ambient_of_face`` [F 2] stands in
    where it does not see a face.
    """
    for p in range(rays.shape[0]):
        with_pattern, without = 0.0, 0.0
        for s in range(rays.shape[1]):
            k = triangle[p, s]
            if k < 0 or weights[p, s] == 0:
                continue
            x, y, z = _hit(rays[p, s], t[p, s])
            nx, ny, nz = _facing(normals[k], rays[p, s])
            other = _from_elsewhere(
                x, y, z, face[k], pinhole, ambient_face, ambient, ambient_of_face
            )
            direct, patterned = 0.0, 0.0
            if not shadowed[p, s]:
                direct = _irradiance(x, y, z, nx, ny, nz, light)
                if direct > 0:
                    patterned = direct * _pattern(x, y, z, light, table, table_step)
            with_pattern += albedo[k] * (patterned + other[0])
            without += albedo[k] * (direct + other[1])
        out[0, p] = with_pattern / rays.shape[1]
        out[1, p] = without / rays.shape[1]


@_compiled
def _transfer(cycles, table, step):
    """Transfer of a uniform disc, from a table over diameter × frequency."""
    at = abs(cycles) / step
    k = int(at)
    if k + 1 >= table.shape[0]:
        return 0.0
    return table[k] + (at - k) * (table[k + 1] - table[k])


@_compiled
def _sinc(value):
    argument = math.pi * value
    return 1.0 if abs(argument) < 1e-6 else math.sin(argument) / argument


@_compiled
def _plane_cycles(x, y, ox, oy, normal, offset, camera, light):
    """Where in the pattern the ray of a pixel position and a lens point ends on a plane."""
    dx, dy = _ideal(x, y, camera)
    dx, dy = dx - ox / camera[9], dy - oy / camera[9]
    z = (offset - normal[0] * ox - normal[1] * oy) / (normal[0] * dx + normal[1] * dy + normal[2])
    return _cycles(ox + z * dx, oy + z * dy, z, light)[0]


@_compiled
def gather_plain(
    out,
    samples,
    seed,
    pixels,
    width,
    camera,
    triangle,
    shadowed,
    corners,
    waves,
    disc,
    disc_step,
    normals,
    albedo,
    face,
    light,
    table,
    table_step,
    pinhole,
    ambient_face,
    ambient,
    ambient_of_face,
):
    """What :func:`gather` gives for pixels whose rays all end on one plane, lit or shadowed alike.

    ``triangle`` [P] is what each sees and ``corners`` [T 3] a point of each triangle.  The plane is
    met without tracing, and its irradiance is that of the pixel's centre.  Stripes, given as
    ``waves`` [N 2] (mean; harmonic and amplitude of each sine), are blurred in closed form: the
    lens, the projector's aperture and the pixel each multiply a wave by their transfer.  Other
    patterns, and bundles that the stop cuts, are sampled.
    """
    for p in range(pixels.shape[0]):
        x, y = pixels[p] % width, pixels[p] // width
        k = triangle[p]
        normal = normals[k]
        nx, ny, nz = normal[0], normal[1], normal[2]
        offset = nx * corners[k, 0] + ny * corners[k, 1] + nz * corners[k, 2]
        dx, dy = _ideal(x, y, camera)
        z = offset / (nx * dx + ny * dy + nz)
        other = _from_elsewhere(
            z * dx, z * dy, z, face[k], pinhole, ambient_face, ambient, ambient_of_face
        )
        side = -1.0 if offset > 0 else 1.0
        direct = 0.0
        if not shadowed[p]:
            direct = _irradiance(z * dx, z * dy, z, side * nx, side * ny, side * nz, light)
        whole = camera[12] <= 0 or (
            math.hypot(dx, dy) * camera[11] + camera[10] * abs(1 - camera[11] / camera[9])
            < camera[12]
        )
        passed, transmitted = 1.0, 0.0
        if whole and direct == 0:
            pass
        elif whole and waves.shape[0] > 0:
            u, _, scale = _cycles(z * dx, z * dy, z, light)
            radius = camera[10]
            right = _plane_cycles(x + 0.5, y, 0.0, 0.0, normal, offset, camera, light)
            left = _plane_cycles(x - 0.5, y, 0.0, 0.0, normal, offset, camera, light)
            down = _plane_cycles(x, y + 0.5, 0.0, 0.0, normal, offset, camera, light)
            up = _plane_cycles(x, y - 0.5, 0.0, 0.0, normal, offset, camera, light)
            east = _plane_cycles(x, y, radius, 0.0, normal, offset, camera, light)
            west = _plane_cycles(x, y, -radius, 0.0, normal, offset, camera, light)
            south = _plane_cycles(x, y, 0.0, radius, normal, offset, camera, light)
            north = _plane_cycles(x, y, 0.0, -radius, normal, offset, camera, light)
            lens = math.hypot(east - west, south - north)
            spread = (
                light[14] * abs(1 - scale) * math.hypot(math.hypot(light[8], light[9]), light[10])
            )
            transmitted = waves[0, 1]
            for w in range(1, waves.shape[0]):
                m = waves[w, 0]
                transmitted += (
                    waves[w, 1]
                    * _transfer(m * lens, disc, disc_step)
                    * _transfer(m * spread, disc, disc_step)
                    * _sinc(m * (right - left))
                    * _sinc(m * (down - up))
                    * math.sin(2 * math.pi * m * u)
                )
        else:
            moves = _moves(seed, pixels[p])
            passed = 0.0
            for s in range(samples.shape[0]):
                ox, oy, dx, dy, passes = _lens_ray(x, y, samples[s], moves, camera)
                if passes:
                    passed += 1
                    if direct > 0:
                        z = (offset - nx * ox - ny * oy) / (nx * dx + ny * dy + nz)
                        transmitted += _pattern(
                            ox + z * dx, oy + z * dy, z, light, table, table_step
                        )
            passed /= samples.shape[0]
            transmitted /= samples.shape[0]
        out[0, p] = albedo[k] * (direct * transmitted + other[0] * passed)
        out[1, p] = albedo[k] * (direct + other[1]) * passed


@_compiled
def hemisphere_rays(out, points, normals, samples, seed, pixels):
    """Cosine-weighted rays from ``points`` [P 3] about ``normals`` [P 3]: ``out`` [P S 6].

    Points that are not finite get rays that leave the scene.
    """
    for p in range(points.shape[0]):
        s0, s1 = _shift(seed, pixels[p], 6), _shift(seed, pixels[p], 7)
        nx, ny, nz = normals[p, 0], normals[p, 1], normals[p, 2]
        # Any two directions in the surface (Duff and others, 2017).
        sign = 1.0 if nz >= 0 else -1.0
        a = -1 / (sign + nz)
        b = nx * ny * a
        for s in range(samples.shape[0]):
            u, v = _on_disc(_unit(samples[s, 0], s0), _unit(samples[s, 1], s1))
            w = math.sqrt(max(0.0, 1 - u * u - v * v))
            out[p, s, 0] = points[p, 0] + _NUDGE_MM * nx
            out[p, s, 1] = points[p, 1] + _NUDGE_MM * ny
            out[p, s, 2] = points[p, 2] + _NUDGE_MM * nz
            out[p, s, 3] = u * (1 + sign * nx * nx * a) + v * b + w * nx
            out[p, s, 4] = u * sign * b + v * (sign + ny * ny * a) + w * ny
            out[p, s, 5] = u * -sign * nx + v * -ny + w * nz


@_compiled
def gather_ambient(
    out, rays, t, triangle, shadowed, normals, albedo, light, sky, bounce, pattern_mean
):
    """Sky and one diffuse bounce of the projector's light, as seen along rays: ``out`` [P 2].

    With the pattern, of whose mean the bounce is, and with the projector open.
    """
    for p in range(rays.shape[0]):
        open_sky, bounced = 0.0, 0.0
        for s in range(rays.shape[1]):
            k = triangle[p, s]
            if k < 0:
                open_sky += sky
            elif bounce > 0 and not shadowed[p, s]:
                x, y, z = _hit(rays[p, s], t[p, s])
                nx, ny, nz = _facing(normals[k], rays[p, s])
                bounced += bounce * albedo[k] * _irradiance(x, y, z, nx, ny, nz, light)
        out[p, 0] = (open_sky + pattern_mean * bounced) / rays.shape[1]
        out[p, 1] = (open_sky + bounced) / rays.shape[1]

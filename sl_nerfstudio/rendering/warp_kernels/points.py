# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""From pixels to the points at which a training step evaluates the field; one thread per pixel, ray or point.

The formulas are those of `rendering/ray_samples.py`, `rendering/renderer.py` and `rendering/direct_losses.py`.
Camera and projector poses are one per frame, `views` is the frame of each ray. `noise` holds uniform random numbers.
"""

import warp as wp

from sl_nerfstudio.device_kernels import kernel, part
from sl_nerfstudio.rendering.warp_kernels.projector import project, unproject

_CACHE_SAMPLES = wp.constant(64)  # of first_crossing
_GATE = wp.constant(4.0)  # these five as in direct_losses.py
_BAND_SIGMAS, _LEAST_BAND, _MOST_BAND = wp.constant(4.0), wp.constant(0.006), wp.constant(0.03)
_NEAR_SHARE, _NEAR_BANDS = wp.constant(0.5), wp.constant(4.0)
_PARALLEL = wp.constant(1.0e-12)  # as in geometry/triangulation.py


@part
def turned(T: wp.mat44, d: wp.vec3):
    """A direction in the frame to which a pose leads."""
    return wp.vec3(
        T[0, 0] * d[0] + T[0, 1] * d[1] + T[0, 2] * d[2],
        T[1, 0] * d[0] + T[1, 1] * d[1] + T[1, 2] * d[2],
        T[2, 0] * d[0] + T[2, 1] * d[1] + T[2, 2] * d[2],
    )


@part
def turned_back(T: wp.mat44, d: wp.vec3):
    """A direction in the frame from which a pose leads."""
    return wp.vec3(
        T[0, 0] * d[0] + T[1, 0] * d[1] + T[2, 0] * d[2],
        T[0, 1] * d[0] + T[1, 1] * d[1] + T[2, 1] * d[2],
        T[0, 2] * d[0] + T[1, 2] * d[1] + T[2, 2] * d[2],
    )


@part
def centre(T: wp.mat44):
    """The translation of a pose."""
    return wp.vec3(T[0, 3], T[1, 3], T[2, 3])


@part
def in_ball(noise: wp.array(dtype=wp.float32), first: wp.int32):
    """A point uniform in the unit ball, from three random numbers."""
    z = 2.0 * noise[first] - 1.0
    angle = 6.283185307179586 * noise[first + 1]
    around = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    return wp.pow(noise[first + 2], 1.0 / 3.0) * wp.vec3(around * wp.cos(angle), around * wp.sin(angle), z)


@kernel
def rays_and_random_points(
    index: wp.array(dtype=wp.int64),
    among: wp.array(dtype=wp.int32),
    frame: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int16),
    column: wp.array(dtype=wp.int16),
    coords: wp.array(dtype=wp.vec2),
    pattern: wp.array(dtype=wp.float16),
    T_scene_camera: wp.array(dtype=wp.mat44),
    cameras: wp.array2d(dtype=wp.float32),
    model: wp.int32,
    distorted: wp.int32,
    views: wp.array(dtype=wp.int32),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    measured: wp.array(dtype=wp.vec2),
    captured: wp.array(dtype=wp.float32),
    noise: wp.array(dtype=wp.float32),
    random_points: wp.array(dtype=wp.vec3),
):
    """Camera rays through the centres of the pixels `index` of a table, and what was measured there.

    `index` counts the rows `among` of the table, if there are any. Besides, points in the unit ball.
    """
    i = wp.tid()
    if i < random_points.shape[0]:
        random_points[i] = in_ball(noise, 3 * i)
    if i >= index.shape[0]:
        return
    k = wp.int32(index[i])
    if among.shape[0] > 0:
        k = among[k]
    view = frame[k]
    T = T_scene_camera[view]
    views[i] = view
    origins[i] = centre(T)
    x = wp.float32(column[k]) + 0.5
    y = wp.float32(row[k]) + 0.5
    directions[i] = turned(T, unproject(cameras[view], model, distorted, wp.vec2(x, y)))
    measured[i] = coords[k]
    captured[i] = wp.float32(pattern[k])


@kernel
def rays_adjoint(
    T_scene_camera: wp.array(dtype=wp.mat44),
    views: wp.array(dtype=wp.int32),
    directions: wp.array(dtype=wp.vec3),
    t: wp.array2d(dtype=wp.float32),
    d_points: wp.array(dtype=wp.vec3),
    d_origins: wp.array(dtype=wp.vec3),
    d_directions: wp.array(dtype=wp.vec3),
    d_T: wp.array3d(dtype=wp.float32),
):
    """Add to the adjoint of the cameras' poses: by the rays, and by the samples at `t` along them."""
    ray = wp.tid()
    d_o = d_origins[ray]
    d_d = d_directions[ray]
    for i in range(t.shape[1]):
        d_p = d_points[ray * t.shape[1] + i]
        d_o += d_p
        d_d += t[ray, i] * d_p
    view = views[ray]
    turn = wp.outer(d_d, turned_back(T_scene_camera[view], directions[ray]))
    for a in range(3):
        for b in range(3):
            wp.atomic_add(d_T, view, a, b, turn[a, b])
        wp.atomic_add(d_T, view, a, 3, d_o[a])


@part
def near_and_far(o: wp.vec3, d: wp.vec3):
    """Distances at which a ray enters and leaves the unit sphere; see `sphere_interval`."""
    b = wp.dot(o, d)
    half = wp.sqrt(wp.max(b * b - wp.dot(o, o) + 1.0, 0.25))
    return wp.vec2(wp.max(-b - half, 0.0), wp.max(-b + half, 1.0e-3))


@part
def cached(values: wp.array3d(dtype=wp.float32), p: wp.vec3):
    """Trilinear value of the cached grid; outside the box that at the border."""
    last = values.shape[0] - 1
    top = wp.float32(last)
    x = wp.clamp((p[0] + 1.0) * 0.5 * top, 0.0, top)
    y = wp.clamp((p[1] + 1.0) * 0.5 * top, 0.0, top)
    z = wp.clamp((p[2] + 1.0) * 0.5 * top, 0.0, top)
    i = wp.min(wp.int32(x), last - 1)
    j = wp.min(wp.int32(y), last - 1)
    k = wp.min(wp.int32(z), last - 1)
    r = x - wp.float32(i)
    s = y - wp.float32(j)
    t = z - wp.float32(k)
    low = wp.lerp(
        wp.lerp(values[k, j, i], values[k, j, i + 1], r), wp.lerp(values[k, j + 1, i], values[k, j + 1, i + 1], r), s
    )
    high = wp.lerp(
        wp.lerp(values[k + 1, j, i], values[k + 1, j, i + 1], r),
        wp.lerp(values[k + 1, j + 1, i], values[k + 1, j + 1, i + 1], r),
        s,
    )
    return wp.lerp(low, high, t)


@kernel
def sample(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    noise: wp.array(dtype=wp.float32),
    values: wp.array3d(dtype=wp.float32),
    along_surface: wp.int32,
    cell: wp.float32,
    half_width: wp.float32,
    kappa: wp.array(dtype=wp.float64),
    t: wp.array2d(dtype=wp.float32),
    points: wp.array(dtype=wp.vec3),
):
    """Samples in equal strata of the interval in which the surface is, by the cached grid, or of the whole ray."""
    ray = wp.tid()
    o = origins[ray]
    d = directions[ray]
    interval = near_and_far(o, d)
    low = interval[0]
    high = interval[1]
    if along_surface != 0:
        step = (high - low) / wp.float32(_CACHE_SAMPLES)
        before = cached(values, o + (low + 0.5 * step) * d)
        found = wp.int32(0)
        crossing = wp.float32(0.0)
        for i in range(1, _CACHE_SAMPLES):
            if found == 0:
                here = cached(values, o + (low + (wp.float32(i) + 0.5) * step) * d)
                if before > 0.0 and here <= 0.0:
                    found = 1
                    share = before / wp.max(before - here, 1.0e-9)
                    crossing = low + (wp.float32(i) - 0.5 + share) * step
                before = here
        if found != 0:
            reach = half_width / wp.float32(kappa[0]) + cell
            low = crossing - reach
            high = crossing + reach
    count = t.shape[1]
    for i in range(count):
        x = low + (high - low) * (wp.float32(i) + noise[ray * count + i]) / wp.float32(count)
        t[ray, i] = x
        points[ray * count + i] = o + x * d


@kernel
def triangulate(
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    views: wp.array(dtype=wp.int32),
    T_scene_projector: wp.array(dtype=wp.mat44),
    measured: wp.array(dtype=wp.vec2),
    projector: wp.array(dtype=wp.float32),
    model: wp.int32,
    distorted: wp.int32,
    noise_px: wp.array(dtype=wp.float32),
    px_per_length: wp.array(dtype=wp.float32),
    noise: wp.array(dtype=wp.float32),
    surface: wp.array(dtype=wp.vec3),
    sides: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.float32),
    at_least: wp.array(dtype=wp.float32),
):
    """Where projector rays meet camera rays: the point, its weight, and points on either side (in front, then behind).

    `at_least` is the value that the field should have in front. The weight is 0 where decoding failed or was wrong.
    """
    ray = wp.tid()
    o = origins[ray]
    d = directions[ray]
    T = T_scene_projector[views[ray]]
    uv = measured[ray]
    decoded = wp.isfinite(uv[0]) and wp.isfinite(uv[1])
    if not decoded:
        uv = wp.vec2(projector[2], projector[3])
    e = turned(T, unproject(projector, model, distorted, uv))
    between = centre(T) - o
    normal = wp.cross(d, e)
    sin2 = wp.dot(normal, normal)
    usable = decoded and sin2 > _PARALLEL
    depth = wp.float32(1.0)
    sigma = wp.float32(0.0)
    w = wp.float32(0.0)
    if sin2 > _PARALLEL:
        depth = wp.dot(wp.cross(between, e), normal) / sin2
        depth_projector = wp.dot(wp.cross(between, d), normal) / sin2
        p = o + depth * d
        pixel = project(projector, model, distorted, turned_back(T, p - centre(T)))
        gap = turned_back(T, between + depth_projector * e - depth * d)
        off = wp.length(wp.vec2(wp.dot(pixel.du, gap), wp.dot(pixel.dv, gap)))
        along = turned_back(T, d)
        slope = wp.length(wp.vec2(wp.dot(pixel.du, along), wp.dot(pixel.dv, along)))
        sigma = noise_px[0] / wp.max(slope, 1.0e-9)
        good = usable and pixel.lit != 0 and off < _GATE * noise_px[0] and depth > 0.0 and depth_projector > 0.0
        if good and wp.length(p) < 1.0:
            w = wp.clamp(slope / px_per_length[0], 0.1, 2.0)
    near = near_and_far(o, d)[0]
    band = wp.clamp(_BAND_SIGMAS * sigma, _LEAST_BAND, _MOST_BAND)
    u = noise[3 * ray]
    before = near + wp.max(depth - band - near, 0.0) * u
    if noise[3 * ray + 2] < _NEAR_SHARE:
        before = wp.max(depth - band * (1.0 + (_NEAR_BANDS - 1.0) * u), near)
    surface[ray] = o + depth * d
    sides[ray] = o + before * d
    sides[origins.shape[0] + ray] = o + (depth + band * (1.0 + noise[3 * ray + 1])) * d
    weight[ray] = w
    at_least[ray] = wp.min(0.3 * wp.max(depth - before, 0.0), _MOST_BAND)

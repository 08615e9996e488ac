# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""From signed distances along rays to the losses of what they see, and back; one thread per ray.

The formulas are those of `rendering/volume_rendering.py` and `rendering/losses.py`. `T_scene_projector` has one pose
per frame, `views` the frame of each ray. The first five `sums` are, over all rays: the coordinates' error and how many
rays have one; the products rendered x captured, rendered x rendered and captured x captured of the pattern.
"""

import warp as wp

from sl_nerfstudio.device_kernels import kernel, part
from sl_nerfstudio.rendering.warp_kernels.points import centre, turned, turned_back
from sl_nerfstudio.rendering.warp_kernels.projector import look_up, project

_EPSILON = wp.constant(1e-6)  # as in volume_rendering.py and losses.py


@part
def log_phi(x: wp.float32):
    """Logarithm of the logistic function, without overflow."""
    small = wp.exp(-wp.abs(x))
    log1p = wp.where(small < 1.0e-3, small * (1.0 - small * (0.5 - small / 3.0)), wp.log(1.0 + small))
    return wp.min(x, 0.0) - log1p


@part
def opacity(drop: wp.float32):
    """`1 - exp(drop)` for `drop <= 0`, as exact for small `drop`."""
    series = -drop * (
        1.0 + drop * (0.5 + drop * (1.0 / 6.0 + drop * (1.0 / 24.0 + drop * (1.0 / 120.0 + drop / 720.0))))
    )
    return wp.where(drop > -0.3, series, 1.0 - wp.exp(drop))


@part
def counts(measured: wp.vec2, lit: wp.float32):
    """Whether a ray's coordinates are compared."""
    return wp.where(wp.isfinite(measured[0]) and wp.isfinite(measured[1]) and lit > 0.5, 1.0, 0.0)


@part
def number(x: wp.float32):
    """Zero for what is not a number: measured coordinates of pixels that were not decoded."""
    return wp.where(wp.isfinite(x), x, 0.0)


@kernel
def render(
    sdf: wp.array2d(dtype=wp.float32),
    t: wp.array2d(dtype=wp.float32),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    T_scene_projector: wp.array(dtype=wp.mat44),
    views: wp.array(dtype=wp.int32),
    params: wp.array(dtype=wp.float32),
    model: wp.int32,
    distorted: wp.int32,
    pattern: wp.array2d(dtype=wp.float32),
    kappa: wp.array(dtype=wp.float64),
    measured: wp.array(dtype=wp.vec2),
    captured: wp.array(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
    coordinates: wp.array(dtype=wp.vec2),
    rendered: wp.array(dtype=wp.float32),
    lit: wp.array(dtype=wp.float32),
    lit_weight: wp.array(dtype=wp.float32),
    error: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
):
    """What each ray sees; `before` is the logarithm of the transparency in front of each sample.

    `error` is the distance between coordinates, infinite where none were decoded.
    """
    ray = wp.tid()
    o = origins[ray]
    d = directions[ray]
    T = T_scene_projector[views[ray]]
    k = wp.float32(kappa[0])
    total = wp.float32(0.0)
    seen = wp.float32(0.0)
    uv = wp.vec2()
    brightness = wp.float32(0.0)
    transparency = wp.float32(0.0)
    last = log_phi(k * sdf[ray, 0])
    for i in range(sdf.shape[1] - 1):
        following = log_phi(k * sdf[ray, i + 1])
        drop = wp.min(following - last, 0.0)
        last = following
        before[ray, i] = transparency
        weight = opacity(drop) * wp.exp(transparency)
        transparency += drop
        if weight > 0.0:
            middle = 0.5 * (t[ray, i] + t[ray, i + 1])
            total += weight
            pixel = project(params, model, distorted, turned_back(T, o + middle * d - centre(T)))
            if pixel.lit != 0:
                seen += weight
                uv += weight * pixel.uv
                found = look_up(pattern, pixel.uv)
                brightness += weight * found[0]
    before[ray, sdf.shape[1] - 1] = transparency
    uv = uv / (seen + _EPSILON)
    share = seen / (total + _EPSILON)
    coordinates[ray] = uv
    rendered[ray] = brightness
    lit[ray] = share
    lit_weight[ray] = seen
    count = counts(measured[ray], share)
    off = uv - wp.vec2(number(measured[ray][0]), number(measured[ray][1]))
    error[ray] = wp.where(wp.isfinite(measured[ray][0]) and wp.isfinite(measured[ray][1]), wp.length(off), wp.inf)
    wp.atomic_add(sums, 0, count * (wp.abs(off[0]) + wp.abs(off[1])))
    wp.atomic_add(sums, 1, count)
    wp.atomic_add(sums, 2, brightness * captured[ray])
    wp.atomic_add(sums, 3, brightness * brightness)
    wp.atomic_add(sums, 4, captured[ray] * captured[ray])


@kernel
def render_adjoint(
    sdf: wp.array2d(dtype=wp.float32),
    t: wp.array2d(dtype=wp.float32),
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    T_scene_projector: wp.array(dtype=wp.mat44),
    views: wp.array(dtype=wp.int32),
    params: wp.array(dtype=wp.float32),
    model: wp.int32,
    distorted: wp.int32,
    pattern: wp.array2d(dtype=wp.float32),
    kappa: wp.array(dtype=wp.float64),
    measured: wp.array(dtype=wp.vec2),
    captured: wp.array(dtype=wp.float32),
    before: wp.array2d(dtype=wp.float32),
    coordinates: wp.array(dtype=wp.vec2),
    rendered: wp.array(dtype=wp.float32),
    lit: wp.array(dtype=wp.float32),
    lit_weight: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
    px_per_length: wp.array(dtype=wp.float32),
    per_length: wp.float32,
    per_pixel: wp.float32,
    pattern_weight: wp.float32,
    g_coordinates: wp.array(dtype=wp.float32),
    g_pattern: wp.array(dtype=wp.float32),
    d_sdf: wp.array2d(dtype=wp.float32),
    d_origins: wp.array(dtype=wp.vec3),
    d_directions: wp.array(dtype=wp.vec3),
    d_T: wp.array3d(dtype=wp.float32),
):
    """Adjoints of the distances; of rays and poses where there are arrays for them (adding to the last)."""
    ray = wp.tid()
    o = origins[ray]
    d = directions[ray]
    view = views[ray]
    T = T_scene_projector[view]
    k = wp.float32(kappa[0])
    samples = sdf.shape[1]
    uv = coordinates[ray]
    # adjoint of this ray's coordinates and intensity
    by_pixel = per_pixel
    if per_length > 0.0:
        by_pixel = per_length / px_per_length[0]
    scale = by_pixel * g_coordinates[0] * counts(measured[ray], lit[ray]) / wp.max(sums[1], 1.0)
    off = uv - wp.vec2(number(measured[ray][0]), number(measured[ray][1]))
    d_uv = wp.vec2(0.0, 0.0)
    for a in range(2):
        if off[a] > 0.0:
            d_uv[a] = scale
        elif off[a] < 0.0:
            d_uv[a] = -scale
    norm = wp.sqrt(sums[3])
    captured_norm = wp.max(wp.sqrt(sums[4]), _EPSILON)
    d_rendered = captured[ray] / (wp.max(norm, _EPSILON) * captured_norm)
    if norm > _EPSILON:
        d_rendered -= sums[2] * rendered[ray] / (norm * norm * norm * captured_norm)
    d_rendered = -pattern_weight * g_pattern[0] * d_rendered
    seen = lit_weight[ray] + _EPSILON
    d_o = wp.vec3()
    d_d = wp.vec3()
    d_turn = wp.mat33()
    behind = wp.float32(0.0)  # sum of weight times its adjoint over the intervals behind this one
    d_log = wp.float32(0.0)  # adjoint of the logarithm at the far end of this interval, from the interval behind it
    last = log_phi(k * sdf[ray, samples - 1])
    for j in range(samples - 1):
        i = samples - 2 - j
        f = sdf[ray, i + 1]
        first = log_phi(k * sdf[ray, i])
        step = last - first
        last = first
        drop = wp.min(step, 0.0)
        transparency = wp.exp(before[ray, i])
        weight = opacity(drop) * transparency
        d_weight = wp.float32(0.0)
        middle = 0.5 * (t[ray, i] + t[ray, i + 1])
        p = o + middle * d - centre(T)
        pixel = project(params, model, distorted, turned_back(T, p))
        if pixel.lit != 0:
            found = look_up(pattern, pixel.uv)
            d_weight = wp.dot(d_uv, pixel.uv - uv) / seen + d_rendered * found[0]
            u = weight * (d_uv[0] / seen + d_rendered * found[1])
            v = weight * (d_uv[1] / seen + d_rendered * found[2])
            d_p = u * pixel.du + v * pixel.dv
            d_turn += wp.outer(p, d_p)
            d_scene = turned(T, d_p)
            d_o += d_scene
            d_d += middle * d_scene
        d_l = behind - wp.exp(drop) * transparency * d_weight
        behind += weight * d_weight
        if step > 0.0:
            d_l = wp.float32(0.0)
        rate = (d_log + d_l) / (1.0 + wp.exp(k * f))  # derivative of the logarithm by k f
        d_sdf[ray, i + 1] = rate * k
        d_log = -d_l
    f = sdf[ray, 0]
    rate = d_log / (1.0 + wp.exp(k * f))
    d_sdf[ray, 0] = rate * k
    if d_origins.shape[0] > 0:
        d_origins[ray] = d_o
        d_directions[ray] = d_d
    if d_T.shape[0] > 0:
        for a in range(3):
            for b in range(3):
                wp.atomic_add(d_T, view, a, b, d_turn[a, b])
            wp.atomic_add(d_T, view, a, 3, -d_o[a])

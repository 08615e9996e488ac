# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""From signed distances along rays to the losses of what they see, and back; one thread per ray.

The formulas are those of `rendering/volume_rendering.py` and `rendering/losses.py`. `T_scene_projector` has one pose
per frame, `views` the frame of each ray. The first five `sums` are, over all rays: the coordinates' error and how many
rays have one; the products rendered x captured, rendered x rendered and captured x captured of the pattern.
"""

import warp as wp

from sl_nerfstudio.field.device_kernels import kernel, part, structure

# Projection into a projector, and its pattern, for one point; the formulas are those of `geometry/devices/`.

_MIN_DEPTH = wp.constant(1e-6)  # as in geometry/devices

Pixel = structure(
    "Pixel",
    __name__,
    lit=wp.int32,  # whether the point has a pixel; else the rest is zero
    uv=wp.vec2,
    du=wp.vec3,  # derivatives by the point, in the projector's axes
    dv=wp.vec3,
)


@part
def project(params: wp.array(dtype=wp.float32), model: wp.int32, distorted: wp.int32, p: wp.vec3):
    """Pixel of a point in the projector's axes; `model` is 0 for the pinhole model and 1 for the DOE."""
    pixel = Pixel()
    norm = wp.length(p)
    if not (-p[2] > _MIN_DEPTH * norm):
        return pixel
    q = -1.0 / p[2]
    x = p[0] * q
    y = -p[1] * q
    dx = wp.vec3(q, 0.0, x * q)
    dy = wp.vec3(0.0, -q, y * q)
    if model == 1:
        q = 1.0 / norm
        x = p[0] * q
        y = -p[1] * q
        dx = wp.vec3(q, 0.0, 0.0) - (x * q * q) * p
        dy = wp.vec3(0.0, -q, 0.0) - (y * q * q) * p
    if distorted != 0:
        k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        slope = 2.0 * k1 + 4.0 * k2 * r2
        a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        if not (a * d > b * b and a > 0.0):  # beyond where the polynomial folds back
            return pixel
        xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        x = xd
        along_x = a * dx + b * dy
        dy = b * dx + d * dy
        dx = along_x
    pixel.lit = 1
    pixel.uv = wp.vec2(params[0] * x + params[2], params[1] * y + params[3])
    pixel.du = params[0] * dx
    pixel.dv = params[1] * dy
    return pixel


@part
def unproject(params: wp.array(dtype=wp.float32), model: wp.int32, distorted: wp.int32, uv: wp.vec2):
    """Unit direction, in the device's axes, of a pixel; not a number where the model has none."""
    xd = (uv[0] - params[2]) / params[0]
    yd = (uv[1] - params[3]) / params[1]
    x = wp.float32(xd)
    y = wp.float32(yd)
    if distorted != 0:
        k1, k2, p1, p2 = params[4], params[5], params[6], params[7]
        for _ in range(12):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * k2)
            slope = 2.0 * k1 + 4.0 * k2 * r2
            ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - xd
            ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - yd
            a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            det = a * d - b * b
            if wp.abs(det) < 1.0e-9:
                det = wp.float32(1.0e-9)
            x -= (d * ex - b * ey) / det
            y -= (a * ey - b * ex) / det
    direction = wp.vec3(x, -y, -1.0)
    if model == 1:
        return wp.vec3(x, -y, -wp.sqrt(1.0 - x * x - y * y))
    return direction / wp.length(direction)


@part
def texel(pattern: wp.array2d(dtype=wp.float32), column: wp.int32, row: wp.int32):
    """Intensity of a pixel of the pattern; 0 outside."""
    inside = column >= 0 and row >= 0 and column < pattern.shape[1] and row < pattern.shape[0]
    value = wp.float32(0.0)
    if inside:
        value = pattern[row, column]
    return value


@part
def look_up(pattern: wp.array2d(dtype=wp.float32), uv: wp.vec2):
    """Bilinear intensity at continuous coordinates (first pixel's centre at 0.5), and its two derivatives."""
    x = uv[0] - 0.5
    y = uv[1] - 0.5
    found = wp.vec3()
    if x > -1.0 and y > -1.0 and x < wp.float32(pattern.shape[1]) and y < wp.float32(pattern.shape[0]):
        column = wp.int32(wp.floor(x))
        row = wp.int32(wp.floor(y))
        s = x - wp.float32(column)
        t = y - wp.float32(row)
        a = texel(pattern, column, row)
        b = texel(pattern, column + 1, row)
        c = texel(pattern, column, row + 1)
        d = texel(pattern, column + 1, row + 1)
        top = a + s * (b - a)
        bottom = c + s * (d - c)
        found = wp.vec3(top + t * (bottom - top), (1.0 - t) * (b - a) + t * (d - c), bottom - top)
    return found


# From pixels to the points at which a training step evaluates the field; one thread per pixel, ray or point.
#
# The formulas are those of `rendering/ray_samples.py`, `rendering/renderer.py` and `rendering/direct_losses.py`.
# Camera and projector poses are one per frame, `views` is the frame of each ray. `noise` holds uniform random
# numbers.

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


# The losses on triangulated points and on the field's slope, with their adjoints; see `rendering/direct_losses.py`.
#
# There are n triangulated points and m others. `f` and `slope` are the field and its gradient at all of them, `sides`
# the field in front of the n points, then behind them. The sums, from number 5 on: weights; the surface term; how
# many points count; the terms in front and behind; the facing term; the Eikonal term, and how many points it has.

_LEAST_DESCENT = wp.constant(0.05)  # as in losses.py
_BEHIND, _FACING = wp.constant(0.3), wp.constant(0.1)  # as in direct_losses.py


@kernel
def direct(
    f: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=wp.vec3),
    sides: wp.array(dtype=wp.float32),
    directions: wp.array(dtype=wp.vec3),
    measured: wp.array(dtype=wp.vec2),
    weight: wp.array(dtype=wp.float32),
    at_least: wp.array(dtype=wp.float32),
    width: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float32),
):
    """Add the terms of each point to the sums."""
    i = wp.tid()
    n = weight.shape[0]
    counts = wp.float32(1.0)
    if i < n:
        counts = wp.where(wp.isfinite(measured[i][0]) and wp.isfinite(measured[i][1]), 1.0, 0.0)
        w = weight[i]
        if w > 0.0:
            spread = wp.float32(width[0])
            wp.atomic_add(sums, 5, w)
            wp.atomic_add(sums, 6, w * spread * (1.0 - wp.exp(-wp.abs(f[i]) / spread)))
            wp.atomic_add(sums, 7, 1.0)
            wp.atomic_add(sums, 8, wp.max(at_least[i] - sides[i], 0.0))
            wp.atomic_add(sums, 9, wp.max(sides[n + i], 0.0))
            wp.atomic_add(sums, 10, w * wp.max(wp.dot(slope[i], directions[i]) + _LEAST_DESCENT, 0.0))
    if counts > 0.0:
        off = wp.length(slope[i]) - 1.0
        wp.atomic_add(sums, 11, off * off)
        wp.atomic_add(sums, 12, 1.0)


@kernel
def losses(
    sums: wp.array(dtype=wp.float32),
    px_per_length: wp.array(dtype=wp.float32),
    per_length: wp.float32,
    per_pixel: wp.float32,
    pattern: wp.float32,
    surface: wp.float32,
    free_space: wp.float32,
    eikonal: wp.float32,
    ordered: wp.array(dtype=wp.float32),
    out: wp.array(dtype=wp.float32),
):
    """The weighted losses: coordinates, pattern, surface, free space, Eikonal; then how well rays fit.

    That is the lower median of the errors of the coordinates, which come in ascending order, and the patterns' cosine.
    """
    by_pixel = per_pixel
    if per_length > 0.0:
        by_pixel = per_length / px_per_length[0]
    out[0] = by_pixel * sums[0] / wp.max(sums[1], 1.0)
    norms = wp.max(wp.sqrt(sums[3]), 1.0e-6) * wp.max(wp.sqrt(sums[4]), 1.0e-6)
    out[1] = pattern * (1.0 - sums[2] / norms)
    weights = wp.max(sums[5], 1.0e-9)
    number = wp.max(sums[7], 1.0)
    out[2] = surface * sums[6] / weights
    out[3] = free_space * ((sums[8] + _BEHIND * sums[9]) / number + _FACING * sums[10] / weights)
    out[4] = eikonal * sums[11] / wp.max(sums[12], 1.0)
    low = wp.int32(0)
    high = ordered.shape[0]
    while low < high:  # how many are finite
        middle = (low + high) / 2
        if wp.isfinite(ordered[middle]):
            low = middle + 1
        else:
            high = middle
    out[5] = wp.nan
    if low > 0:
        out[5] = ordered[(low - 1) / 2]
    out[6] = sums[2] / (wp.max(wp.sqrt(sums[3]), 1.0e-8) * wp.max(wp.sqrt(sums[4]), 1.0e-8))


@kernel
def direct_adjoint(
    f: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=wp.vec3),
    sides: wp.array(dtype=wp.float32),
    directions: wp.array(dtype=wp.vec3),
    measured: wp.array(dtype=wp.vec2),
    weight: wp.array(dtype=wp.float32),
    at_least: wp.array(dtype=wp.float32),
    width: wp.array(dtype=wp.float64),
    sums: wp.array(dtype=wp.float32),
    surface: wp.float32,
    free_space: wp.float32,
    eikonal: wp.float32,
    g_surface: wp.array(dtype=wp.float32),
    g_free_space: wp.array(dtype=wp.float32),
    g_eikonal: wp.array(dtype=wp.float32),
    d_f: wp.array(dtype=wp.float32),
    d_slope: wp.array(dtype=wp.vec3),
    d_sides: wp.array(dtype=wp.float32),
):
    """Adjoints of the field and its gradient at all points."""
    i = wp.tid()
    n = weight.shape[0]
    by_f = wp.float32(0.0)
    by_slope = wp.vec3()
    counts = wp.float32(1.0)
    if i < n:
        counts = wp.where(wp.isfinite(measured[i][0]) and wp.isfinite(measured[i][1]), 1.0, 0.0)
        w = weight[i]
        before = wp.float32(0.0)
        behind = wp.float32(0.0)
        if w > 0.0:
            weights = wp.max(sums[5], 1.0e-9)
            each = g_free_space[0] * free_space / wp.max(sums[7], 1.0)
            by_f = g_surface[0] * surface * w / weights * wp.exp(-wp.abs(f[i]) / wp.float32(width[0])) * wp.sign(f[i])
            if f[i] == 0.0:
                by_f = wp.float32(0.0)
            if at_least[i] - sides[i] >= 0.0:
                before = -each
            if sides[n + i] >= 0.0:
                behind = _BEHIND * each
            if wp.dot(slope[i], directions[i]) + _LEAST_DESCENT >= 0.0:
                by_slope = (_FACING * g_free_space[0] * free_space * w / weights) * directions[i]
        d_sides[i] = before
        d_sides[n + i] = behind
    if counts > 0.0:
        length = wp.length(slope[i])
        if length > 0.0:
            by_slope += (2.0 * g_eikonal[0] * eikonal / wp.max(sums[12], 1.0) * (length - 1.0) / length) * slope[i]
    d_f[i] = by_f
    d_slope[i] = by_slope


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

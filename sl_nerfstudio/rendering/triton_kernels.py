# pyright: basic, reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportGeneralTypeIssues=false
"""Kernels in Triton from pixels to the weighted losses, and back; `triton_step.py` launches them.

The formulas are those of `renderer.py`, `volume_rendering.py`, `losses.py` and `direct_losses.py`. The field is
evaluated at these points, one after the other: samples on the rendered rays; of each ray a point in front of the
triangulated one; a point behind it; the triangulated one; and random points.
"""

from functools import partial

import triton
import triton.language as tl

from sl_nerfstudio.field.triton_vectors import (
    along,
    columns,
    cross,
    dot,
    finite,
    length,
    minus,
    one_minus_exp,
    store,
    summed,
    vector,
)
from sl_nerfstudio.rendering import direct_losses, renderer
from sl_nerfstudio.rendering import losses as plain_losses
from sl_nerfstudio.rendering.triton_devices import (
    cached,
    intrinsics,
    look_up,
    near_and_far,
    pose,
    project,
    turned,
    turned_back,
    unproject,
)

CACHE_SAMPLES = tl.constexpr(renderer.CACHE_SAMPLES)
_GATE, _BAND_SIGMAS = tl.constexpr(direct_losses.GATE), tl.constexpr(direct_losses.BAND_SIGMAS)
_LEAST_BAND, _MOST_BAND = tl.constexpr(direct_losses.LEAST_BAND), tl.constexpr(direct_losses.MOST_BAND)
_NEAR_SHARE, _NEAR_BANDS = tl.constexpr(direct_losses.NEAR_SHARE), tl.constexpr(direct_losses.NEAR_BANDS)
_BEHIND, _FACING = tl.constexpr(direct_losses.BEHIND), tl.constexpr(direct_losses.FACING)
_LEAST_DESCENT, _EPSILON = tl.constexpr(plain_losses.LEAST_DESCENT), tl.constexpr(1e-6)

_kernel = partial(triton.jit, do_not_specialize=["rays", "rendered", "others", "n", "start", "resolution"])


@triton.jit
def _shifted(x):
    """The column before each one of a tile; the first one remains."""
    j = tl.arange(0, x.shape[1])[None, :]
    return tl.gather(x, tl.broadcast_to(tl.maximum(j - 1, 0), x.shape), 1)


# From pixels to the points at which the field is evaluated. `noise` are uniform random numbers: one for each sample,
# three for each ray, three for each random point.


@triton.jit
def _ball(noise, i, there):
    """Points uniform in the unit ball."""
    z = 2.0 * tl.load(noise + 3 * i, there, 0.0) - 1.0
    angle = 6.283185307179586 * tl.load(noise + 3 * i + 1, there, 0.0)
    radius = tl.exp(tl.log(tl.maximum(tl.load(noise + 3 * i + 2, there, 0.0), 1e-30)) / 3.0)
    around = radius * tl.sqrt(tl.maximum(1.0 - z * z, 0.0))
    return around * tl.cos(angle), around * tl.sin(angle), radius * z


@triton.jit
def _interval(o, d, cache, resolution, kappa, there, HALF_WIDTH: tl.constexpr):
    """Where rays are sampled: around the first passage into the surface, by the cached grid, or else all along."""
    low, high = near_and_far(o, d)
    step = (high - low) / CACHE_SAMPLES
    j = tl.arange(0, CACHE_SAMPLES)[None, :]
    o, d = columns(o), columns(d)
    t = low[:, None] + (j + 0.5) * step[:, None]
    here = cached(cache, resolution, o, t, d, there[:, None])
    before = _shifted(here)
    enters = (j > 0) & (before > 0.0) & (here <= 0.0)
    first = tl.min(tl.where(enters, j, CACHE_SAMPLES), 1)
    at = t - step[:, None] + before / tl.maximum(before - here, 1e-9) * step[:, None]
    crossing = tl.sum(tl.where(j == first[:, None], at, 0.0), 1)
    reach = HALF_WIDTH / kappa + 2.0 / (resolution - 1.0)
    found = first < CACHE_SAMPLES
    return tl.where(found, crossing - reach, low), tl.where(found, crossing + reach, high)


@triton.jit
def _triangulated(o, d, T, k, u, v, noise_px, px_per_length, DOE: tl.constexpr, DISTORTED: tl.constexpr):
    """Where projector rays of coordinates meet camera rays: distance, its sigma, and the point's weight.

    The weight is 0 where nothing was decoded, or wrongly.
    """
    decoded = finite(u) & finite(v)
    e = turned(T, unproject(k, tl.where(decoded, u, k[1][0]), tl.where(decoded, v, k[1][1]), DOE, DISTORTED))
    between = minus(T[3], o)
    normal = cross(d, e)
    sin2 = dot(normal, normal)
    meets = sin2 > 1e-12  # as in geometry/triangulation.py
    scale = 1.0 / tl.where(meets, sin2, 1.0)
    depth = tl.where(meets, dot(cross(between, e), normal) * scale, 1.0)
    other = dot(cross(between, d), normal) * scale
    p = depth * d[0] - between[0], depth * d[1] - between[1], depth * d[2] - between[2]  # from the projector
    lit, _, _, du, dv = project(k, turned_back(T, p), DOE, DISTORTED)
    gap = turned_back(T, along(along(between, other, e), -depth, d))
    off = tl.sqrt(dot(du, gap) * dot(du, gap) + dot(dv, gap) * dot(dv, gap))
    way = turned_back(T, d)
    slope = tl.sqrt(dot(du, way) * dot(du, way) + dot(dv, way) * dot(dv, way))
    sigma = tl.where(meets & lit, noise_px / tl.maximum(slope, 1e-9), 0.0)
    good = decoded & meets & lit & (off < _GATE * noise_px) & (depth > 0.0) & (other > 0.0)
    good = good & (length(along(o, depth, d)) < 1.0)
    return depth, sigma, tl.where(good, tl.minimum(tl.maximum(slope / px_per_length, 0.1), 2.0), 0.0)


@_kernel()
def begin_rays(
    index, among, frame, row, column, coords, pattern, T_cameras, cameras, T_projectors, projector,
    noise, cache, kappa, noise_px, px_per_length,
    views, origins, directions, measured, captured, t, points, weight, at_least,
    rays, rendered, others, resolution, STRIDES: tl.constexpr,
    AMONG: tl.constexpr, CAMERA_DOE: tl.constexpr, CAMERA_DISTORTED: tl.constexpr, DOE: tl.constexpr,
    DISTORTED: tl.constexpr, RENDERS: tl.constexpr, SURFACE: tl.constexpr, DIRECT: tl.constexpr,
    HALF_WIDTH: tl.constexpr, SAMPLES: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Rays of the pixels `index` of a table (of its rows `among`, if AMONG), what was measured there, and all points.

    STRIDES are those of the table's five columns, from one pixel to the next.
    `at_least` is the value that the field should have in front of the triangulated points, `weight` what these count.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, direct = i < rays, rays if DIRECT else 0
    sides = rendered * SAMPLES
    own = i < others
    store(points, sides + 3 * direct + i, _ball(noise + sides + 3 * direct, i, own), own)
    pixel = tl.load(index + i, there, 0)
    if AMONG:
        pixel = tl.load(among + pixel, there, 0)
    pixel = pixel.to(tl.int64)
    view = tl.load(frame + pixel * STRIDES[0], there, 0)
    T = pose(T_cameras, view, there)
    y = tl.load(row + pixel * STRIDES[1], there, 0).to(tl.float32) + 0.5
    x = tl.load(column + pixel * STRIDES[2], there, 0).to(tl.float32) + 0.5
    coords += pixel * STRIDES[3]
    o, d = T[3], turned(T, unproject(intrinsics(cameras, view, there), x, y, CAMERA_DOE, CAMERA_DISTORTED))
    u, v = tl.load(coords, there, 0.0), tl.load(coords + 1, there, 0.0)
    tl.store(views + i, view, there)
    store(origins, i, o, there)
    store(directions, i, d, there)
    tl.store(measured + 2 * i, u, there)
    tl.store(measured + 2 * i + 1, v, there)
    tl.store(captured + i, tl.load(pattern + pixel * STRIDES[4], there, 0.0).to(tl.float32), there)
    low, high = near_and_far(o, d)
    if DIRECT:
        k, T = intrinsics(projector, 0, True), pose(T_projectors, view, there)
        px, usual = tl.load(noise_px), tl.load(px_per_length)
        depth, sigma, w = _triangulated(o, d, T, k, u, v, px, usual, DOE, DISTORTED)
        band = tl.minimum(tl.maximum(_BAND_SIGMAS * sigma, _LEAST_BAND), _MOST_BAND)
        chance = vector(noise + sides, i, there)
        close = tl.maximum(depth - band * (1.0 + (_NEAR_BANDS - 1.0) * chance[0]), low)
        before = tl.where(chance[2] < _NEAR_SHARE, close, low + tl.maximum(depth - band - low, 0.0) * chance[0])
        store(points, sides + i, along(o, before, d), there)
        store(points, sides + rays + i, along(o, depth + band * (1.0 + chance[1]), d), there)
        store(points, sides + 2 * rays + i, along(o, depth, d), there)
        tl.store(weight + i, w, there)
        tl.store(at_least + i, tl.minimum(0.3 * tl.maximum(depth - before, 0.0), _MOST_BAND), there)
    if RENDERS:
        there = i < rendered
        if SURFACE:
            low, high = _interval(o, d, cache, resolution, tl.load(kappa).to(tl.float32), there, HALF_WIDTH)
        j = tl.arange(0, COLUMNS)[None, :]
        at, some = i[:, None] * SAMPLES + j, there[:, None] & (j < SAMPLES)
        x = low[:, None] + (high - low)[:, None] * (j + tl.load(noise + at, some, 0.0)) / SAMPLES
        tl.store(t + at, x, some)
        store(points, at, along(columns(o), x, columns(d)), some)


@_kernel()
def rays_adjoint(
    T_cameras, views, directions, t, d_points, d_origins, d_directions, d_T, rendered,
    SAMPLES: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add to the adjoint of the cameras' poses: by the rays, and by the samples along them."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, j = i < rendered, tl.arange(0, COLUMNS)[None, :]
    at, some = i[:, None] * SAMPLES + j, there[:, None] & (j < SAMPLES)
    d_p, x = vector(d_points, at, some), tl.load(t + at, some, 0.0)
    d_o = along(vector(d_origins, i, there), 1.0, summed(d_p))
    d_d = along(vector(d_directions, i, there), 1.0, summed((x * d_p[0], x * d_p[1], x * d_p[2])))
    view = tl.load(views + i, there, 0)
    _add_pose(d_T, view, d_d, turned_back(pose(T_cameras, view, there), vector(directions, i, there)), d_o, there)


@triton.jit
def _add_pose(d_T, view, a, b, centre, there):
    """Add to the adjoints of poses: `a b^T` to that of the rotation, `centre` to that of the translation."""
    for ROW in tl.static_range(3):
        for COLUMN in tl.static_range(3):
            tl.atomic_add(d_T + 16 * view + 4 * ROW + COLUMN, a[ROW] * b[COLUMN], there, sem="relaxed")
        tl.atomic_add(d_T + 16 * view + 4 * ROW + 3, centre[ROW], there, sem="relaxed")


# What rays see, as volume_rendering.py has it: a row of a tile is a ray, a column the interval behind a sample. `sums`
# are, over all rays: (0) the coordinates' error, (1) how many rays have one; the products (2) rendered x captured, (3)
# rendered x rendered, (4) captured x captured of the pattern; (5) how many rays were decoded.


@triton.jit
def _log_phi(x):
    """Logarithm of the logistic function, without overflow."""
    small = tl.exp(-tl.abs(x))
    log1p = tl.where(small < 1e-3, small * (1.0 - small * (0.5 - small / 3.0)), tl.log(1.0 + small))
    return tl.minimum(x, 0.0) - log1p


@triton.jit
def _weights(sdf, t, i, there, kappa, SAMPLES: tl.constexpr, COLUMNS: tl.constexpr):
    """Of the intervals: weight, transparency in front, step of the logarithm of Phi, middle, and which are there."""
    j = tl.arange(0, COLUMNS)[None, :]
    at, some = i[:, None] * SAMPLES + j, there[:, None] & (j < SAMPLES - 1)
    before = _log_phi(kappa * tl.load(sdf + at, some, 0.0))
    step = _log_phi(kappa * tl.load(sdf + at + 1, some, 0.0)) - before
    drop = tl.minimum(step, 0.0)
    clear = tl.exp(tl.cumsum(tl.where(j > 0, _shifted(drop), 0.0), 1))  # never above 1, with any rounding
    middle = 0.5 * (tl.load(t + at, some, 0.0) + tl.load(t + at + 1, some, 0.0))
    return one_minus_exp(drop) * clear, clear, step, middle, some


@triton.jit
def _pixels(T, k, o, d, middle, some, pattern, height, width, DOE: tl.constexpr, DISTORTED: tl.constexpr):
    """Of the intervals: their point from the projector, whether it is lit, its pixel with gradients, its intensity."""
    p = along(minus(columns(o), columns(T[3])), middle, columns(d))
    axes = columns(T[0]), columns(T[1]), columns(T[2])
    lit, u, v, du, dv = project(k, turned_back(axes, p), DOE, DISTORTED)
    lit = lit & some
    return p, lit, u, v, du, dv, look_up(pattern, height, width, u, v, lit)


@triton.jit
def _views(weight, lit, u, v, intensity):
    """Of rays: coordinates, lit weight, its share, and intensity."""
    weight_lit = tl.where(lit, weight, 0.0)
    seen = tl.sum(weight_lit, 1)
    x = tl.sum(tl.where(lit, weight * u, 0.0), 1) / (seen + _EPSILON)
    y = tl.sum(tl.where(lit, weight * v, 0.0), 1) / (seen + _EPSILON)
    return x, y, seen, seen / (tl.sum(weight, 1) + _EPSILON), tl.sum(weight_lit * intensity, 1)


@triton.jit
def _offsets(measured, i, there, x, y, share):
    """Of rays: by how much coordinates are off, whether they were decoded, and whether they count."""
    u, v = tl.load(measured + 2 * i, there, float("nan")), tl.load(measured + 2 * i + 1, there, float("nan"))
    decoded = finite(u) & finite(v)
    return tl.where(decoded, x - u, 0.0), tl.where(decoded, y - v, 0.0), decoded, decoded & (share > 0.5)


@_kernel()
def render(
    sdf, t, origins, directions, T_projectors, views, projector, pattern, kappa, measured, captured,
    error, sums, rendered, height, width,
    DOE: tl.constexpr, DISTORTED: tl.constexpr, SAMPLES: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Add what rays see to the sums. `error` is the distance between coordinates, infinite where none were decoded."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < rendered
    weight, _, _, middle, some = _weights(sdf, t, i, there, tl.load(kappa).to(tl.float32), SAMPLES, COLUMNS)
    T, k = pose(T_projectors, tl.load(views + i, there, 0), there), intrinsics(projector, 0, True)
    o, d = vector(origins, i, there), vector(directions, i, there)
    _, lit, u, v, _, _, found = _pixels(T, k, o, d, middle, some, pattern, height, width, DOE, DISTORTED)
    x, y, _, share, intensity = _views(weight, lit, u, v, found[0])
    off_x, off_y, decoded, counts = _offsets(measured, i, there, x, y, share)
    tl.store(error + i, tl.where(decoded, tl.sqrt(off_x * off_x + off_y * off_y), float("inf")), there)
    target = tl.load(captured + i, there, 0.0)
    tl.atomic_add(sums, tl.sum(tl.where(counts, tl.abs(off_x) + tl.abs(off_y), 0.0)), sem="relaxed")
    tl.atomic_add(sums + 1, tl.sum(counts.to(tl.float32)), sem="relaxed")
    tl.atomic_add(sums + 2, tl.sum(intensity * target), sem="relaxed")
    tl.atomic_add(sums + 3, tl.sum(intensity * intensity), sem="relaxed")
    tl.atomic_add(sums + 4, tl.sum(target * target), sem="relaxed")
    tl.atomic_add(sums + 5, tl.sum(decoded.to(tl.float32)), sem="relaxed")


@triton.jit
def _by_pixel(px_per_length, PER_LENGTH: tl.constexpr, PER_PIXEL: tl.constexpr):
    """Weight of an error of coordinates by one pixel."""
    return PER_LENGTH / tl.load(px_per_length) if PER_LENGTH > 0.0 else PER_PIXEL


@triton.jit
def _sign(x):
    """-1, 0 or 1."""
    return (x > 0.0).to(tl.float32) - (x < 0.0).to(tl.float32)


@_kernel()
def render_adjoint(
    sdf, t, origins, directions, T_projectors, views, projector, pattern, kappa, measured, captured,
    sums, px_per_length, g_coordinates, g_pattern, d_sdf, d_origins, d_directions, d_T, rendered, height, width,
    PER_LENGTH: tl.constexpr, PER_PIXEL: tl.constexpr, PATTERN: tl.constexpr, RAYS: tl.constexpr, POSES: tl.constexpr,
    DOE: tl.constexpr, DISTORTED: tl.constexpr, SAMPLES: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adjoints of the distances; of rays if RAYS, and, added, of the projectors' poses if POSES."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, j = i < rendered, tl.arange(0, COLUMNS)[None, :]
    at, sharpness = i[:, None] * SAMPLES + j, tl.load(kappa).to(tl.float32)
    weight, clear, step, middle, some = _weights(sdf, t, i, there, sharpness, SAMPLES, COLUMNS)
    view = tl.load(views + i, there, 0)
    T, k = pose(T_projectors, view, there), intrinsics(projector, 0, True)
    o, d = vector(origins, i, there), vector(directions, i, there)
    p, lit, u, v, du, dv, found = _pixels(T, k, o, d, middle, some, pattern, height, width, DOE, DISTORTED)
    x, y, seen, share, intensity = _views(weight, lit, u, v, found[0])
    off_x, off_y, _, counts = _offsets(measured, i, there, x, y, share)
    # adjoints of a ray's coordinates, divided by its lit weight, and of its intensity
    scale = (
        _by_pixel(px_per_length, PER_LENGTH, PER_PIXEL) * tl.load(g_coordinates) / tl.maximum(tl.load(sums + 1), 1.0)
    )
    d_x = tl.where(counts, scale * _sign(off_x), 0.0) / (seen + _EPSILON)
    d_y = tl.where(counts, scale * _sign(off_y), 0.0) / (seen + _EPSILON)
    product, norm = tl.load(sums + 2), tl.sqrt(tl.load(sums + 3))
    captured_norm = tl.maximum(tl.sqrt(tl.load(sums + 4)), _EPSILON)
    shrink = tl.where(norm > _EPSILON, product / (norm * norm * norm * captured_norm), 0.0)
    by_intensity = tl.load(captured + i, there, 0.0) / (tl.maximum(norm, _EPSILON) * captured_norm) - shrink * intensity
    by_intensity *= -PATTERN * tl.load(g_pattern)
    d_x, d_y, by_intensity = d_x[:, None], d_y[:, None], by_intensity[:, None]
    d_weight = tl.where(lit, d_x * (u - x[:, None]) + d_y * (v - y[:, None]) + by_intensity * found[0], 0.0)
    # the logarithm of Phi falls in an interval: that dims all intervals behind
    dimmed = weight * d_weight
    d_log = tl.cumsum(dimmed, 1, reverse=True) - dimmed - (clear - weight) * d_weight
    d_log = tl.where(some & (step <= 0.0), d_log, 0.0)
    here = tl.load(sdf + at, there[:, None] & (j < SAMPLES), 0.0)
    d_here = tl.where(j > 0, _shifted(d_log), 0.0) - d_log
    tl.store(d_sdf + at, d_here * sharpness / (1.0 + tl.exp(sharpness * here)), there[:, None] & (j < SAMPLES))
    if RAYS or POSES:
        d_u = tl.where(lit, weight * (d_x + by_intensity * found[1]), 0.0)
        d_v = tl.where(lit, weight * (d_y + by_intensity * found[2]), 0.0)
        d_p = d_u * du[0] + d_v * dv[0], d_u * du[1] + d_v * dv[1], d_u * du[2] + d_v * dv[2]
        d_o = turned(T, summed(d_p))
        if RAYS:
            store(d_origins, i, d_o, there)
            moved = middle * d_p[0], middle * d_p[1], middle * d_p[2]
            store(d_directions, i, turned(T, summed(moved)), there)
        if POSES:
            for ROW in tl.static_range(3):
                for COLUMN in tl.static_range(3):
                    at = d_T + 16 * view + 4 * ROW + COLUMN
                    tl.atomic_add(at, tl.sum(p[ROW] * d_p[COLUMN], 1), there, sem="relaxed")
                tl.atomic_add(d_T + 16 * view + 4 * ROW + 3, -d_o[ROW], there, sem="relaxed")


# The terms on triangulated points and on the field's slope, as direct_losses.py has them. There are n triangulated
# points; `start` is the number of the first point on their sides, `f` the field at all points, `slope` its gradient at
# the triangulated ones and the others. The sums, from number 6 on: weights; the surface term; how many points count;
# the terms in front and behind; the facing term; the Eikonal term, and how many points it has.


@triton.jit
def _counted(measured, i, n, others):
    """Whether triangulated points were decoded, or others are there: these have an Eikonal term."""
    u, v = tl.load(measured + 2 * i, i < n, 0.0), tl.load(measured + 2 * i + 1, i < n, 0.0)
    return finite(u) & finite(v) & (i < n + others)


@_kernel()
def direct(
    f, slope, directions, measured, weight, at_least, surface_width, sums, start, n, others, BLOCK: tl.constexpr
):  # fmt: skip
    """Add the terms of points to the sums."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    spread = tl.maximum(tl.load(surface_width).to(tl.float32), 1e-9)  # 0 where the term is not used
    w = tl.load(weight + i, i < n, 0.0)
    some = w > 0.0
    at_surface, in_front = tl.load(f + start + 2 * n + i, some, 0.0), tl.load(f + start + i, some, 0.0)
    normal = vector(slope, i, i < n + others)
    rise = tl.maximum(dot(normal, vector(directions, i, some)) + _LEAST_DESCENT, 0.0)
    counts = _counted(measured, i, n, others)
    off = length(normal) - 1.0
    tl.atomic_add(sums + 6, tl.sum(w), sem="relaxed")
    tl.atomic_add(sums + 7, tl.sum(w * spread * (1.0 - tl.exp(-tl.abs(at_surface) / spread))), sem="relaxed")
    tl.atomic_add(sums + 8, tl.sum(some.to(tl.float32)), sem="relaxed")
    missing = tl.where(some, tl.maximum(tl.load(at_least + i, some, 0.0) - in_front, 0.0), 0.0)
    tl.atomic_add(sums + 9, tl.sum(missing), sem="relaxed")
    tl.atomic_add(sums + 10, tl.sum(tl.maximum(tl.load(f + start + n + i, some, 0.0), 0.0)), sem="relaxed")
    tl.atomic_add(sums + 11, tl.sum(w * rise), sem="relaxed")
    tl.atomic_add(sums + 12, tl.sum(tl.where(counts, off * off, 0.0)), sem="relaxed")
    tl.atomic_add(sums + 13, tl.sum(counts.to(tl.float32)), sem="relaxed")


@_kernel()
def direct_adjoint(
    f, slope, directions, measured, weight, at_least, surface_width, sums, g_surface, g_free_space, g_eikonal,
    d_f, d_slope, start, n, others,
    SURFACE: tl.constexpr, FREE_SPACE: tl.constexpr, EIKONAL: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Adjoints of the field at all of these points, and of its gradient."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there, own = i < n + others, i < n
    spread = tl.maximum(tl.load(surface_width).to(tl.float32), 1e-9)  # 0 where the term is not used
    w = tl.load(weight + i, own, 0.0)
    some, share = w > 0.0, w / tl.maximum(tl.load(sums + 6), 1e-9)
    each = tl.load(g_free_space) * FREE_SPACE / tl.maximum(tl.load(sums + 8), 1.0)
    at_surface, in_front = tl.load(f + start + 2 * n + i, some, 0.0), tl.load(f + start + i, some, 0.0)
    by_f = tl.load(g_surface) * SURFACE * share * tl.exp(-tl.abs(at_surface) / spread) * _sign(at_surface)
    tl.store(d_f + start + 2 * n + i, by_f, there)
    tl.store(d_f + start + i, tl.where(some & (tl.load(at_least + i, some, 0.0) >= in_front), -each, 0.0), own)
    behind = tl.load(f + start + n + i, some, -1.0) >= 0.0
    tl.store(d_f + start + n + i, tl.where(behind, _BEHIND * each, 0.0), own)
    normal, d = vector(slope, i, there), vector(directions, i, some)
    rises = some & (dot(normal, d) + _LEAST_DESCENT >= 0.0)
    rise = tl.where(rises, _FACING * tl.load(g_free_space) * FREE_SPACE * share, 0.0)
    size = length(normal)
    steep = 2.0 * EIKONAL * tl.load(g_eikonal) / tl.maximum(tl.load(sums + 13), 1.0) * (size - 1.0)
    steep = tl.where(_counted(measured, i, n, others) & (size > 0.0), steep / tl.maximum(size, 1e-30), 0.0)
    pulled = rise * d[0] + steep * normal[0], rise * d[1] + steep * normal[1], rise * d[2] + steep * normal[2]
    store(d_slope, i, pulled, there)


@triton.jit
def losses(
    sums, px_per_length, ordered, out,
    PER_LENGTH: tl.constexpr, PER_PIXEL: tl.constexpr, PATTERN: tl.constexpr,
    SURFACE: tl.constexpr, FREE_SPACE: tl.constexpr, EIKONAL: tl.constexpr,
):  # fmt: skip
    """The weighted losses: coordinates, pattern, surface, free space, Eikonal; then how well rays fit.

    That is the lower median of the errors of the coordinates, which come in ascending order, and the patterns' cosine.
    """
    error = tl.load(sums) / tl.maximum(tl.load(sums + 1), 1.0)
    tl.store(out, _by_pixel(px_per_length, PER_LENGTH, PER_PIXEL) * error)
    product, norm, captured_norm = tl.load(sums + 2), tl.sqrt(tl.load(sums + 3)), tl.sqrt(tl.load(sums + 4))
    cosine = product / (tl.maximum(norm, _EPSILON) * tl.maximum(captured_norm, _EPSILON))
    tl.store(out + 1, PATTERN * (1.0 - cosine))
    weights, number = tl.maximum(tl.load(sums + 6), 1e-9), tl.maximum(tl.load(sums + 8), 1.0)
    tl.store(out + 2, SURFACE * tl.load(sums + 7) / weights)
    signs = (tl.load(sums + 9) + _BEHIND * tl.load(sums + 10)) / number
    tl.store(out + 3, FREE_SPACE * (signs + _FACING * tl.load(sums + 11) / weights))
    tl.store(out + 4, EIKONAL * tl.load(sums + 12) / tl.maximum(tl.load(sums + 13), 1.0))
    decoded = tl.load(sums + 5).to(tl.int32)
    tl.store(out + 5, tl.load(ordered + (decoded - 1) // 2, decoded > 0, float("nan")))
    tl.store(out + 6, product / (tl.maximum(norm, 1e-8) * tl.maximum(captured_norm, 1e-8)))

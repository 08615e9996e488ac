# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""The losses on triangulated points and on the field's slope, with their adjoints; see `rendering/direct_losses.py`.

There are n triangulated points and m others. `f` and `slope` are the field and its gradient at all of them, `sides` the
field in front of the n points, then behind them. The sums, from number 5 on: weights; the surface term; how many points
count; the terms in front and behind; the facing term; the Eikonal term, and how many points it has.
"""

import warp as wp

from sl_nerfstudio.device_kernels import kernel

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

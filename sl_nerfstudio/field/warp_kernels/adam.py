# type: ignore  (Warp compiles what is below; its types are not those of Python)
"""The optimiser's step for a feature table, in Warp: one thread per row, rows without a gradient are left alone."""

import warp as wp

from sl_nerfstudio.device_kernels import kernel, part
from sl_nerfstudio.field.warp_kernels.grid import vec8


@part
def one_minus_exp(x: wp.float32):
    """`1 - exp(x)` for `x <= 0`, as exact for small `x`."""
    series = -x * (1.0 + x * (0.5 + x * (1.0 / 6.0 + x * (1.0 / 24.0 + x * (1.0 / 120.0 + x / 720.0)))))
    return wp.where(x > -0.3, series, 1.0 - wp.exp(x))


@kernel
def row_adam(
    table: wp.array(dtype=vec8),
    gradient: wp.array(dtype=vec8),
    moments: wp.array2d(dtype=vec8),
    steps: wp.array(dtype=wp.float32),
    lr: wp.array(dtype=wp.float32),
    log_beta1: wp.float32,
    log_beta2: wp.float32,
    most_steps: wp.float32,
    eps: wp.float32,
):
    """Adam for the rows whose gradient is not exactly zero; clears the gradient.

    `moments` [row, 2]: mean and mean square of the gradient; `steps` counts the steps of each row.
    """
    row = wp.tid()
    g = gradient[row]
    if wp.dot(wp.abs(g), vec8(1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0)) == 0.0:
        return
    rest1, rest2 = one_minus_exp(log_beta1), one_minus_exp(log_beta2)
    t = wp.min(steps[row] + 1.0, most_steps)
    steps[row] = t
    m = moments[row, 0] + rest1 * (g - moments[row, 0])
    s = moments[row, 1] + rest2 * (wp.cw_mul(g, g) - moments[row, 1])
    moments[row, 0] = m
    moments[row, 1] = s
    rate = lr[0] / one_minus_exp(t * log_beta1)
    root = 1.0 / wp.sqrt(one_minus_exp(t * log_beta2))
    x = table[row]
    for j in range(8):
        x[j] = x[j] - rate * m[j] / (wp.sqrt(s[j]) * root + eps)
    table[row] = x
    gradient[row] = vec8()

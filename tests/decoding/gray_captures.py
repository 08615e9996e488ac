"""Photographs of a Gray-code sequence on a bent, blotchy surface, whose exact coordinates are known."""

import numpy as np
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.grid import sample_bilinear

LAYOUT = GrayCode(320, 240, 2)


def exact_coords(w=200, h=150):
    """A bent surface seen obliquely, with a step in depth; NaN beside it. A pixel is about 1.3 pattern pixels."""
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    u = 20 + 1.25 * x + 0.15 * y + 6 * np.sin(x / 40) + np.where(x > 0.6 * w, 25.0, 0.0)
    v = 12 + 1.3 * y - 0.1 * x + 4 * np.cos(x / 30)
    coords = np.stack([u, v], -1)
    outside = (np.hypot((x / w - 0.5), (y / h - 0.5)) > 0.47) | (u > 318) | (v > 238) | (v < 2)
    coords[outside] = np.nan
    return coords


def photographs(coords, noise=0.01, blur=0.5, room=0.05, gain=0.7, glow=0.0, layout=LAYOUT, seed=0):
    """8-bit images of all patterns; `glow` is light from everywhere that is lit, as interreflection makes it."""
    rng = np.random.default_rng(seed)
    lit = np.isfinite(coords).all(-1)
    albedo = 0.7 + 0.3 * gaussian_filter(rng.standard_normal(lit.shape), 6) * 8
    albedo = np.clip(albedo, 0.3, 1.0)
    out = []
    for pattern in layout.sequence():
        fine = pattern.astype(np.float32) / 255
        light = np.where(lit, np.nan_to_num(sample_bilinear(fine, coords)), 0)
        light = light + glow * gaussian_filter(light, 15)
        image = gaussian_filter(gain * albedo * light + room, blur) + noise * rng.standard_normal(lit.shape)
        out.append(np.clip(np.rint(255 * image), 0, 255).astype(np.uint8))
    return out

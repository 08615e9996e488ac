"""Photographs of a Gray-code sequence on a bent, blotchy surface, whose exact coordinates are known."""

import cv2
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


def figure_before_wall(layout, w=480, h=360, seed=0):
    """Colour photographs of a textured figure before a wall: defocus, room light, a tone curve, noise and JPEG.

    Returns the images, the exact coordinates, and where the wall is seen. The projector is finer than the camera, and
    the figure's paint goes from nearly black to white within a few pixels.
    """
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    figure = ((x - 0.5 * w) / (0.17 * w)) ** 2 + ((y - 0.55 * h) / (0.36 * h)) ** 2
    depth = np.where(figure < 1, 25 + 22 * np.sqrt(np.clip(1 - figure, 0, 1)), 0)  # as a shift in the pattern
    scale = 0.9 * layout.w / w
    u, v = 0.05 * layout.w + scale * x + 0.04 * y + depth, 0.03 * layout.h + 0.9 * layout.h / h * y - 0.02 * x
    coords = np.stack([u, v], -1)
    paint = sum(gaussian_filter(rng.standard_normal((h, w, 3)), (s, s, 0)) * s for s in (1, 3, 9))
    albedo = np.where((figure < 1)[..., None], np.clip(0.5 + 0.5 * paint, 0.06, 1), (0.7, 0.65, 0.55))
    out = []
    for pattern in layout.sequence():
        sharp = gaussian_filter(pattern.astype(np.float32) / 255, 1.1)
        light = np.nan_to_num(sample_bilinear(sharp, coords))[..., None]
        linear = gaussian_filter(albedo * (0.02 + 0.55 * light + 0.08), (0.9, 0.9, 0))
        linear += 0.006 * rng.standard_normal(linear.shape) * np.sqrt(0.05 + linear)
        image = np.clip(np.rint(255 * np.clip(linear, 0, 1) ** (1 / 2.2)), 0, 255).astype(np.uint8)
        stored = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])[1]
        out.append(np.ascontiguousarray(cv2.imdecode(stored, cv2.IMREAD_COLOR)[..., ::-1]))
    return out, coords, figure > 1.1

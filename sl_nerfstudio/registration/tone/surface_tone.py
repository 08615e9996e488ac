"""How much darker or brighter a surface is than around it: prints, grain and dirt, which stay where they are on it.

A vase may be turned about its axis without its shape telling. Its tone tells, because hardly any real surface is
equally bright everywhere.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.registration.tone.settings import ToneSettings


def surface_tone(
    light: Float64[ndarray, "h w"],
    point: Float64[ndarray, "h w 3"],
    normal: Float64[ndarray, "h w 3"],
    p_projector: Float64[ndarray, "3"],
    settings: ToneSettings,
) -> Float32[ndarray, "h w"]:
    """Logarithm of the reflectance against its surroundings, NaN where unknown; all vectors in camera axes.

    `light` is what the surface returns of the projector's light, NaN where unknown. It is divided by what arrives there
    (Lambert's cosine over the squared distance). What functions of the angles to light and camera explain is taken out,
    because it is light that this view sees, such as gloss, and so is what changes slowly over the image, such as the
    projector's own fall-off.
    """
    ray = p_projector - point
    distance = np.linalg.norm(ray, axis=-1)
    to_light = ray / np.maximum(distance, 1e-300)[..., None]
    to_camera = -point / np.maximum(np.linalg.norm(point, axis=-1, keepdims=True), 1e-300)
    cosine = (to_light * normal).sum(-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        known = (light > 0) & (cosine > settings.least_cosine) & ((to_camera * normal).sum(-1) > settings.least_cosine)
        known = _inside(known, settings.border)
        tone = np.where(known, np.log(light * distance**2 / cosine), np.nan)
    if known.sum() < settings.fewest_pixels:
        return np.full(light.shape, np.nan, dtype=np.float32)
    tone = _cut(tone, settings.largest)
    tone[known] -= _explained(tone[known], normal[known], to_light[known], to_camera[known], settings)
    tone = _against_surroundings(tone, settings)
    return _cut(tone, settings.largest).astype(np.float32)


def _inside(known: Bool[ndarray, "h w"], border: int) -> Bool[ndarray, "h w"]:
    """Without a strip along the border, where the light was measured beside something else."""
    square = np.ones((2 * border + 1,) * 2, dtype=np.uint8)
    return cv2.erode(known.astype(np.uint8), square, borderType=cv2.BORDER_CONSTANT, borderValue=(0.0,)) > 0


def _cut(tone: Float64[ndarray, "h w"], largest: float) -> Float64[ndarray, "h w"]:
    """Less the median, and at most so many robust standard deviations."""
    if np.isnan(tone).all():
        return tone
    centred = tone - np.nanmedian(tone)
    reach = largest * MAD_TO_SIGMA * float(np.nanmedian(np.abs(centred)))
    return np.clip(centred, -reach, reach)


def _explained(
    tone: Float64[ndarray, "n"],
    normal: Float64[ndarray, "n 3"],
    to_light: Float64[ndarray, "n 3"],
    to_camera: Float64[ndarray, "n 3"],
    settings: ToneSettings,
) -> Float64[ndarray, "n"]:
    """What the directions of light and camera against the normal explain: a sum of three functions, least squares."""
    middle = to_light + to_camera
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    angles = (np.degrees(np.arccos((normal * v).sum(-1).clip(-1, 1))) for v in (to_light, to_camera, middle))
    terms = np.concatenate([_hats(angle, settings.knots_deg) for angle in angles], 1)
    H = terms.T @ terms + settings.ridge * len(tone) * np.eye(terms.shape[1])
    return terms @ np.linalg.solve(H, terms.T @ tone)


def _hats(angle: Float64[ndarray, "n"], knots: Sequence[float]) -> Float64[ndarray, "n k"]:
    """Piecewise linear functions of angles, each 1 at its knot and 0 at the others."""
    number = np.arange(len(knots))
    return np.maximum(1 - np.abs(np.interp(angle, knots, number)[:, None] - number), 0)


def _against_surroundings(tone: Float64[ndarray, "h w"], settings: ToneSettings) -> Float64[ndarray, "h w"]:
    """The tone less its mean around each place, on the same connected part of the surface."""
    known = np.isfinite(tone)
    sigma = settings.window * max(tone.shape)
    count, label = cv2.connectedComponents(known.astype(np.uint8), connectivity=4)
    out = np.full(tone.shape, np.nan)
    for number in range(1, count):
        part: Bool[ndarray, "h w"] = label == number
        if part.sum() < settings.fewest_pixels:
            continue
        weight = part.astype(np.float32)
        values = np.where(part, tone, 0).astype(np.float32)
        mean = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT) / np.maximum(
            cv2.GaussianBlur(weight, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT), 1e-6
        )
        out[part] = tone[part] - mean[part]
    return out

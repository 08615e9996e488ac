"""One bounce: light of the projector that one surface throws onto another.

The pattern's light is cast in a coarse bundle of rays; each point that it meets shines on like a small matte lamp
(Keller's virtual point lights, 1997). What they send to a surface is gathered at a coarse grid of image pixels, with
shadow rays, as a vector of light for each colour, so that fine relief is still shaded by its own normals. The pattern
itself is too fine to survive the bounce, so its mean is used.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.synthesis.ray_casting import RayCaster

_FACING = 1e-3  # cosines below this carry no light


@dataclass(frozen=True)
class SmallLamps:
    """Points that shine on the light that they receive, in all directions of their side."""

    p_world: Float[ndarray, "m 3"]
    normal: Float[ndarray, "m 3"]
    power: Float[ndarray, "m 3"]  # reflected light times area, red, green, blue
    width: Float[ndarray, "m"]  # of the patch that each stands for, millimetres


def light_vectors(
    caster: RayCaster, lamps: SmallLamps, p_world: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"]
) -> Float32[ndarray, "n 3 3"]:
    """Sum of the lamps' light over directions at points, (colour, axis): its product with a normal is the light there.

    Lamps behind the surface, and lamps that another surface hides, give nothing.
    """
    out = np.zeros((len(p_world), 3, 3))
    for q, towards, power, width in zip(lamps.p_world, lamps.normal, lamps.power, lamps.width, strict=True):
        ray = q - p_world
        distance2 = (ray**2).sum(-1)
        direction = ray / np.sqrt(np.maximum(distance2, 1e-12))[:, None]
        leaving = -(direction @ towards)
        reached = (leaving > _FACING) & ((direction * normal).sum(-1) > _FACING)
        reached[reached] = _clear(caster, q, towards, p_world[reached])
        # a lamp stands for a patch: nearer than its width, the inverse-square law does not hold
        weight = leaving[reached] / (np.pi * np.maximum(distance2[reached], width**2))
        out[reached] += power[:, None] * (weight[:, None] * direction[reached])[:, None, :]
    return out.astype(np.float32)


def interpolate_vectors(
    vectors: Float32[ndarray, "n 3 3"], known: Bool[ndarray, "a b"], stride: int, shape: tuple[int, int]
) -> Float32[ndarray, "h w 3 3"]:
    """Vectors at every pixel from those on a grid of every `stride`-th pixel, of which `known` ones exist."""
    h, w = shape
    grid = np.zeros((*known.shape, 10), dtype=np.float32)
    grid[known, :9] = vectors.reshape(-1, 9)
    grid[known, 9] = 1
    i, j = np.meshgrid((np.arange(h) - stride // 2) / stride, (np.arange(w) - stride // 2) / stride, indexing="ij")
    full = np.stack([map_coordinates(grid[..., k], [i, j], order=1, mode="nearest") for k in range(10)], -1)
    return (full[..., :9] / np.maximum(full[..., 9:], 1e-3)).reshape(h, w, 3, 3)


def _clear(
    caster: RayCaster, origin: Float[ndarray, "3"], normal: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"]
) -> Bool[ndarray, "n"]:
    """Whether nothing is between a lamp, lifted off its own surface, and points."""
    lift = 1e-3 * caster.scene.size
    return caster.sees(origin + lift * normal, p_world, np.full(len(p_world), -2))

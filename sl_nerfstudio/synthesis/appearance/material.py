"""What a surface does with light: a coloured, textured, matte base, and a highlight."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.synthesis.appearance.ranges import Ranges, draw, draw_log
from sl_nerfstudio.synthesis.appearance.textures import TEXTURES, Texture

LUMA = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # Rec. 601, as captures are made grey
_DARKEST, _BRIGHTEST = 0.04, 0.95


@dataclass(frozen=True)
class Layer:
    """A texture, and the share of light (red, green, blue) that is left where it is 1."""

    texture: Texture
    left: Float32[ndarray, "3"]


@dataclass(frozen=True)
class Material:
    """A matte base under layers of texture, and a highlight by Blinn and Phong that keeps the lamp's colour."""

    centre: Float[ndarray, "3"]
    base: Float32[ndarray, "3"]
    layers: tuple[Layer, ...]
    gloss: float
    exponent: float

    def albedo(self, p_world: Float[ndarray, "n 3"]) -> Float32[ndarray, "n 3"]:
        """Share of light reflected in red, green and blue."""
        p = (p_world - self.centre).astype(np.float32)
        out = np.broadcast_to(self.base, (len(p), 3)).copy()
        for layer in self.layers:
            out *= 1 - layer.texture(p)[:, None] * (1 - layer.left)
        return np.clip(out, _DARKEST, _BRIGHTEST)

    def highlight(self, cosine: Float32[ndarray, "n"]) -> Float32[ndarray, "n"]:
        """Share of light in the highlight, by the cosine between normal and half-way direction.

        The factor (m + 8) / 8 keeps the energy about the same for every exponent m.
        """
        return np.float32(self.gloss * (self.exponent + 8) / 8) * np.maximum(cosine, 0) ** np.float32(self.exponent)


def make_material(
    centre: Float[ndarray, "3"], size: float, ranges: Ranges, most_layers: int, rng: np.random.Generator
) -> Material:
    """A random material: a tinted base, and different textures drawn without order."""
    least = min(ranges.texture_layers[0], most_layers)
    names = rng.permutation(list(TEXTURES))[: int(rng.integers(least, most_layers + 1))]
    layers = []
    for name in names:
        texture = TEXTURES[str(name)](size, rng)
        taken = draw(rng, ranges.texture_contrast) * rng.uniform(0.7, 1.0, 3)
        layers.append(Layer(texture, (1 - taken).astype(np.float32)))
    return Material(
        centre,
        _tinted(draw(rng, ranges.brightness), 0.25, rng),
        tuple(layers),
        draw(rng, ranges.gloss),
        draw_log(rng, ranges.gloss_exponent),
    )


def _tinted(brightness: float, strength: float, rng: np.random.Generator) -> Float32[ndarray, "3"]:
    """A colour of the given luma."""
    return tint(strength, rng) * np.float32(brightness)


def tint(strength: float, rng: np.random.Generator) -> Float32[ndarray, "3"]:
    """A random colour of luma 1; channels differ by about `strength`."""
    colour = np.exp(rng.uniform(-strength, strength, 3)).astype(np.float32)
    return colour / (colour @ LUMA)

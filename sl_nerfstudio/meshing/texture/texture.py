"""What a textured mesh has beside its triangles."""

from dataclasses import dataclass

from jaxtyping import Float32, Int64, UInt8
from numpy import ndarray


@dataclass(frozen=True)
class Charts:
    """A mesh laid out flat in pieces: a vertex has one corner for each of the charts that it belongs to."""

    corners: Int64[ndarray, "f 3"]  # of each triangle
    uv: Float32[ndarray, "c 2"]  # of each corner, in [0, 1]: to the right, and down
    vertex: Int64[ndarray, "c"]  # of each corner
    count: int  # charts


@dataclass(frozen=True)
class Texture:
    """Texture coordinates of a mesh's triangles, and the image they refer to."""

    charts: Charts
    image: UInt8[ndarray, "n n 3"]  # sRGB; its first row is at v = 0

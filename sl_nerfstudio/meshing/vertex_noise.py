"""The part of a vertex's uncertainty that comes from decoding noise, and from a field that does not follow the pixels.

The field averages the pixels of all frames over a small area of the surface. So the variance of a vertex is that of a
pixel's coordinate, divided by the number of pixels in that area and by the square of their slope along the normal.
Where the pixels, averaged over the same area, put the surface elsewhere, the distance counts instead: a field that was
trained too briefly, or that rounds an edge, is farther from the truth than noise alone would put it.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import coo_array

from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.vertex_sums import VertexSums

AVERAGED_CELLS = 2.0
"""Area over which the field averages, in squares of its finest cells; measured with several draws of noise (1.4 to 3.8
in benchmarks/log.md)."""
_MOST_ROUNDS = 60  # of smoothing, for meshes that are much finer than the field


def independent_variance(mesh: Mesh, sums: VertexSums, averaged_area: float) -> Float[ndarray, "v"]:
    """Variance of each vertex along its normal, from what its own neighbourhood was decoded as; NaN without views."""
    total = sums.weight
    seen = total > 0
    if not seen.any():
        return np.full(len(total), np.nan)
    with np.errstate(divide="ignore", invalid="ignore"):
        from_noise = sums.correlation * sums.variance / averaged_area / total**2
        smooth = Smoothing(mesh, averaged_area)
        misfit = smooth(sums.pull) / smooth(total)
        from_misfit = smooth(np.where(seen, misfit**2, 0.0)) / smooth(seen.astype(float))
    return np.where(seen, np.fmax(from_noise, from_misfit), np.nan)


class Smoothing:
    """Averages values of vertices over an area of the mesh, by diffusion along its edges."""

    def __init__(self, mesh: Mesh, area: float) -> None:
        """A Gaussian of standard deviation d averages as much as a disk of area 4 pi d^2."""
        count = len(mesh.vertices)
        a, b = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]).T
        ends = np.concatenate([a, b]), np.concatenate([b, a])
        links = coo_array((np.ones(2 * len(a)), ends), (count, count)).tocsr()
        degree = np.maximum(np.asarray(links.sum(1)).reshape(-1), 1.0)
        self._links, self._degree = links, degree
        # A round keeps half of each value and spreads the other half: d^2 grows by a quarter of the squared edge.
        edge2 = float(((mesh.vertices[a] - mesh.vertices[b]) ** 2).sum(1).mean())
        self._rounds = min(round(area / (4 * np.pi) / (edge2 / 4)), _MOST_ROUNDS) if edge2 > 0 else 0

    def __call__(self, values: Float[ndarray, "v"]) -> Float[ndarray, "v"]:
        """The averages; the sum over all vertices stays."""
        for _ in range(self._rounds):
            values = 0.5 * values + 0.5 * (self._links @ (values / self._degree))
        return values

"""A result against its nominal part: signed deviations, what of them is certain, and where they are.

A deviation is measured along the part's normal and positive outside: there is too much material. What counts as
certain follows ISO 14253-1: a point is out of tolerance if its deviation is beyond it by more than 2 sigma, within if
it is inside by more than 2 sigma, and undecided in between.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.part_alignment import facet_sag
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality

_SIGMAS = 2.0
_MOST_PATCHES = 8
_HIGHEST = 90.0  # percentile of the deviations of a patch that counts as its height: single vertices are noise


@dataclass(frozen=True)
class Patch:
    """A connected piece of the surface that is out of tolerance; lengths in the part's unit."""

    place: tuple[float, float, float]  # in the part's axes, where the deviation is largest
    area: float
    mean: float
    height: float  # 90 % of its deviations are smaller in size
    sigma: float | None  # median


@dataclass(frozen=True)
class Inspection:
    """Deviations of a result from its part; lengths in the part's unit, shares of the result's area."""

    deviation: Float64[ndarray, "v"]  # of every vertex
    sigma: Float64[ndarray, "v"] | None  # 1 sigma along the normal, NaN where not measured; None: not stated
    tolerance: float | None
    S_part_mesh: Similarity  # from the mesh's world to the part's axes
    mean: float
    median: float
    rms: float
    lowest: float  # percentile 1
    highest: float  # percentile 99
    median_sigma: float | None
    unmeasured: float  # share that no frame confirms, and that counts nowhere else
    within: float | None  # shares of what was measured; None without a tolerance
    undecided: float | None
    out: float | None
    patches: tuple[Patch, ...]
    facet_error: float  # RMS distance of the part's facets from the curved surfaces that they stand for

    def beyond(self) -> Float64[ndarray, "v"]:
        """By how much each vertex is certainly out of tolerance, with the sign of its deviation; 0 for all others."""
        return np.sign(self.deviation) * np.maximum(_certain_excess(self.deviation, self.sigma, self.tolerance), 0.0)


def _certain_excess(
    deviation: Float64[ndarray, "v"], sigma: Float64[ndarray, "v"] | None, tolerance: float | None
) -> Float64[ndarray, "v"]:
    margin = 0.0 if sigma is None else _SIGMAS * np.nan_to_num(sigma, nan=np.inf)
    return np.abs(deviation) - margin - (np.inf if tolerance is None else tolerance)


def inspect(
    mesh: Mesh,
    part: Mesh,
    S_part_mesh: Similarity,
    tolerance: float | None = None,
    quality: VertexQuality | None = None,
) -> Inspection:
    """Compare a result with its nominal part.

    Args:
        mesh: the result.
        part: the nominal surface, its triangles counter-clockwise as seen from outside.
        S_part_mesh: where the result lies in the part's axes and unit: `PartAlignment.S_part_result`, or another.
        tolerance: largest deviation allowed on either side, in the part's unit.
        quality: of the mesh's vertices, in its unit: `read_quality` of its file; None if they state no uncertainty.
    """
    indexed = IndexedMesh(part)
    deviation = indexed.signed_distance(S_part_mesh.points(mesh.vertices))
    sigma = None if quality is None else quality.sigma * S_part_mesh.scale
    thirds = np.repeat(mesh.face_areas() / 3, 3)  # of the triangles around each vertex
    area = np.bincount(mesh.faces.ravel(), thirds, len(mesh.vertices)) * S_part_mesh.scale**2
    measured = area > 0 if sigma is None else np.isfinite(sigma) & (area > 0)
    if not measured.any():
        sigma, measured = None, area > 0
    d, a = deviation[measured], area[measured]
    order = np.argsort(d)
    share = (np.cumsum(a[order]) - a[order] / 2) / a.sum()
    low, median, high = np.interp([0.01, 0.5, 0.99], share, d[order])
    out = _certain_excess(deviation, sigma, tolerance) > 0
    within = undecided = beyond = None
    if tolerance is not None:
        inside = np.abs(d) + (0.0 if sigma is None else _SIGMAS * sigma[measured]) <= tolerance
        outside = out[measured]
        shares = (float(a[chosen].sum() / a.sum()) for chosen in (inside, outside, ~(inside | outside)))
        within, beyond, undecided = shares
    return Inspection(
        deviation=deviation,
        sigma=sigma,
        tolerance=tolerance,
        S_part_mesh=S_part_mesh,
        mean=float(a @ d / a.sum()),
        median=float(median),
        rms=float(np.sqrt(a @ d**2 / a.sum())),
        lowest=float(low),
        highest=float(high),
        median_sigma=None if sigma is None else float(np.median(sigma[measured])),
        unmeasured=float(1 - a.sum() / area.sum()),
        within=within,
        undecided=undecided,
        out=beyond,
        patches=_patches(mesh, deviation, sigma, out, area, S_part_mesh),
        facet_error=facet_sag(indexed),
    )


def _patches(
    mesh: Mesh,
    deviation: Float64[ndarray, "v"],
    sigma: Float64[ndarray, "v"] | None,
    out: Bool[ndarray, "v"],
    area: Float64[ndarray, "v"],
    S_part_mesh: Similarity,
) -> tuple[Patch, ...]:
    """The largest connected pieces, on one side each, whose corners are all out of tolerance."""
    found = []
    for side in (1.0, -1.0):
        chosen = out & (side * deviation > 0)
        faces = np.flatnonzero(chosen[mesh.faces].all(1))
        piece = Mesh(mesh.vertices, mesh.faces[faces]).component_of_faces()
        for number in range(int(piece.max(initial=-1)) + 1):
            corners = np.unique(mesh.faces[faces[piece == number]])
            d, a = deviation[corners], area[corners]
            peak = corners[int(np.abs(d).argmax())]
            x, y, z = S_part_mesh.points(mesh.vertices[peak]).tolist()
            height = side * float(np.percentile(np.abs(d), _HIGHEST))
            usual = None if sigma is None else float(np.median(sigma[corners]))
            found.append(Patch((x, y, z), float(a.sum()), float(a @ d / a.sum()), height, usual))
    return tuple(sorted(found, key=lambda patch: -patch.area)[:_MOST_PATCHES])


def deviation_colours(deviation: Float64[ndarray, "v"], limit: float) -> UInt8[ndarray, "v 3"]:
    """Blue at -`limit` and below, through green at 0, to red at `limit` and above."""
    import matplotlib

    rgb = np.asarray(matplotlib.colormaps["turbo"](np.clip(deviation / limit / 2 + 0.5, 0.05, 0.95)))[:, :3]
    return np.round(255 * rgb).astype(np.uint8)

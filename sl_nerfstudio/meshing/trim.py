"""Cut a mesh to what the frames observed: the surface that closes unseen sides is an invention of the field."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.observe import Occluder, Votes, collect_votes
from sl_nerfstudio.scan.types import Scan

HOLE_SHARE, SILENT_SHARE, SPECK_SHARE = 2e-3, 2e-2, 1e-4
"""Of the kept area: smaller gaps inside the observed surface stay closed (larger ones where the pattern was seen but
not decoded), smaller pieces apart from it are dropped."""
SILENT_MEMBERS, CONTRADICTED = 0.75, 0.25
"""Such a gap counts as seen but not decoded if this share of its vertices fell into masks, and frames spoke against
fewer vertices than this share of those: what closes a real gap between two surfaces is seen through by some frames."""
TINY = 3  # vertices: so small a gap is closed whatever frames say, wrong decodings meet by chance
BADLY_DECODED = 0.25  # share of undecoded sightings above which a mask counts as evidence
_LEAST_SHARE = 0.1  # observed vertices, of those seen: with fewer, the agreement is chance
_SECOND_LOOK_SHARE = 1e-3  # denied vertices, of all, that are removed from the occluders before looking again


@dataclass(frozen=True)
class Trimmed:
    """The observed part of a mesh, and why the rest is gone; counts of vertices."""

    mesh: Mesh
    total: int
    unseen: int  # no frame saw them
    denied: int  # frames saw something else there, or nothing
    closed: int  # kept although not observed: small gaps inside the observed surface
    specks: int  # pieces (not vertices) that were too small, or that no frame confirmed
    residual_px: float  # between predicted and decoded coordinates, median over frames; NaN if nothing was decoded


def trim_to_observed(
    mesh: Mesh,
    scan: Scan,
    T_world_camera: Float[ndarray, "n 4 4"] | None = None,
    T_world_projector: Float[ndarray, "n 4 4"] | None = None,
) -> Trimmed:
    """Keep the triangles of a mesh in world units whose corners at least one frame observed.

    A frame observes a vertex that faces its camera and its projector, is hidden from neither, falls inside the mask and
    inside the pattern, and whose predicted pattern coordinate is the decoded one. Frames that decoded another one, or
    where the pattern should fall on the vertex and does not, speak against it: the majority counts. Frames that see it
    just beside their mask have half a voice against it.
    Poses default to the scan's own; give the refined ones, in the order of the frames, if the mesh was made with them.
    Raises UserError if nothing was observed.
    """
    T_camera = scan.T_world_camera if T_world_camera is None else T_world_camera
    T_projector = scan.T_world_projector if T_world_projector is None else T_world_projector
    votes = collect_votes(mesh, Occluder(mesh), scan, T_camera, T_projector)
    denied = _denied(votes)
    if denied.sum() > _SECOND_LOOK_SHARE * len(denied):
        # What stands in front of the object without being there hid the object itself: look again without it.
        without = _without(mesh, denied, _observed(votes))
        if len(without.faces):
            votes = collect_votes(mesh, Occluder(without), scan, T_camera, T_projector, before=votes)
    observed = _observed(votes)
    seen = votes.confirmed + votes.silent + votes.denied > 0
    if observed.sum() < _LEAST_SHARE * seen.sum() or not observed[mesh.faces].all(1).any():
        raise UserError(_nothing_observed(votes))
    keep = observed | _small_gaps(mesh, observed, votes)
    kept = keep[mesh.faces].all(1)
    specks, n_specks = _specks(mesh, kept, votes)
    return Trimmed(
        mesh=mesh.with_faces(kept & ~specks),
        total=len(mesh.vertices),
        unseen=int((~seen).sum()),
        denied=int(_denied(votes).sum()),
        closed=int((keep & ~observed).sum()),
        specks=n_specks,
        residual_px=float(np.nanmedian(votes.residual_px)) if np.isfinite(votes.residual_px).any() else float("nan"),
    )


def _observed(votes: Votes) -> Bool[ndarray, "v"]:
    """Confirmed at least as often as denied; or never confirmed, but silently seen more often than denied.

    The latter only in scans that decode badly. Where decoding rarely fails, real surface is confirmed by some frame,
    and what falls into masks without ever being confirmed is the invented continuation of a visible side; what little
    real surface is undecoded there is a gap, which `_small_gaps` closes.
    """
    by_code = (votes.confirmed > 0) & (votes.confirmed >= votes.against)
    by_mask = (votes.confirmed == 0) & (votes.silent > votes.against)
    silent, confirmed = int(votes.silent.sum()), int(votes.confirmed.sum())
    return by_code | by_mask if silent > BADLY_DECODED * (silent + confirmed) else by_code


def _denied(votes: Votes) -> Bool[ndarray, "v"]:
    return ~_observed(votes) & (votes.denied > 0)


def _without(mesh: Mesh, denied: Bool[ndarray, "v"], observed: Bool[ndarray, "v"]) -> Mesh:
    """The mesh without denied vertices, and without what remains of a phantom once its visible side is gone."""
    edges = _edges(mesh)
    count, label = _components(len(denied), edges[~denied[edges].any(1)])
    real = np.bincount(label, observed, count) > 0
    return mesh.with_vertices(~denied & real[label])


def _edges(mesh: Mesh) -> Int64[ndarray, "e 2"]:
    return np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])


def _components(n: int, edges: Int64[ndarray, "e 2"]) -> tuple[int, Int64[ndarray, "n"]]:
    graph = coo_matrix((np.ones(len(edges), dtype=np.int8), (edges[:, 0], edges[:, 1])), shape=(n, n))
    count, label = connected_components(graph, directed=False)
    return int(count), label.astype(np.int64)


def _small_gaps(mesh: Mesh, observed: Bool[ndarray, "v"], votes: Votes) -> Bool[ndarray, "v"]:
    """Vertices of small unobserved patches inside the observed surface: tiny, or not denied by several frames."""
    edges = _edges(mesh)
    gap = ~observed
    count, label = _components(len(gap), edges[gap[edges].all(1)])
    face_gap = gap[mesh.faces]
    touched = face_gap.any(1)
    face_label = np.where(face_gap, label[mesh.faces], -1).max(1)  # corners are neighbours, so of one patch
    areas = mesh.face_areas()
    area = np.bincount(face_label[touched], areas[touched], count)
    beside = np.zeros(count, dtype=bool)
    mixed = edges[observed[edges[:, 0]] != observed[edges[:, 1]]]
    beside[label[mixed[gap[mixed]]]] = True
    members = np.bincount(label[gap], minlength=count)
    several = np.bincount(label[gap], (votes.denied[gap] > 1).astype(float), count)
    in_mask = np.bincount(label[gap], (votes.silent[gap] > 0).astype(float), count)
    silent, denied = (np.bincount(label[gap], v[gap].astype(float), count) for v in (votes.silent, votes.denied))
    undecoded = (in_mask > SILENT_MEMBERS * members) & (denied < CONTRADICTED * silent)
    share = np.where(undecoded, SILENT_SHARE, HOLE_SHARE)
    allowed = (several <= 0.5 * members) | (members <= TINY)
    good = beside & (area < share * areas[~touched].sum()) & allowed
    return gap & good[label]


def _specks(mesh: Mesh, kept: Bool[ndarray, "f"], votes: Votes) -> tuple[Bool[ndarray, "f"], int]:
    """Kept triangles in pieces that are tiny or that no decoded coordinate confirms, and the number of such pieces."""
    faces = mesh.faces[kept]
    count, label = _components(len(mesh.vertices), np.concatenate([faces[:, :2], faces[:, 1:]]))
    area = np.bincount(label[faces[:, 0]], mesh.face_areas()[kept], count)
    confirmed = np.bincount(label, (votes.confirmed > 0).astype(float), count)
    bad = area < SPECK_SHARE * area.sum()
    if votes.confirmed.any():
        bad |= confirmed == 0
    pieces = np.unique(label[faces[:, 0]])
    return kept & bad[label[mesh.faces[:, 0]]], int(bad[pieces].sum())


def _nothing_observed(votes: Votes) -> str:
    if (votes.denied > 0).any():
        off = f"off by {np.nanmedian(votes.residual_px):.0f} px (median)"
        cause = f"the predicted pattern coordinates are not the decoded ones, {off}"
    else:
        cause = "no vertex falls inside a mask while facing camera and projector"
    return (
        "the frames observed no part of the surface, so nothing is left of it\n"
        f"    cause:  {cause}: wrong poses or axes, or an unfinished training\n"
        "    remedy: check the scan with sl-check and look at the run in ns-viewer; "
        "--keep-unobserved writes the surface uncut"
    )

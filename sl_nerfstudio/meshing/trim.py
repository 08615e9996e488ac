"""Trim a mesh to what the frames observed: the field invents the surface that closes unseen sides."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Int64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.connectivity import component_labels
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.lit_vertices import Occluder
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.visibility import FrameCounts, count_frames
from sl_nerfstudio.scan.types import Scan

HOLE_SHARE, UNDECODED_HOLE_SHARE, PIECE_SHARE = 2e-3, 2e-2, 1e-4
"""Shares of the kept area. Smaller gaps inside the observed surface stay closed (the second limit is for gaps where the
pattern was seen but not decoded); smaller separate pieces are dropped."""
UNDECODED_MEMBERS, CONTRADICTED = 0.75, 0.25
"""A gap counts as seen but not decoded if more than the first share of its vertices have inconclusive frames, and the
contradictions are fewer than the second share of the inconclusive counts: surface that wrongly closes a real gap
between two surfaces is contradicted by the frames that see through it."""
TINY = 3  # vertices: such a small gap is always closed, because wrong decodings can coincide by chance
BADLY_DECODED = 0.25  # share of inconclusive counts above which the mask alone counts as evidence
_SEVERAL = 2  # frames that contradict a vertex: one alone may have decoded wrongly
_LEAST_SHARE = 0.1  # of the seen vertices must be observed: with fewer, the agreement is chance
_SECOND_PASS_SHARE = 1e-3  # of all vertices: if more are contradicted, they are removed and all frames counted again


@dataclass(frozen=True)
class Trimmed:
    """The observed part of a mesh, and why the rest was removed; counts of vertices."""

    mesh: Mesh
    kept: Bool[ndarray, "f"]  # triangles of the whole mesh
    observed: Bool[ndarray, "v"]  # vertices of the whole mesh; those of closed gaps are not
    denied: Bool[ndarray, "v"]  # vertices of the whole mesh that several frames contradict
    total: int
    unseen: int  # no frame saw them
    contradicted: int  # frames saw something else there, or nothing
    closed: int  # kept although not observed: small gaps inside the observed surface
    loose_pieces: int  # pieces (not vertices) that were too small, or that no frame confirmed
    residual_px: float  # between predicted and decoded coordinates, median over frames; NaN if nothing was decoded


def trim_to_observed(mesh: Mesh, scan: Scan, poses: DevicePoses | None = None) -> Trimmed:
    """Keep the triangles of a mesh in world units whose corners at least one frame observed.

    A frame confirms a vertex that faces its camera and its projector, is hidden from neither, is inside the mask and
    inside the pattern, and whose predicted pattern coordinate is the decoded one. A frame contradicts it if it decoded
    another coordinate, or if the vertex is outside the mask although it should be lit. The majority decides; frames
    that see the vertex just outside their mask count half.
    The default is the scan's own poses; give the refined ones if the mesh was made with them. Raises UserError if
    nothing was observed.
    """
    poses = scan.poses if poses is None else poses
    counts = count_frames(mesh, Occluder(mesh), scan, poses)
    contradicted = _contradicted(counts)
    if contradicted.sum() > _SECOND_PASS_SHARE * len(contradicted):
        # Invented surface in front of the object may have hidden the object: count again without it.
        without = _without(mesh, contradicted, _observed(counts))
        if len(without.faces):
            counts = count_frames(mesh, Occluder(without), scan, poses, before=counts)
    observed = _observed(counts)
    seen = counts.confirmed + counts.inconclusive + counts.contradicted > 0
    if observed.sum() < _LEAST_SHARE * seen.sum() or not observed[mesh.faces].all(1).any():
        raise UserError(_nothing_observed(counts))
    keep = observed | _small_gaps(mesh, observed, counts)
    kept = keep[mesh.faces].all(1)
    loose, pieces = _loose_pieces(mesh, kept, counts)
    kept &= ~loose
    return Trimmed(
        mesh=mesh.with_faces(kept),
        kept=kept,
        observed=observed,
        denied=~observed & (counts.contradicted >= _SEVERAL),
        total=len(mesh.vertices),
        unseen=int((~seen).sum()),
        contradicted=int(_contradicted(counts).sum()),
        closed=int((keep & ~observed).sum()),
        loose_pieces=pieces,
        residual_px=float(np.nanmedian(counts.residual_px)) if np.isfinite(counts.residual_px).any() else float("nan"),
    )


def _observed(counts: FrameCounts) -> Bool[ndarray, "v"]:
    """Confirmed at least as often as contradicted; or never confirmed, but inconclusive more often than contradicted.

    The latter only in scans that were decoded badly. Where decoding rarely fails, real surface is confirmed by some
    frame, and what is in masks without ever being confirmed is the invented continuation of a visible side. The little
    real surface that is undecoded there is a gap, which `_small_gaps` closes.
    """
    by_code = (counts.confirmed > 0) & (counts.confirmed >= counts.against)
    by_mask = (counts.confirmed == 0) & (counts.inconclusive > counts.against)
    inconclusive, confirmed = int(counts.inconclusive.sum()), int(counts.confirmed.sum())
    return by_code | by_mask if inconclusive > BADLY_DECODED * (inconclusive + confirmed) else by_code


def _contradicted(counts: FrameCounts) -> Bool[ndarray, "v"]:
    return ~_observed(counts) & (counts.contradicted > 0)


def _without(mesh: Mesh, contradicted: Bool[ndarray, "v"], observed: Bool[ndarray, "v"]) -> Mesh:
    """The mesh without contradicted vertices, and without the pieces of invented surface that this leaves behind."""
    edges = mesh.edges()
    count, label = _components(len(contradicted), edges[~contradicted[edges].any(1)])
    real = np.bincount(label, observed, count) > 0
    return mesh.with_vertices(~contradicted & real[label])


def _components(n: int, edges: Int64[ndarray, "e 2"]) -> tuple[int, Int64[ndarray, "n"]]:
    label = component_labels(edges[:, 0], edges[:, 1], n)
    return int(label.max(initial=-1)) + 1, label


def _small_gaps(mesh: Mesh, observed: Bool[ndarray, "v"], counts: FrameCounts) -> Bool[ndarray, "v"]:
    """Vertices of small unobserved patches inside the observed surface: tiny, or not contradicted by several frames."""
    edges = mesh.edges()
    gap = ~observed
    count, label = _components(len(gap), edges[gap[edges].all(1)])
    face_gap = gap[mesh.faces]
    touched = face_gap.any(1)
    face_label = np.where(face_gap, label[mesh.faces], -1).max(1)  # corners are neighbours, so they are in one patch
    areas = mesh.face_areas()
    area = np.bincount(face_label[touched], areas[touched], count)
    bordering = np.zeros(count, dtype=bool)
    mixed = edges[observed[edges[:, 0]] != observed[edges[:, 1]]]
    bordering[label[mixed[gap[mixed]]]] = True
    members = np.bincount(label[gap], minlength=count)
    several = np.bincount(label[gap], (counts.contradicted[gap] >= _SEVERAL).astype(float), count)
    in_mask = np.bincount(label[gap], (counts.inconclusive[gap] > 0).astype(float), count)
    silent, denied = (
        np.bincount(label[gap], v[gap].astype(float), count) for v in (counts.inconclusive, counts.contradicted)
    )
    undecoded = (in_mask > UNDECODED_MEMBERS * members) & (denied < CONTRADICTED * silent)
    share = np.where(undecoded, UNDECODED_HOLE_SHARE, HOLE_SHARE)
    allowed = (several <= 0.5 * members) | (members <= TINY)
    good = bordering & (area < share * areas[~touched].sum()) & allowed
    return gap & good[label]


def _loose_pieces(mesh: Mesh, kept: Bool[ndarray, "f"], counts: FrameCounts) -> tuple[Bool[ndarray, "f"], int]:
    """Kept triangles in pieces that are tiny or that no decoded coordinate confirms, and the number of those pieces."""
    faces = mesh.faces[kept]
    count, label = _components(len(mesh.vertices), np.concatenate([faces[:, :2], faces[:, 1:]]))
    area = np.bincount(label[faces[:, 0]], mesh.face_areas()[kept], count)
    confirmed = np.bincount(label, (counts.confirmed > 0).astype(float), count)
    bad = area < PIECE_SHARE * area.sum()
    if counts.confirmed.any():
        bad |= confirmed == 0
    pieces = np.unique(label[faces[:, 0]])
    return kept & bad[label[mesh.faces[:, 0]]], int(bad[pieces].sum())


def _nothing_observed(counts: FrameCounts) -> str:
    if (counts.contradicted > 0).any():
        off = f"they differ by {np.nanmedian(counts.residual_px):.0f} px (median)"
        cause = f"the predicted pattern coordinates are not the decoded ones; {off}"
    else:
        cause = "no vertex that faces camera and projector is inside a mask"
    return (
        "the frames observed no part of the surface, so nothing is left of it\n"
        f"    cause:  {cause}: wrong poses or axes, or an unfinished training\n"
        "    remedy: check the scan with sl-check and look at the run in ns-viewer; "
        "--keep-unobserved writes the whole surface"
    )

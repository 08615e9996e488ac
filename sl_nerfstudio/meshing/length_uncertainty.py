"""Uncertainty of the distance between two points of the surface.

A point that is measured on the surface moves with the poses of the frames that see it, along the surface as well as
across it. It is where their rays meet: it minimises its residuals in camera pixels and projector pixels. The shared
part of a length's variance follows from the joint covariance, in the gauge of the scan: the length that fixes the scale
counts as exact. Decoding noise moves each end along its normal.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.joint_covariance.covariance import JointCovariance
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.surface_derivatives import point_equations
from sl_nerfstudio.meshing.vertex_uncertainty import columns_of
from sl_nerfstudio.meshing.vertex_views import VertexViews, collect_views, devices_of
from sl_nerfstudio.scan.types import Scan


@dataclass(frozen=True)
class LengthSigma:
    """1 sigma of lengths, in the scan's unit; NaN where no frame confirms one of the ends."""

    shared: Float[ndarray, "n"]  # from poses and intrinsics
    independent: Float[ndarray, "n"]  # from decoding noise at both ends


def length_sigma(
    mesh: Mesh,
    sigma_independent: Float[ndarray, "v"],
    ends: Int64[ndarray, "n 2"],
    scan: Scan,
    poses: DevicePoses,
    joint: JointCovariance,
) -> LengthSigma:
    """Uncertainty of the distances between pairs of vertices."""
    chosen, index = np.unique(ends, return_inverse=True)
    index = index.reshape(ends.shape)
    views = collect_views(mesh, scan, poses, chosen)
    moved = point_changes(mesh, scan, poses, views, chosen, joint.factor)
    along = mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]]
    with np.errstate(invalid="ignore", divide="ignore"):
        along = along / np.linalg.norm(along, axis=1, keepdims=True)
    change = np.einsum("ni,nik->nk", along, moved[index[:, 1]] - moved[index[:, 0]])
    across = np.einsum("ni,nei->ne", along, mesh.vertex_normals()[ends])
    return LengthSigma(np.sqrt((change**2).sum(1)), np.sqrt(((across * sigma_independent[ends]) ** 2).sum(1)))


def point_changes(
    mesh: Mesh,
    scan: Scan,
    poses: DevicePoses,
    views: VertexViews,
    chosen: Int64[ndarray, "c"],
    steps: Float[ndarray, "joint k"],
) -> Float[ndarray, "c 3 k"]:
    """Changes of points by some steps of (delta, rho, intrinsics); NaN where no frame confirms the vertex."""
    n, p = len(scan.frames), torch.from_numpy(mesh.vertices)
    normal = np.zeros((len(chosen), 3, 3))
    right = np.zeros((len(chosen), 3, steps.shape[1]))
    for k in np.unique(views.frame).tolist():
        vertex = views.vertex[views.frame == k]
        at = np.searchsorted(chosen, vertex)
        A, B = (x.numpy() for x in point_equations(devices_of(scan, poses, k), p[vertex]))
        normal[at] += A.transpose(0, 2, 1) @ A
        mine = np.concatenate([steps[columns_of(k, n)], steps[12 * n :]])
        right[at] += (A.transpose(0, 2, 1) @ B) @ mine
    seen = np.isin(chosen, views.vertex)
    out = np.full_like(right, np.nan)
    out[seen] = -np.linalg.solve(normal[seen], right[seen])
    return out

"""What a result is compared with, a true mesh or reference points; alignment with it, and errors of poses."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.mesh_index import Closest, IndexedMesh, capture_views, observable
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, log_so3
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan

# Aligning a result with the truth: by its poses, then by its surface (ICP).

_MAX_LOG_SCALE = np.log(1.5)  # limit for ICP with scale, which could otherwise shrink the result onto a patch
_TRUSTED = 0.7  # share of the points assumed to lie on the target
_TRUSTED_SIGMA = 1.0364  # quantile of |x| at _TRUSTED, x standard normal
_MOST_STEPS = 60
_TUKEY = 4.685  # of the robust sigma: 95 % efficiency on normal residuals (Tukey's biweight)


@dataclass(frozen=True)
class Alignment:
    """A fitted map, and how well it fits."""

    S_target_source: Similarity
    residual: float  # RMS distance of the best 80 % of the points, in the target's unit


def align_poses(
    T_estimated: Float[ndarray, "n 4 4"], T_true: Float[ndarray, "n 4 4"], with_scale: bool = True
) -> Similarity:
    """Least-squares map of estimated onto true device poses, from centres and orientations together.

    The rotation minimises the squared centre errors (relative to the spread of the centres) plus the
    squared chordal distances of the orientations, so that two devices, or centres on one line, are enough.
    Scale and translation then follow from the centres alone.
    """
    source, target = T_estimated[:, :3, 3], T_true[:, :3, 3]
    mean_s, mean_t = source.mean(0), target.mean(0)
    s, t = source - mean_s, target - mean_t
    spread = float(np.sqrt((s * s).sum(1).mean() * (t * t).sum(1).mean()))
    # The true orientation of a device is R @ the estimated one.
    turns = np.einsum("nij,nkj->ik", T_true[:, :3, :3], T_estimated[:, :3, :3]) / len(s)
    centres = t.T @ s / len(s) / spread if spread > 0 else np.zeros((3, 3))
    U, _, Vt = np.linalg.svd(turns + centres)
    R = (U * np.array([1.0, 1.0, np.linalg.det(U @ Vt)])) @ Vt
    moment = float((s * s).sum())
    scale = float((t * (s @ R.T)).sum() / moment) if with_scale and moment > 0 else 1.0
    scale = scale if scale > 0 else 1.0
    return Similarity(scale, R, mean_t - scale * R @ mean_s)


def icp(points: Float[ndarray, "n 3"], target: IndexedMesh, start: Similarity, with_scale: bool) -> Alignment:
    """Robust point-to-plane ICP of `points` onto `target`, from `start`.

    Each round matches every point with the nearest point of the target's triangles and takes one
    Gauss-Newton step on the point-to-plane distances, weighted by Tukey's biweight with the sigma of the best
    70 % of the current distances, so surface that the target does not have gets weight zero. (With the best half, a
    plate that fits perfectly would give weight zero to everything on it.)
    Directions that the data do not determine (the rotations of a sphere) stay at their start.
    """
    S = start
    for _ in range(_MOST_STEPS):
        moved = S.points(points)
        near = target.closest(moved)
        proposed = icp_step(moved, near, target, with_scale) @ S
        bounded = float(np.clip(np.log(proposed.scale / start.scale), -_MAX_LOG_SCALE, _MAX_LOG_SCALE))
        S = Similarity(start.scale * float(np.exp(bounded)), proposed.R, proposed.t)
        change = np.abs(S.points(points) - moved).max()
        if change < 1e-5 * target.diagonal:
            break
    final = np.sort(target.distance(S.points(points)))
    best = final[: max(1, int(0.8 * len(final)))]
    return Alignment(S, float(np.sqrt((best**2).mean())))


def icp_step(p: Float[ndarray, "n 3"], near: Closest, target: IndexedMesh, with_scale: bool) -> Similarity:
    """One step of `icp`: the small similarity, about their centroid, of points with their nearest ones on the target.

    It moves the points closest to the planes through those.
    """
    spread = _TUKEY * float(np.percentile(near.distance, 100 * _TRUSTED)) / _TRUSTED_SIGMA
    weights = np.clip(1 - (near.distance / max(spread, 1e-9 * target.diagonal)) ** 2, 0, None) ** 2
    normal, total = near.normal, weights.sum()
    if total <= 0:
        return Similarity.identity()
    centroid = weights @ p / total
    local = p - centroid
    size = float(np.sqrt(weights @ (local**2).sum(1) / total)) or 1.0
    local = local / size  # columns without units: rotation, translation and scale have equal weight
    columns = [normal, np.cross(local, normal)]
    if with_scale:
        columns.append((local * normal).sum(1, keepdims=True))
    J = np.concatenate(columns, 1)
    r = ((near.point - p) * normal).sum(1) / size
    H = J.T @ (weights[:, None] * J)
    x = np.linalg.lstsq(H, J.T @ (weights * r), rcond=1e-8)[0]
    R = _rotation(x[3:6])
    scale = float(np.exp(np.clip(x[6], -0.2, 0.2))) if with_scale else 1.0
    return Similarity(scale, R, centroid + size * x[:3] - scale * R @ centroid)


def _rotation(w: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """Rotation by |w| about w, at most 0.5 rad per step."""
    angle = float(np.linalg.norm(w))
    if angle < 1e-300:
        return np.eye(3)
    x, y, z = w / angle
    angle = min(angle, 0.5)
    W = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * W + (1 - np.cos(angle)) * W @ W


# Errors of camera and projector poses against the true ones.


@dataclass(frozen=True)
class DeviceErrors:
    """Errors of one kind of device over all frames; lengths in the truth's unit."""

    translation: Float[ndarray, "n"]
    rotation_deg: Float[ndarray, "n"]

    @property
    def translation_rmse(self) -> float:
        """Root mean square of the frames' position errors."""
        return float(np.sqrt((self.translation**2).mean()))

    @property
    def rotation_rmse_deg(self) -> float:
        """Root mean square of the frames' rotation errors."""
        return float(np.sqrt((self.rotation_deg**2).mean()))


@dataclass(frozen=True)
class PoseErrors:
    """Errors after one common similarity has aligned all estimated devices with the true ones."""

    camera: DeviceErrors
    projector: DeviceErrors
    relative: DeviceErrors  # projector relative to the camera of its frame; needs no alignment except for the scale
    scale_error: float  # estimated lengths are 1 + scale_error times the true ones


def compare_poses(estimated: DevicePoses, true: DevicePoses) -> PoseErrors:
    """Errors of all poses. The gauge (position, orientation and scale of the world) is not an error.

    One map is fitted to all camera and projector centres and orientations together. What remains are contradictions
    between the poses; the scale error is reported separately.
    """
    S = align_poses(estimated.stacked(), true.stacked())
    relative = estimated.T_camera_projector
    relative[:, :3, 3] *= S.scale
    aligned = estimated.mapped(S)
    return PoseErrors(
        camera=_device_errors(aligned.T_world_camera, true.T_world_camera),
        projector=_device_errors(aligned.T_world_projector, true.T_world_projector),
        relative=_device_errors(relative, true.T_camera_projector),
        scale_error=1 / S.scale - 1,
    )


def _device_errors(T: Float[ndarray, "n 4 4"], true_T: Float[ndarray, "n 4 4"]) -> DeviceErrors:
    """Distance of the centres and angle between the orientations, frame by frame."""
    turn = torch.as_tensor(np.swapaxes(true_T[:, :3, :3], -1, -2) @ T[:, :3, :3], dtype=torch.float64)
    return DeviceErrors(
        translation=np.linalg.norm(T[:, :3, 3] - true_T[:, :3, 3], axis=1),
        rotation_deg=np.degrees(log_so3(turn).norm(dim=-1).numpy()),
    )


_ICP_POINTS = 20_000
_SMOOTHED = 4  # number of reference points over which an error colour is averaged


@dataclass(frozen=True)
class MeshReference:
    """A true surface; `observed` are area-uniform points of the part that the scan could observe."""

    surface: IndexedMesh
    observed: Float[ndarray, "m 3"]
    description: str
    start: Similarity | None = None  # where the result lies on it, if that is not where it is in the world

    @property
    def size(self) -> float:
        """Diagonal of the bounding box."""
        return self.surface.diagonal

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from the nearest point on the triangles, observed or not."""
        return self.surface.distance(points)

    def surface_errors(
        self, result: IndexedMesh, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in the frame of the result) from the truth."""
        return self.surface.signed_distance(S_truth_result.points(points))

    def align(
        self, result: IndexedMesh, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool
    ) -> Alignment:
        """ICP of points of the result onto the true triangles."""
        return icp(_thinned(samples), self.surface, start, with_scale)


class PointReference:
    """Measured points, for example from another scanner: a reference, but not exact."""

    def __init__(self, points: Float[ndarray, "m 3"], description: str) -> None:
        self.observed = np.asarray(points, np.float64)
        self.description = description
        self.size = float(np.linalg.norm(np.ptp(self.observed, axis=0)))
        self._tree = KDTree(self.observed)

    def distance(self, points: Float[ndarray, "n 3"]) -> Float[ndarray, "n"]:
        """Distance from the nearest reference point; between the points it cannot fall below their spacing."""
        return np.asarray(self._tree.query(points, workers=-1)[0], np.float64)

    def surface_errors(
        self, result: IndexedMesh, S_truth_result: Similarity, points: Float[ndarray, "n 3"]
    ) -> Float[ndarray, "n"]:
        """Signed distances, for colours, of `points` on the result (in the frame of the result) from the reference.

        Each is a mean over the nearest reference points: how far the result is outside of *them*. The distance to the
        nearest reference point would mostly show the spacing of the points.
        """
        here = S_truth_result.inverse().points(self.observed)
        near = result.closest(here)
        outside = -np.copysign(near.distance, ((here - near.point) * near.normal).sum(1)) * S_truth_result.scale
        return outside[np.asarray(KDTree(here).query(points, k=_SMOOTHED)[1])].mean(1)

    def align(
        self, result: IndexedMesh, samples: Float[ndarray, "n 3"], start: Similarity, with_scale: bool
    ) -> Alignment:
        """ICP of the reference points onto the result's triangles, inverted."""
        found = icp(_thinned(self.observed), result, start.inverse(), with_scale)
        S = found.S_target_source.inverse()
        return Alignment(S, found.residual * S.scale)


Reference = MeshReference | PointReference
"""Something to measure a result against, in world axes and the scan's unit.

`observed` are the points that the result should reach, `size` is the diagonal of the bounding box, `description` is a
sentence for the report.
"""


def mesh_reference(mesh: Mesh, scan: Scan, poses: DevicePoses, samples: int = 100_000, seed: int = 0) -> MeshReference:
    """A true mesh with the part of it that `scan` could observe with `poses` (the true ones, if known).

    Raises UserError if nothing of it could be observed, or if it is probably inside out.
    """
    surface = IndexedMesh(mesh)
    points, normals = surface.sample(samples, seed + 1)
    views = capture_views(scan, poses)
    seen = observable(points, normals, surface, views)
    # Almost nothing of a closed mesh is visible if it is inside out; with flipped normals, much more is.
    few = seen.mean() < 0.05
    if not seen.any() or (few and observable(points, -normals, surface, views).mean() > 4 * seen.mean()):
        raise UserError(
            "no part of the reference mesh is both seen by a camera and lit by its projector\n"
            f"    cause:  it is inside out, in another unit than the scan ({scan.units}), or in other axes\n"
            "    remedy: give a mesh in the world axes and unit of transforms.json, triangles counter-clockwise "
            "from outside"
        )
    return MeshReference(
        surface,
        points[seen],
        f"true mesh; {seen.mean():.0%} of its area is seen by at least one camera while its projector lights it, "
        "and only that part counts for completeness",
    )


def _thinned(points: Float[ndarray, "n 3"]) -> Float[ndarray, "m 3"]:
    """Keep at most `_ICP_POINTS` of the points, evenly spaced."""
    return points[:: max(1, -(-len(points) // _ICP_POINTS))]

"""The whole evaluation of one result: surface against truth, poses against truth, fit to the captures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.alignment import align_poses
from sl_nerfstudio.evaluation.capture_fit import CaptureFit, FitAccumulator, FrameFit, FramePixels, fit_captures
from sl_nerfstudio.evaluation.metrics import SurfaceScore, default_f_distances, score_surface
from sl_nerfstudio.evaluation.observed import observable
from sl_nerfstudio.evaluation.pose_errors import PoseErrors, compare_poses
from sl_nerfstudio.evaluation.reference import MeshReference, Reference
from sl_nerfstudio.evaluation.surface import Surface
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan import Frame, Scan

ALIGNMENTS = ("rigid", "similarity", "none")


@dataclass(frozen=True)
class Poses:
    """Camera and projector poses of all frames of a scan, device to world."""

    T_world_camera: Float[ndarray, "n 4 4"]
    T_world_projector: Float[ndarray, "n 4 4"]

    def stacked(self) -> Float[ndarray, "m 4 4"]:
        """Cameras, then projectors."""
        return np.concatenate([self.T_world_camera, self.T_world_projector])


@dataclass(frozen=True)
class Evaluation:
    """Everything `sl-eval` finds; lengths in `units`, distances from the truth in `truth_units`."""

    units: str
    fit: CaptureFit
    reference: Reference | None
    surface: dict[str, SurfaceScore]  # alignment -> score; empty without a reference
    pose_errors: PoseErrors | None  # of the poses that were evaluated
    initial_pose_errors: PoseErrors | None  # of the scan's own poses, where they are others
    starting_poses: bool  # the scan's own poses were evaluated, not refined ones

    @property
    def truth_units(self) -> str:
        """Unit of distances from the truth: an alignment with scale brings a scan of unknown unit to the truth's."""
        return "units of the truth" if self.units == "arbitrary" else self.units

    @property
    def alignment(self) -> str:
        """The alignment to judge by: rigid, but where nothing says how long a unit is, with scale."""
        return "similarity" if self.units == "arbitrary" else "rigid"


def evaluate(
    mesh: Mesh,
    scan: Scan,
    poses: Poses,
    reference: Reference | None = None,
    true_poses: Poses | None = None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
    on_frame: Callable[[Frame, FrameFit, FramePixels], None] | None = None,
) -> Evaluation:
    """Evaluate `mesh` with `poses` on `scan`.

    `on_frame` is called with each frame's pixels as they pass (for pictures). Raises UserError where the
    mesh cannot belong to the scan.
    """
    surface = Surface(mesh)
    fit = _fit(surface, scan, poses, on_frame)
    initial = Poses(scan.T_world_camera, scan.T_world_projector)
    moved = not np.array_equal(initial.stacked(), poses.stacked())
    scores: dict[str, SurfaceScore] = {}
    if reference is not None:
        # Without true poses the scan's own ones tell where the reference lies: ICP starts from there, too.
        towards = true_poses or (initial if moved else None)
        scores = score_alignments(surface, reference, poses, towards, f_distances, samples, seed)
    return Evaluation(
        units=scan.units,
        fit=fit,
        reference=reference,
        surface=scores,
        pose_errors=_pose_errors(poses, true_poses),
        initial_pose_errors=_pose_errors(initial, true_poses) if moved else None,
        starting_poses=not moved,
    )


def score_alignments(
    surface: Surface,
    reference: Reference,
    poses: Poses | None,
    true_poses: Poses | None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
) -> dict[str, SurfaceScore]:
    """Scores under rigid ICP, under ICP with scale, and as is.

    ICP starts from where the result lies and, with true poses (or others in the reference's world), from the map
    that brings the estimated devices onto those; the better end counts.
    """
    points, _ = surface.sample(samples, seed)
    distances = tuple(f_distances) or default_f_distances(reference.size)
    scores = {}
    for name in ALIGNMENTS:
        S = Similarity.identity()
        if name != "none":
            with_scale = name == "similarity"
            starts = _starts(poses, true_poses, with_scale, points, 1e-6 * surface.diagonal)
            ends = [reference.align(surface, points, start, with_scale) for start in starts]
            S = min(ends, key=lambda end: end.residual).S_target_source
        scores[name] = score_surface(surface, points, reference, S, distances)
    return scores


def _starts(
    poses: Poses | None, true_poses: Poses | None, with_scale: bool, points: Float[ndarray, "n 3"], tolerance: float
) -> list[Similarity]:
    """Where ICP starts from; one start only if the poses say that the result lies where it should."""
    identity = Similarity.identity()
    if poses is None or true_poses is None:
        return [identity]
    by_poses = align_poses(poses.stacked(), true_poses.stacked(), with_scale)
    apart = np.abs(by_poses.points(points) - points).max() > tolerance
    return [identity, by_poses] if apart else [identity]


def mesh_reference(mesh: Mesh, scan: Scan, poses: Poses, samples: int = 100_000, seed: int = 0) -> MeshReference:
    """A true mesh with the part of it that `scan` could observe with `poses` (the true ones, if known)."""
    surface = Surface(mesh)
    points, normals = surface.sample(samples, seed + 1)
    frames = [
        (frame.camera, T_c, scan.projector, T_p)
        for frame, T_c, T_p in zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    ]
    seen = observable(points, normals, surface, frames)
    # A closed mesh that is inside out shows next to nothing; turned round, it shows much more.
    few = seen.mean() < 0.05
    if not seen.any() or (few and observable(points, -normals, surface, frames).mean() > 4 * seen.mean()):
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


def _fit(
    surface: Surface,
    scan: Scan,
    poses: Poses,
    on_frame: Callable[[Frame, FrameFit, FramePixels], None] | None,
) -> CaptureFit:
    fit = FitAccumulator()
    frames = fit_captures(surface, scan, poses.T_world_camera, poses.T_world_projector)
    for frame, figures, pixels in track(frames, "ray casting the frames", total=len(scan.frames)):
        fit.add(figures, pixels)
        if on_frame is not None:
            on_frame(frame, figures, pixels)
    result = fit.result()
    if not any(frame.hit_share > 0 for frame in result.frames):
        raise UserError(_missed(surface, scan, poses))
    return result


def _missed(surface: Surface, scan: Scan, poses: Poses) -> str:
    """Why no ray meets the mesh, as far as sizes and distances tell."""
    distance = float(np.median(np.linalg.norm(poses.T_world_camera[:, :3, 3] - surface.centre, axis=1)))
    return (
        "no camera ray through a masked pixel meets the mesh\n"
        f"    cause:  mesh and poses do not belong together: the mesh measures {surface.diagonal:.4g}, and the cameras "
        f"stand {distance:.4g} from it (median; the scan's unit is {scan.units}); another unit, other axes or "
        "another scan are likely\n"
        "    remedy: give the mesh that was exported from this scan, in its unit and world axes"
    )


def _pose_errors(poses: Poses, true_poses: Poses | None) -> PoseErrors | None:
    if true_poses is None:
        return None
    return compare_poses(
        poses.T_world_camera, poses.T_world_projector, true_poses.T_world_camera, true_poses.T_world_projector
    )

"""The whole evaluation of one result: its surface and poses against the truth, and its agreement with the captures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.alignment import align_poses
from sl_nerfstudio.evaluation.capture_agreement import (
    AgreementAccumulator,
    CaptureAgreement,
    FrameAgreement,
    compare_captures,
)
from sl_nerfstudio.evaluation.completeness.completeness import Completeness, assess_completeness
from sl_nerfstudio.evaluation.frame_pixels import FramePixels
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.metrics import SurfaceScore, default_f_distances, score_surface
from sl_nerfstudio.evaluation.pose_errors import PoseErrors, compare_poses
from sl_nerfstudio.evaluation.reference import Reference
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan import Frame, PoseSigma, Scan
from sl_nerfstudio.threads import one_library_thread
from sl_nerfstudio.verdict.agreement import CrossFrameAgreement
from sl_nerfstudio.verdict.scan_agreement import compare_scan_frames

ALIGNMENTS = ("rigid", "similarity", "none")


@dataclass(frozen=True)
class Evaluation:
    """Everything `sl-eval` finds; lengths in `units`, distances from the truth in `truth_units`."""

    units: str
    agreement: CaptureAgreement
    reference: Reference | None
    surface: dict[str, SurfaceScore]  # alignment -> score; empty without a reference
    pose_errors: PoseErrors | None  # of the poses that were evaluated
    initial_pose_errors: PoseErrors | None  # of the scan's own poses, if others were evaluated
    starting_poses: bool  # the scan's own poses were evaluated, not refined ones
    cross: CrossFrameAgreement | None = None  # of the frames with each other, under the evaluated poses
    completeness: Completeness | None = None
    true_units: str | None = None  # what the truth's files say

    @property
    def truth_units(self) -> str:
        """Unit of distances from the truth; a scan of unknown unit is scaled to that of the truth."""
        if self.units != "arbitrary":
            return self.units
        return self.true_units if self.true_units not in (None, "arbitrary") else "units of the truth"

    @property
    def alignment(self) -> str:
        """The alignment to judge by: rigid, or with scale if the scan's unit is unknown."""
        return "similarity" if self.units == "arbitrary" else "rigid"

    @property
    def comparable(self) -> dict[str, SurfaceScore]:
        """The scores that say something: without a known unit, only the one after an alignment with scale."""
        known = self.units != "arbitrary"
        return {name: score for name, score in self.surface.items() if known or name == "similarity"}


@one_library_thread()
def evaluate(
    mesh: Mesh,
    scan: Scan,
    poses: DevicePoses,
    reference: Reference | None = None,
    true_poses: DevicePoses | None = None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
    on_frame: Callable[[Frame, FrameAgreement, FramePixels], None] | None = None,
    sigma: Sequence[PoseSigma | None] = (),
    true_units: str | None = None,
) -> Evaluation:
    """Evaluate `mesh` with `poses` on `scan`; `sigma` is the stated uncertainty of the poses, if they are rough.

    `true_units`, as the files of the truth state it, names distances where the scan's own unit is unknown. `on_frame`
    is called with each frame and its pixels in turn (to make pictures). Raises UserError if the mesh cannot be a
    surface of this scan.
    """
    surface = IndexedMesh(mesh)
    agreement = _agreement(surface, scan, poses, on_frame)
    initial = scan.poses
    moved = not np.array_equal(initial.stacked(), poses.stacked())
    scores: dict[str, SurfaceScore] = {}
    if reference is not None:
        # Without true poses the scan's own ones show where the reference is: ICP starts from there as well.
        target_poses = true_poses or (initial if moved else None)
        scores = score_alignments(surface, reference, poses, target_poses, f_distances, samples, seed)
    return Evaluation(
        units=scan.units,
        agreement=agreement,
        reference=reference,
        surface=scores,
        pose_errors=compare_poses(poses, true_poses) if true_poses else None,
        initial_pose_errors=compare_poses(initial, true_poses) if true_poses and moved else None,
        starting_poses=not moved,
        cross=compare_scan_frames(scan, poses, sigma or [None] * len(scan.frames)),
        completeness=assess_completeness(surface, agreement),
        true_units=true_units,
    )


def score_alignments(
    surface: IndexedMesh,
    reference: Reference,
    poses: DevicePoses | None,
    true_poses: DevicePoses | None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
) -> dict[str, SurfaceScore]:
    """Scores after rigid ICP, after ICP with scale, and without any alignment.

    ICP starts from where the result is. With true poses (or others in the reference's world) it starts a second time
    from the map of the estimated devices onto those, and the better result counts.
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
    poses: DevicePoses | None,
    true_poses: DevicePoses | None,
    with_scale: bool,
    points: Float[ndarray, "n 3"],
    tolerance: float,
) -> list[Similarity]:
    """Where ICP starts from; a single start if the poses say that the result is already in place."""
    identity = Similarity.identity()
    if poses is None or true_poses is None:
        return [identity]
    by_poses = align_poses(poses.stacked(), true_poses.stacked(), with_scale)
    apart = np.abs(by_poses.points(points) - points).max() > tolerance
    return [identity, by_poses] if apart else [identity]


def _agreement(
    surface: IndexedMesh,
    scan: Scan,
    poses: DevicePoses,
    on_frame: Callable[[Frame, FrameAgreement, FramePixels], None] | None,
) -> CaptureAgreement:
    total = AgreementAccumulator()
    frames = compare_captures(surface, scan, poses)
    for frame, figures, pixels in track(frames, "ray casting the frames", total=len(scan.frames)):
        total.add(figures, pixels)
        if on_frame is not None:
            on_frame(frame, figures, pixels)
    result = total.result()
    if not any(frame.hit_share > 0 for frame in result.frames):
        raise UserError(_missed(surface, scan, poses))
    return result


def _missed(surface: IndexedMesh, scan: Scan, poses: DevicePoses) -> str:
    """Why no ray hits the mesh, as far as sizes and distances show."""
    distance = float(np.median(np.linalg.norm(poses.T_world_camera[:, :3, 3] - surface.centre, axis=1)))
    return (
        "no camera ray through a masked pixel hits the mesh\n"
        f"    cause:  mesh and poses do not match: the mesh measures {surface.diagonal:.4g}, and the cameras are "
        f"{distance:.4g} away from it (median; the scan's unit is {scan.units}); probably another unit, other axes or "
        "another scan\n"
        "    remedy: give the mesh that was exported from this scan, in its unit and world axes"
    )

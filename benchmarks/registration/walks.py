"""Calibration of each frame and registration, against the truth of synthetic scans and on captures with known poses.

    python -m benchmarks.registration [--scenes cone-and-cylinder head frog] [--scans FOLDER ...]

For every scene, a noisy scan is made with sl-synth (200 x 200 pixels, its default noise). Its frames are calibrated one
by one, registered in the order of capture without starting poses, and adjusted jointly. `--scans` adds existing scan
folders; their poses count as the truth if they have no ground_truth/.

It prints the errors of rotation and baseline direction, and how often they are within one stated sigma; and the errors
of rotation, position and scale of the frames after registration and after the bundle adjustment, both after one common
similarity.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy import ndarray

from benchmarks.common.machine import write_rows
from sl_nerfstudio.bundle_adjustment.registered_frames import adjust_registered
from sl_nerfstudio.geometry.lie import DevicePoses, fit_similarity
from sl_nerfstudio.processing.result import exclusion_sentence, uncertainty_sentence
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.scan import Scan, read_ground_truth, read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

FRAMES = {"cone-and-cylinder": 22, "head": 43, "frog": 43}


@dataclass(frozen=True)
class RelativePoseErrors:
    """Errors of the frames' relative poses."""

    rotation_deg_median: float
    rotation_deg_max: float
    direction_deg_median: float
    direction_deg_max: float
    rotation_within_sigma: float  # fraction of the frames
    direction_within_sigma: float
    mahalanobis: float  # mean squared error in units of the covariance, per degree of freedom (5): 1 is exact
    seconds_a_frame: float


@dataclass(frozen=True)
class Poses:
    """Errors of the frames' poses after one similarity; positions in mean camera distances."""

    registered: int
    rotation_deg_median: float
    rotation_deg_max: float
    position_max: float
    scale_max: float  # fraction
    within_target: int  # frames within 2 degrees and 3 %
    seconds: float


@dataclass(frozen=True)
class Row:
    """One scan."""

    scan: str
    projector: str
    frames: int
    relative_pose: RelativePoseErrors
    registration: Poses
    joint: Poses
    not_registered: dict[str, str]
    remarks: tuple[str, ...]


def truth_of(scan: Scan) -> DevicePoses:
    """True poses, or the ones in the file."""
    return read_ground_truth(scan).poses or scan.poses


def relative_poses(scan: Scan, true_relative: ndarray) -> tuple[list[FrameCloud], RelativePoseErrors]:
    """All frames, one by one."""
    from scipy.spatial.transform import Rotation

    from sl_nerfstudio.relative_pose.epipolar import direction_basis

    clouds, rows = [], []
    start = time.process_time()
    for frame, T in zip(scan.frames, true_relative, strict=True):
        coords = frame.read_coords()
        pose = estimate_relative_pose(*correspondences_of(coords), frame.camera, scan.projector)
        clouds.append(frame_cloud(frame.name, coords, frame.camera, scan.projector, pose))
        found, b = pose.T_camera_projector, T[:3, 3] / np.linalg.norm(T[:3, 3])
        w = Rotation.from_matrix(T[:3, :3] @ found[:3, :3].T).as_rotvec()
        swing = np.cross(found[:3, 3], b)
        e = np.concatenate([w, direction_basis(found[:3, 3]).T @ swing])
        rows.append(
            (
                np.degrees(np.linalg.norm(w)),
                np.degrees(np.arctan2(np.linalg.norm(swing), found[:3, 3] @ b)),
                pose.sigma_rotation_deg,
                pose.sigma_direction_deg,
                e @ np.linalg.solve(pose.covariance, e) / 5,
            )
        )
    rotation, direction, sigma_rotation, sigma_direction, distance = np.array(rows).T
    return clouds, RelativePoseErrors(
        float(np.median(rotation)),
        float(rotation.max()),
        float(np.median(direction)),
        float(direction.max()),
        float((rotation < sigma_rotation).mean()),
        float((direction < sigma_direction).mean()),
        float(distance.mean()),
        (time.process_time() - start) / len(clouds),
    )


@dataclass(frozen=True)
class FrameErrors:
    """Errors of registered frames after one common similarity."""

    rotation_deg: ndarray
    position: ndarray  # in mean distances of the cameras from their centre
    scale: ndarray  # fraction

    @property
    def right(self) -> ndarray:
        """Frames within 2 degrees and 3 %."""
        return (self.rotation_deg < 2) & (self.scale < 0.03)


def frame_errors(T_camera: ndarray, baseline: ndarray, truth: DevicePoses) -> FrameErrors:
    """Errors of registered frames after one similarity that fits cameras and the places they look at.

    `truth` holds the true poses of cameras and projectors.
    """
    from scipy.spatial.transform import Rotation

    known = np.isfinite(baseline)
    true = truth.T_world_camera[known]
    true_baseline = truth.baseline[known]
    found, length = T_camera[known], baseline[known]
    ahead = np.linalg.norm(true[:, :3, 3] - true[:, :3, 3].mean(0), axis=1).mean()
    ratio = float(np.exp(np.mean(np.log(true_baseline / length))))
    ends = [
        np.concatenate([T[:, :3, 3], T[:, :3, 3] - unit * ahead * T[:, :3, 2]])
        for T, unit in ((found, 1 / ratio), (true, 1.0))
    ]
    found = fit_similarity(ends[0], ends[1]).poses(found)
    turn = np.degrees(Rotation.from_matrix(np.swapaxes(true[:, :3, :3], 1, 2) @ found[:, :3, :3]).magnitude())
    shift = np.linalg.norm(found[:, :3, 3] - true[:, :3, 3], axis=1) / ahead
    return FrameErrors(turn, shift, np.abs(length * ratio / true_baseline - 1))


def summary_of(errors: FrameErrors, seconds: float) -> Poses:
    """Medians and largest values."""
    return Poses(
        len(errors.scale), float(np.median(errors.rotation_deg)), float(errors.rotation_deg.max()),
        float(errors.position.max()), float(errors.scale.max()), int(errors.right.sum()), seconds,
    )  # fmt: skip


def measure(root: Path, sequence: bool = True) -> Row:
    """Estimate relative poses, register, adjust."""
    scan = read_scan(root)
    truth = truth_of(scan)
    clouds, relative = relative_poses(scan, truth.T_camera_projector)
    start = time.process_time()
    found = register(clouds, sequence)
    middle = time.process_time()
    joint = adjust_registered(clouds, found)
    end = time.process_time()
    return Row(
        root.name,
        scan.projector.model,
        len(clouds),
        relative,
        summary_of(frame_errors(found.T_world_camera, found.baseline, truth), middle - start),
        summary_of(frame_errors(joint.poses.T_world_camera, joint.poses.baseline, truth), end - middle),
        {e.frame: exclusion_sentence(e) for e in found.exclusions},
        tuple(map(uncertainty_sentence, found.uncertainties)),
    )


def text_of(row: Row) -> str:
    """A few lines."""
    c = row.relative_pose
    lines = [
        f"{row.scan} ({row.frames} frames, {row.projector})",
        f"  relative pose rotation {c.rotation_deg_median:.3f} deg (max {c.rotation_deg_max:.3f}), direction "
        f"{c.direction_deg_median:.3f} deg (max {c.direction_deg_max:.3f}); within 1 sigma "
        f"{c.rotation_within_sigma:.0%} and {c.direction_within_sigma:.0%}, squared error over "
        f"covariance {c.mahalanobis:.2f}; {c.seconds_a_frame:.2f} s per frame",
    ]
    for name, p in (("registration", row.registration), ("joint", row.joint)):
        lines.append(
            f"  {name:13} {p.registered} registered, {p.within_target} within 2 deg and 3 %; rotation "
            f"{p.rotation_deg_median:.3f} deg (max {p.rotation_deg_max:.3f}), position max {p.position_max:.2%}, scale "
            f"max {p.scale_max:.2%}; {p.seconds:.0f} s"
        )
    lines += [f"  not registered: {name}: {why}" for name, why in row.not_registered.items()]
    return "\n".join(lines + [f"  {remark}" for remark in row.remarks])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="*", default=list(FRAMES), choices=FRAMES)
    parser.add_argument("--scans", nargs="*", type=Path, default=[], help="existing scan folders")
    parser.add_argument("--projector-model", choices=["OPENCV", "DOE"], default="OPENCV")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--resolution", type=int, default=200)
    parser.add_argument("--unordered", action="store_true", help="frames were not taken in order")
    parser.add_argument(
        "--folder", type=Path, default=Path("outputs/registration"), help="folder of the scans made here"
    )
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/registration.json"))
    options = parser.parse_args(arguments)
    roots = list(options.scans)
    for scene in options.scenes:
        root = options.folder / f"{scene}-{options.projector_model}-{options.resolution}-{options.seed}"
        if not root.exists():
            synthesise(
                SynthConfig(
                    scene=scene,
                    frames=FRAMES[scene],
                    resolution=options.resolution,
                    supersampling=1,  # coordinates do not depend on it
                    seed=options.seed,
                    projector_model=options.projector_model,
                ),
                root,
            )
        roots.append(root)
    rows: list[Row] = []
    for root in roots:
        rows.append(measure(root, not options.unordered))
        print(text_of(rows[-1]), flush=True)
        write_rows(options.output, rows, sequence=not options.unordered)


if __name__ == "__main__":
    main()

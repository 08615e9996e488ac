"""Decisive settings of the stages that find poses, each over a range around its default.

    python -m benchmarks.sensitivity.settings_sweep [--settings registration.pair.tolerance_sigmas ...] [--frames 14]

Six scans of sl-synth with twice its default noise, wrong and missing coordinates (200 x 200 pixels); their
coordinates are taken as decoded, so no network is needed. One setting at a time differs from its default. The table,
and benchmarks/results/settings_sweep.json, give the number of right frames (within 2 degrees, and 3 % of the baseline's
length) and the median error of the cameras, after one common similarity.

Settings of relative pose estimation and registration are judged by the registered poses, those of bundle adjustment by
the adjusted ones.
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from benchmarks.common.machine import write_rows
from benchmarks.registration.walks import FrameErrors, frame_errors, truth_of
from sl_nerfstudio.bundle_adjustment.registered_frames import (
    RegisteredFramesSettings,
    adjust_registered,
)
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.settings import RegistrationSettings
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import RelativePoseSettings, correspondences_of
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from sl_nerfstudio.scan import read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

SCENES = ("cone-and-cylinder", "head", "frog")
NOISE, MISSING, WRONG = 0.6, 0.3, 0.04
T = TypeVar("T")


@dataclass(frozen=True)
class StageSettings:
    """Settings of all stages; the names in `SWEEPS` begin with these fields."""

    relative_pose: RelativePoseSettings = field(default_factory=RelativePoseSettings)
    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    bundle_adjustment: RegisteredFramesSettings = field(default_factory=RegisteredFramesSettings)


SWEEPS: dict[str, tuple[float, ...]] = {
    "relative_pose.five_point.samples": (10, 30, 100, 300),
    "relative_pose.fit.kernel_sigmas": (2.0, 3.0, 4.0, 6.0),
    "relative_pose.inlier_sigmas": (3.0, 4.0, 6.0),
    "relative_pose.candidates.rival_share": (0.01, 0.03, 0.06),
    "registration.pair.tolerance_sigmas": (3.0, 4.0, 6.0),
    "registration.pair.common_rms": (1.5, 2.5, 4.0),
    "registration.pair.scale_sigma": (0.1, 0.25, 0.5),
    "registration.assembly.misfit_factor": (1.5, 2.5, 4.0),
    "registration.assembly.largest_rival": (0.7, 0.85, 0.95),
    "registration.edge.fitness_scale": (0.025, 0.035, 0.05, 0.07, 0.1),
    "registration.pose_graph.kernel_chi2": (20.0, 40.0, 80.0),
    "bundle_adjustment.adjustment.anchors_per_frame": (150, 300, 600, 1200),
    "bundle_adjustment.adjustment.frames_per_anchor": (2, 4, 8, 13),
}
"""Path of each setting, and its values; the default is among them."""


@dataclass(frozen=True)
class Row:
    """One value of one setting, over all scans."""

    setting: str
    value: float
    default: bool
    right_frames: tuple[int, ...]  # of each scan
    rotation_deg: float  # median over all registered frames of all scans
    position: float  # the same, in mean distances of the cameras from their centre


def value_at(settings: Any, path: str) -> Any:
    """The setting of a path such as "registration.pair.tolerance_sigmas"."""
    for name in path.split("."):
        settings = getattr(settings, name)
    return settings


def changed(settings: T, path: str, value: Any) -> T:
    """The settings with another value at a path."""
    name, _, rest = path.partition(".")
    part = changed(getattr(settings, name), rest, value) if rest else value
    return replace(settings, **{name: part})  # pyright: ignore[reportCallIssue, reportArgumentType, reportType]


@cache
def clouds_of(root: Path, settings: RelativePoseSettings) -> list[FrameCloud]:
    """Frames of a scan whose relative pose is found."""
    scan, out = read_scan(root), []
    for frame in scan.frames:
        coords = frame.read_coords()
        uv = correspondences_of(coords)
        try:
            pose = estimate_relative_pose(*uv, frame.camera, scan.projector, settings=settings)
            out.append(frame_cloud(frame.name, coords, frame.camera, scan.projector, pose))
        except RelativePoseError:
            continue
    return out


@cache
def registered(
    root: Path, relative_pose: RelativePoseSettings, registration: RegistrationSettings
) -> tuple[list[FrameCloud], Registration]:
    """Frames whose relative pose is found, and their registration."""
    clouds = clouds_of(root, relative_pose)
    return clouds, register(clouds, settings=registration)


@cache
def errors_of(root: Path, settings: StageSettings, adjusted: bool) -> FrameErrors:
    """Errors of the registered frames of a scan, before or after bundle adjustment; none where fewer than two are."""
    clouds, found = registered(root, settings.relative_pose, settings.registration)
    if found.registered.sum() < 2:
        return FrameErrors(*np.zeros((3, 0)))
    scan = read_scan(root)
    number = {frame.name: k for k, frame in enumerate(scan.frames)}
    truth = truth_of(scan)[[number[cloud.name] for cloud in clouds]]
    if not adjusted:
        return frame_errors(found.T_world_camera, found.baseline, truth)
    poses = adjust_registered(clouds, found, settings.bundle_adjustment).poses
    return frame_errors(poses.T_world_camera, poses.baseline, truth)


def measure(roots: Sequence[Path], path: str, value: float) -> Row:
    """All scans with one setting changed."""
    default = StageSettings()
    adjusted = path.startswith("bundle_adjustment.")
    errors = [errors_of(root, changed(default, path, value), adjusted) for root in roots]
    rotation, position = (np.concatenate([getattr(e, key) for e in errors]) for key in ("rotation_deg", "position"))
    return Row(
        path, value, value == value_at(default, path), tuple(int(e.right.sum()) for e in errors),
        float(np.median(rotation)), float(np.median(position)),
    )  # fmt: skip


def scans(folder: Path, frames: int, resolution: int, seeds: Sequence[int]) -> list[Path]:
    """The scans, made where they are not there yet."""
    roots = []
    for scene, seed in product(SCENES, seeds):
        root = folder / f"{scene}-{frames}-{resolution}-{seed}"
        if not (root / "transforms.json").exists():
            config = SynthConfig(
                scene=scene, frames=frames, resolution=resolution, supersampling=1, seed=seed,
                noise=NOISE, missing=MISSING, wrong=WRONG,
            )  # fmt: skip
            synthesise(config, root)
        roots.append(root)
    return roots


def text_of(row: Row) -> str:
    """One line of the table."""
    return (
        f"{row.setting:48} {row.value:7g}{'*' if row.default else ' '} | {sum(row.right_frames):3} right "
        f"({' '.join(map(str, row.right_frames))}) | "
        f"{row.rotation_deg:.3f} deg {row.position:.3%}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", default=list(SWEEPS), choices=SWEEPS)
    parser.add_argument("--frames", type=int, default=14, help="of each scan")
    parser.add_argument("--resolution", type=int, default=200)
    parser.add_argument("--seeds", nargs="+", type=int, default=[1, 2], help="of the scans")
    parser.add_argument("--folder", type=Path, default=Path("outputs/settings_sweep"), help="for the scans; made once")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/settings_sweep.json"))
    options = parser.parse_args(arguments)
    roots = scans(options.folder, options.frames, options.resolution, options.seeds)
    rows: list[Row] = []
    for path in options.settings:
        for value in SWEEPS[path]:
            rows.append(measure(roots, path, value))
            print(text_of(rows[-1]), flush=True)
            write_rows(options.output, rows, scans=[root.name for root in roots])


if __name__ == "__main__":
    main()

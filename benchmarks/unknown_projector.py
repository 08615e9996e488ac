"""Projectors that nobody has calibrated: intrinsics and surface, found against known.

    python -m benchmarks.unknown_projector [--sets 4] [--output FILE]

Free-hand sets under a projector with lens shift, whose starting focal length is 20 % wrong and whose principal point
counts as the middle of its image. Each set is processed with the true intrinsics and with those that are found: poses,
registration, joint adjustment. The surface is the triangulated points after one similarity onto the truth.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from benchmarks.common.measuring import Rows, options
from sl_nerfstudio.calibration.stated import CERTAIN
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses, fit_similarity
from sl_nerfstudio.processing.consistency import ConsistentFrames, adjust_consistent
from sl_nerfstudio.processing.projector import FoundProjector, adjustment_settings, refine_projector, sigma_of_fields
from sl_nerfstudio.registration.register import choose_projectors, chosen_clouds, register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, directions
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.relative_pose.intrinsics import camera_depth
from sl_nerfstudio.relative_pose.unknown_projector import FrameMatches, NoProjector, estimate_projector
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import (
    CoordinateNoise,
    DevicePair,
    disturb_coords,
    make_devices,
    make_paths,
    pixels,
)
from sl_nerfstudio.synthesis.render import FrameGeometry, RayCaster, visible_centres
from sl_nerfstudio.synthesis.scenes import make_scene
from sl_nerfstudio.synthesis.synthesise import make_cells

PATTERN, _RESOLUTION = (1280, 800), 400
NOISE = CoordinateNoise(sigma=0.3, missing=0.15, wrong=0.02)


@dataclass(frozen=True)
class SetOptions:
    """One set."""

    scene: str
    seed: int
    frames: int
    shift: float = 1.2  # of the principal point below the middle of the image, in image heights
    aspect: float = 1.0  # fl_y over fl_x
    k1: float = 0.0


@dataclass(frozen=True)
class CoordinateSet:
    """Decoded coordinates of all frames, with the truth; lengths in millimetres."""

    devices: DevicePair
    coords: tuple[Float32[ndarray, "h w 2"], ...]  # as decoded; NaN where nothing was
    p_world: tuple[Float64[ndarray, "h w 3"], ...]  # what every pixel sees


def make_set(options: SetOptions) -> CoordinateSet:
    """Render one set."""
    scene = make_scene(options.scene, 1.0)
    poses = make_paths(scene, options.frames, "hand-held", np.random.default_rng([options.seed, 1]))
    devices = make_devices(scene, poses, PATTERN, SynthConfig(resolution=_RESOLUTION))
    projector, poses = _with_shift(devices.projector, poses, scene.vertices[::20], options)
    devices = DevicePair(devices.camera, projector)
    caster, cells = RayCaster(scene), make_cells(np.zeros(PATTERN[::-1], np.float32), None)
    coords, points = [], []
    for k in range(options.frames):
        seen = visible_centres(FrameGeometry(caster, devices, poses.T_world_camera[k], poses.T_world_projector[k]))
        shape = devices.camera.h, devices.camera.w
        exact = seen.coords(devices.camera)
        rng = np.random.default_rng([options.seed, 2, k])
        coords.append(disturb_coords(exact, seen.lit.reshape(shape), cells, NOISE, rng))
        points.append(seen.p_world.reshape(*shape, 3))
    return CoordinateSet(devices, tuple(coords), tuple(points))


def _with_shift(
    projector: Device, poses: DevicePoses, p_world: Float64[ndarray, "n 3"], options: SetOptions
) -> tuple[Device, DevicePoses]:
    """The projector with lens shift, turned so that its image stays where it was and the object fills 90 % of it."""
    middle = np.array([projector.w / 2, projector.h / 2])
    device = replace(projector, cy=projector.h * (0.5 + options.shift), k1=options.k1)
    for _ in range(10):
        device = replace(device, fl_y=device.fl_x * options.aspect)
        turn = np.eye(4)
        angle = np.arctan2(device.cy - middle[1], device.fl_y)  # from the axis to the middle of the image
        turn[:3, :3] = Rotation.from_euler("x", -angle).as_matrix()
        turned = poses.T_world_projector @ turn
        reach = max(float((np.abs(pixels(device, T, p_world)[0] - middle) / middle).max()) for T in turned)
        if abs(reach - 0.9) < 1e-3:
            break
        device = replace(device, fl_x=device.fl_x * 0.9 / reach)
    return device, replace(poses, T_world_projector=turned)


SETS = (
    SetOptions("head", 1, 16), SetOptions("frog", 2, 16), SetOptions("cone-and-cylinder", 3, 16),
    SetOptions("dog", 4, 20), SetOptions("chair", 5, 16), SetOptions("head", 6, 16, aspect=0.97, k1=-0.03),
)  # fmt: skip
_START = 1.2  # of the true focal length


@dataclass(frozen=True)
class Row:
    """Figures of one set: errors in percent and pixels, each with the stated sigma."""

    scene: str
    seed: int
    frames: int
    focal_percent: float  # error of fl_x from the epipolar geometry
    focal_sigma_percent: float
    centre_px: tuple[float, float]
    centre_sigma_px: tuple[float, float]
    adjusted_focal_percent: float  # after the joint adjustment
    adjusted_focal_sigma_percent: float
    adjusted_centre_px: tuple[float, float]
    adjusted_centre_sigma_px: tuple[float, float]
    surface_known_mm: float  # RMS of 95 % of the points, with the true intrinsics
    surface_found_mm: float
    ratio: float


def main() -> None:
    """Run, print and write the first sets, by default all."""
    given = options(__doc__, sets=len(SETS), output=Path("benchmarks/results/unknown_projector.json"))
    rows: Rows[Row] = Rows(given.output, start=_START)
    for one in SETS[: given.sets]:
        rows.add(run(one))


def run(options: SetOptions) -> Row:
    """Process one set with the true intrinsics, and with those that are found."""
    made = make_set(options)
    true = made.devices.projector
    known = surface_error(made, *processed(made, true, None))
    w, h = true.w, true.h
    start = Device(w, h, _START * true.fl_x, _START * true.fl_x, w / 2, h / 2)
    frames = [FrameMatches(str(k), *correspondences_of(uv), made.devices.camera) for k, uv in enumerate(made.coords)]
    estimate = estimate_projector(frames, start, True)
    if isinstance(estimate, NoProjector):
        raise SystemExit(f"{options}: {estimate}")
    sigma = sigma_of_fields(estimate.projector, estimate.covariance)
    found = FoundProjector(estimate.projector, sigma, len(estimate.frames), estimate.noise_px, "epipolar geometry")
    clouds, consistent = processed(made, found.projector, found)
    settings = adjustment_settings("free", found)
    clouds, consistent, refined = refine_projector(clouds, consistent, found, CERTAIN, settings, lambda _: None)
    error = surface_error(made, clouds, consistent)
    return Row(options.scene, options.seed, options.frames, *_errors(found, true), *_errors(refined, true),
               round(known, 5), round(error, 5), round(error / known, 3))  # fmt: skip


def _errors(found: FoundProjector, true: Device) -> tuple[float, float, tuple[float, float], tuple[float, float]]:
    device, sigma = found.projector, found.sigma
    return (
        round(100 * (device.fl_x / true.fl_x - 1), 4), round(100 * sigma[0] / true.fl_x, 4),
        (round(device.cx - true.cx, 2), round(device.cy - true.cy, 2)), (round(sigma[2], 2), round(sigma[3], 2)),
    )  # fmt: skip


def processed(
    made: CoordinateSet, projector: Device, found: FoundProjector | None
) -> tuple[Sequence[FrameCloud], ConsistentFrames]:
    """Relative poses, registration and joint adjustment, as `sl-process` does them."""
    camera, clouds = made.devices.camera, []
    for k, coords in enumerate(made.coords):
        pose = estimate_relative_pose(*correspondences_of(coords), camera, projector)
        clouds.append(frame_cloud(f"{k:03d}", coords, camera, projector, pose))
    choice = choose_projectors(clouds, True, 0)
    clouds = chosen_clouds(clouds, choice.chosen)
    return clouds, adjust_consistent(clouds, register(clouds), lambda _: None, adjustment_settings("free", found))


def surface_error(made: CoordinateSet, clouds: Sequence[FrameCloud], consistent: ConsistentFrames) -> float:
    """RMS distance of the better 95 % of all points from the truth, after one similarity; millimetres."""
    ours, theirs = [], []
    poses = consistent.adjusted.poses
    for k in np.flatnonzero(consistent.registration.registered):
        p, place = _points(clouds[k], poses.T_camera_projector[k])
        ours.append(p @ poses.T_world_camera[k, :3, :3].T + poses.T_world_camera[k, :3, 3])
        theirs.append(made.p_world[k][place])
    a, b = np.concatenate(ours), np.concatenate(theirs)
    good = np.isfinite(a).all(1) & np.isfinite(b).all(1)
    a, b = a[good], b[good]
    for _ in range(3):
        distance = np.linalg.norm(fit_similarity(a, b).points(a) - b, axis=1)
        keep = distance <= np.quantile(distance, 0.95)
        S = fit_similarity(a[keep], b[keep])
        distance = np.linalg.norm(S.points(a) - b, axis=1)
    return float(np.sqrt((np.sort(distance)[: int(0.95 * len(distance))] ** 2).mean()))


def _points(cloud: FrameCloud, T: Float64[ndarray, "4 4"]) -> tuple[Float64[ndarray, "n 3"], tuple[ndarray, ndarray]]:
    uv_camera, uv_projector = correspondences_of(cloud.coords)
    d = directions(cloud.camera, uv_camera)
    depth = camera_depth(T[:3, :3], T[:3, 3], d, directions(cloud.projector, uv_projector))
    column, row = np.floor(uv_camera).astype(np.int64).T
    return d * depth[:, None], (row, column)


if __name__ == "__main__":
    main()

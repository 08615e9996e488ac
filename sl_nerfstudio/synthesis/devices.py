"""Devices that fit a scene, their paths around it, and the errors of poses, coordinates and images."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Float64, Int64, UInt8
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import DevicePoses, exp_so3, fit_similarity, log_so3
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.synthesis.config import PathKind, SynthConfig
from sl_nerfstudio.synthesis.sdf import Scene

# Intrinsics: the object fills the image, and the pattern covers the object.

_CAMERA_FILL = 0.92  # of half the image, reached by the object in the frame where it extends farthest
_PATTERN_FILL = 0.88


@dataclass(frozen=True)
class DevicePair:
    """The camera and the projector of a scan."""

    camera: Device
    projector: Device


def make_devices(scene: Scene, poses: DevicePoses, pattern_size: tuple[int, int], config: SynthConfig) -> DevicePair:
    """A square camera and a projector of the pattern's (w, h), zoomed so that the whole object is in every frame."""
    n, (w, h) = config.resolution, pattern_size
    # principal points slightly off the middle, as in real devices
    camera = Device(n, n, 1.0, 1.0, 0.503 * n, 0.496 * n, *config.camera_distortion)
    projector = Device(w, h, 1.0, 1.0, 0.498 * w, 0.505 * h, *config.projector_distortion, config.projector_model)
    return DevicePair(
        _zoomed(camera, scene, poses.T_world_camera, _CAMERA_FILL),
        _zoomed(projector, scene, poses.T_world_projector, _PATTERN_FILL),
    )


def _zoomed(device: Device, scene: Scene, T_world_device: Float[ndarray, "n 4 4"], fill: float) -> Device:
    """The device with the focal length at which the object extends to `fill` of half the image."""
    some = scene.vertices[:: max(1, len(scene.vertices) // 2000)]
    reach = 0.0
    for T in T_world_device:
        out = np.abs(pixels(device, T, some)[0] - (device.cx, device.cy)) / (device.w / 2, device.h / 2)
        reach = max(reach, float(out.max()))
    return replace(device, fl_x=fill / reach, fl_y=fill / reach)


def rays(device: Device, T_world_device: Float[ndarray, "4 4"], uv: Float[ndarray, "n 2"]) -> Float64[ndarray, "n 3"]:
    """Unit directions in the world of the rays through pixels."""
    directions = unproject(Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(uv, np.float64)))
    return directions.numpy() @ T_world_device[:3, :3].T


def pixels(
    device: Device, T_world_device: Float[ndarray, "4 4"], p_world: Float[ndarray, "n 3"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pixels of points in the world, and whether each is in front of the device and inside its image."""
    p_device = (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]
    uv, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p_device))
    x, y = uv.numpy().T
    inside = in_front.numpy() & (x >= 0) & (y >= 0) & (x < device.w) & (y < device.h)
    return uv.numpy(), inside


# Poses of camera and projector in each frame: smooth paths around the object, as if hand-held.

DISTANCE = 4.5  # of the devices from the object, in sizes of the object
_DISTANCE_SWING = 0.06
_BASELINE = (0.75, 1.5)  # in sizes of the object
_AIM_SWING = 0.03  # how far a device aims off the centre, in sizes of the object
_CAMERA_ROLL, _PROJECTOR_ROLL = np.radians(25.0), np.radians(35.0)
_FRAMES_A_LAP = 30


def make_paths(scene: Scene, frames: int, kind: PathKind, rng: np.random.Generator) -> DevicePoses:
    """Poses of `frames` captures, in millimetres, about the scene's centre.

    hand-held: both devices move independently, so their relative pose differs in every frame; half-turn: likewise, but
    around half of the object; rigid-rig: one relative pose for all; static-projector: the projector does not move, the
    camera circles around the projector's axis.
    """
    t = np.arange(frames) / frames
    if kind == "static-projector":
        return _about_a_projector(scene, t, rng)
    laps = 0.5 if kind == "half-turn" else float(max(1, round(frames / _FRAMES_A_LAP)))
    camera = _around_the_object(scene, t, laps, rng)
    if kind == "rigid-rig":
        return DevicePoses(camera, camera @ _rig(scene))
    return DevicePoses(camera, _beside(scene, camera, t, rng))


def look_at(
    position: Float[ndarray, "*n 3"],
    target: Float[ndarray, "*#n 3"],
    roll: Float[ndarray, "*n"],
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> Float64[ndarray, "*n 4 4"]:
    """Pose of a device at `position` that looks at `target`; `roll` (radians) rotates it about its axis."""
    back = position - target
    back = back / np.linalg.norm(back, axis=-1, keepdims=True)
    # looking straight up or down, any horizontal direction may be "up"
    upwards = np.where(np.abs(back @ up)[..., None] > 0.999, [0.0, 1.0, 0.0], up)
    right = np.cross(upwards, back)
    right = right / np.linalg.norm(right, axis=-1, keepdims=True)
    above = np.cross(back, right)
    c, s = np.cos(roll)[..., None], np.sin(roll)[..., None]
    T = np.zeros((*back.shape[:-1], 4, 4))
    T[..., :3, 0] = c * right + s * above
    T[..., :3, 1] = c * above - s * right
    T[..., :3, 2] = back
    T[..., :3, 3] = position
    T[..., 3, 3] = 1.0
    return T


def wander(t: Float[ndarray, "n"], rng: np.random.Generator, cycles: float = 3.0) -> Float[ndarray, "n"]:
    """A smooth random function of `t` in [0, 1], with values in [-1, 1] and up to about `cycles` oscillations."""
    k = np.arange(1, 5)
    frequency = cycles * k / 4
    phase = rng.uniform(0, 2 * np.pi, 4)
    weight = rng.uniform(0.5, 1.0, 4)
    waves = np.sin(2 * np.pi * frequency * t[:, None] + phase)
    return waves @ weight / weight.sum()


def _direction(azimuth: Float[ndarray, "n"], elevation: Float[ndarray, "n"]) -> Float[ndarray, "n 3"]:
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], -1)


def _distance(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> Float[ndarray, "n"]:
    return DISTANCE * scene.size * (1 + _DISTANCE_SWING * wander(t, rng))


def _aim(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> Float[ndarray, "n 3"]:
    swing = np.stack([wander(t, rng, 4.0) for _ in range(3)], -1)
    return scene.centre + _AIM_SWING * scene.size * swing


def _around_the_object(
    scene: Scene, t: Float[ndarray, "n"], laps: float, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Laps around the object, up and down between the scene's lowest and highest elevation."""
    azimuth = rng.uniform(0, 2 * np.pi) + 2 * np.pi * laps * t + np.radians(4.0) * wander(t, rng, 5.0)
    low, high = np.radians(scene.elevation_deg)
    swing = np.sin(2 * np.pi * (2 * laps + 0.5) * t + rng.uniform(0, 2 * np.pi))
    height = np.clip(0.85 * swing + 0.3 * wander(t, rng), -1, 1)
    elevation = (low + high) / 2 + (high - low) / 2 * height
    position = scene.centre + _distance(scene, t, rng)[:, None] * _direction(azimuth, elevation)
    return look_at(position, _aim(scene, t, rng), _CAMERA_ROLL * wander(t, rng, 4.0))


def _beside(
    scene: Scene, T_world_camera: Float64[ndarray, "n 4 4"], t: Float[ndarray, "n"], rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """A projector in the other hand: its distance from the camera and its side change all the time."""
    offset = T_world_camera[:, :3, 3] - scene.centre
    camera_distance = np.linalg.norm(offset, axis=-1)
    distance = _distance(scene, t, rng)
    shortest, longest = np.array(_BASELINE) * scene.size
    baseline = (shortest + longest) / 2 + (longest - shortest) / 2 * np.clip(1.3 * wander(t, rng, 4.0), -1, 1)
    side = rng.choice([-1.0, 1.0])
    bearing = side * np.radians(80.0 + 60.0 * wander(t, rng, 3.0))  # 0: the projector is above the camera
    cos = (camera_distance**2 + distance**2 - baseline**2) / (2 * camera_distance * distance)
    angle = np.arccos(np.clip(cos, -1, 1))
    out = offset / camera_distance[:, None]
    position = scene.centre + distance[:, None] * _tilt(out, angle, bearing)
    return look_at(position, _aim(scene, t, rng), _PROJECTOR_ROLL * wander(t, rng, 3.0))


def _tilt(
    out: Float[ndarray, "n 3"], angle: Float[ndarray, "n"], bearing: Float[ndarray, "n"]
) -> Float[ndarray, "n 3"]:
    """Unit directions `angle` away from `out`, towards `bearing` (0 is up, clockwise seen from outside)."""
    T = look_at(out, np.zeros(3), np.zeros(len(out)))
    towards = np.cos(bearing)[:, None] * T[:, :3, 1] + np.sin(bearing)[:, None] * T[:, :3, 0]
    return np.cos(angle)[:, None] * out + np.sin(angle)[:, None] * towards


def _rig(scene: Scene) -> Float64[ndarray, "4 4"]:
    """The projector relative to the camera: to the right and slightly above, aimed at the object."""
    position, target = (np.array(p) * scene.size for p in ((1.0, 0.25, 0.0), (0.0, 0.0, -DISTANCE)))
    return look_at(position, target, np.zeros(()), up=(0.0, 1.0, 0.0))


def _about_a_projector(scene: Scene, t: Float[ndarray, "n"], rng: np.random.Generator) -> DevicePoses:
    """A projector that does not move, and a camera that circles around its axis, nearer and farther."""
    azimuth, elevation = np.array([rng.uniform(0, 2 * np.pi)]), np.radians([50.0])
    out = _direction(azimuth, elevation)
    projector = look_at(scene.centre + DISTANCE * scene.size * out, scene.centre, np.radians([rng.uniform(-20, 20)]))
    laps = max(2, round(len(t) / 12))
    angle = np.radians(22.0 + 10.0 * wander(t, rng))
    bearing = rng.uniform(0, 2 * np.pi) + 2 * np.pi * laps * t
    direction = _tilt(np.broadcast_to(out, (len(t), 3)), angle, bearing)
    position = scene.centre + _distance(scene, t, rng)[:, None] * direction
    camera = look_at(position, _aim(scene, t, rng), _CAMERA_ROLL * wander(t, rng, 4.0))
    return DevicePoses(camera, np.repeat(projector, len(t), axis=0))


# Errors of the starting poses, like those of auto-calibration and registration; nothing here renders.
#
# Auto-calibration has errors in the pose of a projector relative to its camera: rotation, direction and length of the
# baseline. The frame's triangulated points are then slightly deformed and have a wrong size, and registration aligns
# *them* with the others: a baseline 2 % too long moves camera and projector about 2 % away from the object. The error
# of registration itself moves a frame as a whole and rotates it about the object.

_FEWEST_POINTS = 20  # with fewer, a frame is not registered again


@dataclass(frozen=True)
class PoseNoise:
    """Root mean squares over the frames; every scan has exactly these values."""

    rotation_deg: float  # of a frame about the object
    translation: float  # of a frame, at the object, millimetres
    relative_rotation_deg: float  # projector relative to camera
    baseline_direction_deg: float
    baseline_length: float  # as a fraction
    first_baseline_exact: bool = True

    @property
    def is_zero(self) -> bool:
        """Whether the poses stay exact."""
        return not (self.rotation_deg or self.translation or self.disturbs_relative)

    @property
    def disturbs_relative(self) -> bool:
        """Whether auto-calibration has errors."""
        return bool(self.relative_rotation_deg or self.baseline_direction_deg or self.baseline_length)


@dataclass(frozen=True)
class ExactMatches:
    """Exact matches of one frame, with which its disturbed points are registered."""

    uv_camera: Float[ndarray, "n 2"]
    uv_projector: Float[ndarray, "n 2"]
    p_world: Float[ndarray, "n 3"]


def disturb_poses(
    truth: DevicePoses,
    noise: PoseNoise,
    centre: Float[ndarray, "3"],
    devices: DevicePair,
    matches: list[ExactMatches],
    rng: np.random.Generator,
) -> DevicePoses:
    """Starting poses: errors of auto-calibration, registration of the resulting points, errors of registration."""
    if noise.is_zero:
        return truth
    calibrated = disturb_relative(truth.T_camera_projector, noise, rng)
    camera = truth.T_world_camera.copy()
    if noise.disturbs_relative:
        for n, match in enumerate(matches):
            camera[n] = _registered(camera[n], calibrated[n], devices, match)
    motion = _motions_about(centre, len(camera), noise, rng)
    camera = motion @ camera
    return DevicePoses(camera, camera @ calibrated)


def disturb_relative(
    T_camera_projector: Float64[ndarray, "n 4 4"], noise: PoseNoise, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Auto-calibration errors. Those of the logarithms of the lengths have mean zero."""
    n = len(T_camera_projector)
    out = T_camera_projector.copy()
    out[:, :3, :3] = T_camera_projector[:, :3, :3] @ _rotations(np.radians(noise.relative_rotation_deg), n, rng)
    baseline = T_camera_projector[:, :3, 3]
    swing = np.cross(baseline, rng.standard_normal((n, 3)))  # about axes perpendicular to the baseline
    swing = swing / np.linalg.norm(swing, axis=1, keepdims=True) * np.abs(rng.standard_normal((n, 1)))
    swing = _with_rms(swing, np.radians(noise.baseline_direction_deg))
    length = np.exp(_log_lengths(n, noise, rng))
    out[:, :3, 3] = length[:, None] * (_exp(swing) @ baseline[:, :, None])[:, :, 0]
    return out


def pose_sigma(truth: DevicePoses, start: DevicePoses, centre: Float[ndarray, "3"]) -> PoseSigma | None:
    """Standard deviation along each axis (RMS length / sqrt(3)) of the errors that `start` really has.

    "Camera" errors are those of the frame as a whole: its rotation about `centre`, and the translation of `centre`.
    None if the poses are exact.
    """
    moved = start.T_world_camera @ np.linalg.inv(truth.T_world_camera)
    shift = (moved[:, :3, :3] @ centre + moved[:, :3, 3]) - centre
    relative, relative_start = truth.T_camera_projector, start.T_camera_projector
    turned = relative[:, :3, :3].transpose(0, 2, 1) @ relative_start[:, :3, :3]
    values = (
        _sigma(shift),
        np.degrees(_sigma(_log(moved[:, :3, :3]))),
        _sigma(relative_start[:, :3, 3] - relative[:, :3, 3]),
        np.degrees(_sigma(_log(turned))),
    )
    if max(values) < 1e-9:
        return None
    # a prior cannot have a sigma of zero; a value far below what data can resolve takes its place
    floors = (1e-6 * np.linalg.norm(truth.T_world_camera[0, :3, 3] - centre), 1e-4) * 2
    return PoseSigma(*(float(max(value, floor)) for value, floor in zip(values, floors, strict=True)))


def _registered(
    T_world_camera: Float64[ndarray, "4 4"],
    T_camera_projector: Float64[ndarray, "4 4"],
    devices: DevicePair,
    match: ExactMatches,
) -> Float64[ndarray, "4 4"]:
    """The camera pose for which the points that the disturbed rig triangulates fit best onto the true ones."""
    start = T_world_camera, T_world_camera @ T_camera_projector
    points = triangulate(
        Intrinsics.of(devices.camera, torch.float64),
        torch.from_numpy(start[0]),
        torch.from_numpy(match.uv_camera),
        Intrinsics.of(devices.projector, torch.float64),
        torch.from_numpy(start[1]),
        torch.from_numpy(match.uv_projector),
    )
    p = points.p_world.numpy()
    known = all_finite(p)
    if known.sum() < _FEWEST_POINTS:
        return T_world_camera
    return fit_similarity(p[known], match.p_world[known], with_scale=False).matrix() @ T_world_camera


def _motions_about(
    centre: Float[ndarray, "3"], n: int, noise: PoseNoise, rng: np.random.Generator
) -> Float64[ndarray, "n 4 4"]:
    """Random rigid motions: a rotation about `centre`, then a shift."""
    out = np.tile(np.eye(4), (n, 1, 1))
    out[:, :3, :3] = _rotations(np.radians(noise.rotation_deg), n, rng)
    shift = _with_rms(rng.standard_normal((n, 3)), noise.translation)
    out[:, :3, 3] = centre - out[:, :3, :3] @ centre + shift
    return out


def _log_lengths(n: int, noise: PoseNoise, rng: np.random.Generator) -> Float[ndarray, "n"]:
    """Errors of the baselines' logarithms: mean zero, the given RMS over the frames that have an error."""
    value = rng.standard_normal(n)
    free = np.ones(n, dtype=bool)
    free[0] = not noise.first_baseline_exact
    if free.sum() < 2:  # one error alone cannot have mean zero
        return np.zeros(n)
    value[free] -= value[free].mean()
    value[~free] = 0.0
    value[free] *= noise.baseline_length / np.sqrt((value[free] ** 2).mean())
    return value


def _rotations(rms: float, n: int, rng: np.random.Generator) -> Float64[ndarray, "n 3 3"]:
    return _exp(_with_rms(rng.standard_normal((n, 3)), rms))


def _with_rms(vectors: Float[ndarray, "n 3"], rms: float) -> Float[ndarray, "n 3"]:
    return vectors * (rms / np.sqrt((vectors**2).sum(-1).mean()))


def _sigma(vectors: Float[ndarray, "n 3"]) -> float:
    return float(np.sqrt((vectors**2).mean()))


def _exp(w: Float[ndarray, "n 3"]) -> Float64[ndarray, "n 3 3"]:
    return exp_so3(torch.from_numpy(w)).numpy()


def _log(R: Float[ndarray, "n 3 3"]) -> Float64[ndarray, "n 3"]:
    return log_so3(torch.from_numpy(np.ascontiguousarray(R))).numpy()


# Noise of captured images and of decoded coordinates; nothing here renders.

_LARGEST_SLIP = 5  # periods by which a wrong cell may be shifted


@dataclass(frozen=True)
class NoisyCells:
    """The cells of a pattern, one around each node: a decoder finds or misses them as a whole."""

    period: float  # pattern pixels
    x0: float  # of the first node
    y0: float
    rows: int
    columns: int
    w: int  # of the pattern
    h: int

    def index(self, coords: Float[ndarray, "n 2"]) -> Int64[ndarray, "n"]:
        """Number of the cell that holds each pattern pixel (x, y)."""
        j = np.clip(np.rint((coords[:, 0] - self.x0) / self.period), 0, self.columns - 1)
        i = np.clip(np.rint((coords[:, 1] - self.y0) / self.period), 0, self.rows - 1)
        return (i * self.columns + j).astype(np.int64)


@dataclass(frozen=True)
class CoordinateNoise:
    """The errors of a decoder."""

    sigma: float  # pattern pixels, each coordinate of each pixel
    missing: float  # fraction of the visible cells that are not decoded
    wrong: float  # fraction of the visible cells that are mistaken for others


def disturb_coords(
    coords: Float32[ndarray, "h w 2"],
    mask: Bool[ndarray, "h w"],
    cells: NoisyCells,
    noise: CoordinateNoise,
    rng: np.random.Generator,
) -> Float32[ndarray, "h w 2"]:
    """Coordinates as decoded: missing cells, cells shifted by whole periods, and jitter everywhere else.

    Of the cells that the frame sees, exactly the given fractions (rounded) are missing and wrong. Missing cells are
    clustered; wrong ones are single or in small groups that share their shift of 1 to 5 periods.
    """
    out = coords.astype(np.float64)
    index = cells.index(coords[mask])
    seen = np.unique(index)
    missing = _missing_cells(seen, cells, round(noise.missing * len(seen)), rng)
    slips = _wrong_cells(np.setdiff1d(seen, missing), cells, round(noise.wrong * len(seen)), rng)
    value = out[mask] + noise.sigma * rng.standard_normal((len(index), 2))
    value += slips[index] * cells.period
    value = np.clip(value, 0, [cells.w, cells.h])  # a decoder never gives coordinates outside the pattern
    value[np.isin(index, missing)] = np.nan
    out[mask] = value
    return out.astype(np.float32)


def disturb_image(
    radiance: Float32[ndarray, "h w"], gain: float, noise: float, rng: np.random.Generator
) -> UInt8[ndarray, "h w"]:
    """An 8-bit image: exposure, shot and read noise (`noise` is their sum at full scale), saturation, rounding."""
    signal = np.clip(radiance * gain, 0, None)
    sigma = noise * np.sqrt(0.15 + 0.85 * signal)
    return np.clip(np.rint(255 * (signal + sigma * rng.standard_normal(signal.shape))), 0, 255).astype(np.uint8)


def _missing_cells(
    seen: Int64[ndarray, "n"], cells: NoisyCells, count: int, rng: np.random.Generator
) -> Int64[ndarray, "m"]:
    """The cells where a smooth random field plus a rough one is highest."""
    rough = rng.standard_normal((cells.rows, cells.columns))
    smooth = gaussian_filter(rng.standard_normal((cells.rows, cells.columns)), 1.2)
    score = (smooth / smooth.std() + 0.7 * rough).reshape(-1)[seen]
    return np.sort(seen[np.argsort(-score, kind="stable")[:count]])


def _wrong_cells(
    candidates: Int64[ndarray, "n"], cells: NoisyCells, count: int, rng: np.random.Generator
) -> Int64[ndarray, "all 2"]:
    """Shift of every cell of the pattern in periods (x, y); zero except for `count` of the candidates."""
    slips = np.zeros((cells.rows * cells.columns, 2), dtype=np.int64)
    free = set(candidates.tolist())
    while count > 0 and free:
        start = int(rng.choice(sorted(free)))
        slip = _slip(start, cells, rng)
        group = [c for c in _block(start, cells, int(rng.integers(1, 5))) if c in free][:count]
        inside = [c for c in group if _stays_inside(c, slip, cells)]
        for cell in inside:
            slips[cell] = slip
        free -= set(inside)
        count -= len(inside)
    return slips


def _block(start: int, cells: NoisyCells, size: int) -> list[int]:
    """Up to four cells in a square of 2 x 2, the first being `start`."""
    i, j = divmod(start, cells.columns)
    square = [(i, j), (i, j + 1), (i + 1, j), (i + 1, j + 1)]
    return [r * cells.columns + c for r, c in square[:size] if r < cells.rows and c < cells.columns]


def _slip(cell: int, cells: NoisyCells, rng: np.random.Generator) -> Int64[ndarray, "2"]:
    """A whole number of periods in x and y, not both zero, small ones more often, that keeps `cell` inside."""
    while True:
        size = np.minimum(rng.geometric(0.5, 2) - 1, _LARGEST_SLIP)
        slip = size * rng.choice([-1, 1], 2)
        if slip.any() and _stays_inside(cell, slip, cells):
            return slip


def _stays_inside(cell: int, slip: Int64[ndarray, "2"], cells: NoisyCells) -> bool:
    i, j = divmod(cell, cells.columns)
    return bool(0 <= i + slip[1] < cells.rows and 0 <= j + slip[0] < cells.columns)

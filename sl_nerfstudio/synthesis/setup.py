"""Everything that is fixed before the first frame is rendered: scene, devices, paths and their errors."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.pattern.files import read_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.layout import Lattice, PatternLayout
from sl_nerfstudio.scan.types import PoseSigma
from sl_nerfstudio.synthesis.appearance.look import Look, make_look
from sl_nerfstudio.synthesis.appearance.plain import Appearance, make_appearance
from sl_nerfstudio.synthesis.appearance.ranges import RANGES
from sl_nerfstudio.synthesis.capture_plan import Shot, choose_useless, plan_shots, turn_away
from sl_nerfstudio.synthesis.config import MILLIMETRES, SynthConfig
from sl_nerfstudio.synthesis.devices import DeviceOptions, DevicePair, make_devices
from sl_nerfstudio.synthesis.noise import Cells
from sl_nerfstudio.synthesis.paths import DISTANCE, make_paths
from sl_nerfstudio.synthesis.photograph import Photograph, Stage, take_photograph
from sl_nerfstudio.synthesis.pose_noise import ExactMatches, PoseNoise, disturb_poses, pose_sigma
from sl_nerfstudio.synthesis.ray_casting import RayCaster
from sl_nerfstudio.synthesis.render import RenderedCapture, render_capture, visible_points
from sl_nerfstudio.synthesis.scenes.library import make_scene
from sl_nerfstudio.synthesis.scenes.scene import Scene
from sl_nerfstudio.synthesis.scenes.surroundings import above_the_table, make_surroundings

_REGISTRATION_GRID = 28  # pixels per side of the grid with which a frame's disturbed points are registered


class Stream(IntEnum):
    """Every use of randomness has its own stream: a change in one does not affect the others."""

    PATHS = 1
    TEXTURE = 2
    POSES = 3
    COORDS = 4
    SENSOR = 5
    WORLD = 6
    SURROUNDINGS = 7
    LOOK = 8
    SHOTS = 9
    USELESS = 10
    AWAY = 11


def random_stream(seed: int, stream: Stream, frame: int = 0) -> np.random.Generator:
    """The generator of one use of randomness in one frame."""
    return np.random.default_rng([seed, int(stream), frame])


@dataclass(frozen=True)
class Photography:
    """How the frames of a scan that is not plain are photographed."""

    look: Look
    shots: tuple[Shot, ...]


@dataclass(frozen=True)
class Setup:
    """A scan before it is rendered; lengths in millimetres, poses in the scene's axes."""

    scene: Scene
    surroundings: Scene | None  # table and walls
    caster: RayCaster
    devices: DevicePair
    pattern: Float32[ndarray, "h w"]
    layout: PatternLayout | None  # None: the pattern is a plain image
    cells: Cells
    appearance: Appearance
    photography: Photography | None  # None: plain images
    truth: DevicePoses
    start: DevicePoses
    sigma: PoseSigma | None

    def render(self, frame: int, supersampling: int) -> RenderedCapture:
        """Frame number `frame`, without noise."""
        return render_capture(
            self.caster,
            self.devices,
            self.truth.T_world_camera[frame],
            self.truth.T_world_projector[frame],
            self.pattern,
            self.appearance,
            supersampling,
        )

    def photograph(self, frame: int, supersampling: int, photography: Photography, seed: int) -> Photograph:
        """Frame number `frame` as a camera takes it."""
        poses = self.truth.T_world_camera[frame], self.truth.T_world_projector[frame]
        stage = Stage(self.caster, self.devices, *poses)
        noise = random_stream(seed, Stream.SENSOR, frame)
        return take_photograph(stage, photography.look, photography.shots[frame], supersampling, noise)


def make_setup(config: SynthConfig) -> Setup:
    """Scene, devices, paths and their errors, as configured. Raises UserError for bad files."""
    scene = make_scene(config.scene, 1 / MILLIMETRES[config.units])
    if config.background != "none":
        scene = above_the_table(scene)
    surroundings = make_surroundings(scene, config.background, random_stream(config.seed, Stream.SURROUNDINGS))
    pattern, layout = _make_pattern(config)
    truth = make_paths(scene, config.frames, config.path, random_stream(config.seed, Stream.PATHS))
    options = DeviceOptions(
        config.resolution, config.projector_model, config.camera_distortion, config.projector_distortion
    )
    devices = make_devices(scene, truth, (pattern.shape[1], pattern.shape[0]), options)
    photography = _make_photography(config, scene, pattern)
    if photography is not None:
        away = [random_stream(config.seed, Stream.AWAY, n) for n in range(config.frames)]
        truth = turn_away(truth, photography.shots, away)
    caster = RayCaster(scene, surroundings)
    noise = PoseNoise(*config.pose_error, *config.autocalibration_error, config.scale_known)
    pairs = zip(truth.T_world_camera, truth.T_world_projector, strict=True)
    matches = [_matches(caster, devices, camera, projector) for camera, projector in pairs]
    start = disturb_poses(truth, noise, scene.centre, devices, matches, random_stream(config.seed, Stream.POSES))
    return Setup(
        scene=scene,
        surroundings=surroundings,
        caster=caster,
        devices=devices,
        pattern=pattern,
        layout=layout,
        cells=make_cells(pattern, None if layout is None else layout.lattice),
        appearance=make_appearance(scene, DISTANCE * scene.size, random_stream(config.seed, Stream.TEXTURE)),
        photography=photography,
        truth=truth,
        start=start,
        sigma=pose_sigma(truth, start, scene.centre),
    )


def make_cells(pattern: Float32[ndarray, "h w"], lattice: Lattice | None) -> Cells:
    """The cells around the nodes; a pattern without nodes is treated as 40 cells along its longer side."""
    h, w = pattern.shape
    if lattice is not None:
        return Cells(lattice.period, lattice.x0, lattice.y0, lattice.rows, lattice.columns, w, h)
    period = max(w, h) / 40
    return Cells(period, period / 2, period / 2, max(1, round(h / period)), max(1, round(w / period)), w, h)


def _make_pattern(config: SynthConfig) -> tuple[Float32[ndarray, "h w"], PatternLayout | None]:
    if config.pattern is not None:
        return read_pattern(config.pattern)
    grid = GridPattern()
    return grid.render(), grid


def _make_photography(config: SynthConfig, scene: Scene, pattern: Float32[ndarray, "h w"]) -> Photography | None:
    """None for plain images. A scan must have coordinates in every frame, so only captures have useless ones."""
    if config.appearance == "plain":
        return None
    ranges, distance = RANGES[config.appearance], DISTANCE * scene.size
    look_rng = random_stream(config.seed, Stream.LOOK)
    look = make_look(scene, distance, pattern, config.resolution, ranges, config.sensor_noise, look_rng)
    useless: frozenset[int] = frozenset()
    if config.images_only:
        useless = choose_useless(config.frames, ranges, random_stream(config.seed, Stream.USELESS))
    rngs = [random_stream(config.seed, Stream.SHOTS, n) for n in range(config.frames)]
    return Photography(look, plan_shots(ranges, rngs, useless))


def _matches(
    caster: RayCaster,
    devices: DevicePair,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> ExactMatches:
    """Exact correspondences on a coarse grid of pixels."""
    place = (np.arange(_REGISTRATION_GRID) + 0.5) / _REGISTRATION_GRID
    uv = np.stack(np.meshgrid(place * devices.camera.w, place * devices.camera.h), -1).reshape(-1, 2)
    seen = visible_points(caster, devices, T_world_camera, T_world_projector, uv)
    return ExactMatches(uv[seen.lit], seen.uv_projector[seen.lit], seen.p_world[seen.lit])

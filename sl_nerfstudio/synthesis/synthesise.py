"""Synthesis from a configuration to files: a few frames at a time are rendered, disturbed and written."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.parallel import results, threads
from sl_nerfstudio.pattern.files import read_pattern
from sl_nerfstudio.pattern.grid import GridPattern, normalise_locally
from sl_nerfstudio.pattern.layout import Lattice, PatternLayout
from sl_nerfstudio.scan.images import as_grey, encode_png
from sl_nerfstudio.scan.types import PoseSigma, Scale
from sl_nerfstudio.scan.write import ScanWriter, encode_intrinsics, encode_json, sigma_fields
from sl_nerfstudio.storage import NewFolder
from sl_nerfstudio.synthesis.appearance import RANGES, Appearance, Look, make_appearance, make_look
from sl_nerfstudio.synthesis.config import MILLIMETRES, SynthConfig
from sl_nerfstudio.synthesis.devices import (
    DISTANCE,
    CoordinateNoise,
    DevicePair,
    ExactMatches,
    NoisyCells,
    PoseNoise,
    disturb_coords,
    disturb_image,
    disturb_poses,
    make_devices,
    make_paths,
    pose_sigma,
)
from sl_nerfstudio.synthesis.photograph import Photograph, Shot, choose_useless, plan_shots, take_photograph, turn_away
from sl_nerfstudio.synthesis.render import (
    FrameGeometry,
    RayCaster,
    RenderedCapture,
    above_the_table,
    make_surroundings,
    render_capture,
    visible_points,
)
from sl_nerfstudio.synthesis.scenes import encode_ply, make_scene
from sl_nerfstudio.synthesis.sdf import Scene

# Everything that is fixed before the first frame is rendered: scene, devices, paths and their errors.

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
    """Photography of the frames of a scan that is not plain."""

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
    cells: NoisyCells
    appearance: Appearance
    photography: Photography | None  # None: plain images
    truth: DevicePoses
    start: DevicePoses
    sigma: PoseSigma | None

    def render(self, frame: int, supersampling: int) -> RenderedCapture:
        """Frame number `frame`, without noise."""
        return render_capture(self._geometry(frame), self.pattern, self.appearance, supersampling)

    def photograph(self, frame: int, supersampling: int, photography: Photography, seed: int) -> Photograph:
        """Frame number `frame` as a camera takes it."""
        noise = random_stream(seed, Stream.SENSOR, frame)
        shot = photography.shots[frame]
        return take_photograph(self._geometry(frame), photography.look, shot, supersampling, noise)

    def _geometry(self, frame: int) -> FrameGeometry:
        poses = self.truth.T_world_camera[frame], self.truth.T_world_projector[frame]
        return FrameGeometry(self.caster, self.devices, *poses)


def make_setup(config: SynthConfig) -> Setup:
    """Scene, devices, paths and their errors, as configured. Raises UserError for bad files."""
    scene = make_scene(config.scene, 1 / MILLIMETRES[config.units], config.seed)
    if config.background != "none":
        scene = above_the_table(scene)
    surroundings = make_surroundings(scene, config.background, random_stream(config.seed, Stream.SURROUNDINGS))
    default = GridPattern()
    pattern, layout = (default.render(), default) if config.pattern is None else read_pattern(config.pattern)
    truth = make_paths(scene, config.frames, config.path, random_stream(config.seed, Stream.PATHS))
    devices = make_devices(scene, truth, (pattern.shape[1], pattern.shape[0]), config)
    photography = _make_photography(config, scene, pattern)
    if photography is not None:
        away = [random_stream(config.seed, Stream.AWAY, n) for n in range(config.frames)]
        truth = turn_away(truth, photography.shots, away)
    caster = RayCaster(scene, surroundings)
    noise = PoseNoise(*config.pose_error, *config.autocalibration_error, config.scale_known)
    pairs = zip(truth.T_world_camera, truth.T_world_projector, strict=True)
    matches = [_matches(FrameGeometry(caster, devices, *poses)) for poses in pairs]
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


def make_cells(pattern: Float32[ndarray, "h w"], lattice: Lattice | None) -> NoisyCells:
    """The cells around the nodes; a pattern without nodes is treated as 40 cells along its longer side."""
    h, w = pattern.shape
    if lattice is not None:
        return NoisyCells(lattice.period, lattice.x0, lattice.y0, lattice.rows, lattice.columns, w, h)
    period = max(w, h) / 40
    return NoisyCells(period, period / 2, period / 2, max(1, round(h / period)), max(1, round(w / period)), w, h)


def _make_photography(config: SynthConfig, scene: Scene, pattern: Float32[ndarray, "h w"]) -> Photography | None:
    """Look and shots; None for plain images. Scans need coordinates in every frame: only captures have useless ones."""
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


def _matches(frame: FrameGeometry) -> ExactMatches:
    """Exact correspondences on a coarse grid of pixels."""
    place = (np.arange(_REGISTRATION_GRID) + 0.5) / _REGISTRATION_GRID
    camera = frame.devices.camera
    uv = np.stack(np.meshgrid(place * camera.w, place * camera.h), -1).reshape(-1, 2)
    seen = visible_points(frame, uv)
    return ExactMatches(uv[seen.lit], seen.uv_projector[seen.lit], seen.p_world[seen.lit])


# Frames, rendered a few at a time, and the folders that hold them.

TwoPoses = tuple[Float[ndarray, "4 4"], Float[ndarray, "4 4"]]
GAIN = 1.05  # exposure: a surface of mean albedo that faces the lamp in full light has 0.82 of full scale
_WINDOW = 0.8  # of local normalisation, in periods of the pattern


@dataclass(frozen=True)
class SyntheticFrame:
    """One frame as it is written."""

    name: str
    image: UInt8[ndarray, "h w *c"]
    encoded: bytes  # the file that the camera writes
    suffix: str  # of that file
    pattern: UInt8[ndarray, "h w"]
    coords: Float32[ndarray, "h w 2"]
    mask: Bool[ndarray, "h w"]
    object_mask: Bool[ndarray, "h w"]  # the object and not its surroundings, lit or not


def synthesise(config: SynthConfig, output: Path) -> None:
    """Make a scan folder at `output`, with the truth under ground_truth/.

    With `config.images_only`, `output` holds images, pattern and intrinsics, and ground_truth/ is a complete scan
    with exact coordinates and poses. Raises UserError for bad flags or files, or an output that is not empty.
    """
    config.check()
    if config.clean:
        config = replace(
            config, noise=0.0, missing=0.0, wrong=0.0, sensor_noise=0.0, pose_error=(0.0, 0.0),
            autocalibration_error=(0.0, 0.0, 0.0),
        )  # fmt: skip
    with NewFolder(output) as folder:  # before the slow work: nobody else may start it
        setup = make_setup(config)
        (_write_captures if config.images_only else _write_scan)(config, setup, folder)


def world_from_scene(config: SynthConfig, scene: Scene) -> Similarity:
    """The map from the rendered scene to the written world: the unit, and a random rotation and shift on request."""
    scale = MILLIMETRES[config.units]
    if config.world_turn is None:
        return Similarity.scaling(scale)
    rng = random_stream(config.world_turn, Stream.WORLD)
    Q, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    Q = Q * np.sign(np.diag(upper))
    Q[:, 2] *= np.sign(np.linalg.det(Q))
    return Similarity(scale, Q, scale * scene.size * rng.uniform(-3, 3, 3))


def _frames(config: SynthConfig, setup: Setup) -> Iterator[SyntheticFrame]:
    """Rendered and disturbed frames, as many in memory as there are threads."""
    together = threads()
    groups = [range(first, min(first + together, config.frames)) for first in range(0, config.frames, together)]
    rendered = chain.from_iterable(results([partial(_frame, config, setup, k) for k in group]) for group in groups)
    yield from track(rendered, "rendering", config.frames)


def _frame(config: SynthConfig, setup: Setup, index: int) -> SyntheticFrame:
    """One frame: a grey PNG of a plain scan, else a JPEG in colour."""
    if setup.photography is not None:
        seen = setup.photograph(index, config.supersampling, setup.photography, config.seed)
        image, encoded, suffix, grey = seen.image, seen.jpeg, ".jpg", as_grey(seen.image)
    else:
        seen = setup.render(index, config.supersampling)
        sensor = random_stream(config.seed, Stream.SENSOR, index)
        image = disturb_image(seen.radiance, GAIN, config.sensor_noise, sensor)
        encoded, suffix, grey = encode_png(image), ".png", image / 255
    noise = CoordinateNoise(config.noise, config.missing, config.wrong)
    coords = disturb_coords(
        seen.coords, seen.mask, setup.cells, noise, random_stream(config.seed, Stream.COORDS, index)
    )
    pattern = _pattern_image(grey, seen.mask, setup)
    return SyntheticFrame(_frame_name(index), image, encoded, suffix, pattern, coords, seen.mask, seen.object_mask)


def _frame_name(index: int) -> str:
    return f"frame_{index:05d}"


def _pattern_image(grey: Float[ndarray, "h w"], mask: Bool[ndarray, "h w"], setup: Setup) -> UInt8[ndarray, "h w"]:
    """The captured image without albedo, shading and fall-off."""
    # both devices are about equally far away, so the focal lengths give the apparent size of a period
    period = setup.cells.period * setup.devices.camera.fl_x / setup.devices.projector.fl_x
    mean, contrast = float(setup.pattern.mean()), float(setup.pattern.std())
    return _to_8_bit(normalise_locally(grey, mask, _WINDOW * period, mean, contrast))


def _to_8_bit(image: Float[ndarray, "h w"]) -> UInt8[ndarray, "h w"]:
    return np.rint(255 * image).astype(np.uint8)


def _mask_image(mask: Bool[ndarray, "h w"]) -> bytes:
    return encode_png(mask.astype(np.uint8) * np.uint8(255))


def _scan_writer(config: SynthConfig, setup: Setup, root: Path, folder: NewFolder) -> ScanWriter:
    extra: dict[str, Any] = {}
    if config.pose_sigma and setup.sigma is not None:
        factor = MILLIMETRES[config.units]
        extra["sl_pose_sigma"] = {
            key: value * (factor if "translation" in key else 1) for key, value in sigma_fields(setup.sigma).items()
        }
    scale = Scale(True, "baseline of frame 0", _frame_name(0)) if config.scale_known else Scale(False)
    return ScanWriter(
        root,
        units=config.units,
        scale=scale,
        projector=setup.devices.projector,
        pattern=_to_8_bit(setup.pattern),
        camera=setup.devices.camera,
        extra=extra,
        within=folder,
    )


def _world_poses(config: SynthConfig, setup: Setup, poses: DevicePoses, index: int) -> TwoPoses:
    """Camera and projector of one frame in the written axes and unit."""
    S_world_scene = world_from_scene(config, setup.scene)
    return S_world_scene.poses(poses.T_world_camera[index]), S_world_scene.poses(poses.T_world_projector[index])


def _add(writer: ScanWriter, frame: SyntheticFrame, poses: TwoPoses, truth: TwoPoses | None) -> None:
    writer.add_frame(
        frame.name,
        image=frame.image,
        coords=frame.coords,
        mask=frame.mask,
        pattern=frame.pattern,
        T_world_camera=poses[0],
        T_world_projector=poses[1],
        true_poses=truth,
    )


def _add_files(writer: ScanWriter, config: SynthConfig, setup: Setup, truth: str) -> None:
    """The pattern's description, and below the folder `truth` the surfaces of the object and of what is around it."""
    if setup.layout is not None:
        writer.add_file("pattern.json", setup.layout.encode())
    S_world_scene = world_from_scene(config, setup.scene)
    for name, part in (("mesh", setup.scene), ("surroundings", setup.surroundings)):
        if part is not None:
            writer.add_file(f"{truth}{name}.ply", encode_ply(S_world_scene.points(part.vertices), part.faces))


def _captures_document(config: SynthConfig, setup: Setup) -> dict[str, Any]:
    """Document which frames are of use, and what the others lack."""
    shots = [None] * config.frames if setup.photography is None else setup.photography.shots
    faults = [None if shot is None else shot.fault for shot in shots]
    frames = [{"name": _frame_name(k), "usable": fault is None, "fault": fault} for k, fault in enumerate(faults)]
    return {"appearance": config.appearance, "background": config.background, "frames": frames}


def _write_scan(config: SynthConfig, setup: Setup, folder: NewFolder) -> None:
    """A scan with its truth."""
    with _scan_writer(config, setup, folder.root, folder) as writer:
        for index, frame in enumerate(_frames(config, setup)):
            start, truth = (_world_poses(config, setup, poses, index) for poses in (setup.start, setup.truth))
            _add(writer, frame, start, truth)
            writer.add_file(f"ground_truth/object_masks/{frame.name}.png", _mask_image(frame.object_mask))
        _add_files(writer, config, setup, "ground_truth/")


def _write_captures(config: SynthConfig, setup: Setup, folder: NewFolder) -> None:
    """The images that a decoder starts from, and separately the scan that it should produce."""
    exact = replace(config, noise=0.0, missing=0.0, wrong=0.0, pose_sigma=False)
    with _scan_writer(exact, setup, folder.root / "ground_truth", folder) as truth:
        for index, frame in enumerate(_frames(exact, setup)):
            _add(truth, frame, _world_poses(exact, setup, setup.truth, index), None)
            truth.add_file(f"object_masks/{frame.name}.png", _mask_image(frame.object_mask))
            folder.write(f"images/{frame.name}{frame.suffix}", frame.encoded)
        truth.add_file("captures.json", encode_json(_captures_document(config, setup)))
        _add_files(truth, exact, setup, "")
    folder.write("pattern.png", encode_png(_to_8_bit(setup.pattern)))
    if setup.layout is not None:
        folder.write("pattern.json", setup.layout.encode())
    intrinsics = encode_intrinsics(config.units, setup.devices.camera, setup.devices.projector)
    folder.write("intrinsics.json", intrinsics, last=True)

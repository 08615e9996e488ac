"""From a configuration to a scan folder: scene, paths, rendering, noise, files."""

import json
from dataclasses import dataclass, replace
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.pattern.files import encode_grid, read_pattern
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.normalise import normalise_locally
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.atomic import require_empty, write_atomic
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.types import PoseSigma, Scale
from sl_nerfstudio.scan.writing import ScanWriter, device_fields
from sl_nerfstudio.synthesis.appearance import Appearance, make_appearance
from sl_nerfstudio.synthesis.config import MILLIMETRES, SynthConfig
from sl_nerfstudio.synthesis.devices import Pair, make_devices
from sl_nerfstudio.synthesis.mesh_file import encode_ply
from sl_nerfstudio.synthesis.noise import Cells, CoordinateNoise, disturb_coords, disturb_image
from sl_nerfstudio.synthesis.paths import DISTANCE, Poses, make_paths
from sl_nerfstudio.synthesis.pose_noise import Correspondences, PoseNoise, disturb_poses, pose_sigma
from sl_nerfstudio.synthesis.ray_casting import Caster
from sl_nerfstudio.synthesis.render import Capture, capture, look
from sl_nerfstudio.synthesis.scene import Scene
from sl_nerfstudio.synthesis.scenes import make_scene

_GAIN = 0.95  # exposure: a mid-grey surface, perpendicular, in full light, comes to about 0.75 of full scale
_REGISTRATION_GRID = 28  # pixels a side that a frame's disturbed points are registered by


class _Stream(IntEnum):
    """Every use of randomness has its own stream: changing one leaves the others as they were."""

    PATHS = 1
    TEXTURE = 2
    POSES = 3
    COORDS = 4
    SENSOR = 5
    WORLD = 6


@dataclass(frozen=True)
class Rehearsal:
    """All that is settled before the first frame is rendered; lengths in millimetres, poses in the scene's axes."""

    scene: Scene
    caster: Caster
    devices: Pair
    pattern: Float32[ndarray, "h w"]
    grid: GridPattern | None
    cells: Cells
    appearance: Appearance
    truth: Poses
    start: Poses
    sigma: PoseSigma | None

    def render(self, frame: int, supersampling: int) -> Capture:
        """Frame number `frame`, without noise."""
        return capture(
            self.caster,
            self.devices,
            self.truth.T_world_camera[frame],
            self.truth.T_world_projector[frame],
            self.pattern,
            self.appearance,
            supersampling,
        )


def synthesise(config: SynthConfig, output: Path) -> None:
    """Make a scan folder at `output` with its truth under ground_truth/. Raises UserError for bad flags or files."""
    config.check()
    require_empty(output)
    if config.clean:
        config = replace(
            config,
            noise=0.0,
            missing=0.0,
            wrong=0.0,
            sensor_noise=0.0,
            pose_error=(0.0, 0.0),
            autocalibration_error=(0.0, 0.0, 0.0),
        )
    rehearsal = rehearse(config)
    if config.images_only:
        _write_images(config, rehearsal, output)
        _write_scan(config, rehearsal, output / "ground_truth")
    else:
        _write_scan(config, rehearsal, output)


def rehearse(config: SynthConfig) -> Rehearsal:
    """Scene, devices, paths and their errors."""
    scene = make_scene(config.scene, 1 / MILLIMETRES[config.units])
    if config.pattern is None:
        grid: GridPattern | None = GridPattern()
        pattern = grid.render()
    else:
        pattern, grid = read_pattern(config.pattern)
    devices = make_devices(
        scene,
        config.resolution,
        (pattern.shape[1], pattern.shape[0]),
        config.projector_model,
        config.camera_distortion,
        config.projector_distortion,
    )
    truth = make_paths(scene, config.frames, config.path, _rng(config.seed, _Stream.PATHS))
    caster = Caster(scene)
    noise = PoseNoise(*config.pose_error, *config.autocalibration_error, config.scale_known)
    matches = [_matches(caster, devices, *poses) for poses in zip(truth.T_world_camera, truth.T_world_projector)]
    start = disturb_poses(truth, noise, scene.centre, devices, matches, _rng(config.seed, _Stream.POSES))
    return Rehearsal(
        scene=scene,
        caster=caster,
        devices=devices,
        pattern=pattern,
        grid=grid,
        cells=make_cells(pattern, grid),
        appearance=make_appearance(scene, DISTANCE * scene.size, _rng(config.seed, _Stream.TEXTURE)),
        truth=truth,
        start=start,
        sigma=pose_sigma(truth, start, scene.centre),
    )


def make_cells(pattern: Float32[ndarray, "h w"], grid: GridPattern | None) -> Cells:
    """The grid's cells; a plain image counts as 40 cells along its longer side."""
    h, w = pattern.shape
    if grid is not None:
        return Cells(grid.period, grid.x0, grid.y0, grid.rows, grid.columns, w, h)
    period = max(w, h) / 40
    return Cells(period, period / 2, period / 2, max(1, round(h / period)), max(1, round(w / period)), w, h)


def _rng(seed: int, stream: _Stream, frame: int = 0) -> np.random.Generator:
    return np.random.default_rng([seed, int(stream), frame])


def _matches(
    caster: Caster, devices: Pair, T_world_camera: Float[ndarray, "4 4"], T_world_projector: Float[ndarray, "4 4"]
) -> Correspondences:
    """Exact correspondences on a coarse grid of pixels."""
    w, h = devices.camera.w, devices.camera.h
    place = (np.arange(_REGISTRATION_GRID) + 0.5) / _REGISTRATION_GRID
    uv = np.stack(np.meshgrid(place * w, place * h), -1).reshape(-1, 2)
    sight = look(caster, devices, T_world_camera, T_world_projector, uv)
    return Correspondences(uv[sight.lit], sight.uv_projector[sight.lit], sight.p_world[sight.lit])


def world_from_scene(config: SynthConfig, scene: Scene) -> Similarity:
    """How what is written lies to what was rendered: the unit, and a turn and shift of the world if asked for."""
    scale = MILLIMETRES[config.units]
    if config.world_turn is None:
        return Similarity(scale, np.eye(3), np.zeros(3))
    rng = np.random.default_rng([config.world_turn, int(_Stream.WORLD)])
    Q, upper = np.linalg.qr(rng.standard_normal((3, 3)))
    Q = Q * np.sign(np.diag(upper))
    Q[:, 2] *= np.sign(np.linalg.det(Q))
    return Similarity(scale, Q, scale * scene.size * rng.uniform(-3, 3, 3))


def _write_scan(config: SynthConfig, rehearsal: Rehearsal, output: Path) -> None:
    S_world_scene = world_from_scene(config, rehearsal.scene)
    truth, start = (
        Poses(S_world_scene.poses(p.T_world_camera), S_world_scene.poses(p.T_world_projector))
        for p in (rehearsal.truth, rehearsal.start)
    )
    extra: dict[str, Any] = {}
    if config.pose_sigma and rehearsal.sigma is not None:
        extra["sl_pose_sigma"] = _sigma_fields(rehearsal.sigma, S_world_scene.scale)
    scale = Scale(True, "baseline of frame 0") if config.scale_known else Scale(False)
    with ScanWriter(
        output,
        units=config.units,
        scale=scale,
        projector=rehearsal.devices.projector,
        pattern=_to_8_bit(rehearsal.pattern),
        camera=rehearsal.devices.camera,
        extra=extra,
    ) as writer:
        for frame in track(range(config.frames), "rendering", config.frames):
            rendered = rehearsal.render(frame, config.supersampling)
            image = disturb_image(
                rendered.radiance, _GAIN, config.sensor_noise, _rng(config.seed, _Stream.SENSOR, frame)
            )
            coords = disturb_coords(
                rendered.coords,
                rendered.mask,
                rehearsal.cells,
                CoordinateNoise(config.noise, config.missing, config.wrong),
                _rng(config.seed, _Stream.COORDS, frame),
            )
            writer.add_frame(
                f"frame_{frame:05d}",
                image=image,
                coords=coords,
                mask=rendered.mask,
                pattern=_pattern_image(image, rendered, rehearsal),
                T_world_camera=start.T_world_camera[frame],
                T_world_projector=start.T_world_projector[frame],
                true_poses=(truth.T_world_camera[frame], truth.T_world_projector[frame]),
            )
        if rehearsal.grid is not None:
            writer.add_file("pattern.json", encode_grid(rehearsal.grid))
        vertices = S_world_scene.points(rehearsal.scene.vertices)
        writer.add_file("ground_truth/mesh.ply", encode_ply(vertices, rehearsal.scene.faces))


def _sigma_fields(sigma: PoseSigma, scale: float) -> dict[str, float]:
    return {
        "camera_translation": sigma.camera_translation * scale,
        "camera_rotation_deg": sigma.camera_rotation_deg,
        "relative_translation": sigma.relative_translation * scale,
        "relative_rotation_deg": sigma.relative_rotation_deg,
    }


def _pattern_image(image: ndarray, rendered: Capture, rehearsal: Rehearsal) -> ndarray:
    """The captured image with albedo, shading and fall-off taken out."""
    camera, projector = rehearsal.devices.camera, rehearsal.devices.projector
    period = rehearsal.cells.period * camera.fl_x / projector.fl_x  # as the camera sees it, nearly
    pattern = rehearsal.pattern
    return _to_8_bit(
        normalise_locally(image / 255, rendered.mask, 0.8 * period, float(pattern.mean()), float(pattern.std()))
    )


def _to_8_bit(image: Float32[ndarray, "h w"]) -> ndarray:
    return np.rint(255 * image).astype(np.uint8)


def _write_images(config: SynthConfig, rehearsal: Rehearsal, output: Path) -> None:
    """Captured images, pattern and intrinsics: what a decoder starts from."""
    for frame in track(range(config.frames), "capturing", config.frames):
        rendered = rehearsal.render(frame, config.supersampling)
        image = disturb_image(rendered.radiance, _GAIN, config.sensor_noise, _rng(config.seed, _Stream.SENSOR, frame))
        write_atomic(output / "images" / f"frame_{frame:05d}.png", encode_png(image))
    write_atomic(output / "pattern.png", encode_png(_to_8_bit(rehearsal.pattern)))
    if rehearsal.grid is not None:
        write_atomic(output / "pattern.json", encode_grid(rehearsal.grid))
    intrinsics = {
        "units": config.units,
        **device_fields(rehearsal.devices.camera, "camera_model"),
        "projector": {**device_fields(rehearsal.devices.projector, "model"), "pattern_path": "pattern.png"},
    }
    write_atomic(output / "intrinsics.json", (json.dumps(intrinsics, indent=1) + "\n").encode())

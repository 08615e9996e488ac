"""Scans in memory: exact coordinates of a scene, disturbed as a decoder, a calibration and a registration do it."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.parameters import PosePrior
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import CoordinateNoise, NoisyCells, disturb_coords
from sl_nerfstudio.synthesis.synthesise import Setup, make_setup

FRAMES, RESOLUTION = 8, 240
SHARED_PIXELS = 2.0  # standard deviation of the blur of noise that neighbouring pixels share
INTRINSICS = 0.001  # 1 sigma of the calibration, as a share of the focal length: stated, and drawn
NOISES = {
    "low": CoordinateNoise(0.1, 0.05, 0.005),
    "usual": CoordinateNoise(0.3, 0.15, 0.02),
    "high": CoordinateNoise(0.8, 0.3, 0.04),
}


@dataclass(frozen=True)
class ExactScan:
    """What a scene and a seed fix; lengths in millimetres."""

    camera: Device
    projector: Device
    truth: DevicePoses
    start: DevicePoses
    sigma: tuple[float, float, float, float]  # of the starting poses: frame mm, deg; projector mm, deg
    S_scene_world: Similarity
    coords: Float[ndarray, "frames h w 2"]
    cells: NoisyCells

    @staticmethod
    def of(setup: Setup) -> "ExactScan":
        """Render all frames."""
        s = setup.sigma
        assert s is not None
        return ExactScan(
            setup.devices.camera,
            setup.devices.projector,
            setup.truth,
            setup.start,
            (s.camera_translation, s.camera_rotation_deg, s.relative_translation, s.relative_rotation_deg),
            centred_on(setup.scene.vertices, 2.0),
            np.stack([setup.render(k, 1).coords for k in range(len(setup.truth))]),
            setup.cells,
        )


@dataclass(frozen=True)
class Case:
    """One scan as the adjustment gets it, and its truth in the same scene frame."""

    truth: Rig  # with the true intrinsics
    start: Rig  # with the stated ones
    maps: CoordinateMaps
    prior: PosePrior
    exact: ExactScan


def exact_scan(scene: str, seed: int) -> ExactScan:
    """The scan of a scene, without noise in its coordinates."""
    return ExactScan.of(make_setup(SynthConfig(scene=scene, frames=FRAMES, resolution=RESOLUTION, seed=seed)))


def make_case(exact: ExactScan, noise: CoordinateNoise, seed: int, start: DevicePoses | None = None) -> Case:
    """Coordinates with noise, half as much of it again shared by neighbouring pixels, and intrinsics slightly wrong."""
    rng = np.random.default_rng([seed, round(1000 * noise.sigma)])
    images = [torch.from_numpy(_disturbed(c, exact.cells, noise, rng)) for c in exact.coords]
    error = IntrinsicsChange.of((INTRINSICS * rng.standard_normal(6)).tolist())
    camera, projector = error.camera.applied(exact.camera), error.projector.applied(exact.projector)
    S, n = exact.S_scene_world, len(exact.truth)
    rows = np.array(exact.sigma) * (S.scale, np.pi / 180, S.scale, np.pi / 180)
    return Case(
        Rig.of([exact.camera] * n, exact.projector, exact.truth, S),
        Rig.of([camera] * n, projector, start or exact.start, S),
        CoordinateMaps.of(images),
        PosePrior(*torch.from_numpy(np.tile(rows, (n, 1))).unbind(1), intrinsics=INTRINSICS),
        exact,
    )


def _disturbed(
    coords: Float[ndarray, "h w 2"], cells: NoisyCells, noise: CoordinateNoise, rng: np.random.Generator
) -> Float[ndarray, "h w 2"]:
    rough = rng.standard_normal(coords.shape)
    smooth = gaussian_filter(rough, (SHARED_PIXELS, SHARED_PIXELS, 0))
    shared = 0.5 * noise.sigma * smooth / smooth.std()
    mask = np.isfinite(coords[..., 0])
    return (disturb_coords(coords, mask, cells, noise, rng) + shared).astype(np.float32)

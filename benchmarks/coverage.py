"""Does the stated uncertainty of poses and lengths cover the errors?

    python -m benchmarks.coverage [--scenes ...] [--seeds 1 2 3] [--noises low usual high] [--output FILE]

Small scans of all scenes of sl-synth (8 frames of 240 x 240) start from rough poses, with intrinsics that are wrong
within their stated uncertainty, and with noise of which neighbouring pixels share a part. Only the bundle adjustment
runs. 68 % of the errors should be within 1 sigma, 95 % within 2. One scan of each scene is adjusted from the true
poses, too: how far apart do both end, in units of sigma? Results are written after every scan; a scan whose result is
there is not repeated.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from benchmarks.common.measuring import Rows, kept_rows, markdown, options
from sl_nerfstudio.bundle_adjustment.adjust import Adjustment, adjust
from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    baseline_scale,
    gauge_projection,
    of_baselines,
    restore,
)
from sl_nerfstudio.bundle_adjustment.residuals import Rig
from sl_nerfstudio.bundle_adjustment.search import AdjustmentSettings
from sl_nerfstudio.geometry.devices import Device, IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, centred_on, hat, inverse, log_se3
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import CoordinateNoise, NoisyCells, disturb_coords
from sl_nerfstudio.synthesis.scenes import BUILT_IN
from sl_nerfstudio.synthesis.synthesise import make_setup

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


@dataclass(frozen=True)
class Case:
    """One scan as the adjustment gets it, and its truth in the same scene frame."""

    truth: Rig  # with the true intrinsics
    start: Rig  # with the stated ones
    maps: CoordinateMaps
    prior: PosePrior
    exact: ExactScan


def exact_scan(
    scene: str, seed: int, frames: int = FRAMES, resolution: int = RESOLUTION,
    pose_error: tuple[float, float] = SynthConfig.pose_error,
) -> ExactScan:  # fmt: skip
    """The scan of a scene, without noise in its coordinates; `pose_error` in degrees and millimetres."""
    setup = make_setup(SynthConfig(scene=scene, frames=frames, resolution=resolution, seed=seed, pose_error=pose_error))
    s, devices = setup.sigma, setup.devices
    assert s is not None
    sigma = (s.camera_translation, s.camera_rotation_deg, s.relative_translation, s.relative_rotation_deg)
    coords = np.stack([setup.render(k, 1).coords for k in range(frames)])
    S = centred_on(setup.scene.vertices, 2.0)
    return ExactScan(devices.camera, devices.projector, setup.truth, setup.start, sigma, S, coords, setup.cells)


def make_case(exact: ExactScan, noise: CoordinateNoise, seed: int, start: DevicePoses | None = None) -> Case:
    """Coordinates with noise, half as much of it again shared by neighbouring pixels, and intrinsics slightly wrong."""
    rng = np.random.default_rng([seed, round(1000 * noise.sigma)])
    images = [torch.from_numpy(_disturbed(c, exact.cells, noise, rng)) for c in exact.coords]
    error = IntrinsicsChange.of((INTRINSICS * rng.standard_normal(6)).tolist())
    camera, projector = error.camera.applied(exact.camera), error.projector.applied(exact.projector)
    S, n = exact.S_scene_world, len(exact.truth)
    rows = np.array(exact.sigma) * (S.scale, np.pi / 180, S.scale, np.pi / 180)
    truth, given = (Rig.of([exact.camera] * n, exact.projector, exact.truth, S),
                    Rig.of([camera] * n, projector, start or exact.start, S))  # fmt: skip
    prior = PosePrior(*torch.from_numpy(np.tile(rows, (n, 1))).unbind(1), intrinsics=INTRINSICS)
    return Case(truth, given, CoordinateMaps.of(images), prior, exact)


def _disturbed(
    coords: Float[ndarray, "h w 2"], cells: NoisyCells, noise: CoordinateNoise, rng: np.random.Generator
) -> Float[ndarray, "h w 2"]:
    rough = rng.standard_normal(coords.shape)
    smooth = gaussian_filter(rough, (SHARED_PIXELS, SHARED_PIXELS, 0))
    shared = 0.5 * noise.sigma * smooth / smooth.std()
    mask = np.isfinite(coords[..., 0])
    return (disturb_coords(coords, mask, cells, noise, rng) + shared).astype(np.float32)


_KNOWN = 0  # the frame whose baseline is known


def errors_of(case: Case, found: Adjustment) -> dict[str, Any]:
    """Figures of a row, where the baseline of the first frame is known, and the frames are aligned with the truth."""
    n, truth = case.truth.frames, case.truth
    rig = restore(truth, found.rig, baseline_scale(truth, found.rig, _KNOWN))
    P = gauge_projection(rig, _KNOWN)
    C = P @ found.covariance @ P.T
    turn = log_se3(rig.T_world_camera @ inverse(truth.T_world_camera))[:, 3:]
    centre = (rig.T_world_camera - truth.T_world_camera)[:, :3, 3]
    camera = torch.cat([centre, turn], 1) / _sigma(by_camera(rig), C).reshape(n, 6)
    rho = log_se3(rig.T_camera_projector @ inverse(truth.T_camera_projector))
    others = torch.arange(n) != _KNOWN
    relative = (rho / C.diagonal()[6 * n :].clamp_min(1e-30).sqrt().reshape(n, 6))[others]
    baseline = torch.log(rig.baseline / truth.baseline)[others]
    stated = _sigma(torch.stack([of_baselines(rig, k) for k in range(n)]), C)[others]
    J, lengths = _between_cameras(rig)
    apart = (lengths - _between_cameras(truth)[1]) / _sigma(J, C)
    parts = {
        "relative": relative.flatten(),
        "camera": camera.flatten(),
        "length": torch.cat([baseline / stated, apart]),
    }
    return {
        **{k: [float((z.abs() < m).double().mean()) for m in (1, 2)] + [rms(z)] for k, z in parts.items()},
        "camera_mm": rms(centre) * 3**0.5 / case.exact.S_scene_world.scale,
        "camera_deg": float(np.degrees(rms(turn) * 3**0.5)),
        "baseline_percent": 100 * rms(baseline), "baseline_sigma_percent": 100 * rms(stated),
    }  # fmt: skip


def rms(values: Tensor) -> float:
    """Root mean square."""
    return float(values.pow(2).mean().sqrt())


def _sigma(J: Float[Tensor, "k unknowns"], C: Float[Tensor, "unknowns unknowns"]) -> Float[Tensor, "k"]:
    return ((J @ C) * J).sum(1).clamp_min(1e-30).sqrt()


def by_camera(rig: Rig) -> Float[Tensor, "k unknowns"]:
    """Derivatives of each camera's position and rotation vector."""
    n = rig.frames
    J = torch.zeros(n, 6, 12 * n, dtype=torch.float64)
    for k in range(n):
        own = slice(6 * k, 6 * k + 6)
        J[k, :, own] = torch.eye(6, dtype=torch.float64)
        J[k, :3, 6 * k + 3 : 6 * k + 6] = -hat(rig.T_world_camera[k, :3, 3])
    return J.flatten(0, 1)


def _between_cameras(rig: Rig) -> tuple[Float[Tensor, "pairs unknowns"], Float[Tensor, "pairs"]]:
    """Distances of each camera from the next ones, and their derivatives."""
    n, centre = rig.frames, rig.T_world_camera[:, :3, 3]
    by_centre = by_camera(rig).reshape(n, 6, -1)[:, :3]
    first = torch.arange(n)
    second = (first + n // 3) % n
    apart = centre[second] - centre[first]
    length = apart.norm(dim=-1)
    J = ((apart / length[:, None])[:, None] @ (by_centre[second] - by_centre[first])).squeeze(1)
    return J, length


TWO_STARTS = (1, "usual")  # seed and noise of the scans that are also adjusted from their true poses
QUANTITIES = ("relative", "camera", "length")


@dataclass(frozen=True)
class Row:
    """One scan. Shares: within 1 sigma, within 2 sigma, RMS of error over sigma."""

    scene: str
    seed: int
    noise: str
    relative: list[float]
    camera: list[float]
    length: list[float]
    camera_mm: float  # RMS error of the positions of cameras
    camera_deg: float
    baseline_percent: float  # RMS error of the baselines that are not known
    baseline_sigma_percent: float  # RMS of what is stated
    apart: float | None  # results of rough and true starts, RMS over all pose parameters, in sigma
    seconds: float


def measure(exact: ExactScan, scene: str, seed: int, noise: str) -> Row:
    """Adjust from rough starting poses; the first scan with usual noise also from the true ones."""
    case, begin = make_case(exact, NOISES[noise], seed), time.monotonic()
    found = adjust(case.start, case.maps, case.prior, "free", AdjustmentSettings())
    seconds, other = time.monotonic() - begin, None
    if (seed, noise) == TWO_STARTS:
        near = make_case(exact, NOISES[noise], seed, exact.truth)
        other = apart(found, adjust(near.start, near.maps, near.prior, "free", AdjustmentSettings()))
    return Row(scene, seed, noise, **errors_of(case, found), apart=other, seconds=seconds)


def apart(a: Adjustment, b: Adjustment) -> float:
    """RMS difference of two results in units of the first one's sigma, after one common similarity."""
    scale = float(torch.exp(torch.log(a.rig.baseline / b.rig.baseline).mean()))
    rig = restore(a.rig, b.rig, scale)
    P = gauge_projection(a.rig)
    sigma = (P @ a.covariance @ P.T).diagonal().clamp_min(1e-30).sqrt()
    pairs = ((rig.T_world_camera, a.rig.T_world_camera), (rig.T_camera_projector, a.rig.T_camera_projector))
    steps = [log_se3(theirs @ inverse(mine)).reshape(-1) for theirs, mine in pairs]
    return float((torch.cat(steps) / sigma).pow(2).mean().sqrt())


def summary(rows: list[Row]) -> str:
    """A Markdown table: shares within 1 and 2 sigma, per scene and over all."""
    lines = []
    for scene in [*dict.fromkeys(r.scene for r in rows), None]:
        mine = [r for r in rows if scene in (None, r.scene)]
        cells = []
        for name in QUANTITIES:
            one, two, ratio = np.array([getattr(r, name) for r in mine]).T
            cells.append(f"{100 * one.mean():.0f} %, {100 * two.mean():.0f} % ({np.sqrt((ratio**2).mean()):.2f})")
        starts = [r.apart for r in mine if r.apart is not None]
        median = f"{np.median(starts):.2f}" if starts else ""
        lines.append((scene or "all", str(len(mine)), *cells, median))
    return markdown(("scene", "scans", "relative poses", "camera poses", "lengths", "starts apart"), lines)


def main() -> None:
    """Run the benchmark."""
    given = options(
        __doc__, scenes=BUILT_IN, seeds=[1, 2, 3], noises=NOISES, output=Path("benchmarks/results/coverage.json")
    )
    rows = Rows(given.output, kept_rows(given.output, Row))
    for seed in given.seeds:
        for scene in given.scenes:
            wanted = [n for n in given.noises if not rows.have(scene=scene, seed=seed, noise=n)]
            exact = exact_scan(scene, seed) if wanted else None
            for noise in wanted:
                assert exact is not None
                rows.add(measure(exact, scene, seed, noise))
    print(summary(rows))


if __name__ == "__main__":
    main()

"""How well first-order steps find the poses if the surface is known: the true one, fixed.

    python -m benchmarks.pose_conditioning [--scenes cone-and-cylinder head frog] [--seeds 1 2] [--steps 10000]

The scans are those of `benchmarks.accuracy`, with their noise and their rough starting poses. Rays are cast at the true
mesh; the residual is the projector coordinate that is predicted where they hit it, minus the decoded one. 2024 random
pixels a step, mean L1 loss, Adam at the paper's rate of 1e-3, under several readings of what the paper leaves open:
increments (camera and projector independently; the frame about the object and the projector relative to its camera;
these, whitened by the frame's Gauss-Newton matrix at the start) and decay (exponential, as in `sl-neus-paper`; cosine).
Gauss-Newton for comparison. Results are written after each run, and runs whose results are there are not repeated.
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from benchmarks.accuracy import FRAMES
from benchmarks.common.measuring import Rows, kept_rows, options
from benchmarks.common.runs import made_once
from sl_nerfstudio.dataparser.dataparser import LoadedScan
from sl_nerfstudio.evaluation.reference import compare_poses
from sl_nerfstudio.geometry.devices import Intrinsics, project, project_jacobian, unproject
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, adjoint, exp_se3, inverse, rotate, transform
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import read_ground_truth
from sl_nerfstudio.synthesis.config import SynthConfig


@dataclass(frozen=True)
class Poses:
    """Poses of all devices in the scene."""

    camera: Float[Tensor, "frames 4 4"]
    projector: Float[Tensor, "frames 4 4"]

    def moved(self, camera: Float[Tensor, "frames 6"], projector: Float[Tensor, "frames 6"]) -> "Poses":
        """After a twist of each device in the scene."""
        return Poses(exp_se3(camera) @ self.camera, exp_se3(projector) @ self.projector)


@dataclass(frozen=True)
class Residuals:
    """Predicted minus decoded coordinates, pattern pixels, of the rays that hit the surface."""

    frame: Int[Tensor, "n"]
    value: Float[Tensor, "n 2"]
    by_camera: Float[Tensor, "n 2 6"]  # by a twist of the camera in the scene (translation, rotation)
    by_projector: Float[Tensor, "n 2 6"]


class Problem:
    """Decoded pixels of a scan and its true surface, in the scene frame in which the methods train."""

    def __init__(self, loaded: LoadedScan, truth: Mesh) -> None:
        """`truth` in the scan's world; the pixels are those for training."""
        import open3d as o3d

        S, scan = loaded.S_scene_world, loaded.scan
        corners = S.points(truth.vertices)
        self._tensor = o3d.core.Tensor
        self._tree = o3d.t.geometry.RaycastingScene(nthreads=torch.get_num_threads())
        self._tree.add_triangles(
            o3d.core.Tensor(corners.astype(np.float32)), o3d.core.Tensor(truth.faces.astype(np.uint32))
        )
        a, b, c = (torch.from_numpy(corners[truth.faces[:, k]]) for k in range(3))
        self._corner, self._normal = a, torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
        self._projector = Intrinsics.of(scan.projector, torch.float64)
        samples = loaded.samples
        pixels = samples.at((samples.coords[:, 0].isfinite() & ~samples.held_out).nonzero()[:, 0])
        self.frame, self.coords = pixels.frame, pixels.coords.double()
        cameras = [Intrinsics.of(frame.camera, torch.float64) for frame in scan.frames]
        self._ray = torch.cat([unproject(c, pixels.uv[pixels.frame == k].double()) for k, c in enumerate(cameras)])
        self.frames = len(cameras)

    def residuals(self, poses: Poses, index: Int[Tensor, "rays"]) -> Residuals:
        """Residuals of the pixels `index`, where the surface is locally a plane. Rays that miss it say nothing."""
        frame = self.frame[index]
        T = poses.camera[frame]
        origin, ray = T[:, :3, 3], rotate(T, self._ray[index])
        answer = self._tree.cast_rays(self._tensor(torch.cat([origin, ray], 1).float().numpy()))
        hit = torch.from_numpy(np.isfinite(answer["t_hit"].numpy())).nonzero()[:, 0]
        face = torch.from_numpy(answer["primitive_ids"].numpy().astype(np.int64))[hit]
        frame, origin, ray, normal = frame[hit], origin[hit], ray[hit], self._normal[face]
        across = (ray * normal).sum(-1, keepdim=True)
        p = origin + ((self._corner[face] - origin) * normal).sum(-1, keepdim=True) / across * ray
        T = inverse(poses.projector)[frame]
        p_projector = transform(T, p)
        value = project(self._projector, p_projector)[0] - self.coords[index[hit]]
        by_point = project_jacobian(self._projector, p_projector) @ T[:, :3, :3]
        # a camera that moves takes its ray along; where the ray meets the surface slides along the surface
        slope = (by_point @ ray[..., None]) / across[..., None]
        carried = by_point - slope * normal[:, None]
        return Residuals(frame, value, _by_twist(carried, p), _by_twist(-by_point, p))


def _by_twist(by_point: Float[Tensor, "n 2 3"], p: Float[Tensor, "n 3"]) -> Float[Tensor, "n 2 6"]:
    """Derivatives by the twist that carries points along."""
    return torch.cat([by_point, torch.linalg.cross(p[:, None].expand_as(by_point), by_point)], -1)


def of_devices(poses: Poses, independent: bool) -> tuple[Float[Tensor, "frames 6 12"], Float[Tensor, "frames 6 12"]]:
    """Twists of camera and projector in the scene by the 12 increments of a frame.

    Independent ones turn each device about itself (`T <- T exp(xi)`). Those of a rig move the frame as a whole about
    the object (delta), and its projector relative to its camera (rho): `T_camera <- exp(delta) T_camera` and
    `T_camera_projector <- exp(rho) T_camera_projector`.
    """
    camera = adjoint(poses.camera)
    zero, one = torch.zeros_like(camera), torch.eye(6, dtype=camera.dtype).expand_as(camera)
    if independent:
        return torch.cat([camera, zero], -1), torch.cat([zero, adjoint(poses.projector)], -1)
    return torch.cat([one, zero], -1), torch.cat([one, camera], -1)


def per_frame(
    frame: Int[Tensor, "n"], values: Float[Tensor, "n *shape"], frames: int
) -> Float[Tensor, "frames *shape"]:
    """Sums over the rows of each frame."""
    return values.new_zeros(frames, *values.shape[1:]).index_add_(0, frame, values)


Increments = Literal["independent", "rig", "whitened"]
Decay = Literal["exponential", "cosine"]
RATE = 1e-3  # the paper's for poses
_BETAS, _EPS = (0.9, 0.999), 1e-15
_COSINE_END = 0.01  # of the rate
_STILL = 1e-9  # scene units and radian a step: the exponential decay falls below it at step 5,785, and nothing moves


@dataclass(frozen=True)
class AdamChoice:
    """One reading of what the paper leaves open."""

    increments: Increments
    decay: Decay


def rate_at(decay: Decay, step: int, steps: int) -> float:
    """Exponential as in `sl-neus-paper`: from 1e-3 to 5e-12 at step 8,000. Cosine: to a hundredth over the run."""
    if decay == "exponential":
        return RATE * (5e-12 / RATE) ** min(step / 8000, 1.0)
    return RATE * (_COSINE_END + (1 - _COSINE_END) * 0.5 * (1 + math.cos(math.pi * step / steps)))


def normal_matrices(
    problem: Problem, poses: Poses, independent: bool, pixels: int, seed: int
) -> Float[Tensor, "f 12 12"]:
    """The Gauss-Newton matrix of each frame, divided by its number of residuals: squared pixels per squared unit."""
    index = drawn(problem, pixels * problem.frames, torch.Generator().manual_seed(seed))
    r = problem.residuals(poses, index)
    camera, projector = of_devices(poses, independent)
    J = r.by_camera @ camera[r.frame] + r.by_projector @ projector[r.frame]
    count = per_frame(r.frame, torch.ones(len(J), dtype=J.dtype), problem.frames).clamp_min(1)
    return per_frame(r.frame, J.mT @ J, problem.frames) / count[:, None, None]


def whitening(H: Float[Tensor, "f 12 12"]) -> Float[Tensor, "f 12 12"]:
    """Increments that all change the residuals of their frame alike, and as much as the old ones do on average.

    The mean is the geometric one, so that the same rate can be used.
    """
    value, vector = torch.linalg.eigh(H)
    root = value.clamp_min(1e-12 * float(value.max())).sqrt()
    return vector * (root.log().mean(-1, keepdim=True).exp() / root)[:, None]


def drawn(problem: Problem, count: int, generator: torch.Generator) -> Tensor:
    """Random pixels of all frames."""
    return torch.randint(len(problem.frame), (count,), generator=generator)


def adam(problem: Problem, start: Poses, choice: AdamChoice, steps: int, rays: int, seed: int) -> Poses:
    """Adam on the mean L1 residual. Every step is an increment to the present poses."""
    generator = torch.Generator().manual_seed(seed)
    independent = choice.increments == "independent"
    W = None
    if choice.increments == "whitened":
        W = whitening(normal_matrices(problem, start, False, 3000, seed))
    poses, m, v = start, torch.zeros(problem.frames, 12).double(), torch.zeros(problem.frames, 12).double()
    for step in range(steps):
        rate = rate_at(choice.decay, step, steps)
        if rate < _STILL:
            break
        r = problem.residuals(poses, drawn(problem, rays, generator))
        sign = r.value.sign()[:, None]
        twists = per_frame(r.frame, torch.cat([sign @ r.by_camera, sign @ r.by_projector], -1), problem.frames)
        camera, projector = of_devices(poses, independent)
        if W is not None:
            camera, projector = camera @ W, projector @ W
        g = (twists[..., :6] @ camera + twists[..., 6:] @ projector)[:, 0] / rays
        m, v = _BETAS[0] * m + (1 - _BETAS[0]) * g, _BETAS[1] * v + (1 - _BETAS[1]) * g * g
        mean, square = m / (1 - _BETAS[0] ** (step + 1)), v / (1 - _BETAS[1] ** (step + 1))
        move = -rate * mean / (square.sqrt() + _EPS)
        poses = _moved(poses, camera, projector, move)
    return poses


def gauss_newton(problem: Problem, start: Poses, iterations: int, pixels: int, seed: int) -> Poses:
    """Gauss-Newton with Geman-McClure weights, each frame by itself: the surface is known, so nothing joins them.

    The kernel's width follows twice the median residual of the frame. The damping starts at a thousandth of the
    diagonal and halves with every iteration: kept, it would hold the weak directions where they are.
    """
    index = drawn(problem, pixels * problem.frames, torch.Generator().manual_seed(seed))
    poses = start
    for iteration in range(iterations):
        r = problem.residuals(poses, index)
        size = r.value.norm(dim=-1)
        width = 2 * torch.stack([_median(size[r.frame == k]) for k in range(problem.frames)])[r.frame]
        weight = (width**2 / (width**2 + size**2)) ** 2
        camera, projector = of_devices(poses, independent=False)
        J = r.by_camera @ camera[r.frame] + r.by_projector @ projector[r.frame]
        scaled = weight[:, None, None] * J.mT
        H = per_frame(r.frame, scaled @ J, problem.frames)
        g = per_frame(r.frame, (scaled @ r.value[..., None])[..., 0], problem.frames)
        damping = 1e-3 * 0.5**iteration
        H = H + torch.diag_embed(damping * H.diagonal(dim1=-2, dim2=-1) + 1e-9)
        poses = _moved(poses, camera, projector, -torch.linalg.solve(H, g))
    return poses


def _moved(poses: Poses, camera: Tensor, projector: Tensor, increment: Float[Tensor, "frames 12"]) -> Poses:
    return poses.moved((camera @ increment[..., None])[..., 0], (projector @ increment[..., None])[..., 0])


def _median(values: Tensor) -> Tensor:
    return values.median() if len(values) else values.new_tensor(1.0)


RAYS = 2024
CHOICES = {
    f"{increments}, {decay}": AdamChoice(increments, decay)
    for increments in get_args(Increments)
    for decay in get_args(Decay)
}
GAUSS_NEWTON = "Gauss-Newton"
_ITERATIONS, _PIXELS = 40, 3000  # of Gauss-Newton, and of the matrices, a frame


@dataclass(frozen=True)
class Row:
    """One run; RMS errors of the cameras after one similarity, in mm and degrees."""

    scene: str
    seed: int
    way: str
    steps: int
    start_mm: float
    start_deg: float
    end_mm: float
    end_deg: float
    least_root: float  # smallest square root of an eigenvalue of a frame's matrix: pixels per scene unit or radian
    largest_root: float
    seconds: float


def measure(problem: Problem, S: Similarity, poses: tuple[DevicePoses, DevicePoses], key: tuple, seed: int) -> Row:
    """One way from the starting poses (the second are the true ones)."""
    start, true = poses
    scene, number, way, steps = key
    first, begin = _in_scene(start, S), time.monotonic()
    if way == GAUSS_NEWTON:
        found = gauss_newton(problem, first, steps, _PIXELS, seed)
    else:
        found = adam(problem, first, CHOICES[way], steps, RAYS, seed)
    seconds = time.monotonic() - begin
    independent = way.startswith("independent")
    roots = torch.linalg.eigvalsh(normal_matrices(problem, _in_scene(true, S), independent, _PIXELS, seed)).sqrt()
    before = compare_poses(start, true).camera
    after = compare_poses(DevicePoses(found.camera.numpy(), found.projector.numpy()).mapped(S.inverse()), true).camera
    return Row(
        scene, number, way, steps, before.translation_rmse, before.rotation_rmse_deg, after.translation_rmse,
        after.rotation_rmse_deg, float(roots.min()), float(roots.max()), seconds,
    )  # fmt: skip


def _in_scene(poses: DevicePoses, S: Similarity) -> Poses:
    scene = poses.mapped(S)
    return Poses(torch.from_numpy(scene.T_world_camera), torch.from_numpy(scene.T_world_projector))


def main() -> None:
    """Run the benchmark; the scans are made once."""
    given = options(
        __doc__, scenes=FRAMES, seeds=[1, 2], ways=dict.fromkeys([GAUSS_NEWTON, *CHOICES]), steps=10_000,
        folder=Path("outputs/pose_conditioning"), output=Path("benchmarks/results/pose_conditioning.json"),
    )  # fmt: skip
    rows = Rows(given.output, kept_rows(given.output, Row), rays=RAYS)
    for seed in given.seeds:
        for scene in given.scenes:
            keys = [(scene, seed, w, _ITERATIONS if w == GAUSS_NEWTON else given.steps) for w in given.ways]
            names = ("scene", "seed", "way", "steps")
            wanted = [key for key in keys if not rows.have(**dict(zip(names, key, strict=True)))]
            if not wanted:
                continue
            loaded = made_once(SynthConfig(scene=scene, frames=FRAMES[scene], seed=seed), given.folder)
            truth = read_ground_truth(loaded.scan)
            assert truth.mesh_path is not None and truth.poses is not None
            problem = Problem(loaded, read_mesh(truth.mesh_path))
            for key in wanted:
                rows.add(measure(problem, loaded.S_scene_world, (loaded.scan.poses, truth.poses), key, seed))


if __name__ == "__main__":
    main()

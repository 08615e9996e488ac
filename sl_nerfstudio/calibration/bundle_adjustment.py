"""Joint adjustment of all cameras and projectors from decoded coordinates.

Second order (Levenberg-Marquardt) with a Geman-McClure kernel whose width shrinks from the size of
the starting errors to the size of the noise (graduated non-convexity: Yang et al., RA-L 2020), priors
from the stated uncertainty of the starting poses, and a fixed gauge. See `linearisation` for the
residuals, and docs/method.md for why this comes before, and not out of, volume rendering.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.calibration.coordinate_maps import CoordinateMaps
from sl_nerfstudio.calibration.linearisation import (
    Anchors,
    NormalEquations,
    Observations,
    Residuals,
    Rig,
    linearise,
    normal_equations,
    residuals_of,
)
from sl_nerfstudio.calibration.modes import RefinePoses, free_directions
from sl_nerfstudio.geometry.devices import project, unproject
from sl_nerfstudio.geometry.se3 import hat, inverse, log_se3, log_so3, transform
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.progress import track

_OBSERVE_EVERY = 4  # iterations between new choices of which frame sees which anchor
_INDEPENDENT_ROWS = 50  # of a frame, while residuals come from wrong poses rather than from noise
_SETTLED = 0.98  # of its last width: the kernel has stopped shrinking
_SMALL_STEP = 1e-4  # of the scene's radius, or radian: the adjustment has converged
_DAMPING = 1e-4  # of the diagonal, at the start of each stage
_NOISE_FLOOR = 0.01  # projector pixels: residuals are not believed to be better than this


@dataclass(frozen=True)
class PosePrior:
    """How well the starting poses are known: 1 sigma per frame, lengths in the scene's unit, angles in radian."""

    frame_translation: Float[Tensor, "frames"]
    frame_rotation: Float[Tensor, "frames"]
    relative_translation: Float[Tensor, "frames"]
    relative_rotation: Float[Tensor, "frames"]


@dataclass
class AdjustmentSettings:
    """How much work the joint adjustment is."""

    anchors_per_frame: int = 600
    """Decoded pixels of each frame that are looked for in other frames."""
    max_anchors: int = 12000
    """The same over all frames, at most: time grows with this number, accuracy with its square root."""
    frames_per_anchor: int = 8
    """Other frames in which each of them is looked for, at most."""
    max_iterations: int = 40
    """Levenberg-Marquardt steps, at most."""
    rigid_iterations: int = 5
    """Steps, at most, in which frames move as a whole before projectors move against their cameras."""
    seed: int = 0
    """Seed of the choice of pixels."""


@dataclass(frozen=True)
class Adjustment:
    """What the joint adjustment found."""

    rig: Rig
    covariance: Float[Tensor, "unknowns unknowns"]  # of (delta, rho), gauge freedom projected out
    noise_px: float  # estimated noise of one look-up, projector pixels
    iterations: int
    median_before_px: float
    median_after_px: float


@dataclass(frozen=True)
class _Stage:
    """A part of the adjustment."""

    refine: RefinePoses
    rough: bool  # residuals are still made by wrong poses: those of one frame err together, and count as few
    iterations: int  # at most


def _stages(refine: RefinePoses, settings: AdjustmentSettings) -> list[_Stage]:
    """Frames find each other as wholes; then everything moves; then everything moves, trusting every residual.

    As long as poses are wrong, the thousands of residuals of a frame are a handful of independent measurements.
    Counted as thousands they overrule the prior along directions they hardly know, and the scene drifts away.
    """
    rough = max(settings.max_iterations // 2 - settings.rigid_iterations, 1)
    found = [_Stage(refine, True, rough), _Stage(refine, False, settings.max_iterations)]
    if refine in ("free", "rigid-rig"):  # a static projector has its place already
        found.insert(0, _Stage("known-rig", True, settings.rigid_iterations))
    return found


def place_anchors(rig: Rig, maps: CoordinateMaps, per_frame: int, generator: torch.Generator) -> Anchors:
    """Random decoded pixels whose neighbourhood is smooth and whose rays meet in front of both devices."""
    parts = []
    for frame in range(rig.frames):
        uv = maps.draw(frame, per_frame, generator)
        index = torch.full((len(uv),), frame)
        seen = maps.look_up(index, uv)
        d_camera = unproject(rig.camera[frame], uv)
        T = rig.T_camera_projector[frame]
        d_projector = (T[:3, :3] @ unproject(rig.projector, seen.uv_projector)[..., None]).squeeze(-1)
        depth, depth_projector = closest_approach(
            torch.zeros_like(d_camera), d_camera, T[:3, 3].expand_as(d_camera), d_projector
        )
        good = seen.valid & (depth > 0) & (depth_projector > 0)
        parts.append(Anchors(index, d_camera, seen.uv_projector, depth).chosen(good))
    return Anchors(*(torch.cat([getattr(p, f) for p in parts]) for f in ("frame", "d_camera", "uv_projector", "depth")))


def observe(
    rig: Rig, anchors: Anchors, maps: CoordinateMaps, per_anchor: int, gate_px: float, generator: torch.Generator
) -> Observations:
    """For every anchor up to `per_anchor` other frames that decoded something near it, within `gate_px` of it."""
    chosen = []
    p_world = transform(rig.T_world_camera[anchors.frame], anchors.depth[:, None] * anchors.d_camera)
    for j in range(rig.frames):
        anchor = (anchors.frame != j).nonzero().squeeze(-1)
        frame = torch.full_like(anchor, j)
        p_j = transform(inverse(rig.T_world_camera[j]), p_world[anchor])
        uv_camera, in_front = project(rig.camera[j], p_j)
        expected, lit = project(rig.projector, transform(inverse(rig.T_camera_projector[j]), p_j))
        miss = (maps.decoded_at(frame, uv_camera) - expected).norm(dim=-1)
        keep = in_front & lit & (miss < gate_px)  # False where nothing is decoded
        chosen.append(torch.stack([anchor[keep], frame[keep]]))
    rows = torch.cat(chosen, 1)
    rows = rows[:, torch.randperm(rows.shape[1], generator=generator)]
    rows = rows[:, torch.argsort(rows[0], stable=True)]
    starts = torch.searchsorted(rows[0].contiguous(), rows[0].contiguous())
    rows = rows[:, torch.arange(rows.shape[1]) - starts < per_anchor]
    return Observations(rows[0], rows[1])


def prior_equations(
    prior: PosePrior, start: Rig, rig: Rig
) -> tuple[Float[Tensor, "unknowns unknowns"], Float[Tensor, "unknowns"]]:
    """Information matrix and gradient of the departure from the starting poses."""
    n = rig.frames
    delta = log_se3(rig.T_world_camera @ inverse(start.T_world_camera))
    weight = torch.cat([(1 / s**2)[:, None].expand(n, 3) for s in (prior.frame_translation, prior.frame_rotation)], 1)
    # relative: position and rotation of the projector in camera axes
    t = rig.T_camera_projector[:, :3, 3]
    e = torch.cat(
        [
            t - start.T_camera_projector[:, :3, 3],
            log_so3(rig.T_camera_projector[:, :3, :3] @ start.T_camera_projector[:, :3, :3].transpose(1, 2)),
        ],
        1,
    )
    eye = torch.eye(3, dtype=torch.float64).expand(n, 3, 3)
    J = torch.cat([torch.cat([eye, -hat(t)], -1), torch.cat([torch.zeros_like(eye), eye], -1)], -2)
    w_relative = torch.cat(
        [(1 / s**2)[:, None].expand(n, 3) for s in (prior.relative_translation, prior.relative_rotation)], 1
    )
    JtW = J.transpose(1, 2) * w_relative[:, None, :]
    H = torch.zeros(12 * n, 12 * n, dtype=torch.float64)
    H[: 6 * n, : 6 * n] = torch.diag(weight.reshape(-1))
    H[6 * n :, 6 * n :] = torch.block_diag(*(JtW @ J))
    return H, torch.cat([(weight * delta).reshape(-1), (JtW @ e[..., None]).reshape(-1)])


def gauge_directions(rig: Rig) -> Float[Tensor, "unknowns 7"]:
    """Increments that move the whole scene by a similarity: no residual feels them."""
    n = rig.frames
    out = torch.zeros(2, n, 6, 7, dtype=torch.float64)
    out[0, :, :, :6] = torch.eye(6, dtype=torch.float64)
    out[0, :, :3, 6] = rig.T_world_camera[:, :3, 3]
    out[1, :, :3, 6] = rig.T_camera_projector[:, :3, 3]
    return out.reshape(12 * n, 7)


def _kernel_weight(r: Float[Tensor, "n 2"], width: float) -> Float[Tensor, "n"]:
    return (width**2 / (width**2 + (r * r).sum(-1))) ** 2


def _cost(r: Float[Tensor, "n 2"], width: float) -> float:
    r2 = (r * r).sum(-1)
    return float((width**2 * r2 / (width**2 + r2)).sum())


def _weights(r: Residuals, width: float) -> tuple[Tensor, Tensor]:
    cross = _kernel_weight(r.cross, width)
    return _kernel_weight(r.own, width), torch.where(r.cross_valid, cross, torch.zeros_like(cross))


def adjust(
    start: Rig,
    maps: CoordinateMaps,
    prior: PosePrior,
    refine: RefinePoses,
    settings: AdjustmentSettings,
) -> Adjustment:
    """Refine all poses jointly. The scene must be normalised: origin at the object's centre, radius about one.

    The gauge is left where the prior puts it; see `gauge.restore` for pinning the scale. Frames that share nothing
    with others stay where they are.
    """
    generator = torch.Generator().manual_seed(settings.seed)
    rig = start
    per_frame = max(1, min(settings.anchors_per_frame, settings.max_anchors // rig.frames))
    anchors = place_anchors(rig, maps, per_frame, generator)
    stages, stage_start = _stages(refine, settings), 0
    everything = float("inf")
    observations = observe(rig, anchors, maps, settings.frames_per_anchor, everything, generator)
    r = residuals_of(rig, anchors, observations, maps)
    if settings.max_iterations < 1 or not r.cross_valid.any():
        return _unmoved(start, prior, free_directions(refine, rig))
    before = float(r.cross[r.cross_valid].norm(dim=-1).median())
    noise = max(before, _NOISE_FLOOR)
    width, damping = 2 * noise, _DAMPING
    iteration = 0
    for iteration in track(range(settings.max_iterations), "Adjusting poses"):
        if iteration % _OBSERVE_EVERY == 0 and iteration < settings.max_iterations // 2:
            observations = observe(rig, anchors, maps, settings.frames_per_anchor, everything, generator)
        linear = linearise(rig, anchors, observations, maps)
        r = linear.residuals
        median = float(r.cross[r.cross_valid].norm(dim=-1).median())
        noise = _noise(r, width)
        previous, width = width, max(min(width, 2 * median), 3 * noise)
        own_weight, cross_weight = _weights(r, width)
        equations = normal_equations(linear, anchors, observations, own_weight, cross_weight, rig.frames)
        H_prior, g_prior = prior_equations(prior, start, rig)
        independent = _INDEPENDENT_ROWS * rig.frames / max(int(r.cross_valid.sum()), 1)
        trust = noise**2 / min(independent, 1.0) if stages[0].rough else noise**2
        B = free_directions(stages[0].refine, rig)
        H = B.T @ (equations.H + trust * H_prior) @ B
        g = B.T @ (equations.g + trust * g_prior)
        rig, anchors, damping, size = _step(rig, anchors, observations, maps, equations, B, H, g, r, width, damping)
        small = size < _SMALL_STEP and (damping < 1 or size == 0)  # or damped to be small
        settled = width > _SETTLED * previous and small
        over = settled or iteration + 1 - stage_start >= stages[0].iterations
        if len(stages) > 1 and over:
            stages, stage_start, damping = stages[1:], iteration + 1, _DAMPING
        elif settled and len(stages) == 1:
            break
    linear = linearise(rig, anchors, observations, maps)
    r = linear.residuals
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 4 * width)
    # at the result, with every residual trusted, in whichever stage the steps ended
    equations = normal_equations(linear, anchors, observations, *_weights(r, width), rig.frames)
    B = free_directions(refine, rig)
    H = B.T @ (equations.H + noise**2 * prior_equations(prior, start, rig)[0]) @ B
    return Adjustment(
        rig=rig,
        covariance=_covariance(rig, B, H, noise),
        noise_px=noise,
        iterations=iteration + 1,
        median_before_px=before,
        median_after_px=float(r.cross[inliers].norm(dim=-1).median()),
    )


def _unmoved(start: Rig, prior: PosePrior, B: Tensor) -> Adjustment:
    """The starting poses, where no step is asked for or no frame sees what another decoded; known as the prior says."""
    H = B.T @ prior_equations(prior, start, start)[0] @ B
    nan = float("nan")
    return Adjustment(start, _covariance(start, B, H, 1.0), _NOISE_FLOOR, 0, nan, nan)


def _noise(r: Residuals, width: float) -> float:
    """Robust 1 sigma of one residual component among those that the kernel keeps."""
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 2 * width)
    values = torch.cat([r.cross[inliers].reshape(-1)]).abs()
    return max(float(values.median()) * 1.4826, _NOISE_FLOOR)


def _step(
    rig: Rig,
    anchors: Anchors,
    observations: Observations,
    maps: CoordinateMaps,
    equations: NormalEquations,
    B: Tensor,
    H: Tensor,
    g: Tensor,
    r: Residuals,
    width: float,
    damping: float,
) -> tuple[Rig, Anchors, float, float]:
    """One damped step that lowers the cost, trying stronger damping until it does."""
    n = rig.frames
    for _ in range(8):
        x = B @ torch.linalg.solve(H + damping * torch.diag(torch.diag(H)), -g) if B.shape[1] else B.sum(1)
        depth = anchors.depth + equations.depth_step(x)
        depth = depth.clamp(0.7 * anchors.depth, 1.4 * anchors.depth)
        moved = rig.moved(x[: 6 * n].reshape(n, 6), x[6 * n :].reshape(n, 6))
        after = residuals_of(moved, anchors.at(depth), observations, maps)
        both = r.cross_valid & after.cross_valid
        old = _cost(r.own, width) + _cost(r.cross[both], width)
        new = _cost(after.own, width) + _cost(after.cross[both], width)
        if new < old:
            return moved, anchors.at(depth), max(damping / 5, 1e-9), float(x.abs().max())
        damping = damping * 10
    return rig, anchors, damping, 0.0


def _covariance(rig: Rig, B: Tensor, H: Tensor, noise: float) -> Float[Tensor, "unknowns unknowns"]:
    """Posterior covariance of (delta, rho) with the freedom of the whole scene projected out."""
    if B.shape[1] == 0:
        return torch.zeros(12 * rig.frames, 12 * rig.frames, dtype=torch.float64)
    C = noise**2 * B @ torch.linalg.inv(H) @ B.T
    G = gauge_directions(rig)
    P = torch.eye(len(C), dtype=torch.float64) - G @ torch.linalg.solve(G.T @ G, G.T)
    return P @ C @ P.T

"""Several searches: which of their ends is the most probable, and which others remain plausible.

A search leads frames home from about their own details away. So others begin elsewhere: where the frames' surfaces
register, beside the best end so far, and at poses as uncertain as the starting ones (basin hopping: Wales and Doye, J.
Phys. Chem. A, 1997). Every end is asked the same question: is it more probable than the best one, by more than the
uncertainty of the answer (`posterior`)? Where none is, the others show what remains possible, each with its weight.
On a surface that slides along itself (a vase about its axis, parallel planes) errors of the look-ups make small minima
wherever a frame may be: the covariance covers how far they spread (randomised maximum likelihood: Chen and Oliver,
Mathematical Geosciences, 2012; the data stay as they are). Ends between which the posterior falls are modes of their
own: the sides of an object that looks the same from several.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from math import exp, log

import numpy as np
import torch
from jaxtyping import Float, Float32, Float64, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import moved_together
from sl_nerfstudio.bundle_adjustment.normal_equations import normal_equations
from sl_nerfstudio.bundle_adjustment.parameters import (
    UNKNOWNS,
    PosePrior,
    PriorTerm,
    RefinePoses,
    alignment,
    baseline_scale,
    gauge_directions,
    restore,
)
from sl_nerfstudio.bundle_adjustment.posterior import GROSS, Odds, odds, with_slides
from sl_nerfstudio.bundle_adjustment.residuals import Rig, linearise
from sl_nerfstudio.bundle_adjustment.search import (
    FRAMES_MOVE,
    SearchProblem,
    SearchProgress,
    SearchStage,
    kernel_of,
    problem_of,
    run_stage,
    search,
    unplaced_frames,
)
from sl_nerfstudio.geometry.devices import PARAMETERS, Device, Intrinsics
from sl_nerfstudio.geometry.lie import Similarity, exp_se3, exp_so3, inverse, log_se3, log_so3
from sl_nerfstudio.parallel import results
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, lattice_step
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near

_ROUGH_DEG = 1.5  # 1 sigma per axis of the median frame's starting rotation, from which the starts are rough
_PATIENCE = 4  # searches beside the best end that lead elsewhere, after which there is no further one
_MOST_HOPS = 12  # of these
_SIZE = 0.3  # distance from the best end at which these begin, in uncertainties of the starting poses
_HALF = 0.5  # share of the frames that every second one moves
_MOST_LEFT = 0.35  # share of a distance within which all frames must return for a search to lead back
_DRAWN = 3  # searches from poses as uncertain as the starting ones, if a result is one of several minima
_SHAKE_SIGMAS = 2.0  # distance from the result, in its sigma, from which further steps should lead back
_SHAKE_STEPS = 15  # most of those steps
_SHAKE_LEFT = 0.25  # share of that distance within which all frames must return: what slides ends 0.25 to 0.7 away
_MOST_FRAMES = 100  # beyond which no further search is made: it takes time, and many frames hold each other
_LEAST_WEIGHT = 1e-4  # of an end, relative to the result, that is worth saying
_BARRIER = 20.0  # nats that the posterior falls between two modes: errors of look-ups make small ones everywhere
_LEAST_TURN_DEG = 5.0  # of a frame, from which an end may be a mode of its own
_BENT = 5.0  # times the noise, by which look-ups may be off half-way
_TURNED = 0.5  # share of the largest rotation from which a frame counts as turned


@dataclass(frozen=True)
class Mode:
    """Another place at which frames may be: there, they are turned as one against the others."""

    log_odds: float  # nats, against the poses of the result
    error: float  # standard error of these
    frames: tuple[int, ...]
    angle_deg: float
    axis: tuple[float, float, float]  # of the turn, in the scene's axes

    def turned(self, R: Float64[ndarray, "3 3"]) -> "Mode":
        """In other axes, to which a rotation leads."""
        x, y, z = (R @ self.axis).tolist()
        return replace(self, axis=(x, y, z))


@dataclass(frozen=True)
class Explored:
    """Ends of searches."""

    problem: SearchProblem  # with the places of lost frames, if they were found, as their starting poses
    refine: RefinePoses
    best: SearchProgress
    others: tuple[SearchProgress, ...] = ()
    settled: bool = True  # the last search led back to the best end, or none was asked for

    @property
    def rig(self) -> Rig:
        """The poses at the best end."""
        return self.best.state.rig

    @property
    def unplaced(self) -> tuple[int, ...]:
        """Frames that do not agree with the others there."""
        return unplaced_frames(self.rig, self.problem.maps, self.best.noise, self.problem.settings)

    @property
    def may_differ(self) -> bool:
        """Whether further searches may lead elsewhere."""
        return self.refine in FRAMES_MOVE and self.rig.frames <= _MOST_FRAMES


def explore(problem: SearchProblem, refine: RefinePoses, first: SearchProgress) -> Explored:
    """The end of a search, or a more probable one of others: from rough starts, and for frames that are lost.

    A lost frame agrees with no others. Where its surface puts it far from where it was given, the stated uncertainty of
    its starting pose was wrong, and now holds about the new place; what was known of its projector against its camera
    stays. From rough starts, searches begin beside the best end as long as they lead back or too many do not.
    """
    found, rough = Explored(problem, refine, first), is_rough(problem.prior, _ROUGH_DEG)
    if not (problem.settings.further_searches and found.may_differ):
        return found
    lost = found.unplaced
    if rough or lost:
        beside = problem.start if rough else first.state.rig
        begin = registered_start(problem, refine, beside, [k for k in range(beside.frames) if k not in lost])
        if begin is not None:
            begin = begin if rough else with_frames_of(beside, begin, lost)
            away = PriorTerm(problem.prior, problem.start, 0.5).energies(begin) > GROSS
            wrong = [k for k in lost if away[k]]
            start = replace(problem.start, T_world_camera=with_frames_of(problem.start, begin, wrong).T_world_camera)
            found, leads_back = _joined(found, replace(problem, start=start), begin)
            if leads_back:
                return found
    if not rough:  # an end that differs by frames that belong nowhere says nothing of the others
        return replace(found, others=())
    generator, patience = torch.Generator().manual_seed(problem.settings.seed), _PATIENCE
    for hop in range(_MOST_HOPS):
        if not patience:
            break
        best = found.best
        beside = _moved(found.rig, problem.prior, _SIZE, 1.0 if hop % 2 else _HALF, generator)
        found, leads_back = _joined(found, found.problem, beside)
        if leads_back:
            return found
        patience = patience - 1 if found.best is best else _PATIENCE
    return replace(found, settled=False)


def _joined(found: Explored, problem: SearchProblem, begin: Rig) -> tuple[Explored, bool]:
    """With the end of a search that begins there, as the best one if it is more probable; whether it leads back."""
    ended = search(problem_of(problem.start, problem.maps, problem.prior, problem.settings, begin), found.refine)
    if ended is None:
        return found, False
    end, noise = ended[0], min(ended[0].noise, found.best.noise)
    if odds(found.problem, end.state.rig, found.rig, noise).better:
        return replace(found, problem=problem, best=end, others=(*found.others, found.best)), False
    left = departure_of(with_frames_of(end.state.rig, found.rig, found.unplaced), found.rig).reshape(2, -1, 6)[0]
    sigmas = (left / problem.prior.sigma[:, :6]).square().mean(1).max().sqrt()
    if float(sigmas) <= _MOST_LEFT * _SIZE:
        return found, True
    return replace(found, others=(*found.others, end)), False


def is_rough(prior: PosePrior, from_deg: float) -> bool:
    """Whether the starting poses of most frames are as uncertain as that."""
    return float(torch.rad2deg(prior.frame_rotation).median()) >= from_deg


def _moved(rig: Rig, prior: PosePrior, size: float, share: float, generator: torch.Generator) -> Rig:
    """Some frames as a whole at poses drawn about theirs, with a share of the uncertainty of the starting poses."""
    chosen = torch.rand(rig.frames, 1, generator=generator, dtype=torch.float64) < share
    draw = torch.randn(rig.frames, 6, generator=generator, dtype=torch.float64)
    delta = torch.where(chosen, size * draw * prior.sigma[:, :6], torch.zeros_like(draw))
    return rig.moved(delta, torch.zeros_like(delta))


# What remains possible beside the result.


def with_others(
    found: Explored, factor: Float[Tensor, "joint k"], unplaced: Sequence[int]
) -> tuple[Float[Tensor, "joint more"], tuple[Mode, ...]]:
    """The covariance's factor, wider by what other ends in the same valley differ, and the modes beyond it.

    Further searches begin at poses as uncertain as the starting ones, which are their prior, if the result, shaken,
    does not lead back. Ends in its valley count by what look-ups say, as it may be within its error. Then each frame
    alone may have slid (`with_slides`). Frames that no search has placed are passed over.
    """
    problem, rig, noise = found.problem, found.rig, found.best.noise
    if not (problem.settings.other_minima and found.may_differ):
        return factor, ()
    generator = torch.Generator().manual_seed(problem.settings.seed)
    ends = list(found.others)
    if not found.settled or not _shaken_leads_back(found, factor, unplaced, generator):
        starts = [drawn_start(rig, problem.prior, found.refine == "free", generator) for _ in range(_DRAWN)]
        again = [problem_of(start, problem.maps, problem.prior, problem.settings) for start in starts]
        ends += [end[0] for end in results([partial(search, p, found.refine) for p in again]) if end]
    near: list[tuple[float, Tensor]] = []  # weights, and increments (delta, rho)
    modes: list[tuple[Odds, Rig]] = []
    for end in (with_frames_of(end.state.rig, rig, unplaced) for end in ends):
        said = odds(problem, end, rig, noise)
        weight = exp(min(said.data + said.error, 0.0))  # starting poses were drawn by their probability
        if weight < _LEAST_WEIGHT:
            continue
        if not _apart(problem, end, rig, noise):
            near.append((weight, departure_of(end, rig)))
        elif said.nats > log(_LEAST_WEIGHT) and all(_apart(problem, end, mode, noise) for _, mode in modes):
            modes.append((said, end))
    modes.sort(key=lambda mode: -mode[0].nats)
    placed = [k for k in range(rig.frames) if k not in unplaced]
    factor = with_slides(problem, found.refine, found.best, widened(factor, near), placed)
    return factor, tuple(_mode(said, other, rig) for said, other in modes)


def _apart(problem: SearchProblem, one: Rig, two: Rig, noise: float) -> bool:
    """Whether the look-ups say that frames are not half-way between two rigs, nor near there: valleys are bent."""
    half = departure_of(two, one).reshape(2, -1, 6) / 2
    if float(torch.rad2deg(2 * half[0, :, 3:].norm(dim=1).max())) < _LEAST_TURN_DEG:
        return False
    middle = one.moved(half[0], half[1])
    said = (odds(problem, end, middle, _BENT * noise) for end in (one, two))
    return all(found.data > max(_BARRIER, found.error) for found in said)


def _mode(said: Odds, other: Rig, rig: Rig) -> Mode:
    """What differs at another end, if most frames are where they are at the result."""
    back = rig.T_world_camera @ inverse(other.T_world_camera)  # for each frame, what brings it to where it is
    turn = log_so3((inverse(back)[None] @ back[:, None])[..., :3, :3]).norm(dim=-1)
    usual = int(turn.median(1).values.argmin())
    vectors = log_so3((back[usual] @ other.T_world_camera @ inverse(rig.T_world_camera))[:, :3, :3])
    angle = vectors.norm(dim=1)
    turned = (angle > _TURNED * angle.max()).nonzero()[:, 0]
    mine = vectors[turned]
    mean = (mine * (mine @ mine[0]).sign()[:, None]).mean(0)  # half a turn may go either way
    axis = torch.nn.functional.normalize(mean, dim=0).tolist()
    degrees = float(torch.rad2deg(angle[turned].median()))
    return Mode(said.nats, said.error, tuple(turned.tolist()), degrees, (axis[0], axis[1], axis[2]))


def _shaken_leads_back(
    found: Explored, factor: Float[Tensor, "joint k"], unplaced: Sequence[int], generator: torch.Generator
) -> bool:
    """Whether some steps lead back to the result from poses beside it, along what is known worst."""
    problem, best, state = found.problem, found.best, found.best.state
    delta, rho = shake(factor, _SHAKE_SIGMAS, generator).reshape(2, -1, 6)
    linear = linearise(state.rig, state.anchors, best.rows, problem.maps)
    kernel = kernel_of(state, best.rows, best.widths, linear.residuals)
    equations = normal_equations(linear, best.rows, *kernel.weights(linear.residuals))
    rig, anchors = moved_together(state.rig, state.anchors, equations, torch.cat([delta, rho], 1))
    beside = replace(state, rig=rig, anchors=anchors)
    back = run_stage(problem, SearchStage(found.refine, False, _SHAKE_STEPS), replace(best, state=beside))
    end = with_frames_of(back.state.rig, found.rig, unplaced)
    return farthest_frame(factor, departure_of(end, found.rig)) <= _SHAKE_LEFT * _SHAKE_SIGMAS


def shake(factor: Float[Tensor, "joint k"], sigmas: float, generator: torch.Generator) -> Float[Tensor, "unknowns"]:
    """A random increment (delta, rho) of some sigmas of the poses, the intrinsics staying as they are."""
    variance, axes = torch.linalg.eigh(_given_intrinsics(factor))
    draw = torch.randn(len(variance), generator=generator, dtype=torch.float64)
    return axes @ (sigmas * variance.clamp_min(0).sqrt() * draw)


def farthest_frame(factor: Float[Tensor, "joint k"], departure: Float[Tensor, "unknowns"]) -> float:
    """Increment of the frame that departs most, in sigma of the poses given the intrinsics (RMS over its six)."""
    sigma = _given_intrinsics(factor).diagonal().clamp_min(0).sqrt()
    ratio = torch.where(sigma > 0, departure / sigma, torch.zeros_like(sigma))
    return float(ratio[: len(ratio) // 2].reshape(-1, 6).pow(2).mean(1).max().sqrt())


def departure_of(other: Rig, rig: Rig) -> Float[Tensor, "unknowns"]:
    """Increments (delta, rho) from `rig` to `other`, without motion and growth of the scene as a whole."""
    there = restore(rig, other, baseline_scale(rig, other, None))
    pairs = (
        (there.T_world_camera, rig.T_world_camera),
        (there.T_camera_projector, rig.T_camera_projector),
    )
    step = torch.cat([log_se3(theirs @ inverse(mine)).reshape(-1) for theirs, mine in pairs])
    G = gauge_directions(rig)
    return step - G @ torch.linalg.solve(G.T @ G, G.T @ step)


def with_frames_of(rig: Rig, other: Rig, frames: Sequence[int]) -> Rig:
    """The rig with some frames where another has them."""
    chosen = list(frames)
    camera, relative = rig.T_world_camera.clone(), rig.T_camera_projector.clone()
    camera[chosen], relative[chosen] = other.T_world_camera[chosen], other.T_camera_projector[chosen]
    return replace(rig, T_world_camera=camera, T_camera_projector=relative)


def drawn_start(rig: Rig, prior: PosePrior, with_projectors: bool, generator: torch.Generator) -> Rig:
    """Starting poses as uncertain as the stated ones, about `rig`; projectors stay in their frames, or move as well."""
    draw = torch.randn(rig.frames, 12, generator=generator, dtype=torch.float64) * prior.sigma
    frames = replace(rig, T_world_camera=exp_se3(draw[:, :6]) @ rig.T_world_camera)
    if not with_projectors:
        return frames
    T = rig.T_camera_projector.clone()
    T[:, :3, :3] = exp_so3(draw[:, 9:]) @ T[:, :3, :3]
    T[:, :3, 3] += draw[:, 6:9]
    return replace(frames, T_camera_projector=T)


def widened(
    factor: Float[Tensor, "joint k"], departures: Sequence[tuple[float, Float[Tensor, "unknowns"]]]
) -> Float[Tensor, "joint more"]:
    """The covariance with the mean square of departures, by weights of at most 1: small ones alone add little."""
    total = max(sum(weight for weight, _ in departures), 1.0)
    columns = [torch.nn.functional.pad((w / total) ** 0.5 * d, (0, UNKNOWNS)) for w, d in departures]
    return torch.cat([factor, *(column[:, None] for column in columns)], 1)


def _given_intrinsics(factor: Float[Tensor, "joint k"]) -> Float[Tensor, "unknowns unknowns"]:
    """Covariance of the poses if the intrinsics are right."""
    poses, common = factor[:-UNKNOWNS], factor[-UNKNOWNS:]
    scale = common.norm(dim=1).clamp_min(1e-15)
    common = common / scale[:, None]
    inner = torch.linalg.pinv(common @ common.T, hermitian=True)
    border = poses @ common.T
    return poses @ poses.T - border @ inner @ border.T


# Registered surfaces as another place to begin a search. Look-ups compare coordinates at one place and lead a frame
# home from about its own details away. Each frame alone shows a surface, too, from its coordinates and the pose of its
# projector, and surfaces can be registered from much farther.

_FEWEST = 2  # frames that a registration may join
_REGISTERED_SIDE = 240  # pixels along the longer side of an image that are used to register surfaces
_REGISTERED_PIXELS = 300  # decoded pixels that a frame must have for its surface to be registered


def registered_start(problem: SearchProblem, refine: RefinePoses, beside: Rig, known: Sequence[int]) -> Rig | None:
    """A rig with frames where the registration of their surfaces puts them; None if it joins too few.

    `known` frames of the rig `beside` give the axes and the scale; the others may be anywhere. A frame that was not
    joined stays where it is there. Projectors move only where they are free.
    """
    start = problem.start
    clouds = [c for c in results([partial(_cloud, problem, k) for k in range(start.frames)]) if c is not None]
    frame = np.array([int(c.name) for c in clouds])
    if len(clouds) < _FEWEST:
        return None
    roughly = start.T_world_camera.numpy()[frame]
    roughly[~np.isin(frame, list(known))] = np.nan
    found = register(clouds, False, problem.settings.seed, roughly)
    joined = np.flatnonzero(found.registered)
    common = np.isin(frame[joined], list(known))
    if common.sum() < _FEWEST:
        return None
    cameras, relative = found.T_world_camera[joined], np.stack([clouds[k].pose.T_camera_projector for k in joined])
    relative[:, :3, 3] *= found.baseline[joined, None]
    reference = _frames(beside, frame[joined][common])
    same = replace(reference, **_poses(cameras[common], relative[common]))
    scale = baseline_scale(reference, same, None)
    S = alignment(reference, same, scale) @ Similarity.scaling(scale)
    camera, projector = beside.T_world_camera.numpy().copy(), beside.T_camera_projector.numpy().copy()
    camera[frame[joined]] = S.poses(cameras)
    if refine == "free":
        relative[:, :3, 3] *= scale
        projector[frame[joined]] = relative
    return replace(beside, **_poses(camera, projector))


def _poses(camera: Float64[ndarray, "n 4 4"], relative: Float64[ndarray, "n 4 4"]) -> dict[str, Tensor]:
    return {"T_world_camera": torch.from_numpy(camera), "T_camera_projector": torch.from_numpy(relative)}


def _frames(rig: Rig, index: Int64[ndarray, "n"]) -> Rig:
    chosen = torch.from_numpy(index)
    return Rig(rig.camera[chosen], rig.projector, rig.T_world_camera[chosen], rig.T_camera_projector[chosen])


def _cloud(problem: SearchProblem, k: int) -> FrameCloud | None:
    """The surface of one frame, named by its number; None where too little of it was decoded."""
    rig = problem.start
    coords = _thinned(problem.maps.image(k).numpy())
    uv_camera, uv_projector = correspondences_of(coords)
    if len(uv_camera) < _REGISTERED_PIXELS:
        return None
    h, w = coords.shape[:2]
    lit = np.ceil(uv_projector.max(0)).astype(int)  # the part of the pattern that matters
    devices = _device(rig.camera[k], w, h), _device(rig.projector, int(lit[0]), int(lit[1]))
    try:
        pose = relative_pose_near(rig.T_camera_projector[k].numpy(), uv_camera, uv_projector, *devices)
        return frame_cloud(str(k), coords, *devices, pose)
    except RelativePoseError:  # hardly any coordinate agrees with a pose near the stated one
        return None


def _thinned(image: ndarray) -> Float32[ndarray, "h w 2"]:
    """Keep every n-th decoded pixel of an image that is much larger than surfaces are compared at."""
    used = lattice_step(*image.shape[:2])  # correspondences are taken there only: a multiple loses none of the kept
    step = used * max(round(max(image.shape[:2]) / (used * _REGISTERED_SIDE)), 1)
    kept = np.full_like(image, np.nan, dtype=np.float32)
    kept[::step, ::step] = image[::step, ::step]
    return kept


def _device(intrinsics: Intrinsics, w: int, h: int) -> Device:
    values = dict(zip(PARAMETERS, intrinsics.params.tolist(), strict=True))
    return Device(w, h, **values, model=intrinsics.model)

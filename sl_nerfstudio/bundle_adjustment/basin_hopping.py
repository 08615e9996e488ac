"""Further searches after the first one: from rough starts, and for frames that agree with no others.

From starting poses that are off by several degrees some frames end in a minimum of their own, where two or three of
them agree with each other and well enough with the rest. Searches that begin about that end let them out again, while
the frames that are right return (basin hopping: Wales and Doye, J. Phys. Chem. A, 1997; only what is better is kept).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.covariance import (
    departure_of,
    with_frames_of,
)
from sl_nerfstudio.bundle_adjustment.observations import (
    anchors_at,
    in_front_of,
    observe,
    partners,
)
from sl_nerfstudio.bundle_adjustment.parameters import (
    PosePrior,
    PriorTerm,
    RefinePoses,
    alignment,
    baseline_scale,
)
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Rig, residuals_of
from sl_nerfstudio.bundle_adjustment.search import (
    EVERY_FRAME_PER_ANCHOR,
    FRAMES_MOVE,
    INDEPENDENT,
    LEAST_COSINE,
    PARTNERS,
    SearchProblem,
    SearchProgress,
    search,
    unplaced_frames,
)
from sl_nerfstudio.geometry.devices import PARAMETERS, Device, Intrinsics
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.geometry.numerics import geman_mcclure_cost
from sl_nerfstudio.parallel import results
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of, lattice_step
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, relative_pose_near

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


# Which of two ends of searches is more probable: the whole posterior, of the look-ups that exist at both. What exists
# at one end alone says nothing by itself: frames that are turned onto one side of a round object see each other more
# than they do where they belong, and agree as far as the object is round. So both ends are asked the same: an anchor is
# the same pixel of the same frame, at the depth that each end gives it, and the same frames look it up.

_COMPARED_ANCHORS = 300  # decoded pixels of each frame that are looked up
_COMPARED_NOISES = 4.0  # residual at which a look-up costs half of what a contradiction costs
_HIDDEN = 2.0  # widths of the kernel from which on a nearer surface is another one, which hides the anchor


def log_odds(problem: SearchProblem, end: SearchProgress, other: SearchProgress) -> float:
    """Logarithm of how many times as probable one end is as another, in nats: below zero if it is less probable.

    A contradiction costs a fixed amount, however far off it is. A camera that sees another surface in front of the
    anchor says nothing. Look-ups of a frame are correlated: together they count as `INDEPENDENT`, however many they
    are. The prior counts in full, so an end far from the starting poses must explain far better what both
    explain.
    """
    one, two = end.state.rig, other.state.rig
    generator = torch.Generator().manual_seed(problem.settings.seed)
    drawn = problem.maps.draw(torch.arange(one.frames), _COMPARED_ANCHORS, generator)
    (mine, good), (theirs, as_good) = (anchors_at(rig, problem.maps, *drawn) for rig in (one, two))
    ends = [(one, mine.chosen(good & as_good)), (two, theirs.chosen(good & as_good))]
    rows = _common(problem, ends, generator)
    found = [residuals_of(rig, anchors, rows, problem.maps) for rig, anchors in ends]
    width = _COMPARED_NOISES * min(end.noise, other.noise)
    common = found[0].cross_valid & found[1].cross_valid
    for (rig, anchors), r in zip(ends, found, strict=True):
        far = r.cross.norm(dim=-1) > _HIDDEN * width
        common &= ~(far & in_front_of(rig, anchors, rows, problem.maps))
    cost, cost_other = (
        float(geman_mcclure_cost((torch.cat([r.own, r.cross[common]]) / width).square().sum(-1)).sum()) for r in found
    )
    nats = _COMPARED_NOISES**2 / 2  # of a look-up that contradicts
    share = min(INDEPENDENT * one.frames / max(int(common.sum()), 1), 1.0)
    prior = PriorTerm(problem.prior, problem.start, 0.5)
    return nats * share * (cost_other - cost) + prior.energy(two) - prior.energy(one)


def _common(problem: SearchProblem, ends: list[tuple[Rig, Anchors]], generator: torch.Generator) -> Observations:
    """Anchors in frames that see them at both ends; a random choice of these if there are too many."""
    allowed = torch.stack([partners(*end, problem.maps, PARTNERS, LEAST_COSINE, generator) for end in ends]).any(0)
    first, second = (_numbers(problem, *end, allowed, generator) for end in ends)
    common = first[torch.isin(first, second)]
    most = EVERY_FRAME_PER_ANCHOR * len(ends[0][1].frame)
    chosen = common[torch.randperm(len(common), generator=generator)[:most].sort().values]
    frames = ends[0][0].frames
    return Observations(chosen // frames, chosen % frames)


def _numbers(
    problem: SearchProblem, rig: Rig, anchors: Anchors, allowed: Tensor, generator: torch.Generator
) -> Int[Tensor, "rows"]:
    """Every look-up of an end as one number: of its anchor, then of the frame that looks it up."""
    rows = observe(rig, anchors, problem.maps, rig.frames, float("inf"), LEAST_COSINE, generator, allowed)
    return rows.anchor * rig.frames + rows.frame


# After rough starts: a search is begun again beside its end, and goes on from wherever is more probable.

_ROUGH_DEG = 1.5  # uncertainty of the starting rotations, 1 sigma per axis of the median frame, from which to hop
_PATIENCE = 4  # searches after the best one that end elsewhere, after which there is no further one
_SIZE = 0.3  # distance from the best end at which a search begins, in uncertainties of the starting poses
_LEAST_ODDS = 5.0  # nats by which the end of a search must be more probable to replace the best one
MOST_LEFT = 0.35  # share of a distance within which all frames must return for a search to lead back
MOST_FRAMES = 100  # beyond which no further search is made: it takes time, and many frames hold each other
_HALF = 0.5  # share of the frames that every second hop moves


@dataclass(frozen=True)
class Hopped:
    """Ends of further searches."""

    best: SearchProgress
    others: tuple[SearchProgress, ...]  # where those after the best one have ended, if it was elsewhere
    settled: bool  # the last one led back, or none was asked for


def hopped(problem: SearchProblem, refine: RefinePoses, found: SearchProgress) -> Hopped:
    """The end of the search, or a better one; ends as soon as a hop leads back to the best one, or none is better.

    The first hop begins where a registration of the frames' surfaces puts them. Frames that agree with no others at the
    first end are not searched for again.
    """
    hops, generator = problem.settings.hops, torch.Generator().manual_seed(problem.settings.seed)
    possible = refine in FRAMES_MOVE and found.state.rig.frames <= MOST_FRAMES
    if hops < 1 or not possible or not is_rough(problem.prior, _ROUGH_DEG):
        return Hopped(found, (), True)
    best, others = found, []
    unplaced = unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)
    expected = problem.expected.clone()
    expected[list(unplaced)] = float("-inf")
    registered = registered_start(problem, refine, problem.start, range(problem.start.frames))
    for hop in range(hops):
        if hop == 0 and registered is not None:
            again = problem.again(problem.start, registered, problem.expected)
        else:
            begin = _moved(best.state.rig, problem.prior, _SIZE, 1.0 if hop % 2 else _HALF, generator)
            again = problem.again(problem.start, begin, expected)
        end = search(again, refine)
        if end is None:
            continue
        other = end[0]
        if log_odds(problem, other, best) > _LEAST_ODDS:
            best, others = other, []
        elif _leads_back(with_frames_of(other.state.rig, best.state.rig, unplaced), best.state.rig, problem):
            return Hopped(best, tuple(others), True)
        else:
            others.append(other)
            if len(others) == _PATIENCE:
                break
    return Hopped(best, tuple(others), False)


def _leads_back(other: Rig, best: Rig, problem: SearchProblem) -> bool:
    """Whether every frame has come back, most of the way that hops take it."""
    departure = departure_of(other, best).reshape(2, -1, 6)[0] / (_SIZE * problem.prior.sigma[:, :6])
    return float(departure.square().mean(1).max().sqrt()) <= MOST_LEFT


def is_rough(prior: PosePrior, from_deg: float) -> bool:
    """Whether the starting poses of most frames are as uncertain as that."""
    return float(torch.rad2deg(prior.frame_rotation).median()) >= from_deg


def _moved(rig: Rig, prior: PosePrior, size: float, share: float, generator: torch.Generator) -> Rig:
    """Some frames as a whole at poses drawn about theirs, with a share of the uncertainty of the starting poses."""
    chosen = torch.rand(rig.frames, 1, generator=generator, dtype=torch.float64) < share
    draw = torch.randn(rig.frames, 6, generator=generator, dtype=torch.float64)
    delta = torch.where(chosen, size * draw * prior.sigma[:, :6], torch.zeros_like(draw))
    return rig.moved(delta, torch.zeros_like(delta))


# Frames that agree with no others after a search: their surfaces may show where they belong, however far that is.


def with_lost_frames(
    problem: SearchProblem, refine: RefinePoses, found: SearchProgress
) -> tuple[SearchProblem, SearchProgress] | None:
    """The problem and the end of a search with lost frames where their surfaces put them; None if none is found there.

    The stated uncertainty of such a frame's starting pose was wrong: it now holds about the new place. What was known
    of its projector against its camera stays.
    """
    if not problem.settings.lost_by_surface or refine not in FRAMES_MOVE or problem.start.frames > MOST_FRAMES:
        return None
    lost = _lost(problem, found)
    others = [k for k in range(problem.start.frames) if k not in lost]
    rig = registered_start(problem, refine, found.state.rig, others) if lost else None
    if rig is None:
        return None
    begin = with_frames_of(found.state.rig, rig, lost)
    start = replace(problem.start, T_world_camera=with_frames_of(problem.start, rig, lost).T_world_camera)
    end = search(problem.again(start, begin, problem.expected), refine)
    if end is None or not set(_lost(problem, end[0])) < set(lost):
        return None
    return replace(problem, start=start), end[0]


def _lost(problem: SearchProblem, found: SearchProgress) -> tuple[int, ...]:
    return unplaced_frames(found.state.rig, problem.maps, found.noise, problem.settings)

"""Registration and joint adjustment re-examined: frames whose coordinates contradict the others are taken out.

Registration compares surfaces, which are known only as well as each frame's own relative pose. After the joint
adjustment the coordinates themselves can be compared, through both devices of every pair of frames, and a wrong frame
that surfaces could not tell from a right one stands out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from sl_nerfstudio.bundle_adjustment.registered_frames import (
    AdjustedFrames,
    RegisteredFramesSettings,
    RegisteredMinimum,
    find_registered_minimum,
    keep_registered,
)
from sl_nerfstudio.geometry.lie import DevicePoses, angle_deg
from sl_nerfstudio.parallel import one_library_thread, results
from sl_nerfstudio.processing.records import LargeClouds
from sl_nerfstudio.registration.register import include_left_out, with_edges_at_poses, with_relative_pose
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
    PairsContradict,
    Registration,
    SeparatePoses,
    UndecidedProjector,
    without_frames,
)
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.review.agreement import (
    GOOD_EXCESS,
    GOOD_SHARE,
    CrossFrameAgreement,
    agreeing_groups,
    compare_frames,
)

_ROUNDS = 4
_MOVES = 3  # times that frames are tried at other places
_INCLUSIONS = 3  # times that frames left out are placed
_FEWEST = 2  # frames of a scan
_DOUBTFUL_EXCESS = 1.3  # residual of a frame, relative to the better pairs, from which other places are tried
_DOUBTFUL_SHARE = 0.02  # points that agree fewer than usual, as a share, from which they are tried
_MOST_DOUBTFUL = 6  # frames that are tried at once, at most a third: the others must say where they belong
_ELSEWHERE_DEG = 8.0  # rotation between two places of a frame


@dataclass(frozen=True)
class ConsistentFrames:
    """Frames that agree with each other, adjusted together."""

    registration: Registration
    adjusted: AdjustedFrames
    cross: CrossFrameAgreement  # of the registered frames, in their order


@dataclass(frozen=True)
class _Group:
    """Frames that were adjusted together, and may be adjusted again with others."""

    registration: Registration
    minimum: RegisteredMinimum
    cross: CrossFrameAgreement

    def missing(self) -> list[int]:
        """Frames that are not in it."""
        found: list[int] = np.flatnonzero(~self.registration.registered).tolist()
        return found


def adjust_consistent(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    log: Callable[[str], None],
    settings: RegisteredFramesSettings | None = None,
) -> ConsistentFrames:
    """Adjust all registered frames, and again without those that contradict the largest group that agrees.

    Frames that agree less well than most are tried at other places, and stay where they agree better.

    Frames that were left out come in if they can be placed against the adjusted ones and agree with them; that is tried
    again as long as frames come in, because each shows more of the surface to the rest. Each frame is placed once: if
    it contradicts the others there, too, it stays out. What surfaces do not tell before, they do not tell afterwards
    either: frames that fit at several places stay out, and of what looks the same from several sides no frame is moved.
    How far other minima are is asked of the last group only.

    Raises UserError if fewer than two frames are registered.
    """
    found = _without_contradictions(clouds, _adjusted(clouds, registration, settings), log, settings)
    undecidable = _undecidable(registration)
    for _ in range(0 if len(undecidable) == len(clouds) else _MOVES):
        moved = _moved_elsewhere(clouds, found, log, settings)
        if moved is None:
            break
        found = moved
    placed_before: set[int] = set()
    for _ in range(_INCLUSIONS):
        candidates = [k for k in found.missing() if k not in placed_before | undecidable]
        more = _placed(clouds, found, candidates)
        new = [k for k in candidates if more.registered[k]]
        if not new:
            break
        placed_before.update(new)
        names = ", ".join(registration.names[k] for k in new)
        log(f"placed against the adjusted frames: {names}; adjusting again with them")
        larger = _with_agreeing(clouds, more, new, settings)
        if larger is None:
            break
        known, found = found.registration.registered, _without_contradictions(clouds, larger, log, settings)
        if not (found.registration.registered & ~known).any():
            break
    return ConsistentFrames(found.registration, found.minimum.with_other_minima(), found.cross)


def _moved_elsewhere(
    clouds: Sequence[FrameCloud],
    found: _Group,
    log: Callable[[str], None],
    settings: RegisteredFramesSettings | None,
) -> _Group | None:
    """With frames that agree less well than the rest at other places; None if they do not agree better there.

    Of an object that nearly looks the same from several sides, surfaces that are bent by the errors of their own
    relative poses may not tell at which a frame is; adjusted ones do.
    """
    registration, poses = found.registration, found.minimum.frames.poses
    index = np.flatnonzero(registration.registered).tolist()
    doubtful = [index[n] for n in _doubtful(found.cross)]
    if not doubtful:
        return None
    without = replace(registration, registered=registration.registered & ~np.isin(np.arange(len(clouds)), doubtful))
    placed = _placed(clouds, replace(found, registration=without), doubtful)
    turned = [
        k for k in doubtful if placed.registered[k]
        and angle_deg(placed.T_world_camera[k, :3, :3] @ poses.T_world_camera[k, :3, :3].T) > _ELSEWHERE_DEG
    ]  # fmt: skip
    if not turned:
        return None
    names = ", ".join(registration.names[k] for k in turned)
    log(f"tried at other places, where they may agree better: {names}")
    there = _adjusted(clouds, _with_places(registration, poses, placed, turned), settings)
    before, after = ([group.cross.frames[index.index(k)] for k in turned] for group in (found, there))
    better = all(b.excess <= a.excess and b.share >= a.share for a, b in zip(before, after, strict=True))
    return _without_contradictions(clouds, there, log, settings) if better else None


def _doubtful(cross: CrossFrameAgreement) -> list[int]:
    """Places in `cross` of frames that agree less well than most; of many, the worst."""
    judged = {n: frame for n, frame in enumerate(cross.frames) if np.isfinite(frame.share)}
    if not judged:
        return []
    usual = float(np.median([frame.share for frame in judged.values()]))
    doubts = {n: max(usual - f.share - _DOUBTFUL_SHARE, f.excess - _DOUBTFUL_EXCESS) for n, f in judged.items()}
    worst = sorted((n for n, doubt in doubts.items() if doubt > 0), key=lambda n: -doubts[n])
    return sorted(worst[: min(_MOST_DOUBTFUL, len(cross.frames) // 3)])


def _with_places(
    registration: Registration, poses: DevicePoses, placed: Registration, turned: Sequence[int]
) -> Registration:
    """The registration at adjusted poses, with some frames where they were placed."""
    T, baseline = poses.T_world_camera.copy(), poses.baseline.copy()
    T[turned], baseline[turned] = placed.T_world_camera[turned], placed.baseline[turned]
    moved = replace(registration, T_world_camera=T, baseline=baseline)
    return with_edges_at_poses(moved, [registration.names[k] for k in turned])


def _undecidable(registration: Registration) -> set[int]:
    """Frames that fit at several places: all if the object looks the same from several sides."""
    if registration.by_order or registration.turns_deg:
        return set(range(len(registration.names)))
    torn = {e.frame for e in registration.exclusions if isinstance(e, PairsContradict | UndecidedProjector)}
    return {k for k, name in enumerate(registration.names) if name in torn}


def _with_agreeing(
    clouds: Sequence[FrameCloud], more: Registration, new: Sequence[int], settings: RegisteredFramesSettings | None
) -> _Group | None:
    """All frames adjusted again with those of the `new` ones that then agree; None if none does."""
    with_more = _adjusted(clouds, more, settings)
    doubtful = [k for k in new if not _agrees_well(with_more, k)]
    if len(doubtful) == len(new):
        return None
    return _adjusted(clouds, without_groups(more, [[k] for k in doubtful]), settings) if doubtful else with_more


def registered_only(clouds: Sequence[FrameCloud], registration: Registration) -> ConsistentFrames:
    """All registered frames where registration put them; they are compared within the uncertainty of that.

    Raises UserError if fewer than two frames are registered.
    """
    kept = keep_registered(clouds, registration)
    return ConsistentFrames(registration, kept, _compared(clouds, registration, kept, exact=False))


def _agrees_well(found: _Group, k: int) -> bool:
    """Whether a frame agrees with the others as well as frames of a good scan do."""
    frame = found.cross.frames[int(found.registration.registered[:k].sum())]
    return frame.excess <= GOOD_EXCESS and frame.share >= GOOD_SHARE


@one_library_thread()
def _placed(clouds: Sequence[FrameCloud], found: _Group, candidates: Sequence[int]) -> Registration:
    """The registration with those of the frames that can be placed against the adjusted ones."""
    if not candidates:
        return found.registration
    kept = LargeClouds()
    sharper = results([partial(_sharper, cloud, found, k, kept) for k, cloud in enumerate(clouds)])
    return include_left_out(sharper, found.registration, found.minimum.frames.poses, candidates)


def _sharper(cloud: FrameCloud, found: _Group, k: int, kept: LargeClouds) -> FrameCloud:
    """The surface of a frame with its adjusted relative pose, which is known far better than by itself."""
    frames = found.minimum.frames
    sigma = frames.sigma[k]
    if sigma is None or not found.registration.registered[k]:
        return cloud
    direction = sigma.relative_translation / float(frames.poses.baseline[k])
    turn = float(np.radians(sigma.relative_rotation_deg))
    return kept.kept(with_relative_pose(cloud, frames.poses.T_camera_projector[k], turn, direction))


def _without_contradictions(
    clouds: Sequence[FrameCloud],
    found: _Group,
    log: Callable[[str], None],
    settings: RegisteredFramesSettings | None,
) -> _Group:
    for _ in range(_ROUNDS):
        groups = agreeing_groups(found.cross)
        index = np.flatnonzero(found.registration.registered)
        lost = [[int(index[k]) for k in group] for group in groups[1:]]
        if not lost or len(index) - sum(map(len, lost)) < _FEWEST:
            break
        names = ", ".join(found.registration.names[k] for group in lost for k in group)
        log(f"the coordinates of {names} contradict those of the other frames; adjusting again without them")
        found = _adjusted(clouds, without_groups(found.registration, lost), settings)
    return found


def without_groups(registration: Registration, groups: Sequence[Sequence[int]]) -> Registration:
    """The registration with groups of frames as components of their own."""
    named = [tuple(registration.names[k] for k in group) for group in groups]
    found = without_frames(registration, [CoordinatesDisagree(name, names) for names in named for name in names])
    component, separate, number = found.component.copy(), list(found.separate), int(registration.component.max()) + 1
    for group, names in zip(groups, named, strict=True):
        if len(group) > 1:
            frames = list(group)
            separate.append(SeparatePoses(names, registration.T_world_camera[frames], registration.baseline[frames]))
            component[frames] = number
            number += 1
    return replace(found, component=component, separate=tuple(separate))


def _adjusted(
    clouds: Sequence[FrameCloud], registration: Registration, settings: RegisteredFramesSettings | None
) -> _Group:
    minimum = find_registered_minimum(clouds, registration, settings)
    return _Group(registration, minimum, compare_registered(clouds, registration, minimum.frames))


def compare_registered(
    clouds: Sequence[FrameCloud], registration: Registration, adjusted: AdjustedFrames
) -> CrossFrameAgreement:
    """Coordinates of all registered frames against each other; the poses count as exact, so that errors show."""
    return _compared(clouds, registration, adjusted, exact=True)


def _compared(
    clouds: Sequence[FrameCloud], registration: Registration, adjusted: AdjustedFrames, exact: bool
) -> CrossFrameAgreement:
    """`exact`: the poses count as exact; else they may err by what they state."""
    index = np.flatnonzero(registration.registered)
    chosen = [clouds[k] for k in index]
    sigma = [None if exact else adjusted.sigma[k] for k in index]
    return compare_frames(
        [c.camera for c in chosen], clouds[0].projector, adjusted.poses[index], [c.coords for c in chosen], sigma
    )

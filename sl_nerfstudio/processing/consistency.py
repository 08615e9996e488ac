"""Registration and joint adjustment re-examined: frames whose coordinates contradict the others are taken out.

Registration compares surfaces, which are known only as well as each frame's own relative pose. After the joint
adjustment the coordinates themselves can be compared, through both devices of every pair of frames, and a wrong frame
that surfaces could not tell from a right one stands out.
"""

from collections.abc import Callable, Iterable, Sequence
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
from sl_nerfstudio.parallel import one_library_thread, results
from sl_nerfstudio.processing.config import FEWEST_FRAMES
from sl_nerfstudio.processing.records import LargeClouds
from sl_nerfstudio.registration.register import include_left_out, with_relative_pose
from sl_nerfstudio.registration.result import (
    CoordinatesDisagree,
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
    FrameCrossAgreement,
    agreeing_groups,
    compare_frames,
)

_EXCLUSIONS = 4  # times that contradicting frames are taken out of one group
_INCLUSIONS = 3  # times that frames left out are placed


@dataclass(frozen=True)
class ConsistentFrames:
    """Frames that agree with each other, adjusted together."""

    registration: Registration
    adjusted: AdjustedFrames
    cross: CrossFrameAgreement  # of the registered frames, in their order


def adjust_consistent(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    log: Callable[[str], None],
    settings: RegisteredFramesSettings | None = None,
) -> ConsistentFrames:
    """Adjust all registered frames, and again without those that contradict the largest group that agrees.

    Frames that were left out come in if they can be placed against the adjusted ones and agree with them. Of what looks
    the same from several sides none is: surfaces do not tell afterwards what they did not tell before. How far other
    minima are is asked of the last group only.

    Raises UserError if fewer than two frames are registered.
    """
    run = _Adjuster(clouds, log, settings)
    undecidable = _undecidable(registration)
    group = run.with_included(run.without_contradictions(run.adjusted(registration)), undecidable)
    return ConsistentFrames(group.registration, group.minimum.with_other_minima(), group.cross)


def registered_only(clouds: Sequence[FrameCloud], registration: Registration) -> ConsistentFrames:
    """All registered frames where registration put them; they are compared within the uncertainty of that.

    Raises UserError if fewer than two frames are registered.
    """
    kept = keep_registered(clouds, registration)
    return ConsistentFrames(registration, kept, compare_registered(clouds, registration, kept, exact=False))


def _undecidable(registration: Registration) -> set[int]:
    """Frames that fit at several places: all if the object looks the same from several sides."""
    if registration.by_order or registration.turns_deg:
        return set(range(len(registration.names)))
    torn = {e.frame for e in registration.exclusions if isinstance(e, UndecidedProjector)}
    return {k for k, name in enumerate(registration.names) if name in torn}


@dataclass(frozen=True)
class _Group:
    """Frames that were adjusted together, and may be adjusted again with others."""

    registration: Registration
    minimum: RegisteredMinimum
    cross: CrossFrameAgreement

    def agreement(self, frame: int) -> FrameCrossAgreement:
        """How a registered frame agrees with the others."""
        return self.cross.frames[int(self.registration.registered[:frame].sum())]

    def agrees_well(self, frame: int) -> bool:
        """Whether a frame agrees with the others as well as frames of a good scan do."""
        found = self.agreement(frame)
        return found.excess <= GOOD_EXCESS and found.share >= GOOD_SHARE

    def named(self, frames: Iterable[int]) -> str:
        """Names of frames, for a sentence."""
        return ", ".join(self.registration.names[k] for k in frames)


@dataclass(frozen=True)
class _Adjuster:
    """Adjusts groups of frames, judges each frame by the coordinates of the others, and acts on the worst."""

    clouds: Sequence[FrameCloud]
    log: Callable[[str], None]
    settings: RegisteredFramesSettings | None

    def adjusted(self, registration: Registration) -> _Group:
        """All registered frames adjusted together."""
        minimum = find_registered_minimum(self.clouds, registration, self.settings)
        return _Group(registration, minimum, compare_registered(self.clouds, registration, minimum.frames))

    def without_contradictions(self, group: _Group) -> _Group:
        """The largest part of a group in which no coordinates contradict each other."""
        for _ in range(_EXCLUSIONS):
            index = np.flatnonzero(group.registration.registered).tolist()
            lost = [[index[n] for n in part] for part in agreeing_groups(group.cross)[1:]]
            if not lost or len(index) - sum(map(len, lost)) < FEWEST_FRAMES:
                break
            names = group.named(k for part in lost for k in part)
            self.log(f"the coordinates of {names} contradict those of the other frames; adjusting again without them")
            group = self.adjusted(without_groups(group.registration, lost))
        return group

    def with_included(self, group: _Group, undecidable: set[int]) -> _Group:
        """The group with frames that were left out and can be placed against it.

        That is tried again as long as frames come in, because each shows more of the surface to the rest. A frame is
        placed once: if it contradicts the others there, too, it stays out.
        """
        placed_before: set[int] = set()
        for _ in range(_INCLUSIONS):
            registered = group.registration.registered
            candidates = [k for k in np.flatnonzero(~registered).tolist() if k not in placed_before | undecidable]
            more = self._placed(group, candidates)
            new = [k for k in candidates if more.registered[k]]
            if not new:
                break
            placed_before.update(new)
            self.log(f"placed against the adjusted frames: {group.named(new)}; adjusting again with them")
            larger = self.adjusted(more)
            strangers = [k for k in new if not larger.agrees_well(k)]
            if len(strangers) == len(new):
                break
            if strangers:
                larger = self.adjusted(without_groups(more, [[k] for k in strangers]))
            group = self.without_contradictions(larger)
            if not (group.registration.registered & ~registered).any():
                break
        return group

    @one_library_thread()
    def _placed(self, group: _Group, candidates: Sequence[int]) -> Registration:
        """The registration with those of the frames that can be placed against the adjusted ones."""
        if not candidates:
            return group.registration
        kept = LargeClouds()
        sharper = results([partial(_sharper, cloud, group, k, kept) for k, cloud in enumerate(self.clouds)])
        return include_left_out(sharper, group.registration, group.minimum.frames.poses, candidates)


def _sharper(cloud: FrameCloud, group: _Group, k: int, kept: LargeClouds) -> FrameCloud:
    """The surface of a frame with its adjusted relative pose, which is known far better than by itself."""
    frames = group.minimum.frames
    sigma = frames.sigma[k]
    if sigma is None or not group.registration.registered[k]:
        return cloud
    direction = sigma.relative_translation / float(frames.poses.baseline[k])
    turn = float(np.radians(sigma.relative_rotation_deg))
    return kept.kept(with_relative_pose(cloud, frames.poses.T_camera_projector[k], turn, direction))


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


def compare_registered(
    clouds: Sequence[FrameCloud], registration: Registration, adjusted: AdjustedFrames, exact: bool = True
) -> CrossFrameAgreement:
    """Coordinates of all registered frames against each other.

    `exact`: the poses count as exact, so that errors show; else they may err by what they state.
    """
    index = np.flatnonzero(registration.registered)
    chosen = [clouds[k] for k in index]
    sigma = [None if exact else adjusted.sigma[k] for k in index]
    return compare_frames(
        [c.camera for c in chosen], clouds[0].projector, adjusted.poses[index], [c.coords for c in chosen], sigma
    )

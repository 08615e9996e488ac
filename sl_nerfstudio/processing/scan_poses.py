"""The axes and the unit of the scan: those of given poses, of a known length, or arbitrary ones."""

from collections.abc import Sequence
from dataclasses import dataclass

from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.given_poses import GivenPoses, align_to
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.known_length import KnownLength, scale_to
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.scan.types import UNITS, PickedPixel, Scale, ScaleBar


@dataclass(frozen=True)
class ScanPoses:
    """Poses of all frames in the axes and the unit of the scan."""

    adjusted: AdjustedFrames
    units: str
    scale: Scale


def find_scan_poses(
    clouds: Sequence[FrameCloud],
    registration: Registration,
    adjusted: AdjustedFrames,
    known: KnownLength | None,
    given: GivenPoses | None,
) -> ScanPoses:
    """The adjusted poses in the axes and the unit that are known.

    A known length overrules the unit of given poses. Raises UserError if it is in a frame that was not registered.
    """
    poses = ScanPoses(adjusted, "arbitrary", Scale(False))
    if given is not None:
        poses = _in_given_axes(poses, registration, given)
    if known is not None:
        poses = _with_known_length(poses, clouds, known)
    return poses


def _in_given_axes(poses: ScanPoses, registration: Registration, given: GivenPoses) -> ScanPoses:
    """The poses moved, turned and scaled onto the given ones."""
    S_given_found = align_to(given, poses.adjusted.poses.T_world_camera, registration.registered)
    scale = poses.scale if given.units == "arbitrary" else Scale(True, "given camera poses")
    return ScanPoses(poses.adjusted.mapped(S_given_found), given.units, scale)


def _with_known_length(poses: ScanPoses, clouds: Sequence[FrameCloud], known: KnownLength) -> ScanPoses:
    """The poses scaled until the length is the true one."""
    adjusted = poses.adjusted
    devices = adjusted.poses
    factor = scale_to(known, known.unit, clouds, devices.T_world_camera, devices.T_world_projector)
    return ScanPoses(adjusted.scaled(factor), known.unit, stated_scale(known))


def require_known_frames(known: KnownLength, clouds: Sequence[FrameCloud]) -> None:
    """Raise UserError if a frame of the known length has no cloud."""
    lost = set(known.frames) - {cloud.name for cloud in clouds}
    if lost:
        raise UserError(
            f"--known-length: {sorted(lost)[0]} could not be used, so no length in it can be measured\n"
            "    cause:  it could not be decoded or calibrated\n    remedy: give a length in another frame"
        )


def stated_scale(known: KnownLength) -> Scale:
    """The known length as the scan states it; its frames are given by name."""
    if not known.pixels:
        return Scale(True, known.source, baseline_of=known.frames[0])
    first, second = (PickedPixel(*end) for end in zip(known.frames, known.pixels, strict=True))
    length = known.metres / (UNITS[known.unit] or 1.0)
    return Scale(True, known.source, bar=ScaleBar((first, second), length))

"""The files and flags of a run, read and checked before the long work starts."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sl_nerfstudio.calibration.stated_sigma import CERTAIN, StatedSigma
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.capture_files.cameras import Cameras, read_cameras, require_intrinsics
from sl_nerfstudio.processing.capture_files.captured import CaptureNotes, read_captured
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameJob
from sl_nerfstudio.processing.given_poses import GivenPoses, read_given_poses
from sl_nerfstudio.processing.projector.stated import read_projector, read_projector_sigma, require_known_camera
from sl_nerfstudio.processing.selection.user_masks import find_masks
from sl_nerfstudio.registration.known_length import KnownLength, is_index, parse_known_length


@dataclass(frozen=True)
class Inputs:
    """Everything that the stages start from."""

    job: FrameJob
    cameras: Cameras
    captures: Captures
    projector_stated: bool  # in a file; False: only its size is known
    given: GivenPoses | None  # in the order of the captures
    known: KnownLength | None  # its frames by name
    notes: CaptureNotes  # on the captures


def read_inputs(config: ProcessConfig) -> Inputs:
    """Read what the flags name. Raises UserError for flags and files that are wrong."""
    config.check()
    known = None if config.known_length is None else parse_known_length(config.known_length)
    captured = read_captured(config)
    decoder, captures = captured.decoder, captured.captures
    layout = decoder.layout
    names = [frame.name for frame in captures.frames]
    require_intrinsics(config, projector_needed=not config.finds_projector)
    cameras = read_cameras(config, captures)
    require_known_camera(config, cameras)
    projector, stated = read_projector(config, (layout.w, layout.h))
    masks = None if config.masks is None else find_masks(config.masks, _sizes_of_frames(captures))
    doubt = StatedSigma(cameras.sigma, read_projector_sigma(config, (layout.w, layout.h)) if stated else CERTAIN)
    known_beam = not config.finds_projector
    return Inputs(
        FrameJob(
            config.work_folder,
            decoder,
            cameras.first,
            projector,
            config.seed,
            masks,
            cameras.several,
            doubt,
            known_beam,
            cameras.start is None,
        ),
        cameras,
        captures,
        stated,
        None if config.poses is None else read_given_poses(config.poses, names),
        None if known is None else frames_by_name(known, names),
        captured.notes,
    )


def _sizes_of_frames(captures: Captures) -> dict[str, tuple[int, int]]:
    return {frame.name: captures.sizes[frame.camera] for frame in captures.frames}


def frames_by_name(known: KnownLength, names: Sequence[str]) -> KnownLength:
    """The known length with its frames by name; numbers count the captures from 0."""
    found = []
    for frame in known.frames:
        if frame not in names and not is_index(frame, len(names)):
            raise UserError(
                f"--known-length: there is no frame {frame}\n    cause:  a typing error, or a number counted from 1\n"
                f"    remedy: give a number from 0 to {len(names) - 1}, or the name of an image without its ending"
            )
        found.append(frame if frame in names else names[int(frame)])
    return replace(known, frames=tuple(found))

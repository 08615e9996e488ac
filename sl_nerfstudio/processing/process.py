"""From photographs to a scan folder, stage by stage.

Reading, decoding and auto-calibration of each frame, registration of all, joint adjustment, scale, writing. A frame
that fails is left out, with its reason; the scan folder appears whole or not at all.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames, adjust_registered
from sl_nerfstudio.calibration.device_files import read_device_file
from sl_nerfstudio.decoding.decoders import decoder_for
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.processing.advice import first_line
from sl_nerfstudio.processing.captures import Captures, find_captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_stage import FrameJob, FrameOutcome, cores, run_frames
from sl_nerfstudio.processing.given_poses import GivenPoses, align_to, read_given_poses
from sl_nerfstudio.processing.preview import Preview
from sl_nerfstudio.processing.result import ProcessResult
from sl_nerfstudio.processing.store import Manifest
from sl_nerfstudio.processing.summary import summarise
from sl_nerfstudio.processing.writing import write_scan
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud, frame_cloud
from sl_nerfstudio.registration.known_length import KnownLength, parse_known_length, scale_to
from sl_nerfstudio.registration.register import Registration, register
from sl_nerfstudio.relative_pose.estimation import RelativePose, estimate_relative_pose
from sl_nerfstudio.relative_pose.projector_focal import CalibratedView, refine_projector_focal
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of
from sl_nerfstudio.scan.atomic import require_empty, write_atomic
from sl_nerfstudio.scan.types import UNITS, PickedPixel, Scale, ScaleBar

MakeReport = Callable[[ProcessResult, Sequence[Preview]], str]
REPORT = "processing.html"


@dataclass(frozen=True)
class Placed:
    """Frames in one world, with their unit."""

    registration: Registration
    joint: AdjustedFrames
    units: str
    scale: Scale


def process(config: ProcessConfig, make_report: MakeReport, tell: Callable[[str], None]) -> ProcessResult:
    """Make the scan folder; `tell` hears of every stage.

    Raises UserError for flags and files that are wrong, and if fewer than two frames can be used: the report on
    them then lies in the work folder.
    """
    config.check()
    require_empty(config.output)
    known = parse_known_length(config.known_length) if config.known_length else None
    job, captures, given = _prepare(config)
    known = None if known is None else _by_name(known, [frame.name for frame in captures.frames])
    tell(f"{len(captures.frames)} frames of {captures.size[0]} x {captures.size[1]} pixels, decoder {job.decoder}")
    outcomes = _run_frames(config, job, captures)
    usable = [o for o in outcomes if o.cloud is not None]
    tell(_frame_summary(outcomes, usable))
    if len(usable) < 2:
        raise _too_few(config, job, outcomes, None, make_report)
    if config.refine_projector_focal:
        job, outcomes = _with_refined_focal(job, outcomes, tell)
    clouds = [o.cloud for o in outcomes if o.cloud is not None]
    given = None if given is None else given.chosen([o.cloud is not None for o in outcomes])
    start = None if given is None else given.T_world_camera
    registration = register(clouds, not config.unordered, config.seed, start, tell)
    tell(f"registered {int(registration.registered.sum())} of {len(clouds)} frames")
    if registration.registered.sum() < 2:
        raise _too_few(config, job, outcomes, registration, make_report)
    placed = _place(clouds, registration, known, given)
    result = summarise(config, job.decoder, outcomes, registration, placed.joint, placed.units, placed.scale)
    if result.joint_px is not None:
        tell("joint adjustment: frames agree to {1:.2f} px, {0:.2f} px before".format(*result.joint_px))
    write_scan(config.output, job, outcomes, clouds, placed.joint, placed.units, placed.scale, result, make_report)
    return result


def _prepare(config: ProcessConfig) -> tuple[FrameJob, Captures, GivenPoses | None]:
    """Everything that can be wrong with flags and files is found before the long work starts."""
    layout = read_layout(config.pattern)
    decoder = decoder_for(layout, config.decoder, config.pattern)
    captures = find_captures(config.images, sequences=isinstance(layout, GrayCode))
    camera = read_device_file(config.intrinsics, "camera", captures.size, procam_step=config.procam_step)
    projector = read_device_file(
        config.projector_intrinsics or config.intrinsics, "projector", (layout.w, layout.h), config.projector_model,
        config.procam_step,
    )  # fmt: skip
    given = None if config.poses is None else read_given_poses(config.poses, [f.name for f in captures.frames])
    return FrameJob(config.work_folder, decoder, layout, camera, projector, config.seed), captures, given


def _run_frames(config: ProcessConfig, job: FrameJob, captures: Captures) -> list[FrameOutcome]:
    """Outcomes of all frames, in the order of the captures."""
    found: dict[str, FrameOutcome] = {
        frame.name: FrameOutcome(frame, "", False, 0.0, 0.0, None, "reading", str(captures.faults[frame.name]))
        for frame in captures.frames
        if frame.name in captures.faults
    }
    todo = [frame for frame in captures.frames if frame.name not in found]
    settings = {"decoder": job.decoder, "pattern": str(config.pattern), "images": str(config.images)}
    manifest = Manifest(job.work, settings)
    jobs = config.jobs or cores()
    for outcome in track(run_frames(job, todo, jobs), "decoding and calibrating", len(todo)):
        found[outcome.name] = outcome
        done = "decoded before" if outcome.resumed else "decoded"
        status = f"failed in {outcome.stage}" if outcome.stage else done
        manifest.note(outcome.name, outcome.key, status, outcome.reason)
    return [found[frame.name] for frame in captures.frames]


def _frame_summary(outcomes: Sequence[FrameOutcome], usable: Sequence[FrameOutcome]) -> str:
    resumed = sum(o.resumed for o in outcomes)
    again = f" ({resumed} had been decoded before)" if resumed else ""
    if not usable:
        return f"decoded and calibrated 0 of {len(outcomes)} frames{again}"
    rate = float(np.median([o.decode_rate for o in usable]))
    epipolar = float(np.median([o.cloud.pose.residual_px for o in usable if o.cloud is not None]))
    return (
        f"decoded and calibrated {len(usable)} of {len(outcomes)} frames{again}: {rate:.0%} of the pattern, "
        f"epipolar residual {epipolar:.2f} px (medians)"
    )


def _with_refined_focal(
    job: FrameJob, outcomes: list[FrameOutcome], tell: Callable[[str], None]
) -> tuple[FrameJob, list[FrameOutcome]]:
    """The projector's focal length from all frames, and every frame calibrated anew with it."""
    views = [
        CalibratedView(*correspondences_of(o.cloud.coords), job.camera, _all_inliers(o.cloud))
        for o in outcomes
        if o.cloud is not None
    ]
    found = refine_projector_focal(views, job.projector, job.seed)
    tell(f"projector's focal length: {found.factor:.4f} of the stated one, plus or minus {found.sigma:.4f}")
    if not found.significant:
        tell("that is no significant change: the stated one is kept")
        return job, outcomes
    job = replace(job, projector=found.projector)
    again = []
    for outcome in track(outcomes, "calibrating again", len(outcomes)):
        cloud = outcome.cloud
        if cloud is not None:
            pose = estimate_relative_pose(*correspondences_of(cloud.coords), job.camera, job.projector, job.seed)
            cloud = frame_cloud(outcome.name, cloud.coords, job.camera, job.projector, pose)
        again.append(replace(outcome, cloud=cloud))
    return job, again


def _all_inliers(cloud: FrameCloud) -> RelativePose:
    """The frame's pose, judged by the coordinates that agree with it alone."""
    count = int(np.isfinite(cloud.coords).all(-1).sum())
    return replace(cloud.pose, inliers=np.ones(count, dtype=bool))


def _place(
    clouds: Sequence[FrameCloud], registration: Registration, known: KnownLength | None, given: GivenPoses | None
) -> Placed:
    """Joint adjustment, then axes and unit: those of the given poses, the known length's, or none."""
    joint = adjust_registered(clouds, registration)
    units, scale = "arbitrary", Scale(False)
    if given is not None:
        S = align_to(given, joint.T_world_camera, registration.registered)
        joint = joint.scaled(S.scale)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = S.R, S.t
        joint = replace(joint, T_world_camera=T @ joint.T_world_camera, T_world_projector=T @ joint.T_world_projector)
        units = given.units
        scale = Scale(True, "given camera poses") if units != "arbitrary" else scale
    if known is not None:
        _require_used(known, clouds)
        factor = scale_to(known, known.unit, clouds, joint.T_world_camera, joint.T_world_projector)
        joint, units = joint.scaled(factor), known.unit
        scale = stated_scale(known)
    return Placed(registration, joint, units, scale)


def _by_name(known: KnownLength, names: Sequence[str]) -> KnownLength:
    """The known length with its frames by name; numbers count the captures from 0."""
    found = []
    for frame in known.frames:
        if frame not in names and not (frame.isdecimal() and int(frame) < len(names)):
            raise UserError(
                f"--known-length: there is no frame {frame}\n    cause:  a slip, or a number counted from 1\n"
                f"    remedy: give a number from 0 to {len(names) - 1}, or the name of an image without its ending"
            )
        found.append(frame if frame in names else names[int(frame)])
    return replace(known, frames=tuple(found))


def _require_used(known: KnownLength, clouds: Sequence[FrameCloud]) -> None:
    lost = set(known.frames) - {cloud.name for cloud in clouds}
    if lost:
        raise UserError(
            f"--known-length: {sorted(lost)[0]} could not be used, so its length says nothing\n"
            "    cause:  it could not be decoded or calibrated\n    remedy: give a length in another frame"
        )


def stated_scale(known: KnownLength) -> Scale:
    """The known length as the scan states it; its frames are given by name."""
    if not known.pixels:
        return Scale(True, known.source, baseline_of=known.frames[0])
    first, second = (PickedPixel(*end) for end in zip(known.frames, known.pixels, strict=True))
    length = known.metres / (UNITS[known.unit] or 1.0)
    return Scale(True, known.source, bar=ScaleBar((first, second), length))


def _too_few(
    config: ProcessConfig,
    job: FrameJob,
    outcomes: Sequence[FrameOutcome],
    registration: Registration | None,
    make_report: MakeReport,
) -> UserError:
    """The error that says what became of every frame; the report goes to the work folder."""
    result = summarise(config, job.decoder, outcomes, registration, None, "arbitrary", Scale(False))
    path = config.work_folder / REPORT
    write_atomic(path, make_report(result, [Preview(None, None)] * len(outcomes)).encode())
    lost = [f for f in result.frames if not f.in_scan]
    reasons = "\n".join(f"  {f.name}: {first_line(f.reason)}" for f in lost[:20])
    more = f"\n  and {len(lost) - 20} more" if len(lost) > 20 else ""
    first = lost[0].reason.strip().splitlines()[1:] if lost else []
    return UserError(
        f"{config.images}: {result.registered} of {len(outcomes)} frames can be used, a scan needs at least 2\n"
        f"{reasons}{more}\n" + "\n".join(first) + f"\n    report: {path}"
    )

"""From photographs to a scan folder, stage by stage.

Frames are read, decoded and calibrated one by one; then all are registered, adjusted together, brought to the unit of
the scan, and written. A frame that fails is left out, with its reason. The scan folder appears complete or not at all.
Decoded frames, the registration and the adjustment are kept in the work folder, where the next run goes on.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.registered_frames import keep_registered
from sl_nerfstudio.console import phase, track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import ShownImage
from sl_nerfstudio.processing.cache import (
    StageStore,
    digest_of_captures,
    note_scan,
    note_work,
    with_kept_work,
    work_folder,
    written_scan,
)
from sl_nerfstudio.processing.captures import describe_faults
from sl_nerfstudio.processing.config import FEWEST_FRAMES, ProcessConfig
from sl_nerfstudio.processing.consistency import (
    ConsistentFrames,
    adjust_consistent,
    compare_registered,
    registered_only,
)
from sl_nerfstudio.processing.frames import (
    FrameJob,
    FrameStageResult,
    FrameWorker,
    captures_of,
    clouds_of,
    run_frame_stage_again,
    with_clouds,
)
from sl_nerfstudio.processing.inputs import GivenPoses, Inputs, read_inputs, refine_camera
from sl_nerfstudio.processing.object_only import (
    ObjectOnly,
    Preview,
    find_object_only,
    make_preview,
    object_sentences,
    only_object,
)
from sl_nerfstudio.processing.projector import (
    CalibratedFrames,
    adjustment_settings,
    calibrate_frames,
    contradiction_by_epipolar_geometry,
    describe,
    refine_projector,
    with_equal_baselines,
    within_stated_doubt,
)
from sl_nerfstudio.processing.records import of_earlier_version
from sl_nerfstudio.processing.result import ProcessResult, first_line, left_out, summarise
from sl_nerfstudio.processing.scan_poses import ScanPoses, find_scan_poses, require_known_frames
from sl_nerfstudio.processing.turntable import MASKS, agrees_with_itself, moving_part, only_moving
from sl_nerfstudio.registration.register import choose_projectors, chosen_clouds, register
from sl_nerfstudio.registration.result import Registration, without_undecided
from sl_nerfstudio.registration.surfaces import FrameCloud
from sl_nerfstudio.review.agreement import SurfaceShares, missing_shares, shared_surface
from sl_nerfstudio.review.moving_part import MovingPart
from sl_nerfstudio.scan.document import FileError
from sl_nerfstudio.scan.images import Pixels, read_photograph
from sl_nerfstudio.scan.write import ScanWriter, encode_json
from sl_nerfstudio.storage import NewFolder, write_atomic

MakeReport = Callable[[ProcessResult, Sequence[Preview]], str]
Log = Callable[[str], None]
Watch = Callable[[Sequence[FrameCloud], DevicePoses, str], None]
"""Gets the frames, their poses (NaN where a frame was left out), and the word for what was done with them."""

# The errors of a run whose frames cannot make a scan: they say what happened to every frame.

REPORT = "processing.html"
_LISTED = 20  # frames in a message


def too_few_frames(result: ProcessResult, usable: int, make_report: MakeReport) -> UserError:
    """The error of a run in which fewer than two frames are usable; its report goes to the work folder."""
    config = result.config
    path = config.work_folder / REPORT
    write_atomic(path, make_report(result, [Preview(None, None)] * len(result.frames)).encode())
    lost = [frame for frame in result.frames if not frame.in_scan]
    first = lost[0].reason.strip().splitlines()[1:] if lost else []
    if result.contradiction:  # measured, and cause enough
        first = [f"    {line}" if k == 0 else line for k, line in enumerate(result.contradiction.splitlines())]
    return UserError(
        f"{config.images}: {usable} of {len(result.frames)} frames can be used, a scan needs at least "
        f"{FEWEST_FRAMES}\n"
        f"{_listed([f'{f.name}: {first_line(f.reason)}' for f in lost])}\n" + "\n".join(first) + f"\n    report: {path}"
    )


def require_given_poses(
    config: ProcessConfig, given: GivenPoses, results: Sequence[FrameStageResult], registration: Registration
) -> None:
    """Raise UserError unless at least two frames with given poses, at different places, were registered.

    `given` is in the order of `results`. Fewer poses determine neither axes nor unit.
    """
    path = Path() if config.poses is None else config.poses
    reasons = {result.name: left_out(result, registration) for result in results}
    with_pose = [r.name for r, pose in zip(results, given.known, strict=True) if pose]
    usable = [name for name in with_pose if reasons[name] is None]
    if len(usable) < FEWEST_FRAMES:
        lines = []
        for name in with_pose:
            failure = reasons[name]
            what = "registered" if failure is None else f"left out in {failure[0]}: {first_line(failure[1])}"
            lines.append(f"{name}: {what}")
        raise UserError(
            f"{path}: {len(usable)} of the {len(with_pose)} frames with given poses could be registered, the axes and "
            f"the unit of the scan need at least {FEWEST_FRAMES}\n{_listed(lines)}\n"
            "    cause:  the frames with given poses are among those that cannot be used\n"
            "    remedy: give poses of other frames, capture these again, or leave --poses out"
        )
    chosen = np.array([name in usable for name in (r.name for r in results)])
    if not given.at_different_places(chosen):
        raise UserError(
            f"{path}: the given poses of the registered frames are all at the same place\n"
            "    cause:  frames with other positions are among those that cannot be used\n"
            "    remedy: give poses of other frames, capture those again, or leave --poses out"
        )


def _listed(lines: Sequence[str]) -> str:
    more = f"\n  and {len(lines) - _LISTED} more" if len(lines) > _LISTED else ""
    return "\n".join(f"  {line}" for line in lines[:_LISTED]) + more


# The scan folder of the registered frames, with the report on all frames.

_SUPERSAMPLING = 4  # of pattern.png


def write_scan(
    folder: NewFolder,
    job: FrameJob,
    results: Sequence[FrameStageResult],
    poses: ScanPoses,
    result: ProcessResult,
    pictures: dict[str, Path],
    make_report: MakeReport,
) -> None:
    """Write all frames that are in the scan by `result`. Leaving the folder completes it.

    `pictures` are those without the pattern, by the frame's name; if there are none, a sequence has its images in full
    light.
    """
    layout = job.decoder.layout
    white = layout.place(ShownImage("white")) if isinstance(layout, GrayCode) else None
    shown = white or 0
    row = {cloud.name: k for k, cloud in enumerate(clouds_of(results))}
    worker = FrameWorker(job)
    size = (job.projector.w, job.projector.h)
    previews: list[Preview] = []
    with ScanWriter(
        folder.root,
        units=poses.units,
        scale=poses.scale,
        projector=job.projector,
        extra={"sl_shrunk_by": job.shrink} if job.shrink > 1 else None,
        projector_extra=None if result.projector is None else {"intrinsics_sigma": result.projector.sigmas()},
        pattern=np.rint(255 * layout.render(_SUPERSAMPLING)).astype(np.uint8),
        camera=job.camera,
        within=folder,
    ) as writer:
        for frame, record in zip(track(results, "writing"), result.frames, strict=True):
            image = _image(worker, frame, shown)
            cloud = frame.cloud
            part = None if result.object_only is None else result.object_only.parts.get(frame.name)
            previews.append(make_preview(image, None if cloud is None else cloud.coords, size, part, len(results)))
            if not record.in_scan or cloud is None or image is None:
                continue
            decoded, k = worker.load(frame), row[frame.name]
            keep = np.ones_like(decoded.mask) if part is None else part == Part.OBJECT
            picture = pictures.get(frame.name)
            writer.add_frame(
                frame.name,
                image=image,
                coords=np.where(keep[..., None], cloud.coords, np.float32(np.nan)),
                mask=decoded.mask & keep,
                pattern=np.rint(255 * decoded.pattern * keep).astype(np.uint8),
                color=None if picture is None else read_photograph(picture, job.shrink),
                image_is_color=white is not None and not pictures,
                camera=job.camera_of(frame.frame) if job.cameras else None,
                T_world_camera=poses.adjusted.poses.T_world_camera[k],
                T_world_projector=poses.adjusted.poses.T_world_projector[k],
                pose_sigma=poses.adjusted.sigma[k],
            )
        writer.add_file("pattern.json", layout.encode())
        writer.add_file("processing.json", encode_json(result.document()))
        writer.add_file(REPORT, make_report(result, previews).encode())


def _image(worker: FrameWorker, frame: FrameStageResult, shown: int) -> Pixels | None:
    """The capture (of a sequence the image in full light, by its place); None if it cannot be read."""
    try:
        return worker.image(frame, shown)
    except (FileError, IndexError):
        return None


def process(config: ProcessConfig, make_report: MakeReport, log: Log, watch: Watch | None = None) -> ProcessResult:
    """Make the scan folder; `log` gets a line of text for every stage, `watch` the poses as soon as they are known.

    Raises UserError for flags and files that are wrong, and if fewer than two frames can be used: their report is then
    in the work folder.
    """
    config.check()
    own, config = config.work_folder, with_kept_work(config)
    if config.work_folder != own:
        log(f"these captures were processed before: {config.work_folder} has what was kept of that")
    earlier = written_scan(config)
    renewed = () if earlier is None else tuple(earlier.files)
    with NewFolder(config.output, renewed) as folder, work_folder(config.work_folder):
        with phase("read"):
            inputs = read_inputs(config)
            note_work(config)
            captures, decoder = inputs.captures, inputs.job.decoder.name
            log(f"{len(captures.frames)} frames of {captures.size[0]} x {captures.size[1]} pixels, decoder {decoder}")
            for sentence in (*inputs.notes.sentences, *(f"left out: {fault}" for fault in describe_faults(captures))):
                log(sentence)
            if of_earlier_version(config.work_folder, inputs.job.decoder):
                log(f"{config.work_folder} was filled by an earlier version: its frames are decoded again")
            digest = digest_of_captures(captures)
            if earlier is not None:
                earlier.require_same(digest, config.output)
                log(f"{config.output} holds an earlier scan of the same captures, which this one replaces")
        run = _Run(config, inputs, make_report, log)
        with phase("decode"):
            frames = run.calibrated()
            wrong = run.wrong_intrinsics(frames)
        with phase("register"):
            frames, registration = run.registered(frames)
            run.require_registered(frames.results, registration, wrong)
            if watch is not None:
                clouds = clouds_of(frames.results)
                watch(clouds, keep_registered(clouds, registration).poses, "registered")
        with phase("adjust"):
            frames, consistent = run.adjusted(frames, registration)
            frames, consistent, moving = run.registered_by_what_moves(frames, consistent)
            both = consistent.adjusted.median_before_px, consistent.adjusted.median_after_px
            if np.isfinite(both).all():
                log("frames agree to {1:.2f} px, {0:.2f} px before".format(*both))
            if watch is not None:
                watch(clouds_of(frames.results), consistent.adjusted.poses, "adjusted together")
        with phase("write"):
            result = run.written(folder, frames, consistent, moving, wrong)
            note_scan(config, folder, digest)
        return result


@dataclass(frozen=True)
class _Run:
    """The stages after the inputs were read."""

    config: ProcessConfig
    inputs: Inputs
    make_report: MakeReport
    log: Log

    def given(self, results: Sequence[FrameStageResult]) -> GivenPoses | None:
        """The given poses of the frames that have clouds."""
        return self.inputs.given and self.inputs.given.chosen([result.cloud is not None for result in results])

    def calibrated(self) -> CalibratedFrames:
        """All frames decoded and calibrated; a camera that no file describes is refined with all of them.

        Raises UserError if fewer than two frames were.
        """
        frames = calibrate_frames(self.config, self.inputs, self.log)
        self._require_clouds(frames.results)
        start = self.inputs.cameras.start
        if start is None:
            return frames
        job, results, camera = refine_camera(frames.job, frames.results, start, self.log)
        results = run_frame_stage_again(self.config, job, self.inputs.captures, results)
        self._require_clouds(results)
        notes = self.inputs.notes
        notes = replace(notes, sentences=(*notes.sentences, camera.sentence()), camera=camera.document())
        return replace(frames, job=job, results=results, notes=notes)

    def _require_clouds(self, results: Sequence[FrameStageResult]) -> None:
        usable = len(clouds_of(results))
        if usable < FEWEST_FRAMES:
            result = summarise(self.config, self.inputs.job.decoder.name, results, None, None)
            raise too_few_frames(result, usable, self.make_report)

    def wrong_intrinsics(self, frames: CalibratedFrames) -> str:
        """Which of the stated intrinsics the frames contradict; "" if none, or if they were found from the frames."""
        if frames.found is not None or self.inputs.cameras.start is not None:
            return ""
        wrong = contradiction_by_epipolar_geometry(frames.job, frames.results)
        if wrong:
            self.log(wrong)
        return wrong

    def registered(self, frames: CalibratedFrames) -> tuple[CalibratedFrames, Registration]:
        """The frames with the pose of each projector that the others decide for, and the registration of these."""
        clouds, registration, given = clouds_of(frames.results), frames.registration, self.given(frames.results)
        if self.inputs.known is not None:
            require_known_frames(self.inputs.known, clouds)
        if registration is None:
            config, log = self.config, self.log
            start = None if given is None else given.T_world_camera
            settings = captures_of(frames.results), config.unordered, config.seed, start
            chosen, registration = StageStore(frames.job.work, log).kept(
                "registration", (clouds, *settings), lambda: register_clouds(clouds, *settings, log)
            )
            frames = replace(frames, results=with_clouds(frames.results, chosen_clouds(clouds, chosen)))
            if config.rig == "rigid":
                registration = with_equal_baselines(registration)
        self.log(f"registered {int(registration.registered.sum())} of {len(clouds)} frames")
        return frames, registration

    def require_registered(self, results: Sequence[FrameStageResult], registration: Registration, wrong: str) -> None:
        """Raise UserError if fewer than two frames were registered, or fewer than two of those with given poses.

        `wrong`: which intrinsics the frames contradict, or "": then this is the cause.
        """
        usable = int(registration.registered.sum())
        if usable < FEWEST_FRAMES:
            decoder = self.inputs.job.decoder.name
            result = summarise(self.config, decoder, results, registration, None, contradicted=wrong)
            raise too_few_frames(result, usable, self.make_report)
        if self.inputs.given is not None:
            require_given_poses(self.config, self.inputs.given, results, registration)

    def adjusted(
        self, frames: CalibratedFrames, registration: Registration
    ) -> tuple[CalibratedFrames, ConsistentFrames]:
        """All registered frames adjusted together, and with them a projector that was found from the frames."""
        config, log = self.config, self.log
        clouds, found = clouds_of(frames.results), frames.found
        settings = adjustment_settings(config.rig, found)
        if config.no_adjust:
            consistent = registered_only(clouds, registration)
        else:
            consistent = StageStore(frames.job.work, log).kept(
                "adjustment",
                (clouds, registration, settings),
                lambda: adjust_consistent(clouds, registration, log, settings),
            )
        if found is None or config.rig == "static-projector":  # whose placement has adjusted everything
            return frames, consistent
        clouds, consistent, found = refine_projector(
            clouds, consistent, found, self.inputs.job.stated.camera, settings, log
        )
        log(f"after the joint adjustment: {describe(found)}")
        job, results = replace(frames.job, projector=found.projector), with_clouds(frames.results, clouds)
        return replace(frames, job=job, results=results, found=found), consistent

    def registered_by_what_moves(
        self, frames: CalibratedFrames, consistent: ConsistentFrames
    ) -> tuple[CalibratedFrames, ConsistentFrames, MovingPart | None]:
        """The frames registered by what moves, where cameras in one place look at something that does, and what it is.

        They stay as they are where nothing moves, and where what moves does not agree with itself.
        """
        part = moving_part(frames.results, consistent)
        if part is None or frames.registration is not None:  # a still projector was placed by what stands still
            return frames, consistent, part
        self.log(
            f"all cameras are in one place, and {part.share:.0%} of the decoded pixels show something that moves: "
            f"turntable with a static background. Registering what moves alone; masks of it: {frames.job.work / MASKS}"
        )
        rigid = part.rigid and self.config.rig == "free" and not self.config.no_adjust
        run = replace(self, config=replace(self.config, rig="rigid")) if rigid else self
        alone = only_moving(frames, part, rigid)
        if len(clouds_of(alone.results)) >= FEWEST_FRAMES:
            alone, registration = run.registered(alone)
            if registration.registered.sum() >= FEWEST_FRAMES:
                alone, found = run.adjusted(alone, registration)
                if agrees_with_itself(found, alone.results):
                    return alone, found, replace(part, registered=True)
        self.log(
            "what moves could not be registered; leave the background out with --masks, or cover it and capture again"
        )
        return frames, consistent, part

    def written(
        self,
        folder: NewFolder,
        frames: CalibratedFrames,
        consistent: ConsistentFrames,
        moving: MovingPart | None,
        wrong: str,
    ) -> ProcessResult:
        """Judge the adjusted frames, and write the scan with its report."""
        config, results = self.config, frames.results
        registration, adjusted = consistent.registration, within_stated_doubt(consistent.adjusted, frames.job.stated)
        poses = find_scan_poses(clouds_of(results), registration, adjusted, self.inputs.known, self.given(results))
        parts, cross, shown = None, consistent.cross, registration
        if config.object_only:
            parts = find_object_only(frames.job, results, registration, poses)
            self.log("object only: " + "\n    ".join(object_sentences(parts)))
            poses = replace(poses, scale=parts.usable_scale(poses.scale))
            shown, results = only_object(registration, results, parts)
            enough = shown.registered.sum() >= FEWEST_FRAMES
            cross = compare_registered(clouds_of(results), shown, adjusted, not config.no_adjust) if enough else None
        shares = () if cross is None else _surface_shares(frames.job, results, shown, adjusted.poses, parts)
        result = summarise(
            config, self.inputs.job.decoder.name, frames.results, registration, poses, cross, shares, frames.found,
            wrong, frames.notes, parts, moving,
        )  # fmt: skip
        write_scan(folder, frames.job, frames.results, poses, result, self.inputs.pictures, self.make_report)
        return result


def register_clouds(
    clouds: Sequence[FrameCloud],
    captures: Sequence[int],
    unordered: bool,
    seed: int,
    start: Float64[ndarray, "n 4 4"] | None,
    log: Log,
) -> tuple[tuple[int, ...], Registration]:
    """Which cloud of every frame, and the registration of these; every pair is tried if the order says nothing.

    `captures`: number of each frame's capture.
    """
    choice = choose_projectors(clouds, not unordered, seed)
    registration = register(chosen_clouds(clouds, choice.chosen), not unordered, seed, start, captures)
    if not (unordered or registration.ordered):
        log("the frames do not follow each other in the order of capture: --unordered says so")
        before, choice = choice, choose_projectors(clouds, False, seed)  # they were compared with wrong neighbours
        if choice.chosen != before.chosen:
            registration = register(chosen_clouds(clouds, choice.chosen), False, seed, start, captures)
    return choice.chosen, without_undecided(registration, choice.undecided)


def _surface_shares(
    job: FrameJob,
    results: Sequence[FrameStageResult],
    registration: Registration,
    poses: DevicePoses,
    parts: ObjectOnly | None,
) -> list[SurfaceShares]:
    """What each registered frame decoded, and should have seen, of the surface that others show, or of the object."""
    index, worker = np.flatnonzero(registration.registered), FrameWorker(job)
    frames, clouds = [result for result in results if result.cloud is not None], clouds_of(results)
    cameras, chosen = [job.camera_of(frames[k].frame) for k in index], poses[index]
    coords, seen = (clouds[k].coords for k in index), (worker.load_mask(frames[k]) for k in index)
    masks = seen if parts is None else (m & parts.keeps(frames[k].name) for k, m in zip(index, seen, strict=True))
    shared = shared_surface(cameras, job.projector, chosen, coords, masks)
    missing = missing_shares(cameras, job.projector, chosen, shared.points, (clouds[k].seen for k in index))
    return [SurfaceShares(*both) for both in zip(shared.decoded, missing, strict=True)]

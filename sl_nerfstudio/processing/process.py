"""From photographs to a scan folder, stage by stage.

Frames are read, decoded and calibrated one by one; then all are registered, adjusted together, brought to the unit of
the scan, and written. A frame that fails is left out, with its reason. The scan folder appears complete or not at all.
Decoded frames, the registration and the adjustment are kept in the work folder, where the next run goes on.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.files.new_folder import NewFolder
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.processing.capture_files.cameras import refine_camera
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.consistency import adjust_consistent, registered_only
from sl_nerfstudio.processing.failures import FEWEST_FRAMES, require_given_poses, too_few_frames
from sl_nerfstudio.processing.frame_stage import run_frame_stage_again
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of, with_clouds
from sl_nerfstudio.processing.given_poses import GivenPoses
from sl_nerfstudio.processing.inputs import Inputs, read_inputs
from sl_nerfstudio.processing.kept.stages import StageStore
from sl_nerfstudio.processing.kept.work_folder import work_folder
from sl_nerfstudio.processing.preview import Preview
from sl_nerfstudio.processing.projector.found import describe
from sl_nerfstudio.processing.projector.refinement import adjustment_settings, refine_projector
from sl_nerfstudio.processing.projector.rigid import with_equal_baselines
from sl_nerfstudio.processing.projector.stage import calibrate_frames
from sl_nerfstudio.processing.projector.stated_test import contradiction_by_epipolar_geometry, within_stated_doubt
from sl_nerfstudio.processing.result import ProcessResult, with_object_only
from sl_nerfstudio.processing.scan_poses import find_scan_poses, require_known_frames
from sl_nerfstudio.processing.selection.object_only import find_object_only, with_usable_scale
from sl_nerfstudio.processing.selection.object_words import object_sentences
from sl_nerfstudio.processing.summary import summarise
from sl_nerfstudio.processing.writing import write_scan
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.registration.projector_choice import choose_projectors, chosen_clouds
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration, without_undecided
from sl_nerfstudio.verdict.missing_surface import missing_shares
from sl_nerfstudio.verdict.shared_surface import SurfaceShares, shared_surface

MakeReport = Callable[[ProcessResult, Sequence[Preview]], str]
Log = Callable[[str], None]


def process(config: ProcessConfig, make_report: MakeReport, log: Log) -> ProcessResult:
    """Make the scan folder; `log` gets a line of text for every stage.

    Raises UserError for flags and files that are wrong, and if fewer than two frames can be used: their report is then
    in the work folder.
    """
    config.check()
    with NewFolder(config.output) as folder, work_folder(config.work_folder):
        return _process(config, folder, make_report, log)


def _process(config: ProcessConfig, folder: NewFolder, make_report: MakeReport, log: Log) -> ProcessResult:
    inputs = read_inputs(config)
    job, captures = inputs.job, inputs.captures
    log(f"{len(captures.frames)} frames of {captures.size[0]} x {captures.size[1]} pixels, decoder {job.decoder.name}")
    for sentence in inputs.notes.sentences:
        log(sentence)

    calibrated = calibrate_frames(config, inputs, log)
    job, results, found = calibrated.job, calibrated.results, calibrated.found
    _require_clouds(config, inputs, results, make_report)
    notes = inputs.notes
    if inputs.cameras.start is not None:
        job, results, camera = refine_camera(job, results, inputs.cameras.start, log)
        notes = notes.with_camera(camera.sentence(), camera.document())
        results = run_frame_stage_again(config, job, captures, results)
        _require_clouds(config, inputs, results, make_report)
    wrong = (
        ""
        if found is not None or inputs.cameras.start is not None
        else contradiction_by_epipolar_geometry(job, results)
    )
    if wrong:
        log(wrong)

    clouds = clouds_of(results)
    if inputs.known is not None:
        require_known_frames(inputs.known, clouds)
    given = _given_for_clouds(inputs.given, results)
    start = None if given is None else given.T_world_camera
    store = StageStore(job.work, log)
    if calibrated.registration is None:
        chosen, registration = store.kept(
            "registration",
            (clouds, config.unordered, config.seed, start),
            lambda: _register(clouds, config.unordered, config.seed, start, log),
        )
        clouds = chosen_clouds(clouds, chosen)
        results = with_clouds(results, clouds)
        if config.rig == "rigid":
            registration = with_equal_baselines(registration)
    else:
        registration = calibrated.registration
    log(f"registered {int(registration.registered.sum())} of {len(clouds)} frames")
    _require_registered(config, inputs, results, registration, wrong, make_report)

    settings = adjustment_settings(config.rig, found)
    if config.no_adjust:
        consistent = registered_only(clouds, registration, settings)
    else:
        consistent = store.kept(
            "adjustment",
            (clouds, registration, settings),
            lambda: adjust_consistent(clouds, registration, log, settings),
        )
    if found is not None and config.rig != "static-projector":  # whose placement has adjusted everything
        refined = refine_projector(clouds, consistent, found, job.stated.camera, settings, log)
        clouds, consistent, found = refined.clouds, refined.consistent, refined.found
        log(f"after the joint adjustment: {describe(found)}")
        job, results = replace(job, projector=found.projector), with_clouds(results, clouds)
    registration = consistent.registration
    adjusted = within_stated_doubt(consistent.adjusted, job.stated)
    poses = find_scan_poses(clouds, registration, adjusted, inputs.known, given)
    shares = _surface_shares(job, results, registration, adjusted.poses)
    result = summarise(config, job.decoder.name, results, registration, poses, consistent.cross, shares, found, wrong)
    result = replace(result, captured=notes)
    if config.object_only:
        parts = find_object_only(job, results, registration, poses)
        log("object only: " + "\n    ".join(object_sentences(parts)))
        poses, result = with_usable_scale(poses, parts), with_object_only(result, parts)
    if result.joint_px is not None:
        log("joint adjustment: frames agree to {1:.2f} px, {0:.2f} px before".format(*result.joint_px))
    write_scan(folder, job, results, poses, result, make_report)
    return result


def _register(
    clouds: Sequence[FrameCloud], unordered: bool, seed: int, start: Float64[ndarray, "n 4 4"] | None, log: Log
) -> tuple[tuple[int, ...], Registration]:
    """Which cloud of every frame, and the registration of these; every pair is tried if the order says nothing."""
    choice = choose_projectors(clouds, not unordered, seed)
    registration = register(chosen_clouds(clouds, choice.chosen), not unordered, seed, start, log)
    if not (unordered or registration.ordered):
        log("the frames do not follow each other in the order of capture: --unordered says so")
        before, choice = choice, choose_projectors(clouds, False, seed)  # they were compared with wrong neighbours
        if choice.chosen != before.chosen:
            registration = register(chosen_clouds(clouds, choice.chosen), False, seed, start, log)
    return choice.chosen, without_undecided(registration, choice.undecided)


def _surface_shares(
    job: FrameJob, results: Sequence[FrameStageResult], registration: Registration, poses: DevicePoses
) -> list[SurfaceShares]:
    """What each registered frame decoded, and should have seen, of the surface that others show."""
    index, worker = np.flatnonzero(registration.registered), FrameWorker(job)
    frames, clouds = [result for result in results if result.cloud is not None], clouds_of(results)
    cameras, chosen = [job.camera_of(frames[k].frame) for k in index], poses[index]
    coords, masks = (clouds[k].coords for k in index), (worker.load(frames[k]).mask for k in index)
    shared = shared_surface(cameras, job.projector, chosen, coords, masks)
    missing = missing_shares(cameras, job.projector, chosen, shared.points, (clouds[k].seen for k in index))
    return [SurfaceShares(*both) for both in zip(shared.decoded, missing, strict=True)]


def _require_clouds(
    config: ProcessConfig, inputs: Inputs, results: Sequence[FrameStageResult], make_report: MakeReport
) -> None:
    """Raise UserError if fewer than two frames were decoded and calibrated."""
    usable = len(clouds_of(results))
    if usable < FEWEST_FRAMES:
        raise too_few_frames(summarise(config, inputs.job.decoder.name, results, None, None), usable, make_report)


def _require_registered(
    config: ProcessConfig,
    inputs: Inputs,
    results: Sequence[FrameStageResult],
    registration: Registration,
    wrong: str,
    make_report: MakeReport,
) -> None:
    """Raise UserError if fewer than two frames were registered, or fewer than two of those with given poses.

    `wrong`: which intrinsics the frames contradict, or "": then this is the cause.
    """
    usable = int(registration.registered.sum())
    if usable < FEWEST_FRAMES:
        result = summarise(config, inputs.job.decoder.name, results, registration, None, contradicted=wrong)
        raise too_few_frames(result, usable, make_report)
    if inputs.given is not None:
        require_given_poses(config, inputs.given, results, registration)


def _given_for_clouds(given: GivenPoses | None, results: Sequence[FrameStageResult]) -> GivenPoses | None:
    """The given poses of the frames that have a cloud."""
    return None if given is None else given.chosen([result.cloud is not None for result in results])

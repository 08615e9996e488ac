"""The files and flags of a run, read and checked before the long work starts."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.calibration.formats import camera_names, read_device_file, read_entries
from sl_nerfstudio.calibration.stated import (
    CERTAIN,
    CameraStart,
    Shares,
    StatedSigma,
    camera_from_exif,
    read_stated_sigma,
)
from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Decoder
from sl_nerfstudio.decoding.decoders import choose_decoder
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.decoding.grid_networks import networks_for_all_processes
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import Similarity, fit_similarity
from sl_nerfstudio.parallel import usable_device
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.processing.cache import StageStore
from sl_nerfstudio.processing.captures import (
    CapturedFrame,
    Captures,
    describe_sequence,
    find_captures,
    find_pictures,
    incomplete,
    layout_in_order,
    picture_sentences,
    recognise_sequence,
    resolution,
)
from sl_nerfstudio.processing.config import FEWEST_FRAMES, ProcessConfig
from sl_nerfstudio.processing.frames import (
    FrameJob,
    FrameStageResult,
    FrameWorker,
    clouds_of,
    matches_of,
    with_kept_cloud,
)
from sl_nerfstudio.processing.masks import find_masks
from sl_nerfstudio.processing.records import DecodedStore, LargeClouds
from sl_nerfstudio.processing.video import VideoChoice, is_video, video_frames
from sl_nerfstudio.registration.result import KnownLength, is_index, parse_known_length
from sl_nerfstudio.relative_pose.intrinsics import CameraEstimate, estimate_camera
from sl_nerfstudio.scan.document import Faults, Fields, FileError, document_faults, frame_label, read_document
from sl_nerfstudio.scan.images import read_photograph, refuse_mosaic
from sl_nerfstudio.scan.read import POSES, read_pose
from sl_nerfstudio.scan.types import UNITS

# The cameras: from the intrinsics file, or, where none describes them, a start from the photographs themselves.

_ROUNDS = 2  # the first poses, found with the rough focal length, reject some coordinates


@dataclass(frozen=True)
class Cameras:
    """The camera of every folder, or the only one under the name ""."""

    devices: dict[str, Device]
    start: CameraStart | None = None  # None: from a file
    sigma: Shares = CERTAIN  # of the first, as its file states it

    @property
    def first(self) -> Device:
        """The only camera, or the first of several."""
        return next(iter(self.devices.values()))

    @property
    def several(self) -> dict[str, Device]:
        """The cameras by name if there are several; otherwise empty."""
        return {} if "" in self.devices else self.devices

    def shrunk(self, factor: int) -> "Cameras":
        """The cameras of the captures as they are read."""
        return replace(self, devices={name: device.shrunk(factor) for name, device in self.devices.items()})


def read_cameras(config: ProcessConfig, captures: Captures) -> Cameras:
    """The cameras of the captures. Raises UserError for files that do not fit, or if nothing is known of the camera."""
    path = config.intrinsics
    if path is not None and any(entry.role != "projector" for entry in read_entries(path, config.procam_step)):
        step = config.procam_step
        found = {
            name: read_device_file(path, "camera", size, None, step, name) for name, size in captures.sizes.items()
        }
        first = next(iter(captures.sizes))
        return Cameras(found, sigma=read_stated_sigma(path, "camera", captures.sizes[first], step, first))
    start = camera_from_exif([frame.images[0] for frame in captures.require_whole()], captures.size)
    return Cameras({"": start.camera}, start)


def require_intrinsics(config: ProcessConfig, projector_needed: bool) -> None:
    """Raise UserError if no file is given, although the projector's intrinsics must be in one."""
    if projector_needed and config.intrinsics is None and config.projector_intrinsics is None:
        raise UserError(
            "--intrinsics: no file is given\n    cause:  the intrinsics of both devices must be known, or found\n"
            "    remedy: make a file with sl-calibrate; or give the camera's alone (sl-calibrate --camera-only) and "
            "find the projector's from the captures: --estimate-projector; or the projector's alone, if the "
            "photographs state the camera's focal length"
        )


@dataclass(frozen=True)
class CameraNotes:
    """A camera that no file describes: its start, and what the frames say of it."""

    start: CameraStart
    found: CameraEstimate

    def sentence(self) -> str:
        """Describe the camera for the output and the report."""
        camera, (x, y) = self.found.camera, self.found.sigma_centre_px
        return (
            f"camera: focal length {self.start.camera.fl_x:.0f} px ± {100 * self.start.sigma:.0f} % from EXIF "
            f"({self.start.source}); with all frames {camera.fl_x:.1f} ± {self.found.sigma_focal_px:.1f} px, principal "
            f"point ({camera.cx:.1f} ± {x:.1f}, {camera.cy:.1f} ± {y:.1f}) px, k1 {camera.k1:.3f} ± "
            f"{self.found.sigma_k1:.3f}"
        )

    def document(self) -> dict[str, Any]:
        """Return the figures as JSON."""
        start, camera = self.start, self.found.camera
        return {
            "source": start.source,
            "start_px": start.camera.fl_x,
            "start_sigma_px": start.camera.fl_x * start.sigma,
            "px": camera.fl_x,
            "sigma_px": self.found.sigma_focal_px,
            "centre_px": [camera.cx, camera.cy],
            "sigma_centre_px": list(self.found.sigma_centre_px),
            "k1": camera.k1,
            "sigma_k1": self.found.sigma_k1,
        }


def refine_camera(
    job: FrameJob, results: Sequence[FrameStageResult], start: CameraStart, log: Callable[[str], None]
) -> tuple[FrameJob, list[FrameStageResult], CameraNotes]:
    """The job with the camera from all frames, and the frames calibrated with it. Some frame must have a pose.

    Frames start again from all of their decoded coordinates: those that the first pose rejected may be right. Raises
    ValueError if no frame has a pose.
    """
    refined, again, found = job, list(results), None
    for _ in range(_ROUNDS):
        frames, poses = matches_of(clouds_of(again))
        if not frames:
            break
        found = estimate_camera(frames, poses, job.camera, job.projector, start.sigma, job.seed)
        refined = replace(job, camera=found.camera)
        worker, clouds = FrameWorker(refined), LargeClouds()
        again = [
            result if result.cloud is None else with_kept_cloud(worker.calibrate(result), clouds)
            for result in track(again, "calibrating again", len(again))
        ]
    if found is None:
        raise ValueError("no frame has a pose")
    notes = CameraNotes(start, replace(found, camera=found.camera.scaled(float(job.shrink))))
    log(notes.sentence())
    return replace(refined, last_step="match"), again, notes


# What the user's files say of the projector.

_USUAL_FOCAL = 1.5  # widths of the image: the middle of what data projectors have


def read_projector(config: ProcessConfig, size: tuple[int, int]) -> tuple[Device, bool]:
    """The projector for patterns of `size` (w, h), and whether a file states it.

    If it is to be found from the frames, no file needs to: then only its size is known. Raises UserError.
    """
    if config.finds_projector and not _described(config):
        if config.projector_model == "DOE":
            raise UserError(
                "--projector-model DOE: a diffractive projector cannot be found without a start\n"
                "    cause:  its pattern is no central projection, so no fundamental matrix tells its intrinsics\n"
                "    remedy: give a rough focal length and the middle of the pattern with --projector-intrinsics"
            )
        w, h = size
        return Device(w, h, _USUAL_FOCAL * w, _USUAL_FOCAL * w, w / 2, h / 2), False
    return read_device_file(_file(config), "projector", size, config.projector_model, config.procam_step), True


def _file(config: ProcessConfig) -> Path:
    return config.projector_intrinsics or config.intrinsics or Path()


def _described(config: ProcessConfig) -> bool:
    """Whether a file holds a projector: one of its own, or an entry beside the camera's."""
    if config.projector_intrinsics is not None:
        return True
    if config.intrinsics is None:
        return False
    entries = read_entries(config.intrinsics, config.procam_step)
    return any(entry.role == "projector" for entry in entries) or len(entries) > 1


def require_known_camera(config: ProcessConfig, cameras: Cameras) -> None:
    """Raise UserError where the projector cannot be found, or one pose assumed, with what is known of the cameras."""
    if config.finds_projector and cameras.start is not None:
        raise UserError(
            "--estimate-projector, --rig static-projector: the camera's intrinsics are not known\n"
            "    cause:  no file describes the camera, EXIF gives only a rough focal length, and both devices at once "
            "cannot be found\n    remedy: calibrate the camera (sl-calibrate --camera-only), give its file with "
            "--intrinsics"
        )
    if config.rig == "rigid" and cameras.several:
        raise UserError(
            f"--rig rigid: there are {len(cameras.several)} cameras, each with a relative pose of its own\n"
            "    remedy: leave --rig out, or process the frames of each camera by themselves"
        )


# Everything about the captures that the flags name: the pattern, the frames, and what is to be said about them.


@dataclass(frozen=True)
class CaptureNotes:
    """What was found out about the captures, for the output, processing.json and the report."""

    sentences: tuple[str, ...] = ()
    sequence: str | None = None  # names of the order of a Gray code
    recognised: bool = False  # the order, from the images
    video: VideoChoice | None = None
    shrink: int = 1  # squares of so many pixels of the photographs are read as one
    camera: dict[str, Any] | None = None  # figures of a camera that no file describes

    def document(self) -> dict[str, Any]:
        """Return the figures as JSON."""
        video = None if self.video is None else asdict(self.video)
        names = {"sequence": self.sequence, "sequence_recognised": self.recognised}
        return {**names, "video": video, "shrunk_by": self.shrink, "camera_focal": self.camera}


@dataclass(frozen=True)
class CapturedFrames:
    """The captures with their pattern."""

    decoder: Decoder[Any]
    captures: Captures
    notes: CaptureNotes


def read_captured(config: ProcessConfig) -> CapturedFrames:
    """Find the captures, and the pattern that they show. Raises UserError for flags and files that are wrong."""
    size = resolution(config.pattern)
    layout = None if size is not None else _layout(config)
    video = None
    root = config.images
    if is_video(root):
        if size is not None or isinstance(layout, GrayCode):
            raise FileError(
                root,
                "is a video, and Gray code needs one image for each pattern",
                "only the coded grid is decoded from single pictures",
                "give a folder with one sub-folder for each frame",
            )
        root, video = video_frames(root, config.work_folder)
    cameras = () if config.intrinsics is None else camera_names(config.intrinsics)
    if video is not None and cameras:
        raise FileError(
            config.images,
            "is one video, and the intrinsics file names several cameras",
            "a video shows the frames of one camera",
            "give a file with this camera alone",
        )

    def chosen_for(layout: PatternLayout) -> Decoder[Any]:
        return choose_decoder(layout, config.decoder, config.pattern, config.sequence is not None)

    decoder = None if layout is None else chosen_for(layout)
    captures = find_captures(root, decoder is None or decoder.sequence, cameras)
    if not config.not_mosaic and video is None:
        _refuse_mosaics(captures)
    if layout is None and size is not None:
        layout = recognise_sequence(captures, size, config.sequence, config.cell)
    if layout is None:
        raise ValueError("a pattern is a file or a resolution")
    decoder = decoder or chosen_for(layout)
    sentences: list[str] = [] if video is None else list(video.sentences())
    if isinstance(decoder, NetworkDecoder):
        device, sentence = usable_device(config.device)
        decoder.networks = None if device == "cpu" else networks_for_all_processes(device)
        sentences += [sentence] if sentence else []
    if not isinstance(layout, GrayCode):
        return CapturedFrames(decoder, captures, CaptureNotes(tuple(sentences), video=video))
    captures = captures.with_faults(incomplete(captures, layout))
    recognised = size is not None and config.sequence is None
    said = describe_sequence(layout) + (", recognised from the images" if recognised else "")
    return CapturedFrames(decoder, captures, CaptureNotes((said,), layout.order, recognised))


def _layout(config: ProcessConfig) -> PatternLayout:
    """The pattern of a file, in the order of --sequence."""
    if config.cell is not None:
        raise UserError(
            "--cell: pattern.json states it\n    cause:  the flag is for a --pattern like 1024x768\n"
            "    remedy: leave --cell out"
        )
    return layout_in_order(config.pattern, config.sequence)


def _refuse_mosaics(captures: Captures) -> None:
    """Look at three images of the first whole frame of every camera. Raises FileError for raw mosaics."""
    for camera in captures.sizes:
        for frame in captures.whole_of(camera)[:1]:
            images = frame.images
            for path in dict.fromkeys((images[0], images[len(images) // 2], images[-1])):
                refuse_mosaic(path)


# The size at which photographs are read: one for all of them.

_SEEN = 3  # photographs of each camera that are looked at


def shrink_factor(captures: Captures, decoder: Decoder[Any], work: Path) -> int:
    """The largest factor with which all photographs that are looked at have enough pixels for the decoder.

    Those are the first, the middle and the last of each camera.
    """
    if decoder.sequence:
        return 1
    looked_at: list[CapturedFrame] = []
    for camera in captures.sizes:
        frames = captures.whole_of(camera)
        places = np.unique(np.linspace(0, len(frames) - 1, min(_SEEN, len(frames))).astype(int))
        looked_at += [frames[place] for place in places]
    store = DecodedStore(work, decoder.key)
    inputs = [store.key(frame) for frame in looked_at]

    def measure() -> int:
        found = []
        for frame in looked_at:
            with suppress(FileError):  # said when the frame is decoded
                found.append(decoder.shrink_factor(read_photograph(frame.images[0])))
        return min((factor for factor in found if factor is not None), default=1)

    return StageStore(work).kept("size of photographs", inputs, measure)


def _shrunk_sentence(captures: Captures, factor: int) -> str:
    """How large the photographs are, and as how large they are read."""
    (w, h), (own_w, own_h) = captures.size, (side // factor for side in captures.size)
    return (
        f"photographs of {w} x {h} pixels are read as {own_w} x {own_h}, which is enough for this pattern "
        f"(shrunk by {factor}); --full-size decodes every pixel"
    )


# Rough camera poses from a transforms.json, from which registration starts.


@dataclass(frozen=True)
class GivenPoses:
    """Camera poses in the order of the frames; NaN where the file has none."""

    T_world_camera: Float64[ndarray, "n 4 4"]
    units: str  # "arbitrary" where the file does not say

    @property
    def known(self) -> Bool[ndarray, "n"]:
        """Frames that have a pose."""
        return np.isfinite(self.T_world_camera).all((1, 2))

    def at_different_places(self, frames: Bool[ndarray, "n"]) -> bool:
        """Whether some of the frames, all with poses, have more than one position."""
        return bool(np.ptp(self.T_world_camera[frames, :3, 3], axis=0).any())

    def chosen(self, frames: Sequence[bool]) -> "GivenPoses":
        """The poses of some of the frames."""
        return GivenPoses(self.T_world_camera[np.array(frames, dtype=bool)], self.units)


def read_given_poses(path: Path, names: Sequence[str]) -> GivenPoses:
    """`transform_matrix` of every frame in the file whose image has the name of a capture.

    Raises FileError if the file is faulty, has poses for fewer than two captures, or all at one place.
    """
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    records = document.get("frames")
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FileError(
            path, "frames: is missing or is not a list", "the file is no transforms.json", "give one with frames"
        )
    T = np.full((len(names), 4, 4), np.nan)
    for index, record in enumerate(records):
        name = frame_label(record, index)
        pose = read_pose(Fields(record, faults, path.name, name), POSES[0]) if name in names else None
        if pose is not None:
            T[names.index(name)] = pose
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.frame}: {fault.field} {fault.problem}", fault.cause, fault.remedy)
    units = document.get("units", "arbitrary")
    if not isinstance(units, str) or units not in UNITS:
        raise FileError(path, f"units is {units!r}", "an unknown unit", f"give one of {', '.join(UNITS)}")
    given = GivenPoses(T, units)
    if given.known.sum() < FEWEST_FRAMES:
        raise FileError(
            path,
            "has poses for fewer than two of the captures",
            "its images have other names than the captures",
            "frames are matched by the image's name without folder and ending: rename the images in the file",
        )
    if not given.at_different_places(given.known):
        raise FileError(
            path,
            "has all captures at the same place",
            "the file holds rotations only",
            "give the cameras' positions, too, or leave --poses out",
        )
    return given


def align_to(
    given: GivenPoses, T_world_camera: Float64[ndarray, "n 4 4"], registered: Bool[ndarray, "n"]
) -> Similarity:
    """The similarity that maps the registered camera poses onto the given ones, in least squares.

    At least two frames must have both, at different places.
    """
    both = registered & given.known
    found, wanted = T_world_camera[both], given.T_world_camera[both]
    # Points on the axes of each camera count, too: the positions of two cameras leave a turn about their line open.
    return fit_similarity(_points(found, _spread(found)), _points(wanted, _spread(wanted)))


def _spread(T: Float64[ndarray, "n 4 4"]) -> float:
    """RMS distance of the devices from their mean."""
    centre = T[:, :3, 3]
    return float(np.sqrt(((centre - centre.mean(0)) ** 2).sum(-1).mean()))


def _points(T: Float64[ndarray, "n 4 4"], distance: float) -> Float64[ndarray, "m 3"]:
    centre, right, up, back = (T[:, :3, k] for k in (3, 0, 1, 2))
    return np.concatenate([centre, *(centre + distance * axis for axis in (right, up, -back))])


# Everything together.


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
    pictures: dict[str, Path]  # without the pattern, by the frame's name


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
    sizes = {frame.name: captures.sizes[frame.camera] for frame in captures.frames}
    masks = None if config.masks is None else find_masks(config.masks, sizes)
    pictures = {} if config.color is None else find_pictures(config.color, captures)
    said = picture_sentences(pictures, captures) if pictures else ()
    file = _file(config) if stated else None
    sigma = read_stated_sigma(file, "projector", (layout.w, layout.h), config.procam_step)
    doubt = StatedSigma(cameras.sigma, sigma)
    last_step = "decode" if config.finds_projector else "match" if cameras.start is None else "calibrate"
    given = None if config.poses is None else read_given_poses(config.poses, names)
    known = None if known is None else frames_by_name(known, names)
    # Everything that was given fits together: now photographs are read.
    shrink = 1 if config.full_size else shrink_factor(captures, decoder, config.work_folder)
    cameras, captures = cameras.shrunk(shrink), captures.shrunk(shrink)
    said = ((_shrunk_sentence(captures, shrink),) if shrink > 1 else ()) + said
    masks = None if masks is None else replace(masks, shrink=shrink)
    devices = cameras.first, projector
    return Inputs(
        FrameJob(config.work_folder, decoder, *devices, config.seed, masks, cameras.several, doubt, last_step, shrink),
        cameras,
        captures,
        stated,
        given,
        None if known is None else known.shrunk(shrink),
        replace(captured.notes, sentences=(*captured.notes.sentences, *said), shrink=shrink),
        pictures,
    )


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

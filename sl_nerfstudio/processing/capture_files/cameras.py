"""The cameras: from the intrinsics file, or, where none describes them, a start from the photographs themselves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sl_nerfstudio.calibration.device_files import read_device_file, read_entries
from sl_nerfstudio.calibration.exif import CameraStart, camera_from_exif
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker
from sl_nerfstudio.progress import track
from sl_nerfstudio.relative_pose.camera_focal import CameraFocal, FrameOfCamera, estimate_camera_focal
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of


@dataclass(frozen=True)
class Cameras:
    """The camera of every folder, or the only one under the name ""."""

    devices: dict[str, Device]
    start: CameraStart | None = None  # None: from a file

    @property
    def first(self) -> Device:
        """The only camera, or the first of several."""
        return next(iter(self.devices.values()))

    @property
    def several(self) -> dict[str, Device]:
        """The cameras by name if there are several; otherwise empty."""
        return {} if "" in self.devices else self.devices


def read_cameras(config: ProcessConfig, captures: Captures) -> Cameras:
    """The cameras of the captures. Raises UserError for files that do not fit, or if nothing is known of the camera."""
    path = config.intrinsics
    if path is not None and any(entry.role != "projector" for entry in read_entries(path, config.procam_step)):
        step = config.procam_step
        return Cameras(
            {name: read_device_file(path, "camera", size, None, step, name) for name, size in captures.sizes.items()}
        )
    images = [frame.images[0] for frame in captures.frames if frame.name not in captures.faults]
    if not images:
        raise next(iter(captures.faults.values()))
    start = camera_from_exif(images, captures.size)
    return Cameras({"": start.camera}, start)


def require_intrinsics(config: ProcessConfig, projector_needed: bool) -> None:
    """Raise UserError if no file is given, although the projector's intrinsics must be in one."""
    if projector_needed and config.intrinsics is None and config.projector_intrinsics is None:
        raise UserError(
            "--intrinsics: no file is given\n    cause:  the intrinsics of the projector must be known\n"
            "    remedy: give a file with camera and projector, or with the projector alone if the photographs state "
            "the camera's focal length; sl-calibrate makes one"
        )


@dataclass(frozen=True)
class CameraNotes:
    """A camera that no file describes: its start, and what the frames say of it."""

    start: CameraStart
    found: CameraFocal | None = None  # None: the frames were not asked

    def sentence(self) -> str:
        """For the output and the report."""
        focal = self.start.camera.fl_x
        said = (
            f"camera: focal length {focal:.0f} px ± {100 * self.start.sigma:.0f} % from EXIF ({self.start.source}), "
            "principal point in the middle, no distortion"
        )
        if self.found is None:
            return said
        return (
            f"{said}; with all frames {focal * self.found.factor:.1f} ± {focal * self.found.sigma:.1f} px "
            f"(frames alone: {focal * self.found.from_frames:.1f} ± {focal * self.found.sigma_from_frames:.1f} px)"
        )

    def document(self) -> dict[str, Any]:
        """As JSON."""
        focal, found = self.start.camera.fl_x, self.found
        return {
            "source": self.start.source,
            "start_px": focal,
            "start_sigma_px": focal * self.start.sigma,
            "px": focal * (1.0 if found is None else found.factor),
            "sigma_px": focal * (self.start.sigma if found is None else found.sigma),
        }


def refine_camera(
    job: FrameJob, results: Sequence[FrameStageResult], start: CameraStart, log: Callable[[str], None]
) -> tuple[FrameJob, list[FrameStageResult], CameraNotes]:
    """The job with the camera's focal length from all frames, and the frames calibrated with it."""
    frames = [
        FrameOfCamera(
            *correspondences_of(result.cloud.coords),
            (result.cloud.pose.T_camera_projector[:3, :3], result.cloud.pose.T_camera_projector[:3, 3]),
        )
        for result in results
        if result.cloud is not None
    ]
    if not frames:
        return job, list(results), CameraNotes(start)
    found = estimate_camera_focal(frames, job.camera, job.projector, start.sigma, job.seed)
    notes = CameraNotes(start, found)
    log(notes.sentence())
    camera = replace(job.camera, fl_x=job.camera.fl_x * found.factor, fl_y=job.camera.fl_y * found.factor)
    refined = replace(job, camera=camera)
    worker = FrameWorker(refined)
    again = [
        result if result.cloud is None else worker.calibrate(result, worker.load(result))
        for result in track(results, "calibrating again", len(results))
    ]
    return refined, again, notes

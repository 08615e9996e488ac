"""The cameras: from the intrinsics file, or, where none describes them, a start from the photographs themselves."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sl_nerfstudio.calibration.device_files import read_device_file, read_entries
from sl_nerfstudio.calibration.exif import CameraStart, camera_from_exif
from sl_nerfstudio.calibration.stated_sigma import CERTAIN, Shares, read_stated_sigma
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.captures import Captures
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of, with_kept_cloud
from sl_nerfstudio.processing.kept.large_clouds import LargeClouds
from sl_nerfstudio.progress import track
from sl_nerfstudio.relative_pose.camera_estimate import CameraEstimate, FrameOfCamera, estimate_camera
from sl_nerfstudio.relative_pose.ray_pairs import correspondences_of

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
    found: CameraEstimate

    def sentence(self) -> str:
        """For the output and the report."""
        camera, (x, y) = self.found.camera, self.found.sigma_centre_px
        return (
            f"camera: focal length {self.start.camera.fl_x:.0f} px ± {100 * self.start.sigma:.0f} % from EXIF "
            f"({self.start.source}); with all frames {camera.fl_x:.1f} ± {self.found.sigma_focal_px:.1f} px, principal "
            f"point ({camera.cx:.1f} ± {x:.1f}, {camera.cy:.1f} ± {y:.1f}) px, k1 {camera.k1:.3f} ± "
            f"{self.found.sigma_k1:.3f}"
        )

    def document(self) -> dict[str, Any]:
        """As JSON."""
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
        frames = [
            FrameOfCamera(*correspondences_of(cloud.coords), (T[:3, :3], T[:3, 3]))
            for cloud in clouds_of(again)
            for T in (cloud.pose.T_camera_projector,)
        ]
        if not frames:
            break
        found = estimate_camera(frames, job.camera, job.projector, start.sigma, job.seed, refined.camera)
        refined = replace(job, camera=found.camera)
        worker, clouds = FrameWorker(refined), LargeClouds()
        again = [
            result if result.cloud is None else with_kept_cloud(worker.calibrate(result), clouds)
            for result in track(again, "calibrating again", len(again))
        ]
    if found is None:
        raise ValueError("no frame has a pose")
    notes = CameraNotes(start, found)
    log(notes.sentence())
    return replace(refined, camera_known=True), again, notes

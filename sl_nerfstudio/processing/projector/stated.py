"""What the user's files say of the projector."""

from pathlib import Path

from sl_nerfstudio.calibration.device_files import read_device_file, read_entries
from sl_nerfstudio.calibration.stated_sigma import Shares, read_stated_sigma
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.capture_files.cameras import Cameras
from sl_nerfstudio.processing.config import ProcessConfig

_USUAL_FOCAL = 1.5  # widths of the image: the middle of what data projectors have


def read_projector(config: ProcessConfig, size: tuple[int, int]) -> tuple[Device, bool]:
    """The projector for patterns of `size` (w, h), and whether a file states it.

    If it is to be found from the frames, no file needs to: then only its size is known. Raises UserError.
    """
    path = _file(config)
    if config.finds_projector and not _described(config):
        if config.projector_model == "DOE":
            raise UserError(
                "--projector-model DOE: a diffractive projector cannot be found without a start\n"
                "    cause:  its pattern is no central projection, so no fundamental matrix tells its intrinsics\n"
                "    remedy: give a rough focal length and the middle of the pattern with --projector-intrinsics"
            )
        w, h = size
        return Device(w, h, _USUAL_FOCAL * w, _USUAL_FOCAL * w, w / 2, h / 2), False
    return read_device_file(path, "projector", size, config.projector_model, config.procam_step), True


def read_projector_sigma(config: ProcessConfig, size: tuple[int, int]) -> Shares:
    """How uncertain the file says that the projector is."""
    return read_stated_sigma(_file(config), "projector", size, config.procam_step)


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

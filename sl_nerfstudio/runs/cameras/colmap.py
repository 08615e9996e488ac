"""A COLMAP model as text, with the projector as a second camera: cameras, rigs, frames, images and points3D.

COLMAP's pixels are this package's: the centre of the first is (0.5, 0.5). Lengths and world axes are the scan's. Each
frame has two images: the capture and, under the name `projector/FRAME.png`, the pattern as its projector "sees" it.
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.runs.cameras.posed_device import PosedDevice, PosedFrames
from sl_nerfstudio.runs.cameras.tracks import SurfaceTracks

_SINE = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880)
"""sin t = t (1 + .. t^2 + .. t^4 + .. t^6 + .. t^8): with these, OPENCV_FISHEYE has the direction cosines of a DOE, to
1e-7 of the focal length up to 65 degrees."""

_RIGID = 1e-6  # largest change of a rotation's entries, and of the translation in baselines, within one rig


def require_possible(frames: PosedFrames, root: Path) -> None:
    """Raise UserError for devices that COLMAP has no model of, and for names that its text format cannot hold."""
    if not any(frames.placed):
        raise UserError(
            "--cameras colmap: no frame agrees with the others, so there is no pose to write\n"
            "    remedy: check the scan with sl-check, or leave --cameras out"
        )
    projector = frames.projectors[0].device
    if projector.model == "DOE" and any((projector.k1, projector.k2, projector.p1, projector.p2)):
        raise UserError(
            "--cameras colmap: the projector has a diffractive element and lens distortion\n"
            "    cause:  COLMAP has no such model\n"
            "    remedy: leave --cameras out, or make a scan whose projector has no distortion"
        )
    for camera in frames.cameras:
        name = camera.image.relative_to(root).as_posix()
        if any(c.isspace() for c in name):
            raise UserError(
                f"--cameras colmap: {name!r} has a space in it\n"
                "    cause:  COLMAP's text files end a name there\n"
                "    remedy: rename the image and its entry in transforms.json, and train again; or leave --cameras out"
            )


def encode_colmap(frames: PosedFrames, root: Path, tracks: SurfaceTracks) -> dict[str, bytes]:
    """The files by name; images are named by their paths below `root`, frames that are not placed are left out.

    Raises UserError as `require_possible` does.
    """
    require_possible(frames, root)
    placed = [k for k, good in enumerate(frames.placed) if good]
    kinds = list(dict.fromkeys(frames.cameras[k].device for k in placed))
    devices = [*kinds, frames.projectors[0].device]
    cameras = [f"{k + 1} {_camera(device)}" for k, device in enumerate(devices)]
    images: list[str] = []
    for k in placed:
        camera, projector = frames.cameras[k], frames.projectors[k]
        name = camera.image.relative_to(root).as_posix()
        mine = np.flatnonzero(tracks.frame == k)
        points = tracks.point[mine].tolist()
        number = kinds.index(camera.device) + 1
        images += [_image(2 * k + 1, camera, number, name), _points(tracks.uv_camera[mine].tolist(), points)]
        name = f"projector/{projector.frame}.png"
        images += [
            _image(2 * k + 2, projector, len(devices), name),
            _points(tracks.uv_projector[mine].tolist(), points),
        ]
    rigs, shots = _rigs(frames, placed, kinds)
    return {
        "rigs.txt": _text("# RIG_ID NUM_SENSORS REF_TYPE REF_ID, then (TYPE ID HAS_POSE QW QX QY QZ TX TY TZ)[]", rigs),
        "frames.txt": _text("# FRAME_ID RIG_ID QW QX QY QZ TX TY TZ NUM_DATA, then (TYPE SENSOR_ID IMAGE_ID)[]", shots),
        "cameras.txt": _text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]; the last one is the projector", cameras),
        "images.txt": _text(
            "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then (X Y POINT3D_ID)[]; world to device, +y down",
            images,
        ),
        "points3D.txt": _text(
            "# POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)", _tracks(tracks, placed)
        ),
    }


def _rigs(frames: PosedFrames, placed: Sequence[int], kinds: Sequence[Device]) -> tuple[list[str], list[str]]:
    """Lines of rigs.txt and frames.txt: one rig if all frames have the same relative pose, else each device alone."""
    relative = [np.linalg.inv(frames.projectors[k].T_world_cv) @ frames.cameras[k].T_world_cv for k in placed]
    baseline = float(np.linalg.norm(relative[0][:3, 3]))
    scaled = np.array(relative) / np.array([1.0, 1.0, 1.0, baseline])
    projector = len(kinds) + 1
    if len(kinds) > 1 or np.ptp(scaled, axis=0).max() > _RIGID:
        rigs = [f"{k + 1} 1 CAMERA {k + 1}" for k in range(projector)]
        shots = []
        for k in placed:
            for number, device in (
                (kinds.index(frames.cameras[k].device) + 1, frames.cameras[k]),
                (projector, frames.projectors[k]),
            ):
                image = 2 * k + (2 if number == projector else 1)
                pose = _pose(np.linalg.inv(device.T_world_cv))
                shots.append(f"{image} {number} {pose} 1 CAMERA {number} {image}")
        return rigs, shots
    shots = [
        f"{k + 1} 1 {_pose(np.linalg.inv(frames.cameras[k].T_world_cv))} 2 CAMERA 1 {2 * k + 1} CAMERA 2 {2 * k + 2}"
        for k in placed
    ]
    return [f"1 2 CAMERA 1 CAMERA 2 1 {_pose(relative[0])}"], shots


def _pose(T: Float64[ndarray, "4 4"]) -> str:
    """A rigid motion as COLMAP writes it: QW QX QY QZ TX TY TZ."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return " ".join(f"{v:.15g}" for v in (w, x, y, z, *T[:3, 3].tolist()))


def _text(comment: str, lines: Sequence[str]) -> bytes:
    return ("\n".join([comment, *lines]) + "\n").encode()


def _camera(device: Device) -> str:
    size, focal = f"{device.w} {device.h}", f"{device.fl_x!r} {device.fl_y!r} {device.cx!r} {device.cy!r}"
    distortion = (device.k1, device.k2, device.p1, device.p2)
    if device.model == "OPENCV":
        return f"OPENCV {size} {focal} {' '.join(map(repr, distortion))}"
    return f"OPENCV_FISHEYE {size} {focal} {' '.join(map(repr, _SINE))}"


def _image(number: int, device: PosedDevice, camera: int, name: str) -> str:
    return f"{number} {_pose(np.linalg.inv(device.T_world_cv))} {camera} {name}"


def _points(uv: list[list[float]], points: list[int]) -> str:
    return " ".join(f"{x:.4f} {y:.4f} {point + 1}" for (x, y), point in zip(uv, points, strict=True))


def _tracks(tracks: SurfaceTracks, placed: Sequence[int]) -> list[str]:
    """One line for each point that an image sees; the error is the mean over its images, and a camera's is 0."""
    seen_by: list[list[str]] = [[] for _ in tracks.p_world]
    error, place = np.zeros(len(tracks.p_world)), np.zeros(len(tracks.frame), dtype=np.int64)
    for k in placed:
        mine = tracks.frame == k
        place[mine] = np.arange(mine.sum())
    good = np.isin(tracks.frame, placed)
    np.add.at(error, tracks.point[good], tracks.residual_px[good])
    for point, frame, at in zip(
        tracks.point[good].tolist(), tracks.frame[good].tolist(), place[good].tolist(), strict=True
    ):
        seen_by[point] += [f"{2 * frame + 1} {at} {2 * frame + 2} {at}"]
    rows = zip(tracks.p_world.tolist(), tracks.rgb.tolist(), error.tolist(), seen_by, strict=True)
    return [
        f"{k + 1} {' '.join(f'{v:.12g}' for v in p)} {' '.join(map(str, rgb))} {e / 2 / len(seen):.4f} {' '.join(seen)}"
        for k, (p, rgb, e, seen) in enumerate(rows)
        if seen
    ]

"""Photographs of a calibration board under a pattern, with their truth: `sl-synth --scene chessboard`."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, UInt8
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.console import track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.pattern.boards import Board, CharucoBoard, Chessboard, draw_board
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.gray_code import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.write import device_fields, encode_json
from sl_nerfstudio.storage import NewFolder
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import DevicePair

# Devices and poses of a board: tilted, near and far, all over the image, and lit by the whole projector.

_FOCAL = 1.3  # in widths of the image: a field of view of 42 degrees
_PROJECTOR_FOCAL = 1.4
_LENS_SHIFT = 1.2  # principal point of the projector, in heights of the pattern from its upper edge
_BASELINE = 0.35  # in distances of the board
_LARGEST_TILT_DEG = 40.0
_NEAREST, _FARTHEST = 0.75, 1.25  # in usual distances
_FILL = 0.45  # of the image's width, at the usual distance
_TRIES = 10_000


@dataclass(frozen=True)
class BoardScene:
    """Both devices, and the board in every pose; boards have x to the right, y up, and z = 0, in millimetres."""

    board: Board
    devices: DevicePair
    T_projector_camera: Float64[ndarray, "4 4"]
    T_camera_board: Float64[ndarray, "n 4 4"]


def board_devices(pattern: tuple[int, int], config: SynthConfig) -> DevicePair:
    """A camera of 4:3, and a projector whose principal point lies below its image; `pattern` is its (w, h)."""
    w, h = config.resolution, round(0.75 * config.resolution)
    f = _FOCAL * w
    camera = Device(w, h, f, f, 0.51 * w, 0.49 * h, *config.camera_distortion)
    columns, rows = pattern
    fp = _PROJECTOR_FOCAL * columns
    projector = Device(columns, rows, fp, fp, 0.49 * columns, _LENS_SHIFT * rows, *config.projector_distortion,
                       config.projector_model)  # fmt: skip
    return DevicePair(camera, projector)


def make_board_scene(board: Board, devices: DevicePair, poses: int, rng: np.random.Generator) -> BoardScene:
    """Poses with all corners in the camera's image and in the pattern."""
    camera, projector = devices.camera, devices.projector
    p_board = np.c_[board.corners() * (1, -1), np.zeros(len(board.corners()))]
    distance = camera.fl_x / camera.w / _FILL * float(np.ptp(p_board[:, 0]))
    T_projector_camera = _relative_pose(projector, distance)
    found: list[ndarray] = []
    for _ in range(_TRIES):
        T = _random_pose(camera, p_board, distance, rng)
        if _inside(camera, T, p_board).all() and _inside(projector, T_projector_camera @ T, p_board).all():
            found.append(T)
            if len(found) == poses:
                return BoardScene(board, devices, T_projector_camera, np.array(found))
    raise AssertionError("the devices see no common volume")


def _relative_pose(projector: Device, distance: float) -> Float64[ndarray, "4 4"]:
    """The middle of the pattern falls on the point at which the camera looks from the usual distance."""
    target = np.array([0.0, 0.0, -distance])
    T_camera_projector = np.eye(4)
    T_camera_projector[:3, 3] = distance * _BASELINE * np.array([np.cos(0.2), np.sin(0.2), 0.1])
    towards = target - T_camera_projector[:3, 3]
    middle = torch.tensor([projector.w / 2, projector.h / 2], dtype=torch.float64)
    ray = unproject(Intrinsics.of(projector, torch.float64), middle).numpy()
    R, _ = Rotation.align_vectors(
        [towards / np.linalg.norm(towards), [0.0, 1.0, 0.0]], [ray, [0.0, 1.0, 0.0]], [1e6, 1.0]
    )
    T_camera_projector[:3, :3] = R.as_matrix()
    return np.linalg.inv(T_camera_projector)


def _random_pose(
    camera: Device, p_board: Float64[ndarray, "n 3"], distance: float, rng: np.random.Generator
) -> Float64[ndarray, "4 4"]:
    tilt = rng.uniform(-_LARGEST_TILT_DEG, _LARGEST_TILT_DEG, 2)
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", [*tilt, rng.uniform(-20, 20)], degrees=True).as_matrix()
    uv = torch.from_numpy(rng.uniform(0.2, 0.8, 2) * (camera.w, camera.h))
    ray = unproject(Intrinsics.of(camera, torch.float64), uv).numpy()
    T[:3, 3] = ray * distance * rng.uniform(_NEAREST, _FARTHEST) - T[:3, :3] @ p_board.mean(0)
    return T


def _inside(device: Device, T_device_board: ndarray, p_board: Float64[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
    p = p_board @ T_device_board[:3, :3].T + T_device_board[:3, 3]
    uv, in_front = project(Intrinsics.of(device, torch.float64), torch.from_numpy(p))
    x, y = uv.numpy().T
    margin = 0.03 * min(device.w, device.h)
    return in_front.numpy() & (x > margin) & (y > margin) & (x < device.w - margin) & (y < device.h - margin)


# Photographs of a board under a projector: albedo of the board times room light and the pattern.

_SQUARE_PX = 64  # of the drawn board
_WHITE, _BLACK, _BEYOND = 0.85, 0.08, 0.4  # albedo of paper, ink, and the plate on which the board is fixed
_ROOM_LIGHT, _LAMP = 0.12, 0.85  # of full scale, on white paper
_PROJECTOR_BLUR, _CAMERA_BLUR = 0.6, 0.5  # standard deviations, pixels
_MARGIN = 1  # squares of white around the board


@dataclass(frozen=True)
class BoardPhotographer:
    """Takes the photographs of one pose."""

    scene: BoardScene
    supersampling: int
    noise: float  # standard deviation, of full scale

    def photographs(
        self, pose: int, patterns: Sequence[UInt8[ndarray, "h w"]], rng: np.random.Generator
    ) -> Iterator[UInt8[ndarray, "h w"]]:
        """One image under each pattern."""
        albedo, lookup = self._surface(self.scene.T_camera_board[pose])
        for pattern in patterns:
            blurred = cv2.GaussianBlur(pattern.astype(np.float32) / 255, (0, 0), _PROJECTOR_BLUR)
            lit = cv2.remap(blurred, *_maps(lookup), cv2.INTER_LINEAR, borderValue=(0.0,))
            yield self._exposed(albedo * (_ROOM_LIGHT + _LAMP * lit), rng)

    def _exposed(self, light: Float32[ndarray, "hs ws"], rng: np.random.Generator) -> UInt8[ndarray, "h w"]:
        camera = self.scene.devices.camera
        image = cv2.resize(light, (camera.w, camera.h), interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image, (0, 0), _CAMERA_BLUR)
        noisy = image / _WHITE + self.noise * rng.standard_normal(image.shape).astype(np.float32)
        return np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)

    def _surface(
        self, T_camera_board: Float64[ndarray, "4 4"]
    ) -> tuple[Float32[ndarray, "hs ws"], Float32[ndarray, "hs ws 2"]]:
        """Albedo, and pattern coordinates, of every supersampled pixel."""
        camera, s = self.scene.devices.camera, self.supersampling
        x, y = np.meshgrid((np.arange(camera.w * s) + 0.5) / s, (np.arange(camera.h * s) + 0.5) / s)
        rays = unproject(Intrinsics.of(camera, torch.float64), torch.from_numpy(np.stack([x, y], -1))).numpy()
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        depth = (R[:, 2] @ t) / (rays @ R[:, 2])
        p_camera = rays * depth[..., None]
        p_board = (p_camera - t) @ R
        T = self.scene.T_projector_camera
        p_projector = torch.from_numpy(p_camera @ T[:3, :3].T + T[:3, 3])
        uv, in_front = project(Intrinsics.of(self.scene.devices.projector, torch.float64), p_projector)
        seen = in_front.numpy() & (depth > 0)
        lookup = np.where(seen[..., None], uv.numpy(), -1e4).astype(np.float32)
        return _albedo(self.scene.board, p_board), lookup


def _albedo(board: Board, p_board: Float64[ndarray, "h w 3"]) -> Float32[ndarray, "h w"]:
    drawn = draw_board(board, _SQUARE_PX, _MARGIN).astype(np.float32) / 255
    values = _BLACK + (_WHITE - _BLACK) * drawn
    place = (p_board[..., :2] * (1, -1) / board.square + _MARGIN) * _SQUARE_PX
    return cv2.remap(values, *_maps(place.astype(np.float32)), cv2.INTER_LINEAR, borderValue=(_BEYOND,))


def _maps(uv: Float32[ndarray, "h w 2"]) -> tuple[Float32[ndarray, "h w"], Float32[ndarray, "h w"]]:
    """Columns and rows as cv2.remap counts them, with the first pixel's centre at 0."""
    return uv[..., 0] - np.float32(0.5), uv[..., 1] - np.float32(0.5)


BOARDS: dict[str, Board] = {
    "chessboard": Chessboard(9, 6, 30.0),
    "charuco": CharucoBoard(11, 8, 30.0, 22.0, "5X5_1000"),
}
"""The boards by the name of their scene."""
_USED = (
    "scene", "frames", "resolution", "pattern", "seed", "projector_model", "camera_distortion",
    "projector_distortion", "supersampling", "sensor_noise",
)  # fmt: skip
_DEFAULT = GrayCode(1024, 768, 2)


def write_board_captures(config: SynthConfig, output: Path) -> None:
    """Photographs in a folder for each pose, pattern.json, and the truth.

    Gray code is photographed image by image; a coded grid once under the pattern and once under white light. Raises
    UserError for flags that say nothing about a board, bad files, or an output that is not empty.
    """
    config.check()
    _refuse_other_flags(config)
    layout = _DEFAULT if config.pattern is None else read_layout(config.pattern)
    board, rng = BOARDS[config.scene], np.random.default_rng([config.seed, 0])
    scene = make_board_scene(board, board_devices((layout.w, layout.h), config), config.frames, rng)
    with NewFolder(output) as folder:
        write_photographs(
            folder, BoardPhotographer(scene, config.supersampling, config.sensor_noise), layout, config.seed
        )
        folder.write("pattern.png", encode_png(np.rint(255 * layout.render()).astype(np.uint8)))
        folder.write("pattern.json", layout.encode(), last=True)


def write_photographs(folder: NewFolder, photographer: BoardPhotographer, layout: PatternLayout, seed: int) -> None:
    """images/ with a folder for each pose, and ground_truth/intrinsics.json."""
    scene, shown = photographer.scene, _shown(layout)
    for pose in track(range(len(scene.T_camera_board)), "rendering"):
        noise = np.random.default_rng([seed, 1, pose])
        for k, image in enumerate(photographer.photographs(pose, shown, noise)):
            folder.write(f"images/pose_{pose:02d}/{k:02d}.png", encode_png(image))
    truth = {
        "units": "mm",
        **{name: device_fields(device, "model") for name, device in vars(scene.devices).items()},
        "T_projector_camera": scene.T_projector_camera.tolist(),
        "T_camera_board": scene.T_camera_board.tolist(),
    }
    folder.write("ground_truth/intrinsics.json", encode_json(truth))


def _shown(layout: PatternLayout) -> list[UInt8[ndarray, "h w"]]:
    if isinstance(layout, GrayCode):
        return list(layout.sequence())
    return [np.rint(255 * layout.render()).astype(np.uint8), np.full((layout.h, layout.w), 255, dtype=np.uint8)]


def _refuse_other_flags(config: SynthConfig) -> None:
    default = SynthConfig(scene=config.scene)
    other = [
        f.name for f in fields(config) if f.name not in _USED and getattr(config, f.name) != getattr(default, f.name)
    ]
    if other:
        flags = ", ".join(f"--{name.replace('_', '-')}" for name in other)
        raise UserError(
            f"{flags}: says nothing about photographs of a {config.scene}\n"
            f"    remedy: leave it out with --scene {config.scene}"
        )

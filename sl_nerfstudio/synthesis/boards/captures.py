"""The folder that `sl-synth --scene chessboard` writes."""

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.new_folder import NewFolder
from sl_nerfstudio.pattern.boards import Board, CharucoBoard, Chessboard
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.scan.writing import device_fields
from sl_nerfstudio.synthesis.boards.photographs import BoardPhotographer
from sl_nerfstudio.synthesis.boards.poses import board_devices, make_board_scene
from sl_nerfstudio.synthesis.config import SynthConfig

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
        "camera": device_fields(scene.camera, "model"),
        "projector": device_fields(scene.projector, "model"),
        "T_projector_camera": scene.T_projector_camera.tolist(),
        "T_camera_board": scene.T_camera_board.tolist(),
    }
    folder.write("ground_truth/intrinsics.json", (json.dumps(truth, indent=1) + "\n").encode())


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

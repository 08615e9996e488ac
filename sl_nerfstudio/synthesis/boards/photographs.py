"""Photographs of a board under a projector: albedo of the board times room light and the pattern."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, UInt8
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Intrinsics, project, unproject
from sl_nerfstudio.pattern.boards import Board, draw_board
from sl_nerfstudio.synthesis.boards.poses import BoardScene

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
        camera = self.scene.camera
        image = cv2.resize(light, (camera.w, camera.h), interpolation=cv2.INTER_AREA)
        image = cv2.GaussianBlur(image, (0, 0), _CAMERA_BLUR)
        noisy = image / _WHITE + self.noise * rng.standard_normal(image.shape).astype(np.float32)
        return np.rint(255 * noisy.clip(0, 1)).astype(np.uint8)

    def _surface(
        self, T_camera_board: Float64[ndarray, "4 4"]
    ) -> tuple[Float32[ndarray, "hs ws"], Float32[ndarray, "hs ws 2"]]:
        """Albedo, and pattern coordinates, of every supersampled pixel."""
        camera, s = self.scene.camera, self.supersampling
        x, y = np.meshgrid((np.arange(camera.w * s) + 0.5) / s, (np.arange(camera.h * s) + 0.5) / s)
        rays = unproject(Intrinsics.of(camera, torch.float64), torch.from_numpy(np.stack([x, y], -1))).numpy()
        R, t = T_camera_board[:3, :3], T_camera_board[:3, 3]
        depth = (R[:, 2] @ t) / (rays @ R[:, 2])
        p_camera = rays * depth[..., None]
        p_board = (p_camera - t) @ R
        T = self.scene.T_projector_camera
        p_projector = torch.from_numpy(p_camera @ T[:3, :3].T + T[:3, 3])
        uv, in_front = project(Intrinsics.of(self.scene.projector, torch.float64), p_projector)
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

"""Every pixel continued from the place that the edge network chooses, and how probable it is that it is wrong."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int
from numpy import ndarray

from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid
from sl_nerfstudio.decoding.grid.edges.channels import EdgeView, edge_view
from sl_nerfstudio.decoding.grid.edges.continuation import continued, slopes, steps
from sl_nerfstudio.decoding.grid.edges.evidence import Evidence
from sl_nerfstudio.decoding.grid.edges.network import MARGIN, EdgeNetwork
from sl_nerfstudio.decoding.grid.rectify import RectifiedImage, integer_centres
from sl_nerfstudio.pattern.grid import GridPattern

_SURELY_WRONG = 20.0  # log odds where nothing can be continued
_STRIP = 512  # rows of the rectified image that the network is given at a time, which bounds its memory


@dataclass(frozen=True)
class Chosen:
    """Coordinates of every pixel that a surface can be continued to, in pattern pixels, and whether they hold."""

    coords: Float32[ndarray, "h w 2"]
    wrong: Float32[ndarray, "h w"]  # probability that they are more than a tenth of a period off


class EdgeChooser:
    """Applies the trained network to captures of one pattern."""

    def __init__(self, network: EdgeNetwork, grid: GridPattern, drawn: tuple[DrawnGrid, ...]) -> None:
        self._network = network
        self._grid = grid
        self._drawn = drawn
        self._steps = steps()

    def choose(self, evidence: Evidence, rectified: RectifiedImage, turn: int) -> Chosen:
        """The best continuation of each pixel; `turn` are the quarter turns of the pattern in the rectified image."""
        view = edge_view(evidence, rectified, turn, self._grid, self._drawn)
        step, wrong = self._predict(view)
        linear = rectified.from_image[:, :2]
        affine = integer_centres(rectified.from_image)
        shape = (evidence.fitted.shape[1], evidence.fitted.shape[0])
        back = cv2.WARP_INVERSE_MAP
        nearest = np.asarray(cv2.warpAffine(step, affine, shape, flags=cv2.INTER_NEAREST | back), dtype=np.int64)
        border = (_SURELY_WRONG,) * 4
        odds = cv2.warpAffine(wrong, affine, shape, flags=cv2.INTER_LINEAR | back, borderValue=border)
        own = self._own_steps(linear)
        scale = float(np.sqrt(abs(np.linalg.det(linear)))) ** -1
        slope = slopes(evidence.fitted, self._grid.period, scale)
        coords = continued(evidence.fitted, slope, own[nearest])
        odds[np.isnan(coords[..., 0])] = _SURELY_WRONG
        return Chosen(coords, (1 / (1 + np.exp(-odds))).astype(np.float32))

    def _predict(self, view: EdgeView) -> tuple[Int[ndarray, "h w"], Float32[ndarray, "h w"]]:
        """Index of the chosen step, and log odds of being wrong, for every pixel of the rectified image."""
        possible = _possible(np.isfinite(view.fitted[..., 0]), self._steps)
        channels, rows = view.channels(), view.fitted.shape[0]
        step, wrong = np.empty(view.fitted.shape[:2], dtype=np.int16), np.empty(view.fitted.shape[:2], dtype=np.float32)
        for first in range(0, rows, _STRIP):
            begin, last = max(0, first - MARGIN), min(first + _STRIP, rows)
            strip = np.ascontiguousarray(channels[:, begin : min(last + MARGIN, rows)])
            with torch.inference_mode():
                output = self._network(torch.from_numpy(strip)[None].contiguous(memory_format=torch.channels_last))
            inner, here = slice(first - begin, last - begin), slice(first, last)
            can = possible[:, here]
            step[here] = np.where(can, output.step[0, :, inner].numpy(), np.float32(-np.inf)).argmax(0)
            wrong[here] = np.where(can.any(0), output.wrong[0, inner].numpy(), np.float32(_SURELY_WRONG))
        return step, wrong

    def _own_steps(self, linear: Float64[ndarray, "2 2"]) -> Int[ndarray, "k 2"]:
        """The steps in pixels of the capture."""
        return np.rint(np.linalg.solve(linear, self._steps.T).T).astype(np.int64)


def _possible(known: Bool[ndarray, "h w"], all_steps: Int[ndarray, "k 2"]) -> Bool[ndarray, "k h w"]:
    """Whether something is known at each step from each pixel."""
    h, w = known.shape
    reach = int(np.abs(all_steps).max())
    padded = np.pad(known, reach)
    return np.stack([padded[reach + dy : reach + dy + h, reach + dx : reach + dx + w] for dx, dy in all_steps])

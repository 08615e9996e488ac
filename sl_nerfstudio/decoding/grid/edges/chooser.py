"""Every pixel continued from the place that the edge network chooses, and how probable it is that it is wrong."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float32, Float64, Int
from numpy import ndarray

from sl_nerfstudio.compiled import compiled
from sl_nerfstudio.decoding.grid.drawn_grid import DrawnGrid
from sl_nerfstudio.decoding.grid.edges.channels import EdgeView, edge_view
from sl_nerfstudio.decoding.grid.edges.continuation import continued, slopes, steps
from sl_nerfstudio.decoding.grid.edges.evidence import Evidence
from sl_nerfstudio.decoding.grid.edges.network import MARGIN, EdgeNetwork
from sl_nerfstudio.decoding.grid.rectify import RectifiedImage, integer_centres
from sl_nerfstudio.decoding.grid.unet import STRIDE
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
        known = np.isfinite(view.fitted[..., 0])
        channels, rows = view.channels(), len(known)
        step, wrong = np.zeros(known.shape, dtype=np.int16), np.full(known.shape, _SURELY_WRONG, dtype=np.float32)
        for first in range(0, rows, _STRIP):
            begin, last = max(0, first - MARGIN), min(first + _STRIP, rows)
            strip = np.ascontiguousarray(channels[:, begin : min(last + MARGIN, rows)])
            with torch.inference_mode():
                maps = self._network.maps(torch.from_numpy(strip)[None].contiguous(memory_format=torch.channels_last))
            here = maps[0].permute(1, 2, 0).numpy()[(first - begin) // STRIDE :]
            _choose(here, known, self._steps, first, last, step, wrong)
        return step, wrong

    def _own_steps(self, linear: Float64[ndarray, "2 2"]) -> Int[ndarray, "k 2"]:
        """The steps in pixels of the capture."""
        return np.rint(np.linalg.solve(linear, self._steps.T).T).astype(np.int64)


@compiled
def _choose(
    maps: ndarray, known: ndarray, all_steps: ndarray, first: int, last: int, step: ndarray, wrong: ndarray
) -> None:
    """Fill rows `first` to `last` - 1: among the steps to places where something is known, the one scored highest.

    `maps` are those of `EdgeNetwork.maps`, (h, w, outputs), from row `first` on. Pixels without such a step are left.
    """
    h, w = known.shape
    count, parts = len(all_steps), STRIDE * STRIDE
    for row in range(first, last):
        for column in range(w):
            at = maps[(row - first) // STRIDE, column // STRIDE]
            part = (row - first) % STRIDE * STRIDE + column % STRIDE
            best, highest = -1, -np.inf
            for k in range(count):
                r, c = row + all_steps[k, 1], column + all_steps[k, 0]
                if 0 <= r < h and 0 <= c < w and known[r, c] and at[k * parts + part] > highest:
                    best, highest = k, at[k * parts + part]
            if best >= 0:
                step[row, column], wrong[row, column] = best, at[count * parts + part]

"""Whole frames in nerfstudio's form, for evaluation, rendering and the viewer. Each is read when it is needed."""

import numpy as np
import torch
from jaxtyping import Float, Float32, Shaped, UInt8
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.dataparser.held_out import held_out_pixels
from sl_nerfstudio.scan import Frame, Scan


class SLDataset(InputDataset):
    """Frames of a scan, at the resolution of `cameras`.

    Besides `image` (RGB, [0, 1]) an item holds, each as (h, w, channels): `pattern` in [0, 1], `coords` in pattern
    pixels (NaN where not decoded), and the flags `mask`, `decoded` and `held_out`.
    """

    @property
    def scan(self) -> Scan:
        """The scan behind the data set."""
        return self.metadata["sl_scan"]

    def get_numpy_image(self, image_idx: int) -> UInt8[ndarray, "h w 3"]:
        """The captured image as 8-bit RGB, from any bit depth and number of channels in the file."""
        return (self._image(image_idx) * 255 + 0.5).astype(np.uint8)

    def get_image_float32(self, image_idx: int) -> Float[Tensor, "h w 3"]:
        """The captured image in [0, 1] with the file's full bit depth."""
        return torch.from_numpy(self._image(image_idx))

    def get_metadata(self, data: dict) -> dict[str, Tensor]:
        """The data of the pixels other than their colour."""
        index = data["image_idx"]
        frame = self.scan.frames[index]
        coords = frame.read_coords()
        mask = np.isfinite(coords).all(-1) if frame.mask_path is None else frame.read_mask()
        images = {
            "coords": coords,
            "pattern": frame.read_pattern()[..., None],
            "mask": mask[..., None],
            "decoded": (np.isfinite(coords).all(-1) & mask)[..., None],
            "held_out": (held_out_pixels(index, *mask.shape) & mask)[..., None],
        }
        return {name: torch.from_numpy(self._resized(index, image)) for name, image in images.items()}

    def _image(self, index: int) -> Float32[ndarray, "h w 3"]:
        return self._resized(index, _rgb(self.scan.frames[index]))

    def _resized(self, index: int, image: Shaped[ndarray, "h w c"]) -> Shaped[ndarray, "h2 w2 c"]:
        """An image at the camera's resolution, by nearest pixel: coordinates must not be averaged across edges."""
        h, w = int(self.cameras.height[index]), int(self.cameras.width[index])
        rows, columns = _nearest(h, image.shape[0]), _nearest(w, image.shape[1])
        return np.ascontiguousarray(image[rows[:, None], columns[None, :]])


def _nearest(size: int, source: int) -> ndarray:
    return ((np.arange(size) + 0.5) * source / size).astype(np.int64)


def _rgb(frame: Frame) -> Float32[ndarray, "h w 3"]:
    stored = frame.read_image()
    image = stored.astype(np.float32) / np.iinfo(stored.dtype).max
    if image.ndim == 2:
        image = image[..., None]
    return image.repeat(3, -1) if image.shape[-1] == 1 else image

"""Clouds of many frames: beyond a share of the memory their arrays are in temporary files, mapped into memory."""

import threading
from collections.abc import Sequence

from numpy import ndarray

from sl_nerfstudio.files.large_arrays import in_file, largest_in_memory
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.processing.kept.records import with_arrays
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.relative_pose.degeneracy import Degeneracy
from sl_nerfstudio.relative_pose.estimation import RelativePose

_CLASSES = (FrameCloud, RelativePose, Degeneracy, Device)


class LargeClouds:
    """Takes clouds, also from several threads. Files are gone with the process, whatever ends it."""

    def __init__(self, most_bytes: int | None = None) -> None:
        """`most_bytes` of clouds stay in memory; default: a share of it."""
        self._left = largest_in_memory() if most_bytes is None else most_bytes
        self._counting = threading.Lock()

    def kept(self, cloud: FrameCloud) -> FrameCloud:
        """An equal cloud. Raises UserError if there is no space for the file."""
        return with_arrays(cloud, _CLASSES, self._arrays)

    def _arrays(self, arrays: Sequence[ndarray]) -> Sequence[ndarray]:
        with self._counting:
            self._left -= sum(array.nbytes for array in arrays)
            fits = self._left >= 0
        return arrays if fits else in_file(arrays)

"""How uncertain the intrinsics in a file are, where the file says so: sl-calibrate's does."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.device_files import chosen_entry
from sl_nerfstudio.calibration.formats.entry import Role

CERTAIN = (0.0, 0.0, 0.0)
Shares = tuple[float, float, float]


@dataclass(frozen=True)
class StatedSigma:
    """1 sigma of focal length and principal point x, y of both devices, as shares of their focal lengths.

    0 where nothing is stated: such values count as certain.
    """

    camera: Shares = CERTAIN
    projector: Shares = CERTAIN

    @property
    def either(self) -> Float64[ndarray, "3 3"]:
        """Covariance of what a wrong value of either device looks like in one of them.

        A focal length of the camera that is one per cent off looks much like one of the projector, and a principal
        point that lies beside its place is a turn of the device.
        """
        return np.diag(np.square(self.camera) + np.square(self.projector))

    @property
    def both(self) -> Float64[ndarray, "6"]:
        """1 sigma of the six values, the camera's first."""
        return np.array([*self.camera, *self.projector])


def read_stated_sigma(
    path: Path | None, role: Role, size: tuple[int, int], procam_step: int = 1, name: str = ""
) -> Shares:
    """What a file states of a device that `read_device_file` reads; `CERTAIN` if it states nothing, or for no file."""
    if path is None:
        return CERTAIN
    entry = chosen_entry(path, role, size, procam_step, name)
    focal = float(entry.matrix[0, 0])
    a, b, c = entry.sigma_px
    return a / focal, b / focal, c / focal

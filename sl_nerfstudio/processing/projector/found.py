"""A projector's intrinsics that were found from the frames, with their uncertainty, for reports and for programs."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device

FIELDS = ("fl_x", "fl_y", "cx", "cy", "k1")


@dataclass(frozen=True)
class FoundProjector:
    """The projector, and 1 sigma of `FIELDS`: pixels, and k1 as it is; 0 where a value was kept."""

    projector: Device
    sigma: tuple[float, float, float, float, float]
    frames: int  # that it was found from
    noise_px: float  # robust standard deviation of what is left, projector pixels
    method: str  # in words
    doubt: str = ""  # why it is uncertain, and what to add; "" if it is well determined

    @property
    def sigma_share(self) -> Float64[ndarray, "3"]:
        """1 sigma of focal length and principal point, as shares of the focal length."""
        focal = self.projector.fl_x
        return np.array([self.sigma[0], self.sigma[2], self.sigma[3]]) / focal

    def sigmas(self) -> dict[str, float]:
        """1 sigma by the name of the value."""
        return dict(zip(FIELDS, self.sigma, strict=True))

    def document(self) -> dict[str, Any]:
        """As JSON."""
        device = self.projector
        return {
            "method": self.method,
            **{key: getattr(device, key) for key in FIELDS},
            "sigma": self.sigmas(),
            "frames": self.frames,
            "noise_px": self.noise_px,
            "doubt": self.doubt or None,
        }


def describe(found: FoundProjector) -> str:
    """One sentence with all values and 1 sigma of each."""
    d, s = found.projector, found.sigma
    focal = f"focal lengths {d.fl_x:.1f} ± {s[0]:.1f}, {d.fl_y:.1f} ± {s[1]:.1f} px"
    centre = f"principal point ({d.cx:.1f} ± {s[2]:.1f}, {d.cy:.1f} ± {s[3]:.1f}) px"
    lens = f", k1 {d.k1:.4f} ± {s[4]:.4f}" if s[4] else ""
    return f"projector, {found.method}: {focal}, {centre}{lens}"

"""Intrinsics of one device, and of a batch of devices as a tensor."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from numpy import ndarray
from torch import Tensor

DeviceKind = Literal["OPENCV", "DOE"]
"""Names of the device models, the keys of `models.MODELS`."""
PARAMETERS = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")


@dataclass(frozen=True)
class Device:
    """Intrinsics of one camera or projector; focal lengths and principal point in pixels."""

    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    model: DeviceKind = "OPENCV"

    @property
    def parameters(self) -> Float64[ndarray, "8"]:
        """PARAMETERS, for compiled loops."""
        return np.array([getattr(self, key) for key in PARAMETERS], dtype=np.float64)

    def scaled(self, factor: float) -> "Device":
        """The same device with its image resized by `factor` (no half-pixel shift, because centres are at .5)."""
        return replace(
            self,
            w=round(self.w * factor),
            h=round(self.h * factor),
            **{k: getattr(self, k) * factor for k in ("fl_x", "fl_y", "cx", "cy")},
        )


DEVICE_FIELDS = tuple(f.name for f in fields(Device))


@dataclass(frozen=True)
class Intrinsics:
    """A batch of devices of one model as a tensor; `params` holds PARAMETERS in the last dimension."""

    params: Float[Tensor, "*batch 8"]
    model: DeviceKind
    distorted: bool

    @staticmethod
    def of(devices: Device | Sequence[Device], dtype: torch.dtype = torch.float32) -> "Intrinsics":
        """Batch of shape () from one device, or (n,) from a sequence. Raises ValueError for mixed models."""
        if isinstance(devices, Device):
            one = Intrinsics.of([devices], dtype)
            return Intrinsics(one.params[0], one.model, one.distorted)
        models: list[DeviceKind] = sorted({d.model for d in devices})
        if len(models) != 1:
            raise ValueError(f"devices of one batch must share a model, got {models}")
        params = torch.tensor([d.parameters.tolist() for d in devices], dtype=dtype)
        return Intrinsics(params, models[0], bool((params[:, 4:] != 0).any()))

    def __getitem__(self, index: Int[Tensor, "*n"] | int | slice) -> "Intrinsics":
        """Devices selected along the first batch dimension."""
        return Intrinsics(self.params[index], self.model, self.distorted)

    def to(self, *args: torch.device | torch.dtype | str) -> "Intrinsics":
        """On another torch device, or with another dtype."""
        return Intrinsics(self.params.to(*args), self.model, self.distorted)  # pyright: ignore[reportCallIssue, reportArgumentType]

    def reshape(self, *shape: int) -> "Intrinsics":
        """With another batch shape, for broadcasting against points."""
        return Intrinsics(self.params.reshape(*shape, 8), self.model, self.distorted)

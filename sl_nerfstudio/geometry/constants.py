"""Small constant tensors, copied to a device once: a copy from the host's memory makes the host wait for a GPU."""

from functools import lru_cache

import torch
from torch import Tensor

Numbers = tuple[float, ...] | tuple[tuple[float, ...], ...]


@lru_cache(maxsize=256)
def constant(values: Numbers, dtype: torch.dtype, device: torch.device) -> Tensor:
    """The tensor of some numbers; it is shared, so it must not be changed."""
    with torch.inference_mode(False):
        return torch.tensor(values, dtype=dtype, device=device)

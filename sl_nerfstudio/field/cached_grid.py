"""A coarse grid of the field's values: a very cheap way to find where a ray meets the surface."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.field.signed_distance import SignedDistance

_BAND_CELLS = 3.0  # vertices this close to the surface are kept up to date
_AT_ONCE = 131072


class CachedGrid(nn.Module):
    """Values of a field on a grid of [-1, 1]^3.

    Part of a checkpoint, so that a resumed run samples as an uninterrupted one would.
    """

    values: Tensor
    filled: Tensor

    def __init__(self, resolution: int = 96) -> None:
        super().__init__()
        self.resolution = resolution
        self.register_buffer("values", torch.zeros(resolution, resolution, resolution))
        self.register_buffer("filled", torch.tensor(False))
        self.is_filled = False  # the same, known to the host
        self.register_load_state_dict_post_hook(_read_filled)

    @property
    def cell(self) -> float:
        """Distance between neighbouring vertices."""
        return 2 / (self.resolution - 1)

    @torch.no_grad()
    def refresh(self, field: SignedDistance) -> None:
        """Evaluate the field again near its cached surface; the first time, and on a GPU, everywhere.

        A GPU does that in milliseconds, and would have to tell the host how many vertices are near.
        """
        flat = self.values.reshape(-1)
        if self.is_filled and flat.device.type == "cpu":
            index = (flat.abs() < _BAND_CELLS * self.cell).nonzero()[:, 0]
        else:
            index = torch.arange(len(flat), device=flat.device)
        n = self.resolution
        for part in index.split(_AT_ONCE):
            xyz = torch.stack([part % n, part // n % n, part // (n * n)], -1)
            flat[part] = field.sdf(xyz * self.cell - 1.0)
        self.filled.fill_(True)
        self.is_filled = True

    def look_up(self, p: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Trilinear values at points; outside the box, the value at the border."""
        grid = p.reshape(1, -1, 1, 1, 3)
        found = F.grid_sample(self.values[None, None], grid, padding_mode="border", align_corners=True)
        return found.reshape(-1)


def _read_filled(cache: CachedGrid, _: object) -> None:
    """After a checkpoint was loaded."""
    cache.is_filled = bool(cache.filled)

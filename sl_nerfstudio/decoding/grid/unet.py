"""The U-Net: where in a rectified image the pattern is, the phases of its grid, and the symbols."""

from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.decoding.grid.channels import CHANNELS
from sl_nerfstudio.pattern.codes import SYMBOLS

STRIDE = 2
"""Pixels of the image per pixel of the network's maps."""
_WIDTHS = (16, 32, 64, 96)
MULTIPLE = STRIDE * 2 ** (len(_WIDTHS) - 1)
"""Width and height of the image must be multiples of this."""


class NetworkOutput(NamedTuple):
    """What the network predicts, at half the resolution of its input; places lie where four pixels meet."""

    mask: Float[Tensor, "b h w"]  # logit: the pattern is here
    phase: Float[Tensor, "b 4 h w"]  # cosine and sine of the phase in x, then in y; both 0 where unknown
    symbol: Float[Tensor, "b 5 h w"]  # logits of the symbol of the nearest node


class LevelNetwork(nn.Module):
    """Levels of two 3 x 3 convolutions, down and up again; the image enters with 2 x 2 pixels folded into channels."""

    def __init__(self, channels: int, widths: tuple[int, ...], outputs: int) -> None:
        super().__init__()
        self.down = nn.ModuleList(
            ConvolutionPair(n_in, n_out) for n_in, n_out in pairwise((channels * STRIDE**2, *widths))
        )
        self.up = nn.ModuleList(ConvolutionPair(deep + own, own) for own, deep in pairwise(widths))
        self.head = nn.Conv2d(widths[0], outputs, 1)

    def maps(self, channels: Float[Tensor, "b c h2 w2"]) -> Float[Tensor, "b outputs h w"]:
        """The outputs at half the resolution of the image."""
        x = F.pixel_unshuffle(channels, STRIDE)
        kept: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else F.max_pool2d(x, 2))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            larger = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.up[level](torch.cat([larger, kept[level]], 1))
        return self.head(x)


class UNet(LevelNetwork):
    """Four levels, for images whose sides are multiples of `MULTIPLE`."""

    def __init__(self) -> None:
        super().__init__(CHANNELS, _WIDTHS, 1 + 4 + SYMBOLS)

    def forward(self, channels: Float[Tensor, "b 2 h2 w2"]) -> NetworkOutput:
        """Predict for images whose sides are multiples of `MULTIPLE`."""
        out = self.maps(channels)
        return NetworkOutput(out[:, 0], out[:, 1:5], out[:, 5:])


class ConvolutionPair(nn.Sequential):
    """Two convolutions, each followed by batch normalisation and a rectifier."""

    def __init__(self, n_in: int, n_out: int) -> None:
        super().__init__(
            nn.Conv2d(n_in, n_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(n_out),
            nn.ReLU(inplace=True),
            nn.Conv2d(n_out, n_out, 3, padding=1, bias=False),
            nn.BatchNorm2d(n_out),
            nn.ReLU(inplace=True),
        )

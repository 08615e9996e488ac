"""The edge network: from which place each pixel of a rectified image is continued, and how probably it is wrong."""

from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.decoding.grid.edges.channels import CHANNELS
from sl_nerfstudio.decoding.grid.edges.continuation import steps
from sl_nerfstudio.decoding.grid.unet import ConvolutionPair

_STRIDE = 2
_WIDTHS = (32, 48, 64, 64)
_STEPS = len(steps())
MARGIN = 112
"""Pixels around a part of an image on which its output depends, at most; a multiple of `unet.MULTIPLE`."""
_OWN = 2.0  # log odds of the pixel itself at the beginning of the training


class EdgeOutput(NamedTuple):
    """What the network predicts for every pixel of its input."""

    step: Float[Tensor, "b k h w"]  # logit of each of `continuation.steps`
    wrong: Float[Tensor, "b h w"]  # logit: more than a tenth of a period off, or the pattern is not here


class EdgeNetwork(nn.Module):
    """Four levels of two 3 x 3 convolutions; 2 x 2 pixels are folded into channels, and unfolded at the end."""

    def __init__(self) -> None:
        super().__init__()
        widths = _WIDTHS
        self.down = nn.ModuleList(
            ConvolutionPair(n_in, n_out) for n_in, n_out in pairwise((CHANNELS * _STRIDE**2, *widths))
        )
        self.up = nn.ModuleList(ConvolutionPair(deep + own, own) for own, deep in pairwise(widths))
        self.head = nn.Conv2d(widths[0], (_STEPS + 1) * _STRIDE**2, 1)
        bias = torch.zeros((_STEPS + 1) * _STRIDE**2)
        bias[: _STRIDE**2] = _OWN
        self.head.bias = nn.Parameter(bias)
        nn.init.zeros_(self.head.weight)

    def forward(self, channels: Float[Tensor, "b c h w"]) -> EdgeOutput:
        """Predict for images whose sides are multiples of `unet.MULTIPLE`."""
        x = F.pixel_unshuffle(channels, _STRIDE)
        kept: list[Tensor] = []
        for level, block in enumerate(self.down):
            x = block(x if level == 0 else F.max_pool2d(x, 2))
            kept.append(x)
        for level in reversed(range(len(self.up))):
            larger = F.interpolate(x, scale_factor=2.0, mode="nearest")
            x = self.up[level](torch.cat([larger, kept[level]], 1))
        out = F.pixel_shuffle(self.head(x), _STRIDE)
        return EdgeOutput(out[:, :_STEPS], out[:, _STEPS])

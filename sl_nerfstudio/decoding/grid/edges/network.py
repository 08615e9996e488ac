"""The edge network: from which place each pixel of a rectified image is continued, and how probably it is wrong."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sl_nerfstudio.decoding.grid.edges.channels import CHANNELS
from sl_nerfstudio.decoding.grid.edges.continuation import steps
from sl_nerfstudio.decoding.grid.unet import STRIDE, LevelNetwork

_WIDTHS = (32, 48, 64, 64)
_STEPS = len(steps())
MARGIN = 112
"""Pixels around a part of an image on which its output depends, at most; a multiple of `unet.MULTIPLE`."""
_OWN = 2.0  # log odds of the pixel itself at the beginning of the training


class EdgeOutput(NamedTuple):
    """What the network predicts for every pixel of its input."""

    step: Float[Tensor, "b k h w"]  # logit of each of `continuation.steps`
    wrong: Float[Tensor, "b h w"]  # logit: more than a tenth of a period off, or the pattern is not here


class EdgeNetwork(LevelNetwork):
    """Four levels; what they predict for 2 x 2 pixels is unfolded at the end."""

    def __init__(self) -> None:
        outputs = (_STEPS + 1) * STRIDE**2
        super().__init__(CHANNELS, _WIDTHS, outputs)
        bias = torch.zeros(outputs)
        bias[: STRIDE**2] = _OWN
        self.head.bias = nn.Parameter(bias)
        nn.init.zeros_(self.head.weight)

    def forward(self, channels: Float[Tensor, "b c h w"]) -> EdgeOutput:
        """Predict for images whose sides are multiples of `unet.MULTIPLE`.

        Map c s s + s i + j of `maps`, with s = `STRIDE`, holds what output c is at rows i, s + i, .. and columns
        j, s + j, ..; the last output is `wrong`.
        """
        out = F.pixel_shuffle(self.maps(channels), STRIDE)
        return EdgeOutput(out[:, :_STEPS], out[:, _STEPS])

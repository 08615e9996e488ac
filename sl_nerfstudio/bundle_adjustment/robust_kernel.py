"""The robust kernel of the bundle adjustment: wrong decodings lose their influence, slow frames keep theirs.

Its width shrinks with the residuals (graduated non-convexity: Yang et al., RA-L 2020), separately for every frame: when
most frames already fit, a frame that does not yet fit keeps a kernel wide enough to be pulled in.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.loops.groups import Groups
from sl_nerfstudio.bundle_adjustment.loops.medians import medians_by_frame
from sl_nerfstudio.bundle_adjustment.residuals import Residuals, array
from sl_nerfstudio.bundle_adjustment.settings import KernelSettings
from sl_nerfstudio.geometry.robust import (
    MAD_TO_SIGMA,
    geman_mcclure_cost,
    geman_mcclure_curvature,
    geman_mcclure_weight,
)


@dataclass(frozen=True)
class Kernel:
    """The Geman-McClure kernel, with a width for each frame; a gross error costs the same at any width."""

    width: Float[Tensor, "frames"]  # projector pixels
    frame: Int[Tensor, "anchors"]
    pair: Int[Tensor, "2 rows"]  # frame of the anchor, frame that looks it up
    noise_ratio: Float[Tensor, "rows"] | None = None  # noise of each look-up over the usual one: as much wider

    @property
    def narrowest(self) -> float:
        """Width of the frames that fit best."""
        return float(self.width.min())

    def weights(self, r: Residuals) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]:
        """Weights of own and cross residuals, for the normal equations."""
        parts = []
        for value, width2 in zip((r.own, r.cross), self._squares(), strict=True):
            parts.append(self.narrowest**2 / width2 * geman_mcclure_weight((value * value).sum(-1) / width2))
        own, cross = parts
        return own, torch.where(r.cross_valid, cross, torch.zeros_like(cross))

    def curvature(self, r: Residuals) -> float:
        """Second derivative of the cost over what the weights make of it, all residuals together.

        Weighted normal equations take weights for constants, and so overrate what residuals say by the inverse of this
        (Huber, Robust Statistics, 1981, section 7.6).
        """
        own2, cross2 = self._squares()
        parts = (r.own, own2), (r.cross[r.cross_valid], cross2[r.cross_valid])
        squares = [((value * value).sum(-1) / width2, width2) for value, width2 in parts]
        true = sum(float((geman_mcclure_curvature(u) / width2).sum()) for u, width2 in squares)
        return true / sum(float((geman_mcclure_weight(u) / width2).sum()) for u, width2 in squares)

    def cost(self, r: Residuals, valid: Bool[Tensor, "rows"]) -> float:
        """The data's part of the objective, px^2; half of its gradient is that of the weighted normal equations."""
        own2, cross2 = self._squares()
        own = ((r.own**2).sum(-1), own2)
        cross = ((r.cross**2).sum(-1)[valid], cross2[valid])
        return self.narrowest**2 * sum(float(geman_mcclure_cost(r2 / w2).sum()) for r2, w2 in (own, cross))

    def _squares(self) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]:
        cross = self.width[self.pair].amax(0)
        cross = cross if self.noise_ratio is None else cross * self.noise_ratio
        return self.width[self.frame] ** 2, cross**2


def frame_medians(r: Residuals, pair: Int[Tensor, "2 rows"], frames: int) -> Float[Tensor, "frames"]:
    """Median of the cross residuals that involve each frame; infinite if there are none."""
    groups = [Groups.of(array(one), frames) for one in pair]
    out = np.empty(frames)
    parts = [part for group in groups for part in (group.first, group.entries)]
    medians_by_frame(frames, *parts, array(r.cross.norm(dim=-1)), array(r.cross_valid), out)
    return torch.from_numpy(out)


def narrowed(
    width: Float[Tensor, "frames"], target: Float[Tensor, "frames"], settings: KernelSettings
) -> Float[Tensor, "frames"]:
    """Kernel widths one gradual step closer to a narrower target: a part of a frame may fit before all of it does."""
    gently = torch.where(width.isfinite(), width / settings.fastest, torch.zeros_like(width))
    return torch.minimum(width, torch.maximum(target, gently))


def noise_of(r: Residuals, width: float, settings: KernelSettings) -> float:
    """Robust 1 sigma of one residual component, from the residuals that the kernel keeps; pattern pixels."""
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 2 * width)
    values = r.cross[inliers].reshape(-1).abs()
    return max(float(values.median()) * MAD_TO_SIGMA, settings.noise_floor_px)


def useful_distance(distance: Float[Tensor, "n"], size: Float[Tensor, "n"], settings: KernelSettings) -> float:
    """Distance from the border of what was decoded from which on residuals are no larger than usual.

    Classes by distance hold equally many. Only those that are nearer than most are asked, so at most half fall away.
    """
    if not len(distance):
        return 0.0
    shares = np.linspace(0, 1, settings.border_classes + 1)[: settings.border_classes // 2 + 1]
    edges = np.quantile(array(distance), shares)
    most = settings.most_border_noise * float(size.median().clamp_min(settings.noise_floor_px))
    for low, high in reversed(list(pairwise(edges.tolist()))):
        mine = (distance >= low) & (distance < high)
        if mine.any() and float(size[mine].median()) > most:
            return high
    return 0.0


def noise_ratios(r: Residuals, cosine: Float[Tensor, "rows"], settings: KernelSettings) -> Float[Tensor, "rows"]:
    """Noise of each look-up over that of all, from the residuals of those that see their surface as obliquely.

    `cosine`: between the surface's normal and the line of sight. Classes hold equally many look-ups.
    """
    size, known = r.cross.norm(dim=-1), r.cross_valid
    if not known.any():
        return torch.ones_like(size)
    shares = np.linspace(0, 1, settings.obliqueness_classes + 1)[1:-1]
    group = torch.bucketize(cosine, torch.from_numpy(np.quantile(array(cosine[known]), shares)))
    usual, ratio = size[known].median(), torch.ones_like(size)
    for k in range(settings.obliqueness_classes):
        mine = group == k
        if (mine & known).any():
            ratio[mine] = size[mine & known].median() / usual.clamp_min(settings.noise_floor_px)
    return ratio.clamp_min(settings.least_noise_ratio)

"""What a search is given, and how far it has come."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.levenberg_marquardt import LMState
from sl_nerfstudio.bundle_adjustment.observations import observe, partners, place_anchors
from sl_nerfstudio.bundle_adjustment.priors import PosePrior
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Residuals, viewing_cosines
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.bundle_adjustment.robust_kernel import Kernel, noise_ratios
from sl_nerfstudio.bundle_adjustment.settings import AdjustmentSettings

FRAMES_MOVE = ("free", "rigid-rig", "known-rig")
"""What may be refined if single frames are to move by themselves."""
_NO_GATE = float("inf")  # pixels: no residual is too large to be used


@dataclass(frozen=True)
class Problem:
    """What does not change during an adjustment."""

    start: Rig  # to which the prior belongs
    begin: Rig  # where the search begins
    maps: CoordinateMaps
    prior: PosePrior
    settings: AdjustmentSettings
    generator: torch.Generator
    partners: Bool[Tensor, "frames frames"]
    anchors: Anchors  # where they are at its beginning
    expected: Float[Tensor, "frames"]  # support of each frame with which it is not lost; -inf: it is never searched for

    def observe(self, state: LMState) -> Observations:
        """A new choice of which frame looks up which anchor."""
        s = self.settings
        return observe(
            state.rig, state.anchors, self.maps, s.frames_per_anchor, _NO_GATE, s.least_cosine, self.generator,
            self.partners,
        )  # fmt: skip

    def again(self, start: Rig, begin: Rig, expected: Float[Tensor, "frames"]) -> "Problem":
        """The same problem for another search, which expects that support of each frame."""
        return replace(problem_of(start, self.maps, self.prior, self.settings, begin), expected=expected)


@dataclass(frozen=True)
class Progress:
    """The current state of an adjustment."""

    state: LMState
    rows: Observations
    widths: Float[Tensor, "frames"]  # of each frame's kernel
    noise: float
    iterations: int

    @property
    def pairs(self) -> Int[Tensor, "2 rows"]:
        """Frame of the anchor, frame that looks it up."""
        return self.rows.pairs(self.state.anchors)

    def at(self, rig: Rig, moved: Bool[Tensor, "frames"]) -> "Progress":
        """The same with some frames at other poses; the kernels of those frames are wide again."""
        widths = torch.where(moved, torch.full_like(self.widths, float("inf")), self.widths)
        return replace(self, state=replace(self.state, rig=rig), widths=widths)


def kernel_of(
    state: LMState, rows: Observations, widths: Float[Tensor, "frames"], r: Residuals, problem: Problem
) -> Kernel:
    """The kernel with the noise that look-ups have by how obliquely a camera sees the surface."""
    cosine = viewing_cosines(state.rig, state.anchors, rows)
    ratio = noise_ratios(r, cosine, problem.settings.kernel)
    return Kernel(widths, state.anchors.frame, rows.pairs(state.anchors), ratio)


def problem_of(
    start: Rig, maps: CoordinateMaps, prior: PosePrior, settings: AdjustmentSettings, begin: Rig | None = None
) -> Problem:
    """A search that begins at the starting poses, or elsewhere."""
    begin = start if begin is None else begin
    generator = torch.Generator().manual_seed(settings.seed)
    per_frame = min(settings.anchors_per_frame, settings.max_anchors // start.frames)
    per_frame = max(per_frame, min(settings.least_anchors_per_frame, settings.anchors_per_frame))
    anchors = place_anchors(begin, maps, per_frame, generator)
    together = partners(begin, anchors, maps, settings.partners, settings.least_cosine, generator)
    whatever = torch.full((start.frames,), float("inf"), dtype=torch.float64)
    return Problem(start, begin, maps, prior, settings, generator, together, anchors, whatever)

"""Settings of losses and of samples along rays."""

from dataclasses import dataclass
from typing import Literal


@dataclass
class LossConfig:
    """Weights of the losses. Lengths are in scene units (the object's radius is 0.8)."""

    coordinates: float = 0.1
    """Weight of the rendered coordinates' L1 error, converted to a length by the scan's median depth sensitivity."""
    coordinates_per_pixel: float | None = None
    """If set, the weight of the coordinates' L1 error in pattern pixels, used instead of `coordinates`."""
    pattern: float = 0.005
    """Weight of the pattern term, 1 - cosine of rendered and captured intensities."""
    eikonal: float = 0.1
    """Weight of the Eikonal term, the mean squared difference between the field's slope and one."""
    surface: float = 1.0
    """Weight of the direct term |f| at triangulated points."""
    free_space: float = 1.0
    """Weight of the sign terms: positive in front of a triangulated point, negative just behind it."""

    @property
    def direct(self) -> bool:
        """Whether the terms on triangulated points have any weight."""
        return self.surface != 0 or self.free_space != 0


@dataclass
class SamplingConfig:
    """Where the field is evaluated in a training step."""

    strategy: Literal["surface", "uniform"] = "surface"
    """`surface`: around the crossing found in a cached coarse grid; `uniform`: along the whole ray."""
    samples: int = 16
    """Samples per ray for volume rendering."""
    half_width: float = 4.0
    """Half the interval sampled around the surface, in units of 1 / kappa (plus one cell of the cached grid)."""
    render_rays: int = 256
    """Rays of a batch that are volume rendered; the direct terms use all of the batch's decoded rays."""
    eikonal_points: int = 1024
    """Random points of the scene at which the Eikonal term is evaluated, besides the surface points."""

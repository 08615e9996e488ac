"""How complete a surface is: of what the frames decoded, and where it ends."""

from dataclasses import dataclass

import numpy as np

from sl_nerfstudio.evaluation.capture_agreement import CaptureAgreement
from sl_nerfstudio.evaluation.completeness.openings import Openings, find_openings
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA

_LEAST_NOISE_PX = 0.1  # pattern pixels: no decoding is better


@dataclass(frozen=True)
class Completeness:
    """What the surface has and lacks; lengths in the scan's unit."""

    observed: float  # share of what the frames decoded that the surface has
    surface_area: float
    openings: Openings
    noise_px: float  # of the decoding, 1 sigma, pattern pixels

    @property
    def rim_area(self) -> float:
        """Area of the largest opening: where the scan as a whole ends, for instance below."""
        return float(self.openings.area[:1].sum())

    @property
    def hole_share(self) -> float:
        """Area of all openings but the largest, relative to the surface's."""
        return float(self.openings.area[1:].sum()) / self.surface_area


def assess_completeness(surface: IndexedMesh, agreement: CaptureAgreement) -> Completeness:
    """What the surface has of what was decoded, and where it ends."""
    decoded = np.array([frame.pixels * frame.decoded_share for frame in agreement.frames])
    missing = float((decoded * [frame.hole_share for frame in agreement.frames]).sum())
    openings = find_openings(surface.mesh)
    noise = max(MAD_TO_SIGMA * float(np.nan_to_num(agreement.epipolar_px_median)), _LEAST_NOISE_PX)
    return Completeness(
        observed=1 - missing / decoded.sum() if decoded.sum() else float("nan"),
        surface_area=surface.area,
        openings=openings,
        noise_px=noise,
    )

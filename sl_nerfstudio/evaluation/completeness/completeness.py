"""How complete a surface is: of what the frames decoded, and where it ends."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sl_nerfstudio.evaluation.capture_agreement import CaptureAgreement
from sl_nerfstudio.evaluation.completeness.next_view import NextView, next_view
from sl_nerfstudio.evaluation.completeness.openings import Openings, find_openings
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.scan import Scan

_LEAST_NOISE_PX = 0.1  # pattern pixels: no decoding is better


@dataclass(frozen=True)
class Completeness:
    """What the surface has and lacks; lengths in the scan's unit."""

    observed: float  # share of what the frames decoded that the surface has
    surface_area: float
    openings: Openings
    next_view: NextView | None  # None: another capture would add nothing

    @property
    def rim_area(self) -> float:
        """Area of the largest opening: where the scan as a whole ends, for instance below."""
        return float(self.openings.area[:1].sum())

    @property
    def hole_share(self) -> float:
        """Area of all openings but the largest, relative to the surface's."""
        return float(self.openings.area[1:].sum()) / self.surface_area

    def summary(self) -> dict[str, Any]:
        """The main figures, for JSON."""
        o, v = self.openings, self.next_view
        return {
            "observed": self.observed,
            "surface_area": self.surface_area,
            "openings": {"count": len(o), "area": float(o.area.sum()), "boundary_length": float(o.length.sum()),
                         "largest_area": self.rim_area, "largest_boundary_length": float(o.length[:1].sum())},
            "next_capture": None if v is None else {
                "transform_matrix": v.T_world_camera.tolist(),
                "projector_transform_matrix": v.T_world_projector.tolist(),
                "new_area": v.new_area, "unseen_area": v.unseen_area, "removed_share": v.removed,
                "degrees_from_nearest_frame": v.nearest_deg, "elevation_deg": v.elevation_deg,
            },
        }  # fmt: skip


def assess_completeness(
    surface: IndexedMesh, scan: Scan, poses: DevicePoses, agreement: CaptureAgreement
) -> Completeness:
    """What the surface has of what was decoded, where it ends, and what to capture next."""
    decoded = np.array([frame.pixels * frame.decoded_share for frame in agreement.frames])
    missing = float((decoded * [frame.hole_share for frame in agreement.frames]).sum())
    openings = find_openings(surface.mesh)
    noise = max(MAD_TO_SIGMA * float(np.nan_to_num(agreement.epipolar_px_median)), _LEAST_NOISE_PX)
    return Completeness(
        observed=1 - missing / decoded.sum() if decoded.sum() else float("nan"),
        surface_area=surface.area,
        openings=openings,
        next_view=next_view(surface, openings, scan, poses, noise),
    )

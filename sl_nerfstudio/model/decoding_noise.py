"""How well a scan's coordinates are decoded, measured once before the first step."""

import torch
from jaxtyping import Float
from torch import Tensor

from sl_nerfstudio.dataparser.samples import PixelSamples
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.rendering.direct_losses import DecodingNoise
from sl_nerfstudio.scan import Scan

_PER_FRAME = 2000  # pixels
_LEAST_PX = 0.02  # smallest plausible noise, pattern pixels


@torch.no_grad()
def measure_decoding(
    scan: Scan,
    samples: PixelSamples,
    T_scene_camera: Float[Tensor, "n 4 4"],
    T_scene_projector: Float[Tensor, "n 4 4"],
) -> DecodingNoise:
    """Robust 1 sigma of the epipolar residual, and the median slope of coordinates along camera rays."""
    residuals, slopes = [], []
    projector = Intrinsics.of(scan.projector, torch.float64)
    for number, frame in enumerate(scan.frames):
        first, last = int(samples.first[number]), int(samples.first[number + 1])
        if last == first:
            continue
        pixels = samples.at(first + torch.from_numpy(evenly_spaced(last - first, min(_PER_FRAME, last - first))))
        ok = pixels.decoded
        camera = Intrinsics.of(frame.camera, torch.float64)
        arguments = (
            camera,
            T_scene_camera[number],
            pixels.uv[ok].double(),
            projector,
            T_scene_projector[number],
            pixels.coords[ok].double(),
        )
        residuals.append(epipolar_residual(*arguments).abs())
        slopes.append(1 / triangulate(*arguments).sigma_depth)
    residual, slope = torch.cat(residuals), torch.cat(slopes)
    finite = residual.isfinite() & slope.isfinite()
    sigma = float(residual[finite].median()) * MAD_TO_SIGMA
    return DecodingNoise(max(sigma, _LEAST_PX), float(slope[finite].median()))

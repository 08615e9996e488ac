"""What a mesh and the poses predict at the pixels of a frame, next to what was decoded and captured there.

Rays are cast from the camera onto the mesh, and the points that they hit are projected into the pattern.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.geometry.se3 import inverse, transform
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Frame, Scan

_SIGMAS = 4.0  # within which predicted and decoded coordinates agree; chance alone exceeds it once in 3000 pixels
_FOOTPRINT = 0.25  # camera pixels: error that no calibration is assumed to be free of, 1 sigma, as between frames
MAX_PIXELS = 250_000  # of a frame; larger frames are evaluated on a regular grid of their pixels
_ALL_PIXELS = 30_000_000  # of all frames: bounds memory and time where there are many


@dataclass(frozen=True)
class FramePixels:
    """The evaluated pixels of one frame; NaN where a value does not exist."""

    row: Int[ndarray, "n"]
    column: Int[ndarray, "n"]
    stride: int  # every stride-th row and column was evaluated
    hit: Bool[ndarray, "n"]  # the camera ray hits the mesh
    lit: Bool[ndarray, "n"]  # ... at a point that the projector lights, inside the pattern
    decoded: Bool[ndarray, "n"]
    coords: Float[ndarray, "n 2"]  # as decoded, pattern pixels
    offset: Float[ndarray, "n 2"]  # predicted minus decoded coordinates, pattern pixels
    epipolar: Float[ndarray, "n"]  # signed distance from the epipolar curve, pattern pixels
    captured: Float[ndarray, "n"]  # locally normalised captured pattern
    rendered: Float[ndarray, "n"]  # pattern looked up at the predicted coordinates, where lit
    depth_per_px: Float[ndarray, "n"]  # how far a point moves along the camera ray for one pattern pixel
    ray_angle_deg: Float[ndarray, "n"]  # between camera ray and projector ray at the hit
    behind: Float[ndarray, "n"]  # how far the hit lies behind the point triangulated from the decoded coordinate
    noise_px: float  # robust 1 sigma of the epipolar residual, pattern pixels; not below what look-ups resolve
    footprint_px: float  # pattern pixels under one camera pixel, median

    @property
    def tolerance_px(self) -> float:
        """Distance of predicted from decoded coordinates up to which they agree, pattern pixels."""
        return _SIGMAS * self.noise_px

    @property
    def coordinate(self) -> Float[ndarray, "n"]:
        """Distance of predicted from decoded coordinates, pattern pixels."""
        return np.linalg.norm(self.offset, axis=1)


def most_pixels(frames: int) -> int:
    """Pixels of each of so many frames that are evaluated at most."""
    return min(MAX_PIXELS, max(_ALL_PIXELS // frames, 1))


def frame_pixels(
    surface: IndexedMesh,
    frame: Frame,
    scan: Scan,
    pattern: Float[ndarray, "ph pw"],
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
    max_pixels: int = MAX_PIXELS,
) -> FramePixels:
    """Everything that the figures and pictures of one frame need; reads the files of the frame."""
    mask, coords, captured = frame.read_mask(), frame.read_coords(), frame.read_pattern()
    stride = max(1, int(np.ceil(np.sqrt(mask.sum() / max_pixels))))
    row, column = np.nonzero(mask[::stride, ::stride])
    row, column = row * stride, column * stride
    camera, projector = Intrinsics.of(frame.camera, torch.float64), Intrinsics.of(scan.projector, torch.float64)
    T_c, T_p = torch.as_tensor(T_world_camera), torch.as_tensor(T_world_projector)
    uv = torch.as_tensor(np.stack([column, row], 1) + 0.5)
    decoded_uv = torch.as_tensor(coords[row, column].astype(np.float64))

    origin, direction = (x.numpy() for x in pixel_rays(camera, T_c, uv))
    hits = surface.cast(origin, direction)
    p_world = origin + hits.distance[:, None] * direction
    predicted, reached = _predict(p_world, hits.hit, surface, scan.projector, projector, T_p)
    predicted[~hits.hit] = np.nan
    rendered = np.where(reached, look_up(pattern, predicted), np.nan)
    measured = triangulate(camera, T_c, uv, projector, T_p, torch.nan_to_num(decoded_uv)).depth_camera.numpy()

    epipolar = epipolar_residual(camera, T_c, uv, projector, T_p, decoded_uv).numpy()
    meeting = triangulate(camera, T_c, uv, projector, T_p, torch.as_tensor(np.nan_to_num(predicted)))
    to_projector = T_world_projector[:3, 3] - p_world
    cosine = -(to_projector * direction).sum(1) / np.linalg.norm(to_projector, axis=1)
    footprint = _footprint(coords)
    return FramePixels(
        row=row,
        column=column,
        stride=stride,
        hit=hits.hit,
        lit=reached,
        decoded=np.isfinite(coords[row, column]).all(1),
        coords=decoded_uv.numpy(),
        offset=predicted - decoded_uv.numpy(),
        epipolar=epipolar,
        captured=captured[row, column].astype(np.float64),
        rendered=rendered,
        depth_per_px=np.where(reached, meeting.sigma_depth.numpy(), np.nan),
        ray_angle_deg=np.degrees(np.arccos(np.clip(cosine, -1, 1))),
        behind=np.where(np.isfinite(decoded_uv).all(1), hits.distance - measured, np.nan),
        noise_px=float(np.nan_to_num(max(MAD_TO_SIGMA * _known_median(np.abs(epipolar)), _FOOTPRINT * footprint))),
        footprint_px=footprint,
    )


def _predict(
    p_world: Float[ndarray, "n 3"],
    hit: Bool[ndarray, "n"],
    surface: IndexedMesh,
    device: Device,
    projector: Intrinsics,
    T_world_projector: torch.Tensor,
) -> tuple[Float[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Pattern coordinates of surface points, and whether the projector really lights them."""
    p_device = transform(inverse(T_world_projector), torch.as_tensor(np.nan_to_num(p_world)))
    uv, in_front = project(projector, p_device)
    uv = uv.numpy()
    x, y = uv.T
    reached = hit & in_front.numpy() & (x >= 0) & (x < device.w) & (y >= 0) & (y < device.h)
    candidates = np.flatnonzero(reached)
    reached[candidates] = ~surface.occluded(p_world[candidates], T_world_projector[:3, 3].numpy())
    return np.where(in_front.numpy()[:, None], uv, np.nan), reached


def _footprint(coords: Float[ndarray, "h w 2"]) -> float:
    """Pattern pixels between the coordinates of neighbouring camera pixels; NaN where there are none."""
    step = np.linalg.norm(np.diff(coords, axis=1), axis=2)
    return _known_median(step.ravel())


def look_up(image: Float[ndarray, "h w"], uv: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
    """Bilinear value of an image at pixels `uv` (centre of the first pixel: 0.5); NaN for NaN."""
    out = np.full(len(uv), np.nan)
    known = np.isfinite(uv).all(1)
    x, y = uv[known].T - 0.5
    out[known] = map_coordinates(image.astype(np.float64), [y, x], order=1, mode="nearest")
    return out


def _known_median(values: Float[ndarray, "n"]) -> float:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")

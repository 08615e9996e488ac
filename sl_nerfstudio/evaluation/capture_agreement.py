"""How well a mesh and the poses agree with the captures, frame by frame; the truth is not needed.

Rays are cast from each camera onto the mesh, and the points that they hit are projected into the pattern. This
prediction is compared with the decoded coordinates and, looked up in the pattern, with the captured pattern image.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import map_coordinates

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.geometry.rays import pixel_rays
from sl_nerfstudio.geometry.se3 import inverse, transform
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Frame, Scan

MAX_PIXELS = 250_000  # of a frame; larger frames are evaluated on a regular grid of their pixels


@dataclass(frozen=True)
class FramePixels:
    """The evaluated pixels of one frame; NaN where a value does not exist."""

    row: Int[ndarray, "n"]
    column: Int[ndarray, "n"]
    stride: int  # every stride-th row and column was evaluated
    hit: Bool[ndarray, "n"]  # the camera ray hits the mesh
    lit: Bool[ndarray, "n"]  # ... at a point that the projector lights, inside the pattern
    decoded: Bool[ndarray, "n"]
    offset: Float[ndarray, "n 2"]  # predicted minus decoded coordinates, pattern pixels
    epipolar: Float[ndarray, "n"]  # signed distance from the epipolar curve, pattern pixels
    captured: Float[ndarray, "n"]  # locally normalised captured pattern
    rendered: Float[ndarray, "n"]  # pattern looked up at the predicted coordinates, where lit
    depth_per_px: Float[ndarray, "n"]  # how far a point moves along the camera ray for one pattern pixel
    ray_angle_deg: Float[ndarray, "n"]  # between camera ray and projector ray at the hit

    @property
    def coordinate(self) -> Float[ndarray, "n"]:
        """Distance of predicted from decoded coordinates, pattern pixels."""
        return np.linalg.norm(self.offset, axis=1)


@dataclass(frozen=True)
class FrameAgreement:
    """Figures of one frame; NaN where no pixel has one."""

    name: str
    pixels: int  # inside the mask, all of them
    hit_share: float  # of the masked pixels
    lit_share: float
    decoded_share: float
    coordinate_px_median: float
    coordinate_px_p95: float
    epipolar_px_median: float
    pattern_cosine: float
    depth_per_px: float
    ray_angle_deg: float


@dataclass(frozen=True)
class CaptureAgreement:
    """Figures of the whole scan."""

    coordinate_px_median: float
    coordinate_px_p95: float
    epipolar_px_median: float
    pattern_cosine: float
    hit_share: float
    depth_per_px: float
    ray_angle_deg: float
    frames: tuple[FrameAgreement, ...]


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

    epipolar = epipolar_residual(camera, T_c, uv, projector, T_p, decoded_uv).numpy()
    meeting = triangulate(camera, T_c, uv, projector, T_p, torch.as_tensor(np.nan_to_num(predicted)))
    to_projector = T_world_projector[:3, 3] - p_world
    cosine = -(to_projector * direction).sum(1) / np.linalg.norm(to_projector, axis=1)
    return FramePixels(
        row=row,
        column=column,
        stride=stride,
        hit=hits.hit,
        lit=reached,
        decoded=np.isfinite(coords[row, column]).all(1),
        offset=predicted - decoded_uv.numpy(),
        epipolar=epipolar,
        captured=captured[row, column].astype(np.float64),
        rendered=rendered,
        depth_per_px=np.where(reached, meeting.sigma_depth.numpy(), np.nan),
        ray_angle_deg=np.degrees(np.arccos(np.clip(cosine, -1, 1))),
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


def look_up(image: Float[ndarray, "h w"], uv: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
    """Bilinear value of an image at pixels `uv` (centre of the first pixel: 0.5); NaN for NaN."""
    out = np.full(len(uv), np.nan)
    known = np.isfinite(uv).all(1)
    x, y = uv[known].T - 0.5
    out[known] = map_coordinates(image.astype(np.float64), [y, x], order=1, mode="nearest")
    return out


def frame_agreement(name: str, masked: int, pixels: FramePixels) -> FrameAgreement:
    """Summary of one frame's pixels."""
    both = pixels.lit & np.isfinite(pixels.rendered)
    return FrameAgreement(
        name=name,
        pixels=masked,
        hit_share=_mean(pixels.hit),
        lit_share=_mean(pixels.lit),
        decoded_share=_mean(pixels.decoded),
        coordinate_px_median=_median(pixels.coordinate),
        coordinate_px_p95=_percentile(pixels.coordinate, 95.0),
        epipolar_px_median=_median(np.abs(pixels.epipolar)),
        pattern_cosine=_cosine(pixels.captured[both], pixels.rendered[both]),
        depth_per_px=_median(pixels.depth_per_px),
        ray_angle_deg=_median(pixels.ray_angle_deg),
    )


class AgreementAccumulator:
    """Collects frames one by one; keeps the residuals (float32), not the images."""

    def __init__(self) -> None:
        self._frames: list[FrameAgreement] = []
        self._coordinate: list[ndarray] = []
        self._epipolar: list[ndarray] = []
        self._depth: list[ndarray] = []
        self._products = np.zeros(3)

    def add(self, figures: FrameAgreement, pixels: FramePixels) -> None:
        """Add one more frame."""
        self._frames.append(figures)
        self._coordinate.append(_known(pixels.coordinate))
        self._epipolar.append(_known(np.abs(pixels.epipolar)))
        self._depth.append(_known(pixels.depth_per_px))
        both = pixels.lit & np.isfinite(pixels.rendered)
        a, b = pixels.captured[both], pixels.rendered[both]
        self._products += (float(a @ b), float(a @ a), float(b @ b))

    def result(self) -> CaptureAgreement:
        """Figures over all pixels of all frames added."""
        coordinate = np.concatenate(self._coordinate)
        ab, aa, bb = self._products
        weight = np.array([f.pixels for f in self._frames], np.float64)
        return CaptureAgreement(
            coordinate_px_median=_median(coordinate),
            coordinate_px_p95=_percentile(coordinate, 95.0),
            epipolar_px_median=_median(np.concatenate(self._epipolar)),
            pattern_cosine=float(ab / np.sqrt(aa * bb)) if aa * bb > 0 else float("nan"),
            hit_share=float(np.average([f.hit_share for f in self._frames], weights=weight)) if weight.sum() else 0.0,
            depth_per_px=_median(np.concatenate(self._depth)),
            ray_angle_deg=_median(np.array([f.ray_angle_deg for f in self._frames])),
            frames=tuple(self._frames),
        )


def compare_captures(
    surface: IndexedMesh,
    scan: Scan,
    poses: DevicePoses,
) -> Iterator[tuple[Frame, FrameAgreement, FramePixels]]:
    """Figures and pixels of every frame in turn; one frame is in memory at a time."""
    pattern = scan.read_pattern()
    for frame, T_c, T_p in zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True):
        pixels = frame_pixels(surface, frame, scan, pattern, T_c, T_p)
        yield frame, frame_agreement(frame.name, len(pixels.row) * pixels.stride**2, pixels), pixels


def _known(values: Float[ndarray, "n"]) -> Float[ndarray, "m"]:
    return values[np.isfinite(values)].astype(np.float32)


def _median(values: Float[ndarray, "n"]) -> float:
    return _percentile(values, 50.0)


def _percentile(values: Float[ndarray, "n"], percent: float) -> float:
    known = values[np.isfinite(values)]
    return float(np.percentile(known, percent)) if len(known) else float("nan")


def _mean(flags: Bool[ndarray, "n"]) -> float:
    return float(flags.mean()) if len(flags) else 0.0


def _cosine(a: Float[ndarray, "n"], b: Float[ndarray, "n"]) -> float:
    product = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / product if product > 0 else float("nan")

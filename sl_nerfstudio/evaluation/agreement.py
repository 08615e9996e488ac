"""How well a mesh and the poses agree with the captures, frame by frame; the truth is not needed.

What `frame_pixels` predicts is compared with the decoded coordinates and, looked up in the pattern, with the captured
pattern image.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.ndimage import binary_opening, label, map_coordinates

from sl_nerfstudio.console import track
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.lie import DevicePoses, inverse, transform
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, all_finite
from sl_nerfstudio.geometry.triangulation import epipolar_residual, pixel_rays, triangulate
from sl_nerfstudio.parallel import results, threads
from sl_nerfstudio.scan import Frame, Scan

# What a mesh and the poses predict at the pixels of a frame, next to what was decoded and captured there.
#
# Rays are cast from the camera onto the mesh, and the points that they hit are projected into the pattern.

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
    """Evaluate the pixels of a frame, whose files this reads, for figures and pictures."""
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
    p_projector = transform(inverse(T_p), torch.as_tensor(np.nan_to_num(p_world)))
    uv_projector, in_front = (x.numpy() for x in project(projector, p_projector))
    predicted = np.where((hits.hit & in_front)[:, None], uv_projector, np.nan)
    reached = ((predicted >= 0) & (predicted < (scan.projector.w, scan.projector.h))).all(1)
    candidates = np.flatnonzero(reached)
    reached[candidates] = ~surface.occluded(p_world[candidates], T_world_projector[:3, 3])
    rendered = np.where(reached, look_up(pattern, predicted), np.nan)
    measured = triangulate(camera, T_c, uv, projector, T_p, torch.nan_to_num(decoded_uv)).depth_camera.numpy()

    epipolar = epipolar_residual(camera, T_c, uv, projector, T_p, decoded_uv).numpy()
    meeting = triangulate(camera, T_c, uv, projector, T_p, torch.as_tensor(np.nan_to_num(predicted)))
    to_projector = T_world_projector[:3, 3] - p_world
    cosine = -(to_projector * direction).sum(1) / np.linalg.norm(to_projector, axis=1)
    footprint = _median(np.linalg.norm(np.diff(coords, axis=1), axis=2).ravel())
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
        noise_px=float(np.nan_to_num(max(MAD_TO_SIGMA * _median(np.abs(epipolar)), _FOOTPRINT * footprint))),
        footprint_px=footprint,
    )


def look_up(image: Float[ndarray, "h w"], uv: Float[ndarray, "n 2"]) -> Float[ndarray, "n"]:
    """Bilinear value of an image at pixels `uv` (centre of the first pixel: 0.5); NaN for NaN."""
    out = np.full(len(uv), np.nan)
    known = np.isfinite(uv).all(1)
    x, y = uv[known].T - 0.5
    out[known] = map_coordinates(image.astype(np.float64), [y, x], order=1, mode="nearest")
    return out


# Holes of a mesh: places that a frame decoded and whose rays meet no surface there.

_LEAST_DEPTH = 0.01  # of the mesh's size: how far behind the measured point a ray must pass where surface is missing
_LEAST_WIDTH = 0.02  # of the side of a square as large as the decoded area: narrower gaps are rims of the surface

_JUMP = 2.5  # usual steps between neighbouring pixels, beyond which coordinates jump
_LARGE_PATCH = 0.03  # of the decoded pixels: larger patches are no wrong decodings but surface that is missing


def find_holes(pixels: FramePixels, mesh_size: float) -> tuple[float, float]:
    """Decoded pixels whose ray misses the mesh, or passes far behind the triangulated point before it hits.

    As shares of all decoded ones: first all of them, then the largest connected area; gaps along rims do not count for
    that. `mesh_size` is the diagonal of the mesh's box, in its unit. Patches of coordinates that are not continuous
    with what surrounds them are wrong decodings, unless they are large.
    """
    trusted = pixels.decoded & (np.abs(pixels.epipolar) < _SIGMAS * pixels.noise_px)
    count = int(trusted.sum())
    if count == 0:
        return 0.0, 0.0
    through = (pixels.behind > _LEAST_DEPTH * mesh_size) & (pixels.coordinate > pixels.tolerance_px)
    missing = _as_image(pixels, trusted & (~pixels.hit | through), False)
    missing &= ~_wrong_patches(pixels, missing, count)
    return float(missing.sum() / count), _largest_area(missing, count) / count


def _as_image(pixels: FramePixels, values: ndarray, nothing: float | bool) -> ndarray:
    """Values on the grid of evaluated pixels."""
    row, column = pixels.row // pixels.stride, pixels.column // pixels.stride
    image = np.full((row.max() + 1, column.max() + 1, *values.shape[1:]), nothing, values.dtype)
    image[row, column] = values
    return image


def _wrong_patches(pixels: FramePixels, missing: Bool[ndarray, "h w"], count: int) -> Bool[ndarray, "h w"]:
    """Small patches, bounded by jumps of the coordinates, that are missing for the most part."""
    coords = _as_image(pixels, pixels.coords, np.nan)
    limit = _JUMP * pixels.footprint_px * pixels.stride + _SIGMAS * np.sqrt(2) * pixels.noise_px
    inside = all_finite(coords)
    for axis in (0, 1):
        jump = np.linalg.norm(np.diff(coords, axis=axis), axis=-1) > limit
        inside &= ~np.insert(jump, jump.shape[axis], False, axis) & ~np.insert(jump, 0, False, axis)
    patch = _numbered(inside)
    size = np.bincount(patch.ravel())
    lost = np.bincount(patch[missing], minlength=len(size))
    wrong = (2 * lost > size) & (size < _LARGE_PATCH * count)
    wrong[0] = True  # at the jumps themselves
    return wrong[patch]


def _largest_area(missing: Bool[ndarray, "h w"], count: int) -> int:
    """Pixels of the largest connected area that is wide enough; `count` pixels were decoded."""
    width = 1 + 2 * max(1, round(_LEAST_WIDTH * np.sqrt(count) / 2))
    wide = binary_opening(missing, np.ones((width, width), bool))
    areas = np.bincount(_numbered(wide).ravel())[1:]
    return int(areas.max()) if len(areas) else 0


def _numbered(flags: Bool[ndarray, "h w"]) -> Int[ndarray, "h w"]:
    """The number of the connected area of each pixel, from 1; 0 elsewhere."""
    out = np.zeros(flags.shape, dtype=np.int32)
    label(flags, output=out)
    return out


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
    covered_share: float  # of the decoded pixels, those at which the mesh has a surface
    agreeing_share: float  # of those, the share that agrees within the noise
    hole_share: float  # of the decoded pixels, those whose ray passes the measured point without meeting a surface
    largest_hole: float  # the largest connected area of such pixels, as a share of the decoded ones


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


def frame_agreement(name: str, pixels: FramePixels, mesh_size: float) -> FrameAgreement:
    """Summary of one frame's pixels, and of what is missing there; `mesh_size` as for `find_holes`."""
    both, holes = pixels.lit & np.isfinite(pixels.rendered), find_holes(pixels, mesh_size)
    return FrameAgreement(
        name=name,
        pixels=len(pixels.row) * pixels.stride**2,
        hit_share=_mean(pixels.hit),
        lit_share=_mean(pixels.lit),
        decoded_share=_mean(pixels.decoded),
        coordinate_px_median=_median(pixels.coordinate),
        coordinate_px_p95=_percentile(pixels.coordinate, 95.0),
        epipolar_px_median=_median(np.abs(pixels.epipolar)),
        pattern_cosine=_cosine(pixels.captured[both], pixels.rendered[both]),
        depth_per_px=_median(pixels.depth_per_px),
        ray_angle_deg=_median(pixels.ray_angle_deg),
        covered_share=_mean(pixels.hit[pixels.decoded]),
        agreeing_share=_mean(pixels.coordinate[pixels.decoded & pixels.hit] < pixels.tolerance_px),
        hole_share=holes[0],
        largest_hole=holes[1],
    )


def compare_captures(
    surface: IndexedMesh,
    scan: Scan,
    poses: DevicePoses,
    on_frame: Callable[[Frame, FrameAgreement, FramePixels], None] | None = None,
) -> CaptureAgreement:
    """Figures of all frames; `on_frame` is called with each of them and its pixels in turn (to make pictures).

    As many frames are in memory at a time as there are threads; their residuals are kept, in float32.
    """
    pattern, most = scan.read_pattern(), most_pixels(len(scan.frames))

    def compare(frame: Frame, *poses: Float[ndarray, "4 4"]) -> tuple[Frame, FrameAgreement, FramePixels]:
        pixels = frame_pixels(surface, frame, scan, pattern, *poses, max_pixels=most)
        return frame, frame_agreement(frame.name, pixels, surface.diagonal), pixels

    every = zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True)
    tasks = [partial(compare, *one) for one in every]
    batches = (results(tasks[first : first + threads()]) for first in range(0, len(tasks), threads()))
    frames: list[FrameAgreement] = []
    coordinate, epipolar, depth, products = [], [], [], np.zeros(3)
    found = (one for batch in batches for one in batch)
    for frame, figures, pixels in track(found, "ray casting the frames", total=len(scan.frames)):
        frames.append(figures)
        coordinate.append(_known(pixels.coordinate))
        epipolar.append(_known(np.abs(pixels.epipolar)))
        depth.append(_known(pixels.depth_per_px))
        both = pixels.lit & np.isfinite(pixels.rendered)
        a, b = pixels.captured[both], pixels.rendered[both]
        products += (float(a @ b), float(a @ a), float(b @ b))
        if on_frame is not None:
            on_frame(frame, figures, pixels)
    ab, aa, bb = products
    weight = np.array([f.pixels for f in frames], np.float64)
    return CaptureAgreement(
        coordinate_px_median=_median(np.concatenate(coordinate)),
        coordinate_px_p95=_percentile(np.concatenate(coordinate), 95.0),
        epipolar_px_median=_median(np.concatenate(epipolar)),
        pattern_cosine=float(ab / np.sqrt(aa * bb)) if aa * bb > 0 else float("nan"),
        hit_share=float(np.average([f.hit_share for f in frames], weights=weight)) if weight.sum() else 0.0,
        depth_per_px=_median(np.concatenate(depth)),
        ray_angle_deg=_median(np.array([f.ray_angle_deg for f in frames])),
        frames=tuple(frames),
    )


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

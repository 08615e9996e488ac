"""For every vertex of a mesh, how many frames see it, and how many of them confirm or contradict it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from scipy.ndimage import binary_dilation

from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing.lit_vertices import Occluder, lit_vertices, packed_device
from sl_nerfstudio.meshing.loops.decoded_offset import compare_decoded
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.types import Frame, Scan

LEAST_PX, MOST_PX, MEDIANS = 2.0, 16.0, 6.0
"""A prediction agrees with a decoded coordinate within MEDIANS times the frame's median residual, kept between
LEAST_PX (decoding noise is smaller) and MOST_PX (with larger errors, the poses are too wrong to confirm anything)."""

OFF_MASK_PX = 3
"""A vertex that should be lit but projects farther than this outside the mask, in camera pixels, is not on the object.
If it is closer, the poses or the border of the mask may be slightly wrong, and the contradiction counts half."""

ENOUGH = 3  # a vertex with this many more confirmations than contradictions is not checked in further frames


@dataclass(frozen=True)
class FrameCounts:
    """Number of frames that should see and light each vertex, by what was decoded there."""

    confirmed: Int64[ndarray, "v"]  # the decoded coordinate is the one that the vertex predicts
    inconclusive: Int64[ndarray, "v"]  # in the mask, but what was decoded nearby, if anything, proves nothing
    contradicted: Int64[ndarray, "v"]  # another coordinate was decoded, or the vertex is outside the mask
    near_mask: Int64[ndarray, "v"]  # the vertex is outside the mask, but within OFF_MASK_PX of it
    residual_px: Float[ndarray, "n"]  # median of each frame; NaN where nothing was decoded on the mesh

    @property
    def against(self) -> Float[ndarray, "v"]:
        """Weighted number of contradictions of each vertex; frames that see it just outside the mask count half.

        A frame that looks along a surface cannot show where the surface ends. At the lower edge of a plate it confirms
        what is a pixel below, which is a millimetre there, while frames that face the plate see the vertex just outside
        the mask.
        """
        return self.contradicted + 0.5 * self.near_mask

    @property
    def decided(self) -> Bool[ndarray, "v"]:
        """Vertices that need not be checked in further frames."""
        return self.confirmed - self.against >= ENOUGH


def count_frames(
    mesh: Mesh, occluder: Occluder, scan: Scan, poses: DevicePoses, before: FrameCounts | None = None
) -> FrameCounts:
    """Check every undecided vertex in every frame; one frame's mask and coordinates are in memory at a time.

    `before` are the counts with more occluders: vertices decided there stay as they are, the others are counted again.
    """
    counts = _begin(mesh, before)
    normals = mesh.vertex_normals()
    medians: list[float] = []
    # A frame's median must not come from doubtful vertices alone: some are checked in all frames.
    always = np.arange(len(mesh.vertices)) % 8 == 0
    was_undecided = ~counts.decided
    frames = list(zip(scan.frames, poses.T_world_camera, poses.T_world_projector, strict=True))
    for frame, T_camera, T_projector in track(frames, "trimming to what was observed"):
        checked = np.flatnonzero(always | ~counts.decided)
        view = visible_vertices(mesh.vertices, normals, checked, occluder, frame, scan.projector, T_camera, T_projector)
        vertex = view.vertex
        known = view.most[always[vertex] & np.isfinite(view.most)]
        medians.append(float(np.median(known)) if len(known) else float("nan"))
        threshold = np.clip(MEDIANS * medians[-1], LEAST_PX, MOST_PX)
        agrees, differs = view.most <= threshold, (view.least > threshold) | view.off_mask
        new = was_undecided[vertex]
        counts.confirmed[vertex] += new & agrees
        counts.contradicted[vertex] += new & differs
        counts.near_mask[vertex] += new & view.near_mask
        counts.inconclusive[vertex] += new & ~agrees & ~differs & ~view.near_mask
    return replace(counts, residual_px=np.array(medians))


def _begin(mesh: Mesh, before: FrameCounts | None) -> FrameCounts:
    """Zero for every vertex, except for those that are decided."""
    if before is None:
        counts = np.zeros((4, len(mesh.vertices)), dtype=np.int64)
    else:
        earlier = np.stack([before.confirmed, before.inconclusive, before.contradicted, before.near_mask])
        counts = np.where(before.decided, earlier, 0)
    return FrameCounts(*counts, residual_px=np.zeros(0))


@dataclass(frozen=True)
class VisibleVertices:
    """The vertices that one frame should see and light, compared with what it decoded; distances in pattern pixels."""

    vertex: Int64[ndarray, "m"]
    off_mask: Bool[ndarray, "m"]  # farther than OFF_MASK_PX outside the mask
    near_mask: Bool[ndarray, "m"]  # outside the mask, but within OFF_MASK_PX of it
    least: Float[ndarray, "m"]  # lower bound of the distance between decoded and predicted coordinate; NaN if unknown
    most: Float[ndarray, "m"]  # upper bound


def visible_vertices(
    vertices: Float[ndarray, "v 3"],
    normals: Float[ndarray, "v 3"],
    chosen: Int64[ndarray, "c"],
    occluder: Occluder,
    frame: Frame,
    projector: Device,
    T_world_camera: Float[ndarray, "4 4"],
    T_world_projector: Float[ndarray, "4 4"],
) -> VisibleVertices:
    """Chosen vertices that a frame should see and light (see `lit_vertices`), compared with what it decoded."""
    views = ((frame.camera, T_world_camera), (projector, T_world_projector))
    lit = lit_vertices(vertices, normals, chosen, occluder, frame.camera, projector, T_world_camera, T_world_projector)
    mask, coords, count = frame.read_mask(), frame.read_coords(), len(lit.vertex)
    offsets, outside = np.full((count, 2), np.nan), np.empty((count, 2), np.bool_)
    packed = np.stack([packed_device(device, T) for device, T in views])
    images = coords, mask, _grown(mask, OFF_MASK_PX)
    compare_decoded(count, vertices, normals, lit.vertex, lit.uv, *images, packed, MOST_PX, offsets, outside)
    off, out = outside.T
    return VisibleVertices(lit.vertex, off, out & ~off, *offsets.T)


def _grown(mask: Bool[ndarray, "h w"], pixels: int) -> Bool[ndarray, "h w"]:
    return np.asarray(binary_dilation(mask, np.ones((3, 3), dtype=bool), iterations=pixels))

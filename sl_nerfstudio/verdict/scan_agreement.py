"""Cross-frame agreement of a scan, from its devices, poses and coordinate images in any world and unit."""

from collections.abc import Iterable, Sequence

import numpy as np
import torch
from jaxtyping import Float, Float32
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.similarity import Similarity, centred_on
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan.types import Frame, PoseSigma, Scan
from sl_nerfstudio.verdict.cross_frame import CrossFrameAgreement, cross_frame_agreement
from sl_nerfstudio.verdict.settings import CrossFrameSettings

_POINTS_PER_FRAME = 500
_EDGE = 2.0  # per cent of the points on each side that may lie outside the object's box: wrong decodings


def compare_scan_frames(
    scan: Scan, poses: DevicePoses, sigma: Sequence[PoseSigma | None], settings: CrossFrameSettings | None = None
) -> CrossFrameAgreement:
    """The same as `compare_frames`, with the coordinates read from the scan's files, where the masks allow them."""
    images = (_masked_coords(frame) for frame in scan.frames)
    return compare_frames([f.camera for f in scan.frames], scan.projector, poses, images, sigma, settings)


def _masked_coords(frame: Frame) -> Float32[ndarray, "h w 2"]:
    coords = frame.read_coords()
    coords[~frame.read_mask()] = np.nan
    return coords


def compare_frames(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    coords: Iterable[Float32[ndarray, "_h _w 2"]],
    sigma: Sequence[PoseSigma | None],
    settings: CrossFrameSettings | None = None,
) -> CrossFrameAgreement:
    """Cross-frame agreement with the given poses; `sigma` in the poses' unit, None where poses count as exact."""
    maps = CoordinateMaps.of(torch.from_numpy(image) for image in coords)
    S_scene_world = _scene(cameras, projector, poses, maps)
    rig = Rig.of(cameras, projector, poses, S_scene_world)
    rows = [_four(s, S_scene_world.scale) for s in sigma]
    stated = torch.tensor(rows, dtype=torch.float64).repeat_interleave(3, 1)
    return cross_frame_agreement(rig, maps, stated, settings)


def _four(s: PoseSigma | None, scale: float) -> tuple[float, float, float, float]:
    """Translation and rotation of the frame, then of its projector against its camera; scene's unit and radian."""
    if s is None:
        return 0.0, 0.0, 0.0, 0.0
    turns = np.radians([s.camera_rotation_deg, s.relative_rotation_deg]).tolist()
    return s.camera_translation * scale, turns[0], s.relative_translation * scale, turns[1]


def _scene(
    cameras: Sequence[Device],
    projector: Device,
    poses: DevicePoses,
    maps: CoordinateMaps,
) -> Similarity:
    """World to scene: the centre of the decoded surface becomes the origin, its radius one."""
    parts = [np.zeros((0, 3))]
    for k, (camera, T_c, T_p) in enumerate(zip(cameras, poses.T_world_camera, poses.T_world_projector, strict=True)):
        image = maps.image(k).numpy()
        decoded = np.flatnonzero(np.isfinite(image).all(-1))
        some = decoded[evenly_spaced(len(decoded), min(_POINTS_PER_FRAME, len(decoded)))]
        row, column = np.divmod(some, image.shape[1])
        found = triangulate(
            Intrinsics.of(camera, torch.float64),
            torch.from_numpy(T_c),
            torch.from_numpy(np.stack([column, row], -1) + 0.5),
            Intrinsics.of(projector, torch.float64),
            torch.from_numpy(T_p),
            torch.from_numpy(image[row, column].astype(np.float64)),
        )
        good = found.p_world.isfinite().all(-1) & (found.depth_camera > 0) & (found.depth_projector > 0)
        parts.append(found.p_world[good].numpy())
    points: Float[ndarray, "n 3"] = np.concatenate(parts)
    if len(points) < 2:
        return Similarity.identity()
    return centred_on(points, _EDGE)

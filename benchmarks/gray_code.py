"""A scan made by `sl-process` from real Gray-code photographs, compared with another decoding of the same photographs.

    python -m benchmarks.gray_code --scan SCAN --reference REFERENCE

Both are scan folders with the same frames in the same order. The reference may be undistorted and of a different size.
Every decoded pixel of the reference is looked up in the scan. Coordinates are compared without lens distortion; points
are triangulated with the poses of their own scan and compared after one common similarity.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float64
from numpy import ndarray

from benchmarks.common.measuring import options
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.geometry.lie import angle_deg, fit_similarity
from sl_nerfstudio.geometry.triangulation import pixel_centres, triangulate
from sl_nerfstudio.scan import Frame, Scan, read_scan


@dataclass(frozen=True)
class Pairs:
    """Pixels that both scans decoded."""

    share: float  # of the reference's decoded pixels that the scan decoded as well
    difference: Float64[ndarray, "n 2"]  # scan minus reference, in projector pixels without distortion
    p_scan: Float64[ndarray, "n 3"]
    p_reference: Float64[ndarray, "n 3"]


def main() -> None:
    """Print the figures."""
    arguments = options(__doc__, scan=Path, reference=Path)
    scan, reference = read_scan(arguments.scan), read_scan(arguments.reference)
    pairs = [compare(scan, f, reference, r) for f, r in zip(scan.frames, reference.frames, strict=True)]
    for frame, pair in zip(scan.frames, pairs, strict=True):
        error = np.linalg.norm(pair.difference, axis=1)
        percent = ", ".join(f"{np.percentile(error, q):.3f}" for q in (50, 75, 90, 95, 99))
        bias = np.median(pair.difference, 0)
        print(f"{frame.name}: {pair.share:.2%} of the reference's pixels decoded")
        print(f"  difference px, 50 75 90 95 99 %: {percent}; median in x, y: {bias[0]:+.4f}, {bias[1]:+.4f}")
    for k in range(len(pairs)):
        turn, swing = _angles(scan.poses.T_camera_projector[k], reference.poses.T_camera_projector[k])
        print(f"{scan.frames[k].name}: relative pose: rotation {turn:.3f} deg, direction {swing:.3f} deg off")
    first = np.linalg.inv(scan.poses.T_world_camera[0]) @ scan.poses.T_world_camera
    first_reference = np.linalg.inv(reference.poses.T_world_camera[0]) @ reference.poses.T_world_camera
    for k in range(1, len(pairs)):
        turn, swing = _angles(first[k], first_reference[k])
        print(f"camera {k} against camera 0: rotation {turn:.3f} deg, direction {swing:.3f} deg off")
    ours, theirs = (np.concatenate([getattr(p, key) for p in pairs]) for key in ("p_scan", "p_reference"))
    good = np.isfinite(ours).all(1) & np.isfinite(theirs).all(1)
    S = fit_similarity(ours[good], theirs[good])
    distance = np.linalg.norm(S.points(ours[good]) - theirs[good], axis=1)
    low, high = np.percentile(theirs[good], [1, 99], axis=0)
    size = float(np.linalg.norm(high - low))
    print(f"points after a similarity, of the scene's size: median {np.median(distance) / size:.4%}, "
          f"95 % {np.percentile(distance, 95) / size:.4%}, RMS {np.sqrt((distance**2).mean()) / size:.4%}")  # fmt: skip


def compare(scan: Scan, frame: Frame, reference: Scan, wanted: Frame) -> Pairs:
    """Look up every decoded pixel of the reference frame in the scan's frame."""
    target = wanted.read_coords()
    known = np.isfinite(target).all(-1)
    uv_reference = pixel_centres(wanted.camera, torch.float64)[torch.from_numpy(known)]
    uv, _ = project(_of(frame.camera), unproject(_of(wanted.camera), uv_reference))
    coords, found = look_up(frame.read_coords().astype(np.float64), uv.numpy())
    ours = without_lens(coords[found], scan.projector)
    theirs = without_lens(target[known][found].astype(np.float64), reference.projector)
    return Pairs(
        share=float(found.mean()),
        difference=ours - theirs,
        p_scan=_points(scan, frame, uv[torch.from_numpy(found)], coords[found]),
        p_reference=_points(reference, wanted, uv_reference[torch.from_numpy(found)], target[known][found]),
    )


def look_up(
    image: Float64[ndarray, "h w 2"], uv: Float64[ndarray, "n 2"]
) -> tuple[Float64[ndarray, "n 2"], Bool[ndarray, "n"]]:
    """Bilinear value from those of the four surrounding pixels that are known; known where the nearest pixel is."""
    h, w = image.shape[:2]
    place = uv - 0.5
    corner = np.floor(place).astype(np.int64)
    total, weight = np.zeros((len(uv), 2)), np.zeros(len(uv))
    for dy in (0, 1):
        for dx in (0, 1):
            column, row = corner[:, 0] + dx, corner[:, 1] + dy
            inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
            value = image[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
            fraction = place - corner
            share = np.abs(1 - dx - fraction[:, 0]) * np.abs(1 - dy - fraction[:, 1])
            good = inside & np.isfinite(value).all(1)
            total += np.where(good[:, None], share[:, None] * np.nan_to_num(value), 0)
            weight += np.where(good, share, 0)
    column, row = np.floor(uv).astype(np.int64).T
    inside = (column >= 0) & (row >= 0) & (column < w) & (row < h)
    nearest = image[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]
    found = inside & np.isfinite(nearest).all(1)
    return total / np.maximum(weight, 1e-12)[:, None], found


def without_lens(uv: Float64[ndarray, "n 2"], device: Device) -> Float64[ndarray, "n 2"]:
    """The pixels that the same device would have without lens distortion."""
    ideal = replace(device, k1=0.0, k2=0.0, p1=0.0, p2=0.0)
    return project(_of(ideal), unproject(_of(device), torch.from_numpy(uv)))[0].numpy()


def _points(scan: Scan, frame: Frame, uv: torch.Tensor, coords: ndarray) -> Float64[ndarray, "n 3"]:
    meeting = triangulate(
        _of(frame.camera), torch.from_numpy(frame.T_world_camera), uv, _of(scan.projector),
        torch.from_numpy(frame.T_world_projector), torch.from_numpy(coords.astype(np.float64)),
    )  # fmt: skip
    return meeting.p_world.numpy()


def _of(device: Device) -> Intrinsics:
    return Intrinsics.of(device, torch.float64)


def _angles(a: Float64[ndarray, "4 4"], b: Float64[ndarray, "4 4"]) -> tuple[float, float]:
    """Angles in degrees between two rotations, and between two directions of translation."""
    t, s = a[:3, 3], b[:3, 3]
    swing = np.arctan2(np.linalg.norm(np.cross(t, s)), t @ s)
    return angle_deg(a[:3, :3].T @ b[:3, :3]), float(np.degrees(swing))


if __name__ == "__main__":
    main()

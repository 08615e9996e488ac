"""What a scan made of photographs is worth, against the truth.

A scan's gauge is free. It is aligned with the truth by the similarity that most frames agree with, so that a frame that
is far off does not tilt the others. What is compared is where a frame puts the points of the object, which depends on
both its poses and on its baseline, and how its devices are turned.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray

from benchmarks.photographs.sets import note_of
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.lie import Similarity, angle_deg, fit_similarity
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Frame, Scan, read_scan
from sl_nerfstudio.scan.images import read_image
from sl_nerfstudio.scan.types import PoseSigma

_POINTS = 400  # of the object in each frame, with which poses are judged


@dataclass(frozen=True)
class FoundFrame:
    """A frame where a scan, or registration alone, has it, in any axes and unit."""

    name: str  # of its image
    T_world_camera: Float64[ndarray, "4 4"]
    T_world_projector: Float64[ndarray, "4 4"]
    pose_sigma: PoseSigma | None


@dataclass(frozen=True)
class TrueFrame:
    """One frame as it should be."""

    frame: Frame
    projector: Device
    usable: bool
    object_mask: Bool[ndarray, "h w"]

    def object_coords(self) -> Float32[ndarray, "h w 2"]:
        """Exact coordinates of the object's lit pixels; NaN elsewhere."""
        coords = self.frame.read_coords().copy()
        coords[~self.object_mask] = np.nan
        return coords

    def some_points(self) -> tuple[Float[ndarray, "n 2"], Float[ndarray, "n 2"]]:
        """Pixels of the camera and of the projector that belong together, spread over the object."""
        coords = self.object_coords()
        row, column = np.nonzero(np.isfinite(coords[..., 0]))
        chosen = np.unique(np.linspace(0, max(len(row) - 1, 0), min(_POINTS, len(row))).astype(int))
        row, column = row[chosen], column[chosen]
        return np.stack([column, row], 1) + 0.5, coords[row, column].astype(np.float64)

    def triangulated(
        self, T_world_camera: Float[ndarray, "4 4"], T_world_projector: Float[ndarray, "4 4"]
    ) -> Float[ndarray, "n 3"]:
        """Where the object's points are if the devices have these poses."""
        uv_camera, uv_projector = self.some_points()
        points = triangulate(
            Intrinsics.of(self.frame.camera, torch.float64), torch.from_numpy(T_world_camera),
            torch.from_numpy(uv_camera), Intrinsics.of(self.projector, torch.float64),
            torch.from_numpy(T_world_projector), torch.from_numpy(uv_projector),
        )  # fmt: skip
        return points.p_world.numpy()


@dataclass(frozen=True)
class Truth:
    """All frames by the name of their image, and the longest side of the object."""

    frames: dict[str, TrueFrame]
    size: float

    @property
    def usable(self) -> list[str]:
        """Names of the frames that a scan should hold."""
        return [name for name, frame in self.frames.items() if frame.usable]


def read_truth(captures: Path) -> Truth:
    """The truth of a folder of captures."""
    root, numbers = captures / "ground_truth", note_of(captures)["frames"]
    scan: Scan = read_scan(root)
    recorded = json.loads((root / "captures.json").read_text())["frames"]
    frames = {}
    for name, number in numbers.items():
        frame = scan.frames[number]
        mask = read_image(root / "object_masks" / f"{frame.name}.png") > 0
        frames[name] = TrueFrame(frame, scan.projector, bool(recorded[number]["usable"]), mask)
    mesh: Any = trimesh.load(root / "mesh.ply", process=False)
    return Truth(frames, float(np.ptp(np.asarray(mesh.vertices), axis=0).max()))


WRONG_DEG, WRONG_SHIFT = 3.0, 0.06  # rotation of a device; displacement of the object as a share of its size
WRONG_PX = 2.0  # error of a decoded pixel
SLIP_PX = 10.0  # half a period: a pixel of another cell, not one that is merely inaccurate at an edge
_FEWEST_POINTS = 8  # of the object in a frame that can be judged


@dataclass(frozen=True)
class PoseError:
    """How far one frame of a scan is off."""

    name: str
    camera_deg: float
    projector_deg: float
    shift: float  # of the object, as a share of its size
    sigma_deg: float  # stated for the rotation of the frame as a whole, per axis; NaN if none is stated

    @property
    def right(self) -> bool:
        """Whether the frame is where it belongs."""
        return max(self.camera_deg, self.projector_deg) <= WRONG_DEG and self.shift <= WRONG_SHIFT

    @property
    def over_sigma(self) -> float:
        """Camera rotation error per axis over the stated sigma."""
        return self.camera_deg / np.sqrt(3) / self.sigma_deg


@dataclass(frozen=True)
class DecodingFigures:
    """Lit pixels of the object in the usable frames."""

    decoded: float  # share
    median_px: float
    wrong: float  # share of the decoded ones that are more than WRONG_PX off
    slipped: float  # that are more than SLIP_PX off


NOTHING_DECODED = DecodingFigures(0.0, float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class _Placed:
    """One frame of the scan beside its truth."""

    found: FoundFrame
    true: TrueFrame
    p_scan: Float[ndarray, "n 3"]
    p_true: Float[ndarray, "n 3"]


def pose_errors(found: Sequence[FoundFrame], truth: Truth) -> list[PoseError]:
    """Errors of the frames that show the object, after the alignment that most of them agree with."""
    placed = [_placed(frame, truth.frames[frame.name]) for frame in found]
    placed = [p for p in placed if len(p.p_true) >= _FEWEST_POINTS]
    if not placed:
        return []
    S_truth_scan = _consensus(placed, truth.size)
    return [_error(p, S_truth_scan, truth.size) for p in placed]


def group_sizes(found: Sequence[FoundFrame], truth: Truth) -> tuple[int, ...]:
    """Sizes of the groups into which frames fall whose cameras are turned rightly against each other, largest first."""
    turns = [truth.frames[f.name].frame.T_world_camera[:3, :3] @ f.T_world_camera[:3, :3].T for f in found]
    near = np.array([[angle_deg(b.T @ a) <= WRONG_DEG for b in turns] for a in turns]).reshape(len(turns), len(turns))
    left, sizes = np.ones(len(turns), dtype=bool), []
    while left.any():
        group = near[(near & left).sum(1).argmax()] & left
        sizes.append(int(group.sum()))
        left &= ~group
    return tuple(sizes)


def decoding_figures(work: Path, truth: Truth) -> DecodingFigures:
    """Figures of the maps that sl-process kept in its work folder; a frame that it did not decode has no pixels."""
    kept = json.loads((work / "manifest.json").read_text())["frames"]
    lit, errors = 0, [np.zeros(0)]
    for name in truth.usable:
        coords = truth.frames[name].object_coords()
        lit += int(np.isfinite(coords[..., 0]).sum())
        key = kept.get(name, {}).get("key")
        if key:
            with np.load(work / "decoded" / f"{name}-{key}.npz") as stored:
                error = np.linalg.norm(stored["coords"] - coords, axis=-1)
            errors.append(error[np.isfinite(error)])
    error = np.concatenate(errors)
    if len(error) == 0:
        return NOTHING_DECODED
    wrong, slipped = float((error > WRONG_PX).mean()), float((error > SLIP_PX).mean())
    return DecodingFigures(len(error) / lit, float(np.median(error)), wrong, slipped)


def _placed(found: FoundFrame, true: TrueFrame) -> _Placed:
    p_scan = true.triangulated(found.T_world_camera, found.T_world_projector)
    p_true = true.triangulated(true.frame.T_world_camera, true.frame.T_world_projector)
    known = np.isfinite(p_scan).all(1) & np.isfinite(p_true).all(1)
    return _Placed(found, true, p_scan[known], p_true[known])


def _consensus(placed: Sequence[_Placed], size: float) -> Similarity:
    """The similarity with which most frames are right, refined with these; each frame counts alike.

    Every frame alone and every pair of frames proposes one: a frame has thousands of points in space.
    """
    groups = [[p] for p in placed] + [[p, q] for k, p in enumerate(placed) for q in placed[k + 1 :]]
    best: tuple[int, float] = (-1, 0.0)
    chosen = Similarity.identity()
    for group in groups:
        S = _fitted(group)
        errors = [_error(p, S, size) for p in placed]
        right = [e.shift for e in errors if e.right]
        score = len(right), -float(np.median(right)) if right else 0.0
        if score > best:
            best, chosen = score, S
    for _ in range(3):
        right = [p for p in placed if _error(p, chosen, size).right]
        chosen = _fitted(right) if right else chosen
    return chosen


def _fitted(group: Sequence[_Placed]) -> Similarity:
    """Maps the scan's points onto the true ones."""
    weights = np.concatenate([np.full(len(p.p_true), 1 / len(p.p_true)) for p in group])
    scan, true = (np.concatenate(parts) for parts in zip(*[(p.p_scan, p.p_true) for p in group], strict=True))
    return fit_similarity(scan, true, weights=weights)


def _error(placed: _Placed, S_truth_scan: Similarity, size: float) -> PoseError:
    found, true = placed.found, placed.true.frame
    R = S_truth_scan.R
    camera = angle_deg(true.T_world_camera[:3, :3].T @ R @ found.T_world_camera[:3, :3])
    projector = angle_deg(true.T_world_projector[:3, :3].T @ R @ found.T_world_projector[:3, :3])
    shift = np.linalg.norm(S_truth_scan.points(placed.p_scan) - placed.p_true, axis=1)
    sigma = float("nan") if found.pose_sigma is None else found.pose_sigma.camera_rotation_deg
    return PoseError(found.name, camera, projector, float(np.median(shift)) / size, sigma)

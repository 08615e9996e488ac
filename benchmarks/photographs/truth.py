"""The truth of a set of captures: poses, coordinates, the object's pixels, and which frames are of use."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Float32
from numpy import ndarray

from benchmarks.photographs.sets import CaptureSet, frame_names
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.scan import Frame, Scan, read_scan
from sl_nerfstudio.scan.images import read_image

_POINTS = 400  # of the object in each frame, with which poses are judged


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
            Intrinsics.of(self.frame.camera, torch.float64),
            torch.from_numpy(T_world_camera),
            torch.from_numpy(uv_camera),
            Intrinsics.of(self.projector, torch.float64),
            torch.from_numpy(T_world_projector),
            torch.from_numpy(uv_projector),
        )
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


def read_truth(captures: Path, one: CaptureSet) -> Truth:
    """The truth that sl-synth wrote."""
    root = captures / "ground_truth"
    scan: Scan = read_scan(root)
    recorded = json.loads((root / "captures.json").read_text())["frames"]
    frames = {}
    for name, number in frame_names(one, len(scan.frames)).items():
        frame = scan.frames[number]
        mask = read_image(root / "object_masks" / f"{frame.name}.png") > 0
        frames[name] = TrueFrame(frame, scan.projector, bool(recorded[number]["usable"]), mask)
    mesh: Any = trimesh.load(root / "mesh.ply", process=False)
    return Truth(frames, float(np.ptp(np.asarray(mesh.vertices), axis=0).max()))

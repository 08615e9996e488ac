"""What `sl-export` is asked for."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Standing = Literal["z-up", "plane"]
CameraKind = Literal["colmap", "blender"]
TrajectoryKind = Literal["tum", "kitti"]
COLMAP_FOLDER = "colmap"
COLMAP_FILES = ("cameras.txt", "rigs.txt", "frames.txt", "images.txt", "points3D.txt")
BLENDER_FILE = "cameras_blender.py"


@dataclass(frozen=True)
class ExportSettings:
    """What is exported, and to which files; lengths in the scan's unit."""

    mesh: Path
    pose_folder: Path | None = None  # for transforms.json and training.json; None: the poses are not written
    resolution: int = 512  # cells along each side of the scene's box
    keep_unobserved: bool = False
    object_only: bool = False  # without planes around the object and what is not connected to it
    largest_component: bool = False  # only the connected piece with the largest area
    largest_hole: float | None = None  # holes up to this size are closed by the field; None: they stay open
    watertight: bool = False  # a closed solid
    target_faces: int | None = None
    texture: int | None = None  # side of the texture in pixels
    points: Path | None = None  # point cloud of what was observed
    align: Standing | None = None  # how mesh and points are turned; None: they have the scan's axes
    cameras: tuple[CameraKind, ...] = ()
    trajectories: tuple[TrajectoryKind, ...] = ()

    @property
    def device_folder(self) -> Path:
        """Where cameras and trajectories are written."""
        return self.mesh.parent if self.pose_folder is None else self.pose_folder

    @property
    def device_files(self) -> dict[str, tuple[Path, ...]]:
        """All files with cameras and trajectories, by the kind that is asked for."""
        folder, files = self.device_folder, {}
        if "colmap" in self.cameras:
            files["colmap"] = tuple(folder / COLMAP_FOLDER / name for name in COLMAP_FILES)
        if "blender" in self.cameras:
            files["blender"] = (folder / BLENDER_FILE,)
        for kind in self.trajectories:
            files[kind] = tuple(folder / f"{device}_{kind}.txt" for device in ("camera", "projector"))
        return files

"""The flags of sl-export."""

from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from sl_nerfstudio.runs.export_settings import ExportSettings


@dataclass(frozen=True)
class ExportConfig:
    """Write the surface of a training run, and optionally poses, cameras and points, in the scan's unit and axes."""

    load_config: Path
    """config.yml of the run; ns-train prints its path at the end."""
    output: Path
    """Mesh file to write: .ply (with all properties of vertices), .obj, .stl (in mm) or .glb (in metres, y up)."""
    poses: Path | None = None
    """Folder for transforms.json with the refined poses, and training.json with settings, versions and curves."""
    cameras: tuple[Literal["colmap", "blender"], ...] = ()
    """Cameras and projectors for other programs, in the --poses folder, else beside the mesh."""
    trajectory: tuple[Literal["tum", "kitti"], ...] = ()
    """Refined poses of cameras and of projectors as text files in the same folder, in metres."""
    points: Path | None = None
    """Point cloud to write, of what frames observed, with normals, sigma and views: .ply, or .las with laspy."""
    resolution: int = 512
    """Cells along each side of the scene's box; the time grows with its square."""
    target_faces: int | None = None
    """Number of triangles to which the mesh is reduced (quadric decimation); what that changes is measured."""
    texture: int | None = None
    """Side in pixels of a square texture for .glb or .obj, from pictures without the pattern; 2048 is usual."""
    fill_holes: float | None = None
    """Size in mm (without a known length, in the scan's units) of holes that the field's own surface closes."""
    watertight: bool = False
    """Write a closed solid for printing; says which share of it no frame observed."""
    keep_unobserved: bool = False
    """Keep the surface that no frame observed. It closes the unseen sides, but is invented by the field."""
    object_only: bool = False
    """Remove the plane that the object stands on, walls, and what is not connected to the object."""
    largest_component: bool = False
    """Keep only the connected piece of the surface with the largest area."""
    data: Path | None = None
    """Scan folder, if it was moved since the training."""
    overwrite: bool = False
    """Replace existing files."""

    @property
    def pose_folder(self) -> Path | None:
        """The folder of --poses, which may also name the file in it."""
        if self.poses is None or self.poses.name != "transforms.json":
            return self.poses
        return self.poses.parent

    @property
    def pose_files(self) -> tuple[Path, ...]:
        """The files with the refined poses and with the training, if they are to be written."""
        folder = self.pose_folder
        return () if folder is None else (folder / "transforms.json", folder / "training.json")

    def words(self) -> list[str]:
        """The flags that give this configuration, for a command to copy."""
        words: list[str] = []
        for field in fields(self):
            value = getattr(self, field.name)
            if field.default is not MISSING and value == field.default:
                continue
            words.append(f"--{field.name.replace('_', '-')}")
            if not isinstance(value, bool):
                words += map(str, value if isinstance(value, tuple) else (value,))
        return words

    def settings(self, units: str) -> "ExportSettings":
        """The export that is asked for, of a scan whose lengths are in `units`."""
        from sl_nerfstudio.runs.export_settings import ExportSettings
        from sl_nerfstudio.scan.types import UNITS

        millimetre = 1e-3 / (UNITS[units] or 1e-3)
        return ExportSettings(
            mesh=self.output,
            pose_folder=self.pose_folder,
            resolution=self.resolution,
            keep_unobserved=self.keep_unobserved,
            object_only=self.object_only,
            largest_component=self.largest_component,
            largest_hole=None if self.fill_holes is None else self.fill_holes * millimetre,
            watertight=self.watertight,
            target_faces=self.target_faces,
            texture=self.texture,
            points=self.points,
            cameras=self.cameras,
            trajectories=self.trajectory,
        )

"""The surface and the refined poses of a trained run, extracted and written."""

import platform
import shlex
import time
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.console import phase, track
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import IntrinsicsChange
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.meshing.extract import Field, extract_mesh
from sl_nerfstudio.meshing.files import observed_points, write_mesh, write_points
from sl_nerfstudio.meshing.finish import (
    Decimated,
    FilledHoles,
    MarkedMesh,
    Planes,
    closed_field,
    decimate,
    fill_holes,
    hull_planes,
)
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties
from sl_nerfstudio.meshing.texture import Colours, Pictures, Textured, has_pictures, surface_texture
from sl_nerfstudio.meshing.uncertainty import vertex_uncertainty
from sl_nerfstudio.meshing.visibility import Trimmed, trim_to_observed
from sl_nerfstudio.model.model import RECOMMENDED_STEPS
from sl_nerfstudio.model.run_files import plain, whole_command
from sl_nerfstudio.object_separation.planes import DecodedFrame, PlaneFinding
from sl_nerfstudio.object_separation.separate import PIXELS_PER_FRAME, Separation, separate
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.runs.cameras import (
    encode_blender,
    encode_colmap,
    encode_kitti,
    encode_tum,
    posed_frames,
    require_possible,
    surface_tracks,
)
from sl_nerfstudio.runs.export_settings import BLENDER_FILE, COLMAP_FOLDER, ExportSettings, Standing
from sl_nerfstudio.runs.pose_covariance import write_covariance
from sl_nerfstudio.runs.run import TrainedModel, TrainedRun
from sl_nerfstudio.scan import PoseSigma, Scan, write_transforms
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.types import UNITS
from sl_nerfstudio.scan.write import encode_json, sigma_fields
from sl_nerfstudio.storage import write_atomic

# Cameras and trajectories of a run, written for other programs.


def write_device_files(
    settings: ExportSettings, model: TrainedModel, mesh: Mesh, colour: UInt8[ndarray, "v 3"] | None
) -> None:
    """Write what the settings ask for; COLMAP gets points of `mesh`."""
    scan, folder, poses = model.scan, settings.device_folder, model.poses()
    frames, unit_m = posed_frames(scan, poses, model.unplaced()), UNITS[scan.units]
    files: dict[str, bytes] = {}
    if "colmap" in settings.cameras:
        model_files = encode_colmap(frames, scan.root, surface_tracks(mesh, colour, scan, poses))
        files |= {f"{COLMAP_FOLDER}/{name}": content for name, content in model_files.items()}
    if "blender" in settings.cameras:
        files[BLENDER_FILE] = encode_blender(frames, unit_m)
    for name, devices in (("camera", frames.cameras), ("projector", frames.projectors)):
        if "tum" in settings.trajectories:
            files[f"{name}_tum.txt"] = encode_tum(devices, frames.placed, unit_m or 1.0)
        if "kitti" in settings.trajectories:
            files[f"{name}_kitti.txt"] = encode_kitti(devices, unit_m or 1.0)
    for name, content in files.items():
        write_atomic(folder / name, content)


# What a person needs to repeat a run: settings, versions, convergence; as plain JSON values.

_PACKAGES = ("sl-nerfstudio", "nerfstudio", "torch", "numpy", "scipy", "numba", "open3d")
_SETTINGS = ("method_name", "max_num_iterations", "schedule_iterations", "mixed_precision", "machine", "optimizers")


def training_record(run: TrainedRun, settings: ExportSettings, pictures: Pictures | None = None) -> dict[str, Any]:
    """`settings` (nested), `versions` (of the export, by package), `curves` (lists by name, NaN as None), and others.

    `intrinsics` says how these were changed, and how well they agree with the captures; `commands` go on from here: to
    `train` the run up to its recommended length, to `export` it with finer cells. `exposures`: what the light of each
    picture without the pattern was divided by, in red, green and blue.
    """
    return {
        "settings": {"step": run.step, **run_settings(run.config)},
        "versions": {
            **package_versions(),
            "torch": torch.__version__,
            "python": platform.python_version(),
            "device": _device(run.model.device),
        },
        "curves": {name: plain(values) for name, values in run.model.history().items()},
        "intrinsics": {
            "change": plain(run.model.scan.intrinsics_change),
            "self_calibration": _self_calibration(run.model.self_calibration()),
        },
        "commands": _commands(run, settings),
        "exposures": {} if pictures is None else pictures.exposures(),
    }


def _commands(run: TrainedRun, settings: ExportSettings) -> dict[str, list[str]]:
    """As words, with absolute paths; where the run is a part of another command, the one that makes both better."""
    if whole_command():
        return dict.fromkeys(("train", "export"), shlex.split(whole_command()))
    config, method = run.config, run.config.method_name
    folder: Path = config.get_base_dir().absolute()
    steps = max(RECOMMENDED_STEPS.get(method, 0), getattr(config, "schedule_iterations", None) or 0) - run.step - 1
    place = ("--output-dir", config.output_dir.absolute(), "--experiment-name", config.experiment_name)
    train = ("ns-train", method, "--data", run.model.scan.root.absolute(), "--load-dir", folder / "nerfstudio_models",
             *place, "--timestamp", config.timestamp, "--max-num-iterations", max(steps, 1))  # fmt: skip
    poses = () if settings.pose_folder is None else ("--poses", settings.pose_folder.absolute())
    export = ("sl-export", "--load-config", folder / "config.yml", "--output", settings.mesh.absolute(), *poses,
              "--resolution", 2 * settings.resolution, "--overwrite")  # fmt: skip
    return {"train": list(map(str, train)), "export": list(map(str, export))}


def _self_calibration(found: SelfCalibration | None) -> dict[str, Any] | None:
    """Which change of the intrinsics would agree better with the captures, with its uncertainty."""
    if found is None:
        return None
    return {
        "change": plain(IntrinsicsChange.of(found.change.tolist())),
        "sigma": plain(IntrinsicsChange.of(found.sigma.tolist())),
        "chi_square": found.chi_square,
        "contradicts": found.contradicts(),
    }


def run_settings(config: Any) -> dict[str, Any]:
    """The settings that determine the result of a run, from nerfstudio's trainer configuration."""
    chosen = {name: plain(getattr(config, name)) for name in _SETTINGS if hasattr(config, name)}
    return {
        **chosen,
        "recommended_steps": RECOMMENDED_STEPS.get(config.method_name),
        "data": str(config.pipeline.datamanager.data),
        "rays": config.pipeline.datamanager.train_num_rays_per_batch,
        "intrinsics_change": plain(config.pipeline.datamanager.dataparser.intrinsics_change),
        "model": plain(config.pipeline.model),
    }


def package_versions() -> dict[str, str]:
    """Versions of the packages that do the computation."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def _device(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"{device.type} ({platform.machine()})"


# The object cut out of a surface: what `sl-export --object-only` leaves of it.


@dataclass(frozen=True)
class ObjectCut:
    """A mesh without surroundings; areas in the square of the scan's unit."""

    kept: Bool[ndarray, "f"]  # triangles of the mesh that was cut
    area_before: float
    area_removed: float
    planes: tuple[PlaneFinding, ...]  # all that were judged
    removed: tuple[PlaneFinding, ...]  # those that were removed


def separate_scan(scan: Scan, poses: DevicePoses) -> Separation:
    """The object in the triangulated points of a scan, found as sl-process does. Raises UserError without points."""
    frames = []
    for k, frame in enumerate(track(scan.frames, "object only")):
        coords = frame.read_coords()
        if all_finite(coords).any():
            T = poses.T_world_camera[k], poses.T_world_projector[k]
            whole = DecodedFrame(frame.camera, scan.projector, *T, coords, frame.read_mask())
            frames.append(whole.thinned(PIXELS_PER_FRAME))
    if not frames:
        raise UserError(
            f"{scan.root}: no frame has decoded coordinates, so --object-only cannot find the object\n"
            "    cause:  the scan has images and poses only\n    remedy: leave --object-only out"
        )
    return separate(frames)


def cut_object(mesh: Mesh, found: Separation, chosen: Bool[ndarray, "f"] | None = None) -> ObjectCut:
    """Keep the chosen triangles; by default all but planes around the object and what is not connected to it.

    Raises UserError if nothing is left.
    """
    kept = found.keeps(mesh.vertices)[mesh.faces].all(1) if chosen is None else chosen
    if not kept.any():
        raise UserError(
            "--object-only leaves nothing of the surface\n"
            "    cause:  the surface is far from the scan's decoded points: wrong poses, or an unfinished training\n"
            "    remedy: look at the run in ns-viewer, or leave --object-only out"
        )
    areas = mesh.face_areas()
    removed = tuple(plane.finding for plane in found.surroundings)
    return ObjectCut(kept, float(areas.sum()), float(areas[~kept].sum()), found.findings, removed)


def planes_below(found: Separation, S_scene_world: Similarity) -> Planes:
    """Normals and offsets, in the scene, of the planes above which the object is: what belongs to a plane is below."""
    planes: Planes = []
    for one in found.surroundings:
        plane = one.finding.plane
        normal = S_scene_world.R @ plane.normal
        offset = S_scene_world.scale * (plane.offset + one.tolerance) + float(normal @ S_scene_world.t)
        planes.append((normal, offset))
    return planes


# The surface of a trained run, as an export wants it: observed, filled, cut out, or closed.

_SAME = 0.01  # of an edge: vertices of two extractions that are so near are the same one


@dataclass(frozen=True)
class ExtractedSurface:
    """The surface in the scan's world and unit, and what became of the whole zero level."""

    marked: MarkedMesh
    trimmed: Trimmed | None  # None: nothing was compared with the frames
    filled: FilledHoles | None  # None: holes were left open
    cut: ObjectCut | None  # None: surroundings were not looked for
    other_pieces: int  # that were removed for not being the largest one
    extraction_seconds: float


def build_surface(model: TrainedModel, settings: ExportSettings) -> ExtractedSurface:
    """Extract the zero level, and keep of it what the settings say.

    Raises UserError if there is no surface, or if no part of it was observed.
    """
    surface = _solid(model, settings) if settings.watertight else _open_surface(model, settings)
    if not settings.largest_component:
        return surface
    pieces = int(surface.marked.mesh.component_of_faces().max(initial=-1)) + 1
    return replace(surface, marked=surface.marked.largest_component(), other_pieces=pieces - 1)


def _zero_level(field: Field, model: TrainedModel, settings: ExportSettings) -> tuple[Mesh, float]:
    """The mesh of a field in the scan's world, and how many seconds it took."""
    start = time.perf_counter()
    mesh = extract_mesh(field, settings.resolution, device=model.device).mapped(model.S_scene_world.inverse())
    return mesh, time.perf_counter() - start


def _open_surface(model: TrainedModel, settings: ExportSettings) -> ExtractedSurface:
    whole, seconds = _zero_level(model.sdf, model, settings)
    trimmed = filled = cut = None
    marked = MarkedMesh(whole, np.zeros(len(whole.vertices), dtype=bool))
    if not settings.keep_unobserved:
        trimmed = trim_to_observed(whole, model.scan, model.poses())
        if settings.largest_hole is not None:
            filled = fill_holes(whole, trimmed, settings.largest_hole)
        marked = MarkedMesh(whole, ~trimmed.observed).with_faces(trimmed.kept if filled is None else filled.kept)
    if settings.object_only:
        cut = cut_object(marked.mesh, separate_scan(model.scan, model.poses()))
        marked = marked.with_faces(cut.kept)
    return ExtractedSurface(marked, trimmed, filled, cut, 0, seconds)


def _solid(model: TrainedModel, settings: ExportSettings) -> ExtractedSurface:
    """Closed pieces of the zero level, in each of which frames observed something.

    What nobody observed is cut off flat where it leaves the convex hull of what was observed, the planes around the
    object, or the box of the field: there the field knows nothing, and bulges.
    """
    scan, poses = model.scan, model.poses()
    whole, first = _zero_level(model.sdf, model, settings)
    trimmed = trim_to_observed(whole, scan, poses)
    real = trimmed.observed & whole.corners_of(trimmed.kept)
    planes, found = [], separate_scan(scan, poses) if settings.object_only else None
    if found is not None:
        real &= found.keeps(whole.vertices)
        planes = planes_below(found, model.S_scene_world)
    planes += hull_planes(model.S_scene_world.points(whole.vertices[real]), 2 / settings.resolution)
    solid, second = _zero_level(closed_field(model.sdf, planes, model.device), model, settings)
    observed = _same_vertices(solid, whole, real)
    piece = solid.component_of_faces()
    kept = np.bincount(piece, observed[solid.faces].all(1).astype(float))[piece] > 0
    cut = None if found is None else cut_object(solid, found, kept)
    return ExtractedSurface(MarkedMesh(solid, ~observed).with_faces(kept), trimmed, None, cut, 0, first + second)


def _same_vertices(mesh: Mesh, other: Mesh, chosen: Bool[ndarray, "w"]) -> Bool[ndarray, "v"]:
    """Vertices of a mesh that are also chosen vertices of another one, extracted on the same grid."""
    if not chosen.any():
        return np.zeros(len(mesh.vertices), dtype=bool)
    distance, _ = KDTree(other.vertices[chosen]).query(mesh.vertices)
    return np.asarray(distance < _SAME * other.edge_length())


# How the surface stands in a file for a program in which z is up.

_LEAST_UP = 0.3  # length of the mean of the cameras' up directions, below which they show none


def standing(align: Standing | None, mesh: Mesh, scan: Scan, poses: DevicePoses) -> Similarity:
    """The map from the scan's axes to those of the files of an export.

    `z-up` turns what was up for the cameras to +z and leaves the origin; `plane` puts the plane that the object stands
    on at z = 0, the object above it, about the origin. Raises UserError where there is no such direction or plane.
    """
    if align is None:
        return Similarity.identity()
    up = np.nanmean(poses.T_world_camera[:, :3, 1], axis=0)
    if align == "z-up":
        if np.linalg.norm(up) < _LEAST_UP:
            raise UserError(
                "--align z-up: the cameras agree on no direction that is up\n"
                "    cause:  they were turned about their lines of sight, or look down from all sides\n"
                "    remedy: give --align plane, or leave --align out"
            )
        return Similarity(1.0, _turned_to_z(up), np.zeros(3))
    below = [one.finding.plane for one in separate_scan(scan, poses).surroundings]
    plane = max(below, key=lambda one: float(one.normal @ up), default=None)
    if plane is None or plane.normal @ up < _LEAST_UP * np.linalg.norm(up):  # others are walls
        raise UserError(
            "--align plane: no plane was found on which the object stands\n"
            "    cause:  the captures show no table, or it was left out of the scan by --object-only or a mask\n"
            "    remedy: give --align z-up, or leave --align out"
        )
    R = _turned_to_z(plane.normal)
    low, high = mesh.mapped(Similarity(1.0, R, np.zeros(3))).bounds()
    x, y = (low + high)[:2] / 2
    return Similarity(1.0, R, np.array([-x, -y, -plane.offset]))


def _turned_to_z(up: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    """The shortest rotation that turns a direction to +z."""
    up, z = up / np.linalg.norm(up), np.array([0.0, 0.0, 1.0])
    if up[2] < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    axis = np.cross(up, z)
    return Rotation.from_rotvec(axis / max(np.linalg.norm(axis), 1e-300) * np.arccos(min(up[2], 1.0))).as_matrix()


_ROUNDING = 1e-6  # of single precision, relative to the largest number


@dataclass(frozen=True)
class Exported:
    """What was written; lengths in the scan's unit."""

    mesh: Mesh
    properties: VertexProperties  # of the mesh's vertices
    surface: ExtractedSurface  # before it was decimated
    decimated: Decimated | None
    colours: Colours | None  # of the surface before it was decimated; None: no picture without the pattern
    pictures: Pictures | None  # from which they are
    textured: Textured | None  # None: no texture was asked for
    points: int  # in the point cloud
    pose_sigma: Float[ndarray, "frames 4"] | None  # in the order of PoseSigma's fields; None: not estimated
    poses_refined: bool  # whether the run's poses are others than the scan's
    writing_seconds: float  # everything but the extraction

    @property
    def invented_share(self) -> float:
        """Share of the mesh's area that no frame observed."""
        return MarkedMesh(self.mesh, self.properties.invented).invented_share()


@one_library_thread()
def export_run(run: TrainedRun, settings: ExportSettings) -> Exported:
    """Extract the surface, keep of it what the settings say, and write the files.

    Raises UserError if there is no surface, if no part of it was observed, or if a file cannot be written.
    """
    model, start = run.model, time.perf_counter()
    if "colmap" in settings.cameras:  # before anything slow
        require_possible(posed_frames(model.scan, model.poses(), model.unplaced()), model.scan.root)
    _require_pictures(settings, model.scan)
    surface = build_surface(model, settings)
    mesh, scan, poses = surface.marked.mesh, model.scan, model.poses()
    joint = model.joint_covariance()
    with phase("uncertainty of the vertices"):
        quality = vertex_uncertainty(mesh, scan, poses, joint, model.cell)
    pictures = Pictures(mesh, scan, poses) if has_pictures(scan) else None
    colours = None if pictures is None else pictures.colours(mesh.vertices, mesh.vertex_normals())
    invented = quality.views == 0 if settings.keep_unobserved else surface.marked.invented
    properties = VertexProperties(quality, invented, None if colours is None else colours.rgb)
    points, S_file_world = 0, standing(settings.align, mesh, scan, poses)
    if settings.points is not None:
        points = write_points(settings.points, *observed_points(mesh.mapped(S_file_world), properties), scan.units)
    if settings.cameras or settings.trajectories:
        write_device_files(settings, model, mesh, properties.colour)
    whole, decimated, textured = mesh, None, None
    if settings.target_faces is not None:
        with phase("fewer triangles"):
            decimated = decimate(mesh, settings.target_faces)
        mesh, properties = decimated.mesh, properties.chosen(decimated.nearest).moved(decimated.distance)
    if settings.watertight:
        _require_closed(mesh, settings)
    if settings.texture is not None and pictures is not None:
        with phase("laying the mesh out flat"):
            textured = surface_texture(mesh, settings.texture, whole, pictures)
    mesh = mesh.mapped(S_file_world)
    write_mesh(settings.mesh, mesh, properties, scan.units, None if textured is None else textured.texture)
    if settings.pose_folder is not None:
        _write_poses(settings.pose_folder / TRANSFORMS, model)
        write_covariance(settings.pose_folder, scan, joint)
        write_atomic(settings.pose_folder / "training.json", encode_json(training_record(run, settings, pictures)))
    seconds = time.perf_counter() - start - surface.extraction_seconds
    refined = poses_refined(model)
    return Exported(
        mesh, properties, surface, decimated, colours, pictures, textured, points, model.pose_sigma(), refined, seconds
    )


def poses_refined(model: TrainedModel) -> bool:
    """Whether the model's poses differ from those of its scan by more than rounding."""
    given, now = model.scan.poses.stacked(), model.poses().stacked()
    return not np.allclose(now, given, rtol=0.0, atol=_ROUNDING * float(np.abs(given).max()))


def _require_pictures(settings: ExportSettings, scan: Scan) -> None:
    if settings.texture is None or has_pictures(scan):
        return
    raise UserError(
        f"--texture {settings.texture}: no frame of {scan.root} has a picture without the pattern\n"
        "    cause:  a texture needs colours, and captures under the pattern have none\n"
        "    remedy: photograph frames once more from the same place in even light, without the pattern, and give\n"
        "            these photographs, named like the frames, to sl-process (--color); or leave --texture out"
    )


def _require_closed(mesh: Mesh, settings: ExportSettings) -> None:
    if mesh.is_closed():
        return
    if settings.target_faces is not None:
        raise UserError(
            f"--target-faces {settings.target_faces}: the surface is no longer closed with so few triangles\n"
            "    cause:  thin parts of it collapse\n    remedy: keep more triangles, or leave --watertight out"
        )
    raise UserError(
        f"--watertight: the surface is not closed at --resolution {settings.resolution}\n"
        "    cause:  parts of it are thinner than a cell\n    remedy: give another --resolution"
    )


def _write_poses(path: Path, model: TrainedModel) -> None:
    """The scan's transforms.json with the refined poses and, if it was estimated, their uncertainty."""
    sigma, unplaced = model.pose_sigma(), model.unplaced()
    extra: list[dict[str, Any]] = [{"sl_unplaced": True} if lost else {} for lost in unplaced]
    if sigma is not None:
        for fields, row in zip(extra, sigma.tolist(), strict=True):
            if not fields:  # where a frame cannot be placed, its sigma says nothing
                fields["sl_pose_sigma"] = sigma_fields(PoseSigma(*row))
    write_transforms(path, model.scan, model.poses(), extra_frame_fields=extra)

"""Other methods on the same scans: COLMAP, fusion and Poisson's surface beside ours, on the same rendered photographs.

    python -m benchmarks.peers [--sets head-table-realistic-505 ...] [--keep FOLDER] [--output FILE]

COLMAP gets the photographs under the moving pattern, and photographs of the same views without it: under the
projector's constant light, which moves as the pattern does, and with the projector off, under still room light and
exposed for it. Surfaces are made from the frames that sl-process decoded and placed, without the table. Every camera
and every surface is compared after a similarity. Rows that are in the result file are not measured again.
"""

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from benchmarks.baselines.colmap import Cameras, structure_from_motion
from benchmarks.baselines.poisson import poisson
from benchmarks.baselines.poses import register
from benchmarks.baselines.tsdf import fuse
from benchmarks.common.measuring import Rows, kept_rows, options
from benchmarks.common.runs import export, process, train
from benchmarks.photographs.scoring import WRONG_DEG, Truth, read_truth
from benchmarks.photographs.sets import captures_of, config_of, note_of
from benchmarks.photographs.surface import OBJECT_MM
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.evaluate import SurfaceScore, score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import align_poses, mesh_reference
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, angle_deg
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import Scan, read_poses, read_scan
from sl_nerfstudio.scan.images import encode_png
from sl_nerfstudio.synthesis.appearance import LUMA
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.devices import disturb_image
from sl_nerfstudio.synthesis.synthesise import GAIN, Setup, Stream, make_setup, random_stream

# Photographs of the same views without the pattern.

Light = Literal["pattern", "constant", "room"]


def without_pattern(setup: Setup, light: Light) -> Setup:
    """The same scene and views under the projector's constant light, or under as much light of the room alone."""
    value, room = (0.0, True) if light == "room" else (1.0, False)
    appearance, photography = setup.appearance, setup.photography
    if room:
        appearance = replace(appearance, room_light=1.0, dark_leak=0.0)
    if photography is not None:
        look = photography.look
        look = replace(look, pattern=replace(look.pattern, levels=np.full_like(look.pattern.levels, value)))
        if room:
            level = float((look.room.ambient + look.room.lamp) @ LUMA)
            factor = np.float32((1 + level) / level)  # what the gain was chosen for
            lit = {key: getattr(look.room, key) * factor for key in ("ambient", "lamp", "nothing")}
            off = replace(look.lamp, colour=np.zeros_like(look.lamp.colour))
            look = replace(look, lamp=off, room=replace(look.room, **lit))
        photography = replace(photography, look=look)
    flat = np.full_like(setup.pattern, value)
    return replace(setup, pattern=flat, appearance=appearance, photography=photography)


def render_without_pattern(captures: Path, config: SynthConfig, light: Light) -> Path:
    """The folder of photographs without the pattern beside those with it, rendered unless it exists."""
    folder = captures / light
    if folder.exists():
        return folder
    started = folder.with_name(f".{light}")
    shutil.rmtree(started, ignore_errors=True)
    started.mkdir()
    setup = without_pattern(make_setup(config), light)
    for name, number in note_of(captures)["frames"].items():
        if setup.photography is None:
            radiance = setup.render(number, config.supersampling).radiance
            noise = random_stream(config.seed, Stream.SENSOR, number)
            image = disturb_image(radiance, GAIN, config.sensor_noise, noise)
            (started / f"{name}.png").write_bytes(encode_png(image))
        else:
            photo = setup.photograph(number, config.supersampling, setup.photography, config.seed)
            (started / f"{name}.jpg").write_bytes(photo.jpeg)
    return started.rename(folder)


# Cameras against the truth.

_WRONG_CENTRE = 0.15  # of the object's size: what WRONG_DEG about the object moves a camera three sizes away


@dataclass(frozen=True)
class CameraErrors:
    """Errors of placed cameras, after the similarity with which most of them are right."""

    deg: Float64[ndarray, "n"]
    centre: Float64[ndarray, "n"]  # share of the object's size

    @property
    def right(self) -> int:
        """How many are where they belong."""
        return int(((self.deg <= WRONG_DEG) & (self.centre <= _WRONG_CENTRE)).sum())


def camera_errors(found: Cameras, true: Cameras, size: float) -> CameraErrors:
    """Errors of the cameras in `found`; a wrong camera does not tilt the others."""
    names = sorted(found)
    if len(names) < 2:
        return CameraErrors(np.zeros(0), np.zeros(0))
    T, T_true = np.stack([found[name] for name in names]), np.stack([true[name] for name in names])

    def errors(of: list[int] | ndarray) -> CameraErrors:
        return _after(align_poses(T[of], T_true[of]), T, T_true, size)

    best = max((errors(pair) for pair in map(list, combinations(range(len(names)), 2))), key=_agreement)
    for _ in range(3):
        right = np.flatnonzero((best.deg <= WRONG_DEG) & (best.centre <= _WRONG_CENTRE))
        best = errors(right) if len(right) > 1 else best
    return best


def _agreement(errors: CameraErrors) -> tuple[int, float]:
    return errors.right, -float(np.median(errors.centre))


def _after(
    S_true_found: Similarity, T: Float64[ndarray, "n 4 4"], T_true: Float64[ndarray, "n 4 4"], size: float
) -> CameraErrors:
    placed = S_true_found.poses(T)
    turns = np.swapaxes(T_true[:, :3, :3], 1, 2) @ placed[:, :3, :3]
    centre = np.linalg.norm(placed[:, :3, 3] - T_true[:, :3, 3], axis=1) / size
    return CameraErrors(np.array([angle_deg(turn) for turn in turns]), centre)


# One set of photographs, and what is measured on it.


@dataclass(frozen=True)
class Row:
    """What a method found; lengths in mm of an object of `OBJECT_MM`, None where there is no such figure."""

    set: str
    method: str
    given: str
    needs: str
    usable: int
    placed: int
    right: int  # of the placed ones
    camera_deg: float | None  # median of the placed ones
    camera_share: float | None  # the same: camera centres, share of the object's size
    rmse: float | None  # of the surface
    median: float | None
    completeness: float | None  # RMS
    seconds: float  # of this step alone: surfaces start from placed frames


@dataclass(frozen=True)
class Case:
    """A set of photographs with its truth and the scans made of it."""

    name: str
    captures: Path
    config: SynthConfig
    truth: Truth

    @property
    def true_cameras(self) -> Cameras:
        """Where the cameras were."""
        return {name: true.frame.T_world_camera for name, true in self.truth.frames.items()}

    @property
    def folder(self) -> Path:
        """What the methods write."""
        return self.captures / "peers"

    def processed(self, *, adjusted: bool) -> Scan:
        """The scan that sl-process makes, made once. Raises UserError if it makes none."""
        root = self.folder / ("scan" if adjusted else "registered")
        if not root.exists():
            more = ["--unordered"] * note_of(self.captures)["unordered"] + ["--no-adjust"] * (not adjusted)
            more += ["--object-only"] if (self.captures / "ground_truth/surroundings.ply").exists() else []
            message = process(self.captures, root, self.folder / "work", 1, *more)
            if message:
                raise UserError(f"{self.name}: sl-process made no scan\n{message}")
        return read_scan(root)

    def true_poses(self, scan: Scan) -> DevicePoses:
        """The truth of a scan's frames."""
        true = [self.truth.frames[frame.name].frame for frame in scan.frames]
        return DevicePoses(np.stack([f.T_world_camera for f in true]), np.stack([f.T_world_projector for f in true]))

    def registered_poses(self, scan: Scan) -> DevicePoses:
        """Poses of a scan's frames before the joint adjustment. Raises UserError if that left a frame out."""
        return read_poses(self.processed(adjusted=False).root / "transforms.json", scan)


def calibrated(case: Case, scan: Scan) -> DevicePoses:
    """Frames as they were registered, but with the true relative pose and baseline of each, as a calibrated rig has."""
    registered, true = case.registered_poses(scan), case.true_poses(scan)
    placed = registered.mapped(align_poses(registered.stacked(), true.stacked()))
    return DevicePoses(placed.T_world_camera, placed.T_world_camera @ true.T_camera_projector)


Surface = Callable[[Case, Scan], tuple[Mesh, DevicePoses]]


def ours(case: Case, scan: Scan) -> tuple[Mesh, DevicePoses]:
    """Train with the default steps, and export."""
    trained, mesh, poses = case.folder / "run", case.folder / "mesh.ply", case.folder / "refined"
    shutil.rmtree(trained, ignore_errors=True)
    export(train(scan.root, trained, "now"), mesh, poses)
    return read_mesh(mesh), read_poses(poses / "transforms.json", scan)


def _with(make: Callable[[Scan, DevicePoses], Mesh], poses: Callable[[Case, Scan], DevicePoses]) -> Surface:
    def made(case: Case, scan: Scan) -> tuple[Mesh, DevicePoses]:
        at = poses(case, scan)
        return make(scan, at), at

    return made


SURFACES: dict[str, tuple[str, Surface]] = {
    "TSDF, ICP": ("pattern, rough poses", _with(fuse, lambda c, s: register(s, c.registered_poses(s)))),
    "TSDF, ICP, true rig": (
        "pattern, calibrated rig, rough poses", _with(fuse, lambda c, s: register(s, calibrated(c, s)))),
    "TSDF, true poses": ("pattern, all poses", _with(fuse, lambda c, s: c.true_poses(s))),
    "TSDF, our poses": ("pattern", _with(fuse, lambda c, s: s.poses)),
    "Poisson, our poses": ("pattern", _with(poisson, lambda c, s: s.poses)),
    "sl-neus": ("pattern", ours),
}  # fmt: skip
PLACINGS: dict[str, tuple[str, Light | None]] = {
    "COLMAP, moving pattern": ("texture", "pattern"), "COLMAP, moving constant light": ("texture", "constant"),
    "COLMAP, room light": ("texture, still light", "room"), "sl-process": ("pattern", None),
}  # fmt: skip
METHODS = {**PLACINGS, **SURFACES}


def measure(case: Case, method: str) -> Row:
    """Run one method."""
    return _placed(case, method) if method in PLACINGS else _surface(case, method)


def _placed(case: Case, method: str) -> Row:
    needs, light = PLACINGS[method]
    if light is None:
        shutil.rmtree(case.folder, ignore_errors=True)
        find = partial(_placed_by_us, case)
    else:
        patterned = case.captures / "images"
        images = patterned if light == "pattern" else render_without_pattern(case.captures, case.config, light)
        camera = next(iter(case.truth.frames.values())).frame.camera
        find = partial(structure_from_motion, images, camera, case.captures / f"colmap-{light}")
    begin = time.monotonic()
    cameras = find()
    return _row(case, method, needs, cameras, None, time.monotonic() - begin)


def _placed_by_us(case: Case) -> Cameras:
    scan = case.processed(adjusted=True)
    return _cameras(scan, scan.poses)


def _surface(case: Case, method: str) -> Row:
    needs, make = SURFACES[method]
    scan = case.processed(adjusted=True)
    case.processed(adjusted=False)  # not part of the time
    begin = time.monotonic()
    mesh, poses = make(case, scan)
    seconds = time.monotonic() - begin
    true = case.true_poses(scan)
    reference = mesh_reference(read_mesh(case.captures / "ground_truth/mesh.ply"), scan, true)
    score = score_alignments(IndexedMesh(mesh), reference, poses, true)["similarity"]
    return _row(case, method, needs, _cameras(scan, poses), score, seconds)


def _cameras(scan: Scan, poses: DevicePoses) -> Cameras:
    return {frame.name: T for frame, T in zip(scan.frames, poses.T_world_camera, strict=True)}


def _row(case: Case, method: str, needs: str, cameras: Cameras, score: SurfaceScore | None, seconds: float) -> Row:
    usable, mm = case.truth.usable, OBJECT_MM / case.truth.size
    placed = {name: T for name, T in cameras.items() if name in usable}
    errors = camera_errors(placed, case.true_cameras, case.truth.size)
    deg, share = (float(np.median(e)) if len(e) else None for e in (errors.deg, errors.centre))
    rmse, median, missing = (None,) * 3 if score is None else [
        mm * d for d in (score.accuracy.rmse, score.accuracy.median, score.completeness.rmse)]  # fmt: skip
    light = PLACINGS[method][1] if method in PLACINGS else None
    given = "the frames of sl-process" if method in SURFACES else f"photographs, {light or 'pattern'}"
    return Row(
        set=case.name, method=method, given=given, needs=needs, usable=len(usable), placed=len(placed),
        right=errors.right, camera_deg=deg, camera_share=share, rmse=rmse, median=median, completeness=missing,
        seconds=seconds,
    )  # fmt: skip


def main() -> None:
    """Print a line for each method, and write all to JSON."""
    given = options(
        __doc__, sets=["head-table-realistic-505"], frames=24, resolution=600, methods=METHODS,
        keep=Path("outputs/peers"), output=Path("benchmarks/results/peers.json"),
    )  # fmt: skip
    rows: Rows[Row] = Rows(given.output, kept_rows(given.output, Row), frames=given.frames, resolution=given.resolution)
    for name in given.sets:
        captures = captures_of(name, given.frames, given.resolution, given.keep)
        config = config_of(name, given.frames, given.resolution, given.keep)
        case = Case(captures.name, captures, config, read_truth(captures))
        for method in given.methods:
            if not rows.have(set=case.name, method=method):
                rows.add(measure(case, method))


if __name__ == "__main__":
    run(main)

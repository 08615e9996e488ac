"""Share of object pixels kept and of surroundings left in, on noisy coordinates of objects on tables and before walls.

    python -m benchmarks.separation [--objects frog medal ...] [--backgrounds none table walls ...] [--zoom 1.0 0.6]

Coordinates are cast on the mesh (24 frames of 300 x 300) and disturbed: 0.3 px noise, 15 % of cells missing, 2 % wrong;
those that contradict the epipolar geometry by more than 1.5 px are dropped, as sl-process does. Poses are wrong by
0.05 degrees and 0.01 % of the distance. `--zoom` below 1 makes both devices see more of the surroundings.
"""

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool
from numpy import ndarray

from benchmarks.machine import write_rows
from benchmarks.separation.objects import BACKGROUNDS, OBJECTS, in_the_room, surroundings
from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.epipolar import epipolar_residual
from sl_nerfstudio.object_separation.frame_points import DecodedFrame
from sl_nerfstudio.object_separation.separate import Part, Separation, separate
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.synthesis.devices import DeviceOptions, make_devices
from sl_nerfstudio.synthesis.noise import CoordinateNoise, disturb_coords
from sl_nerfstudio.synthesis.paths import make_paths
from sl_nerfstudio.synthesis.ray_casting import RayCaster
from sl_nerfstudio.synthesis.render import visible_points
from sl_nerfstudio.synthesis.scenes.surroundings import above_the_table
from sl_nerfstudio.synthesis.setup import make_cells

FRAMES, RESOLUTION = 24, 300
_KEPT_PX = 1.5  # epipolar


@dataclass(frozen=True)
class Row:
    """One object before one background."""

    object: str
    background: str
    zoom: float
    object_kept: float  # share of the decoded pixels of the object
    object_kept_worst: float  # frame
    surroundings_left: float  # share of the decoded pixels of the surroundings
    surroundings_share: float  # of all decoded pixels
    verdicts: tuple[str, ...]  # of the planes
    seconds: float


@dataclass(frozen=True)
class Case:
    """Decoded frames, and where each shows the object."""

    frames: tuple[DecodedFrame, ...]
    is_object: tuple[Bool[ndarray, "h w"], ...]


def make_case(name: str, background: str, zoom: float, seed: int) -> Case:
    """Cast and disturb the coordinates of all frames."""
    rng = np.random.default_rng([seed, 7])
    scene = OBJECTS[name]()
    if background != "none":
        scene = above_the_table(scene)
    caster = RayCaster(scene, surroundings(background, scene, rng))
    poses = make_paths(scene, FRAMES * (3 if background == "room" else 1), "hand-held", rng)
    if background == "room":  # only frames from inside the room
        poses = poses[np.flatnonzero(in_the_room(scene, poses.stacked()[:, :3, 3]).reshape(2, -1).all(0))[:FRAMES]]
    layout = GridPattern()
    devices = make_devices(scene, poses, (layout.w, layout.h), DeviceOptions(RESOLUTION))
    camera, projector = (
        replace(d, fl_x=zoom * d.fl_x, fl_y=zoom * d.fl_y) for d in (devices.camera, devices.projector)
    )
    devices = replace(devices, camera=camera, projector=projector)
    cells = make_cells(layout.render(), layout.lattice)
    uv = np.stack(np.meshgrid(np.arange(camera.w), np.arange(camera.h)), -1).reshape(-1, 2) + 0.5
    frames, objects = [], []
    for T_c, T_p in zip(poses.T_world_camera, poses.T_world_projector, strict=True):
        found = visible_points(caster, devices, T_c, T_p, uv)
        mask = found.lit.reshape(camera.h, camera.w)
        coords = np.where(mask[..., None], found.uv_projector.reshape(*mask.shape, 2), np.nan).astype(np.float32)
        coords = disturb_coords(coords, mask, cells, CoordinateNoise(0.3, 0.15, 0.02), rng)
        coords[np.abs(_epipolar(camera, T_c, uv, projector, T_p, coords)) > _KEPT_PX] = np.nan
        wrong = _wrong_pose(T_c[:3, 3], scene.centre, rng)
        frames.append(DecodedFrame(camera, projector, wrong @ T_c, wrong @ T_p, coords, mask))
        objects.append(mask & caster.on_object(found.face).reshape(mask.shape))
    return Case(tuple(frames), tuple(objects))


def _epipolar(camera, T_c, uv, projector, T_p, coords) -> ndarray:
    residual = epipolar_residual(
        Intrinsics.of(camera, torch.float64), torch.from_numpy(T_c), torch.from_numpy(uv),
        Intrinsics.of(projector, torch.float64), torch.from_numpy(T_p),
        torch.from_numpy(coords.reshape(-1, 2).astype(np.float64)),
    )  # fmt: skip
    return residual.numpy().reshape(coords.shape[:2])


def _wrong_pose(position: ndarray, centre: ndarray, rng: np.random.Generator) -> ndarray:
    """A small motion of a frame as a whole, about the object."""
    from scipy.spatial.transform import Rotation

    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(np.radians(0.05) * rng.standard_normal(3)).as_matrix()
    shift = 1e-4 * np.linalg.norm(position - centre) * rng.standard_normal(3)
    T[:3, 3] = centre - T[:3, :3] @ centre + shift
    return T


def measure(name: str, background: str, zoom: float, seed: int) -> tuple[Row, Case, Separation]:
    """Separate one case and compare."""
    case = make_case(name, background, zoom, seed)
    start = time.monotonic()
    found = separate(case.frames)
    seconds = time.monotonic() - start
    kept, total, left, others = np.zeros((4, len(case.frames)))
    for k, (frame, is_object) in enumerate(zip(case.frames, case.is_object, strict=True)):
        decoded = np.isfinite(frame.coords).all(-1)
        part = found.parts(k, frame)
        kept[k], total[k] = (part[decoded & is_object] == Part.OBJECT).sum(), (decoded & is_object).sum()
        left[k], others[k] = (part[decoded & ~is_object] == Part.OBJECT).sum(), (decoded & ~is_object).sum()
    row = Row(
        name, background, zoom,
        object_kept=float(kept.sum() / total.sum()), object_kept_worst=float((kept / total.clip(1)).min()),
        surroundings_left=float(left.sum() / max(others.sum(), 1)),
        surroundings_share=float(others.sum() / (others.sum() + total.sum())),
        verdicts=tuple(f.verdict for f in found.findings), seconds=seconds,
    )  # fmt: skip
    return row, case, found


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all cases and write them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--objects", nargs="+", default=list(OBJECTS), choices=list(OBJECTS))
    parser.add_argument("--backgrounds", nargs="+", default=list(BACKGROUNDS), choices=list(BACKGROUNDS))
    parser.add_argument("--zoom", nargs="+", type=float, default=[1.0, 0.6])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/separation.json"))
    parser.add_argument("--verbose", action="store_true", help="print every plane")
    given = parser.parse_args(arguments)
    rows = []
    for name in given.objects:
        for background in given.backgrounds:
            for zoom in given.zoom:
                row, _, found = measure(name, background, zoom, given.seed)
                rows.append(row)
                print(f"{name:8} {background:6} {zoom:3.1f}  object kept {row.object_kept:7.2%} (worst frame "
                      f"{row.object_kept_worst:7.2%}), of the surroundings ({row.surroundings_share:.0%}) left "
                      f"{row.surroundings_left:7.2%}  {row.seconds:4.1f} s", flush=True)  # fmt: skip
                if given.verbose:
                    for f in found.findings:
                        print(f"    {f.verdict:22} share {f.share:.2f} front {f.cameras_in_front:.2f} "
                              f"behind {f.behind:.3f} above {f.above:.3f} continues {f.continues:.2f} "
                              f"area {f.area_ratio:.1f} height {f.height_ratio:.2f} around {f.around:.2f}")  # fmt: skip
    write_rows(given.output, rows, frames=FRAMES, resolution=RESOLUTION, seed=given.seed)


if __name__ == "__main__":
    main()

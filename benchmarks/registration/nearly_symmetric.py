"""Registration of frames in no order, of objects that look the same, or nearly, from several sides.

    python -m benchmarks.registration.nearly_symmetric [--things key hub ...] [--seeds 1 2] [--output FILE]

Each of 24 shuffled frames (220 x 220 pixels, noise of 0.35 pattern pixels, 1 % wrong pixels) is calibrated by itself;
then all are registered. A frame is wrong if its camera is turned by more than 5 degrees against the largest group of
frames that agree with the truth. What is exactly symmetric cannot come out right; it has to be named.
"""

import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from numpy import ndarray

from benchmarks.common.measuring import Rows, options
from benchmarks.registration.solids import ball, block, drum, meshed, moved, prism
from sl_nerfstudio.geometry.lie import angle_deg
from sl_nerfstudio.registration.register import register
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.estimation import estimate_relative_pose
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.sdf import carve, union
from sl_nerfstudio.synthesis.synthesise import make_setup

FRAMES, RESOLUTION = 24, 220
_NOISE_PX, _WRONG, _MISSING = 0.35, 0.01, 0.1
_WRONG_DEG = 5.0


@dataclass(frozen=True)
class Row:
    """One registration."""

    thing: str
    seed: int
    right: int
    wrong: int
    left_out: int
    turns_deg: tuple[float, ...]  # that are named
    wrong_by_deg: tuple[int, ...]
    seconds: float


def key() -> trimesh.Trimesh:
    """A plate with two bosses of unequal height."""
    bosses = drum((32, 0, 14), 10, 20), drum((-32, 0, 12), 8, 12)
    return meshed(union(3, block((0, 0, 0), (100, 44, 24), 2), *bosses), (60, 40, 40))


def hub() -> trimesh.Trimesh:
    """Six sides, a hole, and a notch."""
    notch = moved(block((0, 0, 20), (30, 10, 8)), (34, 0, 0))
    return meshed(carve(0.0, prism(6, 34, 40), drum((0, 0, 0), 14, 80), notch), (46, 46, 40))


def cross() -> trimesh.Trimesh:
    """Two bars of unequal length, and a boss."""
    bars = block((0, 0, 0), (110, 24, 24), 2), block((0, 0, 0), (24, 84, 24), 2)
    return meshed(union(4, *bars, drum((45, 0, 12), 7, 14)), (64, 52, 44))


def finned() -> trimesh.Trimesh:
    """Three fins, of which one is thicker and lower; upside down it is the same."""
    sizes = (44, 13, 52), (44, 8, 60), (44, 8, 60)
    fins = [moved(block((38, 0, 0), size, 2), (0, 0, 0), 120.0 * k) for k, size in enumerate(sizes)]
    return meshed(union(5, drum((0, 0, 0), 24, 70), *fins), (70, 70, 46))


def peanut() -> trimesh.Trimesh:
    """Two lobes and a small third."""
    lobes = ball((30, 0, 0), 30), ball((-30, 0, 0), (33, 30, 28)), ball((40, 20, 14), 9)
    return meshed(union(18, *lobes), (76, 50, 50))


def mouse() -> trimesh.Trimesh:
    """An ellipsoid with two ears and a bump."""
    bumps = ball((38, 18, 14), 11), ball((38, -18, 14), 11), ball((-40, 12, 12), 9)
    return meshed(union(8, ball((0, 0, 0), (55, 32, 24)), *bumps), (70, 50, 40))


def brick() -> trimesh.Trimesh:
    """A block that is the same after half a turn about each of three axes."""
    return meshed(block((0, 0, 0), (100, 62, 40), 2), (60, 40, 30))


def bracket() -> trimesh.Trimesh:
    """An angle with holes and a rib."""
    plates = union(3, block((0, 0, -30), (100, 60, 10)), block((-45, 0, 5), (10, 60, 80)))
    rib = carve(0.0, block((-25, 4, -8), (44, 8, 40)), moved(block((30, 0, 30), (90, 60, 60)), (-8, 0, 0), 0, -45))
    holes = [drum((x, y, -30), r, 30) for x, y, r in ((5, -16, 7), (34, 14, 9), (36, -18, 5))]
    return meshed(carve(0.0, union(0.0, plates, rib), *holes, drum((-45, -8, 20), 11, 30, axis=0)), (62, 42, 56))


def nut() -> trimesh.Trimesh:
    """Hexagonal, with a hole."""
    return meshed(carve(0.0, prism(6, 45, 38), drum((0, 0, 0), 26, 60), ball((0, 0, 52), 40)), (58, 58, 26))


def housing() -> trimesh.Trimesh:
    """A bearing block: bore, feet with holes, bosses of unequal height, a rib, an oil cup."""
    body = union(6, block((0, 0, -28), (116, 46, 16), 2), drum((0, 0, 4), 32, 40, axis=1))
    ribs = union(0.0, block((30, 0, -10), (40, 7, 30), 1), block((-30, 6, -12), (36, 6, 24), 1))
    bosses = union(
        2, drum((46, 12, -14), 9, 22), drum((-46, -10, -18), 8, 12), drum((-44, 12, -16), 6, 20),
        drum((8, 0, 38), 8, 24),
    )  # fmt: skip
    holes = [
        drum((0, 0, 4), 19, 80, axis=1), drum((46, 12, -14), 4, 80), drum((-46, -10, -18), 4, 80),
        drum((8, 0, 46), 4, 20),
    ]  # fmt: skip
    return meshed(carve(0.0, union(2, body, ribs, bosses), *holes), (64, 34, 56))


THINGS: dict[str, Callable[[], trimesh.Trimesh]] = {
    make.__name__: make for make in (key, hub, cross, finned, peanut, mouse, brick, housing, nut, bracket)
}


def shuffled(mesh: Path, seed: int) -> tuple[list[FrameCloud], ndarray]:
    """Clouds of the frames in a random order, and their true cameras (n, 4, 4)."""
    setup = make_setup(SynthConfig(scene=str(mesh), frames=FRAMES, resolution=RESOLUTION, seed=seed))
    rng = np.random.default_rng(seed)
    order, (camera, projector) = rng.permutation(FRAMES).tolist(), (setup.devices.camera, setup.devices.projector)
    clouds = []
    for k in order:
        coords = setup.render(k, 1).coords
        coords = coords + _NOISE_PX * rng.standard_normal(coords.shape).astype(np.float32)
        wrong = rng.random(coords.shape[:2]) < _WRONG
        coords[wrong] += rng.uniform(-40, 40, (wrong.sum(), 2)).astype(np.float32)
        coords[rng.random(coords.shape[:2]) < _MISSING] = np.nan
        pose = estimate_relative_pose(*correspondences_of(coords), camera, projector)
        clouds.append(frame_cloud(f"frame_{k:05d}", coords, camera, projector, pose))
    return clouds, setup.truth.T_world_camera[order]


def row_of(thing: str, seed: int, found: Registration, true: ndarray, seconds: float) -> Row:
    """Compared with the truth up to the one turn that most frames say."""
    kept = np.flatnonzero(found.registered)
    turns = [true[k, :3, :3] @ found.T_world_camera[k, :3, :3].T for k in kept]
    off = np.array([[angle_deg(a.T @ b) for b in turns] for a in turns]).reshape(len(kept), len(kept))
    off = off[int((off < _WRONG_DEG).sum(1).argmax())] if len(kept) else np.zeros(0)
    wrong = off[off >= _WRONG_DEG]
    by = tuple(sorted({round(float(angle)) for angle in wrong}))
    named = tuple(round(angle, 1) for angle in found.turns_deg)
    return Row(thing, seed, len(kept) - len(wrong), len(wrong), len(found.names) - len(kept), named, by, seconds)


def measure(thing: str, seed: int) -> Row:
    """Register one thing."""
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / f"{thing}.ply"
        THINGS[thing]().export(mesh)
        clouds, true = shuffled(mesh, seed)
    start = time.process_time()
    found = register(clouds)
    return row_of(thing, seed, found, true, round(time.process_time() - start, 1))


def main() -> None:
    """Print the rows, and write them to JSON."""
    given = options(__doc__, things=THINGS, seeds=[1, 2], output=Path("benchmarks/results/nearly_symmetric.json"))
    rows: Rows[Row] = Rows(given.output, frames=FRAMES)
    for thing in given.things:
        for seed in given.seeds:
            rows.add(measure(thing, seed))


if __name__ == "__main__":
    main()

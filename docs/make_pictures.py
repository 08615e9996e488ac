"""Draws docs/pictures/demo.png from the output of `make demo`.

.venv/bin/python docs/make_pictures.py [outputs/demo]
"""

import json
import sys
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.evaluation.report.pictures import ColourScale, OrthographicView, render
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.meshing.mesh_io import read_mesh
from sl_nerfstudio.scan import read_ground_truth, read_scan

FRAME = 4
SIZE = 460  # pixels of each of the four panels


def main(demo: Path) -> None:
    """One row: what the camera saw, what was decoded of it, the surface, and its errors."""
    scan, mesh = read_scan(demo / "scan"), read_mesh(demo / "mesh.ply")
    truth = read_ground_truth(scan)
    if truth.mesh_path is None:
        raise SystemExit(f"{demo / 'scan'} has no true surface to compare with")
    matrix = np.array(json.loads((demo / "evaluation.json").read_text())["rigid"]["matrix"])
    aligned = mesh.mapped(Similarity(1.0, matrix[:3, :3], matrix[:3, 3]))
    near = IndexedMesh(read_mesh(truth.mesh_path)).closest(aligned.vertices)
    error = np.where(((aligned.vertices - near.point) * near.normal).sum(1) < 0, -near.distance, near.distance)
    limit = float(f"{3 * np.sqrt(np.mean(error**2)):.1g}")
    scale = ColourScale("RdBu_r", -limit, limit)

    frame = scan.frames[FRAME]
    surface = IndexedMesh(aligned)
    T = scan.poses.T_world_camera[FRAME]
    view = OrthographicView(T[:3, 3] - surface.centre, T[:3, 1])
    plain, coloured = (render(surface, view, colours, SIZE, SIZE) for colours in (None, scale(error)))
    rows, columns = np.nonzero(frame.read_mask())
    crop = square(rows, columns, frame.read_mask().shape)
    coords = frame.read_coords()[crop]
    decoded = np.isfinite(coords).all(-1)
    bands = np.ones((*decoded.shape, 3))
    bands[decoded] = np.stack([coords[..., 0] % 128 / 128, coords[..., 1] % 128 / 128, 0 * coords[..., 0] + 0.5], -1)[
        decoded
    ]

    panels = [
        (captured(frame.read_image()[crop]), "captured"),
        (bands, "decoded: pattern x and y, modulo 128"),
        (plain, "surface"),
        (coloured, f"its error, up to {limit:g} {scan.units}"),
    ]
    figure, axes = plt.subplots(1, 4, figsize=(13.4, 3.6), dpi=120)
    for axis, (picture, title) in zip(axes, panels, strict=True):
        axis.imshow(picture, interpolation="nearest")
        axis.set_title(title, fontsize=11)
        axis.axis("off")
    bar = figure.colorbar(
        ScalarMappable(Normalize(-limit, limit), "RdBu_r"),
        ax=axes,
        fraction=0.012,
        pad=0.01,
    )
    bar.set_label(scan.units)
    target = Path(__file__).parent / "pictures" / "demo.png"
    figure.savefig(target, bbox_inches="tight")
    print(f"{target}: {target.stat().st_size // 1000} kB")


def captured(image: np.ndarray) -> np.ndarray:
    """A captured image as RGB in 0..1."""
    values = image.astype(np.float64) / np.iinfo(image.dtype).max
    return np.repeat(values[..., None], 3, -1) if values.ndim == 2 else values


def square(rows: np.ndarray, columns: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The smallest square around pixels, with a margin, cut to the image."""
    half = max(np.ptp(rows), np.ptp(columns)) // 2 + 8
    middle = [(a.min() + a.max()) // 2 for a in (rows, columns)]
    low, high = [max(m - half, 0) for m in middle], [min(m + half, n) for m, n in zip(middle, shape, strict=False)]
    return slice(low[0], high[0]), slice(low[1], high[1])


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "outputs/demo"))

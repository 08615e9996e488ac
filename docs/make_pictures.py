"""Draws the pictures of the documentation that are not plots of benchmarks.

.venv/bin/python docs/make_pictures.py architecture           # docs/pictures/architecture.png, from the code's imports
.venv/bin/python docs/make_pictures.py demo [outputs/demo]    # docs/pictures/demo.png, from the output of `make demo`
.venv/bin/python docs/make_pictures.py capture [captures]       # docs/pictures/capture.png, from sl-synth --images-only

Those of windows: docs/make_windows.py; of photographs with mistakes: docs/make_failures.py.
"""

import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

matplotlib.use("Agg")

import matplotlib.pyplot as plt

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.report.charts import ColourScale, OrthographicView, render
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import read_ground_truth, read_scan

ROOT = Path(__file__).parents[1]
PICTURES = ROOT / "docs" / "pictures"
INK, MUTED, PLAIN, NERFSTUDIO = "#1d2733", "#66727f", "#2563a8", "#c2571a"

# ------------------------------------------------------------------ the preview of sl-capture


def draw_capture(captures: Path) -> None:
    """The preview after four frames, at the fifth."""
    import cv2

    from sl_nerfstudio.capture.camera import compose, draw_map
    from sl_nerfstudio.capture.capture import picture_of
    from sl_nerfstudio.capture.selection import GridReader, Selection
    from sl_nerfstudio.cli.capture import view_lines
    from sl_nerfstudio.pattern.files import read_layout
    from sl_nerfstudio.pattern.grid import GridPattern
    from sl_nerfstudio.scan.images import read_image

    layout = read_layout(captures / "pattern.json")
    if not isinstance(layout, GridPattern):
        raise SystemExit(f"{captures} were not captured under a coded grid")
    reader = GridReader(layout)
    selection = Selection((reader.pattern.rows, reader.pattern.columns))
    images = [read_image(path) for path in sorted((captures / "images").iterdir())[:5]]
    for image in images[:4]:
        selection.add(reader.read(image))
    view = reader.read(images[4])
    lines = view_lines(view, selection.judge(view, 0.0), selection)
    picture = compose(picture_of(images[4], view), [draw_map(selection.times_seen)], lines)
    cv2.imwrite(str(PICTURES / "capture.png"), picture[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


# ------------------------------------------------------------------ the demo

FRAME = 4
SIZE = 460  # pixels of each of the four panels


def draw_demo(demo: Path) -> None:
    """One row: the captured image, its decoded coordinates, the surface, and the error of the surface."""
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
    save(figure, "demo.png")


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


# ------------------------------------------------------------------ the architecture


@dataclass(frozen=True)
class Folder:
    """A folder of the package, or a file directly in it."""

    name: str
    lines: int
    imports: Counter[str]  # number of import statements for each other folder
    uses_nerfstudio: bool


def layout() -> list[str]:
    """Names of the folders and files of the package, in the order of the layout in CONTRIBUTING.md."""
    text = (ROOT / "CONTRIBUTING.md").read_text()
    block = text[text.index("    sl_nerfstudio/\n") : text.index("    tests/ ")]
    return re.findall(r"^ {6}([a-z_]+)(?:/|\.py) ", block, re.MULTILINE)


def read_folder(name: str) -> Folder:
    """Lines and imports of one folder, from its source."""
    path = ROOT / "sl_nerfstudio" / name
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    lines, imports, uses_nerfstudio = 0, Counter[str](), False
    for file in files:
        source = file.read_text()
        lines += len(source.splitlines())
        for module in imported_modules(source):
            parts = module.split(".")
            uses_nerfstudio |= parts[0] == "nerfstudio"
            if parts[0] == "sl_nerfstudio" and len(parts) > 1 and parts[1] != name:
                imports[parts[1]] += 1
    return Folder(name, lines, imports, uses_nerfstudio)


def imported_modules(source: str) -> list[str]:
    """Names of all modules that a source text imports, anywhere in it."""
    found = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found += [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.append(node.module)
    return found


BOX, BAR = (2.3, 0.62), 2.2  # width and height of a folder's box, and length of the longest bar
STEP = 0.62  # from one column to the next
LINE = "#b9c2cc"


def draw_architecture() -> None:
    """Folders on a diagonal; from each, a line to the left and arrows up to the folders that it imports."""
    folders = [read_folder(name) for name in layout()]
    figure, axis = plt.subplots(figsize=(13.6, 11.0), dpi=110)
    column = {folder.name: index * STEP for index, folder in enumerate(folders)}
    row = {folder.name: float(index) for index, folder in enumerate(folders)}
    longest = max(folder.lines for folder in folders)
    for folder in folders:
        importers = {other.name: other.imports[folder.name] for other in folders if folder.name in other.imports}
        draw_folder(axis, folder, column[folder.name], row[folder.name], BAR * folder.lines / longest)
        if importers:
            draw_importers(axis, importers, column[folder.name], row[folder.name], column, row)
    right = max(column.values()) + BOX[0] + BAR + 0.5
    axis.set_xlim(-0.1, right)
    axis.set_ylim(len(folders) - 0.4, -0.7)
    axis.axis("off")
    legend(axis, right)
    save(figure, "architecture.png")


def draw_folder(axis: Axes, folder: Folder, x: float, y: float, bar: float) -> None:
    """A box with the name, and a bar whose length is the number of lines."""
    colour = NERFSTUDIO if folder.uses_nerfstudio else PLAIN
    width, height = BOX
    axis.add_patch(plt.Rectangle((x, y - height / 2), width, height, color=colour, zorder=3))
    axis.text(x + width / 2, y, folder.name, color="white", ha="center", va="center", fontsize=7.2, zorder=4)
    axis.add_patch(plt.Rectangle((x + width, y - height / 6), bar, height / 3, color=colour, alpha=0.35, zorder=3))
    axis.text(x + width + bar + 0.08, y, f"{folder.lines}", color=MUTED, va="center", fontsize=8, zorder=4)


def draw_importers(
    axis: Axes, importers: dict[str, int], x: float, y: float, column: dict[str, float], row: dict[str, float]
) -> None:
    """An arrow up to a folder at (x, y), and on it a dot for each importing folder, with a line to that folder."""
    x += BOX[0] / 5
    lowest = max(row[name] for name in importers)
    arrow = {"arrowstyle": "-|>", "color": LINE, "linewidth": 1.1, "shrinkA": 0, "shrinkB": 0}
    axis.annotate("", (x, y + BOX[1] / 2), (x, lowest), arrowprops=arrow, zorder=1)
    for name, count in importers.items():
        axis.plot([x, column[name]], [row[name]] * 2, color=LINE, linewidth=1.1, zorder=1)
        axis.plot([x], [row[name]], "o", color=INK, markersize=2.5 + 1.1 * np.sqrt(count), zorder=2)


def legend(axis: Axes, right: float) -> None:
    """How to read the picture, in its empty corner."""
    lines: Sequence[tuple[str, str]] = (
        ("Each folder imports only from folders above it.", INK),
        ("Dot: the folder at the right end of the row imports the folder at the top of the column.", INK),
        ("The larger the dot, the more import statements.", INK),
        ("Bar and number: lines of code.", MUTED),
        ("Orange: imports nerfstudio.", NERFSTUDIO),
    )
    for index, (text, colour) in enumerate(lines):
        axis.text(right, 0.1 + 0.8 * index, text, color=colour, ha="right", va="center", fontsize=9.5)


def save(figure: plt.Figure, name: str) -> None:
    """Write a picture, and print its size."""
    figure.savefig(PICTURES / name, bbox_inches="tight")
    print(f"{PICTURES / name}: {(PICTURES / name).stat().st_size // 1000} kB")


def main(arguments: Sequence[str]) -> None:
    """Draw the picture that the first argument names."""
    if arguments[:1] == ["architecture"]:
        draw_architecture()
    elif arguments[:1] == ["capture"]:
        draw_capture(Path(arguments[1] if len(arguments) > 1 else "outputs/demo-images/captures"))
    elif arguments[:1] == ["demo"]:
        draw_demo(Path(arguments[1] if len(arguments) > 1 else "outputs/demo"))
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main(sys.argv[1:])

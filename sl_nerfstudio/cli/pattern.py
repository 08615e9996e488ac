"""sl-pattern: write a pattern to project or to print, and its description."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from numpy import ndarray

    from sl_nerfstudio.files.new_folder import NewFolder
    from sl_nerfstudio.pattern.layout import PatternLayout

_SUPERSAMPLING = 4  # of pattern.png
_GRID_FLAGS = ("period", "line_width", "gap")


@dataclass(frozen=True)
class Arguments:
    """Write pattern.png, to project or to print, and pattern.json, which sl-process needs to decode captures.

    Lengths are in pattern pixels. For Gray code, all images of the sequence are written to sequence/.
    """

    output: Path
    """folder to write; it must be new or empty"""
    kind: Literal["grid", "gray-code"] = "grid"
    """grid: one static pattern, for devices moved by hand; gray-code: a sequence, for devices that stand still while
    each frame is captured"""
    preset: Literal["800x800", "1280x720", "doe"] = "800x800"
    """size and period for a square projector, a 16:9 projector, or a diffractive element"""
    width: int | None = None
    """width of the pattern; default: the preset's"""
    height: int | None = None
    """height of the pattern; default: the preset's"""
    period: float | None = None
    """distance between neighbouring grid lines; default: the preset's"""
    line_width: float | None = None
    """width of the lines; default: a fifth of the period"""
    gap: float | None = None
    """how far line segments are shifted against each other at a crossing; default: three tenths of the period"""
    seed: int = 0
    """selects one of the possible code arrays"""
    cell: int = 2
    """side of the squares that Gray code numbers"""
    print_width: float | None = None
    """width on paper or slide in millimetres; it is stored in pattern.png for printing programs"""


def main() -> None:
    """Entry point of the command."""
    run(_write)


def _write() -> None:
    arguments = tyro.cli(Arguments, prog="sl-pattern")
    if arguments.seed < 0:
        raise UserError(f"--seed {arguments.seed}: seeds are at least 0")
    if arguments.print_width is not None and not arguments.print_width > 0:
        raise UserError(f"--print-width {arguments.print_width:g}: give a width in millimetres above 0")
    from sl_nerfstudio.files.new_folder import NewFolder

    with NewFolder(arguments.output) as folder:
        said = _write_grid(arguments, folder) if arguments.kind == "grid" else _write_gray_code(arguments, folder)
    print(said)


def _write_grid(arguments: Arguments, folder: "NewFolder") -> str:
    import numpy as np

    from sl_nerfstudio.pattern.codes import hamming_margin
    from sl_nerfstudio.pattern.presets import make_grid

    grid = make_grid(
        arguments.preset, arguments.width, arguments.height, arguments.period, arguments.line_width, arguments.gap,
        arguments.seed,
    )  # fmt: skip
    _write_layout(arguments, grid, folder)
    codes = np.asarray(grid.codes)
    return (
        f"wrote a grid of {grid.columns} x {grid.rows} nodes to {arguments.output}: 3 x 3 windows differ in at least "
        f"{hamming_margin(codes, False)} of 9 symbols, in {hamming_margin(codes, True)} where the camera may roll"
    )


def _write_gray_code(arguments: Arguments, folder: "NewFolder") -> str:
    from sl_nerfstudio.pattern.graycode import GrayCode
    from sl_nerfstudio.pattern.presets import PRESETS

    for field in _GRID_FLAGS:
        if getattr(arguments, field) is not None:
            raise UserError(f"--{field.replace('_', '-')}: Gray code has none; set its squares with --cell")
    w, h, _ = PRESETS[arguments.preset]
    try:
        layout = GrayCode(arguments.width or w, arguments.height or h, arguments.cell)
    except ValueError as error:
        raise UserError(f"--width, --height, --cell: {error}") from error
    for index, image in enumerate(layout.sequence()):
        folder.write(f"sequence/{index:02d}.png", _image_file(arguments, image))
    _write_layout(arguments, layout, folder)
    return (
        f"wrote a Gray-code sequence of {layout.images} images to {arguments.output}: show them in the order of their "
        "names"
    )


def _write_layout(arguments: Arguments, layout: "PatternLayout", folder: "NewFolder") -> None:
    """pattern.png and pattern.json."""
    import numpy as np

    picture = np.rint(255 * layout.render(_SUPERSAMPLING)).astype(np.uint8)
    folder.write("pattern.png", _image_file(arguments, picture))
    folder.write("pattern.json", layout.encode(), last=True)


def _image_file(arguments: Arguments, image: "ndarray") -> bytes:
    """A PNG file that says how wide to print it."""
    import io

    from PIL import Image

    buffer = io.BytesIO()
    per_inch = None if arguments.print_width is None else image.shape[1] / arguments.print_width * 25.4
    Image.fromarray(image).save(buffer, "PNG", **({} if per_inch is None else {"dpi": (per_inch, per_inch)}))
    return buffer.getvalue()


if __name__ == "__main__":
    main()

"""pattern.json: the description of a pattern, which travels with it so that a decoder knows the codes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.codes import SYMBOL_NAMES, SYMBOLS, WINDOW, hamming_margin
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.scan.images import as_grey, read_image

FORMAT = 1
_LENGTHS = ("period", "line_width", "gap", "dark")


def grid_document(grid: GridPattern, image: str = "pattern.png") -> dict[str, Any]:
    """A grid as a JSON document; `image` is the file, beside the document, that shows it."""
    codes = np.asarray(grid.codes)
    return {
        "sl_pattern": FORMAT,
        "kind": "grid",
        "image": image,
        **{key: getattr(grid, key) for key in ("w", "h", *_LENGTHS, "seed")},
        "x0": grid.x0,
        "y0": grid.y0,
        "rows": grid.rows,
        "columns": grid.columns,
        "symbols": list(SYMBOL_NAMES),
        "window": WINDOW,
        "hamming_margin": hamming_margin(codes, rotations=False),
        "hamming_margin_turned": hamming_margin(codes, rotations=True),
        "codes": codes.tolist(),
    }


def encode_grid(grid: GridPattern, image: str = "pattern.png") -> bytes:
    """The text of pattern.json: one row of the code array a line."""
    document = grid_document(grid, image)
    codes = document.pop("codes")
    head = json.dumps(document, indent=1)[:-2]
    rows = ",\n  ".join(json.dumps(row, separators=(",", ":")) for row in codes)
    return f'{head},\n "codes": [\n  {rows}\n ]\n}}\n'.encode()


def read_grid(path: Path) -> GridPattern:
    """The grid that a pattern.json describes. Raises UserError naming file and field."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as a pattern description: {error}") from error
    if not isinstance(document, dict) or document.get("kind") != "grid":
        raise UserError(
            f'{path}: "kind" is not "grid", so this is no description of a coded grid; '
            "give the pattern.json that sl-synth wrote"
        )
    if document.get("sl_pattern") != FORMAT:
        raise UserError(f"{path}: sl_pattern is {document.get('sl_pattern')!r}, this version reads {FORMAT}")
    try:
        numbers = {key: float(document[key]) for key in _LENGTHS}
        w, h, seed = (int(document[key]) for key in ("w", "h", "seed"))
        codes = np.array(document["codes"], dtype=np.int64)
        if codes.min(initial=0) < 0 or codes.max(initial=0) >= SYMBOLS:
            raise ValueError(f"codes must be 0 to {SYMBOLS - 1}")
        return GridPattern(w=w, h=h, seed=seed, codes=codes.astype(np.int8), **numbers)
    except KeyError as error:
        raise UserError(f"{path}: {error.args[0]} is missing; write the file again with sl-synth") from error
    except (TypeError, ValueError, IndexError) as error:
        raise UserError(f"{path}: the description contradicts itself: {error}") from error


def read_pattern(path: Path) -> tuple[Float32[ndarray, "h w"], GridPattern | None]:
    """A pattern in [0, 1] from pattern.json or from any image; the grid is None for a plain image.

    Raises UserError if the file cannot be read.
    """
    if path.suffix.lower() == ".json":
        grid = read_grid(path)
        return grid.render(), grid
    return as_grey(read_image(path)), None

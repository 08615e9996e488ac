"""pattern.json: the description of a pattern, which travels with it so that a decoder knows the codes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.codes import SYMBOL_NAMES, SYMBOLS, WINDOW, hamming_margin
from sl_nerfstudio.pattern.graycode import GrayCode
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


def encode_gray_code(layout: GrayCode, image: str = "pattern.png") -> bytes:
    """The text of the pattern.json of a Gray-code sequence; `image` shows its finest stripes."""
    names = ["white", "black"]
    for axis, bits in zip("xy", layout.bits, strict=True):
        names += [f"{axis} bit {bits - 1 - k}{inverse}" for k in range(bits) for inverse in ("", " inverse")]
    document = {
        "sl_pattern": FORMAT,
        "kind": "gray-code",
        "image": image,
        "w": layout.w,
        "h": layout.h,
        "cell": layout.cell,
        "sequence": names,
    }
    return (json.dumps(document, indent=1) + "\n").encode()


def read_layout(path: Path) -> GridPattern | GrayCode:
    """What a pattern.json describes, a coded grid or a Gray-code sequence. Raises UserError naming file and field."""
    document = _read_document(path)
    return _grid(path, document) if document["kind"] == "grid" else _gray_code(path, document)


def read_grid(path: Path) -> GridPattern:
    """The grid that a pattern.json describes. Raises UserError naming file and field."""
    layout = read_layout(path)
    if isinstance(layout, GrayCode):
        raise UserError(f"{path}: describes a Gray-code sequence, where a coded grid is needed")
    return layout


def read_pattern(path: Path) -> tuple[Float32[ndarray, "h w"], GridPattern | None]:
    """A pattern in [0, 1] from pattern.json or from any image; the grid is None for a plain image or Gray code.

    Raises UserError if the file cannot be read.
    """
    if path.suffix.lower() == ".json":
        layout = read_layout(path)
        return (layout.finest(), None) if isinstance(layout, GrayCode) else (layout.render(), layout)
    return as_grey(read_image(path)), None


def _read_document(path: Path) -> dict[str, Any]:
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read as a pattern description: {error}") from error
    if not isinstance(document, dict) or document.get("kind") not in ("grid", "gray-code"):
        raise UserError(
            f'{path}: "kind" is neither "grid" nor "gray-code", so this describes no pattern; '
            "give the pattern.json that sl-pattern or sl-synth wrote"
        )
    if document.get("sl_pattern") != FORMAT:
        raise UserError(f"{path}: sl_pattern is {document.get('sl_pattern')!r}, this version reads {FORMAT}")
    return document


def _grid(path: Path, document: dict[str, Any]) -> GridPattern:
    try:
        numbers = {key: float(document[key]) for key in _LENGTHS}
        w, h, seed = (int(document[key]) for key in ("w", "h", "seed"))
        codes = np.array(document["codes"], dtype=np.int64)
        if codes.min(initial=0) < 0 or codes.max(initial=0) >= SYMBOLS:
            raise ValueError(f"codes must be 0 to {SYMBOLS - 1}")
        return GridPattern(w=w, h=h, seed=seed, codes=codes.astype(np.int8), **numbers)
    except KeyError as error:
        raise _missing(path, error) from error
    except (TypeError, ValueError, IndexError) as error:
        raise _contradiction(path, error) from error


def _gray_code(path: Path, document: dict[str, Any]) -> GrayCode:
    try:
        return GrayCode(*(int(document[key]) for key in ("w", "h", "cell")))
    except KeyError as error:
        raise _missing(path, error) from error
    except (TypeError, ValueError) as error:
        raise _contradiction(path, error) from error


def _missing(path: Path, error: KeyError) -> UserError:
    return UserError(f"{path}: {error.args[0]} is missing; write the file again with sl-pattern")


def _contradiction(path: Path, error: Exception) -> UserError:
    return UserError(f"{path}: the description contradicts itself: {error}")

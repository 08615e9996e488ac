"""pattern.json: the description of a pattern, kept beside its picture so that a decoder knows the codes."""

from pathlib import Path
from typing import Any

from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.grid import GridPattern
from sl_nerfstudio.pattern.layout import FORMAT, PatternLayout
from sl_nerfstudio.scan.document import document_faults, read_document
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.images import as_grey, read_image
from sl_nerfstudio.scan.photographs import ENDINGS
from sl_nerfstudio.scan.problem import Faults

LAYOUTS: dict[str, type[PatternLayout]] = {
    GridPattern.kind: GridPattern,
    GrayCode.kind: GrayCode,
}
"""Every kind of pattern that pattern.json can describe."""


def read_layout(path: Path) -> PatternLayout:
    """The pattern that a pattern.json describes, which must be what sl-pattern makes of its own parameters.

    Raises UserError that names file and field.
    """
    document = _read_document(path)
    try:
        return LAYOUTS[document["kind"]].from_document(document)
    except KeyError as error:
        raise UserError(f"{path}: {error.args[0]} is missing; write the file again with sl-pattern") from error
    except (TypeError, ValueError, IndexError) as error:
        raise UserError(f"{path}: the description contradicts itself: {error}") from error


def read_pattern(path: Path) -> tuple[Float32[ndarray, "h w"], PatternLayout | None]:
    """A pattern in [0, 1] from pattern.json or from any image; a plain image has no layout.

    Raises UserError if the file cannot be read.
    """
    if path.suffix.lower() == ".json":
        layout = read_layout(path)
        return layout.render(), layout
    return as_grey(read_image(path)), None


def _read_document(path: Path) -> dict[str, Any]:
    if path.suffix.lower() in ENDINGS:
        raise FileError(
            path,
            "is a picture; the codes of a pattern are in its pattern.json",
            "the picture of the pattern was given instead of its description",
            "give the pattern.json that sl-pattern or sl-synth wrote beside it",
        )
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.field}: {fault.problem}", fault.cause, "write the file again with sl-pattern")
    if document.get("kind") not in tuple(LAYOUTS):
        known = ", ".join(f'"{kind}"' for kind in LAYOUTS)
        raise UserError(
            f'{path}: this describes no pattern: "kind" must be one of {known}; '
            "give the pattern.json that sl-pattern or sl-synth wrote"
        )
    if document.get("sl_pattern") != FORMAT:
        found = f"is {document['sl_pattern']!r}" if "sl_pattern" in document else "is missing"
        raise UserError(
            f"{path}: sl_pattern, the version of the file's format, {found}; this version reads {FORMAT}\n"
            f'    remedy: write the file again with sl-pattern; in one written by hand, add "sl_pattern": {FORMAT}'
        )
    return document

"""Names with their values, from the calibration files of other programs.

OpenCV's XML and YAML, MATLAB scripts that assign numbers (the camera calibration toolbox, scan3d-capture, SLStudio),
and SLStudio's .slcalib. All are read here: OpenCV's parser crashes on some damaged files. Depth and size are limited.
"""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.scan.document import FileError, read_bytes

MAX_BYTES = 512 << 10  # a calibration with all of its image points is smaller
MAX_DEPTH = 16
_XML_ROOT = "opencv_storage"
_ELEMENT_TYPE = re.compile(r"[1-9]?[ucswifdh]")  # channels, then the type of the numbers
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_NOT_FINITE = {".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf}


class _NotStoredError(UserError):
    """Text that is no such file; the message says why."""


def read_stored_values(path: Path) -> dict[str, Any]:
    """The top level of a file: matrices as arrays, numbers, texts, lists, objects. Raises FileError."""
    read, kind, again = _READERS[path.suffix.lower()]
    content = read_bytes(path)
    try:
        if len(content) > MAX_BYTES:
            raise _NotStoredError(f"it has {len(content)} bytes, far more than a calibration")
        return read(content)
    except (_NotStoredError, ElementTree.ParseError, yaml.YAMLError, UnicodeError, ValueError) as error:
        raise FileError(
            path,
            f"cannot be read as {kind} ({first_line(error)})",
            "it is damaged, or was written by another program",
            f"write it again with {again}, or give plain JSON",
        ) from error


def _storage(tree: Any) -> dict[str, Any]:
    if not isinstance(tree, dict):
        raise _NotStoredError("it holds no names with values")
    return {str(key): _value(item) for key, item in tree.items()}


def _xml_tree(content: bytes) -> Any:
    if b"<!DOCTYPE" in content or b"\0" in content:  # zeros: UTF-16, in which a DOCTYPE would not be found
        raise _NotStoredError("it has a document type or is not UTF-8")
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    depth = 0
    root: ElementTree.Element | None = None
    for place in range(0, len(content), 4096):
        parser.feed(content[place : place + 4096])
        for event, element in parser.read_events():
            depth += 1 if event == "start" else -1
            root = element if root is None else root
            if depth > MAX_DEPTH:
                raise _NotStoredError("it is nested too deeply")
    parser.close()
    if root is None or root.tag != _XML_ROOT:
        raise _NotStoredError(f"its first element is not {_XML_ROOT}")
    return _xml_value(root)


def _xml_value(element: ElementTree.Element) -> Any:
    inner = list(element)
    if not inner:
        text = (element.text or "").strip()
        words = text.split()
        return words if len(words) > 1 and all(_number(word) is not None for word in words) else text.strip('"')
    if all(child.tag == "_" for child in inner):
        return [_xml_value(child) for child in inner]
    if len({child.tag for child in inner}) != len(inner):
        raise _NotStoredError(f"a name occurs more than once in {element.tag}")
    return {child.tag: _xml_value(child) for child in inner}


def _yaml_tree(content: bytes) -> Any:
    text = content.decode("utf-8-sig")
    head, _, rest = text.partition("\n")
    if not head.startswith("%YAML"):
        raise _NotStoredError("it does not start with %YAML")
    loader = _StorageLoader(rest)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


class _StorageLoader(yaml.BaseLoader):
    """YAML with texts for all numbers; tags such as !!opencv-matrix are not interpreted, aliases not allowed."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise _NotStoredError("it refers to an earlier part of itself")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _NotStoredError("it is nested too deeply")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found = super().construct_mapping(node, deep)
        if len(found) != len(node.value):
            raise _NotStoredError("a name occurs more than once")
        return found


def _value(item: Any) -> Any:
    """A matrix as an array; everything else as it is, with numbers for texts that are numbers."""
    if isinstance(item, dict):
        return _matrix(item) if {"rows", "cols", "data"} <= set(item) else item
    if isinstance(item, list):
        return [_value(inner) for inner in item]
    number = _number(item)
    return item if number is None else number


def _matrix(item: dict[Any, Any]) -> Float64[ndarray, "rows columns"]:
    rows, columns = (_count(item[key]) for key in ("rows", "cols"))
    kind = str(item.get("dt", "d")).strip('"')
    if _ELEMENT_TYPE.fullmatch(kind) is None:
        raise _NotStoredError(f"dt is {kind[:20]!r}")
    channels = int(kind[:-1] or 1)
    data = item["data"] if isinstance(item["data"], list) else [item["data"]]
    numbers = [None if isinstance(word, list | dict) else _number(word) for word in data if word != ""]
    found = [number for number in numbers if number is not None]
    if len(found) != len(numbers):
        raise _NotStoredError("a matrix holds something that is not a number")
    if len(found) != rows * columns * channels:
        raise _NotStoredError(f"a matrix of {rows} x {columns} has {len(found)} numbers")
    return np.array(found, dtype=np.float64).reshape(rows, columns * channels)


def _count(word: Any) -> int:
    if not isinstance(word, str) or not re.fullmatch("[0-9]{1,6}", word):
        raise _NotStoredError("the size of a matrix is not a whole number")
    return int(word)


def _number(word: str) -> float | None:
    """The number that a text is, None if it is none."""
    if word.lower() in _NOT_FINITE:
        return _NOT_FINITE[word.lower()]
    return float(word) if _NUMBER.fullmatch(word) else None


# MATLAB scripts, and SLStudio's .slcalib: numbers after names.

_ASSIGNED = re.compile(r"^[ \t]*([A-Za-z]\w*)[ \t]*=[ \t]*(?:\[([^\]]*)\]|([-+.\w]+))", re.MULTILINE)


def _matlab_values(content: bytes) -> dict[str, Any]:
    """Every matrix and number that a script assigns; `fc`, `cc` and `alpha_c` of the toolbox become a matrix `K`."""
    text = re.sub(r"%[^\n]*", "", content.decode("utf-8-sig"))
    found: dict[str, Any] = {}
    for name, inside, number in _ASSIGNED.findall(text):
        rows = [row.replace(",", " ").split() for row in re.split(r"[;\n]", inside or number)]
        value = _rows(name, [row for row in rows if row])
        found[name] = float(value[0, 0]) if number else value
    for of_device in ("", "_left", "_right"):
        focal, centre, skew = (found.get(f"{key}{of_device}") for key in ("fc", "cc", "alpha_c"))
        if isinstance(focal, ndarray) and isinstance(centre, ndarray) and focal.size == centre.size == 2:
            (fx, fy), (cx, cy) = focal.ravel(), centre.ravel()
            bent = 0.0 if skew is None else float(np.ravel(skew)[0])
            found[f"K{of_device}"] = np.array([[fx, bent * fx, cx], [0, fy, cy], [0, 0, 1]])
    return _any(found)


def _slcalib_values(content: bytes) -> dict[str, Any]:
    """A name on a line of its own, then the rows of its matrix."""
    rows: dict[str, list[list[str]]] = {}
    name = ""
    for line in content.decode("utf-8-sig").splitlines():
        words = line.split()
        if not words or line.startswith("#"):
            name = ""
        elif len(words) == 1 and re.fullmatch(r"[A-Za-z]\w*", words[0]):
            name = words[0]
        elif name:
            rows.setdefault(name, []).append(words)
    return _any({name: _rows(name, words) for name, words in rows.items()})


def _any(found: dict[str, Any]) -> dict[str, Any]:
    if not found:
        raise _NotStoredError("it holds no names with numbers")
    return found


def _rows(name: str, rows: list[list[str]]) -> Float64[ndarray, "rows columns"]:
    numbers = [[_number(word) for word in row] for row in rows]
    if not numbers or len({len(row) for row in numbers}) != 1 or any(n is None for row in numbers for n in row):
        raise _NotStoredError(f"{name[:20]} is no matrix of numbers")
    return np.array(numbers, dtype=np.float64)


_Reader = Callable[[bytes], dict[str, Any]]
_YAML: tuple[_Reader, str, str] = (
    lambda content: _storage(_yaml_tree(content)),
    "an OpenCV file",
    "cv2.FileStorage (OpenCV's YAML starts with %YAML:1.0)",
)
_READERS: dict[str, tuple[_Reader, str, str]] = {
    ".yml": _YAML,
    ".yaml": _YAML,
    ".xml": (lambda content: _storage(_xml_tree(content)), "an OpenCV file", "cv2.FileStorage"),
    ".m": (_matlab_values, "a MATLAB script that assigns numbers", "the program that wrote it"),
    ".slcalib": (_slcalib_values, "SLStudio's calibration", "SLStudio"),
}
STORED = tuple(_READERS)
"""Endings of the files that `read_stored_values` reads."""

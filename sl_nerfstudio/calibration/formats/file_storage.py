"""OpenCV's files, XML and YAML, read without OpenCV: its parser crashes on some damaged files.

Both become the same tree of objects, lists and texts. Depth and size are limited.
"""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.scan.file_error import FileError, read_bytes

MAX_BYTES = 512 << 10  # a calibration with all of its image points is smaller
MAX_DEPTH = 16
_XML_ROOT = "opencv_storage"
_ELEMENT_TYPE = re.compile(r"[1-9]?[ucswifdh]")  # channels, then the type of the numbers
_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_NOT_FINITE = {".nan": np.nan, ".inf": np.inf, "+.inf": np.inf, "-.inf": -np.inf}


class _NotAStorageError(UserError):
    """Text that is no OpenCV file; the message says why."""


def read_file_storage(path: Path) -> dict[str, Any]:
    """The top level of an OpenCV file: matrices as arrays, numbers, texts, lists, objects. Raises FileError."""
    content = read_bytes(path)
    try:
        if len(content) > MAX_BYTES:
            raise _NotAStorageError(f"it has {len(content)} bytes, far more than a calibration")
        tree = _xml_tree(content) if path.suffix.lower() == ".xml" else _yaml_tree(content)
        if not isinstance(tree, dict):
            raise _NotAStorageError("it holds no names with values")
        return {str(key): _value(item) for key, item in tree.items()}
    except (_NotAStorageError, ElementTree.ParseError, yaml.YAMLError, UnicodeError, ValueError) as error:
        raise FileError(
            path,
            f"cannot be read as an OpenCV file ({first_line(error)})",
            "it is damaged, or was written by another program (OpenCV's YAML starts with %YAML:1.0)",
            "write it again with cv2.FileStorage, or give plain JSON",
        ) from error


def _xml_tree(content: bytes) -> Any:
    if b"<!DOCTYPE" in content or b"\0" in content:  # zeros: UTF-16, in which a DOCTYPE would not be found
        raise _NotAStorageError("it has a document type or is not UTF-8")
    parser: Any = ElementTree.XMLPullParser(("start", "end"))
    depth = 0
    root: ElementTree.Element | None = None
    for place in range(0, len(content), 4096):
        parser.feed(content[place : place + 4096])
        for event, element in parser.read_events():
            depth += 1 if event == "start" else -1
            root = element if root is None else root
            if depth > MAX_DEPTH:
                raise _NotAStorageError("it is nested too deeply")
    parser.close()
    if root is None or root.tag != _XML_ROOT:
        raise _NotAStorageError(f"its first element is not {_XML_ROOT}")
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
        raise _NotAStorageError(f"a name occurs more than once in {element.tag}")
    return {child.tag: _xml_value(child) for child in inner}


def _yaml_tree(content: bytes) -> Any:
    text = content.decode("utf-8-sig")
    head, _, rest = text.partition("\n")
    if not head.startswith("%YAML"):
        raise _NotAStorageError("it does not start with %YAML")
    loader = _Loader(rest)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


class _Loader(yaml.BaseLoader):
    """YAML with texts for all numbers; tags such as !!opencv-matrix are not interpreted, aliases not allowed."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise _NotAStorageError("it refers to an earlier part of itself")
        self._depth += 1
        if self._depth > MAX_DEPTH:
            raise _NotAStorageError("it is nested too deeply")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        found = super().construct_mapping(node, deep)
        if len(found) != len(node.value):
            raise _NotAStorageError("a name occurs more than once")
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
        raise _NotAStorageError(f"dt is {kind[:20]!r}")
    channels = int(kind[:-1] or 1)
    data = item["data"] if isinstance(item["data"], list) else [item["data"]]
    numbers = [None if isinstance(word, list | dict) else _number(word) for word in data if word != ""]
    found = [number for number in numbers if number is not None]
    if len(found) != len(numbers):
        raise _NotAStorageError("a matrix holds something that is not a number")
    if len(found) != rows * columns * channels:
        raise _NotAStorageError(f"a matrix of {rows} x {columns} has {len(found)} numbers")
    return np.array(found, dtype=np.float64).reshape(rows, columns * channels)


def _count(word: Any) -> int:
    if not isinstance(word, str) or not re.fullmatch("[0-9]{1,6}", word):
        raise _NotAStorageError("the size of a matrix is not a whole number")
    return int(word)


def _number(word: str) -> float | None:
    """The number that a text is, None if it is none."""
    if word.lower() in _NOT_FINITE:
        return _NOT_FINITE[word.lower()]
    return float(word) if _NUMBER.fullmatch(word) else None

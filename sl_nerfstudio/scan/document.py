"""transforms.json as text: strict JSON, UTF-8, every key once, every number finite."""

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from sl_nerfstudio.scan.file_error import FileError, read_bytes
from sl_nerfstudio.scan.problem import Faults, Problem

TRANSFORMS = "transforms.json"
MAX_BYTES = 256 << 20
MAX_DEPTH = 32  # of lists and objects in each other; a scan has 6, and what walks a document may recurse this far
_TOO_DEEP = Problem("is nested too deeply", "it does not describe a scan", "write the file again")
_BOM = b"\xef\xbb\xbf"


class Record(dict[str, Any]):
    """A JSON object that remembers which of its keys occurred more than once."""

    duplicates: tuple[str, ...] = ()


def read_document(path: Path) -> Record:
    """The object in a JSON file. Raises FileError if the file is missing or does not hold one JSON object.

    Numbers may be NaN or infinite and keys may have occurred twice: `document_faults` lists those.
    """
    content = read_bytes(path)
    if len(content) > MAX_BYTES:
        raise FileError(path, f"is {len(content) >> 20} MiB large", "it does not describe a scan", "correct the path")
    if content.startswith(_BOM):
        raise FileError(
            path,
            "starts with a byte-order mark",
            "an editor saved it as 'UTF-8 with BOM'",
            "save it as UTF-8 without BOM",
        )
    try:
        document = json.loads(content.decode("utf-8"), object_pairs_hook=_record)
    except UnicodeDecodeError as error:
        raise FileError(
            path,
            f"is not UTF-8 (byte {error.start})",
            "it was saved in another encoding, such as Latin-1 or UTF-16",
            "save it as UTF-8",
        ) from error
    except RecursionError as error:
        raise FileError(path, _TOO_DEEP.problem, _TOO_DEEP.cause, _TOO_DEEP.remedy) from error
    except json.JSONDecodeError as error:
        raise _syntax_error(path, content, error) from error
    except ValueError as error:  # a number with thousands of digits
        raise FileError(path, f"is not valid JSON ({error})", "a damaged number", "write the file again") from error
    if _deeper_than(document, MAX_DEPTH):
        raise FileError(path, _TOO_DEEP.problem, _TOO_DEEP.cause, _TOO_DEEP.remedy)
    if not isinstance(document, Record):
        raise FileError(
            path,
            f"holds {_name(document)} instead of an object",
            "it is another kind of JSON file",
            "a scan's transforms.json starts with { and has the keys of docs/scan-format.md",
        )
    return document


def document_faults(document: Record, file: str, faults: Faults) -> None:
    """Add every key given twice and every number that is not finite, wherever they are."""
    for frame, key, problem in _walk(document, None, ""):
        faults.add(problem, file, frame, key or None)


def frame_label(record: Any, index: int) -> str:
    """How a frame is named in messages: the stem of its image, else its number counted from 0."""
    path = record.get("file_path") if isinstance(record, dict) else None
    stem = Path(path).stem if isinstance(path, str) else ""
    return stem or f"#{index}"


def _record(pairs: list[tuple[str, Any]]) -> Record:
    record = Record(pairs)
    if len(record) != len(pairs):
        count = Counter(key for key, _ in pairs)
        record.duplicates = tuple(key for key in record if count[key] > 1)
    return record


def _deeper_than(document: Any, limit: int) -> bool:
    """Whether lists and objects are nested more than `limit` times; level by level, without recursion."""
    level = [document]
    for _ in range(limit):
        level = [item for outer in level if isinstance(outer, dict | list) for item in _inside(outer)]
    return any(isinstance(item, dict | list) for item in level)


def _inside(outer: dict[str, Any] | list[Any]) -> Iterable[Any]:
    return outer.values() if isinstance(outer, dict) else outer


def _syntax_error(path: Path, content: bytes, error: json.JSONDecodeError) -> FileError:
    problem = f"is not valid JSON ({error.msg} in line {error.lineno}, column {error.colno})"
    rest = content.decode("utf-8")[error.pos :].strip()
    if not content.strip():
        return FileError(path, "is empty (white space only)", "writing it was interrupted", "write it again")
    if not rest or error.msg.startswith("Unterminated string"):
        return FileError(
            path, problem, "the file is truncated: writing or copying it was interrupted", "write or copy it again"
        )
    return FileError(
        path, problem, "a mistake in editing: a missing or trailing comma, quote or bracket", "correct that line"
    )


def _walk(value: Any, frame: str | None, key: str) -> Iterator[tuple[str | None, str, Problem]]:
    if isinstance(value, Record):
        for twice in value.duplicates:
            yield (
                frame,
                f"{key}.{twice}".lstrip("."),
                Problem("occurs more than once", "a mistake when files were edited or merged", "keep the right one"),
            )
        for name, item in value.items():
            if not key and frame is None and name == "frames" and isinstance(item, list):
                for index, record in enumerate(item):
                    yield from _walk(record, frame_label(record, index), "")
            else:
                yield from _walk(item, frame, f"{key}.{name}".lstrip("."))
    elif isinstance(value, list):
        bad = [number for number in _numbers(value) if not math.isfinite(number)]
        if bad:
            yield frame, key, _not_finite(bad[0])
        elif any(isinstance(item, dict) for item in value):
            for index, item in enumerate(value):
                yield from _walk(item, frame, f"{key}[{index}]")
    elif isinstance(value, float) and not math.isfinite(value):
        yield frame, key, _not_finite(value)


def _numbers(value: list[Any]) -> Iterator[float]:
    for item in value:
        if isinstance(item, list):
            yield from _numbers(item)
        elif isinstance(item, float):
            yield item


def _not_finite(number: float) -> Problem:
    return Problem(
        f"holds {number}, which is not a number",
        "registration or calibration failed here and its result was written anyway",
        "calibrate again, or leave the frame out",
    )


def _name(value: Any) -> str:
    kinds = {list: "a list", str: "a text", bool: "true or false", type(None): "null"}
    return kinds.get(type(value), "a number")

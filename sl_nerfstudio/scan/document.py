"""Files, problems and transforms.json: opening them, collecting what is wrong, reading keys of the right type."""

import json
import math
import os
import stat
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path, PureWindowsPath
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import Fault, UserError

# The error for a file that cannot be used, and the functions that open files and raise it.

MAX_FILE_BYTES = 4 << 30  # far larger than any image or coordinate file of a scan


class FileError(UserError):
    """A file that cannot be used; problem, likely cause and remedy are separate, so that a check can list them."""

    def __init__(self, path: Path, problem: str, cause: str, remedy: str) -> None:
        """All in plain words; `problem` continues a sentence that starts with the file's name."""
        super().__init__(f"{path}: {problem}\n    cause:  {cause}\n    remedy: {remedy}")
        self.path, self.problem, self.cause, self.remedy = path, problem, cause, remedy

    def with_more(self, words: str) -> "FileError":
        """The same error, whose problem goes on with some words."""
        return FileError(self.path, self.problem + words, self.cause, self.remedy)


def check_file(path: Path) -> int:
    """Size in bytes of a regular file that is not empty. Raises FileError for anything else."""
    try:
        status = os.stat(path)
    except FileNotFoundError as error:
        raise FileError(
            path, "is missing", "it was moved, renamed or never written, or its name differs in upper and lower case",
            "restore it or correct the path",
        ) from error  # fmt: skip
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be opened ({error})", "a broken link or path", "correct the path") from error
    if not stat.S_ISREG(status.st_mode):
        raise FileError(path, "is not a file", "there is a folder, a device or a pipe", "correct the path")
    if status.st_size == 0:
        raise FileError(
            path,
            "is empty (0 bytes)",
            "writing it was interrupted, for example by a full disk",
            "copy or export this file again",
        )
    if status.st_size > MAX_FILE_BYTES:
        raise FileError(
            path,
            f"is {status.st_size >> 30} GiB large",
            "it is not a file of a scan",
            "correct the path or write the file again",
        )
    return status.st_size


def read_bytes(path: Path) -> bytes:
    """The whole file. Raises FileError if it is missing, empty, not a regular file or not readable."""
    check_file(path)
    try:
        return path.read_bytes()
    except OSError as error:
        raise unreadable(path, error) from error


def unreadable(path: Path, error: OSError) -> FileError:
    """The FileError for a file that exists but cannot be opened."""
    return FileError(
        path,
        f"cannot be read ({error.strerror})",
        "missing permissions or a failing disk",
        "change its permissions, or copy it from a backup",
    )


# What is wrong with a value, and the collection of everything that is wrong with a folder.


@dataclass(frozen=True)
class Problem:
    """What is wrong, the likely cause and the remedy; the caller knows the place."""

    problem: str
    cause: str
    remedy: str


@dataclass
class Faults:
    """Collects the faults of one folder."""

    found: list[Fault] = field(default_factory=list)
    _known: set[Fault] = field(default_factory=set)  # the same; a scan may have very many

    def add(self, problem: Problem | FileError, file: str, frame: str | None = None, key: str | None = None) -> None:
        """Add a problem, once. `file` is relative to the folder; `key` is a field in it."""
        self.take([Fault(file, frame, key, problem.problem, problem.cause, problem.remedy)])

    def take(self, faults: Iterable[Fault]) -> None:
        """Add faults, each once."""
        for fault in faults:
            if fault not in self._known:
                self._known.add(fault)
                self.found.append(fault)


# transforms.json as text: strict JSON, UTF-8, every key once, every number finite.

TRANSFORMS = "transforms.json"
MAX_BYTES = 256 << 20
MAX_DEPTH = 32  # of lists and objects in each other; a scan has 6, and what walks a document may recurse this far

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
        raise _too_deep(path) from error
    except json.JSONDecodeError as error:
        raise _syntax_error(path, content, error) from error
    except ValueError as error:  # a number with thousands of digits
        raise FileError(path, f"is not valid JSON ({error})", "a damaged number", "write the file again") from error
    if _deeper_than(document, MAX_DEPTH):
        raise _too_deep(path)
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
    """Name of a frame in messages: the stem of its image, else its number counted from 0."""
    path = record.get("file_path") if isinstance(record, dict) else None
    stem = Path(path).stem if isinstance(path, str) else ""
    return stem or f"#{index}"


def _record(pairs: list[tuple[str, Any]]) -> Record:
    record = Record(pairs)
    if len(record) != len(pairs):
        count = Counter(key for key, _ in pairs)
        record.duplicates = tuple(key for key in record if count[key] > 1)
    return record


def _too_deep(path: Path) -> FileError:
    return FileError(path, "is nested too deeply", "it does not describe a scan", "write the file again")


def _deeper_than(document: Any, limit: int) -> bool:
    """Whether lists and objects are nested more than `limit` times; level by level, without recursion."""
    level = [document]
    for _ in range(limit):
        nested = [outer for outer in level if isinstance(outer, dict | list)]
        level = [item for outer in nested for item in (outer.values() if isinstance(outer, dict) else outer)]
    return any(isinstance(item, dict | list) for item in level)


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
        twice = Problem("occurs more than once", "a mistake when files were edited or merged", "keep the right one")
        yield from ((frame, f"{key}.{name}".lstrip("."), twice) for name in value.duplicates)
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


# Reads keys of a JSON object and checks their types; what is wrong goes to a collection of faults.

_ALIKE = 0.85  # similarity of two words, as difflib counts it, from which one is the other misspelt


@dataclass(frozen=True)
class Fields:
    """An object in transforms.json and where it is; `read_*` return None after adding a fault.

    A number that is not finite gives None without a fault: `document_faults` lists it.
    """

    record: dict[str, Any]
    faults: Faults
    file: str
    frame: str | None = None
    prefix: str = ""

    def fault(self, key: str, problem: str, cause: str, remedy: str) -> None:
        """Add a fault at `key`."""
        self.faults.add(Problem(problem, cause, remedy), self.file, self.frame, self.prefix + key)

    def read_number(self, key: str, default: float | None = None) -> float | None:
        """A finite number; `default` where the key is absent, a fault if there is no default."""
        if key not in self.record and default is not None:
            return default
        value = self._get(key)
        found = None if value is None else self._finite(key, value, [value], "a number")
        return None if found is None else float(found[0])

    def read_count(self, key: str) -> int | None:
        """A whole number greater than 0."""
        number = self.read_number(key)
        if number is None:
            return None
        if number < 1 or number != int(number):
            self.fault(
                key, f"is {number:g}, not a whole number greater than 0", "a typing error", "give the size in pixels"
            )
            return None
        return int(number)

    def read_text(self, key: str) -> str | None:
        """A text that is not empty."""
        value = self._get(key)
        if value is None:
            return None
        if not isinstance(value, str) or not value:
            return self._wrong_type(key, value, "a text")
        return value

    def read_optional_text(self, key: str) -> str | None:
        """A text; None without a fault where the key is absent or null."""
        return None if self.record.get(key) is None else self.read_text(key)

    def read_flag(self, key: str) -> bool | None:
        """True or false."""
        value = self._get(key)
        if value is None or isinstance(value, bool):
            return value
        return self._wrong_type(key, value, "true or false")

    def read_choice(self, key: str, choices: Sequence[str], cause: str) -> str | None:
        """One of the texts in `choices`."""
        value = self.read_text(key)
        if value is not None and value not in choices:
            self.fault(key, f"is {value!r}", cause, f"give one of {', '.join(choices)}")
            return None
        return value

    def read_section(self, key: str) -> "Fields | None":
        """An object inside this one."""
        value = self._get(key)
        if value is None:
            return None
        if not isinstance(value, dict):
            return self._wrong_type(key, value, "an object { .. }")
        return Fields(value, self.faults, self.file, self.frame, f"{self.prefix}{key}.")

    def read_numbers(self, key: str, count: int) -> list[float] | None:
        """A list of `count` finite numbers."""
        value, wanted = self._get(key), f"a list of {count} numbers"
        if value is None:
            return None
        if not isinstance(value, list) or len(value) != count:
            return self._wrong_type(key, value, wanted)
        found = self._finite(key, value, value, wanted)
        return None if found is None else found.tolist()

    def read_matrix(self, key: str) -> Float64[ndarray, "rows columns"] | None:
        """A list of rows of finite numbers."""
        value, wanted = self._get(key), "a list of four rows of four numbers"
        if value is None:
            return None
        rows = value if isinstance(value, list) else []
        if not rows or not all(isinstance(row, list) and len(row) == len(rows[0]) > 0 for row in rows):
            return self._wrong_type(key, value, wanted)
        found = self._finite(key, value, [x for row in rows for x in row], wanted)
        return None if found is None else found.reshape(len(rows), -1)

    def _finite(self, key: str, value: Any, numbers: list[Any], wanted: str) -> Float64[ndarray, "n"] | None:
        """The numbers in a value; None after adding a fault where it holds something else, or one is not finite."""
        if not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
            return self._wrong_type(key, value, wanted)
        try:
            found = np.array(numbers, dtype=np.float64)
        except OverflowError:
            return self._wrong_type(key, value, f"{wanted} of reasonable size")
        return found if np.isfinite(found).all() else None

    def check_spelling(self, known: Sequence[str]) -> None:
        """Add a fault for each key that looks like a misspelt one of `known` that is absent."""
        absent = [(key, set(key)) for key in known if key not in self.record]
        for key in self.record:
            similar = [] if key in known else [name for name, letters in absent if _may_be_close(key, name, letters)]
            close = get_close_matches(key, similar, n=1, cutoff=_ALIKE) if similar else []
            if close:
                self.fault(key, "is not a key of a scan", "it is misspelt", f"did you mean {close[0]!r}?")

    def _get(self, key: str) -> Any:
        if key not in self.record:
            self.fault(
                key,
                "is missing",
                "it was removed, or the program that wrote the file does not know this format",
                "add it",
            )
            return None
        if self.record[key] is None:
            self._wrong_type(key, None, "a value")
        return self.record[key]

    def _wrong_type(self, key: str, value: Any, wanted: str) -> None:
        text = "null" if value is None else repr(value)
        shown = text if len(text) <= 40 else text[:37] + "..."
        self.fault(key, f"is {shown} instead of {wanted}", "wrong type", f"give {wanted}")


def _may_be_close(key: str, name: str, letters: set[str]) -> bool:
    """False where two words cannot be `_ALIKE`: sizes or letters differ too much. A file may have very many keys."""
    fewest = _ALIKE * (len(key) + len(name)) / 2  # letters that both must have in the same order
    return fewest <= min(len(key), len(name)) and len(letters.difference(key)) <= len(name) - fewest


# Paths in transforms.json: relative, and inside the folder even after links are followed.


def read_path(fields: Fields, key: str, root: Path) -> Path | None:
    """The absolute path under `key`, inside `root`; None after adding a fault."""
    text = fields.read_text(key)
    if text is None:
        return None
    path = resolve_inside(root, text)
    if isinstance(path, Path):
        return path
    fields.faults.add(path, fields.file, fields.frame, fields.prefix + key)
    return None


def resolve_inside(root: Path, text: str) -> Path | Problem:
    """Absolute path of `text` below `root`, or why it must not be used. The file itself need not exist.

    The returned path keeps links inside the folder as they are; it is not resolved.
    """
    windows = PureWindowsPath(text)
    try:
        encodable = b"\0" not in os.fsencode(text)
    except UnicodeEncodeError:
        encodable = False
    if not encodable:
        return Problem("contains characters that no file name can have", "the text is damaged", "correct the path")
    if text.startswith("/") or windows.drive:
        return Problem(
            f"is absolute ({text})", "it is valid on one machine only", "give the path relative to the scan folder"
        )
    if ".." in windows.parts:
        return Problem(
            f"leaves the scan folder ({text})",
            "the files are elsewhere, or the folder was made to read other people's files",
            "put the files inside the folder and give the path without '..'",
        )
    path = root / text
    if "\\" in text and not path.exists():
        return Problem(f"has backslashes ({text})", "it was written on Windows", "use / between folders")
    try:
        real, real_root = os.path.realpath(path, strict=True), os.path.realpath(root)
    except FileNotFoundError:
        return path  # reading it says that it is missing
    except OSError as error:
        return Problem(
            f"cannot be followed ({text}: {error.strerror})",
            "a link to itself, a file where a folder should be, or missing permissions",
            "put the file itself there",
        )
    if os.path.commonpath([real, real_root]) != real_root:
        return Problem(
            f"is a link out of the scan folder ({text})",
            "the files are elsewhere and were linked instead of copied",
            "copy the files into the folder",
        )
    return path

"""Reads keys of a JSON object and checks their types; what is wrong goes to a collection of faults."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.scan.problem import Faults, Problem

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
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, int | float):
            return self._wrong_type(key, value, "a number")
        try:
            number = float(value)
        except OverflowError:
            return self._wrong_type(key, value, "a number of reasonable size")
        return number if math.isfinite(number) else None

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
        value = self._get(key)
        if value is None:
            return None
        numbers = value if isinstance(value, list) else []
        right = len(numbers) == count and all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers)
        if not right:
            return self._wrong_type(key, value, f"a list of {count} numbers")
        try:
            found = [float(x) for x in numbers]
        except OverflowError:
            return self._wrong_type(key, value, f"a list of {count} numbers of reasonable size")
        return found if all(map(math.isfinite, found)) else None

    def read_matrix(self, key: str) -> Float64[ndarray, "rows columns"] | None:
        """A list of rows of finite numbers."""
        value = self._get(key)
        if value is None:
            return None
        rows = value if isinstance(value, list) else []
        numbers = [x for row in rows if isinstance(row, list) for x in row]
        regular = rows and all(isinstance(row, list) and len(row) == len(rows[0]) > 0 for row in rows)
        if not regular or not all(isinstance(x, int | float) and not isinstance(x, bool) for x in numbers):
            return self._wrong_type(key, value, "a list of four rows of four numbers")
        try:
            matrix = np.array(rows, dtype=np.float64)
        except OverflowError:
            return self._wrong_type(key, value, "a list of four rows of four numbers of reasonable size")
        return matrix if np.isfinite(matrix).all() else None

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

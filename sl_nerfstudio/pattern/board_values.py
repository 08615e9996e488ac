"""What a user types about a board: "9x7" and "75 mm"."""

import re

from sl_nerfstudio.errors import UserError

_MILLIMETRES = {"m": 1e3, "cm": 10.0, "mm": 1.0, "um": 1e-3, "in": 25.4}
_LENGTH = re.compile(r"(\d+(?:\.\d*)?|\.\d+) *([a-z]+)")
_COUNTS = re.compile(r"(\d{1,4}) *[xX\u00d7] *(\d{1,4})")
_MOST = 1e5  # millimetres


def millimetres(text: str, flag: str) -> float:
    """A length with its unit, such as "75 mm", in millimetres. Raises UserError that names the flag."""
    length = _LENGTH.fullmatch(text.strip())
    if length is None or length[2] not in _MILLIMETRES:
        raise UserError(
            f'{flag} "{text}": is no length with a unit\n    cause:  a typing error, or no unit\n'
            f'    remedy: write for example {flag} "75 mm"; units are {", ".join(_MILLIMETRES)}'
        )
    value = float(length[1]) * _MILLIMETRES[length[2]]
    if not 0 < value <= _MOST:
        raise UserError(f'{flag} "{text}": give a length above 0 and up to {_MOST / 1e3:g} m')
    return value


def counts(text: str, flag: str) -> tuple[int, int]:
    """Numbers from left to right and from top to bottom, such as "9x7". Raises UserError that names the flag."""
    found = _COUNTS.fullmatch(text.strip())
    if found is None:
        raise UserError(
            f'{flag} "{text}": is no pair of numbers\n    cause:  a typing error\n'
            f"    remedy: write for example {flag} 9x7, the number from left to right first"
        )
    return int(found[1]), int(found[2])

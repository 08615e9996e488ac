"""A length as a person types it: a number with its unit."""

import re
from dataclasses import dataclass

from sl_nerfstudio.errors import UserError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "inch": 0.0254}
_LENGTH = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?)\s*(\D*)", re.IGNORECASE)


@dataclass(frozen=True)
class Length:
    """A length with the unit in which it was typed, one of `METRES`."""

    metres: float
    unit: str


def parse_length(text: str, where: str, least: float, most: float) -> Length:
    """Read a length such as "75 mm"; a unit is never guessed.

    `where` names the flag and its value in messages; the length must be above zero, and from `least` to `most` metres.
    Raises UserError for anything else.
    """
    found = _LENGTH.fullmatch(text.strip())
    unit = "" if found is None else found[2].strip().lower()
    if found is None or unit not in METRES:
        problem = f'"{text.strip()}" is no length with a unit'
        cause = "a comma in place of the decimal point" if re.search(r"\d,\d", text) else "a typing error"
        if found is not None:
            problem, cause = f"{found[1]} has no unit", "a number alone could be any length"
            if unit:
                problem, cause = f'unit "{found[2].strip()}" is none of {", ".join(METRES)}', "another unit, or a typo"
        example = f"{'75' if found is None else found[1]} mm"
        raise UserError(
            f"{where}: {problem}\n    cause:  {cause}\n"
            f"    remedy: write the length with its unit, as {example}; units are {', '.join(METRES)}"
        )
    metres = float(found[1]) * METRES[unit]
    if not least <= metres <= most:
        limits = f"from {least / METRES[unit]:g} to {most / METRES[unit]:g} {unit}"
        raise UserError(
            f"{where}: a length must be {'above zero' if metres <= 0 else limits}\n    cause:  a typing error\n"
            "    remedy: measure it again, and write it with its unit"
        )
    return Length(metres, unit)

"""Filling in the HTML templates of the reports."""

import math
from collections.abc import Callable
from typing import Any


def page(name: str, values: dict[str, Any], **filters: Callable[..., str]) -> str:
    """The template `name` of this package, filled in; `filters` are its own, besides those for numbers.

    Raises if the template uses an unknown value.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("sl_nerfstudio.evaluation.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": _number, "fixed": _fixed, "percent": _percent, **filters}
    return environment.get_template(name).render(values)


def _number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, a dash where there is no value."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        return f"{value:#.{digits}g}".rstrip(".") if value else "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _fixed(value: float | None, decimals: int = 2) -> str:
    """A fixed number of decimals, a dash where there is no value."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def _percent(value: float | None, decimals: int = 1) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{100 * value:.{decimals}f} %"

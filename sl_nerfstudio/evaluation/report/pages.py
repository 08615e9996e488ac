"""Filling in the HTML templates of the reports."""

from collections.abc import Callable
from typing import Any


def page(name: str, filters: dict[str, Callable[..., str]], values: dict[str, Any]) -> str:
    """The template `name` of this package, filled in. Raises if the template uses an unknown value."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("sl_nerfstudio.evaluation.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= filters
    return environment.get_template(name).render(values)

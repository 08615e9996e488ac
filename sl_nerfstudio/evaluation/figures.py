"""A figure with its judgement by two limits."""

import math
from dataclasses import dataclass
from typing import Literal

from sl_nerfstudio.verdict.verdict import Band


@dataclass(frozen=True)
class JudgedFigure:
    """One figure, with its judgement."""

    name: str
    value: float
    text: str  # the value with its unit
    band: Band | Literal["unknown"]  # unknown: the figure does not exist
    good: str  # the limit of "good", in words
    acceptable: str
    meaning: str
    advice: str  # what to do if it is not good


def judged(
    name: str, value: float, form: str, good: float, acceptable: float, limit: str, meaning: str, advice: str
) -> JudgedFigure:
    """Judge `value`; whether larger is better follows from the order of the limits."""
    sign = 1 if good < acceptable else -1
    band: Band | Literal["unknown"] = "poor"
    if not math.isfinite(value):
        band = "unknown"
    elif sign * value <= sign * good:
        band = "good"
    elif sign * value <= sign * acceptable:
        band = "acceptable"
    text = form.format(value) if math.isfinite(value) else "none"
    worst = limit.format(f"{acceptable:g}") if math.isfinite(acceptable) else "any"
    return JudgedFigure(name, value, text, band, limit.format(f"{good:g}"), worst, meaning, advice)

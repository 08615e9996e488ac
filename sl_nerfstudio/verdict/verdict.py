"""Good, acceptable or poor, with the reasons."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Band = Literal["good", "acceptable", "poor"]
BANDS: tuple[Band, ...] = ("good", "acceptable", "poor")
_LISTED = 6  # names in a sentence


@dataclass(frozen=True)
class Reason:
    """Something that keeps a scan from being good, and how far it does."""

    band: Band
    sentence: str  # names frames and figures


@dataclass(frozen=True)
class Verdict:
    """The worst of all judgements."""

    band: Band
    reasons: tuple[str, ...]  # the worst first; empty for a good scan


def worst(reasons: Iterable[Reason]) -> Verdict:
    """The verdict that some reasons lead to; good if there are none."""
    ordered = sorted((r for r in reasons if r.band != "good"), key=lambda r: -BANDS.index(r.band))
    return Verdict(ordered[0].band if ordered else "good", tuple(r.sentence for r in ordered))


def listed(names: Sequence[str], most: int = _LISTED) -> str:
    """Names for a sentence: the first few, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more

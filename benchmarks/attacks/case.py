"""What an attack is."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Fixture = Literal["scan", "captures", "pattern", "run"]


@dataclass(frozen=True)
class Case:
    """One attack on one command, or on a row of them."""

    group: str  # heading in the table
    name: str  # unique in the group
    fixtures: tuple[Fixture, ...]  # fresh copies of these lie in the case's folder, under their names
    attack: Callable[[Path], str]
    """Called with the case's own folder; "" if the package did right, else one line: what it did wrong."""

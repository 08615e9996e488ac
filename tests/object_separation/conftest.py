"""Small cases with ray-cast truth, made once."""

from collections.abc import Callable

import pytest

from benchmarks.separation.cases import Case, Conditions, make_case
from benchmarks.separation.objects import OBJECTS


@pytest.fixture(scope="session")
def cases() -> Callable[..., Case]:
    """Ten frames of 110 x 110 pixels by object and background; other conditions on request."""
    made: dict[tuple, Case] = {}

    def get(name: str, background: str, zoom: float = 0.75) -> Case:
        key = (name, background, zoom)
        if key not in made:
            made[key] = make_case(OBJECTS[name](), background, Conditions(10, 110, zoom))
        return made[key]

    return get

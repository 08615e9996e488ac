"""Small cases with ray-cast truth, made and separated once."""

from collections.abc import Callable

import pytest

from benchmarks.separation.cases import Case, Conditions, make_case
from benchmarks.separation.objects import OBJECTS
from sl_nerfstudio.object_separation.separate import Separation, separate


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


@pytest.fixture(scope="session")
def separated(cases: Callable[..., Case]) -> Callable[..., Separation]:
    """What is found in a case, which takes seconds; arguments as for `cases`."""
    found: dict[tuple, Separation] = {}

    def get(name: str, background: str, zoom: float = 0.75) -> Separation:
        key = (name, background, zoom)
        if key not in found:
            found[key] = separate(cases(*key).frames)
        return found[key]

    return get

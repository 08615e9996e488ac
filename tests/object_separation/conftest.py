"""Small cases with ray-cast truth, made and separated once."""

from collections.abc import Callable
from functools import cache

import pytest

from benchmarks.separation.cases import Case, Conditions, make_case
from benchmarks.separation.objects import OBJECTS
from sl_nerfstudio.object_separation.separate import Separation, separate


@pytest.fixture(scope="session")
def cases() -> Callable[..., Case]:
    """Ten frames of 110 x 110 pixels by object and background; another zoom on request."""
    return cache(lambda name, around, zoom=0.75: make_case(OBJECTS[name](), around, Conditions(10, 110, zoom)))


@pytest.fixture(scope="session")
def separated(cases: Callable[..., Case]) -> Callable[..., Separation]:
    """What is found in a case, which takes seconds; arguments as for `cases`."""
    return cache(lambda *case: separate(cases(*case).frames))

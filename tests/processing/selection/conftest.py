"""A small separation: two frames, one of which shows nothing of the object."""

import numpy as np
import pytest

from sl_nerfstudio.object_separation.planes import Plane, PlaneFinding
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.processing.object_only import FrameShares, ObjectOnly


def finding(verdict):
    plane = Plane(np.array([0.0, 0.0, 1.0]), 2.0)
    return PlaneFinding(plane, 0.6, 1.0, 0.0, 0.3, 1.0, 5.0, 1.0, 1.0, verdict)


@pytest.fixture
def object_only() -> ObjectOnly:
    table, side = finding("leaves the views"), finding("surface behind it")
    first = np.full((4, 6), Part.PLANE, np.uint8)
    first[1:3, 2:5] = Part.OBJECT
    second = np.full((4, 6), Part.BEYOND, np.uint8)
    shares = (FrameShares("a", 0.25, 0.75, 0.0), FrameShares("b", 0.0, 0.0, 1.0))
    return ObjectOnly((table, side), (table,), shares, {"a": first, "b": second})

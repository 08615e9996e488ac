import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest

with warnings.catch_warnings():  # warnings are errors, but these are nerfstudio's own
    warnings.simplefilter("ignore")
    import nerfstudio.engine.trainer
    import nerfstudio.viewer.viewer  # noqa: F401

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.model.pipeline import mean_over_frames, what_next
from sl_nerfstudio.model.viewer import first_viewpoint, vertical_fov


def test_means_and_deviations_over_the_frames_that_have_a_value() -> None:
    frames = [{"a": 1.0, "b": 5.0}, {"a": 3.0}, {}, {"a": math.nan, "c": math.nan}, {"a": 8.0, "b": math.inf}]
    found = mean_over_frames(frames, with_std=True)
    assert found == {"a": 4.0, "a_std": math.sqrt((9 + 1 + 16) / 2), "b": 5.0, "b_std": 0.0}
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert mean_over_frames(frames, with_std=False) == {"a": 4.0, "b": 5.0}


def test_one_frame_has_a_deviation_of_zero() -> None:
    assert mean_over_frames([{"a": 2.0}], with_std=True) == {"a": 2.0, "a_std": 0.0}
    assert mean_over_frames([], with_std=True) == {}


def test_commands_to_continue_with_are_quoted_for_a_shell() -> None:
    text = what_next(Path("/a b/it's/config.yml"), Path("/scan"))
    assert """ns-viewer --load-config '/a b/it'"'"'s/config.yml'""" in text
    assert text.startswith("result      /a b/it's\n") and max(map(len, text.splitlines())) <= 80


def test_vertical_field_of_view() -> None:
    pinhole = Device(w=640, h=480, fl_x=500.0, fl_y=400.0, cx=320.0, cy=240.0)
    assert vertical_fov(pinhole) == pytest.approx(2 * math.atan(240 / 400))
    doe = Device(w=600, h=600, fl_x=600.0, fl_y=600.0, cx=300.0, cy=300.0, model="DOE")
    assert vertical_fov(doe) == pytest.approx(2 * math.asin(300 / 600))
    shifted = Device(w=640, h=480, fl_x=500.0, fl_y=400.0, cx=320.0, cy=0.0)
    assert vertical_fov(shifted) == pytest.approx(math.atan(480 / 400))


def test_first_viewpoint_is_near_the_first_cameras_line_of_sight() -> None:
    for position in ([0.0, -5.0, 0.0], [3.0, 1.0, -2.0], [0.0, 0.0, 4.0]):
        T = np.eye(4)
        T[:3, 3] = position
        p = first_viewpoint(T)
        assert np.linalg.norm(p) == pytest.approx(3.0)
        angle = math.acos(p @ T[:3, 3] / np.linalg.norm(p) / np.linalg.norm(T[:3, 3]))
        assert angle < 0.6

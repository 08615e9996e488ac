"""Which views are kept, and the first reason against the others."""

import numpy as np
import pytest

from sl_nerfstudio.capture.selection import Exposure, GridView, Selection, SelectionVerdict

GOOD = Exposure(0.0, 0.0)


def view(shift=0.0, nodes=100, blur=0.1, light=GOOD, edge=None):
    uv = np.full((10, 10, 2), np.nan, dtype=np.float32)
    x, y = np.meshgrid(np.arange(10) * 10.0, np.arange(10) * 10.0)
    uv.reshape(-1, 2)[:nodes] = np.stack([x.ravel() + shift, y.ravel()], -1)[:nodes]
    return GridView(uv, 10.0, blur, light, edge)


@pytest.mark.parametrize(
    ("seen", "verdict"),
    [
        (view(), SelectionVerdict.KEEP),
        (view(nodes=47), SelectionVerdict.NO_PATTERN),
        (view(nodes=0, light=Exposure(0.6, 0.0)), SelectionVerdict.SATURATED),
        (view(nodes=0, light=Exposure(0.0, 0.95)), SelectionVerdict.DARK),
        (view(nodes=0, edge=2.5), SelectionVerdict.BLURRED),
        (view(nodes=0, edge=0.9), SelectionVerdict.NO_PATTERN),
        (view(blur=0.16), SelectionVerdict.BLURRED),
        (view(blur=None), SelectionVerdict.BLURRED),
        (view(light=Exposure(0.2, 0.0)), SelectionVerdict.SATURATED),
        (view(light=Exposure(0.0, 0.4)), SelectionVerdict.DARK),
        (GridView(np.zeros((0, 0, 2), dtype=np.float32), 1.0, None, GOOD), SelectionVerdict.BY_KEY),
    ],
)
def test_the_first_view(seen, verdict):
    assert Selection((10, 10)).judge(seen, 0.0) is verdict


def test_views_that_are_known_are_not_kept_again_even_later():
    selection = Selection((10, 10))
    for shift in (0.0, 50.0):
        selection.add(view(shift), 0.0)
    assert selection.judge(view(1.0), 60.0) is SelectionVerdict.KNOWN  # like the first, not the last
    assert selection.judge(view(25.0), 60.0) is SelectionVerdict.KEEP


def test_after_a_frame_there_is_a_pause():
    selection = Selection((10, 10))
    selection.add(view(), 5.0)
    assert (
        selection.judge(view(30.0), 5.9) is SelectionVerdict.WAIT
        and selection.judge(view(30.0), 6.0) is SelectionVerdict.KEEP
    )


def test_frames_of_an_earlier_run_cause_no_pause():
    selection = Selection((10, 10))
    selection.add(view())
    assert selection.judge(view(30.0), 0.0) is SelectionVerdict.KEEP


def test_how_often_each_node_was_seen():
    selection = Selection((10, 10))
    assert selection.times_seen.tolist() == np.zeros((10, 10)).tolist()
    for nodes in (100, 20, 10):
        selection.add(view(nodes=nodes))
    assert selection.times_seen[:4].sum(1).tolist() == [30, 20, 10, 10]

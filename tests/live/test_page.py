"""The page of a live scan, where no browser looks at it: docs/make_live.py takes pictures of it in one."""

from dataclasses import replace

import numpy as np
import pytest

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.live.next_view import NextView
from sl_nerfstudio.live.page import Console, LivePage, cell_colours, decoded_picture, said, where_to
from sl_nerfstudio.live.session import Row, Update
from sl_nerfstudio.live.sight import Fault
from sl_nerfstudio.live.tracker import Doubt, Placed, State, Tracker
from sl_nerfstudio.model import preview as module
from sl_nerfstudio.model.preview import Preview
from tests.live.walks import CAMERA, PROJECTOR, blind, sights

pytestmark = pytest.mark.filterwarnings("ignore")  # of websockets, for what viser uses


@pytest.fixture(scope="module")
def tracker():
    found = Tracker()
    for sight in sights()[:2]:
        found.keep(sight, found.place(sight))
    return found


def update(tracker, sight, placed, number=-1) -> Update:
    cause = "" if placed.cause is None else placed.cause.value
    row = Row("image 7", placed.state.value, cause, number, -1, 0.5, 0.1, 0.01, None)
    return Update(sight, placed, row, [row], tracker.model, view_at(30.0, 20.0))


def view_at(turn_deg: float, elevation_deg: float) -> NextView:
    """A view of the origin from a turn to the right of the x axis, seen by who looks at the origin; z is up."""
    a, b = np.radians([turn_deg, elevation_deg])
    T = np.eye(4)
    T[:3, 3] = 3 * np.cos(b) * np.cos(a), 3 * np.cos(b) * np.sin(a), 3 * np.sin(b)
    return NextView(T, 5.0, np.zeros(3), np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize("cause", [*Fault, *Doubt])
def test_every_cause_is_said_with_what_to_do(tracker, cause):
    text = said(update(tracker, blind(), Placed(State.LOST, cause)))
    assert text.startswith("### lost")
    assert " → **" in text and "to come back: show a part of the surface" in text


def test_the_way_to_the_next_view_is_said_in_the_users_directions():
    here = Similarity(1.0, np.eye(3), np.array([5.0, 0.0, 0.0]))
    assert where_to(view_at(30.0, -20.0), here) == "next: **30° to the right, 20° lower**"
    assert where_to(view_at(-12.0, 3.0), here) == "next: **12° to the left**"
    assert "finish" in where_to(None, here)


def test_cells_seen_once_are_red_and_those_seen_often_green(tracker):
    surface = tracker.model.surfels
    colours = cell_colours(surface, tracker.model.nodes[0].t)
    once = surface.views == 1
    assert (colours[once, 0] > colours[once, 1]).all()
    often = replace(surface, views=np.full_like(surface.views, 3), information=np.full_like(surface.information, 1e12))
    assert (cell_colours(often, tracker.model.nodes[0].t)[:, 1] > cell_colours(often, np.zeros(3))[:, 0]).mean() > 0.5


def test_the_picture_shows_what_was_decoded(tracker):
    plain, coloured = decoded_picture(blind()), decoded_picture(sights()[0])
    assert plain.shape == coloured.shape == (480, 480, 3)
    assert (plain == plain[0, 0]).all() and not (coloured == coloured[0, 0]).all()


def test_the_page_draws_devices_surface_and_ghost_and_is_left_to_what_comes_next(tracker, monkeypatch):
    monkeypatch.setattr(module, "PORT", 8470)
    with Preview("scan") as preview:
        with LivePage(preview, CAMERA, PROJECTOR) as page:
            placed = Placed(State.TRACKED, None, Similarity.identity())
            page.show(update(tracker, sights()[0], placed, 1))
            drawn = {"surface", "/live/kept/0", "/live/kept/1", "/live/now/camera", "/live/now/projector",
                     "/live/next", "/live/next-name"}  # fmt: skip
            assert set(page._nodes) == drawn
            page.show(update(tracker, blind(), Placed(State.LOST, Fault.NO_PATTERN)))
            assert set(page._nodes) == {name for name in drawn if "now" not in name}
            assert not page.stopped()
        assert all(box.visible for box in preview._shown.values())


def test_the_console_says_a_state_once():
    lines: list[str] = []
    console, tracker = Console(lines.append, resumed=3), Tracker()
    for placed in (Placed(State.TRACKED), Placed(State.TRACKED), Placed(State.LOST, Fault.DARK)):
        console.show(update(tracker, blind(), placed))
    assert lines[:2] == ["going on after 3 images", "image 7: tracked"]
    assert len(lines) == 3 and lines[2].startswith("image 7: lost: too dark")


def test_a_shared_page_names_an_address(monkeypatch):
    monkeypatch.setattr(module, "PORT", 8480)
    with Preview("scan", shared=True) as page:
        host = page.where.split(":")[0]
        assert host.count(".") == 3 and host != "0.0.0.0"

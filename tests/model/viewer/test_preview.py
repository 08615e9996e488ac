"""The page of `sl-scan --preview` where no browser looks at it; tests/cli/test_scan.py opens one."""

import socket

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.model import preview
from sl_nerfstudio.model.preview import MOST_POINTS, Preview
from sl_nerfstudio.model.scene_nodes import SCENE_SCALE
from tests.bundle_adjustment.analytic import rig_of
from tests.registration.analytic_clouds import clouds_of, part_of

SIZE = 120
pytestmark = pytest.mark.filterwarnings("ignore")  # of websockets, for what viser uses


@pytest.fixture
def page(monkeypatch):
    monkeypatch.setattr(preview, "PORT", 8450)
    with Preview("captures") as found:
        yield found


def test_the_training_is_left_alone_while_no_browser_looks(page):
    page.trained(None)  # a model that is asked for anything at all would fail


def test_frames_that_were_left_out_are_not_drawn_and_what_is_drawn_is_in_view(page):
    rig = part_of(rig_of(18, SIZE), [0, 1, 2])
    clouds, T_camera = clouds_of(rig, SIZE), rig.T_world_camera.numpy()
    T_projector = T_camera @ rig.T_camera_projector.numpy()
    page.registered(clouds, DevicePoses(T_camera, T_projector), "registered")
    assert len(page._drawn) == 9
    without = T_camera.copy()
    without[1] = np.nan
    page.registered(clouds, DevicePoses(without, T_projector), "adjusted together")
    assert sorted(page._drawn) == [
        f"/{kind}/{clouds[k].name}" for kind in ("cameras", "points", "projectors") for k in (0, 2)
    ]
    assert "2 of 3 frames adjusted together" in page._said.content
    queued = page.server._websock_server._broadcast_buffer.message_from_id.values()
    points = np.concatenate([m.points for m in queued if type(m).__name__ == "PointCloudMessage"])
    assert 1000 < len(points) <= MOST_POINTS
    assert np.linalg.norm(points, axis=1).max() < 1.5 * SCENE_SCALE
    assert np.ptp(points, axis=0).max() > SCENE_SCALE / 2  # and large enough


def test_without_a_port_it_says_so(monkeypatch):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(preview, "PORT", port)
        monkeypatch.setattr(preview, "_PORTS", 1)
        with pytest.raises(UserError, match=rf"--preview: no port from {port} to {port} (.|\n)*remedy: leave the flag"):
            Preview("captures")

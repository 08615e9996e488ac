"""A viewer without a browser: viser's server, a stand-in for nerfstudio's Viewer, and a model whose field is known."""

import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import viser
from nerfstudio.viewer.viewer import Viewer

from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.model import viewer
from sl_nerfstudio.model.viewer import SceneView, ViewerSurface
from sl_nerfstudio.scan import Scan, read_scan
from tests.dataparser.tiny_scan import RADIUS, TinyScan

SCALE = 0.8 / RADIUS  # scene units by mm


class SphereModel:
    """The field of the sphere that was scanned; poses as in the scan, unless they are set."""

    device, cell = torch.device("cpu"), 1.0

    def __init__(self, scan: Scan) -> None:
        self.scan, self.S_scene_world = scan, Similarity.scaling(SCALE)
        self.step, self.viewed_frame = 7, 0
        self.current, self.lost, self.offset = scan.poses, [False] * len(scan.frames), 0.0

    def sdf(self, p_scene: torch.Tensor) -> torch.Tensor:
        return p_scene.norm(dim=-1) - 0.8 + self.offset

    def poses(self) -> DevicePoses:
        return self.current

    def poses_scene(self) -> tuple[torch.Tensor, torch.Tensor]:
        p = self.current.mapped(self.S_scene_world)
        return torch.from_numpy(p.T_world_camera), torch.from_numpy(p.T_world_projector)

    def joint_covariance(self) -> None:
        return None

    pose_sigma = self_calibration = history = joint_covariance

    def unplaced(self) -> list[bool]:
        return self.lost


class BareViewer(Viewer):
    """What of nerfstudio's viewer a SceneView uses."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.viser_server, self.train_lock, self.trainer, self.rerendered = server, None, None, 0
        self.config = SimpleNamespace(websocket_host="127.0.0.1", camera_frustum_scale=0.1)  # type: ignore[assignment]
        self.control_panel = SimpleNamespace(_layer_depth=SimpleNamespace(value=True))  # type: ignore[assignment]
        self.camera_handles = {}

    def _trigger_rerender(self) -> None:
        self.rerendered += 1


@pytest.fixture(scope="session")
def sphere_scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Three frames; of the last one nothing was decoded."""
    root: Path = TinyScan().write(tmp_path_factory.mktemp("viewed") / "sphere")
    np.savez(root / "coords/frame_00002.npz", coords=np.full((40, 48, 2), np.nan, np.float32))
    return read_scan(root)


@pytest.fixture(scope="session")
def server() -> Iterator[viser.ViserServer]:
    with warnings.catch_warnings():  # of websockets, for what viser uses
        warnings.simplefilter("ignore")
        found = viser.ViserServer(host="127.0.0.1", port=8310, verbose=False)  # or the next free port
    yield found
    found.stop()


@pytest.fixture
def view(sphere_scan: Scan, server: viser.ViserServer, monkeypatch: pytest.MonkeyPatch) -> SceneView:
    """Set up as by nerfstudio; callbacks are called by the tests themselves, in their own thread."""
    monkeypatch.setattr(viewer, "ViewerSurface", partial(ViewerSurface, resolution=32))
    server.scene.reset()
    server.gui.reset()
    made = SceneView(SphereModel(sphere_scan))
    made._setup(BareViewer(server))
    return made

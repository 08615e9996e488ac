"""Depth maps, pairs to register and window matching, against formulas."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.baselines.tsdf import backprojected, triangulated_depth
from benchmarks.baselines.window_matching import match_windows
from sl_nerfstudio.decoding.grid_graph import one_hot, turned_pattern
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.pattern.codes import code_array
from sl_nerfstudio.scan import Scan, read_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

PATTERN = turned_pattern(code_array(12, 14, seed=3))
LENS = (-0.12, 0.05, 1e-3, -2e-3)


@pytest.fixture(scope="module")
def distorted(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Exact coordinates and poses, seen through a lens with distortion."""
    root = tmp_path_factory.mktemp("distorted") / "scan"
    synthesise(SynthConfig(frames=3, resolution=120, supersampling=1, clean=True, camera_distortion=LENS), root)
    return read_scan(root)


def on_truth(scan: Scan, points: np.ndarray) -> np.ndarray:
    """Distance of points from the true surface."""
    from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
    from sl_nerfstudio.meshing.files import read_mesh

    return IndexedMesh(read_mesh(scan.root / "ground_truth/mesh.ply")).distance(points)


def test_depth_maps_are_those_of_an_ideal_pinhole(distorted: Scan) -> None:
    """Nearest pixels are taken, so points are off by up to half a pixel's footprint across, and far less in depth."""
    frame = distorted.frames[0]
    assert frame.camera.k1 == LENS[0]
    depth = triangulated_depth(frame, distorted, frame.T_world_camera, frame.T_world_projector)
    assert depth.camera == Device(120, 120, frame.camera.fl_x, frame.camera.fl_y, frame.camera.cx, frame.camera.cy)
    points = backprojected(depth)
    p_world = points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3]
    footprint = np.median(-points[:, 2]) / frame.camera.fl_x
    assert np.percentile(on_truth(distorted, p_world), 95) < footprint
    assert (depth.depth > 0).sum() == pytest.approx(frame.read_mask().sum(), rel=0.1)


@given(st.integers(0, 2**31 - 1), st.integers(0, 3))
def test_one_wrong_symbol_changes_nothing_but_random_symbols_match_nothing_reliably(seed: int, turn: int) -> None:
    rng = np.random.default_rng(seed)
    mine = np.flatnonzero(PATTERN.turn == turn)
    around = np.where(PATTERN.around[mine] < 0, -1, PATTERN.around[mine] - mine[0]).astype(np.int32)
    symbol = PATTERN.symbol[mine].copy()
    wrong = int(rng.integers(len(mine)))
    symbol[wrong] = (symbol[wrong] + rng.integers(1, 5)) % 5
    found = match_windows(one_hot(symbol).numpy(), around, PATTERN, 1)
    assert (found == mine).mean() > 0.98 and found[wrong] in (mine[wrong], -1)
    noise = rng.integers(0, 5, len(mine)).astype(symbol.dtype)
    found = match_windows(one_hot(noise).numpy(), around, PATTERN, 0)
    assert (found == -1).mean() > 0.8

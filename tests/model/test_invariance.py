"""The same scan in other units, or in a rotated and shifted world, gives the same surface."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from nerfstudio.data.scene_box import SceneBox
from scipy.spatial import KDTree

from sl_nerfstudio.dataparser.datamanager import SceneRays
from sl_nerfstudio.dataparser.dataparser import load_scan
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.meshing.visibility import trim_to_observed
from sl_nerfstudio.model.model import SLModel, SLModelConfig
from sl_nerfstudio.scan import read_ground_truth
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise

pytestmark = pytest.mark.slow

STEPS = 12  # few: rounding grows with each step, and is amplified to anything after some 40


def small_scan(folder: Path, **options) -> Path:
    synthesise(SynthConfig(frames=6, resolution=100, seed=3, **options), folder)
    return folder


def surface(folder: Path) -> np.ndarray:
    """Vertices of the observed surface after a short run, in world units."""
    loaded = load_scan(folder)
    config = SLModelConfig(schedule_iterations=STEPS)
    config.adjustment = replace(config.adjustment, anchors_per_frame=100, further_searches=False, other_minima=False)
    config.sdf.levels, config.sdf.max_resolution, config.sdf.hidden = 3, 64, 32
    torch.manual_seed(0)
    box = SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    metadata = {"sl_scan": loaded.scan, "sl_S_scene_world": loaded.S_scene_world}
    model = SLModel(config, box, len(loaded.scan.frames), metadata=metadata)
    model.train()
    model.adjust_poses(loaded.samples)
    model.measure_noise(loaded.samples)
    rays = SceneRays(
        loaded.scan, torch.from_numpy(loaded.S_scene_world.poses(loaded.scan.poses.T_world_camera)).float()
    )
    optimizer = torch.optim.Adam([p for group in model.get_param_groups().values() for p in group], lr=2e-3)
    for step in range(STEPS):
        torch.manual_seed(step)
        model.anneal(step)
        pixels = loaded.samples.at(loaded.samples.draw(512))
        decoded, pattern = pixels.decoded[:, None], pixels.pattern[:, None]
        batch = {"coords": pixels.coords, "decoded": decoded, "pattern": pattern}
        losses = model.get_loss_dict(model(rays(pixels.frame, pixels.uv)), batch)
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(losses.values())).sum().backward()
        optimizer.step()
    mesh = extract_mesh(model.sdf, 64)
    world = Mesh(loaded.S_scene_world.inverse().points(mesh.vertices), mesh.faces)
    return trim_to_observed(world, loaded.scan, model.poses()).mesh.vertices


@pytest.fixture(scope="module")
def plain(tmp_path_factory) -> Path:
    return small_scan(tmp_path_factory.mktemp("units") / "mm")


@pytest.fixture(scope="module")
def in_mm(plain) -> np.ndarray:
    return surface(plain)


def share_apart(a: np.ndarray, b: np.ndarray) -> float:
    """90 % quantile of the distances between two vertex sets, as a share of the first one's size."""
    size = np.linalg.norm(np.ptp(a, axis=0))
    both = np.concatenate([KDTree(a).query(b)[0], KDTree(b).query(a)[0]])
    return float(np.quantile(both, 0.9) / size)


def test_the_unit_and_a_rotated_and_shifted_world_do_not_matter(plain, in_mm, tmp_path):
    folder = small_scan(tmp_path / "turned", units="m", world_turn=5)
    turned = surface(folder) * 1000
    truth, start = (read_ground_truth(load_scan(f).scan) for f in (folder, plain))
    assert start.poses is not None and truth.poses is not None
    T = truth.poses.T_world_camera[0].copy()
    T[:3, 3] *= 1000
    back = start.poses.T_world_camera[0] @ np.linalg.inv(T)
    assert share_apart(in_mm, turned @ back[:3, :3].T + back[:3, 3]) < 0.01

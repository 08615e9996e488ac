"""Poses that the steps of a training move, and those that are off."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sl_nerfstudio.model.poses import PoseMode, PoseOptimizerConfig
from tests.model.training.small_runs import folder_of, last_state, settings, train

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely
POSES = "_model.device_poses."


@pytest.mark.parametrize("camera, projector", [("SO3xR3", "off"), ("off", "SE3"), ("off", "off")])
def test_only_what_is_on_moves(scan_root: Path, tmp_path: Path, camera: PoseMode, projector: PoseMode) -> None:
    config = settings(scan_root, tmp_path, steps=4)
    model = config.pipeline.model
    model.pose_method, model.warm_start = "render-independently", 0.0
    model.camera_optimizer, model.projector_optimizer = PoseOptimizerConfig(camera), PoseOptimizerConfig(projector)
    model.losses = replace(model.losses, surface=0.0, free_space=0.0, coordinates_per_pixel=0.01)
    train(config)
    state = last_state(folder_of(tmp_path))["pipeline"]
    for device, mode in (("camera", camera), ("projector", projector)):
        base, start = state[f"{POSES}base_{device}"], state[f"{POSES}start_{device}"]
        assert torch.equal(base, start), "nothing was adjusted before the first step"
        moved = state[f"{POSES}{device}_step"].abs().amax(1)
        assert (moved > 0).all() if mode != "off" else not moved.any()

"""Trainings of other scans and settings: coordinates as images, poses that steps move or that are off."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sl_nerfstudio.cli.check import check_run_folder
from sl_nerfstudio.model.poses import PoseMode, PoseOptimizerConfig
from tests.dataparser.coordinate_images import one_tiff, pair_of_parts, replace_coords
from tests.model.training.small_runs import STEPS, folder_of, last_state, require_equal, settings, train

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


def test_floating_point_images_train_the_same_run_as_arrays(scan_root: Path, finished: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(scan_root, tmp_path / "sphere"))
    train(settings(replace_coords(root, one_tiff, "pixels"), tmp_path / "outputs"))
    found, wanted = last_state(folder_of(tmp_path / "outputs")), last_state(finished)
    assert found["step"] == wanted["step"] == STEPS - 1
    for state in (found, wanted):  # of other files, so another one
        del state["pipeline"][next(key for key in state["pipeline"] if key.endswith("scan_fingerprint"))]
    require_equal(found["pipeline"], wanted["pipeline"])


def test_16_bit_pairs_train_and_belong_to_their_run(scan_root: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(scan_root, tmp_path / "sphere"))
    train(settings(replace_coords(root, pair_of_parts, "parts_of_65535"), tmp_path / "outputs"))
    folder = folder_of(tmp_path / "outputs")
    assert "complete" in check_run_folder(folder) and "is there and unchanged" in check_run_folder(folder)
    image = root / "coords/frame_00001_y.png"
    image.write_bytes(image.with_name("frame_00002_y.png").read_bytes())
    with pytest.raises(Exception, match="was trained on another scan"):
        check_run_folder(folder)


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

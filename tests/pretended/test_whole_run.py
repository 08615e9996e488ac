"""What comes before and after the steps of a run on a GPU: checkpoints, evaluation, viewer, export."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.pretended.gpu import PretendedGpu
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.model import trainer
from sl_nerfstudio.model.run_files import checkpoints_in
from sl_nerfstudio.model.viewer import MODES, RENDERED, ViewerSurface
from sl_nerfstudio.runs.export import build_surface
from sl_nerfstudio.runs.export_settings import ExportSettings

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


@pytest.mark.slow
def test_a_whole_run(begin, tmp_path):
    with PretendedGpu():
        training = begin("sl-neus")
        for _ in range(5):
            training.step()
        _evaluates(training, tmp_path)
        _shows(training.model)
        _exports(training.model, tmp_path)
        training.trainer.save_checkpoint(4)
        (saved,) = checkpoints_in(training.trainer.checkpoint_dir)
        again = begin("sl-neus", lambda config: setattr(config, "load_checkpoint", saved))
        wanted = {name: x.cpu() for name, x in training.model.state_dict().items()}
        found = {name: x for name, x in again.model.state_dict().items()}
        assert all(x.device.type == "cuda" for x in found.values())
        for name, value in wanted.items():
            torch.testing.assert_close(found[name].cpu(), value, rtol=0, atol=0, equal_nan=True, msg=name)
        assert _recordable(again)
        again.done = 5
        assert torch.equal(again.step()[0], training.step()[0])  # also the optimisers' state
    here = begin("sl-neus", lambda config: setattr(config, "load_checkpoint", saved), device="cpu")
    for name, value in here.model.state_dict().items():
        torch.testing.assert_close(value, wanted[name], rtol=0, atol=0, equal_nan=True, msg=name)
    assert not _recordable(here)
    here.done = 5
    assert here.step()[0].isfinite()


def _recordable(training):
    """Whether torch's optimisers let a CUDA graph record them: the file says what was right elsewhere."""
    (flag,) = {group["capturable"] for group in training.trainer.optimizers.optimizers["mlp"].param_groups}
    return flag


def test_the_gpus_of_apple_are_refused(begin):
    with pytest.raises(UserError, match=r"device-type mps: Apple's GPUs do not compute in float64.* on the CPU"):
        begin("sl-neus", device="mps")


def test_a_gpu_that_cannot_be_used_is_said_before_a_training_begins(begin, monkeypatch, capsys):
    monkeypatch.setattr(trainer, "gpu_found", lambda: (False, "its driver is too old"))
    begin("sl-neus", device="cpu")
    assert "The GPU is not used: its driver is too old." in " ".join(capsys.readouterr().out.split())
    with PretendedGpu():
        monkeypatch.setattr(trainer, "gpu_fault", lambda: "no kernel image is available")
        with pytest.raises(UserError, match=r"cuda: the GPU cannot be used: no kernel image(.|\n)*type cpu"):
            begin("sl-neus")


def _evaluates(training, folder):
    metrics = training.pipeline.get_average_eval_image_metrics(output_path=folder / "images", get_std=True)
    assert np.isfinite(metrics["coordinate_px"]) and len(list((folder / "images").iterdir())) >= 3 * 4
    training.pipeline.eval()
    rays, _ = training.pipeline.datamanager.next_eval(5)
    assert training.model(rays)["depth"].device.type == "cuda"
    training.pipeline.train()


def _shows(model):
    """A free viewpoint, as nerfstudio's viewer asks for it, and the surface as a mesh."""
    from nerfstudio.cameras.cameras import Cameras

    model.eval()
    pose = model.poses_scene()[0][:1, :3].float()
    size = torch.tensor([[12]], device="cuda")
    focal = torch.tensor([[20.0]], device="cuda")
    camera = Cameras(camera_to_worlds=pose, fx=focal, fy=focal, cx=focal / 4, cy=focal / 4, width=size, height=size)
    picture = model.get_outputs_for_camera(camera)
    assert picture["rgb"].shape == (12, 12, 3) and picture["rgb"].device.type == "cuda"
    surface = ViewerSurface(model, resolution=16)
    for mode in MODES:
        if mode != RENDERED and mode != "views":
            assert surface.coloured(mode, 0).rgb.shape == (len(surface.mesh.vertices), 3)
    model.train()


def _exports(model, folder):
    model.eval()
    settings = ExportSettings(folder / "mesh.ply", resolution=16)
    for kind in (settings, replace(settings, keep_unobserved=True)):
        try:
            assert len(build_surface(model, kind).marked.mesh.faces) > 100
        except UserError as error:  # a sphere after five steps may be nowhere near what was observed
            assert "observed" in str(error) and not kind.keep_unobserved
    model.train()

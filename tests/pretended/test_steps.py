"""A training step on a GPU: no tensors of two devices meet, and the host never waits."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from benchmarks.pretended.gpu import MixedDevicesError, PretendedGpu
from benchmarks.pretended.recorder import PretendedRecorder
from sl_nerfstudio.bundle_adjustment.adjust import CrossValidation
from sl_nerfstudio.bundle_adjustment.covariance import joint_of_prior
from sl_nerfstudio.field import device_kernels
from sl_nerfstudio.geometry.devices import Device, Intrinsics, unproject
from sl_nerfstudio.model.loop import WARM_UP
from sl_nerfstudio.model.pose_refinement import ScanAdjustment, pose_prior, scene_rig

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely

RENDERED_FROM = 3


def with_poses(refine, method, backend, config):
    config.pipeline.model.refine_poses, config.pipeline.model.pose_method = refine, method
    config.pipeline.model.sdf.backend = backend


def adjusted_at_once(scan, S_scene_world, samples, refine, prior, settings):
    """The adjustment runs on the CPU, and takes seconds."""
    rig = scene_rig(scan, S_scene_world)
    prior = pose_prior(scan, S_scene_world, prior)
    decision = CrossValidation(0.1, 0.05, -0.01, 0.001, 0.01)
    return ScanAdjustment(rig, prior.sigma, joint_of_prior(prior, rig), 0.1, None, (1,), decision)


@pytest.mark.parametrize(
    "method, refine, poses, backend",
    [
        ("sl-neus", "off", "adjust", "torch"),  # fixed
        ("sl-neus", "free", "adjust", "triton"),  # refined before the first step
        pytest.param("sl-neus", "rigid-rig", "render", "triton", marks=pytest.mark.slow),  # trained
        pytest.param("sl-neus-paper", "free", "render-independently", "torch", marks=pytest.mark.slow),
    ],
)
def test_no_step_waits_for_the_gpu(begin, monkeypatch, method, refine, poses, backend):
    with PretendedGpu(kernels=backend == "triton") as gpu:
        training = begin(method, partial(with_poses, refine, poses, backend))
        if refine == "free" and poses == "adjust":
            monkeypatch.setattr("sl_nerfstudio.model.model.adjust_scan", adjusted_at_once)
            assert "Poses adjusted" in training.model.adjust_poses(training.pipeline.datamanager.samples)
            assert training.model.pose_sigma() is not None and training.model.unplaced() == [False, True, False]
        assert all(x.device.type == "cuda" for x in training.model.state_dict().values())
        before = {name: x.detach().clone() for name, x in training.model.named_parameters()}
        for step in range(RENDERED_FROM + 2):
            with gpu.counting() as seen:
                loss, terms, metrics = training.step()
                training.after()
            if step not in (0, RENDERED_FROM):  # constants are copied once
                assert not seen.waits, f"step {step}: {dict(seen.waits)}"
            assert seen.launches.total() > 20
        assert loss.device.type == "cuda" and loss.isfinite()
        assert "coordinates" in terms and metrics["coordinate_px"].isfinite()
        moved = {name for name, x in training.model.named_parameters() if not torch.equal(x, before[name])}
        assert {"field.encoding.table", "field.mlp.0.weight"} <= moved
        assert ("device_poses.camera_step" in moved) == (poses != "adjust")
        assert training.model.history()["step"] == [0.0]


def test_rays_of_a_distorted_lens_do_not_wait_for_the_gpu():
    lens = Intrinsics.of(Device(640, 480, 600.0, 600.0, 320.0, 240.0, k1=-0.2, k2=0.05), torch.float32)
    uv = 400 * torch.rand(100, 2, generator=torch.Generator().manual_seed(0))
    with PretendedGpu(kernels=False) as gpu:
        there, at = replace(lens, params=lens.params.to("cuda")), uv.to("cuda")
        with gpu.counting() as seen:
            found = unproject(there, at)
        assert not seen.waits and seen.launches.total() > 20
        torch.testing.assert_close(found.cpu(), unproject(lens, uv))


def test_kernels_that_do_not_compile_are_said_before_the_first_step_and_plain_torch_is_used(begin, monkeypatch, capsys):
    monkeypatch.setattr(device_kernels, "_failures", [])
    with PretendedGpu(kernels=True) as gpu:
        training = begin("sl-neus", partial(with_poses, "off", "adjust", "auto"))
        before = {name: x.detach().clone() for name, x in training.model.named_parameters()}
        training.trainer._compile_kernels()
        assert all(torch.equal(x, before[name]) for name, x in training.model.named_parameters())
        assert training.model.field.backend == "triton" and "kernels for this GPU" in capsys.readouterr().out

        def full(*_):
            raise OSError(28, "No space left on device", "/root/.triton")

        monkeypatch.setattr(device_kernels, "run", full)
        training.trainer._compile_kernels()
        said = " ".join(capsys.readouterr().out.split())
        assert "Plain torch computes the steps, which is slower:" in said
        assert "TRITON_CACHE_DIR may name a folder" in said
        assert training.model.field.backend == "torch"
        with gpu.counting() as seen:
            training.step()
        assert not [name for name in seen.launches if "triton" in name]


def test_a_pixel_table_that_does_not_fit_gives_the_batches_of_one_on_the_host(begin, monkeypatch):
    """While the GPU works on one batch, the next one is copied; the host waits for neither."""
    here = begin("sl-neus-paper", device="cpu").pipeline.datamanager
    wanted = [here.train_pixel_sampler.sample(step) for step in (7, 8, 9, 3, 4)]
    with PretendedGpu() as gpu:
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (1000, 1000))
        sampler = begin("sl-neus-paper").pipeline.datamanager.train_pixel_sampler
        sampler.sample(6)
        for step, batch in zip((7, 8, 9, 3, 4), wanted, strict=True):
            with gpu.counting() as seen:
                found = [sampler.sample(step), sampler.samples.at(sampler.choose(step))]
            assert not seen.waits, dict(seen.waits)
            for name, values in vars(batch).items():
                for one in found:
                    there = getattr(one, name)
                    assert there.device.type == "cuda"
                    torch.testing.assert_close(there.cpu(), values, rtol=0, atol=0, equal_nan=True, msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["torch", "triton"])
def test_kernels_and_recording_stay_where_the_pixel_table_does_not_fit(begin, monkeypatch, backend):
    def trained(recorded):
        with PretendedGpu(kernels=backend == "triton") as gpu:
            monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (1000, 1000))
            training = begin("sl-neus-paper", partial(with_poses, "off", "adjust", backend))
            if recorded:
                training.trainer.record_steps(PretendedRecorder(gpu))
            for _ in range(WARM_UP + 2):
                with gpu.counting() as seen:
                    losses = training.step()[0]
            assert recorded == (training.trainer.recorded is not None) and not seen.waits, dict(seen.waits)
            assert recorded or ("triton render" in seen.launches) == (backend == "triton")
            return float(losses), training.pipeline.datamanager.train_pixel_sampler.samples.records.cpu()

    (loss, records), (wanted, expected) = trained(True), trained(False)
    assert loss == pytest.approx(wanted, rel=1e-6) and torch.equal(records, expected)


def test_the_pretended_gpu_finds_what_a_gpu_refuses_or_waits_for():
    with PretendedGpu() as gpu:
        there, here = torch.zeros(4, device="cuda"), torch.ones(4)
        for wrong in (lambda: there + here, lambda: torch.cat([there, here]), lambda: here[there.long()]):
            with pytest.raises(MixedDevicesError):
                wrong()
        with pytest.raises(TypeError, match="can't convert cuda"):
            there.numpy()
        assert (there + torch.tensor(2.0)).cpu().tolist() == [2.0] * 4  # scalars may be on the CPU
        for reads in (
            lambda: float(there[0]),
            lambda: bool(there.any()),
            lambda: there.tolist(),
            lambda: there[there > 0],
            lambda: there.nonzero(),
            lambda: there.new_tensor([1.0]),
            lambda: torch.tensor([1.0], device="cuda"),
            lambda: here.to("cuda"),
            lambda: there.copy_(here),
            lambda: there[torch.tensor([1])],
        ):
            with gpu.counting() as seen:
                reads()
            assert seen.waits.total() == 1, dict(seen.waits)
        with gpu.counting() as seen:
            there[1:].fill_(3.0)
            torch.where(there > 1, there, 0.0).sort()
        assert not seen.waits and set(seen.launches) == {"fill_", "gt", "where", "sort"}
    with pytest.raises(RuntimeError, match="after it was switched off"):
        torch.add(there, 1)

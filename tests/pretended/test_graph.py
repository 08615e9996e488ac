"""Steps that repeat a recording give the same training, so the recording reads all that changes from tensors."""

from functools import partial

import pytest
import torch

from benchmarks.pretended.gpu import PretendedGpu
from benchmarks.pretended.recorder import PretendedRecorder
from sl_nerfstudio.model.loop import WARM_UP, NotRecordedError, StepGraph

pytestmark = pytest.mark.filterwarnings("ignore")  # nerfstudio warns freely


def with_backend(backend, config):
    config.pipeline.model.sdf.backend = backend
    if config.method_name == "sl-neus":
        config.pipeline.model.warm_start, config.pipeline.model.pose_method = 0.25, "render"


def trained(begin, recorder, method, backend, steps):
    with PretendedGpu(kernels=backend == "triton") as gpu:
        training = begin(method, partial(with_backend, backend))
        used = None
        if recorder is not None:
            used = recorder(gpu)
            training.trainer.record_steps(used)
        for _ in range(steps):
            training.step()
        rates = [scheduler.get_last_lr() for scheduler in training.trainer.optimizers.schedulers.values()]
        return used, rates, {name: x.cpu() for name, x in training.model.state_dict().items()}


@pytest.mark.slow
@pytest.mark.parametrize("method, backend, steps", [("sl-neus", "triton", 10), ("sl-neus-paper", "triton", 5)])
def test_a_recording_gives_the_same_training(begin, method, backend, steps):
    recorder, rates, recorded = trained(begin, PretendedRecorder, method, backend, steps)
    assert recorder is not None
    # sl-neus: step 0 has one level, steps 1 to 4 a second one, from step 5 on rays are rendered
    assert recorder.recordings == {"sl-neus": 2, "sl-neus-paper": 1}[method]
    assert recorder.replays == steps - {"sl-neus": 1 + 2 * WARM_UP, "sl-neus-paper": WARM_UP}[method]
    _, wanted_rates, plain = trained(begin, None, method, backend, steps)
    assert rates == wanted_rates
    for name, wanted in plain.items():
        # nerfstudio's own step gives the rates as float64; kernels for GPUs take float32
        torch.testing.assert_close(recorded[name], wanted, rtol=1e-5, atol=2e-6, equal_nan=True, msg=name)


def test_other_operations_are_recorded_anew(begin):
    with PretendedGpu() as gpu:
        recorder, x = PretendedRecorder(gpu), torch.zeros((), device="cuda")
        graph = StepGraph(recorder, lambda: x.add_(1) * 2)
        found = [float(graph.step("first")) for _ in range(WARM_UP + 3)]
        assert found == [2.0 * k for k in range(1, WARM_UP + 4)] and recorder.recordings == 1
        graph.step("second")
        graph.forget()
        for _ in range(WARM_UP + 2):
            last = graph.step("second")
        assert recorder.recordings == 2 and float(last) == 2.0 * float(x) == 2.0 * (2 * WARM_UP + 6)


@pytest.mark.slow
def test_a_step_that_waits_is_not_recorded_and_training_goes_on(begin, capsys):
    with PretendedGpu(kernels=True) as gpu:
        graph = StepGraph(PretendedRecorder(gpu), lambda: float(torch.zeros((), device="cuda")))
        for _ in range(WARM_UP):
            graph.step(0)
        with pytest.raises(NotRecordedError, match="not permitted when stream is capturing"):
            graph.step(0)
        training = begin("sl-neus-paper", partial(with_backend, "triton"))

        def record(work):
            raise RuntimeError("this GPU is too old\nCompile with TORCH_USE_CUDA_DSA to enable assertions")

        recorder = PretendedRecorder(gpu)
        recorder.record = record
        training.trainer.record_steps(recorder)
        losses = [float(training.step()[0]) for _ in range(WARM_UP + 2)]
        assert len(set(losses)) == len(losses) and training.trainer.recorded is None
    said = " ".join(capsys.readouterr().out.split())
    assert "Steps are not recorded as a CUDA graph, which would be faster: this GPU is too old." in said


@pytest.mark.parametrize(
    "change, why",
    [
        ({"cuda_graph": False}, "--cuda-graph False"),
        ({"mixed_precision": True}, "--mixed-precision True"),
        ({"gradient_accumulation_steps": {"mlp": 2}}, "--gradient-accumulation-steps"),
        ({"log_gradients": True}, "--log-gradients True"),
    ],
)
def test_why_steps_are_not_recorded_is_said(begin, capsys, change, why):
    def changed(config):
        for name, value in {"cuda_graph": True, **change}.items():
            setattr(config, name, value)

    with PretendedGpu():
        training = begin("sl-neus-paper", changed)
        assert training.trainer.recorded is None
    assert f"which would be faster: {why}." in " ".join(capsys.readouterr().out.split())

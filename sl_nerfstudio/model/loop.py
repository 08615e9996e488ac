"""nerfstudio's training loop, which may be stopped at any time without losing what was found."""

import functools
import math
import signal
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext, suppress
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast, runtime_checkable

import torch
import torch.distributed as dist
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import comms
from torch import Tensor, nn
from torch.optim import Optimizer

from sl_nerfstudio.console import Phase, paragraph, phase
from sl_nerfstudio.errors import UserError, first_line, last_line
from sl_nerfstudio.field import numba_backend
from sl_nerfstudio.field.backend import TableGradient
from sl_nerfstudio.field.device_kernels import give_up
from sl_nerfstudio.field.field import MIN_RESOLUTION, FieldConfig, SDFField
from sl_nerfstudio.field.optimiser import RowAdam
from sl_nerfstudio.field.simd import needs_compiling
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.model.optimisers import make_recordable
from sl_nerfstudio.model.run_files import (
    INTERRUPTION,
    PARTIAL,
    SCHEDULE_KEY,
    Interrupted,
    checkpoint_name,
    checkpoints_in,
    go_on_command,
    quiet_nerfstudio,
    write_checkpoint,
)
from sl_nerfstudio.parallel import one_library_thread, threads
from sl_nerfstudio.rendering.direct_losses import measured
from sl_nerfstudio.rendering.volume_rendering import comes_below, first_crossings, render_rays

if TYPE_CHECKING:
    from sl_nerfstudio.model.model import SLModel

# What the processes of one training, one on each GPU, share: a start, the mean of their gradients, and an end.
#
# nerfstudio starts them (`--machine.num-devices`), and would wrap the model in torch's DistributedDataParallel. That
# averages the gradients of what a module's `forward` computed; here most losses are computed after it, and kernels
# write the table's gradient themselves. So gradients are averaged before each step of the optimisers, with the same
# result: each process draws its own pixels, and all of them take the same step.


def several() -> bool:
    """Whether this process trains together with others."""
    return comms.get_world_size() > 1


@torch.no_grad()
def share_state(module: nn.Module) -> None:
    """Give all processes the parameters and saved buffers of the main one."""
    for tensor in module.state_dict().values():
        whole = tensor.contiguous()
        dist.broadcast(whole, 0)
        if whole is not tensor:
            tensor.copy_(whole)


def greatest(number: int, device: str) -> int:
    """The greatest of a small number over all processes."""
    shared = torch.tensor(number, dtype=torch.int32, device=device)
    dist.all_reduce(shared, dist.ReduceOp.MAX)
    return int(shared)


class SharedOptimizers(Optimizers):
    """nerfstudio's optimisers, which step along the mean of all processes' gradients.

    The mean is taken before a gradient scaler looks for infinities, so that all processes find the same.
    """

    @torch.no_grad()
    def optimizer_scaler_step_some(self, grad_scaler: Any, param_groups: list[str]) -> None:
        """See nerfstudio's Optimizers."""
        for parameter in (parameter for name in param_groups for parameter in self.parameters[name]):
            if parameter.grad is not None:
                dist.all_reduce(parameter.grad)
                parameter.grad /= dist.get_world_size()
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


# The loops of a training step, compiled by another process while this one reads the scan and adjusts the poses.
#
# Machine code is kept on disk, so this is done once. It takes a quarter of a minute, and half of that Python's lock:
# a thread of this process would gain little.

_LONGEST = 120  # seconds that `finish` waits; what is missing then is compiled here, when it is used
_CODE = f"from {__name__} import compile_step; compile_step()"
_process: subprocess.Popen[bytes] | None = None


def start() -> None:
    """Begin, if there is anything to compile and more than one core for it."""
    global _process
    if threads() > 1 and needs_compiling(numba_backend.pull_back_gradient_fused):
        quiet = subprocess.DEVNULL
        with suppress(OSError):
            _process = subprocess.Popen([sys.executable, "-c", _CODE], stdin=quiet, stdout=quiet, stderr=quiet)


def finish() -> None:
    """Wait for the other process, rather than compile the same here."""
    global _process
    if _process is not None:
        with suppress(subprocess.TimeoutExpired):
            _process.wait(_LONGEST)
        _process = None


def compile_step() -> None:
    """Call every loop of a step, and of evaluation, with a tiny field."""
    torch.set_num_threads(1)
    field = SDFField(FieldConfig(levels=1, max_resolution=MIN_RESOLUTION, hidden=16, backend="numba"))
    table = field.encoding.table
    p = torch.zeros(8, 3)
    value, gradient = field.sdf_and_gradient(p)
    (field.sdf(p).sum() + value.sum() + gradient.sum()).backward()
    RowAdam([table]).step()
    TableGradient.of(table).clear()
    with torch.no_grad():
        rays, T, one = torch.ones(1, 3), torch.eye(4)[None], torch.ones(1)
        interval = torch.zeros(2, 2, 2), rays, rays, one, one, 2
        first_crossings(*interval)
        comes_below(*interval, one)
        device = Intrinsics.of(Device(w=2, h=2, fl_x=1.0, fl_y=1.0, cx=1.0, cy=1.0))
        measured((rays, rays), T, rays, one > 0, device, 1.0, 1.0, 1.0)
        render_rays(torch.ones(1, 2), torch.ones(1, 2), rays, rays, T, device, torch.ones(2, 2), 1.0)


# Training steps recorded as a CUDA graph: one launch a step in place of thousands.
#
# A graph repeats the operations of the step that it was recorded from, on the same memory. What changes from step to
# step must therefore be in tensors that are written before: sharpness, widths and level weights (the model's
# buffers), learning rates (`DeviceRates`), the random numbers' seeds. Where the operations themselves change, a new
# graph is recorded.

WARM_UP = 3  # steps before a recording, so that libraries and constants are there

T = TypeVar("T")


@runtime_checkable
class Recorder(Protocol):
    """What records and repeats operations."""

    def warm_up(self, work: Callable[[], T]) -> T:
        """Do some work in the way in which it will be recorded."""
        ...

    def record(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Record some work without doing it: what does it, and the results that it then fills in."""
        ...


class CudaRecorder:
    """Records CUDA graphs. `generators`: those that the work draws from, besides torch's own."""

    def __init__(self, generators: Iterable[torch.Generator]) -> None:
        self._generators = tuple(generators)
        self._stream = torch.cuda.Stream()

    def warm_up(self, work: Callable[[], T]) -> T:
        """On a stream of its own: a recording is made on one, too, and torch ties gradients to the stream."""
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            result = work()
        torch.cuda.current_stream().wait_stream(self._stream)
        return result

    def record(self, work: Callable[[], T]) -> tuple[Callable[[], None], T]:
        """Raises RuntimeError if the work makes the host wait, or launches something outside of its stream."""
        graph = self._graph()
        try:
            with self._recording(graph):
                result = work()
        except RuntimeError as error:
            with suppress(RuntimeError, AttributeError):  # else torch's allocator keeps to the recording's memory
                torch._C._cuda_endAllocateToPool(torch.cuda.current_device(), graph.pool())
            with suppress(RuntimeError), warnings.catch_warnings():  # that nothing is recorded
                warnings.simplefilter("ignore")
                with self._recording(self._graph()):  # else random numbers remain those of a recording
                    pass
            before = error.__context__  # the cause; the error itself may say that a recording cannot end
            raise RuntimeError(first_line(before if isinstance(before, Exception) else error)) from error
        return graph.replay, result

    def _graph(self) -> torch.cuda.CUDAGraph:
        graph = torch.cuda.CUDAGraph()
        for generator in self._generators:
            graph.register_generator_state(generator)
        return graph

    def _recording(self, graph: torch.cuda.CUDAGraph) -> AbstractContextManager[None]:
        """Other threads, such as the viewer's, may use the GPU meanwhile."""
        return torch.cuda.graph(graph, stream=self._stream, capture_error_mode="thread_local")


class NotRecordedError(RuntimeError):
    """A step could not be recorded; it has not been done."""


class StepGraph:
    """Does steps by a recording, as soon as there is one."""

    def __init__(self, recorder: Recorder, work: Callable[[], Any]) -> None:
        self._recorder = recorder
        self._work = work
        self.forget()

    def forget(self) -> None:
        """Record again: the memory that the recording uses is no longer what counts."""
        self._key: Hashable = None
        self._warm = 0
        self._replay: Callable[[], None] | None = None
        self._result: Any = None

    def step(self, key: Hashable) -> Any:
        """One step and its results, which the next step overwrites; another `key` means other operations.

        Raises NotRecordedError if the step cannot be recorded.
        """
        if key != self._key:
            self.forget()  # first of all it frees the memory of the last recording
            self._key = key
        if self._replay is None and self._warm < WARM_UP:
            self._warm += 1
            return self._recorder.warm_up(self._work)
        if self._replay is None:
            try:
                self._replay, self._result = self._recorder.record(self._work)
            except (RuntimeError, AttributeError) as error:  # of CUDA; of a torch without what is called
                raise NotRecordedError(first_line(error)) from error
        self._replay()
        return self._result


class DeviceRates:
    """Learning rates on the parameters' device. The optimisers' own stay numbers, for schedules and checkpoints."""

    def __init__(self, optimizers: Iterable[Optimizer]) -> None:
        groups = [group for optimizer in optimizers for group in optimizer.param_groups]
        self._groups = [(group, torch.zeros((), device=group["params"][0].device)) for group in groups]

    def update(self) -> None:
        """Write the current rates, for which the host need not wait."""
        for group, rate in self._groups:
            rate.fill_(group["lr"])

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Optimisers read the rates from the device."""
        numbers: list[float | Tensor] = [group["lr"] for group, _ in self._groups]
        try:
            for group, rate in self._groups:
                group["lr"] = rate
            yield
        finally:
            for (group, _), number in zip(self._groups, numbers, strict=True):
                group["lr"] = number


# Between two checkpoints that are written because of the time.
SECONDS_PER_SAVE = 60.0
LEAST_STEPS = 100
_STEPS_PER_AGREEMENT = 10  # of several processes on whether to stop: each agreement waits for all of them


class SLTrainer(Trainer):
    """nerfstudio's trainer with eight differences.

    - Poses are adjusted before the first step, whose time would otherwise include it, and saved.
    - Each phase prints one line, with a bar or the time left while it runs; nerfstudio itself is quiet.
    - A checkpoint is also written when 60 seconds and 100 steps have passed, and on SIGINT and SIGTERM,
      which then end the process with status 130 or 143.
    - A checkpoint is complete or not there. Files in its folder that are no checkpoints are left alone.
    - A checkpoint that does not fit the model gives a message.
    - On a GPU, steps are recorded as a CUDA graph.
    - When the schedule has ended, the optimisers forget their moments, two thirds of a checkpoint: what goes on from
      there, at once or later, starts with new ones.
    - Several processes take the same steps, along the mean of their gradients. The main one adjusts the poses; all stop
      together.
    """

    config: Any
    pipeline: Any
    recorded: tuple[StepGraph, DeviceRates] | None = None  # if steps are done by a CUDA graph
    _done: int | None = None  # the last step whose results the weights hold
    _saved: tuple[int | None, float] = (None, 0.0)  # the last step that was saved, and when

    def __init__(self, config: Any, local_rank: int = 0, world_size: int = 1) -> None:
        quiet_nerfstudio(not config.verbose)  # also in the processes of several GPUs
        super().__init__(config, local_rank, world_size)
        if several():  # a process alone did so when it checked its settings
            INTERRUPTION.install(patient=True)
            if config.machine.device_type == "cuda":
                torch.cuda.set_device(local_rank)
        self._phases = ExitStack()
        self._training = Phase("train")

    def setup(self, test_mode: Any = "val") -> None:
        """Make the pipeline and load the checkpoint; see nerfstudio's Trainer."""
        with self._ending():
            super().setup(test_mode)
            if torch.device(self.device).type == "cuda":
                torch.backends.cuda.matmul.allow_tf32 = self.config.tf32
                why = self._why_not_recorded()
                if why:
                    print(paragraph("graph", _not_recorded(why)), flush=True)
                else:
                    generator = self.pipeline.datamanager.train_pixel_sampler.generator
                    self.record_steps(CudaRecorder([generator] if generator.device.type == "cuda" else []))
        for line in getattr(self.viewer_state, "viewer_info", []):
            print(paragraph("viewer", line), flush=True)

    def setup_optimizers(self) -> Optimizers:
        """Make the optimisers; see nerfstudio's Trainer."""
        if several():
            return SharedOptimizers(self.config.optimizers.copy(), self.pipeline.get_param_groups())
        return super().setup_optimizers()

    def train(self) -> None:
        """Train; see nerfstudio's Trainer. If interrupted, save what has been trained and say how to go on."""
        self._saved = (None, time.monotonic())
        try:
            with self._ending(), self._phases, one_library_thread():
                super().train()
            INTERRUPTION.remove()  # if interrupted they stay: a second signal ends the process at once
        finally:
            self.config.leave_folder()

    @property
    def _model(self) -> "SLModel":
        return cast("SLModel", self.pipeline.model)

    def _init_viewer_state(self) -> None:
        """Show the scene and adjust the poses: nerfstudio calls this last before the first step."""
        super()._init_viewer_state()
        if self._start_step == 0 and self.config.load_checkpoint is None and comms.is_main_process():
            with self.train_lock:
                self._adjust_poses()
        finish()
        self._compile_kernels()
        if several():
            share_state(self._model)
            self._model.load_state_dict(self._model.state_dict())  # modules look again at what the host must know
        self._training = self._phases.enter_context(_shown_phase("train"))

    def _adjust_poses(self) -> None:
        samples = self.pipeline.datamanager.samples
        if self._model.config.adjusts_poses:
            with _shown_phase("adjust") as shown:
                shown.say(self._model.adjust_poses(samples))
        else:
            self._model.adjust_poses(samples)
        with INTERRUPTION.held():
            self._model.measure_noise(samples)
            self.save_checkpoint(-1)

    def _compile_kernels(self) -> None:
        """Compile a GPU's kernels before the first step; if that fails, plain torch computes the steps."""
        model = self._model
        if torch.device(self.device).type != "cuda" or model.field.config.backend == "torch":
            return
        why = model.field.obstacle("triton")
        if why is None and model.has_kernels:
            from sl_nerfstudio.model.kernel_step import compile_kernels  # imports Triton

            try:
                with _shown_phase("compile") as shown:
                    compile_kernels(model, self.pipeline.datamanager.train_pixel_sampler)
                    shown.say("kernels for this GPU")
            except Exception as error:  # whatever a driver, a compiler or a cache folder does
                why = give_up(error)
        if why is not None and comms.is_main_process():
            print(paragraph("kernels", f"Plain torch computes the steps, which is slower: {why}."), flush=True)

    def begin_step(self, step: int) -> None:
        """Before each step, and before anything else in it."""
        INTERRUPTION.hold()

    def train_iteration(self, step: int) -> Any:
        """One step; nerfstudio writes the losses to its log, and torch warns of those that have a gradient."""
        loss, terms, metrics = self._recorded_iteration(step) if self.recorded else super().train_iteration(step)
        loss, terms = loss.detach(), {name: term.detach() for name, term in terms.items()}
        self._model.remember(loss, terms, metrics)
        return loss, terms, metrics

    def record_steps(self, recorder: Recorder) -> None:
        """From now on, do steps by a recording."""
        rates = DeviceRates(self.optimizers.optimizers.values())
        self.recorded = StepGraph(recorder, partial(self._operations, rates)), rates

    def _recorded_iteration(self, step: int) -> Any:
        assert self.recorded is not None
        graph, rates = self.recorded
        rates.update()
        self.pipeline.datamanager.train_pixel_sampler.begin(step)
        try:
            result = graph.step(self._model.operations_of_step)
        except NotRecordedError as error:
            self.recorded = None
            print(paragraph("graph", _not_recorded(str(error))), flush=True)
            return super().train_iteration(step)
        self.optimizers.scheduler_step_all(step)
        return result

    def _operations(self, rates: DeviceRates) -> Any:
        """What nerfstudio's `train_iteration` does on the device; precision is not mixed, and no step is left out."""
        groups = list(self.optimizers.parameters)
        self.optimizers.zero_grad_some(groups)
        _, terms, metrics = self.pipeline.get_train_loss_dict(step=self.step)
        loss = functools.reduce(torch.add, terms.values())
        loss.backward()
        with rates.in_use():
            self.optimizers.optimizer_scaler_step_some(self.grad_scaler, groups)
        return loss.detach(), {name: term.detach() for name, term in terms.items()}, metrics

    def _why_not_recorded(self) -> str:
        """Why a GPU's steps cannot be recorded as a CUDA graph; "" if they can."""
        c = self.config
        reasons = {
            "--cuda-graph False": not c.cuda_graph,
            "--mixed-precision True": self.use_grad_scaler,
            "--gradient-accumulation-steps": any(n != 1 for n in self.gradient_accumulation_steps.values()),
            "--log-gradients True": c.log_gradients,
            f"{self.world_size} processes": self.world_size > 1,
        }
        return ", ".join(reason for reason, holds in reasons.items() if holds)

    def eval_iteration(self, step: int) -> None:
        """Evaluate if it is due, as the last part of each step; a signal that came during the step counts now."""
        super().eval_iteration(step)
        if step + 1 == self.config.schedule_iterations:
            for optimizer in self.optimizers.optimizers.values():
                optimizer.state.clear()
            if self.recorded:
                self.recorded[0].forget()
        self._done = step
        self._training.update(step + 1, self._start_step + self.config.max_num_iterations, self._fit())
        saved, when = self._saved
        since = step - (self._start_step - 1 if saved is None else saved)
        if since >= LEAST_STEPS and time.monotonic() - when >= SECONDS_PER_SAVE:
            self.save_checkpoint(step)
        if not several():
            INTERRUPTION.release()
        elif step % _STEPS_PER_AGREEMENT == 0:
            INTERRUPTION.receive(greatest(INTERRUPTION.received, self.device))
            INTERRUPTION.release()

    def save_checkpoint(self, step: int) -> None:
        """Write weights and optimisers after a step; -1: before the first one."""
        self._saved = (step, time.monotonic())
        if not comms.is_main_process():
            return
        pipeline = getattr(self.pipeline, "module", self.pipeline)
        state = {
            "step": step,
            "pipeline": pipeline.state_dict(),
            "optimizers": {name: optimizer.state_dict() for name, optimizer in self.optimizers.optimizers.items()},
            "schedulers": {name: scheduler.state_dict() for name, scheduler in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
            SCHEDULE_KEY: self.config.schedule_iterations,
        }
        path = self.checkpoint_dir / checkpoint_name(step)
        with INTERRUPTION.held():
            write_checkpoint(path, state, self.base_dir / PARTIAL)
            if self.config.save_only_latest_checkpoint:
                for other in checkpoints_in(self.checkpoint_dir):
                    if other != path:
                        other.unlink(missing_ok=True)

    def _load_checkpoint(self) -> None:
        try:
            super()._load_checkpoint()
            make_recordable(self.optimizers.optimizers.values())
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise UserError(
                f"{self.config.load_checkpoint}: does not fit this training "
                f"({last_line(error)})\n"
                "    cause:  it was written with other settings, or by another version of this package\n"
                "    remedy: give the settings of the run that wrote it, or train again"
            ) from error

    def _fit(self) -> str:
        """How well rendered and decoded coordinates agree, in words; "" before anything was rendered."""
        px = self._model.history_table.latest("coordinate_px")
        return f"coordinates to {px:.2g} px" if math.isfinite(px) else ""

    def _after_train(self) -> None:
        """Say what was trained, save it and say what to do next."""
        self._training.say(", ".join(filter(None, [f"{self._training.done} steps", self._fit()])))
        self._phases.close()
        super()._after_train()

    def _train_complete_viewer(self) -> None:
        """Keep the viewer open until control-C, which is then the normal end."""
        INTERRUPTION.remove()
        if self.viewer_state is not None:
            print("The viewer stays open until control-C.", flush=True)
        before = signal.signal(signal.SIGINT, signal.default_int_handler)
        try:
            super()._train_complete_viewer()
        except KeyboardInterrupt:
            pass
        finally:
            signal.signal(signal.SIGINT, before)

    @contextmanager
    def _ending(self) -> Iterator[None]:
        """A signal saves the last complete step and says how to go on; an error that a user can fix is a message."""
        try:
            yield
        except Interrupted:
            if self._done is not None and self._done != self._saved[0]:
                self.save_checkpoint(self._done)
            assert self.config.method_name is not None
            if comms.is_main_process():
                print(f"to go on: {go_on_command(self.config.method_name, self.base_dir)}", file=sys.stderr, flush=True)
            if several() and self._done is not None:
                comms.synchronize()  # a process that ends earlier ends the others
            raise
        except UserError as error:
            if comms.is_main_process():
                print(f"error: {error}", file=sys.stderr, flush=True)
            raise SystemExit(1) from None


def _not_recorded(why: str) -> str:
    return f"Steps are not recorded as a CUDA graph, which would be faster: {why}."


def _shown_phase(name: str) -> AbstractContextManager[Phase]:
    """A phase that only the main process shows."""
    return phase(name) if comms.is_main_process() else nullcontext(Phase(name))

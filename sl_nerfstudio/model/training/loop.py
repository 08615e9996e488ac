"""nerfstudio's training loop, which may be stopped at any time without losing what was found."""

import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, cast

from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils import comms

from sl_nerfstudio.errors import UserError, last_line
from sl_nerfstudio.model.training.checkpoints import SCHEDULE_KEY, checkpoint_name, checkpoints_in, write_checkpoint
from sl_nerfstudio.model.training.interruption import INTERRUPTION, Interrupted
from sl_nerfstudio.model.training.run_folder import PARTIAL, go_on_command

if TYPE_CHECKING:
    from sl_nerfstudio.model.model import SLModel

LEAST_STEPS = 100  # between two checkpoints that are written because of the time


class SLTrainer(Trainer):
    """nerfstudio's trainer with four differences.

    - The adjusted poses are saved before the first step.
    - A checkpoint is also written when `seconds_per_save` seconds and 100 steps have passed, and on SIGINT and SIGTERM,
      which then end the process with status 130 or 143.
    - A checkpoint is complete or not there. Files in its folder that are no checkpoints are left alone.
    - A checkpoint that does not fit the model gives a message.
    """

    _done: int | None = None  # the last step whose results the weights hold
    _saved: tuple[int | None, float] = (None, 0.0)  # the last step that was saved, and when

    def setup(self, test_mode: Any = "val") -> None:
        """Make the pipeline and load the checkpoint; see nerfstudio's Trainer."""
        with self._ending():
            super().setup(test_mode)

    def train(self) -> None:
        """Train; see nerfstudio's Trainer. If interrupted, save what has been trained and say how to go on."""
        self._saved = (None, time.monotonic())
        try:
            with self._ending():
                super().train()
            INTERRUPTION.remove()  # if interrupted they stay: a second signal ends the process at once
        finally:
            self._leave_folder()

    def begin_step(self, step: int) -> None:
        """Before each step, and before anything else in it: the first one begins with the adjustment of the poses."""
        if step == 0 and self.config.load_checkpoint is None:
            model, samples = cast("SLModel", self.pipeline.model), self.pipeline.datamanager.samples  # type: ignore[attr-defined]
            model.adjust_poses(samples)
            with INTERRUPTION.held():
                model.measure_noise(samples)
                self.save_checkpoint(-1)
        INTERRUPTION.hold()

    def eval_iteration(self, step: int) -> None:
        """Evaluate if it is due, as the last part of each step; a signal that came during the step counts now."""
        super().eval_iteration(step)
        self._done = step
        saved, when = self._saved
        since = step - (self._start_step - 1 if saved is None else saved)
        if since >= LEAST_STEPS and time.monotonic() - when >= self.config.seconds_per_save:  # type: ignore[attr-defined]
            self.save_checkpoint(step)
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
            SCHEDULE_KEY: self.config.schedule_iterations,  # type: ignore[attr-defined]
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
        except (RuntimeError, ValueError, KeyError, TypeError, AttributeError, IndexError) as error:
            raise UserError(
                f"{self.config.load_checkpoint}: does not fit this training "
                f"({last_line(error)})\n"
                "    cause:  it was written with other settings, or by another version of this package\n"
                "    remedy: give the settings of the run that wrote it, or train again"
            ) from error

    def _train_complete_viewer(self) -> None:
        """Keep the viewer open until control-C, which is then the normal end."""
        INTERRUPTION.remove()
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
            print(f"to go on: {go_on_command(self.config.method_name, self.base_dir)}", file=sys.stderr)
            raise
        except UserError as error:
            print(f"error: {error}", file=sys.stderr)
            raise SystemExit(1) from None

    def _leave_folder(self) -> None:
        leave = getattr(self.config, "leave_folder", None)
        if leave is not None:
            leave()

"""How long a surface was trained, against what is recommended."""

from dataclasses import dataclass
from typing import Any

from sl_nerfstudio.evaluation.figures import JudgedFigure, judged


@dataclass(frozen=True)
class TrainedSteps:
    """Steps of a training."""

    done: int
    wanted: int  # recommended for the method, or what the run was started with if that is more

    @property
    def share(self) -> float:
        """Part of the wanted steps that was done."""
        return self.done / self.wanted


def trained_steps(training: dict[str, Any] | None) -> TrainedSteps | None:
    """From a training.json; None if it does not say."""
    settings = (training or {}).get("settings")
    if not isinstance(settings, dict):
        return None
    step, numbers = settings.get("step"), (settings.get("recommended_steps"), settings.get("schedule_iterations"))
    known = [n for n in numbers if isinstance(n, int) and n > 0]
    if not isinstance(step, int) or step < 0 or not known:
        return None
    return TrainedSteps(step + 1, max(known))


def training_figure(steps: TrainedSteps) -> JudgedFigure:
    """Below a tenth of the steps a surface has not formed; in between it may be good, but the other figures decide."""
    return judged(
        "Training", 100 * steps.share, f"{{:.0f}} % ({steps.done} of {steps.wanted} steps)", 100.0, 10.0, "≥ {} %",
        "Steps of the training, compared with those that are recommended for the method, or with the run's own length.",
        "train to the end, or with the recommended number of steps",
    )  # fmt: skip

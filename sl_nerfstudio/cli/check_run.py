"""The part of `sl-check` that checks a training run instead of a scan."""

import warnings
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sl_nerfstudio.runs.check_run import RunCheck


def is_run(path: Path) -> bool:
    """Whether a path is the folder or the config.yml of a training run."""
    if path.is_dir():
        return (path / "config.yml").is_file() and not (path / "transforms.json").exists()
    return path.suffix in (".yml", ".yaml")


def check_run_folder(path: Path) -> str:
    """What the run is and what there is of it. Raises UserError for anything that is wrong."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # nerfstudio's own, at its import
        from sl_nerfstudio.runs.check_run import check_run

    return summary(check_run(path))


def summary(found: "RunCheck") -> str:
    """The main facts about a good run, in a few lines."""
    config, step, last = found.config, found.last.step, found.config.last_step
    state = "poses adjusted, no step yet" if step < 0 else f"step {step}"
    if last is not None:
        state += ", complete" if step >= last else f" of {last}: interrupted, or still in training"
    there = "is there and unchanged" if found.has_scan else "is not there, so it was not compared"
    return "\n".join(
        [
            f"{found.folder}: no faults",
            f"  method              {config.method_name}",
            f"  state               {state}",
            f"  checkpoints         {found.checkpoints}, the last is {found.last.path.name}",
            f"  scan                {found.scan} {there}",
            "",
        ]
    )

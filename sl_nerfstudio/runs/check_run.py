"""What a run's folder holds, without running anything from it: for runs from elsewhere, and before an export."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sl_nerfstudio.dataparser.dataparser import scan_root
from sl_nerfstudio.dataparser.fingerprint import scan_fingerprint
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.model.pipeline import require_together
from sl_nerfstudio.model.training.checkpoints import Checkpoint, checkpoints_in, read_checkpoint
from sl_nerfstudio.runs.config_file import read_config
from sl_nerfstudio.runs.trained_run import config_file, last_checkpoint, require_settings
from sl_nerfstudio.scan import read_scan


@dataclass(frozen=True)
class RunCheck:
    """A run without faults."""

    folder: Path
    config: Any  # SLTrainerConfig
    last: Checkpoint
    checkpoints: int
    scan: Path
    has_scan: bool  # False: the scan is not on this machine, and was not compared


def check_run(path: Path) -> RunCheck:
    """Check the config.yml at `path` or in that folder, its checkpoints, and that they and the scan belong together.

    Raises UserError, with everything that is wrong once config.yml could be read.
    """
    file = config_file(path)
    config = read_config(file)
    saved = checkpoints_in(last_checkpoint(config, file).parent)
    faults: list[str] = []
    good: list[Checkpoint] = []
    for checkpoint in saved:
        try:
            good.append(read_checkpoint(checkpoint))
        except UserError as error:
            faults.append(str(error))
    scan, found = _scan_there(config)
    try:
        require_settings(file, config)
        for checkpoint in good:
            _require_together(config, checkpoint, scan, found)
    except UserError as error:
        faults.append(str(error))
    if faults:
        raise UserError("\n".join(faults))
    return RunCheck(file.absolute().parent, config, good[-1], len(saved), scan, found is not None)


def _scan_there(config: Any) -> tuple[Path, str | None]:
    """The scan's folder, and its fingerprint if it is there."""
    scan = scan_root(config.pipeline.datamanager.data or config.pipeline.datamanager.dataparser.data)
    return scan, scan_fingerprint(read_scan(scan)) if (scan / "transforms.json").is_file() else None


def _require_together(config: Any, checkpoint: Checkpoint, scan: Path, found: str | None) -> None:
    try:
        require_together(config.pipeline, checkpoint.weights, scan, found or config.pipeline.scan_fingerprint)
    except UserError as error:
        raise UserError(f"{checkpoint.path}: {error}") from error

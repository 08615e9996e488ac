"""Synthetic scans that benchmarks load directly, without the commands of a user."""

from pathlib import Path

from sl_nerfstudio.dataparser.dataparser import LoadedScan, load_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise


def made_once(config: SynthConfig, parent: Path) -> LoadedScan:
    """The scan of `config`, from a folder of its own below `parent`, which is made if it is not there.

    Raises UserError where a run that was broken off has left half of it.
    """
    folder = parent / f"{config.scene}-{config.frames}-{config.resolution}-{config.seed}"
    if not (folder / "transforms.json").exists():
        synthesise(config, folder)
    return load_scan(folder)

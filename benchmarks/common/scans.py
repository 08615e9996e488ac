"""Synthetic scans that benchmarks load directly, without running commands."""

from pathlib import Path

from sl_nerfstudio.dataparser.dataparser import LoadedScan, load_scan
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise


def made_once(config: SynthConfig, parent: Path) -> LoadedScan:
    """The scan of `config`, from its folder below `parent`; it is made if it does not exist.

    Raises UserError if an interrupted run has left an incomplete scan there.
    """
    folder = parent / f"{config.scene}-{config.frames}-{config.resolution}-{config.seed}"
    if not (folder / "transforms.json").exists():
        synthesise(config, folder)
    return load_scan(folder)

"""sl-export: the surface and the refined poses of a training run, in the scan's own unit and axes."""

from contextlib import ExitStack
from typing import TYPE_CHECKING

import tyro

from sl_nerfstudio.cli.exporting.checks import check_outputs, require_other_files
from sl_nerfstudio.cli.exporting.config import ExportConfig
from sl_nerfstudio.cli.exporting.words import summary
from sl_nerfstudio.cli.run import run

if TYPE_CHECKING:
    from sl_nerfstudio.runs.trained_run import TrainedRun


def main() -> None:
    """Entry point of the command."""
    run(lambda: export(tyro.cli(ExportConfig, prog="sl-export", config=(tyro.conf.FlagCreatePairsOff,))))


def export(config: ExportConfig) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    check_outputs(config)
    from sl_nerfstudio.files.lock import locked, locked_file

    with ExitStack() as held:
        held.enter_context(locked_file(config.output))
        if config.points is not None:
            held.enter_context(locked_file(config.points))
        if config.pose_folder is not None:
            held.enter_context(locked(config.pose_folder))
        check_outputs(config)  # again: a process that held them until now may have written them
        from sl_nerfstudio.runs.trained_run import load_run

        print(export_trained(load_run(config.load_config, config.data), config))


def export_trained(trained: "TrainedRun", config: ExportConfig) -> str:
    """Export a loaded run; returns the summary to print."""
    from sl_nerfstudio.runs.export import export_run

    scan = trained.model.scan
    require_other_files(config.pose_files, scan.root)
    return summary(config, scan, export_run(trained, config.settings(scan.units)))


if __name__ == "__main__":
    main()

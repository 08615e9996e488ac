"""sl-capture: capture frames with a camera, and keep those that add something."""

import tyro

from sl_nerfstudio.capture.config import CaptureConfig
from sl_nerfstudio.cli.run import run


def main() -> None:
    """Entry point of the command."""
    run(_capture)


def _capture() -> None:
    config = tyro.cli(CaptureConfig, prog="sl-capture", config=(tyro.conf.FlagCreatePairsOff,))
    config.check()
    from sl_nerfstudio.cli.capture_run import capture  # slow to import: OpenCV, torch

    capture(config)


if __name__ == "__main__":
    main()

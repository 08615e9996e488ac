"""sl-synth: make a synthetic scan."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from sl_nerfstudio.cli.run import run
from sl_nerfstudio.synthesis.config import SynthConfig


@dataclass(frozen=True)
class Arguments(SynthConfig):
    """Make a synthetic scan with its truth: a moving camera and a moving projector about a matte object.

    Lengths in flags are millimetres, fractions lie between 0 and 1.
    """

    output: Path = Path("scan")
    """folder to write; it must be new or empty"""


def _synthesise() -> None:
    arguments = tyro.cli(Arguments, prog="sl-synth")
    from sl_nerfstudio.synthesis.synthesise import synthesise  # slow to import: torch, open3d

    synthesise(arguments, arguments.output)
    print(f"wrote {arguments.frames} frames to {arguments.output}")


def main() -> None:
    """Entry point of the command."""
    run(_synthesise)


if __name__ == "__main__":
    main()

"""sl-redecode: decode the frames of a scan again, with what a training has learnt about its surface and poses."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sl_nerfstudio.cli.arguments import CONFIG, SCAN, parse
from sl_nerfstudio.cli.run import load_run, run
from sl_nerfstudio.console import command, next_steps, phase
from sl_nerfstudio.errors import UserError

if TYPE_CHECKING:
    from sl_nerfstudio.redecoding.redecode import Redecoded, RedecodedFacts
    from sl_nerfstudio.runs.run import TrainedRun

_MOST_NAMED = 6


@dataclass(frozen=True)
class RedecodeArguments:
    """Decode a scan again after a training: surface and poses predict where in the pattern each pixel looks.

    Pixels that were not decoded, or decoded wrongly, get the coordinate that their image shows there. What the image
    does not show stays empty. Writes a new scan folder to train on; the old one is not changed.
    """

    load_config: Path
    """config.yml of the run; ns-train prints its path at the end."""
    output: Path
    """Folder of the new scan; it must be new or empty."""
    resolution: int = 256
    """Cells of the surface along each side of the scene's box."""
    data: Path | None = None
    """Scan folder, if it was moved since the training."""


def main() -> None:
    """Entry point of the command."""
    run(lambda: redecode(parse(RedecodeArguments, "sl-redecode", {"load_config": CONFIG, "data": SCAN})))


def redecode(arguments: RedecodeArguments) -> None:
    """Do what the command line asks for. Raises UserError for anything a user can correct."""
    check(arguments)
    with phase("load"):
        trained = load_run(arguments.load_config, arguments.data)
    with phase("decode"):
        said = redecode_trained(trained, arguments)
    print(said)


def check(arguments: RedecodeArguments) -> None:
    """Check before anything slow: a sensible resolution, an output that is new or empty."""
    if arguments.resolution < 2:
        raise UserError(f"--resolution {arguments.resolution}: at least 2 cells are needed; 256 is usual")
    from sl_nerfstudio.storage import NewFolder

    NewFolder(arguments.output).close(complete=False)


def redecode_trained(trained: "TrainedRun", arguments: RedecodeArguments) -> str:
    """Decode the scan of a loaded run again; returns the summary to print."""
    from sl_nerfstudio.redecoding.redecode import redecode_run

    found = redecode_run(trained, arguments.output, arguments.resolution)
    return summary(arguments.output, trained.config.method_name, found)


def summary(output: Path, method: str, found: "Redecoded") -> str:
    """What became of the pixels, which frames were left as they are, and what to do next."""
    confirmed = found.total("confirmed") / max(found.total("checked"), 1)
    lines = [
        f"{output}: {found.share_after:.1%} of the pixels that show the pattern are decoded, "
        f"{found.share_before:.1%} before",
        f"  added {found.total('added'):,}, replaced {found.total('replaced'):,}, removed {found.total('removed'):,} "
        f"pixels; the images confirm {confirmed:.1%} of what was decoded before",
    ]
    left = [frame for frame in found.frames if frame.limits is None]
    elsewhere = [frame.accepted_elsewhere for frame in found.frames if frame.limits is not None]
    if elsewhere:
        share = sum(elsewhere) / len(elsewhere)
        lines.append(f"  at places of the pattern that are certainly wrong, {share:.1%} would have been accepted")
    if left:
        lines += _left(left)
    return "\n".join([*lines, next_steps([command("ns-train", method, "--data", output)])])


def _left(frames: "list[RedecodedFacts]") -> list[str]:
    """The frames that were left as they are, and why that may be."""
    names = ", ".join(frame.name for frame in frames[:_MOST_NAMED])
    more = f" and {len(frames) - _MOST_NAMED} more" if len(frames) > _MOST_NAMED else ""
    return [
        f"  left as they are: {names}{more}",
        "    At too few of their decoded pixels, the image shows the pattern where surface and poses predict it.",
        "    The image is too coarse or does not show this pattern, or the frame's poses are wrong.",
    ]


if __name__ == "__main__":
    main()

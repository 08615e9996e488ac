"""sl-synth: make a synthetic scan."""

from dataclasses import dataclass, field
from pathlib import Path

from sl_nerfstudio.cli.arguments import parse, require_paths
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, fitted, next_steps, phase
from sl_nerfstudio.synthesis.config import SynthConfig


@dataclass(frozen=True)
class SynthArguments:
    """Make a synthetic scan with its truth: a camera and a projector that move around a matte object.

    Lengths in flags are in millimetres, fractions are between 0 and 1.
    """

    output: Path
    """folder to write; it must be new or empty"""
    config: SynthConfig = field(default_factory=SynthConfig)


_GROUPS = {
    "the scene": ("scene", "appearance", "background", "units"),
    "the devices": ("path", "frames", "resolution", "pattern", "projector_model", "camera_distortion",
                    "projector_distortion", "supersampling", "sensor_noise"),
    "errors of coordinates and poses": ("noise", "missing", "wrong", "pose_error",
                                                           "autocalibration_error", "clean"),
    "what is written": ("images_only", "scale_known", "pose_sigma", "world_turn", "seed"),
}  # fmt: skip


def main() -> None:
    """Entry point of the command."""
    run(_synthesise)


def _synthesise() -> None:
    arguments = parse(SynthArguments, "sl-synth", groups=_GROUPS)
    scene = Path(arguments.config.scene)
    mesh = scene if scene.suffix else None
    pattern = arguments.config.pattern, "give a pattern.json or an image"
    require_paths({"--scene": (mesh, "give a mesh file, or the name of a scene (--help)"), "--pattern": pattern})
    arguments.config.check()
    with phase("render"):
        # slow to import: torch, open3d
        from sl_nerfstudio.synthesis.boards import BOARDS, write_board_captures
        from sl_nerfstudio.synthesis.synthesise import synthesise

        board = arguments.config.scene in BOARDS
        (write_board_captures if board else synthesise)(arguments.config, arguments.output)
    print(f"wrote {arguments.config.frames} {'poses of a board' if board else 'frames'} to {arguments.output}")
    print(_next_of_board(arguments) if board else _next(arguments.output, arguments.config))


def _next_of_board(arguments: SynthArguments) -> str:
    from sl_nerfstudio.cli.pattern import calibrate_command
    from sl_nerfstudio.synthesis.boards import BOARDS

    images, pattern = arguments.output / "images", arguments.output / "pattern.json"
    return next_steps([calibrate_command(BOARDS[arguments.config.scene], images, pattern)])


def _next(output: Path, config: SynthConfig) -> str:
    """Say how to go on with what was made."""
    if not config.images_only:
        return next_steps([command("ns-train", "sl-neus", "--data", output)])
    pattern = output / "pattern.json"
    if not pattern.exists():
        return fitted(
            "sl-process cannot decode these captures: their pattern is a picture without the codes that pattern.json "
            "holds. They can be the pictures without the pattern of another scan (sl_color_path)"
        )
    files = ("--images", output / "images", "--pattern", pattern)
    return next_steps([command("sl-process", *files, "--intrinsics", output / "intrinsics.json", "--output", "scan")])


if __name__ == "__main__":
    main()

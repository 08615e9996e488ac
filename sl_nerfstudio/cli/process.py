"""sl-process: from photographs to a scan folder."""

from typing import TYPE_CHECKING

from sl_nerfstudio.cli.arguments import PHOTOGRAPHS, parse
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import command, next_steps, phase, say
from sl_nerfstudio.processing.config import ProcessConfig

if TYPE_CHECKING:
    from sl_nerfstudio.processing.process import Watch
    from sl_nerfstudio.processing.result import ProcessResult


_INPUTS = {
    "images": "give the folder with the captures",
    **PHOTOGRAPHS,
    "projector_intrinsics": PHOTOGRAPHS["intrinsics"],
    "poses": "give a transforms.json with rough poses",
}
_GROUPS = {
    "devices": ("intrinsics", "projector_intrinsics", "projector_model", "procam_step", "rig", "estimate_projector"),
    "captures": ("decoder", "sequence", "cell", "unordered", "not_mosaic", "full_size"),
    "lengths and poses": ("known_length", "poses", "no_adjust"),
    "what is used of the pictures": ("masks", "object_only", "color"),
    "this run": ("work", "jobs", "device", "seed"),
}


def main() -> None:
    """Entry point of the command."""
    run(_process)


def _process() -> None:
    result = process_photographs(parse(ProcessConfig, "sl-process", _INPUTS, _GROUPS))
    kept = (
        f"decoded frames and poses are kept in {result.config.work_folder}: the same command with another length,\n"
        "    other flags or another output takes them from there; remove this folder once you are happy with the scan"
    )
    print(
        findings(result), kept, next_steps([command("ns-train", "sl-neus", "--data", result.config.output)]), sep="\n"
    )


def process_photographs(config: ProcessConfig, watch: "Watch | None" = None) -> "ProcessResult":
    """Make the scan folder with its report; for `watch` see `process`. Raises UserError for what a user can correct."""
    config.check()
    with phase("start"):
        from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
        from sl_nerfstudio.processing.process import process

    return process(config, render_processing_report, say, watch)


def findings(result: "ProcessResult", what: str = "") -> str:
    """The verdict (on `what`), the frames that were left out, and where the report is."""
    from sl_nerfstudio.processing.result import first_line

    output = result.config.output
    lost = [f"  left out: {f.name}: {first_line(f.reason)}\n" for f in result.frames if not f.in_scan]
    reasons = "".join(f"  {reason}\n" for reason in result.verdict.reasons)
    scale = f"lengths in {result.units} ({result.scale_source})"
    if not result.scale_source:
        some = next((frame.name for frame in result.frames if frame.in_scan), "0")
        scale = (
            "no length is known: the same command with\n"
            f"{command('--known-length', f'baseline of frame {some} = 85 mm', indent='    ')}\n"
            "    (as you measure it) adds one in seconds"
        )
    return (
        f"verdict{what}: {result.verdict.band}\n{reasons}"
        f"wrote {result.registered} of {len(result.frames)} frames to {output}, {scale}\n{''.join(lost)}"
        f"report: {output / 'processing.html'}"
    )


if __name__ == "__main__":
    main()

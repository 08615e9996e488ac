"""`sl-check DIR`: every fault of a scan folder at once, or those of a training run."""

import math
import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from sl_nerfstudio.cli.arguments import SCAN, parse, require_paths
from sl_nerfstudio.cli.run import run
from sl_nerfstudio.console import phase, unit_word

if TYPE_CHECKING:
    from sl_nerfstudio.review.agreement import CrossFrameAgreement
    from sl_nerfstudio.review.verdict import Help
    from sl_nerfstudio.scan.check import FolderCheck

# The part of `sl-check` that checks a training run instead of a scan.


def is_run(path: Path) -> bool:
    """Whether a path is the folder or the config.yml of a training run."""
    if path.is_dir():
        return (path / "config.yml").is_file() and not (path / "transforms.json").exists()
    return path.suffix in (".yml", ".yaml")


def check_run_folder(path: Path) -> str:
    """What the run is and what there is of it. Raises UserError for anything that is wrong."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # nerfstudio's own, at its import
        from sl_nerfstudio.runs.run import check_run

    found = check_run(path)
    config, step, last = found.config, found.last.step, found.config.last_step
    state = "poses adjusted, no step yet" if step < 0 else f"step {step}"
    if last is not None:
        state += ", complete" if step >= last else f" of {last}: interrupted, or still in training"
    there = "is there and unchanged" if found.has_scan else "is not there, so it was not compared"
    return (
        f"{found.folder}: no faults\n"
        f"  method              {config.method_name}\n"
        f"  state               {state}\n"
        f"  checkpoints         {found.checkpoints}, the last is {found.last.path.name}\n"
        f"  scan                {found.scan} {there}\n"
    )


@dataclass(frozen=True)
class CheckArguments:
    """List every fault of a scan folder at once: file, frame, field, likely cause, what to do.

    Reads transforms.json and decodes every file; training makes the same check before it starts. Without faults it
    prints a short summary, a verdict on the starting poses and what is doubtful, and exits with status 0; otherwise it
    prints all faults and exits with status 1.

    For a training run, checks without running anything from it: config.yml, the checkpoints, and whether they and the
    scan belong together.
    """

    folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
    """the scan folder, which holds transforms.json; or a run's folder or its config.yml"""
    output: Path | None = None
    """if there are no faults, write the scan to this new folder, with coordinates in images as .npz in pattern pixels;
    everything else stays as it is"""


def main() -> None:
    """Entry point of `sl-check`."""
    run(lambda: check(parse(CheckArguments, "sl-check")))


def check(arguments: CheckArguments) -> None:
    """Do what the command line asks for. Raises UserError with everything that is wrong."""
    folder, output = arguments.folder, arguments.output
    require_paths({"DIR": (folder, SCAN)})
    if output is not None:
        _require_new(output, folder)
    with phase("check"):
        said = check_run_folder(folder) if is_run(folder) else check_scan_folder(folder, output)
    sys.stdout.write(said)


def _require_new(output: Path, folder: Path) -> None:
    """Before anything slow. Raises UserError if the output cannot be written, or `folder` is no scan."""
    from sl_nerfstudio.errors import UserError
    from sl_nerfstudio.storage import NewFolder

    if is_run(folder):
        raise UserError(
            f"--output {output}: {folder} is a training run, of which no copy is written\n"
            "    cause:  --output writes scans\n    remedy: leave --output out, or give the scan folder"
        )
    NewFolder(output).close(complete=False)


def check_scan_folder(folder: Path, output: Path | None = None) -> str:
    """What the scan is, and how its frames agree; then written to `output`. Raises ScanError for all that is wrong."""
    from sl_nerfstudio.errors import ScanError
    from sl_nerfstudio.scan.check import check_folder

    result = check_folder(folder)
    if result.faults:
        raise ScanError(result.faults, str(folder))
    scan, said = result.scan, ""
    if scan is not None:
        with phase("comparing the frames"):
            from sl_nerfstudio.review.agreement import compare_scan_frames, shared_surface_of_scan
            from sl_nerfstudio.review.moving_part import moving_share

            cross = compare_scan_frames(scan, scan.poses, [frame.pose_sigma for frame in scan.frames])
            said = agreement(result, cross, shared_surface_of_scan(scan).decoded, moving_share(scan))
        if output is not None:
            from sl_nerfstudio.scan.write import write_copy

            write_copy(scan, output)
            said += f"  written             {output}, with coordinates as .npz\n"
    return summary(result) + said


_HELP: "dict[Help, str]" = {
    "again": "leave it out of transforms.json, or capture it again and run sl-process",
    "between": "capture views in between, and register all with sl-process",
    "light": "capture it again with more light from the projector and less from the room",
    "poses": "if the poses are only rough, state how much (sl_pose_sigma): ns-train sl-neus refines them; else "
    "find them anew with sl-process",
}


def agreement(
    result: "FolderCheck",
    cross: "CrossFrameAgreement",
    shared_decoded: Sequence[float | None],
    moving: float | None = None,
) -> str:
    """What the coordinates of the frames say about each other under the starting poses, and the verdict.

    `shared_decoded`: of the surface that others show, how much each frame decoded; None where not known.
    `moving`: the share that moves before cameras in one place; None if nothing does.
    """
    from sl_nerfstudio.review.verdict import FrameFacts, ScanFacts, judge_scan

    usable = [content.name for content in result.contents if content.correspondences is not None]
    fit = result.fit
    rays = {} if fit is None else dict(zip(usable, zip(fit.residual_px, fit.stated_px, strict=True), strict=True))
    frames = []
    for content, shared in zip(result.contents, shared_decoded, strict=True):
        px, stated_px = rays.get(content.name, (math.nan, math.nan))
        facts = FrameFacts(content.name, decode_rate=content.decoded, shared_decoded=shared)
        known = not math.isnan(stated_px)
        frames.append(replace(facts, rays_px=float(px), stated_px=float(stated_px)) if known else facts)
    verdict = judge_scan(ScanFacts(tuple(frames), cross=cross, moving_share=moving)).with_help(_HELP)
    seen = [frame.seen for frame in cross.frames]
    scan = result.scan
    stated = scan is not None and any(frame.pose_sigma is not None for frame in scan.frames)
    allowed = f"the noise of {cross.noise_px:.2g} px{' and the stated sl_pose_sigma' if stated else ''}"
    lines = [
        f"  coverage            {100 * min(seen):.0f} to {100 * max(seen):.0f} % of a frame's points seen by others",
        f"  frames differ       by {cross.px_median:.2g} px (median), {cross.px_p95:.2g} px (95 %) under these poses;",
        f"                      {cross.share:.0%} of that within what {allowed} allow{'' if stated else 's'}",
        f"  verdict             {verdict.band}",
        *(f"  warning             {reason}" for reason in verdict.reasons),
    ]
    return "\n".join(lines) + "\n"


def summary(result: "FolderCheck") -> str:
    """The main facts about a good scan, in a few lines."""
    scan, fit = result.scan, result.fit
    if scan is None or fit is None:
        raise ValueError("a scan with faults has no summary")
    sizes = sorted({(frame.camera.w, frame.camera.h) for frame in scan.frames})
    unit = unit_word(scan.units)
    decoded = [content.decoded for content in result.contents]
    lines = [
        f"{scan.root}: no faults",
        f"  frames              {len(scan.frames)}, {', '.join(f'{w} x {h}' for w, h in sizes)} pixels",
        f"  projector           {scan.projector.model}, {scan.projector.w} x {scan.projector.h} pixels",
        f"  units               {scan.units}, scale {'known' if scan.scale.known else 'unknown'}"
        + (f" ({scan.scale.source})" if scan.scale.source else ""),
        f"  working distance    {fit.depth:.4g} {unit} (median)",
        f"  decoded             {100 * min(decoded):.0f} to {100 * max(decoded):.0f} % of the masked pixels",
        f"  starting poses      epipolar residual {fit.typical_px:.2g} px (median)",
    ]
    whole = [content.name for content in result.contents if content.masked == 1]
    if whole:
        lines.append(f"  note                the mask covers the whole image in {', '.join(whole)}")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()

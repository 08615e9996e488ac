"""Matching along epipolar lines alone: pixels kept, their errors against the truth, and processor seconds.

    python -m benchmarks.matching --captures FOLDER ... [--each 8] [--output FILE]

Folders are those of `benchmarks.photographs`. What is decoded there is not decoded again; relative poses are those that
sl-process finds. Every lit pixel counts, the surroundings' too.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from benchmarks.common.measuring import Rows, measured, options
from benchmarks.photographs.scoring import WRONG_PX, read_truth
from benchmarks.photographs.sets import WORK
from sl_nerfstudio.decoding.grid import NetworkDecoder
from sl_nerfstudio.matching.matcher import DecodedImage, LineMatcher
from sl_nerfstudio.parallel import only_one_library_thread
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.frames import FrameWorker
from sl_nerfstudio.processing.inputs import read_inputs
from sl_nerfstudio.scan.images import as_grey, read_photograph

_EXACT_PX = 0.5


@dataclass(frozen=True)
class Row:
    """Figures of one set, over all its frames; shares of the lit pixels, unless said otherwise."""

    name: str
    frames: int
    left: int  # frames that were left as they were decoded
    decoded: float  # before matching
    kept: float
    right: float  # kept and less than 2 pattern pixels off
    exact: float  # kept and less than half a pattern pixel off
    wrong: float  # of the kept ones that are lit
    unlit: float  # of the kept ones where no light falls
    median_px: float
    cpu_seconds: float  # a frame; of the first set of a first run, with compilation


def measure(captures: Path, each: int) -> Row:
    """Match every frame whose number is a multiple of `each`."""
    truth = read_truth(captures)
    job = read_inputs(ProcessConfig(
        images=captures / "images", pattern=captures / "pattern.json", intrinsics=captures / "intrinsics.json",
        output=captures / "scan", work=captures / WORK,
    ))  # fmt: skip
    assert isinstance(job.job.decoder, NetworkDecoder)
    worker, matcher = FrameWorker(replace(job.job, last_step="calibrate")), LineMatcher(job.job.decoder.layout)
    found: list[tuple[Float32[ndarray, "h w 2"], Float32[ndarray, "h w 2"], Float32[ndarray, "h w 2"]]] = []
    seconds, left = 0.0, 0
    for frame in job.captures.frames[::each]:
        result = worker(frame)
        if result.cloud is None or result.cloud.pose.alternatives:
            continue
        decoded, pose = worker.load(result), result.cloud.pose.T_camera_projector
        image = DecodedImage(as_grey(read_photograph(frame.images[0])), decoded.coords, decoded.mask)
        devices = job.job.camera_of(frame), job.job.projector
        coords, part = measured(lambda image=image, pose=pose, devices=devices: matcher.match(image, *devices, pose))
        seconds += part.cpu_seconds
        left += coords is image.coords
        found.append((truth.frames[frame.name].frame.read_coords(), image.coords, coords))
    true, before, after = (np.stack(part) for part in zip(*found, strict=True))
    lit, error = np.isfinite(true[..., 0]), np.linalg.norm(after - true, axis=-1)
    kept = np.isfinite(after[..., 0])
    return Row(
        captures.name, len(found), left,
        decoded=float(np.isfinite(before[..., 0])[lit].mean()),
        kept=float(kept[lit].mean()),
        right=float((error[lit] < WRONG_PX).mean()),
        exact=float((error[lit] < _EXACT_PX).mean()),
        wrong=float((error[kept & lit] >= WRONG_PX).mean()),
        unlit=float((kept & ~lit).sum() / kept.sum()),
        median_px=float(np.median(error[kept & lit])),
        cpu_seconds=seconds / len(found),
    )  # fmt: skip


def main() -> None:
    """Print a line for each set, and write all to JSON."""
    args = options(__doc__, captures=[""], each=8, output=Path)
    only_one_library_thread()
    rows: Rows[Row] = Rows(args.output)
    for captures in map(Path, args.captures):
        rows.add(measure(captures, args.each))


if __name__ == "__main__":
    main()

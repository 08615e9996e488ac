"""The scan folder of the frames that were placed, with the report on all of them."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.bundle_adjustment.registered_frames import AdjustedFrames
from sl_nerfstudio.decoding.decoders import Layout
from sl_nerfstudio.pattern.files import encode_gray_code, encode_grid
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.processing.frame_stage import FrameJob, FrameOutcome, FrameWorker
from sl_nerfstudio.processing.preview import Preview, make_preview
from sl_nerfstudio.processing.result import ProcessResult
from sl_nerfstudio.progress import track
from sl_nerfstudio.registration.frame_cloud import FrameCloud
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.images import read_image
from sl_nerfstudio.scan.types import Scale
from sl_nerfstudio.scan.writing import ScanWriter, encode_json


def write_scan(
    root: Path,
    job: FrameJob,
    outcomes: Sequence[FrameOutcome],
    clouds: Sequence[FrameCloud],
    joint: AdjustedFrames,
    units: str,
    scale: Scale,
    result: ProcessResult,
    make_report: Callable[[ProcessResult, Sequence[Preview]], str],
) -> None:
    """Write all frames that `joint` has poses of. The folder is new, and complete or not there at all."""
    layout = job.layout
    picture = layout.finest() if isinstance(layout, GrayCode) else layout.render(4)
    row = {cloud.name: k for k, cloud in enumerate(clouds)}
    worker = FrameWorker(job)
    size = (job.projector.w, job.projector.h)
    previews: list[Preview] = []
    with ScanWriter(
        root,
        units=units,
        scale=scale,
        projector=job.projector,
        pattern=np.rint(255 * picture).astype(np.uint8),
        camera=job.camera,
    ) as writer:
        for outcome, record in zip(track(outcomes, "writing"), result.frames, strict=True):
            image = _image(outcome)
            cloud = outcome.cloud
            previews.append(make_preview(image, None if cloud is None else cloud.coords, size))
            if not record.in_scan or cloud is None or image is None:
                continue
            decoded, k = worker.load(outcome), row[outcome.name]
            writer.add_frame(
                outcome.name,
                image=image,
                coords=cloud.coords,
                mask=decoded.mask,
                pattern=np.rint(255 * decoded.pattern).astype(np.uint8),
                T_world_camera=joint.poses.T_world_camera[k],
                T_world_projector=joint.poses.T_world_projector[k],
                pose_sigma=joint.sigma[k],
            )
        writer.add_file("pattern.json", _description(layout))
        writer.add_file("processing.json", encode_json(result.document()))
        writer.add_file("processing.html", make_report(result, previews).encode())


def _image(outcome: FrameOutcome) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None:
    """The capture (of a Gray-code sequence its first image, in full light); None if it cannot be read."""
    try:
        return read_image(outcome.frame.images[0])
    except FileError:
        return None


def _description(layout: Layout) -> bytes:
    return encode_gray_code(layout) if isinstance(layout, GrayCode) else encode_grid(layout)

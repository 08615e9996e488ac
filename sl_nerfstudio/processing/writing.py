"""The scan folder of the registered frames, with the report on all frames."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.files.new_folder import NewFolder
from sl_nerfstudio.object_separation.separate import Part
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.sequence import Shown
from sl_nerfstudio.processing.failures import REPORT
from sl_nerfstudio.processing.frame_worker import FrameJob, FrameStageResult, FrameWorker, clouds_of
from sl_nerfstudio.processing.preview import Preview, make_preview
from sl_nerfstudio.processing.result import ProcessResult
from sl_nerfstudio.processing.scan_poses import ScanPoses
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.photographs import read_photograph
from sl_nerfstudio.scan.writing import ScanWriter, encode_json

_SUPERSAMPLING = 4  # of pattern.png


def write_scan(
    folder: NewFolder,
    job: FrameJob,
    results: Sequence[FrameStageResult],
    poses: ScanPoses,
    result: ProcessResult,
    make_report: Callable[[ProcessResult, Sequence[Preview]], str],
) -> None:
    """Write all frames that are in the scan by `result`. Leaving the folder completes it."""
    layout = job.decoder.layout
    shown = layout.place(Shown("white")) or 0 if isinstance(layout, GrayCode) else 0
    row = {cloud.name: k for k, cloud in enumerate(clouds_of(results))}
    worker = FrameWorker(job)
    size = (job.projector.w, job.projector.h)
    previews: list[Preview] = []
    with ScanWriter(
        folder.root,
        units=poses.units,
        scale=poses.scale,
        projector=job.projector,
        projector_extra=None if result.projector is None else {"intrinsics_sigma": result.projector.sigmas()},
        pattern=np.rint(255 * layout.render(_SUPERSAMPLING)).astype(np.uint8),
        camera=job.camera,
        within=folder,
    ) as writer:
        for frame, record in zip(track(results, "writing"), result.frames, strict=True):
            image = _image(frame, shown)
            cloud = frame.cloud
            part = None if result.object_only is None else result.object_only.parts.get(frame.name)
            previews.append(make_preview(image, None if cloud is None else cloud.coords, size, part, len(results)))
            if not record.in_scan or cloud is None or image is None:
                continue
            decoded, k = worker.load(frame), row[frame.name]
            keep = np.ones_like(decoded.mask) if part is None else part == Part.OBJECT
            writer.add_frame(
                frame.name,
                image=image,
                coords=np.where(keep[..., None], cloud.coords, np.float32(np.nan)),
                mask=decoded.mask & keep,
                pattern=np.rint(255 * decoded.pattern * keep).astype(np.uint8),
                camera=job.camera_of(frame.frame) if job.cameras else None,
                T_world_camera=poses.adjusted.poses.T_world_camera[k],
                T_world_projector=poses.adjusted.poses.T_world_projector[k],
                pose_sigma=poses.adjusted.sigma[k],
            )
        writer.add_file("pattern.json", layout.encode())
        writer.add_file("processing.json", encode_json(result.document()))
        writer.add_file(REPORT, make_report(result, previews).encode())


def _image(frame: FrameStageResult, shown: int) -> UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None:
    """The capture (of a sequence the image in full light, by its place); None if it cannot be read."""
    try:
        return read_photograph(frame.frame.images[shown])
    except (FileError, IndexError):
        return None

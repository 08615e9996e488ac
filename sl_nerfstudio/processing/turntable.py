"""A turntable before a static background: frames without what stands still, so that what turns can be registered."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool
from numpy import ndarray

from sl_nerfstudio.processing.consistency import ConsistentFrames
from sl_nerfstudio.processing.frames import FrameStageResult, clouds_of, with_kept_cloud
from sl_nerfstudio.processing.masks import find_masks
from sl_nerfstudio.processing.projector import CalibratedFrames, with_one_pose
from sl_nerfstudio.processing.records import LargeClouds
from sl_nerfstudio.registration.surfaces import FrameCloud, frame_cloud
from sl_nerfstudio.relative_pose.estimation import RelativePoseError
from sl_nerfstudio.review.moving_part import MovingPart, find_moving_part, in_one_place
from sl_nerfstudio.review.verdict import cross_reasons, worst
from sl_nerfstudio.scan.images import encode_png, photograph_header
from sl_nerfstudio.storage import write_atomic

MASKS = "moving"  # folder of the masks, in the work folder
_LEAST_FRAMES = 0.5  # share of the frames that must be registered for it to count


def moving_part(results: Sequence[FrameStageResult], consistent: ConsistentFrames) -> MovingPart | None:
    """What moves before cameras that the registration has put in one place; None if nothing does."""
    clouds, adjusted = clouds_of(results), consistent.adjusted
    return find_moving_part(
        [c.camera for c in clouds], clouds[0].projector, adjusted.poses, (c.coords for c in clouds), adjusted.sigma
    )


def only_moving(frames: CalibratedFrames, part: MovingPart, rigid: bool) -> CalibratedFrames:
    """The frames with what moves alone; their relative poses stay those of the whole picture.

    `rigid`: all get one. The masks are written to the work folder, for `--masks` once they are corrected. Frames in
    which hardly anything moves are left out. Raises UserError if no pose fits all frames.
    """
    folder, kept, sizes = frames.job.work / MASKS, LargeClouds(), {}
    results = {result.name: result for result in frames.results}
    shown = [result for result in frames.results if result.cloud is not None]
    for result, mask in zip(with_one_pose(frames.job, shown) if rigid else shown, part.masks, strict=True):
        results[result.name] = result
        if result.cloud is None:
            continue
        photograph = result.frame.images[0]
        try:
            results[result.name] = with_kept_cloud(replace(result, cloud=_masked(result.cloud, mask)), kept)
        except RelativePoseError:
            results[result.name] = result.failed("registering", _NOTHING_MOVES.format(photograph))
            continue
        header = photograph_header(photograph)
        sizes[result.name] = header.w, header.h
        whole = _as_photographed(mask, sizes[result.name], result.frame.shrink)
        write_atomic(folder / f"{result.name}.png", encode_png(255 * whole.astype(np.uint8)))
    masks = find_masks(folder, sizes, frames.job.shrink) if sizes else frames.job.masks
    return replace(frames, job=replace(frames.job, masks=masks), results=list(results.values()))


_NOTHING_MOVES = (
    "{}: hardly anything in it moves against the other frames\n"
    "    cause:  a turntable with a static background, and an object that is hidden, or not turned in this frame\n"
    "    remedy: capture this view again; cover the background"
)


def _as_photographed(mask: Bool[ndarray, "a b"], size: tuple[int, int], shrink: int) -> Bool[ndarray, "h w"]:
    """The mask of a photograph of `size` (w, h) that was read with squares of `shrink` pixels as one."""
    whole = np.zeros(size[::-1], dtype=bool)
    large = mask.repeat(shrink, axis=0).repeat(shrink, axis=1)
    whole[: large.shape[0], : large.shape[1]] = large
    return whole


def _masked(cloud: FrameCloud, mask: Bool[ndarray, "h w"]) -> FrameCloud:
    """The points of a frame inside a mask. Raises RelativePoseError where hardly any is."""
    column, row = cloud.uv_camera.astype(np.int64).T
    inside = mask[row, column]
    coords = np.where(mask[..., None], cloud.coords, np.float32(np.nan))
    noise = cloud.pose.noise_px[cloud.pose.inliers][inside]
    pose = replace(cloud.pose, inliers=np.ones(len(noise), bool), noise_px=noise, alternatives=())
    return frame_cloud(cloud.name, coords, cloud.camera, cloud.projector, pose, light=cloud.light, seen=cloud.seen)


def agrees_with_itself(found: ConsistentFrames, results: Sequence[FrameStageResult]) -> bool:
    """Whether what moves was registered: most frames, not in one place again, and without a contradiction."""
    registered, clouds = found.registration.registered, clouds_of(results)
    if registered.sum() < _LEAST_FRAMES * len(results):
        return False
    names = [name for name, inside in zip(found.registration.names, registered, strict=True) if inside]
    first = int(np.argmax(registered))
    depth = float(np.median(-clouds[first].points[:, 2])) * float(found.adjusted.poses.baseline[first])
    return not in_one_place(found.adjusted.poses, depth) and worst(cross_reasons(names, found.cross)).band != "poor"

"""`--object-only`: which part every pixel of the registered frames shows; with small pictures for the report."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.object_separation.planes import DecodedFrame, PlaneFinding, Verdict
from sl_nerfstudio.object_separation.separate import Part, separate
from sl_nerfstudio.processing.frames import FrameJob, FrameStageResult, FrameWorker, clouds_of, with_clouds
from sl_nerfstudio.processing.scan_poses import ScanPoses
from sl_nerfstudio.registration.result import Registration
from sl_nerfstudio.scan.images import as_grey
from sl_nerfstudio.scan.types import Scale


@dataclass(frozen=True)
class FrameShares:
    """What the decoded pixels of a frame show, as shares of them."""

    name: str
    object: float
    plane: float
    beyond: float


@dataclass(frozen=True)
class ObjectOnly:
    """The object and what was left out; lengths in the unit of the scan, planes in its axes."""

    planes: tuple[PlaneFinding, ...]  # all that were judged
    left_out: tuple[PlaneFinding, ...]  # those that are not in the scan
    frames: tuple[FrameShares, ...]
    parts: dict[str, UInt8[ndarray, "h w"]]  # `Part` of every pixel, by the frame's name

    def keeps(self, frame: str) -> Bool[ndarray, "h w"]:
        """The pixels of a frame that show the object."""
        return self.parts[frame] == Part.OBJECT

    def shares(self) -> FrameShares:
        """Mean shares of all frames; each counts alike."""
        means = np.mean([(f.object, f.plane, f.beyond) for f in self.frames], axis=0).tolist()
        return FrameShares("all", *means)

    def empty_frames(self) -> tuple[str, ...]:
        """Frames in which nothing of the object was decoded."""
        return tuple(frame.name for frame in self.frames if frame.object == 0)

    def usable_scale(self, scale: Scale) -> Scale:
        """The scale without a reference to what was left out: a frame, or a pixel.

        The scan has its unit already; only a later adjustment could have looked at the length again.
        """
        lost = set(self.empty_frames())
        picked = () if scale.bar is None else scale.bar.ends
        gone = lost & set(scale.frames) or any(
            not self.keeps(end.frame)[int(end.pixel[1]), int(end.pixel[0])] for end in picked if end.frame in self.parts
        )
        return Scale(scale.known, scale.source) if gone else scale


def find_object_only(
    job: FrameJob, results: Sequence[FrameStageResult], registration: Registration, poses: ScanPoses
) -> ObjectOnly:
    """Separate the object in all registered frames."""
    worker = FrameWorker(job)
    by_name = {result.name: result for result in results}
    names, frames = [], []
    for k, cloud in enumerate(clouds_of(results)):
        if registration.registered[registration.names.index(cloud.name)]:
            names.append(cloud.name)
            devices = poses.adjusted.poses
            frames.append(DecodedFrame(
                cloud.camera, cloud.projector, devices.T_world_camera[k], devices.T_world_projector[k], cloud.coords,
                worker.load_mask(by_name[cloud.name]),
            ))  # fmt: skip
    found = separate(frames, job.seed)
    tracked = enumerate(zip(names, track(frames, "object only"), strict=True))
    parts = {name: found.parts(k, frame) for k, (name, frame) in tracked}
    shares = tuple(_shares(name, parts[name], frame.coords) for name, frame in zip(names, frames, strict=True))
    return ObjectOnly(found.findings, tuple(s.finding for s in found.surroundings), shares, parts)


def only_object(
    registration: Registration, results: Sequence[FrameStageResult], found: ObjectOnly
) -> tuple[Registration, list[FrameStageResult]]:
    """The registered frames that show the object, and all frames with nothing but the object: what is judged."""
    empty = np.isin(registration.names, found.empty_frames())
    clouds = [
        replace(c, coords=np.where(found.keeps(c.name)[..., None], c.coords, np.float32(np.nan)))
        if c.name in found.parts else c
        for c in clouds_of(results)
    ]  # fmt: skip
    return replace(registration, registered=registration.registered & ~empty), with_clouds(results, clouds)


def _shares(name: str, part: UInt8[ndarray, "h w"], coords: Float[ndarray, "h w 2"]) -> FrameShares:
    shown = part[all_finite(coords) & (part != Part.NOTHING)]
    count = max(len(shown), 1)
    return FrameShares(name, *(float((shown == kind).sum() / count) for kind in (Part.OBJECT, Part.PLANE, Part.BEYOND)))


# What `--object-only` found, in words and as JSON.

_BECAUSE: dict[Verdict, str] = {
    "leaves the views": "all cameras are in front of it, nothing is behind it, and it continues beyond the views",
    "object stands on it": "it is far larger than the object, which stands on it",
    "cameras on both sides": "cameras are on both sides of it",
    "surface behind it": "there is surface behind it",
    "nothing on it": "nothing is in front of it",
    "edges seen": "its edges are seen, and what rises from it is flat or nearly as large: it may be the object itself",
}


def object_sentences(found: ObjectOnly) -> tuple[str, ...]:
    """What was left out and what was kept, the most important first."""
    shares, begin = found.shares(), "no plane was left out"
    if found.left_out:
        begin = f"left out {shares.plane:.0%} of the decoded pixels as planes around the object"
    lines = [f"{begin}, and {shares.beyond:.1%} as not connected to it; {shares.object:.0%} show the object"]
    if found.planes and not found.left_out and any(plane.is_surroundings for plane in found.planes):
        lines.append("hardly anything would have been left without its planes, so they were kept")
    lines += [plane_sentence(plane, plane in found.left_out) for plane in found.planes]
    empty = found.empty_frames()
    if empty:
        lines.append(f"frames without any of the object, not in the scan: {', '.join(empty)}")
    return tuple(lines)


def plane_sentence(plane: PlaneFinding, left_out: bool) -> str:
    """Why a plane was left out or kept."""
    what = "left out" if left_out else "kept"
    return f"plane with {plane.share:.0%} of the points {what}: {_BECAUSE[plane.verdict]}"


def object_document(found: ObjectOnly) -> dict[str, Any]:
    """Figures for processing.json; planes are `normal . p = offset` in the axes and the unit of the scan."""
    shares = found.shares()
    return {
        "object": shares.object,
        "planes_left_out": shares.plane,
        "beyond_left_out": shares.beyond,
        "planes": [
            {
                "normal": plane.plane.normal.tolist(),
                "offset": float(plane.plane.offset),
                "share": plane.share,
                "left_out": plane in found.left_out,
                "because": _BECAUSE[plane.verdict],
            }
            for plane in found.planes
        ],
        "frames": [dict(vars(frame)) for frame in found.frames],
    }


# Small pictures of a frame for the report.

_SIDE, _SMALLEST = 640, 200  # longest side of a picture, pixels
_PICTURES = 60  # of that size: about 3 MB in the report; those of more frames are smaller
_TINTS = {Part.PLANE: (0.85, 0.15, 0.1), Part.BEYOND: (0.95, 0.6, 0.0)}
_TINT = 0.6  # opacity


@dataclass(frozen=True)
class Preview:
    """A capture and its decoded coordinates, RGB in [0, 1]; None where there is nothing to show."""

    image: Float32[ndarray, "h w 3"] | None
    coords: Float32[ndarray, "h w 3"] | None
    left_out: Float32[ndarray, "h w 3"] | None = None  # the capture with surroundings in colour


def make_preview(
    image: UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"] | None,
    coords: Float32[ndarray, "_h _w 2"] | None,
    size: tuple[int, int],
    part: UInt8[ndarray, "_h _w"] | None = None,
    frames: int = 1,
) -> Preview:
    """Reduced pictures of one of `frames` frames.

    `part` is what each pixel shows (`Part`), if surroundings were looked for.
    `size` is the pattern's (w, h): x gives red, y gives blue; grey where nothing was decoded.
    """
    picture = colours = tinted = None
    side = max(_SMALLEST, round(_SIDE * min(1.0, _PICTURES / (2 * frames)) ** 0.5))
    if image is not None:
        grey = as_grey(_thinned(image, side))
        picture = np.repeat((grey / max(float(grey.max()), 1e-6))[..., None], 3, -1)
    if coords is not None:
        thin = _thinned(coords, side)
        place = np.nan_to_num(thin) / np.array(size, dtype=np.float32)
        colours = np.stack([place[..., 0], np.full(thin.shape[:2], 0.35), place[..., 1]], -1).astype(np.float32)
        colours[np.isnan(thin).any(-1)] = 0.85
    if picture is not None and part is not None:
        tinted, thin = picture.copy(), _thinned(part, side)
        for kind, colour in _TINTS.items():
            shown = thin == kind
            tinted[shown] = (1 - _TINT) * tinted[shown] + _TINT * np.array(colour, dtype=np.float32)
    return Preview(picture, colours, tinted)


def _thinned(pixels: ndarray, side: int) -> ndarray:
    """Every n-th row and column, so that no side is longer than `side`."""
    step = max(1, -(-max(pixels.shape[:2]) // side))
    return pixels[::step, ::step]

"""Whether frames agree with each other: coordinates of one, through its own two devices into those of another.

A point is triangulated in one frame and projected into another camera; the coordinate decoded *there* is compared with
where that frame's projector has the point. A point in front of what the other camera saw contradicts it: it would have
been seen instead. One behind it may be hidden and is not judged; if it is a contradiction, it shows the other way round,
where the other frame's points then lie in front.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe, place_anchors
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, linearise
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import project, unproject
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.threads import one_torch_thread
from sl_nerfstudio.verdict.decoding_noise import frame_noise
from sl_nerfstudio.verdict.settings import CrossFrameSettings


@dataclass(frozen=True)
class PairAgreement:
    """Two frames that saw some of the same surface."""

    frames: tuple[int, int]
    judged: int  # points of one that the other can judge, both ways
    share: float  # of these, how many agree
    px_p95: float  # 95 % of the residuals are smaller, pattern pixels


@dataclass(frozen=True)
class FrameCrossAgreement:
    """One frame against all others; NaN where nothing could be judged."""

    points: int  # that were triangulated and looked up
    seen: float  # share of these that at least one other frame can judge
    share: float  # of its judged points, those that agree: the median over its pairs
    px_median: float  # pattern pixels, the median over its pairs
    px_p95: float  # the same of the 95 % quantiles


@dataclass(frozen=True)
class CrossFrameAgreement:
    """All frames against each other, in the order of the frames."""

    noise_px: float  # of one look-up: the median over the frames
    share: float  # of all judged points, those that agree; NaN where nothing could be judged
    px_median: float
    px_p95: float
    frames: tuple[FrameCrossAgreement, ...]
    pairs: tuple[PairAgreement, ...]


@one_torch_thread()
def cross_frame_agreement(
    rig: Rig,
    maps: CoordinateMaps,
    sigma: Float[Tensor, "frames 12"],
    settings: CrossFrameSettings | None = None,
) -> CrossFrameAgreement:
    """Compare all frames. The scene must be normalised: origin at the object's centre, radius about one.

    `sigma` is 1 sigma of each frame's pose as a whole and of its projector against its camera (translation xyz and
    rotation xyz each), in the scene's unit and radian: what these explain is no contradiction.
    """
    s = settings or CrossFrameSettings()
    generator = torch.Generator().manual_seed(0)
    per_frame = max(1, min(s.pixels_per_frame, s.most_pixels // rig.frames))
    anchors = place_anchors(rig, maps, per_frame, generator)
    rows = observe(rig, anchors, maps, rig.frames, float("inf"), s.least_cosine, generator)
    linear = linearise(rig, anchors, rows, maps)
    noise = frame_noise(linear, anchors, rig.frames)
    usual = float(noise.nanmedian())
    noise = noise.nan_to_num(usual).clamp_max(s.largest_noise_ratio * usual)
    size = linear.residuals.cross.norm(dim=-1)
    expected = _expected_sigma(linear, anchors, rows, sigma, noise, s.footprint * _footprint(rig, anchors, maps))
    agrees = size < s.sigmas * expected
    judged = linear.residuals.cross_valid & (agrees | _in_front(rig, anchors, rows, maps))
    return _summary(rig.frames, anchors, rows.frame, rows.anchor, judged.numpy(), agrees.numpy(), size.numpy(), usual, s)


def _footprint(rig: Rig, anchors: Anchors, maps: CoordinateMaps) -> Float[Tensor, "frames"]:
    """Pattern pixels under one camera pixel: the median over each frame's points."""
    uv, _ = project(rig.camera[anchors.frame], anchors.d_camera)
    size = maps.look_up(anchors.frame, uv).jacobian.flatten(1).norm(dim=-1) / 2**0.5
    found = [size[anchors.frame == k] for k in range(rig.frames)]
    return torch.stack([x.median() if len(x) else torch.zeros((), dtype=size.dtype) for x in found])


def _expected_sigma(
    linear: Linearisation,
    anchors: Anchors,
    rows: Observations,
    sigma: Float[Tensor, "frames 12"],
    noise: Float[Tensor, "frames"],
    floor: Float[Tensor, "frames"],
) -> Float[Tensor, "rows"]:
    """1 sigma of each cross residual (root of the sum over both coordinates, for the poses' part), pattern pixels."""
    variance = noise**2 + floor**2
    # What an error of the anchor's own coordinate, or of its projector, does to its depth, and that to the residual.
    length2 = (linear.own_depth**2).sum(-1).clamp_min(1e-300)
    gain2 = (linear.cross_depth**2).sum(-1) / length2[rows.anchor]
    own = (linear.own_depth[:, :, None] * linear.own).sum(1) / length2[:, None]
    flat = sigma.reshape(len(sigma), 2, 6).transpose(0, 1).flatten() ** 2
    through_depth = (own**2 * flat[linear.own_columns]).sum(-1)[rows.anchor] * (linear.cross_depth**2).sum(-1)
    direct = (linear.cross**2 * flat[linear.cross_columns][:, None, :]).sum((1, 2))
    return (variance[rows.frame] + variance[anchors.frame[rows.anchor]] * gain2 + direct + through_depth).sqrt()


def _in_front(rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps) -> Tensor:
    """Whether a point is nearer to the other camera than what that camera saw in its place."""
    j, a = rows.frame, rows.anchor
    p_world = transform(rig.T_world_camera[anchors.frame[a]], (anchors.depth[:, None] * anchors.d_camera)[a])
    p_j = transform(inverse(rig.T_world_camera)[j], p_world)
    uv, _ = project(rig.camera[j], p_j)
    d_camera = unproject(rig.camera[j], uv)
    T = rig.T_camera_projector[j]
    d_projector = rotate(T, unproject(rig.projector, maps.look_up(j, uv).uv_projector))
    depth, beyond = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    return (beyond > 0) & (p_j.norm(dim=-1) < depth)  # False where the rays do not meet


def _summary(
    frames: int,
    anchors: Anchors,
    viewer: Tensor,
    anchor: Tensor,
    judged: ndarray,
    agrees: ndarray,
    size: ndarray,
    noise: float,
    settings: CrossFrameSettings,
) -> CrossFrameAgreement:
    """Figures of the pairs, the frames and all together."""
    source = anchors.frame.numpy()
    first, second = np.sort(np.stack([source[anchor.numpy()], viewer.numpy()]), 0)
    pair = np.where(judged, first * frames + second, -1)
    order = np.argsort(pair, kind="stable")
    bounds = np.flatnonzero(np.diff(pair[order], prepend=-2, append=-2))
    pairs = []
    for low, high in zip(bounds[:-1], bounds[1:], strict=True):
        mine = order[low:high]
        if judged[mine[0]] and len(mine) >= settings.fewest_judged:
            p95 = float(np.quantile(size[mine], 0.95))
            pairs.append((mine, PairAgreement(tuple(divmod(int(pair[mine[0]]), frames)), len(mine), float(agrees[mine].mean()), p95)))  # fmt: skip
    seen = np.zeros(len(source), bool)
    seen[anchor.numpy()[judged]] = True
    rows = [
        _frame(k, seen[source == k], [(p, float(np.median(size[mine]))) for mine, p in pairs if k in p.frames])
        for k in range(frames)
    ]
    everything = size[judged]
    return CrossFrameAgreement(
        noise_px=noise,
        share=float(agrees[judged].mean()) if len(everything) else float("nan"),
        px_median=_quantile(everything, 0.5),
        px_p95=_quantile(everything, 0.95),
        frames=tuple(rows),
        pairs=tuple(p for _, p in pairs),
    )


def _frame(k: int, seen: ndarray, pairs: Sequence[tuple[PairAgreement, float]]) -> FrameCrossAgreement:
    weight = np.array([p.judged for p, _ in pairs], np.float64)
    share, median, p95 = (
        _weighted_median(np.array(values), weight)
        for values in ([p.share for p, _ in pairs], [m for _, m in pairs], [p.px_p95 for p, _ in pairs])
    )
    return FrameCrossAgreement(len(seen), float(seen.mean()) if len(seen) else 0.0, share, median, p95)


def _weighted_median(values: Float[ndarray, "n"], weight: Float[ndarray, "n"]) -> float:
    if not len(values):
        return float("nan")
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])


def _quantile(values: Float[ndarray, "n"], q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")

"""Figures of cross-frame agreement: of pairs of frames, of each frame, and of the scan."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from sl_nerfstudio.verdict.settings import CrossFrameSettings


@dataclass(frozen=True)
class LookUps:
    """Points of one frame that another frame can judge."""

    frames: int
    source: Int[ndarray, "points"]  # frame of every point that was tried
    anchor: Int[ndarray, "n"]  # the point that was judged
    viewer: Int[ndarray, "n"]  # by which frame
    px: Float[ndarray, "n"]  # residual, pattern pixels
    normalised: Float[ndarray, "n"]  # in units of what noise and stated uncertainty explain, 1 sigma
    by_poses: Float[ndarray, "n"]  # share of the expected variance that comes from the stated uncertainty of the poses


@dataclass(frozen=True)
class PairAgreement:
    """Two frames that saw some of the same surface."""

    frames: tuple[int, int]
    judged: int  # points of one that the other can judge, both ways
    share: float  # of these, how many agree
    px_median: float  # residual, pattern pixels
    px_p95: float
    excess: float  # residual in units of what is expected, relative to the scan's better pairs


@dataclass(frozen=True)
class FrameCrossAgreement:
    """One frame against all others: medians over its pairs, weighted by judged points; NaN where it has no pair."""

    points: int  # that were looked up
    seen: float  # share of these that at least one other frame can judge
    share: float  # of its judged points, how many agree
    px_median: float  # pattern pixels
    px_p95: float
    excess: float


@dataclass(frozen=True)
class CrossFrameAgreement:
    """All frames against each other, in the order of the frames; NaN where nothing could be judged."""

    noise_px: float  # of one look-up: the median over the frames, pattern pixels
    share: float  # of all judged points, how many agree
    px_median: float
    px_p95: float
    frames: tuple[FrameCrossAgreement, ...]
    pairs: tuple[PairAgreement, ...]  # with enough judged points


def summarise(found: LookUps, noise_px: float, settings: CrossFrameSettings) -> CrossFrameAgreement:
    """Figures of the pairs, the frames and all together."""
    pairs = _pairs(found, settings)
    seen = np.zeros(len(found.source), bool)
    seen[found.anchor] = True
    of_frame: list[list[PairAgreement]] = [[] for _ in range(found.frames)]
    for pair in pairs:
        for k in pair.frames:
            of_frame[k].append(pair)
    return CrossFrameAgreement(
        noise_px=noise_px,
        share=_mean(found.normalised < settings.sigmas),
        px_median=_quantile(found.px, 0.5),
        px_p95=_quantile(found.px, 0.95),
        frames=tuple(_frame(seen[found.source == k], of_frame[k]) for k in range(found.frames)),
        pairs=tuple(pairs),
    )


def _pairs(found: LookUps, settings: CrossFrameSettings) -> list[PairAgreement]:
    first, second = np.sort(np.stack([found.source[found.anchor], found.viewer]), 0)
    pair = first * found.frames + second
    order = np.argsort(pair, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(pair[order])) + 1) if len(order) else []
    groups = [mine for mine in groups if len(mine) >= settings.fewest_judged]
    residuals = [_residual(found, mine, settings) for mine in groups]
    allowed = settings.largest_typical * _quantile(np.array([t.stated for t in residuals]), 0.5)
    reference = min(_quantile(np.array([t.noises for t in residuals]), settings.reference_quantile), allowed)
    return [
        PairAgreement(
            frames=(int(first[mine[0]]), int(second[mine[0]])),
            judged=len(mine),
            share=_mean(found.normalised[mine] < settings.sigmas),
            px_median=_quantile(found.px[mine], 0.5),
            px_p95=_quantile(found.px[mine], 0.95),
            excess=t.noises / (reference * t.chance),
        )
        for mine, t in zip(groups, residuals, strict=True)
    ]


@dataclass(frozen=True)
class _PairResidual:
    """The residual of a pair at the typical quantile."""

    noises: float  # in units of the noise, but not below what look-ups decide
    stated: float  # expected sigma, with the stated uncertainty of the poses, in the same units
    chance: float  # factor by which right pairs may differ: an error of a pose is common to all points of a pair


def _residual(found: LookUps, mine: Int[ndarray, "m"], settings: CrossFrameSettings) -> _PairResidual:
    by_noise = np.sqrt(1 - found.by_poses[mine])  # share of the expected sigma
    return _PairResidual(
        max(_quantile(found.normalised[mine] / by_noise, settings.typical_quantile), settings.least_typical),
        float(np.median(1 / by_noise)),
        1 + (settings.rough_factor - 1) * _mean(found.by_poses[mine]),
    )


def _frame(seen: ndarray, pairs: list[PairAgreement]) -> FrameCrossAgreement:
    weight = np.array([p.judged for p in pairs], np.float64)
    figures = (
        _weighted_median(np.array([getattr(p, key) for p in pairs]), weight)
        for key in ("share", "px_median", "px_p95", "excess")
    )
    return FrameCrossAgreement(len(seen), _mean(seen) if len(seen) else 0.0, *figures)


def _weighted_median(values: Float[ndarray, "n"], weight: Float[ndarray, "n"]) -> float:
    if not len(values):
        return float("nan")
    order = np.argsort(values)
    total = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(total, total[-1] / 2)]])


def _mean(values: ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")


def _quantile(values: ndarray, q: float) -> float:
    return float(np.quantile(values, q)) if len(values) else float("nan")

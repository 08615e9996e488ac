"""Which intrinsics to fit: what predicts views that were left out, and nothing that does not pay for itself.

A left-out view keeps only its board's pose free, which its corners in the camera give. Its corners in the projector are
then predicted outright. Of all models the simplest is taken that is not worse than the best one with certainty (a
paired t test over the views): terms that only overfit are left out. How far the result moves with the better one is
part of the stated uncertainty.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.stats import t as student_t

from sl_nerfstudio.calibration.board.adjustment import Adjusted, Free, Seen, Sigma, adjust, kernel, place_boards
from sl_nerfstudio.calibration.board.residuals import Sightings, residuals
from sl_nerfstudio.calibration.board.rig import BoardRig, FreeIntrinsics
from sl_nerfstudio.geometry.devices import Device

_TERMS = (0, 1, 2, 4)
_RICH = FreeIntrinsics(False, 2)  # of the projector while the camera's model is chosen
_RICHEST = FreeIntrinsics(True, 4)  # by whose noise errors are judged
_CERTAIN = 0.95  # one-sided
_MUCH_WORSE = 1.25  # mean cost relative to that of the best model
_LEAST_COST = 1e-12  # of noise-free corners
_FOLDS = 10  # views are left out one by one, or in so many groups
Track = Callable[[Sequence[int], str], Iterable[int]]


@dataclass(frozen=True)
class ModelScore:
    """How well one model of a device predicts left-out views."""

    device: int  # 0: camera, 1: projector
    model: FreeIntrinsics
    error_px: tuple[float, ...]  # RMS in each device over all left-out views
    costs: Float64[ndarray, "v"]  # mean robust cost of every view's corners when it was left out
    fitted: Device  # with this model, to all views
    chosen: bool = False


@dataclass(frozen=True)
class LeftOut:
    """Fits without some of the views, and how they predict those views."""

    whole: Adjusted  # the fit to all views
    rigs: tuple[Adjusted, ...]
    costs: Float64[ndarray, "v"]  # mean robust cost of every view's corners when it was left out
    error_px: tuple[float, ...]  # RMS of the predictions in each device
    by_view_px: Float64[ndarray, "d v"]  # the same for every view; NaN where a device does not see it


def choose_models(start: Adjusted, seen: Seen, track: Track) -> tuple[Free, tuple[ModelScore, ...]]:
    """The model of each device, and what was compared: first the terms of the lens, then two focal lengths."""
    free: Free = (FreeIntrinsics(), *(_RICH for _ in start.rig.devices[1:]))
    sigma = adjust(start.rig, tuple(_RICHEST for _ in free), seen).sigma_px
    scores: list[ModelScore] = []
    for device, name in enumerate(("camera", "projector")[: len(free)]):

        def score(model: FreeIntrinsics, device: int = device, others: Free = free) -> ModelScore:
            tried = (*others[:device], model, *others[device + 1 :])
            found = leave_out(start.rig, tried, seen, sigma)
            return ModelScore(device, model, found.error_px, found.costs, found.whole.rig.devices[device])

        found = [score(FreeIntrinsics(False, terms)) for terms in track(_TERMS, f"Lens models of the {name}")]
        found.append(score(FreeIntrinsics(True, found[_simplest(found)].model.terms)))
        best = _simplest(found)
        scores += [replace(one, chosen=k == best) for k, one in enumerate(found)]
        free = (*free[:device], found[best].model, *free[device + 1 :])
    return free, tuple(scores)


def leave_out(start: BoardRig, free: Free, seen: Seen, sigma: Sigma) -> LeftOut:
    """Fit without each group of views, and predict them. `sigma` is the noise by which errors are judged."""
    count = len(start.T_camera_board)
    costs, fits = np.full(count, np.nan), []
    squares: list[Float64[ndarray, v]] = [np.full(count, np.nan) for _ in seen]
    whole = adjust(start, free, seen, sigma)
    for group in np.array_split(np.arange(count), min(count, _FOLDS)):
        kept = np.setdiff1d(np.arange(count), group)
        fit = adjust(whole.rig.only(kept.tolist()), free, tuple(_of(one, kept) for one in seen), sigma)
        fits.append(fit)
        boards = replace(fit.rig, T_camera_board=whole.rig.T_camera_board[group])
        rig = place_boards(boards, _of(seen[0], group), sigma[0])
        for place, view in enumerate(group):
            total, corners = 0.0, 0
            for k, one in enumerate(seen):
                own = _of(_of(one, group), np.array([place]))
                if not len(own.view):
                    continue
                r = residuals(rig.only([place]), k, own)
                total, corners = total + float(kernel(r / sigma[k])[0].sum()), corners + len(r)
                squares[k][view] = float((r**2).mean())
            costs[view] = total / max(corners, 1)
    by_view = np.sqrt(np.array(squares))
    return LeftOut(whole, tuple(fits), costs, tuple(float(np.sqrt(np.nanmean(s))) for s in squares), by_view)


def _of(seen: Sightings, views: ndarray) -> Sightings:
    """The sightings of some views, which are numbered anew."""
    number = np.full(int(seen.view.max(initial=-1)) + 1 + int(views.max(initial=-1)) + 1, -1)
    number[views] = np.arange(len(views))
    own = number[seen.view] >= 0
    return Sightings(number[seen.view[own]], seen.p_board[own], seen.uv[own])


def _simplest(scores: Sequence[ModelScore]) -> int:
    """The simplest model that is not certainly worse than the best, nor much worse; views are compared one by one.

    The ratio of a view's costs is compared, not their difference: views that are hard for every model would hide how
    much the others differ. Few views make nothing certain, so a model must not cost much more in the mean, either.
    """
    best = min(scores, key=lambda one: one.costs.mean())

    def as_good(one: ModelScore) -> bool:
        ratio = np.log(one.costs.clip(_LEAST_COST) / best.costs.clip(_LEAST_COST))
        n = len(ratio)
        if one.costs.mean() > _MUCH_WORSE * best.costs.mean().clip(_LEAST_COST):
            return False
        return bool(ratio.mean() <= student_t.ppf(_CERTAIN, n - 1) * ratio.std(ddof=1) / np.sqrt(n))

    return min((k for k, one in enumerate(scores) if as_good(one)), key=lambda k: scores[k].model.columns().shape[1])

"""How uncertain the intrinsics are: by the noise of the corners, and by how much the views disagree.

The noise alone says too little where a board is bent, or where a lens is not quite what its model says: such errors are
common to all corners of a view. Leaving views out (the jackknife; Efron and Tibshirani, "An Introduction to the
Bootstrap", 11) shows them, and the larger of the two counts. To it is added how far the numbers move with another lens
model that predicts left-out views no worse than the one chosen.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.board.adjustment import Adjusted, Free, covariance
from sl_nerfstudio.calibration.board.selection import LeftOut, ModelScore
from sl_nerfstudio.geometry.devices import PARAMETERS


@dataclass(frozen=True)
class DeviceSigma:
    """Standard deviation of every number of a device; 0 where it was not fitted."""

    values: dict[str, float]  # by the names in PARAMETERS

    def focal(self) -> float:
        """Of the focal length, in pixels."""
        return max(self.values["fl_x"], self.values["fl_y"])

    def centre(self) -> float:
        """Of the principal point, in pixels."""
        return max(self.values["cx"], self.values["cy"])


def device_sigmas(adjusted: Adjusted, left_out: LeftOut, models: Sequence[ModelScore]) -> tuple[DeviceSigma, ...]:
    """Of each device."""
    formal = formal_sigmas(adjusted.free, adjusted.information)
    out = []
    for k, one in enumerate(formal):
        fits = np.array([fit.rig.devices[k].parameters for fit in left_out.rigs])
        n = len(fits)
        jackknife = np.sqrt((n - 1) / n * ((fits - fits.mean(0)) ** 2).sum(0))
        sigma = np.hypot(np.maximum(one, jackknife), _by_model([score for score in models if score.device == k]))
        out.append(DeviceSigma(dict(zip(PARAMETERS, map(float, sigma), strict=True))))
    return tuple(out)


def _by_model(scores: Sequence[ModelScore]) -> Float64[ndarray, "8"]:
    """How far each number moves with another model that is at least as good; 0 where the other one does not fit it."""
    chosen = next(score for score in scores if score.chosen)
    fitted = chosen.model.columns().any(1)
    moves = [
        np.abs(score.fitted.parameters - chosen.fitted.parameters) * fitted
        for score in scores
        if score.costs.mean() <= chosen.costs.mean()
    ]
    return np.max(moves, axis=0)


def formal_sigmas(free: Free, information: Float64[ndarray, "s s"]) -> list[Float64[ndarray, "8"]]:
    """Of PARAMETERS of each device, by the noise of the corners; `information` as in `Adjusted`."""
    found, out, place = covariance(information), [], 0
    for one in free:
        columns = one.columns()
        part = slice(place, place + columns.shape[1])
        out.append(np.sqrt(np.einsum("ps,st,pt->p", columns, found[part, part], columns).clip(0)))
        place += columns.shape[1]
    return out

"""The result of every decoder, and the error of a capture that cannot be decoded."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray

from sl_nerfstudio.errors import UserError


@dataclass(frozen=True)
class Decoded:
    """One decoded frame. Coordinates are projector pixels; the centre of the first pixel is (0.5, 0.5)."""

    coords: Float32[ndarray, "h w 2"]  # (x_p, y_p), NaN where not decoded
    mask: Bool[ndarray, "h w"]  # where the pattern lights the object; True at every decoded pixel
    pattern: Float32[ndarray, "h w"]  # in [0, 1]: captured intensity, locally normalised; 0 outside the mask
    light: Float32[ndarray, "h w"] | None = None  # that a pattern value of 1 adds, of full scale; NaN where unknown

    @property
    def decoded(self) -> Bool[ndarray, "h w"]:
        """Pixels that have coordinates."""
        return np.isfinite(self.coords).all(-1)

    @property
    def rate(self) -> float:
        """Share of the mask that has coordinates; 0 for an empty mask."""
        masked = int(self.mask.sum())
        return int((self.decoded & self.mask).sum()) / masked if masked else 0.0


class DecodingError(UserError):
    """A capture that cannot be decoded, with problem, likely cause and remedy.

    A decoder knows images, not files: the caller adds the name of the file.
    """

    def __init__(self, problem: str, cause: str, remedy: str) -> None:
        """All three in plain words; `problem` continues a sentence that starts with the name of a file or frame."""
        super().__init__(f"{problem}\n    cause:  {cause}\n    remedy: {remedy}")
        self.problem, self.cause, self.remedy = problem, cause, remedy

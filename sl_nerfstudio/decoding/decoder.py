"""The interface of decoders: from the image files of one frame to pattern coordinates."""

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Generic, TypeVar

import numpy as np
from jaxtyping import Bool, Float32, Int32
from numpy import ndarray
from scipy.ndimage import find_objects

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.parallel import compiled
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import Pixels

Layer = Float32[ndarray, "h w"]
"""A number for each pixel of an image."""
Coords = Float32[ndarray, "h w 2"]
"""The point (x, y) of the pattern that each pixel shows; NaN where unknown."""
Mask = Bool[ndarray, "h w"]

# The result of every decoder, and the error of a capture that cannot be decoded.


@dataclass(frozen=True)
class Decoded:
    """One decoded frame. Coordinates are projector pixels; the centre of the first pixel is (0.5, 0.5)."""

    coords: Float32[ndarray, "h w 2"]  # (x_p, y_p), NaN where not decoded
    mask: Bool[ndarray, "h w"]  # where the pattern lights the object; True at every decoded pixel
    pattern: Float32[ndarray, "h w"]  # in [0, 1]: captured intensity, locally normalised; 0 outside the mask
    light: Float32[ndarray, "h w"] | None = None  # that a pattern value of 1 adds, of full scale; NaN where unknown
    notes: tuple[str, ...] = ()  # what is to be said about the capture, in words that are the same for similar captures

    @property
    def decoded(self) -> Bool[ndarray, "h w"]:
        """Pixels that have coordinates."""
        return all_finite(self.coords)

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


# Connected regions of a coordinate image, and the tears between them: small regions are decoding errors.


def drop_small_regions(coords: Coords, largest_step: float, least_pixels: int) -> Coords:
    """Set connected regions of fewer than `least_pixels` pixels to NaN; `largest_step` as in `number_regions`."""
    number = number_regions(coords, largest_step)
    small = np.bincount(number.ravel(), minlength=1) < least_pixels
    return np.where(small[number][..., None], np.float32(np.nan), coords)


def large_regions(
    coords: Coords, largest_step: float, least_pixels: float
) -> Iterator[tuple[tuple[slice, slice], Bool[ndarray, "a b"]]]:
    """Regions of at least `least_pixels` pixels: the bounding box of each, and its pixels within the box."""
    number = number_regions(coords, largest_step)
    area = np.bincount(number.ravel())
    for index, box in enumerate(find_objects(number), 1):
        if area[index] >= least_pixels:
            yield box, number[box] == index


def torn(coords: Coords, largest_step: float) -> Mask:
    """Pixels on both sides of a step of either coordinate larger than `largest_step`; one to NaN is none."""
    out = np.zeros(coords.shape[:2], dtype=np.bool_)
    _mark_torn(coords, np.float32(largest_step), out)
    return out


def number_regions(coords: Coords, largest_step: float) -> Int32[ndarray, "h w"]:
    """Connected regions, numbered from 1 in the order of their first pixels; 0 where nothing is decoded.

    Neighbouring pixels (4 directions) are connected if both are decoded and neither coordinate differs by more than
    `largest_step`.
    """
    number = np.zeros(coords.shape[:2], dtype=np.int32)
    _fill(coords, largest_step, number)
    return number


@compiled
def _fill(coords: ndarray, tear: float, number: ndarray) -> None:
    """Fill `number`: 0 where coordinates are unknown, otherwise 1, 2, .. by region."""
    h, w = number.shape
    stack = np.empty((h * w, 2), dtype=np.int32)
    regions = 0
    for row in range(h):
        for column in range(w):
            if number[row, column] != 0 or np.isnan(coords[row, column, 0]):
                continue
            regions += 1
            number[row, column] = regions
            stack[0, 0], stack[0, 1] = row, column
            top = 1
            while top > 0:
                top -= 1
                r, c = stack[top, 0], stack[top, 1]
                for d in range(4):
                    rr = r + (d == 1) - (d == 3)
                    cc = c + (d == 0) - (d == 2)
                    if rr < 0 or cc < 0 or rr >= h or cc >= w or number[rr, cc] != 0:
                        continue
                    dx = abs(coords[rr, cc, 0] - coords[r, c, 0])
                    dy = abs(coords[rr, cc, 1] - coords[r, c, 1])
                    if dx <= tear and dy <= tear:  # false for NaN
                        number[rr, cc] = regions
                        stack[top, 0], stack[top, 1] = rr, cc
                        top += 1


@compiled
def _mark_torn(coords: ndarray, largest: float, out: ndarray) -> None:
    h, w = out.shape
    for row in range(h):
        for column in range(w):
            for r, c in ((row + 1, column), (row, column + 1)):
                if r >= h or c >= w:
                    continue
                dx, dy = coords[r, c, 0] - coords[row, column, 0], coords[r, c, 1] - coords[row, column, 1]
                if abs(dx) > largest or abs(dy) > largest:  # False for NaN
                    out[row, column] = out[r, c] = True


L = TypeVar("L", bound=PatternLayout)


class Decoder(ABC, Generic[L]):
    """Decodes captures of one pattern.

    Creating one must be quick, because it is also created where only its key is needed, and it is sent to worker
    processes: load networks at the first call of `decode`. A new decoder is a class that derives from this one, and an
    entry in `decoders.DECODERS`.
    """

    name: ClassVar[str]  # of the flag --decoder
    version: ClassVar[int]  # raise it when the decoder gives other results
    reads: ClassVar[str]  # kind of the patterns it decodes
    sequence: ClassVar[bool]  # a frame is a folder of images, not a single image

    def __init__(self, layout: L, order_stated: bool = False) -> None:
        """Create a decoder; with `order_stated`, evidence against the stated order of images is a note, no error."""
        self.layout, self.order_stated = layout, order_stated

    @abstractmethod
    def decode(self, images: Sequence[Pixels], names: Sequence[str]) -> Decoded:
        """Decode the images of one frame, in the order of projection; `names` are those of their files, for messages.

        Raises DecodingError for a capture that cannot be decoded.
        """

    def shrink_factor(self, image: Pixels) -> int | None:
        """By how much a photograph can be shrunk before it is decoded; None where it does not show the pattern.

        1, as here: every pixel is needed.
        """
        return 1

    @property
    def key(self) -> str:
        """A text that changes whenever the decoder would give other results."""
        stated = " stated" if self.order_stated else ""
        digest = hashlib.sha256(f"{self.name} {self.version}{stated}".encode() + self.layout.encode())
        for path in self.weights():
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def weights(self) -> Iterable[Path]:
        """Files, besides the code, on which the results depend."""
        return ()

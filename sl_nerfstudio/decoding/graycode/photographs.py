"""The photographs of one sequence by what they show, as intensities in [0, 1]."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.decoding.decoded import DecodingError
from sl_nerfstudio.geometry.robust import MAD_TO_SIGMA
from sl_nerfstudio.pattern.graycode import GrayCode
from sl_nerfstudio.pattern.sequence import Shown
from sl_nerfstudio.scan.images import as_grey

Image = UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]
Grey = Float32[ndarray, "h w"]


@dataclass(frozen=True)
class Sine:
    """What the photographs of a shifted sine say of every pixel."""

    phase: Float32[ndarray, "h w"]  # radians, 0 to 2 pi
    amplitude: Float32[ndarray, "h w"]  # of full scale; half of the direct light
    mean: Float32[ndarray, "h w"]


@dataclass(frozen=True)
class Photographs:
    """The images of one sequence, in the order of `layout`."""

    images: Sequence[Image]
    layout: GrayCode

    def grey(self, place: int) -> Grey:
        """One image."""
        return as_grey(self.images[place])

    def shown(self, what: Shown) -> Grey | None:
        """The image that shows this; None if the sequence has none."""
        place = self.layout.place(what)
        return None if place is None else self.grey(place)

    def pair(self, place: int, inverse: int | None) -> tuple[Grey, Grey]:
        """An image and its inverse; white + black - image is the inverse where none was photographed."""
        direct = self.grey(place)
        if inverse is not None:
            return direct, self.grey(inverse)
        white, black = (self.grey(self.layout.shown.index(Shown(what))) for what in ("white", "black"))
        return direct, white + black - direct

    def sine(self, axis: int, steps: int, period: float) -> Sine:
        """Phase, amplitude and mean of a sine, by least squares over its shifts."""
        x = y = total = np.zeros(self.images[0].shape[:2], dtype=np.float32)
        for k, place in enumerate(self.layout.sine_images(axis, steps, period)):
            image = self.grey(place)
            angle = 2 * np.pi * k / steps
            x, y = x + np.float32(np.cos(angle)) * image, y + np.float32(np.sin(angle)) * image
            total = total + image
        phase = np.arctan2(y, x) % np.float32(2 * np.pi)
        return Sine(phase, np.hypot(x, y) * np.float32(2 / steps), total / np.float32(steps))

    def noise(self) -> float:
        """Standard deviation of an image, from images that hold the same light, or from the finest differences."""
        pairs = [self.layout.bit_images(axis) for axis in (0, 1)]
        if all(pairs) and pairs[0][0][1] is not None:
            sums = [np.add(*self.pair(*places[0])) for places in pairs]
            return MAD_TO_SIGMA / 2 * float(np.median(np.abs(sums[0] - sums[1])))
        if all(pairs):
            return self._noise_of_one_bit(pairs[0][0][0])
        (steps, period), (other_steps, other) = (self.layout.sines(axis)[0] for axis in (0, 1))
        means = self.sine(0, steps, period).mean - self.sine(1, other_steps, other).mean
        spread = np.sqrt(1 / steps + 1 / other_steps)  # of the difference of two means
        return MAD_TO_SIGMA / spread * float(np.median(np.abs(means)))

    def _noise_of_one_bit(self, place: int) -> float:
        """From a coarse bit against white or black, whichever is nearer, less the mean of its four neighbours.

        That difference is smooth: it holds nothing of the object's texture, and global light varies slowly.
        """
        image = self.grey(place)
        white, black = (self.grey(self.layout.shown.index(Shown(what))) for what in ("white", "black"))
        rest = np.where(np.abs(image - white) < np.abs(image - black), image - white, image - black)
        around = (rest[:-2, 1:-1] + rest[2:, 1:-1] + rest[1:-1, :-2] + rest[1:-1, 2:]) / 4
        scale = np.sqrt(2 * (1 + 1 / 4))
        return MAD_TO_SIGMA / scale * float(np.median(np.abs(rest[1:-1, 1:-1] - around)))


def check_sizes(images: Sequence[Image]) -> None:
    """Raise DecodingError unless all images of a sequence have one size."""
    sizes = sorted({f"{image.shape[1]} x {image.shape[0]}" for image in images})
    if len(sizes) > 1:
        raise DecodingError(
            f"holds images of several sizes ({', '.join(sizes)})",
            "the folder holds images of another camera or resolution, too",
            "keep one folder for each frame, with nothing but its own images",
        )

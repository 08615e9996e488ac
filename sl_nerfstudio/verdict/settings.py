"""Limits of the verdict: multiples of the measured noise, shares of pixels and of frames. No lengths, no pattern pixels."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CrossFrameSettings:
    """When the coordinates of two frames agree."""

    pixels_per_frame: int = 500
    """Decoded pixels of each frame that are looked up in the others."""
    most_pixels: int = 12000
    """The same over all frames, at most."""
    least_cosine: float = 0.2
    """Cosine between surface normal and ray below which a device counts as not seeing a point."""
    sigmas: float = 4.0
    """Standard deviations of a residual, from noise and stated uncertainty of the poses, up to which a point agrees:
    chance alone exceeds it once in 3000 points."""
    footprint: float = 0.25
    """Error that no calibration and no look-up is assumed to be free of, 1 sigma, in camera pixels."""
    largest_noise_ratio: float = 3.0
    """Noise of a frame relative to the median frame's, beyond which it does not count as noise: a wrong pose of its
    projector makes it."""
    fewest_judged: int = 30
    """Judged points below which a pair of frames shares too little to say anything."""
    least_pair_share: float = 0.85
    """Share of a pair's judged points that must agree for the two frames to confirm each other."""

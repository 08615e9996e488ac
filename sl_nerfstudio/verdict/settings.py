"""Limits of the verdict: multiples of the measured noise, shares of pixels and of frames; no lengths."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class CrossFrameSettings:
    """When the coordinates of two frames agree."""

    pixels_per_frame: int = 500
    """Decoded pixels of each frame that are looked up in the others."""
    most_pixels: int = 12000
    """The same over all frames, at most."""
    least_pixels_per_frame: int = 60
    """The same of each frame, at least, however many frames there are."""
    partners: int = 32
    """Other frames that a frame is compared with, about, where there are more than `compared_frames`."""
    compared_frames: int = 150
    """Most frames of which each is compared with every other."""
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
    typical_quantile: float = 0.8
    """Quantile of a pair's residuals by which it is compared with other pairs: wrong decodings do not reach it, and a
    plane on which two frames agree by chance rarely holds so much of them."""
    least_typical: float = 0.5
    """Smallest such residual that counts, in units of the noise: below, look-ups decide, not poses."""
    largest_typical: float = 1.5
    """Largest such residual, in units of the expected sigma, that a scan's better pairs may have: normal errors in two
    dimensions have 1.8, and the expected sigma is generous."""
    rough_factor: float = 1.6
    """Factor on the limits where the stated uncertainty of the poses, not noise, makes up the expected sigma: an error
    of a pose is common to all points of a pair, so right pairs differ by chance."""
    reference_quantile: float = 0.25
    """Quantile of those residuals over all pairs with which each is compared: a quarter of the pairs must be right."""
    contradicting_excess: float = 2.5
    """Residual of a pair relative to that reference, beyond which the two frames contradict each other."""

    def pixels_of_each(self, frames: int) -> int:
        """Decoded pixels of each of so many frames that are looked up."""
        return max(self.least_pixels_per_frame, min(self.pixels_per_frame, self.most_pixels // frames))


@dataclass(frozen=True)
class MissingSurfaceSettings:
    """When a frame should have seen a surface."""

    margin: float = 0.02
    """Distance from all that a frame saw of the pattern, as a share of the image's longer side, beyond which it saw
    nothing; as far inside the image and the pattern must a point lie."""
    least_cosine: float = 0.35
    """Cosine between a surface's normal and its rays to both devices above which it would be lit and seen."""
    cells: int = 60
    """Places along the longer side of an image at which it is known what lies nearest to the device."""
    thickness: float = 0.08
    """Distance behind what is nearest from which points count as hidden, as a share of the surface's radius."""
    fewest_judged: int = 30
    """Points below which nothing is said of a frame."""


@dataclass(frozen=True)
class VerdictSettings:
    """What makes a scan good, acceptable or poor. A single frame beyond a limit keeps it from being good."""

    most_frames: float = 0.25
    """Share of the frames that may be left out, undecided, unconfirmed or weakly decoded before the scan is poor."""
    least_decoded: float = 0.5
    """Share of the surface that other frames show which must be decoded in every frame; of the visible pattern, where
    others show too little."""
    most_missing: float = 0.05
    """Share of the surface that others show, and that a frame should have seen, of which it may have seen nothing; in a
    single frame, something may have cast a shadow."""
    least_own_share: float = 0.5
    """Share of a frame's decoded pixels that must agree with the frame's own pose of its projector: with less, another
    pose could explain the majority."""
    good_sigma_deg: float = 1.0
    """Standard deviation of a frame's rotation, in degrees, up to which a scan is good, and beyond which it is
    acceptable: edges of the object may be smeared by a hundredth of its size."""
    largest_sigma_deg: float = 3.0
    """Standard deviation of a frame's rotation, in degrees, beyond which the frame may well be wrong and the scan is
    poor."""
    least_seen: float = 0.15
    """Share of a frame's points that other frames must be able to judge: registration demands the same overlap."""
    good_share: float = 0.95
    """Share of the judged points that must agree for a scan to be good, in every frame and over all."""
    least_share: float = 0.85
    """The same for an acceptable scan."""
    good_excess: float = 2.0
    """Residual of a frame relative to the better pairs of the scan, up to which a scan is good; frames beyond
    `cross.contradicting_excess` make it poor."""
    cross: CrossFrameSettings = field(default_factory=CrossFrameSettings)
    """When frames agree with each other."""

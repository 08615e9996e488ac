"""Settings of matching along epipolar lines. Lengths in the image are in periods of the pattern as it appears there."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class HypothesisSettings:
    """The inverse distances that are tried."""

    step: float = 0.1
    """between two of them on the pattern, periods (median over the image)"""
    fewest: int = 16
    """so many are tried at least"""
    most: int = 512
    """so many are tried at most; the step grows where more would be needed"""
    quantile: float = 0.002
    """share of the decoded pixels that may be nearer than the range, and share that may be farther"""
    margin: float = 0.04
    """by which the range is longer on each side, as a share of it"""
    agreement: float = 0.15
    """distance of decoded coordinates from their epipolar line up to which they count, periods"""
    offset_window: float = 1.0
    """standard deviation of the window in which these distances are averaged, periods"""
    offset_prior: float = 0.05
    """share of decoded pixels in the window at which the average is halved"""


@dataclass(frozen=True)
class CostSettings:
    """Correlation of image and pattern in a Gaussian window."""

    window: float = 0.14
    """standard deviation of the window, periods"""
    least_pattern_variance: float = 1e-3
    """added to the variance of the drawn pattern: where it is flat, nothing can be compared"""
    least_image_variance: float = 0.03
    """added to the variance of the image, as a share of its median at decoded pixels"""


@dataclass(frozen=True)
class SmoothnessSettings:
    """What a change of distance from one pixel to the next costs; a correlation of 0 costs 127, of -1 costs 254."""

    small: int = 30
    """to the next inverse distance"""
    large: int = 250
    """to any other"""
    steepest: int = 4
    """steps from one pixel to the next up to which a decoded surface is steep; beyond, it has a jump there"""
    apart: int = 3
    """steps from the best inverse distance within which another one is no rival"""


@dataclass(frozen=True)
class LineFitSettings:
    """The fit of coordinates to the image, from matched ones."""

    smoothing: tuple[tuple[float, float], ...] = ((0.25, 0.05), (0.12, 0.1))
    """windows in which the surface is taken to be flat, largest first, and how far from them a pixel may be; periods"""
    window: float = 0.38
    """standard deviation of the window of a shift, periods"""
    rounds: int = 6
    """each recovers a part of the detail that the window of the fit averages over"""
    detail: float = 0.06
    """how far coordinates along the line are expected to be from that flat surface (1 sigma), periods"""
    across: float = 0.02
    """the same across the line: more than there is, because distances from it tell how large noise is"""
    dependent: float = 16.0
    """area, in pixels, over which the errors of an image depend on each other"""
    largest: float = 0.12
    """limit of all shifts together, periods"""
    least_area: float = 1.0
    """smaller regions are left out, periods squared"""
    tear: float = 0.35
    """difference between neighbouring pixels that separates regions, periods"""


@dataclass(frozen=True)
class KeepingSettings:
    """Which pixels are kept."""

    least_probability: float = 0.5
    """that a pixel is right"""
    near: float = 0.1
    """distance within which coordinates count as right, and matched ones as those that were decoded; periods"""
    jump: float = 0.3
    """difference between neighbouring pixels that counts as a jump in depth, periods"""
    smallest_region: float = 2.0
    """smaller regions are left out, periods squared"""
    tear: float = 0.5
    """difference between neighbouring pixels that separates such regions, periods"""
    least_agreement: float = 0.8
    """share of the decoded pixels that must be matched where they were decoded; otherwise nothing is replaced"""


@dataclass(frozen=True)
class MatchingSettings:
    """Everything that matching depends on besides its inputs."""

    hypotheses: HypothesisSettings = field(default_factory=HypothesisSettings)
    """the inverse distances that are tried"""
    costs: CostSettings = field(default_factory=CostSettings)
    """correlation of image and pattern"""
    smoothness: SmoothnessSettings = field(default_factory=SmoothnessSettings)
    """what changes of distance cost"""
    fit: LineFitSettings = field(default_factory=LineFitSettings)
    """the fit to the image"""
    keeping: KeepingSettings = field(default_factory=KeepingSettings)
    """which pixels are kept"""
    finest: float = 12.0
    """pixels per period: finer captures are averaged first"""
    most_bytes: int = 2**28
    """memory for costs; larger images are matched in strips"""
    strip_margin: float = 6.0
    """by which strips overlap on each side, periods"""


MATCHING_DEFAULTS = MatchingSettings()

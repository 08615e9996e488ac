"""Settings of the placement of cameras under a projector that stands still."""

from dataclasses import dataclass, field

from sl_nerfstudio.relative_pose.unknown_projector.settings import IntrinsicsPrior


@dataclass(frozen=True)
class CellSettings:
    """Squares of the pattern at whose centres all cameras are compared."""

    pixels: float = 20.0
    """camera pixels in a square, in the mean"""
    most_along: int = 300
    """squares along the longer side of the pattern, at most"""
    fewest: int = 6
    """camera pixels from which a square is used"""
    roughness_medians: float = 3.0
    """distance of a square's pixels from a linear map, in medians of all squares, beyond which it lies at an edge"""
    largest_lever: float = 4.0
    """inverse share of pixels that determine the place of the centre: how far it may lie beside the pixels"""


@dataclass(frozen=True)
class ChainSettings:
    """Cameras placed one after the other."""

    fewest: int = 60
    """squares that two cameras, or a camera and the known points, must have in common"""
    pairs: int = 60
    """pairs of cameras that are tried as the first, at most"""
    outlier_px: float = 2.0
    """distance within which a match is an inlier, camera pixels"""
    usable_angle_deg: float = 15.0
    """angle between two cameras' rays beyond which more is no gain for a first pair"""
    least_angle_deg: float = 1.0
    """angle between rays from which a point counts as known"""


@dataclass(frozen=True)
class ResectionSettings:
    """The projector from points and their codes."""

    fewest: int = 20
    """points, at least"""
    rounds: int = 8
    """of leaving out what does not fit"""
    outlier_sigmas: float = 4.0
    """standard deviations beyond which a point is left out"""
    least_relief: float = 1e-3
    """extent of the points across their plane, as a share of that along it"""


@dataclass(frozen=True)
class StaticSettings:
    """All settings."""

    most_points: int = 2500
    """squares in the bundle adjustment, at most"""
    iterations: int = 40
    """Levenberg-Marquardt steps, at most"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""
    noise_quantile: float = 0.8
    """share of the residuals whose size tells the noise: with lenses modelled less than perfectly, half is too few"""
    parts_along: int = 8
    """parts along the longer side of the pattern within which errors may depend on each other"""
    noise_floor_px: float = 1e-4
    """noise that is assumed at least, pixels"""
    converged: float = 1e-6
    """share of the cost that a step must gain for the search to go on"""
    standard_errors: float = 2.0
    """standard errors by which left-out squares must agree better for another free parameter"""
    folds: int = 4
    """parts that are left out in turn"""
    dependence: float = 2.0
    """factor on the stated sigma: neighbouring squares share errors of decoding and of the lens"""
    largest_sigma: float = 0.08
    """standard deviation of the focal length, as a share, beyond which there is no result"""
    largest_noise_share: float = 0.005
    """noise, as a share of the pattern's width, beyond which no single projector explains what the cameras see"""
    doubtful_sigma: float = 0.02
    """the same beyond which the result is doubtful"""
    prior: IntrinsicsPrior = field(default_factory=IntrinsicsPrior)
    """what is known of any projector"""
    cells: CellSettings = field(default_factory=CellSettings)
    """squares"""
    chain: ChainSettings = field(default_factory=ChainSettings)
    """placement of the cameras"""
    resection: ResectionSettings = field(default_factory=ResectionSettings)
    """the projector's first place"""
    difference_step: float = 1e-6
    """change of the intrinsics for derivatives"""


STATIC_DEFAULTS = StaticSettings()

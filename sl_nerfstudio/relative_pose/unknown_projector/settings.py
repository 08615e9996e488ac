"""Settings of the search for a projector's intrinsics."""

from dataclasses import dataclass, field

from sl_nerfstudio.relative_pose.settings import CandidateSettings, PatternBlocks, RelativePoseSettings


@dataclass(frozen=True)
class IntrinsicsPrior:
    """What is known of any projector before the first frame is looked at: 1 sigma around the start."""

    log_focal: float = 0.7
    """logarithm of the focal length"""
    log_aspect: float = 0.1
    """logarithm of fl_y over fl_x: keystone correction and scaling change it"""
    cx: float = 0.5
    """principal point to the right, widths of the image"""
    cy: float = 1.0
    """principal point downward, widths of the image: lens shift moves it far outside"""
    k1: float = 0.1
    """radial distortion"""


@dataclass(frozen=True)
class GridSettings:
    """Intrinsics from which the search starts."""

    focal_widths: tuple[float, ...] = (0.6, 0.8, 1.0, 1.25, 1.5, 1.8, 2.2, 2.7, 3.3, 4.0, 5.0)
    """focal lengths, widths of the image"""
    centre_x: tuple[float, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)
    """principal points, widths of the image"""
    centre_y: tuple[float, ...] = (-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0)
    """principal points, heights of the image"""
    starts: int = 6
    """places of the grid from which the fit starts"""
    apart: float = 0.2
    """distance between them at least: logarithm of the focal length, and principal point in widths"""
    largest_misfit: float = 0.3
    """relative difference of an essential matrix's two singular values at which a frame counts as an outlier"""


@dataclass(frozen=True)
class FundamentalSettings:
    """The fundamental matrix of each frame."""

    most: int = 2000
    """correspondences at most"""
    outlier_px: float = 1.5
    """distance from the epipolar line, in pixels, within which a correspondence is an inlier"""
    samples: int = 2000
    """random samples at most"""
    fewest: int = 50
    """correspondences with which a fundamental matrix is looked for"""


@dataclass(frozen=True)
class JointFitSettings:
    """Levenberg-Marquardt on intrinsics and all relative poses."""

    most: int = 40000
    """correspondences of all frames together, at most"""
    most_per_frame: int = 3000
    """the same of one frame"""
    difference_step: float = 1e-5
    """step of the differences by the intrinsics"""
    iterations: int = 40
    """iterations at most"""
    converged: float = 1e-7
    """size of a step below which the fit has converged"""
    least_gain: float = 1e-6
    """share of the cost that a step must gain for the fit to go on"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""
    noise_floor_px: float = 1e-3
    """noise that is assumed at least, in projector pixels"""
    damping: float = 1e-4
    """damping of the first step, relative to the diagonal of the normal equations"""
    damping_factor: float = 8.0
    """factor by which the damping falls after a good step and rises after a bad one"""
    tries: int = 8
    """dampings that are tried before the fit ends"""
    largest_step: float = 0.3
    """step of the intrinsics at most; principal points in widths"""


@dataclass(frozen=True)
class UnknownProjectorSettings:
    """All settings of the search."""

    fewest_frames: int = 3
    """frames with two constraints each on three unknowns and more"""
    fewest_posed: int = 2
    """frames with a pose and with depth that a fit needs"""
    few_frames: int = 6
    """frames below which an uncertain result is put down to their number"""
    alike_deg: float = 5.0
    """angle between relative poses below which frames are alike"""
    rounds: int = 4
    """searches for the poses of all frames, each with the projector found before, at most"""
    settled: float = 0.5
    """standard deviations by which the intrinsics may change in the last round"""
    start_iterations: int = 20
    """iterations from each start"""
    start_most: int = 200
    """correspondences of each frame with which the starts are compared"""
    choice_most: int = 12000
    """correspondences of all frames with which models are compared"""
    fold_iterations: int = 6
    """iterations of each fit to the others, from the fit to all"""
    folds: int = 4
    """parts of the pattern's squares that are left out in turn to choose the model"""
    standard_errors: float = 2.0
    """standard errors by which left-out squares must agree better for another free parameter"""
    largest_sigma: float = 0.08
    """standard deviation of focal length or principal point, shares of the focal length, beyond which there is no
    result"""
    doubtful_sigma: float = 0.02
    """the same beyond which the result is doubtful"""
    largest_noise_share: float = 0.005
    """noise, as a share of the image's width, beyond which no intrinsics fit"""
    check_most: int = 20000
    """correspondences of all frames with which stated intrinsics are tested"""
    contradiction: float = 30.0
    """chi square (three degrees of freedom) above which the frames contradict stated intrinsics: chance alone exceeds
    it once in a million, but the errors of squares and frames are not quite independent"""
    least_change: float = 0.01
    """share of the focal length by which stated intrinsics must be wrong to be reported: real lenses and decoders err
    by up to 0.3 % in ways that no sigma of two frames includes"""
    explained: float = 16.0
    """chi square (one or two degrees of freedom) that may remain where a part of the intrinsics explains it all"""
    prior: IntrinsicsPrior = field(default_factory=IntrinsicsPrior)
    """what is known of any projector"""
    grid: GridSettings = field(default_factory=GridSettings)
    """starts"""
    fundamental: FundamentalSettings = field(default_factory=FundamentalSettings)
    """fundamental matrices"""
    fit: JointFitSettings = field(default_factory=JointFitSettings)
    """joint fit"""
    pose: RelativePoseSettings = field(
        default_factory=lambda: RelativePoseSettings(
            most=2000, candidates=CandidateSettings(polishing_rays=400, ranking_rays=1500)
        )
    )
    """search for one frame's pose"""
    blocks: PatternBlocks = field(default_factory=PatternBlocks)
    """squares of the pattern"""


UNKNOWN_PROJECTOR_DEFAULTS = UnknownProjectorSettings()

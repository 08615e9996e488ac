"""Settings of relative pose estimation."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class Separation:
    """How far two relative poses must differ to count as two solutions: in rotation or in direction."""

    rotation_rad: float
    """angle between the rotations, radian (to first order)"""
    direction: float
    """distance between the unit baselines"""


@dataclass(frozen=True)
class FivePointSettings:
    """Random minimal samples, and the choice of the best solutions."""

    samples: int = 100
    """samples of five correspondences; with a third of them wrong, no sample is good with probability 1e-6"""
    scoring_rays: int = 300
    """correspondences on which the solutions of all samples are scored"""
    outlier_px: float = 4.0
    """residual, in projector pixels, beyond which a correspondence counts as wrong in the score"""
    least_cosine: float = 1e-3
    """cosine between ray and optical axis below which a ray cannot be written as an image point"""
    starts: int = 8
    """number of solutions that are kept"""
    separation: Separation = field(default_factory=lambda: Separation(0.05, 0.1))
    """by how much they differ from each other"""


@dataclass(frozen=True)
class PlaneSettings:
    """The plane that holds most correspondences, and its two reconstructions."""

    fewest: int = 20
    """correspondences with which a plane is looked for"""
    outlier_px: float = 4.0
    """distance from the plane's image, in projector pixels, within which a correspondence lies in the plane"""
    least_cosine: float = 1e-3
    """cosine between ray and optical axis below which a ray cannot be written as an image point"""
    least_translation: float = 1e-6
    """translation, in distances of the plane, below which two devices differ by a rotation alone"""


@dataclass(frozen=True)
class CandidateSettings:
    """Refinement and ranking of the first solutions."""

    polishing_rays: int = 800
    """correspondences with which solutions are refined before they are compared"""
    polishing_iterations: int = 12
    """iterations of that refinement"""
    ranking_rays: int = 4000
    """correspondences by which the refined solutions are compared"""
    inlier_sigmas: float = 3.0
    """standard deviations of the noise within which a correspondence votes on which side the surface lies"""
    least_in_front: float = 0.5
    """share of these that must lie in front of both devices"""
    separation: Separation = field(default_factory=lambda: Separation(0.02, 0.05))
    """by how much the refined solutions differ from each other"""
    rival_share: float = 0.03
    """share of the correspondences that a solution may explain less than the best one and still be a rival"""
    rival_errors: float = 3.0
    """standard errors of the difference within which a solution is a rival"""
    most: int = 3
    """solutions of a frame, the best one included, at most"""


@dataclass(frozen=True)
class EpipolarFitSettings:
    """Levenberg-Marquardt on the distances from the epipolar curves."""

    noise_floor_px: float = 1e-3
    """noise that is assumed at least, in projector pixels"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""
    iterations: int = 30
    """iterations at most"""
    converged_rad: float = 1e-10
    """size of a step, in radian, below which the fit has converged"""
    damping: float = 1e-4
    """damping of the first step, relative to the diagonal of the normal equations"""
    damping_factor: float = 10.0
    """factor by which the damping falls after a good step and rises after a bad one"""
    least_damping: float = 1e-12
    """below this the damping does not fall"""
    tries: int = 8
    """dampings that are tried before the fit ends"""


@dataclass(frozen=True)
class PatternBlocks:
    """Squares of the pattern within which decoding errors may depend on each other."""

    along_longer_side: int = 25
    """squares along the longer side of the pattern: with 50 grid lines, two periods each"""


@dataclass(frozen=True)
class LatticeSettings:
    """Which pixels of large images the pose is found from, and where points are."""

    most_pixels: int = 600_000
    """pixels of an image of which every one is used; of larger ones, every second, third, .. row and column"""
    rows: int = 64
    """rows whose other pixels are compared with the pose at a time, which bounds the memory"""


@dataclass(frozen=True)
class DegeneracyLimits:
    """When a frame's correspondences count as degenerate."""

    least_points: int = 200
    """correspondences that agree with the pose, at least"""
    least_block_share: float = 30 / 625
    """share of the squares of the pattern that must hold points, so that their errors can be judged"""
    least_relief_sigmas: float = 6.0
    """standard deviations of the noise by which points must depart from a plane, and from a pure rotation"""
    least_parallax_deg: float = 2.0
    """angle between camera ray and projector ray, in degrees, below which depth hangs on tiny errors"""
    largest_outlier_share: float = 0.3
    """share of the correspondences that may disagree with the pose"""
    largest_noise_px: float = 2.0
    """noise of the residuals, in projector pixels"""
    largest_sigma_rotation_deg: float = 0.5
    """standard deviation of the rotation, in degrees"""
    largest_sigma_direction_deg: float = 1.5
    """standard deviation of the direction of the baseline, in degrees"""
    relief_iterations: int = 10
    """iterations of the robust fits of a plane and of a pure rotation"""
    relief_kernel_medians: float = 3.0
    """width of their kernel, in medians of the residuals"""
    relief_share: float = 0.9
    """share of the smallest residuals that the relief is measured on: wrong coordinates are among the others"""
    epipole_sectors: int = 8
    """sectors around the baseline that must all hold rays for an epipole to be in view"""


@dataclass(frozen=True)
class RelativePoseSettings:
    """All settings of the relative pose of one frame."""

    fewest: int = 20
    """correspondences: enough for five unknowns and a judgement of the result"""
    most: int = 20000
    """correspondences in the fit at most; neighbouring pixels add nothing new"""
    inlier_sigmas: float = 4.0
    """standard deviations of the noise within which a correspondence agrees with the pose"""
    least_inlier_share: float = 0.3
    """share of the correspondences that must agree with the pose"""
    largest_noise_share: float = 0.02
    """noise beyond which nothing fits, as a share of the pattern's width"""
    fewest_in_block: int = 20
    """correspondences in a square of the pattern from which its own noise is measured"""
    largest_local_noise: float = 3.0
    """noise in a square of the pattern at most, relative to that of the whole frame"""
    solutions: Separation = field(default_factory=lambda: Separation(0.0354, 0.1))
    """by how much two solutions of a frame differ: by more than unfinished refinements do"""
    blocks: PatternBlocks = field(default_factory=PatternBlocks)
    """squares of the pattern"""
    lattice: LatticeSettings = field(default_factory=LatticeSettings)
    """pixels of large images"""
    five_point: FivePointSettings = field(default_factory=FivePointSettings)
    """first solutions from random samples"""
    plane: PlaneSettings = field(default_factory=PlaneSettings)
    """first solutions from the dominant plane"""
    candidates: CandidateSettings = field(default_factory=CandidateSettings)
    """their refinement and ranking"""
    fit: EpipolarFitSettings = field(default_factory=EpipolarFitSettings)
    """the fit of the best one"""
    degeneracy: DegeneracyLimits = field(default_factory=DegeneracyLimits)
    """when a frame is degenerate"""


RELATIVE_POSE_DEFAULTS = RelativePoseSettings()


@dataclass(frozen=True)
class CameraEstimateSettings:
    """Refinement of a camera whose focal length is only roughly known."""

    most: int = 3000
    """correspondences of each frame"""
    iterations: int = 12
    """Gauss-Newton steps, at most"""
    largest_step: float = 0.05
    """change of any unknown in one step"""
    difference_step: float = 1e-5
    """the same for derivatives"""
    converged: float = 1e-8
    """step below which the search ends"""
    sigma_centre: float = 0.01
    """how far principal points are from the middle, as a share of the image's longer side"""
    sigma_k1: float = 0.03
    """first term of the distortion of a usual lens"""
    kernel_sigmas: float = 3.0
    """width of the robust kernel, in standard deviations of the residuals"""


CAMERA_ESTIMATE_DEFAULTS = CameraEstimateSettings()

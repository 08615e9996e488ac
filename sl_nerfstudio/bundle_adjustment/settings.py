"""Settings of the bundle adjustment; `benchmarks.sensitivity.settings_sweep` varies them.

The defaults suit object-sized scans.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LookUpSettings:
    """How decoded coordinates are looked up between pixels."""

    half_window: int = 3
    """Camera pixels to each side of the window in which a paraboloid is fitted."""
    wide_half_window: int = 12
    """The same for the windows whose derivatives say how much residuals know: errors of coordinates are shared over
    about a period of the pattern, and derivatives of windows no larger than that are noisy, which looks like
    information."""
    least_pixels: int = 24
    """Decoded pixels that a window must hold."""
    least_pivot: float = 1e-3
    """Smallest share of a pivot that elimination may leave; below it the window's pixels lie on a conic."""
    roughness_px: float = 2.0
    """RMS distance, in pattern pixels, of a window's pixels from their paraboloid, beyond which the map counts as
    discontinuous there."""
    roughness_medians: float = 3.0
    """The same limit as a multiple of the median window's roughness; the larger limit applies."""
    sampled_windows: int = 200
    """Number of windows of each frame from which that median is taken."""


@dataclass(frozen=True)
class KernelSettings:
    """Width of the robust kernel (Geman-McClure), which narrows while the poses improve."""

    medians: float = 2.0
    """Width that a frame's kernel narrows to, as a multiple of its median residual."""
    noises: float = 3.0
    """Smallest width, as a multiple of the estimated noise."""
    fastest: float = 1.4
    """Largest factor by which a kernel narrows in one step."""
    obliqueness_classes: int = 8
    """Classes of look-ups, by the cosine at which the camera sees the surface, each of which has its own noise."""
    least_noise_ratio: float = 0.5
    """Smallest noise of such a class, relative to that of all look-ups."""
    border_classes: int = 8
    """Classes of look-ups by the distance from the border of what was decoded, whose noise is compared."""
    most_border_noise: float = 1.25
    """Noise of such a class, relative to that of all look-ups, beyond which it and those nearer to the border are left
    out: a decoder continues coordinates up to there, and errs alike in many frames."""
    least_curvature: float = 0.2
    """Smallest share of what weights say that residuals may really say: with less, most of them do not fit at all."""
    noise_floor_px: float = 0.01
    """Smallest plausible noise of one look-up, in pattern pixels."""


@dataclass(frozen=True)
class StepSettings:
    """Levenberg-Marquardt steps."""

    damping: float = 1e-4
    """Damping of the first step, as a share of the normal matrix's diagonal."""
    relax: float = 5.0
    """Factor by which damping falls after an accepted step."""
    tighten: float = 10.0
    """Factor by which damping grows after a rejected step."""
    least_damping: float = 1e-9
    """Damping never falls below this."""
    tries: int = 8
    """Rejected steps in a row after which the poses are left unchanged."""
    least_depth: float = 0.7
    """Smallest factor by which one step may change an anchor's depth."""
    most_depth: float = 1.4
    """Largest factor by which one step may change an anchor's depth."""
    converged: float = 1e-4
    """Largest component of a step, in scene units or radian, below which the poses have converged."""
    factorised_frames: int = 100
    """Most frames whose whole normal matrix is factorised; beyond, steps are found by conjugate gradients."""
    iterative_steps: int = 150
    """Most conjugate gradient steps for one step of the adjustment."""
    iterative_tolerance: float = 1e-2
    """Residual of the equations, relative to the first one, at which those end."""
    settled: float = 0.98
    """Share of its last width above which a kernel counts as no longer narrowing."""


@dataclass(frozen=True)
class RelocalisationSettings:
    """The search for frames that ended in a wrong minimum."""

    rounds: int = 3
    """Most rounds of searching; frames that were found help to find the others."""
    anchors_per_frame: int = 200
    """Decoded pixels of each frame that are used."""
    frames_per_anchor: int = 16
    """Most other frames in which each of them is looked up."""
    most_residuals: int = 6000
    """Most residuals between one frame and all others that are used."""
    starts: int = 12
    """Starting poses for the search of a lost frame, drawn from the prior."""
    frame_steps: int = 10
    """Steps from each starting pose in which the frame moves as a whole."""
    projector_steps: int = 10
    """Steps after those in which its projector moves, too."""
    observe_every: int = 3
    """Steps between new choices of which pixels the other frames see."""
    inlier_noises: float = 5.0
    """Largest residual that supports a pose, as a multiple of the noise."""
    least_gain: float = 0.01
    """Share of supporting residuals that a new pose must add to replace the old one."""
    sigmas: float = 4.0
    """A frame is lost if its support is this many robust standard deviations below the median frame's."""
    least_share: float = 0.75
    """Support below this share of the median frame's always counts as lost."""
    most_share: float = 0.95
    """Support above this share of the median frame's never counts as lost."""


@dataclass(frozen=True)
class OtherMinimaSettings:
    """The question whether other poses agree as well with the captures, and how far away they are."""

    shake_sigmas: float = 2.0
    """Distance from the result, in its sigma, from which further steps should lead back."""
    shake_steps: int = 6
    """Most of those steps."""
    most_left: float = 0.35
    """Share of that distance that may be left in any frame."""
    searches: int = 3
    """Searches from other starting poses if more is left; 0: never any."""
    most_frames: int = 100
    """Frames beyond which the question is not asked: it takes time, and many frames hold each other."""
    worse: float = 1.4
    """Median residual of any frame, relative to the result's, beyond which such a search has lost that frame."""


@dataclass(frozen=True)
class HopSettings:
    """Further searches after rough starts, each begun beside the best end so far."""

    most: int = 12
    """Most of them; they end as soon as one leads back. 0: none."""
    patience: int = 4
    """Searches after the best one that end elsewhere, after which there is no further one."""
    from_deg: float = 1.5
    """Uncertainty of the starting rotations, 1 sigma per axis of the median frame in degrees, from which starts count
    as rough."""
    size: float = 0.3
    """Distance from the best end at which a search begins, as a share of the starting poses' uncertainty."""
    least_gain: float = 5.0
    """Logarithm of the odds (nats) by which the end of a search must be more probable to replace the best one."""
    most_left: float = 0.35
    """Share of that distance within which all frames must return for a search to lead back."""
    width_noises: float = 4.0
    """Residual at which a look-up costs half of what a contradiction costs, as a multiple of the noise."""
    anchors_per_frame: int = 300
    """Decoded pixels of each frame that are looked up for that comparison."""
    most_frames: int = 100
    """Frames beyond which no further search is made: it takes time, and many frames hold each other."""
    lost_by_surface: bool = True
    """Whether frames that agree with no others after all searches are looked for by their surfaces."""
    registered_side: int = 240
    """Pixels along the longer side of an image that are used to register surfaces, before the first of them."""
    registered_pixels: int = 300
    """Decoded pixels that a frame must have for its surface to be registered."""


@dataclass(frozen=True)
class CrossValidationSettings:
    """The decision whether adjusted poses (or intrinsics) are kept, based on held-out pixels."""

    pixels_per_frame: int = 300
    """Most held-out pixels used of each frame."""
    frames_per_pixel: int = 8
    """Most other frames in which each of them is looked up."""
    width_noises: float = 4.0
    """Width of the robust kernel, as a multiple of the decoding noise."""
    least_width_px: float = 0.25
    """Smallest width of that kernel, in pattern pixels: looking up between pixels is never perfect."""
    standard_errors: float = 2.0
    """Standard errors by which the mean paired difference must be below zero for the change to be kept."""
    least_gain: float = 0.01
    """Share of the mean robust square by which it must be below zero as well if poses are to be kept: held-out pixels
    share systematic errors of decoding with those that were adjusted, which standard errors do not show."""


@dataclass(frozen=True)
class SelfCalibrationSettings:
    """When captures contradict the stated intrinsics, and how those are changed on request."""

    contradiction: float = 50.0
    """Chi square (six degrees of freedom) above which the captures contradict the intrinsics. Chance alone exceeds it
    once in 10^8, but the errors of blocks of pixels are not independent."""
    least_change: float = 1e-3
    """Changes below this share of the focal length are never reported: no calibration is that good."""
    agreement: float = 6.0
    """Chi square of correct intrinsics: below it, no further steps are taken."""
    rounds: int = 3
    """Most Gauss-Newton steps of the intrinsics; all poses are adjusted again after each."""


@dataclass(frozen=True)
class AdjustmentSettings:
    """Size and details of the bundle adjustment."""

    anchors_per_frame: int = 600
    """Decoded pixels of each frame that are looked up in other frames."""
    max_anchors: int = 12000
    """The same over all frames, at most: time grows with this number, accuracy with its square root."""
    least_anchors_per_frame: int = 60
    """The same of each frame, at least, however many frames there are."""
    partners: int = 64
    """Other frames in which those of one frame may be looked up, about; chosen at random from those that see the same
    surface. So the time grows with the number of frames, not with its square."""
    frames_per_anchor: int = 8
    """Most other frames in which each of them is looked up."""
    max_iterations: int = 40
    """Most Levenberg-Marquardt steps."""
    rigid_iterations: int = 5
    """Most steps in which frames move as a whole, before projectors move relative to their cameras."""
    observe_every: int = 4
    """Steps between new choices of which frame sees which anchor."""
    least_cosine: float = 0.1
    """Cosine between surface normal and ray below which a device counts as not seeing a point."""
    independent_residuals: float = 50.0
    """Number of a frame's residuals that count as independent of each other while the poses are still rough."""
    image_blocks: int = 4
    """Blocks along each side of an image; the covariance allows residuals within a block to depend on each other."""
    seed: int = 0
    """Seed of the choice of pixels."""
    look_up: LookUpSettings = field(default_factory=LookUpSettings)
    """Look-up of coordinates between pixels."""
    kernel: KernelSettings = field(default_factory=KernelSettings)
    """Robust kernel."""
    steps: StepSettings = field(default_factory=StepSettings)
    """Levenberg-Marquardt steps."""
    relocalisation: RelocalisationSettings = field(default_factory=RelocalisationSettings)
    """Search for frames that ended in a wrong minimum."""
    hops: HopSettings = field(default_factory=HopSettings)
    """Further searches after rough starts."""
    other_minima: OtherMinimaSettings = field(default_factory=OtherMinimaSettings)
    """Other poses that agree as well."""
    cross_validation: CrossValidationSettings = field(default_factory=CrossValidationSettings)
    """Decision between the result and the starting poses."""
    self_calibration: SelfCalibrationSettings = field(default_factory=SelfCalibrationSettings)
    """Intrinsics that the captures contradict."""

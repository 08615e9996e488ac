"""Settings of the bundle adjustment. The defaults suit object-sized scans; `benchmarks.settings_sweep` varies them."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class LookUpSettings:
    """How decoded coordinates are looked up between pixels."""

    half_window: int = 3
    """Camera pixels to each side of the window in which a paraboloid is fitted."""
    least_pixels: int = 24
    """Decoded pixels that a window must hold."""
    least_pivot: float = 1e-3
    """Smallest share of a pivot that elimination may leave; below it the window's pixels lie on a conic."""
    roughness_px: float = 2.0
    """RMS distance, in pattern pixels, of a window's pixels from their paraboloid, beyond which the map is torn
    there."""
    roughness_medians: float = 3.0
    """The same limit as a multiple of the median window's roughness; the larger limit holds."""
    sampled_windows: int = 200
    """Windows of each frame from which that median is taken."""


@dataclass(frozen=True)
class KernelSettings:
    """Width of the robust kernel (Geman-McClure), which narrows while the poses improve."""

    medians: float = 2.0
    """Width that a frame's kernel narrows to, as a multiple of its median residual."""
    noises: float = 3.0
    """Smallest width, as a multiple of the estimated noise."""
    fastest: float = 1.4
    """Factor by which a kernel narrows in one step at most."""
    noise_floor_px: float = 0.01
    """Smallest noise of one look-up that is believed, in pattern pixels."""


@dataclass(frozen=True)
class StepSettings:
    """Levenberg-Marquardt steps."""

    damping: float = 1e-4
    """Damping of the first step, as a share of the normal matrix's diagonal."""
    relax: float = 5.0
    """Factor by which damping falls after a step that was accepted."""
    tighten: float = 10.0
    """Factor by which damping grows after a step that was refused."""
    least_damping: float = 1e-9
    """Damping never falls below this."""
    tries: int = 8
    """Refused steps in a row after which the poses stay where they are."""
    least_depth: float = 0.7
    """Smallest factor by which one step may change an anchor's depth."""
    most_depth: float = 1.4
    """Largest factor by which one step may change an anchor's depth."""
    converged: float = 1e-4
    """Largest component of a step, in scene units or radian, below which the poses have converged."""
    settled: float = 0.98
    """Share of its last width above which a kernel counts as no longer narrowing."""


@dataclass(frozen=True)
class RelocalisationSettings:
    """The search for frames that ended in a wrong minimum."""

    rounds: int = 3
    """Searches at most; frames that were found help to find the others."""
    anchors_per_frame: int = 200
    """Decoded pixels of each frame that take part."""
    most_residuals: int = 6000
    """Residuals between one frame and all others that take part, at most."""
    starts: int = 12
    """Places from which a lost frame is searched, drawn from the prior."""
    frame_steps: int = 10
    """Steps from each place in which the frame moves as a whole."""
    projector_steps: int = 10
    """Steps after those in which its projector moves, too."""
    observe_every: int = 3
    """Steps between new choices of which pixels the other frames see."""
    inlier_noises: float = 5.0
    """Residual, as a multiple of the noise, up to which it supports a pose."""
    least_gain: float = 0.02
    """Share of supporting residuals that a new place must add to replace the old one."""
    sigmas: float = 4.0
    """A frame is lost if its support lies this many robust standard deviations below the median frame's."""
    least_share: float = 0.75
    """Support below this share of the median frame's always counts as lost."""
    most_share: float = 0.95
    """Support above this share of the median frame's never counts as lost."""


@dataclass(frozen=True)
class CrossValidationSettings:
    """The decision whether adjusted poses (or intrinsics) are kept, on pixels that were held out."""

    pixels_per_frame: int = 300
    """Held-out pixels of each frame, at most."""
    frames_per_pixel: int = 8
    """Other frames in which each of them is looked up, at most."""
    width_noises: float = 4.0
    """Width of the robust kernel, as a multiple of the decoding noise."""
    least_width_px: float = 0.25
    """Smallest width of that kernel, in pattern pixels: looking up between pixels is never perfect."""
    standard_errors: float = 2.0
    """Standard errors by which the mean paired difference must lie below zero for the change to be kept."""


@dataclass(frozen=True)
class SelfCalibrationSettings:
    """When captures contradict the stated intrinsics, and how those are changed on request."""

    contradiction: float = 50.0
    """Chi square (six degrees of freedom) beyond which the intrinsics are contradicted. Chance alone exceeds it once in
    10^8, but blocks of pixels do not err independently."""
    least_change: float = 1e-3
    """Changes below this share of the focal length are never reported: no calibration is that good."""
    agreement: float = 6.0
    """Chi square that right intrinsics have: below it the change ends."""
    rounds: int = 3
    """Gauss-Newton steps of the intrinsics at most; all poses are adjusted again after each."""


@dataclass(frozen=True)
class AdjustmentSettings:
    """Size and details of the bundle adjustment."""

    anchors_per_frame: int = 600
    """Decoded pixels of each frame that are looked up in other frames."""
    max_anchors: int = 12000
    """The same over all frames, at most: time grows with this number, accuracy with its square root."""
    frames_per_anchor: int = 8
    """Other frames in which each of them is looked up, at most."""
    max_iterations: int = 40
    """Levenberg-Marquardt steps, at most."""
    rigid_iterations: int = 5
    """Steps, at most, in which frames move as a whole before projectors move against their cameras."""
    observe_every: int = 4
    """Steps between new choices of which frame sees which anchor."""
    least_cosine: float = 0.1
    """Cosine between surface normal and ray below which a device is taken not to see a place."""
    independent_residuals: float = 50.0
    """Residuals of a frame that count as independent of each other while the poses are still rough."""
    image_blocks: int = 4
    """Blocks along each side of an image; residuals within a block may depend on each other in the covariance."""
    seed: int = 0
    """Seed of the choice of pixels."""
    look_up: LookUpSettings = field(default_factory=LookUpSettings)
    """Coordinates between pixels."""
    kernel: KernelSettings = field(default_factory=KernelSettings)
    """Robust kernel."""
    steps: StepSettings = field(default_factory=StepSettings)
    """Levenberg-Marquardt steps."""
    relocalisation: RelocalisationSettings = field(default_factory=RelocalisationSettings)
    """Frames that ended in a wrong minimum."""
    cross_validation: CrossValidationSettings = field(default_factory=CrossValidationSettings)
    """Keep the result or the starting poses."""
    self_calibration: SelfCalibrationSettings = field(default_factory=SelfCalibrationSettings)
    """Intrinsics that the captures contradict."""

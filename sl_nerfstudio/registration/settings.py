"""Settings of registration. Lengths are in radii: RMS distances of a frame's points from their centroid."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class FrameCloudSettings:
    """Triangulation of one frame."""

    fewest_points: int = 50
    """points that a frame must have"""
    difference_step_rad: float = 1e-4
    """step of the differences of depth by the relative pose, radian"""


@dataclass(frozen=True)
class SurfaceMapSettings:
    """Averaging of a frame's points on a lattice of camera pixels."""

    largest_side: int = 200
    """map pixels along the longer side at most: registration needs no more, and poses are refined later"""
    half_window: int = 2
    """map pixels on each side of the centre of a plane fit"""
    fewest_pixels: int = 8
    """map pixels in a plane fit"""
    largest_relief: float = 0.03
    """RMS departure from the plane, as a share of the depth, beyond which a window holds an edge"""
    least_cosine: float = 0.15
    """cosine between ray and normal below which a surface is seen too obliquely"""
    largest_sigma_ratio: float = 4.0
    """uncertainty of a point relative to the frame's median, beyond which it is left out"""
    centre_depth: float = 0.4
    """radii from the centroid of the visible points to about the centre of the object behind them"""


@dataclass(frozen=True)
class AgreementSettings:
    """When points of one frame agree with the surface of another."""

    hidden_depth: float = 0.35
    """radii behind a surface: points that are farther back are hidden by it, nearer ones contradict it"""
    least_facing_cosine: float = 0.3
    """cosine between the normals of two places that may be the same"""
    behind_penalty: float = 0.5
    """what a point a little behind the surface costs in the score; a point in front of it costs 1"""
    kernel_cutoff: float = 4.0
    """widths of the robust kernel beyond which a point has no weight"""


@dataclass(frozen=True)
class Search:
    """Rotations to start from: all within an angle of the guess."""

    angle_deg: float
    """largest rotation, degrees"""
    spacing_deg: float
    """angle between neighbouring rotations, degrees"""
    all_rolls: bool = False
    """every rotation about the line of sight, combined with tilts within the angle"""


@dataclass(frozen=True)
class PairSettings:
    """Registration of one frame to another."""

    neighbours: Search = field(default_factory=lambda: Search(50.0, 17.0))
    """for frames that follow each other in a sequence"""
    anywhere: Search = field(default_factory=lambda: Search(75.0, 20.0, all_rolls=True))
    """for frames of which nothing is known"""
    nearby: Search = field(default_factory=lambda: Search(20.0, 10.0))
    """for frames that other pairs have placed"""
    rough: Search = field(default_factory=lambda: Search(30.0, 12.0))
    """for frames with rough camera poses"""
    start_scales: tuple[float, ...] = (0.87, 1.0, 1.15)
    """scales to start from, relative to the one that makes the visible parts equally large"""
    tolerance: float = 0.04
    """radii within which a point agrees with a surface: errors of the relative pose bend surfaces by about this much"""
    search_tolerance: float = 0.15
    """the same while starts are compared"""
    coarse_tolerance_factor: float = 2.0
    """tolerance times this while the results of the first refinement are compared"""
    search_points: int = 200
    """points of each frame by which starts are compared"""
    coarse_points: int = 400
    """points of each frame in the first refinement"""
    fine_points: int = 1500
    """points of each frame in the last refinement"""
    coarse_starts: int = 24
    """best starts that are refined"""
    fine_starts: int = 4
    """best distinct results that are refined further"""
    coarse_widths: tuple[float, ...] = (0.3, 0.3, 0.25, 0.25, 0.2, 0.2, 0.15, 0.15, 0.12, 0.1, 0.08, 0.08)
    """kernel width of each step of the first refinement, radii"""
    fine_widths: tuple[float, ...] = (0.08, 0.06, 0.05, 0.04, 0.03, 0.03, 0.03, 0.03)
    """kernel width of each step of the last refinement, radii"""
    damping: float = 1e-4
    """damping of a step, as a share of the trace of the normal equations"""
    largest_step: float = 0.5
    """size of a step, radii"""
    scale_sigma: float = 0.2
    """prior of the logarithm of the scale: how far the sizes of the visible parts may differ"""
    largest_log_scale: float = 0.6
    """bound of the logarithm of the scale"""
    independent_points: float = 40.0
    """points of a pair that count as independent: errors of a surface are shared by neighbouring points"""
    least_information: float = 1e-3
    """information on each unknown that is assumed at least, in inverse squares of radians and radii"""
    least_rms: float = 0.015
    """radii: no pair is assumed to fit better, because errors of the relative pose bend the surfaces"""
    same_rotation_deg: float = 6.0
    """rotation between two results, in degrees, below which they are one"""
    same_shift: float = 0.12
    """shift between two results, in radii, below which they are one"""
    agreement: AgreementSettings = field(default_factory=AgreementSettings)
    """when points agree with a surface"""


@dataclass(frozen=True)
class EdgeSettings:
    """Which registered pairs are accepted, and their weights in the pose graph."""

    least_fitness: float = 0.6
    """share of the points that can be judged which must agree"""
    least_overlap: float = 0.15
    """share of all points which must agree"""
    ambiguous_ratio: float = 0.85
    """score of the second best solution relative to the best, from which a pair is ambiguous"""
    ambiguous_weight: float = 0.5
    """factor of the weight of an ambiguous pair"""
    good_quantile: float = 0.75
    """quantile of the fitness of all pairs that good pairs have"""
    fitness_scale: float = 0.05
    """fitness below that of good pairs at which a pair's weight falls to 1/e"""
    least_weight: float = 0.02
    """weight of the worst pair"""


@dataclass(frozen=True)
class PoseGraphSettings:
    """Cycle consistency, spanning tree and robust optimisation of the graph of frames."""

    cycle_rotation_deg: float = 6.0
    """rotation, in degrees, by which three pairs may fail to close a cycle"""
    cycle_shift: float = 0.15
    """shift, in radii, by which three pairs may fail to close a cycle"""
    cycle_log_scale: float = 0.15
    """logarithm of the scale by which three pairs may fail to close a cycle"""
    cycle_weight: float = 5.0
    """what a closed cycle adds to the strength of an edge in a spanning tree; a perfect pair adds 1"""
    trees: int = 20
    """spanning trees of which the best starts the optimisation: one tree may hold a wrong pair"""
    kernel_chi2: float = 40.0
    """chi square (7 degrees of freedom) at which an edge counts a quarter: errors of edges are not quite normal"""
    first_kernel_factor: float = 30.0
    """kernel_chi2 times this to begin with: the drift of a tree must be within it, wrong pairs should be beyond"""
    kernel_shrinkage: float = 1.7
    """factor by which the squared kernel width falls in an iteration"""
    rejection_factor: float = 4.0
    """kernel_chi2 times this: edges beyond are inconsistent"""
    iterations: int = 40
    """iterations at most"""
    converged: float = 1e-6
    """step, in radian and radii, below which the optimisation has converged"""
    largest_log_scale_step: float = 0.5
    """logarithm of the scale that one step may change"""


@dataclass(frozen=True)
class PairSelectionSettings:
    """Which pairs of frames are registered with each other."""

    sequence_gaps: tuple[int, ...] = (1, 2)
    """differences between the numbers of frames that are paired in a sequence"""
    least_overlap: float = 0.25
    """expected share of common surface that makes a pair worth registering"""
    overlap_tolerance: float = 0.12
    """radii within which surfaces count as overlapping before cycles are closed"""
    largest_view_angle_deg: float = 75.0
    """angle between two lines of sight, in degrees, beyond which frames see no common surface"""
    partners: int = 8
    """pairs of each frame that are tried for closing cycles"""
    rounds: int = 2
    """rounds of closing cycles"""
    bridges: int = 4
    """frames of the largest group with which each frame outside is paired"""


@dataclass(frozen=True)
class StartSettings:
    """Rough camera poses as a start."""

    least_distance: float = 0.2
    """distance of a camera from the object, relative to the median, below which it is not used"""


@dataclass(frozen=True)
class AcceptanceSettings:
    """Which frames are registered in the end, and what is uncertain about them."""

    least_fitness: float = 0.55
    """share of a frame's points, of those that other frames can judge, which must agree"""
    largest_sigma_rotation_deg: float = 3.0
    """standard deviation of the least known rotation, in degrees, beyond which it is uncertain"""


@dataclass(frozen=True)
class KnownLengthSettings:
    """Points that a user picked in images."""

    picking_radius_px: float = 3.0
    """pixels around a picked one of whose depths the median is taken"""


@dataclass(frozen=True)
class RegistrationSettings:
    """All settings of registration."""

    surface_map: SurfaceMapSettings = field(default_factory=SurfaceMapSettings)
    """averaging of each frame's points"""
    start: StartSettings = field(default_factory=StartSettings)
    """rough camera poses"""
    pair: PairSettings = field(default_factory=PairSettings)
    """registration of one frame to another"""
    selection: PairSelectionSettings = field(default_factory=PairSelectionSettings)
    """which pairs are registered"""
    edge: EdgeSettings = field(default_factory=EdgeSettings)
    """which pairs are accepted"""
    pose_graph: PoseGraphSettings = field(default_factory=PoseGraphSettings)
    """all accepted pairs together"""
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    """which frames are registered"""


FRAME_CLOUD_DEFAULTS = FrameCloudSettings()
REGISTRATION_DEFAULTS = RegistrationSettings()
KNOWN_LENGTH_DEFAULTS = KnownLengthSettings()

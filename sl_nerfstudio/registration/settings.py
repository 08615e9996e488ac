"""Settings of registration. Lengths are in radii: RMS distances of a frame's points from their centroid."""

from dataclasses import dataclass, field

# Settings of tones: what of a frame's brightness belongs to its surface, and when it holds two frames.


@dataclass(frozen=True)
class ToneSettings:
    """What of a frame's brightness belongs to its surface."""

    window: float = 0.06
    """standard deviation of the window in which brightness is compared, as a share of the map's longer side: what
    changes more slowly is light, not surface"""
    least_cosine: float = 0.35
    """cosine of the normal with the ray of either device, below which the surface is seen or lit too obliquely"""
    knots_deg: tuple[float, ...] = (
        *(0.0, 4.0, 8.0, 12.0, 16.0, 20.0, 25.0, 30.0),
        *(37.0, 45.0, 54.0, 63.0, 72.0, 81.0, 90.0),
    )
    """angles of the normal to light, camera and the middle of both, in degrees, between which brightness is linear:
    highlights are narrow"""
    ridge: float = 1e-4
    """weight of the squares of those functions, relative to one pixel's"""
    border: int = 2
    """map pixels along the border of what is known that have no tone"""
    fewest_pixels: int = 60
    """map pixels of a connected part of the surface that has a tone"""
    largest: float = 3.0
    """tone, in robust standard deviations of the frame's, beyond which it is cut off: a highlight"""


@dataclass(frozen=True)
class ToneMatchSettings:
    """Frames that slip along each other, held by the tone of their surface."""

    step_deg: float = 3.0
    """rotation between places that are compared, degrees"""
    follow_steps: int = 2
    """steps by which the rest of the motion follows each of them"""
    followed_points: int = 300
    """points of each frame by which it follows"""
    points: int = 5000
    """points of a frame that are compared at most"""
    least_share: float = 0.15
    """share of a frame's toned points that the other must see, for a correlation to count"""
    least_correlation: float = 0.3
    """correlation of the tones at the place that is taken"""
    largest_correlation: float = 0.999
    """correlation that counts at most: Fisher's transform of 1 is infinite"""
    least_lead: float = 2.0
    """lead of that place over all others, Fisher's transforms, in standard deviations of what chance gives"""
    fewest_others: int = 12
    """other places that it must be compared with"""
    least_sigma_deg: float = 0.3
    """smallest standard deviation, in degrees, of a rotation found so"""
    largest_sigma_deg: float = 1.5
    """largest such standard deviation: broad shades are as likely light as surface"""
    largest_loss: float = 0.05
    """share of the points that may agree less there than where the surfaces agree best"""


# Settings of what looks the same, or nearly, from several sides. Lengths are in radii, see `registration.settings`.


@dataclass(frozen=True)
class SymmetrySettings:
    """When a surface looks the same after a turn."""

    same_rotation_deg: float = 8.0
    """rotation between two turns, in degrees, below which they are one"""
    largest_log_scale: float = 0.05
    """logarithm of the scale of a turn, which is 0 but for the errors of the pairs"""
    least_agreeing: float = 0.25
    """points that must agree after the turn, as a share of those that agree before it: what was seen from one side only
    covers little of its place upside down"""
    neighbours: int = 6
    """frames with which each one is compared after the turn"""
    most_compared: int = 12
    """turns that are tried"""
    exact_widths: tuple[float, ...] = (0.06, 0.04, 0.03, 0.02, 0.01, 0.0, 0.0)
    """kernel width, in radii, of each step that makes a turn exact; never below `kernel_sigmas` of pairs"""
    exact_rcond: float = 1e-6
    """singular values, relative to the largest, along which a turn is not moved: what is round slips"""
    least_excess: float = 8.0
    """how many times as much must contradict after a part of a turn as after all of it; less: it is round, or long"""


@dataclass(frozen=True)
class TurnedBlockSettings:
    """Which blocks of frames are at the wrong one of several sides that look nearly the same."""

    fewest_frames: int = 3
    """frames of a component in which blocks are looked for"""
    neighbours: int = 16
    """frames with which each one is compared"""
    most_compared: int = 12
    """turns that are tried"""
    least_judged: float = 0.1
    """points that a pair can judge, in frames, if it says how much usually contradicts"""
    better_quantile: float = 0.25
    """quantile of the shares that contradict in pairs: those inside a block, even if blocks contradict each other"""
    least_misfit: float = 0.003
    """share that may contradict in such pairs: points at edges do in every pair"""
    usual_factor: float = 1.5
    """times as much may contradict before it counts against a block"""
    least_contradicting: float = 0.5
    """points that must contradict beyond the usual, in frames, if a block is looked for"""
    starts: int = 24
    """frames from which a block is grown"""
    least_agreeing: float = 1.0
    """points of a block that must agree with the other frames after the turn, in frames: 1 is all points of one"""
    least_overlap: float = 0.1
    """the same, relative to those that agreed before it"""
    largest_remainder: float = 0.5
    """share that contradicts across a block after the turn, relative to that before it"""
    least_improvement: float = 0.8
    """share that contradicts among all frames after the turn, relative to that before it"""
    most_tried: int = 2
    """turned blocks of a component that are tried, those that contradict most"""
    most_turned: int = 4
    """times that blocks are turned, one after the other"""


@dataclass(frozen=True)
class FrameCloudSettings:
    """Triangulation of one frame."""

    fewest_points: int = 50
    """points that a frame must have"""


@dataclass(frozen=True)
class EmptyPlaceSettings:
    """Where a frame saw nothing."""

    margin: float = 0.02
    """distance within which nothing of the pattern may be seen, as a share of the image's longer side"""
    projector_side: int = 100
    """places along the longer side of the pattern at which it is known how far its light went"""


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
    lattice_error: float = 0.25
    """error of a point that no averaging removes, map pixels"""
    orientations: int = 150
    """directions that normals are sorted into, about 15 degrees apart"""
    centre_depth: float = 0.4
    """radii from the centroid of the visible points to about the centre of the object behind them"""
    middle: float = 0.15
    """distance from the image's centre, as a share of its shorter side, within which the object may be expected"""
    fewest_central: int = 200
    """map pixels in the middle at least; with fewer, the middle is larger"""
    near_quantile: float = 0.3
    """quantile of the depths in the middle at which the object is expected: a table may be behind it"""
    nearness: float = 0.1
    """share of that depth by which the object's centre lies behind its surface at most"""
    empty: EmptyPlaceSettings = field(default_factory=EmptyPlaceSettings)
    """where a frame saw nothing"""
    tone: ToneSettings = field(default_factory=ToneSettings)
    """what of the brightness belongs to the surface"""


@dataclass(frozen=True)
class AgreementSettings:
    """When points of one frame agree with the surface of another."""

    hidden_depth: float = 0.35
    """radii behind a surface: points that are farther back are hidden by it, nearer ones contradict it"""
    least_facing_cosine: float = 0.3
    """cosine between the normals of two places that may be the same"""
    least_lit_cosine: float = 0.35
    """cosine between a surface's normal and its rays to camera and projector above which it would be seen and lit"""
    behind: float = 0.5
    """what a point a little behind the surface counts as, where a point in front of it counts as 1"""
    search_penalty: float = 1.0
    """what a point that contradicts costs in the score while starts are compared; one that agrees earns 1"""
    penalty: float = 3.0
    """the same where results are compared: of right pairs hardly any point contradicts, and a plane always agrees with
    a plane"""
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
    start_scales: tuple[float, ...] = (0.8, 1.0, 1.25)
    """scales to start from, relative to the one that makes the expected objects equally large, or equally far"""
    tolerance_sigmas: float = 4.0
    """standard deviations of the two surfaces within which a point agrees"""
    search_tolerance: float = 0.15
    """radii within which a point agrees while starts are compared"""
    coarse_tolerance: float = 0.06
    """the same while the results of the first refinement are compared"""
    likeness_points: int = 80
    """points of each frame by which pairs are chosen"""
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
    """kernel width of each step of the first refinement, radii; never below `kernel_sigmas`"""
    fine_widths: tuple[float, ...] = (0.08, 0.06, 0.04, 0.03, 0.02, 0.015, 0.01, 0.0, 0.0, 0.0)
    """kernel width of each step of the last refinement, radii; never below `kernel_sigmas`"""
    kernel_sigmas: float = 3.0
    """least width of the kernel, in standard deviations of the two surfaces"""
    likely: float = 0.7
    """share of the largest overlap that a result must have to say how closely surfaces agree"""
    common_rms: float = 2.5
    """width at which results are compared, in root mean square distances of the closest one"""
    least_width: float = 1.25
    """least such width, in standard deviations of the surfaces"""
    common_steps: int = 4
    """steps of refinement with a kernel of that width"""
    damping: float = 1e-4
    """damping of a step, as a share of the trace of the normal equations"""
    largest_step: float = 0.5
    """size of a step, radii"""
    scale_sigma: float = 0.25
    """prior of the logarithm of the scale, about that of the start"""
    largest_log_scale: float = 0.6
    """bound of the logarithm of the scale, about that of the start"""
    independent_points: float = 40.0
    """points of a pair that count as independent: errors of a surface are shared by neighbouring points"""
    least_information: float = 1e-3
    """information on each unknown that is assumed at least, in inverse squares of radians and radii"""
    shift_sigmas: float = 1.5
    """error of a pair's translation that all points share, in standard deviations of the surfaces"""
    turn_sigmas: float = 0.4
    """the same of its rotation and its scale, as lengths at one radius"""
    slip_angles_deg: tuple[float, ...] = (4.0, 8.0, 12.0)
    """rotations, in degrees, by which slipping is tried"""
    bounded_slip_deg: float = 4.0
    """slip, in degrees, up to which several pairs together connect frames: an uncertainty like any other"""
    slip_steps: int = 5
    """steps by which the rest of the motion follows each of these rotations"""
    slip_sigmas: float = 3.0
    """displacement along its normal, in standard deviations of both surfaces, from which a point notices a motion"""
    slip_rise: float = 0.056
    """rise of the mean robust cost from which a motion is noticed: three standard errors of about 40 independent points
    that each have one standard deviation"""
    same_rotation_deg: float = 6.0
    """rotation between two results, in degrees, below which they are one"""
    same_shift: float = 0.12
    """shift between two results, in radii, below which they are one"""
    tone: ToneMatchSettings = field(default_factory=ToneMatchSettings)
    """how the tone of a surface holds frames that would slip"""
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
    """Robust optimisation of the graph of frames."""

    kernel_chi2: float = 40.0
    """chi square (7 degrees of freedom) at which an edge counts a quarter: errors of edges are not quite normal"""
    first_kernel_factor: float = 30.0
    """kernel_chi2 times this to begin with: the drift of a component must be within it, wrong pairs beyond"""
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
    step_factors: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1, 0.02)
    """lengths of a step that are tried, relative to that of Gauss-Newton, until one costs no more than none"""
    least_information: float = 1e-9
    """that every unknown has, so that the equations can be solved"""


@dataclass(frozen=True)
class AssemblySettings:
    """Which components of frames are joined."""

    tolerance_sigmas: float = 6.0
    """standard deviations of two surfaces within which points agree: components have small errors of their own"""
    least_agreeing: float = 0.15
    """points that must agree across two components, in frames: 1 is all points of one frame"""
    misfit_factor: float = 2.5
    """share of the points that may contradict, of those that can be judged, relative to good pairs of the scan"""
    inner_misfit_factor: float = 1.6
    """the same relative to frames of one component that look as much alike as those across"""
    least_misfit: float = 0.015
    """share that may contradict in good pairs: points at edges do in every pair"""
    largest_sigma_deg: float = 6.0
    """standard deviation of the least known rotation, in degrees, of a pair that joins two components on its own"""
    largest_rival: float = 0.85
    """votes for a clearly different similarity, relative to the best one, from which the connection is undecided"""
    slip_deg: float = 8.0
    """rotation, in degrees, along which two components must notice that they slip"""
    slip_sigmas: tuple[float, ...] = (0.4, 0.8, 1.6, 3.2)
    """widths of the kernel of that test, in standard deviations of the surfaces: the first that is wide enough"""
    saturated: float = 0.4
    """mean cost from which a kernel is too narrow for the errors that components have of their own"""
    same_chi2: float = 30.0
    """chi square (7 degrees of freedom) of the difference between two similarities, by the uncertainty of a pair, up
    to which they are one: a pair that may slip does not contradict another that slipped"""
    most_compared: int = 8
    """clearly different similarities that are compared at most"""
    same_rotation_deg: float = 8.0
    """rotation between two similarities, in degrees, below which they are one"""
    same_shift: float = 0.2
    """shift between two similarities, in radii, below which they are one"""
    most_pairs: int = 12
    """pairs of frames across two components that are compared at most"""


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
    compared_frames: int = 40
    """frames that each is compared with to find those: with known poses the ones with the most similar lines of sight,
    without any, random ones"""
    rounds: int = 2
    """rounds of closing cycles"""
    least_joined: float = 0.5
    """share of successive frames that must be joined for the order of the frames to be that of capture"""
    likely_partners: int = 8
    """frames with which each frame is registered where no order is known: those that look most alike"""
    bridged: int = 4
    """components, the largest ones, that are bridged with all others"""
    bridges: int = 8
    """pairs of frames across two components that are registered in order to join them"""
    most_compared: int = 40
    """pairs across two components of which those that look most alike are chosen"""
    bridges_nearby: int = 3
    """how many of these are those taken one soon after the other"""


@dataclass(frozen=True)
class StartSettings:
    """Rough camera poses as a start."""

    least_distance: float = 0.2
    """distance of a camera from the object, relative to the median, below which it is not used"""


@dataclass(frozen=True)
class ProjectorChoiceSettings:
    """Which of several poses of a frame's projector is right."""

    reach: int = 2
    """frames before and after a frame with which each of its poses is compared"""
    rival: float = 0.8
    """support of another pose, relative to the best one, from which the choice is not certain"""


@dataclass(frozen=True)
class AcceptanceSettings:
    """Which frames are registered in the end, and what is uncertain about them."""

    least_fitness: float = 0.55
    """share of a frame's points, of those that other frames can judge, which must agree"""
    most_doubtful: float = 0.25
    """share of the frames up to which those are left out most of whose pairs contradict the pose found: where there are
    more, the pairs are to blame"""
    largest_sigma_rotation_deg: float = 3.0
    """standard deviation of the least known rotation, in degrees, beyond which it is uncertain"""
    unknown_sigma_rotation_deg: float = 104.0
    """the same where nothing tells the angle: that of all angles from -180 to 180"""


@dataclass(frozen=True)
class KnownLengthSettings:
    """Points that a user picked in images."""

    picking_radius_px: float = 3.0
    """pixels around a picked one of whose depths the median is taken"""
    least_metres: float = 1e-9
    """shortest known length, in metres: nothing that a camera sees is smaller"""
    most_metres: float = 1e9
    """longest known length, in metres"""


@dataclass(frozen=True)
class CaptureOrderSettings:
    """How frames of a symmetric object are placed by the order of capture."""

    least_steps: float = 0.5
    """share of the successive frames that must agree for their usual step to be known"""
    different_sides_deg: float = 20.0
    """rotation between two results of a pair, in degrees, beyond which they show different sides of the object"""
    largest_step: float = 2.0
    """largest rotation between successive frames, in usual steps"""
    spacing: float = 0.5
    """angle between the rotations from which a step is searched for, in usual steps"""
    least_ratio: float = 0.5
    """score of a small step, relative to that of the best result of its pair, from which it may be right"""


@dataclass(frozen=True)
class RegistrationSettings:
    """All settings of registration."""

    surface_map: SurfaceMapSettings = field(default_factory=SurfaceMapSettings)
    """averaging of each frame's points"""
    start: StartSettings = field(default_factory=StartSettings)
    """rough camera poses"""
    pair: PairSettings = field(default_factory=PairSettings)
    """registration of one frame to another"""
    choice: ProjectorChoiceSettings = field(default_factory=ProjectorChoiceSettings)
    """which of several poses of a frame's projector is right"""
    selection: PairSelectionSettings = field(default_factory=PairSelectionSettings)
    """which pairs are registered"""
    edge: EdgeSettings = field(default_factory=EdgeSettings)
    """which pairs are accepted"""
    assembly: AssemblySettings = field(default_factory=AssemblySettings)
    """which components of frames are joined"""
    pose_graph: PoseGraphSettings = field(default_factory=PoseGraphSettings)
    """all accepted pairs together"""
    acceptance: AcceptanceSettings = field(default_factory=AcceptanceSettings)
    """which frames are registered"""
    symmetry: SymmetrySettings = field(default_factory=SymmetrySettings)
    """whether the surface looks the same after a turn"""
    blocks: TurnedBlockSettings = field(default_factory=TurnedBlockSettings)
    """which blocks of frames are at the wrong side"""
    order: CaptureOrderSettings = field(default_factory=CaptureOrderSettings)
    """what the order of capture decides then"""


FRAME_CLOUD_DEFAULTS = FrameCloudSettings()
REGISTRATION_DEFAULTS = RegistrationSettings()
KNOWN_LENGTH_DEFAULTS = KnownLengthSettings()

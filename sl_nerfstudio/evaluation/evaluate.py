"""The whole evaluation of one result: its surface and poses against the truth, and its agreement with the captures."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.errors import UserError, first_line
from sl_nerfstudio.evaluation.agreement import CaptureAgreement, FrameAgreement, FramePixels, compare_captures
from sl_nerfstudio.evaluation.completeness import Completeness, assess_completeness
from sl_nerfstudio.evaluation.mesh_faults import MeshFault, find_mesh_faults, missed_axes
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.part_alignment import PartAlignment, place_on_part
from sl_nerfstudio.evaluation.reference import (
    MeshReference,
    PointReference,
    PoseErrors,
    Reference,
    align_poses,
    compare_poses,
    mesh_reference,
)
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity
from sl_nerfstudio.meshing.files import read_colour, read_mesh, read_quality
from sl_nerfstudio.meshing.mesh import Mesh, VertexQuality
from sl_nerfstudio.meshing.uncertainty import length_sigma
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.processing.result import ProcessRecord, read_record
from sl_nerfstudio.review.agreement import CrossFrameAgreement, compare_scan_frames
from sl_nerfstudio.review.verdict import DepartedFrame, departed_frames
from sl_nerfstudio.runs.pose_covariance import read_covariance
from sl_nerfstudio.scan import (
    FileError,
    Frame,
    PoseSigma,
    Scan,
    read_devices,
    read_ground_truth,
    read_pose_sigmas,
    read_poses,
    read_scan,
    read_unplaced,
)
from sl_nerfstudio.scan.coordinates import ARRAY_DAMAGE
from sl_nerfstudio.scan.document import TRANSFORMS, check_file, read_document
from sl_nerfstudio.scan.types import UNITS

# Distances between a reconstructed surface and the truth.
#
# *Accuracy* is the distance of every part of the result from the truth: wrong or invented surface makes it worse.
# *Completeness* is the distance of every observable part of the truth from the result: holes make it worse.


@dataclass(frozen=True)
class DistanceStats:
    """Summary of distances, in the scan's unit."""

    mean: float
    median: float
    rmse: float
    p95: float  # 95 % of the distances are below

    @staticmethod
    def of(distance: Float[ndarray, "n"]) -> "DistanceStats":
        """Summary of at least one distance."""
        return DistanceStats(
            mean=float(distance.mean()),
            median=float(np.median(distance)),
            rmse=float(np.sqrt((distance**2).mean())),
            p95=float(np.percentile(distance, 95)),
        )


@dataclass(frozen=True)
class SurfaceScore:
    """How close result and truth are after one alignment; lengths in the truth's unit."""

    accuracy: DistanceStats  # result -> truth
    completeness: DistanceStats  # observed truth -> result
    chamfer: float  # mean of the two means
    f_score: dict[float, float]  # distance -> harmonic mean of the shares of result and truth that are closer than it
    scale: float  # factor the result was multiplied by
    S_truth_result: Similarity


def score_surface(
    result: IndexedMesh,
    samples: Float[ndarray, "n 3"],
    reference: Reference,
    S_truth_result: Similarity,
    f_distances: Sequence[float],
) -> SurfaceScore:
    """Distances in both directions after the result was moved by `S_truth_result`.

    `samples` are area-uniform points on the result, in its own frame.
    """
    accuracy = reference.distance(S_truth_result.points(samples))
    # The truth is moved into the result's frame: the same distances without building a second search tree.
    observed = S_truth_result.inverse().points(reference.observed)
    completeness = result.distance(observed) * S_truth_result.scale
    return SurfaceScore(
        accuracy=DistanceStats.of(accuracy),
        completeness=DistanceStats.of(completeness),
        chamfer=float(accuracy.mean() + completeness.mean()) / 2,
        f_score={d: _f_score(accuracy, completeness, d) for d in f_distances},
        scale=S_truth_result.scale,
        S_truth_result=S_truth_result,
    )


def _f_score(accuracy: Float[ndarray, "n"], completeness: Float[ndarray, "m"], distance: float) -> float:
    precision, recall = float((accuracy <= distance).mean()), float((completeness <= distance).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0


def default_f_distances(size: float) -> tuple[float, ...]:
    """Four round distances from about a thousandth to a hundredth of `size`: 0.1, 0.2, 0.5, 1 for size 110."""
    exponent = np.floor(np.log10(size * 1e-3) + 1e-9)
    mantissa = size * 1e-3 / 10.0**exponent
    first = max(k for k in (1, 2, 5) if k <= mantissa * (1 + 1e-9))
    return tuple(float(f"{k * first * 10.0**exponent:.3g}") for k in (1, 2, 5, 10))


# The files that an evaluation reads: mesh, scan, poses, truth or reference, and what is known about the training.

_FEWEST_POINTS = 100
_ANOTHER_UNIT = 5.0  # ratio of sizes that no part of an object explains if it does not fit
FILE_UNITS = {".stl": "mm", ".glb": "m"}
"""Units of mesh files that have one."""


@dataclass(frozen=True)
class EvaluationInputs:
    """A result and what it is evaluated on; lengths in the scan's unit."""

    mesh: Mesh
    scan: Scan  # with the intrinsics of the poses file, if it has any
    poses: DevicePoses  # to evaluate
    true_poses: DevicePoses | None
    reference: Reference | None
    poses_path: Path | None  # None: the scan's own poses are evaluated
    pose_sigma: list[PoseSigma | None] = field(default_factory=list)  # one per frame, or empty
    unplaced: list[str] = field(default_factory=list)  # frames that the poses file says do not agree with the others
    training: dict[str, Any] | None = None  # training.json next to the poses: settings, versions, curves
    quality: VertexQuality | None = None  # of the mesh's vertices, if its file says
    joint: JointCovariance | None = None  # of the evaluated poses, if it is known
    true_units: str | None = None  # of the truth that is compared with, where its files say
    colour: UInt8[ndarray, "v 3"] | None = None  # sRGB, of the mesh's vertices, if its file has them
    record: ProcessRecord | None = None  # of the captures, if sl-process made the scan
    placed: PartAlignment | None = None  # of the result on a reference mesh that was given

    @property
    def stated_sigma(self) -> list[PoseSigma | None]:
        """Stated uncertainty of the evaluated poses, where those are the scan's rough starting poses; else none.

        Refined poses count as exact, so that their errors show.
        """
        return [None if self.poses_path is not None else frame.pose_sigma for frame in self.scan.frames]

    @property
    def departed(self) -> list[DepartedFrame]:
        """Frames that ended far from their starting poses; none where those are evaluated."""
        return [] if self.poses_path is None else departed_frames(self.scan, self.poses)


def read_inputs(
    mesh: Path,
    data: Path,
    poses: Path | None,
    reference: Path | None,
    samples: int,
    seed: int,
    reference_unit: str | None = None,
) -> EvaluationInputs:
    """Read everything. `poses` is a transforms.json or its folder; `reference` replaces the mesh in ground_truth/.

    A `reference` mesh, whose lengths are in `reference_unit`, may have any axes: the result is placed on it by its
    shape. `samples` points with `seed` are spread over a true mesh. Raises UserError for anything missing or faulty.
    """
    scan = read_scan(data)
    result = read_mesh(mesh, scan.units)
    truth = read_ground_truth(scan)
    path = poses / TRANSFORMS if poses and poses.is_dir() else poses
    training = None if path is None else path.with_name("training.json")
    quality, colour, record = read_quality(mesh), read_colour(mesh), scan.root / "processing.json"
    evaluated = scan.poses if path is None else read_refined_poses(path, scan)
    scan = scan if path is None else read_devices(path, scan)
    if reference is None or reference.suffix.lower() == ".npz":
        path_of_truth = reference or truth.mesh_path
        compared, placed = read_reference(path_of_truth, scan, truth.poses or evaluated, samples, seed), None
    else:
        compared, placed = read_part(reference, reference_unit, result, scan, evaluated, truth.poses, samples, seed)
    return EvaluationInputs(
        mesh=result,
        scan=scan,
        poses=evaluated,
        true_poses=truth.poses,
        true_units=truth.units if reference is None else reference_unit or FILE_UNITS.get(reference.suffix.lower()),
        reference=compared,
        placed=placed,
        poses_path=path,
        pose_sigma=[] if path is None else read_pose_sigmas(path, scan),
        unplaced=[] if path is None else read_unplaced(path, scan),
        training=read_document(training) if training is not None and training.exists() else None,
        quality=quality if quality is not None and len(quality.sigma) == len(result.vertices) else None,
        joint=None if path is None else read_covariance(path.parent, scan),
        colour=colour if colour is not None and len(colour) == len(result.vertices) else None,
        record=read_record(record) if record.exists() else None,
    )


def read_refined_poses(path: Path, scan: Scan) -> DevicePoses:
    """Poses of a transforms.json made from `scan`. Raises UserError if they are those of another scan or unit."""
    document, problem = read_document(path), ""
    units, frames = document.get("units"), document.get("frames")
    if units != scan.units:
        problem = f"units: {units!r}, but the scan's are {scan.units!r}"
    elif isinstance(frames, list) and len(frames) != len(scan.frames):
        problem = f"holds {len(frames)} frames, the scan {len(scan.frames)}"
    if problem:
        remedy = "give poses that were refined from this scan"
        raise FileError(path, problem, "the poses are those of another scan", remedy)
    return read_poses(path, scan)


def read_reference(path: Path | None, scan: Scan, poses: DevicePoses, samples: int, seed: int) -> Reference | None:
    """The true mesh or reference points; None without a path. `poses` decide what the scan could observe."""
    if path is None:
        return None
    if path.suffix.lower() == ".npz":
        points = read_points(path)
        return PointReference(
            points, f"{len(points):,} reference points ({path.name}); accuracy cannot fall below their spacing, and "
            "completeness counts all of them",
        )  # fmt: skip
    return mesh_reference(read_mesh(path, scan.units), scan, poses, samples, seed)


def read_part(
    path: Path,
    unit: str | None,
    result: Mesh,
    scan: Scan,
    poses: DevicePoses,
    true_poses: DevicePoses | None,
    samples: int,
    seed: int,
) -> tuple[MeshReference, PartAlignment]:
    """A nominal mesh in any axes, with where `result` lies on it, unless that fits nowhere.

    `unit` is that of the file's lengths; by default the scan's, of .stl millimetres and of .glb metres. Raises
    UserError if the sizes are those of different units.
    """
    of_scan, of_file = UNITS[scan.units], None if unit is None else UNITS[unit]
    part = read_mesh(path, scan.units if unit is None else "arbitrary")
    if of_scan and of_file:
        part = part.mapped(Similarity.scaling(of_file / of_scan))
    placed = place_on_part(result, part, with_scale=not of_scan, seed=seed)
    size, size_of_part = (float(np.linalg.norm(np.subtract(*mesh.bounds()))) for mesh in (result, part))
    if of_scan and not placed.fits and not 1 / _ANOTHER_UNIT < size / size_of_part < _ANOTHER_UNIT:
        stated = unit or FILE_UNITS.get(path.suffix.lower()) or f"{scan.units}, the scan's unit"
        raise FileError(
            path,
            f"measures {size_of_part:.4g} {scan.units} from corner to corner, and the scan's surface "
            f"{size:.4g} {scan.units}",
            f"its lengths are not in {stated}, or the surface is of something else",
            "state the unit of the file with --reference-unit; cut the object out with sl-export --object-only",
        )
    if placed.in_place or not placed.fits:
        return mesh_reference(part, scan, true_poses or poses, samples, seed), placed
    seen = mesh_reference(part, scan, poses.mapped(placed.S_part_result), samples, seed)
    return replace(seen, start=placed.S_part_result), placed


def read_points(path: Path) -> Float64[ndarray, "n 3"]:
    """Points under the key `xyz` of an .npz file, never unpickled. Raises FileError."""
    check_file(path)
    try:
        with path.open("rb") as stream:
            archive = np.load(stream, allow_pickle=False)
            if isinstance(archive, np.ndarray):
                raise ValueError("it is a plain array")
            if "xyz" not in archive:
                raise FileError(
                    path,
                    f"has no key xyz (it has {', '.join(archive.files) or 'none'})",
                    "it is another kind of .npz file",
                    "save the points as numpy.savez(path, xyz=points), points (n, 3)",
                )
            points = archive["xyz"]
    except (*ARRAY_DAMAGE, MemoryError) as error:
        raise FileError(
            path, f"cannot be read ({error})", "it is damaged or not an .npz file", "save the points again"
        ) from error
    right = points.ndim == 2 and points.shape[1] == 3 and len(points) >= _FEWEST_POINTS
    if not right or not np.issubdtype(points.dtype, np.number):
        raise FileError(
            path,
            f"xyz: is {points.dtype} {points.shape}",
            "it is not a list of points",
            f"give at least {_FEWEST_POINTS} points as (n, 3) numbers",
        )
    if not np.isfinite(points).all():
        bad = int((~np.isfinite(points)).any(1).sum())
        raise FileError(path, f"xyz: {bad} points are not numbers", "failed triangulations", "leave those points out")
    return points.astype(np.float64)


ALIGNMENTS = ("rigid", "similarity", "none")


@dataclass(frozen=True)
class Evaluation:
    """Everything `sl-eval` finds; lengths in `units`, distances from the truth in `truth_units`."""

    units: str
    agreement: CaptureAgreement
    reference: Reference | None
    surface: dict[str, SurfaceScore]  # alignment -> score; empty without a reference
    pose_errors: PoseErrors | None  # of the poses that were evaluated
    initial_pose_errors: PoseErrors | None  # of the scan's own poses, if others were evaluated
    starting_poses: bool  # the scan's own poses were evaluated, not refined ones
    cross: CrossFrameAgreement | None = None  # of the frames with each other, under the evaluated poses
    completeness: Completeness | None = None
    mesh_faults: tuple[MeshFault, ...] = ()
    true_units: str | None = None  # what the truth's files say

    @property
    def truth_units(self) -> str:
        """Unit of distances from the truth; a scan of unknown unit is scaled to that of the truth."""
        if self.units != "arbitrary":
            return self.units
        return self.true_units if self.true_units not in (None, "arbitrary") else "units of the truth"

    @property
    def alignment(self) -> str:
        """The alignment to judge by: rigid, or with scale if the scan's unit is unknown."""
        return "similarity" if self.units == "arbitrary" else "rigid"

    @property
    def comparable(self) -> dict[str, SurfaceScore]:
        """The scores that say something: without a known unit, only the one after an alignment with scale."""
        known = self.units != "arbitrary"
        return {name: score for name, score in self.surface.items() if known or name == "similarity"}


@one_library_thread()
def evaluate(
    mesh: Mesh,
    scan: Scan,
    poses: DevicePoses,
    reference: Reference | None = None,
    true_poses: DevicePoses | None = None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
    on_frame: Callable[[Frame, FrameAgreement, FramePixels], None] | None = None,
    sigma: Sequence[PoseSigma | None] = (),
    true_units: str | None = None,
) -> Evaluation:
    """Evaluate `mesh` with `poses` on `scan`; `sigma` is the stated uncertainty of the poses, if they are rough.

    `true_units`, as the files of the truth state it, names distances where the scan's own unit is unknown. `on_frame`
    is called with each frame and its pixels in turn (to make pictures). Raises UserError if the mesh cannot be a
    surface of this scan.
    """
    surface = IndexedMesh(mesh)
    agreement = compare_captures(surface, scan, poses, on_frame)
    if not any(frame.hit_share > 0 for frame in agreement.frames):
        raise UserError(_missed(surface, scan, poses))
    initial = scan.poses
    moved = not np.array_equal(initial.stacked(), poses.stacked())
    scores: dict[str, SurfaceScore] = {}
    if reference is not None:
        # Without true poses the scan's own ones show where the reference is: ICP starts from there as well.
        target_poses = true_poses or (initial if moved else None)
        scores = score_alignments(surface, reference, poses, target_poses, f_distances, samples, seed)
    return Evaluation(
        units=scan.units,
        agreement=agreement,
        reference=reference,
        surface=scores,
        pose_errors=compare_poses(poses, true_poses) if true_poses else None,
        initial_pose_errors=compare_poses(initial, true_poses) if true_poses and moved else None,
        starting_poses=not moved,
        cross=compare_scan_frames(scan, poses, sigma or [None] * len(scan.frames)),
        completeness=assess_completeness(surface, agreement),
        mesh_faults=find_mesh_faults(surface, scan, poses),
        true_units=true_units,
    )


def score_alignments(
    surface: IndexedMesh,
    reference: Reference,
    poses: DevicePoses | None,
    true_poses: DevicePoses | None,
    f_distances: Sequence[float] = (),
    samples: int = 100_000,
    seed: int = 0,
) -> dict[str, SurfaceScore]:
    """Scores after rigid ICP, after ICP with scale, and without any alignment.

    ICP starts from where the result is; on a reference in other axes only from its place there, and there is no score
    without alignment. With true poses (or others in the reference's world) it starts a second time
    from the map of the estimated devices onto those, and the better result counts.
    """
    points, _ = surface.sample(samples, seed)
    distances = tuple(f_distances) or default_f_distances(reference.size)
    start = reference.start if isinstance(reference, MeshReference) else None
    scores = {}
    for name in ALIGNMENTS if start is None else ALIGNMENTS[:-1]:
        S = Similarity.identity()
        if name != "none":
            with_scale = name == "similarity"
            starts = [start] if start else _starts(poses, true_poses, with_scale, points, 1e-6 * surface.diagonal)
            ends = [reference.align(surface, points, start, with_scale) for start in starts]
            S = min(ends, key=lambda end: end.residual).S_target_source
        scores[name] = score_surface(surface, points, reference, S, distances)
    return scores


def _starts(
    poses: DevicePoses | None,
    true_poses: DevicePoses | None,
    with_scale: bool,
    points: Float[ndarray, "n 3"],
    tolerance: float,
) -> list[Similarity]:
    """Choose where ICP starts from; a single start if the poses say that the result is already in place."""
    identity = Similarity.identity()
    if poses is None or true_poses is None:
        return [identity]
    by_poses = align_poses(poses.stacked(), true_poses.stacked(), with_scale)
    apart = np.abs(by_poses.points(points) - points).max() > tolerance
    return [identity, by_poses] if apart else [identity]


def _missed(surface: IndexedMesh, scan: Scan, poses: DevicePoses) -> str:
    """Why no ray hits the mesh, as far as sizes and distances show."""
    distance = float(np.median(np.linalg.norm(poses.T_world_camera[:, :3, 3] - surface.centre, axis=1)))
    axes = missed_axes(surface, scan, poses)
    probably = axes or "probably another unit, other axes or another scan"
    return (
        "no camera ray through a masked pixel hits the mesh\n"
        f"    cause:  mesh and poses do not match: the mesh measures {surface.diagonal:.4g}, and the cameras are "
        f"{distance:.4g} away from it (median; the scan's unit is {scan.units}); {probably}\n"
        "    remedy: give the mesh that was exported from this scan, in its unit and world axes"
    )


# Distances between points of the surface, with their uncertainty.

_OFF_SURFACE = 0.02  # of the mesh's diagonal: a point that is farther away was not meant to be on this mesh
_TYPICAL, _LONG = 400, 0.3  # how many distances say what is typical, and the shortest one, of the mesh's diagonal
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
POINT = rf"{NUMBER},{NUMBER},{NUMBER}"


@dataclass(frozen=True)
class PointPair:
    """Two points in the mesh's unit and axes, and a name for the distance between them."""

    name: str
    p: tuple[float, float, float]
    q: tuple[float, float, float]


@dataclass(frozen=True)
class Length:
    """A distance between two points on the surface, in the scan's unit."""

    name: str
    p: tuple[float, float, float]  # on the surface, nearest to what was given
    q: tuple[float, float, float]
    length: float
    sigma: float | None  # 1 sigma; None if it is not known
    sigma_shared: float | None  # the part from poses and intrinsics
    sigma_independent: float | None  # the part from decoding noise
    views: tuple[int, int] | None  # frames that confirm each end; None if the mesh does not say


def parse_pair(text: str, where: str) -> PointPair:
    """A pair from "x,y,z x,y,z", with "name:" before it if wanted. Raises UserError; `where` is the flag or line."""
    name, colon, rest = text.rpartition(":")
    found = re.fullmatch(rf"\s*({POINT})\s+({POINT})\s*", rest)
    if found is None or (colon and not name.strip()):
        raise UserError(
            f"{where}: {text.strip()!r:.100} is not two points\n"
            '    remedy: give x,y,z of both, in the unit and axes of the mesh: "12.5,-3,40 10,2,38", or '
            '"handle: 12.5,-3,40 10,2,38"'
        )
    p, q = (_triple(np.array(point.split(","), dtype=np.float64)) for point in found.groups())
    return PointPair(name.strip() or f"{found[1]} to {found[2]}", p, q)


def read_pairs(path: Path) -> list[PointPair]:
    """The pairs of a text file, one a line; empty lines and those that begin with # count as nothing."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"--distances {path}: cannot be read ({first_line(error)})\n"
            "    remedy: give a text file with a line such as `handle: 12.5,-3,40 10,2,38` for each distance"
        ) from error
    kept = {number: line for number, line in enumerate(lines, 1) if line.strip() and line.lstrip()[0] != "#"}
    if not kept:
        raise UserError(f"--distances {path}: holds no distances\n    remedy: give a line `name: x,y,z x,y,z` for each")
    return [parse_pair(line, f"{path}, line {number}") for number, line in kept.items()]


def measure_lengths(
    pairs: Sequence[PointPair],
    mesh: Mesh,
    quality: VertexQuality | None,
    scan: Scan,
    poses: DevicePoses,
    joint: JointCovariance | None,
) -> list[Length]:
    """The distances between the surface points nearest to each pair; sigma needs `quality` and `joint`.

    Raises UserError for a point that is far from the surface, or where both are the same point.
    """
    if not pairs:
        return []
    surface = IndexedMesh(mesh)
    given = np.array([[pair.p, pair.q] for pair in pairs])
    near = surface.closest(given.reshape(-1, 3))
    for k, away in enumerate(near.distance):
        if away > _OFF_SURFACE * surface.diagonal:
            raise UserError(_off_surface(pairs[k // 2], given[k // 2, k % 2], float(away), surface, scan.units))
    ends = near.point.reshape(-1, 2, 3)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    for pair, length in zip(pairs, lengths, strict=True):
        if not length > 0:
            raise UserError(f"--distance {pair.name}: both points are the same\n    remedy: give two points")
    used = np.unique(mesh.faces)
    vertices = used[np.asarray(KDTree(mesh.vertices[used]).query(near.point)[1]).reshape(-1, 2)]
    shared = independent = np.full(len(pairs), np.nan)
    if quality is not None and joint is not None:
        found = length_sigma(mesh, quality.sigma_independent, vertices, scan, poses, joint)
        shared, independent = found.shared, found.independent
    views = [None if quality is None else (int(quality.views[a]), int(quality.views[b])) for a, b in vertices]
    return [
        Length(pair.name, _triple(p), _triple(q), float(length), _known(np.hypot(a, b)), _known(a), _known(b), seen)
        for pair, (p, q), length, a, b, seen in zip(pairs, ends, lengths, shared, independent, views, strict=True)
    ]


def typical_sigma(
    mesh: Mesh, quality: VertexQuality | None, scan: Scan, poses: DevicePoses, joint: JointCovariance | None
) -> float | None:
    """Median 1 sigma of distances across the surface, as a share of their length; None if it is not known."""
    seen = np.flatnonzero(quality.views > 0) if quality is not None else np.empty(0)
    if quality is None or joint is None or len(seen) < 2:
        return None
    ends = np.random.default_rng(0).choice(seen, (_TYPICAL, 2))
    length = np.linalg.norm(mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]], axis=1)
    lower, upper = mesh.bounds()
    long = length > _LONG * float(np.linalg.norm(upper - lower))
    if not long.any():
        return None
    found = length_sigma(mesh, quality.sigma_independent, ends[long], scan, poses, joint)
    return _known(np.nanmedian(np.hypot(found.shared, found.independent) / length[long]))


def _triple(p: Float[ndarray, "3"]) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])


def _known(value: float | np.floating) -> float | None:
    return float(value) if np.isfinite(value) else None


def _off_surface(pair: PointPair, point: Float[ndarray, "3"], away: float, surface: IndexedMesh, units: str) -> str:
    at = ",".join(f"{v:g}" for v in point)
    low, high = (",".join(f"{v:.4g}" for v in corner) for corner in (surface.lower, surface.upper))
    return (
        f"--distance {pair.name}: {at} is {away:.4g} away from the surface (unit: {units})\n"
        f"    cause:  the point is in other axes or another unit; the mesh reaches from {low} to {high}\n"
        "    remedy: pick both points on the mesh itself, in a viewer that shows its coordinates"
    )

"""Whether sigma of the vertices is true: errors of exported meshes against the truth, in units of their sigma.

    python -m benchmarks.vertex_coverage [--scenes ...] [--seeds 1 2] [--noise 0.2 0.5] [--again]

Each scan has rough starting poses, and goes through `sl-synth`, `ns-train` and `sl-export` as a user would run them.
The mesh is aligned with the truth as in `sl-eval`, rigidly. If sigma is right, 68 % of the vertices are closer to the
truth than sigma, and 95 % closer than two sigma. Runs that are in the folder are not trained again, and rows that are
in the result file are not measured again, so an interrupted benchmark continues; `--again` measures all of them.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.stats import rankdata

from benchmarks.common.measuring import Rows, kept_rows, options
from benchmarks.common.runs import export, run
from benchmarks.common.runs import train as trained
from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.parameters import UNKNOWNS
from sl_nerfstudio.evaluation.evaluate import EvaluationInputs, read_inputs, score_alignments
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.evaluation.reference import MeshReference
from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.meshing.files import read_quality
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.meshing.uncertainty import length_sigma, vertex_uncertainty

SCENES = ("cone-and-cylinder", "head", "frog", "dog", "vase", "medal")
_SAMPLES = 20_000
_LENGTHS, _AWAY = 500, 0.8  # how many distances, and the least cosine of their ends' normals with them


@dataclass(frozen=True)
class Case:
    """One scan."""

    scene: str
    seed: int
    noise: float  # of decoded coordinates, pattern pixels
    frames: int
    resolution: int
    iterations: int
    intrinsics: float  # 1 sigma of their error, as shares of the focal length; 0: exact, which nobody states

    @property
    def name(self) -> str:
        """Name of its folder."""
        wrong = f"-{self.intrinsics:g}" if self.intrinsics else ""
        return f"{self.scene}-{self.seed}-{self.noise:g}-{self.frames}-{self.resolution}-{self.iterations}{wrong}"


@dataclass(frozen=True)
class Row(Case):
    """Errors of the vertices of one mesh; lengths in mm, shares between 0 and 1."""

    vertices: int  # with a sigma
    unobserved: float  # share of vertices that are marked as not observed
    error_rms: float
    error_rms_unobserved: float  # of the marked ones
    sigma_median: float
    sigma_independent_median: float
    within_1: float
    within_2: float
    within_1_independent: float  # if the shared part is left out
    within_1_exact_intrinsics: float  # if the doubt of the intrinsics, which are exact in these scans, is left out
    lengths_within_1: float  # of distances between points of opposite sides
    lengths_within_2: float
    rank_correlation: float  # of |error| and sigma, over the vertices


def train(case: Case, folder: Path) -> Path:
    """Make the scan and train on it, unless that was done; returns the run's config.yml."""
    scan, out = folder / case.name / "scan", folder / case.name / "runs"
    if not (scan / "transforms.json").exists():
        run("sl-synth", "--output", scan, "--scene", case.scene, "--frames", case.frames, "--resolution",
            case.resolution, "--seed", case.seed, "--noise", case.noise)  # fmt: skip
        disturb_intrinsics(scan / "transforms.json", case)
    config = out / "run/sl-neus/now/config.yml"
    stated = ("--pipeline.model.prior.intrinsics", str(case.intrinsics)) if case.intrinsics else ()
    if not list(config.parent.glob(f"nerfstudio_models/step-*{case.iterations - 1}.ckpt")):
        trained(scan, out, "now", ("--max-num-iterations", case.iterations, *stated))
    return config


def disturb_intrinsics(path: Path, case: Case) -> None:
    """Wrong focal lengths and principal points of both devices, of the size that the training is then told."""
    document, rng = json.loads(path.read_text()), np.random.default_rng(case.seed)
    for device in (document, document["projector"]):
        focal, x, y = case.intrinsics * rng.standard_normal(3)
        device["cx"] += device["fl_x"] * x
        device["cy"] += device["fl_x"] * y
        for key in ("fl_x", "fl_y"):
            device[key] *= 1 + focal
    path.write_text(json.dumps(document, indent=1))


def measure(case: Case, folder: Path) -> Row:
    """Export the run and compare its vertices with the truth."""
    config, here = train(case, folder), folder / case.name
    mesh, refined = here / "mesh.ply", here / "refined"
    export(config, mesh, refined, "--resolution", 256, "--overwrite")
    inputs = read_inputs(mesh, here / "scan", refined / "transforms.json", None, _SAMPLES, 0)
    quality, reference = read_quality(mesh), inputs.reference
    assert quality is not None and isinstance(reference, MeshReference)
    surface = IndexedMesh(inputs.mesh)
    score = score_alignments(surface, reference, inputs.poses, inputs.true_poses, samples=_SAMPLES)["rigid"]
    error = np.abs(reference.surface_errors(surface, score.S_truth_result, inputs.mesh.vertices))
    seen = quality.views > 0
    ratio, alone = error[seen] / quality.sigma[seen], error[seen] / quality.sigma_independent[seen]
    certain = error[seen] / _with_exact_intrinsics(inputs, quality)[seen]
    lengths = _length_errors(inputs, quality, reference, score.S_truth_result)
    return Row(
        **asdict(case), vertices=int(seen.sum()), unobserved=float((~seen).mean()), error_rms=_rms(error[seen]),
        error_rms_unobserved=_rms(error[~seen]), sigma_median=float(np.median(quality.sigma[seen])),
        sigma_independent_median=float(np.median(quality.sigma_independent[seen])), within_1=float((ratio < 1).mean()),
        within_2=float((ratio < 2).mean()), within_1_independent=float((alone < 1).mean()),
        within_1_exact_intrinsics=float((certain < 1).mean()), lengths_within_1=float((lengths < 1).mean()),
        lengths_within_2=float((lengths < 2).mean()),
        rank_correlation=float(np.corrcoef(rankdata(error[seen]), rankdata(quality.sigma[seen]))[0, 1]),
    )  # fmt: skip


def _with_exact_intrinsics(inputs: EvaluationInputs, quality: VertexQuality) -> np.ndarray:
    """Sigma of each vertex under the covariance of the poses given the intrinsics."""
    assert inputs.joint is not None
    given, common = inputs.joint.factor.copy(), inputs.joint.factor[-UNKNOWNS:]
    given -= (given @ common.T) @ np.linalg.solve(common @ common.T, common)
    given[-UNKNOWNS:] = 0
    found = vertex_uncertainty(inputs.mesh, inputs.scan, inputs.poses, JointCovariance(given), 1.0)
    shared = found.sigma**2 - found.sigma_independent**2
    return np.sqrt(quality.sigma_independent**2 + shared)


def _length_errors(
    inputs: EvaluationInputs, quality: VertexQuality, reference: MeshReference, S_truth_result: Similarity
) -> np.ndarray:
    """Errors of distances in units of their sigma, between vertices that face away from each other.

    The nearest point of the truth then shows how far each end is off along the distance.
    """
    mesh, rng = inputs.mesh, np.random.default_rng(0)
    seen, normals = np.flatnonzero(quality.views > 0), mesh.vertex_normals()
    ends = rng.choice(seen, (40_000, 2))
    along = mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]]
    length = np.linalg.norm(along, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        away = np.einsum("nej,nj->ne", normals[ends], along / length[:, None]) * [-1, 1]
    ends = ends[(away > _AWAY).all(1) & (length > 0.1 * reference.size)][:_LENGTHS]
    assert inputs.joint is not None
    sigma = length_sigma(mesh, quality.sigma_independent, ends, inputs.scan, inputs.poses, inputs.joint)
    true = reference.surface.closest(S_truth_result.points(mesh.vertices[ends.ravel()])).point.reshape(-1, 2, 3)
    found = np.linalg.norm(mesh.vertices[ends[:, 1]] - mesh.vertices[ends[:, 0]], axis=1)
    error = np.abs(found - np.linalg.norm(true[:, 1] - true[:, 0], axis=1))
    return error / np.hypot(sigma.shared, sigma.independent)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean())) if len(values) else 0.0


def main() -> None:
    """Run the benchmark; `--intrinsics` is the error of the intrinsics as a share of the focal length."""
    given = options(
        __doc__, scenes=list(SCENES), seeds=[1, 2], noise=[0.2, 0.5], frames=14, resolution=240, iterations=400,
        intrinsics=0.0, folder=Path("outputs/vertex_coverage"), again=False,
        output=Path("benchmarks/results/vertex_coverage.json"),
    )  # fmt: skip
    size = (given.frames, given.resolution, given.iterations, given.intrinsics)
    rows = Rows(given.output, [] if given.again else kept_rows(given.output, Row))
    for case in (Case(a, b, c, *size) for b in given.seeds for c in given.noise for a in given.scenes):
        if not rows.have(**asdict(case)):
            rows.add(measure(case, given.folder))
    ones = np.array([row.within_1 for row in rows])
    inside = ((ones >= 0.6) & (ones <= 0.8)).sum()
    print(f"within 1 sigma: mean {ones.mean():.0%}, {inside} of {len(ones)} scans in 60 to 80 %")


if __name__ == "__main__":
    main()

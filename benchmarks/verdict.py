"""Do the limits of sl-eval's verdict tell surfaces that are right from those that are not?

    python -m benchmarks.verdict [--scenes ...] [--faults ...] [--output FILE]

Small scans of sl-synth, as they are and with one fault each, are trained and exported as a user would do it, and judged
from the captures alone. The truth then says how far each surface is off after rigid alignment. A limit is right if it
lies between the figures of surfaces that are right and those that are not. Rows that are in the result file are not
measured again.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.common.measuring import Rows, kept_rows, options
from benchmarks.common.runs import export, run, train
from sl_nerfstudio.evaluation.evaluate import evaluate, read_inputs, typical_sigma
from sl_nerfstudio.evaluation.judgement import judge, trained_steps

SCENES = ("cone-and-cylinder", "frog", "staircase")
FRAMES, RESOLUTION, STEPS = 10, 200, 300
_SAMPLES = 20_000


@dataclass(frozen=True)
class Fault:
    """What is done to a scan."""

    synth: tuple[str, ...] = ()
    train: tuple[str, ...] = ()
    steps: int = STEPS
    change: Callable[[dict], None] | None = None  # of transforms.json


@dataclass(frozen=True)
class Row:
    """One surface."""

    scene: str
    fault: str
    rmse_percent: float  # of the size, after rigid alignment
    similarity_percent: float  # after alignment with scale
    verdict: str
    reasons: list[str]
    figures: dict[str, float]


def longer_focal(document: dict) -> None:
    """The projector's focal length is stated 2 % too long."""
    for key in ("fl_x", "fl_y"):
        document["projector"][key] *= 1.02


def turned_frame(document: dict) -> None:
    """One starting pose is wrong by 60 degrees about the world's z axis, and does not say so."""
    c, s = np.cos(np.radians(60)), np.sin(np.radians(60))
    turn = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    for key in [key for key in document["frames"][3] if key.endswith("transform_matrix")]:
        document["frames"][3][key] = (turn @ np.array(document["frames"][3][key])).tolist()


KNOWN = ("--pipeline.model.prior.intrinsics", "0.001")
FAULTS = {
    "none": Fault(train=KNOWN), "intrinsics not stated": Fault(),
    "starting poses kept": Fault(train=(*KNOWN, "--pipeline.model.refine-poses", "off")),
    "20 steps": Fault(train=KNOWN, steps=20), "90 % missing": Fault(synth=("--missing", "0.9"), train=KNOWN),
    "2 px noise": Fault(synth=("--noise", "2"), train=KNOWN), "4 frames": Fault(synth=("--frames", "4"), train=KNOWN),
    "focal 2 % off": Fault(change=longer_focal), "frame turned": Fault(train=KNOWN, change=turned_frame),
}  # fmt: skip


def measure(scene: str, name: str, folder: Path) -> Row:
    """Make, train, export and judge one scan."""
    fault, here = FAULTS[name], folder / f"{scene}-{name.replace(' ', '-').replace('%', 'percent')}"
    scan, mesh, refined = here / "scan", here / "mesh.ply", here / "refined"
    config = here / "runs/run/sl-neus/now/config.yml"
    if not scan.exists():
        usual = ("--frames", str(FRAMES)) if "--frames" not in fault.synth else ()
        run("sl-synth", "--output", scan, "--scene", scene, "--seed", 31, "--resolution", RESOLUTION, *usual,
            *fault.synth)  # fmt: skip
        if fault.change:
            path = scan / "transforms.json"
            document = json.loads(path.read_text())
            fault.change(document)
            path.write_text(json.dumps(document, indent=1))
    if not list(config.parent.glob("nerfstudio_models/*.ckpt")):
        train(scan, here / "runs", "now", ("--max-num-iterations", fault.steps, *fault.train))
    export(config, mesh, refined, "--resolution", 192, "--overwrite")
    return judged_row(scene, name, mesh, scan, refined)


def judged_row(scene: str, name: str, mesh: Path, scan: Path, refined: Path) -> Row:
    """Judged from the captures alone, and compared with the truth."""
    inputs = read_inputs(mesh, scan, refined / "transforms.json", None, _SAMPLES, 0)
    found = evaluate(inputs.mesh, inputs.scan, inputs.poses, inputs.reference, inputs.true_poses, (), _SAMPLES, 0)
    sigma = typical_sigma(inputs.mesh, inputs.quality, inputs.scan, inputs.poses, inputs.joint)
    blind = replace(found, reference=None, surface={}, pose_errors=None)
    judgement = judge(blind, "", trained_steps(inputs.training), None, inputs.unplaced, sigma)
    assert found.reference is not None
    rigid, similar = (
        100 * found.surface[kind].accuracy.rmse / found.reference.size for kind in ("rigid", "similarity")
    )
    figures = {figure.name: figure.value for figure in judgement.figures}
    return Row(scene, name, rigid, similar, judgement.verdict.band, list(judgement.verdict.reasons), figures)


def main() -> None:
    """Run the benchmark."""
    given = options(
        __doc__, scenes=list(SCENES), faults=FAULTS, folder=Path("outputs/verdict"),
        output=Path("benchmarks/results/verdict.json"),
    )  # fmt: skip
    rows = Rows(given.output, kept_rows(given.output, Row))
    for name in given.faults:
        for scene in given.scenes:
            if not rows.have(scene=scene, fault=name):
                rows.add(measure(scene, name, given.folder))


if __name__ == "__main__":
    main()

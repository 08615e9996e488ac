"""sl-eval from its flags to its files."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro

from sl_nerfstudio.cli.evaluate import EvalConfig, evaluate_scan, main
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh, write_mesh
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties
from sl_nerfstudio.scan import PoseSigma, read_scan, write_transforms
from sl_nerfstudio.storage import held_results
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise
from tests.evaluation.faceted_scan import FacetedScan
from tests.evaluation.test_inspection import PLACE, quality, wrong_bracket

from .snapshots import expect, expect_refusals, masked


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A clean synthetic scan with truth."""
    root = tmp_path_factory.mktemp("eval") / "scan"
    synthesise(SynthConfig(frames=3, resolution=80, supersampling=1, clean=True), root)
    return root


@pytest.fixture
def untrue(scan: Path, tmp_path: Path) -> Path:
    """The same scan without its truth."""
    return Path(shutil.copytree(scan, tmp_path / "untrue", ignore=shutil.ignore_patterns("ground_truth")))


def mesh_of(scan: Path) -> Path:
    return scan / "ground_truth" / "mesh.ply"


def run(*flags: str | Path) -> None:
    evaluate_scan(tyro.cli(EvalConfig, args=[str(flag) for flag in flags]))


def failure(*flags: str | Path) -> str:
    with pytest.raises(UserError) as error:
        run(*flags)
    return str(error.value)


def edited(path: Path, copy: Path, change: Callable[[dict], None]) -> Path:
    document = json.loads(path.read_text())
    change(document)
    copy.write_text(json.dumps(document))
    return copy


def test_truth_and_true_poses_are_judged_perfect(scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out, page = tmp_path / "new" / "evaluation.json", tmp_path / "new" / "report.html"
    run("--mesh", mesh_of(scan), "--data", scan, "--json", out, "--report", page, "--samples", "5000",
        "--f-distances", "0.01", "2")  # fmt: skip
    content = json.loads(out.read_text())
    assert content["units"] == "mm"
    for alignment in ("rigid", "similarity", "none"):
        assert content[alignment]["accuracy"]["rmse"] < 1e-3
        assert content[alignment]["completeness"]["rmse"] < 1e-3
        assert content[alignment]["f_score"] == {"0.01": 1.0, "2": 1.0}
        assert content[alignment]["scale"] == pytest.approx(1.0, abs=1e-5)
    for device in ("camera", "projector"):
        assert content[device]["translation_rmse"] < 1e-6
        assert content[device]["rotation_rmse_deg"] < 1e-6
    assert content["fit"]["coordinate_px_median"] < 1e-2
    assert content["fit"]["epipolar_px_median"] < 1e-2
    assert content["fit"]["pattern_cosine"] > 0.9
    assert "initial" not in content
    assert page.stat().st_size < 10e6 and "Scan report: scan" in page.read_text()
    printed = capsys.readouterr().out
    expect("sl-eval", "run", masked(printed.replace(str(out.parent), "DIR")))
    assert all(len(line) <= 80 for line in printed.splitlines() if not line.startswith("written"))
    assert np.shape(content["coverage"]["next_capture"]["transform_matrix"]) == (4, 4)
    assert sorted(p.name for p in out.parent.iterdir()) == ["evaluation.json", "report.html"]
    marks = {out: b'"format": 1,\n  "verdict"', page: b"<title>Scan report: "}
    with held_results(marks):  # earlier results may be replaced
        assert "evaluation.json: is in use by" in failure("--mesh", mesh_of(scan), "--data", scan, "--json", out)


def test_the_poses_file_brings_its_intrinsics(scan: Path, untrue: Path, tmp_path: Path) -> None:
    """The scan states a projector 2 % too long; what was refined from it does not."""
    refined = shutil.copy(scan / "transforms.json", tmp_path / "refined.json")
    wrong = read_scan(scan).projector.fl_x * 1.02
    edited(scan / "transforms.json", untrue / "transforms.json", lambda d: d["projector"].update(fl_x=wrong))
    residuals = []
    for poses in ((), ("--poses", refined)):
        out = tmp_path / f"{len(poses)}.json"
        run("--mesh", mesh_of(scan), "--data", untrue, "--json", out, "--samples", "2000", *poses)
        residuals.append(json.loads(out.read_text())["fit"]["coordinate_px_median"])
    assert residuals[0] > 1 and residuals[1] < 1e-2


@pytest.mark.slow
def test_refined_poses_are_compared_with_the_initial_ones(scan: Path, tmp_path: Path) -> None:
    known = read_scan(scan)
    refined = DevicePoses(known.poses.T_world_camera, known.poses.T_world_projector)
    refined.T_world_camera[1, :3, 3] += [3.0, 0.0, 0.0]
    (tmp_path / "refined").mkdir()
    sigma = {"sl_pose_sigma": vars(PoseSigma(0.5, 0.1, 0.2, 0.05))}
    write_transforms(tmp_path / "refined" / "transforms.json", known, refined, [sigma] * 3)
    curves = {"curves": {"step": [0, 1], "loss": [2.0, 1.0]}, "settings": {"seed": 42}, "versions": {"torch": "9.9"}}
    (tmp_path / "refined" / "training.json").write_text(json.dumps(curves))
    out, page = tmp_path / "evaluation.json", tmp_path / "report.html"
    run("--mesh", mesh_of(scan), "--data", scan, "--poses", tmp_path / "refined", "--json", out, "--report", page,
        "--samples", "2000")  # fmt: skip
    content = json.loads(out.read_text())
    assert 1.0 < content["camera"]["translation_rmse"] < 2.0
    assert content["initial"]["camera"]["translation_rmse"] < 1e-6
    text = page.read_text()
    assert "refined/transforms.json" in text and "9.9" in text and "σ frame" in text


@pytest.mark.slow
def test_what_is_not_printed_is_in_the_report_that_was_written_or_could_be(scan, tmp_path, capsys):
    known = read_scan(scan)
    wrong = DevicePoses(known.poses.T_world_camera.copy(), known.poses.T_world_projector)
    wrong.T_world_camera[:, :3, 3] += [6.0, 0.0, 0.0]
    write_transforms(tmp_path / "transforms.json", known, wrong)
    page = tmp_path / "r.html"
    for flags, place in (((), "in the report: --report FILE.html"), (("--report", page), f"in {page}")):
        run("--mesh", mesh_of(scan), "--data", scan, "--poses", tmp_path, "--samples", "2000", *flags)
        printed = " ".join(capsys.readouterr().out.split())
        left = re.findall(r"\((\d+) more (.*?)\)", printed)
        assert printed.startswith("verdict: poor") and left and {where for _, where in left} == {place}


def test_reference_points_take_the_place_of_a_mesh(scan: Path, untrue: Path, tmp_path: Path) -> None:
    truth = read_mesh(mesh_of(scan))
    np.savez(tmp_path / "points.npz", xyz=truth.vertices[truth.faces].mean(1).astype(np.float32))
    run("--mesh", mesh_of(scan), "--data", untrue, "--reference", tmp_path / "points.npz",
        "--json", tmp_path / "out.json", "--samples", "2000")  # fmt: skip
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["none"]["completeness"]["rmse"] < 1e-3
    assert "reference points" in content["reference"]
    assert "camera" not in content


@pytest.mark.slow
def test_a_part_in_other_axes_is_inspected(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A bracket with a plateau of 0.2 mm, scanned in metres and turned, against its STL in millimetres."""
    part, mesh, S = wrong_bracket(1e-3)
    turned = part.mapped(S.inverse())
    scan = FacetedScan(units="m", with_truth=False, scale=0.04, mesh=Mesh(
        (turned.vertices - mesh.vertices.mean(0)) / 0.04, turned.faces)).write(tmp_path / "scan")  # fmt: skip
    mesh = Mesh(mesh.vertices - mesh.vertices.mean(0), mesh.faces)
    properties = VertexProperties(quality(mesh, 2e-5), np.zeros(len(mesh.vertices), bool))
    write_mesh(tmp_path / "mesh.ply", mesh, properties, "m")
    write_mesh(tmp_path / "part.stl", part, units="m")
    given = ("--mesh", tmp_path / "mesh.ply", "--data", scan, "--reference", tmp_path / "part.stl", "--samples", "5000")
    out, coloured, page = (tmp_path / name for name in ("out.json", "deviations.ply", "report.html"))
    run(*given, "--tolerance", "0.1 mm", "--json", out, "--deviations", coloured, "--report", page)
    content, printed = json.loads(out.read_text()), capsys.readouterr().out
    assert content["part"]["fits"] and not content["part"]["in_place"] and "none" not in content
    (patch,) = content["inspection"]["patches"]
    assert patch["mean"] == pytest.approx(2e-4, abs=2e-5)
    np.testing.assert_allclose(patch["place"], PLACE / 1000, atol=0.0065)
    assert "placed on part.stl by its shape" in printed and "±0.1 mm" in printed and "+0.2" in printed
    assert b"colours: blue -0.0002 or less" in coloured.read_bytes()[:1000] and "out of tolerance" in page.read_text()
    np.testing.assert_allclose(read_mesh(coloured).bounds(), [[0, 0, 0], [0.06, 0.04, 0.03]], atol=2e-4)
    assert "measures 78.1 m from corner to corner" in failure(*given, "--reference-unit", "m")
    assert "--tolerance 0.1: 0.1 has no unit" in failure(*given, "--tolerance", "0.1")
    assert "there is no nominal surface" in failure(*given[:4], "--tolerance", "0.1 mm")


def test_what_cannot_be_evaluated_is_named_and_nothing_is_written(scan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(scan, "scan")
    truth, stated = read_mesh(mesh_of(scan)), scan / "transforms.json"
    write_mesh(Path("far.ply"), Mesh(truth.vertices + 1e5, truth.faces))
    axes = [f"property float {axis}" for axis in "xyz"]
    points = ["ply", "format ascii 1.0", "element vertex 2", *axes, "end_header", "0 0 0", "1 1 1", ""]
    files = {
        "empty.ply": "", "broken.ply": "ply\nformat ascii 1.0\nelement vertex 3\n", "mesh.xyz": "1 2 3",
        "points.ply": "\n".join(points), "cut.json": '{"frames": [', "text.npz": "not a zip file",
        "mine": '{"frames": []}',
    }  # fmt: skip
    for name, text in files.items():
        Path(name).write_text(text)
    Path("folder").mkdir()
    Path("broken").symlink_to("nowhere")
    changes: dict[str, Callable[[dict], object]] = {
        "renamed": lambda d: d["frames"][1].update(file_path="images/other.png"),
        "shorter": lambda d: d["frames"].pop(),
        "metres": lambda d: d.update(units="m"),
        "unlit": lambda d: [frame.pop("projector_transform_matrix") for frame in d["frames"]],
        "nan": lambda d: d["frames"][2]["transform_matrix"][0].__setitem__(3, float("nan")),
    }
    for name, change in changes.items():
        edited(stated, Path(f"{name}.json"), change)
    arrays: dict[str, dict[str, np.ndarray]] = {
        "named": {"points": np.zeros((200, 3))}, "flat": {"xyz": np.zeros((200, 2))}, "few": {"xyz": np.zeros((5, 3))},
        "nan": {"xyz": np.full((200, 3), np.nan)}, "objects": {"xyz": np.array([{}] * 200, dtype=object)},
    }  # fmt: skip
    for name, values in arrays.items():
        np.savez(f"{name}.npz", **values)
    np.save("points.npy", np.zeros((200, 3)))
    before = sorted(tmp_path.rglob("*"))
    expect_refusals(
        main, "sl-eval", ["--mesh", "scan/ground_truth/mesh.ply", "--data", "scan"],
        *(["--mesh", name] for name in ("missing.ply", "empty.ply", "broken.ply", "mesh.xyz", "points.ply", "far.ply")),
        *(["--poses", f"{name}.json"] for name in ("missing", "cut", *changes)),
        *(["--reference", f"{name}.npz"] for name in ("text", *arrays)),
        *(["--f-distances", *values] for values in (("0.1", "-1"), ("nan",))),
        ["--samples", 10], ["--seed", -1], ["--reference", "points.npy"],
        ["--json", "mine"], ["--report", "mine"], ["--json", "folder"], ["--json", "broken"], ["--json", "/dev/null"],
        ["--json", "n" * 256], ["--json", "a", "--report", "./a"], ["--json", "/proc/x"], ["--json", "mine/out.json"],
    )  # fmt: skip
    assert sorted(tmp_path.rglob("*")) == before and Path("mine").read_text() == files["mine"]

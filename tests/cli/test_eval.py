"""sl-eval from its flags to its files."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tyro

from sl_nerfstudio.cli.evaluate import EvalConfig, evaluate_scan, main
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.meshing.files import read_mesh, write_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.scan import read_scan, write_transforms
from sl_nerfstudio.storage import held_results
from sl_nerfstudio.synthesis.config import SynthConfig
from sl_nerfstudio.synthesis.synthesise import synthesise


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
    names = [line[:12].split(":")[0].strip() for line in printed.splitlines() if not line.startswith(" ")]
    assert names == ["verdict", "surface", "captures", "coverage", "next", "written", "written"]
    assert printed.startswith("verdict: good\n") and "rigid" in printed and str(out) in printed.replace("\n", "")
    assert all(len(line) <= 80 for line in printed.splitlines() if not line.startswith("written"))
    assert np.shape(content["coverage"]["next_capture"]["transform_matrix"]) == (4, 4)
    assert sorted(p.name for p in out.parent.iterdir()) == ["evaluation.json", "report.html"]
    with held_results(
        {out: b'"format": 1,\n  "verdict"', page: b"<title>Scan report: "}
    ):  # earlier results may be replaced
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


def test_refined_poses_are_compared_with_the_initial_ones(scan: Path, tmp_path: Path) -> None:
    known = read_scan(scan)
    refined = DevicePoses(known.poses.T_world_camera, known.poses.T_world_projector)
    refined.T_world_camera[1, :3, 3] += [3.0, 0.0, 0.0]
    (tmp_path / "refined").mkdir()
    sigma = {
        "camera_translation": 0.5,
        "camera_rotation_deg": 0.1,
        "relative_translation": 0.2,
        "relative_rotation_deg": 0.05,
    }
    write_transforms(
        tmp_path / "refined" / "transforms.json",
        known,
        refined,
        [{"sl_pose_sigma": sigma}] * 3,
    )
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


def test_what_is_not_printed_is_in_the_report_that_was_written_or_could_be(
    scan: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
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


def test_without_truth_the_fit_is_there_and_nothing_else(scan: Path, untrue: Path, tmp_path: Path) -> None:
    run("--mesh", mesh_of(scan), "--data", untrue, "--json", tmp_path / "out.json")
    content = json.loads((tmp_path / "out.json").read_text())
    assert set(content) == {"format", "verdict", "reasons", "units", "fit", "coverage", "cross_frame"}
    assert content["fit"]["coordinate_px_median"] < 1e-2


def test_reference_points_take_the_place_of_a_mesh(scan: Path, untrue: Path, tmp_path: Path) -> None:
    truth = read_mesh(mesh_of(scan))
    np.savez(tmp_path / "points.npz", xyz=truth.vertices[truth.faces].mean(1).astype(np.float32))
    run("--mesh", mesh_of(scan), "--data", untrue, "--reference", tmp_path / "points.npz",
        "--json", tmp_path / "out.json", "--samples", "2000")  # fmt: skip
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["none"]["completeness"]["rmse"] < 1e-3
    assert "reference points" in content["reference"]
    assert "camera" not in content


def test_reference_mesh_takes_the_place_of_the_truth(scan: Path, tmp_path: Path) -> None:
    truth = read_mesh(mesh_of(scan))
    write_mesh(tmp_path / "moved.ply", Mesh(truth.vertices + [0.0, 0.0, 0.7], truth.faces))
    run("--mesh", mesh_of(scan), "--data", scan, "--reference", tmp_path / "moved.ply", "--json", tmp_path / "out.json",
        "--samples", "2000")  # fmt: skip
    content = json.loads((tmp_path / "out.json").read_text())
    assert content["rigid"]["accuracy"]["rmse"] < 1e-3
    assert content["rigid"]["matrix"][2][3] == pytest.approx(0.7, abs=1e-3)
    assert 0.3 < content["none"]["accuracy"]["p95"] <= 0.7 + 1e-6


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("missing.ply", None, "missing.ply: is missing"),
        ("empty.ply", b"", "empty.ply: is empty"),
        ("broken.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "broken.ply: cannot be read as PLY"),
        ("mesh.xyz", b"1 2 3", "unknown kind of mesh file '.xyz'"),
    ],
)
def test_meshes_that_cannot_be_read(scan: Path, tmp_path: Path, name: str, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert message in failure("--mesh", tmp_path / name, "--data", scan)


def test_points_instead_of_a_mesh(scan: Path, tmp_path: Path) -> None:
    axes = [f"property float {axis}" for axis in "xyz"]
    lines = ["ply", "format ascii 1.0", "element vertex 2", *axes, "end_header", "0 0 0", "1 1 1", ""]
    (tmp_path / "points.ply").write_text("\n".join(lines))
    assert "has no triangles" in failure("--mesh", tmp_path / "points.ply", "--data", scan)


def test_mesh_of_another_place(scan: Path, tmp_path: Path) -> None:
    truth = read_mesh(mesh_of(scan))
    write_mesh(tmp_path / "far.ply", Mesh(truth.vertices + 1e5, truth.faces))
    message = failure("--mesh", tmp_path / "far.ply", "--data", scan, "--json", tmp_path / "out.json")
    assert "no camera ray through a masked pixel hits the mesh" in message and "mm" in message
    assert not (tmp_path / "out.json").exists()


def poses_failure(scan: Path, tmp_path: Path, change: Callable[[dict], None]) -> str:
    poses = edited(scan / "transforms.json", tmp_path / "poses.json", change)
    return failure("--mesh", mesh_of(scan), "--data", scan, "--poses", poses)


def test_poses_of_another_scan(scan: Path, tmp_path: Path) -> None:
    def rename(document: dict) -> None:
        document["frames"][1]["file_path"] = "images/other.png"

    def drop(document: dict) -> None:
        document["frames"].pop()

    def other_units(document: dict) -> None:
        document["units"] = "m"

    def no_projector(document: dict) -> None:
        for frame in document["frames"]:
            del frame["projector_transform_matrix"]

    def not_finite(document: dict) -> None:
        document["frames"][2]["transform_matrix"][0][3] = float("nan")

    assert "frame_00001" in poses_failure(scan, tmp_path, rename)
    assert "holds 2 frames, the scan 3" in poses_failure(scan, tmp_path, drop)
    assert "units: 'm', but the scan's are 'mm'" in poses_failure(scan, tmp_path, other_units)
    assert "has no projector_transform_matrix" in poses_failure(scan, tmp_path, no_projector)
    assert "frame_00002" in poses_failure(scan, tmp_path, not_finite)


def test_poses_file_that_is_missing_or_no_json(scan: Path, tmp_path: Path) -> None:
    assert "is missing" in failure("--mesh", mesh_of(scan), "--data", scan, "--poses", tmp_path / "none.json")
    (tmp_path / "cut.json").write_text('{"frames": [')
    assert "is truncated" in failure("--mesh", mesh_of(scan), "--data", scan, "--poses", tmp_path / "cut.json")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"points": np.zeros((200, 3))}, "has no key xyz (it has points)"),
        ({"xyz": np.zeros((200, 2))}, "not a list of points"),
        ({"xyz": np.zeros((5, 3))}, "at least 100 points"),
        ({"xyz": np.full((200, 3), np.nan)}, "200 points are not numbers"),
        ({"xyz": np.array([{}] * 200, dtype=object)}, "cannot be read"),
    ],
)
def test_reference_points_that_are_none(scan: Path, tmp_path: Path, arrays: dict, message: str) -> None:
    np.savez(tmp_path / "points.npz", **arrays)
    assert message in failure("--mesh", mesh_of(scan), "--data", scan, "--reference", tmp_path / "points.npz")


def test_reference_that_is_no_archive(scan: Path, tmp_path: Path) -> None:
    (tmp_path / "points.npz").write_bytes(b"not a zip file")
    assert "cannot be read" in failure("--mesh", mesh_of(scan), "--data", scan, "--reference", tmp_path / "points.npz")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--f-distances", "0.1", "-1"), "--f-distances: -1 is not a distance"),
        (("--f-distances", "nan"), "--f-distances: nan is not a distance"),
        (("--samples", "10"), "--samples: 10 points are too few"),
        (("--seed", "-1"), "--seed: -1 is negative"),
        (("--reference", "points.npy"), ".npz file with the key xyz"),
    ],
)
def test_flags_that_make_no_sense(scan: Path, flags: tuple[str, ...], message: str) -> None:
    assert message in failure("--mesh", mesh_of(scan), "--data", scan, *flags)


def test_place_where_nothing_can_be_written(scan: Path, untrue: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    message = failure("--mesh", mesh_of(scan), "--data", untrue, "--json", tmp_path / "file" / "out.json")
    assert "cannot be written" in message


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--json", "mine"), "mine: would be overwritten, and is no earlier result of this command"),
        (("--report", "mine"), "mine: would be overwritten, and is no earlier result of this command"),
        (("--json", "folder"), "folder: is not a file"),
        (("--json", "broken"), "broken: is not a file"),
        (("--json", "/dev/null"), "/dev/null: is not a file"),
        (("--json", "n" * 256), "cannot be"),
        (("--json", "a", "--report", "./a"), "--json and --report: both are a"),
        (("--json", "/proc/x"), "/proc/x: cannot be written"),
    ],
)
def test_files_that_are_no_earlier_results_stay(
    scan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flags: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine").write_text('{"frames": []}')
    Path("folder").mkdir()
    Path("broken").symlink_to("nowhere")
    assert message in failure("--mesh", mesh_of(scan), "--data", scan, *flags)
    assert {p.name for p in tmp_path.iterdir()} == {"mine", "folder", "broken"}
    assert Path("mine").read_text() == '{"frames": []}'


def test_command_ends_with_status_1_and_one_message(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr(sys, "argv", ["sl-eval", "--mesh", "none.ply", "--data", "none"])
    with pytest.raises(SystemExit) as status:
        main()
    assert status.value.code == 1
    captured = capsys.readouterr()
    assert captured.err.startswith("error: ") and "Traceback" not in captured.err
    assert captured.out == ""


def test_help_is_quick_because_it_imports_little() -> None:
    code = (
        "import sys, sl_nerfstudio.cli.evaluate; "
        "print([m for m in ('torch', 'open3d', 'scipy', 'matplotlib', 'nerfstudio') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

"""The open benchmark on two tiny scans: made, filled with results, scored; formats, and what is refused."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.open import __main__ as command
from benchmarks.open import scans as module
from benchmarks.open import scoring
from benchmarks.open.scans import SCANS, OpenScan, checksum
from benchmarks.open.scoring import read_handed_poses
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.files import read_mesh, write_mesh

TINY = {"frames": 3, "resolution": 72, "supersampling": 1}
NAMES = ("rough-cone", "photographs-head")
SMALL = tuple(replace(scan, config=replace(scan.config, **TINY)) for scan in SCANS if scan.name in NAMES)


def used(monkeypatch, scans: tuple[OpenScan, ...]) -> None:
    for place in (module, command):
        monkeypatch.setattr(place, "SCANS", scans)
    monkeypatch.setattr(scoring, "_SAMPLES", 2000)


def call(monkeypatch, *words: object) -> None:
    monkeypatch.setattr(sys, "argv", ["open", *map(str, words)])
    command.main()


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("open") / "data"
    with pytest.MonkeyPatch.context() as patch:
        used(patch, SMALL)
        call(patch, "make", "--output", root)
    return root


@pytest.fixture
def small(monkeypatch):
    used(monkeypatch, SMALL)


@pytest.fixture
def truth_handed_in(data, tmp_path):
    """The truth as a result: of the photographs in other axes and another unit."""
    turn, scale = Rotation.from_rotvec([0.3, -1.0, 0.7]).as_matrix(), 0.02
    for name in NAMES:
        truth, folder = data / name / "ground_truth", tmp_path / "results" / name
        folder.mkdir(parents=True)
        mesh, document = read_mesh(truth / "mesh.ply"), json.loads((truth / "transforms.json").read_text())
        if name == "photographs-head":
            mesh = replace(mesh, vertices=scale * mesh.vertices @ turn.T)
            for frame in document["frames"]:
                for key in ("transform_matrix", "projector_transform_matrix"):
                    T = np.array(frame[key])
                    T[:3, :3], T[:3, 3] = turn @ T[:3, :3], scale * turn @ T[:3, 3]
                    frame[key] = T.tolist()
        write_mesh(folder / "mesh.ply", mesh)
        (folder / "transforms.json").write_text(json.dumps(document))
    return tmp_path / "results"


@pytest.mark.usefixtures("small")
def test_the_truth_scores_perfectly(monkeypatch, capsys, data, truth_handed_in, tmp_path):
    found = tmp_path / "scores.json"
    call(monkeypatch, "score", "--data", data, "--results", truth_handed_in, "--json", found)
    document = json.loads(found.read_text())
    assert document["version"] == module.VERSION
    for row in document["rows"]:
        assert row["results"] == "results" and row["frames"] == row["all_frames"]
        assert row["accuracy_rmse"] < 1e-3 and row["completeness_mean"] < 1e-3 and row["f_score"] > 0.999
        assert row["camera_mm"] < 1e-3 and row["camera_deg"] < 1e-3 and row["projector_deg"] < 1e-3
        assert row["scale"] == pytest.approx(50 if row["scan"] == "photographs-head" else 1, rel=1e-4)
    said = capsys.readouterr().out
    assert "| rough-cone | 0.000 / 0.000; 0.00 mm, 0.000 deg |" in said
    made = json.loads((data / "benchmark.json").read_text())["scans"]
    assert made == {scan.name: checksum(data / scan.name) for scan in SMALL}


def test_poses_in_the_format_of_tum_are_the_same_poses(truth_handed_in, tmp_path):
    """Device axes of OpenCV: x to the right, y down, z forward."""
    expected = read_handed_poses(truth_handed_in / "rough-cone")
    assert expected is not None
    for name, poses in (("cameras.txt", expected.camera), ("projectors.txt", expected.projector)):
        lines = ["# frame tx ty tz qx qy qz qw"]
        for frame, T in poses.items():
            R = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])
            lines.append(
                " ".join([frame, *map(repr, [*T[:3, 3].tolist(), *Rotation.from_matrix(R).as_quat().tolist()])])
            )
        (tmp_path / name).write_text("\n".join(lines) + "\n")
    found = read_handed_poses(tmp_path)
    assert found is not None
    for mine, theirs in ((found.camera, expected.camera), (found.projector, expected.projector)):
        assert list(mine) == list(theirs)
        for frame in mine:
            np.testing.assert_allclose(mine[frame], theirs[frame], atol=1e-9)


@pytest.mark.parametrize("line", ["frame_00000 1 2 3 0 0 0", "frame_00000 1 2 3 0 0 0 x", "frame_00000 1 2 3 0 0 0 0"])
def test_a_line_that_is_no_pose_is_named(tmp_path, line):
    (tmp_path / "cameras.txt").write_text(f"# comment\n{line}\n")
    with pytest.raises(UserError, match=r"cameras\.txt: line 2: is not NAME TX TY TZ QX QY QZ QW"):
        read_handed_poses(tmp_path)


@pytest.mark.usefixtures("small")
def test_results_of_other_frames_missing_results_and_missing_scans_are_errors(
    monkeypatch, capsys, data, truth_handed_in, tmp_path
):
    path = truth_handed_in / "rough-cone/transforms.json"
    path.write_text(path.read_text().replace("frame_", "image_"))
    with pytest.raises(SystemExit):
        call(monkeypatch, "score", "--data", data, "--results", truth_handed_in, "--scans", "rough-cone")
    assert "poses of 0 of the frames frame_00000 to frame_00002" in capsys.readouterr().err
    for words, message in (
        (("--data", data, "--results", tmp_path), "no result has a mesh.ply"),
        (("--data", tmp_path / "nowhere", "--results", truth_handed_in), "benchmarks.open make"),
        (("--data", data, "--results", tmp_path, "--scans", "cone"), "--scans cone: no scan is named so"),
    ):
        with pytest.raises(SystemExit):
            call(monkeypatch, "score", *words)
        assert message in capsys.readouterr().err


@pytest.mark.usefixtures("small")
def test_fusion_hands_in_a_mesh_and_poses_and_is_not_run_again(monkeypatch, capsys, data, tmp_path):
    words = ("run", "--data", data, "--method", "fusion-start", "--results", tmp_path / "f", "--scans", "rough-cone")
    call(monkeypatch, *words)
    call(monkeypatch, *words)
    assert capsys.readouterr().out.count("fusion-start on rough-cone") == 1
    assert sorted(path.name for path in (tmp_path / "f/rough-cone").iterdir()) == [
        "mesh.ply", "method.json", "transforms.json",
    ]  # fmt: skip
    poses = read_handed_poses(tmp_path / "f/rough-cone")
    assert poses is not None and len(poses.camera) == len(poses.projector) == 3
    (tmp_path / "f/rough-cone/method.json").unlink()
    with pytest.raises(SystemExit):
        call(monkeypatch, *words)
    assert "an interrupted run left it" in capsys.readouterr().err

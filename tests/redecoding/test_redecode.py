"""sl-redecode with a run whose field is a ball by formula: the folder that it writes, and what it says."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.cli.redecode import RedecodeArguments, check, main, redecode_trained
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.redecoding.redecode import redecode_run
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan import PoseSigma, Scale, Scan, ScanWriter, check_scan, read_scan
from tests.redecoding.lit_ball import CAMERA, PROJECTOR, RADIUS, T_CAMERA, T_PROJECTOR, grid, picture, truth, with_holes
from tests.runs.ball_run import BallModel, run_of

MASK = np.isfinite(truth()).all(-1)
HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])  # about z: a frame from the other side sees the same of the ball


class Ball(BallModel):
    """The ball of lit_ball.py, at the origin."""

    def sdf(self, p_scene):
        centre = torch.from_numpy(self.S_scene_world.points(np.zeros(3))).float()
        return (p_scene - centre).norm(dim=-1) - RADIUS * self.S_scene_world.scale


def eight_bit(image: np.ndarray) -> np.ndarray:
    return np.rint(255 * image).astype(np.uint8)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    """Two frames, 60 % of whose cells are missing; the second image shows nothing."""
    root = tmp_path_factory.mktemp("scans") / "ball"
    sigma = PoseSigma(1.0, 0.5, 0.5, 0.1)
    with ScanWriter(
        root, units="mm", scale=Scale(True, "test"), projector=PROJECTOR, pattern=eight_bit(grid()), camera=CAMERA,
        extra={"of_ours": [1, {"a": 2}]},
    ) as writer:  # fmt: skip
        for k, (turn, image) in enumerate([(np.eye(4), picture()), (HALF_TURN, np.full(MASK.shape, 0.5))]):
            writer.add_frame(
                f"frame_{k}", color=None if k else eight_bit(0.5 * MASK), image=eight_bit(image),
                coords=with_holes(truth(), 0.6, k), mask=MASK,
                T_world_camera=turn @ T_CAMERA, T_world_projector=turn @ T_PROJECTOR, pose_sigma=sigma,
                true_poses=(turn @ T_CAMERA, turn @ T_PROJECTOR),
            )  # fmt: skip
        writer.add_file("pattern.json", b"{}")
        writer.add_file("ground_truth/masks/a.png", b"anything")
    return read_scan(root)


@pytest.fixture(scope="module")
def run(scan: Scan) -> TrainedRun:
    trained = run_of(scan)
    return replace(trained, model=Ball(scan))


def files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_the_new_folder_is_the_old_scan_with_more_coordinates(run, scan, tmp_path):
    before, output = files(scan.root), tmp_path / "again"
    found = redecode_run(run, output, 90)
    after = files(output)
    assert files(scan.root) == before
    assert set(after) == set(before) | {"redecoding.json"}
    changed = {name for name in before if after[name] != before[name]}
    assert changed <= {"coords/frame_0.npz", "coords/frame_1.npz", "transforms.json"}
    assert json.loads(after["transforms.json"]) == json.loads(before["transforms.json"])
    old, new = (np.stack([f.read_coords() for f in s.frames]) for s in (scan, read_scan(output)))
    assert np.isfinite(new[0]).all(-1).sum() > 0.75 * MASK.sum() and np.nanmax(np.abs(new[0] - truth())) < 1
    np.testing.assert_array_equal(new[1], old[1])  # its image does not show the pattern
    assert [frame.limits is None for frame in found.frames] == [False, True]
    assert found.share_after == np.isfinite(new[..., 0]).sum() / (2 * MASK.sum()) > found.share_before
    record = json.loads(after["redecoding.json"])
    assert record["share_after"] == found.share_after and record["frames"][0]["added"] == found.frames[0].added
    assert {fault.kind for fault in check_scan(output)} == {fault.kind for fault in check_scan(scan.root)}


def test_what_is_said(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = redecode_trained(run, RedecodeArguments(Path("config.yml"), Path("again"), 90))
    assert "of the pixels that show the pattern are decoded, 4" in said and "replaced 0, removed 0 pixels" in said
    assert "left as they are: frame_1\n" in said and "0.0% would have been accepted" in said
    assert said.endswith("next:\n  ns-train sl-neus --data again")


def test_nothing_is_overwritten_and_nothing_is_left_behind(run, scan, tmp_path, monkeypatch):
    with pytest.raises(UserError, match=r"is not empty(.|\n)*choose another output"):
        check(RedecodeArguments(Path("c"), scan.root))
    with pytest.raises(UserError, match=r"--resolution 1: at least 2 cells"):
        check(RedecodeArguments(Path("c"), tmp_path / "new", 1))
    check(RedecodeArguments(Path("c"), tmp_path / "new"))
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr("sl_nerfstudio.redecoding.redecode.copy_others", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        redecode_run(run, tmp_path / "new", 60)
    assert not (tmp_path / "new").exists()


def test_a_run_that_is_not_there_ends_with_status_1(tmp_path, monkeypatch, capsys):
    arguments = ("--load-config", tmp_path / "config.yml", "--output", tmp_path / "again")
    monkeypatch.setattr(sys, "argv", ["sl-redecode", *map(str, arguments)])
    with pytest.raises(SystemExit) as end:
        main()
    assert end.value.code == 1 and capsys.readouterr().err.startswith("error: --load-config")
    assert list(tmp_path.iterdir()) == []

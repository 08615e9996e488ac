"""Decoded coordinates at scene points, and convergence curves."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sl_nerfstudio.geometry.devices import Intrinsics
from sl_nerfstudio.geometry.lie import inverse
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays
from sl_nerfstudio.model.outputs import History, MeasuredCoordinates
from sl_nerfstudio.scan import Frame, read_scan
from tests.dataparser.tiny_scan import TinyScan


def test_every_pixels_ray_leads_back_to_its_coordinates(tmp_path: Path) -> None:
    scan = read_scan(TinyScan(frames=2).write(tmp_path / "scan"))
    T_camera_world = inverse(torch.from_numpy(scan.poses.T_world_camera))
    points, views, expected = [], [], []
    for k, frame in enumerate(scan.frames):
        uv = pixel_centres(frame.camera, torch.float64)
        T = torch.from_numpy(scan.poses.T_world_camera[k]).expand(*uv.shape[:2], 4, 4)
        o, d = pixel_rays(Intrinsics.of(frame.camera, torch.float64), T, uv)
        points.append((o + 200 * d).reshape(-1, 3))
        views.append(torch.full((frame.camera.w * frame.camera.h,), k))
        expected.append(torch.from_numpy(frame.read_coords()).reshape(-1, 2))
    order = torch.randperm(sum(map(len, points)), generator=torch.Generator().manual_seed(0))
    p, view = torch.cat(points)[order].float(), torch.cat(views)[order]
    found = MeasuredCoordinates(scan).at(p, view, T_camera_world.float())
    torch.testing.assert_close(found, torch.cat(expected)[order], rtol=0, atol=0, equal_nan=True)
    assert found.isfinite().any() and found.isnan().any()
    axes, centre = scan.poses.T_world_camera[0, :3, :3], scan.poses.T_world_camera[0, :3, 3]
    behind, beside = centre + 100 * axes[:, 2], centre - 100 * axes[:, 2] + 200 * axes[:, 0]
    p = torch.tensor(np.stack([behind, beside, np.zeros(3)]), dtype=torch.float32)
    found = MeasuredCoordinates(scan).at(p, torch.zeros(3, dtype=torch.long), T_camera_world.float())
    assert found[:2].isnan().all() and found[2].isfinite().all()


def test_a_frame_is_read_once_while_it_is_among_the_last_two(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = read_scan(TinyScan(frames=3).write(tmp_path / "scan"))
    read: list[str] = []
    original = Frame.read_coords
    monkeypatch.setattr(Frame, "read_coords", lambda frame: (read.append(frame.name), original(frame))[1])
    coordinates = MeasuredCoordinates(scan)
    T_camera_world = inverse(torch.from_numpy(scan.poses.T_world_camera)).float()
    for view in (0, 1, 0, 1, 2, 1, 0):
        coordinates.at(torch.zeros(1, 3), torch.tensor([view]), T_camera_world)
    assert read == [scan.frames[k].name for k in (0, 1, 2, 0)]


def row(loss: float, rmse: float) -> dict[str, torch.Tensor]:
    return {"loss": torch.tensor(loss, dtype=torch.float64), "rmse": torch.tensor(rmse)}


def filled(count: int) -> History:
    history = History(["loss", "rmse"])
    for step in range(count):
        history.add(step, row(1.0 / (1 + step), step))
    return history


@pytest.mark.parametrize("rows", [0, 1, 511, 512, 513, 2_000])
def test_the_table_stays_within_bounds_evenly_spaced_and_in_order(rows):
    history = History(["loss", "rmse"])
    for step in range(5 * rows):
        if step % history.every == 0:
            loss = torch.tensor(1.0 / (1 + step), dtype=torch.float64)
            history.add(step, {"loss": loss, "other": torch.tensor(1.0)})
    curves = history.curves()
    assert list(curves) == ["step", "loss", "rmse"]
    steps = curves["step"]
    assert min(rows, 256) <= len(steps) < 512
    assert steps == [float(k) for k in range(0, 5 * rows, history.every)]
    assert history.every == (20 if rows == 2_000 else 10 if rows > 511 else 5)
    assert curves["loss"] == [1.0 / (1 + s) for s in steps] and np.isnan(curves["rmse"]).all()  # which was not given


def test_a_checkpoint_continues_without_a_difference():
    whole, first = filled(1000), filled(600)
    second = History(["loss", "rmse"])
    second.load_state_dict(first.state_dict())
    assert second.every == first.every and second.curves() == first.curves()
    for step in range(600, 1000):
        second.add(step, row(1.0 / (1 + step), step))
    assert second.curves() == whole.curves() and second.every == whole.every

"""Decoded coordinates at scene points, and convergence curves."""

import math
from itertools import pairwise
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


def test_nothing_is_measured_behind_a_camera_or_outside_its_image(tmp_path: Path) -> None:
    scan = read_scan(TinyScan(frames=2).write(tmp_path / "scan"))
    T = scan.poses.T_world_camera[0]
    axes, centre = T[:3, :3], T[:3, 3]
    behind, beside = centre + 100 * axes[:, 2], centre - 100 * axes[:, 2] + 200 * axes[:, 0]
    p = torch.tensor(np.stack([behind, beside, np.zeros(3)]), dtype=torch.float32)
    T_camera_world = inverse(torch.from_numpy(scan.poses.T_world_camera)).float()
    found = MeasuredCoordinates(scan).at(p, torch.zeros(3, dtype=torch.long), T_camera_world)
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


@pytest.mark.parametrize("count", [0, 1, 511, 512, 513, 10_000])
def test_the_table_stays_within_bounds_and_in_order(count):
    history = filled(count)
    curves = history.curves()
    assert list(curves) == ["step", "loss", "rmse"]
    steps = curves["step"]
    assert len(steps) < 512 and len(steps) >= min(count, 256)
    assert steps == sorted(set(steps))
    assert steps[:1] == [0.0][:count] and (count == 0 or steps[-1] >= count - 2)
    assert curves["rmse"] == steps and curves["loss"] == [1.0 / (1 + s) for s in steps]


def test_entries_get_sparser_as_a_run_gets_longer():
    history, added = History(["loss"]), 0
    for step in range(10_000):
        if step % history.every == 0:
            history.add(step, {"loss": torch.tensor(0.0)})
            added += 1
    steps = history.curves()["step"]
    assert added < 1200 and history.every == 20
    assert {b - a for a, b in pairwise(steps)} == {20.0}  # evenly spaced throughout
    assert steps[0] == 0 and steps[-1] >= 10_000 - 20


def test_a_checkpoint_continues_without_a_difference():
    whole, first = filled(1000), filled(600)
    second = History(["loss", "rmse"])
    second.load_state_dict(first.state_dict())
    assert second.every == first.every and second.curves() == first.curves()
    for step in range(600, 1000):
        second.add(step, row(1.0 / (1 + step), step))
    assert second.curves() == whole.curves() and second.every == whole.every


def test_missing_values_are_nan_and_unknown_names_are_ignored():
    history = History(["loss", "rmse"])
    history.add(3, {"loss": torch.tensor(2.0), "other": torch.tensor(1.0)})
    curves = history.curves()
    assert curves["step"] == [3.0] and curves["loss"] == [2.0] and math.isnan(curves["rmse"][0])

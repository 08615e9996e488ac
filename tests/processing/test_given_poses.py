"""Rough poses are matched by name and checked, and they define the axes of the scan."""

import json

import numpy as np
import pytest

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.processing.inputs import GivenPoses, align_to, read_given_poses

AT_PLACE, TURNED = np.eye(4).tolist(), np.diag([1.0, -1.0, -1.0, 1.0]).tolist()


def _poses(n=3, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (n, 1, 1))
    for k in range(n):
        Q = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        T[k, :3, :3] = Q * np.sign(np.linalg.det(Q))
        T[k, :3, 3] = rng.uniform(-100, 100, 3)
    return T


def _write(path, frames, **extra):
    records = [{"file_path": f"images/{name}.png", "transform_matrix": T} for name, T in frames.items()]
    path.write_text(json.dumps({"frames": records, **extra}))
    return path


def test_frames_are_matched_by_name(tmp_path):
    T = _poses()
    path = _write(tmp_path / "t.json", {"c": T[2].tolist(), "a": T[0].tolist(), "x": "not read"}, units="mm")
    given = read_given_poses(path, ["a", "b", "c"])
    np.testing.assert_array_equal(given.T_world_camera[[0, 2]], T[[0, 2]])
    assert np.isnan(given.T_world_camera[1]).all() and given.units == "mm"
    assert given.chosen([True, False, True]).T_world_camera.shape == (2, 4, 4)


@pytest.mark.parametrize("count", [2, 5])
def test_alignment_recovers_axes_and_scale(count):
    T = _poses(count)
    registered = np.ones(count, dtype=bool)
    given = GivenPoses(T.copy(), "mm")
    if count > 2:
        given.T_world_camera[1] = np.nan
        registered[2] = False
    turned = np.linalg.inv(T[0]) @ T
    turned[:, :3, 3] *= 0.01
    turned[~registered] = np.nan
    S = align_to(given, turned, registered)
    both = registered & np.isfinite(given.T_world_camera).all((1, 2))
    np.testing.assert_allclose(S.poses(turned[both]), T[both], atol=1e-8)
    assert S.scale == pytest.approx(100)


@pytest.mark.parametrize(
    ("frames", "extra", "message"),
    [
        ({"a": np.eye(4).tolist()}, {}, "has poses for fewer than two of the captures"),
        ({"a": (2 * np.eye(4)).tolist(), "b": np.eye(4).tolist()}, {}, "a: transform_matrix"),
        (
            {"a": AT_PLACE, "b": TURNED},
            {},
            "has all captures at the same place\n.*cause:  the file holds rotations only",
        ),
        ({"a": np.eye(4).tolist(), "b": np.eye(4).tolist()}, {"units": "furlong"}, "units is 'furlong'"),
    ],
)
def test_faulty_poses(tmp_path, frames, extra, message):
    path = _write(tmp_path / "t.json", frames, **extra)
    with pytest.raises(UserError, match=message) as caught:
        read_given_poses(path, ["a", "b", "c"])
    assert "cause:" in str(caught.value) and "remedy:" in str(caught.value)


@pytest.mark.parametrize("units", [["mm"], {}, 1, True, "inch"])
def test_units_that_are_none(tmp_path, units):
    path = tmp_path / "poses.json"
    frames = [{"file_path": f"{name}.png", "transform_matrix": np.eye(4).tolist()} for name in "ab"]
    path.write_text(json.dumps({"units": units, "frames": frames}))
    with pytest.raises(UserError, match="units is"):
        read_given_poses(path, ["a", "b"])

"""Mitsuba's photographs against the geometry of the package: where a projected ramp of coordinates lands."""

import importlib.util
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.path_traced import rendering
from benchmarks.path_traced.rendering import Body, Matter, Optics, Quality, Studio, View
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.synthesis.devices import DevicePair, look_at

HAS_MITSUBA = importlib.util.find_spec("mitsuba") is not None
needs_mitsuba = pytest.mark.skipif(not HAS_MITSUBA, reason="mitsuba is not installed: the extra [render]")
DEVICES = DevicePair(
    Device(90, 70, 150.0, 150.0, 47.3, 33.1, -0.12, 0.05), Device(300, 260, 420.0, 430.0, 140.4, 131.2, 0.06, -0.02)
)
FAR = 300.0


def _poses():
    eyes = np.array([[20.0, -90.0, 280.0], [-70.0, 40.0, 290.0]])
    return look_at(eyes, np.zeros((2, 3)), np.array([0.3, -0.4]))


def _plane(colour=0.5):
    """A square of 400 mm in z = 0, which hangs over the ideal views of both devices."""
    mesh = trimesh.Trimesh([[-200, -200, 0], [200, -200, 0], [200, 200, 0], [-200, 200, 0]], [[0, 1, 2], [0, 2, 3]],
                           vertex_normals=np.tile([0.0, 0, 1], (4, 1)), process=False)  # fmt: skip
    return Body(mesh, Matter(np.full((4, 3), colour), 1.0, 0.0, 0.0))


def _photograph(pattern, optics, quality, bodies=None, devices=DEVICES):
    studio = Studio(bodies or [_plane()], devices, pattern.astype(np.float32), optics, 100.0, FAR)
    return studio.photograph(View(*_poses(), FAR), quality, 1).mean(-1)


def _expected(devices=DEVICES):
    """Pattern pixels of the plane's points in the middle of each camera pixel, by the package."""
    T_camera, T_projector = _poses()
    d = devices.camera
    uv = np.stack(np.meshgrid(np.arange(d.w), np.arange(d.h)), -1).reshape(-1, 2) + 0.5
    ray = unproject(Intrinsics.of(d, torch.float64), torch.from_numpy(uv)).numpy() @ T_camera[:3, :3].T
    p = T_camera[:3, 3] - T_camera[2, 3] / ray[:, 2:] * ray
    in_projector = torch.from_numpy((p - T_projector[:3, 3]) @ T_projector[:3, :3])
    return project(Intrinsics.of(devices.projector, torch.float64), in_projector)[0].numpy().reshape(d.h, d.w, 2)


def _decoded(optics, quality, devices=DEVICES):
    """Coordinates as ratios of ramps to full light."""
    h, w = devices.projector.h, devices.projector.w
    x, y = np.meshgrid((np.arange(w) + 0.5) / w, (np.arange(h) + 0.5) / h)
    full, across, down = (_photograph(ramp, optics, quality, devices=devices) for ramp in (np.ones((h, w)), x, y))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.stack([across / full * w, down / full * h], -1)


@needs_mitsuba
@pytest.mark.parametrize(
    ("optics", "quality", "blurred"),
    [
        (Optics(), Quality(moments=1, direct=400, indirect=0), 12),
        (Optics(camera_blur=3.0, projector_blur=6.0), Quality(moments=8, direct=144, indirect=0), 25),
    ],
    ids=["pinholes", "lenses with an aperture"],
)
def test_projected_coordinates_are_those_of_the_package(optics, quality, blurred):
    """Both devices have distortion and a principal point beside the middle, the projector has no square pixels."""
    expected, found = _expected(), _decoded(optics, quality)
    d = DEVICES.projector
    inside = ((expected > blurred) & (expected < np.array([d.w, d.h]) - blurred)).all(-1)
    assert inside.mean() > 0.5
    error = (found - expected)[inside]
    assert np.abs(error).max() < 0.05
    assert np.abs(np.median(error, axis=0)).max() < 0.01


@needs_mitsuba
def test_a_projector_out_of_focus_blurs_by_the_stated_diameter():
    """Half an object's size (50 mm) behind the focused plane an edge is as wide as a disc of 12 pattern pixels."""
    d = replace(DEVICES.projector, k1=0.0, k2=0.0, fl_y=420.0)
    T = look_at(np.array([[0.0, 0.0, FAR + 50]]), np.zeros((1, 3)), np.zeros(1))[0]
    pattern = np.tile((np.arange(d.w) > d.cx).astype(np.float32), (d.h, 1))
    camera = Device(200, 20, 560.0, 560.0, 100.0, 10.0)
    widths = []
    for blur in (0.001, 12.0):
        studio = Studio([_plane()], DevicePair(camera, d), pattern, Optics(projector_blur=blur), 100.0, FAR)
        image = studio.photograph(View(T, T, FAR), Quality(moments=64, direct=9, indirect=0), 1).mean((0, 2))
        profile = np.diff(np.clip(image / image[-20:].mean(), 0, 1.2))
        middle = (profile * np.arange(len(profile))).sum() / profile.sum()
        variance = (profile * (np.arange(len(profile)) - middle) ** 2).sum() / profile.sum()
        widths.append(variance * (d.fl_x / camera.fl_x) ** 2)
    # the projection of a uniform disc onto a line has variance diameter^2 / 16
    assert widths[1] - widths[0] == pytest.approx(12**2 / 16, rel=0.05)


@needs_mitsuba
def test_indirect_light_has_no_part_of_the_direct_one():
    """A plane lights nothing; a wall beside it lights what the projector does not reach, and darkens nothing."""
    pattern = np.kron(np.indices((13, 15)).sum(0) % 2, np.ones((20, 20)))
    direct, more = Quality(moments=1, direct=4, indirect=0), Quality(moments=1, direct=4, indirect=16)
    alone = _photograph(pattern, Optics(), direct)
    assert _photograph(pattern, Optics(), more) == pytest.approx(alone, abs=1e-4 * alone.max())
    wall = trimesh.Trimesh([[-40, -60, 0], [-40, 60, 0], [-40, 60, 50], [-40, -60, 50]], [[0, 1, 2], [0, 2, 3]],
                           vertex_normals=np.tile([1.0, 0, 0], (4, 1)), process=False)  # fmt: skip
    bodies = [_plane(), Body(wall, Matter(np.full((4, 3), 0.8), 1.0, 0.0, 0.0))]
    added = _photograph(pattern, Optics(), more, bodies) - _photograph(pattern, Optics(), direct, bodies)
    assert added.min() > -1e-4 * alone.max()
    assert (added > 0.003 * alone.max()).mean() > 0.1


def test_a_missing_renderer_is_named_with_its_remedy(monkeypatch):
    monkeypatch.setattr(rendering.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=r"mitsuba is not installed[\s\S]*pip install 'sl-nerfstudio\[render\]'"):
        rendering.mitsuba()


def _no_library(variant):
    raise ImportError("could not be found")


@pytest.mark.parametrize(
    ("set_variant", "version", "said"),
    [
        (_no_library, (19, 1, 7), r"finds no libLLVM, with which it compiles: could not be found"),
        (lambda variant: None, (15, 0, 7), r"found libLLVM 15, which cannot compile for all processors"),
    ],
)
def test_a_compiler_that_is_missing_or_too_old_is_named_with_its_remedy(monkeypatch, set_variant, version, said):
    modules = {
        "mitsuba": SimpleNamespace(set_variant=set_variant),
        "drjit": SimpleNamespace(set_thread_count=int, detail=SimpleNamespace(llvm_version=lambda: version)),
    }
    monkeypatch.setattr(rendering.importlib.util, "find_spec", modules.get)
    monkeypatch.setattr(rendering.importlib, "import_module", modules.get)
    with pytest.raises(UserError, match=said + r"\n.*remedy: apt-get install libllvm19"):
        rendering.mitsuba()

"""Textures of a ball whose colour is a function of the place, in files that trimesh reads: colours at random places."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.meshing import texture as module
from sl_nerfstudio.meshing.files import files_of, read_mesh, write_mesh
from sl_nerfstudio.meshing.finish import decimate
from sl_nerfstudio.meshing.mesh import GREY, Mesh
from sl_nerfstudio.meshing.texture import Textured, surface_texture
from sl_nerfstudio.scan import Scan
from tests.meshing.coloured_ball import BALL, RADIUS, angle_cosines, coloured_scan

CAMERA = Device(w=384, h=336, fl_x=900.0, fl_y=930.0, cx=180.0, cy=174.0)
COARSE = decimate(BALL, 300)
TOLERANCE = 0.02  # of full scale: half a grey value in each picture and the texture, bilinear values of both


def waves(p: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1]: periods that the 300 triangles (12 mm) of COARSE cannot follow, but pictures (0.3 mm) can."""
    x, y, z = np.moveaxis(p, -1, 0)
    return 0.5 + 0.3 * np.stack(
        [np.sin(x / 3) * np.cos(z / 5), np.sin(y / 4 + 1), np.cos((x - y) / 5) * z / RADIUS], -1
    )


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return coloured_scan(tmp_path_factory.mktemp("texture") / "scan", 3, CAMERA, waves)


@pytest.fixture(scope="module", params=["whole", "decimated"])
def mesh(request) -> Mesh:
    return BALL if request.param == "whole" else COARSE.mesh


@pytest.fixture(scope="module")
def textured(mesh, scan) -> Textured:
    return surface_texture(mesh, 768, BALL, scan, scan.poses)


def loaded(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, Image.Image]:
    """What trimesh reads: corners of all triangles in the scan's axes, in mm, their texture coordinates, the image."""
    found = trimesh.load_mesh(path, process=False)
    corners, uv = found.triangles, found.visual.uv[found.faces]
    material = found.visual.material
    image = material.image if path.suffix == ".obj" else material.baseColorTexture
    assert image is not None
    if path.suffix == ".glb":  # metres, y up
        x, y, z = np.moveaxis(corners, -1, 0)
        corners = np.stack([x, -z, y], -1) * 1000
    return np.asarray(corners), uv[..., 0], uv[..., 1], image


def sampled(image: Image.Image, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Bilinear values in [0, 1] by trimesh, whose v is counted upwards for all formats."""
    return trimesh.visual.color.uv_to_interpolated_color(np.stack([u, v], 1), image.convert("RGB"))[:, :3] / 255


@pytest.mark.parametrize("where", ["inside triangles", "on their edges"])
@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_the_texture_has_the_colour_of_the_place(suffix, where, mesh, textured, scan, tmp_path):
    """Edges include the borders of all charts, where filters of the texture read beside the chart."""
    path = tmp_path / f"a ball{suffix}"
    write_mesh(path, mesh, None, "mm", textured.texture)
    corners, u, v, image = loaded(path)
    random = np.random.default_rng(3)
    weights = random.dirichlet([1, 1, 1], (len(corners), 20))
    if where == "on their edges":
        weights[..., 2] = 0
        weights = np.take_along_axis(weights / weights.sum(-1, keepdims=True), random.permuted(
            np.broadcast_to(np.arange(3), weights.shape), axis=-1), -1)  # fmt: skip
    p = np.einsum("fnk,fki->fni", weights, corners).reshape(-1, 3)
    found = sampled(image, *(np.einsum("fnk,fk->fn", weights, x).reshape(-1) for x in (u, v)))
    p *= RADIUS / np.linalg.norm(p, axis=1, keepdims=True)
    cosine = angle_cosines(scan, range(3), p)
    clearly = (cosine > 0.4).any(0) & ~((cosine > 0.1) & (cosine < 0.3)).any(0)
    error = np.abs(found - waves(p))[clearly]
    assert clearly.sum() > 0.3 * len(p) > 1000
    assert np.percentile(error, 99) < TOLERANCE and error.max() < 3 * TOLERANCE
    unseen = (cosine < 0.1).all(0)
    assert unseen.any() and np.abs(found[unseen] - GREY / 255).max() < 0.003


def test_vertices_alone_would_not_do():
    """The bound above means something: colours of the vertices of COARSE, interpolated, are off by ten times that."""
    centres = COARSE.mesh.vertices[COARSE.mesh.faces]
    error = np.abs(waves(centres).mean(1) - waves(centres.mean(1)))
    assert np.percentile(error, 90) > 10 * TOLERANCE


def test_smaller_copies_of_the_image_show_nothing_from_between_the_charts(mesh, textured):
    """Reduced eight times, as for a distant view, every pixel is still a mean of colours of the ball: none is black."""
    image = textured.texture.image.astype(float)
    small = image.reshape(96, 8, 96, 8, 3).mean((1, 3)) / 255
    assert small.min() > 0.19 and small.max() < 0.81
    assert image.min() / 255 > 0.19 and image.max() / 255 < 0.81


def test_figures_of_a_texture(mesh, textured):
    """The side of a pixel: as many of them as are inside triangles have the area of the surface."""
    assert textured.pictures == 3 and 0.4 < textured.seen < 0.9
    uv = textured.texture.charts.uv[textured.texture.charts.corners].astype(float) * 768
    a, b = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    pixels = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
    area = trimesh.Trimesh(mesh.vertices, mesh.faces).area
    assert textured.texel == pytest.approx((area / pixels) ** 0.5, rel=1e-6)


def test_parts_of_a_texture_are_coloured_like_the_whole(scan, mesh, textured, monkeypatch):
    monkeypatch.setattr(module, "_AT_A_TIME", 50_000)
    assert np.array_equal(surface_texture(mesh, 768, BALL, scan, scan.poses).texture.image, textured.texture.image)


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_the_mesh_itself_comes_back_without_the_seams_of_its_charts(suffix, mesh, textured, tmp_path):
    path = tmp_path / f"m{suffix}"
    write_mesh(path, mesh, None, "mm", textured.texture)
    assert set(tmp_path.iterdir()) == set(files_of(path, textured=True))
    back = read_mesh(path, "mm")
    assert len(back.vertices) == len(mesh.vertices) and len(back.faces) == len(mesh.faces) and back.is_closed()
    np.testing.assert_allclose(np.sort(back.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=2e-5)


@pytest.mark.parametrize("suffix", [".ply", ".stl"])
def test_formats_without_textures(suffix, mesh, textured, tmp_path):
    with pytest.raises(ValueError, match=f"{suffix} files have no texture"):
        write_mesh(tmp_path / f"m{suffix}", mesh, None, "mm", textured.texture)
    assert list(tmp_path.iterdir()) == []

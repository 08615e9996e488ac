"""Colours of vertices and textures of a ball whose colour is a function of the place."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.numerics import component_labels
from sl_nerfstudio.meshing import texture as module
from sl_nerfstudio.meshing.files import files_of, read_mesh, write_mesh
from sl_nerfstudio.meshing.finish import decimate
from sl_nerfstudio.meshing.mesh import GREY, Mesh, as_linear, as_srgb
from sl_nerfstudio.meshing.texture import Colours, Pictures, Textured, draw_triangles, square_charts, surface_texture
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png
from tests.formulas import on_ball, rays

from .ray_cast_scan import pairs_around, scan_of
from .solids import mesh_of, together

RADIUS = 40.0
BALL = mesh_of(trimesh.creation.icosphere(4, RADIUS))
PINHOLE = Device(w=128, h=112, fl_x=300.0, fl_y=310.0, cx=60.0, cy=58.0)
Colour = Callable[[np.ndarray], np.ndarray]


def colour_at(p: np.ndarray) -> np.ndarray:
    """sRGB in [0, 1]: three different gradients, of which none is symmetric in the image."""
    return 0.5 + p / (2.5 * RADIUS)


def picture(T_world_camera: np.ndarray, camera: Device = PINHOLE, colour: Colour = colour_at) -> np.ndarray:
    """What a pinhole camera sees of the ball, by the formulas of the format; black beside it."""
    p = on_ball(*rays(camera, T_world_camera), RADIUS)
    return np.round(np.nan_to_num(colour(p)) * 255).astype(np.uint8)


def coloured_scan(root: Path, pictures: int, camera: Device = PINHOLE, colour: Colour = colour_at) -> Scan:
    """Four captures from above, of which the first ones were also taken without the pattern."""
    scan = scan_of(BALL, pairs_around(4, 40), root, camera=camera)
    (root / "color").mkdir()
    frames = list(scan.frames)
    for k, frame in enumerate(frames[:pictures]):
        path = root / f"color/{frame.name}.png"
        path.write_bytes(encode_png(picture(frame.T_world_camera, camera, colour)))
        frames[k] = replace(frame, color_path=path)
    return replace(scan, frames=tuple(frames))


def angle_cosines(scan: Scan, frames: range, points: np.ndarray) -> np.ndarray:
    """Cosine between the ball's normal and the line of sight, of each frame and point of the ball."""
    eyes = np.stack([scan.frames[k].T_world_camera[:3, 3] for k in frames])
    way = eyes[:, None] - points
    return (way * points).sum(2) / np.linalg.norm(way, axis=2) / RADIUS


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return coloured_scan(tmp_path_factory.mktemp("colour") / "scan", pictures=3)


def coloured(scan: Scan, mesh: Mesh = BALL) -> Colours:
    return Pictures(mesh, scan, scan.poses).colours(mesh.vertices, mesh.vertex_normals())


def test_vertices_have_the_colour_of_their_place_and_unseen_ones_are_grey(scan):
    found = coloured(scan)
    cosine = angle_cosines(scan, range(3), BALL.vertices)
    clearly = (cosine > 0.3).any(0)
    assert found.seen[clearly].all() and not found.seen[(cosine < 0.1).all(0)].any()
    expected = colour_at(BALL.vertices) * 255
    assert np.abs(found.rgb[clearly] - expected[clearly]).max() < 5
    assert (found.rgb[~found.seen] == GREY).all() and 0.2 < found.seen.mean() < 0.8


def test_flat_views_weigh_less(scan, monkeypatch):
    """One picture has the same value everywhere: its share in a vertex is its squared cosine, of linear light."""
    monkeypatch.setattr(module, "_ROUNDS", 0)  # as if nothing were known of the exposures
    path = scan.root / "color/bright.png"
    path.write_bytes(encode_png(np.full((PINHOLE.h, PINHOLE.w), 240, dtype=np.uint8)))
    first = replace(scan.frames[0], color_path=path)
    found = coloured(replace(scan, frames=(first, *scan.frames[1:2])))
    squares = angle_cosines(scan, range(2), BALL.vertices) ** 2
    both = (angle_cosines(scan, range(2), BALL.vertices) > 0.3).all(0)
    share = (squares[0] / squares.sum(0))[:, None]
    light = share * as_linear(np.array(240 / 255)) + (1 - share) * as_linear(colour_at(BALL.vertices))
    assert both.sum() > 100 and np.abs(found.rgb[both] - 255 * as_srgb(light)[both]).max() < 5


@pytest.mark.parametrize("seed", range(3))
def test_exposures_are_evened_out_whatever_shadows_and_reflections_say(tmp_path, seed):
    """Gains of 0.7 to 1.4 in each picture and channel leave the colours as they are, but for one gain of all."""
    scan, random = coloured_scan(tmp_path / "scan", pictures=4), np.random.default_rng(seed)
    gains = np.exp(random.uniform(np.log(0.7), np.log(1.4), (4, 3)))
    for gain, frame in zip(gains, scan.frames, strict=True):
        light = gain * as_linear(picture(frame.T_world_camera) / 255)
        x, y = random.integers(20, 80, 2)
        light[y : y + 12, x : x + 12] *= random.choice([0.2, 3.0])  # a twentieth of the ball is in shadow, or shines
        frame.color_path.write_bytes(encode_png(np.round(255 * as_srgb(light)).astype(np.uint8)))
    pictures = Pictures(BALL, scan, scan.poses)
    mean = np.exp(np.log(gains).mean(0))
    assert np.abs(pictures.gains / gains * mean - 1).max() < 0.02
    assert list(pictures.exposures()) == [frame.name for frame in scan.frames]
    found = pictures.colours(BALL.vertices, BALL.vertex_normals())
    expected = 255 * as_srgb(mean * as_linear(colour_at(BALL.vertices)))
    clearly = (angle_cosines(scan, range(4), BALL.vertices) > 0.3).any(0)
    error = np.abs(found.rgb[clearly] - expected[clearly])
    assert np.median(error) < 2 and np.percentile(error, 90) < 6


def test_pictures_that_share_nothing_are_compared_among_themselves():
    values = np.log([[1.0, 2, 9, 9], [2.0, 4, 9, 9], [9, 9, 1, 5], [9, 9, 4, 20]])
    weights = np.kron(np.eye(2), np.ones((2, 2)))
    level = module.relative_levels(values, weights)
    assert np.diff(level)[[0, 2]] == pytest.approx(np.log([2.0, 4.0]), abs=1e-6) and abs(level.sum()) < 1e-9
    assert module.relative_levels(values[:, :0], weights[:, :0]) == pytest.approx(np.zeros(4))


def test_a_capture_in_full_light_shows_only_what_the_projector_lights(scan):
    frame = scan.frames[0]
    lit = replace(scan, frames=(replace(frame, color_path=frame.image_path), *scan.frames[3:]))
    seen = coloured(lit).seen
    with_all = coloured(replace(scan, frames=(frame, *scan.frames[3:]))).seen
    assert 0.2 < seen.sum() / with_all.sum() < 1 and not seen[~with_all].any()


def test_what_is_hidden_takes_no_colour_from_what_hides_it(scan):
    eye = scan.frames[0].T_world_camera[:3, 3]
    plate = trimesh.creation.box((12.0, 12.0, 0.5))
    plate.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], eye / np.linalg.norm(eye)))
    plate.apply_translation(0.5 * eye)
    alone = replace(scan, frames=scan.frames[:1])
    open_view, found = coloured(alone), coloured(alone, together(BALL, mesh_of(plate)))
    behind = open_view.seen & ~found.seen[: len(BALL.vertices)]
    ray = BALL.vertices - eye
    off = np.linalg.norm(np.cross(ray, -eye / np.linalg.norm(eye)), axis=1) / np.linalg.norm(ray, axis=1)
    assert behind.any() and (off[behind] < 0.06).all() and not (open_view.seen & (off < 0.036) & ~behind).any()
    assert (found.rgb[: len(BALL.vertices)][behind] == GREY).all()


def test_pictures_with_16_bits(scan):
    path = scan.root / "color/deep.png"
    path.write_bytes(encode_png(picture(scan.frames[0].T_world_camera).astype(np.uint16) * 257))
    deep = replace(scan, frames=(replace(scan.frames[0], color_path=path),))
    plain = replace(scan, frames=scan.frames[:1])
    assert np.array_equal(coloured(deep).rgb, coloured(plain).rgb)


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
def waving(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return coloured_scan(tmp_path_factory.mktemp("texture") / "scan", 3, CAMERA, waves)


@pytest.fixture(scope="module", params=["whole", "decimated"])
def mesh(request) -> Mesh:
    return BALL if request.param == "whole" else COARSE.mesh


@pytest.fixture(scope="module")
def textured(mesh, waving) -> Textured:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_PIECE", 1500 if mesh is BALL else 10**9)
        return surface_texture(mesh, 768, BALL, Pictures(BALL, waving, waving.poses))


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
def test_the_texture_has_the_colour_of_the_place(suffix, where, mesh, textured, waving, tmp_path):
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
    cosine = angle_cosines(waving, range(3), p)
    clearly = (cosine > 0.4).any(0) & ~((cosine > 0.1) & (cosine < 0.3)).any(0)
    error = np.abs(found - waves(p))[clearly]
    assert clearly.sum() > 0.3 * len(p) > 1000
    assert np.percentile(error, 99) < TOLERANCE and error.max() < 3 * TOLERANCE
    unseen = (cosine < 0.1).all(0)
    assert unseen.any() and np.abs(found[unseen] - GREY / 255).max() < 0.003


def test_smaller_copies_of_the_image_show_nothing_from_between_the_charts(mesh, textured):
    """Reduced eight times, as for a distant view, every pixel is still a mean of colours of the ball: none is black."""
    image = textured.texture.image.astype(float)
    small = image.reshape(96, 8, 96, 8, 3).mean((1, 3)) / 255
    assert small.min() > 0.19 and small.max() < 0.81
    assert image.min() / 255 > 0.19 and image.max() / 255 < 0.81


def test_charts_have_one_scale_which_is_said(mesh, textured):
    charts = textured.texture.charts
    assert np.array_equal(charts.vertex[charts.corners], mesh.faces)
    assert charts.uv.min() >= 0 and charts.uv.max() <= 1 and 0.4 < textured.seen < 0.9
    flat = trimesh.triangles.area(np.pad(charts.uv.astype(float), ((0, 0), (0, 1)))[charts.corners])
    scale = np.sqrt(flat / mesh.face_areas())
    assert 0.25 < flat.sum() < 1 and np.percentile(scale, 99) / np.percentile(scale, 1) < 1.5
    number = component_labels(charts.corners[:, :2].ravel(), charts.corners[:, 1:].ravel(), len(charts.uv))
    assert len(np.unique(number)) == charts.count
    assert textured.texel == pytest.approx((mesh.face_areas().sum() / flat.sum()) ** 0.5 / 768, rel=1e-6)


def test_parts_of_a_texture_are_coloured_like_the_whole(waving, mesh, textured, monkeypatch):
    monkeypatch.setattr(module, "_AT_A_TIME", 50_000)
    monkeypatch.setattr(module, "_PIECE", 1500 if mesh is BALL else 10**9)
    again = surface_texture(mesh, 768, BALL, Pictures(BALL, waving, waving.poses))
    assert np.array_equal(again.texture.image, textured.texture.image)


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


KNOT = trimesh.creation.torus(30.0, 11.0, major_sections=48, minor_sections=24)


def test_the_unit_and_the_place_of_a_mesh_do_not_matter_and_a_small_texture_has_few_charts():
    plain, tiny = (square_charts(mesh_of(KNOT, scale), 256) for scale in (1.0, 1e-5))
    far = square_charts(Mesh(mesh_of(KNOT).vertices + 1e4, mesh_of(KNOT).faces), 256)
    for other in (tiny, far):
        assert np.array_equal(plain.corners, other.corners)
        np.testing.assert_allclose(plain.uv, other.uv, atol=0.02)
    assert square_charts(mesh_of(KNOT), 64).count < 30 < square_charts(mesh_of(KNOT), 512).count


def test_degenerate_triangles_cover_nothing():
    corners = np.array([[[0.1, 0.1], [0.5, 0.5], [0.9, 0.9]], [[0.3, 0.3]] * 3])
    assert (draw_triangles(corners, 8)[0] == -1).all()

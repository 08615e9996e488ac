"""sl-export --texture: what it writes and says, and what it refuses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sl_nerfstudio.cli.export import ExportConfig, check_outputs, export_trained
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.files import read_mesh
from sl_nerfstudio.scan import Scan
from sl_nerfstudio.scan.images import encode_png
from tests.runs.ball_run import CENTRE, RADIUS, ball_scan, run_of

COLOUR = (200, 100, 50)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Scan:
    return ball_scan(tmp_path_factory.mktemp("export") / "scan")


@pytest.fixture(scope="module")
def coloured(scan) -> Scan:
    """The same scan, of which two frames were also taken without the pattern."""
    camera = scan.frames[0].camera
    path = scan.root / "one_colour.png"
    path.write_bytes(encode_png(np.full((camera.h, camera.w, 3), COLOUR, dtype=np.uint8)))
    pictures = [replace(frame, color_path=path) for frame in scan.frames[:2]]
    return replace(scan, frames=(*pictures, *scan.frames[2:]))


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_a_texture_is_written_with_the_decimated_mesh_and_described(coloured, tmp_path, suffix):
    output = tmp_path / f"mesh{suffix}"
    config = ExportConfig(Path("c"), output, resolution=64, texture=256, target_faces=2000, points=tmp_path / "p.ply")
    text = " ".join(export_trained(run_of(coloured), config).split())  # long lines are broken where they need be
    found = trimesh.load_mesh(output, process=False)
    material = found.visual.material
    image = np.asarray((material.baseColorTexture if suffix == ".glb" else material.image).convert("RGB")).reshape(
        -1, 3
    )
    assert image.shape == (256 * 256, 3)
    assert set(map(tuple, np.unique(image, axis=0).tolist())) == {COLOUR, (128, 128, 128)}  # seen, or not seen
    mesh = read_mesh(output, "mm")
    assert len(mesh.faces) <= 2000 and len(found.faces) == len(mesh.faces)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - CENTRE, axis=1), RADIUS, atol=0.2)
    assert "texture of 256 x 256 pixels, " in text and " charts, from 2 pictures without the pattern; " in text
    assert "% of the surface is in none of them and grey" in text and "colours from" not in text
    assert ((tmp_path / "mesh.png").exists(), (tmp_path / "mesh.mtl").exists()) == ((suffix == ".obj"),) * 2
    assert (trimesh.load(tmp_path / "p.ply").colors[:, :3] == COLOUR).all(1).any()  # points keep colours of their own


def test_without_pictures_it_says_what_to_add(scan, tmp_path):
    config = ExportConfig(Path("c"), tmp_path / "mesh.glb", resolution=48, texture=512)
    with pytest.raises(
        UserError, match=r"no frame of .* has a picture without(.|\n)*sl_color_path(.|\n)*leave --texture"
    ):
        export_trained(run_of(scan), config)
    assert list(tmp_path.iterdir()) == []


def check(output: Path, **flags) -> None:
    check_outputs(ExportConfig(Path("c"), output, **flags))


def test_flags_that_cannot_be(tmp_path):
    with pytest.raises(
        UserError, match=r"\.ply files have no texture(.|\n)*\.glb or \.obj, or leave(.|\n)*of its vertices"
    ):
        check(tmp_path / "mesh.ply", texture=2048)
    with pytest.raises(
        UserError, match=r"\.stl files have no texture(.|\n)*remedy: end the name .* in \.glb or \.obj$"
    ):
        check(tmp_path / "mesh.stl", texture=2048)
    for size in (0, -5, 63, 8193):
        with pytest.raises(UserError, match=rf"--texture {size}: must be 64 to 8192, the side in pixels"):
            check(tmp_path / "mesh.glb", texture=size)
    check(tmp_path / "mesh.glb", texture=64)


def test_the_image_beside_an_obj_is_not_replaced(tmp_path):
    (tmp_path / "mesh.png").write_bytes(b"mine")
    with pytest.raises(UserError, match=r"mesh.png: already exists(.|\n)*--overwrite"):
        check(tmp_path / "mesh.obj", texture=512)
    check(tmp_path / "mesh.obj")
    check(tmp_path / "mesh.glb", texture=512)

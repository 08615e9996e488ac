"""Means over frames, the commands that are printed at the end, and the rays of a texture."""

import json
import math
from pathlib import Path

import numpy as np
import torch
import trimesh

from sl_nerfstudio.model.pipeline import mean_over_frames, unwrap_mesh_with_xatlas, what_next


def test_means_and_deviations_over_the_frames_that_have_a_value() -> None:
    frames = [{"a": 1.0, "b": 5.0}, {"a": 3.0}, {}, {"a": math.nan, "c": math.nan}, {"a": 8.0, "b": math.inf}]
    found = mean_over_frames(frames, with_std=True)
    assert found == {"a": 4.0, "a_std": math.sqrt((9 + 1 + 16) / 2), "b": 5.0, "b_std": 0.0}
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert mean_over_frames(frames, with_std=False) == {"a": 4.0, "b": 5.0}


def test_what_comes_next_is_quoted_for_a_shell_and_fits_into_80_columns(tmp_path: Path) -> None:
    """A scan with much missing is to be decoded again, but not a second time."""
    text = what_next(Path("/a b/it's/config.yml"), Path("/scan"), 0.9)
    assert """ns-viewer --load-config '/a b/it'"'"'s/config.yml'""" in text
    assert text.startswith("result      /a b/it's\n") and "sl-redecode" not in text
    again = what_next(Path("/run/config.yml"), Path("/scans/a vase"), 0.404)
    assert "40% of the pixels" in again and "--output '/scans/a vase-again'" in again
    assert max(map(len, (text + again).splitlines())) <= 80
    (tmp_path / "redecoding.json").touch()
    assert "sl-redecode" not in what_next(Path("/run/config.yml"), tmp_path, 0.404)


def test_rays_of_a_sphere_start_on_it_and_lead_inwards():
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices, faces = torch.from_numpy(np.array(ball.vertices)).float(), torch.from_numpy(np.array(ball.faces))
    normals = torch.nn.functional.normalize(vertices, dim=-1)
    corners, origins, directions = unwrap_mesh_with_xatlas(vertices, faces, normals, num_pixels_per_side=128)
    assert corners.shape == (len(faces), 3, 2) and corners.min() >= 0 and corners.max() <= 1
    assert origins.shape == directions.shape == (128, 128, 3)
    torch.testing.assert_close(directions.norm(dim=-1), torch.ones(128, 128))
    on = origins.norm(dim=-1) < 1.0
    assert on.float().mean() > 0.4  # the atlas is not empty
    assert (origins[on].norm(dim=-1) - 0.5).abs().max() < 0.02  # chords of the sphere, and two pixels of gutter
    assert (directions[on] * torch.nn.functional.normalize(origins[on], dim=-1)).sum(-1).max() < -0.98
    missing = origins[~on] + torch.linspace(0, 100, 50)[:, None, None] * directions[~on]
    assert missing.norm(dim=-1).min() > 10  # the rest never comes near the scene
    # where a corner lies in the texture, the ray starts at its vertex
    pixel = (corners.reshape(-1, 2) * 128).long().clamp(0, 127)
    there = origins[pixel[:, 1], pixel[:, 0]]
    assert (there - vertices[faces.reshape(-1)]).norm(dim=-1).median() < 0.02

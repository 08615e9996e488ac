"""The rays of a texture: every pixel inside a triangle gets the triangle's point and normal."""

import numpy as np
import torch
import trimesh

from sl_nerfstudio.model.pipeline import unwrap_mesh_with_xatlas


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

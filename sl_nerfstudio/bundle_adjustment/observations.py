"""Which decoded pixels take part in the bundle adjustment, and in which other frames they are looked up."""

from dataclasses import fields

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import project, unproject
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach


def place_anchors(rig: Rig, maps: CoordinateMaps, per_frame: int, generator: torch.Generator) -> Anchors:
    """Random decoded pixels whose neighbourhood is smooth and whose rays meet in front of both devices."""
    parts = []
    for frame in range(rig.frames):
        uv = maps.draw(frame, per_frame, generator)
        index = torch.full((len(uv),), frame)
        seen = maps.look_up(index, uv)
        beside = uv[:, None] + torch.eye(2, dtype=uv.dtype)
        there = seen.uv_projector[:, None] + seen.jacobian.transpose(-1, -2)
        (p, good), (q, _) = (_meet(rig, frame, *pixels) for pixels in ((uv, seen.uv_projector), (beside, there)))
        edge = q - p[:, None]
        normal = torch.nn.functional.normalize(torch.linalg.cross(edge[:, 0], edge[:, 1]), dim=-1)
        normal = -normal * (normal * p).sum(-1, keepdim=True).sign()
        depth = p.norm(dim=-1)
        parts.append(Anchors(index, p / depth[:, None], seen.uv_projector, depth, normal).chosen(seen.valid & good))
    return Anchors(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Anchors)))


def _meet(
    rig: Rig, frame: int, uv_camera: Float[Tensor, "*n 2"], uv_projector: Float[Tensor, "*n 2"]
) -> tuple[Float[Tensor, "*n 3"], Bool[Tensor, "*n"]]:
    """Points on a frame's camera rays nearest to its projector rays, in camera axes; whether in front of both."""
    d_camera = unproject(rig.camera[frame], uv_camera)
    T = rig.T_camera_projector[frame]
    d_projector = rotate(T, unproject(rig.projector, uv_projector))
    depth, depth_projector = closest_approach(
        torch.zeros_like(d_camera), d_camera, T[:3, 3].expand_as(d_camera), d_projector
    )
    return depth[..., None] * d_camera, (depth > 0) & (depth_projector > 0)


def observe(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    per_anchor: int,
    gate_px: float,
    least_cosine: float,
    generator: torch.Generator,
    around: int | None = None,
) -> Observations:
    """For every anchor, up to `per_anchor` other frames that decoded something near it, within `gate_px` of it.

    Frames whose camera or projector is behind the anchor's surface, or sees it at a cosine below `least_cosine`, are
    left out: they see, or light, another side of the object. With `around`, only observations that involve one frame.
    """
    chosen = []
    devices = (rig.T_world_camera, rig.T_world_projector)
    p_world = transform(rig.T_world_camera[anchors.frame], anchors.depth[:, None] * anchors.d_camera)
    normal = rotate(rig.T_world_camera[anchors.frame], anchors.normal)
    for j in range(rig.frames):
        others = anchors.frame != j if around in (None, j) else anchors.frame == around
        anchor = others.nonzero().squeeze(-1)
        frame = torch.full_like(anchor, j)
        p_j = transform(inverse(rig.T_world_camera[j]), p_world[anchor])
        uv_camera, in_front = project(rig.camera[j], p_j)
        expected, lit = project(rig.projector, transform(inverse(rig.T_camera_projector[j]), p_j))
        miss = (maps.decoded_at(frame, uv_camera) - expected).norm(dim=-1)
        faces = [_cosine(normal[anchor], T[j, :3, 3] - p_world[anchor]) > least_cosine for T in devices]
        keep = in_front & lit & faces[0] & faces[1] & (miss < gate_px)  # False where nothing is decoded
        chosen.append(torch.stack([anchor[keep], frame[keep]]))
    rows = torch.cat(chosen, 1)
    rows = rows[:, torch.randperm(rows.shape[1], generator=generator)]
    rows = rows[:, torch.argsort(rows[0], stable=True)]
    starts = torch.searchsorted(rows[0].contiguous(), rows[0].contiguous())
    rows = rows[:, torch.arange(rows.shape[1]) - starts < per_anchor]
    return Observations(rows[0], rows[1])


def _cosine(a: Float[Tensor, "*n 3"], b: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
    return (a * b).sum(-1) / (a.norm(dim=-1) * b.norm(dim=-1))

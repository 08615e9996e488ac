"""Whether frames agree with each other: coordinates of one, through its own two devices into those of another.

A point is triangulated in one frame and projected into another camera; the coordinate decoded *there* is compared with
where that frame's projector has the point. A point in front of what the other camera saw contradicts it: it would have
been seen instead. One behind it may be hidden and is not judged; if it is a contradiction, that shows the other way
round, where the other frame's points then lie in front.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps
from sl_nerfstudio.bundle_adjustment.observations import observe, partners, place_anchors
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Linearisation, Observations, linearise
from sl_nerfstudio.bundle_adjustment.rig import Rig
from sl_nerfstudio.geometry.devices import project, unproject
from sl_nerfstudio.geometry.se3 import inverse, rotate, transform
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.threads import one_library_thread
from sl_nerfstudio.verdict.agreement import CrossFrameAgreement, LookUps, summarise
from sl_nerfstudio.verdict.decoding_noise import frame_noise
from sl_nerfstudio.verdict.settings import CrossFrameSettings


@one_library_thread()
def cross_frame_agreement(
    rig: Rig,
    maps: CoordinateMaps,
    sigma: Float[Tensor, "frames 12"],
    settings: CrossFrameSettings | None = None,
) -> CrossFrameAgreement:
    """Compare all frames. The scene must be normalised: origin at the object's centre, radius about one.

    `sigma` is 1 sigma of each frame's pose as a whole and of its projector against its camera (translation xyz and
    rotation xyz each), in the scene's unit and radian: what these explain is no contradiction.
    """
    s = settings or CrossFrameSettings()
    generator = torch.Generator().manual_seed(0)
    anchors = place_anchors(rig, maps, s.pixels_of_each(rig.frames), generator)
    most = rig.frames if rig.frames <= s.compared_frames else s.partners
    together = partners(rig, anchors, maps, most, s.least_cosine, generator)
    rows = observe(rig, anchors, maps, rig.frames, float("inf"), s.least_cosine, generator, together)
    linear = linearise(rig, anchors, rows, maps)
    noise = frame_noise(linear, anchors, rig.frames)
    usual = float(noise.nanmedian())
    noise = noise.nan_to_num(usual).clamp_max(s.largest_noise_ratio * usual)
    size = linear.residuals.cross.norm(dim=-1)
    by_noise = _variance_by_noise(linear, anchors, rows, noise**2 + (s.footprint * _footprint(rig, anchors, maps)) ** 2)
    by_poses = _variance_by_poses(linear, anchors, rows, sigma)
    normalised = size / (by_noise + by_poses).sqrt()
    judged = linear.residuals.cross_valid & ((normalised < s.sigmas) | _in_front(rig, anchors, rows, maps))
    looked_up = LookUps(
        frames=rig.frames,
        source=anchors.frame.numpy(),
        anchor=rows.anchor[judged].numpy(),
        viewer=rows.frame[judged].numpy(),
        px=size[judged].numpy(),
        normalised=normalised[judged].numpy(),
        by_poses=(by_poses / (by_noise + by_poses))[judged].numpy(),
    )
    return summarise(looked_up, usual, s)


def _footprint(rig: Rig, anchors: Anchors, maps: CoordinateMaps) -> Float[Tensor, "frames"]:
    """Pattern pixels under one camera pixel: the median over each frame's points."""
    uv, _ = project(rig.camera[anchors.frame], anchors.d_camera)
    size = maps.look_up(anchors.frame, uv).jacobian.flatten(1).norm(dim=-1) / 2**0.5
    found = [size[anchors.frame == k] for k in range(rig.frames)]
    return torch.stack([x.median() if len(x) else torch.zeros((), dtype=size.dtype) for x in found])


def _variance_by_noise(
    linear: Linearisation, anchors: Anchors, rows: Observations, variance: Float[Tensor, "frames"]
) -> Float[Tensor, "rows"]:
    """Variance of a coordinate of each cross residual from the `variance` of look-ups in both frames, px^2.

    An error of the anchor's own coordinate changes its depth, and that the residual.
    """
    own2, cross2 = (linear.own_depth**2).sum(-1).clamp_min(1e-300), (linear.cross_depth**2).sum(-1)
    source = anchors.frame[rows.anchor]
    return variance[rows.frame] + variance[source] * cross2 / own2[rows.anchor]


def _variance_by_poses(
    linear: Linearisation, anchors: Anchors, rows: Observations, sigma: Float[Tensor, "frames 12"]
) -> Float[Tensor, "rows"]:
    """Variance of each cross residual, both coordinates together, from the stated sigma of the poses, px^2."""
    variance = sigma**2
    length2 = (linear.own_depth**2).sum(-1).clamp_min(1e-300)
    depth = (linear.own_depth[:, :, None] * linear.own).sum(1) / length2[:, None]  # by the projector's pose
    through_depth = (depth**2 * variance[anchors.frame, 6:]).sum(-1)[rows.anchor] * (linear.cross_depth**2).sum(-1)
    source, viewer = rows.pairs(anchors)
    of_poses = torch.cat([variance[source, :6], variance[viewer]], 1)
    return (linear.cross**2 * of_poses[:, None, :]).sum((1, 2)) + through_depth


def _in_front(rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps) -> Bool[Tensor, "rows"]:
    """Whether a point is nearer to the other camera than what that camera saw in its place."""
    j, a = rows.frame, rows.anchor
    p_world = transform(rig.T_world_camera[anchors.frame[a]], (anchors.depth[:, None] * anchors.d_camera)[a])
    p_j = transform(inverse(rig.T_world_camera)[j], p_world)
    uv, _ = project(rig.camera[j], p_j)
    d_camera = unproject(rig.camera[j], uv)
    T = rig.T_camera_projector[j]
    d_projector = rotate(T, unproject(rig.projector, maps.look_up(j, uv).uv_projector))
    depth, beyond = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], d_projector)
    return (beyond > 0) & (p_j.norm(dim=-1) < depth)  # False where the rays do not meet

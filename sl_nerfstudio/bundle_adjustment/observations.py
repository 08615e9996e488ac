"""Which decoded pixels take part in the bundle adjustment, and in which other frames they are looked up."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64, Int, Int64
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import (
    CoordinateMaps,
    Groups,
    MapSample,
    mixed,
    place_of,
    seed_from,
    uniform,
    words_of,
)
from sl_nerfstudio.bundle_adjustment.residuals import Anchors, Observations, Residuals, Rig, array, pixels_of_rows
from sl_nerfstudio.geometry.devices import project, unproject, view_of
from sl_nerfstudio.geometry.lie import inverse, moved, rotate, transform
from sl_nerfstudio.geometry.numerics import (
    MAD_TO_SIGMA,
    geman_mcclure_cost,
    geman_mcclure_curvature,
    geman_mcclure_weight,
)
from sl_nerfstudio.geometry.triangulation import closest_approach
from sl_nerfstudio.parallel import compiled, compiled_range

_ENTRIES_AT_ONCE = 2**28  # pairs of an anchor and a frame: bounds memory, to a byte each
_TRIED_ANCHORS = 24  # of each frame, that show which frames see the same surface
_LEAST_SHARED = 2  # of those, both ways, for two frames to be partners

_STEP = 0.05  # pixels to either side, of differences that give normals
_LEAST_ALIKE = 0.7  # cosine between normals at the same place
NOISE_FLOOR_PX = 0.01  # smallest plausible noise of one look-up, pattern pixels
_FASTEST = 1.4  # largest factor by which a kernel narrows in one step
_ROUGHNESS_CLASSES = 16  # of look-ups, by how rough the coordinates are; each has its own noise
_LEAST_NOISE_RATIO = 0.5  # of such a class, relative to all look-ups
_BORDER_CLASSES = 8  # of look-ups, by the distance from the border of what was decoded
_MOST_BORDER_NOISE = 1.25  # of such a class, relative to all look-ups; beyond, it and those nearer to the border are
# left out: a decoder continues coordinates up to there, and errs alike in many frames

# Which frames decoded something near an anchor, and which of them look it up.


@compiled_range
def mark_visible(first, last, devices, images, frame, p_world, normal, centres, allowed, limits, visible):
    """visible[j, a]: whether frame j decoded something near anchor a, for frames first to last - 1.

    `images` are values and their PixelIndex; `centres` those of cameras and projectors [2, frames, 3]; `allowed[i, j]`
    whether frame j may look up anchors of frame i; `limits` the gate in pixels and the least cosine. Without a gate no
    coordinate is read.
    """
    _, T_camera_world, T_projector_camera, cameras, camera_code, projector, projector_code = devices
    values, (words, first_words, widths, heights) = images
    gate, least_cosine = limits
    for j in range(first, last):
        T, T_projector, camera = T_camera_world[j], T_projector_camera[j], cameras[j]
        w, h = widths[j], heights[j]
        for a in range(len(frame)):
            visible[j, a] = False
            if not allowed[frame[a], j]:
                continue
            p = p_world[a]
            if not _faces(normal[a], p, centres[0, j], centres[1, j], least_cosine):
                continue
            x, y, z = moved(T, p[0], p[1], p[2])
            view = view_of(camera_code, x, y, z, camera)
            u, v, in_front = view[0], view[1], view[2]
            if not (in_front and u >= 0 and v >= 0 and u < w and v < h):
                continue
            place = place_of(words, first_words[j] + int(v) * words_of(w), int(u))
            if place < 0:
                continue
            x, y, z = moved(T_projector, x, y, z)
            expected = view_of(projector_code, x, y, z, projector)
            if gate < np.inf:
                value = values[place]
                visible[j, a] = expected[2] and np.hypot(value[0] - expected[0], value[1] - expected[1]) < gate
            else:
                visible[j, a] = expected[2]


@compiled
def _faces(normal, p, camera, projector, least_cosine):
    """Whether both devices are in front of a surface, and neither sees it too obliquely."""
    length = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    for k in range(2):
        centre = camera if k == 0 else projector
        x, y, z = centre[0] - p[0], centre[1] - p[1], centre[2] - p[2]
        along = normal[0] * x + normal[1] * y + normal[2] * z
        if not along > least_cosine * np.sqrt(length * (x * x + y * y + z * z)):
            return False
    return True


@compiled_range
def count_chosen(first, last, visible, most, counts):
    """How many frames look up each anchor."""
    for a in range(first, last):
        total = 0
        for j in range(visible.shape[0]):
            total += visible[j, a]
        counts[a] = min(total, most)


@compiled_range
def choose_frames(first, last, visible, starts, seed, number, frames):
    """Choose as many frames as `starts` leaves room for, at random among those that see an anchor, in order.

    Selection sampling (Knuth, The Art of Computer Programming 2, algorithm S); `number` identifies each anchor.
    """
    for a in range(first, last):
        at, end, left = starts[a], starts[a + 1], 0
        for j in range(visible.shape[0]):
            left += visible[j, a]
        bits = mixed(seed, number[a])
        for j in range(visible.shape[0]):
            if at == end:
                break
            if visible[j, a]:
                bits = mixed(bits, j)
                if uniform(bits) * left < end - at:
                    frames[at] = j
                    at += 1
                left -= 1


def place_anchors(rig: Rig, maps: CoordinateMaps, per_frame: int, generator: torch.Generator) -> Anchors:
    """Random decoded pixels whose neighbourhood is smooth and whose rays meet in front of both devices."""
    frame, uv = maps.draw(torch.arange(rig.frames), per_frame, generator)
    anchors, good = anchors_at(rig, frame, uv, maps.look_up(frame, uv))
    return anchors.chosen(good)


def anchors_at(
    rig: Rig, frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"], seen: MapSample
) -> tuple[Anchors, Bool[Tensor, "n"]]:
    """Anchors at decoded pixels; whether the neighbourhood is smooth and the rays meet in front of both devices.

    `seen` is what was decoded there.
    """
    return anchors_on(rig, frame, seen, surface_rays(rig, frame, uv, seen))


def anchors_on(
    rig: Rig, frame: Int[Tensor, "n"], seen: MapSample, rays: tuple[Float[Tensor, "5 n 3"], Float[Tensor, "5 n 3"]]
) -> tuple[Anchors, Bool[Tensor, "n"]]:
    """Anchors at decoded pixels, by their `surface_rays`; whether these can be used, as `anchors_at` has it."""
    p, normal, good = _surface(rig, frame, rays)
    depth = p.norm(dim=-1)
    return Anchors(frame, p / depth[:, None], seen.uv_projector, depth, normal, seen.roughness), seen.valid & good


def with_common_normals(rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps) -> Anchors:
    """Anchors with the mean of the normals that all frames show there: their own, and those that look them up.

    Derivatives of residuals depend on normals. Their noise looks like information (errors in variables: Fuller, 1987):
    a step along a direction in which the surface slides would be a hundredth of what it should be. So normals are means
    over frames, and of windows that are wider than those of single look-ups.
    """
    own_uv, (uv, _) = project(rig.camera[anchors.frame], anchors.d_camera)[0], pixels_of_rows(rig, anchors, rows)
    frame = torch.cat([anchors.frame, rows.frame])
    seen = maps.for_normals.look_up(frame, torch.cat([own_uv, uv]))
    _, normal, good = _surface(rig, frame, surface_rays(rig, frame, torch.cat([own_uv, uv]), seen))
    good &= seen.valid
    normal = rotate(rig.T_world_camera[frame], normal)
    count = len(anchors.frame)
    narrow = rotate(rig.T_world_camera[anchors.frame], anchors.normal)
    own = torch.where(good[:count, None], normal[:count], narrow)
    theirs, at = normal[count:], own[rows.anchor]
    alike = good[count:] & ((theirs * at).sum(-1) > _LEAST_ALIKE)  # another one is that of another surface
    total = own.index_add(0, rows.anchor, torch.where(alike[:, None], theirs, torch.zeros_like(theirs)))
    total = torch.nn.functional.normalize(total, dim=-1)
    return replace(anchors, normal=rotate(inverse(rig.T_world_camera)[anchors.frame], total))


def surface_rays(
    rig: Rig, frame: Int[Tensor, "n"], uv: Float[Tensor, "n 2"], seen: MapSample
) -> tuple[Float[Tensor, "5 n 3"], Float[Tensor, "5 n 3"]]:
    """Rays of the camera and of the projector, each in its axes, through pixels and places to both sides of them.

    In the order: pixel; a little right and left of it; a little below and above it. They do not depend on poses.
    """
    at, theirs = [uv], [seen.uv_projector]
    for axis in range(2):
        step, change = _STEP * torch.eye(2, dtype=uv.dtype)[axis], _STEP * seen.jacobian[..., axis]
        at += [uv + step, uv - step]
        theirs += [seen.uv_projector + change, seen.uv_projector - change]
    return unproject(rig.camera[frame], torch.stack(at)), unproject(rig.projector, torch.stack(theirs))


def _surface(
    rig: Rig, frame: Int[Tensor, "n"], rays: tuple[Float[Tensor, "5 n 3"], Float[Tensor, "5 n 3"]]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3"], Bool[Tensor, "n"]]:
    """Points where `surface_rays` meet, normals towards the camera, in its axes; whether both devices see them."""
    points, _, good = _meeting(rig, frame, *rays)
    p, right, left, below, above = points
    normal = torch.nn.functional.normalize(torch.linalg.cross(right - left, below - above), dim=-1)
    return p, -normal * (normal * p).sum(-1, keepdim=True).sign(), good[0]


def in_front_of(rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps) -> Bool[Tensor, "rows"]:
    """Whether the surface that a camera sees where it looks an anchor up is nearer to it than the anchor is."""
    uv, _ = pixels_of_rows(rig, anchors, rows)
    seen, *_ = where_rays_meet(rig, rows.frame, uv, maps.look_up(rows.frame, uv, rows.memory).uv_projector)
    p_world = transform(rig.T_world_camera[anchors.frame], anchors.depth[:, None] * anchors.d_camera)[rows.anchor]
    return seen.norm(dim=-1) < (p_world - rig.T_world_camera[rows.frame, :3, 3]).norm(dim=-1)


def where_rays_meet(
    rig: Rig, frame: Int[Tensor, "n"], uv_camera: Float[Tensor, "n 2"], uv_projector: Float[Tensor, "n 2"]
) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n"], Bool[Tensor, "n"]]:
    """Points on camera rays nearest to their projector rays, in camera axes, and their depths along these.

    And whether they are in front of both devices.
    """
    return _meeting(rig, frame, unproject(rig.camera[frame], uv_camera), unproject(rig.projector, uv_projector))


def _meeting(
    rig: Rig, frame: Int[Tensor, "n"], d_camera: Float[Tensor, "*batch n 3"], d_projector: Float[Tensor, "*batch n 3"]
) -> tuple[Float[Tensor, "*batch n 3"], Float[Tensor, "*batch n"], Bool[Tensor, "*batch n"]]:
    """The same of rays, each in the axes of its device."""
    T = rig.T_camera_projector[frame]
    depth, depth_projector = closest_approach(torch.zeros_like(d_camera), d_camera, T[:, :3, 3], rotate(T, d_projector))
    return depth[..., None] * d_camera, depth, (depth > 0) & (depth_projector > 0)


def observe(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    per_anchor: int,
    gate_px: float,
    least_cosine: float,
    generator: torch.Generator,
    allowed: Bool[Tensor, "frames frames"] | None = None,
) -> Observations:
    """Choose for every anchor up to `per_anchor` other frames that decoded something near it, within `gate_px`.

    Frames whose camera or projector is behind the anchor's surface, or sees it at a cosine below `least_cosine`, are
    left out: they see, or light, another side of the object. `allowed[i, j]` says whether frame j may look up anchors
    of frame i; without it, every other frame may. Rows are ordered by anchor, then by frame.
    """
    allowed = every_other(rig.frames) if allowed is None else allowed
    seed, limits = seed_from(generator), (gate_px, least_cosine)
    parts = [
        _visible_rows(rig, anchors, maps, some, per_anchor, limits, allowed, seed)
        for some in _portions(len(anchors.frame), rig.frames)
    ]
    none = torch.zeros(0, dtype=torch.int64)
    return Observations(*(torch.cat([none, *part]) for part in ([p[k] for p in parts] for k in range(2))))


def away_from_borders(
    anchors: Anchors,
    rows: Observations,
    distances: tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]],
    least: float,
    frames: int,
) -> tuple[Anchors, Observations]:
    """Keep anchors and rows that are at least so many pixels from the border of what was decoded.

    `distances` are those of anchors in their own frame and of rows in the frame that looks up. Of frames of thin
    things, which are all border, the better half remains.
    """
    own, seen = distances
    limit = torch.full((frames,), least, dtype=own.dtype)
    for frame in range(frames):
        mine = own[anchors.frame == frame]
        if len(mine):
            limit[frame] = min(least, float(mine.median()))
    kept = own >= limit[anchors.frame]
    number = torch.cumsum(kept, 0) - 1
    chosen = kept[rows.anchor] & (seen >= limit[rows.frame])
    return anchors.chosen(kept), Observations(number[rows.anchor[chosen]], rows.frame[chosen])


def every_other(frames: int) -> Bool[Tensor, "frames frames"]:
    """Every frame may look up anchors of every other."""
    return ~torch.eye(frames, dtype=torch.bool)


def partners(
    rig: Rig, anchors: Anchors, maps: CoordinateMaps, most: int, least_cosine: float, generator: torch.Generator
) -> Bool[Tensor, "frames frames"]:
    """Choose for each frame about `most` others that see the same surface, at random; every other if there are few.

    Random partners hold the frames together better than neighbours do: no chain of frames is long.
    """
    n = rig.frames
    if n - 1 <= most:
        return every_other(n)
    groups = Groups.of(array(anchors.frame), n)
    tried = [groups.entries[first:last][:_TRIED_ANCHORS] for first, last in pairwise(groups.first)]
    some = anchors.chosen(torch.from_numpy(np.concatenate(tried)))
    shared = np.zeros((n, n))
    for part in _portions(len(some.frame), n):
        mine = some.chosen(part)
        visible = _visible(rig, mine, maps, (float("inf"), least_cosine), every_other(n))
        frame = array(mine.frame)  # ascends
        starts = np.flatnonzero(np.diff(frame, prepend=-1))
        shared[frame[starts]] += np.add.reduceat(visible, starts, axis=1, dtype=np.float64).T
    overlap = torch.from_numpy(shared + shared.T >= _LEAST_SHARED)
    rank = torch.where(overlap, torch.rand(n, n, generator=generator), torch.inf)
    half = (most + 1) // 2
    chosen = overlap & (rank <= rank.sort(1).values[:, half - 1 : half])
    return chosen | chosen.T


def _portions(anchors: int, frames: int) -> list[Int[Tensor, "_"]]:
    """Numbers of all anchors, as many at once as memory allows."""
    return list(torch.arange(anchors).split(max(_ENTRIES_AT_ONCE // frames, 1))) if anchors else []


def _visible_rows(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    number: Int[Tensor, "n"],
    per_anchor: int,
    limits: tuple[float, float],
    allowed: Bool[Tensor, "frames frames"],
    seed: int,
) -> tuple[Int[Tensor, "rows"], Int[Tensor, "rows"]]:
    """The rows of some anchors: numbers of anchors and frames."""
    n, counts = len(number), np.empty(len(number), dtype=np.int64)
    visible = _visible(rig, anchors.chosen(number), maps, limits, allowed)
    count_chosen(n, visible, per_anchor, counts)
    starts = np.concatenate([[0], np.cumsum(counts)])
    frames = np.empty(starts[-1], dtype=np.int64)
    choose_frames(n, visible, starts, seed, array(number), frames)
    return torch.repeat_interleave(number, torch.from_numpy(counts)), torch.from_numpy(frames)


def _visible(
    rig: Rig,
    anchors: Anchors,
    maps: CoordinateMaps,
    limits: tuple[float, float],
    allowed: Bool[Tensor, "frames frames"],
) -> Bool[ndarray, "frames anchors"]:
    """Which frames decoded something near which anchors."""
    p_world, normal = _in_world(rig, anchors)
    visible = np.empty((rig.frames, len(anchors.frame)), dtype=np.bool_)
    mark_visible(
        rig.frames, rig.arrays, maps.arrays, array(anchors.frame), array(p_world), array(normal), array(_centres(rig)),
        array(allowed), limits, visible,
    )  # fmt: skip
    return visible


def visible_rows(
    rig: Rig, anchors: Anchors, rows: Observations, maps: CoordinateMaps, least_cosine: float
) -> Bool[Tensor, "rows"]:
    """Whether frames decoded something at the anchors that they look up and face their surface, as `observe` asks."""
    uv, in_front = pixels_of_rows(rig, anchors, rows)
    seen = in_front & maps.decoded(rows.frame, uv)
    p_world, normal = (part[rows.anchor] for part in _in_world(rig, anchors))
    for centre in _centres(rig):
        towards = centre[rows.frame] - p_world
        seen &= (normal * towards).sum(-1) > least_cosine * towards.norm(dim=-1) * normal.norm(dim=-1)
    return seen


def _in_world(rig: Rig, anchors: Anchors) -> tuple[Float[Tensor, "anchors 3"], Float[Tensor, "anchors 3"]]:
    """Points and normals of anchors."""
    T = rig.T_world_camera[anchors.frame]
    return transform(T, anchors.depth[:, None] * anchors.d_camera), rotate(T, anchors.normal)


def _centres(rig: Rig) -> Float[Tensor, "2 frames 3"]:
    """Where cameras and projectors are."""
    return torch.stack([rig.T_world_camera[:, :3, 3], rig.T_world_projector[:, :3, 3]])


# The robust kernel: its width shrinks with the residuals (graduated non-convexity: Yang et al., RA-L 2020), separately
# for every frame. When most frames already fit, a frame that does not yet fit keeps a kernel wide enough to pull it in.


@dataclass(frozen=True)
class Kernel:
    """The Geman-McClure kernel, with a width for each frame; a gross error costs the same at any width."""

    width: Float[Tensor, "frames"]  # projector pixels
    frame: Int[Tensor, "anchors"]
    pair: Int[Tensor, "2 rows"]  # frame of the anchor, frame that looks it up
    ratios: tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]] | None = None  # see `noise_ratios`: as much wider

    @property
    def narrowest(self) -> float:
        """Width of the frames that fit best."""
        return float(self.width.min())

    def weights(self, r: Residuals) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]:
        """Weights of own and cross residuals, for the normal equations."""
        parts = []
        for value, width2 in zip((r.own, r.cross), self._squares(), strict=True):
            parts.append(self.narrowest**2 / width2 * geman_mcclure_weight((value * value).sum(-1) / width2))
        own, cross = parts
        return own, torch.where(r.cross_valid, cross, torch.zeros_like(cross))

    def curvature(self, r: Residuals) -> float:
        """Second derivative of the cost over what the weights make of it, all residuals together.

        Weighted normal equations take weights for constants, and so overrate what residuals say by the inverse of this
        (Huber, Robust Statistics, 1981, section 7.6).
        """
        own2, cross2 = self._squares()
        parts = (r.own, own2), (r.cross[r.cross_valid], cross2[r.cross_valid])
        squares = [((value * value).sum(-1) / width2, width2) for value, width2 in parts]
        true = sum(float((geman_mcclure_curvature(u) / width2).sum()) for u, width2 in squares)
        return true / sum(float((geman_mcclure_weight(u) / width2).sum()) for u, width2 in squares)

    def cost(self, r: Residuals, valid: Bool[Tensor, "rows"]) -> float:
        """The data's part of the objective, px^2; half of its gradient is that of the weighted normal equations."""
        own2, cross2 = self._squares()
        own = ((r.own**2).sum(-1), own2)
        cross = ((r.cross**2).sum(-1)[valid], cross2[valid])
        return self.narrowest**2 * sum(float(geman_mcclure_cost(r2 / w2).sum()) for r2, w2 in (own, cross))

    def _squares(self) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]:
        own, cross = self.width[self.frame], self.width[self.pair].amax(0)
        if self.ratios is not None:
            own, cross = own * self.ratios[0], cross * self.ratios[1]
        return own**2, cross**2


def frame_medians(r: Residuals, pair: Int[Tensor, "2 rows"], frames: int) -> Float[Tensor, "frames"]:
    """Lower median of the cross residuals that involve each frame; infinite if there are none."""
    size = np.tile(array(r.cross[r.cross_valid].norm(dim=-1)), 2)
    return _lower_medians(array(pair[:, r.cross_valid]).ravel(), size, frames)


def _lower_medians(group: Int64[ndarray, "n"], values: Float64[ndarray, "n"], count: int) -> Float[Tensor, "count"]:
    """Lower median of the values of each group; infinite if there are none."""
    groups, out = Groups.of(group, count), np.full(count, np.inf)
    values = values[groups.entries]
    for k, (first, last) in enumerate(pairwise(groups.first.tolist())):
        if last > first:
            middle = (last - first - 1) // 2
            out[k] = np.partition(values[first:last], middle)[middle]
    return torch.from_numpy(out)


def narrowed(width: Float[Tensor, "frames"], target: Float[Tensor, "frames"]) -> Float[Tensor, "frames"]:
    """Kernel widths one gradual step closer to a narrower target: a part of a frame may fit before all of it does."""
    gently = torch.where(width.isfinite(), width / _FASTEST, torch.zeros_like(width))
    return torch.minimum(width, torch.maximum(target, gently))


def noise_of(r: Residuals, width: float) -> float:
    """Robust 1 sigma of one residual component, from the residuals that the kernel keeps; pattern pixels."""
    inliers = r.cross_valid & (r.cross.norm(dim=-1) < 2 * width)
    values = r.cross[inliers].reshape(-1).abs()
    return max(float(values.median()) * MAD_TO_SIGMA, NOISE_FLOOR_PX)


def useful_distance(distance: Float[Tensor, "n"], size: Float[Tensor, "n"]) -> float:
    """Distance from the border of what was decoded from which on residuals are no larger than usual.

    Classes by distance hold equally many. Only those that are nearer than most are asked, so at most half fall away.
    """
    if not len(distance):
        return 0.0
    shares = np.linspace(0, 1, _BORDER_CLASSES + 1)[: _BORDER_CLASSES // 2 + 1]
    edges = np.quantile(array(distance), shares)
    most = _MOST_BORDER_NOISE * float(size.median().clamp_min(NOISE_FLOOR_PX))
    for low, high in reversed(list(pairwise(edges.tolist()))):
        mine = (distance >= low) & (distance < high)
        if mine.any() and float(size[mine].median()) > most:
            return high
    return 0.0


def noise_ratios(
    r: Residuals, roughness: Float[Tensor, "anchors"], anchor: Int[Tensor, "rows"]
) -> tuple[Float[Tensor, "anchors"], Float[Tensor, "rows"]]:
    """Noise of own and of cross residuals over that of all cross residuals, from those with coordinates as rough.

    How far the pixels of a window are from a paraboloid (`roughness` of the anchors, `r.roughness` of what is looked
    up, at `anchor`) shows the noise of decoding, and edges and grooves, over which a decoder smooths. A cross residual
    has the errors of two windows, an own one those of one. Classes hold equally many look-ups.
    """
    rough = torch.hypot(roughness[anchor], r.roughness)
    size, known = r.cross.norm(dim=-1), r.cross_valid & rough.isfinite()
    if not known.any():
        return torch.ones_like(roughness), torch.ones_like(size)
    shares = np.linspace(0, 1, _ROUGHNESS_CLASSES + 1)[1:-1]
    edges = torch.from_numpy(np.quantile(array(rough[known]), shares))
    group, usual = torch.bucketize(rough, edges), size[known].median().clamp_min(NOISE_FLOOR_PX)
    ratio = _lower_medians(array(group[known]), array(size[known]), _ROUGHNESS_CLASSES) / usual
    ratio = torch.where(ratio.isfinite(), ratio, 1.0).clamp_min(_LEAST_NOISE_RATIO)
    return ratio[torch.bucketize(2**0.5 * roughness, edges)], ratio[group]

"""How complete a surface is of what the frames decoded, where it ends, and which capture would add most."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from sl_nerfstudio.console import track
from sl_nerfstudio.evaluation.agreement import CaptureAgreement
from sl_nerfstudio.evaluation.mesh_index import CaptureView, IndexedMesh, faces_and_falls_inside
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA, component_labels
from sl_nerfstudio.geometry.triangulation import world_pixels
from sl_nerfstudio.meshing.mesh import Mesh

# Openings of a mesh: where its surface ends. Every real object is closed, so behind each of them something lacks.

_SMOOTHING = 8  # steps, each over one edge: jags are one edge wide


@dataclass(frozen=True)
class Openings:
    """The connected borders of a mesh, the largest area first; lengths in the mesh's unit."""

    area: Float[ndarray, "n"]  # as seen along the normal
    length: Float[ndarray, "n"]  # of the border, smoothed: triangles make it jagged
    centre: Float[ndarray, "n 3"]
    normal: Float[ndarray, "n 3"]  # unit, outward: where somebody stands who looks into the opening
    fan: Float[ndarray, "m 3 3"]  # corners of all closing triangles, counter-clockwise as seen from outside
    opening: Int[ndarray, "m"]  # of each closing triangle

    def __len__(self) -> int:
        return len(self.area)

    def closing_mesh(self) -> Mesh:
        """The closing triangles, in the order of `fan`."""
        corners = self.fan.reshape(-1, 3)
        return Mesh(corners, np.arange(len(corners)).reshape(-1, 3))


def find_openings(mesh: Mesh) -> Openings:
    """Find all borders of the mesh; those that meet in a vertex count as one."""
    start, end = _border(mesh)
    label = component_labels(start, end, len(mesh.vertices))[start]
    _, label = np.unique(label, return_inverse=True)
    count = int(label.max()) + 1 if len(label) else 0
    a, b = mesh.vertices[start], mesh.vertices[end]
    edge = np.linalg.norm(b - a, axis=1)
    total = np.maximum(np.bincount(label, edge, count), 1e-300)
    centre = _sums(label, (a + b) / 2 * edge[:, None], count) / total[:, None]
    fan = np.stack([b, a, centre[label]], 1)  # against the direction of the faces beside the border
    cross = np.cross(fan[:, 1] - fan[:, 0], fan[:, 2] - fan[:, 0]) / 2
    normal = _sums(label, cross, count)
    area = np.linalg.norm(normal, axis=1)
    normal /= np.maximum(area, 1e-300)[:, None]
    order = np.argsort(-area, kind="stable")
    rank = np.argsort(order)
    smooth = _smoothed(mesh.vertices, start, end)
    length = np.bincount(label, np.linalg.norm(smooth[end] - smooth[start], axis=1), count).astype(np.float64)
    return Openings(area[order], length[order], centre[order], normal[order], fan, rank[label])


def _border(mesh: Mesh) -> tuple[Int[ndarray, "e"], Int[ndarray, "e"]]:
    """Edges of one triangle only, in the direction of its corners."""
    start, end = mesh.faces.ravel(), np.roll(mesh.faces, -1, axis=1).ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    _, which, uses = np.unique(low * len(mesh.vertices) + high, return_inverse=True, return_counts=True)
    single = uses[which] == 1
    return start[single], end[single]


def _smoothed(
    vertices: Float[ndarray, "v 3"], start: Int[ndarray, "e"], end: Int[ndarray, "e"]
) -> Float[ndarray, "v 3"]:
    """Vertices on borders, each moved to the middle of its neighbours along the border, a few times."""
    count = np.bincount(np.concatenate([start, end]), minlength=len(vertices))
    some = count > 0
    out = vertices.copy()
    for _ in range(_SMOOTHING):
        sums = _sums(np.concatenate([start, end]), np.concatenate([out[end], out[start]]), len(vertices))
        out[some] = 0.5 * (out[some] + sums[some] / count[some, None])
    return out


def _sums(label: Int[ndarray, "e"], values: Float[ndarray, "e 3"], count: int) -> Float[ndarray, "n 3"]:
    return np.stack([np.bincount(label, values[:, k], count) for k in range(3)], 1).astype(np.float64)


_LEAST_NOISE_PX = 0.1  # pattern pixels: no decoding is better


@dataclass(frozen=True)
class Completeness:
    """What the surface has and lacks; lengths in the scan's unit."""

    observed: float  # share of what the frames decoded that the surface has
    surface_area: float
    openings: Openings
    noise_px: float  # of the decoding, 1 sigma, pattern pixels

    @property
    def rim_area(self) -> float:
        """Area of the largest opening: where the scan as a whole ends, for instance below."""
        return float(self.openings.area[:1].sum())

    @property
    def hole_share(self) -> float:
        """Area of all openings but the largest, relative to the surface's."""
        return float(self.openings.area[1:].sum()) / self.surface_area


def assess_completeness(surface: IndexedMesh, agreement: CaptureAgreement) -> Completeness:
    """What the surface has of what was decoded, and where it ends."""
    decoded = np.array([frame.pixels * frame.decoded_share for frame in agreement.frames])
    missing = float((decoded * [frame.hole_share for frame in agreement.frames]).sum())
    observed = 1 - missing / decoded.sum() if decoded.sum() else float("nan")
    noise = max(MAD_TO_SIGMA * float(np.nan_to_num(agreement.epipolar_px_median)), _LEAST_NOISE_PX)
    return Completeness(observed, surface.area, find_openings(surface.mesh), noise)


# How well each place of a surface is known from the frames that see it, and what one more frame would add.
#
# A place of the surface that no frame sees may lie anywhere within the size of the opening; a frame that sees it
# determines it to the decoding noise, divided by the pattern pixels per length along its ray. Information (1 /
# variance) adds up.

_LEAST_COSINE = 0.2  # between normal and ray of either device: what is seen at a flatter angle is hardly decoded
_SEED = 0


@dataclass(frozen=True)
class Places:
    """Points spread evenly over a surface and over what closes its openings."""

    points: Float[ndarray, "n 3"]
    normals: Float[ndarray, "n 3"]
    area: Float[ndarray, "n"]  # that each point stands for
    doubt: Float[ndarray, "n"]  # 1 sigma of a place that no frame sees: the size of its opening, or of the surface
    opening: Int[ndarray, "n"]  # number of the opening, -1 on the surface


def occluders(surface: IndexedMesh, openings: Openings) -> list[IndexedMesh]:
    """The surface and what closes its openings: whoever looks through an opening sees no inner side."""
    return [surface, IndexedMesh(openings.closing_mesh())] if len(openings.fan) else [surface]


def places(surface: IndexedMesh, openings: Openings, count: int) -> Places:
    """About `count` places on the surface and as many on its openings."""
    points, normals = surface.sample(count, _SEED)
    area = np.full(count, surface.area / count)
    found = Places(points, normals, area, np.full(count, surface.diagonal), np.full(count, -1))
    wide = openings.area > 0
    if not wide.any():
        return found
    share = np.where(wide[openings.opening], openings.closing_mesh().face_areas(), 0.0)
    rng = np.random.default_rng(_SEED)
    triangle = rng.choice(len(share), count, p=share / share.sum())
    weights = rng.dirichlet(np.ones(3), count)
    where = np.einsum("nk,nkd->nd", weights, openings.fan[triangle])
    opening = openings.opening[triangle]
    per_opening = np.maximum(np.bincount(opening, minlength=len(openings)), 1)
    return Places(
        np.concatenate([points, where]),
        np.concatenate([normals, openings.normal[opening]]),
        np.concatenate([area, (openings.area / per_opening)[opening]]),
        np.concatenate([found.doubt, np.sqrt(openings.area / np.pi)[opening]]),
        np.concatenate([found.opening, opening]),
    )


def information(at: Places, hiding: Sequence[IndexedMesh], view: CaptureView, noise_px: float) -> Float[ndarray, "n"]:
    """What a view adds to the knowledge of each place along its normal, 1 / length^2; 0 where it does not see it."""
    index = np.arange(len(at.points))
    for device, T in view.devices:
        inside = faces_and_falls_inside(at.points[index], at.normals[index], device, T)
        index = index[inside & (_cosine(at.points[index], at.normals[index], T) > _LEAST_COSINE)]
    for (_, T), mesh in product(view.devices, hiding):
        index = index[~mesh.occluded(at.points[index], T[:3, 3])]
    out = np.zeros(len(at.points))
    cosine = _cosine(at.points[index], at.normals[index], view.T_world_camera)
    out[index] = cosine * (_pattern_px_per_length(at.points[index], view) / noise_px) ** 2
    return out


def known(
    at: Places, hiding: Sequence[IndexedMesh], views: Sequence[CaptureView], noise_px: float
) -> Float[ndarray, "n"]:
    """Information about each place from all views and from the size of what is not seen."""
    return sum((information(at, hiding, view, noise_px) for view in views), start=1 / at.doubt**2)


def _pattern_px_per_length(points: Float[ndarray, "n 3"], view: CaptureView) -> Float[ndarray, "n"]:
    """Measure how far the pattern moves under a point that moves along its camera ray."""
    eye = view.T_world_camera[:3, 3]
    step = 1e-4 * (points - eye)
    uv = [world_pixels(view.projector, view.T_world_projector, points + side * step)[0] for side in (-0.5, 0.5)]
    return np.linalg.norm(uv[1] - uv[0], axis=1) / np.linalg.norm(step, axis=1)


def _cosine(
    points: Float[ndarray, "n 3"], normals: Float[ndarray, "n 3"], T: Float[ndarray, "4 4"]
) -> Float[ndarray, "n"]:
    way = T[:3, 3] - points
    return (way * normals).sum(1) / np.maximum(np.linalg.norm(way, axis=1), 1e-300)


# The capture that would reduce what is not known of a surface most: a search over views from all directions.

_PLACES, _DIRECTIONS, _TURNS = 600, 48, 4
_STILL = 0.01  # of the usual baseline: a projector that moves less stands still
_UPRIGHT = 0.5  # length of the mean of all cameras' upward axes from which there is an up


@dataclass(frozen=True)
class NextView:
    """The capture that would add most; lengths in the scan's unit."""

    T_world_camera: Float[ndarray, "4 4"]
    T_world_projector: Float[ndarray, "4 4"]
    new_area: float  # that it would see and no frame saw
    unseen_area: float  # that no frame saw: weakly known places of the surface, and openings
    opening: int  # the one of which it sees most, -1: none
    removed: float  # share of the doubt (variance, summed over the area) that it would remove
    nearest: int  # number of the frame whose direction is nearest
    nearest_deg: float  # between the two directions
    elevation_deg: float  # above the horizon; NaN where the cameras do not say what is up


def next_view(
    surface: IndexedMesh, openings: Openings, frames: Sequence[CaptureView], noise_px: float
) -> NextView | None:
    """The best of some hundred views as far away as the frames are; None if none would add anything.

    The projector is held as in the frame with the usual distance from the camera, or where it stands, if it stands
    still. `noise_px` is the decoding's, in pattern pixels. Nothing is known here about what is in a tripod's way.
    """
    at, hiding = places(surface, openings, _PLACES), occluders(surface, openings)
    poses = DevicePoses(np.stack([f.T_world_camera for f in frames]), np.stack([f.T_world_projector for f in frames]))
    before = known(at, hiding, frames, noise_px)
    doubt = at.area / before
    best, most = None, 0.0
    for view in track(list(_candidates(surface, openings, frames, poses)), "what to capture next"):
        added = information(at, hiding, view, noise_px)
        removed = float((doubt - at.area / (before + added)).sum())
        if removed > most:
            best, most = (view, added), removed
    return None if best is None else _described(*best, most / float(doubt.sum()), at, before, surface, poses)


def _described(
    view: CaptureView, added: Float[ndarray, "n"], removed: float, at: Places, before: Float[ndarray, "n"],
    surface: IndexedMesh, poses: DevicePoses,
) -> NextView:  # fmt: skip
    unseen = before <= 1 / at.doubt**2
    seen = np.bincount(at.opening[unseen & (added > 0)] + 1, minlength=1)
    seen[0] = 0
    way = _unit(view.T_world_camera[:3, 3] - surface.centre)
    ways = _unit(poses.T_world_camera[:, :3, 3] - surface.centre)
    angle = np.degrees(np.arccos(np.clip(ways @ way, -1, 1)))
    up = poses.T_world_camera[:, :3, 1].mean(0)
    upright = float(np.linalg.norm(up))
    elevation = float(np.degrees(np.arcsin(np.clip(way @ up / upright, -1, 1)))) if upright > _UPRIGHT else float("nan")
    return NextView(
        view.T_world_camera,
        view.T_world_projector,
        new_area=float(at.area[unseen & (added > 0)].sum()),
        unseen_area=float(at.area[unseen].sum()),
        opening=int(seen.argmax()) - 1 if seen.any() else -1,
        removed=removed,
        nearest=int(angle.argmin()),
        nearest_deg=float(angle.min()),
        elevation_deg=elevation,
    )


def _candidates(
    surface: IndexedMesh, openings: Openings, frames: Sequence[CaptureView], poses: DevicePoses
) -> Iterator[CaptureView]:
    """Views from directions all around and from in front of the openings, each turned about its axis in four ways."""
    positions = poses.T_world_camera[:, :3, 3]
    distance = float(np.median(np.linalg.norm(positions - surface.centre, axis=1)))
    usual = int(np.argsort(poses.baseline)[len(frames) // 2])
    relative = np.linalg.inv(poses.T_world_camera[usual]) @ poses.T_world_projector[usual]
    moved = np.linalg.norm(np.ptp(poses.T_world_projector[:, :3, 3], axis=0))
    still = len(frames) > 1 and moved < _STILL * float(np.median(poses.baseline))
    for direction in np.concatenate([_sphere(_DIRECTIONS), openings.normal[:_TURNS]]):
        if not direction.any():
            continue
        for turn in range(_TURNS):
            T = _looking_at(surface.centre, direction, distance, turn * 2 * np.pi / _TURNS)
            at_projector = frames[usual].T_world_projector if still else T @ relative
            yield CaptureView(frames[usual].camera, T, frames[usual].projector, at_projector)


def _looking_at(
    centre: Float[ndarray, "3"], direction: Float[ndarray, "3"], distance: float, turn: float
) -> Float[ndarray, "4 4"]:
    """A camera at `centre + distance * direction` that looks back (along -z), turned about its axis."""
    z = direction
    side = np.cross([0.0, 0.0, 1.0], z) if abs(z[2]) < 0.95 else np.cross([0.0, 1.0, 0.0], z)
    x = _unit(side)
    y = np.cross(z, x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1] = np.cos(turn) * x + np.sin(turn) * y, np.cos(turn) * y - np.sin(turn) * x
    T[:3, 2], T[:3, 3] = z, centre + distance * z
    return T


def _sphere(count: int) -> Float[ndarray, "n 3"]:
    """Directions spread evenly over the sphere (Fibonacci lattice)."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(angle), r * np.sin(angle), z], 1)


def _unit(v: Float[ndarray, "*n 3"]) -> Float[ndarray, "*n 3"]:
    return v / np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-300)

"""The capture that would reduce what is not known of a surface most: a search over views from all directions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from sl_nerfstudio.evaluation.completeness.knowledge import Occluders, Places, View, information, known, places
from sl_nerfstudio.evaluation.completeness.openings import Openings
from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh
from sl_nerfstudio.geometry.device_poses import DevicePoses
from sl_nerfstudio.progress import track

_PLACES, _DIRECTIONS, _TURNS = 600, 48, 4
_STILL = 0.01  # of the usual baseline: a projector that moves less stands still
_UPRIGHT = 0.5  # length of the mean of all cameras' upward axes from which there is an up


@dataclass(frozen=True)
class NextView:
    """Where to capture next; lengths in the scan's unit."""

    T_world_camera: Float[ndarray, "4 4"]
    T_world_projector: Float[ndarray, "4 4"]
    new_area: float  # that it would see and no frame saw
    unseen_area: float  # that no frame saw: weakly known places of the surface, and openings
    opening: int  # the one of which it sees most, -1: none
    removed: float  # share of the doubt (variance, summed over the area) that it would remove
    nearest: int  # number of the frame whose direction is nearest
    nearest_deg: float  # between the two directions
    elevation_deg: float  # above the horizon; NaN where the cameras do not say what is up


def next_view(surface: IndexedMesh, openings: Openings, frames: Sequence[View], noise_px: float) -> NextView | None:
    """The best of some hundred views as far away as the frames are; None if none would add anything.

    The projector is held as in the frame with the usual distance from the camera, or where it stands, if it stands
    still. `noise_px` is the decoding's, in pattern pixels. Nothing is known here about what is in a tripod's way.
    """
    at, occluders = places(surface, openings, _PLACES), Occluders(surface, openings)
    poses = DevicePoses(
        *(np.stack(T) for T in zip(*((f.T_world_camera, f.T_world_projector) for f in frames), strict=True))
    )
    before = known(at, occluders, frames, noise_px)
    doubt = at.area / before
    best, most = None, 0.0
    for view in track(list(_candidates(surface, openings, frames, poses)), "what to capture next"):
        added = information(at, occluders, view, noise_px)
        removed = float((doubt - at.area / (before + added)).sum())
        if removed > most:
            best, most = (view, added), removed
    return None if best is None else _described(*best, most / float(doubt.sum()), at, before, surface, poses)


def _described(
    view: View, added: Float[ndarray, "n"], removed: float, at: Places, before: Float[ndarray, "n"],
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


def _candidates(surface: IndexedMesh, openings: Openings, frames: Sequence[View], poses: DevicePoses) -> Iterator[View]:
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
            yield View(frames[usual].camera, T, frames[usual].projector, at_projector)


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

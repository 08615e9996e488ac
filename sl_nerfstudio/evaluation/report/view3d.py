"""What the interactive views of the reports show, as data for their script: surfaces, colours, and devices."""

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Float, Float64, Int, UInt8
from numpy import ndarray
from scipy.spatial import KDTree

from sl_nerfstudio.console import unit_word
from sl_nerfstudio.evaluation.mesh_index import IndexedMesh, faces_and_falls_inside
from sl_nerfstudio.evaluation.report.charts import (
    CLAY,
    ColourLayer,
    ColourScale,
    OrthographicView,
    data_uri,
    render,
    render_discs,
)
from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.geometry.lie import DevicePoses
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.geometry.triangulation import OUTLINE, beside, frustum, world_pixels
from sl_nerfstudio.late_imports import open3d as o3d
from sl_nerfstudio.meshing.finish import simplified
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.processing.scan_poses import PlacedFrame, PlacedGroup
from sl_nerfstudio.scan import Scan

CAMERA_COLOUR, PROJECTOR_COLOUR = "#2563a8", "#c2571a"
UNDECIDED_COLOUR, MISSING_COLOUR = "#d99a00", "#1d7a46"
MOST_TRIANGLES = 40_000  # about 1 MB in the page
KNOWN_DISTANCE = "distance between frame {} ({}, {}) and frame {} ({}, {}) = {} {}"  # as --known-length takes it
_FRUSTUM = 0.18  # length of a pyramid, of the median distance between devices and object
_STOPS = 256  # colours of a scale
STILL = (560, 900)  # height and width of the picture, pixels


def packed(values: ndarray, kind: str) -> str:
    """Numbers as the bytes of a little-endian type, in base64."""
    return base64.b64encode(np.ascontiguousarray(values, np.dtype(kind).newbyteorder("<")).tobytes()).decode()


@dataclass(frozen=True)
class ShownSurface:
    """Triangles, or discs where there are none, and what is known of their points."""

    points: Float64[ndarray, "v 3"]
    normals: Float64[ndarray, "v 3"]
    names: Sequence[str]  # of the frames
    frame: Int[ndarray, "v"]  # in which each point was decoded, index into the names; -1: in none
    uv: Float[ndarray, "v 2"]  # pixel of its photograph
    layers: Sequence[ColourLayer] = ()
    faces: Int[ndarray, "f 3"] | None = None
    radius: float = 0.0  # of the discs
    colour: UInt8[ndarray, "v 3"] | None = None  # the object's own
    sigma: Float[ndarray, "v"] | None = None  # of the points, 1 sigma along the normal


@dataclass(frozen=True)
class DrawnDevices:
    """Devices that are drawn as pyramids of one colour."""

    colour: str
    devices: Sequence[Device]
    T_world_device: Float64[ndarray, "n 4 4"]
    labels: Sequence[tuple[str, str]] = ()  # for each, what is written at its centre, and said where the pointer is

    def document(self, length: float, origin: Float64[ndarray, "3"]) -> dict[str, Any]:
        """Pyramids of some length as segments, about an origin."""
        drawn = [frustum(device, T, length) for device, T in zip(self.devices, self.T_world_device, strict=True)]
        lines = np.array(drawn).reshape(-1, 8, 3)[:, OUTLINE] - origin
        at = zip(self.labels, (self.T_world_device[:, :3, 3] - origin).tolist(), strict=False)
        return {
            "rgb": [int(self.colour[k : k + 2], 16) / 255 for k in (1, 3, 5)],
            "lines": packed(np.stack([lines[:, :-1], lines[:, 1:]], 2), "f4"),
            "labels": [{"text": text, "title": title, "at": place} for (text, title), place in at],
        }


def _group(
    name: str, surface: ShownSurface, devices: Sequence[DrawnDevices], T_world_camera: Float64[ndarray, "n 4 4"]
) -> dict[str, Any]:
    """One choice of the view: a surface with its devices. Positions are about an origin in the middle of the object."""
    lower, upper = np.percentile(surface.points, (1, 99) if surface.faces is None else (0, 100), axis=0)
    origin = (lower + upper) / 2
    towards, up = first_direction(T_world_camera, origin)
    length = _FRUSTUM * float(np.median(np.linalg.norm(T_world_camera[:, :3, 3] - origin, axis=1)))
    about = np.linalg.norm(surface.points - origin, axis=1)
    return {
        "name": name,
        "origin": origin.tolist(), "towards": towards.tolist(), "up": up.tolist(),
        "reach": float(np.percentile(about, 98 if surface.faces is None else 100)) or 1.0,
        "points": packed(surface.points - origin, "f4"),
        "normals": packed(np.rint(127 * np.nan_to_num(surface.normals)), "i1"),
        "faces": None if surface.faces is None else packed(surface.faces, "u4"),
        "radius": surface.radius,
        "colour": None if surface.colour is None else packed(surface.colour, "u1"),
        "layers": [_layer(layer) for layer in surface.layers],
        "sigma": None if surface.sigma is None else packed(surface.sigma, "f4"),
        "names": list(surface.names),
        "frame": packed(surface.frame, "i2"),
        "uv": packed(surface.uv, "f4"),
        "devices": [one.document(length, origin) for one in devices],
    }  # fmt: skip


def _label(name: str, numbers: dict[str, int]) -> tuple[str, str]:
    return str(numbers[name]), f"camera of frame {numbers[name]}: {name}"


def _layer(layer: ColourLayer) -> dict[str, Any]:
    scale = layer.scale
    colours = scale(np.linspace(scale.lower, scale.upper, _STOPS))
    return {
        "name": layer.name, "units": unit_word(layer.units), "lower": scale.lower, "upper": scale.upper,
        "gradient": scale.css_gradient(), "values": packed(layer.values, "f4"),
        "table": packed(np.rint(255 * colours), "u1"),
    }  # fmt: skip


@dataclass(frozen=True)
class View:
    """An interactive view for a page."""

    scene: str  # JSON for a <script> element
    still: str  # data address of a picture of its object

    @staticmethod
    def of(units: str, groups: Sequence[dict[str, Any]], still: Float[ndarray, "h w 3"]) -> "View":
        """The view of some groups, of which the first one is shown."""
        scene = {"units": unit_word(units), "clay": list(CLAY), "knownDistance": KNOWN_DISTANCE, "groups": groups}
        return View(json.dumps(scene, allow_nan=False).replace("<", "\\u003c"), data_uri(still, 90))


def first_direction(
    T_world_camera: Float64[ndarray, "n 4 4"], centre: Float64[ndarray, "3"]
) -> tuple[Float64[ndarray, "3"], Float64[ndarray, "3"]]:
    """Look from beside the first of the cameras; up is the cameras' up. Both are unit directions."""
    up = T_world_camera[:, :3, 1].mean(0)
    if np.linalg.norm(up) < 0.1:  # cameras held in every orientation
        up = T_world_camera[0, :3, 1]
    towards = T_world_camera[0, :3, 3] - centre
    direction = beside(towards if np.linalg.norm(towards) > 0 else T_world_camera[0, :3, 2], up)
    return direction, up / np.linalg.norm(up)


# The surface of an evaluated mesh.


def decimated(mesh: Mesh, most: int = MOST_TRIANGLES) -> tuple[Mesh, ndarray]:
    """The mesh reduced to about `most` triangles, and for each of its vertices the nearest one of the original."""
    if len(mesh.faces) <= most:
        return mesh, np.arange(len(mesh.vertices))

    def simplify(plain: o3d.geometry.TriangleMesh) -> o3d.geometry.TriangleMesh:
        if len(mesh.faces) > 5 * most:  # first a coarse pass: precise decimation of a million triangles takes 10 s
            cell = float(np.sqrt(mesh.face_areas().sum() / most)) / float(np.ptp(mesh.vertices, axis=0).max())
            plain = plain.simplify_vertex_clustering(cell, o3d.geometry.SimplificationContraction.Average)
        return plain.simplify_quadric_decimation(most)

    small, used = simplified(mesh, simplify), np.unique(mesh.faces)
    return small, used[np.asarray(KDTree(mesh.vertices[used]).query(small.vertices)[1])]


def mesh_scene(
    surface: IndexedMesh,
    layers: Sequence[ColourLayer],
    scan: Scan,
    poses: DevicePoses,
    numbers: dict[str, int],
    sigma: Float[ndarray, "v"] | None = None,
    colour: UInt8[ndarray, "v 3"] | None = None,
) -> View:
    """View a mesh with cameras and projectors; layers, `sigma` and `colour` are of its vertices.

    `numbers` are the frames' places among all captures.
    """
    small, nearest = decimated(surface.mesh)
    normals = surface.mesh.vertex_normals()[nearest]
    shown = ShownSurface(
        small.vertices,
        normals,
        [frame.name for frame in scan.frames],
        *decoded_at(surface, small.vertices, normals, scan, poses),
        [ColourLayer(one.name, one.values[nearest], one.scale, one.units) for one in layers],
        small.faces,
        colour=None if colour is None else colour[nearest],
        sigma=None if sigma is None else sigma[nearest],
    )
    labels = [_label(frame.name, numbers) for frame in scan.frames]
    devices = [
        DrawnDevices(CAMERA_COLOUR, [frame.camera for frame in scan.frames], poses.T_world_camera, labels),
        DrawnDevices(PROJECTOR_COLOUR, [scan.projector] * len(scan.frames), poses.T_world_projector),
    ]
    view = OrthographicView(*first_direction(poses.T_world_camera, surface.centre))
    still = render(surface, view, None if colour is None else colour / 255.0, *STILL)
    return View.of(scan.units, [_group("surface", shown, devices, poses.T_world_camera)], still)


def decoded_at(
    surface: IndexedMesh,
    points: Float64[ndarray, "n 3"],
    normals: Float64[ndarray, "n 3"],
    scan: Scan,
    poses: DevicePoses,
) -> tuple[Int[ndarray, "n"], Float64[ndarray, "n 2"]]:
    """Of the frames that see a point of the surface, and decoded the pixel, the one that looks at it most directly.

    Its number, -1 if there is none, and the pixel of its photograph.
    """
    frame, uv, best = np.full(len(points), -1), np.zeros((len(points), 2)), np.zeros(len(points))
    for k, one in enumerate(scan.frames):
        T = poses.T_world_camera[k]
        towards = T[:3, 3] - points
        facing = (towards * normals).sum(1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-300)
        left = np.flatnonzero((facing > best) & faces_and_falls_inside(points, normals, one.camera, T))
        pixel = world_pixels(one.camera, T, points[left])[0]
        column, row = np.floor(pixel).astype(np.int64).T
        decoded = all_finite(one.read_coords()[row, column])
        left, pixel = left[decoded], pixel[decoded]
        seen = ~surface.occluded(points[left], T[:3, 3])
        left, pixel = left[seen], pixel[seen]
        frame[left], uv[left], best[left] = k, pixel, facing[left]
    return frame, uv * scan.shrunk_by


# The points of registered frames, one group of frames at a time.

_MOST_DISCS = 60_000  # about 1.5 MB in the page
_NEIGHBOURS = 25  # points, of whichever frames, that make the plane at one of them
_DISC = 1.0  # radius of the discs, of the usual distance to the eighth neighbour: they overlap


def placed_scene(
    groups: Sequence[PlacedGroup],
    units: str,
    undecided: Sequence[str],
    missing: Sequence[tuple[str, str]],
    numbers: dict[str, int],
    shrink: int = 1,
) -> View:
    """View the points and devices of a group of frames, with a choice of the groups.

    `undecided` are frames whose poses are not certain; `missing` are pairs between which a frame should be added;
    `numbers` are the frames' places among all captures; `shrink` is the size of a pixel in the photographs.
    """
    drawn, still = [], None
    for group in groups:
        cameras = np.array([frame.T_world_camera for frame in group.frames])
        surface = placed_surface(group, numbers, shrink)
        if still is None:
            view = OrthographicView(*first_direction(cameras, np.median(surface.points, axis=0)))
            still = render_discs(surface.points, surface.normals, surface.radius, view, *STILL)
        devices = _devices(group.frames, set(undecided), numbers)
        if group.component == 0:
            devices += _between(group.frames, missing, np.median(surface.points, axis=0))
        drawn.append(_group(_group_name(group), surface, devices, cameras))
    assert still is not None
    return View.of(units, drawn, still)


def placed_surface(group: PlacedGroup, numbers: dict[str, int], shrink: int = 1) -> ShownSurface:
    """Points of a group's frames as discs, each in the plane of its neighbours; the others as in `placed_scene`."""
    step = max(1, -(-sum(len(frame.points) for frame in group.frames) // _MOST_DISCS))
    frames = [replace(f, points=f.points[::step], uv_camera=f.uv_camera[::step]) for f in group.frames]
    points = np.concatenate([frame.points for frame in frames]).astype(np.float64)
    index = np.repeat(np.arange(len(frames)), [len(frame.points) for frame in frames])
    uv = np.concatenate([frame.uv_camera for frame in frames])
    if not len(points):  # nothing of the object: a point before the first camera, for a view of the devices
        T = frames[0].T_world_camera
        points, index, uv = T[None, :3, 3] - T[None, :3, 2], np.array([-1]), np.zeros((1, 2))
    normals, radius = _discs(points, np.array([frame.T_world_camera[:3, 3] for frame in frames])[index])
    places = np.array([numbers[frame.name] for frame in frames])
    scale = ColourScale("turbo", float(places.min()), max(float(places.max()), places.min() + 1.0))
    layer = ColourLayer("frames", places[index].astype(np.float64), scale, "number of the frame")
    names = [frame.name for frame in frames]
    return ShownSurface(points, normals, names, index, uv * shrink, [layer], radius=radius)


def _discs(points: Float64[ndarray, "n 3"], eyes: Float64[ndarray, "n 3"]) -> tuple[Float64[ndarray, "n 3"], float]:
    """Normals towards the eyes that see the points, and a radius with which discs cover the surface."""
    towards = (eyes - points) / np.maximum(np.linalg.norm(eyes - points, axis=1, keepdims=True), 1e-300)
    if len(points) < _NEIGHBOURS:
        return towards, 0.01 * float(np.linalg.norm(eyes[0] - points[0]))
    distance, near = KDTree(points).query(points, _NEIGHBOURS)
    offset = points[near] - points[near].mean(1, keepdims=True)
    normal = np.linalg.eigh(np.swapaxes(offset, 1, 2) @ offset)[1][:, :, 0]
    normal = normal * np.where((normal * towards).sum(1) < 0, -1.0, 1.0)[:, None]
    return normal, _DISC * float(np.median(distance[:, 8]))


def _group_name(group: PlacedGroup) -> str:
    count = len(group.frames)
    if group.component == 0:
        return f"the scan: {count} frames"
    return f"group {group.component}: {count} frames" if count > 1 else f"{group.frames[0].name} by itself"


def _devices(frames: Sequence[PlacedFrame], undecided: set[str], numbers: dict[str, int]) -> list[DrawnDevices]:
    out = []
    for kind, usual in (("camera", CAMERA_COLOUR), ("projector", PROJECTOR_COLOUR)):
        for doubtful, colour in ((False, usual), (True, UNDECIDED_COLOUR)):
            chosen = [frame for frame in frames if (frame.name in undecided) == doubtful]
            if chosen:
                poses = np.array([getattr(frame, f"T_world_{kind}") for frame in chosen])
                names = [_label(frame.name, numbers) for frame in chosen]
                devices = [getattr(frame, kind) for frame in chosen]
                out.append(DrawnDevices(colour, devices, poses, names if kind == "camera" else ()))
    return out


def _between(
    frames: Sequence[PlacedFrame], missing: Sequence[tuple[str, str]], centre: Float64[ndarray, "3"]
) -> list[DrawnDevices]:
    """Where frames should be added: midway between two cameras, as far from the object, looking at it."""
    named = {frame.name: frame for frame in frames}
    pairs = [(named[a], named[b]) for a, b in missing if a in named and b in named]
    if not pairs:
        return []
    poses = np.array([_midway(a.T_world_camera, b.T_world_camera, centre) for a, b in pairs])
    labels = [("add", f"add a frame here, between {a.name} and {b.name}") for a, b in pairs]
    return [DrawnDevices(MISSING_COLOUR, [a.camera for a, _ in pairs], poses, labels)]


def _midway(
    T_world_a: Float64[ndarray, "4 4"], T_world_b: Float64[ndarray, "4 4"], centre: Float64[ndarray, "3"]
) -> Float64[ndarray, "4 4"]:
    a, b = T_world_a[:3, 3] - centre, T_world_b[:3, 3] - centre
    distance = (np.linalg.norm(a), np.linalg.norm(b))
    back = a / distance[0] + b / distance[1]
    if np.linalg.norm(back) < 1e-6:  # opposite each other: over the cameras' heads
        back = T_world_a[:3, 1] + T_world_b[:3, 1]
    back = back / np.linalg.norm(back)
    right = np.cross(T_world_a[:3, 1] + T_world_b[:3, 1], back)
    if np.linalg.norm(right) < 1e-6:
        right = T_world_a[:3, 0] - (T_world_a[:3, 0] @ back) * back
    right = right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    T[:3, 3] = centre + 0.5 * sum(distance) * back
    return T

"""A scan decoded again with the surface and the poses of a run that was trained on it, written as a new scan."""

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64
from numpy import ndarray
from scipy.ndimage import find_objects, gaussian_filter

from sl_nerfstudio.console import track
from sl_nerfstudio.decoding.decoder import Coords, Layer, Mask, drop_small_regions
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.numerics import all_finite, evenly_spaced
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays, world_pixels
from sl_nerfstudio.meshing.extract import extract_mesh
from sl_nerfstudio.meshing.mesh import Mesh
from sl_nerfstudio.parallel import one_library_thread
from sl_nerfstudio.redecoding.measure import (
    AGREES,
    STEEPEST,
    AcceptanceLimits,
    Ambiguity,
    Measured,
    PatternView,
    ShownPattern,
    confirmed,
    correlation_at,
    learn,
    measure,
)
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan.coordinates import encode_coords
from sl_nerfstudio.scan.document import TRANSFORMS, read_document
from sl_nerfstudio.scan.write import copy_others, encode_json, put_coords
from sl_nerfstudio.storage import NewFolder

# What a surface and the poses of a frame say that each pixel of the frame sees of the pattern.

_PUSH = 1e-4  # of the depth: how far a point is moved along its ray to see where its coordinate goes
_OWN = 2.0  # edge lengths: a hit this close before a point is the surface on which the point lies


@dataclass(frozen=True)
class Prediction:
    """Prediction for each pixel of a frame; NaN where it sees no surface that the projector lights."""

    coords: Coords  # pattern pixels
    along: Coords  # unit direction in which a coordinate moves with the depth of its point
    depth: Layer  # distance from the camera over the focal length: the width of a pixel there

    @property
    def known(self) -> Mask:
        """Pixels that have a prediction."""
        return all_finite(self.coords)


class PredictedSurface:
    """A mesh that rays are cast at."""

    def __init__(self, mesh: Mesh) -> None:
        """`mesh` may be open; both of its sides are seen and give shade."""
        from sl_nerfstudio.late_imports import open3d as o3d

        self._tensor = o3d.core.Tensor
        self._centre = mesh.vertices.mean(0)  # open3d computes in single precision
        self._scale = 1 / max(float(np.ptp(mesh.vertices, axis=0).max()), 1e-300)
        self._own = _OWN * mesh.edge_length()
        a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        self._normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        self._corner = a
        self._scene = o3d.t.geometry.RaycastingScene()
        vertices = ((mesh.vertices - self._centre) * self._scale).astype(np.float32)
        self._scene.add_triangles(o3d.core.Tensor(vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))

    def predict(
        self,
        camera: Device,
        projector: Device,
        T_world_camera: Float[ndarray, "4 4"],
        T_world_projector: Float[ndarray, "4 4"],
    ) -> Prediction:
        """Predict what the camera sees of the pattern that the projector throws on the surface."""
        uv = pixel_centres(camera, torch.float64).reshape(-1, 2)
        pose = torch.as_tensor(T_world_camera, dtype=torch.float64)
        direction = pixel_rays(Intrinsics.of(camera, torch.float64), pose, uv)[1].numpy()
        eye, lamp = np.asarray(T_world_camera[:3, 3]), np.asarray(T_world_projector[:3, 3])
        face, distance = self._first_hits(eye, direction)
        seen = np.flatnonzero(np.isfinite(distance))
        p_world = eye + distance[seen, None] * direction[seen]
        normal = self._normal[face[seen]]
        lit = _dot(eye - p_world, normal) * _dot(lamp - p_world, normal) > 0
        lit &= self._reached(lamp, p_world)
        seen, p_world = seen[lit], p_world[lit]
        place, inside = world_pixels(projector, T_world_projector, p_world)
        pushed, _ = world_pixels(projector, T_world_projector, p_world + _PUSH * distance[seen, None] * direction[seen])
        moved = pushed - place
        length = np.linalg.norm(moved, axis=1)
        inside &= length > 0
        n, seen = camera.h * camera.w, seen[inside]
        coords, along = np.full((2, n, 2), np.nan, dtype=np.float32)
        depth = np.full(n, np.nan, dtype=np.float32)
        coords[seen], along[seen] = place[inside], moved[inside] / length[inside, None]
        depth[seen] = distance[seen] / min(camera.fl_x, camera.fl_y)
        shape = (camera.h, camera.w)
        return Prediction(coords.reshape(*shape, 2), along.reshape(*shape, 2), depth.reshape(shape))

    def _first_hits(self, eye: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]) -> tuple[ndarray, ndarray]:
        """Face, and distance to its plane in double precision (infinite without a hit), of unit rays."""
        answer = self._cast(eye, direction)
        face, hit = answer["primitive_ids"].numpy().astype(np.int64), np.isfinite(answer["t_hit"].numpy())
        distance = np.full(len(direction), np.inf)
        normal, corner = self._normal[face[hit]], self._corner[face[hit]]
        distance[hit] = _dot(corner - eye, normal) / _dot(direction[hit], normal)
        return face, distance

    def _reached(self, lamp: Float[ndarray, "3"], p_world: Float[ndarray, "n 3"]) -> Bool[ndarray, "n"]:
        """Whether nothing but the surface around a point is between it and the projector."""
        way = p_world - lamp
        length = np.linalg.norm(way, axis=1)
        first = self._cast(lamp, way / length[:, None])["t_hit"].numpy() / self._scale
        return first > length - self._own

    def _cast(self, origin: Float[ndarray, "3"], direction: Float[ndarray, "n 3"]) -> dict:
        rays = np.empty((len(direction), 6), dtype=np.float32)
        rays[:, :3], rays[:, 3:] = (origin - self._centre) * self._scale, direction
        return self._scene.cast_rays(self._tensor(rays))


def _dot(a: Float[ndarray, "n k"], b: Float[ndarray, "n k"]) -> Float[ndarray, "n"]:
    return np.einsum("nk,nk->n", a, b)


# One frame decoded again.

_BLURS = (0.04, 0.06, 0.09, 0.13, 0.18, 0.25)  # standard deviations tried, pitches
_TRIED = 1000  # pixels on which the blur is chosen
_MANY = 20_000  # decoded pixels of which a ninth is enough to learn from
_ELSEWHERE = 6000  # pixels that are looked for where the pattern is not
_COARSEST = 1 / 3  # pitch from one pixel to the next: beyond, the image does not resolve the pattern
_FAR = 0.5  # pitch: a decoded coordinate this far from what all frames predict contradicts the surface
_CELLS = 4.0  # size of a region that is no evidence for itself
_TEAR = 0.35  # pitch between neighbouring pixels of one region


@dataclass(frozen=True)
class RedecodedFacts:
    """Outcome for the pixels of a frame; numbers of pixels."""

    name: str
    shown: int  # where the pattern falls on the object
    decoded_before: int
    checked: int  # decoded ones that were compared with the image
    confirmed: int  # those that it confirms
    added: int
    replaced: int
    removed: int
    decoded_after: int
    limits: AcceptanceLimits | None  # None: the frame was left as it is
    accepted_elsewhere: float  # share of pixels that would be accepted where the pattern certainly is not


def redecode_frame(
    name: str,
    image: Layer,
    mask: Mask | None,
    decoded: Coords,
    predicted: Prediction,
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
) -> tuple[Coords, RedecodedFacts]:
    """New coordinates of a frame, and what became of the old ones.

    `image` shows the pattern where `mask` says so (None: perhaps everywhere). Pixels are added where nothing was
    decoded, replaced where the image shows another place of the pattern than the decoded one, and removed where
    neither image nor surface supports the decoded one. All others stay as they are.
    """
    shows = np.ones(image.shape, dtype=bool) if mask is None else mask
    before = int(all_finite(decoded).sum())
    facts = RedecodedFacts(name, int(shows.sum()), before, 0, 0, 0, 0, 0, before, None, 0.0)
    stretch = _stretch(predicted.coords)
    usable = predicted.known & shows & (stretch < _COARSEST * ambiguity.pitch)
    if not (usable & all_finite(decoded)).any():
        return decoded, facts
    box = find_objects(usable.astype(np.uint8))[0]
    view = PatternView(image[box], predicted.coords[box], predicted.depth[box], usable[box])
    pitch_px = ambiguity.pitch / max(float(np.median(stretch[usable])) / np.sqrt(2), 1e-6)
    out = decoded.copy()
    out[box], facts = _redecode(view, predicted.along[box], decoded[box], pattern, ambiguity, pitch_px, facts)
    return out, facts


def _redecode(
    view: PatternView,
    along: Coords,
    decoded: Coords,
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
    pitch_px: float,
    facts: RedecodedFacts,
) -> tuple[Coords, RedecodedFacts]:
    """Decode a view again of which some decoded pixels are usable; `facts` has the numbers before."""
    pitch, old = ambiguity.pitch, all_finite(decoded)
    checked = view.usable & old & _thinned(view.usable & old)
    # A decoded pixel that is as predicted stays as it is: it is measured only to learn from it.
    agrees = np.abs(decoded - view.coords).max(-1) < AGREES * pitch
    measured = view.usable & (~agrees | checked)
    places, before = np.argwhere(measured), decoded[measured]
    shown = _as_shown(view, along, pattern, ambiguity, pitch_px, np.argwhere(checked))
    found = measure(view, along, shown, places)
    elsewhere = _elsewhere(view, along, shown, places)
    right = confirmed(found, before, pitch) & checked[measured]
    limits = learn(found, right, ~old[measured], int(checked.sum()), elsewhere, pitch)
    facts = replace(facts, checked=int(checked.sum()), confirmed=int(right.sum()), limits=limits)
    if limits is None:
        return decoded, facts
    good = limits.accept(found) & _inside(view)[tuple(places.T)]
    changed, wrong = _changed(view, shown, found, before, good, limits)
    out = decoded.copy()
    out[tuple(places[changed].T)] = found.coords[changed]
    out[tuple(places[wrong].T)] = np.nan
    out = _without_specks(out, decoded, places[changed], pitch, pitch_px)
    new, same = all_finite(out), (out == decoded).all(-1)
    return out, replace(
        facts,
        added=int((new & ~old).sum()),
        replaced=int((new & old & ~same).sum()),
        removed=int((old & ~new).sum()),
        decoded_after=facts.decoded_before + int(new.sum()) - int(old.sum()),
        accepted_elsewhere=float(limits.accept(elsewhere).mean()),
    )


def _thinned(known: Mask) -> Mask:
    """Every third pixel in both directions if there are many, else all."""
    step = 3 if known.sum() > _MANY else 1
    some = np.zeros_like(known)
    some[::step, ::step] = True
    return some


def _inside(view: PatternView) -> Mask:
    """Pixels whose four neighbours are on the same surface: at its border, surface and image may be a pixel apart."""
    depth = np.pad(np.where(view.usable, view.depth, np.float32(np.nan)), 1, constant_values=np.nan)
    here = depth[1:-1, 1:-1]
    around = (depth[:-2, 1:-1], depth[2:, 1:-1], depth[1:-1, :-2], depth[1:-1, 2:])
    return np.logical_and.reduce([np.abs(there - here) <= STEEPEST * here for there in around])  # False for NaN


def _stretch(coords: Coords) -> Layer:
    """Distance of a predicted coordinate from those of the neighbouring pixels; the larger neighbour counts."""
    total = np.zeros(coords.shape[:2], dtype=np.float32)
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(coords, axis=axis), axis=-1)
        pad = [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
        padded = np.pad(step, pad, constant_values=np.nan)
        ends = (padded[:-1], padded[1:]) if axis == 0 else (padded[:, :-1], padded[:, 1:])
        total += np.fmax(*ends) ** 2
    return np.sqrt(total)


def _as_shown(
    view: PatternView,
    along: Coords,
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
    pitch_px: float,
    known: Int64[ndarray, "n 2"],
) -> ShownPattern:
    """The pattern with the blur that agrees best with the image at decoded pixels."""
    some = known[evenly_spaced(len(known), min(_TRIED, len(known)))]
    tried = [ShownPattern(gaussian_filter(pattern, b * ambiguity.pitch), ambiguity, pitch_px) for b in _BLURS]
    return max(tried, key=lambda shown: float(np.median(measure(view, along, shown, some).correlation)))


def _elsewhere(view: PatternView, along: Coords, shown: ShownPattern, places: Int64[ndarray, "n 2"]) -> Measured:
    """Match with the prediction displaced by some pitches: places that are certainly wrong."""
    some = places[evenly_spaced(len(places), min(_ELSEWHERE, len(places)))]
    decoys = shown.ambiguity.decoys
    parts = []
    for k, part in enumerate(np.array_split(some, 2)):
        away = decoys[k * len(decoys) // 2]
        parts.append(measure(replace(view, coords=view.coords + away), along, shown, part))
    return Measured(*(np.concatenate([getattr(p, name) for p in parts]) for name in Measured.__dataclass_fields__))


def _changed(
    view: PatternView,
    shown: ShownPattern,
    found: Measured,
    before: Float32[ndarray, "n 2"],
    good: Bool[ndarray, "n"],
    limits: AcceptanceLimits,
) -> tuple[Bool[ndarray, "n"], Bool[ndarray, "n"]]:
    """Pixels that get the coordinate that was found, and decoded ones that cannot be right.

    The first are accepted, and had no coordinate or one that the image shows clearly less. The others are decoded far
    from what all frames predict, where the image shows what is predicted, though not sharply.
    """
    pitch, predicted = shown.ambiguity.pitch, view.coords[tuple(found.places.T)]
    differs = good & (np.abs(found.coords - before).max(1) > AGREES * pitch)  # False for NaN
    far = np.abs(before - predicted).max(1) > _FAR * pitch
    doubtful = far & ~good & (found.correlation >= limits.correlation) & (found.margin >= limits.margin)
    shown_less = np.zeros(len(before), dtype=bool)
    old = np.flatnonzero(differs | doubtful)
    as_it_was = correlation_at(view, shown, found.places[old], before[old])
    shown_less[old] = found.correlation[old] - as_it_was > limits.margin
    new = good & ~np.isfinite(before).all(1)
    return new | (differs & shown_less), doubtful & shown_less


def _without_specks(
    coords: Coords, decoded: Coords, changed: Int64[ndarray, "n 2"], pitch: float, pitch_px: float
) -> Coords:
    """Regions of a few cells are no evidence: what was changed in them is as it was."""
    kept = all_finite(drop_small_regions(coords, _TEAR * pitch, round(_CELLS * pitch_px**2)))
    back = changed[~kept[tuple(changed.T)]]
    out = coords.copy()
    out[tuple(back.T)] = decoded[tuple(back.T)]
    return out


# A whole run: a new scan folder with the coordinates of all frames.

RECORD = "redecoding.json"


@dataclass(frozen=True)
class Redecoded:
    """Outcome for all frames."""

    frames: tuple[RedecodedFacts, ...]

    @property
    def share_before(self) -> float:
        """Share of the pixels with the pattern that were decoded."""
        return self._share("decoded_before")

    @property
    def share_after(self) -> float:
        """Share of the pixels with the pattern that are decoded now."""
        return self._share("decoded_after")

    def total(self, name: str) -> int:
        """Sum of one of the frames' numbers."""
        return sum(getattr(frame, name) for frame in self.frames)

    def _share(self, name: str) -> float:
        return self.total(name) / max(self.total("shown"), 1)


@one_library_thread()
def redecode_run(run: TrainedRun, output: Path, resolution: int = 256) -> Redecoded:
    """Write the scan of a run with coordinates that were decoded again; one frame is in memory at a time.

    `output` is a folder that is new or empty, `resolution` the number of cells along each side of the scene's box.

    All else is copied: images, masks, truth, and the starting poses with their sigma. Those are independent of the
    coordinates, while the refined ones already contain them: as a prior they would count the coordinates twice.
    Raises UserError if the output is not empty, there is no surface, or the scan was changed meanwhile.
    """
    model = run.model
    scan, poses = model.scan, model.poses()
    document = read_document(scan.root / TRANSFORMS)
    with NewFolder(output) as folder:
        mesh = extract_mesh(model.sdf, resolution, device=model.device)
        surface = PredictedSurface(mesh.mapped(model.S_scene_world.inverse()))
        pattern = scan.read_pattern()
        ambiguity, facts = Ambiguity.of(pattern), []
        for k, frame in enumerate(track(scan.frames, "decoding again")):
            predicted = surface.predict(
                frame.camera, scan.projector, poses.T_world_camera[k], poses.T_world_projector[k]
            )
            mask = None if frame.mask_path is None else frame.read_mask()
            coords, found = redecode_frame(
                frame.name, frame.read_pattern(), mask, frame.read_coords(), predicted, pattern, ambiguity
            )
            folder.write(put_coords(document, k, frame.name), encode_coords(coords))
            facts.append(found)
        copy_others(folder, scan, document, (RECORD,))
        result = Redecoded(tuple(facts))
        record = {"share_before": result.share_before, "share_after": result.share_after}
        folder.write(RECORD, encode_json({**record, "frames": [dataclasses.asdict(frame) for frame in result.frames]}))
        folder.write(TRANSFORMS, encode_json(document), last=True)
    return result

"""One photograph of a scene under the projected pattern, and its truth."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy import ndarray

from benchmarks.another_renderer.optics import Lens, dots, into_device
from benchmarks.another_renderer.scene import EPSILON, Hits, Paint, Scene
from benchmarks.another_renderer.sensor import Sensor, exposed

_SIGMAS = (
    0.4,
    0.9,
    1.5,
    2.3,
    3.4,
)  # of the blurred patterns between which a surface's distance chooses, pattern pixels


@dataclass(frozen=True)
class Look:
    """How difficult a set's photographs are."""

    room_light: float = 0.05  # next to the projector's white
    texture: float = 0.0
    spots: bool = False
    colour: bool = False
    gloss: float = 0.0
    projector_blur: float = 0.5  # sigma in focus, pattern pixels
    projector_defocus: float = 1.0  # sigma added at one and a half times the distance in focus
    contrast: float = 0.97  # of the projector: 1 - black / white
    translucent: float = 0.0  # share of the light that comes out of the object elsewhere than where it went in
    scatter_px: float = 3.0  # how far from there, camera pixels (sigma)
    bounces: bool = False  # light that surfaces send to each other once
    sensor: Sensor = field(default_factory=Sensor)


@dataclass(frozen=True)
class View:
    """Both devices during one photograph; poses are device to world."""

    T_camera: ndarray
    T_projector: ndarray
    focus_camera: float
    focus_projector: float


@dataclass(frozen=True)
class Truth:
    """What each camera pixel's centre sees."""

    p_world: ndarray  # (h, w, 3), NaN where the object is not seen or the projector does not reach it
    uv_projector: ndarray  # (h, w, 2)
    object_seen: ndarray  # (h, w)


class Projection:
    """A pattern, blurred by the projector's lens according to distance."""

    def __init__(self, pattern: ndarray, lens: Lens, look: Look) -> None:
        self.lens, self.look = lens, look
        self._levels = [cv2.GaussianBlur(pattern.astype(np.float32), (0, 0), sigma) for sigma in _SIGMAS]

    def light(self, uv: ndarray, distance: ndarray, focus: float) -> ndarray:
        """What the projector sends (n,) to pattern pixels (n, 2) at some distance; 0 outside its image."""
        sigma = self.look.projector_blur + 3 * self.look.projector_defocus * np.abs(1 - focus / distance)
        place = np.interp(sigma, _SIGMAS, np.arange(len(_SIGMAS)))
        xy = np.where(np.isfinite(uv), uv, -10).astype(np.float32) - np.float32(0.5)
        result = np.zeros(len(uv), dtype=np.float32)
        for k, level in enumerate(self._levels):
            weight = np.maximum(1 - np.abs(place - k), 0)
            if weight.max(initial=0) > 0:
                result += weight * _looked_up(level, xy)
        inside = _within(uv, self.lens)
        black = 1 - self.look.contrast
        return np.where(inside, black + self.look.contrast * result, 0)


def _within(uv: ndarray, lens: Lens) -> ndarray:
    x, y = uv[:, 0], uv[:, 1]
    return (x > 0) & (x < lens.w) & (y > 0) & (y < lens.h)


def _looked_up(image: ndarray, xy: ndarray) -> ndarray:
    rows = -(-len(xy) // 4096)  # cv2.remap takes images of less than 32768 a side
    padded = np.full((rows * 4096, 2), -10, np.float32)
    padded[: len(xy)] = xy
    grid = padded.reshape(rows, 4096, 2)
    found = [cv2.remap(image, part, None, cv2.INTER_LINEAR) for part in np.array_split(grid, -(-rows // 30000))]  # type: ignore[call-overload]
    return np.concatenate(found).ravel()[: len(xy)]


def photograph(
    scene: Scene,
    camera: Lens,
    projection: Projection,
    paints: tuple[Paint, Paint],
    view: View,
    rng: np.random.Generator,
) -> tuple[ndarray, Truth]:
    """Values (h, w, 3) from 0 to 255, four rays a pixel, and what the pixels' centres see."""
    look, shape = projection.look, (camera.h, camera.w)
    light, sent = np.zeros((*shape, 3), dtype=np.float32), np.zeros(shape, dtype=np.float32)
    for dx in (0.25, 0.75):
        for dy in (0.25, 0.75):
            rays = _directions(camera, view.T_camera, rng.uniform(-0.2, 0.2, (*shape, 2)) + [dx, dy])
            seen, on_object = _seen(scene, projection, paints, view, rays)
            light += seen.reshape(light.shape) / 4
            sent += on_object.reshape(shape) / 4
    rays = _directions(camera, view.T_camera, np.full((*shape, 2), 0.5))
    hits = scene.hits(view.T_camera[:3, 3], rays)
    if look.translucent:
        light += look.translucent * _albedo(paints, hits).reshape(light.shape) * _scattered(sent, hits, look)[..., None]
    if look.bounces:
        got = _bounced(scene, projection, paints, view, hits, rng).reshape(light.shape)
        light += _albedo(paints, hits).reshape(light.shape) * cv2.GaussianBlur(got, (0, 0), 3.0)
    truth = _truth(scene, camera, projection.lens, view, hits)
    return exposed(light, hits.depth.reshape(shape), view.focus_camera, look.sensor, rng), truth


def _scattered(sent: ndarray, hits: Hits, look: Look) -> ndarray:
    """What light (h, w) on the object gains and loses inside it."""
    there = (hits.is_object & np.isfinite(hits.depth)).reshape(sent.shape).astype(np.float32)
    blurred = cv2.GaussianBlur(sent, (0, 0), look.scatter_px)
    return there * (blurred / np.maximum(cv2.GaussianBlur(there, (0, 0), look.scatter_px), 0.05) - sent)


def _bounced(
    scene: Scene, projection: Projection, paints: tuple[Paint, Paint], view: View, hits: Hits, rng: np.random.Generator
) -> ndarray:
    """Light (n, 3) of the projector that pixels' centres get from other surfaces, by six directions each."""
    met = np.nonzero(np.isfinite(hits.depth))[0]
    p, n = hits.p_world[met], hits.normal[met]
    got = np.zeros((len(hits.depth), 3), dtype=np.float32)
    for _ in range(6):
        way = _unit(n + _unit(rng.normal(size=n.shape)))  # as often as its cosine is large
        other = scene.hits(p + EPSILON * n, way)
        there = np.nonzero(np.isfinite(other.depth))[0]
        sent = _sent(scene, projection, view, other.p_world[there], other.normal[there])
        got[met[there]] += _albedo(paints, other)[there] * sent[:, None] / 6
    return got


def _directions(camera: Lens, T_camera: ndarray, within: ndarray) -> ndarray:
    """World directions (h w, 3) of a point `within` (h, w, 2) each pixel."""
    column, row = np.meshgrid(np.arange(camera.w), np.arange(camera.h))
    uv = (np.stack([column, row], -1) + within).reshape(-1, 2)
    return camera.directions(uv) @ T_camera[:3, :3].T


def _seen(
    scene: Scene, projection: Projection, paints: tuple[Paint, Paint], view: View, rays: ndarray
) -> tuple[ndarray, ndarray]:
    """Light (n, 3) that comes along rays (n, 3) into the camera, and the projector's light (n,) on the object there."""
    look, eye = projection.look, view.T_projector[:3, 3]
    hits = scene.hits(view.T_camera[:3, 3], rays)
    met = np.nonzero(np.isfinite(hits.depth))[0]
    p, n = hits.p_world[met], hits.normal[met]
    sent = _sent(scene, projection, view, p, n)
    room = look.room_light * (0.7 + 0.3 * n[:, 2] + 0.25 * np.maximum(n @ np.array([0.5, -0.6, 0.62]), 0))
    to_eye = _unit(eye - p)
    half = _unit(to_eye - rays[met])
    cosine = np.maximum(dots(n, to_eye), 1e-6)
    shine = look.gloss * np.maximum(dots(n, half), 0) ** 40
    result, on_object = np.zeros((len(rays), 3)), np.zeros(len(rays), dtype=np.float32)
    result[met] = _albedo(paints, hits)[met] * (sent + room)[:, None] + (shine * sent / cosine)[:, None]
    on_object[met] = np.where(hits.is_object[met], sent, 0)
    return result, on_object


def _sent(scene: Scene, projection: Projection, view: View, p: ndarray, n: ndarray) -> ndarray:
    """The projector's light (m,) on surfaces at points (m, 3) with normals (m, 3)."""
    eye = view.T_projector[:3, 3]
    distance = np.linalg.norm(eye - p, axis=1)
    cosine = np.maximum(dots(n, eye - p) / distance, 0)
    light = projection.light(projection.lens.pixels(into_device(view.T_projector, p)), distance, view.focus_projector)
    reached = np.nonzero((cosine > 0) & (light > 0))[0]
    lit = np.zeros(len(p))
    lit[reached] = light[reached] * scene.sees(p[reached] + EPSILON * n[reached], eye)
    return cosine * (view.focus_projector / distance) ** 2 * lit


def _unit(v: ndarray) -> ndarray:
    return v / np.sqrt(dots(v, v))[:, None]


def _albedo(paints: tuple[Paint, Paint], hits: Hits) -> ndarray:
    """(n, 3); 0 where nothing was met."""
    met = np.isfinite(hits.depth)
    result = np.zeros((len(met), 3))
    result[met] = np.where(
        hits.is_object[met, None], paints[0].albedo(hits.p_world[met]), paints[1].albedo(hits.p_world[met])
    )
    return result


def _truth(scene: Scene, camera: Lens, projector: Lens, view: View, hits: Hits) -> Truth:
    on_object = hits.is_object & np.isfinite(hits.depth)
    uv = projector.pixels(into_device(view.T_projector, hits.p_world))
    inside = _within(uv, projector)
    eye = view.T_projector[:3, 3]
    lit = on_object & inside & (dots(eye - hits.p_world, hits.normal) > 0)
    chosen = np.nonzero(lit)[0]
    lit[chosen] = scene.sees(hits.p_world[chosen] + EPSILON * hits.normal[chosen], eye)
    p, uv = np.where(lit[:, None], hits.p_world, np.nan), np.where(lit[:, None], uv, np.nan)
    shape = camera.h, camera.w
    return Truth(p.reshape(*shape, 3), uv.reshape(*shape, 2), on_object.reshape(shape))

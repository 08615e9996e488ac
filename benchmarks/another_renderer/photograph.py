"""One photograph of a scene under the projected pattern, and its truth: lenses, surfaces, light, sensor."""

import io
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
import open3d as o3d
import trimesh
from numpy import ndarray
from PIL import Image
from scipy.spatial.transform import Rotation


def dots(a: ndarray, b: ndarray) -> ndarray:
    """Products of vectors (..., k), summed over the last axis; much faster than by `sum`."""
    return np.einsum("...i,...i->...", a, b)


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels; the centre of the first pixel is (0.5, 0.5), y points down."""

    w: int
    h: int
    f: float
    cx: float
    cy: float
    k1: float = 0.0
    k2: float = 0.0

    def document(self) -> dict[str, float]:
        """The lens as the plain JSON of sl-process has it."""
        return {"w": self.w, "h": self.h, "fl_x": self.f, "fl_y": self.f, "cx": self.cx, "cy": self.cy,
                "k1": self.k1, "k2": self.k2, "p1": 0.0, "p2": 0.0}  # fmt: skip

    def pixels(self, p: ndarray) -> ndarray:
        """Pixels (..., 2) of points (..., 3) in device axes; NaN behind the device."""
        with np.errstate(divide="ignore", invalid="ignore"):
            n = np.stack([p[..., 0], -p[..., 1]], -1) / -p[..., 2:]
        n[p[..., 2] >= 0] = np.nan
        r2 = dots(n, n)[..., None]
        return self.f * n * (1 + self.k1 * r2 + self.k2 * r2**2) + [self.cx, self.cy]

    def directions(self, uv: ndarray) -> ndarray:
        """Unit directions (..., 3) in device axes of pixels (..., 2)."""
        distorted = (uv - [self.cx, self.cy]) / self.f
        n = distorted.copy()
        for _ in range(8):
            r2 = dots(n, n)[..., None]
            n = distorted / (1 + self.k1 * r2 + self.k2 * r2**2)
        d = np.concatenate([n[..., :1], -n[..., 1:], -np.ones_like(n[..., :1])], -1)
        return d / np.sqrt(dots(d, d))[..., None]

    def turned_to_middle(self) -> ndarray:
        """Rotation (4, 4) in device axes, after which the middle of the image looks where its axis did."""
        right, down = (self.w / 2 - self.cx) / self.f, (self.h / 2 - self.cy) / self.f
        if max(abs(right), abs(down)) < 0.1:  # as exact as people aim
            return np.eye(4)
        middle, axis = np.array([right, -down, -1.0]), np.array([0.0, 0.0, -1.0])
        T = np.eye(4)
        T[:3, :3] = Rotation.align_vectors(axis[None], middle[None])[0].as_matrix()
        return T


def looking(eye: ndarray, at: ndarray, roll: float) -> ndarray:
    """Pose (4, 4), device to world, of a device at `eye` that looks at a point; `roll` in radian about its sight."""
    back = (eye - at) / np.linalg.norm(eye - at)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    c, s = np.cos(roll), np.sin(roll)
    T = np.eye(4)
    T[:3, :3] = np.stack([c * right + s * up, c * up - s * right, back], 1)
    T[:3, 3] = eye
    return T


def into_device(T_world_device: ndarray, p_world: ndarray) -> ndarray:
    """Points (..., 3) in the axes of the device."""
    return (p_world - T_world_device[:3, 3]) @ T_world_device[:3, :3]


def nearest_points(o1: ndarray, d1: ndarray, o2: ndarray, d2: ndarray) -> ndarray:
    """Middles (n, 3) of the shortest connections of rays from o1 along d1 (n, 3) and from o2 along d2."""
    a, b, c = dots(d1, d1), dots(d1, d2), dots(d2, d2)
    e, f = d1 @ (o1 - o2), d2 @ (o1 - o2)
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (b * f - c * e) / (a * c - b * b), (a * f - b * e) / (a * c - b * b)
    return (o1 + s[:, None] * d1 + o2 + t[:, None] * d2) / 2


def triangulated(
    camera: Lens, T_camera: ndarray, uv: ndarray, projector: Lens, T_projector: ndarray, xy: ndarray
) -> ndarray:
    """Points (n, 3) in the world that camera pixels and projector pixels see."""
    d1, d2 = camera.directions(uv) @ T_camera[:3, :3].T, projector.directions(xy) @ T_projector[:3, :3].T
    return nearest_points(T_camera[:3, 3], d1, T_projector[:3, 3], d2)


EPSILON = 0.02  # mm by which shadow rays start off a surface


@dataclass(frozen=True)
class Hits:
    """What rays met first; `depth` is infinite where they met nothing."""

    depth: ndarray
    p_world: ndarray
    normal: ndarray
    is_object: ndarray


class Scene:
    """One object and what surrounds it, for one thread."""

    def __init__(self, thing: trimesh.Trimesh, others: list[trimesh.Trimesh]) -> None:
        self._caster: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
        self._normals: list[ndarray] = []
        self._faces: list[ndarray] = []
        for mesh in (thing, *others):
            faces = np.asarray(mesh.faces, dtype=np.uint32)
            self._caster.add_triangles(np.asarray(mesh.vertices, dtype=np.float32), faces)
            # flat surroundings keep their facets' normals; of the object, whose facets are fine, they are interpolated
            self._normals.append(
                np.asarray(mesh.vertex_normals if mesh is thing else mesh.face_normals, dtype=np.float32)
            )
            self._faces.append(faces)

    def hits(self, origin: ndarray, directions: ndarray) -> Hits:
        """First hits of rays (n, 3) from one point, or from one each."""
        rays = np.concatenate([np.broadcast_to(origin, directions.shape), directions], -1).astype(np.float32)
        found = {key: value.numpy() for key, value in self._caster.cast_rays(o3d.core.Tensor(rays), nthreads=1).items()}
        depth, which, face, uv = found["t_hit"], found["geometry_ids"], found["primitive_ids"], found["primitive_uvs"]
        normal = np.zeros_like(directions)
        for number, (normals, faces) in enumerate(zip(self._normals, self._faces, strict=True)):
            chosen = which == number
            if number == 0:
                a, b, c = (normals[faces[face[chosen], k]] for k in range(3))
                u, v = uv[chosen, :1], uv[chosen, 1:]
                normal[chosen] = a * (1 - u - v) + b * u + c * v
            else:
                normal[chosen] = normals[face[chosen]]
        normal /= np.maximum(np.sqrt(dots(normal, normal)), 1e-9)[:, None]
        normal[dots(normal, directions) > 0] *= -1
        points = origin + np.where(np.isfinite(depth), depth, 0)[:, None] * directions
        return Hits(depth, points, normal, which == 0)

    def sees(self, p_world: ndarray, eye: ndarray) -> ndarray:
        """Whether nothing lies between points (n, 3) and `eye`."""
        rays = np.concatenate([p_world, eye - p_world], -1).astype(np.float32)  # the eye is at 1 along each ray
        return ~self._caster.test_occlusions(o3d.core.Tensor(rays), 0.0, 1.0, nthreads=1).numpy()


def surroundings(kind: str, thing: trimesh.Trimesh, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    """Nothing ("none"), a table below the object, or a room with a table, walls and clutter."""
    if kind == "none":
        return []
    low, high = thing.bounds
    size, floor = float((high - low).max()), float(low[2])
    table = _at(trimesh.creation.box((9 * size, 9 * size, 8)), (0, 0, floor - 4))
    if kind == "table":
        return [table]
    walls = []
    for angle in (20.0, 115.0, 200.0, 290.0):
        wall = trimesh.creation.box((10, 12 * size, 7 * size))
        turn = np.radians(angle + rng.uniform(-8, 8))
        wall.apply_transform(trimesh.transformations.rotation_matrix(turn, (0, 0, 1)))
        walls.append(_at(wall, (4.6 * size * np.cos(turn), 4.6 * size * np.sin(turn), floor + 2 * size)))
    clutter = []
    for k in range(6):
        angle, far = np.radians(60 * k + rng.uniform(-20, 20)), rng.uniform(0.95, 1.3) * size
        a, b, c = rng.uniform(0.12, 0.34, 3) * size
        made = (trimesh.creation.box((a, b, c)), trimesh.creation.cylinder(a / 2, c), trimesh.creation.cone(a / 2, c))[
            k % 3
        ]
        made.apply_transform(trimesh.transformations.rotation_matrix(rng.uniform(0, 6.3), (0, 0, 1)))
        clutter.append(_at(made, (far * np.cos(angle), far * np.sin(angle), floor - float(made.bounds[0, 2]))))
    return [table, *walls, *clutter]


def _at(mesh: trimesh.Trimesh, shift: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh.apply_translation(shift)
    return mesh


@dataclass(frozen=True)
class Paint:
    """Colours of surfaces: clouds of several sizes, and printed spots."""

    waves: ndarray  # (n, 3) radian per mm
    phases: ndarray  # (n,)
    strength: float  # 0: one grey
    tints: ndarray  # (2, 3) colours that are mixed
    spots: bool

    @staticmethod
    def random(strength: float, spots: bool, colour: bool, rng: np.random.Generator) -> "Paint":
        """Clouds from 8 to 80 mm."""
        directions = rng.normal(size=(14, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        waves = directions * (2 * np.pi / np.geomspace(8, 80, 14))[:, None]
        tints = rng.uniform(0.45, 0.95, (2, 3)) if colour else np.repeat(rng.uniform(0.6, 0.85, (2, 1)), 3, 1)
        return Paint(waves, rng.uniform(0, 2 * np.pi, 14), strength, tints, spots)

    def albedo(self, p_world: ndarray) -> ndarray:
        """(n, 3) of points (n, 3)."""
        p = p_world.astype(np.float32)
        waves = np.cos(p @ self.waves.T.astype(np.float32) + self.phases.astype(np.float32))
        clouds = np.clip(0.5 + 0.22 * waves[:, 4:].sum(1), 0, 1)[:, None]
        colour = self.tints[0] * clouds + self.tints[1] * (1 - clouds)
        shade = 1 - self.strength * np.clip(0.4 + 0.25 * waves[:, :8].sum(1), 0, 1)[:, None]
        if self.spots:
            shade = np.where((waves[:, 2] + waves[:, 5] + waves[:, 7] > 1.1)[:, None], shade * 0.45, shade)
        return colour * shade


@dataclass(frozen=True)
class Sensor:
    """How good the camera is."""

    blur_px: float = 0.5  # sigma in focus, pixels
    defocus_px: float = 0.0  # sigma at one and a half times the distance in focus
    motion_px: float = 0.0  # longest smear
    electrons: float = 12000.0  # at full scale
    read_noise: float = 0.002  # of full scale
    exposure_stops: float = 0.0  # frames differ by up to this, either way
    gamma: float = 2.2
    quality: int = 95  # of JPEG
    vignetting: float = 0.0  # light lost in the corners, share
    denoising_px: float = 0.0  # sigma of a filter that keeps edges
    sharpening: float = 0.0  # share of what a blur of 1.2 pixels takes away that is added
    tone: float = 0.0  # how far the tones are drawn to an S, as in the pictures of telephones; at most 1
    thinned_colour: bool = False  # colour at half the resolution in JPEG


def blurred_by_depth(light: ndarray, depth: ndarray, focus: float, sensor: Sensor) -> ndarray:
    """(h, w, 3), each pixel blurred by its own distance."""
    sigma = np.full(depth.shape, sensor.blur_px)
    far = np.where(np.isfinite(depth), depth, 3 * focus)
    sigma += 3 * sensor.defocus_px * np.abs(1 - focus / far)
    levels = np.linspace(float(sigma.min()), float(max(np.quantile(sigma, 0.995), sigma.min() + 1e-3)), 4)
    place = np.clip((sigma - levels[0]) / (levels[1] - levels[0]), 0, 3)
    result = np.zeros_like(light)
    for k, level in enumerate(levels):
        weight = np.maximum(1 - np.abs(place - k), 0)[..., None]
        result += weight * cv2.GaussianBlur(light, (0, 0), float(max(level, 0.05)))
    return result


def smeared(light: ndarray, length: float, angle: float) -> ndarray:
    """Moved along a line of `length` pixels during the exposure."""
    if length < 0.2:
        return light
    result, steps = np.zeros_like(light), 7
    for t in np.linspace(-0.5, 0.5, steps) * length:
        M = np.array([[1, 0, t * np.cos(angle)], [0, 1, t * np.sin(angle)]])
        result += cv2.warpAffine(light, M, light.shape[1::-1], flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return result / steps


def exposed(light: ndarray, depth: ndarray, focus: float, sensor: Sensor, rng: np.random.Generator) -> ndarray:
    """Values from 0 to 255 of light (h, w, 3): the brightest hundredth comes near full scale, but for the exposure."""
    image = blurred_by_depth(light.astype(np.float32), depth, focus, sensor)
    image = smeared(image, sensor.motion_px * rng.uniform(0, 1), rng.uniform(0, np.pi))
    stops = sensor.exposure_stops * rng.uniform(-1, 1) - 0.15
    image = image / max(float(np.quantile(image, 0.99)), 1e-6) * 2**stops
    image = image * _vignette(image.shape, sensor.vignetting)
    electrons = rng.normal(image, np.sqrt(np.maximum(image, 0) / sensor.electrons + sensor.read_noise**2))
    return (255 * processed(np.clip(electrons, 0, 1) ** (1 / sensor.gamma), sensor) + 0.5).astype(np.uint8)


def processed(values: ndarray, sensor: Sensor) -> ndarray:
    """Values from 0 to 1 (h, w, 3) as the camera's own software leaves them."""
    if sensor.denoising_px:
        values = cv2.bilateralFilter(values.astype(np.float32), -1, 0.05, sensor.denoising_px)
    if sensor.sharpening:
        values = values + sensor.sharpening * (values - cv2.GaussianBlur(values, (0, 0), 1.2))
    values = np.clip(values, 0, 1)
    return values + sensor.tone * (values**2 * (3 - 2 * values) - values)


def _vignette(shape: tuple[int, ...], share: float) -> ndarray:
    """(h, w, 1) of an image of `shape`, 1 in its middle."""
    y, x = (np.linspace(-1, 1, n) for n in shape[:2])
    return (1 - share * ((x[None, :] ** 2 + y[:, None] ** 2) / 2))[..., None]


def jpeg(values: ndarray, sensor: Sensor, colour: bool) -> bytes:
    """An image file of (h, w, 3), grey unless `colour`."""
    image = Image.fromarray(values if colour else values[..., 1])
    stored = io.BytesIO()
    image.save(stored, "JPEG", quality=sensor.quality, subsampling=2 if sensor.thinned_colour else 0)
    return stored.getvalue()


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
    scene: Scene, camera: Lens, projection: Projection, paints: tuple[Paint, Paint], view: View,
    rng: np.random.Generator,
) -> tuple[ndarray, Truth]:  # fmt: skip
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

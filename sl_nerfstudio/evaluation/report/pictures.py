"""Pictures for the report: colour-coded maps and shaded views of a mesh, all embedded as data."""

import base64
import io
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from PIL import Image

from sl_nerfstudio.evaluation.indexed_mesh import IndexedMesh

CLAY = (0.80, 0.78, 0.74)


@dataclass(frozen=True)
class ColourScale:
    """A matplotlib colour map between two values."""

    colours: str
    lower: float
    upper: float

    def __call__(self, values: Float[ndarray, "*n"]) -> Float[ndarray, "*n 3"]:
        """RGB in 0..1; values beyond the limits get the colours of the limits."""
        span = self.upper - self.lower
        return np.asarray(matplotlib.colormaps[self.colours](np.clip((values - self.lower) / span, 0, 1)))[..., :3]

    def css_gradient(self, stops: int = 9) -> str:
        """The scale as a CSS background, left to right."""
        values = np.linspace(self.lower, self.upper, stops)
        colours = ", ".join("#" + bytes(np.round(255 * rgb).astype(np.uint8)).hex() for rgb in self(values))
        return f"linear-gradient(to right, {colours})"


def data_uri(rgb: Float[ndarray, "h w 3"] | Float[ndarray, "h w"], quality: int = 82) -> str:
    """An image in 0..1 as a `data:` address (WebP)."""
    buffer = io.BytesIO()
    _to_image(rgb).save(buffer, "WEBP", quality=quality, method=4)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def _to_image(rgb: Float[ndarray, "h w *c"]) -> Image.Image:
    values: UInt8[ndarray, "h w *c"] = np.round(np.clip(np.nan_to_num(rgb), 0, 1) * 255).astype(np.uint8)
    return Image.fromarray(values)


def shrink(rgb: Float[ndarray, "h w 3"], longest: int) -> Float[ndarray, "h2 w2 3"]:
    """The image reduced so that its longer side is at most `longest` pixels."""
    image = _to_image(rgb)
    image.thumbnail((longest, longest), Image.Resampling.BOX)
    return np.asarray(image, np.float64) / 255


@dataclass(frozen=True)
class OrthographicView:
    """The direction from which a mesh is drawn, and which direction is up."""

    towards_viewer: Float[ndarray, "3"]
    up: Float[ndarray, "3"]


def camera_views(
    T_world_camera: Float[ndarray, "n 4 4"], centre: Float[ndarray, "3"], count: int = 3
) -> list[OrthographicView]:
    """Views from camera positions, as different from each other as possible: sides that the scan really saw."""
    towards = T_world_camera[:, :3, 3] - centre
    towards = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-300)
    common_up = T_world_camera[:, :3, 1].mean(0)
    chosen = [int(np.argmax(towards @ towards.mean(0)))]
    while len(chosen) < min(count, len(towards)):
        chosen.append(int(np.argmin((towards @ towards[chosen].T).max(1))))
    rolled = np.linalg.norm(common_up) < 0.3  # if cameras were held in every orientation, use the up direction of each
    return [OrthographicView(towards[i], T_world_camera[i, :3, 1] if rolled else common_up) for i in chosen]


def render(
    surface: IndexedMesh,
    view: OrthographicView,
    colours: Float[ndarray, "v 3"] | None = None,
    height: int = 420,
    width: int = 420,
    supersampling: int = 2,
) -> Float[ndarray, "h w 3"]:
    """A shaded orthographic picture on white; `colours` are per vertex, None draws it in clay."""
    right, up, back = _view_axes(view)
    h, w = height * supersampling, width * supersampling
    used = surface.mesh.used_vertices() - surface.centre
    x, y = used @ right, used @ up
    middle = surface.centre + right * (x.max() + x.min()) / 2 + up * (y.max() + y.min()) / 2
    pixel = max(np.ptp(x) / (w * 0.94), np.ptp(y) / (h * 0.94), 1e-12)
    columns, rows = np.meshgrid(np.arange(w) - (w - 1) / 2, (h - 1) / 2 - np.arange(h))
    origins = middle + pixel * (columns.reshape(-1, 1) * right + rows.reshape(-1, 1) * up) + surface.diagonal * back
    hits = surface.cast(origins, np.broadcast_to(-back, origins.shape))
    picture = np.ones((h * w, 3))
    p = origins[hits.hit] - hits.distance[hits.hit, None] * back
    picture[hits.hit] = _shade(surface, hits.face[hits.hit], p, colours, right, up, back)
    return picture.reshape(height, supersampling, width, supersampling, 3).mean((1, 3))


def _view_axes(view: OrthographicView) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"], Float[ndarray, "3"]]:
    back = view.towards_viewer / np.linalg.norm(view.towards_viewer)
    right = np.cross(view.up, back)
    if np.linalg.norm(right) < 1e-3 * max(np.linalg.norm(view.up), 1e-300):  # looking along "up"
        right = np.cross(np.eye(3)[np.argmin(np.abs(back))], back)
    right = right / np.linalg.norm(right)
    return right, np.cross(back, right), back


def _shade(
    surface: IndexedMesh,
    face: ndarray,
    p: Float[ndarray, "n 3"],
    colours: Float[ndarray, "v 3"] | None,
    right: Float[ndarray, "3"],
    up: Float[ndarray, "3"],
    back: Float[ndarray, "3"],
) -> Float[ndarray, "n 3"]:
    weights = _barycentric(surface, face, p)
    corners = surface.faces[face]
    normal = (surface.vertex_normals[corners] * weights[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    outside = normal @ back > 0
    lamp = back + 0.45 * up - 0.35 * right
    lamp /= np.linalg.norm(lamp)
    light = np.abs(normal @ lamp)
    base = np.array(CLAY) if colours is None else (colours[corners] * weights[..., None]).sum(1)
    brightness = 0.38 + 0.66 * light
    brightness = np.where(outside, brightness, 0.55 * brightness)  # the inside is darker
    return np.clip(base * brightness[:, None], 0, 1)


def _barycentric(surface: IndexedMesh, face: ndarray, p: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    a, b, c = (surface.vertices[surface.faces[face, k]] for k in range(3))
    normal = surface.face_cross[face]
    norm2 = np.maximum((normal**2).sum(1), 1e-300)
    u = (np.cross(c - b, p - b) * normal).sum(1) / norm2
    v = (np.cross(a - c, p - c) * normal).sum(1) / norm2
    return np.clip(np.stack([u, v, 1 - u - v], 1), 0, 1)


def pixel_map(row: ndarray, column: ndarray, stride: int, rgb: Float[ndarray, "n 3"]) -> Float[ndarray, "h w 3"]:
    """An image of scattered pixels (every stride-th of a frame), cropped to them; white elsewhere."""
    if len(row) == 0:
        return np.ones((1, 1, 3))
    y, x = (row - row.min()) // stride, (column - column.min()) // stride
    picture = np.ones((int(y.max()) + 1, int(x.max()) + 1, 3))
    picture[y, x] = rgb
    return picture


def residual_colours(
    values: Float[ndarray, "n"],
    scale: ColourScale,
    no_surface: Bool[ndarray, "n"],
) -> Float[ndarray, "n 3"]:
    """Colours of residuals; grey where there is no value, blue where there is no surface."""
    rgb = scale(np.nan_to_num(values))
    rgb[np.isnan(values)] = NO_VALUE
    rgb[no_surface] = NO_SURFACE
    return rgb


NO_VALUE = (0.78, 0.80, 0.82)
NO_SURFACE = (0.18, 0.42, 0.75)

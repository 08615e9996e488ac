"""What reports are made of: charts as inline SVG, pictures as embedded data, colours, and filled-in templates."""

import base64
import io
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float, UInt8
from markupsafe import escape
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy import ndarray
from PIL import Image

from sl_nerfstudio.evaluation.mesh_index import IndexedMesh
from sl_nerfstudio.meshing.mesh import VertexQuality
from sl_nerfstudio.processing.result import EdgeRecord, FrameRecord

# Pictures for the report: colour-coded maps and shaded views of a mesh, all embedded as data.

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
    normal = (surface.mesh.vertex_normals()[corners] * weights[..., None]).sum(1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    base = np.array(CLAY) if colours is None else (colours[corners] * weights[..., None]).sum(1)
    return np.clip(base * _brightness(normal, right, up, back)[:, None], 0, 1)


def _brightness(
    normal: Float[ndarray, "n 3"], right: Float[ndarray, "3"], up: Float[ndarray, "3"], back: Float[ndarray, "3"]
) -> Float[ndarray, "n"]:
    """Lit from beside the eye, as in the interactive view."""
    lamp = back + 0.45 * up - 0.35 * right
    brightness = 0.38 + 0.66 * np.abs(normal @ (lamp / np.linalg.norm(lamp)))
    return np.where(normal @ back > 0, brightness, 0.55 * brightness)  # the inside is darker


def render_discs(
    points: Float[ndarray, "n 3"],
    normals: Float[ndarray, "n 3"],
    radius: float,
    view: OrthographicView,
    height: int,
    width: int,
) -> Float[ndarray, "h w 3"]:
    """A shaded orthographic picture on white of points, as discs; framed on all but the outermost 0.2 %."""
    right, up, back = _view_axes(view)
    x, y = points @ right, points @ up
    (left, bottom), (far_right, top) = ([np.percentile(v, q) for v in (x, y)] for q in (0.2, 99.8))
    pixel = max((far_right - left) / (width * 0.9), (top - bottom) / (height * 0.9), 1e-12)
    k = max(1, min(math.ceil(radius / pixel), height // 20))
    square = np.mgrid[-k : k + 1, -k : k + 1].reshape(2, -1)
    dy, dx = square[:, np.hypot(*square) <= k]
    order = np.argsort(points @ back, kind="stable")  # the nearest last: it hides the others
    column = np.rint((x[order] - (left + far_right) / 2) / pixel + width / 2).astype(np.int64)[:, None] + dx
    row = np.rint(((bottom + top) / 2 - y[order]) / pixel + height / 2).astype(np.int64)[:, None] + dy
    rgb = np.clip(np.array(CLAY) * _brightness(normals[order], right, up, back)[:, None], 0, 1)
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    picture = np.ones((height, width, 3))
    picture[row[inside], column[inside]] = np.repeat(rgb, inside.sum(1), axis=0)
    return picture


def _barycentric(surface: IndexedMesh, face: ndarray, p: Float[ndarray, "n 3"]) -> Float[ndarray, "n 3"]:
    (a, b, c), normal = surface.corners(face), surface.face_cross[face]
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
    values: Float[ndarray, "n"], scale: ColourScale, no_surface: Bool[ndarray, "n"]
) -> Float[ndarray, "n 3"]:
    """Colours of residuals; grey where there is no value, blue where there is no surface."""
    rgb = scale(np.nan_to_num(values))
    rgb[np.isnan(values)] = NO_VALUE
    rgb[no_surface] = NO_SURFACE
    return rgb


NO_VALUE = (0.78, 0.80, 0.82)
NO_SURFACE = (0.18, 0.42, 0.75)

INK, MUTED, GRID = "#1d2733", "#66727f", "#dfe4e9"
BLUE, ORANGE = "#2563a8", "#c2571a"
_RC = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 9,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.spines.top": False,
    "axes.spines.right": False,
}


def frame_bars(title: str, unit: str, series: Mapping[str, Sequence[float]], wide: bool = False) -> str:
    """Bars per frame, several series, by their names, side by side; `wide` fills the width of the page."""
    with matplotlib.rc_context(_RC):
        figure, axes = _figure(10.4 if wide else 5.4, 2.1)
        width = 0.8 / len(series)
        for k, (label, values) in enumerate(series.items()):
            x = np.arange(len(values)) + (k - (len(series) - 1) / 2) * width
            y = np.nan_to_num(np.asarray(values, np.float64))
            axes.bar(x, y, width, color=(BLUE, ORANGE)[k % 2], label=label)
        axes.set_xlim(-0.7, len(next(iter(series.values()))) - 0.3)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("frame")
        axes.set_ylabel(unit)
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        if len(series) > 1:
            place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1, 0.98), "borderaxespad": 0}
            axes.legend(frameon=False, fontsize=8, ncols=len(series), **place)
        return _svg(figure, title)


def histogram(title: str, unit: str, values: Float[ndarray, "n"], lower: float, upper: float) -> str:
    """Share of the values in each bin between two limits; values outside count in the outermost bins."""
    with matplotlib.rc_context(_RC):
        figure, axes = _figure(5.4, 2.1)
        share = np.full(len(values), 100 / max(len(values), 1))
        axes.hist(np.clip(values, lower, upper), bins=61, range=(lower, upper), weights=share, color=BLUE)
        axes.set_xlabel(unit)
        axes.set_ylabel("% of the surface")
        axes.set_xlim(lower, upper)
        return _svg(figure, title)


def curve(title: str, step: Sequence[float | int | None], values: Sequence[float | int | None]) -> str:
    """A convergence curve; logarithmic where positive values span more than a factor of 20."""
    with matplotlib.rc_context(_RC):
        figure, axes = _figure(2.9, 1.7)
        x, y = np.asarray(step, np.float64), np.asarray(values, np.float64)
        known = np.isfinite(x) & np.isfinite(y)
        x, y = x[known], y[known]
        axes.plot(x, y, color=BLUE, linewidth=1.2, marker="." if len(x) == 1 else "")
        if len(y) and y.min() > 0 and y.max() / y.min() > 20:
            axes.set_yscale("log")
        axes.set_title(title, fontsize=9, color=INK, loc="left")
        axes.set_xlabel("iteration")
        return _svg(figure, title)


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasSVG(figure)
    figure.patch.set_alpha(0)
    axes = figure.add_subplot()
    axes.patch.set_alpha(0)
    axes.grid(axis="y", color=GRID, linewidth=0.8)
    axes.set_axisbelow(True)
    return figure, axes


def _svg(figure: Figure, title: str) -> str:
    """The figure as an <svg> element with a title for screen readers."""
    buffer = io.StringIO()
    # One salt per chart: the ids of several charts on one page must differ, and every run must give the same.
    with matplotlib.rc_context({"svg.hashsalt": title}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    prefix = "c" + format(zlib.crc32(title.encode()), "x") + "-"
    text = re.sub(r'\bid="', f'id="{prefix}', text)
    text = re.sub(r'(xlink:href="#|url\(#)', lambda m: m.group(1) + prefix, text)
    head = f'<svg role="img" aria-label="{escape(title)}" class="chart"'
    return text.replace("<svg", head, 1)


def nice_limit(value: float) -> float:
    """The smallest number of 1, 2, 5 times a power of ten that is at least `value`."""
    if not math.isfinite(value) or value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (1, 2, 5, 10) if k * power >= value * (1 - 1e-12))


# Filling in the HTML templates of the reports.


def page(name: str, values: dict[str, Any], **filters: Callable[..., str]) -> str:
    """The template `name` of this package, filled in; `filters` are its own, besides those for numbers.

    Raises if the template uses an unknown value.
    """
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("sl_nerfstudio.evaluation.report"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"number": _number, "fixed": _fixed, "percent": _percent, **filters}
    return environment.get_template(name).render(values)


def _number(value: float | None, digits: int = 3) -> str:
    """Three significant digits, a dash where there is no value."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0 or 1e-4 <= abs(value) < 1e5:
        return f"{value:#.{digits}g}".rstrip(".") if value else "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def _fixed(value: float | None, decimals: int = 2) -> str:
    """A fixed number of decimals, a dash where there is no value."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{decimals}f}"


def _percent(value: float | None, decimals: int = 1) -> str:
    return "–" if value is None or not math.isfinite(value) else f"{100 * value:.{decimals}f} %"


# A drawing of which frames were registered with which.

_SIZE, _RADIUS = 460.0, 185.0
_WEAK = 0.7  # fitness below which an edge is drawn as weak


def draw_overlaps(frames: Sequence[FrameRecord], edges: Sequence[EdgeRecord]) -> str:
    """An <svg> of the frames on a circle, in order; thick lines mean large overlap, dashed ones were rejected."""
    place = {f.name: _place(k, len(frames)) for k, f in enumerate(frames)}
    lines = [_line(place, edge) for edge in sorted(edges, key=lambda e: e.used) if set(edge.frames) <= place.keys()]
    nodes = [_node(frame, place[frame.name], str(k)) for k, frame in enumerate(frames)]
    return (
        f'<svg role="img" aria-label="Overlap graph" class="chart" viewBox="0 0 {_SIZE:g} {_SIZE:g}" '
        f'style="max-width:{_SIZE:g}px">{"".join(lines + nodes)}</svg>'
    )


def _place(index: int, count: int) -> tuple[float, float]:
    angle = 2 * math.pi * index / max(count, 1) - math.pi / 2
    return _SIZE / 2 + _RADIUS * math.cos(angle), _SIZE / 2 + _RADIUS * math.sin(angle)


def _line(place: dict[str, tuple[float, float]], edge: EdgeRecord) -> str:
    (x1, y1), (x2, y2) = (place[name] for name in edge.frames)
    colour = MUTED if not edge.used else ORANGE if edge.fitness < _WEAK or edge.undecided else BLUE
    width = 0.8 + 4 * max(0.0, min(edge.overlap, 1.0))
    dashed = "" if edge.used else ' stroke-dasharray="4 4" opacity="0.6"'
    title = f"{edge.frames[0]} – {edge.frames[1]}: overlap {edge.overlap:.0%}, agreement {edge.fitness:.0%}"
    return (
        f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="{colour}" '
        f'stroke-width="{width:.1f}"{dashed}><title>{escape(title)}</title></line>'
    )


def _node(frame: FrameRecord, place: tuple[float, float], label: str) -> str:
    x, y = place
    fill = "#f6c7c2" if not frame.in_scan else "#f7dc8f" if frame.undecided else "#ffffff"
    return (
        f'<g><title>{escape(frame.name)}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="11" fill="{fill}" '
        f'stroke="{INK}"/><text x="{x:.1f}" y="{y + 3.5:.1f}" text-anchor="middle" font-size="10" '
        f'fill="{INK}">{escape(label)}</text></g>'
    )


# What the interactive view of the surface can be coloured by.


@dataclass(frozen=True)
class ColourLayer:
    """A value of every vertex with its colours."""

    name: str
    values: Float[ndarray, "v"]
    scale: ColourScale
    units: str


def colour_layers(
    error: Float[ndarray, "v"] | None,
    error_scale: ColourScale | None,
    quality: VertexQuality | None,
    units: str,
    error_units: str,
) -> list[ColourLayer]:
    """The error, where the truth is known, and what the mesh file says of its vertices, where it does.

    Vertices that no frame confirms have no sigma and no residual: they get the colour of the worst.
    """
    layers = []
    if error is not None and error_scale is not None:
        layers.append(ColourLayer("error", error, error_scale, error_units))
    if quality is not None and (quality.views > 0).any():
        most_views = ColourScale("viridis", 0.0, float(quality.views.max()))
        angles = ColourScale("viridis", 0.0, nice_limit(float(np.nanpercentile(quality.ray_angle, 95))))
        layers += [
            _from_zero("uncertainty (1 sigma)", quality.sigma, units),
            ColourLayer("views", quality.views.astype(np.float64), most_views, "frames"),
            _from_zero("residual", quality.residual, "px"),
            ColourLayer("ray angle", np.nan_to_num(quality.ray_angle), angles, "degrees"),
        ]
    return layers


def _from_zero(name: str, values: Float[ndarray, "v"], units: str) -> ColourLayer:
    """Dark is small and good; values that are not known lie beyond the scale."""
    limit = nice_limit(float(np.nanpercentile(values, 95)))
    return ColourLayer(name, np.nan_to_num(values, nan=2 * limit), ColourScale("inferno", 0.0, limit), units)

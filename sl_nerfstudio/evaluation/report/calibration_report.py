"""The report of `sl-calibrate`: what was found in every photograph, and how far the result can be trusted."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy import ndarray

from sl_nerfstudio.calibration.board.calibrate import BoardCalibration
from sl_nerfstudio.calibration.board.captures import BoardCaptures, BoardPicture
from sl_nerfstudio.calibration.board.detection import Corners
from sl_nerfstudio.evaluation.report import charts
from sl_nerfstudio.evaluation.report.pages import page
from sl_nerfstudio.evaluation.report.pictures import data_uri
from sl_nerfstudio.geometry.devices import PARAMETERS, Device
from sl_nerfstudio.verdict.calibration import DEVICES, shortcomings
from sl_nerfstudio.verdict.verdict import Verdict

TITLE = b"<title>Calibration report"
"""By which an earlier report is known."""
_THUMBNAIL = 360  # pixels
_ARROW = 0.06  # of the image's width: length of the arrow of the largest usual residual


@dataclass(frozen=True)
class PoseCard:
    """One pose of the board."""

    picture: str  # data address
    name: str
    problem: str | None
    figures: tuple[tuple[str, float, float, int], ...]  # device, RMS, predicted error when left out, corners


@dataclass(frozen=True)
class DeviceTable:
    """The numbers of a device, with their standard deviations."""

    name: str
    device: Device
    rows: tuple[tuple[str, float, float], ...]
    model: str
    rms_px: float
    left_out_px: float
    field: str  # data address: residuals over the image


def render_calibration_report(
    found: BoardCalibration, captures: BoardCaptures, verdict: Verdict, next_pose: str, command: str
) -> str:
    """The page as text. `next_pose` is the sentence on what to add."""
    values = {
        "found": found,
        "verdict": verdict,
        "next_pose": next_pose,
        "command": command,
        "lacking": shortcomings(found),
        "devices": [_device_table(found, k) for k in range(len(found.sigmas))],
        "models": [(DEVICES[one.device], one) for one in found.models],
        "cards": _cards(found, captures.pictures),
        "chart": _chart(found),
    }
    return page("calibration.html.j2", values)


def _device_table(found: BoardCalibration, k: int) -> DeviceTable:
    device, sigma = found.adjusted.rig.devices[k], found.sigmas[k]
    rows = tuple((key, getattr(device, key), sigma.values[key]) for key in PARAMETERS if sigma.values[key])
    corners = [view.camera if k == 0 else view.projector for view in found.views]
    field = _residual_field(device, corners, found.residuals[k])
    return DeviceTable(DEVICES[k], device, rows, str(found.free[k]), found.rms_px[k], found.left_out.error_px[k], field)


def _cards(found: BoardCalibration, pictures: Sequence[BoardPicture]) -> list[PoseCard]:
    number = {view.name: k for k, view in enumerate(found.views)}
    out = []
    for picture in pictures:
        place, figures = number.get(picture.name), []
        if place is not None:
            for k, residuals in enumerate(found.residuals):
                r = residuals[place]
                if len(r):
                    rms = float(np.sqrt((r**2).mean()))
                    figures.append((DEVICES[k], rms, float(found.left_out.by_view_px[k, place]), len(r)))
        out.append(PoseCard(_thumbnail(picture), picture.name, picture.problem, tuple(figures)))
    return out


def _chart(found: BoardCalibration) -> str:
    series = [
        charts.Bars(DEVICES[k], [float(np.sqrt((r**2).mean())) if len(r) else np.nan for r in residuals])
        for k, residuals in enumerate(found.residuals)
    ]
    return charts.frame_bars("Residual of the corners by pose (RMS)", "px", series, wide=True)


def _thumbnail(picture: BoardPicture) -> str:
    """The photograph with the corners that were found."""
    grey = picture.grey / max(float(np.quantile(picture.grey, 0.99)), 1e-3)
    factor = _THUMBNAIL / grey.shape[1]

    def draw(axes: Axes) -> None:
        axes.imshow(np.clip(grey, 0, 1), cmap="gray", vmin=0, vmax=1, extent=(0, grey.shape[1], grey.shape[0], 0))
        if picture.corners is not None:
            axes.plot(*picture.corners.uv.T, "+", color=charts.ORANGE, markersize=4, markeredgewidth=0.8)
        axes.set_xlim(0, grey.shape[1])
        axes.set_ylim(grey.shape[0], 0)
        axes.axis("off")

    return data_uri(_drawn(_THUMBNAIL, round(grey.shape[0] * factor), draw, 0.0))


def _residual_field(
    device: Device, corners: Sequence[Corners | None], residuals: Sequence[Float64[ndarray, "_ 2"]]
) -> str:
    """Residuals as arrows over the image, all enlarged alike; a pattern in them shows what the model lacks."""
    uv = np.concatenate([one.uv for one in corners if one is not None and len(one.uv)])
    r = np.concatenate([one for one in residuals if len(one)])
    usual = max(float(np.quantile(np.linalg.norm(r, axis=1), 0.95)), 1e-9)
    scale = _ARROW * device.w / usual
    low, high = np.minimum(uv.min(0), 0), np.maximum(uv.max(0), (device.w, device.h))

    def draw(axes: Axes) -> None:
        axes.quiver(*uv.T, *(r * scale).T, angles="xy", scale_units="xy", scale=1, width=0.0018, color=charts.BLUE)
        axes.plot([device.cx], [device.cy], "x", color=charts.ORANGE, markersize=7)
        axes.add_patch(Rectangle((0, 0), device.w, device.h, fill=False, color=charts.MUTED))
        axes.set_aspect("equal")
        axes.set_xlim(min(low[0], device.cx) - 0.02 * device.w, max(high[0], device.cx) + 0.02 * device.w)
        axes.set_ylim(max(high[1], device.cy) + 0.02 * device.h, min(low[1], device.cy) - 0.02 * device.h)
        axes.set_title(f"residuals, enlarged {scale:.0f} times; x: principal point", fontsize=8, color=charts.MUTED)
        axes.tick_params(labelsize=7)

    return data_uri(_drawn(640, 520, draw, 0.07), quality=90)


def _drawn(w: int, h: int, draw: Callable[[Axes], None], margin: float) -> Float[ndarray, "h w 3"]:
    figure = Figure(figsize=(w / 100, h / 100), dpi=100)
    canvas = FigureCanvasAgg(figure)
    draw(figure.add_axes((margin, margin, 1 - 1.3 * margin, 1 - 2 * margin)))
    canvas.draw()
    return np.asarray(canvas.buffer_rgba(), np.float64)[..., :3] / 255

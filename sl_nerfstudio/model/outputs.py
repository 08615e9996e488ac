"""The model's outputs outside training: images for viewer, exporters and evaluation."""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Protocol, runtime_checkable

import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor, nn

from sl_nerfstudio.bundle_adjustment.covariance import JointCovariance
from sl_nerfstudio.bundle_adjustment.parameters import SelfCalibration
from sl_nerfstudio.dataparser.dataparser import PixelSamples
from sl_nerfstudio.geometry.devices import Intrinsics, project
from sl_nerfstudio.geometry.lie import DevicePoses, Similarity, inverse, transform
from sl_nerfstudio.geometry.numerics import MAD_TO_SIGMA
from sl_nerfstudio.geometry.triangulation import epipolar_residual, triangulate
from sl_nerfstudio.rendering.direct_losses import DecodingNoise
from sl_nerfstudio.rendering.renderer import Ends, Renderer
from sl_nerfstudio.rendering.volume_rendering import Rendered
from sl_nerfstudio.scan import Scan


@runtime_checkable
class TrainedModel(Protocol):
    """What viewer and export need of a model; the field is in the scene frame."""

    scan: Scan
    S_scene_world: Similarity
    viewed_frame: int  # whose projector lights what is rendered from a free viewpoint

    @property
    def step(self) -> int:
        """The step of the training."""
        ...

    @property
    def cell(self) -> float:
        """Length of the field's finest cells, in the scan's unit."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the field is evaluated."""
        ...

    def sdf(self, p_scene: Float[Tensor, "n 3"]) -> Float[Tensor, "n"]:
        """Signed distance in scene units."""
        ...

    def poses(self) -> DevicePoses:
        """Current poses of cameras and projectors in the scan's world and unit."""
        ...

    def poses_scene(self) -> tuple[Float[Tensor, "frames 4 4"], Float[Tensor, "frames 4 4"]]:
        """Current poses of cameras and projectors in the scene."""
        ...

    def pose_sigma(self) -> Float[ndarray, "frames 4"] | None:
        """One sigma of each frame's poses, in the order of PoseSigma's fields; None if it was not estimated."""
        ...

    def joint_covariance(self) -> JointCovariance | None:
        """Covariance of all poses and the intrinsics in the scan's world and unit; None if it was not estimated."""
        ...

    def unplaced(self) -> list[bool]:
        """Of each frame, whether it does not agree with the others."""
        ...

    def self_calibration(self) -> SelfCalibration | None:
        """How well the intrinsics agree with the captures; None where poses were not adjusted."""
        ...

    def history(self) -> dict[str, list[float]]:
        """Convergence curves, with the steps under `step`."""
        ...


# Decoded coordinates looked up at scene points, for the residual image in the viewer.

_KEPT = 2  # frames whose coordinates stay in memory


class MeasuredCoordinates:
    """The coordinate files of a scan; the frames that were used last stay in memory."""

    def __init__(self, scan: Scan) -> None:
        self._scan = scan
        self._image = lru_cache(maxsize=_KEPT)(self._read)

    def at(
        self, p: Float[Tensor, "n 3"], views: Int[Tensor, "n"], T_camera_scene: Float[Tensor, "frames 4 4"]
    ) -> Float[Tensor, "n 2"]:
        """The coordinates decoded at the pixels where frames `views` see scene points; NaN where not decoded."""
        result = torch.full_like(p[:, :2], float("nan"))
        for view in views.unique().tolist():
            mine = views == view
            camera = self._scan.frames[view].camera
            uv, in_front = project(Intrinsics.of(camera).to(p.device), transform(T_camera_scene[view], p[mine]))
            inside = in_front & (uv >= 0).all(-1) & (uv < uv.new_tensor([camera.w, camera.h])).all(-1)
            pixel = torch.where(inside[:, None], uv, 0.0).long()
            decoded = self._image(view).to(p.device)[pixel[:, 1], pixel[:, 0]]
            result[mine] = torch.where(inside[:, None], decoded, float("nan"))
        return result

    def _read(self, view: int) -> Float[Tensor, "h w 2"]:
        return torch.from_numpy(self._scan.frames[view].read_coords())


# How well a scan's coordinates are decoded, measured once before the first step.

_PER_FRAME = 2000  # pixels
_LEAST_PX = 0.02  # smallest plausible noise, pattern pixels


@torch.no_grad()
def measure_decoding(
    scan: Scan, samples: PixelSamples, T_scene_camera: Float[Tensor, "n 4 4"], T_scene_projector: Float[Tensor, "n 4 4"]
) -> DecodingNoise:
    """Robust 1 sigma of the epipolar residual, and the median slope of coordinates along camera rays."""
    residuals, slopes = [], []
    projector = Intrinsics.of(scan.projector, torch.float64)
    for number, frame in enumerate(scan.frames):
        pixels = samples.some_of(number, _PER_FRAME)
        ok = pixels.decoded
        seen = Intrinsics.of(frame.camera, torch.float64), T_scene_camera[number], pixels.uv[ok].double()
        arguments = (*seen, projector, T_scene_projector[number], pixels.coords[ok].double())
        residuals.append(epipolar_residual(*arguments).abs())
        slopes.append(1 / triangulate(*arguments).sigma_depth)
    residual, slope = torch.cat(residuals), torch.cat(slopes)
    finite = residual.isfinite() & slope.isfinite()
    sigma = float(residual[finite].median()) * MAD_TO_SIGMA
    return DecodingNoise(max(sigma, _LEAST_PX), float(slope[finite].median()))


# Convergence curves that are saved in the checkpoint.

_ROWS = 512


class History(nn.Module):
    """A table of values over the run, thinned out when full, so that a run of any length fits."""

    table: Tensor
    state: Tensor

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        self.register_buffer("table", torch.full((_ROWS, len(names) + 1), float("nan"), dtype=torch.float64))
        self._used = 0  # rows
        self._arrived: Tensor | None = None
        self.every = 5
        """Steps between two entries."""
        self.register_buffer("state", torch.tensor([self._used, self.every]))  # the same two, for the checkpoint
        self.register_load_state_dict_post_hook(_read_state)
        self.register_state_dict_pre_hook(_write_state)

    @torch.no_grad()
    def add(self, step: int, values: Mapping[str, Float[Tensor, ""]]) -> None:
        """Append one row; missing values are NaN. When the table is full, every other row is removed.

        Values on a GPU stay there, so that the host need not wait for them.
        """
        row = self.table[self._used]
        row[1:] = torch.stack([values.get(name, row[0]) for name in self.names])  # unused rows are NaN
        row[0].fill_(step)
        self._send(row)
        self._used += 1
        if self._used == _ROWS:
            kept = self.table[::2].clone()
            self.table.fill_(float("nan"))
            self.table[: len(kept)] = kept
            self._used = len(kept)
            self.every *= 2

    def latest(self, name: str) -> float:
        """The value of the last row that has arrived at the host since the start, NaN if there is none."""
        return float("nan") if self._arrived is None else float(self._arrived[1 + self.names.index(name)])

    def _send(self, row: Tensor) -> None:
        """Copy a row to where the host reads it without waiting: from a GPU it arrives when the GPU is that far."""
        if row.device.type == "cpu":
            self._arrived = row.clone()
            return
        if self._arrived is None:
            self._arrived = torch.full((len(row),), float("nan"), dtype=row.dtype, device="cpu", pin_memory=True)
        self._arrived.copy_(row, non_blocking=True)

    def curves(self) -> dict[str, list[float]]:
        """Columns by name, `step` first."""
        rows = self.table[: self._used].cpu()
        return {name: rows[:, i].tolist() for i, name in enumerate(("step", *self.names))}


def _write_state(history: History, *_: object) -> None:
    """Before a checkpoint is written."""
    history.state.copy_(torch.tensor([history._used, history.every]))


def _read_state(history: History, _: object) -> None:
    """After a checkpoint was loaded."""
    history._used, history.every = history.state.tolist()


_OPAQUE = 0.5
_MODULO = 128.0  # pattern pixels of one cycle of the coordinate colours
_RESIDUAL_WHITE_PX = 5.0
_NOTHING = {"depth": 1e3, "normals": 0.5}  # outputs of a ray that sees nothing; the others are 0


@torch.no_grad()
def ray_outputs(
    renderer: Renderer,
    origins: Float[Tensor, "rays 3"],
    directions: Float[Tensor, "rays 3"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
    view: Int[Tensor, "rays"],
    ends: Ends | None = None,
) -> dict[str, Tensor]:
    """Float images of 1 or 3 channels: those that nerfstudio's viewer, renderer and exporters need, and our own.

    `view` is the frame whose projector lights each ray. `depth` is the distance along the unit ray, in scene units, and
    1000 where there is no object. Rays that pass the surface at a distance are not rendered: in most images they are
    most rays.
    """
    near = renderer.near_surface(origins, directions, ends)
    if near.all():
        return _rendered(renderer, origins, directions, T_scene_projector, view, ends)
    some_ends = None if ends is None else (ends[0][near], ends[1][near])
    some = _rendered(renderer, origins[near], directions[near], T_scene_projector, view[near], some_ends)
    outputs = {}
    for name, values in some.items():
        outputs[name] = values.new_full((len(near), values.shape[1]), _NOTHING.get(name, 0.0))
        outputs[name][near] = values
    return outputs


def _rendered(
    renderer: Renderer,
    o: Float[Tensor, "rays 3"],
    d: Float[Tensor, "rays 3"],
    T_scene_projector: Float[Tensor, "frames 4 4"],
    view: Int[Tensor, "rays"],
    ends: Ends | None,
) -> dict[str, Tensor]:
    seen = renderer.render(o, d, inverse(T_scene_projector)[view], renderer.image_samples, jitter=False, ends=ends)
    p = o + seen.depth[:, None] * d
    normal = torch.nn.functional.normalize(renderer.field.sdf_and_gradient(p)[1].detach(), dim=-1)
    opaque = seen.accumulation > _OPAQUE
    lit = renderer.is_lit(p, normal, T_scene_projector[view, :3, 3]) & opaque
    facing = (-(normal * d).sum(-1)).clamp(0, 1)
    shade = (0.15 + 0.35 * facing + 0.5 * facing * torch.where(lit, seen.pattern, 0.0)) * opaque
    return {
        "rgb": shade[:, None].expand(-1, 3).contiguous(),
        "accumulation": seen.accumulation[:, None],
        "depth": torch.where(opaque, seen.depth, 1e3)[:, None],
        "normals": torch.where(opaque[:, None], 0.5 * normal + 0.5, 0.5),
        "pattern": torch.where(lit, seen.pattern, 0.0)[:, None],
        "coordinates": coordinate_colours(seen.coordinates, lit),
        "coordinate_x": torch.where(opaque, seen.coordinates[:, 0], 0.0)[:, None],
        "coordinate_y": torch.where(opaque, seen.coordinates[:, 1], 0.0)[:, None],
    }


def picture_outputs(outputs: dict[str, Tensor], measured: Float[Tensor, "rays 2"]) -> dict[str, Tensor]:
    """The outputs of an image's rays as pictures, with the residual to measured coordinates.

    Grey pictures have three equal channels: nerfstudio would give a single one false colours. The coordinates
    themselves, in pattern pixels, are no picture and are left out.
    """
    pictures = {name: values for name, values in outputs.items() if name not in ("coordinate_x", "coordinate_y")}
    grey = {"pattern": outputs["pattern"], "residual": residual_output(outputs, measured)}
    return pictures | {name: values.expand(-1, 3).contiguous() for name, values in grey.items()}


def residual_output(outputs: dict[str, Tensor], measured: Float[Tensor, "rays 2"]) -> Float[Tensor, "rays 1"]:
    """Distance between rendered and measured coordinates as brightness; 0 beside the object and where not decoded."""
    rendered = torch.cat([outputs["coordinate_x"], outputs["coordinate_y"]], -1)
    share = torch.nan_to_num((rendered - measured).norm(dim=-1) / _RESIDUAL_WHITE_PX, nan=0.0)
    opaque = outputs["accumulation"][:, 0] > _OPAQUE
    return torch.where(opaque, share, 0.0).clamp(0, 1)[:, None]


def coordinate_colours(uv: Float[Tensor, "n 2"], valid: Tensor) -> Float[Tensor, "n 3"]:
    """The usual colours of a coordinate image: x modulo 128 in red, y modulo 128 in green."""
    turn = uv.remainder(_MODULO) / _MODULO
    colour = torch.cat([turn, torch.full_like(turn[:, :1], 0.2)], -1)
    return torch.where(valid[:, None], colour, 0.0)


def seen_by_rays(
    outputs: dict[str, Any],
) -> tuple[Float[Tensor, "rays 2"], Float[Tensor, "rays"], Bool[Tensor, "rays"]] | None:
    """Rendered coordinates and pattern, and which rays meet something lit; None in steps that render nothing."""
    if "rendered" in outputs:
        rendered: Rendered = outputs["rendered"]
        return rendered.coordinates, rendered.pattern, rendered.lit > 0.5
    if "coordinate_x" not in outputs:
        return None
    coordinates = torch.cat([outputs["coordinate_x"], outputs["coordinate_y"]], -1)
    return coordinates, outputs["pattern"][:, 0], outputs["accumulation"][:, 0] > _OPAQUE


@torch.no_grad()
def fit_metrics(outputs: dict[str, Any], batch: dict[str, Tensor]) -> dict[str, Tensor]:
    """Median coordinate residual (pattern pixels) and cosine of rendered and captured pattern."""
    seen = seen_by_rays(outputs)
    if seen is None:
        return {}
    coordinates, pattern, _ = seen
    n = len(pattern)
    error = (coordinates - batch["coords"][:n]).norm(dim=-1)
    return {
        "coordinate_px": _median(error, batch["decoded"][:n, 0]),
        "pattern_cosine": torch.nn.functional.cosine_similarity(pattern, batch["pattern"][:n, 0], dim=0),
    }


def _median(values: Float[Tensor, "n"], counts: Bool[Tensor, "n"]) -> Float[Tensor, ""]:
    """The lower median of the values that count, NaN if there is none; on a GPU the host need not know how many."""
    last = torch.where(counts, values, torch.inf).sort().values
    number = counts.sum()
    middle = last.gather(0, ((number - 1) // 2).clamp_min(0)[None])[0]
    return torch.where(number > 0, middle, torch.nan)

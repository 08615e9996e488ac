"""What Python programs need and no single function elsewhere does: arrays in, arrays and our dataclasses out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, UInt8, UInt16
from numpy import ndarray

from sl_nerfstudio.console import say
from sl_nerfstudio.decoding.decoder import Decoded
from sl_nerfstudio.decoding.decoders import choose_decoder
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.evaluation.report.capture_reports import render_processing_report
from sl_nerfstudio.geometry.devices import Device, Intrinsics
from sl_nerfstudio.geometry.triangulation import triangulate
from sl_nerfstudio.meshing.mesh import Mesh, VertexProperties
from sl_nerfstudio.meshing.uncertainty import vertex_uncertainty
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.processing.config import ProcessConfig
from sl_nerfstudio.processing.process import process
from sl_nerfstudio.processing.result import ProcessResult
from sl_nerfstudio.runs.export import build_surface
from sl_nerfstudio.runs.export_settings import ExportSettings
from sl_nerfstudio.runs.run import TrainedRun
from sl_nerfstudio.scan.images import read_photograph
from sl_nerfstudio.scan.write import device_fields, encode_json
from sl_nerfstudio.storage import write_atomic

Image = UInt8[ndarray, "h w *c"] | UInt16[ndarray, "h w *c"]


def decode_image(
    capture: Path | str | Image | Sequence[Path] | Sequence[Image], pattern: PatternLayout | Path | str
) -> Decoded:
    """Find out which point of the pattern lights each pixel of a capture.

    Args:
        capture: one photograph, as a file or as an array (h, w) grey or (h, w, 3) RGB, linear or gamma-encoded; of a
            Gray code one for each image of the sequence, in its order.
        pattern: what was projected: a layout, or its pattern.json.

    Every pixel is decoded; of large photographs, 12 pixels a period of the pattern are enough and far faster.
    Returns coordinates (h, w, 2) in projector pixels, NaN where they are not known, the mask (h, w) that the pattern
    lights, and the normalised pattern (h, w). Raises UserError for files that cannot be read, and DecodingError, one
    of those, for a capture in which the pattern is not found.
    """
    path = Path("pattern.json") if isinstance(pattern, PatternLayout) else Path(pattern)
    layout = pattern if isinstance(pattern, PatternLayout) else read_layout(path)
    decoder = choose_decoder(layout, None, path)
    captures = [capture] if isinstance(capture, Path | str | ndarray) else list(capture)
    if len(captures) != 1 and not decoder.sequence:
        raise UserError(
            f"{len(captures)} images of {layout.description}, which a single one shows\n"
            "    remedy: decode them one by one"
        )
    names = [f"image {k}" if isinstance(one, ndarray) else Path(one).name for k, one in enumerate(captures)]
    images = [one if isinstance(one, ndarray) else read_photograph(Path(one)) for one in captures]
    return decoder.decode(images, names)


def triangulate_pixels(
    camera: Device,
    T_world_camera: Float[ndarray, "4 4"],
    uv_camera: Float[ndarray, "n 2"],
    projector: Device,
    T_world_projector: Float[ndarray, "4 4"],
    uv_projector: Float[ndarray, "n 2"],
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n"]]:
    """Points where the rays of camera pixels and projector pixels meet.

    Args:
        camera: its intrinsics.
        T_world_camera: its pose, device to world; devices look along -z, +y is up.
        uv_camera: pixels (x, y) from the image's corner: the centre of the first one is (0.5, 0.5).
        projector: its intrinsics.
        T_world_projector: its pose.
        uv_projector: the pixels of the pattern that correspond.

    Returns the points in the unit of the poses, NaN where rays are parallel, and the 1 sigma of each along its camera
    ray for coordinate noise of one projector pixel.
    """

    def tensor(values: ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values, np.float64))

    def intrinsics(device: Device) -> Intrinsics:
        return Intrinsics.of(device, torch.float64)

    found = triangulate(
        intrinsics(camera), tensor(T_world_camera), tensor(uv_camera),
        intrinsics(projector), tensor(T_world_projector), tensor(uv_projector),
    )  # fmt: skip
    return found.p_world.numpy(), found.sigma_depth.numpy()


def write_devices(path: Path | str, camera: Device | None, projector: Device | None) -> None:
    """Write intrinsics as the JSON that `read_device_file` and `sl-process --intrinsics` read."""
    both = {"camera": camera, "projector": projector}
    record = {name: device_fields(device, "model") for name, device in both.items() if device is not None}
    write_atomic(Path(path), encode_json(record))


def process_folder(
    images: Path | str, pattern: Path | str, intrinsics: Path | str | None, output: Path | str, **flags: Any
) -> ProcessResult:
    """Make a scan folder from photographs, as `sl-process` does.

    Args:
        images: the folder of the captures.
        pattern: pattern.json of what was projected.
        intrinsics: file of both devices; None: of neither.
        output: the scan folder, new or that of an earlier run with the same captures.
        flags: other fields of `ProcessConfig`, such as `known_length="baseline of frame 0 = 85 mm"`.

    Returns the verdict and what became of every frame; the scan itself is read with `read_scan(output)`. Raises
    UserError for files and flags that are wrong, and if fewer than two frames can be used.
    """
    paths = {"masks", "poses", "projector_intrinsics", "work"}
    flags = {name: Path(value) if name in paths and value is not None else value for name, value in flags.items()}
    config = ProcessConfig(
        Path(images), Path(pattern), None if intrinsics is None else Path(intrinsics), Path(output), **flags
    )
    return process(config, render_processing_report, say)


@dataclass(frozen=True)
class RunSurface:
    """The surface of a trained run, in the scan's unit and axes."""

    mesh: Mesh
    properties: VertexProperties  # its `quality.sigma` is 1 sigma of every vertex along its normal


def surface_of(run: TrainedRun, resolution: int = 512, object_only: bool = False) -> RunSurface:
    """Extract what frames observed of a run's surface, with the uncertainty of every vertex.

    `resolution` is the number of cells along each side of the scene's box; `object_only` removes the plane that the
    object stands on, walls, and what is not connected to it. Raises UserError if no part of the surface was observed.
    """
    model = run.model
    settings = ExportSettings(Path(), resolution=resolution, object_only=object_only)
    found = build_surface(model, settings).marked
    quality = vertex_uncertainty(found.mesh, model.scan, model.poses(), model.joint_covariance(), model.cell)
    return RunSurface(found.mesh, VertexProperties(quality, found.invented))

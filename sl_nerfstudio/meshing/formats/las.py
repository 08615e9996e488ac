"""LAS 1.4 point clouds, which surveying programs read; written by laspy, an optional package."""

import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.meshing.vertex_properties import VertexProperties

_PLAIN, _COLOURED = 6, 7  # point formats
_STEPS = 2**30  # of the largest extent: coordinates are whole numbers


def require_laspy(path: Path) -> None:
    """Raise UserError if laspy is not installed."""
    try:
        import laspy  # noqa: F401
    except ImportError as error:
        raise UserError(
            f"{path}: LAS files need the package laspy\n"
            "    remedy: pip install 'sl-nerfstudio[las]', or give a name that ends in .ply"
        ) from error


def encode_las(
    points_m: Float64[ndarray, "n 3"], normals: Float64[ndarray, "n 3"], properties: VertexProperties, unit_m: float
) -> bytes:
    """Points in metres with the further dimensions `nx ny nz sigma views residual`; `unit_m` is the unit of `sigma`."""
    import laspy

    header = laspy.LasHeader(point_format=_PLAIN if properties.colour is None else _COLOURED, version="1.4")
    header.offsets = points_m.mean(0)
    header.scales = np.full(3, max(float(np.ptp(points_m, axis=0).max()), 1e-9) / _STEPS)
    quality = properties.quality
    extra: dict[str, tuple[type, ndarray]] = {f"n{axis}": (np.float32, normals[:, k]) for k, axis in enumerate("xyz")}
    extra |= {
        "sigma": (np.float32, quality.sigma * unit_m),
        "views": (np.uint16, quality.views),
        "residual": (np.float32, quality.residual),
    }
    header.add_extra_dims([laspy.ExtraBytesParams(name, kind) for name, (kind, _) in extra.items()])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points_m.T
    for name, (kind, values) in extra.items():
        cloud[name] = values.astype(kind)
    if properties.colour is not None:
        cloud.red, cloud.green, cloud.blue = (properties.colour.astype(np.uint16) * 257).T
    buffer = io.BytesIO()
    cloud.write(buffer, do_compress=False)
    return buffer.getvalue()

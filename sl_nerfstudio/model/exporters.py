"""`ns-export` without a GPU: two steps of nerfstudio's that take hours there, replaced by ones that take seconds."""

import sys
from functools import partial

from sl_nerfstudio.model.texture_rays import unwrap_mesh_with_xatlas

_EXPORTER = "nerfstudio.scripts.exporter"


def quicken_exporters() -> None:
    """Called when a run is opened; does nothing in commands other than `ns-export`.

    - A texture's rays are found by drawing triangles; see texture_rays.py.
    - open3d's Poisson reconstruction runs in one thread. Its threads wait for each other in loops: 20,000 points at
      depth 6 took 0.5 s with one thread and more than 30 s with four, on four cores that were not idle.
    """
    exporter = sys.modules.get(_EXPORTER)
    if exporter is None:
        return
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    mesh = exporter.o3d.geometry.TriangleMesh
    poisson = mesh.create_from_point_cloud_poisson
    if not isinstance(poisson, partial):
        mesh.create_from_point_cloud_poisson = partial(poisson, n_threads=1)

"""`ns-export` without a GPU: what takes hours or minutes there in nerfstudio, and how it takes seconds."""

import sys
from functools import partial

from sl_nerfstudio.model.texture_rays import unwrap_mesh_with_xatlas
from sl_nerfstudio.threads import torch_on_one_thread

_EXPORTER = "nerfstudio.scripts.exporter"


def quicken_exporters() -> None:
    """Called when a run is opened; does nothing in commands other than `ns-export`.

    - A texture's rays are found by drawing triangles; see texture_rays.py.
    - open3d's Poisson reconstruction runs in one thread. Its threads wait for each other in loops: 20,000 points at
      depth 6 took 0.5 s with one thread and more than 30 s with four, on four cores that were not idle.
    - So do torch's threads in nerfstudio's own loops over frames: rays of cameras took 27 s of processor time instead
      of 2, the sums of the TSDF 16 instead of 5. Torch gets one thread, our loops keep all.
    """
    exporter = sys.modules.get(_EXPORTER)
    if exporter is None:
        return
    torch_on_one_thread()
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    mesh = exporter.o3d.geometry.TriangleMesh
    poisson = mesh.create_from_point_cloud_poisson
    if not isinstance(poisson, partial):
        mesh.create_from_point_cloud_poisson = partial(poisson, n_threads=1)

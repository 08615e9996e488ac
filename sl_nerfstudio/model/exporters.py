"""`ns-export` without a GPU: what takes hours or minutes there in nerfstudio, and how it takes seconds."""

import sys
from functools import partial
from typing import Any

import numpy as np

from sl_nerfstudio.geometry.spatial_order import spatial_order
from sl_nerfstudio.model.texture_rays import unwrap_mesh_with_xatlas
from sl_nerfstudio.threads import torch_on_one_thread

_EXPORTER = "nerfstudio.scripts.exporter"


def quicken_exporters() -> None:
    """Called when a run is opened; does nothing in commands other than `ns-export`.

    - A texture's rays are found by drawing triangles; see texture_rays.py.
    - open3d's Poisson reconstruction runs in one thread. Its threads wait for each other in loops: 20,000 points at
      depth 6 took 0.5 s with one thread and more than 30 s with four, on four cores that were not idle.
    - So do torch's threads in nerfstudio's own loops over frames: beside other work, the rays of 22 frames took 27 s of
      processor time instead of 0.3, the sums of the TSDF 18 instead of 6. Torch gets one thread, our loops keep all.
    - Points of random pixels come in random order. open3d gets them sorted in space: of a million, it then searches
      outliers in 2 s instead of 10, and reconstructs in 14 s instead of 20.
    """
    exporter = sys.modules.get(_EXPORTER)
    if exporter is None:
        return
    torch_on_one_thread()
    exporter.texture_utils.unwrap_mesh_with_xatlas = unwrap_mesh_with_xatlas
    clouds, meshes = exporter.o3d.geometry.PointCloud, exporter.o3d.geometry.TriangleMesh
    poisson, without_outliers = meshes.create_from_point_cloud_poisson, clouds.remove_statistical_outlier
    if isinstance(poisson, partial):
        return
    meshes.create_from_point_cloud_poisson = partial(_poisson, poisson, n_threads=1)
    clouds.remove_statistical_outlier = lambda *given, **named: _without_outliers(without_outliers, *given, **named)


def _poisson(reconstruct: Any, cloud: Any, *given: Any, **named: Any) -> Any:
    return reconstruct(_sorted(cloud, spatial_order(np.asarray(cloud.points))), *given, **named)


def _without_outliers(remove: Any, cloud: Any, *given: Any, **named: Any) -> tuple[Any, list[int]]:
    """What open3d's method returns: the cloud that remains, and the indices of its points, both in the old order."""
    order = spatial_order(np.asarray(cloud.points))
    kept = np.sort(order[np.asarray(remove(_sorted(cloud, order), *given, **named)[1], dtype=np.int64)]).tolist()
    return cloud.select_by_index(kept), kept


def _sorted(cloud: Any, order: np.ndarray) -> Any:
    """A copy of open3d's cloud with its points, normals and colours in another order."""
    copy = type(cloud)()
    for name in ("points", "normals", "colors"):
        values = getattr(cloud, name)
        if len(values):
            setattr(copy, name, type(values)(np.asarray(values)[order]))
    return copy

"""What `ns-export` gets in place of open3d's functions, against those functions themselves."""

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import open3d as o3d
import pytest
from scipy.spatial import KDTree

from sl_nerfstudio.model import exporters


@pytest.fixture
def cloud() -> Any:
    """A sphere of 4000 points in random order, 40 of them far outside."""
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    p = normals * np.where(np.arange(4000) % 100 == 7, 3.0, 0.5)[:, None]
    found = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(p))
    found.normals = o3d.utility.Vector3dVector(normals)
    found.colors = o3d.utility.Vector3dVector(rng.random((4000, 3)))
    return found


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> Any:
    """open3d's classes as `ns-export` sees them after two runs were opened."""

    class Cloud(o3d.geometry.PointCloud):
        pass

    class Mesh(o3d.geometry.TriangleMesh):
        pass

    monkeypatch.setattr(exporters, "torch_on_one_thread", lambda: None)
    geometry = SimpleNamespace(PointCloud=Cloud, TriangleMesh=Mesh)
    exporter = SimpleNamespace(o3d=SimpleNamespace(geometry=geometry), texture_utils=SimpleNamespace())
    monkeypatch.setitem(sys.modules, "nerfstudio.scripts.exporter", exporter)
    exporters.quicken_exporters()
    first = Mesh.create_from_point_cloud_poisson
    exporters.quicken_exporters()
    assert Mesh.create_from_point_cloud_poisson is first
    return geometry


def test_the_same_outliers_are_removed(cloud: Any, quick: Any) -> None:
    wanted, expected = cloud.remove_statistical_outlier(nb_neighbors=8, std_ratio=1.0)
    found, kept = quick.PointCloud.remove_statistical_outlier(cloud, nb_neighbors=8, std_ratio=1.0)
    assert len(kept) == 3960 and sorted(expected) == kept
    for name in ("points", "normals", "colors"):
        assert np.array_equal(np.asarray(getattr(found, name)), np.asarray(getattr(wanted, name)))


def test_the_reconstructed_surface_is_the_same(cloud: Any, quick: Any) -> None:
    real = cloud.select_by_index(np.flatnonzero(np.arange(4000) % 100 != 7).tolist())
    wanted, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(real, depth=6, n_threads=1)
    found, densities = quick.TriangleMesh.create_from_point_cloud_poisson(real, depth=6)
    assert len(densities) == len(found.vertices) == len(found.vertex_colors)
    distance, near = KDTree(np.asarray(wanted.vertices)).query(np.asarray(found.vertices))
    assert abs(len(found.vertices) - len(wanted.vertices)) < 5 and np.quantile(distance, 0.99) < 1e-4
    colours = np.asarray(found.vertex_colors) - np.asarray(wanted.vertex_colors)[near]
    assert np.quantile(np.abs(colours), 0.99) < 1e-3

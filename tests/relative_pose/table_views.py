"""One frame by formula: a table that fills most of the view, and a bumpy object on it."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Intrinsics, project, unproject
from tests.relative_pose.two_views import CAMERA, PROJECTORS, View, pose_of

NORMAL = np.array([0.0, np.sin(np.radians(50)), np.cos(np.radians(50))])  # the camera looks down at 50 degrees
DISTANCE = 4.5  # of the table from the camera, along its line of sight


@dataclass(frozen=True)
class TableView:
    """A frame and which of its correspondences lie on the object."""

    view: View
    on_object: ndarray

    def noisy(self, table_px: float, object_px: float, seed: int, wrong: float = 0.0) -> View:
        """Noise of each part, and wrong coordinates on both."""
        rng = np.random.default_rng(seed)
        sigma = np.where(self.on_object, object_px, table_px)[:, None]
        uv = self.view.uv_projector + sigma * rng.standard_normal(self.view.uv_projector.shape)
        return replace(self.view, uv_projector=uv).noisy(0.0, seed + 1, wrong)


def table_view(
    share: float,
    projector: str = "pinhole",
    offset: tuple[float, float, float] = (1.0, 0.25, 0.1),
    count: int = 4000,
    seed: int = 0,
    height: float = 0.5,
) -> TableView:
    """`share` of the pixels see the table, the others an object that stands up to `height` above it."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([140, 80], [500, 400], (count, 2))
    d = unproject(Intrinsics.of(CAMERA, torch.float64), torch.from_numpy(uv)).numpy()
    s = DISTANCE * NORMAL[2] / -(d @ NORMAL)  # to the table
    p = d * s[:, None]
    off = np.linalg.norm(uv - [320, 240], axis=1)
    on_object = off < np.quantile(off, 1 - share)
    x, y = 12 * d[:, 0] + seed, 12 * d[:, 1]
    up = height * (0.6 + 0.25 * np.sin(x) * np.cos(y) + 0.15 * np.sin(2.3 * y + 0.5 * x))
    p = np.where(on_object[:, None], d * (s * (1 - up / DISTANCE))[:, None], p)
    T = pose_of(offset, (0.0, 0.0, -DISTANCE), 10.0)
    uv_projector, lit = project(
        Intrinsics.of(PROJECTORS[projector], torch.float64), torch.from_numpy((p - T[:3, 3]) @ T[:3, :3])
    )
    assert lit.all()
    return TableView(View(CAMERA, PROJECTORS[projector], T, uv, uv_projector.numpy(), p), on_object)


def twin_of(T: ndarray) -> ndarray:
    """The other pose of the projector that explains the table (Longuet-Higgins 1986), baseline one.

    Points of the plane `n . p = -D` are mapped by `H = A + (A t) n^T / D`, where A = R^T. Vectors perpendicular to n
    keep their lengths and angles under H, and so do those perpendicular to `c = t + |t|^2 n / 2D`: there H is the
    twin's rotation. What remains of H along c is its translation.
    """
    A, t, D = T[:3, :3].T, T[:3, 3], DISTANCE * NORMAL[2]
    H = A + np.outer(A @ t, NORMAL) / D
    c = t + (t @ t) * NORMAL / (2 * D)
    c = c / np.linalg.norm(c) * np.sign(c[2])  # the plane is in front of the camera
    across = np.cross(NORMAL, c)
    across = across / np.linalg.norm(across)
    inside = np.cross(c, across)
    before = np.stack([across, inside, c], 1)
    after = np.stack([H @ across, H @ inside, np.cross(H @ across, H @ inside)], 1)
    A_twin = after @ before.T
    t_twin = A_twin.T @ (H - A_twin) @ c
    twin = np.eye(4)
    twin[:3, :3], twin[:3, 3] = A_twin.T, t_twin / np.linalg.norm(t_twin)
    return twin

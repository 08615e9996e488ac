"""Frames all around an object at their true places, and pairs that take one side of it for another."""

from copy import copy
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity
from sl_nerfstudio.registration.agreement import Side
from sl_nerfstudio.registration.assembly import PoseGraphSolution
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS
from sl_nerfstudio.registration.surfaces import build_surface_map
from sl_nerfstudio.registration.symmetry import symmetric_turns_deg
from tests.registration.graph_edges import edge
from tests.registration.shaped_clouds import rendered

FRAMES = 8  # all the way around


def write_bar(path: Path) -> None:
    """A bar of 90 mm with a boss on each end, 22 and 12 mm high: nearly the same after half a turn."""
    parts = [trimesh.creation.box((90, 40, 24))]
    for x, height in ((30, 22), (-30, 12)):
        boss = trimesh.creation.box((16, 20, height))
        boss.apply_translation((x, 0, 12 + height / 2))
        parts.append(boss)
    trimesh.util.concatenate(parts).export(path)


class Scan:
    """Frames at their true places, with right pairs of neighbours."""

    def __init__(self, scene: str) -> None:
        made = rendered(scene, tuple(range(FRAMES)), FRAMES, 90)
        rng = np.random.default_rng(0)
        self.nodes = made.S_world_camera
        self.axis = np.zeros(3)
        self.sides = [Side.sampled(build_surface_map(c), 400, rng) for c in made.clouds]
        self.pairs = [self.pair(k, (k + 1) % FRAMES) for k in range(FRAMES)]

    def aside(self, x: float) -> "Scan":
        """The same scan with the world's origin beside the object's axis."""
        other = copy(self)
        other.nodes = [Similarity(1.0, np.eye(3), np.array([x, 0.0, 0.0])) @ node for node in self.nodes]
        other.axis = np.array([x, 0.0, 0.0])
        return other

    def turned(self, i: int, j: int, degrees: float, scale: float = 1.0) -> Similarity:
        """What a pair says that takes one side of the object for another: it is turned about the vertical axis."""
        R = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
        turn = Similarity(scale, R, self.axis - scale * R @ self.axis)
        return self.nodes[j].inverse() @ turn @ self.nodes[i]

    def pair(self, i: int, j: int, rivals: tuple[Rival, ...] = ()) -> PairMatch:
        return edge(self.nodes, i, j, rivals=rivals)

    def turns(self, *others: PairMatch, used: bool = False) -> tuple[float, ...]:
        edges = [*self.pairs, *others]
        consistent = np.array([True] * len(self.pairs) + [used] * len(others))
        return symmetric_turns_deg(
            self.sides, edges, PoseGraphSolution(list(self.nodes), consistent), REGISTRATION_DEFAULTS
        )

"""Edges between frames whose place is known."""

import numpy as np
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.lie import Similarity, exps_at
from sl_nerfstudio.registration.evidence import Commonness
from sl_nerfstudio.registration.pairs import PairMatch, Rival
from sl_nerfstudio.registration.pose_graph import Pivots

NO_SLIP = np.array([0.0, 0, 0, 0, 0, 1, 0])  # the direction of a slip: about the line of sight


def edge(
    nodes: list[Similarity],
    i: int,
    j: int,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
    log_odds: float = 100.0,
    rivals: tuple[Rival, ...] = (),
    sigma_deg: float = 0.5,
    slip_deg: float = 0.0,
) -> PairMatch:
    """What an exact registration of i onto j would say, or one that is off by `noise` radian about the object."""
    S = nodes[j].inverse() @ nodes[i]
    if noise and rng is not None:
        turn = Rotation.from_rotvec(noise * rng.standard_normal(3)).as_matrix()
        c = np.array([0.0, 0.0, -4 / nodes[j].scale])
        S = Similarity(float(np.exp(noise * rng.standard_normal())), turn, c - turn @ c) @ S
    return PairMatch(
        i, j, S, np.eye(7) / max(noise, 1e-3) ** 2, 0.5, 0.98, log_odds, rivals, sigma_deg, slip_deg, NO_SLIP,
        (Commonness.none(1), Commonness.none(1)), (1.0, 1.0),
    )  # fmt: skip


def pivots_of(nodes: list[Similarity]) -> Pivots:
    """The object's centre, four units before every camera."""
    return Pivots(np.array([[0.0, 0.0, -4 / S.scale] for S in nodes]), np.array([1 / S.scale for S in nodes]))


def turned(S: Similarity, degrees: float, centre: np.ndarray, axis: tuple[float, float, float] = (0, 1, 0)):
    """A similarity into the axes of a target, turned there about a point."""
    R = Rotation.from_rotvec(np.radians(degrees) * np.array(axis, dtype=np.float64)).as_matrix()
    return Similarity(1.0, R, centre - R @ centre) @ S


def exp_at(x: np.ndarray, centre: np.ndarray, radius: float, largest_log_scale: float) -> Similarity:
    """The similarity of one increment about a pivot."""
    return exps_at(x[None], centre[None], np.array([radius]), largest_log_scale).each()[0]

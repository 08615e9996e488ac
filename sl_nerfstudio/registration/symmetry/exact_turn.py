"""A turn that a pair of frames says, made as exact as all frames together know it.

A pair is off by degrees and by per cents of scale, which moves edges of the object past each other. A turn that leaves
an object as it is has no scale, and every frame says something of it.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.graph_residuals import Nodes, node_at
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance, agreement
from sl_nerfstudio.registration.settings import RegistrationSettings
from sl_nerfstudio.registration.symmetry.judged import facing


def exact_turn(sides: Sequence[Side], nodes: Nodes, turn: Similarity, settings: RegistrationSettings) -> Similarity:
    """Gauss-Newton from `turn`: rigid, by the point-to-plane distances of every frame, moved, from those it faces."""
    s = settings.symmetry
    centre = _centre(sides, nodes)
    turn = Similarity(1.0, turn.R, turn.points(centre[None])[0] - turn.R @ centre)
    for radii in s.exact_widths:
        width = Tolerance(radii, settings.pair.kernel_sigmas)
        H, g = np.zeros((6, 6)), np.zeros(6)
        for i, j, S in facing(nodes, turn, s.neighbours, settings):
            sums = agreement(sides[i], sides[j], Hypotheses.of(S), width, width, settings.pair.agreement)
            M = _motion_in_camera(node_at(nodes, j), sides[j].map.centroid, centre)
            H += M.T @ sums.H[0] @ M
            g += M.T @ sums.g[0] * node_at(nodes, j).scale
        step = -np.linalg.lstsq(H, g, rcond=s.exact_rcond)[0]
        R = Rotation.from_rotvec(step[3:]).as_matrix()
        turn = Similarity(1.0, R, centre - R @ centre + step[:3]) @ turn
    return turn


def _centre(sides: Sequence[Side], nodes: Nodes) -> Float64[ndarray, "3"]:
    """Of what the frames see."""
    seen = [S.points(sides[k].map.centroid[None])[0] for k, S in enumerate(nodes) if S is not None]
    return np.mean(seen, axis=0)


def _motion_in_camera(
    S_world_camera: Similarity, c_camera: Float64[ndarray, "3"], centre: Float64[ndarray, "3"]
) -> Float64[ndarray, "7 6"]:
    """How a motion (v, w) of the world about `centre` moves a camera's points, (v, w, l) about its own centre.

    Weighted by the camera's unit, so that distances of all cameras count alike.
    """
    to_camera = S_world_camera.R.T
    arm = S_world_camera.points(c_camera[None])[0] - centre
    M = np.zeros((7, 6))
    M[:3, :3] = to_camera / S_world_camera.scale
    M[:3, 3:] = to_camera @ np.cross(np.eye(3), arm).T / S_world_camera.scale
    M[3:6, 3:] = to_camera
    return M * S_world_camera.scale

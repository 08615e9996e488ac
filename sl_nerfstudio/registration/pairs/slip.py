"""How far one frame may slip along the surface of another without anything telling.

A table, or a vase without texture, looks the same after some motions. The normal equations do not show it: noise of the
normals makes information where there is none. So the motion that they know least is tried.
"""

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.linalg import expm

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance, agreement
from sl_nerfstudio.registration.settings import PairSettings
from sl_nerfstudio.registration.surface_map import SurfaceMap


def weakest_rotation(information: Float64[ndarray, "7 7"]) -> Float64[ndarray, "7"]:
    """The increment (v, w, l) with |w| = 1 that is known least, with translation and scale free to follow."""
    other = [0, 1, 2, 6]
    follow = -np.linalg.solve(information[np.ix_(other, other)], information[other][:, 3:6])
    reduced = information[3:6, 3:6] + information[3:6][:, other] @ follow
    w = np.linalg.eigh(reduced)[1][:, 0]
    x = np.zeros(7)
    x[3:6], x[other] = w, follow @ w
    return x


def slip_deg(
    sides: tuple[Side, Side],
    S_target_source: Similarity,
    direction: Float64[ndarray, "7"],
    common: Tolerance,
    settings: PairSettings,
) -> float:
    """The largest of some angles, in degrees, up to which a motion in either sense is not noticed; 0 where all are.

    A motion is noticed where the mean robust cost of the points rises, with a kernel as narrow as the surfaces agree,
    though everything but its rotation may follow: the axis of a surface of revolution is never known exactly.
    """
    surface, unit = sides[1].map, Tolerance(0.0, common.sigmas / settings.common_rms)
    angles = np.array([0.0, *settings.slip_angles_deg])
    least = np.full(len(angles), np.inf)
    for sense in (1.0, -1.0):
        moved = Hypotheses.joined(
            [
                Hypotheses.of(screw_motion(sense * angle * direction, surface) @ S_target_source)
                for angle in np.radians(angles)
            ]
        )
        for _ in range(settings.slip_steps):
            moved = _followed(sides, moved, direction[3:6], Tolerance(0.0, common.sigmas), settings)
        least = np.minimum(least, agreement(*sides, moved, unit, unit, settings.agreement).cost)
    noticed = np.flatnonzero(least > least[0] + settings.slip_rise)
    return float(angles[noticed[0] - 1] if len(noticed) else angles[-1])


def _followed(
    sides: tuple[Side, Side],
    moved: Hypotheses,
    held: Float64[ndarray, "3"],
    kernel: Tolerance,
    settings: PairSettings,
) -> Hypotheses:
    """After a Gauss-Newton step of each that does not rotate about the axis `held`."""
    target = sides[1].map
    sums = agreement(*sides, moved, kernel, kernel, settings.agreement)
    D = np.array([1.0] * 3 + [target.radius] * 4)
    H, g = sums.H / D[:, None] / D, sums.g / D
    free = np.eye(7) - np.outer(np.r_[0, 0, 0, held, 0], np.r_[0, 0, 0, held, 0])
    damping = settings.damping * np.trace(H, axis1=1, axis2=2).clip(1e-12)
    H = free @ H @ free + damping[:, None, None] * np.eye(7)
    step = -np.linalg.solve(H, (g @ free)[..., None])[..., 0] / D
    return moved.incremented(step[:, :3], step[:, 3:6], np.exp(step[:, 6]), target.centroid)


def screw_motion(x: Float64[ndarray, "7"], surface: SurfaceMap) -> Similarity:
    """A screw motion with growth: a point follows the velocity `l (p - c) + w x (p - c) + radius v` for a unit of time.

    To first order it is the increment x; unlike that it stays on a surface of revolution.
    """
    v, w, growth = x[:3] * surface.radius, x[3:6], x[6]
    A = np.zeros((4, 4))
    A[:3, :3] = np.cross(np.eye(3), w) + growth * np.eye(3)
    A[:3, 3] = v - A[:3, :3] @ surface.centroid
    M = expm(A)
    scale = float(np.exp(growth))
    return Similarity(scale, M[:3, :3] / scale, M[:3, 3])

"""How far one frame may slip along the surface of another without anything telling.

A table, or a vase without texture, looks the same after some motions. The normal equations do not show it: noise of the
normals makes information where there is none. So the motion that they know least is tried.
"""

from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.linalg import expm

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.surface_agreement import Agreement, Side, Tolerance, agreement
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


@dataclass(frozen=True)
class CostOfPoints:
    """Robust cost of some points before and after a motion; sums and counts in shares of all points."""

    still: float  # sum of the costs before the motion
    moved: float
    judged_still: float  # how many of the points the other frame can judge
    judged_moved: float

    def __add__(self, other: "CostOfPoints") -> "CostOfPoints":
        """Of two pairs of frames together."""
        return CostOfPoints(*(a + b for a, b in zip(astuple(self), astuple(other), strict=True)))

    @property
    def rise(self) -> float:
        """Of the mean cost; 0 where nothing is judged."""
        if min(self.judged_still, self.judged_moved) <= 0:
            return 0.0
        return self.moved / self.judged_moved - self.still / self.judged_still


@dataclass(frozen=True)
class MotionCost:
    """What a motion costs: all points, and those that it moves along their normals."""

    every: CostOfPoints
    telling: CostOfPoints

    def __add__(self, other: "MotionCost") -> "MotionCost":
        """Of two pairs of frames together."""
        return MotionCost(self.every + other.every, self.telling + other.telling)

    @property
    def rise(self) -> float:
        """The larger rise, in the units of a rise of all points: few points must notice a motion all the more.

        The standard error of a mean over a share of the points is larger by the inverse root of that share.
        """
        share = self.telling.judged_still / max(self.every.judged_still, 1e-9)
        return max(self.every.rise, self.telling.rise * float(np.sqrt(share)))


def motion_cost(
    sides: tuple[Side, Side], still: Similarity, moved: Similarity, kernel: Tolerance, settings: PairSettings
) -> MotionCost:
    """What a motion from one similarity to another costs the points of both frames.

    Points that stay on their own tangent plane tell nothing, whatever they are: those of a vase that turns about its
    axis, or of the table below it.
    """
    source, target = sides
    both = Hypotheses.joined([Hypotheses.of(still), Hypotheses.of(moved)])
    some = (
        _moved_points(source, still, moved, settings.slip_sigmas),
        _moved_points(target, still.inverse(), moved.inverse(), settings.slip_sigmas),
    )
    share = (len(some[0].points) / len(source.points) + len(some[1].points) / len(target.points)) / 2
    every = _cost_of(agreement(*sides, both, kernel, kernel, settings.agreement), 1.0)
    return MotionCost(every, _cost_of(agreement(*some, both, kernel, kernel, settings.agreement), share))


def _cost_of(found: Agreement, share: float) -> CostOfPoints:
    """Of points that are a share of all; `found` is before and after the motion."""
    before, after = (share * found.judged).tolist()
    return CostOfPoints(float(found.cost[0]) * before, float(found.cost[1]) * after, before, after)


def _moved_points(side: Side, still: Similarity, moved: Similarity, sigmas: float) -> Side:
    """The points that a motion moves along their normals by more than some standard deviations of both surfaces."""
    step = moved.points(side.points) - still.points(side.points)
    along = np.abs((step * (side.normals @ still.R.T)).sum(1))
    some = along > sigmas * 2**0.5 * still.scale * side.sigma
    return Side(side.map, side.points[some], side.normals[some], side.sigma[some])


def slip_deg(
    sides: tuple[Side, Side],
    S_target_source: Similarity,
    direction: Float64[ndarray, "7"],
    common: Tolerance,
    settings: PairSettings,
) -> float:
    """The largest of some angles, in degrees, up to which a motion in either sense is not noticed; 0 where all are.

    A motion is noticed where the mean robust cost of all points, or of those that it moves, rises, with a kernel as
    narrow as the surfaces agree, though everything but its rotation may follow: the axis of a surface of revolution is
    never known exactly.
    """
    surface, unit = sides[1].map, Tolerance(0.0, common.sigmas / settings.common_rms)
    angles = np.array([0.0, *settings.slip_angles_deg])
    rise = np.full(len(angles) - 1, np.inf)
    for sense in (1.0, -1.0):
        moved = Hypotheses.joined(
            [
                Hypotheses.of(screw_motion(sense * angle * direction, surface) @ S_target_source)
                for angle in np.radians(angles)
            ]
        )
        for _ in range(settings.slip_steps):
            moved = followed(sides, moved, direction[3:6], Tolerance(0.0, common.sigmas), settings)
        still, *others = (moved.similarity(k) for k in range(len(angles)))
        rises = [motion_cost(sides, still, other, unit, settings).rise for other in others]
        rise = np.minimum(rise, rises)
    noticed = np.flatnonzero(rise > settings.slip_rise)
    return float(angles[noticed[0]] if len(noticed) else angles[-1])


def followed(
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
    growth = np.clip(step[:, 6], -settings.largest_log_scale, settings.largest_log_scale)
    return moved.incremented(step[:, :3], step[:, 3:6], np.exp(growth), target.centroid)


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

"""The result of registering one frame to another: an edge of the pose graph."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.slip import slip_deg, weakest_rotation
from sl_nerfstudio.registration.pairs.surface_agreement import Agreement, Side, Tolerance
from sl_nerfstudio.registration.pairs.tone_match import ToneTurn
from sl_nerfstudio.registration.settings import PairSettings


@dataclass(frozen=True)
class Rival:
    """A clearly different similarity between the same two frames."""

    S_target_source: Similarity
    ratio: float  # its score over that of the best one: 1 is as good


@dataclass(frozen=True)
class PairMatch:
    """One frame on another. Similarities map camera axes to camera axes, each in units of its own baseline."""

    source: int
    target: int
    S_target_source: Similarity
    information: Float64[ndarray, "7 7"]  # of (v, w, l), see surface_agreement; lengths in radii of the target
    overlap: float  # fraction of all points that lie on the other frame's surface
    fitness: float  # the same among the points that could be judged
    rms: float  # distance of agreeing points from the surface, in radii
    rivals: tuple[Rival, ...]  # the best first
    rotation_sigma_deg: float  # standard deviation of the least known rotation
    slip_deg: float  # rotation that nothing tells from none: above zero on planes and surfaces of revolution
    slip_direction: Float64[ndarray, "7"]  # the motion (v, w, l) in the target's axes, about its centroid, |w| = 1
    shape_slip_deg: float = 0.0  # the rotation that surfaces alone do not tell: larger than `slip_deg` where tones do

    @property
    def second_best_ratio(self) -> float:
        """Score of the best rival over that of this similarity: 1 is ambiguous."""
        return self.rivals[0].ratio if self.rivals else 0.0

    @property
    def by_tone(self) -> bool:
        """Whether tones hold the frames where surfaces alone would let them slip."""
        return self.shape_slip_deg > self.slip_deg

    def without_tone(self) -> "PairMatch":
        """The same pair as one that slips."""
        d, slip = self.slip_direction, np.radians(self.shape_slip_deg)
        covariance = np.linalg.inv(self.information) + slip**2 * np.outer(d, d)
        sigma_deg = float(np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])))
        return replace(
            self,
            information=np.linalg.inv(covariance),
            rotation_sigma_deg=sigma_deg,
            slip_deg=self.shape_slip_deg,
        )

    def between(self, source: int, target: int) -> Similarity:
        """The similarity from `source` to `target`, whichever way it was found."""
        forward = (self.source, self.target) == (source, target)
        return self.S_target_source if forward else self.S_target_source.inverse()

    def other(self, frame: int) -> int:
        """The frame at the other end."""
        return self.target if self.source == frame else self.source


def match_from(
    pair: tuple[int, int],
    S_target_source: Similarity,
    found: Agreement,
    k: int,
    rivals: tuple[Rival, ...],
    sides: tuple[Side, Side],
    common: Tolerance,
    settings: PairSettings,
    turn: ToneTurn | None = None,
) -> PairMatch:
    """The edge for similarity k of `found`, with the uncertainty that follows from the sums and from slipping.

    `turn` is how tones hold two frames that slip.
    """
    target = sides[1].map
    D = np.array([target.radius] * 3 + [1] * 4)
    H = found.H[k] * D[:, None] * D / target.radius**2
    # No pair is assumed to fit better than the surfaces are known: errors of the relative pose bend them.
    typical = float(np.median(target.sigma[target.valid])) / target.radius
    rms = max(float(np.sqrt(found.squares[k])), 1.0) * typical
    count = max(np.trace(H[:3, :3]), 1e-9)  # about the sum of the weights
    information = H * (settings.independent_points / count / rms**2) + settings.least_information * np.eye(7)
    # Errors of the two relative poses move and bend a surface as a whole: more points do not average them.
    bending = np.array([settings.shift_sigmas] * 3 + [settings.turn_sigmas] * 4) * rms
    covariance = np.linalg.inv(information) + np.diag(bending**2)
    direction = weakest_rotation(information) if turn is None else turn.direction
    slip = slip_deg(sides, S_target_source, direction, common, settings) if turn is None else turn.shape_slip_deg
    free = np.radians(slip if turn is None else turn.sigma_deg)
    covariance = covariance + free**2 * np.outer(direction, direction)
    sigma = np.sqrt(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])
    return PairMatch(
        *pair,
        S_target_source,
        np.linalg.inv(covariance),
        float(found.agreeing[k]),
        float(found.fitness[k]),
        rms,
        rivals,
        float(np.degrees(sigma)),
        slip if turn is None else 0.0,
        direction,
        slip,
    )

"""How well the surfaces of two frames agree under a similarity, and how to improve it: sums over looked-up points.

Points of one frame are projected into the other's camera and compared with the tangent plane of the surface seen
there, both ways. Unlike nearest neighbours this also finds contradictions: a point in front of a surface that the other
camera saw would have hidden that surface.

A similarity maps the source's points to the target's axes. Increments (v, w, l) act there, about the target's centroid
c: `p <- c + exp(l) exp(w) (p - c) + v`.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.agreement_loops import agreement_sums
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, AgreementSettings, PairSettings
from sl_nerfstudio.registration.surface_map import SurfaceMap


@dataclass(frozen=True)
class Side:
    """One frame of a pair: its map, and some of its points with normals."""

    map: SurfaceMap
    points: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]
    sigma: Float64[ndarray, "n"]  # along the normals

    @cached_property
    def rows(self) -> Float64[ndarray, "6 n"]:
        """Points and normals, for compiled loops."""
        return np.ascontiguousarray(np.concatenate([self.points, self.normals], 1).T)

    @staticmethod
    def sampled(surface: SurfaceMap, count: int, rng: np.random.Generator) -> "Side":
        """With about `count` points spread evenly over the image."""
        return Side(surface, *surface.sample(count, rng))

    def thinned(self, most: int) -> "Side":
        """With every n-th of its points, at most about `most`."""
        some = slice(None, None, max(1, len(self.points) // most))
        return Side(self.map, *(np.ascontiguousarray(part[some]) for part in (self.points, self.normals, self.sigma)))


@dataclass(frozen=True)
class Tolerance:
    """A distance between two surfaces: the larger of a length and a multiple of their standard deviation."""

    radii: float  # of the target's points
    sigmas: float


@dataclass(frozen=True)
class Agreement:
    """Sums for each of k similarities; distances in units of the target's baseline."""

    H: Float64[ndarray, "k 7 7"]  # of robustly weighted point-to-plane distances
    g: Float64[ndarray, "k 7"]
    agreeing: Float64[ndarray, "k"]  # fraction of the points that lie on the other surface
    in_front: Float64[ndarray, "k"]  # fraction that would hide what the other camera saw
    behind: Float64[ndarray, "k"]  # fraction a little behind what the other camera saw
    squares: Float64[ndarray, "k"]  # mean squared distance of those that agree, in units of its variance
    absent: Float64[ndarray, "k"]  # fraction that would be seen and lit where the other camera saw nothing
    cost: Float64[ndarray, "k"]  # mean robust cost of the points that could be judged: 0 exact, 1 far beyond the kernel

    @property
    def fitness(self) -> Float64[ndarray, "k"]:
        """Of the points that could be judged, or should be seen and are not, the fraction that agree."""
        return self.agreeing / self.expected.clip(1e-9)

    @property
    def judged(self) -> Float64[ndarray, "k"]:
        """Fraction of the points that could be judged: the other camera saw a surface where they lie."""
        return self.agreeing + self.in_front + self.behind

    @property
    def expected(self) -> Float64[ndarray, "k"]:
        """Fraction of the points that the other camera should have seen: what could be judged, and absent ones."""
        return self.judged + self.absent

    def contradicting(self, behind: float) -> Float64[ndarray, "k"]:
        """Fraction that contradicts, of which points behind count as `behind`."""
        return self.in_front + self.absent + behind * self.behind

    def score(self, penalty: float, behind: float) -> Float64[ndarray, "k"]:
        """Points that agree less `penalty` times those that contradict, of which points behind count as `behind`."""
        return self.agreeing - penalty * self.contradicting(behind)


def agreement(
    source: Side,
    target: Side,
    hypotheses: Hypotheses,
    tolerance: Tolerance,
    width: Tolerance,
    settings: AgreementSettings = REGISTRATION_DEFAULTS.pair.agreement,
) -> Agreement:
    """Both ways, for k similarities `p_target = scale R p_source + t`.

    `tolerance` is the distance within which points agree, `width` that of the robust kernel.
    """
    k, radius = len(hypotheses), target.map.radius
    H, g, counts = np.zeros((k, 7, 7)), np.zeros((k, 7)), np.zeros((2, k, 6))
    tolerances = np.array([tolerance.radii * radius, width.radii * radius, settings.hidden_depth * radius,
                           tolerance.sigmas, width.sigmas])  # fmt: skip
    scale, R, t = hypotheses.scale, np.ascontiguousarray(hypotheses.R), np.ascontiguousarray(hypotheses.t)
    for reverse, (mover, seen) in enumerate(((source, target), (target, source))):
        m = seen.map
        agreement_sums(
            len(scale), mover.rows, mover.sigma, scale, R, t, bool(reverse), m.plane, m.valid, m.model_code,
            m.parameters, target.map.centroid, tolerances, settings.least_facing_cosine, settings.kernel_cutoff,
            m.nothing.empty, m.nothing.light, settings.least_lit_cosine, H, g, counts[reverse],
        )  # fmt: skip
    shares = (counts[0] / max(len(source.points), 1) + counts[1] / max(len(target.points), 1)) / 2
    squares = counts[..., 3].sum(0) / np.maximum(counts[..., 0].sum(0), 1)
    cost = counts[..., 4].sum(0) / np.maximum(counts[..., :3].sum((0, 2)), 1)
    return Agreement(H, g, shares[:, 0], shares[:, 1], shares[:, 2], squares, shares[:, 5], cost)


def agreement_at(
    maps: tuple[SurfaceMap, SurfaceMap],
    S_target_source: Similarity,
    rng: np.random.Generator,
    tolerance: Tolerance,
    settings: PairSettings,
) -> Agreement:
    """How two frames agree under one similarity."""
    source, target = (Side.sampled(m, settings.coarse_points, rng) for m in maps)
    return agreement(source, target, Hypotheses.of(S_target_source), tolerance, tolerance, settings.agreement)

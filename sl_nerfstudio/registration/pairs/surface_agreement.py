"""How well the surfaces of two frames agree under a similarity, and how to improve it: sums over looked-up points.

Points of one frame are projected into the other's camera and compared with the tangent plane of the surface seen
there, both ways. Unlike nearest neighbours this also finds contradictions: a point in front of a surface that the other
camera saw would have hidden that surface.

A similarity maps the source's points to the target's axes. Increments (v, w, l) act there, about the target's centroid
c: `p <- c + exp(l) exp(w) (p - c) + v`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.geometry.devices.models import pixel_of
from sl_nerfstudio.geometry.robust import geman_mcclure_cost, geman_mcclure_weight
from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, AgreementSettings, PairSettings
from sl_nerfstudio.registration.surface_map import SurfaceMap

_kernel_weight = compiled(geman_mcclure_weight)
_kernel_cost = compiled(geman_mcclure_cost)


@dataclass(frozen=True)
class Side:
    """One frame of a pair: its map, and some of its points with normals."""

    map: SurfaceMap
    points: Float64[ndarray, "n 3"]
    normals: Float64[ndarray, "n 3"]
    sigma: Float64[ndarray, "n"]  # along the normals

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
    cost: Float64[ndarray, "k"]  # mean robust cost of the points that could be judged: 0 exact, 1 far beyond the kernel

    @property
    def fitness(self) -> Float64[ndarray, "k"]:
        """Of the points that could be judged, the fraction that agree."""
        return self.agreeing / self.judged.clip(1e-9)

    @property
    def judged(self) -> Float64[ndarray, "k"]:
        """Fraction of the points that could be judged: the other camera saw a surface where they lie."""
        return self.agreeing + self.in_front + self.behind

    def contradicting(self, behind: float) -> Float64[ndarray, "k"]:
        """Fraction that contradicts, of which points behind count as `behind`."""
        return self.in_front + behind * self.behind

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
    H, g, counts = np.zeros((k, 7, 7)), np.zeros((k, 7)), np.zeros((2, k, 5))
    tolerances = np.array([tolerance.radii * radius, width.radii * radius, settings.hidden_depth * radius,
                           tolerance.sigmas, width.sigmas])  # fmt: skip
    scale, R, t = hypotheses.scale, np.ascontiguousarray(hypotheses.R), np.ascontiguousarray(hypotheses.t)
    for reverse, (mover, seen) in enumerate(((source, target), (target, source))):
        m = seen.map
        _sums(
            len(scale), mover.points, mover.normals, mover.sigma, scale, R, t, bool(reverse),
            m.point, m.normal, m.sigma, m.valid, m.model_code, m.parameters, target.map.centroid, tolerances,
            settings.least_facing_cosine, settings.kernel_cutoff, H, g, counts[reverse],
        )  # fmt: skip
    shares = (counts[0] / max(len(source.points), 1) + counts[1] / max(len(target.points), 1)) / 2
    squares = counts[..., 3].sum(0) / np.maximum(counts[..., 0].sum(0), 1)
    cost = counts[..., 4].sum(0) / np.maximum(counts[..., :3].sum((0, 2)), 1)
    return Agreement(H, g, shares[:, 0], shares[:, 1], shares[:, 2], squares, cost)


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


@compiled_range
def _sums(
    first, last, points, normals, sigma, scale, R, t, reverse, map_point, map_normal, map_sigma, valid, code, camera, c,
    tolerances, least_facing, cutoff, H, g, counts
):  # fmt: skip
    """Adds to H, g and counts (agreeing, in front, behind, squares, cost); `reverse`: points are the target's."""
    h, w = valid.shape
    hidden = tolerances[2]
    for k in range(first, last):
        s = scale[k]
        J = np.zeros(7)
        for n in range(len(points)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            a, b, d = normals[n, 0], normals[n, 1], normals[n, 2]
            if reverse:
                x, y, z = (x - t[k, 0]) / s, (y - t[k, 1]) / s, (z - t[k, 2]) / s
                X = R[k, 0, 0] * x + R[k, 1, 0] * y + R[k, 2, 0] * z
                Y = R[k, 0, 1] * x + R[k, 1, 1] * y + R[k, 2, 1] * z
                Z = R[k, 0, 2] * x + R[k, 1, 2] * y + R[k, 2, 2] * z
                A = R[k, 0, 0] * a + R[k, 1, 0] * b + R[k, 2, 0] * d
                B = R[k, 0, 1] * a + R[k, 1, 1] * b + R[k, 2, 1] * d
                C = R[k, 0, 2] * a + R[k, 1, 2] * b + R[k, 2, 2] * d
            else:
                X = s * (R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z) + t[k, 0]
                Y = s * (R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z) + t[k, 1]
                Z = s * (R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z) + t[k, 2]
                A = R[k, 0, 0] * a + R[k, 0, 1] * b + R[k, 0, 2] * d
                B = R[k, 1, 0] * a + R[k, 1, 1] * b + R[k, 1, 2] * d
                C = R[k, 2, 0] * a + R[k, 2, 1] * b + R[k, 2, 2] * d
            if A * X + B * Y + C * Z > 0:  # turned away from the camera
                continue
            column, row, in_front = pixel_of(code, X, Y, Z, camera)
            if not (in_front and column >= 0 and row >= 0 and column < w and row < h):
                continue
            i, j = int(row), int(column)
            if not valid[i, j]:
                continue
            na, nb, nc = map_normal[i, j, 0], map_normal[i, j, 1], map_normal[i, j, 2]
            r = na * (X - map_point[i, j, 0]) + nb * (Y - map_point[i, j, 1]) + nc * (Z - map_point[i, j, 2])
            if reverse:
                r *= s
                spread = np.hypot(sigma[n], s * map_sigma[i, j])
            else:
                spread = np.hypot(s * sigma[n], map_sigma[i, j])
            tau, width = max(tolerances[0], tolerances[3] * spread), max(tolerances[1], tolerances[4] * spread)
            facing = na * A + nb * B + nc * C
            if abs(r) < tau and facing > least_facing:
                counts[k, 0] += 1
                counts[k, 3] += (r / spread) ** 2
            elif r > tau:
                counts[k, 1] += 1
            elif r > -hidden:
                counts[k, 2] += 1
            if r > -hidden:
                counts[k, 4] += _kernel_cost((r / width) ** 2)
            if facing < least_facing or abs(r) > cutoff * width:
                continue
            weight = _kernel_weight((r / width) ** 2) * facing
            if reverse:  # the normal, in the target's axes and against the motion of the source
                ma = -(R[k, 0, 0] * na + R[k, 0, 1] * nb + R[k, 0, 2] * nc)
                mb = -(R[k, 1, 0] * na + R[k, 1, 1] * nb + R[k, 1, 2] * nc)
                mc = -(R[k, 2, 0] * na + R[k, 2, 1] * nb + R[k, 2, 2] * nc)
                X, Y, Z = points[n, 0], points[n, 1], points[n, 2]
            else:
                ma, mb, mc = na, nb, nc
            X, Y, Z = X - c[0], Y - c[1], Z - c[2]
            J[0], J[1], J[2] = ma, mb, mc
            J[3], J[4], J[5] = Y * mc - Z * mb, Z * ma - X * mc, X * mb - Y * ma
            J[6] = ma * X + mb * Y + mc * Z
            for p in range(7):
                wp = weight * J[p]
                g[k, p] += wp * r
                for m in range(p + 1):
                    H[k, p, m] += wp * J[m]
        for p in range(7):
            for m in range(p):
                H[k, m, p] = H[k, p, m]

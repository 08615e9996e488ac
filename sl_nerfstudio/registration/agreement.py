"""Agreement of the surfaces of two frames under a similarity, and normal equations to improve it.

Points of one frame are projected into the other's camera and compared with the tangent plane of the surface seen
there, both ways. Unlike nearest neighbours this also finds contradictions: a point in front of a surface that the other
camera saw would have hidden that surface.

A similarity maps the source's points to the target's axes. Increments (v, w, l) act there, about the target's centroid
c: `p <- c + exp(l) exp(w) (p - c) + v`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.devices import for_loops, pixel_of
from sl_nerfstudio.geometry.lie import Similarities, Similarity, moved, rotated
from sl_nerfstudio.geometry.numerics import geman_mcclure_weight
from sl_nerfstudio.parallel import compiled, compiled_range, compiled_sums
from sl_nerfstudio.registration.surfaces import SurfaceMap

COARSE_POINTS = 400  # of each frame, wherever many pairs are compared
AGREEING_SIGMAS = 4.0  # standard deviations of the two surfaces within which a point agrees
HIDDEN_DEPTH = 0.35  # radii behind a surface: points farther back are hidden by it, nearer ones contradict it
LEAST_FACING_COSINE = 0.3  # between the normals of two places that may be the same
LEAST_LIT_COSINE = 0.35  # between a normal and its rays to camera and projector: a surface would be seen and lit
KERNEL_CUTOFF = 4.0  # widths of the robust kernel beyond which a point has no weight
BEHIND_WEIGHT = 0.5  # of a point a little behind the surface, where a point in front of it counts 1

# The compiled loops of `agreement`. Registration spends most of its time here, so each step does one thing for all
# points, without branches that a processor would have to guess: map, look up, compare, sum up; each step keeps the
# numbers of the points that are still of interest.

_kernel_weight = compiled(geman_mcclure_weight)


@compiled_range
def agreement_sums(
    first, last, points, sigma, scale, R, t, reverse, plane, valid, code, camera, c, tolerances, least_facing, cutoff,
    empty, light, least_lit, H, g, counts
):  # fmt: skip
    """Adds to H, g and counts (agreeing, in front, behind, absent); `reverse`: points are the target's.

    `points` are (6, n): points and normals. For every similarity, they are compared with the other frame's surface.
    """
    h, w = valid.shape
    n = points.shape[1]
    mapped, place, some, rows = np.empty((6, n)), np.empty(n), np.empty(n, np.int64), np.empty((9, n))
    flat_plane, flat_valid = plane.reshape(h * w, 5), valid.reshape(h * w)
    M, shift, turn = np.empty((3, 3)), np.empty(3), np.eye(3)
    for k in range(first, last):
        s = scale[k]
        M[:] = R[k].T if reverse else R[k]
        for i in range(3):
            shift[i] = -(M[i, 0] * t[k, 0] + M[i, 1] * t[k, 1] + M[i, 2] * t[k, 2]) / s if reverse else t[k, i]
        _map(points, M, 1 / s if reverse else s, shift, code, camera, h, w, mapped, place)
        counts[k, 3] += _absent(mapped, place, empty.reshape(h * w), light, least_lit)
        count = _on_surface(place, flat_valid, some)
        scales = (1.0, s, s) if reverse else (s, 1.0, 1.0)  # of sigma, of the surface's sigma and of distances
        count = _compare(
            mapped, sigma, place, flat_plane, scales, tolerances, least_facing, cutoff, some, count, rows, counts[k]
        )
        if reverse:  # the normal, in the target's axes and against the motion of the source
            turn[:] = -R[k]
        _derive(points if reverse else mapped, turn, c, some, count, rows)
        _add_normal_equations(rows, count, H[k], g[k])


@compiled
def _map(points, M, scale, shift, code, camera, h, w, mapped, place):
    """Points and normals in the other frame's axes, and their place in its map; -1 where it cannot see them."""
    # Numbers of their own: an array might be the one that is written to, as far as the compiler knows.
    r00, r01, r02 = M[0, 0], M[0, 1], M[0, 2]
    r10, r11, r12 = M[1, 0], M[1, 1], M[1, 2]
    r20, r21, r22 = M[2, 0], M[2, 1], M[2, 2]
    tx, ty, tz = shift[0], shift[1], shift[2]
    for n in range(points.shape[1]):
        x, y, z, a, b, d = points[0, n], points[1, n], points[2, n], points[3, n], points[4, n], points[5, n]
        X = scale * (r00 * x + r01 * y + r02 * z) + tx
        Y = scale * (r10 * x + r11 * y + r12 * z) + ty
        Z = scale * (r20 * x + r21 * y + r22 * z) + tz
        A = r00 * a + r01 * b + r02 * d
        B = r10 * a + r11 * b + r12 * d
        C = r20 * a + r21 * b + r22 * d
        mapped[0, n], mapped[1, n], mapped[2, n] = X, Y, Z
        mapped[3, n], mapped[4, n], mapped[5, n] = A, B, C
        column, row, in_front = pixel_of(code, X, Y, Z, camera)
        towards = A * X + B * Y + C * Z <= 0
        seen = towards & in_front & (column >= 0) & (row >= 0) & (column < w) & (row < h)
        place[n] = np.floor(row) * w + np.floor(column) if seen else -1.0


@compiled
def _on_surface(place, valid, some):
    """Puts the indices of points whose place has a surface into `some`, and returns how many they are."""
    seen = 0
    for n in range(len(place)):
        some[seen] = n
        seen += place[n] >= 0
    count = 0
    for m in range(seen):
        n = some[m]
        some[count] = n
        count += valid[int(place[n])]
    return count


@compiled
def lit(x, y, z, a, b, c, light, least_cosine):
    """Whether a point with its normal would be seen, and lit by the projector; `light` see `EmptyPlaces`."""
    code, projector, T, reach = light
    if -(a * x + b * y + c * z) < least_cosine * np.sqrt(x * x + y * y + z * z):
        return False
    X, Y, Z = moved(T, x, y, z)
    A, B, C = rotated(T, a, b, c)
    distance = np.sqrt(X * X + Y * Y + Z * Z)
    if least_cosine * distance > -(A * X + B * Y + C * Z):
        return False
    column, row, in_front = pixel_of(code, X, Y, Z, projector)
    if not (in_front and column >= 0 and row >= 0 and column < reach.shape[1] and row < reach.shape[0]):
        return False
    return distance < reach[int(row), int(column)]


@compiled
def _absent(mapped, place, empty, light, least_cosine):
    """Count the points that would be seen and lit where the other frame saw nothing; `light` see `EmptyPlaces`."""
    count = 0
    for n in range(len(place)):
        if place[n] < 0 or not empty[int(place[n])]:
            continue
        x, y, z, a, b, c = mapped[0, n], mapped[1, n], mapped[2, n], mapped[3, n], mapped[4, n], mapped[5, n]
        count += lit(x, y, z, a, b, c, light, least_cosine)
    return count


@compiled
def _compare(mapped, sigma, place, plane, scales, tolerances, least_facing, cutoff, some, count, rows, counts):
    """Adds to the counts; leaves in `some` the points that move the alignment, returns how many they are.

    Their normals are put into the first three of `rows`, weights and distances into the last two.
    """
    used, agreeing, ahead, behind = 0, 0, 0, 0
    for m in range(count):
        n = some[m]
        at = int(place[n])
        na, nb, nc = plane[at, 0], plane[at, 1], plane[at, 2]
        r = scales[2] * (na * mapped[0, n] + nb * mapped[1, n] + nc * mapped[2, n] - plane[at, 3])
        spread = np.sqrt((scales[0] * sigma[n]) ** 2 + (scales[1] * plane[at, 4]) ** 2)
        tau = max(tolerances[0], tolerances[2] * spread)
        facing = na * mapped[3, n] + nb * mapped[4, n] + nc * mapped[5, n]
        agrees = (abs(r) < tau) & (facing > least_facing)
        in_front = (r > tau) & ~agrees
        agreeing += agrees
        ahead += in_front
        behind += (r > -tolerances[1]) & ~agrees & ~in_front
        rows[0, used], rows[1, used], rows[2, used] = na, nb, nc
        rows[7, used], rows[8, used] = _kernel_weight((r / tau) ** 2) * facing, r
        some[used] = n
        used += (facing >= least_facing) & (abs(r) <= cutoff * tau)
    counts[0] += agreeing
    counts[1] += ahead
    counts[2] += behind
    return used


@compiled
def _derive(points, turn, c, some, count, rows):
    """Derivatives of the distances by the increment, into the first seven of `rows`; `turn` turns the normals."""
    for m in range(count):
        n = some[m]
        na, nb, nc = rows[0, m], rows[1, m], rows[2, m]
        a = turn[0, 0] * na + turn[0, 1] * nb + turn[0, 2] * nc
        b = turn[1, 0] * na + turn[1, 1] * nb + turn[1, 2] * nc
        d = turn[2, 0] * na + turn[2, 1] * nb + turn[2, 2] * nc
        X, Y, Z = points[0, n] - c[0], points[1, n] - c[1], points[2, n] - c[2]
        rows[0, m], rows[1, m], rows[2, m] = a, b, d
        rows[3, m], rows[4, m], rows[5, m] = Y * d - Z * b, Z * a - X * d, X * b - Y * a
        rows[6, m] = a * X + b * Y + d * Z


@compiled_sums
def _add_normal_equations(rows, count, H, g):
    """Add the normal equations of weighted distances."""
    for i in range(7):
        total = 0.0
        for n in range(count):
            total += rows[7, n] * rows[i, n] * rows[8, n]
        g[i] += total
        for j in range(i + 1):
            total = 0.0
            for n in range(count):
                total += rows[7, n] * rows[i, n] * rows[j, n]
            H[i, j] += total
    for i in range(7):
        for j in range(i):
            H[j, i] = H[i, j]


# Several similarities between two frames at once, as arrays.


Many = TypeVar("Many", bound="PairSimilarities")


@dataclass(frozen=True)
class PairSimilarities:
    """Similarities `p_target = scale R p_source + t`, with what else is known of each."""

    scale: Float64[ndarray, "k"]
    R: Float64[ndarray, "k 3 3"]
    t: Float64[ndarray, "k 3"]

    @classmethod
    def joined(cls: type[Many], parts: Sequence[Many]) -> Many:
        """Several sets as one."""
        return cls(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(cls)))

    def __len__(self) -> int:
        """Number of similarities."""
        return len(self.scale)

    def __getitem__(self: Many, index: Sequence[int] | slice | ndarray) -> Many:
        """Select by index."""
        return type(self)(*(getattr(self, f.name)[index] for f in fields(self)))

    def similarity(self, k: int) -> Similarity:
        """One of them."""
        return Similarity(float(self.scale[k]), self.R[k], self.t[k])

    def incremented(
        self: Many, v: Float64[ndarray, "k 3"], w: Float64[ndarray, "k 3"], growth: Float64[ndarray, "k"],
        centre: Float64[ndarray, "3"],
    ) -> Many:  # fmt: skip
        """Each followed by `p <- centre + growth exp(w) (p - centre) + v`."""
        turn = Rotation.from_rotvec(w).as_matrix()
        t = centre + growth[:, None] * np.einsum("kij,kj->ki", turn, self.t - centre) + v
        return replace(self, scale=self.scale * growth, R=turn @ self.R, t=t)


@dataclass(frozen=True)
class Hypotheses(PairSimilarities):
    """Similarities of a search."""

    log_scale_prior: Float64[ndarray, "k"]  # logarithm of the scale that each started with

    @staticmethod
    def of(*each: Similarity) -> "Hypotheses":
        """Stack at least one similarity."""
        stacked = Similarities.of(each)
        return Hypotheses(stacked.scale, stacked.R, stacked.t, np.log(stacked.scale))


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
        """Draw about `count` points spread evenly over the image."""
        return Side(surface, *surface.sample(count, rng))


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
    absent: Float64[ndarray, "k"]  # fraction that would be seen and lit where the other camera saw nothing

    @property
    def score(self) -> Float64[ndarray, "k"]:
        """Points that agree less those that contradict; a point a little behind the surface counts BEHIND_WEIGHT."""
        return self.agreeing - (self.in_front + self.absent + BEHIND_WEIGHT * self.behind)


def agreement(source: Side, target: Side, hypotheses: Hypotheses, tolerance: Tolerance) -> Agreement:
    """Compare both ways, for k similarities `p_target = scale R p_source + t`.

    `tolerance` is the distance within which points agree, and the width of the robust kernel.
    """
    k, radius = len(hypotheses), target.map.radius
    H, g, counts = np.zeros((k, 7, 7)), np.zeros((k, 7)), np.zeros((2, k, 4))
    tolerances = np.array([tolerance.radii * radius, HIDDEN_DEPTH * radius, tolerance.sigmas])
    scale, R, t = hypotheses.scale, np.ascontiguousarray(hypotheses.R), np.ascontiguousarray(hypotheses.t)
    for reverse, (mover, seen) in enumerate(((source, target), (target, source))):
        m = seen.map
        agreement_sums(
            len(scale), mover.rows, mover.sigma, scale, R, t, bool(reverse), m.plane, m.valid,
            *for_loops(m.camera), target.map.centroid, tolerances, LEAST_FACING_COSINE, KERNEL_CUTOFF,
            m.nothing.empty, m.nothing.light, LEAST_LIT_COSINE, H, g, counts[reverse],
        )  # fmt: skip
    shares = (counts[0] / max(len(source.points), 1) + counts[1] / max(len(target.points), 1)) / 2
    return Agreement(H, g, *shares.T)

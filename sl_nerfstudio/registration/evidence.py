"""Evidence for the place of two frames: the likelihood of what one of them decoded, given the surface of the other.

Each frame is a lattice of distances along the rays of its camera, at the resolution at which it was decoded. A point of
one frame that falls on a place of the other has a residual: how far it lies behind the surface there, along the other's
ray, in standard deviations of both. Its density is a mixture with tails, because some coordinates are simply wrong.

A point counts by how much its residual says about the place (as the information in features against that in smooth
surface): a point that fits wherever the frames were tried says nothing, however well it fits. So each frame keeps, of
each of its points, the share of other places at which it fitted. Neighbouring pixels share their errors, so all pixels
of a correlation area count as one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int8, Int64
from numpy import ndarray
from scipy.ndimage import uniform_filter

from sl_nerfstudio.geometry.devices import Device, for_loops, pixel_of
from sl_nerfstudio.geometry.lie import Similarities, Similarity, cross, rotated, row_times_rotation
from sl_nerfstudio.geometry.numerics import all_finite
from sl_nerfstudio.parallel import both, compiled, compiled_range
from sl_nerfstudio.registration.agreement import (
    AGREEING_SIGMAS,
    HIDDEN_DEPTH,
    LEAST_LIT_COSINE,
    Hypotheses,
    PairSimilarities,
    lit,
)
from sl_nerfstudio.registration.surfaces import (
    EmptyPlaces,
    FrameCloud,
    Lattice,
    SurfaceMap,
    build_surface_map,
    centre_and_radius,
    find_empty_places,
)

LARGEST_SIDE = 640  # places of the lattice along the image's longer side
POINTS = 2000  # of a frame that are compared, about
INDEPENDENT = 300.0  # points of a frame that count as independent at most
CORRELATION_AREA = 120.0  # places whose errors are one, of the largest lattice: the decoder looks at windows
NORMAL_REACH = (2, 4)  # places on each side over which normals are differences: the widest that is known
BLOCK = 4  # places along each side of a block whose normal and pose errors are one
RELIEF_REACH = 6  # places on each side over which the relief is measured
NOISE_FACTOR, RELIEF_FACTOR, LARGEST_RELIEF = 0.75, 1.6, 200.0  # sigma grows with relief: the decoder smooths over it
LEAST_FACING_COSINE = 0.3  # between a surface and the ray from the other camera
POSE_ERRORS = 5  # principal errors of a frame's relative pose, which bend its surface
UNKNOWNS = 7 + 2 * POSE_ERRORS  # a similarity and the errors of both relative poses

# The density of residuals in sigmas: three normal distributions and a uniform one for coordinates that are wrong.
TAIL_SIGMAS = np.array([1.0, 3.0, 10.0])
TAIL_SHARES = 0.09, 0.02  # of the second, and of the third where the surface is smooth
WRONG_SHARE = 0.01  # of coordinates that are wrong, there
LARGEST_SPREAD = 8.0  # sigma over that of smooth surface, up to which these shares grow with it
LARGEST_RESIDUAL = 100.0
NOISE_QUANTILES = np.array([0.68, 0.95])  # of residuals, by which a pair's are compared with that density
LARGEST_NOISE = 5.0  # factor: beyond it residuals are no noise, the place is wrong
NOISE_RESIDUALS = np.array([1.06, 3.2])  # its quantiles there
FEWEST_JUDGED = 50  # points by which noise is known
USUAL_SIGMAS = 1.0  # of a residual in the right place
INDISTINCT_SIGMAS = 3.0  # within which residuals say nothing of the place: views that are alike share errors
ELSEWHERE_SIGMA = 12.0  # of a point that does not belong there: somewhere near, or anywhere

USUAL_SHARE = 0.9  # of other places at which a point fits, before any was tried: most surface is smooth
# Points that should be seen and are not: in the right place, and elsewhere at least.
ABSENT_SHARE, LEAST_ABSENT = 1e-3, 0.01

LEAST_SEEN = 0.3  # points that a place must let be judged, relative to the place that lets most
LEAST_AGREEING = 0.7  # of those that it lets be judged, for a place to be such a measure
LEAST_ODDS = 10.0  # nats that decide: errors of the decoder that pixels share make wrong places lead by a few
LARGEST_LEAD = 1e6  # nats: of the only place
MOST_OF_A_PAIR = 40.0  # nats that one pair of frames says for or against a place

NEAR_THINNED = 3  # only each so-manieth point is used to find the most likely place close to one
NEAR_WIDTHS = (10.0, 7.0, 5.0, 4.0)  # of the kernel on the way there, sigmas
NEAR_DEG, NEAR_SHIFT = 2.0, 0.08  # how far that may be: degrees, radii
NEAR_SIGMAS = 3.0  # and what errors of both relative poses explain
NEARLY_SAME_SHIFT = 0.01  # radii, between two places of which evidence is asked only once
NEARLY_SAME_TRACE = 1 + 2 * np.cos(np.radians(0.5))  # of the rotation between them
MOST_KEPT = 6000  # places of which residuals are kept, of 36 kB each

CONTRADICTING_SIGMAS = 3.0  # behind the surface, from which it is asked whether an edge hides a point
STEEPEST = 5.0  # change of distance from place to place, in their width, beyond which a surface has an edge

JUDGED, ABSENT, UNDECODED, HIDDEN = 1, 2, 3, 4  # codes of points that are in view


@dataclass(frozen=True)
class FrameEvidence:
    """The surface of one frame for comparisons, in camera axes, in units of its baseline."""

    camera: Device  # of the lattice
    surface: Float32[ndarray, "h w 2"]  # distance along the ray (NaN: none) and its sigma
    smooth: Float32[ndarray, "a b 8"]  # pose errors of the distance and the normal (NaN: unknown), of blocks of places
    nothing: EmptyPlaces
    points: Float64[ndarray, "n 12"]  # position, normal, sigma along the ray, pose errors
    centroid: Float64[ndarray, "3"]
    radius: float
    area: float  # points that count as one
    usual_sigma: float  # of the distances, on smooth surface
    depth_sigma: float  # of the surface as a whole along its rays, by the errors of the relative pose

    @property
    def hidden(self) -> float:
        """How far behind the surface a point is hidden by it, and contradicts nothing."""
        return HIDDEN_DEPTH * self.radius


@dataclass(frozen=True)
class Frame:
    """A frame as registration sees it: coarse, to search; and as it was decoded, to compare."""

    map: SurfaceMap
    evidence: FrameEvidence

    @staticmethod
    def of(cloud: FrameCloud) -> "Frame":
        """Build both from a cloud."""
        return Frame(*both(lambda: build_surface_map(cloud), lambda: frame_evidence(cloud)))


def frame_evidence(cloud: FrameCloud) -> FrameEvidence:
    """Put the points of a cloud on the lattice."""
    lattice = Lattice.of(cloud.camera, cloud.uv_camera, LARGEST_SIDE)
    camera, mean, known = lattice.camera, lattice.mean, lattice.count > 0
    h, w = camera.h, camera.w
    inverse = mean(1 / np.linalg.norm(cloud.points, axis=1))
    distance = np.where(known, 1 / np.where(known, inverse, 1.0), np.nan)
    ray = lattice.rays()
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    point = ray * distance[..., None]
    noise = mean(cloud.sigma_noise)
    with np.errstate(invalid="ignore", divide="ignore"):
        relief = np.nan_to_num(_relief(distance) / noise, nan=3.0)
    sigma = noise * NOISE_FACTOR * np.sqrt(1 + RELIEF_FACTOR * np.minimum(relief, LARGEST_RELIEF))
    errors = np.stack([mean(values) for values in cloud.pose_errors.T], -1)
    normal = _normals(point)
    surface = np.stack([distance, sigma], -1).astype(np.float32)
    usable = known & all_finite(normal)
    step = max(1, round(float(np.sqrt(usable.sum() / POINTS))))
    some = np.zeros_like(usable)
    some[step // 2 :: step, step // 2 :: step] = True
    place = np.flatnonzero(usable & some)
    points = np.concatenate([point, normal, sigma[..., None], errors], -1).reshape(h * w, -1)[place]
    centroid, radius = centre_and_radius(point[usable] if usable.any() else cloud.points)
    return FrameEvidence(
        camera, np.ascontiguousarray(surface), _in_blocks(errors, normal, known), find_empty_places(cloud, camera),
        np.ascontiguousarray(points), centroid, radius,
        max(CORRELATION_AREA * (max(w, h) / LARGEST_SIDE) ** 2 / step**2, len(place) / INDEPENDENT, 1.0),
        float(np.median(sigma[usable])) if usable.any() else 1.0,
        float(np.linalg.norm(cloud.pose_errors.mean(0))),
    )  # fmt: skip


def _in_blocks(
    errors: Float64[ndarray, "h w 5"], normal: Float64[ndarray, "h w 3"], known: Bool[ndarray, "h w"]
) -> Float32[ndarray, "a b 8"]:
    """Means over BLOCK x BLOCK places: what changes slowly need not be kept for each."""
    h, w = known.shape
    shape = -(-h // BLOCK), -(-w // BLOCK)
    row, column = np.nonzero(known)
    index = row // BLOCK * shape[1] + column // BLOCK
    values = np.concatenate([errors[known], np.nan_to_num(normal[known])], 1)
    count = np.maximum(np.bincount(index, minlength=shape[0] * shape[1]), 1)[:, None]
    sums = np.stack([np.bincount(index, v, shape[0] * shape[1]) for v in values.T], -1) / count
    with np.errstate(invalid="ignore", divide="ignore"):
        sums[:, POSE_ERRORS:] /= np.linalg.norm(sums[:, POSE_ERRORS:], axis=1, keepdims=True)
    return np.ascontiguousarray(sums.reshape(*shape, 8).astype(np.float32))


def _normals(point: Float64[ndarray, "h w 3"]) -> Float64[ndarray, "h w 3"]:
    """Unit normals towards the camera from differences of points; NaN where unknown."""
    normal = np.full(point.shape, np.nan)
    for m in NORMAL_REACH:
        across, down = np.full(point.shape, np.nan), np.full(point.shape, np.nan)
        across[:, m:-m] = point[:, 2 * m :] - point[:, : -2 * m]
        down[m:-m] = point[2 * m :] - point[: -2 * m]
        n = np.cross(down, across)
        with np.errstate(invalid="ignore", divide="ignore"):
            n /= np.linalg.norm(n, axis=-1, keepdims=True)
        n *= -np.sign((n * point).sum(-1, keepdims=True))
        normal = np.where(np.isfinite(n).all(-1, keepdims=True), n, normal)
    return normal


def _relief(distance: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
    """Root mean square departure of the distances around each place from a plane (of inverse distances)."""
    known = np.isfinite(distance)
    weight, size = known.astype(np.float64), 2 * RELIEF_REACH + 1
    q = np.where(known, 1 / np.where(known, distance, 1.0), 0.0)
    y, x = np.mgrid[0 : q.shape[0], 0 : q.shape[1]].astype(np.float64)

    def mean(values: Float64[ndarray, "h w"]) -> Float64[ndarray, "h w"]:
        return uniform_filter(values, size, mode="constant")

    total = mean(weight) + 1e-12
    mx, my, mq = mean(weight * x) / total, mean(weight * y) / total, mean(q) / total
    cxx, cyy = mean(weight * x * x) / total - mx * mx, mean(weight * y * y) / total - my * my
    cxy = mean(weight * x * y) / total - mx * my
    cxq, cyq = mean(q * x) / total - mx * mq, mean(q * y) / total - my * mq
    cqq = mean(q * q) / total - mq * mq
    determinant = np.maximum(cxx * cyy - cxy**2, 1e-9)
    a, b = (cxq * cyy - cyq * cxy) / determinant, (cyq * cxx - cxq * cxy) / determinant
    return np.sqrt(np.maximum(cqq - a * cxq - b * cyq, 0)) * distance**2


# The compiled loop.


@compiled_range
def _residuals(
    first, last, points, scale, R, t, reverse, own, other, surface, smooth, block, code, camera, empty, light, hidden,
    least_facing, least_lit, centre, widths, usual, z, codes, spread, H, g
):  # fmt: skip
    """Residual and code of every point under every similarity; adds weighted normal equations where `widths` > 0.

    `own`, `other`: pose errors of the points' frame and of the one they fall on, (k, 5). `reverse`: points are the
    target's, `surface` is the source's.
    """
    h, w = surface.shape[0], surface.shape[1]
    n = points.shape[0]
    M, shift, J = np.empty((3, 3)), np.empty(3), np.empty(17)
    for k in range(first, last):
        s = scale[k]
        M[:] = R[k].T if reverse else R[k]
        for i in range(3):
            shift[i] = -(M[i, 0] * t[k, 0] + M[i, 1] * t[k, 1] + M[i, 2] * t[k, 2]) / s if reverse else t[k, i]
        f = 1 / s if reverse else s
        width = widths[k]
        for m in range(n):
            codes[k, m] = 0
            z[k, m] = 0.0
            spread[k, m] = 1.0
            px, py, pz = points[m, 0], points[m, 1], points[m, 2]
            length = np.sqrt(px * px + py * py + pz * pz)
            off = 0.0
            for e in range(5):
                off += points[m, 7 + e] * own[k, e]
            grown = 1 + off / length
            px, py, pz = px * grown, py * grown, pz * grown
            turned_x, turned_y, turned_z = rotated(M, px, py, pz)
            X, Y, Z = f * turned_x + shift[0], f * turned_y + shift[1], f * turned_z + shift[2]
            column, row, front = pixel_of(code, X, Y, Z, camera)
            u, v = column - 0.5, row - 0.5
            if not (front and u >= 0 and v >= 0 and u < w - 1 and v < h - 1):
                continue
            A, B, C = rotated(M, points[m, 3], points[m, 4], points[m, 5])
            d = np.sqrt(X * X + Y * Y + Z * Z)
            if least_facing * d > -(A * X + B * Y + C * Z):
                continue
            iu, iv = int(u), int(v)
            fu, fv = u - iu, v - iv
            d00, d01 = float(surface[iv, iu, 0]), float(surface[iv, iu + 1, 0])
            d10, d11 = float(surface[iv + 1, iu, 0]), float(surface[iv + 1, iu + 1, 0])
            nu, nv = int(u + 0.5), int(v + 0.5)
            seen = (d00 * (1 - fu) + d01 * fu) * (1 - fv) + (d10 * (1 - fu) + d11 * fu) * fv
            if not np.isfinite(seen):
                codes[k, m] = UNDECODED
                if empty[nv, nu] and lit(X, Y, Z, A, B, C, light, least_lit):
                    codes[k, m] = ABSENT
                continue
            br, bc = nv // block, nu // block
            off = 0.0
            for e in range(5):
                off += smooth[br, bc, e] * other[k, e]
            rho = d - seen - off
            if rho > hidden:
                codes[k, m] = HIDDEN
                continue
            na, nb, nc = float(smooth[br, bc, 5]), float(smooth[br, bc, 6]), float(smooth[br, bc, 7])
            cosine = -(na * X + nb * Y + nc * Z) / d
            if not cosine > 0.1:  # too oblique, or its normal is unknown
                na, nb, nc = A, B, C
                cosine = -(A * X + B * Y + C * Z) / d
            # the residual's derivative by the mapped point: along the normal, over its cosine with the ray
            ga, gb, gc = -na / cosine, -nb / cosine, -nc / cosine
            # and by a motion along the point's own ray
            ea = (ga * turned_x + gb * turned_y + gc * turned_z) * f / (length * grown)
            twist = 0.5 * (d00 + d11 - d01 - d10)
            sigma = np.sqrt(float(surface[nv, nu, 1]) ** 2 + (ea * points[m, 6]) ** 2 + twist * twist)
            codes[k, m] = JUDGED
            r = rho / sigma
            if width <= 0 and r > CONTRADICTING_SIGMAS:
                jump = max(d00, d01, d10, d11) - min(d00, d01, d10, d11)
                if _behind_edge(X, Y, Z, shift, surface, code, camera, jump):
                    codes[k, m] = HIDDEN
                    continue
            z[k, m] = r
            spread[k, m] = sigma / usual
            if width <= 0 or abs(r) > 4 * width:
                continue
            x = r / width
            weight = 1 / (1 + x * x) ** 2
            if reverse:  # the point stays, the increment moves the other frame below it
                Ga, Gb, Gc = row_times_rotation(ga, gb, gc, M)
                Ga, Gb, Gc = -Ga / s, -Gb / s, -Gc / s
                qx, qy, qz = px - centre[0], py - centre[1], pz - centre[2]
            else:
                Ga, Gb, Gc = ga, gb, gc
                qx, qy, qz = X - centre[0], Y - centre[1], Z - centre[2]
            J[0], J[1], J[2] = Ga / sigma, Gb / sigma, Gc / sigma
            turn_x, turn_y, turn_z = cross(qx, qy, qz, Ga, Gb, Gc)
            J[3], J[4], J[5] = turn_x / sigma, turn_y / sigma, turn_z / sigma
            J[6] = (qx * Ga + qy * Gb + qz * Gc) / sigma
            for e in range(5):
                moved, below = ea * points[m, 7 + e] / sigma, -smooth[br, bc, e] / sigma
                J[7 + e] = below if reverse else moved
                J[12 + e] = moved if reverse else below
            for i in range(17):
                scaled = weight * J[i]
                g[k, i] += scaled * r
                for j in range(i + 1):
                    H[k, i, j] += scaled * J[j]


@compiled
def _behind_edge(X, Y, Z, eye, surface, code, camera, jump):
    """Whether a point that lies behind the surface is hidden by an edge of it, and seen past that edge from `eye`.

    On the way towards the other camera the point comes out from behind the surface: through it, or where its distance
    jumps; however far away that is, as behind a post. `jump`: of the distances around the point.
    """
    h, w = surface.shape[0], surface.shape[1]
    d = np.sqrt(X * X + Y * Y + Z * Z)
    a, b, c = eye[0] - X, eye[1] - Y, eye[2] - Z
    far = np.sqrt(a * a + b * b + c * c)
    a, b, c = a / far, b / far, c / far
    along = (a * X + b * Y + c * Z) / d
    sine = np.sqrt(max(1 - along * along, 1e-12))
    column, row, front = pixel_of(code, X, Y, Z, camera)
    short = 1e-3 * d
    column_1, row_1, front = pixel_of(code, X + short * a, Y + short * b, Z + short * c, camera)
    step = short / max(np.sqrt((column_1 - column) ** 2 + (row_1 - row) ** 2), 1e-9)  # by a place of the lattice
    steepest = STEEPEST * step * sine  # change of distance from place to place
    if jump > steepest:
        return True
    last = float(surface[int(row), int(column), 0])
    for n in range(1, int(far / step) + 1):
        x, y, z = X + n * step * a, Y + n * step * b, Z + n * step * c
        column, row, front = pixel_of(code, x, y, z, camera)
        if not (front and column >= 0 and row >= 0 and column < w and row < h):
            return True
        here = float(surface[int(row), int(column), 0])
        if not np.isfinite(here) or abs(here - last) > steepest:
            return True
        if np.sqrt(x * x + y * y + z * z) <= here:
            return False
        last = here
    return False


@dataclass(frozen=True)
class Places(PairSimilarities):
    """Similarities with the errors of both relative poses, in their sigmas."""

    errors: Float64[ndarray, "k 10"]  # of the source, of the target

    @staticmethod
    def of(*each: Similarity) -> "Places":
        """Stack similarities; no errors."""
        return Places.without_errors(Similarities.of(each))

    @staticmethod
    def without_errors(found: Hypotheses | Similarities) -> "Places":
        """Similarities, such as the ends of a search, with no errors."""
        return Places(found.scale, found.R, found.t, np.zeros((len(found.scale), 2 * POSE_ERRORS)))


@dataclass(frozen=True)
class Compared:
    """Residuals (in sigmas) and codes of the points of both frames at k places: source's points first."""

    z: Float32[ndarray, "k n"]
    codes: Int8[ndarray, "k n"]
    spread: Float32[ndarray, "k n"]  # sigma of each residual, relative to what is usual on smooth surface
    indistinct: float = 0.0  # sigmas: residuals within say nothing of the place

    @cached_property
    def density(self) -> Float32[ndarray, "k n"]:
        """Of the residuals of points that lie on the other frame's surface."""
        return density(np.abs(self.z), self.spread)

    @cached_property
    def contrast(self) -> Float32[ndarray, "k n"]:
        """Log-density by which places are compared, relative to that of a residual as it usually is."""
        least = max(self.indistinct, USUAL_SIGMAS)
        usual = density(np.full_like(self.z, least), self.spread)
        return np.log(density(np.maximum(np.abs(self.z), self.indistinct), self.spread) / usual)

    def chosen(self, index: Int64[ndarray, "m"]) -> "Compared":
        """Some of the places."""
        return replace(self, z=self.z[index], codes=self.codes[index], spread=self.spread[index])

    @staticmethod
    def joined(parts: Sequence["Compared"]) -> "Compared":
        """All places of several."""
        z, codes, spread = (np.concatenate([getattr(p, name) for p in parts]) for name in ("z", "codes", "spread"))
        return Compared(z, codes, spread, parts[0].indistinct)

    def noise(self, k: int, points: slice) -> float:
        """How much larger the residuals of some points are at a place than stated; within limits."""
        size = np.abs(self.z[k, points][self.codes[k, points] == JUDGED])
        if len(size) < FEWEST_JUDGED:
            return 1.0
        return float(np.clip((np.quantile(size, NOISE_QUANTILES) / NOISE_RESIDUALS).max(), 1.0, LARGEST_NOISE))

    def overlaps(self, other: "Compared", share: float) -> bool:
        """Whether the first place lets at least a share of the points be judged that the other's does."""
        judged, least = (self.codes[0] == JUDGED).sum(), share * (other.codes[0] == JUDGED).sum()
        return bool(judged >= least)


def density(size: Float32[ndarray, "*n"], spread: Float32[ndarray, "*n"]) -> Float32[ndarray, "*n"]:
    """Of residuals in the right place, by their absolute values; beside edges the decoder is wrong more often."""
    size = np.minimum(size, np.float32(LARGEST_RESIDUAL))
    wide = np.clip(spread, 1, LARGEST_SPREAD)
    wrong, tail = WRONG_SHARE * wide, TAIL_SHARES[1] * wide
    shares = 1 - wrong - tail - TAIL_SHARES[0], TAIL_SHARES[0], tail
    found = wrong / np.float32(2 * LARGEST_RESIDUAL)
    for share, sigma in zip(shares, TAIL_SIGMAS.tolist(), strict=True):
        found += share * np.float32(1 / sigma / np.sqrt(2 * np.pi)) * np.exp(np.float32(-0.5 / sigma**2) * size * size)
    return found


def density_elsewhere(z: Float32[ndarray, "*n"]) -> Float32[ndarray, "*n"]:
    """Of residuals of points that are somewhere else: near the surface, or anywhere."""
    size = np.minimum(np.abs(z), np.float32(LARGEST_RESIDUAL))
    near = np.float32(0.5 / ELSEWHERE_SIGMA / np.sqrt(2 * np.pi))
    return np.float32(0.25 / LARGEST_RESIDUAL) + near * np.exp(np.float32(-0.5 / ELSEWHERE_SIGMA**2) * size * size)


@dataclass(frozen=True)
class Commonness:
    """How often points were tried where they do not belong, and how often they fitted there."""

    fits: Float64[ndarray, "n"]
    trials: Float64[ndarray, "n"]
    absent: float  # points that should have been seen, and were not
    judged: float  # the same and those that could be judged

    @staticmethod
    def none(count: int) -> "Commonness":
        """Before anything was tried."""
        return Commonness(np.zeros(count), np.zeros(count), 0.0, 0.0)

    def __add__(self, other: "Commonness") -> "Commonness":
        return Commonness(
            self.fits + other.fits, self.trials + other.trials, self.absent + other.absent, self.judged + other.judged
        )

    @property
    def share(self) -> Float64[ndarray, "n"]:
        """The share at which each point fits anywhere."""
        return (self.fits + USUAL_SHARE) / (self.trials + 1)

    @property
    def absent_share(self) -> float:
        """The share of points that should be seen and are not, elsewhere."""
        return float(np.clip(self.absent / max(self.judged, 1.0), LEAST_ABSENT, 0.5))


@dataclass(frozen=True)
class Comparison:
    """Places of two frames, or of two groups of frames, compared: log-likelihoods, nats.

    Points that both of two places judge are compared with themselves. What only one of them judges counts as against
    elsewhere. That is worth nothing where the surface looks the same at both: frames that show two such sides agree
    without a surface in common. What contradicts always counts.
    """

    shared: Float64[ndarray, "k k"]  # of the points that both judge: of a place (row) against another (column)
    own: Float64[ndarray, "k k"]  # against elsewhere, of the points that only the first judges
    odds: Float64[ndarray, "k"]  # of each place against elsewhere
    alike: Bool[ndarray, "k k"]  # some frames agree at both places, and nothing tells these apart

    @property
    def leads(self) -> Float64[ndarray, "k k"]:
        """By how many nats each place (row) is more likely than each other (column)."""
        own = np.where(self.alike, np.minimum(self.own, 0), self.own)
        return self.shared + own - own.T

    def __add__(self, other: "Comparison") -> "Comparison":
        return Comparison(
            self.shared + other.shared, self.own + other.own, self.odds + other.odds, self.alike | other.alike
        )

    def bounded(self) -> "Comparison":
        """As far as two frames can be believed: one of them may be wrong itself, by a wrong pose of its projector."""
        shared, own, odds = (
            np.clip(each, -MOST_OF_A_PAIR, MOST_OF_A_PAIR) for each in (self.shared, self.own, self.odds)
        )
        return Comparison(shared, own, odds, self.alike)

    def scaled(self, weight: float) -> "Comparison":
        """Of evidence that counts less."""
        return Comparison(weight * self.shared, weight * self.own, weight * self.odds, self.alike)

    @staticmethod
    def none(count: int) -> "Comparison":
        """Places of which nothing is known."""
        shared, own = np.zeros((2, count, count))
        return Comparison(shared, own, np.zeros(count), np.zeros((count, count), dtype=bool))


def together(seen: Float[ndarray, "*size"], absent: Float[ndarray, "*size"]) -> Float64[ndarray, "*size"]:
    """What points that are seen and points that are absent say, in all.

    Whatever hides a surface and was not decoded itself, such as the dark side of a wall, hides many points at once:
    together they are as unlikely as one.
    """
    return seen.astype(np.float64) + np.maximum(absent, np.log(ABSENT_SHARE))


class PairEvidence:
    """Two frames that are compared."""

    def __init__(self, source: FrameEvidence, target: FrameEvidence, thin: int = 1) -> None:
        self.source, self.target = source, target
        self._points = tuple(np.ascontiguousarray(f.points[::thin]) for f in (source, target))
        self.area = np.concatenate(
            [np.full(len(p), max(f.area / thin, 1.0)) for p, f in zip(self._points, (source, target), strict=True)]
        )
        self._mean_area = float(self.area.mean())

    def compare(self, places: Places) -> Compared:
        """Residuals of all points at all places."""
        return self._compare(places, np.zeros(len(places)))[0]

    def _compare(self, places: Places, width: Float64[ndarray, "k"]) -> tuple[Compared, ndarray, ndarray]:
        """Residuals, and normal equations with robust kernels of the given widths (sigmas) above 0."""
        k = len(places)
        H, g = np.zeros((k, UNKNOWNS, UNKNOWNS)), np.zeros((k, UNKNOWNS))
        zs, codes, spreads = [], [], []
        R, t = np.ascontiguousarray(places.R), np.ascontiguousarray(places.t)
        own = np.ascontiguousarray(places.errors[:, :POSE_ERRORS]), np.ascontiguousarray(places.errors[:, POSE_ERRORS:])
        for reverse, (points, seen) in enumerate(((self._points[0], self.target), (self._points[1], self.source))):
            z, code = np.empty((k, len(points)), np.float32), np.empty((k, len(points)), np.int8)
            spread = np.empty((k, len(points)), np.float32)
            model, parameters = for_loops(seen.camera)
            _residuals(
                k, points, places.scale, R, t, bool(reverse), own[reverse], own[1 - reverse], seen.surface,
                seen.smooth, BLOCK, model, parameters, seen.nothing.empty, seen.nothing.light, seen.hidden,
                LEAST_FACING_COSINE, LEAST_LIT_COSINE, self.target.centroid, width, seen.usual_sigma, z, code, spread,
                H, g,
            )  # fmt: skip
            zs.append(z)
            codes.append(code)
            spreads.append(spread)
        i, j = np.tril_indices(UNKNOWNS, -1)
        H[:, j, i] = H[:, i, j]
        return (
            Compared(np.concatenate(zs, 1), np.concatenate(codes, 1), np.concatenate(spreads, 1)),
            H / self._mean_area,
            g / self._mean_area,
        )

    def refined(
        self, places: Places, widths: Sequence[float], axis: Float64[ndarray, "k 3"] | None = None
    ) -> tuple[Places, Float64[ndarray, "k 17 17"]]:
        """Gauss-Newton steps with a narrowing kernel, and the last information; lengths in radii of the target.

        `axis`: directions about which no rotation is allowed.
        """
        c, radius = self.target.centroid, self.target.radius
        D = np.ones(UNKNOWNS)
        D[:3] = radius
        prior = np.zeros(UNKNOWNS)
        prior[7:] = 1.0
        prior[6] = 1 / 0.25**2
        diagonal = np.arange(UNKNOWNS)
        H = np.zeros((len(places), UNKNOWNS, UNKNOWNS))
        for width in widths:
            _, H, g = self._compare(places, np.full(len(places), width))
            H, g = H * D[:, None] * D, g * D
            H[:, diagonal, diagonal] += prior
            g[:, 7:] += places.errors
            A = H.copy()
            trace = np.trace(H[:, :7, :7], axis1=1, axis2=2)
            A[:, diagonal[:7], diagonal[:7]] += 1e-6 * trace[:, None]
            if axis is not None:
                P = np.tile(np.eye(UNKNOWNS), (len(places), 1, 1))
                held = axis[:, :, None] * axis[:, None, :]
                P[:, 3:6, 3:6] -= held
                A, g = P @ A @ P, (P @ g[..., None])[..., 0]
                A[:, 3:6, 3:6] += held * trace[:, None, None]
            step = -np.linalg.solve(A, g[..., None])[..., 0]
            step[:, :7] /= np.maximum(np.linalg.norm(step[:, :7], axis=1, keepdims=True) / 0.3, 1)
            moved = places.incremented(step[:, :3] * radius, step[:, 3:6], np.exp(step[:, 6]), c)
            places = replace(moved, errors=places.errors + step[:, 7:])
        return places, H

    def commonness(self, found: Compared) -> tuple[Commonness, Commonness]:
        """What places say, at all of which the frames do not belong, about the points of each frame."""
        p, other = found.density, density_elsewhere(found.z)
        judged, absent = found.codes == JUDGED, found.codes == ABSENT
        fits = np.where(judged, USUAL_SHARE * p / (USUAL_SHARE * p + (1 - USUAL_SHARE) * other), 0)
        n = len(self._points[0])
        parts = [
            Commonness(fits[:, s].sum(0).astype(np.float64), judged[:, s].sum(0).astype(np.float64),
                       float(absent[:, s].sum()), float((judged | absent)[:, s].sum()))
            for s in (slice(None, n), slice(n, None))
        ]  # fmt: skip
        return parts[0], parts[1]

    def log_odds(self, found: Compared, common: tuple[Commonness, Commonness]) -> Float64[ndarray, "k"]:
        """Log-likelihood of each place, against that of the same points elsewhere, in nats."""
        return together(*(part.sum(1) for part in self._against_elsewhere(found, common)))

    def _against_elsewhere(
        self, found: Compared, common: tuple[Commonness, Commonness]
    ) -> tuple[Float32[ndarray, "k n"], Float32[ndarray, "k n"]]:
        """What each point that is seen says of each place, and each that is absent."""
        share = np.concatenate([c.share for c in common]).astype(np.float32)
        gone = np.concatenate([np.full(len(c.fits), c.absent_share) for c in common])
        p, other = found.density, density_elsewhere(found.z)
        seen = np.log(p / (share * p + (1 - share) * other)) + np.log((1 - ABSENT_SHARE) / (1 - gone))
        return self._by_code(found, seen, np.log(ABSENT_SHARE / gone))

    def _by_code(
        self, found: Compared, seen: ndarray, absent: ndarray | np.floating
    ) -> tuple[Float32[ndarray, "k n"], Float32[ndarray, "k n"]]:
        here, gone = found.codes == JUDGED, found.codes == ABSENT
        each = np.where(here, seen / self.area, 0), np.where(gone, absent / self.area, 0)
        return each[0].astype(np.float32), each[1].astype(np.float32)

    def comparison(self, found: Compared, common: tuple[Commonness, Commonness]) -> "Comparison":
        """Compare each place with each other."""
        J = ((found.codes == JUDGED) | (found.codes == ABSENT)).astype(np.float32)
        alone = self._against_elsewhere(found, common)
        each = self._by_code(found, found.contrast, np.log(ABSENT_SHARE))
        shared = together(*(part @ J.T for part in each))
        odds, own = together(*(part.sum(1) for part in alone)), together(*(part @ (1 - J).T for part in alone))
        count = J @ J.T
        seen = count >= LEAST_SEEN * np.maximum.outer(np.diag(count), np.diag(count))
        likely = odds > LEAST_ODDS
        alike = seen & np.logical_and.outer(likely, likely) & (np.abs(shared - shared.T) < LEAST_ODDS)
        return Comparison(shared - shared.T, own, odds, alike)

    def noise(self, found: Compared, k: int) -> tuple[float, float]:
        """How much larger residuals are at a place than stated: of the source's points, of the target's."""
        n = len(self._points[0])
        return found.noise(k, slice(None, n)), found.noise(k, slice(n, None))

    def scaled(self, found: Compared, noise: tuple[float, float]) -> Compared:
        """Residuals in units of what they are found to be."""
        each = [np.full(len(points), size) for points, size in zip(self._points, noise, strict=True)]
        return replace(found, z=found.z / np.concatenate(each).astype(np.float32), indistinct=INDISTINCT_SIGMAS)

    def by_likelihood(self, found: Compared) -> Float64[ndarray, "k"]:
        """By how many nats each place leads the others, at worst; of places that see enough of each other's surface."""
        # places close to a right one fit as well: what only one place sees counts where it contradicts
        compared = self.comparison(found, self.commonness(found))
        worst = replace(compared, alike=np.ones_like(compared.alike)).leads
        np.fill_diagonal(worst, np.inf)
        judged = (found.codes == JUDGED).sum(1)
        agreeing = ((found.codes == JUDGED) & (np.abs(found.z) < AGREEING_SIGMAS)).sum(1)
        enough = judged >= LEAST_SEEN * np.max(judged * (agreeing >= LEAST_AGREEING * judged))
        worst = np.where(enough, worst, np.inf)
        return np.where(enough, worst.min(1, initial=np.float64(LARGEST_LEAD)), -LARGEST_LEAD)

    def lead(self, first: Compared, other: Compared) -> float:
        """By how many nats the first place of one is more likely than that of another, on points that both judge."""
        a, b = first.codes[0], other.codes[0]
        both = (a == JUDGED) & (b == JUDGED)
        ratio = np.where(both, first.contrast[0] - other.contrast[0], 0)
        gone = [np.log(ABSENT_SHARE) * ((x == ABSENT) & (y == JUDGED)) for x, y in ((a, b), (b, a))]
        here, there = together(np.zeros(2), np.array([(each / self.area).sum() for each in gone]))
        return float((ratio / self.area).sum() + here - there)


@dataclass(frozen=True)
class _Kept:
    """Residuals at the most likely place close to one that was asked for."""

    place: Similarity
    compared: Compared


class KeptResiduals:
    """Residuals of pairs of frames at the most likely place close to each place that was asked for.

    Nearly the same place is asked for again and again, and the search looks around each all the same.
    """

    def __init__(self, frames: Sequence[FrameEvidence]) -> None:
        self.frames = frames
        self._found: dict[tuple[int, int], list[_Kept]] = {}
        self._count = 0

    def near(self, source: int, target: int, places: Sequence[Similarity]) -> Compared:
        """Residuals at each place."""
        a, b = self.frames[source], self.frames[target]
        pair, before = PairEvidence(a, b), self._found.get((source, target), [])
        known = [next((one for one in before if nearly_same(a, one.place, place)), None) for place in places]
        new = [place for place, one in zip(places, known, strict=True) if one is None]
        if new:
            compared = pair.compare(self._likeliest_near(a, b, Places.of(*new)))
            rows = [_Kept(place, compared.chosen(np.array([k]))) for k, place in enumerate(new)]
            if self._count > MOST_KEPT:
                self._found.clear()
                self._count = 0
            self._found.setdefault((source, target), []).extend(rows)
            self._count += len(new)
            following = iter(rows)
            known = [next(following) if one is None else one for one in known]
        return Compared.joined([one.compared for one in known if one is not None])

    @staticmethod
    def _likeliest_near(a: FrameEvidence, b: FrameEvidence, start: Places) -> Places:
        """The most likely place close to each, or the place itself if the search leaves it."""
        near, _ = PairEvidence(a, b, NEAR_THINNED).refined(start, NEAR_WIDTHS)
        turned = np.degrees(np.arccos(np.clip((np.einsum("kij,kij->k", near.R, start.R) - 1) / 2, -1, 1)))
        p = np.einsum("kji,kj->ki", start.R, b.centroid - start.t) / start.scale[:, None]
        shift = near.scale[:, None] * np.einsum("kij,kj->ki", near.R, p) + near.t - b.centroid
        by_poses = NEAR_SIGMAS * np.hypot(start.scale * a.depth_sigma, b.depth_sigma)
        left = (turned > NEAR_DEG) | (np.linalg.norm(shift, axis=1) > NEAR_SHIFT * b.radius + by_poses)
        both = Places.joined([start, near])
        return both[np.where(left, 0, len(start)) + np.arange(len(start))]


class ScanEvidence:
    """Any two frames of a scan compared at any place, by what its pairs have shown of each frame's points."""

    def __init__(self, residuals: KeptResiduals, common: Sequence[Commonness], noise: Float64[ndarray, "n"]) -> None:
        self._residuals, self.frames, self.common, self.noise = residuals, residuals.frames, common, noise

    def comparison(self, source: int, target: int, places: Sequence[Similarity | None]) -> Comparison:
        """Compare places of two frames; None: there the frames do not face each other."""
        every = Comparison.none(len(places))
        here = [k for k, S in enumerate(places) if S is not None]
        found = self._near(source, target, [S for S in places if S is not None])
        if found is None:
            return every
        evidence, compared = found
        part = evidence.comparison(compared, (self.common[source], self.common[target]))
        every.odds[here] = part.odds
        every.own[:] = every.odds[:, None]
        for whole, some in ((every.shared, part.shared), (every.own, part.own), (every.alike, part.alike)):
            whole[np.ix_(here, here)] = some
        return every

    def agreement(self, source: int, target: int, place: Similarity) -> tuple[float, float, float]:
        """Log-odds of a place; points of both frames that agree there, and that should, in frames: 1 is all of one."""
        found = self._near(source, target, [place])
        if found is None:
            return 0.0, 0.0, 0.0
        evidence, compared = found
        codes, z = compared.codes[0], np.abs(compared.z[0])
        judged = codes == JUDGED
        odds = evidence.log_odds(compared, (self.common[source], self.common[target]))
        agreeing, expected = (judged & (z < AGREEING_SIGMAS)).mean(), (judged | (codes == ABSENT)).mean()
        return float(odds[0]), float(agreeing), float(expected)

    def _near(self, source: int, target: int, places: Sequence[Similarity]) -> tuple[PairEvidence, Compared] | None:
        """Residuals at the most likely place close to each; None if a frame has no points."""
        a, b = self.frames[source], self.frames[target]
        if not (places and len(a.points) and len(b.points)):
            return None
        pair, noise = PairEvidence(a, b), (float(self.noise[source]), float(self.noise[target]))
        return pair, pair.scaled(self._residuals.near(source, target, places), noise)


def nearly_same(source: FrameEvidence, S: Similarity, place: Similarity) -> bool:
    """Whether two similarities put a frame at nearly the same place."""
    if (S.R * place.R).sum() <= NEARLY_SAME_TRACE or abs(np.log(S.scale / place.scale)) > NEARLY_SAME_SHIFT:
        return False
    centre = source.centroid[None]
    moved = np.linalg.norm(S.points(centre) - place.points(centre))
    return bool(moved < NEARLY_SAME_SHIFT * place.scale * source.radius)

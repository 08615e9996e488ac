"""Two frames turned against each other to where their tones agree, along a motion that their surfaces do not notice.

A vase, a bottle or a ball looks the same from all around, but for its texture. So the whole way around is tried, and
the place where the tones of both frames are most alike is taken if it is clearly better than all others.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.compiled import compiled_range
from sl_nerfstudio.geometry.devices.models import pixel_of
from sl_nerfstudio.geometry.similarity import Similarity, angle_deg
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.slip import followed, screw_motion
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance
from sl_nerfstudio.registration.settings import PairSettings
from sl_nerfstudio.registration.tone.settings import ToneMatchSettings


@dataclass(frozen=True)
class Likeness:
    """How alike the tones of two frames are under each of k similarities."""

    correlation: Float64[ndarray, "k"]  # NaN where too little of both surfaces is seen
    share: Float64[ndarray, "k"]  # of the source's toned points that are compared


@dataclass(frozen=True)
class ToneTurn:
    """Where the tones agree."""

    S_target_source: Similarity
    direction: Float64[ndarray, "7"]  # the motion (v, w, l) along which the frames slip, |w| = 1
    shape_slip_deg: float  # how far the surfaces alone let them
    sigma_deg: float  # of the rotation along it, by tones


def turn_by_tone(
    sides: tuple[Side, Side],
    S_target_source: Similarity,
    slip: tuple[Float64[ndarray, "7"], float],
    common: Tolerance,
    settings: PairSettings,
) -> ToneTurn | None:
    """The similarity along a motion at which tones agree; None where none stands out.

    `slip` is the motion (v, w, l), and how far, in degrees, the surfaces do not notice it; `common` is how closely they
    agree.
    """
    direction, shape_slip_deg = slip
    if not all(np.isfinite(side.map.tone).any() for side in sides):
        return None
    way = _around(sides, S_target_source, direction, common, settings)
    peak = _peak(likeness(sides, way, common, settings), settings.tone)
    if peak is None or peak.sigma_deg > settings.tone.largest_sigma_deg:
        return None
    if angle_deg(way.R[peak.index]) < peak.half_width_deg:
        return None  # both cameras see it from the same side: what light and view make there looks the same, too
    rest = np.radians(peak.offset_deg) * direction
    turned = Hypotheses.of(screw_motion(rest, sides[1].map) @ way.similarity(peak.index))
    for _ in range(settings.slip_steps):
        turned = followed(sides, turned, direction[3:6], common, settings)
    return ToneTurn(turned.similarity(0), direction, shape_slip_deg, max(peak.sigma_deg, settings.tone.least_sigma_deg))


def likeness(sides: tuple[Side, Side], ways: Hypotheses, common: Tolerance, settings: PairSettings) -> Likeness:
    """Correlation of the source's tones with those of the target where its points lie on that surface."""
    source, target = sides[0].map, sides[1].map
    toned = source.valid & np.isfinite(source.tone)
    points, normals, sigma, tone = source.point[toned], source.normal[toned], source.sigma[toned], source.tone[toned]
    thin = slice(None, None, max(1, len(points) // settings.tone.points))
    sums = np.zeros((len(ways), 6))
    scale, R, t = ways.scale, np.ascontiguousarray(ways.R), np.ascontiguousarray(ways.t)
    _sums(
        len(scale), points[thin], normals[thin], sigma[thin], tone[thin], scale, R, t,
        target.point, target.normal, target.sigma, target.valid, target.tone, target.model_code, target.parameters,
        common.sigmas, settings.agreement.least_facing_cosine, sums,
    )  # fmt: skip
    n, a, b, aa, bb, ab = sums.T
    share = n / max(len(points[thin]), 1)
    n = np.maximum(n, 1)
    spread = np.sqrt(np.maximum(aa / n - (a / n) ** 2, 0) * np.maximum(bb / n - (b / n) ** 2, 0))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = (ab / n - a * b / n**2) / spread
    enough = (share > settings.tone.least_share) & (spread > 0)
    return Likeness(np.where(enough, correlation, np.nan), share)


def _around(
    sides: tuple[Side, Side], S: Similarity, direction: Float64[ndarray, "7"], common: Tolerance, settings: PairSettings
) -> Hypotheses:
    """Similarities along the motion, a step apart, once around; all but the rotation follows the surfaces."""
    s, target = settings.tone, sides[1].map
    few = sides[0].thinned(s.followed_points), sides[1].thinned(s.followed_points)
    ways: list[list[Hypotheses]] = []
    for sense in (-1.0, 1.0):
        step, way = screw_motion(sense * np.radians(s.step_deg) * direction, target), [Hypotheses.of(S)]
        for _ in range(round(180 / s.step_deg)):
            at = Hypotheses.of(step @ way[-1].similarity(0))
            for _ in range(s.follow_steps):
                at = followed(few, at, direction[3:6], common, settings)
            if not abs(np.log(at.scale[0] / S.scale)) < settings.largest_log_scale:
                break  # nothing is left that it could follow
            way.append(at)
        ways.append(way)
    return Hypotheses.joined([*reversed(ways[0][1:]), *ways[1]])


@dataclass(frozen=True)
class _Peak:
    """Where tones agree clearly better than anywhere else along the way."""

    index: int
    offset_deg: float  # from there to the top
    half_width_deg: float  # from the top to where the correlation has fallen to a half
    sigma_deg: float


def _peak(found: Likeness, settings: ToneMatchSettings) -> _Peak | None:
    """None where no similarity has tones that agree clearly better than those of all that are apart from it."""
    c = found.correlation.clip(-settings.largest_correlation, settings.largest_correlation)
    if not np.isfinite(c[1:-1]).any():
        return None
    best = 1 + int(np.nanargmax(c[1:-1]))
    if c[best] < settings.least_correlation or not np.isfinite(c[[best - 1, best + 1]]).all():
        return None
    width = _half_width(c, best)
    apart = c[(np.abs(np.arange(len(c)) - best) > 2 * width) & np.isfinite(c)]
    if len(apart) < settings.fewest_others:
        return None
    spread = float(np.sqrt(np.mean(np.arctanh(apart) ** 2)))  # of Fisher's transform, where nothing is in common
    left, top, right = np.arctanh(c[[best - 1, best, best + 1]])
    if top - np.arctanh(apart.max()) < settings.least_lead * spread:
        return None
    # The likelihood of n independent places, of which spread^-2 is the number, falls by n / 2 times the square of it.
    bend = max(2 * top - left - right, 1e-6)
    offset, sigma = float(np.clip(0.5 * (right - left) / bend, -0.5, 0.5)), spread / float(np.sqrt(top * bend))
    return _Peak(best, settings.step_deg * offset, settings.step_deg * width, settings.step_deg * sigma)


def _half_width(c: Float64[ndarray, "k"], best: int) -> int:
    """Steps from the best to where less than half of its correlation is left, on the side where that is farther."""
    low = np.flatnonzero(~(c > c[best] / 2))
    before, after = low[low < best], low[low > best]
    first, last = (before[-1] if len(before) else 0), (after[0] if len(after) else len(c) - 1)
    return int(max(best - first, last - best))


@compiled_range
def _sums(
    first, last, points, normals, sigma, tone, scale, R, t, map_point, map_normal, map_sigma, valid, map_tone, code,
    camera, sigmas, least_facing, out
):  # fmt: skip
    """Adds the number, sums and products of tones that meet, for each similarity."""
    h, w = valid.shape
    for k in range(first, last):
        s = scale[k]
        for n in range(len(points)):
            x, y, z = points[n, 0], points[n, 1], points[n, 2]
            a, b, c = normals[n, 0], normals[n, 1], normals[n, 2]
            X = s * (R[k, 0, 0] * x + R[k, 0, 1] * y + R[k, 0, 2] * z) + t[k, 0]
            Y = s * (R[k, 1, 0] * x + R[k, 1, 1] * y + R[k, 1, 2] * z) + t[k, 1]
            Z = s * (R[k, 2, 0] * x + R[k, 2, 1] * y + R[k, 2, 2] * z) + t[k, 2]
            column, row, in_front = pixel_of(code, X, Y, Z, camera)
            if not (in_front and column >= 0 and row >= 0 and column < w and row < h):
                continue
            i, j = int(row), int(column)
            if not valid[i, j] or not np.isfinite(map_tone[i, j]):
                continue
            na, nb, nc = map_normal[i, j, 0], map_normal[i, j, 1], map_normal[i, j, 2]
            A = R[k, 0, 0] * a + R[k, 0, 1] * b + R[k, 0, 2] * c
            B = R[k, 1, 0] * a + R[k, 1, 1] * b + R[k, 1, 2] * c
            C = R[k, 2, 0] * a + R[k, 2, 1] * b + R[k, 2, 2] * c
            off = na * (X - map_point[i, j, 0]) + nb * (Y - map_point[i, j, 1]) + nc * (Z - map_point[i, j, 2])
            if na * A + nb * B + nc * C < least_facing or abs(off) > sigmas * np.hypot(s * sigma[n], map_sigma[i, j]):
                continue
            p, q = tone[n], map_tone[i, j]
            out[k, 0] += 1
            out[k, 1] += p
            out[k, 2] += q
            out[k, 3] += p * p
            out[k, 4] += q * q
            out[k, 5] += p * q

"""Registration of two frames by a similarity: search over rotations where no guess is given, then refinement.

Point-to-plane with projective association (Blais and Levine, PAMI 1995), both ways, with a scale whose logarithm has a
prior and a bound: each frame's baseline has an unknown length, but a free scale would collapse a cloud onto a patch.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.hypotheses import Hypotheses
from sl_nerfstudio.registration.pair_match import PairMatch, match_from
from sl_nerfstudio.registration.rotation_search import around_guess, without_guess
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PairSettings, Search
from sl_nerfstudio.registration.surface_agreement import Side, agreement
from sl_nerfstudio.registration.surface_map import SurfaceMap

Sides = tuple[Side, Side]  # of the source and the target


def register_pair(
    maps: tuple[SurfaceMap, SurfaceMap],
    pair: tuple[int, int],
    search: Search,
    rng: np.random.Generator,
    guess: Similarity | None = None,
    settings: PairSettings = REGISTRATION_DEFAULTS.pair,
) -> PairMatch | None:
    """Frame `pair[0]` onto frame `pair[1]`; None where no similarity makes anything agree.

    With a guess the search rotates it about the object; without one it starts from both cameras looking at the object
    from the same side, at scales around the one that makes the visible parts equally large.
    """
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return None

    def sides(count: int) -> Sides:
        return Side.sampled(source, count, rng), Side.sampled(target, count, rng)

    if guess is None:
        found = without_guess(source, target, search, settings.start_scales)
    else:
        found = around_guess(target, search, guess)
    few = sides(settings.search_points)
    best = _ranked(few, found, settings.search_tolerance, settings)
    found = found[best[: settings.coarse_starts]]
    log_scale = np.log(guess.scale if guess else target.radius / source.radius)
    coarse = sides(settings.coarse_points)
    for width in settings.coarse_widths:
        found = _improved(coarse, found, width, log_scale, settings)
    best = _ranked(coarse, found, settings.coarse_tolerance_factor * settings.tolerance, settings)
    found = found[_distinct(found, best, settings.fine_starts, target, settings)]
    fine = sides(settings.fine_points)
    for width in settings.fine_widths:
        found = _improved(fine, found, width, log_scale, settings)
    return _best_match(fine, found, pair, settings)


def _ranked(sides: Sides, found: Hypotheses, tolerance: float, settings: PairSettings) -> list[int]:
    """Their indices, the highest score first."""
    score = agreement(*sides, found, tolerance, tolerance, settings.agreement).score(settings.agreement.behind_penalty)
    return np.argsort(-score, kind="stable").tolist()


def _distinct(
    found: Hypotheses, ranked: list[int], count: int, target: SurfaceMap, settings: PairSettings
) -> list[int]:
    """The first `count` of the ranked ones, without those that are close to a better one."""
    kept: list[int] = []
    for k in ranked:
        if len(kept) == count:
            break
        if all(_differ(found, k, j, target, settings) for j in kept):
            kept.append(k)
    return kept


def _differ(found: Hypotheses, a: int, b: int, target: SurfaceMap, settings: PairSettings) -> bool:
    angle_deg, shift = found.difference(a, b, target.centroid)
    return angle_deg > settings.same_rotation_deg or shift / target.radius > settings.same_shift


def _improved(
    sides: Sides, found: Hypotheses, width: float, expected_log_scale: float, settings: PairSettings
) -> Hypotheses:
    """After one damped Gauss-Newton step of each."""
    sums = agreement(*sides, found, width, width, settings.agreement)
    target = sides[1].map
    radius, c, log_scale = target.radius, target.centroid, np.log(found.scale)
    D = np.array([1, 1, 1, radius, radius, radius, radius])  # rotations and scalings as lengths at one radius
    H, g = sums.H / D[:, None] / D, sums.g / D
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None].clip(1e-12)
    H = H + settings.damping * trace * np.eye(7)
    # Prior of the scale: a departure by its sigma costs as much as all independent points being off by the width.
    prior = trace[:, 0, 0] / 3 / settings.independent_points * width**2 / settings.scale_sigma**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (log_scale - expected_log_scale) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    size = np.linalg.norm(step * D, axis=1, keepdims=True)
    step = step / np.maximum(size / (settings.largest_step * radius), 1)
    bound = settings.largest_log_scale
    bounded = np.clip(log_scale + step[:, 6], expected_log_scale - bound, expected_log_scale + bound)
    growth = np.exp(bounded) / found.scale
    turn = Rotation.from_rotvec(step[:, 3:6]).as_matrix()
    t = c + growth[:, None] * np.einsum("kij,kj->ki", turn, found.t - c) + step[:, :3]
    return Hypotheses(np.exp(bounded), turn @ found.R, t)


def _best_match(sides: Sides, found: Hypotheses, pair: tuple[int, int], settings: PairSettings) -> PairMatch | None:
    """The best of the refined similarities, with the figures that show whether it is right."""
    sums = agreement(*sides, found, settings.tolerance, settings.tolerance, settings.agreement)
    score = sums.score(settings.agreement.behind_penalty)
    best, *others = np.argsort(-score, kind="stable").tolist()
    if sums.agreeing[best] <= 0:
        return None
    target = sides[1].map
    different = [k for k in others if _differ(found, k, best, target, settings)]
    ratio = max(0.0, float(score[different[0]] / max(score[best], 1e-9))) if different else 0.0
    return match_from(pair, found.similarity(best), sums, best, ratio, target.radius, settings)

"""Registration of two frames by a similarity: search over rotations where no guess is given, then refinement.

Point-to-plane with projective association (Blais and Levine, PAMI 1995), both ways, with a scale whose logarithm has a
prior and a bound: each frame's baseline has an unknown length, but a free scale would collapse a cloud onto a patch.
"""

import numpy as np

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pairs.hypotheses import Hypotheses
from sl_nerfstudio.registration.pairs.pair_match import PairMatch, Rival, match_from
from sl_nerfstudio.registration.pairs.rotation_search import around_guess, without_guess
from sl_nerfstudio.registration.pairs.surface_agreement import Side, Tolerance, agreement
from sl_nerfstudio.registration.pairs.tone_match import turn_by_tone
from sl_nerfstudio.registration.settings import REGISTRATION_DEFAULTS, PairSettings, Search
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
    from the same side.
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
    coarse = sides(settings.coarse_points)
    for width in settings.coarse_widths:
        found = _improved(coarse, found, Tolerance(width, settings.kernel_sigmas), settings)
    best = _ranked(coarse, found, settings.coarse_tolerance, settings)
    found = found[_distinct(found, best, settings.fine_starts, target, settings)]
    fine = sides(settings.fine_points)
    for width in settings.fine_widths:
        found = _improved(fine, found, Tolerance(width, settings.kernel_sigmas), settings)
    common = Tolerance(0.0, _common_width(fine, found, settings))
    for _ in range(settings.common_steps):
        found = _improved(fine, found, common, settings)
    return _best_match(fine, found, common, pair, settings)


def search_score(
    maps: tuple[SurfaceMap, SurfaceMap],
    search: Search,
    rng: np.random.Generator,
    settings: PairSettings = REGISTRATION_DEFAULTS.pair,
) -> float:
    """How well the best of all starts agrees, before any refinement: which pairs are worth registering."""
    source, target = maps
    if not (source.valid.any() and target.valid.any()):
        return -1.0
    sides = tuple(Side.sampled(m, settings.likeness_points, rng) for m in maps)
    found = without_guess(source, target, search, settings.start_scales)
    a, tolerance = settings.agreement, Tolerance(settings.search_tolerance, settings.tolerance_sigmas)
    return float(agreement(sides[0], sides[1], found, tolerance, tolerance, a).score(a.search_penalty, a.behind).max())


def _ranked(sides: Sides, found: Hypotheses, radii: float, settings: PairSettings) -> list[int]:
    """Their indices, the highest score first; points within some radii agree."""
    tolerance = Tolerance(radii, settings.tolerance_sigmas)
    a = settings.agreement
    score = agreement(*sides, found, tolerance, tolerance, a).score(a.search_penalty, a.behind)
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


def _improved(sides: Sides, found: Hypotheses, kernel: Tolerance, settings: PairSettings) -> Hypotheses:
    """After one damped Gauss-Newton step of each."""
    sums = agreement(*sides, found, kernel, kernel, settings.agreement)
    target = sides[1].map
    radius, c, log_scale = target.radius, target.centroid, np.log(found.scale)
    D = np.array([1, 1, 1, radius, radius, radius, radius])  # rotations and scalings as lengths at one radius
    H, g = sums.H / D[:, None] / D, sums.g / D
    trace = np.trace(H, axis1=1, axis2=2)[:, None, None].clip(1e-12)
    H = H + settings.damping * trace * np.eye(7)
    # Prior of the scale: a departure by its sigma costs as much as all independent points being off by the width.
    width = max(kernel.radii, kernel.sigmas * float(np.median(sides[1].sigma)) / radius)
    prior = trace[:, 0, 0] / 3 / settings.independent_points * width**2 / settings.scale_sigma**2
    H[:, 6, 6] += prior
    g[:, 6] += prior * (log_scale - found.log_scale_prior) * radius
    step = -np.linalg.solve(H, g[..., None])[..., 0] / D
    size = np.linalg.norm(step * D, axis=1, keepdims=True)
    step = step / np.maximum(size / (settings.largest_step * radius), 1)
    bound = settings.largest_log_scale
    bounded = found.log_scale_prior + np.clip(log_scale + step[:, 6] - found.log_scale_prior, -bound, bound)
    return found.incremented(step[:, :3], step[:, 3:6], np.exp(bounded) / found.scale, c)


def _common_width(sides: Sides, found: Hypotheses, settings: PairSettings) -> float:
    """Standard deviations within which surfaces agree if they are the same: from the result that agrees most closely.

    How uncertain the surfaces are says how far they may be apart, not how far they are: most of it is common to all
    points, and a similarity takes it up. What remains shows a relief that would otherwise be lost in it.
    """
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    sums = agreement(*sides, found, tolerance, tolerance, settings.agreement)
    likely = sums.agreeing >= settings.likely * sums.agreeing.max()
    rms = float(np.sqrt(sums.squares[likely].min())) if likely.any() else 0.0
    return float(np.clip(settings.common_rms * rms, settings.least_width, settings.tolerance_sigmas))


def _best_match(
    sides: Sides, found: Hypotheses, common: Tolerance, pair: tuple[int, int], settings: PairSettings
) -> PairMatch | None:
    """The result that explains most at the common width, with the others and how far they fall short."""
    a = settings.agreement
    score = agreement(*sides, found, common, common, a).score(a.penalty, a.behind)
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    sums = agreement(*sides, found, tolerance, tolerance, a)
    best, *others = np.argsort(-score, kind="stable").tolist()
    if sums.agreeing[best] <= 0:
        return None
    target = sides[1].map
    different: list[int] = []
    for k in others:
        if score[k] > 0 and all(_differ(found, k, j, target, settings) for j in [best, *different]):
            different.append(k)
    rivals = tuple(Rival(found.similarity(k), float(score[k] / max(score[best], 1e-9))) for k in different)
    match = match_from(pair, found.similarity(best), sums, best, rivals, sides, common, settings)
    return _held_by_tone(match, sides, common, settings) or match


def _held_by_tone(match: PairMatch, sides: Sides, common: Tolerance, settings: PairSettings) -> PairMatch | None:
    """A pair that slips, turned to where its tones agree; None if it does not slip, or where that is not certain.

    Other results for the pair are passed over: tones were compared all the way around.
    """
    if match.slip_deg == 0:
        return None
    turn = turn_by_tone(sides, match.S_target_source, (match.slip_direction, match.slip_deg), common, settings)
    if turn is None:
        return None
    tolerance = Tolerance(0.0, settings.tolerance_sigmas)
    S = turn.S_target_source
    sums = agreement(*sides, Hypotheses.of(S), tolerance, tolerance, settings.agreement)
    if sums.fitness[0] < match.fitness - settings.tone.largest_loss:
        return None
    return match_from((match.source, match.target), S, sums, 0, (), sides, common, settings, turn)

"""The verdict on a scan: the worst of everything that is known of it, not an average."""

import math
from collections.abc import Iterable, Iterator, Sequence

from sl_nerfstudio.verdict.agreement import CrossFrameAgreement, FrameCrossAgreement
from sl_nerfstudio.verdict.blocks import agreeing_groups, bridges
from sl_nerfstudio.verdict.facts import FrameFacts, PairFacts, ScanFacts
from sl_nerfstudio.verdict.settings import VerdictSettings
from sl_nerfstudio.verdict.verdict import Band, Reason, Verdict, listed, worst


def judge_scan(facts: ScanFacts, settings: VerdictSettings | None = None) -> Verdict:
    """The verdict with all reasons; facts that are not known are not judged."""
    return worst(reasons_of(facts, settings or VerdictSettings()))


def reasons_of(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Everything that keeps the scan from being good."""
    if len(facts.in_scan) < 2:
        yield Reason("poor", f"only {len(facts.in_scan)} of {len(facts.frames)} frames could be used")
        return
    yield from _left_out(facts, settings)
    yield from _undecided(facts, settings)
    if facts.by_order:
        yield _placed_by_order(facts.turns_deg)
    elif facts.turns_deg:
        yield Reason("poor", symmetry_sentence(facts.turns_deg))
    if facts.pairs is not None:
        yield from _weak_connections(facts, settings)
    if facts.cross is not None:
        yield from cross_reasons([f.name for f in facts.in_scan], facts.cross, settings)
    yield from _decoding(facts, settings)
    yield from _missing(facts, settings)
    degenerate = [f.name for f in facts.in_scan if f.degenerate]
    if len(degenerate) > settings.most_frames * len(facts.in_scan):
        yield Reason("acceptable", f"the pose of the projector is weakly determined in {listed(degenerate)}")
    if not facts.adjusted:
        yield Reason(
            "acceptable", "the poses are those of the registration alone (--no-adjust); frames were compared within "
            "its uncertainty only",
        )  # fmt: skip
    if facts.wrong_intrinsics:
        yield Reason("acceptable", "the captures contradict the stated intrinsics")


def _left_out(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Frames that are not in the scan: those that form groups of their own, and single ones."""
    lost = [f for f in facts.frames if not f.in_scan]
    band = _share_band(len(lost), len(facts.frames), settings)
    apart = sorted({f.component for f in lost if f.component})
    for number in apart:
        names = [f.name for f in lost if f.component == number]
        yield Reason(
            band,
            f"{listed(names)}: {'form a group of their own' if len(names) > 1 else 'stands alone'}; the connection to "
            "the other frames is not certain, so they are not in the scan",
        )
    single = [f.name for f in lost if not f.component]
    if single:
        yield Reason(band, f"{len(single)} of {len(facts.frames)} frames were left out: {listed(single)}")


def _undecided(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Frames in the scan whose pose is not certain."""
    good, largest = settings.good_sigma_deg, settings.largest_sigma_deg
    lost = [f for f in facts.in_scan if (f.sigma_rotation_deg or 0.0) > largest]
    if lost:
        yield Reason("poor", _known_only(lost, largest))
    loose = [f for f in facts.in_scan if good < (f.sigma_rotation_deg or 0.0) <= largest]
    if loose and facts.adjusted:  # without the adjustment, it is so in every frame of any scan
        yield Reason("acceptable", _known_only(loose, good))
    names = [f.name for f in facts.in_scan if f.undecided and f not in lost + loose]
    if names:
        band = _share_band(len(names), len(facts.in_scan), settings)
        yield Reason(band, f"{listed(names)}: the pose is undecided; along the surface, others fit as well")


def _known_only(frames: Sequence[FrameFacts], limit_deg: float) -> str:
    """That the rotation of frames is uncertain, with the most uncertain one."""
    sigma = max(f.sigma_rotation_deg or 0.0 for f in frames)
    said = f"{sigma:.2g}" if sigma < 10 else f"{sigma:.0f}"
    return (
        f"{listed([f.name for f in frames])}: rotation known only to {said} degrees (1 sigma of the least certain; at "
        f"most {limit_deg:g})"
    )


def symmetry_sentence(turns_deg: Sequence[float]) -> str:
    """That the surface looks the same after turns, and what it means."""
    return (
        f"{_same_after(turns_deg)}, and pairs of frames contradict each other by it: frames may be placed at another "
        "side than they show. The surface is right if the object really is that symmetric; for the poses, capture in "
        "small steps around it, or put something beside it that looks different from all sides"
    )


def _placed_by_order(turns_deg: Sequence[float]) -> Reason:
    """What it means that the order of capture decided which side each frame shows."""
    how = "each was placed by the order of capture, turned as little as possible against the one before"
    if not turns_deg:
        return Reason(
            "acceptable",
            f"frames fit at several sides of the object; {how}. Unless they were captured in this order, in small "
            "steps, they are at other sides than they show",
        )
    return Reason(
        "poor",
        f"{_same_after(turns_deg)}, so nothing tells which side a frame shows; {how}. That is right if the frames were "
        f"captured in this order, in steps of less than {min(turns_deg) / 2:.0f} degrees; to be certain, put something "
        "beside it that looks different from all sides",
    )


def _same_after(turns_deg: Sequence[float]) -> str:
    return f"the object looks the same after a turn by {listed([f'{angle:.0f}' for angle in turns_deg])} degrees"


def _weak_connections(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Pairs of frames that contradict other pairs, and single pairs that hold the scan together."""
    pairs, names = facts.pairs or (), [f.name for f in facts.in_scan]
    inside = [p for p in pairs if set(p.frames) <= set(names)]
    used = [p.frames for p in inside if p.used]
    # frames from opposite sides are compared, too, where no order is known, and fit somewhere, though not well
    doubtful = [name for name in names if _support(name, inside, False) > _support(name, inside, True)]
    if doubtful:
        yield Reason(
            _share_band(len(doubtful), len(names), settings),
            f"{listed(doubtful)}: most pairs with other frames contradict the pose found",
        )
    index = {name: k for k, name in enumerate(names)}
    if len(names) < 3:
        return  # the only pair: nothing could confirm it but the agreement of its coordinates, which is judged
    for (a, b), part in bridges([(index[a], index[b]) for a, b in used], range(len(names))):
        yield Reason(
            "acceptable",
            f"only the pair {names[a]} and {names[b]} connects {listed([names[k] for k in part])} to the other frames; "
            "no other pair confirms it",
        )


def _support(name: str, pairs: Iterable[PairFacts], used: bool) -> float:
    """Of the pairs of a frame that are used, or are not, together."""
    return math.fsum(p.support for p in pairs if name in p.frames and p.used == used)


def cross_reasons(names: Sequence[str], cross: CrossFrameAgreement, settings: VerdictSettings) -> Iterator[Reason]:
    """What the coordinates of the frames say about each other; `names` in the order of `cross.frames`."""
    alone = [name for name, f in zip(names, cross.frames, strict=True) if not f.seen >= settings.least_seen]
    if alone:
        yield Reason(
            _share_band(len(alone), len(names), settings),
            f"{listed(alone)}: no other frame shows enough of the same surface (at least {settings.least_seen:.0%}) to "
            "confirm the pose",
        )
    if not cross.pairs:
        return
    groups = agreeing_groups(cross, settings.cross)
    named = {k for group in groups[1:] for k in group}
    yield from _contradicting_groups(names, cross, groups)
    for k, (name, frame) in enumerate(zip(names, cross.frames, strict=True)):
        band = frame_band(frame, settings)
        if band != "good" and k not in named:
            yield Reason(band, _frame_sentence(name, frame, cross, band))
    if cross.share < settings.good_share:
        yield Reason(
            "poor" if cross.share < settings.least_share else "acceptable",
            f"of all points that two frames saw, {cross.share:.0%} agree: 95 % lie within {cross.px_p95:.2g} px, the "
            f"noise is {cross.noise_px:.2g} px",
        )


def frame_band(frame: FrameCrossAgreement, settings: VerdictSettings) -> Band:
    """The judgement on one frame by its agreement with the others."""
    if frame.share < settings.least_share or frame.excess > settings.cross.contradicting_excess:
        return "poor"
    return "acceptable" if frame.share < settings.good_share or frame.excess > settings.good_excess else "good"


def _contradicting_groups(
    names: Sequence[str], cross: CrossFrameAgreement, groups: Sequence[Sequence[int]]
) -> Iterator[Reason]:
    if len(groups) > 1 and len(groups[0]) <= len(names) / 4:
        yield Reason(
            "poor",
            f"the frames contradict each other: at most {len(groups[0])} of {len(names)} agree, and 95 % of the points "
            f"that two frames saw lie only within {cross.px_p95:.2g} px",
        )
        return
    for group in groups[1:]:
        between = [p.px_p95 for p in cross.pairs if len(set(p.frames) & set(group)) == 1]
        if not between:
            yield Reason(
                "poor",
                f"{listed([names[k] for k in group])}: no surface in common with the other frames, so nothing confirms "
                "how the two parts lie to each other",
            )
            continue
        if len(group) == 1:
            yield Reason("poor", _frame_sentence(names[group[0]], cross.frames[group[0]], cross, "poor"))
            continue
        yield Reason(
            "poor",
            f"{listed([names[k] for k in group])}: agree with each other and contradict the other frames: 95 % of the "
            f"points that both saw lie only within {_median(between):.2g} px (in the whole scan: noise "
            f"{cross.noise_px:.2g} px)",
        )


def _frame_sentence(name: str, frame: FrameCrossAgreement, cross: CrossFrameAgreement, band: Band) -> str:
    usual = _median([f.px_p95 for f in cross.frames if math.isfinite(f.px_p95)])
    return (
        f"{name}: {'contradicts' if band == 'poor' else 'agrees less well with'} the frames that saw the same surface: "
        f"{frame.excess:.2g} times the usual residual, {frame.share:.0%} of its points within the noise, 95 % within "
        f"{frame.px_p95:.2g} px (usual in this scan: {usual:.2g} px)"
    )


def _decoding(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Frames with little decoded, and frames whose coordinates contradict their own pose."""
    own = "of the decoded pixels agree with the pose of the projector"
    seen = [(f.shared_decoded, f) for f in facts.in_scan]
    alone = [(f.decoded_share, f) for f in facts.in_scan if f.shared_decoded is None]
    for shares, least, words in (
        (seen, settings.least_decoded, "of the surface that other frames show was decoded"),
        (alone, settings.least_decoded, "of the visible pattern was decoded"),
        ([(f.own_share, f) for f in facts.in_scan], settings.least_own_share, own),
    ):
        weak = [(value, f.name) for value, f in shares if value is not None and value < least]
        if weak:
            share, name = min(weak)
            others = f"; also little in {listed([n for _, n in weak if n != name])}" if len(weak) > 1 else ""
            band = _share_band(len(weak), len(facts.in_scan), settings)
            yield Reason(band, f"{name}: only {share:.0%} {words} (at least {least:.0%}){others}")


def _missing(facts: ScanFacts, settings: VerdictSettings) -> Iterator[Reason]:
    """Frames that saw nothing where others show a surface."""
    most = settings.most_missing
    found = [(f.missing_share, f.name) for f in facts.in_scan if f.missing_share is not None and f.missing_share > most]
    if found:
        worst_share = max(found)[0]
        yield Reason(
            _share_band(len(found), len(facts.in_scan), settings),
            f"{listed([name for _, name in found])}: saw nothing of the pattern where other frames show a surface in "
            f"the sight of both devices ({worst_share:.0%} of it in the worst of them; at most {most:.0%}): something "
            "cast a shadow, or frames are at the wrong place",
        )


def _share_band(count: int, total: int, settings: VerdictSettings) -> Band:
    return "poor" if count > settings.most_frames * total else "acceptable"


def _median(values: Sequence[float]) -> float:
    ordered = sorted(values)
    return ordered[len(ordered) // 2] if ordered else math.nan

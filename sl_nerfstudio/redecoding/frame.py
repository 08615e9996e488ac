"""One frame decoded again."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64
from numpy import ndarray
from scipy.ndimage import find_objects, gaussian_filter

from sl_nerfstudio.decoding.regions import drop_small_regions
from sl_nerfstudio.geometry.spacing import evenly_spaced
from sl_nerfstudio.redecoding.acceptance import AGREES, Limits, confirmed, learn
from sl_nerfstudio.redecoding.ambiguity import Ambiguity
from sl_nerfstudio.redecoding.correlation import STEEPEST, View
from sl_nerfstudio.redecoding.measure import Measured, Shown, correlation_at, measure
from sl_nerfstudio.redecoding.prediction import Prediction

_BLURS = (0.04, 0.06, 0.09, 0.13, 0.18, 0.25)  # standard deviations tried, pitches
_TRIED = 1000  # pixels on which the blur is chosen
_MANY = 20_000  # decoded pixels of which a ninth is enough to learn from
_ELSEWHERE = 6000  # pixels that are looked for where the pattern is not
_COARSEST = 1 / 3  # pitch from one pixel to the next: beyond, the image does not resolve the pattern
_FAR = 0.5  # pitch: a decoded coordinate this far from what all frames predict contradicts the surface
_CELLS = 4.0  # size of a region that is no evidence for itself
_TEAR = 0.35  # pitch between neighbouring pixels of one region


@dataclass(frozen=True)
class FrameFacts:
    """What became of the pixels of a frame; numbers of pixels."""

    name: str
    shown: int  # where the pattern falls on the object
    decoded_before: int
    checked: int  # decoded ones that were compared with the image
    confirmed: int  # those that it confirms
    added: int
    replaced: int
    removed: int
    decoded_after: int
    limits: Limits | None  # None: the frame was left as it is
    accepted_elsewhere: float  # share of pixels that would be accepted where the pattern certainly is not


def redecode_frame(
    name: str,
    image: Float32[ndarray, "h w"],
    mask: Bool[ndarray, "h w"] | None,
    decoded: Float32[ndarray, "h w 2"],
    predicted: Prediction,
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
) -> tuple[Float32[ndarray, "h w 2"], FrameFacts]:
    """New coordinates of a frame, and what became of the old ones.

    `image` shows the pattern where `mask` says so (None: perhaps everywhere). Pixels are added where nothing was
    decoded, replaced where the image shows another place of the pattern than the decoded one, and removed where
    neither image nor surface supports the decoded one. All others stay as they are.
    """
    shows = np.ones(image.shape, dtype=bool) if mask is None else mask
    before = int(np.isfinite(decoded).all(-1).sum())
    facts = FrameFacts(name, int(shows.sum()), before, 0, 0, 0, 0, 0, before, None, 0.0)
    stretch = _stretch(predicted.coords)
    usable = predicted.known & shows & (stretch < _COARSEST * ambiguity.pitch)
    if not (usable & np.isfinite(decoded).all(-1)).any():
        return decoded, facts
    box = find_objects(usable.astype(np.uint8))[0]
    view = View(image[box], predicted.coords[box], predicted.depth[box], usable[box])
    pitch_px = ambiguity.pitch / max(float(np.median(stretch[usable])) / np.sqrt(2), 1e-6)
    out = decoded.copy()
    out[box], facts = _redecode(view, predicted.along[box], decoded[box], pattern, ambiguity, pitch_px, facts)
    return out, facts


def _redecode(
    view: View,
    along: Float32[ndarray, "h w 2"],
    decoded: Float32[ndarray, "h w 2"],
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
    pitch_px: float,
    facts: FrameFacts,
) -> tuple[Float32[ndarray, "h w 2"], FrameFacts]:
    """The same for a view of which some decoded pixels are usable; `facts` has the numbers before."""
    pitch, old = ambiguity.pitch, np.isfinite(decoded).all(-1)
    checked = view.usable & old & _thinned(view.usable & old)
    # A decoded pixel that is as predicted stays as it is: it is measured only to learn from it.
    agrees = np.abs(decoded - view.coords).max(-1) < AGREES * pitch
    measured = view.usable & (~agrees | checked)
    places, before = np.argwhere(measured), decoded[measured]
    shown = _as_shown(view, along, pattern, ambiguity, pitch_px, np.argwhere(checked))
    found = measure(view, along, shown, places)
    elsewhere = _elsewhere(view, along, shown, places)
    right = confirmed(found, before, pitch) & checked[measured]
    limits = learn(found, right, ~old[measured], int(checked.sum()), elsewhere, pitch)
    facts = replace(facts, checked=int(checked.sum()), confirmed=int(right.sum()), limits=limits)
    if limits is None:
        return decoded, facts
    good = limits.accept(found) & _inside(view)[tuple(places.T)]
    changed = _changed(view, shown, found, before, good, limits)
    wrong = _impossible(view, shown, found, before, good, limits)
    out = decoded.copy()
    out[tuple(places[changed].T)] = found.coords[changed]
    out[tuple(places[wrong].T)] = np.nan
    out = _without_specks(out, decoded, places[changed], pitch, pitch_px)
    new, same = np.isfinite(out).all(-1), (out == decoded).all(-1)
    return out, replace(
        facts,
        added=int((new & ~old).sum()),
        replaced=int((new & old & ~same).sum()),
        removed=int((old & ~new).sum()),
        decoded_after=facts.decoded_before + int(new.sum()) - int(old.sum()),
        accepted_elsewhere=float(limits.accept(elsewhere).mean()),
    )


def _thinned(known: Bool[ndarray, "h w"]) -> Bool[ndarray, "h w"]:
    """Every third pixel in both directions if there are many, else all."""
    step = 3 if known.sum() > _MANY else 1
    some = np.zeros_like(known)
    some[::step, ::step] = True
    return some


def _inside(view: View) -> Bool[ndarray, "h w"]:
    """Pixels whose four neighbours are on the same surface: at its border, surface and image may be a pixel apart."""
    depth = np.pad(np.where(view.usable, view.depth, np.float32(np.nan)), 1, constant_values=np.nan)
    here = depth[1:-1, 1:-1]
    around = (depth[:-2, 1:-1], depth[2:, 1:-1], depth[1:-1, :-2], depth[1:-1, 2:])
    return np.logical_and.reduce([np.abs(there - here) <= STEEPEST * here for there in around])  # False for NaN


def _stretch(coords: Float32[ndarray, "h w 2"]) -> Float32[ndarray, "h w"]:
    """How far a predicted coordinate is from those of the neighbouring pixels; the larger neighbour counts."""
    total = np.zeros(coords.shape[:2], dtype=np.float32)
    for axis in (0, 1):
        step = np.linalg.norm(np.diff(coords, axis=axis), axis=-1)
        pad = [(1, 1) if k == axis else (0, 0) for k in (0, 1)]
        padded = np.pad(step, pad, constant_values=np.nan)
        ends = (padded[:-1], padded[1:]) if axis == 0 else (padded[:, :-1], padded[:, 1:])
        total += np.fmax(*ends) ** 2
    return np.sqrt(total)


def _as_shown(
    view: View,
    along: Float32[ndarray, "h w 2"],
    pattern: Float32[ndarray, "ph pw"],
    ambiguity: Ambiguity,
    pitch_px: float,
    known: Int64[ndarray, "n 2"],
) -> Shown:
    """The pattern with the blur that agrees best with the image at decoded pixels."""
    some = known[evenly_spaced(len(known), min(_TRIED, len(known)))]
    tried = [Shown(gaussian_filter(pattern, b * ambiguity.pitch), ambiguity, pitch_px) for b in _BLURS]
    return max(tried, key=lambda shown: float(np.median(measure(view, along, shown, some).correlation)))


def _elsewhere(view: View, along: Float32[ndarray, "h w 2"], shown: Shown, places: Int64[ndarray, "n 2"]) -> Measured:
    """What is found if the prediction is displaced by some pitches: matches at places that are certainly wrong."""
    some = places[evenly_spaced(len(places), min(_ELSEWHERE, len(places)))]
    decoys = shown.ambiguity.decoys
    parts = []
    for k, part in enumerate(np.array_split(some, 2)):
        away = decoys[k * len(decoys) // 2]
        parts.append(measure(replace(view, coords=view.coords + away), along, shown, part))
    return Measured(*(np.concatenate([getattr(p, name) for p in parts]) for name in Measured.__dataclass_fields__))


def _changed(
    view: View,
    shown: Shown,
    found: Measured,
    before: Float32[ndarray, "n 2"],
    good: Bool[ndarray, "n"],
    limits: Limits,
) -> Bool[ndarray, "n"]:
    """Accepted pixels that had no coordinate, or one that the image shows clearly less."""
    old = np.isfinite(before).all(1)
    changed = good & ~old
    differs = np.abs(found.coords - before).max(1) > AGREES * shown.ambiguity.pitch  # False for NaN
    other = np.flatnonzero(good & differs)
    as_it_was = correlation_at(view, shown, found.places[other], before[other])
    changed[other] = found.correlation[other] - as_it_was > limits.margin
    return changed


def _impossible(
    view: View,
    shown: Shown,
    found: Measured,
    before: Float32[ndarray, "n 2"],
    good: Bool[ndarray, "n"],
    limits: Limits,
) -> Bool[ndarray, "n"]:
    """Decoded pixels far from what all frames predict, where the image shows what is predicted, though not sharply."""
    predicted = view.coords[tuple(found.places.T)]
    far = np.abs(before - predicted).max(1) > _FAR * shown.ambiguity.pitch  # False for NaN
    doubtful = np.flatnonzero(far & ~good & (found.correlation >= limits.correlation) & (found.margin >= limits.margin))
    wrong = np.zeros(len(before), dtype=bool)
    as_it_was = correlation_at(view, shown, found.places[doubtful], before[doubtful])
    wrong[doubtful] = found.correlation[doubtful] - as_it_was > limits.margin
    return wrong


def _without_specks(
    coords: Float32[ndarray, "h w 2"],
    decoded: Float32[ndarray, "h w 2"],
    changed: Int64[ndarray, "n 2"],
    pitch: float,
    pitch_px: float,
) -> Float32[ndarray, "h w 2"]:
    """Regions of a few cells are no evidence: what was changed in them is as it was."""
    kept = np.isfinite(drop_small_regions(coords, _TEAR * pitch, round(_CELLS * pitch_px**2))).all(-1)
    back = changed[~kept[tuple(changed.T)]]
    out = coords.copy()
    out[tuple(back.T)] = decoded[tuple(back.T)]
    return out

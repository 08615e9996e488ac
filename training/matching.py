"""Fit the logistic model that tells right matches from wrong ones (`sl_nerfstudio/matching/matcher.py`).

    python -m training.matching --output outputs/training/matching [--objects 40] [--frames 3] [--jobs 2] [--seed 0]

Captures of random objects are rendered, decoded and matched as sl-process does, with the relative pose that it finds.
The features of each object are kept in the folder; a run that was interrupted goes on. Ten minutes on two cores.
"""

import argparse
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Float64
from numpy import ndarray

from sl_nerfstudio.decoding.decoder import DecodingError
from sl_nerfstudio.decoding.grid import GridImageDecoder
from sl_nerfstudio.matching.lines import EpipolarLines, pixels_a_period
from sl_nerfstudio.matching.matcher import FEATURES, NEAR, DecodedImage, LineMatcher, Logistic
from sl_nerfstudio.parallel import only_one_library_thread
from sl_nerfstudio.relative_pose.epipolar import correspondences_of
from sl_nerfstudio.relative_pose.estimation import RelativePoseError, estimate_relative_pose
from training.rendered_captures import Rendered, rendered_captures

_SAMPLES = 4000  # pixels of each capture
_ITERATIONS = 30
_RIDGE = 1e-6  # per sample, of standardised weights
_HELD_OUT = 4  # every fourth object is left out of the fit, and judges it

Sample = tuple[Float32[ndarray, "n f"], Bool[ndarray, "n"]]
"""Features of pixels, and whether these are right."""


def main() -> None:
    """Make or load the samples, fit, print the weights and what they do on objects that were held out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, required=True)
    parser.add_argument("--objects", type=int, default=40)
    parser.add_argument("--frames", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.output.mkdir(parents=True, exist_ok=True)
    make = partial(_kept_samples, args.output, args.seed, args.frames)
    with ProcessPoolExecutor(args.jobs, initializer=only_one_library_thread) as pool:
        samples = list(pool.map(make, range(args.objects)))
    fitted = [part for number, part in enumerate(samples) if number % _HELD_OUT]
    x, right = (np.concatenate([part[k] for part in fitted]) for k in (0, 1))
    constant, weights = fit_logistic(x.astype(np.float64), right)
    print(f"{len(right)} pixels, {right.mean():.1%} right")
    print(f"constant {constant:.3f}")
    for name, weight in zip(FEATURES, weights, strict=True):
        print(f"{weight:9.4f}  {name}")
    x, right = (np.concatenate([part[k] for part in samples[::_HELD_OUT]]) for k in (0, 1))
    p = Logistic(constant, tuple(weights)).probability(x)
    for least in (0.5, 0.6, 0.7, 0.8, 0.9):
        kept = p > least
        print(f"held out, from {least}: {kept.mean():.1%} kept, of these {1 - right[kept].mean():.2%} wrong")


def fit_logistic(x: Float64[ndarray, "n f"], right: Bool[ndarray, "n"]) -> tuple[float, Float64[ndarray, "f"]]:
    """Constant and weights of the largest likelihood, by Newton's method on standardised features."""
    mean, spread = x.mean(0), x.std(0) + 1e-9
    z = np.concatenate([np.ones((len(x), 1)), (x - mean) / spread], axis=1)
    ridge = _RIDGE * len(x) * np.diag([0.0, *np.ones(x.shape[1])])
    beta = np.zeros(z.shape[1])
    for _ in range(_ITERATIONS):
        p = 1 / (1 + np.exp(-np.clip(z @ beta, -30, 30)))
        H = (z * (p * (1 - p))[:, None]).T @ z + ridge
        beta += np.linalg.solve(H, z.T @ (right - p) - ridge @ beta)
    weights = beta[1:] / spread
    return float(beta[0] - weights @ mean), weights


def _kept_samples(folder: Path, seed: int, frames: int, number: int) -> Sample:
    """Those of one object, made once."""
    path = folder / f"{seed}-{number:03d}-{frames}.npz"
    if not path.exists():
        parts = list(_samples(seed, number, frames))
        x = np.concatenate([part[0] for part in parts]) if parts else np.zeros((0, len(FEATURES)), np.float32)
        right = np.concatenate([part[1] for part in parts]) if parts else np.zeros(0, np.bool_)
        np.savez(path.with_suffix(".new.npz"), x=x, right=right)
        path.with_suffix(".new.npz").replace(path)
    with np.load(path) as stored:
        return stored["x"], stored["right"]


def _samples(seed: int, number: int, frames: int) -> Iterator[Sample]:
    rng = np.random.default_rng([seed, 11, number])
    for capture in rendered_captures(seed, number, frames):
        found = _features(capture)
        if found is None:
            continue
        features, error, seen = found
        index = rng.permutation(np.flatnonzero(seen.ravel()))[:_SAMPLES]
        right = error.ravel()[index] < NEAR * capture.grid.period  # False for NaN
        yield features.reshape(-1, len(FEATURES))[index], right


def _features(
    capture: Rendered,
) -> tuple[Float32[ndarray, "h w f"], Float[ndarray, "h w"], Bool[ndarray, "h w"]] | None:
    """Features, errors, and which pixels count: those matched near the pattern; None where nothing is matched."""
    try:
        decoded = GridImageDecoder(capture.grid).decode((255 * capture.image.clip(0, 1)).astype(np.uint8))
        pose = estimate_relative_pose(*correspondences_of(decoded.coords), capture.camera, capture.projector)
    except (DecodingError, RelativePoseError):
        return None
    size = pixels_a_period(decoded.coords, capture.grid.period)
    if pose.alternatives or size is None:
        return None
    lines = EpipolarLines.of(capture.camera, capture.projector, pose.T_camera_projector)
    image = DecodedImage(capture.image, decoded.coords, decoded.mask)
    matched = LineMatcher(capture.grid).matched(image, lines, size)
    if matched is None:
        return None
    error = np.linalg.norm(matched.coords - capture.true, axis=-1)
    near = (decoded.mask | np.isfinite(capture.true[..., 0])).astype(np.uint8)
    side = 2 * round(size) + 1
    return matched.features, error, np.isfinite(matched.coords[..., 0]) & (cv2.dilate(near, np.ones((side, side))) > 0)


if __name__ == "__main__":
    main()

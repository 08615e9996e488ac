"""Scans that are wrong, each in one place, and right ones that look unusual (keys and bytes: tests/fuzz)."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray
from PIL import Image

from benchmarks.attacks.commands import Case, accepted, call, refused

Document = dict[str, Any]
_FRAME = 2
_NAME = f"frame_{_FRAME:05d}"


def cases() -> list[Case]:
    """What sl-check says of each."""
    return [
        *[_wrong("Coordinates and images", name, change, _NAME) for name, change in _content_faults().items()],
        *[_wrong("Poses", name, _edited(change), word) for name, (change, word) in _pose_faults().items()],
        *[_right(name, change) for name, change in _right_scans().items()],
    ]


def edit(folder: Path, change: Callable[[Document], Any]) -> None:
    """Change the scan's transforms.json."""
    path = folder / "scan" / "transforms.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def _edited(change: Callable[[Document], Any]) -> Callable[[Path], None]:
    return lambda folder: edit(folder, change)


def _coords(folder: Path, frame: int = _FRAME) -> ndarray:
    with np.load(folder / f"scan/coords/frame_{frame:05d}.npz") as archive:
        return archive["coords"]


def _store(folder: Path, coords: ndarray, frame: int = _FRAME) -> None:
    path = folder / f"scan/coords/frame_{frame:05d}.npz"
    np.savez_compressed(path, coords=np.ascontiguousarray(coords, dtype=coords.dtype))


def _on_coords(change: Callable[[ndarray], ndarray]) -> Callable[[Path], None]:
    return lambda folder: _store(folder, change(_coords(folder)))


def _noise(coords: ndarray) -> ndarray:
    values = np.random.default_rng(0).uniform(0, 800, coords.shape)
    return np.where(np.isfinite(coords), values, np.nan).astype(np.float32)


def _from_the_right(coords: ndarray) -> ndarray:
    coords[..., 0] = 800 - coords[..., 0]
    return coords


def _content_faults() -> dict[str, Callable[[Path], None]]:
    found: dict[str, Callable[[Path], None]] = {
        "coordinates are noise": _on_coords(_noise),
        "rows and columns of the array exchanged": _on_coords(lambda c: c.transpose(1, 0, 2)),
        "x and y exchanged": _on_coords(lambda c: c[..., ::-1]),
        "x counted from the right": _on_coords(_from_the_right), "array mirrored": _on_coords(lambda c: c[:, ::-1]),
        "array upside down": _on_coords(lambda c: c[::-1]),
        "coordinates of the next frame": lambda f: _store(f, _coords(f, _FRAME + 1)),
        "coordinates of two frames exchanged": _exchange, "image of another frame": lambda f: _copy(f, "images", 0),
        "pattern image of another frame": lambda f: _copy(f, "patterns", 0),
        "mask of another frame, inverted": _invert_mask, "all NaN": _on_coords(lambda c: c * np.float32(np.nan)),
        "infinite": _on_coords(lambda c: np.where(np.isnan(c), np.float32(np.inf), c)),
        "-1 instead of NaN": _on_coords(lambda c: np.where(np.isnan(c), np.float32(-1), c)),
        "normalised": _on_coords(lambda c: c / np.float32(800)), "whole numbers": _on_coords(np.floor),
        "float64": _on_coords(lambda c: c.astype(np.float64)),
        "pickled objects": _on_coords(lambda c: c.astype(object)),
        "channels first": _on_coords(lambda c: c.transpose(2, 0, 1)),
        "constant": _on_coords(lambda c: np.where(np.isnan(c), c, np.float32(7.5))),
    }  # fmt: skip
    moves = ((1, 0), (0, 1), (-1, 0), (2, 0), (0, -2), (3, 3), (5, -4), (7, 0), (0, 9), (-12, 8), (25, 0), (40, -30))
    found |= {f"rolled by {x}, {y}": _on_coords(lambda c, m=(y, x): np.roll(c, m, (0, 1))) for x, y in moves}
    return found


def _exchange(folder: Path) -> None:
    one, two = _coords(folder), _coords(folder, _FRAME + 1)
    _store(folder, two)
    _store(folder, one, _FRAME + 1)


def _copy(folder: Path, kind: str, frame: int) -> None:
    shutil.copy(folder / f"scan/{kind}/frame_{frame:05d}.png", folder / f"scan/{kind}/{_NAME}.png")


def _invert_mask(folder: Path) -> None:
    path = folder / f"scan/masks/{_NAME}.png"
    mask = np.array(Image.open(path))
    Image.fromarray(255 - mask).save(path)


def _pose_faults() -> dict[str, tuple[Callable[[Document], Any], str]]:
    def at(key: str, change: Callable[[ndarray], ndarray]) -> Callable[[Document], Any]:
        def apply(document: Document) -> None:
            frame = document["frames"][_FRAME]
            frame[key] = change(np.array(frame[key], dtype=np.float64)).tolist()

        return apply

    def moved(offset: float) -> Callable[[ndarray], ndarray]:
        return lambda T: T + np.array([[0, 0, 0, offset]] + [[0] * 4] * 3)

    found: dict[str, tuple[Callable[[Document], Any], str]] = {}
    for key in ("transform_matrix", "projector_transform_matrix"):
        for x in (1e5, 1e7, 1e11, 1e30, 1e308, -1e308):
            found[f"{key} moved by {x:g}"] = (at(key, moved(x)), _NAME)
        found[f"{key} inverted"] = (at(key, np.linalg.inv), _NAME)
        found[f"{key} transposed"] = (at(key, np.transpose), _NAME)
        found[f"{key} in OpenCV's axes"] = (at(key, lambda T: T @ np.diag([1.0, -1, -1, 1])), _NAME)
        found[f"{key} mirrored"] = (at(key, lambda T: T @ np.diag([-1.0, 1, 1, 1])), _NAME)
        found[f"{key} scaled"] = (at(key, lambda T: T @ np.diag([1.01, 1.01, 1.01, 1])), _NAME)
        found[f"{key} without last row"] = (at(key, lambda T: T[:3]), _NAME)
        found[f"{key} of zeros"] = (at(key, lambda T: 0 * T), _NAME)
    found["a frame removed that the scale depends on"] = (lambda d: d["frames"].pop(0), "frame_00000")
    found["the same, and baseline_of removed"] = (_without_baseline, "frame number 0")
    found["the scale's frame renamed"] = (lambda d: d["scale"].update(baseline_of="frame_7"), "frame_7")
    found["only one frame"] = (lambda d: d.update(frames=d["frames"][:1]), "only one frame")
    found["a frame twice"] = (lambda d: d["frames"].append(d["frames"][_FRAME]), _NAME)
    return found


def _without_baseline(document: Document) -> None:
    document["frames"].pop(0)
    document["scale"].pop("baseline_of")


def _wrong(group: str, name: str, change: Callable[[Path], None], word: str) -> Case:
    def attack(folder: Path) -> str:
        change(folder)
        return refused(call(folder, "sl-check", "scan"), word, "remedy:")

    return Case(group, name, ("scan",), attack)


def _right_scans() -> dict[str, Callable[[Path], None]]:
    """Changes that leave a scan right."""

    def drop(*keys: str) -> Callable[[Path], None]:
        return _edited(lambda d: [frame.pop(key, None) for frame in d["frames"] for key in keys])

    def in_metres(document: Document) -> None:
        document["units"] = "m"
        document.pop("sl_pose_sigma", None)
        for frame in document["frames"]:
            frame.pop("sl_pose_sigma", None)
            for key in ("transform_matrix", "projector_transform_matrix"):
                for row in frame[key][:3]:
                    row[3] /= 1000

    return {
        "unchanged": lambda folder: None, "frames in another order": _edited(lambda d: d["frames"].reverse()),
        "the last frames removed": _edited(lambda d: d.update(frames=d["frames"][:3])),
        "without pattern images": drop("sl_pattern_path"), "without masks": drop("mask_path"),
        "without both": drop("mask_path", "sl_pattern_path"),
        "unknown keys": _edited(lambda d: d.update({f"key_{k}": [k] for k in range(1000)})),
        "lengths in metres": _edited(in_metres), "scale unknown": _edited(lambda d: d.update(scale={"known": False})),
        "uncompressed coordinates": lambda f: np.savez(f / f"scan/coords/{_NAME}.npz", coords=_coords(f)),
        "half of the coordinates missing": _on_coords(_half),
        "a brighter image": lambda f: _brighter(f / f"scan/images/{_NAME}.png"),
    }  # fmt: skip


def _half(coords: ndarray) -> ndarray:
    coords[np.random.default_rng(1).random(coords.shape[:2]) < 0.5] = np.nan
    return coords


def _brighter(path: Path) -> None:
    pixels = np.array(Image.open(path)).astype(np.float64)
    Image.fromarray(np.clip(1.3 * pixels + 10, 0, 255).astype(np.uint8)).save(path)


def _right(name: str, change: Callable[[Path], None]) -> Case:
    def attack(folder: Path) -> str:
        change(folder)
        return accepted(call(folder, "sl-check", "scan"), "no faults")

    return Case("Right scans", name, ("scan",), attack)

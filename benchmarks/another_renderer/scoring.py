"""What a scan is worth, against the truth of its captures; the scan is read by what docs/scan-format.md says."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import trimesh
from numpy import ndarray

from benchmarks.another_renderer.photograph import Lens, triangulated


@dataclass(frozen=True)
class Similarity:
    """Maps p to s R p + t."""

    s: float
    R: ndarray
    t: ndarray

    def points(self, p: ndarray) -> ndarray:
        """Move points (n, 3)."""
        return self.s * p @ self.R.T + self.t

    def pose(self, T: ndarray) -> ndarray:
        """A rigid pose (4, 4), moved; its rotation stays one."""
        moved = np.eye(4)
        moved[:3, :3], moved[:3, 3] = self.R @ T[:3, :3], self.points(T[None, :3, 3])[0]
        return moved


def angle_deg(R: ndarray) -> float:
    """Angle of a rotation (3, 3); exact near 0 and near 180 degrees."""
    sine = np.linalg.norm([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2
    return float(np.degrees(np.arctan2(sine, (np.trace(R) - 1) / 2)))


def nearest_rotation(M: ndarray) -> ndarray:
    """The rotation nearest to a matrix (3, 3), by singular values."""
    U, _, V = np.linalg.svd(M)
    return U @ np.diag([1, 1, np.linalg.det(U @ V)]) @ V


def fitted(p: ndarray, q: ndarray, weights: ndarray) -> Similarity:
    """Weighted least squares (Umeyama) from points p (n, 3) to q."""
    w = weights / weights.sum()
    mp, mq = w @ p, w @ q
    R = nearest_rotation((q - mq).T @ (w[:, None] * (p - mp)))
    s = float(np.sum(w[:, None] * (q - mq) * ((p - mp) @ R.T)) / (w @ ((p - mp) ** 2).sum(1)))
    return Similarity(s, R, mq - s * R @ mp)


def by_cameras(found: Sequence[ndarray], true: Sequence[ndarray]) -> Similarity:
    """Align camera poses: rotation, scale by distances of pairs, and shift are medians."""
    turns = [T[:3, :3] @ F[:3, :3].T for F, T in zip(found, true, strict=True)]
    off = [float(np.median([angle_deg(a.T @ b) for b in turns])) for a in turns]
    R = turns[int(np.argmin(off))]
    for _ in range(30):
        weights = [1 / max(angle_deg(R.T @ turn), 1e-3) for turn in turns]
        R = nearest_rotation(np.sum([w * turn for w, turn in zip(weights, turns, strict=True)], axis=0))
    p, q = np.array([R @ F[:3, 3] for F in found]), np.array([T[:3, 3] for T in true])
    i, k = np.triu_indices(len(p), 1)
    s = float(np.median(np.linalg.norm(q[i] - q[k], axis=1) / np.linalg.norm(p[i] - p[k], axis=1)))
    t = np.median(q - s * p, axis=0)
    for _ in range(60):
        w = 1 / np.maximum(np.linalg.norm(s * p + t - q, axis=1), 1e-9)
        t = w @ (q - s * p) / w.sum()
    return Similarity(s, R, t)


def by_points(found: Sequence[ndarray], true: Sequence[ndarray], right: float) -> Similarity:
    """From points that belong together (one array for each frame): with which most frames are closer than `right`.

    Each frame and some pairs propose; then frames that are right count by the inverse of how far they are off.
    """
    n = len(found)
    groups = [[k] for k in range(n)] + [[k, (k + g) % n] for g in (1, 3, n // 2) for k in range(n)]
    best, chosen = (-1, 0.0), fitted(found[0], true[0], np.ones(len(found[0])))
    for group in groups:
        S = _together(group, found, true, np.ones(n))
        off = np.array([_median_distance(S, found[k], true[k]) for k in range(n)])
        near = off[off < right]
        score = len(near), -float(np.median(near)) if len(near) else 0.0
        if score > best:
            best, chosen = score, S
    for _ in range(15):
        off = np.array([_median_distance(chosen, found[k], true[k]) for k in range(n)])
        near = np.nonzero(off < right)[0].tolist()
        chosen = _together(near, found, true, 1 / np.maximum(off, 1e-4 * right)) if near else chosen
    return chosen


def _together(group: Sequence[int], found: Sequence[ndarray], true: Sequence[ndarray], counts: ndarray) -> Similarity:
    weights = np.concatenate([np.full(len(found[k]), counts[k] / len(found[k])) for k in group])
    return fitted(np.concatenate([found[k] for k in group]), np.concatenate([true[k] for k in group]), weights)


def _median_distance(S: Similarity, p: ndarray, q: ndarray) -> float:
    return float(np.median(np.linalg.norm(S.points(p) - q, axis=1)))


WRONG_DEG, WRONG_SHIFT = 3.0, 0.06  # rotation of a device; displacement as a share of the object's longest side
_POINTS, _FEWEST = 500, 30  # true points of each frame with which it is judged
_USABLE = 0.25  # lit pixels of the object, as a share of the set's median, that a usable frame shows


@dataclass(frozen=True)
class FrameError:
    """How far one frame is off; what ends in `sigma` is an error per axis over what is stated for it."""

    name: str
    camera_deg: float  # after alignment by points
    projector_deg: float
    shift: float  # median over its points, share of the object's size
    camera_deg_by_cameras: float  # after alignment by camera poses
    rotation_sigma: float  # of the frame as a whole, after alignment by points
    translation_sigma: float  # of the frame as a whole, at the middle of the object
    relative_rotation_sigma: float
    relative_translation_sigma: float

    @property
    def right(self) -> bool:
        """Whether it is where it belongs."""
        return max(self.camera_deg, self.projector_deg) <= WRONG_DEG and self.shift <= WRONG_SHIFT


@dataclass(frozen=True)
class Score:
    """All frames of a scan, and its decoded points."""

    usable: tuple[str, ...]
    errors: tuple[FrameError, ...]
    unseen: tuple[str, ...]  # in the scan, but too little of the object in them to judge
    surface_median: float  # distance of decoded points of the object from it, share of its size
    surface_95: float
    decoded: float  # share of the object's lit pixels in the usable frames of the scan
    wrong_pixels: float  # share of the decoded ones that are more than 2 pattern pixels off


class TrueFrame:
    """Truth of one photograph."""

    def __init__(self, file: Path) -> None:
        with np.load(file) as stored:
            self.T_camera, self.T_projector = stored["T_camera"], stored["T_projector"]
            self.p_world, self.uv_projector = stored["p_world"], stored["uv_projector"]
        self.lit = np.isfinite(self.p_world[..., 0])

    def sampled(self, count: int) -> tuple[ndarray, ndarray, ndarray]:
        """Camera pixels, projector pixels and points (n, .) that belong together, spread over the object."""
        row, column = np.nonzero(self.lit)
        chosen = np.unique(np.linspace(0, max(len(row) - 1, 0), min(count, len(row))).astype(int))
        row, column = row[chosen], column[chosen]
        uv = np.stack([column, row], 1) + 0.5
        return uv, self.uv_projector[row, column].astype(float), self.p_world[row, column].astype(float)


def usable_frames(captures: Path) -> tuple[str, ...]:
    """Names of the photographs that show enough of the object."""
    lit = {file.stem: int(TrueFrame(file).lit.sum()) for file in sorted((captures / "truth").glob("*.npz"))}
    least = _USABLE * float(np.median(list(lit.values())))
    return tuple(name for name, count in lit.items() if count >= least)


def score(scan: Path, captures: Path) -> Score:
    """Compare a scan with the truth of its captures."""
    document = json.loads((scan / "transforms.json").read_text())
    thing: Any = trimesh.load(captures / "truth" / "object.ply", process=False)
    size = float(np.ptp(thing.vertices, axis=0).max())
    lenses = json.loads((captures / "intrinsics.json").read_text())
    camera, projector = (_lens(lenses[name]) for name in ("camera", "projector"))
    rows = {Path(f["file_path"]).stem: f for f in document["frames"]}
    truth = {name: TrueFrame(captures / "truth" / f"{name}.npz") for name in rows}
    judged = [name for name in rows if truth[name].lit.sum() >= _FEWEST]
    found, true = [], []
    for name in judged:
        T_camera, T_projector = _poses(rows[name])
        uv, xy, p = truth[name].sampled(_POINTS)
        q = triangulated(camera, T_camera, uv, projector, T_projector, xy)
        known = np.isfinite(q).all(1)
        found.append(q[known])
        true.append(p[known])
    S = by_points(found, true, WRONG_SHIFT * size)
    C = by_cameras([_poses(rows[n])[0] for n in judged], [truth[n].T_camera for n in judged])
    errors = tuple(
        _error(
            name,
            rows[name],
            document,
            truth[name],
            (S, C),
            thing.bounds.mean(0),
            float(np.median(np.linalg.norm(S.points(q) - p, axis=1)) / size),
        )
        for name, q, p in zip(judged, found, true, strict=True)
    )
    usable = usable_frames(captures)
    pixels = [_decoded(scan, rows[n], truth[n], (camera, projector), S, thing) for n in judged if n in usable]
    distances = np.concatenate([p[0] for p in pixels]) / size if pixels else np.full(1, np.nan)
    off = np.concatenate([p[1] for p in pixels]) if pixels else np.full(1, np.nan)
    lit = sum(int(truth[n].lit.sum()) for n in judged if n in usable)
    unseen, wrong = tuple(sorted(set(rows) - set(judged))), float((off > 2).mean())
    median, upper = float(np.median(distances)), float(np.quantile(distances, 0.95))
    return Score(usable, errors, unseen, median, upper, len(off) / max(lit, 1), wrong)


def _lens(d: dict[str, float]) -> Lens:
    return Lens(int(d["w"]), int(d["h"]), d["fl_x"], d["cx"], d["cy"], d["k1"], d["k2"])


def _poses(row: dict[str, Any]) -> tuple[ndarray, ndarray]:
    return np.array(row["transform_matrix"], dtype=float), np.array(row["projector_transform_matrix"], dtype=float)


def _error(
    name: str, row: dict[str, Any], document: dict[str, Any], true: TrueFrame,
    alignments: tuple[Similarity, Similarity], middle: ndarray, shift: float,
) -> FrameError:  # fmt: skip
    T_camera, T_projector = _poses(row)
    sigma = row.get("sl_pose_sigma", document.get("sl_pose_sigma", {}))
    S, C = alignments
    by_points_ = S.pose(T_camera)
    turn = angle_deg(true.T_camera[:3, :3].T @ by_points_[:3, :3])
    other = angle_deg(true.T_camera[:3, :3].T @ C.pose(T_camera)[:3, :3])
    motion = by_points_ @ np.linalg.inv(true.T_camera)
    moved = float(np.linalg.norm(motion[:3, :3] @ middle + motion[:3, 3] - middle))
    relative, wanted = (np.linalg.inv(a) @ b for a, b in ((T_camera, T_projector), (true.T_camera, true.T_projector)))

    def over(error: float, stated: str, scale: float = 1.0) -> float:
        return error / np.sqrt(3) / (sigma[stated] * scale) if stated in sigma else float("nan")

    return FrameError(
        name, turn, angle_deg(true.T_projector[:3, :3].T @ S.R @ T_projector[:3, :3]), shift, other,
        over(turn, "camera_rotation_deg"), over(moved, "camera_translation", S.s),
        over(angle_deg(wanted[:3, :3].T @ relative[:3, :3]), "relative_rotation_deg"),
        over(float(np.linalg.norm(S.s * relative[:3, 3] - wanted[:3, 3])), "relative_translation", S.s),
    )  # fmt: skip


def _decoded(
    scan: Path, row: dict[str, Any], true: TrueFrame, lenses: tuple[Lens, Lens], S: Similarity, thing: trimesh.Trimesh
) -> tuple[ndarray, ndarray]:
    """Distances of some of the object's decoded points from it, and errors of all its decoded pixels."""
    with np.load(scan / row["sl_coords_path"]) as stored:
        coords = stored["coords"]
    r, c = np.nonzero(true.lit & np.isfinite(coords[..., 0]))
    off = np.linalg.norm(coords[r, c] - true.uv_projector[r, c], axis=-1)
    chosen = np.linspace(0, max(len(r) - 1, 0), min(4000, len(r))).astype(int)
    r, c = r[chosen], c[chosen]
    camera, projector = lenses
    T_camera, T_projector = _poses(row)
    p = triangulated(camera, T_camera, np.stack([c, r], 1) + 0.5, projector, T_projector, coords[r, c].astype(float))
    p = S.points(p[np.isfinite(p).all(1)])
    caster: Any = o3d.t.geometry.RaycastingScene(nthreads=1)
    caster.add_triangles(np.asarray(thing.vertices, np.float32), np.asarray(thing.faces, np.uint32))
    return caster.compute_distance(o3d.core.Tensor(p.astype(np.float32)), nthreads=1).numpy(), off

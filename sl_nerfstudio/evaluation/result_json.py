"""The evaluation as JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from sl_nerfstudio.evaluation.completeness.completeness import Completeness
from sl_nerfstudio.evaluation.completeness.next_view import NextView
from sl_nerfstudio.evaluation.evaluate import Evaluation
from sl_nerfstudio.evaluation.lengths import Length
from sl_nerfstudio.evaluation.metrics import SurfaceScore
from sl_nerfstudio.evaluation.pose_errors import DeviceErrors, PoseErrors
from sl_nerfstudio.verdict.verdict import Verdict


def to_json(
    evaluation: Evaluation, verdict: Verdict, capture: NextView | None = None, lengths: Sequence[Length] = ()
) -> dict[str, Any]:
    """A plain dict for `json.dump`; figures that do not exist are null, blocks that do not exist are absent.

    `rigid`, `similarity` and `none` hold the distances under each alignment; `camera` and `projector` the
    errors of the evaluated poses and `initial` those of the scan's own, all in `truth_units`. `fit`, the agreement with
    the captures, is always there, and so are `verdict` and `reasons`. `coverage` says what the surface lacks and what
    to capture next; `cross_frame` is the agreement of the frames with each other, `lengths` are the distances that were
    asked for.
    """
    out: dict[str, Any] = {
        "format": 1,
        "verdict": verdict.band,
        "reasons": list(verdict.reasons),
        "units": evaluation.units,
    }
    if evaluation.reference is not None or evaluation.pose_errors is not None:
        out["truth_units"] = evaluation.truth_units
    if evaluation.reference is not None:
        out["reference"] = evaluation.reference.description
    for name, score in evaluation.surface.items():
        out[name] = _surface(score)
    if evaluation.pose_errors is not None:
        out |= _poses(evaluation.pose_errors)
    if evaluation.initial_pose_errors is not None:
        out["initial"] = _poses(evaluation.initial_pose_errors)
    out["fit"] = asdict(evaluation.agreement)
    if evaluation.completeness is not None:
        out["coverage"] = _coverage(evaluation.completeness) | {"next_capture": _capture(capture)}
    if evaluation.cross is not None:
        out["cross_frame"] = {key: value for key, value in asdict(evaluation.cross).items() if key != "pairs"}
    if lengths:
        out["lengths"] = [asdict(length) for length in lengths]
    return _finite(out)


def _coverage(found: Completeness) -> dict[str, Any]:
    o = found.openings
    openings = {
        "count": len(o),
        "area": float(o.area.sum()),
        "boundary_length": float(o.length.sum()),
        "largest_area": found.rim_area,
        "largest_boundary_length": float(o.length[:1].sum()),
    }
    return {"observed": found.observed, "surface_area": found.surface_area, "openings": openings}


def _capture(view: NextView | None) -> dict[str, Any] | None:
    if view is None:
        return None
    return {
        "transform_matrix": view.T_world_camera.tolist(),
        "projector_transform_matrix": view.T_world_projector.tolist(),
        "new_area": view.new_area,
        "unseen_area": view.unseen_area,
        "removed_share": view.removed,
        "degrees_from_nearest_frame": view.nearest_deg,
        "elevation_deg": view.elevation_deg,
    }


def _surface(score: SurfaceScore) -> dict[str, Any]:
    return {
        "accuracy": asdict(score.accuracy),
        "completeness": asdict(score.completeness),
        "chamfer": score.chamfer,
        "f_score": {f"{distance:g}": value for distance, value in score.f_score.items()},
        "scale": score.scale,
        "matrix": score.S_truth_result.matrix().tolist(),
    }


def _poses(errors: PoseErrors) -> dict[str, Any]:
    return {
        "camera": _device(errors.camera),
        "projector": _device(errors.projector),
        "relative": _device(errors.relative),
        "scale_error": errors.scale_error,
    }


def _device(errors: DeviceErrors) -> dict[str, Any]:
    return {
        "translation_rmse": errors.translation_rmse,
        "rotation_rmse_deg": errors.rotation_rmse_deg,
        "translation": errors.translation.tolist(),
        "rotation_deg": errors.rotation_deg.tolist(),
    }


def _finite(value: Any) -> Any:
    """JSON knows neither NaN nor infinity."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value

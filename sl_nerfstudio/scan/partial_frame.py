"""The frames of transforms.json: what could be read of each, and everything that could not."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.intrinsics import CAMERA_KEYS, read_device
from sl_nerfstudio.scan.paths import read_path
from sl_nerfstudio.scan.pose_problem import FARTHEST, pose_problem
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.types import Frame, PoseSigma

POSES = ("transform_matrix", "projector_transform_matrix")
SIGMA_KEYS = tuple(PoseSigma.__dataclass_fields__)
FRAME_FILES = ("file_path", "sl_pattern_path", "sl_coords_path", "mask_path", "sl_color_path")
_FRAME_KEYS = (*FRAME_FILES, *POSES, *CAMERA_KEYS, "sl_pose_sigma")


@dataclass
class PartialFrame:
    """What could be read of a frame; None where a value is absent, or faulty and listed as a fault."""

    name: str
    camera: Device | None = None
    paths: dict[str, Path] = field(default_factory=dict)
    T_world_camera: Float64[ndarray, "4 4"] | None = None
    T_world_projector: Float64[ndarray, "4 4"] | None = None
    pose_sigma: PoseSigma | None = None

    def complete(self) -> Frame:
        """The frame, if no fault was found. Raises ValueError if a value is missing."""
        if self.camera is None or self.T_world_camera is None or self.T_world_projector is None:
            raise ValueError(f"frame {self.name} has faults")
        return Frame(
            name=self.name,
            camera=self.camera,
            image_path=self.paths["file_path"],
            pattern_path=self.paths.get("sl_pattern_path"),
            coords_path=self.paths.get("sl_coords_path"),
            mask_path=self.paths.get("mask_path"),
            T_world_camera=self.T_world_camera,
            T_world_projector=self.T_world_projector,
            pose_sigma=self.pose_sigma,
            color_path=self.paths.get("sl_color_path"),
        )


def read_frame(frame: Fields, top: Fields, root: Path, common: Device | None, need_coords: bool) -> PartialFrame:
    """One frame of transforms.json; `common` is the camera of the frames that have no camera keys."""
    result = PartialFrame(frame.frame or "")
    frame.check_spelling(_FRAME_KEYS)
    result.camera = read_frame_camera(frame, top) if any(key in frame.record for key in CAMERA_KEYS) else common
    for key in FRAME_FILES:
        if key == "file_path" or (key == "sl_coords_path" and need_coords) or frame.record.get(key) is not None:
            path = read_path(frame, key, root)
            if path is not None:
                result.paths[key] = path
    result.T_world_camera, result.T_world_projector = (read_pose(frame, key) for key in POSES)
    if result.T_world_camera is not None and result.T_world_projector is not None:
        _check_baseline(frame, result.T_world_camera, result.T_world_projector)
    return result


def read_frame_camera(frame: Fields, top: Fields) -> Device | None:
    """Intrinsics of a frame; keys that it lacks are taken from the scan."""
    both = [key for key in CAMERA_KEYS if key in frame.record and key in top.record]
    differ = [key for key in both if frame.record[key] != top.record[key]]
    for key in differ:
        frame.fault(
            key,
            f"is {frame.record[key]} here but {top.record[key]} for all frames",
            "intrinsics were given twice, and programs differ in which value they use",
            "give each key either once for all frames or in every frame",
        )
    if differ:
        return None
    merged = {**{k: top.record[k] for k in CAMERA_KEYS if k in top.record}, **frame.record}
    return read_device(Fields(merged, frame.faults, frame.file, frame.frame), "camera")


def read_pose(frame: Fields, key: str) -> Float64[ndarray, "4 4"] | None:
    """The pose under `key`; None after adding a fault."""
    matrix = frame.read_matrix(key)
    if matrix is None:
        return None
    problem = pose_problem(matrix)
    if problem is None:
        return matrix
    frame.faults.add(problem, frame.file, frame.frame, key)
    return None


def _check_baseline(
    frame: Fields, T_world_camera: Float64[ndarray, "4 4"], T_world_projector: Float64[ndarray, "4 4"]
) -> None:
    if np.array_equal(T_world_camera[:3, 3], T_world_projector[:3, 3]):
        frame.fault(
            "projector_transform_matrix",
            "has exactly the position of the camera",
            "the camera's pose was copied, or the calibration is missing",
            "calibrate the projector relative to the camera; without a distance between them there is no depth",
        )


def read_sigma(fields: Fields) -> PoseSigma | None:
    """The value of `sl_pose_sigma`; None where it is absent, or after adding a fault."""
    if fields.record.get("sl_pose_sigma") is None:
        return None
    section = fields.read_section("sl_pose_sigma")
    if section is None:
        return None
    section.check_spelling(SIGMA_KEYS)
    values = {key: section.read_number(key) for key in SIGMA_KEYS}
    for key, value in values.items():
        if value is not None and value > FARTHEST:
            section.fault(
                key, f"is {value:g}", "the adjustment diverged, or the number was damaged",
                "give the uncertainty of the starting poses, or leave sl_pose_sigma out",
            )  # fmt: skip
            return None
        if value is not None and value <= 0:
            section.fault(
                key, f"is {value:g}", "a standard deviation must be greater than 0",
                "give the uncertainty of the starting poses, however small, or leave sl_pose_sigma out",
            )  # fmt: skip
            return None
    numbers = {key: value for key, value in values.items() if value is not None}
    return PoseSigma(**numbers) if len(numbers) == len(SIGMA_KEYS) else None


def check_together(frames: list[PartialFrame], faults: Faults) -> None:
    """Add the faults that show only when several frames are compared: equal names, or equal poses in all frames."""
    seen: set[str] = set()
    for frame in frames:
        if frame.name in seen:
            problem = Problem(
                "occurs more than once",
                "a frame was duplicated, or images in two folders have the same name",
                "remove the duplicate, or rename one of the images",
            )
            faults.add(problem, TRANSFORMS, frame.name, "file_path")
        seen.add(frame.name)
    posed = [f for f in frames if f.T_world_camera is not None and f.T_world_projector is not None]
    if len(posed) < 2 or len(posed) != len(frames):
        return
    if all(_same_poses(frame, posed[0]) for frame in posed[1:]):
        problem = Problem(
            "is the same in all frames, for camera and projector",
            "the poses were never filled in, or nothing was moved",
            "register the frames first; a scan needs views from different places",
        )
        faults.add(problem, TRANSFORMS, None, "transform_matrix")


def _same_poses(a: PartialFrame, b: PartialFrame) -> bool:
    pairs = ((a.T_world_camera, b.T_world_camera), (a.T_world_projector, b.T_world_projector))
    return all(x is not None and y is not None and np.array_equal(x, y) for x, y in pairs)

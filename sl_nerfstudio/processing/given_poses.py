"""Rough camera poses from a transforms.json, from which registration starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray

from sl_nerfstudio.geometry.similarity import Similarity, fit_similarity
from sl_nerfstudio.scan.document import document_faults, frame_label, read_document
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.file_error import FileError
from sl_nerfstudio.scan.partial_frame import POSES, read_pose
from sl_nerfstudio.scan.problem import Faults
from sl_nerfstudio.scan.types import UNITS


@dataclass(frozen=True)
class GivenPoses:
    """Camera poses in the order of the frames; NaN where the file has none."""

    T_world_camera: Float64[ndarray, "n 4 4"]
    units: str  # "arbitrary" where the file does not say

    @property
    def known(self) -> Bool[ndarray, "n"]:
        """Frames that have a pose."""
        return np.isfinite(self.T_world_camera).all((1, 2))

    def at_different_places(self, frames: Bool[ndarray, "n"]) -> bool:
        """Whether some of the frames, all with poses, have more than one position."""
        return bool(np.ptp(self.T_world_camera[frames, :3, 3], axis=0).any())

    def chosen(self, frames: Sequence[bool]) -> "GivenPoses":
        """The poses of some of the frames."""
        return GivenPoses(self.T_world_camera[np.array(frames, dtype=bool)], self.units)


def read_given_poses(path: Path, names: Sequence[str]) -> GivenPoses:
    """`transform_matrix` of every frame in the file whose image has the name of a capture.

    Raises FileError if the file is faulty, has poses for fewer than two captures, or all at one place.
    """
    document = read_document(path)
    faults = Faults()
    document_faults(document, path.name, faults)
    records = document.get("frames")
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise FileError(
            path, "frames: is missing or is not a list", "the file is no transforms.json", "give one with frames"
        )
    T = np.full((len(names), 4, 4), np.nan)
    for index, record in enumerate(records):
        name = frame_label(record, index)
        pose = read_pose(Fields(record, faults, path.name, name), POSES[0]) if name in names else None
        if pose is not None:
            T[names.index(name)] = pose
    if faults.found:
        fault = faults.found[0]
        raise FileError(path, f"{fault.frame}: {fault.field} {fault.problem}", fault.cause, fault.remedy)
    units = document.get("units", "arbitrary")
    if not isinstance(units, str) or units not in UNITS:
        raise FileError(path, f"units is {units!r}", "an unknown unit", f"give one of {', '.join(UNITS)}")
    given = GivenPoses(T, units)
    if given.known.sum() < 2:
        raise FileError(
            path,
            "has poses for fewer than two of the captures",
            "its images have other names than the captures",
            "frames are matched by the image's name without folder and ending: rename the images in the file",
        )
    if not given.at_different_places(given.known):
        raise FileError(
            path,
            "has all captures at the same place",
            "the file holds rotations only",
            "give the cameras' positions, too, or leave --poses out",
        )
    return given


def align_to(
    given: GivenPoses, T_world_camera: Float64[ndarray, "n 4 4"], registered: Bool[ndarray, "n"]
) -> Similarity:
    """The similarity that maps the registered camera poses onto the given ones, in least squares.

    At least two frames must have both, at different places.
    """
    both = registered & given.known
    found, wanted = T_world_camera[both], given.T_world_camera[both]
    # Points on the axes of each camera count, too: the positions of two cameras leave a turn about their line open.
    return fit_similarity(_points(found, _spread(found)), _points(wanted, _spread(wanted)))


def _spread(T: Float64[ndarray, "n 4 4"]) -> float:
    """RMS distance of the devices from their mean."""
    centre = T[:, :3, 3]
    return float(np.sqrt(((centre - centre.mean(0)) ** 2).sum(-1).mean()))


def _points(T: Float64[ndarray, "n 4 4"], distance: float) -> Float64[ndarray, "m 3"]:
    centre, right, up, back = (T[:, :3, k] for k in (3, 0, 1, 2))
    return np.concatenate([centre, *(centre + distance * axis for axis in (right, up, -back))])

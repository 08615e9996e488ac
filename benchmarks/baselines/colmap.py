"""Structure from motion by COLMAP, from features of the photographs, whatever lights them."""

import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.geometry.devices import Y_Z_DOWN, Device

Cameras = Mapping[str, Float64[ndarray, "4 4"]]
"""Poses of cameras, camera to world, by the names of their images."""


def structure_from_motion(images: Path, camera: Device, work: Path) -> Cameras:
    """Cameras of COLMAP's largest model: SIFT, all pairs, its default settings, intrinsics given and kept; one core."""
    shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True)
    database, on_cpu = work / "database.db", pycolmap.Device.cpu
    given = (camera.fl_x, camera.fl_y, camera.cx, camera.cy, camera.k1, camera.k2, camera.p1, camera.p2)
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model, reader.camera_params = "OPENCV", ",".join(map(str, given))
    extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
    extraction.num_threads = matching.num_threads = 1
    pycolmap.set_random_seed(0)
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
        extraction_options=extraction, device=on_cpu,
    )  # fmt: skip
    pycolmap.match_exhaustive(database, matching_options=matching, device=on_cpu)
    mapping = pycolmap.IncrementalPipelineOptions()
    mapping.num_threads, mapping.random_seed = 1, 0
    mapping.ba_refine_focal_length = mapping.ba_refine_extra_params = False
    models = pycolmap.incremental_mapping(database, images, work, mapping)
    if not models:
        return {}
    largest = max(models.values(), key=lambda model: model.num_reg_images())
    posed = [image for image in largest.images.values() if image.has_pose]
    return {Path(image.name).stem: camera_pose(image.cam_from_world().matrix()) for image in posed}


def camera_pose(T_camera_world: Float64[ndarray, "3 4"]) -> Float64[ndarray, "4 4"]:
    """Pose in our axes, camera to world, of what COLMAP gives."""
    return np.linalg.inv(np.vstack([T_camera_world, [0.0, 0.0, 0.0, 1.0]])) @ Y_Z_DOWN

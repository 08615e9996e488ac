"""Mixed-up conventions are found and named; honest rough scans are left alone."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from sphere_scan import CAMERA, NAMES, PROJECTOR, correspondences, edit, edit_coords, only_fault, poses

from sl_nerfstudio.scan import check_scan
from sl_nerfstudio.scan.check_conventions import apply_interpretation, convention_problems, other_interpretations
from sl_nerfstudio.scan.check_geometry import Correspondences, fit_geometry, sample_pixels
from tests.formulas import look_at

pytestmark = pytest.mark.slow

OPENCV = np.diag([1.0, -1, -1, 1])
KEYS = ("transform_matrix", "projector_transform_matrix")


def frames_of(pairs):
    """Correspondences of the sphere under these poses, with noise and 5 % wrong decodings."""
    random = np.random.default_rng(3)
    out = []
    for index, (T_world_camera, T_world_projector) in enumerate(pairs):
        coords = correspondences(T_world_camera, T_world_projector)
        uv_camera, uv_projector = sample_pixels(coords, np.isfinite(coords[..., 0]))
        uv_projector += random.normal(scale=0.3, size=uv_projector.shape)
        uv_projector[::20] += random.normal(scale=15, size=uv_projector[::20].shape)
        out.append(Correspondences(f"f{index}", CAMERA, T_world_camera, T_world_projector, uv_camera, uv_projector))
    return out


def rigid_rig(count=6):
    """A projector beside the camera, parallel to it: the case in which rays meet in OpenCV axes too."""
    out = []
    for index in range(count):
        angle = 2 * np.pi * index / count
        T = look_at(250 * np.array([np.cos(angle), np.sin(angle), 0.4]), (0, 0, 0), 0.3 * index, (0.1, 0.2, 1.0))
        beside = T.copy()
        beside[:3, 3] += T[:3, :3] @ np.array([30.0, 0, 0])
        out.append((T, beside))
    return out


def disturbed(frames, degrees, mm, relative, seed):
    """Frames as registration and auto-calibration leave them: RMS errors about the camera or the object."""
    random = np.random.default_rng(seed)

    def motion(degrees, mm):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(random.normal(size=3) * np.radians(degrees) / 3**0.5).as_matrix()
        T[:3, 3] = random.normal(size=3) * mm / 3**0.5
        return T

    out = []
    for frame in frames:
        pivot = np.eye(4)
        pivot[:3, 3] = frame.T_world_camera[:3, 3] if random.random() < 0.5 else 0
        error = pivot @ motion(degrees, mm) @ np.linalg.inv(pivot)
        T_camera, T_projector = error @ frame.T_world_camera, error @ frame.T_world_projector @ motion(relative, 0)
        out.append(replace(frame, T_world_camera=T_camera, T_world_projector=T_projector))
    return out


def undo(interpretation, frame):
    """The frame as a user with that mistake would have written it."""
    mixed = {
        "as given": lambda T: T,
        "inverted": np.linalg.inv,
        "OpenCV axes": lambda T: T @ OPENCV,
        "inverted, OpenCV axes": lambda T: np.linalg.inv(T @ OPENCV),
    }
    T_world_projector = frame.T_world_projector.copy()
    T_world_projector[:3, 3] /= interpretation.projector_unit
    x, y = frame.uv_projector.T
    x, y = (PROJECTOR.w - x if interpretation.mirrored_x else x), (PROJECTOR.h - y if interpretation.mirrored_y else y)
    return replace(
        frame,
        T_world_camera=mixed[interpretation.camera](frame.T_world_camera),
        T_world_projector=mixed[interpretation.projector](T_world_projector),
        uv_projector=np.stack([y, x] if interpretation.swapped else [x, y], -1),
    )


def test_interpretations_undo_what_users_do():
    frame = frames_of(poses())[1]
    interpretations = list(other_interpretations())
    assert len(interpretations) == len(set(interpretations)) == 15 + 7 + 2
    for interpretation in interpretations:
        back = apply_interpretation(interpretation, undo(interpretation, frame), PROJECTOR)
        assert np.allclose(back.T_world_camera, frame.T_world_camera, atol=1e-9)
        assert np.allclose(back.T_world_projector, frame.T_world_projector, atol=1e-9)
        assert np.allclose(back.uv_projector, frame.uv_projector)


def test_spread_is_the_distance_between_the_frames_surfaces():
    frames = frames_of(poses())
    fit = fit_geometry(frames, PROJECTOR)
    assert fit.typical_px < 0.5
    assert np.median(np.linalg.norm(fit.clouds[0], axis=1)) == pytest.approx(40, abs=0.5)
    apart = []
    for index, frame in enumerate(frames):
        away = np.eye(4)
        away[0, 3] = 1e4 * index
        poses_away = {name: away @ getattr(frame, name) for name in ("T_world_camera", "T_world_projector")}
        apart.append(replace(frame, **poses_away))
    assert np.allclose(fit_geometry(apart, PROJECTOR).spread * fit.depth, 1e4, rtol=0.02)


@pytest.mark.parametrize("scene", [poses, rigid_rig])
@pytest.mark.parametrize(("degrees", "mm", "relative"), [(0, 0, 0), (10, 30, 0.3)])
def test_every_known_mistake_is_named(scene, degrees, mm, relative):
    honest = disturbed(frames_of(scene()), degrees, mm, relative, seed=1)
    assert list(convention_problems(honest, PROJECTOR, 1e-3)) == []
    for interpretation in other_interpretations():
        found = list(convention_problems([undo(interpretation, frame) for frame in honest], PROJECTOR, None))
        assert len(found) == 1, interpretation
        frame, key, problem = found[0]
        assert frame is None
        coords = interpretation.swapped or interpretation.mirrored_x or interpretation.mirrored_y
        assert key in (("sl_coords_path",) if coords else KEYS)
        words = problem.cause
        for how, text in (
            ("inverted", "map world to device instead of device to world"),
            ("OpenCV axes", "have OpenCV's device axes (y down, looking along +z)"),
            ("inverted, OpenCV axes", "are OpenCV extrinsics (world to device, y down, looking along +z)"),
        ):
            assert (text in words) == (how in (interpretation.camera, interpretation.projector))
        assert ("x and y swapped" in words) == interpretation.swapped
        assert ("x counted from the right" in words) == interpretation.mirrored_x
        assert ("y counted from below" in words) == interpretation.mirrored_y
        assert ("in another unit" in words) == (interpretation.projector_unit != 1)


@pytest.mark.parametrize("count", [2, 3, 7])
@pytest.mark.parametrize("relative", [0.3, 2.0])
def test_honest_rough_scans_are_left_alone(count, relative):
    for seed in range(8):
        scene = rigid_rig(count) if seed % 2 else poses(count)
        rough = disturbed(frames_of(scene), 10, 30, relative, seed)
        assert list(convention_problems(rough, PROJECTOR, 1e-3)) == []


@pytest.mark.parametrize("how", [np.linalg.inv, lambda T: T @ OPENCV])
def test_one_frame_with_other_conventions_than_the_rest(how):
    frames = frames_of(rigid_rig())
    one = frames[2]
    frames[2] = replace(one, T_world_camera=how(one.T_world_camera), T_world_projector=how(one.T_world_projector))
    found = list(convention_problems(frames, PROJECTOR, 1e-3))
    assert [(frame, key) for frame, key, _ in found] == [("f2", "transform_matrix")]
    assert "does not fit the coordinates in this frame" in found[0][2].problem


def test_poses_that_no_known_mistake_explains():
    frames = frames_of(poses())
    random = Rotation.random(len(frames), random_state=np.random.RandomState(4)).as_matrix()
    lost = []
    for frame, R in zip(frames, random, strict=True):
        T = frame.T_world_projector.copy()
        T[:3, :3] = R
        lost.append(replace(frame, T_world_projector=T))
    found = list(convention_problems(lost, PROJECTOR, 1e-3))
    assert [(frame, key) for frame, key, _ in found] == [(None, "transform_matrix")]
    problem = found[0][2]
    assert "coordinates in 4 of 4 frames" in problem.problem and "no single known mistake explains it" in problem.cause


@pytest.mark.parametrize(
    ("metres", "words"), [(1.0, "would put the object 2"), (1e-6, "would put the object 0.0002"), (None, "")]
)
def test_units_that_cannot_be(metres, words):
    found = list(convention_problems(frames_of(poses()), PROJECTOR, metres))
    assert [key for _, key, _ in found] == (["units"] if words else [])
    assert all(words in problem.problem and "m and mm mixed up" in problem.cause for _, _, problem in found)


def test_world_to_camera_in_a_folder_tells_what_to_do(sphere):
    def invert(document):
        for record in document["frames"]:
            for key in KEYS:
                record[key] = np.linalg.inv(record[key]).tolist()

    edit(sphere, invert)
    fault = only_fault(sphere)
    assert (fault.file, fault.frame, fault.field) == ("transforms.json", None, "transform_matrix")
    assert fault.problem.startswith("does not fit the coordinates in all frames: ")
    assert fault.cause == (
        "camera and projector matrices map world to device instead of device to world: interpreted that way they fit"
    )
    assert fault.remedy == "store device to world in OpenGL axes (camera and projector matrices: invert them)"


def test_metres_in_a_folder_of_millimetres(sphere):
    edit(sphere, lambda document: document.update(units="m"))
    fault = only_fault(sphere)
    assert (fault.field, fault.problem) == ("units", "would put the object 270 m from the camera")
    edit(sphere, lambda document: document.update(units="arbitrary"))
    assert check_scan(sphere) == []


def test_coordinates_upside_down_in_a_folder(sphere):
    for name in NAMES:
        edit_coords(sphere, name, lambda coords: np.stack([coords[..., 0], PROJECTOR.h - coords[..., 1]], -1))
    fault = only_fault(sphere)
    assert fault.field == "sl_coords_path" and fault.remedy.endswith("y := projector h - y")

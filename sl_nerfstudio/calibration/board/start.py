"""A first solution: focal lengths and poses from homographies and from points whose place is known.

Zhang, "A flexible new technique for camera calibration" (PAMI 2000). Several focal lengths are tried besides the one in
closed form, which noise can make imaginary.
"""

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from sl_nerfstudio.calibration.board.adjustment import Adjusted, Free, Seen, adjust
from sl_nerfstudio.calibration.board.detection import Corners
from sl_nerfstudio.calibration.board.residuals import sightings
from sl_nerfstudio.calibration.board.rig import BoardRig, BoardView, FreeIntrinsics
from sl_nerfstudio.geometry.devices import Device, DeviceKind

_FOCAL_LENGTHS = (0.6, 1.0, 1.6, 2.5, 4.0)  # in widths of the image
_CENTRES = (0.5, 1.0, 0.0, 1.3, -0.3)  # principal point of a projector, in heights of the pattern: lens shift
_TRIED = 3  # of the starts that fit best, how many are adjusted
_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # between OpenCV's device axes and ours
_LEAST_CORNERS = 6
Size = tuple[int, int]


def camera_start(views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"]) -> Adjusted:
    """The camera without lens distortion, and the boards."""
    w, h = size
    focals = [*(share * max(size) for share in _FOCAL_LENGTHS), *_closed_form(views, size, p_board)]
    found: list[tuple[float, BoardRig]] = []
    for focal in focals:
        camera = Device(w, h, focal, focal, w / 2, h / 2)
        solved = [_pose(camera, p_board, view.camera) for view in views]
        T = np.array([pose for pose, _ in solved])
        found.append((float(sum(cost for _, cost in solved)), BoardRig(camera, None, T, np.eye(4))))
    return _best(found, (FreeIntrinsics(),), sightings(views, p_board)[:1])


def projector_start(
    camera: Adjusted, views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"], model: DeviceKind
) -> Adjusted:
    """The projector as well, without lens distortion: it sees all corners of all views in one frame, the camera's."""
    points, pixels = _seen_by_projector(camera.rig, views, p_board)
    w, h = size
    found: list[tuple[float, BoardRig]] = []
    for focal in _FOCAL_LENGTHS:
        for centre in _CENTRES:
            device = Device(w, h, focal * w, focal * w, w / 2, centre * h, model=model)
            T, cost = _pose(device, points, Corners(np.arange(len(points)), pixels))
            rig = BoardRig(camera.rig.camera, device, camera.rig.T_camera_board, T)
            found.append((cost, rig))
    return _best(found, (*camera.free, FreeIntrinsics()), sightings(views, p_board))


def _best(found: list[tuple[float, BoardRig]], free: Free, seen: Seen) -> Adjusted:
    """The best solution from the starts that fit best."""
    tried = sorted(found, key=lambda one: one[0])[:_TRIED]
    return min((adjust(rig, free, seen) for _, rig in tried), key=lambda one: one.sigma_px[-1])


def _closed_form(views: Sequence[BoardView], size: Size, p_board: Float64[ndarray, "m 3"]) -> Iterator[float]:
    """The common focal length from all homographies, with the principal point in the middle; nothing if imaginary."""
    rows, right = [], []
    for view in views:
        if len(view.camera.ids) < _LEAST_CORNERS:
            continue
        H, _ = cv2.findHomography(p_board[view.camera.ids, :2], view.camera.uv - np.array(size) / 2)
        if H is None:
            continue
        first, second = H[:, 0], H[:, 1]
        scale = np.linalg.norm(first) * np.linalg.norm(second)
        rows += [first[:2] @ second[:2] / scale, (first[:2] @ first[:2] - second[:2] @ second[:2]) / scale]
        right += [-first[2] * second[2] / scale, (second[2] ** 2 - first[2] ** 2) / scale]
    if rows:
        squared = float(np.dot(rows, rows) / np.dot(rows, right)) if np.dot(rows, right) else -1.0
        if squared > 0:
            yield float(np.clip(np.sqrt(squared), 0.2 * max(size), 50 * max(size)))


def _pose(device: Device, points: Float64[ndarray, "m 3"], corners: Corners) -> tuple[Float64[ndarray, "4 4"], float]:
    """Pose of a device to points, and the sum of squared residuals, in pixels."""
    K = np.array([[device.fl_x, 0, device.cx], [0, device.fl_y, device.cy], [0, 0, 1]])
    lens = np.array([device.k1, device.k2, device.p1, device.p2])
    seen, uv = points[corners.ids], corners.uv
    middle = seen.mean(0)  # about which the solver is well conditioned
    flat = bool(np.ptp(points[:, 2]) == 0)
    ok, rotation, shift = cv2.solvePnP(
        (seen - middle)[:, None], uv[:, None], K, lens, flags=cv2.SOLVEPNP_IPPE if flat else cv2.SOLVEPNP_SQPNP
    )
    if not ok or not np.isfinite(rotation).all():
        return np.eye(4), np.inf
    ok, rotation, shift = cv2.solvePnP((seen - middle)[:, None], uv[:, None], K, lens, rotation, shift, True)
    again = cv2.projectPoints((seen - middle)[:, None], rotation, shift, K, lens)[0][:, 0]
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(rotation)[0]
    T[:3, 3] = shift[:, 0] - T[:3, :3] @ middle
    return _AXES @ T, float(((again - uv) ** 2).sum())


def _seen_by_projector(
    rig: BoardRig, views: Sequence[BoardView], p_board: Float64[ndarray, "m 3"]
) -> tuple[Float64[ndarray, "n 3"], Float64[ndarray, "n 2"]]:
    """Corners in the camera's frame, and in the pattern."""
    points, pixels = [], []
    for view, T in zip(views, rig.T_camera_board, strict=True):
        if view.projector is not None and len(view.projector.ids):
            points.append(p_board[view.projector.ids] @ T[:3, :3].T + T[:3, 3])
            pixels.append(view.projector.uv)
    return np.concatenate(points), np.concatenate(pixels)

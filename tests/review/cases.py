"""Scans with known faults: right ones, and the same with frames turned about the object."""

import numpy as np
import torch
from numpy import ndarray

from sl_nerfstudio.geometry.lie import DevicePoses, exp_so3
from sl_nerfstudio.review.agreement import CrossFrameAgreement, FrameCrossAgreement, PairAgreement

AXIS = np.array([0.3, 1.0, 0.2]) / np.linalg.norm([0.3, 1.0, 0.2])


def turned(poses: DevicePoses, frames: list[int], degrees: float) -> DevicePoses:
    """Some frames rotated as a whole about the point nearest to all lines of sight."""
    A, b = np.zeros((3, 3)), np.zeros(3)
    for T in poses.T_world_camera:
        P = np.eye(3) - np.outer(T[:3, 2], T[:3, 2])
        A, b = A + P, b + P @ T[:3, 3]
    centre = np.linalg.solve(A, b)
    M = np.eye(4)
    M[:3, :3] = exp_so3(torch.tensor(AXIS * np.radians(degrees))).numpy()
    M[:3, 3] = centre - M[:3, :3] @ centre
    camera, projector = poses.T_world_camera.copy(), poses.T_world_projector.copy()
    camera[frames], projector[frames] = M @ camera[frames], M @ projector[frames]
    return DevicePoses(camera, projector)


def ring(excess: ndarray, judged: int = 100) -> CrossFrameAgreement:
    """Figures of frames in a row; `excess[i, j]` of a pair, NaN where the two share nothing."""
    n = len(excess)
    pairs = tuple(
        PairAgreement((i, j), judged, 1.0, 0.2, 0.5, float(excess[i, j]))
        for i in range(n)
        for j in range(i + 1, n)
        if np.isfinite(excess[i, j])
    )
    frames = tuple(FrameCrossAgreement(100, 0.9, 0.99, 0.2, 0.5, 1.0) for _ in range(n))
    return CrossFrameAgreement(0.1, 0.99, 0.2, 0.5, frames, pairs)

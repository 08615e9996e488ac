"""The formulas of the scan format and a ray caster written anew, in plain numpy, without the package's geometry."""

import numpy as np


def nearest_on_mesh(vertices, faces, o, d):
    """Distances along rays to the first triangle, each ray against all triangles (Moeller and Trumbore)."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    out = np.empty(len(d))
    for n, (origin, direction) in enumerate(zip(np.broadcast_to(o, d.shape), d, strict=True)):
        h = np.cross(direction, e2)
        det = (e1 * h).sum(1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = origin - a
            u = (s * h).sum(1) / det
            q = np.cross(s, e1)
            v = (q @ direction) / det
            t = (e2 * q).sum(1) / det
        hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-9) & np.isfinite(t)
        out[n] = t[hit].min(initial=np.inf)
    return out


def camera_rays(camera, T_world_camera, uv):
    """Unit directions in the world of pixels; distortion is undone by OpenCV."""
    import cv2

    K = np.array([[camera["fl_x"], 0, camera["cx"]], [0, camera["fl_y"], camera["cy"]], [0, 0, 1]])
    bend = np.array([camera[k] for k in ("k1", "k2", "p1", "p2")])
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-14)
    flat = cv2.undistortPointsIter(uv[:, None].astype(np.float64), K, bend, None, None, stop)[:, 0]
    d = np.stack([flat[:, 0], -flat[:, 1], -np.ones(len(uv))], 1)
    d = d / np.linalg.norm(d, axis=1, keepdims=True)
    return d @ T_world_camera[:3, :3].T


def projector_pixels(projector, T_world_projector, p_world):
    """x_p, y_p of points by the formulas of the scan format."""
    p = (p_world - T_world_projector[:3, 3]) @ T_world_projector[:3, :3]
    q = np.linalg.norm(p, axis=1) if projector["model"] == "DOE" else -p[:, 2]
    x, y = p[:, 0] / q, -p[:, 1] / q  # y down, as images have it
    k1, k2, p1, p2 = (projector[k] for k in ("k1", "k2", "p1", "p2"))
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([projector["fl_x"] * xd + projector["cx"], projector["fl_y"] * yd + projector["cy"]], 1)

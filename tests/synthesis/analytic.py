"""The cone-and-cylinder scene and DATA's formulas written anew, in plain numpy, without the package's geometry."""

import numpy as np

PLATE, CONE, CYLINDER = (80.0, 56.0, 6.0), (-20.0, 19.0, 46.0), (20.0, 14.0, 34.0)
_FAR = np.inf


def first_distance(o, d):
    """Distance along rays from `o` (3,) in unit directions `d` (n, 3) to the object; inf where it is missed."""
    return np.min([_box(o, d), _cone(o, d), _cylinder(o, d)], axis=0)


def _box(o, d):
    low, high = np.array([-PLATE[0] / 2, -PLATE[1] / 2, 0]), np.array([PLATE[0] / 2, PLATE[1] / 2, PLATE[2]])
    with np.errstate(divide="ignore"):
        a, b = (low - o) / d, (high - o) / d
    enter, leave = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
    return np.where((enter < leave) & (enter > 0), enter, _FAR)


def _roots(a, b, c):
    inside = b * b - 4 * a * c
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(inside)
        return np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)], 1)


def _nearest(t, valid):
    return np.where(valid & (t > 0), t, _FAR).min(1)


def _cone(o, d):
    """(x^2 + y^2) = (radius / height)^2 (top - z)^2 below the tip."""
    x, radius, height = CONE
    k2, top = (radius / height) ** 2, PLATE[2] + height
    p = o - np.array([x, 0, top])
    a = d[:, 0] ** 2 + d[:, 1] ** 2 - k2 * d[:, 2] ** 2
    b = 2 * (p[0] * d[:, 0] + p[1] * d[:, 1] - k2 * p[2] * d[:, 2])
    t = _roots(a, b, p[0] ** 2 + p[1] ** 2 - k2 * p[2] ** 2)
    z = o[2] + t * d[:, 2:]
    return _nearest(t, (z >= PLATE[2]) & (z <= top))


def _cylinder(o, d):
    x, radius, height = CYLINDER
    p, top = o - np.array([x, 0, 0]), PLATE[2] + height
    a = d[:, 0] ** 2 + d[:, 1] ** 2
    t = _roots(a, 2 * (p[0] * d[:, 0] + p[1] * d[:, 1]), p[0] ** 2 + p[1] ** 2 - radius**2)
    z = o[2] + t * d[:, 2:]
    side = _nearest(t, (z >= PLATE[2]) & (z <= top))
    lid = ((top - o[2]) / d[:, 2])[:, None]
    at = p[:2] + lid * d[:, :2]
    return np.minimum(side, _nearest(lid, (at**2).sum(1, keepdims=True) <= radius**2))


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
        out[n] = t[hit].min(initial=_FAR)
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

"""Analytic rigs and coordinate maps: balls over a disk, with exact ray intersections in float64."""

from dataclasses import dataclass, replace
from math import cos, radians, sin

import torch
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import CoordinateMaps, MapSample
from sl_nerfstudio.bundle_adjustment.normal_equations import NormalEquations
from sl_nerfstudio.bundle_adjustment.parameters import INTRINSICS_SIGMA, PosePrior, by_kind, gauge_directions
from sl_nerfstudio.bundle_adjustment.residuals import Linearisation, Rig
from sl_nerfstudio.geometry.devices import Device, Intrinsics, project
from sl_nerfstudio.geometry.lie import exp_se3, inverse, log_se3, log_so3, transform
from sl_nerfstudio.geometry.triangulation import pixel_centres, pixel_rays
from tests import formulas

BALLS = ((0.35, 0.1, 0.0, 0.3), (-0.35, 0.3, -0.05, 0.25), (-0.05, -0.4, -0.1, 0.2))  # x, y, z, radius
DISK_HEIGHT, DISK_RADIUS = -0.3, 0.9
PROJECTORS = {
    "pinhole": Device(400, 400, 520.0, 520.0, 200.0, 200.0),
    "DOE": Device(400, 400, 560.0, 560.0, 200.0, 200.0, model="DOE"),
}


def camera_of(size: int) -> Device:
    """A square camera whose image is filled by the scene, three scene units away."""
    return Device(size, size, 1.35 * size, 1.35 * size, size / 2, size / 2)


def look_at(eye: tuple[float, float, float]) -> Tensor:
    """Pose of a device at `eye` that looks along its -z at the origin."""
    return torch.from_numpy(formulas.look_at(eye))


def rig_of(frames: int, size: int, projector: str = "pinhole") -> Rig:
    """Cameras around the scene at two heights, each with a projector about 20 degrees beside it."""
    eyes = []
    for k in range(frames):
        turn, high = 360 * k / frames, 42 + 16 * (k % 2)
        for t, e in ((turn, high), (turn + 20 + k, high + 3)):
            a, b = radians(t), radians(e)
            eyes.append(look_at((3 * cos(a) * cos(b), 3 * sin(a) * cos(b), 3 * sin(b))))
    camera, light = torch.stack(eyes[::2]), torch.stack(eyes[1::2])
    return Rig(
        Intrinsics.of([camera_of(size)] * frames, torch.float64),
        Intrinsics.of(PROJECTORS[projector], torch.float64),
        camera,
        inverse(camera) @ light,
    )


def static_rig(frames: int, size: int) -> Rig:
    """Cameras on a ring around one projector that stays where it is."""
    light = look_at((0.6, -0.5, 3.0))
    turns = [radians(360 * k / frames) for k in range(frames)]
    camera = torch.stack([look_at((0.6 + 0.9 * cos(a), -0.5 + 0.9 * sin(a), 2.7)) for a in turns])
    intrinsics = Intrinsics.of([camera_of(size)] * frames, torch.float64)
    projector = Intrinsics.of(PROJECTORS["pinhole"], torch.float64)
    return Rig(intrinsics, projector, camera, inverse(camera) @ light)


def cast(o: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
    """Distance of unit rays to what they hit first (infinite: nothing), and which part of the scene that is."""
    distances = []
    for *centre, radius in BALLS:
        m = o - o.new_tensor(centre)
        b, c = (m * d).sum(-1), (m * m).sum(-1) - radius**2
        t = -b - (b * b - c).sqrt()  # NaN: missed
        distances.append(torch.where(t > 1e-9, t, torch.full_like(t, float("inf"))))
    t = (DISK_HEIGHT - o[..., 2]) / d[..., 2]
    hit = (t > 1e-9) & ((o + t[..., None] * d)[..., :2].norm(dim=-1) < DISK_RADIUS)
    distances.append(torch.where(hit, t, torch.full_like(t, float("inf"))))
    found = torch.stack(distances).min(0)
    return found.values, found.indices


def seen(rig: Rig, frame: Tensor, uv_camera: Tensor) -> tuple[Tensor, Tensor]:
    """Pattern coordinates of camera pixels (NaN: nothing, shadow, outside the pattern) and the part of the scene."""
    o, d = pixel_rays(rig.camera[frame], rig.T_world_camera[frame], uv_camera)
    t, part = cast(o, d)
    p = o + t[:, None].nan_to_num(posinf=1.0) * d
    T = rig.T_world_projector[frame]
    uv, in_front = project(rig.projector, transform(inverse(T), p))
    way = T[:, :3, 3] - p
    length = way.norm(dim=-1)
    way = way / length[:, None]
    lit = cast(p + 1e-6 * way, way)[0] > length
    good = t.isfinite() & lit & in_front & (uv > 0).all(-1) & (uv < 400).all(-1)
    return torch.where(good[:, None], uv, torch.full_like(uv, float("nan"))), part


def images_of(rig: Rig, size: int) -> list[Tensor]:
    """The output of a perfect decoder: one coordinate image for each frame."""
    uv = pixel_centres(camera_of(size), torch.float64).reshape(-1, 2)
    out = [seen(rig, torch.full((len(uv),), k), uv)[0].reshape(size, size, 2).float() for k in range(rig.frames)]
    return out


@dataclass(frozen=True)
class ExactMaps(CoordinateMaps):
    """Maps without pixels: every look-up is a ray, exact to rounding; invalid within 0.01 px of an edge."""

    rig: Rig

    @staticmethod
    def around(rig: Rig, size: int) -> "ExactMaps":
        """Maps that know the true poses."""
        m = CoordinateMaps.of(images_of(rig, size))
        return ExactMaps(m.values, m.index, m.half_window, m.least_pixels, m.max_roughness, rig)

    def look_up(self, frame: Tensor, uv_camera: Tensor, memory: object = None) -> MapSample:
        uv, part = seen(self.rig, frame, uv_camera)
        valid = uv.isfinite().all(-1) & (uv_camera > 0).all(-1) & (uv_camera < int(self.index.widths[0])).all(-1)
        columns = []
        for step in torch.eye(2, dtype=torch.float64):
            h = 1e-4
            (a, part_a), (b, part_b) = (seen(self.rig, frame, uv_camera + s * h * step) for s in (1, -1))
            far = [seen(self.rig, frame, uv_camera + s * 1e-2 * step) for s in (1, -1)]
            columns.append((a - b) / (2 * h))
            valid = valid & (part_a == part) & (part_b == part) & columns[-1].isfinite().all(-1)
            for value, near in far:
                valid = valid & (near == part) & value.isfinite().all(-1)
        return MapSample(uv.nan_to_num(), torch.stack(columns, -1).nan_to_num(), valid, torch.zeros(len(uv)).double())


def disturbed(rig: Rig, seed: int = 0, degrees: float = 1.0, shift: float = 0.03, relative: float = 0.0) -> Rig:
    """Each frame rotated and shifted as a whole (RMS), its projector by a share `relative` of that."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(2, rig.frames, 6, generator=generator, dtype=torch.float64)
    x = x / x.reshape(2, -1, 2, 3).pow(2).sum(-1).mean(1).sqrt().repeat_interleave(3, -1)[:, None]
    size = torch.tensor([shift] * 3 + [radians(degrees)] * 3, dtype=torch.float64)
    return rig.moved(x[0] * size, x[1] * size * relative)


def turned(rig: Rig, frame: int, degrees: float) -> Rig:
    """One frame turned as a whole about the scene."""
    cameras = rig.T_world_camera.clone()
    turn = torch.tensor([0, 0, 0, 0.3, 0.5, 0.85], dtype=torch.float64) * radians(degrees)
    cameras[frame] = exp_se3(turn) @ cameras[frame]
    return replace(rig, T_world_camera=cameras)


def turns_deg(rig: Rig, other: Rig) -> Tensor:
    """Rotation of each frame against another rig, when their first frames coincide."""
    a, b = (inverse(r.T_world_camera[:1]) @ r.T_world_camera for r in (rig, other))
    return torch.rad2deg(log_so3((a @ inverse(b))[:, :3, :3]).norm(dim=-1))


def prior_of(frames: int, *sigmas: float, intrinsics: float = INTRINSICS_SIGMA) -> PosePrior:
    """The same uncertainty for all frames: translation and rotation of the frame, then of its projector."""
    return PosePrior(*(torch.full((frames,), s, dtype=torch.float64) for s in sigmas), intrinsics=intrinsics)


def rough_prior(frames: int, degrees: float) -> PosePrior:
    """Starting poses whose rotations are known to some degrees."""
    return prior_of(frames, 0.05, radians(degrees), 0.003, radians(0.1))


def without_gauge(found: Rig, true: Rig) -> Tensor:
    """Errors of (delta, rho) less motion and growth of the scene as a whole."""
    pairs = (found.T_world_camera, true.T_world_camera), (found.T_camera_projector, true.T_camera_projector)
    error = torch.cat([log_se3(a @ inverse(b)).reshape(-1) for a, b in pairs])
    G = gauge_directions(found)
    return error - G @ torch.linalg.lstsq(G, error[:, None]).solution[:, 0]


def decoded_at(maps: CoordinateMaps, frame: Tensor, uv: Tensor) -> Tensor:
    """The decoded coordinates of pixels inside the images."""
    pixel = uv.long()
    images = torch.stack([maps.image(k) for k in range(maps.frames)])
    return images[frame, pixel[:, 1], pixel[:, 0]].double()


def without_prior(equations: NormalEquations) -> Tensor:
    """The normal matrix alone."""
    return equations.matrix(torch.zeros_like(equations.H), torch.zeros_like(equations.g_common))


def matrix_by_kind(matrix: Tensor, frames: int) -> Tensor:
    """Rows and columns reordered as by `by_kind`; those after the frames' unknowns stay where they are."""
    order = torch.arange(len(matrix))
    order[: 12 * frames] = by_kind(order[: 12 * frames].reshape(frames, 12))
    return matrix[order][:, order]


def dense(equations: NormalEquations) -> tuple[Tensor, Tensor]:
    """Matrix and gradient by delta of all frames, then rho of all frames."""
    size, frames = equations.g.numel(), len(equations.g)
    return matrix_by_kind(without_prior(equations)[:size, :size], frames), by_kind(equations.g)


def columns_of(linear: Linearisation) -> tuple[Tensor, Tensor]:
    """Which of these unknowns own and cross residuals depend on; those common to all frames come last."""
    n, six = linear.frames, torch.arange(6)
    i, j = linear.cross_frames[..., None]
    last = 12 * n + torch.arange(linear.common)
    own = torch.cat([6 * (n + linear.own_frame[:, None]) + six, last.expand(len(linear.own), -1)], 1)
    return own, torch.cat([6 * i + six, 6 * j + six, 6 * (n + j) + six, last.expand(len(i), -1)], 1)

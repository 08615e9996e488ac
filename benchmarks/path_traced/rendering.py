"""Photographs of a scene under a projected pattern, by Mitsuba 3: both lenses have an aperture, light bounces.

Mitsuba's own devices have no distortion and look along the middle of their images. So it renders an *ideal view* of
the camera, which is then resampled into the photograph, and it projects an ideal view of the pattern. Everything else
(rays, aperture of the camera, materials, light) is Mitsuba's.
"""

import importlib
import importlib.util
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Float32
from numpy import ndarray
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from sl_nerfstudio.errors import UserError
from sl_nerfstudio.geometry.devices import Device, Intrinsics, distort, unproject
from sl_nerfstudio.parallel import threads
from sl_nerfstudio.synthesis.devices import DevicePair

_VARIANT = "llvm_ad_rgb"
_OLDEST_LLVM = 16  # 15 ends the process on processors with AVX-512 ("Cannot select")
_REMEDY = "    remedy: apt-get install libllvm19, or set DRJIT_LIBLLVM_PATH to a libLLVM.so of version 16 or later"
_TEXELS = 2  # of the projector's ideal view, a pattern pixel
_FINER = 1.25  # the camera's ideal view, times the photograph: resampling then costs little sharpness
_LONGEST_PATH = 4  # edges from light to camera: at most two surfaces before the one that is seen
_TOWARDS_ROOM_LAMP = np.array([0.5, 0.25, 1.0])
_LAMP = 8.0  # irradiance by the projector where it is focused; only its ratio to the room's light shows
_BRIGHTEST_INDIRECT = 0.5 * _LAMP / np.pi  # of a moment: single paths by way of highlights would be bright dots


@dataclass(frozen=True)
class Matter:
    """What an object is made of: base colours at the vertices, and parameters of Mitsuba's `principled` material."""

    colour: Float[ndarray, "v 3"]
    roughness: float
    specular: float
    coat: float


@dataclass(frozen=True)
class Body:
    """A mesh, with normals for shading, and its matter."""

    mesh: trimesh.Trimesh
    matter: Matter


@dataclass(frozen=True)
class Optics:
    """Apertures and hands of both devices. Blur is the diameter at half an object's size behind the focused plane."""

    camera_blur: float = 0.0  # camera pixels
    projector_blur: float = 0.0  # pattern pixels
    shake: float = 0.0  # way of either device's image during the exposure, pixels of its own
    room_light: float = 0.0  # of the room, as a share of the projector's full light on a surface that faces it


@dataclass(frozen=True)
class Quality:
    """Samples with which a photograph is computed."""

    moments: int = 8  # of the exposure, each with another place on the projector's lens
    direct: int = 9  # rays a pixel and moment for the projector's own light
    indirect: int = 2  # paths a pixel and moment for what it lights indirectly
    room: int = 16  # paths a pixel for the light of the room


@dataclass(frozen=True)
class View:
    """Where both devices are in one frame, and the distance to which the projector is focused (mm)."""

    T_world_camera: Float[ndarray, "4 4"]
    T_world_projector: Float[ndarray, "4 4"]
    focus_projector: float


def mitsuba() -> Any:
    """Mitsuba with its variant chosen. Raises UserError if it, or the libLLVM that it compiles with, is missing."""
    if importlib.util.find_spec("mitsuba") is None:
        raise UserError(
            "mitsuba is not installed, and it renders these photographs\n"
            "    remedy: pip install 'sl-nerfstudio[render]'"
        )
    mi, drjit = importlib.import_module("mitsuba"), importlib.import_module("drjit")
    try:
        mi.set_variant(_VARIANT)
        drjit.set_thread_count(threads())
        version = drjit.detail.llvm_version()[0]
    except ImportError as error:
        raise UserError(f"mitsuba finds no libLLVM, with which it compiles: {error}\n{_REMEDY}") from error
    if version < _OLDEST_LLVM:
        raise UserError(f"mitsuba found libLLVM {version}, which cannot compile for all processors\n{_REMEDY}")
    return mi


@dataclass(frozen=True)
class _Ideal:
    """An image without distortion whose principal point is its middle, just wide enough for all of a device's image."""

    focal: float
    w: int
    h: int

    @staticmethod
    def of(device: Device, finer: float) -> "_Ideal":
        """With `finer` pixels for each of the device."""
        edge = np.linspace(0, 1, 50)
        border = np.concatenate([np.stack([edge, 0 * edge + k], 1) for k in (0, 1)])
        x, y = _ideal(device, np.concatenate([border, border[:, ::-1]]) * (device.w, device.h)).T
        focal = finer * device.fl_x
        half_w, half_h = (int(np.ceil(focal * np.abs(v).max())) + 2 for v in (x, y))
        return _Ideal(focal, 2 * half_w, 2 * half_h)

    @property
    def fov_deg(self) -> float:
        """Horizontal angle of view."""
        return float(np.degrees(2 * np.arctan(self.w / 2 / self.focal)))

    def normalised(self) -> tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]:
        """Normalised image coordinates (y down) of the centres of all pixels."""
        x, y = ((np.arange(n) + 0.5 - n / 2) / self.focal for n in (self.w, self.h))
        X, Y = np.meshgrid(x, y)
        return X, Y


class Studio:
    """A scene that stands still, of which photographs are taken."""

    def __init__(
        self, bodies: list[Body], devices: DevicePair, pattern: Float32[ndarray, "h w"], optics: Optics, size: float,
        focus: float,
    ) -> None:  # fmt: skip
        """Build the scene; `size` is that of the object, `focus` the camera's focused distance. Raises UserError."""
        self._mi, self._devices, self._pattern, self._optics = mitsuba(), devices, pattern, optics
        self._size, self._focus = size, focus
        self._view = _Ideal.of(devices.camera, _FINER)
        self._slide = _Ideal.of(devices.projector, _TEXELS)
        centres = np.stack(np.meshgrid(np.arange(devices.camera.w), np.arange(devices.camera.h)), -1) + 0.5
        x, y = np.moveaxis(_ideal(devices.camera, centres.reshape(-1, 2)).reshape(centres.shape), -1, 0)
        self._from_view = [self._view.focal * v + n / 2 - 0.5 for v, n in ((y, self._view.h), (x, self._view.w))]
        shapes = {f"body{k}": self._shape(body) for k, body in enumerate(bodies)}
        self._lit, self._dim = (self._mi.load_dict({**self._camera(), **light, **shapes}) for light in self._lights())
        self._direct = self._mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
        self._path = self._mi.load_dict({"type": "path", "max_depth": _LONGEST_PATH})

    def photograph(self, view: View, quality: Quality, seed: int) -> Float32[ndarray, "h w 3"]:
        """Light on the camera's pixels.

        The projector's own light has no noise but that of sampling the pixels. What it lights indirectly is a path
        traced with few samples less the direct light along the same camera rays; that of the room is added.
        """
        rng = np.random.default_rng(seed)
        jolts = [rng.normal(size=3) for _ in range(2)]
        n = quality.moments
        times = rng.permutation((np.arange(n) + 0.5) / n - 0.5)
        total = np.zeros((self._view.h, self._view.w, 3), dtype=np.float32)
        for k, (place, time) in enumerate(zip(_disc(n), times, strict=True)):
            self._aim(view, place, [time * jolt for jolt in jolts])
            moment = seed * 2 * n + k
            total += self._rendered(self._lit, self._direct, quality.direct, moment)
            if quality.indirect:
                traced = self._rendered(self._lit, self._path, quality.indirect, moment + n)
                traced -= self._rendered(self._lit, self._direct, quality.indirect, moment + n)
                total += np.minimum(traced, _BRIGHTEST_INDIRECT)
        if self._optics.room_light > 0:
            self._put(self._dim, {"camera.to_world": self._to_world(view.T_world_camera)})
            total += n * self._rendered(self._dim, self._path, quality.room, seed)
        return np.stack([_sampled(channel, *self._from_view) for channel in np.moveaxis(total / n, -1, 0)], -1)

    def _rendered(self, scene: Any, integrator: Any, samples: int, seed: int) -> Float32[ndarray, "h w 3"]:
        image = self._mi.render(scene, integrator=integrator, spp=samples, seed=seed)
        # a path along a triangle has no direction and no value: it counts as dark
        return np.nan_to_num(np.array(image, dtype=np.float32)[..., :3], nan=0.0)

    def _put(self, scene: Any, values: dict[str, Any]) -> None:
        parameters = self._mi.traverse(scene)
        for key, value in values.items():
            parameters[key] = value
        parameters.update()

    def _aim(self, view: View, place: Float[ndarray, "2"], turns: list[Float[ndarray, "3"]]) -> None:
        """One moment of the exposure: both devices a little turned, light from one place of the projector's lens."""
        camera, projector, how = self._devices.camera, self._devices.projector, self._optics
        T_camera = _shaken(view.T_world_camera, turns[0] * how.shake / camera.fl_x)
        T_projector = _shaken(view.T_world_projector, turns[1] * how.shake / projector.fl_x)
        radius = _aperture(how.projector_blur, projector.fl_x, view.focus_projector, self._size)
        T_lens = T_projector.copy()
        T_lens[:3, 3] += T_projector[:3, :2] @ (radius * place)
        self._put(self._lit, {
            "camera.to_world": self._to_world(T_camera),
            "projector.to_world": self._to_world(T_lens),
            # at unit distance from the lens: a surface at the focused distance gets _LAMP
            "projector.scale": _LAMP * view.focus_projector**2,
            "projector.irradiance.data": self._mi.TensorXf(self._slide_from(radius * place / view.focus_projector)),
        })  # fmt: skip

    def _slide_from(self, shift: Float[ndarray, "2"]) -> Float32[ndarray, "h w 1"]:
        """What shines in each direction from a place on the lens, `shift` beside its middle in focal distances."""
        x, y = self._slide.normalised()
        d = self._devices.projector
        xd, yd = distort(x + shift[0], y - shift[1], d.k1, d.k2, d.p1, d.p2)
        return _sampled(self._pattern, d.fl_y * yd + d.cy - 0.5, d.fl_x * xd + d.cx - 0.5)[..., None]

    def _camera(self) -> dict[str, Any]:
        """A scene with its camera, whose pose is to be set for each frame."""
        blur, camera = self._optics.camera_blur, self._devices.camera
        lens: dict[str, Any] = {"type": "perspective"}
        if blur > 0:
            radius = _aperture(blur, camera.fl_x, self._focus, self._size)
            lens = {"type": "thinlens", "aperture_radius": radius, "focus_distance": self._focus}
        film = {"type": "hdrfilm", "width": self._view.w, "height": self._view.h, "pixel_format": "rgb",
                "component_format": "float32", "rfilter": {"type": "box"}}  # fmt: skip
        camera = {
            **lens, "fov": self._view.fov_deg, "fov_axis": "x", "to_world": self._to_world(np.eye(4)), "film": film,
            "near_clip": 0.01 * self._size, "far_clip": 100 * self._size, "sampler": {"type": "multijitter"},
        }  # fmt: skip
        return {"type": "scene", "camera": camera}

    def _lights(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The projector, whose pose and pattern are to be set for each moment; and the room, with a lamp above."""
        slide = np.zeros((self._slide.h, self._slide.w, 1), dtype=np.float32)
        projector = {
            "type": "projector", "fov": self._slide.fov_deg, "fov_axis": "x", "to_world": self._to_world(np.eye(4)),
            "irradiance": {"type": "bitmap", "data": self._mi.TensorXf(slide), "raw": True, "wrap_mode": "clamp"},
        }  # fmt: skip
        # half of the room's light on a surface that faces the lamp comes from the lamp, half from all around
        half = self._optics.room_light * _LAMP / 2
        far, side = 12 * self._size, 6 * self._size
        towards = far * _TOWARDS_ROOM_LAMP / np.linalg.norm(_TOWARDS_ROOM_LAMP)
        lamp = {
            "type": "rectangle",  # of side 2
            "to_world": self._mi.ScalarTransform4f().look_at(towards, [0, 0, 0], [0, 1, 0]).scale(side / 2),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": half * (far / side) ** 2}},
        }
        walls = {"type": "constant", "radiance": {"type": "rgb", "value": half / np.pi}}
        return {"projector": projector}, {"walls": walls, "lamp": lamp}

    def _shape(self, body: Body) -> Any:
        mi, mesh, matter = self._mi, body.mesh, body.matter
        properties = mi.Properties()
        properties["bsdf"] = mi.load_dict({
            "type": "twosided",
            "bsdf": {
                "type": "principled", "roughness": matter.roughness, "specular": matter.specular,
                "clearcoat": matter.coat, "clearcoat_gloss": 0.9,
                "base_color": {"type": "mesh_attribute", "name": "vertex_color"},
            },
        })  # fmt: skip
        shape = mi.Mesh("body", len(mesh.vertices), len(mesh.faces), properties, has_vertex_normals=True)
        parameters = mi.traverse(shape)
        parameters["vertex_positions"] = np.asarray(mesh.vertices, np.float32).ravel()
        parameters["vertex_normals"] = np.asarray(mesh.vertex_normals, np.float32).ravel()
        parameters["faces"] = np.asarray(mesh.faces, np.uint32).ravel()
        parameters.update()
        shape.add_attribute("vertex_color", 3, matter.colour.astype(np.float32).ravel())
        return shape

    def _to_world(self, T_world_device: Float[ndarray, "4 4"]) -> Any:
        """Mitsuba's devices look along +z with x to the left."""
        return self._mi.ScalarTransform4f(T_world_device @ np.diag([-1.0, 1.0, -1.0, 1.0]))


def _ideal(device: Device, uv: Float[ndarray, "n 2"]) -> Float[ndarray, "n 2"]:
    """Normalised coordinates (y down) of a pinhole that sees what the device sees at pixels."""
    ray = unproject(
        Intrinsics.of(device, torch.float64), torch.from_numpy(np.ascontiguousarray(uv, np.float64))
    ).numpy()
    return np.stack([-ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2]], 1)


def _sampled(
    image: Float32[ndarray, "h w"], row: Float[ndarray, "*n"], column: Float[ndarray, "*n"]
) -> Float32[ndarray, "*n"]:
    """Bilinear, dark outside; the first pixel's centre is at 0. OpenCV's `remap` would round to 1/32 of a pixel."""
    return map_coordinates(image, [row, column], order=1, output=np.float32)


def _aperture(blur: float, focal: float, focus: float, size: float) -> float:
    """Radius of a lens with that blur half a `size` behind its focused plane."""
    return blur / 2 * focus * (focus + size / 2) / (focal * size / 2)


def _disc(n: int) -> Float[ndarray, "n 2"]:
    """Places spread evenly over the unit disc (Vogel's spiral) whose mean is 0."""
    k = np.arange(n)
    radius, angle = np.sqrt((k + 0.5) / n), k * np.pi * (3 - np.sqrt(5))
    place = np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    return place - place.mean(0)


def _shaken(T: Float[ndarray, "4 4"], turn: Float[ndarray, "3"]) -> Float[ndarray, "4 4"]:
    out = T.copy()
    out[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return out

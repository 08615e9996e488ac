"""All that a scan's captures have in common: materials, light, lens and sensor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32
from numpy import ndarray

from sl_nerfstudio.synthesis.appearance.lens import Lens, make_lens
from sl_nerfstudio.synthesis.appearance.light import DefocusedPattern, Lamp, Room, make_lamp, make_pattern, make_room
from sl_nerfstudio.synthesis.appearance.material import LUMA, Material, make_material
from sl_nerfstudio.synthesis.appearance.ranges import Ranges, draw
from sl_nerfstudio.synthesis.scenes.scene import Scene

_EXPOSED_FOR = 0.8  # of full scale: the object's mean material, facing the lamp in full light
_MOST_LAYERS_AROUND = 3  # of texture, on what is around the object


@dataclass(frozen=True)
class Look:
    """How a scan looks; frames differ from it only by their `Shot`."""

    material: Material
    material_around: Material
    pattern: DefocusedPattern
    lamp: Lamp
    room: Room
    lens: Lens
    gain: float  # that suits the object
    noise: float
    gamma: float


def make_look(
    scene: Scene,
    distance: float,
    pattern: Float32[ndarray, "h w"],
    image_width: int,
    ranges: Ranges,
    sensor_noise: float,
    rng: np.random.Generator,
) -> Look:
    """A random look for devices at about `distance` (millimetres); each part has a random stream of its own."""
    of_object, around, of_pattern, of_lamp, of_room, of_lens, of_sensor = rng.spawn(7)
    material = make_material(scene.centre, scene.size, ranges, ranges.texture_layers[1], of_object)
    room = make_room(ranges, of_room)
    some = scene.vertices[:: max(1, len(scene.vertices) // 2000)]
    brightness = float((material.albedo(some) @ LUMA).mean())
    room_light = float((room.ambient + room.lamp) @ LUMA)
    return Look(
        material,
        make_material(scene.centre, scene.size, ranges, _MOST_LAYERS_AROUND, around),
        make_pattern(pattern, distance, scene.size, ranges, of_pattern),
        make_lamp(distance, of_lamp),
        room,
        make_lens(distance, scene.size, image_width, ranges, of_lens),
        _EXPOSED_FOR / (brightness * (1 + room_light)),
        sensor_noise * draw(of_sensor, ranges.noise),
        draw(of_sensor, ranges.gamma),
    )

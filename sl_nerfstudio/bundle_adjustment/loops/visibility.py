"""Which frames decoded something near an anchor, and which of them look it up."""

import numpy as np

from sl_nerfstudio.bundle_adjustment.loops.pixel_index import place_of, words_of
from sl_nerfstudio.bundle_adjustment.loops.random_bits import mixed, uniform
from sl_nerfstudio.compiled import compiled, compiled_range
from sl_nerfstudio.geometry.devices.compiled_view import view_of
from sl_nerfstudio.geometry.rigid import moved


@compiled_range
def mark_visible(first, last, devices, images, frame, p_world, normal, centres, allowed, limits, visible):
    """visible[j, a]: whether frame j decoded something near anchor a, for frames first to last - 1.

    `images` are values and their PixelIndex; `centres` those of cameras and projectors [2, frames, 3]; `allowed[i, j]`
    whether frame j may look up anchors of frame i; `limits` the gate in pixels and the least cosine. Without a gate no
    coordinate is read.
    """
    _, T_camera_world, T_projector_camera, cameras, camera_code, projector, projector_code = devices
    values, (words, first_words, widths, heights) = images
    gate, least_cosine = limits
    for j in range(first, last):
        T, T_projector, camera = T_camera_world[j], T_projector_camera[j], cameras[j]
        w, h = widths[j], heights[j]
        for a in range(len(frame)):
            visible[j, a] = False
            if not allowed[frame[a], j]:
                continue
            p = p_world[a]
            if not _faces(normal[a], p, centres[0, j], centres[1, j], least_cosine):
                continue
            x, y, z = moved(T, p[0], p[1], p[2])
            view = view_of(camera_code, x, y, z, camera)
            u, v, in_front = view[0], view[1], view[2]
            if not (in_front and u >= 0 and v >= 0 and u < w and v < h):
                continue
            place = place_of(words, first_words[j] + int(v) * words_of(w), int(u))
            if place < 0:
                continue
            x, y, z = moved(T_projector, x, y, z)
            expected = view_of(projector_code, x, y, z, projector)
            if gate < np.inf:
                value = values[place]
                visible[j, a] = expected[2] and np.hypot(value[0] - expected[0], value[1] - expected[1]) < gate
            else:
                visible[j, a] = expected[2]


@compiled
def _faces(normal, p, camera, projector, least_cosine):
    """Whether both devices are in front of a surface, and neither sees it too obliquely."""
    length = normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2
    for k in range(2):
        centre = camera if k == 0 else projector
        x, y, z = centre[0] - p[0], centre[1] - p[1], centre[2] - p[2]
        along = normal[0] * x + normal[1] * y + normal[2] * z
        if not along > least_cosine * np.sqrt(length * (x * x + y * y + z * z)):
            return False
    return True


@compiled_range
def count_chosen(first, last, visible, most, counts):
    """How many frames look up each anchor."""
    for a in range(first, last):
        total = 0
        for j in range(visible.shape[0]):
            total += visible[j, a]
        counts[a] = min(total, most)


@compiled_range
def choose_frames(first, last, visible, starts, seed, number, frames):
    """As many frames as `starts` leaves room for, at random among those that see an anchor, in order.

    Selection sampling (Knuth, The Art of Computer Programming 2, algorithm S); `number` identifies each anchor.
    """
    for a in range(first, last):
        at, end, left = starts[a], starts[a + 1], 0
        for j in range(visible.shape[0]):
            left += visible[j, a]
        bits = mixed(seed, number[a])
        for j in range(visible.shape[0]):
            if at == end:
                break
            if visible[j, a]:
                bits = mixed(bits, j)
                if uniform(bits) * left < end - at:
                    frames[at] = j
                    at += 1
                left -= 1

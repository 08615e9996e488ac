"""Photographs of a pattern on a flat wall: homographies, so that the truth is exact."""

import cv2
import numpy as np

from sl_nerfstudio.pattern.grid import GridPattern

SIZE = (400, 300)  # of the camera's image
PATTERN = GridPattern(w=300, h=240, period=20.0, line_width=4.0, gap=6.0, seed=1)


def homography(shift=(0.0, 0.0), roll=0.0, scale=0.9, tilt=0.0004):
    """From pattern pixels to camera pixels (centres at .5): the pattern's middle near that of the image."""
    c, s = np.cos(np.radians(roll)), np.sin(np.radians(roll))
    to_middle = np.array([[1, 0, -PATTERN.w / 2], [0, 1, -PATTERN.h / 2], [0, 0, 1.0]])
    turn = np.array([[scale * c, -scale * s, 0], [scale * s, scale * c, 0], [tilt, -tilt / 2, 1]])
    back = np.array([[1, 0, SIZE[0] / 2 + shift[0]], [0, 1, SIZE[1] / 2 + shift[1]], [0, 0, 1.0]])
    return back @ turn @ to_middle


def photograph(shown, matrix, size=SIZE, light=170.0, ambient=15.0, blur=0.7, noise=1.5, seed=0):
    """RGB image of an image that is projected onto a wall; `matrix` maps its pixels to those of the camera."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    centres = np.linalg.inv(half) @ matrix @ half  # OpenCV's pixel centres are whole numbers
    large = cv2.warpPerspective(shown.astype(np.float32) / shown.max(initial=1), centres, size, flags=cv2.INTER_AREA)
    image = ambient + light * cv2.GaussianBlur(large, (0, 0), blur)
    image = image + np.random.default_rng(seed).normal(0, noise, image.shape)
    return np.repeat(np.clip(np.rint(image), 0, 255).astype(np.uint8)[..., None], 3, -1)

"""What stands for cv2.VideoCapture: a camera whose images come from a function."""

import time

import cv2
import numpy as np


class FakeCapture:
    """Reads `take()` (RGB) every few milliseconds; accepts all settings but those in `refuses`."""

    def __init__(self, take, refuses=(), sizes=True):
        self.take, self.refuses, self.sizes, self.settings, self.open = take, refuses, sizes, {}, True

    def set(self, setting, value):
        if setting in self.refuses:
            return False
        self.settings[setting] = value
        return True

    def read(self):
        time.sleep(0.002)
        image = self.take() if self.open else None
        if image is None:
            return False, None
        if self.sizes and cv2.CAP_PROP_FRAME_WIDTH in self.settings:
            size = tuple(int(self.settings[k]) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
            image = cv2.resize(image, size)
        return True, np.ascontiguousarray(image[..., ::-1])

    def release(self):
        self.open = False

"""From light to a file: exposure, noise, saturation, gamma, JPEG."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

_READ_NOISE = 0.15  # share of the variance at full scale that is there in the dark, too


@dataclass(frozen=True)
class Sensor:
    """A colour camera."""

    gain: float  # signal at full scale is 1
    noise: float  # at full scale, as a fraction of it
    gamma: float
    jpeg_quality: int

    def develop(self, light: Float32[ndarray, "h w 3"], rng: np.random.Generator) -> UInt8[ndarray, "h w 3"]:
        """An 8-bit image in red, green, blue: shot and read noise, saturation, gamma, rounding."""
        signal = np.clip(light * np.float32(self.gain), 0, None)
        sigma = np.float32(self.noise) * np.sqrt(_READ_NOISE + (1 - _READ_NOISE) * np.minimum(signal, 1))
        signal = signal + sigma * rng.standard_normal(signal.shape, dtype=np.float32)
        return np.rint(255 * np.clip(signal, 0, 1) ** np.float32(1 / self.gamma)).astype(np.uint8)

    def encode(self, image: UInt8[ndarray, "h w 3"]) -> bytes:
        """The file that the camera writes."""
        ok, content = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality])
        assert ok
        return content.tobytes()


def decode_jpeg(content: bytes) -> UInt8[ndarray, "h w 3"]:
    """The image as readers see it, in red, green, blue."""
    return np.ascontiguousarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1])

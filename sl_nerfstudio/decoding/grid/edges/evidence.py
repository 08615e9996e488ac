"""What the decoder knows about the pixels of a capture before it decides which of them to keep."""

from dataclasses import dataclass

from jaxtyping import Float32
from numpy import ndarray


@dataclass(frozen=True)
class Evidence:
    """Coordinates and what tells the right ones from the wrong ones; NaN or anything where not decoded."""

    read: Float32[ndarray, "h w 2"]  # coordinates that the network read, pattern pixels
    fitted: Float32[ndarray, "h w 2"]  # the same, fitted to the image
    agreement: Float32[ndarray, "h w"]  # correlation of image and drawn pattern
    log_ratio: Float32[ndarray, "h w"]  # mean log-likelihood ratio of the symbols
    probability: Float32[ndarray, "h w"]  # that the pattern is there

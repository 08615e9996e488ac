"""A pattern on a display, until a key ends it: one image, or the images of a sequence by key or by timer."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.windows import Key, Screen
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import read_image

Image = UInt8[ndarray, "h w"]


def pattern_picture(path: Path, layout: PatternLayout) -> Image:
    """pattern.png beside the pattern.json at `path`. Raises UserError if it is not the picture of this pattern."""
    file = path.parent / "pattern.png"
    image = read_image(file)
    if image.shape != (layout.h, layout.w) or image.dtype != np.uint8:
        raise UserError(
            f"{file}: is no grey image of {layout.w} x {layout.h} pixels, as {path.name} says\n"
            "    cause:  it was changed\n    remedy: write the pattern again with sl-pattern"
        )
    return image


def show_still(screen: Screen, image: Image) -> None:
    """Show one image until a key ends it."""
    screen.show(image)
    while screen.key(None) is not Key.END:
        pass


def show_sequence(
    screen: Screen, images: Sequence[Image], every: float | None, say: Callable[[int], None] = lambda index: None
) -> None:
    """Show images one by one; `say` is called with the index of each.

    Without `every`, keys lead forward and back, and after the last image comes the first. With it, each image stays for
    so many seconds, unless a key comes earlier, and it ends after the last.
    """
    index = 0
    while True:
        screen.show(images[index])
        say(index)
        key = screen.key(every)
        if key is Key.END or (every is not None and key is not Key.BACK and index == len(images) - 1):
            return
        index = max(index - 1, 0) if key is Key.BACK else (index + 1) % len(images)

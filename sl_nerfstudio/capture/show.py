"""A pattern on a display, until a key ends it: one image, or the images of a sequence by key or by timer."""

from collections.abc import Callable, Sequence

from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.windows import Key, Screen

Image = UInt8[ndarray, "h w"]


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

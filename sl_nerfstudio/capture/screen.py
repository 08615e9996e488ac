"""A pattern on a display, until a key ends it: one image, or the images of a sequence by key or by timer."""

import os
import time
from collections.abc import Callable, Sequence
from enum import Enum
from pathlib import Path
from types import ModuleType

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.camera import compose
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.layout import PatternLayout
from sl_nerfstudio.scan.images import read_image

# Displays, windows and keys, by pygame (SDL), which is an optional dependency.

_MILLISECONDS = 1000
_INVISIBLE = ("offscreen", "dummy")  # SDL's drivers that draw into memory
_LONGEST_WAIT = 0.1  # seconds; control-C is noticed in between


class Key(Enum):
    """Meaning of a pressed key."""

    NEXT = "next"  # space, return, right, page down
    BACK = "back"  # left, page up
    END = "end"  # escape, q, or a closed window


def load_pygame() -> ModuleType:
    """pygame with its displays. Raises UserError if it is not installed, or if there is no display to use."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    os.environ.setdefault("SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS", "0")  # the pattern stays while other windows are used
    try:
        import pygame
    except ImportError as error:
        raise UserError(
            "showing patterns and previews needs pygame, which is not installed\n"
            "    cause:  it is an optional dependency\n    remedy: pip install 'sl-nerfstudio[show]'"
        ) from error
    try:
        pygame.display.init()
    except pygame.error as error:
        raise _no_display(str(error)) from error
    driver = pygame.display.get_driver()
    if driver in _INVISIBLE and os.environ.get("SDL_VIDEODRIVER") != driver:
        pygame.display.quit()
        raise _no_display("no screen was found")
    return pygame


def _no_display(what: str) -> UserError:
    return UserError(
        f"there is no display to show anything on ({what})\n"
        "    cause:  the command runs outside a graphical session, for example over ssh\n"
        "    remedy: run it in the graphical session of the computer to which the display is connected; "
        "sl-capture --headless needs none"
    )


def display_size(number: int) -> tuple[int, int]:
    """(w, h) in pixels of a display; the first has the number 0. Raises UserError if there is no such display."""
    sizes = load_pygame().display.get_desktop_sizes()
    if not 0 <= number < len(sizes):
        found = ", ".join(f"{k} ({w} x {h})" for k, (w, h) in enumerate(sizes))
        raise UserError(
            f"--show {number}: there is no display of this number; displays are {found}\n"
            "    cause:  the projector is off or not connected, or the system mirrors the first display\n"
            "    remedy: connect it as a display of its own (extended, not mirrored), or give another number"
        )
    return sizes[number]


class _Keys:
    """What keys are pressed in."""

    _pygame: ModuleType

    def key(self, seconds: float | None) -> Key | None:
        """The next key that means something; None if there is none within `seconds` (None: wait for one)."""
        meanings = {
            Key.NEXT: (self._pygame.K_SPACE, self._pygame.K_RETURN, self._pygame.K_RIGHT, self._pygame.K_PAGEDOWN),
            Key.BACK: (self._pygame.K_LEFT, self._pygame.K_PAGEUP),
            Key.END: (self._pygame.K_ESCAPE, self._pygame.K_q),
        }
        end = None if seconds is None else time.monotonic() + seconds
        while True:
            left = _LONGEST_WAIT if end is None else min(_LONGEST_WAIT, end - time.monotonic())
            event = self._pygame.event.wait(max(1, round(left * _MILLISECONDS)))
            if event.type in (self._pygame.QUIT, self._pygame.WINDOWCLOSE):
                return Key.END
            if event.type == self._pygame.KEYDOWN:
                for key, codes in meanings.items():
                    if event.key in codes:
                        return key
            if event.type == self._pygame.NOEVENT and end is not None and time.monotonic() >= end:
                return None


class Screen(_Keys):
    """A display that is filled by one image at a time, pixel for pixel; black around smaller images."""

    def __init__(self, number: int) -> None:
        """Fill the display with black. Raises UserError if there is no such display, or if it would be scaled."""
        self.size = display_size(number)
        self._pygame = load_pygame()
        self._surface = self._pygame.display.set_mode(self.size, self._pygame.FULLSCREEN, display=number)
        self._pygame.mouse.set_visible(False)
        if self._surface.get_size() != self.size:
            w, h = self._surface.get_size()
            self.close()
            raise UserError(
                f"--show {number}: got {w} x {h} pixels of a display of {self.size[0]} x {self.size[1]}\n"
                "    cause:  the system scales this display\n"
                "    remedy: set its scale to 100 % in the system's settings"
            )

    def show(self, image: UInt8[ndarray, "h w"]) -> None:
        """Put a grey image in the middle of the display; it must not be larger than that."""
        h, w = image.shape
        left, top = offset_on(self.size, (w, h))
        pixels = self._pygame.surfarray.pixels3d(self._surface)  # (x, y, 3)
        pixels[:] = 0
        pixels[left : left + w, top : top + h] = image.T[..., None]
        del pixels  # it locks the surface
        self._pygame.display.flip()

    def close(self) -> None:
        """Give the display back."""
        self._pygame.display.quit()

    def __enter__(self) -> "Screen":
        """The screen itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Give the display back."""
        self.close()


def offset_on(display: tuple[int, int], size: tuple[int, int]) -> tuple[int, int]:
    """Display pixel (x, y) of the upper left pixel of a centred image; both sizes are (w, h).

    Raises UserError if the image is larger than the display.
    """
    if size[0] > display[0] or size[1] > display[1]:
        raise UserError(
            f"the pattern has {size[0]} x {size[1]} pixels, the display {display[0]} x {display[1]}\n"
            "    cause:  the pattern was made for another display, or the system scales this one; a pattern is never "
            "scaled, because its pixels must be those of the projector\n"
            "    remedy: set the display to its own resolution and 100 % scale, or write a pattern for it into a new "
            "folder (--show without --preset, --width and --height makes one of the display's size)"
        )
    return (display[0] - size[0]) // 2, (display[1] - size[1]) // 2


class Window(_Keys):
    """A window for a picture in colour."""

    def __init__(self, title: str) -> None:
        """Raises UserError if there is no display."""
        self._pygame = load_pygame()
        self._title = title
        self._window = None

    def show(self, picture: UInt8[ndarray, "h w 3"]) -> None:
        """Show a picture; the window gets its size."""
        size = picture.shape[1], picture.shape[0]
        if self._window is None:
            self._window = self._pygame.Window(self._title, size)
        if self._window.size != size:
            self._window.size = size
        surface = self._window.get_surface()
        self._pygame.surfarray.blit_array(surface, picture.transpose(1, 0, 2))
        self._window.flip()

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            self._window.destroy()
            self._window = None


# What a person sees while frames are captured: a preview, or lines on the console, and the keys that are pressed.

Picture = UInt8[ndarray, "_h _w 3"]


class Watcher:
    """Shows pictures in a window if there is one; otherwise says the first line of text whenever it changes."""

    def __init__(self, say: Callable[[str], None], window: Window | None, screen: Screen | None) -> None:
        self.say = say
        self._window, self._screen = window, screen
        self._last = ""

    @property
    def has_window(self) -> bool:
        """Whether pictures are shown."""
        return self._window is not None

    def look(
        self,
        picture: Callable[[], Picture],
        beside: Callable[[], Sequence[Picture]],
        lines: list[str],
        quiet: bool = False,
    ) -> None:
        """Show what there is to see; pictures are only made if there is a window.

        `quiet`: what happened is said on the console in other words.
        """
        if self._window is not None:
            self._window.show(compose(picture(), beside(), lines))
            return
        if not quiet and lines[0] != self._last:
            self.say(lines[0])
        self._last = lines[0]

    def key(self) -> Key | None:
        """A key that was pressed in one of the windows."""
        shown = self._window or self._screen
        return None if shown is None else shown.key(0.0)


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

"""What a person sees while frames are captured: a preview, or lines on the console, and the keys that are pressed."""

from collections.abc import Callable, Sequence

from jaxtyping import UInt8
from numpy import ndarray

from sl_nerfstudio.capture.picture import compose
from sl_nerfstudio.capture.windows import Key, Screen, Window

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

"""sl-pattern --show: the pattern of a folder on a display."""

from pathlib import Path

from sl_nerfstudio.capture.show import pattern_picture, show_sequence, show_still
from sl_nerfstudio.capture.windows import Screen, offset_on
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.pattern.files import read_layout
from sl_nerfstudio.pattern.graycode import GrayCode


def show_folder(folder: Path, display: int, every: float | None) -> None:
    """Show what a folder of sl-pattern holds until it is ended. Raises UserError if it cannot be shown."""
    layout = read_layout(folder / "pattern.json")
    if every is not None and not isinstance(layout, GrayCode):
        raise UserError(f"--every {every:g}: {layout.description} is one image; leave it out")
    with Screen(display) as screen:
        print(_words(display, screen.size, (layout.w, layout.h)), flush=True)
        if isinstance(layout, GrayCode):
            names = layout.fields()["sequence"]
            print("Space and the right key show the next image, the left key the one before", flush=True)
            show_sequence(screen, list(layout.sequence()), every, lambda k: print(f"  {k:02d}  {names[k]}", flush=True))
            return
        show_still(screen, pattern_picture(folder / "pattern.json", layout))


def _words(display: int, screen: tuple[int, int], size: tuple[int, int]) -> str:
    shown = f"showing {size[0]} x {size[1]} pixels on display {display}; Escape ends"
    if screen == size:
        return shown
    left, top = offset_on(screen, size)
    return (
        f"{shown}\nthe display has {screen[0]} x {screen[1]} pixels: the pattern lies in its middle, unscaled. Pixel "
        f"(0, 0) of the pattern is pixel ({left}, {top}) of the display; subtract this from a principal point that was "
        "calibrated with the whole display"
    )

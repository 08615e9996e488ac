"""What is captured, and how; the docstrings of the fields are the help text of `sl-capture`."""

from dataclasses import dataclass
from pathlib import Path

from sl_nerfstudio.errors import UserError

_MOST = 1000.0  # images a second, or seconds


@dataclass(frozen=True)
class CaptureConfig:
    """Capture frames for sl-process.

    Coded grid: move camera and projector slowly around the object. Images are decoded as they come, and one is kept
    when it is sharp, well exposed, and shows the pattern at other places than those kept before. Gray code (with
    --show): each press of Space shows the whole sequence and captures it; nothing may move meanwhile. Space keeps an
    image whatever is said about it, Escape ends. Run the same command again to go on.
    """

    camera: str
    """number of the camera, 0 for the first, or a video file"""
    output: Path
    """folder for the captures: a new one, or one that this command has begun"""
    pattern: Path | None = None
    """pattern.json of what is projected; without it, nothing is decoded, and images are kept by key alone"""
    show: int | None = None
    """number of the display on which to show the pattern, full screen; 0 is the first, and 1 usually the projector"""
    size: str | None = None
    """width x height of the camera's images, such as 1920x1080; default: the camera's choice"""
    exposure: float | None = None
    """fixed exposure in the camera's own unit; default: as the camera is set"""
    focus: float | None = None
    """fixed focus in the camera's own unit; default: as it is, without autofocus if the camera can"""
    rate: float = 4.0
    """images per second that are decoded at most; of a video, per second of its time"""
    settle: float = 0.25
    """seconds that each image of a Gray-code sequence is shown before it is captured"""
    frames: int | None = None
    """end when the folder holds so many frames; default: when Escape is pressed or the video ends"""
    headless: bool = False
    """lines on the console instead of a preview window; control-C ends"""

    def check(self) -> None:
        """Raise UserError for flags that mean nothing."""
        for name in ("rate", "settle"):
            value = getattr(self, name)
            if not 0 < value < _MOST:
                raise UserError(f"--{name} {value:g}: give a number above 0 and below {_MOST:g}")
        if self.frames is not None and self.frames < 1:
            raise UserError(f"--frames {self.frames}: give a number of at least 1")
        if self.show is not None and self.pattern is None:
            raise UserError(f"--show {self.show}: give --pattern, which says what is to be shown")
        if self.headless and self.pattern is None:
            raise UserError(
                "--headless: without a pattern, frames are kept by key alone, and there is no window to press it in\n"
                "    cause:  --pattern is missing\n    remedy: give --pattern, or leave --headless out"
            )

    @property
    def image_size(self) -> tuple[int, int] | None:
        """(w, h) of --size. Raises UserError."""
        from sl_nerfstudio.pattern.boards import counts  # --help does not need it

        return None if self.size is None else counts(self.size, "--size")

"""SDL draws into memory, and keys are pressed by the tests."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest


class Keyboard:
    """Presses keys one by one, and keeps what the screen shows whenever a key is waited for."""

    def __init__(self, pygame):
        self.pygame, self.keys, self.shown, self.waits = pygame, [], [], []

    def press(self, *names: str) -> None:
        self.keys += [getattr(self.pygame, f"K_{name}") if name else None for name in names]

    def wait(self, milliseconds: int = 0):
        surface = self.pygame.display.get_surface()
        if surface is not None:
            self.shown.append(self.pygame.surfarray.array3d(surface).transpose(1, 0, 2))
        self.waits.append(milliseconds)
        key = self.keys.pop(0) if self.keys else self.pygame.K_ESCAPE
        event = self.pygame.event.Event
        return event(self.pygame.NOEVENT) if key is None else event(self.pygame.KEYDOWN, key=key)

    def seen(self, w: int, h: int) -> np.ndarray:
        """What the middle of the display shows now, grey; black before there is anything."""
        surface = self.pygame.display.get_surface()
        shown = np.zeros((768, 1024), np.uint8) if surface is None else self.pygame.surfarray.array_red(surface).T
        return middle(shown, w, h)

    def different(self) -> list[np.ndarray]:
        """What was shown, without repetitions in a row."""
        return [a for k, a in enumerate(self.shown) if k == 0 or not np.array_equal(a, self.shown[k - 1])]


def middle(screen: np.ndarray, w: int, h: int) -> np.ndarray:
    """A part of the display of SDL's dummy driver."""
    left, top = (1024 - w) // 2, (768 - h) // 2
    return screen[top : top + h, left : left + w]


@pytest.fixture
def keyboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Keyboard]:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setenv("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame
    import pygame.surfarray  # before several threads do

    keys = Keyboard(pygame)
    monkeypatch.setattr(pygame.event, "wait", keys.wait)
    yield keys
    pygame.display.quit()


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Runs the `main` of a command in this process."""

    def run(main, *flags):
        monkeypatch.setattr("sys.argv", ["sl-command", *map(str, flags)])
        main()

    return run

"""Work on many frames or pairs of them, side by side on all threads, with its progress."""

from collections.abc import Callable, Sequence
from typing import TypeVar

from sl_nerfstudio.progress import track
from sl_nerfstudio.threads import results, threads

T = TypeVar("T")

_EACH = 4  # pieces of work of a thread between two reports


def tracked(tasks: Sequence[Callable[[], T]], words: str) -> list[T]:
    """What the tasks return, in their order; they must not depend on each other.

    Each draws from a random generator of its own, so that results do not depend on the number of threads.
    """
    together = _EACH * threads()
    batches = [tasks[first : first + together] for first in range(0, len(tasks), together)]
    return [found for batch in track(batches, words) for found in results(batch)]

"""Walks around the analytic scene: sights with exact relative poses, and a source of images that stand for them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from sl_nerfstudio.live.sight import Fault, Sight
from sl_nerfstudio.live.sources import Shot, Source
from sl_nerfstudio.registration.evidence import Frame
from sl_nerfstudio.registration.surfaces import FrameCloud
from tests.bundle_adjustment.analytic import PROJECTORS, camera_of, rig_of
from tests.registration.analytic_clouds import clouds_of

SIZE, PLACES = 100, 24  # 15 degrees from place to place
RIG = rig_of(PLACES, SIZE)
CAMERA, PROJECTOR = camera_of(SIZE), PROJECTORS["pinhole"]
AWAY = 255  # of an image: nothing is in view


def seen(cloud: FrameCloud) -> Sight:
    """What an image shows from which this cloud was made."""
    return Sight(blank(0), cloud=cloud, frame=Frame.of(cloud), period=8.0, sharp=True)


@cache
def sights(noise: float = 0.05) -> list[Sight]:
    """One of each place."""
    return [seen(cloud) for cloud in clouds_of(RIG, SIZE, noise=noise)]


def blind(fault: Fault = Fault.NO_PATTERN) -> Sight:
    """What an image shows that shows nothing."""
    return Sight(blank(AWAY), fault=fault)


def blank(place: int) -> np.ndarray:
    """An image that stands for a place."""
    return np.full((SIZE, SIZE, 3), place, dtype=np.uint8)


class FakeEye:
    """Knows what each image stands for."""

    def __init__(self, *_: object) -> None:
        self.factor = 1.0

    def look(self, image: np.ndarray) -> Sight:
        place = int(image[0, 0, 0])
        return replace(blind() if place == AWAY else sights()[place], image=image)


@dataclass
class FakeSource(Source):
    """Gives images of places, and fails after some of them if it is told to."""

    places: Sequence[int]
    fails_after: int | None = None
    name: str = "walk"

    @property
    def size(self) -> tuple[int, int]:
        return SIZE, SIZE

    def shots(self, seen: Sequence[str]) -> Iterator[Shot | None]:
        for number, place in enumerate(self.places):
            if number == self.fails_after:
                raise KeyboardInterrupt
            if f"image {number}" not in seen:
                yield Shot(f"image {number}", blank(place))

    def close(self) -> None:
        pass

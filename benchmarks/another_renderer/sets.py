"""The sets. Those of the first list may be looked at while something is changed; the others are for the end."""

from benchmarks.another_renderer.captures import CaptureSet
from benchmarks.another_renderer.photograph import Look
from benchmarks.another_renderer.sensor import Sensor

LOOKS = {
    "clean": Look(),
    "photo": Look(
        room_light=0.15, texture=0.35, gloss=0.06, projector_blur=0.8, projector_defocus=1.2, contrast=0.95,
        sensor=Sensor(blur_px=0.6, defocus_px=0.8, electrons=6000, read_noise=0.004, exposure_stops=0.4, quality=90),
    ),
    "rough": Look(
        room_light=0.2, texture=0.55, spots=True, colour=True, gloss=0.2, projector_blur=1.0, projector_defocus=1.6,
        contrast=0.9,
        sensor=Sensor(blur_px=0.8, defocus_px=1.5, motion_px=2.0, electrons=2500, read_noise=0.008,
                      exposure_stops=0.7, quality=80),
    ),
}  # fmt: skip


def _set(
    thing: str, around: str, look: str, seed: int, missed: tuple[int, ...] = (), shuffled: bool = False
) -> CaptureSet:
    return CaptureSet(thing, around, look, seed, LOOKS[look], missed=missed, shuffled=shuffled)


KNOWN = (
    _set("mug", "table", "photo", 15),
    _set("box", "none", "clean", 16),
    _set("nut", "none", "clean", 17),
    _set("gear", "none", "clean", 18),
    _set("bracket", "table", "clean", 12),
    _set("sticks", "room", "rough", 14, missed=(3, 10, 11, 19)),
    _set("foot", "none", "photo", 21),
    _set("relief", "table", "photo", 22),
    _set("wire", "table", "photo", 23),
    _set("pair", "table", "clean", 24),
)
UNSEEN = (
    _set("knot", "none", "clean", 31),
    _set("blob", "room", "photo", 32, missed=(4, 5, 12, 13, 20, 21)),
    _set("jaw", "table", "photo", 33),
    _set("bust", "room", "rough", 34),
    _set("blade", "table", "photo", 35),
    _set("housing", "table", "rough", 36, shuffled=True),
    _set("bottle", "none", "photo", 37),
    _set("vertebra", "none", "photo", 38, shuffled=True),
    _set("cloth", "table", "clean", 39),
    _set("steps", "room", "clean", 40),
)


def chosen_sets(parts: tuple[str, ...], unseen: bool) -> list[CaptureSet]:
    """Sets of one of the lists whose names contain one of the parts, or all. Raises ValueError for a part in none."""
    sets = UNSEEN if unseen else KNOWN
    for part in parts:
        if not any(part in one.name for one in sets):
            raise ValueError(f"--sets {part}: no set is named so; there are {', '.join(one.name for one in sets)}")
    return [one for one in sets if not parts or any(part in one.name for part in parts)]

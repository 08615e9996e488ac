"""The sets.

Those of the first list may be looked at while something is changed; the second is for the end; in the third people
walk otherwise; the fourth has objects that came when everything had been chosen; the fifth has other cameras and
projectors, pictures that a telephone has worked on, other matter, and partial views.
"""

from benchmarks.another_renderer.captures import CaptureSet, Equipment, Walk
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
    "phone": Look(
        room_light=0.2, texture=0.4, colour=True, gloss=0.08, projector_blur=0.8, projector_defocus=1.2, contrast=0.93,
        sensor=Sensor(blur_px=0.7, defocus_px=0.8, motion_px=1.0, electrons=2500, read_noise=0.006, exposure_stops=0.4,
                      quality=85, vignetting=0.35, denoising_px=1.5, sharpening=0.9, tone=0.6, thinned_colour=True),
    ),
    "wax": Look(
        room_light=0.1, texture=0.25, gloss=0.15, projector_blur=0.8, contrast=0.95, translucent=0.45, scatter_px=4.0,
        sensor=Sensor(blur_px=0.6, electrons=6000, read_noise=0.004, quality=92),
    ),
    "bounce": Look(
        room_light=0.1, texture=0.3, gloss=0.06, projector_blur=0.8, contrast=0.95, bounces=True,
        sensor=Sensor(blur_px=0.6, defocus_px=0.8, electrons=6000, read_noise=0.004, exposure_stops=0.4, quality=90),
    ),
}  # fmt: skip
LANDSCAPE = Equipment("landscape", aspect=16 / 9, distortion=(-0.16, -0.12))
PORTRAIT = Equipment("portrait", aspect=3 / 4)
SHIFTED = Equipment("lens-shift", lens_shift=0.55, projector_distortion=-0.06)


def _set(
    thing: str, around: str, look: str, seed: int, missed: tuple[int, ...] = (), shuffled: bool = False,
    frames: int = 24, resolution: int = 600, walk: Walk | None = None, equipment: Equipment | None = None,
) -> CaptureSet:  # fmt: skip
    devices = equipment or Equipment()
    return CaptureSet(
        thing, around, look, seed, LOOKS[look], frames, missed, shuffled, resolution, walk or Walk(), devices
    )


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
OTHERWISE = (
    _set("housing", "none", "photo", 51, frames=16, walk=Walk("half-turn", turn_deg=180.0)),
    _set("vertebra", "table", "photo", 52, frames=14, walk=Walk("few-frames")),
    _set("jaw", "none", "photo", 53, walk=Walk("long-lens", zoom=2.5)),
    _set("bust", "table", "photo", 54, walk=Walk("short-baseline", apart_deg=(5.0, 9.0))),
    _set("knot", "table", "photo", 55, walk=Walk("long-baseline", apart_deg=(30.0, 42.0))),
    _set("bracket", "none", "photo", 56, resolution=400),
    _set("foot", "table", "rough", 57, resolution=1000),
    _set("pair", "table", "photo", 58, walk=Walk("from-above", elevation_deg=62.0)),
    _set("cloth", "none", "photo", 59, shuffled=True, walk=Walk("rolled", roll=3.14)),
    _set("sticks", "none", "photo", 60, frames=40, walk=Walk("two-rounds", turn_deg=720.0)),
)
LATER = (
    _set("hand", "table", "photo", 71),
    _set("car", "table", "rough", 72, shuffled=True),
    _set("shoe", "room", "photo", 73),
    _set("knight", "none", "rough", 74, shuffled=True),
    _set("shell", "table", "photo", 75, frames=20, walk=Walk("two-rounds", turn_deg=720.0)),
    _set("pan", "none", "photo", 76),
    _set("pan", "table", "rough", 77),
    _set("hand", "none", "rough", 78, frames=16, walk=Walk("half-turn", turn_deg=180.0)),
)
EQUIPMENT = (
    _set("jaw", "table", "photo", 81, walk=Walk("farther", nearer=1.2), equipment=LANDSCAPE),
    _set("shoe", "room", "phone", 82, equipment=PORTRAIT),
    _set("car", "table", "photo", 83, equipment=SHIFTED),
    _set("bust", "none", "photo", 84, frames=36, walk=Walk("close", turn_deg=720.0, nearer=0.5, aim=0.12)),
    _set("hand", "table", "rough", 85, walk=Walk("near-and-far", distances=(0.65, 1.6))),
    _set("vertebra", "none", "wax", 86),
    _set("bracket", "room", "bounce", 87),
    _set(
        "foot", "room", "phone", 88, shuffled=True, walk=Walk("near-and-far", distances=(0.75, 1.4)), equipment=SHIFTED
    ),
)
LISTS = {"known": KNOWN, "unseen": UNSEEN, "otherwise": OTHERWISE, "later": LATER, "equipment": EQUIPMENT}


def chosen_sets(parts: tuple[str, ...], which: str) -> list[CaptureSet]:
    """Sets of one of the lists whose names contain one of the parts, or all. Raises ValueError for a part in none."""
    sets = LISTS[which]
    for part in parts:
        if not any(part in one.name for one in sets):
            raise ValueError(f"--sets {part}: no set is named so; there are {', '.join(one.name for one in sets)}")
    return [one for one in sets if not parts or any(part in one.name for part in parts)]

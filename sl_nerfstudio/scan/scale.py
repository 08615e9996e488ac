"""The key `scale` of transforms.json: whether lengths are true, and which length was measured."""

import re
from collections.abc import Mapping, Sequence
from typing import Any

from sl_nerfstudio.geometry.devices import Device
from sl_nerfstudio.scan.document import TRANSFORMS
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.problem import Faults, Problem
from sl_nerfstudio.scan.types import PickedPixel, Scale, ScaleBar

_KEYS = ("known", "source", "baseline_of", "distance_between", "length")
_OLD_SOURCE = re.compile(r"baseline of frame (\d+)(?: \((.+)\))?")


def read_scale(top: Fields, frames: Sequence[str]) -> Scale | None:
    """The scale of a scan whose frames have these names; None after adding a fault.

    Scans written before `baseline_of` existed say "baseline of frame 3 (name)" or "baseline of frame 3" in `source`.
    The name in brackets is used if it is there, else the number, if the names of the frames do not contradict it.
    """
    section = top.read_section("scale")
    if section is None:
        return None
    section.check_spelling(_KEYS)
    known = section.read_flag("known")
    source = section.read_optional_text("source") if section.record.get("source") != "" else ""
    baseline_of = section.read_optional_text("baseline_of")
    bar = _read_bar(section)
    if known is None:
        return None
    if not known and (baseline_of is not None or bar is not None):
        section.fault(
            "known", "is false, although a known length is given", "the two keys contradict each other",
            "set known to true, or remove the length",
        )  # fmt: skip
        return None
    if baseline_of is not None and bar is not None:
        section.fault(
            "baseline_of", "is given together with distance_between", "two known lengths can contradict each other",
            "keep one of them",
        )  # fmt: skip
        return None
    if known and baseline_of is None and bar is None:
        baseline_of = _old_baseline(section, source or "", frames)
    return Scale(known, source or "", baseline_of, bar)


def check_scale_frames(scale: Scale, cameras: Mapping[str, Device | None], faults: Faults) -> None:
    """Add a fault for each frame and pixel of the known length that the scan does not have.

    `cameras` holds every frame's camera by name, None where it could not be read.
    """
    key = "scale.baseline_of" if scale.bar is None else "scale.distance_between"
    for name in scale.frames:
        if name not in cameras:
            problem = Problem(
                f"names frame {name!r}, which is not in the scan",
                "the frame was removed or renamed after the scan was made",
                f"put the frame back, or remove {key.removeprefix('scale.')}: then all lengths count alike",
            )
            faults.add(problem, TRANSFORMS, None, key)
    for end in () if scale.bar is None else scale.bar.ends:
        camera, (x, y) = cameras.get(end.frame), end.pixel
        if camera is not None and not (0 <= x < camera.w and 0 <= y < camera.h):
            problem = Problem(
                f"has the pixel ({x:g}, {y:g}), outside the {camera.w} x {camera.h} pixels of frame {end.frame!r}",
                "it was picked in an image of another size, or x and y are swapped",
                "give x and y of a pixel of this image",
            )
            faults.add(problem, TRANSFORMS, None, key)


def scale_record(scale: Scale) -> dict[str, Any]:
    """The value of `scale`."""
    record: dict[str, Any] = {"known": scale.known}
    if scale.source:
        record["source"] = scale.source
    if scale.baseline_of is not None:
        record["baseline_of"] = scale.baseline_of
    if scale.bar is not None:
        record["distance_between"] = [{"frame": e.frame, "pixel": [*map(float, e.pixel)]} for e in scale.bar.ends]
        record["length"] = float(scale.bar.length)
    return record


def _old_baseline(section: Fields, source: str, frames: Sequence[str]) -> str | None:
    """The frame of a scan that has only `source`; a name that is not among `frames` is returned all the same.

    A number alone says nothing once frames were removed. That shows in names which have numbers of their own.
    """
    found = _OLD_SOURCE.search(source)
    if found is None:
        return None
    number, name = int(found[1]), found[2]
    if name is not None and (name in frames or found[0] == source):
        return name
    own = [_last_number(frame) for frame in frames]
    if number < len(frames) and (own[number] == number or None in own):
        return frames[number]
    section.fault(
        "source",
        f"names frame number {number}, and it is not certain which one that is"
        if number < len(frames)
        else f"names frame number {number}, but there are only {len(frames)} frames",
        "frames were removed or renamed after the scan was made",
        "name the frame in baseline_of; if it was removed, take the sentence out: then all lengths count alike",
    )
    return None


def _last_number(name: str) -> int | None:
    """7 for frame_00007; None for a name that does not end in a number."""
    digits = re.search(r"[0-9]{1,9}$", name)
    return None if digits is None else int(digits[0])


def _read_bar(section: Fields) -> ScaleBar | None:
    """None where the scan has no scale bar, or after adding a fault."""
    ends, length = section.record.get("distance_between"), section.record.get("length")
    if ends is None and length is None:
        return None
    if ends is None or length is None:
        section.fault(
            "length" if length is None else "distance_between", "is missing",
            "distance_between and length are only valid together", "give both or neither",
        )  # fmt: skip
        return None
    number = section.read_number("length")
    if number is not None and number <= 0:
        section.fault("length", f"is {number:g}", "a typing error", "give a length greater than 0")
        number = None
    if not isinstance(ends, list) or len(ends) != 2:
        section.fault("distance_between", "is not a list of two pixels", "wrong type", "see docs/scan-format.md")
        return None
    first, second = (_read_end(section, end, f"distance_between[{k}]") for k, end in enumerate(ends))
    if first is None or second is None or number is None:
        return None
    if first == second:
        section.fault("distance_between", "is twice the same pixel", "a copy", "give two different pixels")
        return None
    return ScaleBar((first, second), number)


def _read_end(section: Fields, end: Any, key: str) -> PickedPixel | None:
    if not isinstance(end, dict):
        section.fault(key, "is not an object { .. }", "wrong type", "see docs/scan-format.md")
        return None
    fields = Fields(end, section.faults, section.file, section.frame, f"{section.prefix}{key}.")
    fields.check_spelling(("frame", "pixel"))
    name, pixel = fields.read_text("frame"), fields.read_numbers("pixel", 2)
    return None if name is None or pixel is None else PickedPixel(name, (pixel[0], pixel[1]))

"""Cameras and projectors in transforms.json, and whether their numbers can be right."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from sl_nerfstudio.geometry.devices import Device, Intrinsics, project, unproject
from sl_nerfstudio.scan.fields import Fields
from sl_nerfstudio.scan.images import MAX_PIXELS
from sl_nerfstudio.scan.problem import Problem

REQUIRED = ("w", "h", "fl_x", "fl_y", "cx", "cy")
DISTORTION = ("k1", "k2", "p1", "p2")
CAMERA_KEYS = ("camera_model", *REQUIRED, *DISTORTION)
PROJECTOR_KEYS = ("model", *REQUIRED, *DISTORTION, "pattern_path")
_UNSUPPORTED = ("k3", "k4", "k5", "k6")
_NARROWEST, _WIDEST = 100.0, 0.1  # focal length in widths of the image: fields of view of 0.57 and 157 degrees
_ROUND_TRIP_PX = 1e-3
_LEAST_STRETCH, _MOST_STRETCH = (
    0.2,
    2.0,
)  # of distances from the principal point: fisheye lenses shrink them, none doubles


def read_device(fields: Fields, kind: str) -> Device | None:
    """The device that `fields` describes; `kind` is "camera" or "projector". None after adding faults."""
    key = "camera_model" if kind == "camera" else "model"
    choices = ("OPENCV",) if kind == "camera" else ("OPENCV", "DOE")
    model = fields.read_choice(key, choices, "it is a lens model that this format does not have")
    w, h = fields.read_count("w"), fields.read_count("h")
    values = {k: fields.read_number(k) for k in REQUIRED[2:]}
    values |= {k: fields.read_number(k, default=0.0) for k in DISTORTION}
    for k in _UNSUPPORTED:
        if fields.read_number(k, default=0.0):
            fields.fault(
                k, "is not 0", "the lens model has more terms than k1, k2, p1, p2",
                "calibrate with these four, or undistort the images",
            )  # fmt: skip
    numbers = {k: v for k, v in values.items() if v is not None}
    if model is None or w is None or h is None or len(numbers) != len(values):
        return None
    fl_x, fl_y, cx, cy, k1, k2, p1, p2 = numbers.values()
    device = Device(w, h, fl_x, fl_y, cx, cy, k1, k2, p1, p2, "DOE" if model == "DOE" else "OPENCV")
    problems = list(device_problems(device))
    for field, problem in problems:
        fields.faults.add(problem, fields.file, fields.frame, fields.prefix + field)
    return None if problems else device


def device_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    """(key, problem) of every number of a device that cannot be right."""
    if device.w * device.h > MAX_PIXELS:
        yield (
            "w",
            Problem(
                f"times h is {device.w * device.h} pixels", "a typing error", "give the size of the image in pixels"
            ),
        )
        return
    focal_problems = list(_focal_problems(device))
    yield from focal_problems
    for key, size, centre in (("cx", device.w, device.cx), ("cy", device.h, device.cy)):
        if not -2 * size <= centre <= 3 * size:  # lens shift moves it outside the image, but not that far
            yield (
                key,
                Problem(
                    f"is {centre:g}, far outside an image of {size} pixels",
                    "the intrinsics are those of another resolution or in another unit",
                    "give the principal point in pixels of this image",
                ),
            )
    if not focal_problems and any(getattr(device, k) for k in DISTORTION):
        yield from _distortion_problems(device)


def _focal_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    for key, focal in (("fl_x", device.fl_x), ("fl_y", device.fl_y)):
        size = max(device.w, device.h)
        if focal <= 0:
            yield (
                key,
                Problem(
                    f"is {focal:g}",
                    "it was not filled in, or has the sign of OpenGL's projection",
                    "give the focal length in pixels, a number greater than 0",
                ),
            )
        elif not _WIDEST * size <= focal <= _NARROWEST * size:
            yield (
                key,
                Problem(
                    f"is {focal:g} pixels, which is impossible for an image of {size} pixels",
                    "it was given in millimetres, as a fraction of the image, or for another resolution",
                    "give the focal length in pixels of this image",
                ),
            )


def _distortion_problems(device: Device) -> Iterator[tuple[str, Problem]]:
    """Every pixel must return to its place when it is undistorted and distorted again, from a place not far away."""
    x, y = torch.meshgrid(
        torch.linspace(0, device.w, 33, dtype=torch.float64),
        torch.linspace(0, device.h, 33, dtype=torch.float64),
        indexing="xy",
    )
    uv = torch.stack([x, y], -1)
    # The distortion does not depend on the model (pinhole or DOE); a pinhole has no limit at 90 degrees.
    intrinsics = Intrinsics.of(replace(device, model="OPENCV"), torch.float64)
    directions = unproject(intrinsics, uv)
    again, in_front = project(intrinsics, directions)
    if not (in_front.all() and ((again - uv).abs() < _ROUND_TRIP_PX).all()):
        yield (
            "k1",
            Problem(
                "and the other distortion terms fold the image over itself: two directions share a pixel",
                "the terms are of another model, in another order, or were fitted without points near the corners",
                "give k1, k2, p1, p2 as OpenCV defines them, fitted over the whole image",
            ),
        )
        return
    straight = directions[..., :2] / -directions[..., 2:]
    bent = (uv - uv.new_tensor([device.cx, device.cy])) / uv.new_tensor([device.fl_x, device.fl_y])
    stretch = (bent.norm(dim=-1) / straight.norm(dim=-1)).nan_to_num(1.0)
    extreme = [value for value in (float(stretch.min()), float(stretch.max())) if not _plausible(value)]
    if extreme:
        yield (
            "k1",
            Problem(
                f"and the other distortion terms multiply distances from the principal point by {extreme[0]:.2g}",
                "a slip, terms of another model or in another order, or a fit to too few points; no lens does that",
                "give k1, k2, p1, p2 as OpenCV defines them, fitted over the whole image",
            ),
        )


def _plausible(stretch: float) -> bool:
    return _LEAST_STRETCH <= stretch <= _MOST_STRETCH

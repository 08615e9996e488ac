"""Every masked pixel of a scan in one compact table, and random draws from it."""

from collections.abc import Iterable
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, Int16, Int32
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.dataparser.held_out import block_hash, held_out_pixels, spread
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.large_arrays import GrowingArray, largest_in_memory
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan import Frame, Scan

_COLUMNS = 6  # of the table


@dataclass(frozen=True)
class PixelBatch:
    """Pixels selected from PixelSamples, in the types that computations need."""

    frame: Int[Tensor, "n"]
    row: Int[Tensor, "n"]
    column: Int[Tensor, "n"]
    coords: Float[Tensor, "n 2"]  # pattern pixels; NaN where not decoded
    pattern: Float[Tensor, "n"]  # [0, 1]

    def to(self, device: torch.device | str) -> "PixelBatch":
        """The same pixels on another device."""
        return PixelBatch(**{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    @property
    def uv(self) -> Float[Tensor, "n 2"]:
        """Camera pixel coordinates (x, y) of the pixels' centres."""
        return torch.stack([self.column, self.row], -1).to(self.coords.dtype) + 0.5

    @property
    def decoded(self) -> Bool[Tensor, "n"]:
        """Whether the pixel's projector coordinates are known."""
        return self.coords[:, 0].isfinite()


@dataclass(frozen=True)
class PixelSamples:
    """Every masked pixel of every frame, one frame after the other; 19 bytes per pixel."""

    frame: Int32[Tensor, "n"]
    row: Int16[Tensor, "n"]
    column: Int16[Tensor, "n"]
    coords: Float32[Tensor, "n 2"]  # pattern pixels; NaN where not decoded
    pattern: Float16[Tensor, "n"]  # [0, 1]; 11 bits are enough for a normalised intensity
    held_out: Bool[Tensor, "n"]  # never used for training
    first: Int[Tensor, "frames_and_one"]  # frame i holds rows first[i] to first[i + 1] - 1
    _held_out_index: Int[Tensor, "m"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_held_out_index", self.held_out.nonzero()[:, 0])

    def __len__(self) -> int:
        return len(self.frame)

    @property
    def device(self) -> torch.device:
        """The device that holds the table."""
        return self.frame.device

    def to(self, device: torch.device | str) -> "PixelSamples":
        """The same table on another device."""
        return PixelSamples(**{f.name: getattr(self, f.name).to(device) for f in fields(self) if f.init})

    def draw(self, count: int, generator: torch.Generator | None = None, held_out: bool = False) -> Int[Tensor, "n"]:
        """Indices of `count` pixels, uniformly and with replacement, from those for training or from those held out.

        The time does not depend on the size of the table. `generator` must be on the table's device.
        """
        if held_out:
            return self._held_out_index[self.randint(len(self._held_out_index), count, generator)]
        index = self.randint(len(self), count, generator)
        while True:  # rejection sampling: a few per cent are held out, so two or three rounds
            again = self.held_out[index].nonzero()[:, 0]
            if len(again) == 0:
                return index
            index[again] = self.randint(len(self), len(again), generator)

    @cached_property
    def training(self) -> Int[Tensor, "n_training"]:
        """Indices of all pixels that are not held out; 4 bytes per pixel."""
        return (~self.held_out).nonzero()[:, 0].to(torch.int32)

    def draw_without_waiting(self, count: int, generator: torch.Generator | None = None) -> Int[Tensor, "n"]:
        """Like `draw` for training, but in a fixed number of operations, so that the host need not wait for a GPU."""
        return self.training[self.randint(len(self.training), count, generator)].long()

    def held_out_of(self, frame: int) -> Int[Tensor, "n"]:
        """Indices of one frame's held-out pixels."""
        first, last = int(self.first[frame]), int(self.first[frame + 1])
        lower, upper = torch.searchsorted(self._held_out_index, torch.tensor([first, last], device=self.device))
        return self._held_out_index[lower:upper]

    def at(self, index: Int[Tensor, "n"]) -> PixelBatch:
        """The pixels with these indices."""
        return PixelBatch(
            frame=self.frame[index].long(),
            row=self.row[index].long(),
            column=self.column[index].long(),
            coords=self.coords[index],
            pattern=self.pattern[index].float(),
        )

    def randint(self, high: int, count: int, generator: torch.Generator | None) -> Int[Tensor, "n"]:
        """Random numbers below `high`, on the table's device."""
        return torch.randint(high, (count,), generator=generator, device=self.device)


def build_samples(scan: Scan, show_progress: bool = True) -> PixelSamples:
    """Read all frames of a scan, one in memory at a time. A table that is too large for memory is kept in a file.

    Raises UserError if the whole scan has too few masked pixels to train with some and test with others.
    """
    frames: Iterable[Frame] = track(scan.frames, "Reading frames") if show_progress else scan.frames
    columns: dict[str, GrowingArray] = {}
    most = largest_in_memory() // _COLUMNS
    first = [0]
    for number, frame in enumerate(frames):
        pixels = _frame_pixels(number, frame)
        first.append(first[-1] + len(pixels["row"]))
        for name, values in pixels.items():
            columns.setdefault(name, GrowingArray(most)).append(values)
    # column by column, each released immediately: peak memory is the table and one more column
    table = {name: torch.from_numpy(columns.pop(name).whole()) for name in list(columns)}
    if not table["held_out"].any():
        table["held_out"] = torch.from_numpy(_one_block(scan, table))
    if len(table["row"]) == 0 or table["held_out"].all():
        raise UserError(
            f"{scan.root}: only {len(table['row'])} masked pixels in {len(scan.frames)} frames, too few to train on. "
            "Check masks/ (255 where the pattern falls on the object) or coords/ (NaN only where decoding failed)."
        )
    return PixelSamples(**table, first=torch.tensor(first))


def _frame_pixels(number: int, frame: Frame) -> dict[str, ndarray]:
    coords = frame.read_coords()
    mask = np.isfinite(coords).all(-1) if frame.mask_path is None else frame.read_mask()
    row, column = mask.nonzero()
    return {
        "frame": np.full(len(row), number, dtype=np.int32),
        "row": row.astype(np.int16),
        "column": column.astype(np.int16),
        "coords": coords[mask],
        "pattern": frame.read_pattern()[mask].astype(np.float16),
        "held_out": held_out_pixels(number, *mask.shape)[mask],
    }


def _one_block(scan: Scan, table: dict[str, Tensor]) -> Bool[ndarray, "n"]:
    """For scans so small that the hash holds nothing out: the occupied block with the smallest hash."""
    value = np.empty(len(table["row"]))
    for number, frame in enumerate(scan.frames):
        own = table["frame"] == number
        pixels = spread(block_hash(number, frame.camera.h, frame.camera.w), frame.camera.h, frame.camera.w)
        value[own.numpy()] = pixels[table["row"][own].numpy(), table["column"][own].numpy()]
    return value == value.min(initial=np.inf)

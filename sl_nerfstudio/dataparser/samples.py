"""Every masked pixel of a scan in one compact table, and random draws from it."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float, Float16, Float32, Int, Int16, Int32, Int64, Shaped, UInt8
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.dataparser.held_out import block_hash, held_out_pixels, spread
from sl_nerfstudio.errors import UserError
from sl_nerfstudio.files.large_arrays import GrowingArray, largest_in_memory
from sl_nerfstudio.memory import read_at_random, read_in_order
from sl_nerfstudio.progress import track
from sl_nerfstudio.scan import Frame, Scan

_RECORD = np.dtype(
    [
        ("frame", "i4"),
        ("coords", "f4", 2),
        ("row", "i2"),
        ("column", "i2"),
        ("pattern", "f2"),
        ("held_out", "?"),
        ("", "V1"),
    ]
)  # what is known of a pixel lies together: a table that is in a file is read once for it
_AT_ONCE = 2**24  # pixels: bounds memory


@dataclass(frozen=True)
class PixelBatch:
    """Pixels selected from PixelSamples, in the types that computations need."""

    frame: Int[Tensor, "n"]
    row: Int[Tensor, "n"]
    column: Int[Tensor, "n"]
    coords: Float[Tensor, "n 2"]  # pattern pixels; NaN where not decoded
    pattern: Float[Tensor, "n"]  # [0, 1]
    held_out: Bool[Tensor, "n"]  # never used for training

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
    """Every masked pixel of every frame, one frame after the other; 20 bytes per pixel."""

    records: UInt8[Tensor, "n 20"]
    first: Int[Tensor, "frames_and_one"]  # frame i holds rows first[i] to first[i + 1] - 1
    held_out_index: Int[Tensor, "m"]  # rows that are never used for training, in order
    in_file: bool = False  # whether records are mapped from a file

    def __len__(self) -> int:
        return len(self.records)

    @property
    def frame(self) -> Int32[Tensor, "n"]:
        """Number of each pixel's frame."""
        return self._column("frame", torch.int32)[:, 0]

    @property
    def row(self) -> Int16[Tensor, "n"]:
        """Row in its image."""
        return self._column("row", torch.int16)[:, 0]

    @property
    def column(self) -> Int16[Tensor, "n"]:
        """Column in its image."""
        return self._column("column", torch.int16)[:, 0]

    @property
    def coords(self) -> Float32[Tensor, "n 2"]:
        """Pattern pixels; NaN where not decoded."""
        return self._column("coords", torch.float32)

    @property
    def pattern(self) -> Float16[Tensor, "n"]:
        """Intensity, [0, 1]; 11 bits are enough for a normalised one."""
        return self._column("pattern", torch.float16)[:, 0]

    @property
    def held_out(self) -> Bool[Tensor, "n"]:
        """Whether a pixel is never used for training."""
        return self._column("held_out", torch.bool)[:, 0]

    def _column(self, name: str, kind: torch.dtype) -> Shaped[Tensor, "n k"]:
        """One field of all records, without a copy."""
        part, first = _RECORD.fields[name][:2]  # type: ignore[index]
        return self.records[:, first : first + part.itemsize].view(kind)

    @property
    def decoded_share(self) -> float:
        """Share of the pixels whose coordinates are known."""
        self._announce(read_in_order)
        return sum(int(part.isfinite().sum()) for part in self.coords[:, 0].split(_AT_ONCE)) / len(self)

    def _announce(self, reading: Callable[[int, int], None]) -> None:
        """How the records will be read next, which matters if they are in a file."""
        if self.in_file:
            reading(self.records.data_ptr(), self.records.nbytes)

    @property
    def device(self) -> torch.device:
        """The device that holds the table."""
        return self.records.device

    def to(self, device: torch.device | str) -> "PixelSamples":
        """The same table on another device."""
        if torch.device(device) == self.device:
            return self
        return PixelSamples(self.records.to(device), self.first.to(device), self.held_out_index.to(device))

    def first_frames(self, count: int) -> "PixelSamples":
        """The pixels of the first frames alone."""
        end = int(self.first[count])
        held_out = self.held_out_index[self.held_out_index < end]
        return PixelSamples(self.records[:end], self.first[: count + 1], held_out, self.in_file)

    def in_order(self) -> Iterator[PixelBatch]:
        """All pixels of each frame."""
        self._announce(read_in_order)
        for first, last in pairwise(self.first.tolist()):
            yield self.at(slice(first, last))

    def draw(self, count: int, generator: torch.Generator | None = None, held_out: bool = False) -> Int[Tensor, "n"]:
        """Indices of `count` pixels, uniformly and with replacement, from those for training or from those held out.

        The time does not depend on the size of the table. `generator` must be on the table's device.
        """
        self._announce(read_at_random)
        if held_out:
            return self.held_out_index[self.randint(len(self.held_out_index), count, generator)]
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
        lower, upper = torch.searchsorted(self.held_out_index, torch.tensor([first, last], device=self.device))
        return self.held_out_index[lower:upper]

    def at(self, index: Int[Tensor, "n"] | slice) -> PixelBatch:
        """The pixels with these indices."""
        some = replace(self, records=self.records[index])
        return PixelBatch(
            frame=some.frame.long(),
            row=some.row.long(),
            column=some.column.long(),
            coords=some.coords.contiguous(),
            pattern=some.pattern.float(),
            held_out=some.held_out,
        )

    def randint(self, high: int, count: int, generator: torch.Generator | None) -> Int[Tensor, "n"]:
        """Random numbers below `high`, on the table's device."""
        return torch.randint(high, (count,), generator=generator, device=self.device)


def build_samples(scan: Scan, show_progress: bool = True) -> PixelSamples:
    """Read all frames of a scan, one in memory at a time. A table that is too large for memory is kept in a file.

    Raises UserError if the whole scan has too few masked pixels to train with some and test with others.
    """
    frames: Iterable[Frame] = track(scan.frames, "Reading frames") if show_progress else scan.frames
    table, first, held_out = GrowingArray(largest_in_memory()), [0], [np.zeros(0, dtype=np.int64)]
    for number, frame in enumerate(frames):
        pixels = _frame_pixels(number, frame)
        held_out.append(first[-1] + np.flatnonzero(pixels["held_out"]))
        first.append(first[-1] + len(pixels))
        table.append(pixels.view(np.uint8).reshape(-1, _RECORD.itemsize))
    records, index = table.whole(), np.concatenate(held_out)
    if len(index) == 0:
        index = _hold_one_block_out(scan, records.view(_RECORD)[:, 0])
    if len(records) in (0, len(index)):
        raise UserError(
            f"{scan.root}: only {len(records)} masked pixels in {len(scan.frames)} frames, too few to train on. "
            "Check masks/ (255 where the pattern falls on the object) or coords/ (NaN only where decoding failed)."
        )
    in_file = isinstance(records, np.memmap)
    return PixelSamples(torch.from_numpy(records), torch.tensor(first), torch.from_numpy(index), in_file)


def _frame_pixels(number: int, frame: Frame) -> Shaped[ndarray, "n"]:
    """The records of one frame."""
    coords = frame.read_coords()
    mask = np.isfinite(coords).all(-1) if frame.mask_path is None else frame.read_mask()
    row, column = mask.nonzero()
    out = np.zeros(len(row), dtype=_RECORD)
    out["frame"], out["row"], out["column"], out["coords"] = number, row, column, coords[mask]
    out["pattern"], out["held_out"] = frame.read_pattern()[mask], held_out_pixels(number, *mask.shape)[mask]
    return out


def _hold_one_block_out(scan: Scan, records: Shaped[ndarray, "n"]) -> Int64[ndarray, "m"]:
    """For scans so small that the hash holds nothing out: the occupied block with the smallest hash."""
    value = np.empty(len(records))
    for number, frame in enumerate(scan.frames):
        own = records["frame"] == number
        pixels = spread(block_hash(number, frame.camera.h, frame.camera.w), frame.camera.h, frame.camera.w)
        value[own] = pixels[records["row"][own], records["column"][own]]
    records["held_out"] = value == value.min(initial=np.inf)
    return np.flatnonzero(records["held_out"])

"""The field on the CPU: numba kernels, ranges of points in parallel."""

from collections.abc import Callable
from functools import partial
from threading import local

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from sl_nerfstudio.field.backend import FieldState, Pulled
from sl_nerfstudio.field.hash_grid import GridLayout
from sl_nerfstudio.field.kernels import fused
from sl_nerfstudio.field.kernels.grid import POINTS, Grid, scatter_level
from sl_nerfstudio.field.kernels.mlp import Network, Scratch, Weights, make_scratch
from sl_nerfstudio.field.kernels.pack import pack_grid, pack_network, unpack_gradients, zero_gradients
from sl_nerfstudio.field.kernels.simd import FEATURES
from sl_nerfstudio.threads import parallel, split, threads

_BATCH = 16384  # points whose feature gradients are kept (in cache) between the MLP and the table

_buffers = local()


class NumbaField:
    """`FieldBackend` for float32 on the CPU with 8 features per level."""

    def __init__(self, layout: GridLayout, knee: float):
        self.layout = layout
        self.knee = knee

    def evaluate(
        self, state: FieldState, p: Float[Tensor, "n 3"], gradient: bool
    ) -> tuple[Float[Tensor, "n"], Float[Tensor, "n 3"] | None]:
        """See `FieldBackend`."""
        grid, network, xyz = self._packed(state, p)
        f = np.empty(len(xyz), np.float32)
        n = np.empty((len(xyz) if gradient else 0, 3), np.float32)

        def work(start: int, stop: int) -> None:
            fused.evaluate(grid, network, _scratch(network), xyz, start, stop, f, n, gradient)

        parallel([partial(work, start, stop) for start, stop in _ranges(len(xyz))])
        return torch.from_numpy(f), torch.from_numpy(n) if gradient else None

    def pull_back(
        self,
        state: FieldState,
        p: Float[Tensor, "n 3"],
        g: Float[Tensor, "n"],
        points: bool,
        parameters: bool,
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> Pulled:
        """See `FieldBackend`; points whose `g` is negligible are left out."""
        heavy = _heavy(g)
        if heavy is not None:
            some = self.pull_back(state, p[heavy], g[heavy], points, parameters, table_gradient, marks)
            dp = None if some.points is None else torch.zeros_like(p).index_copy_(0, heavy, some.points)
            return Pulled(dp, some.mlp)
        grid, network, xyz = self._packed(state, p)
        upstream = _array(g)
        dp = np.empty((len(xyz) if points else 0, 3), np.float32)

        def work(sums: Weights, levels: np.ndarray, _: np.ndarray, offset: int, start: int, stop: int) -> None:
            fused.pull_back(
                grid,
                network,
                _scratch(network),
                xyz,
                start,
                stop,
                upstream,
                sums,
                levels,
                offset,
                parameters,
                dp,
                points,
            )

        parts = self._sweep(grid, network, xyz, None, parameters, table_gradient, marks, work)
        mlp = unpack_gradients(self.layout, state, network, parts) if parameters else None
        return Pulled(torch.from_numpy(dp) if points else None, mlp)

    def pull_back_gradient(
        self,
        state: FieldState,
        p: Float[Tensor, "n 3"],
        g: Float[Tensor, "n"],
        v: Float[Tensor, "n 3"],
        table_gradient: Float[Tensor, "rows f"] | None,
        marks: UInt8[Tensor, "marks"] | None,
    ) -> tuple[Tensor, ...]:
        """See `FieldBackend`."""
        grid, network, xyz = self._packed(state, p)
        upstream, direction = _array(g), _array(v)

        def work(sums: Weights, levels: np.ndarray, slopes: np.ndarray, offset: int, start: int, stop: int) -> None:
            fused.pull_back_gradient(
                grid,
                network,
                _scratch(network),
                xyz,
                start,
                stop,
                upstream,
                direction,
                sums,
                levels,
                slopes,
                offset,
            )

        parts = self._sweep(grid, network, xyz, direction, True, table_gradient, marks, work)
        return unpack_gradients(self.layout, state, network, parts)

    def _packed(self, state: FieldState, p: Tensor) -> tuple[Grid, Network, np.ndarray]:
        return pack_grid(self.layout, state), pack_network(self.layout, state, self.knee), _array(p)

    def _sweep(
        self,
        grid: Grid,
        network: Network,
        xyz: np.ndarray,
        direction: np.ndarray | None,
        parameters: bool,
        table_gradient: Tensor | None,
        marks: Tensor | None,
        work: Callable[..., None],
    ) -> list[Weights]:
        """For each batch, run the MLP in parallel over ranges of points, then the table in parallel over levels.

        Returns the sums of MLP gradients of the ranges. Results do not depend on timing: each range has its own sums,
        and each level of the table is written by one thread, in the order of the points.
        """
        batch = min(len(xyz), _BATCH)
        ranges = _ranges(batch)
        sums = [zero_gradients(network) for _ in ranges]
        levels = np.empty((self.layout.levels, batch if parameters else 0, FEATURES), np.float32)
        slopes = np.empty((self.layout.levels, 0 if direction is None else batch, FEATURES), np.float32)
        v = xyz if direction is None else direction
        on = [level for level in reversed(range(self.layout.levels)) if grid.weights[level]]
        for first in range(0, len(xyz), _BATCH):
            count = min(_BATCH, len(xyz) - first)
            parallel(
                [
                    partial(work, part, levels, slopes, first, first + start, first + min(stop, count))
                    for (start, stop), part in zip(ranges, sums, strict=True)
                ]
            )
            if table_gradient is None:
                continue
            gradient = table_gradient.numpy().reshape(-1)
            touched = np.empty(self.layout.rows, np.uint8) if marks is None else marks.numpy()
            parallel(
                [
                    partial(
                        scatter_level,
                        *(grid, level, xyz, first, count, levels, gradient, touched, v, slopes, direction is not None),
                    )
                    for level in on
                ]
            )
        return sums


def _heavy(g: Float[Tensor, "n"]) -> Tensor | None:
    """Indices of the points that matter, or None if leaving out the others would not save much.

    All others together change no sum over the points by more than the rounding (2^-24) of its largest term. Because of
    the rendering weights most points of a ray are negligible: those in free space and those deep behind the surface.
    """
    if len(g) == 0:
        return None
    size = g.abs()
    light = size <= size.max() * (2.0**-24 / len(g))  # false for NaN, which must be kept
    if light.all() or light.count_nonzero() < 0.1 * len(g):
        return None
    return light.logical_not_().nonzero()[:, 0]


def _scratch(network: Network) -> Scratch:
    """This thread's buffers."""
    sizes = (network.depth, network.hidden, network.layers)
    if getattr(_buffers, "sizes", None) != sizes:
        _buffers.sizes, _buffers.scratch = sizes, make_scratch(*sizes)
    return _buffers.scratch


def _array(t: Tensor) -> np.ndarray:
    return t.detach().contiguous().numpy()


def _ranges(n: int) -> list[tuple[int, int]]:
    """Twice as many ranges as threads, so that other threads can take over work from a slow one."""
    count = threads()
    return split(n, 1 if count == 1 else 2 * count, POINTS)

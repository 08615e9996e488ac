"""Weighted normal equations of the bundle adjustment; the depths of the anchors are eliminated (Schur complement).

Two frames are coupled where one sees an anchor of the other, or both see the same one. Time and memory grow with the
number of residuals; only the whole matrix, which many frames do without, grows with the square of their number.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float64, Int
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic as _intrinsic
from numpy import ndarray
from torch import Tensor

from sl_nerfstudio.bundle_adjustment.coordinate_maps import Groups
from sl_nerfstudio.bundle_adjustment.residuals import Linearisation, Observations, array
from sl_nerfstudio.parallel import compiled, compiled_range

# Sums of vectors of 6 and 12 numbers, the unknowns of half a frame and of a frame, as vector instructions. As loops
# they cost more than twice as much: before each of them, code of numba checks whether its arrays overlap.

intrinsic: Any = _intrinsic  # callers omit the typing context, which type checkers cannot know
_NUMBER = 8  # bytes


def _adding(count: int, lanes: int) -> Any:
    """`out[at : at + count] += scale * values[first : first + count]` in flat, contiguous arrays of float64."""
    vector = ir.VectorType(ir.DoubleType(), lanes)
    undefined, zeros = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)

    @intrinsic
    def add(typing: Any, out: Any, at: Any, scale: Any, values: Any, first: Any) -> Any:
        signature = types.void(out, types.int64, types.float64, values, types.int64)

        def emit(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            out, at, scale, values, first = args
            target = context.make_array(signature.args[0])(context, builder, out).data
            source = context.make_array(signature.args[3])(context, builder, values).data
            first_lane = builder.insert_element(undefined, scale, ir.Constant(ir.IntType(32), 0))
            scales = builder.shuffle_vector(first_lane, undefined, zeros)
            kind = ir.FunctionType(vector, [vector] * 3)
            multiply_add = cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{lanes}f64")

            def pointer(data: Any, place: Any, step: int) -> Any:
                there = builder.gep(data, [builder.add(place, ir.Constant(ir.IntType(64), step))])
                return builder.bitcast(there, vector.as_pointer())

            for step in range(0, count, lanes):
                x = builder.load(pointer(source, first, step), align=_NUMBER)
                sums = pointer(target, at, step)
                total = builder.call(multiply_add, [scales, x, builder.load(sums, align=_NUMBER)])
                builder.store(total, sums, align=_NUMBER)
            return context.get_dummy_value()

        return signature, emit

    return add


add_6, add_12 = _adding(6, 2), _adding(12, 4)

# Compiled loops: each frame gathers what belongs to its own rows of the matrix. So no two threads write to the same
# place, and sums do not depend on the number of threads. Unknowns of a frame are its delta and its rho (12); those
# common to all frames come after all others.


@compiled_range
def depth_couplings(first, last, by_anchor, own, cross, depth_by_own, depth_by_row, depth_by_common, H_depth, g_depth):
    """Couplings of the depth of each anchor with the unknowns of its own frame, of those that see it, and of all.

    `own` and `cross` are residuals, derivatives by pose and depth, and weights; `by_anchor` the rows of each anchor.
    """
    starts, entries = by_anchor
    r_own, J_own, d_own, w_own = own
    r_cross, J_cross, d_cross, w_cross = cross
    common = depth_by_common.shape[1]
    for a in range(first, last):
        h = g = 0.0
        for c in range(2):
            wd = w_own[a] * d_own[a, c]
            h += wd * d_own[a, c]
            g += wd * r_own[a, c]
            for x in range(6):
                depth_by_own[a, 6 + x] += wd * J_own[a, c, x]
            for x in range(common):
                depth_by_common[a, x] += wd * J_own[a, c, 6 + x]
        for e in range(starts[a], starts[a + 1]):
            n = entries[e]
            if w_cross[n] > 0:
                for c in range(2):
                    wd = w_cross[n] * d_cross[n, c]
                    h += wd * d_cross[n, c]
                    g += wd * r_cross[n, c]
                    for x in range(6):
                        depth_by_own[a, x] += wd * J_cross[n, c, x]
                    for x in range(12):
                        depth_by_row[n, x] += wd * J_cross[n, c, 6 + x]
                    for x in range(common):
                        depth_by_common[a, x] += wd * J_cross[n, c, 18 + x]
        H_depth[a] = max(h, 1e-12)
        g_depth[a] = g


@compiled
def _add_6(H, at, w, J, n, first, second):
    """`H[x, y] += w J[n, :, first + x] . J[n, :, second + y]` for x and y < 6; H begins at `at` in its array."""
    stride, row = H.shape[-1], 2 * n * J.shape[2]
    for x in range(6):
        add_6(H, at + x * stride, w * J[n, 0, first + x], J, row + second)
        add_6(H, at + x * stride, w * J[n, 1, first + x], J, row + J.shape[2] + second)


@compiled
def _add_12(H, at, w, J, n, first):
    """`H[x, y] += w J[n, :, first + x] . J[n, :, 6 + y]` for x < 6 and y < 12; H begins at `at` in its array."""
    stride, row = H.shape[-1], 2 * n * J.shape[2]
    for x in range(6):
        add_12(H, at + x * stride, w * J[n, 0, first + x], J, row + 6)
        add_12(H, at + x * stride, w * J[n, 1, first + x], J, row + J.shape[2] + 6)


@compiled
def _add_common(border, s, first, w, J, n, second, common):
    """Add the columns by common unknowns, the last ones of J, to rows `first` to `first + 6` of a frame's border."""
    for x in range(6):
        for y in range(common):
            both = J[n, 0, second + x] * J[n, 0, J.shape[2] - common + y]
            both += J[n, 1, second + x] * J[n, 1, J.shape[2] - common + y]
            border[s, first + x, y] += w * both


@compiled
def _subtract(H, at, scale, v, i, u, j):
    """`H[x, y] -= scale v[i, x] u[j, y]` for x and y < 12; H begins at `at` in its array."""
    for x in range(12):
        add_12(H, at + x * H.shape[-1], -scale * v[i, x], u, 12 * j)


@compiled
def _subtract_depth(H, g, border, s, scale, v, i, u, u_g):
    """Subtract what the elimination of a depth takes from a frame's own block, its gradient and its common columns."""
    _subtract(H, 144 * s, scale, v, i, v, i)
    for x in range(12):
        g[s, x] -= scale * v[i, x] * u_g
        for y in range(len(u)):
            border[s, x, y] -= scale * v[i, x] * u[y]


@compiled
def _add_to_gradient(g, w, J, first, n, r, x0):
    for x in range(n):
        g[x0 + x] += w * (J[0, first + x] * r[0] + J[1, first + x] * r[1])


@compiled_range
def frame_sums(first, last, chosen, groups, anchor, own, cross, couplings, H, g, border):
    """Blocks on the diagonal `H[s]`, gradients `g[s]` and columns by common unknowns of some of the chosen frames.

    `groups` are the anchors of each frame, its rows as seeing frame, and the rows of each anchor. Depths are
    eliminated.
    """
    anchor_first, anchor_entries, seen_first, seen_entries, row_first, row_entries = groups
    r_own, J_own, _, w_own = own
    r_cross, J_cross, _, w_cross = cross
    by_own, by_row, by_common, H_depth, g_depth = couplings
    common = border.shape[2]
    for s in range(first, last):
        f = chosen[s]
        for e in range(anchor_first[f], anchor_first[f + 1]):
            a = anchor_entries[e]
            _add_6(H, 144 * s + 78, w_own[a], J_own, a, 0, 0)  # rows and columns of rho
            _add_common(border, s, 6, w_own[a], J_own, a, 0, common)
            _add_to_gradient(g[s], w_own[a], J_own[a], 0, 6, r_own[a], 6)
            _subtract_depth(H, g, border, s, 1 / H_depth[a], by_own, a, by_common[a], g_depth[a])
            for k in range(row_first[a], row_first[a + 1]):
                n = row_entries[k]
                if w_cross[n] > 0:
                    _add_6(H, 144 * s, w_cross[n], J_cross, n, 0, 0)
                    _add_common(border, s, 0, w_cross[n], J_cross, n, 0, common)
                    _add_to_gradient(g[s], w_cross[n], J_cross[n], 0, 6, r_cross[n], 0)
        for e in range(seen_first[f], seen_first[f + 1]):
            n = seen_entries[e]
            if w_cross[n] > 0:
                a = anchor[n]
                for half in (0, 6):
                    _add_12(H, 144 * s + 12 * half, w_cross[n], J_cross, n, 6 + half)
                    _add_common(border, s, half, w_cross[n], J_cross, n, 6 + half, common)
                _add_to_gradient(g[s], w_cross[n], J_cross[n], 6, 12, r_cross[n], 0)
                _subtract_depth(H, g, border, s, 1 / H_depth[a], by_row, n, by_common[a], g_depth[a])


@compiled
def _own_side(s, t):
    """Whether s, rather than t, sums the block that couples both: about half of its partners for each."""
    return t >= 0 and s != t and (s < t) == ((s + t) % 2 == 1)


@compiled_range
def pair_sums(first, last, chosen, slot, groups, rows, cross, couplings, H):
    """Blocks that couple some of the chosen frames with others: `H[12 s + x, 12 t + y]` for unknowns x of s and y of t.

    Of the blocks (s, t) and (t, s) only one is written (see `mirror`). `slot` gives the number of a frame among the
    chosen, or -1; `rows` the anchor and the two frames of each row.
    """
    anchor_first, anchor_entries, seen_first, seen_entries, row_first, row_entries = groups
    anchor, source, viewer = rows
    _, J_cross, _, w_cross = cross
    by_own, by_row, _, H_depth, _ = couplings
    width = H.shape[1]
    for s in range(first, last):
        f, at = chosen[s], 12 * s * width
        for e in range(anchor_first[f], anchor_first[f + 1]):
            a = anchor_entries[e]
            for k in range(row_first[a], row_first[a + 1]):
                n = row_entries[k]
                t = slot[viewer[n]]
                if w_cross[n] > 0 and _own_side(s, t):
                    _add_12(H, at + 12 * t, w_cross[n], J_cross, n, 0)
                    _subtract(H, at + 12 * t, 1 / H_depth[a], by_own, a, by_row, n)
        for e in range(seen_first[f], seen_first[f + 1]):
            n = seen_entries[e]
            if not w_cross[n] > 0:
                continue
            a = anchor[n]
            scale, t = 1 / H_depth[a], slot[source[n]]
            if _own_side(s, t):
                for half in (0, 6):
                    _add_6(H, at + half * width + 12 * t, w_cross[n], J_cross, n, 6 + half, 0)
                _subtract(H, at + 12 * t, scale, by_row, n, by_own, a)
            for k in range(row_first[a], row_first[a + 1]):
                m = row_entries[k]
                t = slot[viewer[m]]
                if w_cross[m] > 0 and _own_side(s, t):
                    _subtract(H, at + 12 * t, scale, by_row, n, by_row, m)


@compiled_range
def mirror(first, last, H):
    """The blocks that `pair_sums` left out, of some frames."""
    for s in range(first, last):
        for t in range(H.shape[0] // 12):
            if s != t and not _own_side(s, t):
                for x in range(12):
                    for y in range(12):
                        H[12 * s + x, 12 * t + y] = H[12 * t + y, 12 * s + x]


@compiled_range
def row_products(first, last, source, viewer, cross, step, out):
    """Weighted changes of cross residuals by a step [frames, 12], without that of the depths."""
    _, J, _, w = cross
    for n in range(first, last):
        i, j = source[n], viewer[n]
        for c in range(2):
            total = 0.0
            if w[n] > 0:
                for x in range(6):
                    total += J[n, c, x] * step[i, x]
                for x in range(12):
                    total += J[n, c, 6 + x] * step[j, x]
            out[n, c] = w[n] * total


@compiled_range
def frame_products(first, last, groups, anchor, own, cross, couplings, step, by_rows, depth_step, out):
    """The normal matrix times a step, for some frames.

    `by_rows` are the `row_products` and `depth_step` the changes of the depths that follow.
    """
    anchor_first, anchor_entries, seen_first, seen_entries, row_first, row_entries = groups
    _, J_own, _, w_own = own
    _, J_cross, _, w_cross = cross
    by_own, by_row, _, _, _ = couplings
    for f in range(first, last):
        y = out[f]
        for x in range(12):
            y[x] = 0.0
        for e in range(anchor_first[f], anchor_first[f + 1]):
            a = anchor_entries[e]
            for x in range(12):
                y[x] += by_own[a, x] * depth_step[a]
            for c in range(2):
                total = 0.0
                for x in range(6):
                    total += J_own[a, c, x] * step[f, 6 + x]
                for x in range(6):
                    y[6 + x] += w_own[a] * total * J_own[a, c, x]
            for k in range(row_first[a], row_first[a + 1]):
                n = row_entries[k]
                if w_cross[n] > 0:
                    for c in range(2):
                        for x in range(6):
                            y[x] += by_rows[n, c] * J_cross[n, c, x]
        for e in range(seen_first[f], seen_first[f + 1]):
            n = seen_entries[e]
            if w_cross[n] > 0:
                for x in range(12):
                    y[x] += by_row[n, x] * depth_step[anchor[n]]
                    y[x] += by_rows[n, 0] * J_cross[n, 0, 6 + x] + by_rows[n, 1] * J_cross[n, 1, 6 + x]


@compiled_range
def depth_steps(first, last, by_anchor, frame, viewer, couplings, step, common_step, out):
    """Changes of the depths that follow from a step [frames, 12] of all frames and of the common unknowns."""
    starts, entries = by_anchor
    by_own, by_row, by_common, H_depth, g_depth = couplings
    for a in range(first, last):
        total = g_depth[a]
        for x in range(12):
            total += by_own[a, x] * step[frame[a], x]
        for x in range(len(common_step)):
            total += by_common[a, x] * common_step[x]
        for e in range(starts[a], starts[a + 1]):
            n = entries[e]
            for x in range(12):
                total += by_row[n, x] * step[viewer[n], x]
        out[a] = -total / H_depth[a]


@compiled
def block_sums(blocks, groups, rows, own, cross, couplings, out):
    """The gradient of the frames' unknowns, then of the common ones, from some blocks of images; no depths.

    `own` and `cross` are weighted residuals and derivatives by pose and depth; `groups` the anchors of each block, its
    rows, and the rows of each anchor.
    """
    own_first, own_entries, cross_first, cross_entries, row_first, row_entries = groups
    anchor, frame, viewer = rows
    r_own, J_own, d_own = own
    r_cross, J_cross, d_cross = cross
    common = out.shape[1] - couplings[2].shape[1]
    for k in range(len(blocks)):
        g = out[k]
        for e in range(own_first[blocks[k]], own_first[blocks[k] + 1]):
            a = own_entries[e]
            pull = 0.0
            for c in range(2):
                r = r_own[a, c]
                pull += d_own[a, c] * r
                _add_scaled(g, 12 * frame[a] + 6, r, J_own[a, c], 0, 6)
                _add_scaled(g, common, r, J_own[a, c], 6, out.shape[1] - common)
            _through_depth(g, a, pull, row_first, row_entries, frame, viewer, couplings, common)
        for e in range(cross_first[blocks[k]], cross_first[blocks[k] + 1]):
            n = cross_entries[e]
            a, pull = anchor[n], 0.0
            for c in range(2):
                r = r_cross[n, c]
                if r != 0:  # weight zero: the derivatives mean nothing
                    pull += d_cross[n, c] * r
                    _add_scaled(g, 12 * frame[a], r, J_cross[n, c], 0, 6)
                    _add_scaled(g, 12 * viewer[n], r, J_cross[n, c], 6, 12)
                    _add_scaled(g, common, r, J_cross[n, c], 18, out.shape[1] - common)
            _through_depth(g, a, pull, row_first, row_entries, frame, viewer, couplings, common)


@compiled
def _add_scaled(g, at, r, J, first, count):
    for x in range(count):
        g[at + x] += r * J[first + x]


@compiled
def _through_depth(g, a, pull, row_first, row_entries, frame, viewer, couplings, common):
    """Add to the gradient what a pull on the depth of an anchor does to it."""
    by_own, by_row, by_common, H_depth, _ = couplings
    scale = -pull / H_depth[a]
    _add_scaled(g, 12 * frame[a], scale, by_own[a], 0, 12)
    _add_scaled(g, common, scale, by_common[a], 0, by_common.shape[1])
    for e in range(row_first[a], row_first[a + 1]):
        n = row_entries[e]
        _add_scaled(g, 12 * viewer[n], scale, by_row[n], 0, 12)


Sums = tuple[ndarray, ndarray, ndarray, ndarray]
"""Residuals, derivatives by pose, derivatives by depth, weights."""


@dataclass(frozen=True)
class DepthCouplings:
    """The parts of the normal matrix that couple depths with other unknowns, and the depths' own."""

    by_own: Float64[ndarray, "anchors 12"]  # with the frame of the anchor
    by_row: Float64[ndarray, "rows 12"]  # with a frame that sees it
    by_common: Float64[ndarray, "anchors common"]
    H: Float64[ndarray, "anchors"]
    g: Float64[ndarray, "anchors"]
    rows: Groups  # of each anchor
    frame: Int[ndarray, "anchors"]
    viewer: Int[ndarray, "rows"]

    @property
    def arrays(self) -> tuple[ndarray, ndarray, ndarray, ndarray, ndarray]:
        """The parts for compiled loops."""
        return self.by_own, self.by_row, self.by_common, self.H, self.g

    def step(
        self, step: Float64[ndarray, "frames 12"], common: Float64[ndarray, "common"], g: Float64[ndarray, "anchors"]
    ) -> Float64[ndarray, "anchors"]:
        """Changes of the depths that follow from a step of the other unknowns, with `g` as the depths' gradient."""
        out, (by_own, by_row, by_common, H, _) = np.empty(len(self.H)), self.arrays
        couplings = by_own, by_row, by_common, H, g
        depth_steps(
            len(out), (self.rows.first, self.rows.entries), self.frame, self.viewer, couplings, step, common, out
        )
        return out


@dataclass(frozen=True)
class NormalEquations:
    """Gauss-Newton equations of all unknowns except the depths, which are eliminated.

    Unknowns of a frame are delta, then rho; some unknowns may be common to all frames. What couples different frames is
    not stored: `matrix` sums it, `times` multiplies with it.
    """

    chosen: Int[ndarray, "m"]  # the frames whose equations these are, in order
    H: Float[Tensor, "m 12 12"]  # blocks on the diagonal of the normal matrix
    g: Float[Tensor, "m 12"]
    border: Float[Tensor, "m 12 common"]
    H_common: Float[Tensor, "common common"]
    g_common: Float[Tensor, "common"]
    rows: tuple[ndarray, ndarray, ndarray]  # anchor of each row, its frame, the frame that sees it
    groups: tuple[ndarray, ...]  # anchors and rows of each frame, rows of each anchor
    own: Sums
    cross: Sums
    depths: DepthCouplings

    def matrix(
        self, prior: Float[Tensor, "m 12 12"], common: Float[Tensor, "common"]
    ) -> Float[Tensor, "unknowns unknowns"]:
        """The whole normal matrix, unknowns common to all frames last.

        Information about each frame alone is added, and `common` to the diagonal of the others.
        """
        m, frames, more = len(self.chosen), len(self.groups[0]) - 1, len(common)
        slot = np.full(frames, -1)
        slot[self.chosen] = np.arange(m)
        H = np.zeros((12 * m + more, 12 * m + more))
        if m > 1:
            pair_sums(m, self.chosen, slot, self.groups, self.rows, self.cross, self.depths.arrays, H)
            mirror(m, H)
        out, first = torch.from_numpy(H), 12 * m
        for k, block in enumerate(self.H + prior):
            out[12 * k : 12 * k + 12, 12 * k : 12 * k + 12] = block
        out[:first, first:] = self.border.flatten(0, 1)
        out[first:, :first] = out[:first, first:].T
        out[first:, first:] = self.H_common + common.diag()
        return out

    def times(self, step: Float[Tensor, "frames 12"]) -> Float[Tensor, "frames 12"]:
        """The normal matrix of all frames times a step."""
        x, (anchor, source, viewer), d = array(step), self.rows, self.depths
        by_rows, out = np.empty((len(anchor), 2)), np.empty(x.shape)
        row_products(len(anchor), source, viewer, self.cross, x, by_rows)
        change = d.step(x, np.zeros(0), np.zeros(len(d.g)))
        frame_products(len(x), self.groups, anchor, self.own, self.cross, d.arrays, x, by_rows, change, out)
        return torch.from_numpy(out)

    def depth_step(self, step: Float[Tensor, "frames 12"]) -> Float[Tensor, "anchors"]:
        """Change of the depths that follows from a step of the poses."""
        return torch.from_numpy(self.depths.step(array(step), np.zeros(0), self.depths.g))


def normal_equations(
    linear: Linearisation,
    observations: Observations,
    own_weight: Float[Tensor, "anchors"],
    cross_weight: Float[Tensor, "rows"],
    chosen: Int[Tensor, "m"] | None = None,
) -> NormalEquations:
    """Weighted normal equations with the Schur complement of the depths; of all frames, or of some that are chosen."""
    frames, common = linear.frames, linear.common
    r = linear.residuals
    own: Sums = (array(r.own), array(linear.own), array(linear.own_depth), array(own_weight))
    cross: Sums = (array(r.cross), array(linear.cross), array(linear.cross_depth), array(cross_weight))
    anchor, frame = array(observations.anchor), array(linear.own_frame)
    source, viewer = (array(part) for part in linear.cross_frames)
    rows, n = Groups.of(anchor, len(frame)), len(frame)
    couplings = np.zeros((n, 12)), np.zeros((len(viewer), 12)), np.zeros((n, common)), np.zeros(n), np.zeros(n)
    depth_couplings(n, (rows.first, rows.entries), own, cross, *couplings)
    depths = DepthCouplings(*couplings, rows, frame, viewer)
    frame_of = np.arange(frames) if chosen is None else array(chosen)
    grouped = Groups.of(frame, frames), Groups.of(viewer, frames), depths.rows
    groups = tuple(part for group in grouped for part in (group.first, group.entries))
    m = len(frame_of)
    H, g, border = np.zeros((m, 12, 12)), np.zeros((m, 12)), np.zeros((m, 12, common))
    frame_sums(m, frame_of, groups, anchor, own, cross, depths.arrays, H, g, border)
    H_common, g_common = _of_common(own, cross, depths)
    return NormalEquations(
        frame_of, torch.from_numpy(H), torch.from_numpy(g), torch.from_numpy(border), torch.from_numpy(H_common),
        torch.from_numpy(g_common), (anchor, source, viewer), groups, own, cross, depths,
    )  # fmt: skip


def _of_common(
    own: Sums, cross: Sums, depths: DepthCouplings
) -> tuple[Float64[ndarray, "common common"], Float64[ndarray, "common"]]:
    """The equations of the unknowns that all frames share."""
    common = depths.by_common.shape[1]
    H, g = np.zeros((common, common)), np.zeros(common)
    if common:
        for (r, J, _, w), first in ((own, 6), (cross, 18)):
            shared = J[:, :, first:].reshape(-1, common)
            weighted = np.repeat(w, 2)[:, None] * shared
            H += weighted.T @ shared
            g += weighted.T @ r.reshape(-1)
        scaled = depths.by_common / depths.H[:, None]
        H -= scaled.T @ depths.by_common
        g -= scaled.T @ depths.g
    return H, g

"""Sums of the normal equations, in compiled loops: each frame gathers what belongs to its own rows of the matrix.

So no two threads write to the same place, and sums do not depend on the number of threads. Unknowns of a frame are its
delta and its rho (12); those common to all frames come after all others.
"""

from sl_nerfstudio.bundle_adjustment.loops.vectors import add_6, add_12
from sl_nerfstudio.compiled import compiled, compiled_range


@compiled_range
def depth_couplings(first, last, by_anchor, own, cross, depth_by_own, depth_by_row, depth_by_common, H_depth, g_depth):
    """What couples the depth of each anchor with the unknowns of its own frame, of those that see it, and of all.

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
    """The same for the columns `second` and later of J, which are those of the common unknowns."""
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
    """What the elimination of a depth takes from a frame's own block, its gradient and its common columns."""
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
    """What a pull on the depth of an anchor does to the gradient."""
    by_own, by_row, by_common, H_depth, _ = couplings
    scale = -pull / H_depth[a]
    _add_scaled(g, 12 * frame[a], scale, by_own[a], 0, 12)
    _add_scaled(g, common, scale, by_common[a], 0, by_common.shape[1])
    for e in range(row_first[a], row_first[a + 1]):
        n = row_entries[e]
        _add_scaled(g, 12 * viewer[n], scale, by_row[n], 0, 12)

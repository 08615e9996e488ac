"""The derived case table: complete, closed over faces, and oriented."""

from itertools import product

import numpy as np

from sl_nerfstudio.meshing.extract import EDGE_CORNERS, FACE_CORNERS, triangle_table

POSITION = np.array([[c & 1, c >> 1 & 1, c >> 2 & 1] for c in range(8)], dtype=float)
MIDDLE = np.array([POSITION[list(pair)].mean(0) for pair in EDGE_CORNERS])


def directed_edges(case: int) -> list[tuple[int, int]]:
    table, count = triangle_table()
    triangles = table[case, : count[case]].tolist()
    return [(t[i], t[(i + 1) % 3]) for t in triangles for i in range(3)]


def border(case: int) -> set[tuple[int, int]]:
    edges = directed_edges(case)
    assert len(edges) == len(set(edges))
    return {e for e in edges if e[::-1] not in edges}


def test_every_case_uses_exactly_the_edges_whose_ends_differ():
    table, count = triangle_table()
    for case in range(256):
        cut = {e for e, (a, b) in enumerate(EDGE_CORNERS) if (case >> a & 1) != (case >> b & 1)}
        assert set(table[case, : count[case]].ravel().tolist()) == cut
        assert (table[case, count[case] :] == -1).all()


def test_the_border_of_each_case_lies_in_the_faces_of_the_cell():
    for case in range(256):
        for a, b in border(case):
            shared = [f for f in FACE_CORNERS if {*EDGE_CORNERS[a], *EDGE_CORNERS[b]} <= set(f)]
            assert len(shared) == 1, case


def test_inner_edges_never_lie_in_a_face_so_no_neighbour_can_draw_them_too():
    for case in range(256):
        for a, b in set(directed_edges(case)) - border(case):
            assert not any({*EDGE_CORNERS[a], *EDGE_CORNERS[b]} <= set(f) for f in FACE_CORNERS), case


def test_two_cells_draw_opposite_segments_on_their_common_face():
    """All sign patterns of two cells that share a face along each axis: their borders cancel there."""
    for axis, low, high in product(range(3), range(256), range(256)):
        step = 1 << axis
        upper = [c for c in range(8) if c & step]
        if any((low >> c & 1) != (high >> (c - step) & 1) for c in upper):
            continue
        mine = {(a, b) for a, b in border(low) if _on(a, upper) and _on(b, upper)}
        theirs = {(_moved(a, step), _moved(b, step)) for a, b in border(high) if _on_low(a, step) and _on_low(b, step)}
        assert mine == {(b, a) for a, b in theirs}


def test_normals_point_from_negative_to_positive():
    """For one cut-off corner and every half cell: the area vector leans from negative to positive corners."""
    table, count = triangle_table()
    for case in [1 << c for c in range(8)] + [255 - (1 << c) for c in range(8)] + [0x0F, 0xF0, 0x33, 0xCC, 0x55, 0xAA]:
        corners = MIDDLE[table[case, : count[case]]]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
        inside = np.array([bool(case >> c & 1) for c in range(8)])
        assert area @ (POSITION[~inside].mean(0) - POSITION[inside].mean(0)) > 0, case


def _on(edge: int, corners: list[int]) -> bool:
    return set(EDGE_CORNERS[edge]) <= set(corners)


def _on_low(edge: int, step: int) -> bool:
    return not any(c & step for c in EDGE_CORNERS[edge])


def _moved(edge: int, step: int) -> int:
    a, b = EDGE_CORNERS[edge]
    return EDGE_CORNERS.index((a + step, b + step))

"""A graph of frames whose edges are similarities between pairs: global placement, and which edges are wrong.

Edges that contradict the rest are kept from doing harm twice over: the optimisation starts from that spanning tree with
which most other edges agree, and its Geman-McClure kernel starts wide and narrows (Yang et al., RA-L 2020).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy import ndarray
from scipy.spatial.transform import Rotation

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.pair_registration import PairMatch

_LOOP_DEG, _LOOP_SHIFT, _LOOP_SCALE = 6.0, 0.15, 0.15  # how far three edges may fail to close
_WIDTH2 = (
    40.0  # chi square (7 degrees of freedom) at which an edge counts a quarter: edges' errors are not quite normal
)
_WIDEST = 30.0  # times that, to begin with: the tree's drift must be within it, wrong pairs should be beyond
_TREES = 20  # from which the optimisation might start: one with a wrong pair in it would lead it astray
_ITERATIONS = 40
_WRONG = 4.0  # chi square over _WIDTH2, beyond which an edge is given up


@dataclass(frozen=True)
class Anchoring:
    """Of every frame, the point about which it turns and the length that a radian of turn counts as."""

    centre: Float64[ndarray, "n 3"]  # camera axes, units of the frame's baseline
    radius: Float64[ndarray, "n"]


@dataclass(frozen=True)
class Placement:
    """Where frames stand: `S_world_camera`, None for frames that no edge connects to the first placed one."""

    S_world_camera: list[Similarity | None]
    used: Bool[ndarray, "edges"]  # edges that agree with the placement
    chi2: Float64[ndarray, "edges"]  # infinite where an end is not placed


def at(nodes: Sequence[Similarity | None], k: int) -> Similarity:
    """The place of a frame. Raises ValueError where it has none."""
    S = nodes[k]
    if S is None:
        raise ValueError(f"frame {k} is not placed")
    return S


def loop_support(
    edges: Sequence[PairMatch], anchoring: Anchoring, trust: Float64[ndarray, "edges"]
) -> Float64[ndarray, "edges"]:
    """For every edge the number of triangles it closes, less those it fails to close; each as good as its others."""
    by_pair = {frozenset((e.source, e.target)): k for k, e in enumerate(edges)}
    support = np.zeros(len(edges))
    for k, e in enumerate(edges):
        for third in {n for pair in by_pair for n in pair} - {e.source, e.target}:
            a, b = by_pair.get(frozenset((e.source, third))), by_pair.get(frozenset((third, e.target)))
            if a is None or b is None:
                continue
            around = oriented(edges[b], third, e.target) @ oriented(edges[a], e.source, third)
            closes = _close(around, e.S_target_source, e.target, anchoring)
            support[k] += trust[a] * trust[b] * (1 if closes else -1)
    return support


def oriented(edge: PairMatch, source: int, target: int) -> Similarity:
    """The edge's similarity from `source` to `target`, whichever way it was found."""
    return edge.S_target_source if (edge.source, edge.target) == (source, target) else edge.S_target_source.inverse()


def _close(a: Similarity, b: Similarity, target: int, anchoring: Anchoring) -> bool:
    D = a @ b.inverse()
    c, radius = anchoring.centre[target], anchoring.radius[target]
    angle = np.degrees(Rotation.from_matrix(D.R).magnitude())
    shift = np.linalg.norm(D.points(c[None])[0] - c) / radius
    return bool(angle < _LOOP_DEG and shift < _LOOP_SHIFT and abs(np.log(D.scale)) < _LOOP_SCALE)


def place(
    edges: Sequence[PairMatch],
    anchoring: Anchoring,
    root: int,
    strength: Float64[ndarray, "edges"],
    trust: Float64[ndarray, "edges"],
) -> Placement:
    """The spanning tree from `root` that most edges agree with, then all edges together, robustly.

    `strength` is what a tree prefers, `trust` what each edge weighs. The root's similarity is the identity.
    """
    nodes = _best_tree(edges, anchoring, root, strength, trust)
    inside = np.array([nodes[e.source] is not None and nodes[e.target] is not None for e in edges], dtype=bool)
    graph = [e for e, here in zip(edges, inside, strict=True) if here]
    chi2 = np.full(len(edges), np.inf)
    if graph:
        nodes, chi2[inside] = _optimised(graph, nodes, anchoring, root, trust[inside])
    return Placement(nodes, chi2 < _WRONG * _WIDTH2, chi2)


def _best_tree(
    edges: Sequence[PairMatch],
    anchoring: Anchoring,
    root: int,
    strength: Float64[ndarray, "edges"],
    trust: Float64[ndarray, "edges"],
) -> list[Similarity | None]:
    """Of the tree of strongest edges and some others, drawn at random with a preference for strong edges, the best."""
    rng = np.random.default_rng(0)
    best, least = _along_the_tree(edges, len(anchoring.radius), root, strength), np.inf
    for attempt in range(_TREES if len(edges) else 0):
        draw = strength if attempt == 0 else strength + rng.gumbel(0, max(float(strength.std()), 1e-3), len(edges))
        nodes = _along_the_tree(edges, len(anchoring.radius), root, draw)
        graph = [k for k, e in enumerate(edges) if nodes[e.source] is not None and nodes[e.target] is not None]
        errors = [_error(edges[k], nodes, anchoring) for k in graph]
        chi2 = np.array([x @ edges[k].information @ x for x, k in zip(errors, graph, strict=True)])
        cost = float((trust[graph] * chi2 / (chi2 + _WIDEST * _WIDTH2)).sum())
        if cost < least:
            best, least = nodes, cost
    return best


def _along_the_tree(
    edges: Sequence[PairMatch], n: int, root: int, strength: Float64[ndarray, "edges"]
) -> list[Similarity | None]:
    nodes: list[Similarity | None] = [None] * n
    nodes[root] = Similarity.identity()
    while True:
        open_edges = [k for k, e in enumerate(edges) if (nodes[e.source] is None) != (nodes[e.target] is None)]
        if not open_edges:
            return nodes
        e = edges[max(open_edges, key=lambda k: strength[k])]
        known, new = (e.source, e.target) if nodes[e.target] is None else (e.target, e.source)
        nodes[new] = at(nodes, known) @ oriented(e, new, known)


def _optimised(
    edges: Sequence[PairMatch],
    nodes: list[Similarity | None],
    anchoring: Anchoring,
    root: int,
    trust: Float64[ndarray, "edges"],
) -> tuple[list[Similarity | None], Float64[ndarray, "edges"]]:
    """Gauss-Newton; increments of a node act in its own axes, about its centre."""
    placed = [k for k, S in enumerate(nodes) if S is not None]
    column = {k: 7 * c for c, k in enumerate(p for p in placed if p != root)}
    size = 7 * len(column)
    width2 = _WIDEST * _WIDTH2
    chi2 = np.zeros(len(edges))
    for _ in range(_ITERATIONS):
        errors = np.stack([_error(e, nodes, anchoring) for e in edges])
        chi2 = np.array([x @ e.information @ x for x, e in zip(errors, edges, strict=True)])
        H, g = 1e-9 * np.eye(size), np.zeros(size)
        for edge, x, c2, weight in zip(edges, errors, chi2, trust, strict=True):
            W = weight * edge.information / (1 + c2 / width2) ** 2
            parts = [(edge.source, _adjoint(edge, anchoring)), (edge.target, -np.eye(7))]
            for a, J_a in parts:
                if a == root:
                    continue
                g[column[a] : column[a] + 7] += J_a.T @ (W @ x)
                for b, J_b in parts:
                    if b != root:
                        H[column[a] : column[a] + 7, column[b] : column[b] + 7] += J_a.T @ W @ J_b
        step = -np.linalg.solve(H, g) if size else np.zeros(0)
        nodes = list(nodes)
        for k, c in column.items():
            nodes[k] = at(nodes, k) @ _small(step[c : c + 7], anchoring.centre[k], anchoring.radius[k])
        if width2 <= _WIDTH2 and (not size or np.abs(step).max() < 1e-6):
            break
        width2 = max(_WIDTH2, width2 / 1.7)
    errors = [_error(e, nodes, anchoring) for e in edges]
    return nodes, np.array([x @ e.information @ x for x, e in zip(errors, edges, strict=True)])


def _small(x: Float64[ndarray, "7"], centre: Float64[ndarray, "3"], radius: float) -> Similarity:
    """`p -> c + exp(l) exp(w) (p - c) + radius v`."""
    R, scale = Rotation.from_rotvec(x[3:6]).as_matrix(), float(np.exp(np.clip(x[6], -0.5, 0.5)))
    return Similarity(scale, R, centre - scale * R @ centre + radius * x[:3])


def _error(edge: PairMatch, nodes: list[Similarity | None], anchoring: Anchoring) -> Float64[ndarray, "7"]:
    """Increment (v, w, l) in the target's axes, lengths in its radii, by which nodes and edge disagree."""
    D = at(nodes, edge.target).inverse() @ at(nodes, edge.source) @ edge.S_target_source.inverse()
    c = anchoring.centre[edge.target]
    v = (D.points(c[None])[0] - c) / anchoring.radius[edge.target]
    return np.concatenate([v, Rotation.from_matrix(D.R).as_rotvec(), [np.log(D.scale)]])


def _adjoint(edge: PairMatch, anchoring: Anchoring) -> Float64[ndarray, "7 7"]:
    """An increment in the source's axes, as one in the target's."""
    S, radius = edge.S_target_source, anchoring.radius[edge.target]
    lever = (anchoring.centre[edge.target] - S.points(anchoring.centre[edge.source][None])[0]) / radius
    A = np.zeros((7, 7))
    A[:3, :3] = S.scale * S.R * anchoring.radius[edge.source] / radius
    A[:3, 3:6] = -np.cross(lever, S.R.T).T  # (R w) x lever
    A[:3, 6] = lever
    A[3:6, 3:6] = S.R
    A[6, 6] = 1.0
    return A

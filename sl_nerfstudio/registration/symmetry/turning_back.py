"""Blocks of frames that contradict the others are turned to where they do not, if the pairs there confirm it."""

from sl_nerfstudio.geometry.similarity import Similarity
from sl_nerfstudio.registration.assembly import Component
from sl_nerfstudio.registration.graph_residuals import node_at
from sl_nerfstudio.registration.pose_graph import PoseGraphSolution
from sl_nerfstudio.registration.symmetry.judged import Judged, judged
from sl_nerfstudio.registration.symmetry.turned_blocks import TurnedBlock, turned_blocks
from sl_nerfstudio.registration.view_graph import ViewGraph


def turn_blocks_back(graph: ViewGraph) -> None:
    """Register pairs across turned blocks anew, in all components, until no block contradicts the rest of its own."""
    for _ in range(graph.settings.blocks.most_turned):
        if not any(turned_back(graph, component) for component in graph.assemble()):
            return


def turned_back(graph: ViewGraph, component: Component) -> bool:
    """Turn the block of a component back that contradicts most; whether there was one."""
    solution, settings = graph.solve(component), graph.settings
    before = _as_they_are(graph, solution)
    blocks = turned_blocks(graph.sides, graph.holding(component), solution, before, settings)
    for block in blocks[: settings.blocks.most_tried]:
        moved = {k: node_at(solution.S_world_camera, k) for k in component}
        moved |= {k: block.turn @ moved[k] for k in block.frames}
        known = graph.snapshot()
        _register_across(graph, moved, block)
        if _confirmed(graph, moved, before.share):
            return True
        graph.restore(known)
    return False


def _register_across(graph: ViewGraph, moved: Component, block: TurnedBlock) -> None:
    """Set pairs aside that put the block where it was, and register those that now overlap."""
    graph.set_aside(moved, [(i, j) for i in block.frames for j in moved if j not in block.frames])
    graph.try_overlapping([moved.get(k) for k in range(len(graph.maps))])


def _confirmed(graph: ViewGraph, moved: Component, before: float) -> bool:
    """Whether pairs hold all frames together where they are now, and less contradicts."""
    solution = graph.solve(moved)
    if not graph.connected(moved, solution.consistent):
        return False
    return _as_they_are(graph, solution).share < graph.settings.blocks.least_improvement * before


def _as_they_are(graph: ViewGraph, solution: PoseGraphSolution) -> Judged:
    """How the frames of a solution agree and contradict each other."""
    neighbours = graph.settings.blocks.neighbours
    return judged(graph.sides, solution.S_world_camera, Similarity.identity(), neighbours, graph.settings)

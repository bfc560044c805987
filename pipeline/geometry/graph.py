"""Which pairs of views hold a scene together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

#: Two views, by number.
Pair = tuple[int, int]
Node = TypeVar("Node", int, str)


def spanning_forest(edges: Sequence[tuple[Node, Node, float]]) -> list[list[int]]:
    """Maximum spanning forest (Kruskal); of equal edges the one whose ends sort first is taken.

    Args:
        edges: (node, node, weight); edges of no weight join nothing.

    Returns:
        For each tree, the numbers of its edges, best first; the tree with most edges first.
    """
    parent: dict[Node, Node] = {node: node for a, b, _ in edges for node in (a, b)}

    def root(node: Node) -> Node:
        while parent[node] != node:
            node = parent[node]
        return node

    used: list[int] = []
    for k in sorted(range(len(edges)), key=lambda k: (-edges[k][2], edges[k][:2])):
        a, b = root(edges[k][0]), root(edges[k][1])
        if a != b and edges[k][2] > 0:
            parent[max(a, b)] = min(a, b)
            used.append(k)
    trees: dict[Node, list[int]] = {}
    for k in used:
        trees.setdefault(root(edges[k][0]), []).append(k)
    return sorted(trees.values(), key=lambda tree: (-len(tree), -edges[tree[0]][2]))


def spanning_pairs(weights: Mapping[Pair, float]) -> list[Pair]:
    """The pairs of all trees of the maximum spanning forest, heaviest first."""
    pairs = sorted(weights, key=lambda pair: (-weights[pair], pair))
    trees = spanning_forest([(*pair, weights[pair]) for pair in pairs])
    return [pairs[k] for k in sorted(k for tree in trees for k in tree)]

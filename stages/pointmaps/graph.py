"""Which pairs of views get a pointmap."""

from __future__ import annotations

import itertools

from pipeline.errors import RequestError, nearest

GRAPHS = ("complete", "window", "star")


def choose_graph(
    graph: str, view_count: int, ordered: bool, multi_view: bool, complete_up_to: int
) -> str:
    """Resolve "auto".

    Pairwise models: all pairs of a few views; of more, a window where the order is known, else a
    star. A multi-view model has put all views into one frame already, so that pairs only carry its
    answer: as few as connect them.

    Raises:
        RequestError: no such graph.
    """
    if graph != "auto":
        if graph not in GRAPHS:
            allowed = ("auto", *GRAPHS)
            raise RequestError(
                f"There is no scene graph '{graph}'; choose one of {', '.join(allowed)}."
                + nearest(graph, allowed)
            )
        return graph
    if not multi_view and view_count <= complete_up_to:
        return "complete"
    return "window" if ordered else "star"


def scene_pairs(
    graph: str, view_count: int, window: int, reference: int | None, symmetric: bool
) -> list[tuple[int, int]]:
    """Pairs (i, j) of view numbers, sorted; with `symmetric` each in both orders.

    Args:
        graph: "complete", "window" or "star".
        view_count: how many views there are.
        window: how many next views each view is paired with.
        reference: number of the view that a star is around; None: the middle one.

    Raises:
        RequestError: the reference is no view.
    """
    if graph == "complete":
        pairs = list(itertools.combinations(range(view_count), 2))
    elif graph == "window":
        pairs = [
            (i, j)
            for i in range(view_count)
            for j in range(i + 1, min(i + window, view_count - 1) + 1)
        ]
    else:
        centre = view_count // 2 if reference is None else reference
        if not 0 <= centre < view_count:
            raise RequestError(
                f"The star's reference is view {centre}, but the {view_count} views are numbered "
                f"0 to {view_count - 1}."
            )
        pairs = [(centre, j) for j in range(view_count) if j != centre]
    if symmetric:
        pairs += [(j, i) for i, j in pairs]
    return sorted(pairs)

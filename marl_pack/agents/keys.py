"""The keys by which heuristics rank placements, and the names of all players that need no file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from marl_pack.agents.afterstates.limits import MOST_LENGTHS

if TYPE_CHECKING:
    from torch import Tensor

    from marl_pack.agents.candidates import Candidates

Keys = Sequence[tuple["Tensor", int]]
"""Keys of all placements: whole numbers that broadcast to [G, 6, W, D], each with a larger bound.

The placement with the lowest first key is the best; the next keys break ties."""


def dblf(c: Candidates) -> Keys:
    """Deepest, bottom, left (Karabulut & İnceoğlu 2004): lowest z, then x, then y."""
    return (c.z, c.size[2] + 1), (c.x, c.size[0]), (c.y, c.size[1])


def height_min(c: Candidates) -> Keys:
    """Heightmap minimisation (Wang & Hauser 2021): least c · (x + y) + sum of the new heightmap.

    With a small c, as in the paper, the sum decides and x + y breaks ties. The item's volume is the
    same everywhere, so the sum is least where the item encloses the fewest empty cells.
    """
    width, depth, height = c.size
    return (c.waste, width * depth * height), (c.x + c.y, width + depth)


def best_fit(c: Candidates) -> Keys:
    """Best fit by wasted space: fewest empty cells enclosed, then the lowest top, then x + y."""
    width, depth, height = c.size
    return (c.waste, width * depth * height), (c.top, height + 1), (c.x + c.y, width + depth)


def max_feasible(c: Candidates) -> Keys:
    """Most feasible cells after the placement (:meth:`Lookahead.feasible_cells`), then top, x + y.

    The first key is the mean number of cells where a box that may come next could be placed. The
    lowest top, then the lowest x + y break ties.
    """
    width, depth, height = c.size
    most = width * depth * MOST_LENGTHS**3
    cells = (c.feasible_cells.double() * MOST_LENGTHS**3).round().long()
    return (most - cells, most + 1), (c.top, height + 1), (c.x + c.y, width + depth)


def as_cut(c: Candidates) -> Keys:
    """Place the pieces of generated cuts where they were cut; place other items as :func:`dblf`.

    With the items ``cut1`` and ``cut2`` this fills the whole bin. No agent that sees only the
    visible item can do so; it is a teacher for such agents.
    """
    return (c.elsewhere, 2), *dblf(c)


KEYS: dict[str, Callable[[Candidates], Keys]] = {
    "dblf": dblf,
    "height_min": height_min,
    "best_fit": best_fit,
    "max_feasible": max_feasible,
    "as_cut": as_cut,
}
"""The keys of every heuristic, by its name."""

POLICIES = (*KEYS, "random")
"""Names of :func:`marl_pack.agents.heuristics.make_policy`, and of ``make_placement_agent``."""

ORIENTATION_AGENTS = (*POLICIES, "first")
"""The heuristics that can play the orientation agent, by name."""

SELECTION_AGENTS = (*POLICIES, "first")
"""The heuristics that can play the selection agent, by name; first takes the first legal option."""
GREEDY_VALUE = "greedy_value"
"""The selection agent that takes the option whose best placement gains most by a critic of
afterstates. Checkpoints have this name where a model without a selection agent plays it."""

"""Heuristics, each of which scores every legal placement and takes the lowest score.

All use the same masks as the learned agents, so their packings are as stable. If the keys of two
placements are equal, the first orientation is taken, then the first cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from marl_pack import renamed
from marl_pack.agents.afterstates.afterstates import MOST_LENGTHS
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.policy import (
    OrientationAgent,
    Placement,
    PlacementAgent,
    Policy,
    draw,
    in_turns,
)
from marl_pack.checks import LARGEST_SEED, shown, whole_number
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.geometry import resting_heights_and_waste

Keys = Sequence[tuple[Tensor, int]]
"""Whole numbers broadcastable to [G, 6, W, D], each with a bound that is larger; the first key
decides, the next ones break ties."""


class Candidates:
    """Every placement of each visible item, legal or not; tensors broadcast to [G, 6, W, D].

    Args:
        game: the games.
        lookahead: what placements leave.
    """

    def __init__(self, game: Packing, lookahead: Lookahead) -> None:
        self.game, self.lookahead = game, lookahead
        self.size = game.size
        self.sides = game.orient_item(game.items).sides  # int16 [G, 6, 3]
        self.x = torch.arange(game.size[0], device=game.device)[:, None]  # int64 [W, 1]
        self.y = torch.arange(game.size[1], device=game.device)[None, :]  # int64 [1, D]

    def _windows(self, waste: bool) -> tuple[Tensor, Tensor]:
        bins = self.game.bins
        return resting_heights_and_waste(
            bins.heightmap, self.sides, bins.height, waste=waste, backend=bins.backend
        )

    @cached_property
    def _both(self) -> tuple[Tensor, Tensor]:
        """Resting heights and wasted cells of every placement, computed together."""
        return self._windows(waste=True)

    @cached_property
    def z(self) -> Tensor:
        """Resting heights, int64 [G, 6, W, D]."""
        if "_both" in vars(self):
            return self._both[0].long()
        return self._windows(waste=False)[0].long()

    @cached_property
    def waste(self) -> Tensor:
        """Empty cells that would be enclosed below the item, int64 [G, 6, W, D]."""
        return self._both[1].long()

    @cached_property
    def top(self) -> Tensor:
        """Heights of the item's top, at most H, int64 [G, 6, W, D]."""
        return (self.z + self.sides[..., 2, None, None]).clamp(max=self.size[2])

    @cached_property
    def feasible_cells(self) -> Tensor:
        """Mean number of cells left for a box that may come, float32 [G, 6, W, D]."""
        return self.lookahead.feasible_cells(self.game)


@dataclass(frozen=True)
class Heuristic:
    """A policy that takes the legal placement with the lowest keys.

    Args:
        keys: the placements' keys.
    """

    keys: Callable[[Candidates], Keys]

    def __call__(
        self, game: Packing, legal: Moves | None = None, lookahead: Lookahead | None = None
    ) -> Placement:
        """Return orientation and cell of the best placement, int64 [G] each.

        Args:
            game: the games.
            legal: the moves to choose among; all legal ones by default.
            lookahead: what placements leave; computed if not given.
        """
        rank = torch.zeros_like(game.mask, dtype=torch.int64)
        for value, bound in self.keys(Candidates(game, lookahead or Lookahead())):
            rank = rank * bound + value
        return (legal or game.moves).least(rank)


def _dblf(c: Candidates) -> Keys:
    """Deepest, bottom, left (Karabulut & İnceoğlu 2004): lowest z, then x, then y."""
    return (c.z, c.size[2] + 1), (c.x, c.size[0]), (c.y, c.size[1])


def _height_min(c: Candidates) -> Keys:
    """Heightmap minimisation (Wang & Hauser 2021): least c · (x + y) + sum of the new heightmap.

    With a small c, as in the paper, the sum decides and x + y breaks ties. As the item's volume is
    the same everywhere, the sum is least where least space is enclosed.
    """
    width, depth, height = c.size
    return (c.waste, width * depth * height), (c.x + c.y, width + depth)


def _best_fit(c: Candidates) -> Keys:
    """Best fit by wasted space: fewest empty cells enclosed, then the lowest top, then x + y."""
    width, depth, height = c.size
    return (c.waste, width * depth * height), (c.top, height + 1), (c.x + c.y, width + depth)


def _max_feasible(c: Candidates) -> Keys:
    """Most feasible cells afterwards (:meth:`Lookahead.feasible_cells`), then top, then x + y.

    Greatest mean number of cells where a box that may come next could be placed, then the lowest
    top, then the lowest x + y.
    """
    width, depth, height = c.size
    most = width * depth * MOST_LENGTHS**3
    cells = (c.feasible_cells.double() * MOST_LENGTHS**3).round().long()
    return (most - cells, most + 1), (c.top, height + 1), (c.x + c.y, width + depth)


dblf = Heuristic(_dblf)
height_min = Heuristic(_height_min)
best_fit = Heuristic(_best_fit)
max_feasible = Heuristic(_max_feasible)

HEURISTICS: dict[str, Heuristic] = {
    "dblf": dblf,
    "height_min": height_min,
    "best_fit": best_fit,
    "max_feasible": max_feasible,
}
"""Every heuristic by its name."""

POLICIES = (*HEURISTICS, "random")
"""Names of :func:`make_policy`, and of :func:`make_placement_agent`."""

ORIENTATION_AGENTS = (*POLICIES, "first")
"""Names of :func:`make_orientation_agent`."""


def make_policy(name: str, seed: int | None = 0, device: torch.device | str = "cpu") -> Policy:
    """Return the policy called ``name``, for games on ``device``.

    Args:
        name: a heuristic, or ``random``: uniform among the legal orientations, then uniform among
            the cells of the chosen one.
        seed: of random play; None draws from torch's global generator.
        device: of the games.

    Raises:
        ValueError: for an unknown name or an impossible seed.
    """
    if not isinstance(name, str) or name not in POLICIES:
        raise _unknown("policy", name, POLICIES)
    if name in HEURISTICS:
        return HEURISTICS[name]
    generator = _generator(seed, device)
    return in_turns(
        lambda game: draw(game.orientation_mask, generator),
        lambda game, orientation: draw(game.moves.of(orientation).flatten(1), generator),
    )


def make_orientation_agent(
    name: str,
    seed: int | None = 0,
    device: torch.device | str = "cpu",
    lookahead: Lookahead | None = None,
) -> OrientationAgent:
    """Return the orientation agent called ``name``: a heuristic, ``random`` or ``first``.

    ``first`` leaves the item as it comes (orientation 0), or takes the first orientation that may
    be chosen if orientation 0 may not. Arguments as :func:`make_policy`; ``lookahead`` is shared
    with the other agent.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "first":
        return lambda game: game.orientation_mask.int().argmax(1)
    if name == "random":
        generator = _generator(seed, device)
        return lambda game: draw(game.orientation_mask, generator)
    if name in HEURISTICS:
        heuristic = HEURISTICS[name]
        return lambda game: heuristic(game, None, lookahead)[0]
    raise _unknown("orientation agent", name, ORIENTATION_AGENTS)


def make_placement_agent(
    name: str,
    seed: int | None = 0,
    device: torch.device | str = "cpu",
    lookahead: Lookahead | None = None,
) -> PlacementAgent:
    """Return the placement agent called ``name``: ``random``, or a heuristic in one orientation.

    Arguments as :func:`make_orientation_agent`.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "random":
        generator = _generator(seed, device)
        return lambda game, orientation: draw(game.moves.of(orientation).flatten(1), generator)
    if name in HEURISTICS:
        heuristic = HEURISTICS[name]
        return lambda game, orientation: heuristic(game, game.moves.only(orientation), lookahead)[1]
    raise _unknown("placement agent", name, POLICIES)


def _unknown(kind: str, name: str, names: Sequence[str]) -> ValueError:
    if isinstance(name, str) and name in renamed.POLICIES:
        return ValueError(f"{kind} {name!r} is now called {renamed.POLICIES[name]!r}")
    return ValueError(f"unknown {kind} {shown(name)}: one of {', '.join(names)}")


def _generator(seed: int | None, device: torch.device | str) -> torch.Generator | None:
    if seed is None:
        return None
    return torch.Generator(device).manual_seed(whole_number(seed, "seed", 0, LARGEST_SEED))

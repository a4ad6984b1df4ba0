"""Heuristics: policies that rank the legal placements by keys and take the lowest.

They use the same masks as the learned agents, so their packings are as stable. If placements have
equal keys, a heuristic takes the first orientation, then the first cell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from marl_pack import renamed
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.candidates import Candidates
from marl_pack.agents.keys import KEYS, ORIENTATION_AGENTS, POLICIES, Keys
from marl_pack.agents.policy import (
    InTurns,
    OrientationAgent,
    Placement,
    PlacementAgent,
    Policy,
    Reasons,
    draw,
    draw_placement,
)
from marl_pack.checks import LARGEST_SEED, shown, whole_number
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing


@dataclass(frozen=True)
class Heuristic:
    """A policy that takes the legal placement with the lowest keys.

    Args:
        keys: computes the keys of all placements.
    """

    keys: Callable[[Candidates], Keys]

    def __call__(
        self, game: Packing, legal: Moves | None = None, lookahead: Lookahead | None = None
    ) -> Placement:
        """Return orientation and cell of the best placement, int64 [G] each.

        Args:
            game: the games.
            legal: the moves to choose among; all legal moves by default.
            lookahead: computes the afterstates; a new one by default.
        """
        return (legal or game.moves).least(self.rank(game, lookahead))

    def rank(self, game: Packing, lookahead: Lookahead | None = None) -> Tensor:
        """Compute the keys as one number, int64 [G, 6, W, D]; the lowest is the best."""
        rank = torch.zeros_like(game.mask, dtype=torch.int64)
        for value, bound in self.keys(Candidates(game, lookahead or Lookahead())):
            rank = rank * bound + value
        return rank

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return the order of the placements (:class:`marl_pack.agents.policy.Explained`)."""
        rank = self.rank(game)
        values = torch.full(rank.shape, torch.nan, dtype=torch.float64, device=rank.device)
        for g in range(game.n):
            legal = game.mask[g]
            values[g][legal] = -torch.unique(rank[g][legal], return_inverse=True)[1].double()
        return Reasons(values=values, value_of="rank, 0 is the best")


@dataclass(frozen=True)
class RandomPlay(InTurns):
    """Two agents that choose at random; both choices of a turn are drawn in one call.

    Args:
        generator: of random numbers; torch's global generator by default.
    """

    generator: torch.Generator | None = None

    def __call__(self, game: Packing) -> Placement:
        """Return orientation and cell of each game, int64 [G] each."""
        return draw_placement(game, self.generator)


HEURISTICS: dict[str, Heuristic] = {name: Heuristic(keys) for name, keys in KEYS.items()}
"""Every heuristic by its name."""


def make_policy(name: str, seed: int | None = 0, device: torch.device | str = "cpu") -> Policy:
    """Return the policy called ``name``, for games on ``device``.

    Args:
        name: a heuristic, or ``random``: it draws one of the legal orientations uniformly, then
            one of the legal cells for this orientation.
        seed: the seed of random choices; with None they come from torch's global generator.
        device: the device of the games.

    Raises:
        ValueError: for an unknown name or an impossible seed.
    """
    if not isinstance(name, str) or name not in POLICIES:
        raise _unknown("policy", name, POLICIES)
    if name in HEURISTICS:
        return HEURISTICS[name]
    generator = _generator(seed, device)
    return RandomPlay(
        lambda game: draw(game.orientation_mask, generator),
        lambda game, orientation: draw(game.mask, generator, orientation),
        generator,
    )


def make_orientation_agent(
    name: str,
    seed: int | None = 0,
    device: torch.device | str = "cpu",
    lookahead: Lookahead | None = None,
) -> OrientationAgent:
    """Return the orientation agent called ``name``: a heuristic, ``random`` or ``first``.

    ``first`` does not rotate the item (orientation 0). If orientation 0 is not legal, it takes
    the first legal orientation. The arguments are those of :func:`make_policy`, and ``lookahead``,
    which computes afterstates and may be shared with the other agent.

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

    The arguments are those of :func:`make_orientation_agent`.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "random":
        generator = _generator(seed, device)
        return lambda game, orientation: draw(game.mask, generator, orientation)
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

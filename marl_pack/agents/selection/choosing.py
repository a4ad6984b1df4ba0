"""Make a policy for games with selection from a policy for one box and one bin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.heuristics import Heuristic, RandomPlay, make_policy
from marl_pack.agents.policy import Policy
from marl_pack.agents.search import Planner
from marl_pack.agents.selection.beam import Beam
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.one_box import OneBoxSearch
from marl_pack.agents.selection.policies import (
    GreedyValue,
    RandomSelection,
    RankedSelection,
    SelectAs,
    SelectFirst,
    SelectionAgent,
    SelectionPlacement,
    SelectionPolicy,
    first_option,
)
from marl_pack.game.selection import SelectionPacking

AGENTS = ("placement_agent", "orientation_agent", "agent")
"""Attributes of policies that hold learned agents."""


def selection_policy_of(policy: Policy, search: BeamSettings | None = None) -> SelectionPolicy:
    """Return a policy for :class:`marl_pack.game.selection.SelectionPacking`.

    A heuristic takes the best placement in any option, random play draws an option first. Learned
    agents take the placement that gains most by their critic of afterstates, or search with it. A
    function of the user's is returned as it is.

    Args:
        policy: a policy for games of one box and one bin, or a function of the user's.
        search: how far to search among the known boxes; None for no search.

    Raises:
        ValueError: if the policy cannot play such games, or cannot search.
    """
    if isinstance(policy, SelectFirst) and search is None:
        return policy
    if isinstance(policy, SelectFirst):
        policy = policy.policy
    if isinstance(policy, Planner):
        raise ValueError(
            "search: games with selection need BeamSettings or BudgetSettings, not SearchSettings"
        )
    if isinstance(policy, OneBoxSearch):
        return policy.search
    if any(agent.symmetric for agent in _agents(policy)):
        raise ValueError("symmetric: goes with games of one visible box and one bin")
    lookahead = lookahead_of(policy)
    if lookahead is not None:
        return GreedyValue(lookahead) if search is None else Beam(lookahead, search)
    if _is_learned(policy):
        raise ValueError(
            "a buffer, a preview or several bins need agents with a critic of afterstates, such as "
            "rs"
        )
    if search is not None:
        raise ValueError("a beam search needs learned agents with a critic of afterstates")
    if isinstance(policy, Heuristic):
        return RankedSelection(policy)
    if isinstance(policy, RandomPlay):
        return RandomSelection(policy, policy.generator)
    return OwnSelection(policy)


def make_selection_agent(
    name: str, seed: int | None = 0, device: torch.device | str = "cpu"
) -> SelectionAgent:
    """Return the selection agent that a heuristic plays.

    Args:
        name: one of :data:`marl_pack.agents.keys.SELECTION_AGENTS`.
        seed, device: as for :func:`marl_pack.agents.heuristics.make_policy`.

    Raises:
        ValueError: for an unknown name.
    """
    if name == "first":
        return first_option
    return SelectAs(selection_policy_of(make_policy(name, seed, device)))


@dataclass(frozen=True)
class OwnSelection:
    """A function of the user's, whose result is checked.

    Args:
        function: ``game -> (option, orientation, cell)``.
    """

    function: Any

    def __call__(self, game: SelectionPacking) -> SelectionPlacement:
        """Return what the function chooses.

        Raises:
            ValueError: unless there are three choices.
        """
        choice = self.function(game)
        if not isinstance(choice, tuple | list) or len(choice) != 3:
            raise ValueError("the policy needs to return (option, orientation, cell)")
        option, orientation, cell = choice
        return option, orientation, cell


def _agents(policy: Any) -> list[Any]:
    """Return the learned agents of a policy."""
    agents = [getattr(policy, name, None) for name in AGENTS]
    return [agent for agent in agents if isinstance(getattr(agent, "lookahead", None), Lookahead)]


def _is_learned(policy: Any) -> bool:
    return bool(_agents(policy))


def lookahead_of(policy: Any) -> Lookahead | None:
    """Return the lookahead of a learned policy; None if its agents have no critic."""
    for agent in _agents(policy):
        lookahead: Lookahead = agent.lookahead
        if lookahead.critic is not None:
            return lookahead
    return None

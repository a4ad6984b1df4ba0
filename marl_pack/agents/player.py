"""Load a policy by name; play many games at once with it, or one environment turn by turn."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, overload

import torch
from pettingzoo import ParallelEnv
from torch import Tensor

from marl_pack import env_aec, env_selection
from marl_pack.agents.heuristics import make_policy
from marl_pack.agents.keys import POLICIES
from marl_pack.agents.policy import InTurns, Placement, Policy
from marl_pack.agents.selection.beam_settings import BeamSettings
from marl_pack.agents.selection.budget_settings import BudgetSettings
from marl_pack.agents.selection.policies import SelectFirst
from marl_pack.agents.sources import is_own, own_policy
from marl_pack.bins import check_device
from marl_pack.checks import LARGEST_SEED, shown, truth_value, whole_number
from marl_pack.env_turns import AtOnce
from marl_pack.game.packing import Packing

if TYPE_CHECKING:
    from marl_pack.agents.search_settings import SearchSettings
    from marl_pack.agents.selection.policies import SelectionPlacement, SelectionPolicy
    from marl_pack.game.selection import SelectionPacking


def load(
    source: str | Path,
    device: torch.device | str = "cpu",
    seed: int | None = 0,
    *,
    symmetric: bool = False,
    search: SearchSettings | BeamSettings | BudgetSettings | None = None,
) -> Player:
    """Return the player that ``source`` names.

    Args:
        source: a heuristic (:data:`marl_pack.agents.keys.POLICIES`), a published model such
            as ``"rs"``, the path of a run's folder or a checkpoint (a path contains a folder or a
            dot: ``"./NAME"``), or ``"FILE.py:NAME"``, a function that you wrote.
        device: the device of the games; the environment plays on the CPU.
        seed: the seed of random play and of the future items that a search draws; with None, random
            play uses torch's global generator.
        symmetric: whether learned agents average over the symmetries of the bin.
        search: how far learned agents search before each placement; None for no search. Future
            items are drawn from the distribution of the items in training. ``BeamSettings`` are for
            games with a buffer, a preview or several bins; ``BudgetSettings`` are for all games.

    Raises:
        ValueError, FileNotFoundError: if there is no such player, or it does not support an option.
    """
    device = check_device(device)
    seed = None if seed is None else whole_number(seed, "seed", 0, LARGEST_SEED)
    symmetric = truth_value(symmetric, "symmetric")
    if not isinstance(source, str | Path):
        raise ValueError(f"policy {shown(source)}: needs a name or a path")
    if source in POLICIES or is_own(source):
        if symmetric or search is not None:
            raise ValueError(f"symmetric, search: need a learned policy, not {source}")
        name = str(source)
        return Player(own_policy(name) if is_own(name) else make_policy(name, seed, device))
    # Learned agents need rsl_rl, which is slow to import.
    from marl_pack.agents.learning import checkpoint as checkpoints
    from marl_pack.agents.loading import Loader, imagined_stream
    from marl_pack.agents.search_settings import SearchSettings

    loader = Loader(device, seed, symmetric)
    if search is None:
        return Player(loader.policy(source))
    if isinstance(search, BeamSettings):
        return Player(loader.policy(source), search)
    if not isinstance(search, SearchSettings | BudgetSettings):
        raise ValueError(
            f"search = {shown(search)}: needs SearchSettings, BeamSettings or BudgetSettings"
        )
    checkpoint = checkpoints.read(source, device)
    try:
        futures = imagined_stream(checkpoint).to(device)
        return Player(loader.planner(checkpoint, search, futures))
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from None


class Player:
    """A player of G games of :class:`marl_pack.game.packing.Packing`, or of the environment.

    Args:
        policy: the policy that chooses, for example from
            :meth:`marl_pack.agents.loading.Loader.policy`. If a function that you wrote has to
            choose the cell alone, its second argument is the moves to choose among.
        search: how far learned agents search in games with selection.
    """

    def __init__(self, policy: Policy, search: BeamSettings | None = None) -> None:
        self.policy, self.search = policy, search
        agents = policy.policy if isinstance(policy, SelectFirst) else policy
        self._agents = agents if isinstance(agents, InTurns) else _TwoTurns(agents)
        self._chosen: tuple[object, list[int]] = (None, [])  # a turn, and the choices in it

    @overload
    def __call__(self, game: Packing) -> Placement: ...

    @overload
    def __call__(self, game: SelectionPacking) -> SelectionPlacement: ...

    def __call__(self, game: Packing | SelectionPacking) -> Placement | SelectionPlacement:
        """Return the orientation and the cell of each game's item, int64 [G] each.

        In a game with selection the chosen options come first.
        """
        if isinstance(game, Packing):
            if self.search is not None:
                raise ValueError("search: BeamSettings go with games with selection")
            return self.policy(game)
        return self._selecting(game)

    @cached_property
    def _selecting(self) -> SelectionPolicy:
        """The policy for games with selection."""
        from marl_pack.agents.selection.choosing import selection_policy_of

        return selection_policy_of(self.policy, self.search)

    def act(self, env: Any) -> Any:
        """Return the action of the agent whose turn it is, for ``env.step``.

        The placement agent uses the chosen orientation, even if another player chose it.

        Args:
            env: an environment of :mod:`marl_pack.env_aec` or :mod:`marl_pack.env_selection`, with
                or without wrappers.

        Returns:
            The action, or None for an agent whose episode has ended. For a parallel environment, a
            dict with the actions that its ``step`` needs.

        Raises:
            ValueError: if this is another environment, or if no agent is left to act.
        """
        raw = getattr(env, "unwrapped", None)
        if not isinstance(raw, env_aec.raw_env | env_selection.raw_env):
            raise ValueError(f"act: needs an environment of marl_pack.env_aec, not {shown(env)}")
        _, _, terminated, truncated, _ = raw.last(observe=False)
        if isinstance(env, AtOnce):
            choices = self(raw.game)[-len(raw.possible_agents) :]
            return {a: int(c) for a, c in zip(raw.possible_agents, choices, strict=True)}
        action = None if terminated or truncated else self._turn(raw)
        return {raw.agent_selection: action} if isinstance(env, ParallelEnv) else action

    def _turn(self, env: env_aec.raw_env | env_selection.raw_env) -> int:
        """Return the choice of the agent whose turn it is."""
        if isinstance(env, env_selection.raw_env):
            return self._selecting_turn(env)
        if env.chosen is None:
            return int(self._agents.orientation_agent(env.game))
        return int(self._agents.placement_agent(env.game, torch.tensor([env.chosen])))

    def _selecting_turn(self, env: env_selection.raw_env) -> int:
        """Return the choice of the agent whose turn it is, in an environment with selection.

        An agent follows the policy's choice in this turn, as long as the agents before it have
        chosen the same. Otherwise a policy in turns sees what they chose.
        """
        game = env.game
        if env.agent_selection == env.possible_agents[0]:
            self._chosen = game.turn, [int(choice) for choice in self._selecting(game)]
        turn, choices = self._chosen
        before = [number for number in (env.selected, env.chosen) if number is not None]
        if turn is game.turn and choices[: len(before)] == before:
            return choices[len(before)]
        return self._other_choice(env)

    def _other_choice(self, env: env_selection.raw_env) -> int:
        """Return a choice for a box, a bin or an orientation that another player has chosen."""
        view, agents = env.view(), self._agents
        if env.chosen is None:
            return int(agents.orientation_agent(view))
        return int(agents.placement_agent(view, torch.tensor([env.chosen])))


class _TwoTurns:
    """The two agents of a policy that chooses orientation and cell together.

    Args:
        policy: a policy that also accepts the moves to choose among, as its second argument.
    """

    def __init__(self, policy: Any) -> None:
        self.policy = policy
        self._turn: object = None  # the game's turn in which the policy chose
        self._choice: Placement

    def orientation_agent(self, game: Packing) -> Tensor:
        """Choose orientations and cells, and return the orientations, int64 [G]."""
        self._turn, self._choice = game.turn, self.policy(game)
        return self._choice[0]

    def placement_agent(self, game: Packing, orientation: Tensor) -> Tensor:
        """Return the cells, int64 [G]; choose again if the orientations have changed."""
        if self._turn is game.turn and torch.equal(self._choice[0], orientation):
            return self._choice[1]
        cell: Tensor = self.policy(game, game.moves.only(orientation))[1]
        return cell

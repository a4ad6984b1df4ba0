"""Agents that choose their actions with a trained network."""

from __future__ import annotations

import torch
from torch import Tensor

from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.networks.actor_critic import Actor
from marl_pack.agents.networks.distribution import check_outputs
from marl_pack.agents.networks.kinds import observe
from marl_pack.agents.networks.selection import SelectionActor, observe_options
from marl_pack.agents.networks.sight import Observation
from marl_pack.agents.networks.symmetry import mean_probabilities
from marl_pack.agents.policy import AFTERSTATE_VALUE, Placement, Reasons
from marl_pack.game.moves import Moves
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.geometry import ORIENTATIONS

TINY = 1e-300
"""Stands for the probability 0, by which nothing can be divided."""


class LearnedAgent:
    """A learned agent: it takes the most probable action of its network.

    Args:
        kind: name in :data:`marl_pack.agents.networks.kinds.AGENT_KINDS`.
        actor: the network.
        lookahead: computes afterstates and their values; the agents of a policy share it.
        symmetric: whether to average the probabilities over the symmetries of the bin
            (:func:`marl_pack.agents.networks.symmetry.mean_probabilities`).
    """

    def __init__(
        self, kind: str, actor: Actor, lookahead: Lookahead, symmetric: bool = False
    ) -> None:
        self.kind, self.actor, self.lookahead = kind, actor, lookahead
        self.symmetric = symmetric

    def observe(self, game: Packing, *orientation: Tensor) -> Observation:
        """Return what the agent observes; the placement agent needs the chosen orientations."""
        return observe(self.kind, game, self.actor.cnns.planes, self.lookahead, *orientation)

    def probabilities(self, observation: Observation) -> Tensor:
        """Compute the probabilities of all actions, float64 [G, K]."""
        if self.symmetric:
            probabilities = mean_probabilities(self.actor, observation, self.kind).double()
        else:
            probabilities = self.actor.log_probs(observation).double().exp()
        check_outputs(probabilities)
        return probabilities

    def chances(self, game: Packing, *orientation: Tensor) -> Tensor:
        """Compute the probabilities of all actions in each game, float64 [G, K]."""
        return self.probabilities(self.observe(game, *orientation))

    def values(self, game: Packing) -> Tensor | None:
        """Return the values of afterstates, float32 [G, 6, W, D]; None if there is no critic."""
        if self.lookahead.critic is None:
            return None
        return self.lookahead.afterstate_value(game)

    def best(self, observation: Observation) -> Tensor:
        """Return the most probable action, int64 [G], from one evaluation of the network.

        Games without a legal action have ended: the network is not evaluated for them.
        """
        able = observation["mask"].sum(1, dtype=torch.int32) > 0  # faster than ``any`` on the CPU
        if bool(able.all()):
            return self.actor(observation).squeeze(1).long()
        rows = able.nonzero().squeeze(1)
        action = torch.zeros(len(able), dtype=torch.int64, device=able.device)
        if len(rows):
            action[rows] = self.best({name: values[rows] for name, values in observation.items()})
        return action

    @torch.inference_mode()
    def __call__(self, game: Packing, *orientation: Tensor) -> Tensor:
        """Return the most probable action, int64 [G]."""
        observation = self.observe(game, *orientation)
        if self.symmetric:
            return self.probabilities(observation).argmax(1)
        return self.best(observation)


class LearnedSelection:
    """A selection agent: it takes the most probable option of its network.

    Args:
        actor: the network.
        lookahead: computes the gains of placements.
    """

    def __init__(self, actor: SelectionActor, lookahead: Lookahead) -> None:
        self.actor, self.lookahead = actor, lookahead

    @torch.inference_mode()
    def __call__(self, game: SelectionPacking) -> Tensor:
        """Return the most probable option, int64 [G]."""
        return self.actor(observe_options(game, self.lookahead)).squeeze(1).long()


class JointPolicy:
    """The policy of a learned joint agent, which chooses orientation and cell together.

    Args:
        agent: the agent.
    """

    def __init__(self, agent: LearnedAgent) -> None:
        self.agent = agent

    @torch.inference_mode()
    def __call__(self, game: Packing, moves: Moves | None = None) -> Placement:
        """Return orientation and cell of each game's most probable placement, int64 [G] each.

        Args:
            game: the games.
            moves: the moves to choose among; all legal moves by default.
        """
        if moves is None:
            return game.floor.split(self.agent(game))
        return moves.least(-self.agent.chances(game).view_as(moves.mask))

    def reasons(self, game: Packing, orientation: Tensor) -> Reasons:
        """Return what the agent computed (:class:`marl_pack.agents.policy.Explained`)."""
        joint = self.agent.chances(game).view(game.n, len(ORIENTATIONS), -1)
        first = joint.sum(2)
        row = torch.arange(game.n, device=joint.device)
        second = joint[row, orientation] / first[row, orientation].clamp(min=TINY)[:, None]
        values = self.agent.values(game)
        return Reasons(first, second, values, "" if values is None else AFTERSTATE_VALUE)

"""Planning at decision time: the agents' best pairs, each played on in imagined futures.

The learned agents propose: of all legal pairs (orientation, cell) the M whose joint probability
π_o(o) · π_p(cell | o) is highest; orientations that turn a box into itself count as one. Each is
then played in futures drawn from the known distribution of the items and the same for all pairs, by
the same agents without planning: in few futures for all M pairs, then in more for the better half,
and so on. The pair whose bin is fullest in the mean is taken. An imagined game is an ordinary one,
with the same masks: planning cannot choose what the agents may not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents import orientation, placement
from marl_pack.agents.checkpoint import load_actor, load_critic
from marl_pack.agents.model import Actor, Critic
from marl_pack.agents.policy import Choice
from marl_pack.bins import ORIENTATIONS, oriented
from marl_pack.items import Stream
from marl_pack.packing import Packing

AT_ONCE = 4096
"""Imagined games that are played at once, about."""


@dataclass(frozen=True)
class Plan:
    """How far to look.

    Args:
        rollouts: imagined futures K for each pair, in the mean.
        top: pairs M to be tried.
        depth: items to be placed in each future before the orientation agent's critic values what
            may still come; None plays every future to its end.
    """

    rollouts: int = 16
    top: int = 8
    depth: int | None = None

    def __post_init__(self) -> None:
        for name in ("rollouts", "top", "depth"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"plan: {name} = {value}, needs 1 or more")

    def __str__(self) -> str:
        named = (f"{k}={v}" for k, v in vars(self).items() if v is not None)
        return f"plan {','.join(named)}"

    @classmethod
    def parse(cls, text: str) -> Plan:
        """``"rollouts=16,top=8,depth=3"``; what is left out has its default.

        Raises:
            ValueError: if it says something else, naming what would be right.
        """
        found = {}
        for part in text.split(","):
            key, _, value = part.partition("=")
            if key.strip() not in cls.__dataclass_fields__ or not value.strip().isdigit():
                raise ValueError(f"plan {text!r}: {part!r} is none of rollouts=K, top=M, depth=D")
            found[key.strip()] = int(value)
        return cls(**found)


class Planner:
    """A policy that plans with two learned agents.

    Args:
        orientation_agent, placement_agent: the agents' networks.
        critic: the orientation agent's; needed with a ``depth``.
        plan: how far to look.
        futures: what may come, e.g. ``make_stream("rs", …)``; drawn anew for every decision.
        seed: of the futures.
    """

    def __init__(
        self,
        orientation_agent: Actor,
        placement_agent: Actor,
        critic: Critic | None,
        plan: Plan,
        futures: Stream,
        seed: int = 0,
    ) -> None:
        if plan.depth is not None and critic is None:
            raise ValueError("plan: a depth needs the orientation agent's critic")
        self.orientation_agent, self.placement_agent = orientation_agent, placement_agent
        self.critic, self.plan, self.futures = critic, plan, futures
        self.seed = -1 - seed  # games have seeds from 0: what really comes is never foreseen

    @torch.inference_mode()
    def __call__(self, game: Packing) -> Choice:
        """The best pair found in every bin."""
        chosen = torch.zeros(2, game.n, dtype=torch.int64, device=game.device)
        alive = game.alive.nonzero().squeeze(1)
        each = max(1, AT_ONCE // (self.plan.top * self.plan.rollouts))
        for start in range(0, len(alive), each):
            which = alive[start : start + each]
            chosen[:, which] = self._decide(game, which)
        return chosen[0], chosen[1]

    def _decide(self, game: Packing, which: Tensor) -> Tensor:
        """The pairs for the bins ``which`` [B], int64 [2, B].

        By sequential halving (Karnin et al. 2013): each round plays as many futures in all, and the
        better half of the pairs goes on to the next.
        """
        pairs = self._propose(game.branch(which))  # [B, M]
        total, played = torch.zeros(pairs.shape, dtype=torch.float64, device=game.device), 0
        rounds = max(1, math.ceil(math.log2(pairs.shape[1])))
        for _ in range(rounds):
            top = pairs.shape[1]
            k = max(1, self.plan.top * self.plan.rollouts // (rounds * top))
            value = self._imagine(
                game.branch(
                    which.repeat_interleave(top * k),
                    self.futures,
                    self.seed,
                    self._futures(game, which, top, played, k),
                ),
                pairs.repeat_interleave(k, 1).flatten(),
            )
            total, played = total + value.view(len(which), top, k).sum(2), played + k
            better = total.topk(-(-top // 2), 1).indices
            pairs, total = pairs.gather(1, better), total.gather(1, better)
        cells = game.size[0] * game.size[1]
        return torch.stack((pairs[:, 0] // cells, pairs[:, 0] % cells))

    def _futures(self, game: Packing, which: Tensor, top: int, first: int, k: int) -> Tensor:
        """Numbers [B · M · k] of ``k`` futures from ``first`` on: for each bin, episode and item.

        One set for all pairs.
        """
        decision = game.episode[which] * game.bins.boxes.shape[1] + game.t[which]
        most = self.plan.top * self.plan.rollouts
        numbers = decision * most + first
        each = numbers[:, None, None] + torch.arange(k, device=which.device)
        return each.expand(-1, top, -1).flatten()

    def _propose(self, game: Packing) -> Tensor:
        """The M most probable pairs ``o · W · D + cell``, int64 [B, M].

        Where fewer are legal, the best one stands in for the rest.
        """
        ways = len(ORIENTATIONS)
        cells = game.size[0] * game.size[1]
        first = self._log_probs(
            self.orientation_agent,
            orientation.observe(game, self.orientation_agent.cnns.planes),
        )  # [B, 6]
        every = torch.arange(game.n, device=game.device).repeat_interleave(ways)
        turned = torch.arange(ways, device=game.device).repeat(game.n)
        second = self._log_probs(
            self.placement_agent,
            placement.observe(game.branch(every), self.placement_agent.cnns.planes, turned),
        )  # [B · 6, W · D]
        both = (first[:, :, None] + second.view(game.n, ways, cells)).double().exp()
        legal = game.mask.flatten(2)
        same = _twins(game)
        both = torch.einsum("noe,nec->noc", same.to(both), both * legal)
        before = torch.einsum("noe,nec->noc", same.tril(-1).to(both), legal.to(both))
        both = both.masked_fill(~legal | (before > 0), 0).flatten(1)
        found, pairs = both.topk(min(self.plan.top, both.shape[1]))
        return torch.where(found > 0, pairs, pairs[:, :1])

    @staticmethod
    def _log_probs(actor: Actor, seen: Mapping[str, Tensor]) -> Tensor:
        """Of all actions, [B, K]."""
        actor(seen, stochastic_output=True)
        return actor.output_distribution_params[0]

    def _imagine(self, game: Packing, pairs: Tensor) -> Tensor:
        """What share of each bin is full in the end [N], by the agents or their critic's word."""
        cells = game.size[0] * game.size[1]
        value = torch.zeros(game.n, dtype=torch.float64, device=game.device)
        rows = torch.arange(game.n, device=game.device)
        choice = pairs // cells, pairs % cells
        steps = 0
        while True:
            game.place(*choice, check=False)
            value[rows] = game.bins.filled.double() / game.volume
            steps += 1
            goes_on = game.alive.nonzero().squeeze(1)
            if not len(goes_on):
                return value
            if len(goes_on) < game.n:
                rows, game = rows[goes_on], game.branch(goes_on)
            seen = orientation.observe(game, self.orientation_agent.cnns.planes)
            if steps == self.plan.depth:
                assert self.critic is not None
                value[rows] += self.critic(seen).squeeze(1).double()
                return value
            turned = self.orientation_agent(seen).squeeze(1).long()
            seen = placement.observe(game, self.placement_agent.cnns.planes, turned)
            choice = turned, self.placement_agent(seen).squeeze(1).long()


def _twins(game: Packing) -> Tensor:
    """Bool [N, 6, 6]: which orientations of the item are the same box, set down the same way."""
    sides = oriented(game.items)
    if any(game.com_offset):  # then a turned cube is another cube
        return torch.eye(len(ORIENTATIONS), dtype=torch.bool, device=sides.device).expand(
            game.n, -1, -1
        )
    return (sides[:, :, None] == sides[:, None]).all(3)


def make_planner(
    found: Mapping[str, Any],
    plan: Plan,
    futures: Stream,
    device: torch.device | str = "cpu",
    seed: int = 0,
) -> Planner:
    """Plan with the agents of a checkpoint.

    Args:
        found: what :func:`marl_pack.agents.checkpoint.read` gave.
        plan, futures, seed: as for :class:`Planner`.
        device: of the games.

    Raises:
        ValueError: if not both agents are learned ones.
    """
    critic = None
    if plan.depth is not None:
        critic = load_critic(found, "orientation", device)
    first, second = (load_actor(found, name, device) for name in ("orientation", "placement"))
    return Planner(first, second, critic, plan, futures, seed)

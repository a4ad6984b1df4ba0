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
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from marl_pack.agents.learning.checkpoint import load_actor, load_critic
from marl_pack.agents.learning.symmetry import mean_probabilities
from marl_pack.agents.networks.actor_critic import Actor, Critic
from marl_pack.agents.policy import Choice
from marl_pack.bins import ORIENTATIONS, oriented
from marl_pack.game.packing import Packing
from marl_pack.items import Stream

AT_ONCE = 1 << 19
"""Cells of the floors of imagined games that are played at once, about."""
MOST = 1 << 20
"""Futures of one decision, at most."""


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
        if self.rollouts * self.top > MOST:
            raise ValueError(f"plan: rollouts · top = {self.rollouts * self.top}, at most {MOST:,}")

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
            key, value = key.strip(), value.strip()
            if key not in cls.__dataclass_fields__ or not re.fullmatch("[0-9]{1,9}", value):
                raise ValueError(f"plan {text!r}: {part!r} is none of rollouts=K, top=M, depth=D")
            if key in found:
                raise ValueError(f"plan {text!r}: {key} stands there twice")
            found[key] = int(value)
        return cls(**found)


class Planner:
    """A policy that plans with two learned agents.

    Args:
        orientation_agent, placement_agent: the agents' networks.
        critic: the orientation agent's; needed with a ``depth``.
        plan: how far to look.
        futures: what may come, e.g. ``make_stream("rs", …)``; drawn anew for every decision.
        seed: of the futures.
        symmetric: whether the agents are asked in all symmetries of the bin which pairs are best;
            what is imagined they play asked once.
    """

    def __init__(
        self,
        orientation_agent: Actor,
        placement_agent: Actor,
        critic: Critic | None,
        plan: Plan,
        futures: Stream,
        seed: int = 0,
        symmetric: bool = False,
    ) -> None:
        if plan.depth is not None and critic is None:
            raise ValueError("plan: a depth needs the orientation agent's critic")
        self.orientation_agent, self.placement_agent = orientation_agent, placement_agent
        self.critic, self.plan, self.futures = critic, plan, futures
        self.symmetric = symmetric
        self.seed = -1 - seed  # games have seeds from 0: what really comes is never foreseen

    @torch.inference_mode()
    def __call__(self, game: Packing) -> Choice:
        """The best pair found in every bin, by sequential halving (Karnin et al. 2013).

        Each round plays as many futures in all, and the better half of the pairs goes on to the
        next, until one is left.
        """
        chosen = torch.zeros(game.n, dtype=torch.int64, device=game.device)
        which = game.alive.nonzero().squeeze(1)  # [B]
        pairs, legal = self._propose(game, which)  # [B, M]
        total, played = torch.zeros(pairs.shape, dtype=torch.float64, device=game.device), 0
        rounds = max(1, math.ceil(math.log2(self.plan.top)))
        for left in range(rounds, 0, -1):
            chosen[which] = pairs[:, 0]
            several = legal.sum(1) > 1
            which, pairs, legal, total = (x[several] for x in (which, pairs, legal, total))
            if not len(which):
                break
            k = max(1, self.plan.top * self.plan.rollouts // (rounds * pairs.shape[1]))
            total[legal] += self._sum(game, which, pairs, legal, played, k)
            played += k
            kept = 1 if left == 1 else -(-pairs.shape[1] // 2)
            better = total.masked_fill(~legal, -torch.inf).topk(kept, 1).indices
            pairs, legal, total = (x.gather(1, better) for x in (pairs, legal, total))
        chosen[which] = pairs[:, 0]
        cells = game.size[0] * game.size[1]
        return chosen // cells, chosen % cells

    def _sum(
        self, game: Packing, which: Tensor, pairs: Tensor, legal: Tensor, first: int, k: int
    ) -> Tensor:
        """What ``k`` futures, from number ``first`` on, make of each legal pair: float64 [L].

        Args:
            game: the bins.
            which: int64 [B], bins.
            pairs: int64 [B, M].
            legal: bool [B, M], of which L are true.
        """
        row, rank = legal.nonzero().unbind(1)
        at_once = max(1, AT_ONCE // (game.size[0] * game.size[1]))
        numbers = self._futures(game, which, first, k)[row].flatten()  # [L · k]
        each = row.repeat_interleave(k), rank.repeat_interleave(k), numbers
        values = [
            self._imagine(game.branch(which[r], self.futures, self.seed, f), pairs[r, m])
            for r, m, f in zip(*(torch.split(x, at_once) for x in each), strict=True)
        ]
        return torch.cat(values).view(-1, k).sum(1)

    def _futures(self, game: Packing, which: Tensor, first: int, k: int) -> Tensor:
        """Numbers int64 [B, k] of futures: others for each bin, episode, item and ``first``."""
        decision = game.episode[which] * game.bins.boxes.shape[1] + game.t[which]
        numbers = decision * self.plan.top * self.plan.rollouts + first
        return numbers[:, None] + torch.arange(k, device=which.device)

    def _propose(self, game: Packing, which: Tensor) -> tuple[Tensor, Tensor]:
        """The M most probable pairs ``o · W · D + cell`` of the bins ``which`` [B], int64 [B, M].

        With bool [B, M]: false from where fewer than M are legal on.
        """
        ways, cells = len(ORIENTATIONS), game.size[0] * game.size[1]
        every = torch.arange(ways, device=game.device)
        probable = [torch.zeros(0, ways, cells, dtype=torch.float64, device=game.device)]
        for some in torch.split(which, max(1, AT_ONCE // (ways * cells))):
            each = game.branch(some)
            first = self._probabilities("orientation", self.orientation_agent.see(each))  # [b, 6]
            second = self._probabilities(
                "placement",
                self.placement_agent.see(
                    each.branch(torch.arange(len(some)).repeat_interleave(ways)),
                    every.repeat(len(some)),
                ),
            )  # [b · 6, W · D]
            probable.append(first[:, :, None] * second.view(-1, ways, cells))
        legal = game.mask[which].flatten(2)
        same = _twins(game)[which].double()
        both = torch.einsum("noe,nec->noc", same, torch.cat(probable) * legal)
        before = torch.einsum("noe,nec->noc", same.tril(-1), legal.double())
        both = both.masked_fill(~legal | (before > 0), -1).flatten(1)
        found, pairs = both.topk(min(self.plan.top, both.shape[1]))
        return pairs, found >= 0

    def _probabilities(self, agent: str, seen: Mapping[str, Tensor]) -> Tensor:
        """Of all actions of ``orientation`` or ``placement``, float64 [B, K]."""
        actor = self.orientation_agent if agent == "orientation" else self.placement_agent
        if self.symmetric:
            return mean_probabilities(actor, seen, agent).double()
        return actor.log_probs(seen).double().exp()

    def _imagine(self, game: Packing, pairs: Tensor) -> Tensor:
        """What share of each bin is full in the end [N].

        With a depth, of what comes after it the critic's word counts: the return (Eq. 5), so that
        the space that may yet be wasted is taken off.
        """
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
            seen = self.orientation_agent.see(game)
            if steps == self.plan.depth:
                assert self.critic is not None
                value[rows] += self.critic(seen).squeeze(1).double()
                return value
            turned = self.orientation_agent(seen).squeeze(1).long()
            seen = self.placement_agent.see(game, turned)
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
    symmetric: bool = False,
) -> Planner:
    """Plan with the agents of a checkpoint.

    Args:
        found: what :func:`marl_pack.agents.learning.checkpoint.read` gave.
        plan, futures, seed, symmetric: as for :class:`Planner`.
        device: of the games.

    Raises:
        ValueError: if not both agents are learned ones, or their critic cannot speak for a depth.
    """
    first, second = (load_actor(found, name, device) for name in ("orientation", "placement"))
    critic = None
    if plan.depth is not None:
        alpha, gamma = found["config"]["game"]["alpha"], found["config"]["ppo"]["gamma"]
        if (alpha, gamma) != (1, 1):
            raise ValueError(
                f"plan: a depth needs agents trained with game.alpha = 1 and ppo.gamma = 1, whose "
                f"critic speaks of shares of the bin, not {alpha:g} and {gamma:g}"
            )
        critic = load_critic(found, "orientation", device, first)
    return Planner(first, second, critic, plan, futures, seed, symmetric)

"""Compare agents with their afterstate critic alone: ``python -m benchmarks.afterstates RUN …``.

Plays the same generated sequences, of the items that each checkpoint was trained on, once with its
agents and once greedily, always taking the placement with the highest value. Prints the mean
utilization of both and the difference episode by episode, with 95 % intervals.
"""

from __future__ import annotations

import argparse

import torch

from benchmarks.planning import spread
from benchmarks.timing import show
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader, load_afterstate_critic
from marl_pack.agents.policy import Placement, Policy
from marl_pack.config import Config, from_dict
from marl_pack.evaluation.rollout import play
from marl_pack.game.packing import Packing
from marl_pack.training.assembly import make_game


def greedy(critic: AfterstateCritic) -> Policy:
    """Return the policy that takes the placement with the highest value."""
    lookahead = Lookahead(critic)

    def choose(game: Packing) -> Placement:
        return game.moves.least(-lookahead.afterstate_value(game))

    return choose


def main() -> None:
    """Play with each checkpoint and print the table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.afterstates")
    options.add_argument("checkpoints", nargs="+", help="that have a critic of afterstates")
    options.add_argument("--episodes", type=int, default=1000)
    options.add_argument("--seed", type=int, default=5, help="of the sequences")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    table = []
    for source in chosen.checkpoints:
        checkpoint = checkpoints.read(source)
        critic = load_afterstate_critic(checkpoint, "cpu")
        if critic is None:
            options.error(f"{source}: has no critic of afterstates")
        config = from_dict(checkpoint["config"])

        def game(n: int, first: int, config: Config = config) -> Packing:
            return make_game(
                config, n, chosen.seed, auto_reset=False, device="cpu", first_episode=first
            )

        agents, values = (
            play(policy, game, chosen.episodes).utilization
            for policy in (Loader().policy_of(checkpoint), greedy(critic))
        )
        table.append([source, f"{checkpoint['items']:,}", spread(agents).lstrip("+"),
                      spread(values).lstrip("+"), spread(agents - values)])  # fmt: skip
    show(
        f"{chosen.episodes} episodes",
        ["checkpoint", "items", "agents %", "greedy in value %", "agents' gain"],
        table,
    )


if __name__ == "__main__":
    main()

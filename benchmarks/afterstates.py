"""What the agents add to their critic of afterstates: ``python -m benchmarks.afterstates RUN …``.

Plays the same generated sequences, of the items that each checkpoint was trained on, with its
agents and greedily, each time the placement that its critic thinks worth most, and prints the mean
utilization of both and the difference episode by episode, with 95 % intervals.
"""

from __future__ import annotations

import argparse

import torch

from benchmarks.planning import spread
from benchmarks.timing import show
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.policy import Choice, Policy
from marl_pack.config import Config, from_dict
from marl_pack.evaluate import play
from marl_pack.game.packing import Packing
from marl_pack.train import make_game


def greedy(critic: AfterstateCritic) -> Policy:
    """Takes what is worth most."""

    def choose(game: Packing) -> Choice:
        pair = critic.worth(game).flatten(1).argmax(1)
        cells = game.size[0] * game.size[1]
        return pair // cells, pair % cells

    return choose


def main() -> None:
    """The table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.afterstates")
    options.add_argument("checkpoints", nargs="+", help="runs or checkpoints that see worth")
    options.add_argument("--episodes", type=int, default=1000)
    options.add_argument("--seed", type=int, default=5, help="of the sequences")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    table = []
    for source in chosen.checkpoints:
        found = checkpoint.read(source)
        critic = checkpoint.load_actor(found, "orientation", "cpu").afterstates
        if critic is None:
            options.error(f"{source}: its orientation agent does not see worth")
        config = from_dict(found["config"])

        def game(n: int, first: int, config: Config = config) -> Packing:
            return make_game(
                config, n, chosen.seed, auto_reset=False, device="cpu", first_episode=first
            )

        agents, alone = (
            play(policy, game, chosen.episodes).utilization
            for policy in (checkpoint.load_policy(found), greedy(critic))
        )
        table.append([source, f"{found['items']:,}", spread(agents).lstrip("+"),
                      spread(alone).lstrip("+"), spread(agents - alone)])  # fmt: skip
    show(
        f"{chosen.episodes} episodes",
        ["checkpoint", "items", "agents %", "greedy in worth %", "agents' gain"],
        table,
    )


if __name__ == "__main__":
    main()

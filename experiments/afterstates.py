"""Compare agents with their critic of afterstates alone: ``python -m experiments.afterstates``.

The program plays the same generated sequences twice, with items as in the checkpoint's training:
once with its agents, and once greedily, always with the placement of highest value. The gain is
computed for each episode.
"""

from __future__ import annotations

import sys

import torch

from benchmarks.record import record
from experiments.rows import Rows, main_of, mean
from marl_pack.agents.afterstates.critic import AfterstateCritic
from marl_pack.agents.afterstates.lookahead import Lookahead
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.loading import Loader, load_afterstate_critic
from marl_pack.agents.policy import Placement, Policy
from marl_pack.config import Config, from_dict
from marl_pack.evaluation.rollout import play
from marl_pack.game.packing import Packing
from marl_pack.training.assembly import make_game

MODELS = ("rs", "cut_1", "cut_2", "types125")


def greedy(critic: AfterstateCritic) -> Policy:
    """Return the policy that takes the placement with the highest value."""
    lookahead = Lookahead(critic)

    def choose(game: Packing) -> Placement:
        return game.moves.least(-lookahead.afterstate_value(game))

    return choose


def main() -> int:
    """Play with each checkpoint that is missing; return the exit status."""
    rows = Rows("python -m experiments.afterstates", __doc__)
    add = rows.options.add_argument
    add("checkpoints", nargs="*", default=MODELS,
        help=f"checkpoints to compare (default: {' '.join(MODELS)})")  # fmt: skip
    add("--episodes", type=int, default=1000, help="number of sequences (default: 1000)")
    add("--seed", type=int, default=5, help="seed of the sequences (default: 5)")
    chosen = rows.parse()
    torch.set_num_threads(1)
    results = rows.results("afterstates")
    for source in rows.missing(results, chosen.checkpoints):
        checkpoint = checkpoints.read(source)
        critic = load_afterstate_critic(checkpoint, "cpu")
        if critic is None:
            raise ValueError(f"{source}: has no critic of afterstates")
        config = from_dict(checkpoint["config"])

        def game(n: int, first: int, config: Config = config) -> Packing:
            games = make_game(
                config, n, chosen.seed, auto_reset=False, device="cpu", first_episode=first
            )
            assert isinstance(games, Packing), "the published models see one box"
            return games

        agents, values = (
            play(policy, game, chosen.episodes).utilization
            for policy in (Loader().policy_of(checkpoint), greedy(critic))
        )
        figures = {
            "episodes": chosen.episodes, "agents": mean(agents), "greedy": mean(values),
            "gain": mean(agents - values),
        }  # fmt: skip
        command = f"python -m experiments.afterstates {source} --episodes {chosen.episodes}"
        results.put(source, figures, record(command, [chosen.seed]))
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))

"""An example's command line, and the account of what its trainer did with the environment.

A trainer fits if it plays no illegal action, goes on to new items, changes what both agents choose
by, and credits both with the environment's rewards (in sum). :class:`Session` sees to that from
outside: it wraps the environment, keeps weights from before, and plays held-out sequences before
and after.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pettingzoo.utils.wrappers import BaseWrapper

from marl_pack import env_aec
from marl_pack.env_aec import AGENTS
from marl_pack.evaluate import interval
from marl_pack.files import write_json
from marl_pack.integrations.network import ActorCritic

HELD_OUT = 10**9
"""Seed of the sequences that are played before and after; training has smaller ones."""


class Counted(BaseWrapper):
    """The environment, with what is done in it counted.

    Attributes:
        items: items placed.
        illegal: actions played against the mask.
        seeded: resets with a seed, each of which begins the stream of items anew.
        totals: agent -> sum of its rewards.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.items, self.illegal, self.seeded = 0, 0, 0
        self.totals = dict.fromkeys(AGENTS, 0.0)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode."""
        self.seeded += seed is not None
        super().reset(seed=seed, options=options)

    def step(self, action: Any) -> None:
        """Play the action."""
        agent = self.env.agent_selection
        played = not (self.env.terminations[agent] or self.env.truncations[agent])
        if played:
            raw = self.env.unwrapped
            self.illegal += not raw.action_mask(agent)[int(action)]
            self.items += agent == AGENTS[1]
        super().step(action)
        if played:
            for name, reward in self.env.rewards.items():
                self.totals[name] += float(reward)


class Session:
    """One run of an example.

    Attributes:
        items: how many items to train on, about.
        turns: how many turns of both agents to play between two updates, about.
        bin_size: W, D, H in cells.
        seed: of weights and items.

    Args:
        arguments: of the command line.
        description: what ``--help`` says.
    """

    def __init__(self, arguments: Sequence[str] | None = None, description: str = "") -> None:
        options = argparse.ArgumentParser(description=description)
        add = options.add_argument
        add("--items", type=int, default=100_000, help="to train on (default: 100,000)")
        add("--turns", type=int, default=2048,
            help="of both agents between two updates, about (default: 2048)")  # fmt: skip
        add("--minutes", type=float, help="end after so long, whatever is left")
        add("--bin", type=int, nargs=3, default=(10, 10, 10), metavar=("W", "D", "H"),
            help="bin size in cells (default: 10 10 10)")  # fmt: skip
        add("--sides", type=int, nargs=2, default=(2, 5), metavar=("SHORTEST", "LONGEST"),
            help="sides of the items (default: 2 5)")  # fmt: skip
        add("--episodes", type=int, default=100,
            help="held-out sequences played before and after (default: 100)")  # fmt: skip
        add("--seed", type=int, default=0, help="of weights and items (default: 0)")
        add("--json", type=Path, metavar="FILE", help="write the account there")
        chosen = options.parse_args(arguments)
        self.items, self.turns, self.seed = chosen.items, chosen.turns, chosen.seed
        self.episodes = chosen.episodes
        self.bin_size, self.sides = tuple(chosen.bin), tuple(chosen.sides)
        self.json: Path | None = chosen.json
        if self.episodes < 2:
            options.error("--episodes: at least 2, for an interval")
        self.minutes = chosen.minutes or float("inf")
        self.envs: list[Counted] = []
        self.credited = dict.fromkeys(AGENTS, 0.0)
        torch.set_num_threads(1)
        torch.manual_seed(chosen.seed)
        np.random.seed(chosen.seed)  # noqa: NPY002  # some trainers draw from there

    def env(self, **options: Any) -> Counted:
        """A new AEC environment (:func:`marl_pack.env_aec.env`), counted."""
        made = Counted(env_aec.env(bin_size=self.bin_size, sides=self.sides, **options))
        self.envs.append(made)
        return made

    def parallel_env(self, **options: Any) -> env_aec.Turns:
        """The same, turn by turn, as :func:`marl_pack.env_aec.parallel_env` gives it."""
        return env_aec.Turns(self.env(**options))

    def go_on(self) -> bool:
        """Whether there is something left to train on."""
        return self.placed < self.items and self.taken < self.minutes

    @property
    def taken(self) -> float:
        """Minutes since training began."""
        return (time.monotonic() - self.start) / 60

    @property
    def placed(self) -> int:
        """Items placed in all environments."""
        return sum(env.items for env in self.envs)

    def watch(self, orientation: ActorCritic, placement: ActorCritic) -> None:
        """Name the networks that will learn (twice the same, if one plays both turns).

        Training begins here: its minutes are counted from now.
        """
        self.networks = {AGENTS[0]: orientation, AGENTS[1]: placement}
        self.before = {name: self._head(name) for name in AGENTS}
        self.utilization_before = self.play()
        for env in self.envs:
            env.seeded = 0
        self.start = time.monotonic()

    def _head(self, agent: str) -> torch.Tensor:
        """The weights that only the agent's own choices move, not the critic."""
        network = self.networks[agent]
        head = network.turns if agent == AGENTS[0] else network.cells
        return head.weight.detach().cpu().clone()

    def credit(self, agent: str, reward: float) -> None:
        """Say what reward the trainer has put down for an agent."""
        self.credited[agent] += float(reward)

    @torch.no_grad()
    def play(self) -> tuple[float, float]:
        """Mean utilization over held-out sequences, and half its 95 % interval (Student's).

        Each agent takes the action that it finds best.
        """
        both = self.networks[AGENTS[0]].agent == "both"
        env = env_aec.env(bin_size=self.bin_size, sides=self.sides, pad_actions=both)
        reached = []
        for episode in range(self.episodes):
            env.reset(seed=HELD_OUT if episode == 0 else None)
            for agent in env.agent_iter():
                seen, _, terminated, truncated, info = env.last()
                if terminated or truncated:
                    reached.append(info["utilization"])
                    break
                network = self.networks[agent]
                planes, mask = (torch.as_tensor(seen[k], device=network.device)[None]
                                for k in ("observation", "action_mask"))  # fmt: skip
                env.step(int(network(planes, mask)[0].argmax()))
        low, high = interval(np.array(reached)) or (np.nan, np.nan)  # there are two or more
        return float(np.mean(reached)), (high - low) / 2

    def account(self, trainer: str, package: str) -> dict[str, Any]:
        """What came of it."""
        minutes = self.taken
        env_rewards = {a: sum(env.totals[a] for env in self.envs) for a in AGENTS}
        updated = {a: not torch.equal(self.before[a], self._head(a)) for a in AGENTS}
        right = {
            a: abs(env_rewards[a] - self.credited[a]) <= 1e-4 * max(1.0, abs(env_rewards[a]))
            for a in AGENTS
        }
        return {
            "trainer": trainer,
            "version": metadata.version(package),
            "bin": self.bin_size,
            "items": self.placed,
            "minutes": minutes,
            "illegal": sum(env.illegal for env in self.envs),
            "repeats": sum(max(0, env.seeded - 1) for env in self.envs),
            "updated": updated,
            "rewards_right": right,
            "rewards": env_rewards,
            "credited": self.credited,
            "episodes": self.episodes,
            "before": self.utilization_before,
            "after": self.play(),
        }


_running: list[Session] = []


def current() -> Session:
    """The session that runs, for trainers that make environments from a pickled function."""
    return _running[-1]


def run(
    trainer: str,
    package: str,
    train: Callable[[Session], None],
    arguments: Sequence[str] | None = None,
    description: str = "",
) -> int:
    """Run an example and print its account.

    Returns:
        The exit status: 0 if it :func:`fits`.
    """
    session = Session(arguments, description)
    _running.append(session)
    train(session)
    found = session.account(trainer, package)
    for key, value in found.items():
        print(f"{key}: {percent(value) if key in ('before', 'after') else value}")
    if session.json is not None:
        write_json(session.json, found)
    if not fits(found):
        print("DOES NOT FIT", file=sys.stderr)
        return 1
    print("fits")
    return 0


def percent(reached: tuple[float, float]) -> str:
    """A utilization and half its interval, as they are shown."""
    return f"{100 * reached[0]:.1f} ± {100 * reached[1]:.1f} %"


def fits(found: dict[str, Any]) -> bool:
    """Whether items came, ever new ones, no action was illegal, both agents learned and got all."""
    return bool(
        found["items"]
        and not found["illegal"]
        and not found["repeats"]
        and all(found["updated"].values())
        and all(found["rewards_right"].values())
    )

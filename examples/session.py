"""The command line of the examples, and the compliance report about a trainer.

A trainer passes if it plays no illegal action, always gets new items, changes the weights that
choose the actions of all agents, and stores for each agent rewards whose sum is the sum of the
environment's rewards. :class:`Session` checks this without changing the trainer: it wraps the
environment, copies the weights before training, and plays held-out sequences before and after.
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

from marl_pack import env_aec, env_turns
from marl_pack.env_mm import COLUMNS
from marl_pack.env_turns import PLACEMENT
from marl_pack.evaluation.statistics import interval
from marl_pack.files import write_json
from marl_pack.integrations.network import ActorCritic, MovesActorCritic

HELD_OUT = 10**9
"""Seed of the sequences played before and after training. Training uses smaller seeds."""


CARTONS = {
    "items": [[600, 400, 300], [600, 400, 200], [400, 300, 250], [400, 300, 150], [300, 200, 200],
              [300, 200, 120], [395, 295, 285], [585, 385, 245], [350, 250, 220], [500, 310, 180]],
    "quantity": [2, 2, 4, 4, 4, 3, 3, 2, 3, 2],
}  # fmt: skip
"""Made-up cartons in millimetres, drawn in proportion to their quantities."""
MILLIMETRES: dict[str, Any] = {
    "world": "mm", "items": CARTONS, "order": "draw", "length": 60, "bin_mm": (1200, 800, 1000),
    "orientations": (0, 1), "rule": "lbcp", "margin_mm": 20, "max_moves": 128,
}  # fmt: skip
"""The options of the environment with ``--world mm``."""


class Counted(BaseWrapper):
    """A wrapper of an environment that counts items, illegal actions, seeds and rewards.

    Attributes:
        items: number of items placed.
        illegal: number of illegal actions played.
        seeded: number of resets with a seed; each of them begins the stream of items again.
        totals: sum of the rewards of each agent, by its name.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        self.items, self.illegal, self.seeded = 0, 0, 0
        self.totals = dict.fromkeys(env.possible_agents, 0.0)

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode; count it if a seed is given."""
        self.seeded += seed is not None
        super().reset(seed=seed, options=options)

    def step(self, action: Any) -> None:
        """Play the action; count it, its item and the rewards."""
        agent = self.env.agent_selection
        played = not (self.env.terminations[agent] or self.env.truncations[agent])
        if played:
            raw = self.env.unwrapped
            self.illegal += not raw.action_mask(agent)[int(action)]
            self.items += agent == PLACEMENT
        super().step(action)
        if played:
            for name, reward in self.env.rewards.items():
                self.totals[name] += float(reward)


class Session:
    """One run of an example: its options, environments, counters and compliance report.

    Attributes:
        items: approximate number of items to train on.
        turns: approximate number of turns of both agents between two updates.
        bin_size: W, D, H in cells; with ``--world mm`` in millimetres.
        sides: shortest and longest side of items on cells.
        seed: seed of weights and items.

    Args:
        arguments: arguments of the command line; None: the arguments of this process.
        description: the text of ``--help``.
        worlds: the worlds that the example can play.
        selects: whether the example can play games with a buffer.
    """

    def __init__(
        self,
        arguments: Sequence[str] | None = None,
        description: str = "",
        worlds: Sequence[str] = ("cells",),
        selects: bool = False,
    ) -> None:
        parser = argparse.ArgumentParser(description=description)
        add = parser.add_argument
        add("--items", type=int, default=100_000,
            help="number of items to train on (default: 100,000)")  # fmt: skip
        add("--turns", type=int, default=2048,
            help="approximate number of turns between two updates, of both agents together "
                 "(default: 2048)")  # fmt: skip
        add("--minutes", type=float, help="end after this many minutes, even if items are left")
        add("--bin", type=int, nargs=3, default=(10, 10, 10), metavar=("W", "D", "H"),
            help="bin size in cells (default: 10 10 10)")  # fmt: skip
        add("--sides", type=int, nargs=2, default=(2, 5), metavar=("SHORTEST", "LONGEST"),
            help="sides of the items (default: 2 5)")  # fmt: skip
        add("--episodes", type=int, default=100,
            help="held-out sequences played before and after training (default: 100)")  # fmt: skip
        add("--seed", type=int, default=0, help="seed of weights and items (default: 0)")
        add("--json", type=Path, metavar="FILE", help="write the compliance report to this file")
        if len(worlds) > 1:
            add("--world", choices=worlds, default=worlds[0],
                help="mm: cartons in millimetres instead of whole cells")  # fmt: skip
        if selects:
            add("--buffer", type=int, default=1, metavar="K",
                help="visible boxes, any of which may be placed next (default: 1); with more than "
                     "one, a third agent selects the box")  # fmt: skip
        options = parser.parse_args(arguments)
        self.in_mm = len(worlds) > 1 and options.world == "mm"
        self.items, self.turns, self.seed = options.items, options.turns, options.seed
        self.episodes = options.episodes
        self.game = {"bin_size": tuple(options.bin), "sides": tuple(options.sides)}
        if selects and options.buffer > 1:
            if self.in_mm:
                parser.error("--buffer: needs --world cells")
            self.game["buffer"] = options.buffer
        self.bin_size, self.sides = tuple(options.bin), tuple(options.sides)
        if self.in_mm:
            self.game, self.bin_size = MILLIMETRES, MILLIMETRES["bin_mm"]
        self.json: Path | None = options.json
        if self.episodes < 2:
            parser.error("--episodes: needs at least 2 for an interval")
        self.minutes = options.minutes or float("inf")
        self.envs: list[Counted] = []
        example = env_aec.env(**self.game)
        self.agents: list[str] = example.possible_agents
        self.credited = dict.fromkeys(self.agents, 0.0)
        if not self.in_mm:
            self.planes = example.observation_space(self.agents[0])["observation"].shape[0]
            self.options = int(example.action_space(self.agents[0]).n)
        torch.set_num_threads(1)
        torch.manual_seed(options.seed)
        np.random.seed(options.seed)  # noqa: NPY002  # some trainers use NumPy's global generator

    def env(self, **options: Any) -> Counted:
        """Return a new AEC environment (:func:`marl_pack.env_aec.env`) with counters."""
        env = Counted(env_aec.env(**self.game, **options))
        self.envs.append(env)
        return env

    def parallel_env(self, **options: Any) -> env_turns.Turns:
        """Return a new environment in the parallel API, turn by turn, with counters."""
        return env_turns.Turns(self.env(**options))

    def go_on(self) -> bool:
        """Return whether items and minutes are left for training."""
        return self.placed < self.items and self.elapsed < self.minutes

    @property
    def elapsed(self) -> float:
        """Minutes since training began."""
        return (time.monotonic() - self.start) / 60

    @property
    def placed(self) -> int:
        """Items placed in all environments."""
        return sum(env.items for env in self.envs)

    def network(self, agent: str) -> ActorCritic | MovesActorCritic:
        """Return a new network for an agent that reads the observations of the game."""
        kind = agent.partition("_")[0]
        if self.in_mm:
            return MovesActorCritic(kind, len(COLUMNS))
        return ActorCritic(kind, planes=self.planes, options=self.options)

    def watch(self, *networks: ActorCritic | MovesActorCritic) -> None:
        """Remember the networks that will learn, play with them, and start to time the training.

        The report checks later that the weights of these networks have changed.

        Args:
            *networks: the network of each agent, in the order of their turns; the same network
                again if one plays several.
        """
        self.networks = dict(zip(self.agents, networks, strict=True))
        self.before = {name: self._head(name) for name in self.agents}
        self.utilization_before = self.play()
        for env in self.envs:
            env.seeded = 0
        self.start = time.monotonic()

    def _head(self, agent: str) -> torch.Tensor:
        """Return a copy of the weights that the agent's policy uses and its critic does not."""
        network = self.networks[agent]
        head = network.cells if agent == PLACEMENT else network.orientations
        return head.weight.detach().cpu().clone()

    def credit(self, agent: str, reward: float) -> None:
        """Record a reward that the trainer stored for an agent."""
        self.credited[agent] += float(reward)

    @torch.no_grad()
    def play(self) -> tuple[float, float]:
        """Return the mean utilization over held-out sequences, and half its 95 % interval.

        Each agent takes its most probable action. The interval is by Student's t.
        """
        both = self.networks[PLACEMENT].agent == "both"
        env = env_aec.env(**self.game, **({"pad_actions": True} if both else {}))
        utilizations = []
        for episode in range(self.episodes):
            env.reset(seed=HELD_OUT if episode == 0 else None)
            for agent in env.agent_iter():
                observation, _, terminated, truncated, info = env.last()
                if terminated or truncated:
                    utilizations.append(info["utilization"])
                    break
                network = self.networks[agent]
                planes, mask = (torch.as_tensor(observation[k], device=network.device)[None]
                                for k in ("observation", "action_mask"))  # fmt: skip
                env.step(int(network(planes, mask)[0].argmax()))
        low, high = interval(np.array(utilizations)) or (np.nan, np.nan)
        return float(np.mean(utilizations)), (high - low) / 2

    def report(self, trainer: str, package: str) -> dict[str, Any]:
        """Return the compliance report.

        Args:
            trainer: name of the trainer in the report.
            package: name of the trainer's package; its version is in the report.
        """
        minutes = self.elapsed
        env_rewards = {a: sum(env.totals[a] for env in self.envs) for a in self.agents}
        updated = {a: not torch.equal(self.before[a], self._head(a)) for a in self.agents}
        rewards_right = {
            a: abs(env_rewards[a] - self.credited[a]) <= 1e-4 * max(1.0, abs(env_rewards[a]))
            for a in self.agents
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
            "rewards_right": rewards_right,
            "rewards": env_rewards,
            "credited": self.credited,
            "episodes": self.episodes,
            "before": self.utilization_before,
            "after": self.play(),
        }


_running: list[Session] = []


def current() -> Session:
    """Return the running session: for trainers that make environments by a pickled function."""
    return _running[-1]


def run(
    trainer: str,
    package: str,
    train: Callable[[Session], None],
    arguments: Sequence[str] | None = None,
    description: str = "",
    worlds: Sequence[str] = ("cells",),
    selects: bool = False,
) -> int:
    """Run an example and print its compliance report.

    Args:
        trainer: name of the trainer in the report.
        package: name of the trainer's package, for its version.
        train: the function that trains the agents until the session ends.
        arguments: arguments of the command line; None: the arguments of this process.
        description: the text of ``--help``.
        worlds: the worlds that the example can play.
        selects: whether the example can play games with a buffer.

    Returns:
        The exit status: 0 if it :func:`passes`.
    """
    session = Session(arguments, description, worlds, selects)
    _running.append(session)
    train(session)
    report = session.report(trainer, package)
    for key, value in report.items():
        print(f"{key}: {percent(value) if key in ('before', 'after') else value}")
    if session.json is not None:
        write_json(session.json, report)
    if not passes(report):
        print("DOES NOT PASS", file=sys.stderr)
        return 1
    print("passes")
    return 0


def percent(utilization: tuple[float, float]) -> str:
    """Return a utilization and half the width of its interval as text, in percent."""
    return f"{100 * utilization[0]:.1f} ± {100 * utilization[1]:.1f} %"


def passes(report: dict[str, Any]) -> bool:
    """Return whether a report has items, no faults, new weights and correct rewards."""
    return bool(
        report["items"]
        and not report["illegal"]
        and not report["repeats"]
        and all(report["updated"].values())
        and all(report["rewards_right"].values())
    )

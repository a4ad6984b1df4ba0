"""Compile all code now, so that no later start has to wait: ``marl-pack compile``.

Numba compiles a function when it is first called, and stores it in a cache on disk. This command
plays a little in every way that commands and environments play. Run it when the package is
installed, for example in the recipe of a container.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from marl_pack.terminal import Parser, complain, make_console, make_progress

if TYPE_CHECKING:
    from marl_pack.agents.policy import Policy
    from marl_pack.game.packing import Packing

PROGRAM = "python -m marl_pack.compile"
STEPS = 6
"""Number of steps that each game is played; later steps place boxes on several others."""


def _play(game: Packing, policy: Policy) -> None:
    for _ in range(STEPS):
        game.place(*policy(game))


def _rules() -> None:
    """Play every rule, with and without a margin, in low and high bins."""
    from marl_pack.agents.heuristics import make_policy
    from marl_pack.game.packing import Packing
    from marl_pack.stability import RULES

    for rule in RULES:
        for margin in (None,) if rule in ("none", "area_ratio") else (0.0, 0.5):
            for height in (10, 300):
                game = Packing(4, (10, 10, height), sides=(2, 5), rule=rule, margin=margin)
                _play(game, make_policy("random", 0))


def _games() -> None:
    """Play every way in which items come, and games without a mask of orientations."""
    from marl_pack.agents.heuristics import make_policy
    from marl_pack.game.packing import Packing

    games = [Packing(4, items=items) for items in ("rs", "cut1", "cut2", [[2, 3, 4], [3, 3, 3]])]
    games += [Packing(4, mask_orientations=False), Packing(4, com_offset=(0.3, 0.2, 0.0))]
    for game in games:
        _play(game, make_policy("random", 0))


def _policies() -> None:
    """Let every heuristic play on floors of three sizes, which take other code."""
    from marl_pack.agents.heuristics import make_policy
    from marl_pack.agents.keys import POLICIES
    from marl_pack.game.packing import Packing

    for name in POLICIES:
        for side in (10, 14, 20):
            _play(Packing(2, (side, side, side), items="cut1"), make_policy(name, 0))


def _agents() -> None:
    """Let trained agents play with and without planning, on a small and on a large floor."""
    from marl_pack.agents.learning import checkpoint
    from marl_pack.agents.loading import Loader
    from marl_pack.agents.search_settings import SearchSettings
    from marl_pack.agents.selection.budget_settings import BudgetSettings
    from marl_pack.game.packing import Packing
    from marl_pack.items import make_stream

    record, loader = checkpoint.read("rs"), Loader()
    for size, sides in (((10, 10, 10), (2, 5)), ((20, 20, 20), (4, 10))):
        _play(Packing(2, size, sides=sides), loader.policy_of(record))
        futures = make_stream("rs", size, sides)
        planner = loader.planner(record, SearchSettings.parse("rollouts=2,top=2,depth=1"), futures)
        _play(Packing(1, size, sides=sides), planner)
        budget = loader.planner(record, BudgetSettings(draws=1), futures)
        _play(Packing(1, size, sides=sides), budget)


def _environments() -> None:
    """Play the first turns of the PettingZoo environment."""
    from marl_pack import env_aec

    env = env_aec.env()
    env.reset(seed=0)
    for agent in env.agent_iter(2 * STEPS):
        if env.terminations[agent]:  # the first boxes may leave no place for the next one
            return
        mask = env.observe(agent)["action_mask"]
        env.step(env.action_space(agent).sample(mask))


def _stacks() -> None:
    """Compute masks from arrays, place a box, and judge a stack in static equilibrium."""
    import numpy as np
    import torch

    from marl_pack import bins
    from marl_pack.evaluation.statistics import strict_equilibrium
    from marl_pack.game.packing import Packing
    from marl_pack.stability import RULES, stable_mask

    floor = np.zeros((4, 4), np.int64)
    for rule in RULES:
        stable_mask(rule, floor, floor, (2, 2, 1), 4, np.empty((0, 6), np.int64))
    bins.place(bins.empty(1, (4, 4, 4), 1), torch.tensor([[2, 2, 1]]), torch.tensor([[0, 0]]))
    game = Packing(1, items=[[2, 3, 4], [3, 3, 3]])
    game.place(torch.tensor([0]), torch.tensor([0]))
    strict_equilibrium(game.plans()[0])


def _training() -> None:
    """Train for one iteration with the default settings."""
    from marl_pack.config import parse
    from marl_pack.published import config
    from marl_pack.training.assembly import make_runner

    words = ["--ppo.num_envs=16", "--ppo.num_steps_per_env=4", "--evaluation.every=0"]
    settings, _ = parse([f"--config={config('default')}", *words])
    make_runner(settings, None).train(1)


def _millimetres() -> None:
    """Play the game in millimetres under every rule, with every heuristic and at random."""
    from marl_pack.exact.limits import RULES
    from marl_pack.exact.packing import ExactPacking
    from marl_pack.exact.policies import NAMES, make_exact_policy

    sides = [[300, 200, 250], [400, 300, 200], [200, 200, 200]] * 3
    for rule in RULES:
        for name in NAMES if rule == "lbcp" else ("max_contact", "random"):
            game = ExactPacking(2, sides, rule=rule, auto_reset=False)
            policy = make_exact_policy(name)
            for _ in range(STEPS):
                if game.alive.any():
                    game.place(policy(game))
            game.plan(0)


def _packer() -> None:
    """Pack boxes one by one with each kind of policy, and report where one was put."""
    from marl_pack.packer.packer import Packer

    boxes = [(300, 200, 250), (400, 300, 200), (200, 200, 200), (390, 290, 110)] * 3
    for policy, plan in (("max_contact", None), ("search", "budget=20ms"), ("rs", None)):
        packer = Packer((500, 400, 600), policy, plan=plan, clearance_mm=10)
        for box in boxes:
            if packer.place(box):
                packer.actual((*packer.placements[-1].centre[:2], 0.5))


PARTS: dict[str, Callable[[], None]] = {
    "rules": _rules,
    "games": _games,
    "stacks": _stacks,
    "heuristics": _policies,
    "agents": _agents,
    "environments": _environments,
    "millimetres": _millimetres,
    "packer": _packer,
    "training": _training,
}
"""The parts of the package whose code is compiled, by name."""


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program,
        usage=f"{program} [OPTIONS]",
        description=__doc__.split(":")[0] + ".",
        examples=("--parts agents environments",),
        notes=(
            "The compiled code is stored beside the package's files, or in the folder that the "
            "environment variable NUMBA_CACHE_DIR names.",
        ),
    )
    options.add_argument(
        "--parts", nargs="+", choices=PARTS, default=list(PARTS), metavar="PART",
        help=f"compile only what these use: {', '.join(PARTS)} (default: all)",
    )  # fmt: skip
    return options


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Compile all code; return the exit status of the command."""
    chosen = parser(program).parse_args(arguments)
    console = make_console()
    start = time.monotonic()
    try:
        with make_progress(console) as bar:
            for name in bar.track(chosen.parts, description="compiling"):
                PARTS[name]()
    except OSError as error:
        complain(program, error)
        return 2
    console.print(f"compiled in {time.monotonic() - start:.0f} s; later starts are fast")
    return 0


if __name__ == "__main__":
    sys.exit(main())

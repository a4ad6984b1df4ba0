"""Options of the commands that play games: who plays, and which game."""

from __future__ import annotations

import argparse

from marl_pack import published
from marl_pack.agents.keys import ORIENTATION_AGENTS, POLICIES
from marl_pack.game.spec import add_arguments
from marl_pack.items import GENERATED

MOST_AT_ONCE = 1024
"""The largest number of threads, and of processes that judge."""
EPILOG = (
    "The game is the one that the first checkpoint among the policies was trained on, else RS in a "
    "bin of 10 x 10 x 10 under hull_alpha; each option changes that."
)


def add_options(options: argparse.ArgumentParser) -> None:
    """Add the options of :func:`marl_pack.players.choose` to a command."""
    add = options.add_argument
    add("--policy", nargs="+", metavar="NAME",
        help=f"one or more of {', '.join((*POLICIES, *published.models()))}, runs' folders or "
             "checkpoints (default: dblf)")  # fmt: skip
    add("--orientation", metavar="NAME",
        help=f"with --placement: the first agent alone, of {', '.join(ORIENTATION_AGENTS)}, a "
             "published model, a run's folder or a checkpoint")  # fmt: skip
    add("--placement", metavar="NAME",
        help=f"with --orientation: the second agent alone, of {', '.join(POLICIES)}, a "
             "published model, a run's folder or a checkpoint")  # fmt: skip
    add("--plan", metavar="rollouts=K,top=M",
        help="learned agents try their M best pairs in K imagined futures before each placement; "
             "depth=D ends each future after D items by the critic's value")  # fmt: skip
    add("--symmetric", action="store_true",
        help="ask learned agents in all symmetries of the bin and take what is most probable on "
             "average; with --plan which pairs to try, not in the imagined futures")  # fmt: skip
    add("--items", help=f"{', '.join(GENERATED)}, or a .npz, .json or .csv file")
    add("--sides", nargs=2, type=int, metavar=("SHORTEST", "LONGEST"),
        help="sides of generated items, in cells")  # fmt: skip
    add_arguments(options)
    add("--seed", type=int, default=0,
        help="of generated items, random play, futures of --plan and drawn bodies "
             "(default: 0)")  # fmt: skip
    add("--device", default="cpu", help="cpu (default), cuda, cuda:1, …")
    add("--threads", type=int, default=1, help="on the CPU (default: 1)")

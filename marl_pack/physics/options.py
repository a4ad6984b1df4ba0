"""Options of the commands that judge packings: files, cells, densities and centres of mass."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans
from marl_pack.sapien_check.bodies import Bodies

BODY_OPTIONS = ("cell", "density", "com_spread")
"""Names of the options that :func:`add_body_options` adds; an option that is not used is None."""


def add_body_options(parser: argparse._ActionsContainer) -> None:
    """Add ``--cell``, ``--density`` and ``--com-spread`` to a command."""
    add = parser.add_argument
    add("--cell", type=float, metavar="METRES",
        help="edge of a cell (default: the unit in the plan; if it has none, the bin's longest "
             "side is 0.6 m)")  # fmt: skip
    add("--density", nargs=2, type=float, metavar=("LOW", "HIGH"),
        help="draw the density of each box at random between these values, in kg/m³ "
             "(default: the weights of the packing)")  # fmt: skip
    add("--com-spread", type=float, metavar="SHARE",
        help="draw the centre of mass of each box at random, up to this share of each side away "
             "from the centre in the packing (default: 0)")  # fmt: skip


def chosen_bodies(options: argparse.Namespace) -> Bodies:
    """Return the bodies that ``--cell``, ``--density``, ``--com-spread`` and ``--seed`` choose.

    Raises:
        ValueError: for an impossible value.
    """
    density = None if options.density is None else (options.density[0], options.density[1])
    return Bodies(options.cell, density, options.com_spread or 0.0, options.seed)


def add_file_options(parser: argparse.ArgumentParser) -> None:
    """Add the file of packings, ``--episodes``, and the options of their bodies to a command."""
    parser.add_argument(
        "file", type=Path, help="a file written by pack, evaluate --save-stacks or play --save"
    )
    parser.add_argument(
        "--episodes", nargs="+", type=int, metavar="K",
        help="numbers of the episodes to judge (default: all); each bin of a plan is one",
    )  # fmt: skip
    add_body_options(parser.add_argument_group("bodies"))


def load_stacks(path: Path) -> list[Plan]:
    """Read a file of plans; return one plan for each bin, in order.

    Raises:
        ValueError: if the file is of another kind, or has an impossible value.
    """
    return [
        plan if len(plan.bin_sizes) == 1 else plan.in_bin(k)
        for plan in load_plans(path)
        for k in range(len(plan.bin_sizes))
    ]


def chosen_episodes(options: argparse.Namespace, plans: Sequence[Plan]) -> Sequence[int]:
    """Return the numbers of the episodes that ``--episodes`` chooses; all by default.

    Raises:
        ValueError: if there is no such episode.
    """
    every = range(len(plans))
    chosen = every if options.episodes is None else list(dict.fromkeys(options.episodes))
    for e in chosen:
        if e not in every:
            raise ValueError(f"--episodes {e}: needs numbers from 0 to {len(every) - 1}")
    return chosen

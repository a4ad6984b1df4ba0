"""Compare the size of each rule's mask with the exact one: ``python -m benchmarks.rules``.

Counts cells over all six orientations of the visible item, summed over all decisions of games that
are played under ``hull_alpha``. ``unsound`` is the share of a rule's cells that exact equilibrium
excludes. Linear programs a decision: the cells that ``hull_1`` allows and ``hull_alpha`` does not.
"""

from __future__ import annotations

import argparse
import time

import torch

from benchmarks.states import LARGE, SMALL
from benchmarks.timing import show
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing
from marl_pack.stability import RULES, make_rule


def compare(
    title: str, place: tuple[tuple[int, int, int], tuple[int, int]], policy: str, n: int, steps: int
) -> None:
    """Print the table of one setting: ``n`` bins, ``steps`` decisions in each."""
    size, sides = place
    game, player = Packing(n, size, sides=sides, seed=1), make_policy(policy, 1)
    rules = {name: make_rule(name) for name in RULES}
    cells = dict.fromkeys(RULES, 0)
    unsound = dict.fromkeys(RULES, 0)
    seconds = dict.fromkeys(RULES, 0.0)
    programs = between = 0
    for _ in range(steps):
        item = game.orient_item(game.items)
        masks = {}
        for name, rule in rules.items():
            start = time.process_time()
            masks[name] = rule(game.bins, item)
            seconds[name] += time.process_time() - start
        for name, mask in masks.items():
            cells[name] += int(mask.sum())
            unsound[name] += int((mask & ~masks["equilibrium"]).sum())
        programs += int((masks["hull_1"] & ~masks["hull_alpha"]).sum())
        between += int((masks["hull_1"] & ~masks["lbcp"]).sum())
        game.place(*player(game))
    decisions = n * steps
    rows = [
        [
            name,
            f"{cells[name] / cells['equilibrium']:.4f}",
            f"{cells[name] / cells['hull_1']:.4f}",
            f"{unsound[name] / max(cells[name], 1):.4f}",
            f"{1e6 * seconds[name] / decisions:,.1f}",
        ]
        for name in RULES
    ]
    show(
        f"{title}, {decisions:,} decisions",
        ["rule", "of equilibrium", "of hull_1", "unsound", "µs a decision"],
        rows,
    )
    print(
        f"linear programs a decision: {programs / decisions:.2f} "
        f"(beyond lbcp: {between / decisions:.2f})\n"
    )


def main() -> None:
    """Print the table of each setting."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.rules", description=__doc__)
    options.add_argument("--large-bins", type=int, default=24, help="bins at 120 × 120 × 120")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    compare("RS, 10³, random play", SMALL, "random", 512, 60)
    compare("RS, 10³, DBLF", SMALL, "dblf", 512, 60)
    compare("120³, sides 6–60, random play", LARGE, "random", chosen.large_bins, 30)


if __name__ == "__main__":
    main()

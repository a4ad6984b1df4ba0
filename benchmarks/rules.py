"""Compare the size of each rule's mask with the exact one: ``python -m benchmarks.rules``.

The program counts cells over all six orientations of the visible item, summed over all decisions of
games that are played under ``hull_alpha``. ``unsound`` is the share of a rule's cells that exact
equilibrium excludes. The linear programs for a decision are the cells that ``hull_1`` allows and
``hull_alpha`` does not.
"""

from __future__ import annotations

import time

import torch

from benchmarks.record import Measurements
from benchmarks.states import LARGE, SMALL
from marl_pack.agents.heuristics import make_policy
from marl_pack.game.packing import Packing
from marl_pack.stability import RULES, make_rule


def compare(
    measured: Measurements,
    title: str,
    place: tuple[tuple[int, int, int], tuple[int, int]],
    policy: str,
    n: int,
    steps: int,
) -> None:
    """Measure one setting: ``n`` bins with ``steps`` decisions in each."""
    size, sides = place
    game, player = Packing(n, size, sides=sides, seed=1), make_policy(policy, 1)
    rules = {name: make_rule(name) for name in RULES}
    cells = dict.fromkeys(RULES, 0)
    unsound = dict.fromkeys(RULES, 0)
    seconds = dict.fromkeys(RULES, 0.0)
    programs = between = 0
    for rule in rules.values():  # compiled code is loaded at its first use
        rule(game.bins, game.orient_item(game.items))
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
    for name in RULES:
        measured.keep(
            f"{title}: {name}",
            decisions=decisions,
            of_equilibrium=cells[name] / cells["equilibrium"],
            of_hull_1=cells[name] / cells["hull_1"],
            unsound=unsound[name] / max(cells[name], 1),
            us_decision=1e6 * seconds[name] / decisions,
        )
    measured.keep(
        f"{title}: linear programs",
        a_decision=programs / decisions,
        beyond_lbcp=between / decisions,
    )


def main() -> None:
    """Compare the rules in each setting."""
    measured = Measurements("rules", __doc__, seed=1)
    add = measured.options.add_argument
    add("--bins", type=int, default=512, help="number of bins of 10 × 10 × 10")
    add("--large-bins", type=int, default=24, help="number of bins of 120 × 120 × 120")
    chosen = measured.parse()
    torch.set_num_threads(1)
    compare(measured, "RS, random play", SMALL, "random", chosen.bins, 60)
    compare(measured, "RS, DBLF", SMALL, "dblf", chosen.bins, 60)
    compare(measured, "120³, random play", LARGE, "random", chosen.large_bins, 30)


if __name__ == "__main__":
    main()

"""Draw utilization against the spread of item volumes: ``python -m experiments.volume_spread``.

As in the paper's figure, episodes are grouped by the standard deviation of the volumes of their
items. The picture shows the mean utilization of each group with its 95 % interval. The rank
correlation is computed over all episodes.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from benchmarks.record import ROOT, Results, record
from experiments.rows import expanded, main_of, mean
from marl_pack.agents.loading import Loader
from marl_pack.evaluation.rollout import play
from marl_pack.files import moved_into_place
from marl_pack.game.packing import Packing
from marl_pack.geometry import Size
from marl_pack.items import Stream, choose_stream

mpl.use("Agg")
from matplotlib import pyplot as plt  # after the choice of a backend without windows

POLICIES = ("rs", "max_feasible", "dblf")
GROUPS = 8


def volume_spread(stream: Stream, episodes: int, seed: int) -> NDArray[np.float64]:
    """Return the standard deviation of the item volumes of each sequence, cells³ [E].

    Args:
        stream: the sequences of a file; all their items count.
        episodes: number of sequences E.
        seed: seed of the stream.
    """
    state = stream.start(seed, torch.arange(episodes))
    longest = stream.longest
    assert longest is not None, "a file's sequences have an end"
    volumes = []
    for t in range(longest):
        items = stream.item(state, torch.full((episodes,), t))
        volumes.append(items.sides.long().prod(1))
    table = torch.stack(volumes, 1).double()
    table[table == 0] = torch.nan  # after the end of the sequence
    return np.nanstd(table.numpy(), axis=1, ddof=1)


def utilization(policy: str, stream: Stream, size: Size, episodes: int) -> NDArray[np.float64]:
    """Return the utilization of each episode of a policy, [E]."""
    chosen = Loader().policy(policy)

    def game(n: int, first: int) -> Packing:
        return Packing(n, size, stream, auto_reset=False, first_episode=first)

    return play(chosen, game, episodes).utilization


def main() -> int:
    """Play the policies, draw the picture and store the figures; return the exit status."""
    options = argparse.ArgumentParser(prog="python -m experiments.volume_spread")
    options.add_argument("policies", nargs="*", default=POLICIES,
                         help="checkpoints, runs' folders or heuristics")  # fmt: skip
    options.add_argument("--items", default="$MARL_PACK_DATA/rs.npz", help="a file of sequences")
    options.add_argument("--picture", type=Path, default=ROOT / "docs" / "volume_spread.png")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    [items] = expanded(chosen.items)
    stream, size = choose_stream(items, None, (2, 5))
    if stream.episodes is None:
        raise ValueError(f"--items {chosen.items}: has sequences without end; give a file")
    spread = volume_spread(stream, stream.episodes, 0)
    edges = np.quantile(spread, np.linspace(0, 1, GROUPS + 1))
    group = np.clip(np.searchsorted(edges, spread, side="right") - 1, 0, GROUPS - 1)
    figure, panel = plt.subplots(figsize=(7, 4), layout="constrained")
    for p, policy in enumerate(chosen.policies):
        reached = 100 * utilization(policy, stream, size, stream.episodes)
        groups = [mean(reached[group == k]) for k in range(GROUPS)]
        middle = [np.median(spread[group == k]) for k in range(GROUPS)]
        panel.scatter(spread, reached, s=2, alpha=0.15, color=f"C{p}")
        centres, halves = [g["mean"] for g in groups], [g["half"] for g in groups]
        panel.errorbar(middle, centres, halves, marker="o", markersize=3, capsize=2, label=policy,
                       color=f"C{p}")  # fmt: skip
        rank, line = stats.spearmanr(spread, reached), stats.linregress(spread, reached)
        slope = {"mean": float(10 * line.slope), "half": float(19.6 * line.stderr)}
        figures = {
            "items": chosen.items, "episodes": stream.episodes,
            "rank_correlation": float(rank.statistic), "p": float(rank.pvalue),
            "points_per_10_cells": slope,
            "first_eighth": groups[0]["mean"], "last_eighth": groups[-1]["mean"],
        }  # fmt: skip
        command = f"python -m experiments.volume_spread {shlex.join(chosen.policies)}"
        Results("volume_spread").put(policy, figures, record(command))
        print(f"{policy}: rank correlation {rank.statistic:+.3f} (p = {rank.pvalue:.2g})")
    panel.set_xlabel("standard deviation of the item volumes of a sequence, cells")
    panel.set_ylabel("utilization, %")
    panel.grid(alpha=0.3)
    panel.legend(loc="lower left")
    with moved_into_place(chosen.picture) as part:
        figure.savefig(part, dpi=120)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))

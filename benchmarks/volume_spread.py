"""Draw utilization against the spread of item volumes, as the paper's figure does.

``python -m benchmarks.volume_spread CHECKPOINT --items rs.npz`` plays every sequence, groups the
episodes by the standard deviation of the volumes of their sequence's items and draws the mean
utilization of each group with its 95 % interval, beside the rank correlation over all episodes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats

from benchmarks.timing import show
from marl_pack.agents.heuristics import POLICIES
from marl_pack.agents.loading import Loader
from marl_pack.evaluation.rollout import play
from marl_pack.evaluation.statistics import interval
from marl_pack.files import moved_into_place
from marl_pack.game.packing import Packing
from marl_pack.geometry import Size
from marl_pack.items import Stream, choose_stream

GROUPS = 8


def volume_spread(stream: Stream, episodes: int, seed: int) -> NDArray[np.float64]:
    """Return the standard deviation of the item volumes of each sequence, cells³ [E].

    Args:
        stream: a file's sequences, of which all items count.
        episodes: E.
        seed: of the stream.
    """
    state = stream.start(seed, torch.arange(episodes))
    longest = stream.longest
    assert longest is not None, "a file's sequences have an end"
    volumes = []
    for t in range(longest):
        items = stream.item(state, torch.full((episodes,), t))
        volumes.append(items.sides.long().prod(1))
    table = torch.stack(volumes, 1).double()
    table[table == 0] = torch.nan  # past the end of its sequence
    return np.nanstd(table.numpy(), axis=1, ddof=1)


def utilization(policy: str, stream: Stream, size: Size, episodes: int) -> NDArray[np.float64]:
    """Return the utilization of each episode of a policy, [E]."""
    chosen = Loader().policy(policy)

    def game(n: int, first: int) -> Packing:
        return Packing(n, size, stream, auto_reset=False, first_episode=first)

    return play(chosen, game, episodes).utilization


def main() -> None:
    """Draw the picture and print the table."""
    options = argparse.ArgumentParser(prog="python -m benchmarks.volume_spread")
    options.add_argument("policies", nargs="+", help="checkpoints, runs' folders or heuristics")
    options.add_argument("--items", required=True, help="a file of sequences")
    options.add_argument("--picture", type=Path, default=Path("docs/volume_spread.png"))
    chosen = options.parse_args()
    torch.set_num_threads(1)
    stream, size = choose_stream(chosen.items, None, (2, 5))
    if stream.episodes is None:
        options.error(f"--items {chosen.items}: has sequences without end; give a file")
    spread = volume_spread(stream, stream.episodes, 0)
    edges = np.quantile(spread, np.linspace(0, 1, GROUPS + 1))
    group = np.clip(np.searchsorted(edges, spread, side="right") - 1, 0, GROUPS - 1)

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, panel = plt.subplots(figsize=(7, 4), layout="constrained")
    table: list[list[Any]] = []
    for p, policy in enumerate(chosen.policies):
        reached = 100 * utilization(policy, stream, size, stream.episodes)
        name = policy if policy in POLICIES else Path(policy).stem
        panel.scatter(spread, reached, s=2, alpha=0.15, color=f"C{p}")
        middle, mean, half = [], [], []
        for k in range(GROUPS):
            own = reached[group == k]
            low, high = interval(own) or (np.nan, np.nan)
            middle.append(np.median(spread[group == k]))
            mean.append(own.mean())
            half.append((high - low) / 2)
        panel.errorbar(middle, mean, half, marker="o", markersize=3, capsize=2, label=name,
                       color=f"C{p}")  # fmt: skip
        rank = stats.spearmanr(spread, reached)
        slope = stats.linregress(spread, reached)
        table.append(
            [name, f"{rank.statistic:+.3f} (p = {rank.pvalue:.2g})",
             f"{10 * slope.slope:+.2f} ± {19.6 * slope.stderr:.2f}",
             f"{mean[0]:.1f}", f"{mean[-1]:.1f}"]
        )  # fmt: skip
    panel.set_xlabel("standard deviation of the item volumes of a sequence, cells")
    panel.set_ylabel("utilization, %")
    panel.grid(alpha=0.3)
    panel.legend(loc="lower left")
    with moved_into_place(chosen.picture) as part:
        figure.savefig(part, dpi=120)
    show(
        f"{stream.episodes} sequences",
        ["policy", "rank correlation", "points per 10 cells", "first eighth", "last eighth"],
        table,
    )


if __name__ == "__main__":
    main()

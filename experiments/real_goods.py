"""Pack real goods in millimetres: ``python -m experiments.real_goods``.

The goods are three public lists (``$MARL_PACK_DATA/real``), played as a public benchmark plays them
(RoboBPP, arXiv 2512.04415): one visible box, two orientations, at most 80 boxes, the episode ends
at the first box that has no place. ``cases`` are the 37 disjoint windows of 80 rows of a list of
picks; ``mix`` and ``boards`` are 100 fixed draws of 80 boxes.

``--tune`` finds the weights of ``linear``, which are stored in ``experiments/weights``. No tuned
weights are measured on episodes that they were tuned on: ``mix`` and ``boards`` are tuned on other
draws; ``cases`` has two sets of weights, each tuned on one half of the picks and measured on the
other half.
"""

from __future__ import annotations

import csv
import os
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.record import record
from experiments.rows import Rows, main_of
from marl_pack.evaluation.rollout import Rollout, batches_mm
from marl_pack.evaluation.statistics import mean_utilization
from marl_pack.exact.goods import Goods, check_goods
from marl_pack.exact.packing import ExactPacking
from marl_pack.exact.policies import HEURISTICS, make_exact_policy, named_weights
from marl_pack.exact.spec import ExactSpec
from marl_pack.exact.streams import Draws, GoodsStream, windows
from marl_pack.exact.tuning import Episodes, tune, utilizations
from marl_pack.files import write_json
from marl_pack.game.packing import Packing
from marl_pack.plan import Plan
from marl_pack.terminal import make_console

LENGTH = 80
DRAWN = 100
BINS = {"cases": (1340, 1250, 1000), "mix": (1200, 1000, 1700), "boards": (2500, 1200, 1000)}
FILES = {"cases": "cases.csv", "mix": "articles.csv", "boards": "boards.csv"}
WEIGHTS = Path(__file__).with_name("weights")
TUNED_FOR = "--rule lbcp --margin-mm 20 --level-tolerance-mm 5"
RULES = {
    "none": "--rule none",
    "lbcp": "--rule lbcp",
    "lbcp, 5 mm of level tolerance": "--rule lbcp --level-tolerance-mm 5",
    "lbcp, 20 mm of margin": "--rule lbcp --margin-mm 20",
    "lbcp, 20 mm of margin, 5 mm of level tolerance": TUNED_FOR,
    "hull_alpha": "--rule hull_alpha",
    "hull_alpha, 20 mm of margin": "--rule hull_alpha --margin-mm 20",
}
POLICIES = ("max_contact", "linear", "tuned", "dblf", "height_min", "best_fit", "random")
CELLS = (10, 20, 50)
"""Cells in millimetres of the games on whole cells."""
BOUND = "volume bound"
"""The row of a stream that no policy can exceed."""
HALF = 19 * LENGTH
"""Rows of the list of picks in its first half: 19 windows."""


@cache
def read_rows(stream: str) -> list[dict[str, str]]:
    """Return the rows of a list of goods."""
    folder = os.environ.get("MARL_PACK_DATA")
    if folder is None:
        raise ValueError("needs the environment variable MARL_PACK_DATA, a folder with real/*.csv")
    with (Path(folder) / "real" / FILES[stream]).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read(stream: str, spec: ExactSpec) -> tuple[Goods, list[dict[str, str]]]:
    """Return the goods that fit into the bin, and their rows."""
    rows = read_rows(stream)
    sides = np.array([[int(row[f"{side}_mm"]) for side in "wdh"] for row in rows])
    long, short = sorted(BINS[stream][:2], reverse=True)
    fits = (sides[:, :2].max(1) <= long) & (sides[:, :2].min(1) <= short)
    rows = [row for row, fit in zip(rows, fits, strict=True) if fit]
    weights = {"weights": [float(row["weight_kg"]) for row in rows]} if stream == "cases" else {}
    return check_goods(sides[fits], spec, weights, source=FILES[stream]), rows


@dataclass(frozen=True)
class ShuffledOrders:
    """Windows of a list of picks whose orders come in a random order."""

    goods: Goods
    orders: list[NDArray[np.int64]]  # the rows of each order
    seed: int

    @property
    def episodes(self) -> int | None:
        """None: any number of episodes."""
        return None

    def sequence(self, episode: int) -> NDArray[np.int64]:
        """Return the rows of one window."""
        generator = np.random.default_rng((self.seed, episode))
        rows = np.concatenate([self.orders[k] for k in generator.permutation(len(self.orders))])
        first = generator.integers(0, len(rows) - LENGTH + 1)
        return rows[first : first + LENGTH]

    def seeded(self, seed: int) -> GoodsStream:
        """Return the stream with another seed."""
        return replace(self, seed=seed)


def spec_of(stream: str, options: str) -> ExactSpec:
    """Return the game of a stream with options as on the command line."""
    words = options.split()
    values: dict[str, Any] = {
        flag.removeprefix("--").replace("-", "_"): value
        for flag, value in zip(words[::2], words[1::2], strict=True)
    }
    numbers: dict[str, Any] = {
        key: value if key == "rule" else float(value) for key, value in values.items()
    }
    return ExactSpec(bin_mm=BINS[stream], orientations=(0, 1), max_boxes=LENGTH, **numbers)


def make_stream(stream: str, spec: ExactSpec, seed: int = 0) -> tuple[GoodsStream, int]:
    """Return the stream and its number of episodes."""
    goods, rows = read(stream, spec)
    if stream == "cases":
        return windows(goods, LENGTH), len(goods) // LENGTH
    shares = None
    if stream == "mix":
        shares = np.array([float(row["shipments"]) for row in rows])
        shares = shares / shares.sum()
    return Draws(goods, LENGTH, seed, shares), DRAWN


# --- tuning ---------------------------------------------------------------------------------------


def tuning_stream(name: str, spec: ExactSpec, seed: int) -> GoodsStream:
    """Return the stream that weights are tuned on: ``mix``, ``boards``, ``cases_a``, ``cases_b``.

    ``cases_a`` are tuned on the first half of the picks, ``cases_b`` on the second half.
    """
    if not name.startswith("cases"):
        return make_stream(name, spec, 1000 + seed)[0]
    goods, rows = read("cases", spec)
    half = range(HALF) if name == "cases_a" else range(HALF, len(rows))
    orders: dict[str, list[int]] = {}
    for row in half:
        orders.setdefault(rows[row]["order"], []).append(row)
    return ShuffledOrders(goods, [np.array(order) for order in orders.values()], 1000 + seed)


def tune_weights(name: str, minutes: float, games: int, seed: int) -> None:
    """Tune the weights of ``linear`` for one stream, and write them.

    Args:
        name: the stream (:func:`tuning_stream`).
        minutes: how long to search.
        games: episodes in a generation.
        seed: seed of episodes and search.
    """
    spec = spec_of(name.split("_")[0], TUNED_FOR)
    stream = tuning_stream(name, spec, seed)
    episodes, start = Episodes(stream, seed), HEURISTICS["max_contact"]().weights
    held_back = episodes.measuring(100)

    def share(weights: NDArray[np.float64], numbers: list[int]) -> float:
        return float(utilizations(weights, stream, spec, numbers).mean())

    base, begin, shown, console = share(start, held_back), time.monotonic(), 0.0, make_console()
    for generation in tune(share, lambda: episodes.tuning(games), start=start, seed=seed):
        spent = time.monotonic() - begin
        if spent - shown > 60 or spent > 60 * minutes:
            shown = spent
            relative = share(generation.weights, held_back) / base
            console.print(
                f"{name}: generation {generation.number}, {spent:.0f} s, {relative:.4f} of "
                "max_contact", soft_wrap=True
            )  # fmt: skip
            write_json(WEIGHTS / f"{name}.json", {
                "weights": named_weights(generation.weights), "streams": [name],
                "options": TUNED_FOR, "generations": generation.number,
                "seconds": round(spent), "games": games, "seed": seed,
                "relative_to_max_contact": relative,
            })  # fmt: skip
        if spent > 60 * minutes:
            return


# --- playing --------------------------------------------------------------------------------------


def play(stream: str, policy: str, options: str) -> Rollout:
    """Play all episodes of a stream; ``tuned`` uses the weights tuned for it."""
    spec = spec_of(stream, options)
    source, episodes = make_stream(stream, spec)

    def part(weights: Any, first: int, last: int) -> Rollout:
        """Play the episodes from ``first`` to before ``last``."""

        def game(n: int, k: int) -> ExactPacking:
            return ExactPacking(n, source, spec=spec, auto_reset=False, first_episode=first + k)

        chosen = make_exact_policy(weights)
        next(batches_mm(chosen, game, 1))  # compiles the code
        (rollout,) = batches_mm(chosen, game, last - first)
        return rollout

    if policy != "tuned":
        return part(policy, 0, episodes)
    if stream != "cases":
        return part(WEIGHTS / f"{stream}.json", 0, episodes)
    first, last = HALF // LENGTH, episodes
    parts = [
        part(WEIGHTS / "cases_b.json", 0, first), part(WEIGHTS / "cases_a.json", first, last)
    ]  # fmt: skip
    return Rollout([plan for half in parts for plan in half.plans], sum(p.seconds for p in parts))


def play_cells(stream: str, policy: str, cell: int) -> Rollout:
    """Play a stream on whole cells, sizes rounded up; the plans have the true sizes.

    A sequence ends before the first box that is too large when it is rounded up.
    """
    from marl_pack.agents.heuristics import make_policy

    spec = spec_of(stream, "--rule none")
    source, episodes = make_stream(stream, spec)
    units = source.goods.sides // 10  # millimetres
    width, depth, height = (side // cell for side in BINS[stream])
    rounded = -(-units // cell)
    long, short = rounded[:, :2].max(1), rounded[:, :2].min(1)
    fits = (long <= max(width, depth)) & (short <= min(width, depth)) & (rounded[:, 2] <= height)
    sequences = [source.sequence(e) for e in range(episodes)]
    sequences = [rows[: int(np.append(fits[rows], False).argmin())] for rows in sequences]
    played = [rounded[rows] for rows in sequences if len(rows)]
    game = Packing(
        len(played), (width, depth, height), items=played, rule="hull_alpha", orientations=(0, 1),
        auto_reset=False,
    )  # fmt: skip
    chosen = make_policy(policy)
    start = time.perf_counter()
    while game.alive.any():
        game.place(*chosen(game))
    seconds = time.perf_counter() - start
    packed = iter(game.plans())
    plans = []
    for rows in sequences:
        if not len(rows):
            plans.append(Plan.of_boxes(BINS[stream], np.empty((0, 6), np.int64), unit_mm=1.0))
            continue
        plan = next(packed)
        boxes = plan.boxes.astype(np.int64) * cell
        true = units[rows[: len(boxes)]]
        turned = plan.orientations == 1
        true[turned] = true[turned][:, [1, 0, 2]]
        boxes[:, 3:] = true
        plans.append(Plan.of_boxes(BINS[stream], boxes, unit_mm=1.0))
    return Rollout(plans, seconds)


def measure(key: str) -> dict[str, Any]:
    """Measure one row, such as ``mix max_contact --rule none`` or ``mix dblf cells of 10 mm``."""
    stream, policy, options = key.split(" ", 2)
    if f"{policy} {options}" == BOUND:
        return volume_bound(stream)
    if options.startswith("cells"):
        rollout = play_cells(stream, policy, int(options.split()[2]))
    else:
        rollout = play(stream, policy, options)
    figures = mean_utilization(rollout)
    figures["interval"] = figures.pop("low"), figures.pop("high")
    return figures


def volume_bound(stream: str) -> dict[str, Any]:
    """Return the mean over episodes of the boxes' volume, at most that of the bin."""
    spec = spec_of(stream, "--rule none")
    source, episodes = make_stream(stream, spec)
    volumes = [source.goods.volumes[source.sequence(e)].sum() for e in range(episodes)]
    shares = np.array(volumes) / np.prod(np.array(spec.size, np.float64))
    return {"episodes": episodes, "utilization": float(shares.clip(max=1).mean())}


def keys() -> Iterator[str]:
    """Yield the keys of all rows."""
    for stream in BINS:
        yield f"{stream} {BOUND}"
        for options in RULES.values():
            for policy in POLICIES:
                yield f"{stream} {policy} {options}"
        for cell in CELLS:
            for policy in ("dblf", "height_min"):
                yield f"{stream} {policy} cells of {cell} mm"


def main() -> int:
    """Measure the chosen rows, or tune weights."""
    rows = Rows("python -m experiments.real_goods", __doc__ or "")
    add = rows.options.add_argument
    add("--tune", metavar="STREAM", choices=("mix", "boards", "cases_a", "cases_b"),
        help="tune weights for this stream, and measure nothing")  # fmt: skip
    add("--minutes", type=float, default=10.0, help="how long to tune (default: 10)")
    add("--games", type=int, default=24, help="episodes in a generation (default: 24)")
    add("--seed", type=int, default=0, help="seed of the tuning (default: 0)")
    arguments = rows.parse()
    if arguments.tune is not None:
        tune_weights(arguments.tune, arguments.minutes, arguments.games, arguments.seed)
        return 0
    results = rows.results("real_goods")
    console = make_console()
    for key in rows.missing(results, keys()):
        figures = measure(key)
        words = " ".join(word for word in key.split() if not word.startswith("--"))
        results.put(key, figures, record(f"python -m experiments.real_goods --only {words}"))
        console.print(f"{key}: {figures}", soft_wrap=True)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))

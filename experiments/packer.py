"""Feed real goods to the packer: ``python -m experiments.packer``.

The streams are those of :mod:`experiments.real_goods`, under ``lbcp`` with a margin of 20 mm and
5 mm of level tolerance. Each bin is packed by :class:`marl_pack.packer.packer.Packer` until the
first box without a place. ``search`` uses the weights tuned for a stream; its futures are drawn
from the goods (``cases``: they follow the order of the half of the picks that the episode is not
in).
Searches stop by the clock, so faster machines have higher figures.

``answers`` are the times of ``marl-pack pack -``; ``orders`` are packed onto pallets. ``poses`` are
packings by tuned ``linear`` in which each box is put down with an error, which is reported to the
packer; a trial then builds them as they are (:mod:`marl_pack.sapien_check.trials`).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.record import ROOT, record
from experiments.real_goods import (
    BINS,
    HALF,
    LENGTH,
    TUNED_FOR,
    WEIGHTS,
    make_stream,
    play,
    read,
    read_rows,
    spec_of,
)
from experiments.rows import Rows, main_of, mean
from marl_pack import pack as pack_command
from marl_pack.evaluation.rollout import Rollout
from marl_pack.evaluation.statistics import mean_utilization, share_interval
from marl_pack.exact.futures import Catalogue, Futures, History
from marl_pack.exact.lengths import to_mm
from marl_pack.files import write_csv
from marl_pack.packer.answers import Placement
from marl_pack.packer.packer import Packer
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans, save_plans
from marl_pack.sapien_check.stack import Stack
from marl_pack.sapien_check.trials import Trial, TrialResult, run_trials
from marl_pack.sapien_check.world import SimulationError

BUDGETS = (500, 100)
"""Milliseconds of a decision."""
SEARCHED = 60
"""Episodes of a search at most, the first ones of a stream."""
PLANS = ROOT / "build" / "packer"
"""Folder of the packings by search, which the trials build."""
TRIAL = Trial(place_error=0.002, yaw=0.3, drop=0.002, size_error=0.01)
POSES = 200
"""Packings with reported poses."""
PLACE_ERROR, YAW = 3.0, 1.0
"""Largest errors of a pose: millimetres, and degrees."""
CLEARANCE = 10.0
"""Millimetres of clearance, which such errors ask for: a box of 600 mm that is rotated by 1 degree
reaches 5 mm farther."""


def episodes_of(stream: str) -> int:
    """Return the number of episodes of a stream."""
    return make_stream(stream, spec_of(stream, TUNED_FOR))[1]


@cache
def futures_of(stream: str, second_half: bool) -> Futures:
    """Return the futures of a search; ``second_half`` says where the episode of cases is."""
    spec = spec_of(stream, TUNED_FOR)
    source, _ = make_stream(stream, spec)
    if stream != "cases":
        return Catalogue(source.goods, getattr(source, "probabilities", None))
    goods, rows = read("cases", spec)
    return History(goods[np.arange(HALF) if second_half else np.arange(HALF, len(rows))])


def weights_of(stream: str, second_half: bool) -> Path:
    """Return the tuned weights of a stream; those for cases are of the other half."""
    if stream != "cases":
        return WEIGHTS / f"{stream}.json"
    return WEIGHTS / f"cases_{'a' if second_half else 'b'}.json"


def pack(stream: str, policy: str, plan: str | None, episode: int) -> tuple[Plan, list[float]]:
    """Pack one episode; return the plan and the seconds of each answer."""
    spec = spec_of(stream, TUNED_FOR)
    source, _ = make_stream(stream, spec)
    second_half = episode >= HALF // LENGTH
    options: dict[str, Any] = {}
    if plan is not None:
        options = {"plan": plan, "catalogue": futures_of(stream, second_half)}
    chosen = weights_of(stream, second_half) if policy in ("tuned", "search") else policy
    packer = Packer(spec=spec, policy=chosen, seed=episode, **options)
    times = []
    for row in source.sequence(episode):
        sides = to_mm(source.goods.sides[row], spec.unit_mm).tolist()
        weight = float(source.goods.weights[row])
        if len(packer.placements) >= spec.max_boxes:
            break
        start = time.perf_counter()
        answer = packer.place(sides, weight=None if np.isnan(weight) else weight)
        times.append(time.perf_counter() - start)
        if not answer:
            break
    return packer.plan, times


def play_stream(
    stream: str, policy: str, plan: str | None, processes: int
) -> tuple[list[Plan], list[float]]:
    """Pack all episodes of a row, in several processes."""
    count = episodes_of(stream)
    if plan is not None:
        count = min(count, SEARCHED)
    pack(stream, policy, None if plan is None else "budget=1ms", 0)  # compiles the code
    task = partial(pack, stream, policy, plan)
    if processes == 1:
        done = [task(episode) for episode in range(count)]
    else:
        with ProcessPoolExecutor(processes, get_context("fork")) as pool:
            done = list(pool.map(task, range(count)))
    return [plan for plan, _ in done], [t for _, times in done for t in times]


def measure_policy(key: str, processes: int) -> dict[str, Any]:
    """Measure a row such as ``mix max_contact`` or ``mix search budget=500ms``."""
    stream, policy, *rest = key.split()
    plan = rest[0] if rest else None
    plans, times = play_stream(stream, policy, plan, processes)
    figures = mean_utilization(Rollout(plans, sum(times)))
    figures["interval"] = figures.pop("low"), figures.pop("high")
    figures |= {
        "median_ms": 1000 * float(np.median(times)), "mean_ms": 1000 * float(np.mean(times)),
        "worst_ms": 1000 * max(times),
    }  # fmt: skip
    if plan is None:  # the exact world's own figures
        exact = [p.utilization for p in play(stream, policy, TUNED_FOR).plans]
        figures["equal"] = bool(np.allclose([p.utilization for p in plans], exact, rtol=1e-12))
    else:
        PLANS.mkdir(parents=True, exist_ok=True)
        save_plans(PLANS / f"{stream}_{plan}.npz", plans)
        linear = np.array(
            [pack(stream, "tuned", None, e)[0].utilization for e in range(len(plans))]
        )
        gain = np.array([p.utilization for p in plans]) - linear
        figures["gain"] = mean(gain)
    return figures


def trial_figures(results: Sequence[TrialResult | SimulationError]) -> dict[str, Any]:
    """Return the figures of trials."""
    run = [result for result in results if isinstance(result, TrialResult)]
    collapses = sum(result.collapse is not None for result in run)
    return {
        "trials": len(run), "errors": len(results) - len(run), "collapses": collapses,
        "collapse_interval": share_interval(collapses, len(run)),
        "left_out": sum(len(result.left_out) for result in run),
        "planned": float(np.mean([result.planned for result in run])),
        "in_physics": float(np.mean([result.in_physics for result in run])),
    }  # fmt: skip


def measure_trial(stream: str, processes: int) -> dict[str, Any]:
    """Build the packings by search in physics, with errors of place and size."""
    path = PLANS / f"{stream}_budget={BUDGETS[0]}ms.npz"
    if not path.is_file():
        raise ValueError(f"{path}: no such file; the row '{stream} search …' makes it")
    stacks = ((Stack.of_plan(plan), e, 0) for e, plan in enumerate(load_plans(path)))
    return trial_figures(list(run_trials(stacks, TRIAL, processes)))


# --- reported poses -------------------------------------------------------------------------------


def pack_with_errors(stream: str, episode: int) -> tuple[Plan, int, int]:
    """Pack with an error at each placement, which is reported to the packer.

    Args:
        stream: the goods.
        episode: number of the episode; it determines the errors.

    Returns:
        The plan of the true poses; how many poses were flagged; and how many could not be, because
        boxes would overlap.
    """
    options = f"{TUNED_FOR} --clearance-mm {CLEARANCE}"
    spec = spec_of(stream, options)
    source, _ = make_stream(stream, spec, seed=7)
    packer = Packer(spec=spec, policy=weights_of(stream, False))
    generator = np.random.default_rng((11, episode))
    flagged = impossible = 0
    for row in source.sequence(episode):
        if len(packer.placements) >= spec.max_boxes:
            break
        answer = packer.place(to_mm(source.goods.sides[row], spec.unit_mm).tolist())
        if not isinstance(answer, Placement):
            break
        radius = PLACE_ERROR * np.sqrt(generator.uniform())
        angle, yaw = generator.uniform(0, 2 * np.pi), generator.uniform(-YAW, YAW)
        x, y = answer.centre[0] + radius * np.cos(angle), answer.centre[1] + radius * np.sin(angle)
        try:
            flagged += bool(packer.actual((x, y, yaw)).problem)
        except ValueError:
            impossible += 1
    return packer.plan, flagged, impossible


def measure_poses(stream: str, processes: int) -> dict[str, Any]:
    """Measure packings whose true poses are reported to the packer, and without errors."""
    done = [pack_with_errors(stream, episode) for episode in range(POSES)]
    plans = [plan for plan, _, _ in done]
    exact = [pack_exactly(stream, episode) for episode in range(POSES)]
    stacks = ((Stack.of_plan(plan), e, 0) for e, plan in enumerate(plans))
    results = list(run_trials(stacks, Trial(), processes))
    utilization = np.array([plan.utilization for plan in plans])
    without = np.array([plan.utilization for plan in exact])
    return trial_figures(results) | {
        "placements": sum(map(len, plans)), "flagged": sum(flagged for _, flagged, _ in done),
        "impossible": sum(impossible for *_, impossible in done),
        "utilization": mean(utilization), "without_errors": mean(without),
        "lost": mean(without - utilization),
    }  # fmt: skip


def pack_exactly(stream: str, episode: int) -> Plan:
    """Pack an episode of the same goods without errors, and without the clearance."""
    spec = spec_of(stream, TUNED_FOR)
    source, _ = make_stream(stream, spec, seed=7)
    packer = Packer(spec=spec, policy=weights_of(stream, False))
    for row in source.sequence(episode):
        if len(packer.placements) >= spec.max_boxes:
            break
        if not packer.place(to_mm(source.goods.sides[row], spec.unit_mm).tolist()):
            break
    return packer.plan


# --- answers and orders ---------------------------------------------------------------------------

PALLET = ("--bin-mm", "1200", "800", "1500", "--margin-mm", "20")
CASES = ((400, 300, 250, 8.2), (395, 295, 285, 11.5), (300, 200, 180, 4.1), (600, 400, 320, 16.0),
         (330, 250, 140, 3.3), (285, 190, 160, 2.2))  # fmt: skip
"""Mixed cases: sides in mm and kilograms. Some stay upright, the last are not stackable."""
ANSWERED = 60
ORDERS = {
    "bed_bpp": ("--bin-mm", "1200", "800", "2000", "--margin-mm", "20"),
    "two_pallets": PALLET,
}
"""Options of the pallets of each set of orders."""


def case_rows() -> list[dict[str, Any]]:
    """Return 60 mixed cases in runs of equal ones, as lines of a conveyor have them."""
    generator = np.random.default_rng(7)
    rows: list[dict[str, Any]] = []
    while len(rows) < ANSWERED:
        kind, count = int(generator.integers(len(CASES))), int(generator.integers(1, 5))
        w, d, h, kilograms = CASES[kind]
        for _ in range(min(count, ANSWERED - len(rows))):
            rows.append({
                "id": f"case {kind}-{len(rows)}", "w_mm": w, "d_mm": d, "h_mm": h,
                "weight_kg": kilograms, "upright": kind in (1, 3), "stackable": kind != 5,
            })  # fmt: skip
    return rows


def measure_answers(policy: str) -> dict[str, Any]:
    """Measure the time of each answer of ``marl-pack pack -``, which also writes the plan."""
    text = "".join(json.dumps(row) + "\n" for row in case_rows())
    PLANS.mkdir(parents=True, exist_ok=True)
    out = PLANS / f"answers_{policy}.json"
    command = [sys.executable, "-m", "marl_pack.pack", "-", "--policy", policy, *PALLET, "--out",
               str(out)]  # fmt: skip
    for _ in range(2):  # the first run may compile code
        run = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    times = [json.loads(line)["ms"] for line in run.stdout.splitlines()]
    plan = Plan.from_json(out)
    return {
        "boxes": len(times), "packed": len(plan), "bins": len(plan.bin_sizes),
        "first_bin": plan.in_bin(0).utilization, "median_ms": float(np.median(times)),
        "worst_ms": max(times),
    }  # fmt: skip


def orders_file(name: str) -> Path:
    """Return a file of orders: BED-BPP's, or three orders of the picks that need two pallets."""
    folder = Path(os.environ["MARL_PACK_DATA"]) / "real"
    if name == "bed_bpp":
        return folder / "orders_bed_bpp.json"
    path = PLANS / "two_pallets.csv"
    orders: dict[str, list[dict[str, str]]] = {}
    for row in read_rows("cases"):
        orders.setdefault(row["order"], []).append(row)
    chosen: list[dict[str, str]] = []
    for order, rows in orders.items():
        packer = Packer((1200, 800, 1500), margin_mm=20, bins=3)
        fits = all(
            packer.place(
                [float(row[f"{side}_mm"]) for side in "wdh"], weight=float(row["weight_kg"]),
                upright=True, order=order,
            )
            for row in rows
            for _ in range(int(row["quantity"]))
        )  # fmt: skip
        if fits and packer.state.bins == 2:
            chosen += [{**row, "upright": "yes"} for row in rows]
            if len({row["order"] for row in chosen}) == 3:
                break
    PLANS.mkdir(parents=True, exist_ok=True)
    write_csv(path, [list(chosen[0]), *(list(row.values()) for row in chosen)])
    return path


def measure_orders(name: str, policy: str) -> dict[str, Any]:
    """Pack orders with ``marl-pack pack``; return the bins of each order."""
    out = PLANS / f"{name}_{policy}.json"
    words = [str(orders_file(name)), "--policy", policy, *ORDERS[name], "--out", str(out)]
    if policy == "search":
        words += ["--plan", f"budget={BUDGETS[0]}ms"]
    if pack_command.main(words):
        raise ValueError(f"{name}: could not be packed")
    plan = Plan.from_json(out)
    bins = []
    for k, order in enumerate(plan.orders):
        packed = plan.in_bin(k)
        width, depth, _ = packed.bin_sizes[0].tolist()
        top = float((packed.positions + packed.sides)[:, 2].max())
        volume = float(packed.sides.astype(np.float64).prod(1).sum())
        bins.append({
            "order": order, "boxes": len(packed), "utilization": packed.utilization,
            "height_mm": top, "fill": volume / (width * depth * top),
            "kilograms": float(packed.weights.sum()),
        })  # fmt: skip
    return {"bins": bins, "left_out": len(plan.left_out)}


# --- rows -----------------------------------------------------------------------------------------


def keys() -> Iterator[str]:
    """Yield the keys of all rows."""
    for stream in BINS:
        for policy in ("max_contact", "linear", "tuned"):
            yield f"{stream} {policy}"
    for budget in BUDGETS:
        for stream in BINS:
            yield f"{stream} search budget={budget}ms"
    for stream in BINS:
        yield f"{stream} trial"
    yield "mix poses"
    for policy in ("max_contact", "linear", "rs"):
        yield f"answers {policy}"
    for name in ORDERS:
        for policy in ("max_contact", "linear", "search"):
            yield f"orders {name} {policy}"


def measure(key: str, processes: int) -> dict[str, Any]:
    """Return the figures of the row with a key."""
    stream, kind, *rest = key.split()
    if stream == "answers":
        return measure_answers(kind)
    if stream == "orders":
        return measure_orders(kind, *rest)
    if kind == "trial":
        return measure_trial(stream, processes)
    if kind == "poses":
        return measure_poses(stream, processes)
    return measure_policy(key, processes)


def main() -> int:
    """Measure the chosen rows."""
    rows = Rows("python -m experiments.packer", __doc__ or "")
    rows.options.add_argument(
        "--processes", type=int, default=os.cpu_count() or 1, metavar="N",
        help="processes that pack or judge at once (default: all cores)",
    )  # fmt: skip
    chosen = rows.parse()
    results = rows.results("packer")
    for key in rows.missing(results, keys()):
        figures = measure(key, chosen.processes)
        results.put(key, figures, record(f"python -m experiments.packer --only {key}"))
        print(f"{key}: {figures}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main_of(main))

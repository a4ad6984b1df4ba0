"""Play policies on item sequences and report what they reach.

``python -m marl_pack.evaluate --policy dblf --items rs --episodes 1000`` prints a table: mean
utilization with its 95 % interval, its standard deviation, items packed, decisions a second, and
the share of episodes whose final stack is in strict static equilibrium as a whole, judged by a
linear program that shares no code with the masks.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from rich import box
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from scipy import stats

from marl_pack.agents.heuristics import ORIENTATION_AGENTS, POLICIES, make_policy
from marl_pack.agents.policy import Policy, in_turns
from marl_pack.bins import Size, check_device
from marl_pack.files import check_writable, write_atomically, write_json
from marl_pack.items import (
    DEFAULT_SIDES,
    GENERATED,
    Stream,
    choose_stream,
    independent,
    make_stream,
)
from marl_pack.packing import ALL_ORIENTATIONS, Packing
from marl_pack.sapien_check.judge import SimulationError, judge_all, load_sapien
from marl_pack.sapien_check.packings import Bodies
from marl_pack.stability import RULES, in_equilibrium
from marl_pack.stability.candidates import NO_OFFSET

BATCH = 1024  # bins played at once, at most
BATCH_CELLS = 1 << 20  # cells in the maps of those bins, at most
NOT_STACKS = "not a file of stacks from evaluate --save-stacks"
EPISODES = 1000  # of a generated stream, unless told
DEFAULTS: dict[str, Any] = {
    "items": "rs", "bin": None, "sides": DEFAULT_SIDES, "rule": "hull_alpha", "margin": None,
    "thresholds": None, "orientations": list(ALL_ORIENTATIONS), "mask_orientations": True,
    "com_offset": NO_OFFSET,
}  # fmt: skip
"""The game's options where neither the command line nor a checkpoint says; ``bin`` None is the
file's own or 10 x 10 x 10."""


@dataclass(frozen=True)
class Episodes:
    """What a policy did in E episodes, one row each."""

    size: Size  # W, D, H
    utilization: NDArray[np.float64]  # [E]
    packed: NDArray[np.int64]  # [E]          boxes in the bin at the end
    boxes: NDArray[np.int16]  # [E, M, 6]     x, y, z, w, d, h in order of placement, then zeros
    loads: NDArray[np.float64]  # [E, M, 3]   weight and x, y of the centre of mass of each box
    seconds: float  # spent in the game and the policy


def play(
    policy: Policy,
    game: Callable[[int, int], Packing],
    episodes: int,
    progress: Callable[[int], object] = lambda done: None,
) -> Episodes:
    """Play episodes 0 … episodes - 1 to their end.

    Args:
        policy: of both agents.
        game: (n, first_episode) -> a game of n bins without ``auto_reset``.
        episodes: how many, E.
        progress: called with the number of episodes that have just ended.
    """
    parts: list[tuple[NDArray[Any], ...]] = []
    seconds, size = 0.0, game(1, 0).size
    batch = max(1, min(BATCH, BATCH_CELLS // (size[0] * size[1])))
    first = 0
    while first < episodes:
        table = game(min(batch, episodes - first), first)
        first += batch
        progress(int((~table.alive).sum()))
        start = time.perf_counter()
        while bool(table.alive.any()):
            outcome = table.place(*policy(table))
            progress(int(outcome.done.sum()))
        seconds += time.perf_counter() - start
        bins = table.bins.to("cpu")
        most = max(int(bins.count.max()), 1)
        void = torch.arange(most) >= bins.count[:, None]
        parts.append(
            (
                bins.filled.double().numpy() / np.prod(size),
                bins.count.numpy(),
                bins.boxes[:, :most].masked_fill(void[..., None], 0).numpy(),
                bins.loads[:, :most].masked_fill(void[..., None], 0).numpy(),
            )
        )
    most = max(part[2].shape[1] for part in parts)

    def padded(rows: NDArray[Any]) -> NDArray[Any]:
        return np.pad(rows, ((0, 0), (0, most - rows.shape[1]), (0, 0)))

    return Episodes(
        size,
        np.concatenate([part[0] for part in parts]),
        np.concatenate([part[1] for part in parts]),
        np.concatenate([padded(part[2]) for part in parts]),
        np.concatenate([padded(part[3]) for part in parts]),
        seconds,
    )


def strict_equilibrium(
    played: Episodes, progress: Callable[[int], object] = lambda done: None
) -> NDArray[np.bool_]:
    """Bool [E]: whether each final stack is in strict equilibrium as a whole (HiGHS)."""
    stands = np.empty(len(played.packed), np.bool_)
    for e, n in enumerate(played.packed):
        stands[e] = in_equilibrium(played.boxes[e, :n], played.loads[e, :n])
        progress(1)
    return stands


def falls(
    played: Episodes,
    bodies: Bodies,
    processes: int = 1,
    progress: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Judge every packing in physics, after each placement up to its first fall.

    Keys ``falls`` (episodes in which something fell), ``no_verdict`` (episodes that could not be
    judged), ``judged`` (placements) and ``judge_seconds`` (a placement).
    """
    judged = []
    for one in judge_all(bodies.stacks(played, range(len(played.packed))), processes=processes):
        judged.append(one)
        progress()
    placements = sum(one.placements for one in judged)
    return {
        "falls": sum(one.fall is not None for one in judged),
        "no_verdict": sum(one.error is not None for one in judged),
        "judged": placements,
        "judge_seconds": sum(one.seconds for one in judged) / max(placements, 1),
    }


def interval(values: NDArray[np.floating[Any]]) -> tuple[float, float] | None:
    """The 95 % interval of the mean (Student's); None for a single value."""
    if len(values) < 2:
        return None
    if np.ptp(values) == 0:  # Student's would be NaN
        return float(values[0]), float(values[0])
    bounds = stats.ttest_1samp(values, 0.0).confidence_interval(0.95)
    return float(bounds.low), float(bounds.high)


def mean_utilization(played: Episodes) -> dict[str, Any]:
    """Mean utilization with its 95 % interval (Student's, over episodes), and items packed.

    Keys ``episodes``, ``utilization``, ``low``, ``high``, ``std``, ``packed``; shares of the bin's
    volume. A single episode has no interval and no std (None).
    """
    u = played.utilization
    low, high = interval(u) or (None, None)
    return {
        "episodes": len(u),
        "utilization": float(u.mean()),
        "low": low,
        "high": high,
        "std": float(u.std(ddof=1)) if len(u) > 1 else None,
        "packed": float(played.packed.mean()),
    }


def summary(played: Episodes, stands: NDArray[np.bool_]) -> dict[str, Any]:
    """The figures of the table; utilization in shares of the bin's volume."""
    found = mean_utilization(played)
    low, high = found.pop("low"), found.pop("high")
    return {
        **found,
        "interval": None if low is None else [low, high],
        "decisions_per_second": float(played.packed.sum() / max(played.seconds, 1e-9)),
        "strict_equilibrium": float(stands.mean()),
    }


def show(rows: dict[str, dict[str, Any]], title: str, console: Console) -> None:
    """Print the table, a row for each policy."""
    table = Table(title=title, box=box.SIMPLE, pad_edge=False)
    table.add_column("policy", overflow="fold")
    physics = any("falls" in row for row in rows.values())
    columns = ["episodes", "utilization %", "std", "items", "dec./s", "strict"]
    for column in [*columns, "falls"] if physics else columns:
        table.add_column(column, justify="right", no_wrap=True)
    for name, row in rows.items():
        spread = ("", "")
        if row["interval"] is not None:
            half = (row["interval"][1] - row["interval"][0]) / 2
            spread = f" ± {100 * half:.2f}", f"{100 * row['std']:.2f}"
        table.add_row(
            name,
            str(row["episodes"]),
            f"{100 * row['utilization']:.2f}{spread[0]}",
            spread[1],
            f"{row['packed']:.2f}",
            f"{row['decisions_per_second']:,.0f}",
            f"{100 * row['strict_equilibrium']:.2f} %",
            *([str(row["falls"])] if physics else []),
        )
    console.print(table)
    console.print(
        "±: 95 % interval of the mean; dec./s: decisions (items placed) a second;\n"
        "strict: final stacks in strict equilibrium as a whole"
        + ("\nfalls: episodes in which something fell, in physics" if physics else "")
    )


def save_stacks(path: Path, played: Episodes) -> None:
    """Save the packed boxes as ``.npz``: ``bin`` [3], ``count`` [E], ``boxes``, ``loads``."""
    write_atomically(
        path,
        lambda file: np.savez_compressed(
            file,
            bin=np.array(played.size),
            count=played.packed,
            boxes=played.boxes,
            loads=played.loads,
            utilization=played.utilization,
        ),
    )


def load_stacks(path: str | Path) -> Episodes:
    """Read what :func:`save_stacks` wrote.

    Raises:
        ValueError: if it is another kind of file.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            size, boxes = archive["bin"], archive["boxes"]
            count, loads, reached = archive["count"], archive["loads"], archive["utilization"]
    except OSError as error:
        if Path(path).is_file():
            raise ValueError(f"{path}: {NOT_STACKS}") from error
        raise
    except Exception as error:
        raise ValueError(f"{path}: {NOT_STACKS}") from error
    e, most = boxes.shape[:2] if boxes.ndim == 3 else (0, 0)
    right = (
        size.shape == (3,) and boxes.shape == (e, most, 6) and loads.shape == (e, most, 3)
        and count.shape == reached.shape == (e,)
        and all(np.issubdtype(a.dtype, np.integer) for a in (size, boxes, count))
        and bool(((count >= 0) & (count <= most)).all())
    )  # fmt: skip
    if not right:
        raise ValueError(f"{path}: {NOT_STACKS}: its arrays do not go together")
    w, d, h = (int(s) for s in size)
    return Episodes((w, d, h), reached, count, boxes, loads, float("nan"))


def parser() -> argparse.ArgumentParser:
    """The command's options."""
    options = argparse.ArgumentParser(
        prog="python -m marl_pack.evaluate",
        description=__doc__.split("\n\n")[0],
        epilog="The game is the one that the first checkpoint among the policies was trained on, "
        "else RS in a bin of 10 x 10 x 10 under hull_alpha; each option changes that.",
    )
    add = options.add_argument
    add("--policy", nargs="+", metavar="NAME",
        help=f"one or more of {', '.join(POLICIES)}, runs' folders or checkpoints "
             "(default: dblf)")  # fmt: skip
    add("--orientation", metavar="NAME",
        help=f"with --placement: the first agent alone, of {', '.join(ORIENTATION_AGENTS)}, a "
             "run's folder or a checkpoint")  # fmt: skip
    add("--placement", metavar="NAME",
        help=f"with --orientation: the second agent alone, of {', '.join(POLICIES)}, a run's "
             "folder or a checkpoint")  # fmt: skip
    add("--plan", metavar="rollouts=K,top=M",
        help="learned agents try their M best pairs in K imagined futures before each placement; "
             "depth=D ends each future after D items by the critic's word")  # fmt: skip
    add("--symmetric", action="store_true",
        help="ask learned agents in all symmetries of the bin and take what is most probable in "
             "the mean")  # fmt: skip
    add("--items", help=f"{', '.join(GENERATED)}, or a .npz, .json or .csv file")
    add("--bin", nargs=3, type=int, metavar=("W", "D", "H"),
        help="bin size in cells; a file brings its own")  # fmt: skip
    add("--sides", nargs=2, type=int, metavar=("SHORTEST", "LONGEST"),
        help="sides of generated items, in cells")  # fmt: skip
    add("--rule", choices=list(RULES), help="stability rule of the masks")
    add("--margin", type=float, help="cells by which the support polygon is shrunk")
    add("--thresholds", choices=["paper", "code"], help="of the rule area_ratio")
    add("--orientations", nargs="+", type=int, metavar="O",
        help="orientations that may be chosen, of 0 … 5")  # fmt: skip
    add("--orientation-mask", action=argparse.BooleanOptionalAction, dest="mask_orientations",
        help="whether orientations without a legal cell are excluded; else choosing one ends the "
             "episode")  # fmt: skip
    add("--com-offset", nargs=3, type=float, metavar=("X", "Y", "Z"),
        help="centre of mass of the items from their middle, in fractions of w, d, h")  # fmt: skip
    add("--episodes", type=int, help=f"how many (default: all of a file, else {EPISODES})")
    add(
        "--seed",
        type=int,
        default=0,
        help="of generated items, random play and drawn bodies (default: 0)",
    )
    add("--device", default="cpu", help="cpu (default), cuda, cuda:1, …")
    add("--threads", type=int, default=1, help="on the CPU (default: 1)")
    add("--physics", action="store_true",
        help="judge every packing in SAPIEN after each placement: the column falls")  # fmt: skip
    Bodies.add_options(options)
    add("--processes", type=int, default=1, help="that judge at once (default: 1)")
    add("--json", type=Path, metavar="FILE", help="write the figures there")
    add("--save-stacks", type=Path, metavar="FILE", help="write the packed boxes there (.npz)")
    return options


def choose_policies(
    arguments: argparse.Namespace, console: Console
) -> tuple[dict[str, Policy], dict[str, Any]]:
    """The policies that the options name, by the name of their row, and the game they are for.

    The game is that of the first checkpoint among them (the keys of
    :class:`marl_pack.config.Game`), empty if there is none.

    Raises:
        ValueError, FileNotFoundError: if there is none of that name.
    """
    pair = arguments.orientation, arguments.placement
    if (pair[0] is None) != (pair[1] is None):
        raise ValueError("--orientation and --placement go together: name both agents")
    names = arguments.policy or ([] if pair[0] else ["dblf"])
    sources = [name for name in dict.fromkeys((*names, *pair)) if name is not None]
    if arguments.symmetric and all(name in ORIENTATION_AGENTS for name in sources):
        raise ValueError("--symmetric goes with a run's folder or checkpoint")
    if all(name in POLICIES for name in names) and pair == (None, None):
        return {n: make_policy(n, arguments.seed, arguments.device) for n in names}, {}
    # Only learned agents need rsl_rl.
    from marl_pack.agents import checkpoint

    how = arguments.device, arguments.seed, arguments.symmetric
    policies = {name: checkpoint.find_policy(name, *how) for name in names}
    if pair[0] is not None:
        policies[f"{pair[0]} + {pair[1]}"] = in_turns(
            checkpoint.find_orientation_agent(pair[0], *how),
            checkpoint.find_placement_agent(pair[1], *how),
        )
    learned: dict[str, Any] = {}
    for source in sources:
        if source not in ORIENTATION_AGENTS:
            found = checkpoint.read(source)
            learned = learned or found["config"]["game"]
            console.print(f"{source}: trained on {checkpoint.trained_on(found)}", soft_wrap=True)
    return policies, learned


def with_plans(
    policies: dict[str, Policy], arguments: argparse.Namespace, stream: Stream, size: Size
) -> dict[str, Policy]:
    """The learned policies, planning as ``--plan`` says; heuristics stay as they are.

    What they imagine to come is what they were trained on; if that was a file, the rows of
    ``stream``.

    Raises:
        ValueError: if the plan cannot be read, or there is no checkpoint to plan with.
    """
    from marl_pack.agents import checkpoint
    from marl_pack.agents.planning import Plan, make_planner

    plan = Plan.parse(arguments.plan)
    if all(name in POLICIES for name in policies) or arguments.orientation is not None:
        raise ValueError("--plan goes with --policy and a run's folder or checkpoint")
    planned: dict[str, Policy] = {}
    for name, policy in policies.items():
        if name in POLICIES:
            planned[name] = policy
        else:
            found = checkpoint.read(name, arguments.device)
            game = found["config"]["game"]
            if game["items"] in GENERATED:
                try:
                    learned = make_stream(game["items"], size, tuple(game["sides"]))
                except ValueError as error:
                    raise ValueError(f"--plan: what the agents were trained on: {error}") from None
            else:
                learned = stream
            futures = independent(learned).to(arguments.device)
            planned[f"{name}, {plan}"] = make_planner(
                found, plan, futures, arguments.device, arguments.seed, arguments.symmetric
            )
    return planned


def choose_game(arguments: argparse.Namespace, learned: dict[str, Any]) -> None:
    """Fill the options on the game that were not given.

    Args:
        arguments: the options, changed in place.
        learned: the game that the policies were trained on, empty if there is none.
    """
    settings = DEFAULTS | learned
    if arguments.rule is not None:  # these belong to the rule
        settings |= {"margin": None, "thresholds": None}
    if arguments.items is not None and arguments.items not in GENERATED:
        settings["bin"] = None
    for key in DEFAULTS:
        if getattr(arguments, key) is None:
            setattr(arguments, key, settings[key])


def run(arguments: argparse.Namespace, console: Console) -> dict[str, dict[str, Any]]:
    """Play what the options ask for; a row of figures for each policy.

    Raises:
        ValueError, FileNotFoundError: if an option cannot be, naming what would be right.
    """
    check_device(arguments.device)
    if arguments.seed < 0:
        raise ValueError(f"--seed {arguments.seed}: needs 0 or more")
    policies, learned = choose_policies(arguments, console)
    choose_game(arguments, learned)
    if arguments.save_stacks and len(policies) > 1:
        raise ValueError("--save-stacks goes with one policy: it keeps one stack an episode")
    for path in (arguments.json, arguments.save_stacks):
        if path is not None:
            check_writable(path)
    bodies = Bodies.from_options(arguments) if arguments.physics else None
    if bodies is not None:
        load_sapien()  # says what to install before anything is played
    elif any(getattr(arguments, key) is not None for key in ("cell", "density", "com_spread")):
        raise ValueError("--cell, --density and --com-spread go with --physics")
    if arguments.processes < 1:
        raise ValueError(f"--processes {arguments.processes}: needs 1 or more")
    stream, size = choose_stream(
        arguments.items, tuple(arguments.bin) if arguments.bin else None, tuple(arguments.sides)
    )
    if arguments.plan is not None:
        policies = with_plans(policies, arguments, stream, size)
    episodes = arguments.episodes
    if episodes is None:
        episodes = stream.episodes or EPISODES
    if episodes < 1 or (stream.episodes and episodes > stream.episodes):
        most = f" … {stream.episodes}, the sequences of the file" if stream.episodes else " or more"
        raise ValueError(f"--episodes {episodes}: needs 1{most}")
    named = {"margin": arguments.margin, "thresholds": arguments.thresholds}
    parameters = {key: value for key, value in named.items() if value is not None}

    def game(n: int, first_episode: int) -> Packing:
        return Packing(
            n, size, stream, rule=arguments.rule, rule_parameters=parameters,
            orientations=arguments.orientations,
            mask_orientations=arguments.mask_orientations,
            com_offset=tuple(arguments.com_offset), device=arguments.device,
            seed=arguments.seed, first_episode=first_episode, auto_reset=False,
        )  # fmt: skip

    rows = {}
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, transient=True,
    )  # fmt: skip
    with bar:
        for name, policy in policies.items():
            task = bar.add_task(f"{name}: episodes", total=episodes)
            played = play(policy, game, episodes, lambda k, t=task: bar.advance(t, k))  # type: ignore[misc]  # a default argument binds the task
            task = bar.add_task(f"{name}: equilibria", total=episodes)
            stands = strict_equilibrium(played, lambda k, t=task: bar.advance(t, k))  # type: ignore[misc]  # likewise
            rows[name] = summary(played, stands)
            unplayable = int((played.packed == 0).sum())
            if unplayable:
                console.print(
                    f"{name}: {unplayable} episodes have a first item that may be set down "
                    "nowhere; they count as utilization 0"
                )
            if arguments.save_stacks:
                save_stacks(arguments.save_stacks, played)
            if bodies is not None:
                task = bar.add_task(f"{name}: physics", total=episodes)
                rows[name] |= falls(
                    played, bodies, arguments.processes, lambda t=task: bar.advance(t, 1)  # type: ignore[misc]  # likewise
                )  # fmt: skip
                if rows[name]["no_verdict"]:
                    console.print(f"{name}: {rows[name]['no_verdict']} episodes without a verdict")
    title = f"{arguments.items}, bin {' x '.join(map(str, size))}, rule {arguments.rule}"
    if parameters:
        title += f" ({', '.join(f'{k} {v}' for k, v in parameters.items())})"
    if set(arguments.orientations) != set(ALL_ORIENTATIONS):
        title += f", orientations {sorted(set(arguments.orientations))}"
    if not arguments.mask_orientations:
        title += ", no mask of orientations"
    if any(arguments.com_offset):
        title += f", centre of mass off by {' '.join(f'{o:g}' for o in arguments.com_offset)}"
    if arguments.symmetric:
        title += "; agents asked in all symmetries"
    if bodies is not None and str(bodies):
        title += f"; {bodies}"
    show(rows, title, console)
    if arguments.json:
        settings = {k: v for k, v in vars(arguments).items() if k not in ("json", "save_stacks")}
        report = {"settings": settings | {"bin": size, "episodes": episodes}, "policies": rows}
        write_json(arguments.json, report)
    return rows


def main(arguments: Sequence[str] | None = None) -> int:
    """The command ``python -m marl_pack.evaluate``."""
    options = parser()
    chosen = options.parse_args(arguments)
    torch.set_num_threads(max(1, chosen.threads))
    try:
        run(chosen, Console())
    except SimulationError as error:  # a process that judged has died
        options.exit(1, f"{options.prog}: {error}\n")
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted\n")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())

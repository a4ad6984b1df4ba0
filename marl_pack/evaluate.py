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

from marl_pack.agents.policy import Policy
from marl_pack.bins import Size
from marl_pack.files import check_writable, write_atomically, write_json
from marl_pack.game.packing import Packing
from marl_pack.options import EPILOG, add_options, choose
from marl_pack.sapien_check.bodies import Bodies
from marl_pack.sapien_check.judge import SimulationError, judge_all, load_sapien
from marl_pack.stability import in_equilibrium

BATCH = 1024  # bins played at once, at most
BATCH_CELLS = 1 << 20  # cells in the maps of those bins, at most
NOT_STACKS = "not a file of stacks from evaluate --save-stacks"
EPISODES = 1000  # of a generated stream, unless told


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
        epilog=EPILOG,
    )
    add_options(options)
    add = options.add_argument
    add("--episodes", type=int, help=f"how many (default: all of a file, else {EPISODES})")
    add("--physics", action="store_true",
        help="judge every packing in SAPIEN after each placement: the column falls")  # fmt: skip
    Bodies.add_options(options)
    add("--processes", type=int, default=1, help="that judge at once (default: 1)")
    add("--json", type=Path, metavar="FILE", help="write the figures there")
    add("--save-stacks", type=Path, metavar="FILE", help="write the packed boxes there (.npz)")
    return options


def run(arguments: argparse.Namespace, console: Console) -> dict[str, dict[str, Any]]:
    """Play what the options ask for; a row of figures for each policy.

    Raises:
        ValueError, FileNotFoundError: if an option cannot be, naming what would be right.
    """
    setup = choose(arguments, console)
    if arguments.save_stacks and len(setup.policies) > 1:
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
    episodes, known = arguments.episodes, setup.stream.episodes
    if episodes is None:
        episodes = known or EPISODES
    if episodes < 1 or (known and episodes > known):
        most = f" … {known}, the sequences of the file" if known else " or more"
        raise ValueError(f"--episodes {episodes}: needs 1{most}")
    rows = {}
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
        console=console, transient=True,
    )  # fmt: skip
    with bar:
        for name, policy in setup.policies.items():
            task = bar.add_task(f"{name}: episodes", total=episodes)
            played = play(policy, setup.game, episodes, lambda k, t=task: bar.advance(t, k))  # type: ignore[misc]  # a default argument binds the task
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
    title = str(setup)
    if bodies is not None and str(bodies):
        title += f"; {bodies}"
    show(rows, title, console)
    if arguments.json:
        settings = {k: v for k, v in vars(arguments).items() if k not in ("json", "save_stacks")}
        report = {
            "settings": settings | {"bin": setup.size, "episodes": episodes},
            "policies": rows,
        }
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

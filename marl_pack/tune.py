"""Find the weights of the heuristic ``linear`` for your own goods: ``marl-pack tune``.

The command packs random episodes of your goods with many weights and improves these by CMA-ES. At
the end it measures the first and the last weights on other episodes, and keeps the better ones.
``marl-pack evaluate --world mm --policy weights.json`` plays them.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Console

from marl_pack.checks import LARGEST_SEED, real_number, whole_number
from marl_pack.exact.spec import ORDERS, ExactSpec
from marl_pack.files import Growing, check_writable, write_json
from marl_pack.items.generated import no_such_file
from marl_pack.option_record import add_arguments, given_options
from marl_pack.terminal import Parser, announce_compiling, complain, make_console, make_progress

PROGRAM = "python -m marl_pack.tune"
MOST_MINUTES = 1e6
MEASURE = 200
"""Episodes on which the result is measured, at most."""


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} --items FILE [OPTIONS]",
        description=__doc__.split("\n\n")[0],
        examples=(
            "--items goods.csv --order draw --length 80 --minutes 5 --out weights.json",
            "--items orders.json --bin-mm 1200 800 1500 --margin-mm 20 --out weights.json",
        ),
    )  # fmt: skip
    add = options.add_argument_group("goods").add_argument
    add("--items", required=True, metavar="FILE", help="a .csv or .json file with sizes in mm")
    add("--order", choices=ORDERS, default=ORDERS[0],
        help="file: the sequences of the file (default); draw: boxes drawn at random")  # fmt: skip
    add("--length", type=int, metavar="N",
        help="boxes in an episode; needed with --order draw")  # fmt: skip
    add_arguments(options.add_argument_group("game"), ExactSpec)
    add = options.add_argument_group("search").add_argument
    add("--minutes", type=float, default=5.0, help="how long to search (default: 5)")
    add("--generations", type=int, metavar="N",
        help="search for N generations instead, however long they take")  # fmt: skip
    add("--games", type=int, default=24, metavar="N",
        help="episodes that all weights of a generation pack (default: 24)")  # fmt: skip
    add("--population", type=int, default=14, metavar="N",
        help="weight vectors in a generation (default: 14)")  # fmt: skip
    add("--start", type=Path, metavar="FILE",
        help="weights to begin with, such as those of an earlier search (default: max_contact)"
        )  # fmt: skip
    add("--seed", type=int, default=0, help="seed of episodes and search (default: 0)")
    add = options.add_argument_group("output").add_argument
    add("--out", type=Path, required=True, metavar="FILE",
        help="write the weights to this .json file, also while the search goes on")  # fmt: skip
    return options


def check_options(arguments: argparse.Namespace) -> None:
    """Refuse impossible options.

    Raises:
        ValueError, FileNotFoundError: says what would be right.
    """
    if arguments.out.suffix != ".json":
        raise ValueError(f"--out {arguments.out}: needs a name that ends in .json")
    check_writable(arguments.out)
    if not Path(arguments.items).is_file():
        raise no_such_file(arguments.items, in_mm=True)
    if not 0 < real_number(arguments.minutes, "--minutes") <= MOST_MINUTES:
        raise ValueError(f"--minutes {arguments.minutes:g}: needs a number > 0, at most 1e6")
    if arguments.start is not None and not arguments.start.is_file():
        raise FileNotFoundError(f"{arguments.start}: no such file")
    if arguments.generations is not None:
        whole_number(arguments.generations, "--generations", 1)
    whole_number(arguments.games, "--games", 1, 4096)
    whole_number(arguments.population, "--population", 4, 4096)
    whole_number(arguments.seed, "--seed", 0, LARGEST_SEED)


def run(arguments: argparse.Namespace, console: Console) -> dict[str, Any]:
    """Search, measure and write the weights; return what was written.

    Raises:
        ValueError, FileNotFoundError: if an option is impossible; says what would be right.
    """
    check_options(arguments)
    announce_compiling(console)
    from marl_pack.evaluation.statistics import interval, spread  # slow to import
    from marl_pack.exact.policies import HEURISTICS, named_weights, read_weights
    from marl_pack.exact.streams import make_goods_stream
    from marl_pack.exact.tuning import Episodes, tune, utilizations

    spec = ExactSpec.of(given_options(arguments, ExactSpec))
    stream = make_goods_stream(
        arguments.items, spec, order=arguments.order, length=arguments.length, seed=arguments.seed
    )
    start = HEURISTICS["max_contact"]().weights
    if arguments.start is not None:
        start = read_weights(arguments.start)
    episodes = Episodes(stream, arguments.seed)
    report: dict[str, Any] = {
        "weights": named_weights(start), "complete": False, "generations": 0, "seconds": 0.0,
        "items": arguments.items, "order": arguments.order, "length": arguments.length,
        "seed": arguments.seed, "spec": asdict(spec),
    }  # fmt: skip
    begin, seconds = time.monotonic(), 60 * arguments.minutes
    search = tune(
        lambda weights, numbers: float(utilizations(weights, stream, spec, numbers).mean()),
        lambda: episodes.tuning(arguments.games), start=start, population=arguments.population,
        seed=arguments.seed,
    )  # fmt: skip
    weights = start
    total = arguments.generations or int(seconds)
    with Growing(arguments.out, write_json) as file, make_progress(console) as bar:
        task = bar.add_task(
            "seconds" if arguments.generations is None else "generations", total=total
        )
        for generation in search:
            weights, spent = generation.weights, time.monotonic() - begin
            report |= {"weights": named_weights(weights), "generations": generation.number,
                       "seconds": spent}  # fmt: skip
            file.update(report)
            done = int(spent) if arguments.generations is None else generation.number
            bar.update(task, completed=min(done, total), total=total)
            if done >= total:
                break
        numbers = episodes.measuring(MEASURE)
        measured = {
            name: utilizations(vector, stream, spec, numbers)
            for name, vector in (("start", start), ("tuned", weights))
        }
        if measured["tuned"].mean() < measured["start"].mean():
            report["weights"] = named_weights(start)
        report |= {"complete": True, "measured_episodes": len(numbers)}
        for name, shares in measured.items():
            report[name] = {"utilization": float(shares.mean()), "interval": interval(shares)}
        file.update(report)
    for name, shares in measured.items():
        text = f"{100 * shares.mean():.2f}{spread(float(shares.mean()), interval(shares))}"
        console.print(f"{name}: utilization {text} %, {len(numbers)} episodes", soft_wrap=True)
    kept = "tuned" if report["weights"] == named_weights(weights) else "start"
    console.print(
        f"{arguments.out}: the weights {kept!r}, after {report['generations']} generations",
        soft_wrap=True,
    )
    return report


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack tune``; return its exit status."""
    chosen = parser(program).parse_args(arguments)
    try:
        run(chosen, make_console())
    except KeyboardInterrupt:
        complain(program, "interrupted; --start FILE continues with the weights written so far")
        return 130
    except (ValueError, OSError, ModuleNotFoundError) as error:
        complain(program, error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Show how a plan was packed: a page for the browser, a picture or a film.

``marl-pack replay plan.json --out replay.html`` writes one page that opens without a network: the
bins in 3D, step by step, with the values of each box. Files that end in .png, .gif or .mp4 are
drawn without a GPU.
"""

from __future__ import annotations

import argparse
import webbrowser
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from marl_pack.checks import real_number, whole_number
from marl_pack.files import check_writable, write_atomically
from marl_pack.plan import Plan
from marl_pack.plan_archive import load_plans
from marl_pack.render.choices import COLOURINGS, ENDINGS
from marl_pack.terminal import Parser, make_console, make_progress

PROGRAM = "python -m marl_pack.replay"
PAGE = ".html"
ONLY_PICTURES = ("step", "seconds", "pixels", "colour")
LEAST_PIXELS, MOST_PIXELS = 160, 4096
SHORTEST, LONGEST = 0.05, 60.0
"""Limits of ``--seconds``."""


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} PLAN --out FILE [OPTIONS]",
        description=__doc__.split("\n\n")[0],
        examples=(
            "plan.json --out replay.html --open",
            "plan.json --out film.mp4 --seconds 0.3 --pixels 1280 720",
            "plans.npz --episode 3 --out bin.png",
        ),
    )  # fmt: skip
    options.add_argument("plan", type=Path, metavar="PLAN", help=".json, .csv or .npz file")
    add = options.add_argument_group("output").add_argument
    add("--out", type=Path, metavar="FILE", required=True,
        help="a page (.html), a picture of the end (.png) or a film (.gif, .mp4)")  # fmt: skip
    add("--title", metavar="TEXT", help="title (default: the name of the plan's file)")
    add("--open", action="store_true", help="open the page in the browser")
    add("--episode", type=int, metavar="N",
        help="number of the plan in a file of several plans (default: 0)")  # fmt: skip
    add = options.add_argument_group("pictures and films").add_argument
    add("--step", type=int, metavar="N",
        help="number of boxes on a picture (default: all)")  # fmt: skip
    add("--seconds", type=float, metavar="S",
        help="how long a film shows each box (default: 0.6)")  # fmt: skip
    add("--pixels", type=int, nargs=2, metavar=("W", "H"),
        help="size of a film, or of the picture of each bin (default: 720 480)")  # fmt: skip
    add("--colour", choices=COLOURINGS, help="what colours show (default: item)")
    return options


def check(chosen: argparse.Namespace) -> None:
    """Refuse impossible options.

    Raises:
        ValueError, OSError: naming the option and what would be right.
    """
    ending = chosen.out.suffix.lower()
    if ending not in (PAGE, *ENDINGS):
        raise ValueError(f"--out {chosen.out}: needs the ending {', '.join((PAGE, *ENDINGS))}")
    if ending == PAGE:
        given = [name for name in ONLY_PICTURES if getattr(chosen, name) is not None]
        if given:
            raise ValueError(f"--{given[0]}: goes with {', '.join(ENDINGS)}, not with a page")
    elif chosen.open:
        raise ValueError(f"--open: goes with a page ({PAGE})")
    if chosen.step is not None and ending != ".png":
        raise ValueError("--step: goes with a picture (.png)")
    if chosen.seconds is not None:
        if ending == ".png":
            raise ValueError("--seconds: goes with a film (.gif, .mp4)")
        if not SHORTEST <= real_number(chosen.seconds, "--seconds") <= LONGEST:
            raise ValueError(f"--seconds {chosen.seconds:g}: needs from {SHORTEST} to {LONGEST:g}")
    for side in chosen.pixels or ():
        whole_number(side, "--pixels", LEAST_PIXELS, MOST_PIXELS)
    check_writable(chosen.out)
    if not chosen.plan.is_file():
        raise FileNotFoundError(f"{chosen.plan}: no such file")


def choose_plan(chosen: argparse.Namespace) -> Plan:
    """Return the plan that the options name.

    Raises:
        ValueError: if there is no such plan, or the file has none.
    """
    plans = load_plans(chosen.plan)
    episode = 0 if chosen.episode is None else chosen.episode
    if not 0 <= episode < len(plans):
        most = f" … {len(plans) - 1}" if len(plans) > 1 else ", the only plan of the file"
        raise ValueError(f"--episode {episode}: needs 0{most}")
    return plans[episode]


def write_page(path: Path, plan: Plan, title: str) -> None:
    """Write the replay page of a plan."""
    from marl_pack.replay.document import make_document
    from marl_pack.replay.page import make_page

    content = make_page(make_document(plan, title)).encode()
    write_atomically(path, lambda file: file.write(content))


def open_page(path: Path, console: Console) -> None:
    """Open a page in the browser, or say that there is none."""
    if not webbrowser.open(path.resolve().as_uri()):
        console.print(f"no browser found: open {path.resolve().as_uri()}", soft_wrap=True)


def write_picture(chosen: argparse.Namespace, plan: Plan, title: str, console: Console) -> None:
    """Write a picture or a film of a plan, with a progress bar.

    Raises:
        ValueError: if an option does not go with the plan.
    """
    from marl_pack.render.animation import PIXELS, SECONDS, Film, save_film
    from marl_pack.render.colours import colour_plan

    colour = chosen.colour or "item"
    if colour_plan(plan, colour) is None:
        raise ValueError(f"--colour {colour}: the plan has no such values, or only one")
    film = Film(plan, title, tuple(chosen.pixels or PIXELS), colour)
    if chosen.step is not None:
        whole_number(chosen.step, "--step", 0, len(plan))
    with make_progress(console) as bar:
        task = bar.add_task("pictures", total=1 if chosen.out.suffix == ".png" else len(film))
        save_film(
            chosen.out, film, step=chosen.step,
            seconds=SECONDS if chosen.seconds is None else chosen.seconds,
            progress=lambda: bar.advance(task),
        )  # fmt: skip


def run(chosen: argparse.Namespace, console: Console) -> None:
    """Write the page, picture or film that the options name.

    Raises:
        ValueError, OSError, ModuleNotFoundError: if an option or a file is wrong; says what would
            be right.
    """
    check(chosen)
    plan = choose_plan(chosen)
    title = chosen.plan.stem if chosen.title is None else chosen.title
    title = title.encode(errors="replace").decode()  # names of files may have other bytes
    if chosen.out.suffix.lower() == PAGE:
        write_page(chosen.out, plan, title)
    else:
        try:
            write_picture(chosen, plan, title, console)
        except ValueError as error:
            named = str(error).startswith("--")
            raise ValueError(str(error) if named else f"{chosen.plan}: {error}") from None
    boxes = "1 box" if len(plan) == 1 else f"{len(plan)} boxes"
    console.print(f"{boxes}, {plan.utilization:.1%} filled: {chosen.out}", soft_wrap=True)
    if chosen.open:
        open_page(chosen.out, console)


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack replay``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    try:
        run(chosen, make_console())
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except (ValueError, OSError, ModuleNotFoundError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0

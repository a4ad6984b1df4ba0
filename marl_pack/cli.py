"""The command ``marl-pack``: every program of the package under one name.

``marl-pack evaluate …`` does what ``python -m marl_pack.evaluate …`` does. A program is imported
when it is called.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Sequence

import marl_pack
from marl_pack.terminal import Parser

COMMANDS = {
    "train": ("marl_pack.train", "train the two agents, or resume a run"),
    "evaluate": ("marl_pack.evaluate", "play many games; print and save how full the bins are"),
    "play": ("marl_pack.play", "play one game turn by turn, and draw the packed bin"),
    "export": ("marl_pack.export.command", "write trained agents as ONNX, or for rsl_rl"),
    "pack": ("marl_pack.pack", "pack boxes in millimetres, from a file or a conveyor"),
    "replay": ("marl_pack.replay.command", "show how a plan was packed: page, picture or film"),
    "demo": ("marl_pack.demo", "pack a pallet of cases, and look at it in the browser"),
    "serve": ("marl_pack.serve", "serve packers over HTTP: bins, placements, plans"),
    "tune": ("marl_pack.tune", "find the weights of the heuristic linear for your own goods"),
    "compile": ("marl_pack.compile", "compile all code now, so that no later start has to wait"),
    "judge": ("marl_pack.physics.command", "build stacks in physics and see what falls; films"),
}
"""For each command the module whose ``main`` runs it, and a description."""

STATUS = """exit status:
  0    done
  1    no result: training diverged, a simulation failed, or a control was judged
       wrongly
  2    refused: an option, a setting or a file is wrong; the message says what would
       be right
  130  interrupted; files that had been written stay"""


def parser(program: str) -> Parser:
    """Return the parser of the first word of the command line, which names the command."""
    commands = "\n".join(f"  {name:10}{summary}" for name, (_, summary) in COMMANDS.items())
    options = Parser(
        prog=program,
        usage=f"{program} COMMAND [OPTIONS]",
        description="Learning to pack boxes online, safely.",
        notes=(f"commands:\n{commands}\n\n{program} COMMAND --help shows its options.", STATUS),
        examples=("evaluate --policy rs dblf --episodes 100", "train --config quick"),
    )
    version = f"marl_pack {marl_pack.__version__}"
    options.add_argument("--version", action="version", version=version)
    options.add_argument("command", choices=COMMANDS, help=argparse.SUPPRESS)
    return options


def main(arguments: Sequence[str] | None = None, program: str = "marl-pack") -> int:
    """Run the command that the first word names; return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    options = parser(program)
    if not words:
        options.error(f"needs one of {', '.join(COMMANDS)}; --help says what they do")
    command = options.parse_args(words[:1]).command
    module = importlib.import_module(COMMANDS[command][0])
    status: int = module.main(words[1:], f"{program} {command}")
    return status

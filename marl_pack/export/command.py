"""The command ``marl-pack export``, which writes a checkpoint's agents for other programs."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from marl_pack import published
from marl_pack.agents.sources import resolve
from marl_pack.extras import missing
from marl_pack.terminal import Parser, make_console, make_status

PROGRAM = "python -m marl_pack.export"


def parser(program: str = PROGRAM) -> Parser:
    """Return the parser of the command's options."""
    options = Parser(
        prog=program, usage=f"{program} CHECKPOINT [OPTIONS]",
        description="Write a checkpoint's agents for use in other programs.",
        examples=("rs --folder onnx", "runs/NAME --format rsl_rl"),
    )  # fmt: skip
    options.add_argument(
        "checkpoint", metavar="CHECKPOINT",
        help=f"a published model ({', '.join(published.models())}), a checkpoint or a run's folder",
    )  # fmt: skip
    add = options.add_argument_group("output").add_argument
    add("--format", choices=["onnx", "rsl_rl", "checkpoint"], default="onnx",
        help="ONNX (default), the state that a stock rsl_rl PPO loads, or a checkpoint to publish, "
             "without the parts that only its run needs")  # fmt: skip
    add("--folder", type=Path,
        help="folder to write to (default: the checkpoint's folder; ./NAME for a published "
             "model)")  # fmt: skip
    return options


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack export``; return its exit status."""
    options = parser(program)
    chosen = options.parse_args(arguments)
    console = make_console()
    try:
        resolve(chosen.checkpoint)
        with make_status(console, "loading the agents"):
            from marl_pack.export.writers import run  # slow to import

        # Importing torch sets the levels of its loggers.
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        run(chosen.checkpoint, chosen.folder, chosen.format, console)
    except KeyboardInterrupt:
        options.exit(130, f"{options.prog}: interrupted")
    except ModuleNotFoundError as error:
        options.exit(2, f"{options.prog}: {missing(error, 'ONNX needs two packages', 'export')}")
    except (ValueError, OSError) as error:
        options.exit(2, f"{options.prog}: {error}")
    return 0

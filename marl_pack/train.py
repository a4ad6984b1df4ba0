"""Train the orientation and the placement agent.

``marl-pack train --config default --seed 1`` makes a run's folder with all settings, checkpoints,
TensorBoard's logs and the history of evaluations. ``--resume runs/NAME`` continues the run.
``--help`` lists every setting.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from marl_pack.config import ConfigError, parse
from marl_pack.config.parsing import PROGRAM
from marl_pack.terminal import complain, make_console, make_status


def main(arguments: Sequence[str] | None = None, program: str = PROGRAM) -> int:
    """Run the command ``marl-pack train``; return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        run, rest = _resume_option(words)
        config = parse(words, program)[0] if run is None else None
    except (ConfigError, OSError) as error:
        complain(program, error)
        return 2
    with make_status(make_console(), "loading the trainer"):
        from marl_pack.training.run import start  # slow to import

    return start(program, words, config, run or "", rest)


def _resume_option(words: Sequence[str]) -> tuple[str | None, list[str]]:
    """Return the value of --resume (None without it), and the other options.

    Raises:
        ConfigError: if --resume has no value.
    """
    first = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    first.add_argument("--resume")
    try:
        options, rest = first.parse_known_args(words)
    except argparse.ArgumentError:
        raise ConfigError("--resume needs a run's folder") from None
    if options.resume == "":
        raise ConfigError("--resume needs a run's folder")
    return options.resume, rest


if __name__ == "__main__":
    sys.exit(main())

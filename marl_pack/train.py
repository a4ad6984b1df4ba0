"""Train the orientation and the placement agent.

``python -m marl_pack.train --config configs/rs.yaml --seed 1`` makes a run's folder with the
resolved settings, checkpoints, TensorBoard's logs and the history of evaluations.
``--resume runs/NAME`` continues it. ``--help`` lists every setting.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from marl_pack.agents.learning.runner import RunInterruptedError, Runner, TrainingDivergedError
from marl_pack.agents.networks.distribution import NotFiniteError
from marl_pack.config import Config, ConfigError, parse
from marl_pack.terminal import complain, make_console
from marl_pack.training.assembly import evaluation, make_runner, rank
from marl_pack.training.display import Display
from marl_pack.training.folder import (
    new_run,
    resumed,
    run_to_resume,
    write_history,
    write_record,
)


def train(
    config: Config,
    folder: Path,
    console: Console,
    arguments: Sequence[str],
    checkpoint: Mapping[str, Any] | None = None,
) -> Runner:
    """Run the training of a run to its end.

    Args:
        config: the settings.
        folder: the run's.
        console: where progress goes.
        arguments: of the command, for the record.
        checkpoint: of the run to resume.

    Raises:
        RunInterruptedError: after SIGINT or SIGTERM, with a checkpoint written.
        ConfigError, ValueError: if a setting is impossible or the checkpoint cannot be resumed.
    """
    torch.set_num_threads(config.threads)
    total = config.ppo.max_iterations
    display = Display(console, total, 0 if checkpoint is None else checkpoint["iter"] + 1)

    def evaluated(history: list[dict[str, Any]]) -> None:
        write_history(folder / "evaluations.csv", history)
        display.evaluated(history[-1])

    runner = make_runner(
        config,
        folder,
        checkpoint,
        evaluate=lambda current: evaluation(config, current),
        show=display.show if rank() == 0 else lambda progress: None,
        evaluated=evaluated,
    )
    if rank() == 0:
        write_record(folder, config, arguments)

    def stop(number: int, frame: object) -> None:
        if runner.stop_requested:  # a second signal stops at once
            raise KeyboardInterrupt
        runner.stop_requested = True
        if rank() == 0:
            console.print("stopping after this iteration; a second signal stops at once")

    before = {kind: signal.signal(kind, stop) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        if display.live and rank() == 0:
            with display.view:
                runner.train(total)
        else:
            runner.train(total)
    finally:
        for kind, handler in before.items():
            signal.signal(kind, handler)
        if runner.is_distributed:
            torch.distributed.destroy_process_group()
    return runner


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command ``python -m marl_pack.train``; return its exit status."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    console = make_console()
    folder = None
    try:
        run, rest = _resume_option(words)
        if run is None:
            config, _ = parse(words)
            claim = new_run(config) if rank() == 0 else nullcontext(Path(config.output.folder))
        else:
            claim = run_to_resume(run) if rank() == 0 else nullcontext(Path(run))
        with claim as folder:
            checkpoint = None
            if run is not None:
                config, checkpoint = resumed(run, rest)
            if rank() == 0:
                console.print(f"run: {folder}", soft_wrap=True)
            quiet = make_console(quiet=True)
            runner = train(config, folder, console if rank() == 0 else quiet, words, checkpoint)
    except RunInterruptedError:
        if rank() == 0:
            console.print(
                f"stopped with a checkpoint; continue with --resume {folder}", soft_wrap=True
            )
        return 130
    except KeyboardInterrupt:
        console.print("stopped at once; the last checkpoint is as it was")
        return 130
    except TrainingDivergedError as error:
        complain("python -m marl_pack.train", error)
        return 1
    except (ConfigError, NotFiniteError, OSError, ModuleNotFoundError) as error:
        nameless = isinstance(error, OSError) and error.errno and not error.filename
        where = f"{folder}: " if nameless else ""  # as where logs are written
        complain("python -m marl_pack.train", f"{where}{error}")
        return 2
    if rank() == 0:
        console.print(
            f"done: {runner.logger.tot_timesteps:,} items; play it with "
            f"python -m marl_pack.evaluate --policy {folder}",
            soft_wrap=True,
        )
    return 0


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

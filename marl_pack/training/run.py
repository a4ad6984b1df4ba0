"""Train agents until the end of the run, or until the user stops it."""

from __future__ import annotations

import signal
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from marl_pack.agents.learning.runner import RunInterruptedError, Runner, TrainingDivergedError
from marl_pack.agents.networks.distribution import NotFiniteError
from marl_pack.config import Config, ConfigError
from marl_pack.terminal import announce_compiling, complain, make_console, make_status
from marl_pack.training.assembly import evaluation, make_runner, rank
from marl_pack.training.display import Display
from marl_pack.training.folder import (
    new_run,
    run_to_resume,
    settings_to_resume,
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
    """Train the agents of one run until its end.

    Args:
        config: the settings of the run.
        folder: the folder of the run.
        console: the console that shows progress.
        arguments: the words of the command line, which are stored in the run's record.
        checkpoint: the checkpoint of the run to resume.

    Raises:
        RunInterruptedError: after SIGINT or SIGTERM; a checkpoint has been written.
        ConfigError, ValueError: if a setting is impossible or the checkpoint cannot be resumed.
    """
    torch.set_num_threads(config.threads)
    total = config.ppo.max_iterations
    display = Display(console, total, 0 if checkpoint is None else checkpoint["iter"] + 1)

    def evaluated(history: list[dict[str, Any]]) -> None:
        write_history(folder / "evaluations.csv", history)
        display.evaluated(history[-1])

    def evaluate(current: Mapping[str, Any]) -> dict[str, Any]:
        display.evaluating()
        return evaluation(config, current)

    announce_compiling(console)
    with make_status(console, "setting up the games and the networks"):
        runner = make_runner(
            config,
            folder,
            checkpoint,
            evaluate=evaluate,
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

    handlers = {kind: signal.signal(kind, stop) for kind in (signal.SIGINT, signal.SIGTERM)}
    try:
        if display.live and rank() == 0:
            with display.view:
                runner.train(total)
        else:
            runner.train(total)
    finally:
        for kind, handler in handlers.items():
            signal.signal(kind, handler)
        if runner.is_distributed:
            torch.distributed.destroy_process_group()
    return runner


def _progress(config: Config, done: int) -> str:
    """Return the text that says where a resumed run continues; empty for a new run.

    Args:
        config: the settings of the run.
        done: number of iterations that the run has finished.
    """
    total = config.ppo.max_iterations
    if done >= total:
        return f", has finished all its {total:,} iterations; --ppo.max_iterations extends it"
    return f", continues after iteration {done:,} of {total:,}" if done else ""


def start(
    program: str, words: Sequence[str], config: Config | None, run: str, rest: Sequence[str]
) -> int:
    """Train a new run or resume one; return the exit status of the command.

    Args:
        program: name of the command, for messages.
        words: the words of the command line, which are stored in the run's record.
        config: the settings of a new run; None to resume a run.
        run: the folder of the run to resume, or its checkpoint.
        rest: the words of the command line without --resume.
    """
    console = make_console()
    folder = None
    try:
        claim: AbstractContextManager[Path]
        if rank() == 0:
            claim = run_to_resume(run) if config is None else new_run(config)
        else:
            claim = nullcontext(Path(run if config is None else config.output.folder))
        with claim as folder:
            checkpoint = None
            if config is None:
                config, checkpoint = settings_to_resume(run, rest)
            done = 0 if checkpoint is None else checkpoint["iter"] + 1
            if rank() == 0:
                console.print(f"run: {folder}{_progress(config, done)}", soft_wrap=True)
            quiet = make_console(quiet=True)
            runner = train(config, folder, console if rank() == 0 else quiet, words, checkpoint)
    except RunInterruptedError:
        if rank() == 0:
            console.print(
                f"stopped with a checkpoint; continue with --resume {folder}", soft_wrap=True
            )
        return 130
    except KeyboardInterrupt:
        console.print("stopped at once; the last checkpoint is unchanged")
        return 130
    except TrainingDivergedError as error:
        complain(program, error)
        return 1
    except (ConfigError, NotFiniteError, OSError, ModuleNotFoundError) as error:
        # Some errors name no file, for example when logs cannot be written.
        nameless = isinstance(error, OSError) and error.errno and not error.filename
        where = f"{folder}: " if nameless else ""
        complain(program, f"{where}{error}")
        return 2
    if rank() == 0:
        console.print(
            f"done: {runner.logger.tot_timesteps:,} items; play it with "
            f"{program.removesuffix('train')}evaluate --policy {folder}",
            soft_wrap=True,
        )
    return 0

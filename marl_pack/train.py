"""Train the orientation and the placement agent.

``python -m marl_pack.train --config configs/rs.yaml --seed 1`` makes a run's folder with the
resolved settings, checkpoints, TensorBoard's logs and the history of evaluations;
``--resume runs/NAME`` goes on with it. ``--help`` lists every setting.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import datetime
import io
import json
import math
import os
import platform
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bar
from rich.text import Text

import marl_pack
from marl_pack import evaluate
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.learning.runner import (
    Progress,
    RunInterruptedError,
    Runner,
    TrainingDivergedError,
)
from marl_pack.bins import check_device
from marl_pack.config import Agent, Config, ConfigError, from_dict, parse
from marl_pack.files import write_atomically
from marl_pack.game.packing import Packing
from marl_pack.items import Stream, choose_stream
from marl_pack.vec_env import PackingVecEnv

PACKAGES = ("torch", "rsl-rl-lib", "tensordict", "numpy", "numba", "scipy", "pettingzoo")
QUIET_SECONDS = 30.0  # between lines of progress where the output is not a terminal
MAY_CHANGE = ("output.", "evaluation.", "ppo.max_iterations")  # beside --resume


def rank() -> int:
    """This process's number among those that torchrun started; 0 alone."""
    return int(os.environ.get("RANK", "0"))


def local_device(config: Config) -> str:
    """The device of this process."""
    if config.device == "cuda" and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        return f"cuda:{os.environ['LOCAL_RANK']}"
    return config.device


def derived_seed(*parts: int) -> int:
    """A seed of its own for each process; none that a user would give to an evaluation."""
    low, high = np.random.SeedSequence(parts).generate_state(2, np.uint32)
    return int(high >> 1) << 32 | int(low)


def make_stream(config: Config) -> Stream:
    """The items of the game.

    Raises:
        ConfigError: if they do not go with the bin.
    """
    game = config.game
    try:
        return choose_stream(game.items, game.bin, game.sides)[0]
    except ValueError as error:
        raise ConfigError(f"game.items: {error}") from None


def make_game(
    config: Config, n: int, seed: int, *, auto_reset: bool, device: str, first_episode: int = 0
) -> Packing:
    """N bins as the settings say."""
    game = config.game
    return Packing(
        n, game.bin, make_stream(config), rule=game.rule, rule_parameters=game.rule_parameters(),
        orientations=game.orientations, mask_orientations=game.mask_orientations,
        alpha=game.alpha, beta=game.beta, com_offset=game.com_offset, auto_reset=auto_reset,
        device=device, seed=seed, first_episode=first_episode,
    )  # fmt: skip


def runner_settings(config: Config, found: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """What :class:`marl_pack.agents.learning.runner.Runner` takes, from the settings.

    Args:
        config: the settings.
        found: the checkpoint of the run to go on with: it holds the frozen agents, and those that
            are imitated.
    """
    ppo = asdict(config.ppo)
    steps, iterations = ppo.pop("num_steps_per_env"), ppo.pop("max_iterations")
    symmetry, final_entropy = ppo.pop("symmetry"), ppo.pop("final_entropy_coef")
    ppo.pop("num_envs")
    schedule = ppo.pop("schedule")
    ppo["schedule"] = "adaptive" if schedule == "adaptive" else "fixed"

    def other(name: str, key: str, source: str) -> dict[str, Any]:
        """What is kept of an agent that another run, or a rule, plays."""
        try:
            return checkpoint.frozen_agent(source, name)
        except (ValueError, FileNotFoundError) as error:
            raise ConfigError(f"{name}.{key}: {error}") from None

    def agent(name: str, own: Agent) -> dict[str, Any]:
        held = None if found is None else found["agents"][name]
        if own.frozen:
            assert own.policy is not None, "the settings were checked"
            return {"frozen": other(name, "policy", own.policy) if held is None else held}
        imitated = None
        if own.imitate is not None:  # what it has learned enough from is not held any more
            imitated = other(name, "imitate", own.imitate) if held is None else held.get("imitated")
        rate = ppo["learning_rate"] if own.learning_rate is None else own.learning_rate
        entropy = ppo["entropy_coef"] if own.entropy_coef is None else own.entropy_coef
        last = final_entropy if own.final_entropy_coef is None else own.final_entropy_coef
        return {
            "network": asdict(own.network),
            "algorithm": {**ppo, "learning_rate": rate, "entropy_coef": entropy},
            "symmetry": symmetry,
            "imitated": imitated,
            "imitate_iterations": own.imitate_iterations,
            "schedule": {
                "schedule": schedule, "learning_rate": rate, "entropy_coef": entropy,
                "final_entropy_coef": entropy if last is None else last,
            },
        }  # fmt: skip

    agents = {"orientation": config.orientation, "placement": config.placement}
    if config.joint:
        agents = {"joint": config.placement}
    logger: str | dict[str, Any] = "tensorboard"
    if config.output.logger == "wandb":
        logger = {"class_name": "WandbLogWriter", "project_name": config.output.wandb_project}
    return {
        "num_steps_per_env": steps,
        "save_interval": config.output.keep_every,
        "check_for_nan": True,
        "logger": logger,
        "algorithm": {
            "class_name": "marl_pack.agents.learning.ppo:PackingPPO", "iterations": iterations,
        },
        "agents": {name: agent(name, own) for name, own in agents.items()},
        "latest_every": config.output.latest_every,
        "evaluate_every": config.evaluation.every,
    }  # fmt: skip


def make_runner(
    config: Config,
    folder: Path | None,
    found: Mapping[str, Any] | None = None,
    **reports: Callable[..., Any],
) -> Runner:
    """The environment, the agents and the runner of a run, gone on with if ``found`` is given.

    Raises:
        ConfigError: if a setting cannot be.
    """
    device = local_device(config)
    try:
        check_device(device)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    torch.manual_seed(config.seed)
    try:
        settings = runner_settings(config, found)
    except (ValueError, FileNotFoundError) as error:
        raise ConfigError(str(error)) from None
    planes = {
        name: agent["network"]["planes"]
        for name, agent in settings["agents"].items()
        if "network" in agent
    }
    try:
        game = make_game(
            config, config.ppo.num_envs, derived_seed(config.seed, rank()), auto_reset=True,
            device=device,
        )  # fmt: skip
        env = PackingVecEnv(game, planes, config)
        runner = Runner(env, settings, folder, device, config=config.to_dict(), **reports)
        torch.manual_seed(derived_seed(config.seed, rank(), 1))  # processes draw different actions
        if found is not None:
            runner.resume(found)
        elif config.init is not None:
            runner.begin_with(checkpoint.read(config.init, device))
    except (ValueError, FileNotFoundError) as error:
        raise ConfigError(str(error)) from None
    return runner


def evaluation(config: Config, found: Mapping[str, Any]) -> dict[str, Any]:
    """Play the held-out sequences with a checkpoint's agents, each taking its best action."""
    device = local_device(config)
    policy = checkpoint.load_policy(found, device, config.evaluation.seed)

    def game(n: int, first_episode: int) -> Packing:
        return make_game(
            config, n, config.evaluation.seed, auto_reset=False, device=device,
            first_episode=first_episode,
        )  # fmt: skip

    stream = make_stream(config)
    episodes = min(config.evaluation.episodes, stream.episodes or config.evaluation.episodes)
    reached = evaluate.mean_utilization(evaluate.play(policy, game, episodes))
    return {"seed": config.evaluation.seed, **reached}


class Display:
    """Progress on the terminal: a bar where there is one, else a line now and then."""

    def __init__(self, console: Console, total: int, done: int) -> None:
        self.console, self.total = console, total
        self.live = console.is_terminal
        self.bar = Bar(
            TextColumn("iteration {task.completed:.0f}/{task.total:.0f}"), BarColumn(20),
            TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console,
        )  # fmt: skip
        self.text = Text()
        self.view = Live(Group(self.bar, self.text), console=console, refresh_per_second=2)
        self.task = self.bar.add_task("", total=total, completed=done)
        self.said = 0.0

    def show(self, progress: Progress) -> None:
        """One iteration is done."""
        lines = self.lines(progress)
        self.bar.update(self.task, completed=progress.iteration)
        self.text.plain = "\n".join(lines)
        now = time.monotonic()
        final = progress.iteration == self.total
        if not self.live and (final or now - self.said > QUIET_SECONDS):
            self.said = now
            left = (self.total - progress.iteration) * progress.seconds / progress.iteration
            self.console.print(
                f"iteration {progress.iteration}/{self.total}  {'  '.join(lines)}  "
                f"left {datetime.timedelta(seconds=round(left))}",
                soft_wrap=True,
            )

    @staticmethod
    def lines(progress: Progress) -> list[str]:
        """Speed, utilization and reward; then each learner's entropy and KL divergence."""
        shown = [f"{progress.items_per_second:,.0f} items/s"]
        if not math.isnan(progress.utilization):
            shown.append(f"util {100 * progress.utilization:.1f} %")
        if not math.isnan(progress.reward):
            shown.append(f"reward {progress.reward:.3f}")
        learned = []
        for name in dict.fromkeys(key.partition("/")[0] for key in progress.losses if "/" in key):
            entropy, kl = (progress.losses[f"{name}/{what}"] for what in ("entropy", "kl"))
            learned.append(f"{name} entropy {entropy:.3f} KL {kl:.3f}")
        return ["  ".join(shown), "  ".join(learned)]

    def evaluated(self, row: Mapping[str, Any]) -> None:
        """An evaluation is done."""
        spread = "" if row["low"] is None else f" ± {50 * (row['high'] - row['low']):.2f}"
        self.console.print(
            f"evaluation after {row['iteration']} iterations, {row['items']:,} items, "
            f"{row['seconds'] / 60:.1f} min: utilization {100 * row['utilization']:.2f}{spread} "
            f"% over {row['episodes']} episodes",
            soft_wrap=True,
        )


def write_history(path: Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Write the evaluations as CSV."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(history[-1]))
    writer.writeheader()
    writer.writerows(history)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def write_record(folder: Path, config: Config, arguments: Sequence[str]) -> None:
    """Keep the settings, and what ran them, beside the checkpoints."""
    text = yaml.safe_dump(config.to_dict(), sort_keys=False)
    write_atomically(folder / "config.yaml", lambda file: file.write(text.encode()))
    versions = {"python": platform.python_version(), "marl_pack": marl_pack.__version__}
    versions |= {name: metadata.version(name) for name in PACKAGES}
    path = folder / "run.json"
    before = json.loads(path.read_text()) if path.is_file() else None
    record: dict[str, Any] = {
        "arguments": list(arguments),
        "seed": config.seed,
        "started": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "versions": versions,
    }
    if before is not None:  # gone on with: keep how it began
        before.setdefault("resumed", []).append(record)
        record = before
    record_text = json.dumps(record, indent=2) + "\n"
    write_atomically(path, lambda file: file.write(record_text.encode()))


def new_folder(config: Config) -> Path:
    """The folder of a new run, made here: no two runs share one.

    Raises:
        ConfigError: if there is something in it, or it cannot be made.
    """
    name = config.output.name
    if name is None:
        name = f"{datetime.datetime.now():%Y-%m-%d_%H-%M-%S}_seed{config.seed}"
    folder = Path(config.output.folder) / name
    if (folder / checkpoint.LATEST).exists():
        raise ConfigError(
            f"output.name: {folder} holds a run; --resume {folder} goes on with it; or name another"
        )
    try:
        folder.mkdir(parents=True)
    except FileExistsError:
        raise ConfigError(f"output.name: {folder} is there already; name another") from None
    except OSError as error:
        raise ConfigError(f"output.folder: {error}") from None
    return folder


def resumed(run: str, arguments: Sequence[str]) -> tuple[Config, dict[str, Any]]:
    """The settings and the latest checkpoint of a run to go on with.

    Raises:
        ConfigError, ValueError, FileNotFoundError: if it cannot be resumed so.
    """
    folder = Path(run)
    try:
        found = checkpoint.read(folder / checkpoint.LATEST if folder.is_dir() else folder)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    kept = from_dict(found["config"])
    config, options = parse(["--config", yaml.safe_dump(kept.to_dict()), *arguments])
    if len(options.config or []) > 1:
        raise ConfigError("--resume: the run has its own settings; give no --config beside it")
    before, after = _flat(kept.to_dict()), _flat(config.to_dict())
    for key, value in after.items():
        if value != before[key] and not key.startswith(MAY_CHANGE):
            raise ConfigError(
                f"--resume: the run has {key} = {before[key]}, not {value}; beside --resume only "
                "output.*, evaluation.* and ppo.max_iterations may change"
            )
    done = found["iter"] + 1
    if config.ppo.max_iterations < min(done, kept.ppo.max_iterations):
        raise ConfigError(
            f"ppo.max_iterations = {config.ppo.max_iterations}: the run has done {done} already"
        )
    return config, found


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys of nested settings."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, dict):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def train(
    config: Config,
    folder: Path,
    console: Console,
    found: Mapping[str, Any] | None = None,
) -> Runner:
    """Run the training to its end.

    Args:
        config: the settings.
        folder: the run's.
        console: where progress goes.
        found: the checkpoint to go on from.

    Raises:
        RunInterruptedError: after SIGINT or SIGTERM, with a checkpoint written.
        ConfigError, ValueError: if a setting or the checkpoint cannot be.
    """
    torch.set_num_threads(config.threads)
    total = config.ppo.max_iterations
    display = Display(console, total, 0 if found is None else found["iter"] + 1)

    def evaluated(history: list[dict[str, Any]]) -> None:
        write_history(folder / "evaluations.csv", history)
        display.evaluated(history[-1])

    runner = make_runner(
        config,
        folder,
        found,
        evaluate=lambda made: evaluation(config, made),
        show=display.show if rank() == 0 else lambda progress: None,
        evaluated=evaluated,
    )
    if rank() == 0:
        write_record(folder, config, sys.argv[1:])

    def stop(number: int, frame: object) -> None:
        if runner.stop_requested:  # asked twice: at once
            raise KeyboardInterrupt
        runner.stop_requested = True
        if rank() == 0:
            console.print("stopping after this iteration; once more stops at once")

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
    """The command ``python -m marl_pack.train``."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    console = Console()
    run, folder = None, None
    try:
        run, rest = _resume_option(given)
        found = None
        if run is not None:
            config, found = resumed(run, rest)
            folder = Path(run) if Path(run).is_dir() else Path(run).parent
        else:
            config, _ = parse(given)
            folder = new_folder(config) if rank() == 0 else Path(config.output.folder)
        if rank() == 0:
            console.print(f"run: {folder}", soft_wrap=True)
        runner = train(config, folder, console if rank() == 0 else Console(quiet=True), found)
    except RunInterruptedError:
        if rank() == 0:
            console.print(
                f"stopped with a checkpoint; go on with --resume {folder}", soft_wrap=True
            )
        return 130
    except KeyboardInterrupt:
        console.print("stopped at once; the last checkpoint is as it was")
        return 130
    except TrainingDivergedError as error:
        print(f"python -m marl_pack.train: {error}", file=sys.stderr)
        return 1
    except (ConfigError, OSError, ModuleNotFoundError) as error:
        if run is None and rank() == 0 and folder is not None:
            with contextlib.suppress(OSError):  # nothing has begun, unless something is in it
                folder.rmdir()
        print(f"python -m marl_pack.train: {error}", file=sys.stderr)
        return 2
    if rank() == 0:
        console.print(
            f"done: {runner.logger.tot_timesteps:,} items; play it with "
            f"python -m marl_pack.evaluate --policy {folder}",
            soft_wrap=True,
        )
    return 0


def _resume_option(given: Sequence[str]) -> tuple[str | None, list[str]]:
    """What follows --resume, None without it, and the other options.

    Raises:
        ConfigError: if nothing follows it.
    """
    first = argparse.ArgumentParser(add_help=False, exit_on_error=False, allow_abbrev=False)
    first.add_argument("--resume")
    try:
        known, rest = first.parse_known_args(given)
    except argparse.ArgumentError:
        raise ConfigError("--resume needs a run's folder") from None
    if known.resume == "":
        raise ConfigError("--resume needs a run's folder")
    return known.resume, rest


if __name__ == "__main__":
    sys.exit(main())

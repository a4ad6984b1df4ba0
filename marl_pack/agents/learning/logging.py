"""A logger of rsl_rl that does not print, and reports each iteration to a function."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from rsl_rl.utils.logger import Logger

from marl_pack.extras import missing


@dataclass(frozen=True)
class Progress:
    """The figures of one iteration."""

    iteration: int  # number of iterations done, this one included
    items: int  # items placed since the run began, by all processes
    items_per_second: float  # in this iteration
    seconds: float  # spent learning since the run began
    utilization: float  # mean of the episodes that ended in this iteration; NaN if none did
    reward: float  # mean return of the last 100 episodes; NaN before the first
    losses: dict[str, float]  # from :meth:`marl_pack.agents.learning.ppo.PackingPPO.update`


class IterationLogger(Logger):
    """A logger of rsl_rl that does not print, and reports each iteration to a function."""

    report: Callable[[Progress], None]

    def init_logging_writer(self) -> None:
        """Open the writer, and store the state of the code in the folder of the logs."""
        try:
            with contextlib.redirect_stdout(io.StringIO()):
                super().init_logging_writer()
        except ModuleNotFoundError as error:
            raise missing(error, "the logger wandb needs its package", "wandb") from None

    def log(
        self, it: int, start_it: int, total_it: int, collect_time: float, learn_time: float,
        loss_dict: dict[str, float], **others: Any,
    ) -> None:  # fmt: skip
        """Log as rsl_rl does, then report."""
        ended = [extra["Train/utilization"] for extra in self.ep_extras if extra]
        utilization = float(torch.cat(ended).mean()) if ended else float("nan")
        with contextlib.redirect_stdout(io.StringIO()):
            super().log(it, start_it, total_it, collect_time, learn_time, loss_dict, **others)
        batch = self.cfg["num_steps_per_env"] * self.num_envs * self.gpu_world_size
        if self.writer is None:  # rsl_rl counts only where it logs; all need the same counts
            self.tot_timesteps += batch
            self.tot_time += collect_time + learn_time
        rewards = self.rewbuffer
        self.report(
            Progress(
                it + 1, self.tot_timesteps, batch / (collect_time + learn_time), self.tot_time,
                utilization, sum(rewards) / len(rewards) if rewards else float("nan"), loss_dict,
            )
        )  # fmt: skip

"""The runner of a training run: rsl_rl's ``OnPolicyRunner`` with exact resuming and evaluation.

The training loop, the optimisation and the scalars are rsl_rl's own. Evaluations and checkpoints
are added after each iteration, when rsl_rl has logged it.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor
from torch.utils._pytree import tree_map

import marl_pack
from marl_pack.agents.learned import LearnedAgent, LearnedSelection
from marl_pack.agents.learning import checkpoint as checkpoints
from marl_pack.agents.learning.form import check_alike, check_form, check_keys
from marl_pack.agents.learning.logging import IterationLogger, Progress
from marl_pack.agents.learning.ppo import PackingPPO, Step
from marl_pack.agents.learning.resuming import check_generator, check_progress, checked_optimizer
from marl_pack.agents.networks.actor_critic import shape_of
from marl_pack.agents.networks.kinds import AGENT_KINDS, SELECTION
from marl_pack.agents.networks.shape import Network
from marl_pack.agents.networks.trunk import widen
from marl_pack.agents.policy import Policy
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.vec_env import PackingVecEnv

COMPARABLE = ("seed", "episodes")  # evaluations that agree in these play the same sequences
LONGEST_RUN = 10**9
"""Longest time of a run, in seconds; TensorBoard numbers its events by seconds."""
LOGGER_STATE = ("tot_timesteps", "tot_time", "cur_reward_sum", "cur_episode_length")
LOGGER_BUFFERS = ("rewbuffer", "lenbuffer")


class RunInterruptedError(Exception):
    """The run was stopped on request, after an iteration and with a checkpoint written."""


class TrainingDivergedError(Exception):
    """A loss or a weight is not finite any more; the last checkpoint is unchanged."""


class Runner(OnPolicyRunner):
    """A runner that trains the agents of :class:`marl_pack.agents.learning.ppo.PackingPPO`.

    Args:
        env: the games.
        train_cfg: the configuration of rsl_rl's runner, with ``agents`` and ``algorithm`` as in
            :meth:`PackingPPO.construct_algorithm`, and ``latest_every`` and ``evaluate_every``: the
            iterations between checkpoints and between evaluations (0: none).
        log_dir: the run's folder; None for no logs and no checkpoints.
        device: the device of games and networks.
        config: the run's settings, stored in the checkpoints.
        evaluate: checkpoint → figures of its policy, with ``utilization``.
        show: called with the figures of each iteration.
        evaluated: called after each evaluation with the history of all evaluations.
    """

    alg: PackingPPO
    logger: IterationLogger

    def __init__(
        self,
        env: PackingVecEnv,
        train_cfg: dict[str, Any],
        log_dir: Path | None,
        device: str,
        *,
        config: Mapping[str, Any],
        evaluate: Callable[[Mapping[str, Any]], dict[str, Any]] | None = None,
        show: Callable[[Progress], None] = lambda progress: None,
        evaluated: Callable[[list[dict[str, Any]]], None] = lambda history: None,
    ) -> None:
        super().__init__(env, train_cfg, None if log_dir is None else str(log_dir), device)
        self.folder = log_dir
        stock = vars(self.logger)
        self.logger = IterationLogger.__new__(IterationLogger)  # with what rsl_rl has set up
        self.logger.__dict__.update(stock)
        self.logger.git_status_repos = [marl_pack.__file__]
        self.logger.report = self._after_iteration
        self.config, self.evaluate, self.show = dict(config), evaluate, show
        self.evaluated = evaluated
        self.evaluations: list[dict[str, Any]] = []
        self.stop_requested = False
        self.last_iteration = 0  # of this call of learn()
        self._frozen = {
            name: settings["record"]
            for name, settings in train_cfg["agents"].items()
            if "record" in settings
        }

    def train(self, iterations: int) -> None:
        """Train until the run has done ``iterations`` iterations in total.

        Raises:
            RunInterruptedError: if :attr:`stop_requested` was set; a checkpoint has been written.
        """
        self.last_iteration = iterations - 1
        remaining = iterations - self.current_learning_iteration
        self.current_learning_iteration -= 1  # the last iteration done
        self._write_latest()  # from now on the run can be resumed
        self.current_learning_iteration += 1
        if remaining > 0:
            self.learn(remaining)
            self.current_learning_iteration += 1  # rsl_rl would repeat the last

    def _after_iteration(self, progress: Progress) -> None:
        """Show the iteration; evaluate, write a checkpoint and stop when due."""
        self.current_learning_iteration = it = progress.iteration - 1
        self.show(progress)
        not_finite = [key for key, value in progress.losses.items() if not math.isfinite(value)]
        not_finite += self._agents_with_weights_not_finite()
        if not_finite:
            raise TrainingDivergedError(
                f"training diverged in iteration {progress.iteration}: {', '.join(not_finite)} not "
                "finite; the last checkpoint is unchanged; try a smaller learning rate"
            )
        final = it == self.last_iteration
        every = self.cfg["evaluate_every"] if self.folder is not None else 0
        if self.evaluate is not None and every and (final or progress.iteration % every == 0):
            self._evaluate(progress)
        stop = self._any_process(self.stop_requested)
        if stop or final or progress.iteration % self.cfg["latest_every"] == 0:
            self._write_latest()
        if stop and not final:
            raise RunInterruptedError

    def _agents_with_weights_not_finite(self) -> list[str]:
        """Return ``NAME/weights`` for each network whose weights are not all finite."""
        weights = {
            name: [*ppo.actor.parameters(), *ppo.critic.parameters()]
            for name, ppo in self.alg.learners.items()
        }
        if self.alg.afterstates is not None:
            weights["afterstate_critic"] = list(self.alg.afterstates.critic.parameters())
        return [
            f"{name}/weights"
            for name, parameters in weights.items()
            if not torch.stack([weight.isfinite().all() for weight in parameters]).all()
        ]

    def _write_latest(self) -> None:
        """Write the checkpoint to resume from; every process takes part."""
        if self.folder is None:
            return
        state = self._gather(self.state())
        if self.gpu_global_rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            checkpoints.write(
                self.folder / checkpoints.LATEST, self.checkpoint() | {"state": state}
            )

    def _evaluate(self, progress: Progress) -> None:
        """Evaluate the policy and add a row to the history; store the best checkpoint."""
        if self.gpu_global_rank != 0:
            return
        start = time.perf_counter()
        figures = self.evaluate(self.checkpoint())  # type: ignore[misc]  # the caller has checked
        row = {
            "iteration": progress.iteration,
            "items": progress.items,
            "seconds": progress.seconds,
            **figures,
            "evaluation_seconds": time.perf_counter() - start,
        }
        comparable = [
            r for r in self.evaluations if all(r.get(k) == row.get(k) for k in COMPARABLE)
        ]
        best = max((r["utilization"] for r in comparable), default=float("-inf"))
        self.evaluations.append(row)
        if self.logger.writer is not None:
            self.logger.writer.add_scalar(
                "Evaluation/utilization", row["utilization"], progress.iteration - 1
            )
        self.evaluated(self.evaluations)
        if row["utilization"] > best:
            checkpoints.write(self.folder / checkpoints.BEST, self.checkpoint())  # type: ignore[operator]  # as above

    # --- checkpoints ------------------------------------------------------------------------------

    def checkpoint(self) -> dict[str, Any]:
        """Return the content of a checkpoint: settings, networks and progress."""
        algorithm = self.alg.save()
        learned = {
            name: {"network": dict(self.cfg["agents"][name]["network"]), **state}
            for name, state in algorithm.pop("learners").items()
        }
        for seat in self.alg.seats:
            if seat.teacher_at(self.alg.iteration) is not None:  # resuming needs no other file
                name = seat.name
                learned[name]["teacher"] = self.cfg["agents"][name]["teacher"]
        return {
            "format": checkpoints.FORMAT,
            "marl_pack": marl_pack.__version__,
            "config": self.config,
            "agents": learned | self._frozen,
            "iter": self.current_learning_iteration,
            "items": self.logger.tot_timesteps,
            "seconds": self.logger.tot_time,
            "evaluations": self.evaluations,
            **algorithm,
        }

    def state(self) -> dict[str, Any]:
        """Return the other state that this process needs to resume exactly where it stopped."""
        random: dict[str, Tensor] = {"cpu": torch.get_rng_state()}
        if torch.device(self.device).type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(self.device)
        logger = {name: getattr(self.logger, name) for name in LOGGER_STATE}
        logger |= {name: list(getattr(self.logger, name)) for name in LOGGER_BUFFERS}
        state = {"game": self.env.game.state_dict(), "random": random, "logger": logger}
        if self.alg.afterstates is not None:
            state["afterstates"] = self.alg.afterstates.state_dict()
        on_cpu: dict[str, Any] = tree_map(
            lambda value: value.cpu() if torch.is_tensor(value) else value, state
        )
        return on_cpu

    def save(self, path: str, infos: dict[str, Any] | None = None) -> None:
        """Write a checkpoint; rsl_rl calls this every ``save_interval`` iterations."""
        checkpoints.write(Path(path), self.checkpoint() | {"infos": infos})
        self.logger.save_model(path, self.current_learning_iteration)

    def load(
        self,
        path: str,
        load_cfg: dict[str, Any] | None = None,
        strict: bool = True,
        map_location: str | None = None,
    ) -> dict[str, Any] | None:
        """Load networks and optimisers from a checkpoint, to train from its next iteration on.

        Raises:
            ValueError: if the checkpoint does not match this run.
        """
        checkpoint = self._checked_learners(checkpoints.read(path, map_location or self.device))
        if self.alg.load(checkpoint | {"learners": checkpoint["agents"]}, load_cfg, strict):
            self.current_learning_iteration = checkpoint["iter"] + 1
        infos: dict[str, Any] | None = checkpoint.get("infos")
        return infos

    def begin_with(self, checkpoint: Mapping[str, Any]) -> None:
        """Load only the weights of another run: of its learners and critic of afterstates.

        Args:
            checkpoint: as :func:`marl_pack.agents.learning.checkpoint.read` returns it.

        Raises:
            ValueError: if an agent that learns here did not learn there, or its network differs. A
                network may have more planes here; their weights are 0 at first.
        """
        for name, ppo in self.alg.learners.items():
            agent = checkpoint["agents"].get(name, {})
            if name == SELECTION and "critic_state_dict" not in agent:
                continue  # none has learned there: the agent keeps its new weights
            if "critic_state_dict" not in agent or "network" not in agent:
                raise ValueError(f"init: the checkpoint has no {name} agent that has learned")
            try:
                old = checkpoints.check_weights(agent, name)
            except ValueError as error:
                raise ValueError(f"init: {error}") from None
            new = shape_of(name, self.cfg["agents"][name]["network"])
            needed = asdict(new)
            if isinstance(old, Network) and isinstance(new, Network):
                needed |= {"planes": old.planes} if set(old.planes) <= set(new.planes) else {}
            if other := {key: v for key, v in asdict(old).items() if needed[key] != v}:
                raise ValueError(
                    f"init: the checkpoint's {name} agent has another network: {other}; use "
                    "the same, or one with more planes (--config with the settings of its run)"
                )
            for part in ("actor", "critic"):
                weights = agent[f"{part}_state_dict"]
                if isinstance(old, Network) and isinstance(new, Network):
                    weights = widen(weights, old, new, AGENT_KINDS[name].orientations)
                getattr(ppo, part).load_state_dict(weights)
        if "afterstate_critic" in checkpoint and self.alg.afterstates is not None:
            # Otherwise the critic keeps its new weights.
            weights = checkpoint["afterstate_critic"]
            own_critic = self.alg.afterstates.critic.state_dict()
            check_alike(weights, own_critic, "init: afterstate_critic")
            self.alg.load_afterstate_critic(weights)

    def resume(self, checkpoint: Mapping[str, Any]) -> None:
        """Resume exactly from the checkpoint of a run with the same settings.

        Args:
            checkpoint: the run's latest, as :func:`marl_pack.agents.learning.checkpoint.read`
                returns it.

        Raises:
            ValueError: if the checkpoint cannot be resumed by this run.
        """
        states = checkpoint.get("state")
        if states is None:
            raise ValueError("this checkpoint has no state of the game; resume from latest.pt")
        if isinstance(states, str):  # the reason why it cannot be resumed
            raise ValueError(f"this run cannot be resumed: {states}")
        if len(states) != self.gpu_world_size:
            raise ValueError(
                f"{self.gpu_world_size} processes: the run needs {len(states)}, as before"
            )
        process_state = states[self.gpu_global_rank]
        try:
            loaded = self._checked(checkpoint, process_state)
            self.alg.load(loaded | {"learners": loaded["agents"]}, None, True)
            if self.alg.afterstates is not None:
                self.alg.afterstates.load_state_dict(process_state["afterstates"])
        except ValueError as error:
            raise ValueError(f"the checkpoint does not match its own settings: {error}") from None
        self.current_learning_iteration = checkpoint["iter"] + 1
        self.evaluations = list(checkpoint["evaluations"])
        self.env.game.load_state_dict(process_state["game"])
        for name in LOGGER_STATE:
            value = process_state["logger"][name]
            setattr(self.logger, name, value.to(self.device) if torch.is_tensor(value) else value)
        for name in LOGGER_BUFFERS:
            getattr(self.logger, name).extend(process_state["logger"][name])
        torch.set_rng_state(process_state["random"]["cpu"].cpu())
        if "cuda" in process_state["random"]:
            torch.cuda.set_rng_state(process_state["random"]["cuda"].cpu(), self.device)

    def _checked(self, checkpoint: Mapping[str, Any], state: Mapping[str, Any]) -> dict[str, Any]:
        """Check that this run may continue a checkpoint, and return it.

        Its optimisers' settings are replaced by those of this run. The game and the learner of the
        critic of afterstates check their own states when they load them.

        Args:
            checkpoint: as for :meth:`resume`.
            state: the state of this process in the checkpoint.

        Raises:
            ValueError: the message names the first value that this run would not have written.
        """
        expected = self.checkpoint() | {"state": self.state()}
        loaded = dict(checkpoint) | {"state": state}
        check_keys(loaded, list(expected), "", also=("infos",))
        progress = ("iter", "items", "seconds", "schedule_iteration")
        check_alike({k: loaded[k] for k in progress}, {k: expected[k] for k in progress}, "")
        steps = self.cfg["num_steps_per_env"]
        check_progress(loaded, self.env.num_envs * self.gpu_world_size * steps)
        for k, row in enumerate(loaded["evaluations"]):
            for key in ("utilization", *COMPARABLE):
                if not isinstance(row.get(key), int | float):
                    raise ValueError(f"evaluations.{k}.{key}: needs a number")
        check_keys(state, list(expected["state"]), "state")
        check_alike(state["random"], expected["state"]["random"], "state.random")
        check_generator(state["random"]["cpu"], "state.random.cpu")
        logger, own_logger = state["logger"], expected["state"]["logger"]
        check_alike(logger, own_logger, "state.logger")
        check_form({name: logger[name] for name in LOGGER_BUFFERS}, {str: [float]}, "state.logger")
        if logger["tot_timesteps"] != loaded["items"]:
            raise ValueError(f"state.logger.tot_timesteps: needs {loaded['items']}")
        if not 0 <= logger["tot_time"] <= LONGEST_RUN:
            raise ValueError(f"state.logger.tot_time: needs seconds from 0 to {LONGEST_RUN:,}")
        return self._checked_learners(loaded)

    def _checked_learners(self, checkpoint: Mapping[str, Any]) -> dict[str, Any]:
        """Check that this run may load a checkpoint's networks and optimisers, and return it.

        Its optimisers' settings are replaced by those of this run. Errors: see :meth:`_checked`.
        """
        expected, begun = self.checkpoint(), checkpoint["iter"] >= 0
        loaded = dict(checkpoint) | {"agents": dict(checkpoint["agents"])}
        check_keys(loaded, list(expected), "", also=list(loaded))
        for name, ppo in self.alg.learners.items():
            where = f"agents.{name}"
            record, needed = checkpoints.agent_of(loaded, name), expected["agents"][name]
            parts = [part for part in needed if part != "teacher"]
            check_keys(record, parts, where, also=("teacher",))
            if checkpoints.check_weights(record, name) != shape_of(name, needed["network"]):
                raise ValueError(f"{where}.network: differs from the network in config.{name}")
            optimizer = checked_optimizer(
                record["optimizer_state_dict"],
                ppo.optimizer,
                f"{where}.optimizer_state_dict",
                begun,
            )
            loaded["agents"][name] = record | {"optimizer_state_dict": optimizer}
        if self.alg.afterstates is not None:
            key = "afterstate_critic"
            check_alike(loaded[key], expected[key], key)
            key = "afterstate_optimizer"
            loaded[key] = checked_optimizer(loaded[key], self.alg.afterstates.optimizer, key, begun)
        return loaded

    def get_inference_policy(self, device: str | None = None) -> Policy:
        """Return the current policy; each learner takes its most probable action."""
        lookahead = self.alg.lookahead
        agents: list[Callable[..., Tensor]] = []
        for seat in self.alg.seats:
            if seat.ppo is None:
                assert seat.frozen is not None, "an agent learns or is frozen"
                agents.append(seat.frozen)
            elif seat.kind is None:
                agents.append(LearnedSelection(seat.ppo.actor, lookahead))
            else:
                agents.append(LearnedAgent(seat.name, seat.ppo.actor, lookahead))

        def play(game: Packing | SelectionPacking) -> Any:
            step = Step(game, lookahead)
            for seat, agent in zip(self.alg.seats, agents, strict=True):
                step.add(seat, agent(step.table, *step.choice))
            return step.actions.unbind(1)

        return play

    def export_policy_to_onnx(self, path: str, *args: Any, **named: Any) -> None:
        """Refuse to export: rsl_rl's exporter supports neither several policies nor masks.

        Raises:
            NotImplementedError: always; ``python -m marl_pack.export`` exports the agents.
        """
        raise NotImplementedError("use python -m marl_pack.export on a checkpoint")

    export_policy_to_jit = export_policy_to_onnx

    # --- several processes ------------------------------------------------------------------------

    def _configure_multi_gpu(self) -> None:
        """Set up the processes as rsl_rl does; processes on the CPU communicate through gloo."""
        world = int(os.environ.get("WORLD_SIZE", "1"))
        if world == 1 or torch.device(self.device).type != "cpu":
            super()._configure_multi_gpu()
            return
        rank = int(os.environ["RANK"])
        self.gpu_world_size, self.is_distributed = world, True
        self.gpu_global_rank, self.gpu_local_rank = rank, int(os.environ["LOCAL_RANK"])
        self.cfg["multi_gpu"] = {
            "global_rank": rank, "local_rank": self.gpu_local_rank, "world_size": world
        }  # fmt: skip
        torch.distributed.init_process_group("gloo", rank=rank, world_size=world)

    def _any_process(self, flag: bool) -> bool:
        """Return whether the flag is set in any process."""
        if not self.is_distributed:
            return flag
        votes = torch.tensor(float(flag), device=self.device)
        torch.distributed.all_reduce(votes, op=torch.distributed.ReduceOp.MAX)
        return bool(votes)

    def _gather(self, state: dict[str, Any]) -> list[dict[str, Any]] | None:
        """Return the states of all processes, in the first process only."""
        if not self.is_distributed:
            return [state]
        states: list[Any] = [None] * self.gpu_world_size
        torch.distributed.gather_object(state, states if self.gpu_global_rank == 0 else None)
        return states

"""PPO for agents that take turns: each has a stock rsl_rl ``PPO``; the runner sees one algorithm.

Within a step the orientation agent acts first. The placement agent then observes the item in the
chosen orientation and acts. Where there are several boxes or bins, the selection agent acts before
them, and they see the selected box and bin (:class:`Step`).

All agents store the same reward and the same end of episode (Eq. 3 – 5); each computes its
advantages over its own turns. A frozen agent plays without learning. An agent that clones a teacher
plays as the teacher does; all its choices have the same advantage, so that PPO makes them more
probable.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from marl_pack.agents.afterstates.critic import AfterstateCritic, AfterstateLearner
from marl_pack.agents.afterstates.lookahead import Lookahead, value_share_at
from marl_pack.agents.learning.bin_returns import BinReturns
from marl_pack.agents.learning.cloning import Teacher
from marl_pack.agents.networks.actor_critic import models_of
from marl_pack.agents.networks.kinds import (
    AGENT_KINDS,
    PLACEMENT,
    SELECTION,
    AgentKind,
    Choice,
    observe,
)
from marl_pack.agents.networks.planes import encode_observation
from marl_pack.agents.networks.selection import observe_options
from marl_pack.agents.networks.sight import Observation
from marl_pack.game.packing import Packing
from marl_pack.game.selection import SelectionPacking
from marl_pack.vec_env import PackingVecEnv

KL_SAMPLES = 256  # states on which the KL divergence of an update is measured


@dataclass
class Seat:
    """One agent's place in a step: a learner with its PPO, or an agent that is frozen.

    Args:
        name: the agent's name.
        ppo: a learner's PPO; None for a frozen agent.
        frozen: a frozen agent: games and earlier choices of the turn → actions int64 [G].
        planes: extra planes that a learner observes.
        schedule: a learner's settings for :meth:`anneal`.
        teacher: the teacher whose choices a learner clones in its first iterations.
    """

    name: str
    ppo: PPO | None = None
    frozen: Callable[..., Tensor] | None = None
    planes: Sequence[str] = ()
    schedule: Mapping[str, Any] | None = None
    teacher: Teacher | None = None

    @property
    def kind(self) -> AgentKind | None:
        """The agent's kind; None for the selection agent, which does not act on one bin."""
        return AGENT_KINDS.get(self.name)

    def teacher_at(self, iteration: int) -> Teacher | None:
        """Return the teacher that the learner clones in an iteration, None if there is none."""
        teacher = self.teacher
        return teacher if teacher and iteration < teacher.iterations else None

    def act(self, observation: TensorDict, step: Step, iteration: int) -> Tensor:
        """Return the actions int64 [G]; a learner records them in its storage."""
        if self.ppo is None:
            return self._play_frozen(step)
        action = self.ppo.act(observation)
        teacher = self.teacher_at(iteration)
        if teacher is None:
            return action.squeeze(1).long()
        actions = teacher(step.table, *step.choice)
        recorded = actions.unsqueeze(1).to(action.dtype)
        self.ppo.transition.actions = recorded
        self.ppo.transition.actions_log_prob = self.ppo.actor.get_output_log_prob(recorded).detach()
        return actions

    def draw(self, observation: TensorDict, step: Step, iteration: int) -> Tensor:
        """Return actions int64 [G] as :meth:`act` would, without recording them."""
        if self.ppo is None:
            return self._play_frozen(step)
        teacher = self.teacher_at(iteration)
        if teacher is not None:
            return teacher(step.table, *step.choice)
        return self.ppo.actor(observation, stochastic_output=True).squeeze(1).long()

    def _play_frozen(self, step: Step) -> Tensor:
        assert self.frozen is not None, "an agent that does not learn is frozen"
        return self.frozen(step.table, *step.choice)

    def anneal(self, progress: float) -> None:
        """Set learning rate and entropy bonus for ``progress``, the share 0 … 1 of the run done."""
        assert self.ppo is not None, "only learners have a schedule"
        assert self.schedule is not None, "a learner has a schedule"
        first, last = self.schedule["entropy_coef"], self.schedule["final_entropy_coef"]
        self.ppo.entropy_coef = first + progress * (last - first)
        if self.schedule["schedule"] == "linear":
            self.ppo.learning_rate = self.schedule["learning_rate"] * (1 - progress)
            for group in self.ppo.optimizer.param_groups:
                group["lr"] = self.ppo.learning_rate


class Step:
    """The choices so far in a step of G games, and the games as the next agent sees them.

    After the selection agent, the next agents see a game of one box and one bin.

    Args:
        game: the games.
        lookahead: its results for all options are used for the selected ones.

    Attributes:
        table: the games as the next agent sees them.
        option: the selected options, int64 [G]; None in games without selection.
        choice: the orientations and the cells chosen so far.
    """

    def __init__(self, game: Packing | SelectionPacking, lookahead: Lookahead) -> None:
        self.game, self.lookahead = game, lookahead
        self.table: Any = game
        self.option: Tensor | None = None
        self.choice: Choice = ()
        if isinstance(game, SelectionPacking) and game.options == 1:
            self.select(torch.zeros(game.n, dtype=torch.int64, device=game.device))

    def select(self, option: Tensor) -> None:
        """Show the next agents the boxes and bins of options, int64 [G]."""
        game = self.game
        assert isinstance(game, SelectionPacking), "only these games have options"
        rows, self.option = game.rows(option), option
        self.table = game.view(rows)
        self.lookahead.memo.follow(game.view(), rows, self.table)

    def add(self, seat: Seat, action: Tensor) -> None:
        """Add the action of an agent, int64 [G]."""
        if seat.kind is None:
            self.select(action)
        else:
            self.choice = seat.kind.extend(self.choice, action, self.game.floor)

    @property
    def actions(self) -> Tensor:
        """All choices, int64 [G, 2], or [G, 3] with the options first."""
        selected = () if self.option is None else (self.option,)
        return torch.stack((*selected, *self.choice), 1)


class PackingPPO:
    """The algorithm for rsl_rl's ``OnPolicyRunner``: all learners and the critic of afterstates.

    Args:
        seats: the agents, in the order of their turns.
        env: the games.
        lookahead: computes afterstates and their values; shared by all learners.
        iterations: number of iterations of the run, for the schedules.
        afterstates: fits the critic of afterstates; None if no agent observes its values.
        afterstate_ramp: see :func:`marl_pack.agents.afterstates.lookahead.value_share_at`.
        bin_returns: records the rewards of each bin, for ``afterstates`` in games with selection.

    Raises:
        ValueError: if no agent learns.
    """

    rnd = None  # no exploration bonus; the runner reads it

    def __init__(
        self,
        seats: Sequence[Seat],
        env: PackingVecEnv,
        lookahead: Lookahead,
        iterations: int,
        afterstates: AfterstateLearner | None = None,
        afterstate_ramp: Sequence[int] = (0, 0),
        bin_returns: BinReturns | None = None,
    ) -> None:
        self.seats = list(seats)
        self.learners = {seat.name: seat.ppo for seat in self.seats if seat.ppo is not None}
        if not self.learners:
            raise ValueError("all agents are frozen: nothing would learn")
        self.bin_returns = bin_returns
        self._bin = torch.zeros(0, dtype=torch.int64)  # of the last placements
        self.env, self.lookahead = env, lookahead
        self.iterations, self.afterstate_ramp = iterations, afterstate_ramp
        self.afterstates = afterstates
        self._set_iteration(0)
        self._last: TensorDict | None = None  # the observation after the rollout

    def _set_iteration(self, iteration: int) -> None:
        """Store the number of iterations done, and set what depends on it."""
        self.iteration = iteration
        self.lookahead.value_share = value_share_at(self.afterstate_ramp, iteration)
        self.lookahead.forget_values()

    @property
    def _learning(self) -> list[Seat]:
        return [seat for seat in self.seats if seat.ppo is not None]

    # --- the rollout ------------------------------------------------------------------------------

    def _observation(self, seat: Seat, step: Step, first: TensorDict) -> TensorDict:
        """Return what a learner observes at its turn: ``first`` if its turn is the first.

        It is encoded here, once for acting and for all passes of the update.
        """
        if seat.ppo is None or seat.kind is None:
            return first
        observation: Observation = first
        if seat is not self.seats[0]:
            observation = observe(
                seat.name, step.table, seat.planes, self.lookahead, *step.choice
            )  # fmt: skip
        return _encoded(observation, seat.planes)

    def act(self, obs: TensorDict) -> Tensor:
        """Return the choices, int64 [G, 2], or [G, 3] with the options first; record the learners'.

        Args:
            obs: as the environment's ``get_observations`` returns it.
        """
        game = self.env.game
        step = Step(game, self.lookahead)
        for seat in self.seats:
            observation = self._observation(seat, step, obs)
            step.add(seat, seat.act(observation, step, self.iteration))
        if self.afterstates is not None:
            self.afterstates.record(step.table, *step.choice)
        if isinstance(game, SelectionPacking) and step.option is not None:
            self._bin = step.option % game.b
        return step.actions

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]
    ) -> None:
        """Record the reward of a step, which all agents share."""
        if self.bin_returns is not None:
            self.bin_returns.record(self._bin, rewards, extras["closed"])
        for ppo in self.learners.values():
            ppo.process_env_step(obs, rewards, dones, extras)

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute the advantages of the rollout that ends at ``obs``.

        Each agent's return is completed by its critic's value at its next turn. The choices of the
        earlier agents in that turn are drawn, but not recorded.
        """
        self._last = obs
        step = Step(self.env.game, self.lookahead)
        remaining = len(self._learning)
        for seat in self.seats:
            observation = self._observation(seat, step, obs)
            if seat.ppo is not None:
                seat.ppo.compute_returns(observation)
                remaining -= 1
                if seat.teacher_at(self.iteration) is not None:
                    storage = seat.ppo.storage
                    storage.advantages = torch.ones_like(storage.advantages)
            if not remaining:
                break
            step.add(seat, seat.draw(observation, step, self.iteration))

    # --- the update -------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """Run one PPO update of each learner.

        Returns:
            For each learner ``name/value``, ``name/surrogate``, ``name/entropy`` (means over the
            minibatches), ``name/kl`` (old to new policy, after the update), ``name/learning_rate``;
            and ``afterstates``, the squared error of the critic of afterstates.
        """
        losses: dict[str, float] = {}
        progress = min(1.0, self.iteration / max(1, self.iterations))
        for seat in self._learning:
            seat.anneal(progress)
        if self.afterstates is not None:
            losses["afterstates"] = self._learn_afterstates(self.afterstates)
        for seat in self._learning:
            name, ppo = seat.name, seat.ppo
            assert ppo is not None, "it learns"
            losses |= {f"{name}/{key}": value for key, value in ppo.update().items()}
            losses[f"{name}/kl"] = self._divergence(ppo)
            losses[f"{name}/learning_rate"] = ppo.learning_rate
        self._set_iteration(self.iteration + 1)
        if self.afterstates is not None and self._last is not None:
            with torch.inference_mode():  # it has values from before this update
                self._last.update_(self.env.get_observations())
        return losses

    def _learn_afterstates(self, learner: AfterstateLearner) -> float:
        """Fit the critic of afterstates to the returns of the first learner, or of each bin."""
        ppo = next(iter(self.learners.values()))
        processes = ppo.gpu_world_size if ppo.is_multi_gpu else 1
        game, storage = self.env.game, ppo.storage
        if self.bin_returns is not None:
            assert isinstance(game, SelectionPacking), "only these games have several bins"
            with torch.inference_mode():
                coming = self.lookahead.expected(game.bins, game.view()).view(game.n, game.b)
            targets = self.bin_returns.targets(coming, ppo.gamma)
        else:
            targets = (storage.returns - storage.rewards).squeeze(-1)
        return learner.learn(targets, ppo.learning_rate, processes)

    @staticmethod
    def _divergence(ppo: PPO) -> float:
        """Average KL(old || new) over states of the last rollout, spread evenly through it."""
        storage = ppo.storage
        total = storage.num_envs * storage.num_transitions_per_env
        sample = torch.arange(0, total, -(-total // KL_SAMPLES), device=storage.device)
        with torch.inference_mode():
            ppo.actor(storage.observations.flatten(0, 1)[sample], stochastic_output=True)
            old = tuple(p.flatten(0, 1)[sample] for p in storage.distribution_params)
            new = ppo.actor.output_distribution_params
            return float(ppo.actor.get_kl_divergence(old, new).mean())

    # --- other methods that the runner calls ------------------------------------------------------

    @property
    def learning_rate(self) -> float:
        """Learning rate of the first learner; the losses contain those of all learners."""
        return float(next(iter(self.learners.values())).learning_rate)

    @property
    def output_std(self) -> Tensor:
        """Spread of the learners' last action distributions (their ``std``)."""
        return torch.cat([ppo.actor.output_std for ppo in self.learners.values()])

    def get_policy(self) -> PackingPPO:
        """Return the algorithm itself, because there is more than one actor."""
        return self

    def train_mode(self) -> None:
        """Set all networks to training mode."""
        for ppo in self.learners.values():
            ppo.train_mode()

    def eval_mode(self) -> None:
        """Set all networks to evaluation mode."""
        for ppo in self.learners.values():
            ppo.eval_mode()

    def broadcast_parameters(self) -> None:
        """Give all processes the weights of the first one."""
        for ppo in self.learners.values():
            ppo.broadcast_parameters()
        if self.afterstates is not None:
            for weight in self.afterstates.critic.state_dict().values():
                torch.distributed.broadcast(weight, src=0)

    def save(self) -> dict[str, Any]:
        """Return the states of the learners' PPOs, the schedule and the critic of afterstates."""
        state: dict[str, Any] = {
            "learners": {name: ppo.save() for name, ppo in self.learners.items()},
            "schedule_iteration": self.iteration,
        }
        if self.afterstates is not None:
            state["afterstate_critic"] = self.afterstates.critic.state_dict()
            state["afterstate_optimizer"] = self.afterstates.optimizer.state_dict()
        return state

    def load(
        self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None, strict: bool
    ) -> bool:
        """Load a state from :meth:`save`; return whether to load the iteration too."""
        load_iteration = True
        for name, ppo in self.learners.items():
            load_iteration = ppo.load(loaded_dict["learners"][name], load_cfg, strict)
        if self.afterstates is not None:
            self.load_afterstate_critic(loaded_dict["afterstate_critic"])
            self.afterstates.optimizer.load_state_dict(loaded_dict["afterstate_optimizer"])
        self._set_iteration(loaded_dict["schedule_iteration"])
        return load_iteration

    def load_afterstate_critic(self, weights: Mapping[str, Tensor]) -> None:
        """Load weights of the critic of afterstates, if agents observe its values."""
        if self.afterstates is not None:
            self.afterstates.critic.load_state_dict(weights)
            self.lookahead.forget_values()

    @staticmethod
    def construct_algorithm(
        obs: TensorDict, env: PackingVecEnv, cfg: dict[str, Any], device: str
    ) -> PackingPPO:
        """Build the algorithm from the runner's configuration.

        Args:
            obs: an example of an observation.
            env: the games.
            cfg: the configuration. ``algorithm`` has ``iterations``, ``afterstate_ramp``,
                ``lookahead``, ``frozen`` and ``teachers`` (both: agents by name, callables as in
                :class:`Seat`). ``agents`` has
                for each learner ``network``, ``precision``, ``algorithm`` (settings of rsl_rl's
                PPO), ``schedule``, ``teacher_iterations`` and ``teacher_random``.
            device: the device of the networks.
        """
        algorithm = cfg["algorithm"]
        lookahead: Lookahead = algorithm.pop("lookahead")
        frozen, teachers = algorithm.pop("frozen"), algorithm.pop("teachers")
        seats = []
        game = env.game
        zeros = torch.zeros(env.num_envs, dtype=torch.int64, device=env.device)
        for name, settings in cfg["agents"].items():
            if name in frozen:
                seats.append(Seat(name, frozen=frozen[name]))
                continue
            planes = settings["network"].get("planes", ())
            if name == SELECTION:
                assert isinstance(game, SelectionPacking), "there is something to select"
                observed = observe_options(game, lookahead)
                example = TensorDict(observed, batch_size=[game.n], device=game.device)
            else:
                table = game.view(game.rows(zeros)) if isinstance(game, SelectionPacking) else game
                before = (zeros,) if name == PLACEMENT else ()
                example = _encoded(observe(name, table, planes, lookahead, *before), planes)
            teacher = None
            if name in teachers:
                length, share = settings["teacher_iterations"], settings["teacher_random"]
                teacher = Teacher(AGENT_KINDS.get(name), teachers[name], length, share)
            seats.append(
                Seat(
                    name, _stock_ppo(name, settings, example, env, cfg, device), planes=planes,
                    schedule=settings["schedule"], teacher=teacher,
                )
            )  # fmt: skip
        afterstates, bin_returns = None, None
        if lookahead.critic is not None:
            assert isinstance(lookahead.critic, AfterstateCritic), "a run's critic learns"
            afterstates = AfterstateLearner(
                lookahead.critic, lookahead, cfg["num_steps_per_env"], env.num_envs
            )
            if isinstance(game, SelectionPacking):
                bin_returns = BinReturns(cfg["num_steps_per_env"], game.n, game.b, game.device)
        ramp = algorithm["afterstate_ramp"]
        return PackingPPO(
            seats, env, lookahead, algorithm["iterations"], afterstates, ramp, bin_returns
        )


def first_observation(
    name: str, game: Packing | SelectionPacking, planes: Sequence[str], lookahead: Lookahead,
    learns: bool,
) -> dict[str, Tensor]:  # fmt: skip
    """Return what the agent observes that acts first in a step.

    Args:
        name: the agent's name.
        game: the games.
        planes: extra planes that it observes.
        lookahead: computes afterstates and their values.
        learns: whether the agent learns; a frozen agent observes the games by itself.
    """
    if name != SELECTION:
        return observe(name, Step(game, lookahead).table, planes, lookahead)
    assert isinstance(game, SelectionPacking), "there is something to select"
    return observe_options(game, lookahead) if learns else {"mask": game.selection_mask}


def _encoded(observation: Observation, planes: Sequence[str]) -> TensorDict:
    """Return an observation of G games with its input channels, as rsl_rl stores it."""
    mask = observation["mask"]
    channels = encode_observation(observation, planes)
    return TensorDict(channels, batch_size=[len(mask)], device=mask.device)


def _stock_ppo(
    name: str,
    settings: Mapping[str, Any],
    obs: TensorDict,
    env: PackingVecEnv,
    cfg: dict[str, Any],
    device: str,
) -> PPO:
    """Build rsl_rl's PPO with the actor and the critic of one agent."""
    actor, critic, named = models_of(name)
    model = {**named, "network": dict(settings["network"])}
    on_a_bin = name != SELECTION
    precision = {"precision": settings["precision"]} if on_a_bin else {}
    agent_cfg = {
        "algorithm": {
            "class_name": PPO,
            "share_cnn_encoders": on_a_bin,
            **settings["algorithm"],
        },
        "actor": {"class_name": actor, **model, **precision},
        "critic": {"class_name": critic, **model},
        "obs_groups": {"actor": list(obs.keys()), "critic": list(obs.keys())},
        "num_steps_per_env": cfg["num_steps_per_env"],
        "multi_gpu": cfg["multi_gpu"],
    }
    single = SimpleNamespace(num_envs=env.num_envs, num_actions=1)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints both networks
        ppo: PPO = PPO.construct_algorithm(obs, single, agent_cfg, device)
    optimizer = ppo.optimizer
    if "fused" in optimizer.defaults:  # the same steps, one call for all weights
        weights = optimizer.param_groups[0]["params"]
        ppo.optimizer = type(optimizer)(weights, lr=ppo.learning_rate, fused=True)
    return ppo

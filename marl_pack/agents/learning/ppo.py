"""PPO for two agents that take turns: one stock rsl_rl ``PPO`` each, driven as if they were one.

Within a step the orientation agent acts on what it sees, then the placement agent on what that
choice shows it. Both store the same reward and the same end of episode (Eq. 3 – 5), each reckons
its advantages over its own turns. A frozen agent plays without learning. One that imitates plays as
another does, one choice in ten at random, and learns to play so: all have the same advantage.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from marl_pack.agents import joint
from marl_pack.agents.afterstates.critic import AfterstateLearner
from marl_pack.agents.heuristics import make_placement_agent
from marl_pack.agents.learning import checkpoint
from marl_pack.agents.learning.symmetry import see_through_symmetries
from marl_pack.agents.networks.actor_critic import Actor, Critic
from marl_pack.agents.policy import OrientationAgent, PlacementAgent, draw
from marl_pack.game.packing import Packing, orientations_with_a_cell
from marl_pack.vec_env import PackingVecEnv

RANDOM_SHARE = 0.1  # of the choices of an agent that imitates, so that it does not grow too sure
RANDOM: Mapping[str, Callable[..., Tensor]] = {
    "orientation": lambda game: draw(orientations_with_a_cell(game.mask)),
    "placement": make_placement_agent("random", None),
}
KL_SAMPLES = 1024  # states on which the KL divergence of an update is measured


@dataclass(frozen=True)
class Imitation:
    """Whom a learner imitates for how many iterations.

    Orientation agents both, or placement agents.
    """

    model: Callable[..., Tensor]
    random: Callable[..., Tensor]
    iterations: int

    def __call__(self, game: Packing, *before: Tensor) -> Tensor:
        """The model's choices, int64 [N], or random ones in their place here and there."""
        chosen = self.model(game, *before)
        other = torch.rand(len(chosen), device=chosen.device) < RANDOM_SHARE
        return torch.where(other, self.random(game, *before), chosen)


class PackingPPO:
    """What rsl_rl's ``OnPolicyRunner`` takes for a PPO.

    Args:
        learners: name (``orientation``, ``placement`` or ``joint``) → the agent's PPO.
        orientation_agent: who orients where no learner does.
        placement_agent: who places where no learner does.
        env: the bins.
        schedules: name → settings of :meth:`anneal` for that learner.
        iterations: how many there will be, for the schedules.
        afterstates: who teaches the critic that says what placements are worth, if agents see it.
        imitations: name → whom that learner imitates at first; nobody where there is none.
    """

    rnd = None  # no exploration bonus; the runner asks

    def __init__(
        self,
        learners: Mapping[str, PPO],
        orientation_agent: OrientationAgent | None,
        placement_agent: PlacementAgent | None,
        env: PackingVecEnv,
        schedules: Mapping[str, Mapping[str, Any]],
        iterations: int,
        afterstates: AfterstateLearner | None = None,
        imitations: Mapping[str, Imitation] | None = None,
    ) -> None:
        if not learners:
            raise ValueError("both agents are frozen: nothing would learn")
        self.learners = dict(learners)
        self.orientation_agent, self.placement_agent = orientation_agent, placement_agent
        self.env = env
        self.schedules = schedules
        self.iterations = iterations
        self.iteration = 0
        self.afterstates = afterstates
        self.imitations = dict(imitations or {})
        self._last: TensorDict | None = None  # what is seen after the rollout

    # --- the rollout ------------------------------------------------------------------------------

    def act(self, obs: TensorDict) -> Tensor:
        """Both agents' choices, int64 [N, 2]; the learners' are recorded.

        Args:
            obs: what the environment's ``get_observations`` gave.
        """
        chosen = self._choose(obs)
        if self.afterstates is not None:
            self.afterstates.record(self.env.game, chosen[:, 0], chosen[:, 1])
        return chosen

    def _choose(self, obs: TensorDict) -> Tensor:
        if "joint" in self.learners:
            pair = self.learners["joint"].act(obs).squeeze(1).long()
            return torch.stack(joint.split(pair, obs["heightmap"][0].numel()), 1)
        if "orientation" in self.learners:
            orientation = self._turn("orientation", obs)
        else:
            orientation = self._frozen_orientation()
        if "placement" in self.learners:
            cell = self._turn("placement", self.env.orient(orientation), orientation)
        else:
            assert self.placement_agent is not None
            cell = self.placement_agent(self.env.game, orientation)
        return torch.stack((orientation, cell), 1)

    def _turn(self, name: str, seen: TensorDict, *before: Tensor) -> Tensor:
        """A learner's choice, int64 [N], or that of whom it imitates, recorded as its own."""
        ppo = self.learners[name]
        action = ppo.act(seen)
        imitated = self.imitated(name)
        if imitated is None:
            return action.squeeze(1).long()
        chosen = imitated(self.env.game, *before)
        taken = chosen.unsqueeze(1).to(action.dtype)
        ppo.transition.actions = taken
        ppo.transition.actions_log_prob = ppo.actor.get_output_log_prob(taken).detach()
        return chosen

    def imitated(self, name: str) -> Imitation | None:
        """Whom the learner imitates in this iteration."""
        imitation = self.imitations.get(name)
        return imitation if imitation and self.iteration < imitation.iterations else None

    def _frozen_orientation(self) -> Tensor:
        assert self.orientation_agent is not None
        return self.orientation_agent(self.env.game)

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]
    ) -> None:
        """Record the reward that the agents share."""
        for ppo in self.learners.values():
            ppo.process_env_step(obs, rewards, dones, extras)

    def compute_returns(self, obs: TensorDict) -> None:
        """Advantages of the rollout that ends at ``obs``; there an orientation is drawn."""
        self._last = obs
        for name, ppo in self.learners.items():
            if name != "placement":
                ppo.compute_returns(obs)
                continue
            imitated = self.imitated("orientation")
            if imitated is not None:
                orientation = imitated(self.env.game)
            elif "orientation" in self.learners:
                actor = self.learners["orientation"].actor
                orientation = actor(obs, stochastic_output=True).squeeze(1).long()
            else:
                orientation = self._frozen_orientation()
            ppo.compute_returns(self.env.orient(orientation))
        for name, ppo in self.learners.items():
            if self.imitated(name) is not None:
                ppo.storage.advantages = torch.ones_like(ppo.storage.advantages)

    # --- the update -------------------------------------------------------------------------------

    def update(self) -> dict[str, float]:
        """One PPO update of each learner.

        Returns:
            For each learner ``name/value``, ``name/surrogate``, ``name/entropy`` (means over the
            minibatches), ``name/kl`` (old to new policy, after the update), ``name/learning_rate``;
            and ``afterstates``, the squared error of what placements were thought worth.
        """
        losses: dict[str, float] = {}
        for name in self.learners:
            self.anneal(name)
        if self.afterstates is not None:
            losses["afterstates"] = self._learn_afterstates(self.afterstates)
        for name, ppo in self.learners.items():
            if self.schedules[name]["symmetry"]:
                see_through_symmetries(ppo, name)
            losses |= {f"{name}/{key}": value for key, value in ppo.update().items()}
            losses[f"{name}/kl"] = self._divergence(ppo)
            losses[f"{name}/learning_rate"] = ppo.learning_rate
        self.iteration += 1
        if self.afterstates is not None:
            assert self._last is not None
            self.env.look_again(self._last)
        return losses

    def _learn_afterstates(self, learner: AfterstateLearner) -> float:
        """Teach the critic of afterstates what the first learner's placements have brought."""
        ppo = next(iter(self.learners.values()))
        processes = ppo.gpu_world_size if ppo.is_multi_gpu else 1
        storage = ppo.storage
        return learner.learn(storage.returns, storage.rewards, ppo.learning_rate, processes)

    def anneal(self, name: str) -> None:
        """Set learning rate and entropy bonus as this iteration's share of the run says."""
        ppo, schedule = self.learners[name], self.schedules[name]
        done = min(1.0, self.iteration / max(1, self.iterations))
        first, last = schedule["entropy_coef"], schedule["final_entropy_coef"]
        ppo.entropy_coef = first + done * (last - first)
        if schedule["schedule"] == "linear":
            ppo.learning_rate = schedule["learning_rate"] * (1 - done)
            for group in ppo.optimizer.param_groups:
                group["lr"] = ppo.learning_rate

    @staticmethod
    def _divergence(ppo: PPO) -> float:
        """Mean KL(old || new) over states of the last rollout, spread evenly through it."""
        storage = ppo.storage
        total = storage.num_envs * storage.num_transitions_per_env
        chosen = torch.arange(0, total, -(-total // KL_SAMPLES), device=storage.device)
        with torch.inference_mode():
            ppo.actor(storage.observations.flatten(0, 1)[chosen], stochastic_output=True)
            old = tuple(p.flatten(0, 1)[chosen] for p in storage.distribution_params)
            new = ppo.actor.output_distribution_params
            return float(ppo.actor.get_kl_divergence(old, new).mean())

    # --- what else the runner asks ----------------------------------------------------------------

    @property
    def learning_rate(self) -> float:
        """The first learner's; each one's own is among the losses."""
        return float(next(iter(self.learners.values())).learning_rate)

    @property
    def output_std(self) -> Tensor:
        """Spread of the learners' last action distributions (their ``std``)."""
        return torch.cat([ppo.actor.output_std for ppo in self.learners.values()])

    def get_policy(self) -> PackingPPO:
        """Itself: there is more than one actor."""
        return self

    def train_mode(self) -> None:
        """All networks to training mode."""
        for ppo in self.learners.values():
            ppo.train_mode()

    def eval_mode(self) -> None:
        """All networks to evaluation mode."""
        for ppo in self.learners.values():
            ppo.eval_mode()

    def broadcast_parameters(self) -> None:
        """Give all processes the first one's weights."""
        for ppo in self.learners.values():
            ppo.broadcast_parameters()

    def save(self) -> dict[str, Any]:
        """Stock states of the learners' PPOs, by name, and the place in the schedules."""
        kept: dict[str, Any] = {
            "learners": {name: ppo.save() for name, ppo in self.learners.items()},
            "schedule_iteration": self.iteration,
        }
        if self.afterstates is not None:
            kept["afterstates"] = self.afterstates.optimizer.state_dict()
        return kept

    def load(
        self, loaded_dict: dict[str, Any], load_cfg: dict[str, Any] | None, strict: bool
    ) -> bool:
        """Load what :meth:`save` gave; returns whether the iteration is to be loaded too."""
        wanted = True
        for name, ppo in self.learners.items():
            wanted = ppo.load(loaded_dict["learners"][name], load_cfg, strict)
        self.iteration = loaded_dict["schedule_iteration"]
        if self.afterstates is not None:
            self.afterstates.optimizer.load_state_dict(loaded_dict["afterstates"])
            self.env.game.forget(self.afterstates.critic)
        return wanted

    @staticmethod
    def construct_algorithm(
        obs: TensorDict, env: PackingVecEnv, cfg: dict[str, Any], device: str
    ) -> PackingPPO:
        """Build it from the runner's configuration.

        Args:
            obs: an observation.
            env: the bins.
            cfg: ``algorithm`` with ``iterations``; ``agents``: for each agent either ``frozen``
                (what a checkpoint keeps of it) or ``network``, ``algorithm`` (rsl_rl's PPO),
                ``schedule``, ``symmetry`` and, if it imitates, ``imitated`` (as ``frozen``) and
                ``imitate_iterations``.
            device: of the networks.
        """
        rebuild: dict[str, Callable[..., Any]] = {
            "orientation": checkpoint.orientation_agent, "placement": checkpoint.placement_agent,
        }  # fmt: skip
        learners, schedules = {}, {}
        frozen: dict[str, Any] = {}
        imitations = {}
        for name, settings in cfg["agents"].items():
            if settings.get("frozen"):
                frozen[name] = settings["frozen"]
                continue
            seen = obs
            if name == "placement":
                seen = env.orient(torch.zeros(env.num_envs, dtype=torch.int64, device=env.device))
            learners[name] = _stock_ppo(name, settings, seen, env, cfg, device)
            schedules[name] = {**settings["schedule"], "symmetry": settings["symmetry"]}
            if settings.get("imitated"):
                model = rebuild[name]({"agents": {name: settings["imitated"]}}, device, None)
                imitations[name] = Imitation(model, RANDOM[name], settings["imitate_iterations"])
        orientation_agent = placement_agent = None
        if "orientation" in frozen:
            orientation_agent = rebuild["orientation"]({"agents": frozen}, device, None)
        if "placement" in frozen:
            placement_agent = rebuild["placement"]({"agents": frozen}, device, None)
        iterations = cfg["algorithm"]["iterations"]
        afterstates = None
        if env.afterstates is not None:
            afterstates = AfterstateLearner(env.afterstates, cfg["num_steps_per_env"], env.num_envs)
        return PackingPPO(
            learners, orientation_agent, placement_agent, env, schedules, iterations, afterstates,
            imitations,
        )  # fmt: skip


def _stock_ppo(
    name: str,
    settings: Mapping[str, Any],
    obs: TensorDict,
    env: PackingVecEnv,
    cfg: dict[str, Any],
    device: str,
) -> PPO:
    """rsl_rl's own PPO with our actor and critic."""
    network = dict(settings["network"])
    model = {"agent": name, "network": network}
    agent_cfg = {
        "algorithm": {
            "class_name": PPO,
            "share_cnn_encoders": network["share_trunk"],
            **settings["algorithm"],
        },
        "actor": {"class_name": Actor, **model},
        "critic": {"class_name": Critic, **model},
        "obs_groups": {"actor": list(obs.keys()), "critic": list(obs.keys())},
        "num_steps_per_env": cfg["num_steps_per_env"],
        "multi_gpu": cfg["multi_gpu"],
    }
    alone = SimpleNamespace(num_envs=env.num_envs, num_actions=1)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints both networks
        ppo: PPO = PPO.construct_algorithm(obs, alone, agent_cfg, device)
    if ppo.actor.afterstates is not None:
        # One for all agents, in place of the actor's own: rsl_rl would copy what it is given. The
        # optimiser still lists the weights of the other, which never have a gradient.
        ppo.actor.afterstates = env.afterstates
    return ppo
